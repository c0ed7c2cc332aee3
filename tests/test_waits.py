"""Training does not wait for a GPU: what would read it is counted, on the CPU, which works as a GPU does."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest
import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from hvnet.config import Config
from hvnet.data.gt_database import load_database
from hvnet.data.insert import sampler_of
from hvnet.data.kitti import KittiFrames
from hvnet.kernels import launch
from hvnet.training.batches import Batch, TrainingFrames, collate, kitti_data
from hvnet.training.run import Run

READS = {f"aten::{name}" for name in ("_local_scalar_dense", "nonzero", "masked_select", "equal", "bincount")}
READS |= {f"aten::{name}" for name in ("_unique2", "unique_dim", "unique_consecutive", "repeat_interleave")}
COPIES = {"aten::lift_fresh"}  # of torch.tensor and new_tensor: numbers of the host


@pytest.fixture(autouse=True)
def many_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "force_many_threads", True)


def waits(work: Callable[[], object]) -> list[str]:
    """The operations of `work`, those inside of ops included, for which the host would wait."""
    found: list[str] = []

    def counted(name: str) -> mock._patch:
        """On the CPU these are no operations of torch's."""
        plain = getattr(Tensor, name)

        def call(tensor: Tensor, *arguments: object, **options: object) -> object:
            found.append(name)
            return plain(tensor, *arguments, **options)

        return mock.patch.object(Tensor, name, call)

    with counted("tolist"), counted("cpu"), counted("numpy"), profile(activities=[ProfilerActivity.CPU]) as recorded:
        work()
    events = recorded.events()
    assert events is not None
    for event in events:
        parent = event.cpu_parent and event.cpu_parent.cpu_parent
        if event.name in READS | COPIES and (parent is None or parent.name != "aten::_fused_adam_"):
            found.append(event.name)  # the fused step of a CPU, not that of a GPU, reads the numbers of its steps
    return found


def test_what_waits_is_counted() -> None:
    values = torch.arange(3)
    assert waits(lambda: values[values > 1]) == ["aten::nonzero"]
    assert waits(lambda: values.sum().item()) == ["aten::_local_scalar_dense"]
    assert waits(lambda: bool(values.any())) == ["aten::_local_scalar_dense"]
    assert waits(lambda: values.tolist()) == ["tolist"]
    assert waits(lambda: values.cpu().numpy()) == ["cpu", "numpy"]
    assert waits(lambda: values.new_tensor([1, 2])) == ["aten::lift_fresh"]
    assert waits(lambda: torch.where(values > 1, values, 0).cumsum(0)) == []


@pytest.mark.parametrize("changed", ["nothing", "loss.box", "skip_non_finite", "average"])
def test_a_step_waits_for_the_encoder_alone(scenes: Path, tiny: Config, tmp_path: Path, changed: str) -> None:
    """... and reading the losses is one wait, for however many steps."""
    config = tiny
    if changed == "loss.box":
        head, loss = dataclasses.replace(tiny.head, iou=True), dataclasses.replace(tiny.loss, box="giou")
        config = dataclasses.replace(tiny, head=head, loss=loss)
    if changed == "skip_non_finite":
        config = dataclasses.replace(tiny, train=dataclasses.replace(tiny.train, skip_non_finite=True))
    if changed == "average":
        config = dataclasses.replace(tiny, train=dataclasses.replace(tiny.train, average=0.999))
    run = Run(config, kitti_data(scenes, config), tmp_path / "run", "cpu")
    run.model.train()
    batches = [batch.to(torch.device("cpu")) for batch in run.loader]
    with mock.patch.object(Batch, "to", lambda batch, _: batch):
        run.step(batches[0])  # makes what is made once
        of_step = waits(lambda: run.step(batches[1]))
    of_encoder = waits(lambda: run.model.encoder(batches[1].points, batches[1].sample, len(batches[1].boxes)))
    assert of_step == of_encoder
    assert of_encoder == ["tolist"]  # the lengths of its index
    assert waits(run.read_steps) == ["tolist"]
    assert sum(map(len, batches[1].boxes)) > 3


def test_augmentation_reads_no_point(scenes: Path, tiny: Config) -> None:
    """On the device "meta" there are shapes and no numbers: what reads one raises."""
    meta = torch.device("meta")
    objects = sampler_of(load_database(scenes, ["000000", "000001", "000002"], []))
    changes = {"mix": 0.5, "whole_frames": 0.5, "fewer_beams": 1.0, "no_reflectance": 0.5, "pitch": 0.02}
    config = dataclasses.replace(tiny, augment=dataclasses.replace(tiny.augment, **changes))
    frames = TrainingFrames(KittiFrames(scenes, ["000000", "000001", "000002"]), config, objects, meta)
    batch = collate([frames[epoch, k] for epoch in range(4) for k in range(3)])
    assert isinstance(batch, Batch)
    assert batch.points.device == batch.sample.device == meta
    assert len(batch.points) == len(batch.sample)
    assert {boxes.device.type for boxes in batch.boxes} == {"cpu"}
    batch.to(meta)
