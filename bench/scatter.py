"""Scatter and gather between points and voxels of 0.1 to 0.8 m, against torch's own and torch_scatter.

"segments at hand" is the case of a network that scatters over the same voxels more than once, "segments made" includes
the sort. Every case first checks values and gradients of its providers against each other.
"""

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from timing import Bench, Run, Work, agree, parser, read_scene, skipped, start
from torch import Tensor
from torch_encoder import torch_max, torch_mean, torch_scatter

from hvnet.cli import run_command
from hvnet.config import EncoderConfig
from hvnet.kernels import reference
from hvnet.kernels.scatter import (
    Segments,
    gather,
    scatter_max,
    scatter_mean,
    segment_gather,
    segment_max,
    segment_mean,
    segments,
)
from hvnet.kernels.voxel import make_grid, voxel_index

warnings.filterwarnings("ignore", message="index_reduce")  # "in beta"

SIZES = (0.1, 0.2, 0.4, 0.8)  # metres
MEAN = {"rtol": 1e-5, "atol": 1e-6}  # float32 sums in another order; a maximum is exact
ORDERS = ("file", "voxel")

Operation = Callable[[Tensor], Tensor]


class Voxels(NamedTuple):
    """The voxels of one size."""

    voxel: Tensor  # (N,) int64
    size: int  # V
    at_hand: Segments


def index_reduce(src: Tensor, voxels: Voxels, how: str) -> Tensor:
    """torch's index_reduce; an empty row is 0."""
    empty = src.new_zeros(voxels.size, src.shape[1])
    return empty.index_reduce(0, voxels.voxel, src, how, include_self=False)


def scatter_reduce(src: Tensor, voxels: Voxels, how: str) -> Tensor:
    """torch's scatter_reduce; an empty row is 0."""
    rows = voxels.voxel[:, None].expand(-1, src.shape[1])
    return src.new_zeros(voxels.size, src.shape[1]).scatter_reduce(0, rows, src, how, include_self=False)


def maxima(voxels: Voxels) -> dict[str, Operation]:
    """The providers of scatter_max."""
    index, size, at_hand = voxels
    found: dict[str, Operation] = {
        "hvnet, segments at hand": lambda src: segment_max(src, at_hand)[0],
        "hvnet, segments made": lambda src: scatter_max(src, index, size)[0],
        "torch scatter_reduce": lambda src: torch_max(src, index, size),
        "torch index_reduce": lambda src: index_reduce(src, voxels, "amax"),
    }
    if torch_scatter:
        found["torch_scatter"] = lambda src: torch_scatter.scatter_max(src, index, dim=0, dim_size=size)[0]
    return found


def means(voxels: Voxels) -> dict[str, Operation]:
    """The providers of scatter_mean."""
    index, size, at_hand = voxels
    found: dict[str, Operation] = {
        "hvnet, segments at hand": lambda src: segment_mean(src, at_hand),
        "hvnet, segments made": lambda src: scatter_mean(src, index, size),
        "torch index_add": lambda src: torch_mean(src, index, size),
        "torch scatter_reduce": lambda src: scatter_reduce(src, voxels, "mean"),
        "torch index_reduce": lambda src: index_reduce(src, voxels, "mean"),
    }
    if torch_scatter:
        found["torch_scatter"] = lambda src: torch_scatter.scatter_mean(src, index, dim=0, dim_size=size)
    return found


def gathers(voxels: Voxels) -> dict[str, Operation]:
    """The providers of gather."""
    index, _, at_hand = voxels
    return {
        "hvnet, segments at hand": lambda src: segment_gather(src, at_hand),
        "hvnet, segments made": lambda src: gather(src, index),
        "torch src[index]": lambda src: src[index],
        "torch index_select": lambda src: src.index_select(0, index),
    }


def both(operation: Operation, src: Tensor, given: Tensor) -> tuple[Tensor, ...]:
    """Forward and backward: the gradient of src."""
    return torch.autograd.grad(operation(src), src, given)


def compare(bench: Bench, case: str, providers: dict[str, Operation], src: Tensor, want: Tensor, exact: bool) -> None:
    """Checks every provider against the twin's values and the first one's gradient, then times both passes."""
    tolerance = {"rtol": 0.0, "atol": 0.0} if exact else MEAN
    trained = src.clone().requires_grad_()
    given = torch.randn_like(want)
    slope = both(next(iter(providers.values())), trained, given)
    for name, operation in providers.items():
        agree(f"{case}, {name}, values", [operation(src)], [want], **tolerance)
        agree(f"{case}, {name}, gradient", both(operation, trained, given), slope, **MEAN)
    runs: dict[str, Run] = {name: partial(operation, src) for name, operation in providers.items()}
    moved = src.nbytes + want.nbytes + 8 * max(len(src), len(want))
    bench.time(f"{case}, forward", runs, Work(moved))
    runs = {name: partial(both, operation, trained, given) for name, operation in providers.items()}
    bench.time(f"{case}, forward + backward", runs, Work(2 * moved))


def bench_size(bench: Bench, points: Tensor, size: float, order: str) -> None:
    """All operations at one voxel size, over the points in the order of the file or of the voxels."""
    config = EncoderConfig()
    sample = torch.zeros(len(points), dtype=torch.int64, device=points.device)
    index = voxel_index(points, sample, 1, [make_grid(config.point_range, (size, size), 1.0)])
    (of_size,) = index.scales
    voxel, count = of_size.segments.voxel, len(of_size.cursor)
    points = points[index.order]
    at_hand = of_size.segments
    if order == "file":
        back = index.order.argsort()
        points, voxel = points[back], voxel[back]
        at_hand = segments(voxel, count)
    voxels = Voxels(voxel, count, at_hand)
    print(f"\n{size} m: {len(points):,} points in {count:,} voxels, points in the order of the {order}")
    for channels in (64, 128):
        src = torch.randn(len(points), channels, device=points.device)
        want, _ = reference.scatter_max(src, voxel, count)
        compare(bench, f"max, {channels} channels, {size} m", maxima(voxels), src, want, True)
    for name, src in (("4", points), ("64", torch.randn(len(points), 64, device=points.device))):
        want = reference.scatter_mean(src, voxel, count)
        compare(bench, f"mean, {name} channels, {size} m", means(voxels), src, want, False)
    src = torch.randn(count, 64, device=points.device)
    compare(bench, f"gather, 64 channels, {size} m", gathers(voxels), src, reference.gather(src, voxel), True)


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments = parser("scatter", __doc__, repeat=20)
    arguments.add_argument("--points", type=Path, help="a velodyne .bin (default: a generated scene)")
    arguments.add_argument("--max-points", type=int, help="run on the first points only")
    arguments.add_argument(
        "--order", choices=ORDERS, default="file", help="order of the points; the network's is that of voxels"
    )
    args = arguments.parse_args(argv)
    bench = start("scatter", args)
    if not torch_scatter:
        skipped("torch_scatter", "not installed (pip install torch-scatter --no-build-isolation)")
    points = read_scene(args.points)[: args.max_points].to(bench.device)
    bench.machine |= {"points": len(points), "order": args.order}
    for size in SIZES:
        bench_size(bench, points, size, args.order)
    bench.write(args.csv, args.json)


if __name__ == "__main__":
    run_command(main)
