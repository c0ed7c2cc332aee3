"""Several ranks: they get the gradients, the statistics and the losses of one process with the joint batch."""

import dataclasses
from pathlib import Path

import pytest
import torch
import torch.multiprocessing as mp
from torch import Tensor

from hvnet import ranks
from hvnet.config import Config, load_config
from hvnet.network.model import HVNet
from tests.helpers import ROOT
from tests.models import NARROW


def small() -> Config:
    config = load_config(ROOT / "configs" / "demo.yaml", NARROW)
    return dataclasses.replace(config, backbone=dataclasses.replace(config.backbone, layers=(2, 2, 2)))


def cloud(b: int) -> tuple[Tensor, Tensor, Tensor]:
    """Points, boxes and labels of sample b; they differ in size, one has no box, those from 4 on no point."""
    generator = torch.Generator().manual_seed(b)
    low, high = torch.tensor([0.0, -3.2, -3.0, 0.0]), torch.tensor([12.8, 3.2, 2.0, 1.0])
    points = low + torch.rand(200 + 90 * b if b < 4 else 0, 4, generator=generator) * (high - low)
    boxes = torch.tensor([[4.0 + b, 0.5, -0.7, 3.9, 1.6, 1.5, 0.3], [8.0, -1.0 - b / 4, -0.6, 0.8, 0.8, 1.7, 1.0]])
    return points, boxes[: 2 * (b != 1)], torch.tensor([0, 1])[: 2 * (b != 1)]


def one_step(batch: list[int]) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Gradients and buffers after a forward and a backward pass, and the losses of all ranks."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    model = HVNet(small()).train()
    joint = ranks.wrap_ddp(model)
    points, boxes, labels = zip(*(cloud(b) for b in batch), strict=True)
    sample = torch.repeat_interleave(torch.arange(len(batch)), torch.tensor([len(p) for p in points]))
    terms = joint(torch.cat(points), sample, list(boxes), list(labels))
    loss = torch.stack(list(terms.values())).sum()
    (ranks.size() * loss).backward()
    tensors = {
        f"gradient of {name}": weight.grad for name, weight in model.named_parameters() if weight.grad is not None
    }
    tensors |= {name: buffer for name, buffer in model.named_buffers() if "running" in name}
    assert all(tensor.isfinite().all() for tensor in tensors.values())
    return tensors, {name: ranks.all_reduce(term.detach()).item() for name, term in terms.items()}


def worker(rank: int, out: str, rendezvous: str, batches: list[list[int]]) -> None:
    torch.distributed.init_process_group("gloo", init_method=rendezvous, rank=rank, world_size=2)
    torch.save(one_step(batches[rank]), f"{out}/{rank}.pt")
    ranks.stop()


@pytest.mark.parametrize("batches", [[[0, 1], [2, 3]], [[1], [0]], [[0], [4]], [[4], [5]]])
def test_two_ranks_give_what_one_gives_with_the_joint_batch(tmp_path: Path, batches: list[list[int]]) -> None:
    want, losses = one_step(batches[0] + batches[1])
    mp.spawn(worker, args=(str(tmp_path), f"file://{tmp_path}/rendezvous", batches), nprocs=2)
    for rank in (0, 1):
        found, of_ranks = torch.load(tmp_path / f"{rank}.pt")
        assert of_ranks == pytest.approx(losses, rel=1e-4)
        assert found.keys() == want.keys()
        for name, tensor in want.items():
            error = (found[name] - tensor).norm() / tensor.norm().clamp(min=1e-4)
            assert error < 2e-3, (name, error)


def test_a_process_alone() -> None:
    assert ranks.start(torch.device("cpu")) == torch.device("cpu")
    assert (ranks.size(), ranks.rank()) == (1, 0)
    value = torch.ones(3)
    assert ranks.all_reduce(value) is value
    assert ranks.broadcast("this") == "this"
    assert ranks.all_gather("this") == ["this"]
    features = torch.randn(2, 3, 4, 5)
    own, plain = ranks.BatchNorm2d(3), torch.nn.BatchNorm2d(3)
    assert torch.equal(own(features), plain(features))
