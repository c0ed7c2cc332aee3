"""A GPU's frame and training step on tensors without data: all on one device, nothing copied to it, nothing read."""

import contextlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from fake_cuda import CUDA, ReadsDevice, Record, ToHost, fake_cuda, index_of_known_length
from torch import Tensor

from hvnet.config import load_config
from hvnet.network.detector import Detector
from hvnet.network.model import HVNet
from tests.models import CONFIGS

POINTS = 65536


def after_warm_up(run: Callable[[], object], record: Record) -> Counter[str]:
    """Runs a function twice: the copies from the host of the second time. A copy to the host ends a run."""
    for _ in range(2):
        record.from_host.clear()
        record.to_host.clear()
        with contextlib.suppress(ToHost):
            run()
    return record.from_host


def frame(detector: Detector, batch_size: int) -> object:
    """From points to the table of boxes, as the detector goes."""
    points, counts = torch.empty(batch_size, POINTS, 4, device=CUDA), torch.empty(batch_size, device=CUDA).int()
    return detector.numbers(points, counts, torch.zeros(batch_size * POINTS, device=CUDA).long())


def step(model: HVNet, batch_size: int) -> object:
    """From points to losses, as training goes."""
    boxes = [torch.empty(6, 7, device=CUDA) for _ in range(batch_size)]
    labels = [torch.zeros(6, device=CUDA).long() for _ in range(batch_size)]
    return model(torch.empty(POINTS, 4, device=CUDA), torch.zeros(POINTS, device=CUDA).long(), boxes, labels)


@pytest.mark.parametrize(("config", "batch_size"), [("hvnet", 1), ("compact", 2)])
def test_a_frame_asks_the_host_for_nothing(config: str, batch_size: int) -> None:
    with fake_cuda() as record, torch.no_grad():
        detector = Detector(HVNet(load_config(CONFIGS / f"{config}.yaml")).eval(), CUDA, ground=-1.7)
        assert after_warm_up(lambda: frame(detector, batch_size), record) == Counter()
        assert record.to_host == Counter()
        assert record.launches.total() > 10


@pytest.mark.parametrize("config", ["hvnet", "compact"])
def test_a_training_step_reads_no_value(config: str) -> None:
    """But the lengths of the index, which `index_of_known_length` stands for. Without gradients, which fakes lack."""
    with fake_cuda(voxel_index=index_of_known_length) as record, torch.no_grad():
        model = HVNet(load_config(CONFIGS / f"{config}.yaml")).to(CUDA).train()
        assert after_warm_up(lambda: step(model, 2), record) == Counter()
        assert record.to_host == Counter()
        assert record.launches.total() > 10


def test_a_planted_copy_is_found() -> None:
    def copies() -> Tensor:
        x = torch.zeros(4, device=CUDA)
        return x.new_tensor([1, 2, 3, 4]) * x + torch.tensor([1.0, 2, 3, 4], device=CUDA) + torch.ones(4).to(CUDA)

    with fake_cuda() as record:
        found = after_warm_up(copies, record)
    assert found.total() == 3
    assert all(each.startswith(f"{Path(__file__).name}:") for each in found)


@pytest.mark.parametrize(
    "reads",
    [
        lambda x: x.sum().item(),
        lambda x: x.tolist(),
        lambda x: bool((x > 0).any()),
        lambda x: x.nonzero(),
        lambda x: x[x > 0],
    ],
)
def test_a_planted_read_is_found(reads: Callable[[Tensor], object]) -> None:
    with fake_cuda(), pytest.raises(ReadsDevice, match=r"test_fake_cuda.py:\d+: "):
        reads(torch.zeros(4, device=CUDA))


def test_another_device_is_found() -> None:
    with fake_cuda(), pytest.raises(RuntimeError, match="device"):
        torch.zeros(4, device=CUDA) + torch.zeros(4)


@pytest.mark.parametrize(
    "take",
    [
        lambda x, rows: x[0],
        lambda x, rows: x[1:3],
        lambda x, rows: x[:, 2],
        lambda x, rows: x[..., -1],
        lambda x, rows: x[None, 0],
        lambda x, rows: x[0, ..., None],
        lambda x, rows: x[rows],
        lambda x, rows: x[:, rows],
        lambda x, rows: x[rows, rows + 1],
    ],
)
def test_indexing_is_that_of_torch(take: Callable[[Tensor, Tensor], Tensor]) -> None:
    expected = take(torch.zeros(4, 5, 6), torch.tensor([0, 2])).shape
    with fake_cuda():
        assert take(torch.zeros(4, 5, 6, device=CUDA), torch.tensor([0, 2], device=CUDA)).shape == expected
