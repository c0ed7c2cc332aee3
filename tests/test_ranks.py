"""Several ranks: they get the gradients, the statistics and the losses of one process with the joint batch."""

import dataclasses
import itertools

import pytest
import torch
import torch.multiprocessing as mp
from torch import Tensor

from hvnet import ranks
from hvnet.config import Config, load_config
from hvnet.network.model import HVNet
from tests.helpers import ROOT
from tests.models import NARROW

NormCase = tuple[torch.dtype, str, float | None]
BATCHES = [[[0, 1], [2, 3]], [[1], [0]], [[0], [4]], [[4], [5]], [[0, 1], [2]]]
"""The samples of each rank."""
NORMS: list[NormCase] = [
    *itertools.product((torch.float32, torch.bfloat16), ("contiguous", "channels_last", "permuted"), (0.1,)),
    *((torch.float32, "channels_last", momentum) for momentum in (0.0, 1.0, None)),
]
"""The type of the features, how the gradient lies in memory, and the momentum, of which torch takes None for a mean."""
SHARES = slice(3), slice(3, None)
"""The samples of a norm's batch on each rank."""


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


def laid_out(features: Tensor, layout: str) -> Tensor:
    """The same features (B, C, H, W) in memory in another order."""
    if layout == "channels_last":
        return features.contiguous(memory_format=torch.channels_last)
    return features.permute(2, 0, 3, 1).contiguous().permute(1, 3, 0, 2) if layout == "permuted" else features


def normed(case: NormCase, samples: slice, norm: torch.nn.BatchNorm2d) -> dict[str, Tensor]:
    """What a batch norm makes of its samples of two batches of 4, the gradients of the second, and its buffers."""
    dtype, layout, momentum = case
    norm.momentum = momentum
    with torch.no_grad():
        norm.weight.copy_(torch.tensor([0.5, 1.0, -2.0]))
        norm.bias.copy_(torch.tensor([0.0, 0.3, -1.0]))
    generator = torch.Generator().manual_seed(0)
    for _ in range(2):
        features, grads = torch.randn(2, 4, 3, 5, 6, generator=generator)
        features = laid_out((2 * features + 3).to(dtype)[samples], "channels_last").requires_grad_()
        norm.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
            out = norm(features)
        out.backward(laid_out(grads.to(out.dtype)[samples], layout))
    slopes = {"features": features.grad, "weight": norm.weight.grad, "bias": norm.bias.grad}
    found = {name: slope for name, slope in slopes.items() if slope is not None}
    return {"out": out.detach(), **found, **dict(norm.named_buffers())}


def worker(rank: int, out: str, rendezvous: str) -> None:
    torch.distributed.init_process_group("gloo", init_method=rendezvous, rank=rank, world_size=2)
    steps = [one_step(batches[rank]) for batches in BATCHES]
    norms = [normed(case, SHARES[rank], ranks.BatchNorm2d(3)) for case in NORMS]
    torch.save((steps, norms), f"{out}/{rank}.pt")
    ranks.stop()


@pytest.fixture(scope="module")
def of_ranks(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[list, list]]:
    """What each of two ranks found, of every batch and of every norm."""
    folder = tmp_path_factory.mktemp("ranks")
    mp.spawn(worker, args=(str(folder), f"file://{folder}/rendezvous"), nprocs=2)
    return [torch.load(folder / f"{rank}.pt") for rank in (0, 1)]


@pytest.mark.parametrize("k", range(len(BATCHES)), ids=[str(batches) for batches in BATCHES])
def test_two_ranks_give_what_one_gives_with_the_joint_batch(of_ranks: list[tuple[list, list]], k: int) -> None:
    want, losses = one_step(BATCHES[k][0] + BATCHES[k][1])
    for steps, _ in of_ranks:
        found, joint_losses = steps[k]
        assert joint_losses == pytest.approx(losses, rel=1e-4)
        assert found.keys() == want.keys()
        for name, tensor in want.items():
            error = (found[name] - tensor).norm() / tensor.norm().clamp(min=1e-4)
            assert error < 2e-3, (name, error)


@pytest.mark.parametrize("k", range(len(NORMS)), ids=[str(case) for case in NORMS])
def test_the_batch_norm_of_two_ranks_is_that_of_torch(of_ranks: list[tuple[list, list]], k: int) -> None:
    """Three samples on one rank and one on the other; the gradients of weights are each rank's share of a sum."""
    want = normed(NORMS[k], slice(None), torch.nn.BatchNorm2d(3))
    found, other = (norms[k] for _, norms in of_ranks)
    assert found.keys() == want.keys()
    joined = {name: torch.cat((found[name], other[name])) for name in ("out", "features")}
    joined |= {name: found[name] + other[name] for name in ("weight", "bias")}
    tolerance = {"rtol": 2**-7, "atol": 0.01} if NORMS[k][0] == torch.bfloat16 else {"rtol": 1e-5, "atol": 1e-5}
    for name, tensor in want.items():
        for each in [joined[name]] if name in joined else [found[name], other[name]]:
            torch.testing.assert_close(each, tensor, **tolerance, msg=lambda text, name=name: f"{name}: {text}")


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
