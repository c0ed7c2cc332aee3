"""A race detector: every thread of a CPU launch alone, from the memory before the launch; then all writes are joined.

Two threads that write to one place conflict. If all threads together give something else than the writes joined, a
thread reads what another one writes. `python -m tests.races` runs small versions of all that the package does, and
prints a JSON tree of what was found; it needs a process of its own (see `thread_order`).
"""

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import numpy as np
import torch
import warp as wp
from cuda_kernels import builtins_of, name_of, uses_atomics

from hvnet.config import load_config
from hvnet.kernels import launch, rotated, scatter, voxel
from hvnet.kernels.raycast import raycast
from hvnet.network.detector import Detector
from hvnet.network.encoder import HybridVoxelEncoder
from hvnet.network.fused import FusedEncoder
from hvnet.network.model import HVNet
from tests import thread_order
from tests.encoders import SMALL, cloud, trained
from tests.helpers import random_boxes
from tests.models import CONFIGS, NARROW, some_points
from tests.models import SMALL as DETECTOR_CONFIG

INDIVISIBLE = ["encoder.feature_channels=3", "encoder.image_channels=5"]
"""Channels that no vector length divides, so that one thread takes the same kernels as many."""


MOST_BYTES = 500_000_000
"""That are compared for a launch."""


@dataclass
class Seen:
    """What was seen of a kernel."""

    atomics: bool
    serial: bool  # its source asks for no thread
    launches: int = 0
    threads: int = 0  # of the largest launch
    faults: list[str] = field(default_factory=list)


def faults_of(command: wp.Launch, memory: Sequence[np.ndarray]) -> list[str]:
    """Launches a recorded command, and says what its threads do to each other in the memory (bytes) given to it."""
    faults = set()
    before = [part.copy() for part in memory]
    joined = [part.copy() for part in memory]
    written = [np.zeros(part.shape, bool) for part in memory]
    # one thread a part; where that takes too long, some that chance has put together
    parts = min(command.bounds.size, max(2, MOST_BYTES // max(1, sum(part.nbytes for part in memory))))
    for part in range(parts):
        command.bounds.coord_mult = (parts << thread_order.PARTS) + part
        command.launch()
        for now, old, all_writes, taken in zip(memory, before, joined, written, strict=True):
            changed = np.flatnonzero(now != old)
            if taken[changed].any():
                faults.add("two threads write to one place")
            all_writes[changed], taken[changed] = now[changed], True
            now[changed] = old[changed]
    command.launch()  # all, in a random order: coord_mult is 1 again
    if any((now != all_writes).any() for now, all_writes in zip(memory, joined, strict=True)):
        faults.add("a thread depends on what another writes")
    return sorted(faults)


def watched(run: Callable[[], object]) -> dict[str, Seen]:
    """Runs a function with every launch of Warp checked: what was seen of each kernel, by name."""
    seen: dict[str, Seen] = {}
    real = wp.launch

    def checked(kernel: wp.Kernel, dim: Any, inputs: Sequence[Any], **options: Any) -> None:
        command = real(kernel, dim=dim, inputs=inputs, record_cmd=True, **options)
        if command is None:  # no thread
            return
        # the tensors of a bare descriptor, as `launch.array` makes it, and of a Warp array
        given = [getattr(each, "_tensor", getattr(each, "_ref", None)) for each in inputs]
        tensors = [each for each in given if each is not None]
        storages = {tensor.untyped_storage().data_ptr(): tensor.untyped_storage() for tensor in tensors}
        memory = [torch.empty(0, dtype=torch.uint8).set_(each).numpy() for each in storages.values() if len(each)]
        found = seen.setdefault(name_of(kernel), Seen(uses_atomics(kernel), "tid" not in builtins_of(kernel)))
        found.launches += 1
        found.threads = max(found.threads, command.bounds.size)
        found.faults = sorted({*found.faults, *faults_of(command, memory)})

    with mock.patch.object(wp, "launch", checked):
        run()
    return seen


def encode() -> None:
    """The encoder in training and in inference, with scales that nest and with others."""
    for changes in ({}, {"projection_scales": (1.5, 3.0)}, {"vfe": "plain"}):
        config = dataclasses.replace(SMALL, feature_channels=3, image_channels=5, **changes)
        images = HybridVoxelEncoder(config)(*cloud(60), 2)
        torch.stack([image.square().sum() for image in images]).sum().backward()
    fused = FusedEncoder(trained(dataclasses.replace(SMALL, feature_channels=3, image_channels=5)))
    for seed in (0, 1):  # the second one clears what the first has left
        fused(*cloud(60, seed), 2)


def detect() -> None:
    """From points to boxes, and a training step's losses."""
    torch.manual_seed(0)
    model = HVNet(load_config(CONFIGS / "demo.yaml", [*DETECTOR_CONFIG, *NARROW, *INDIVISIBLE]))
    points = some_points(60)
    boxes, labels = [random_boxes(4, 0, centre=5.0).float()], [torch.tensor([0, 0, 1, 2])]
    terms = model(points, torch.zeros(len(points), dtype=torch.int64), boxes, labels)
    torch.stack(list(terms.values())).sum().backward()
    Detector(model.eval(), torch.device("cpu"), torch.float32, ground=-1.7).batch([points, points[:40]])


def overlap() -> None:
    """Rotated boxes."""
    a, b, scores = random_boxes(70, 1).float(), random_boxes(6, 2).float(), torch.rand(70)
    rotated.rotated_iou_bev(a, b)
    rotated.rotated_iou_3d(a, b)
    rotated.rotated_overlap_pairs(a, a.flip(0))
    rotated.rotated_nms(a, scores, 0.1)
    rotated.rotated_match(a, b, torch.tensor([0, 2, 6]))


def scattered() -> None:
    """Scatter, gather, cursors and rays."""
    src, index = torch.randn(50, 3, requires_grad=True), torch.randint(9, (50,))
    with torch.no_grad():
        src[7] = math.nan
    scatter.scatter_max(src, index, 10)[0].sum().backward()
    scatter.scatter_mean(src, index, 10).sum().backward()
    scatter.gather(src, index).sum().backward()
    points = some_points(50)
    voxel.cursors(
        points, torch.zeros(50, dtype=torch.int64), voxel.make_grid((0, -3.2, -3, 12.8, 3.2, 2), (0.4, 0.4), 1)
    )
    rays = torch.nn.functional.normalize(torch.randn(50, 3), dim=1)
    raycast(torch.randn(60, 3), torch.arange(60).view(20, 3), torch.zeros(50, 3), rays, 9.0)


WORKLOADS = (encode, detect, overlap, scattered)


@wp.kernel(enable_backward=False, module="unique")
def reads_a_neighbour(x: wp.array(dtype=float)):
    """Planted: what it reads another thread writes."""
    i = wp.tid()
    x[i] = x[(i + 1) % x.shape[0]] + 1.0


@wp.kernel(enable_backward=False, module="unique")
def writes_one_place(x: wp.array(dtype=float)):
    """Planted: all threads write there."""
    x[0] = float(wp.tid() + 1)


@wp.kernel(enable_backward=False, module="unique")
def keeps_to_itself(x: wp.array(dtype=float)):
    """Has no fault."""
    i = wp.tid()
    x[i] = x[i] + 1.0


PLANTED = (reads_a_neighbour, writes_one_place, keeps_to_itself)


def workloads() -> None:
    """All of them, as a GPU works and as a CPU does."""
    for many_threads in (True, False):
        with mock.patch.object(launch, "force_many_threads", many_threads):
            for run in WORKLOADS:
                run()


def planted() -> None:
    """The kernels that are meant to be found, and one that is not."""
    for kernel in PLANTED:
        x = torch.zeros(10)
        launch.launch(kernel, len(x), [launch.array(x)], x.device)


if __name__ == "__main__":
    thread_order.install()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    trees = {run.__name__: {name: vars(seen) for name, seen in watched(run).items()} for run in (workloads, planted)}
    json.dump(trees, sys.stdout)
