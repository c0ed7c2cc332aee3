"""Rotated IoU and NMS in bird's eye view, against shapely, a numba twin and the plain-Python reference.

Boxes are a detector's candidates: clustered around objects, the better the nearer. Those with an IoU within rounding of
the threshold are left out, so that all providers must keep the very same boxes.
"""

import math
from collections.abc import Sequence
from functools import partial

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from timing import Bench, Run, Work, agree, parser, peak_memory, skipped, start
from torch import Tensor

from hvnet.cli import run_command
from hvnet.exceptions import InputError
from hvnet.kernels import reference
from hvnet.kernels.rotated import rotated_iou_bev, rotated_nms

try:
    import shapely
except ImportError:
    shapely = None

Floats = NDArray[np.float64]

IOU = {"rtol": 0.0, "atol": 2e-5}  # float32 against float64, at coordinates of up to 64 m
MARGIN = 2e-5  # of an IoU to the threshold
PER_OBJECT = 100  # candidates
REFERENCE_LIMIT = 1024  # boxes; the reference takes minutes beyond


def candidates(count: int, threshold: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Boxes (M, 7) float32 and scores (M,) as from the heads: PER_OBJECT around each object, a tenth elsewhere."""
    generator = torch.Generator().manual_seed(seed)
    made = count + count // 20 + 20
    objects = max(1, count // PER_OBJECT)
    centres = torch.rand(objects, 2, generator=generator) * 64 - torch.tensor([0.0, 32.0])
    yaws = torch.rand(objects, generator=generator) * 2 * math.pi
    owner = torch.randint(objects, (made,), generator=generator)
    noise = torch.randn(made, 7, generator=generator)
    boxes = torch.tensor([0.0, 0.0, -0.8, 3.9, 1.7, 1.56, 0.0]).repeat(made, 1)
    boxes += noise * torch.tensor([0.6, 0.6, 0.1, 0.2, 0.1, 0.1, 0.15])
    boxes[:, :2] += centres[owner]
    boxes[:, 6] += yaws[owner]
    scores = torch.exp(-noise[:, :2].square().sum(1) / 2) * torch.rand(made, generator=generator)
    stray = torch.rand(made, generator=generator) < 0.1
    boxes[stray, :2] = torch.rand(int(stray.sum()), 2, generator=generator) * 64 - torch.tensor([0.0, 32.0])
    wide = boxes.double()
    clear = torch.cat([((rotated_iou_bev(rows, wide) - threshold).abs() > MARGIN).all(1) for rows in wide.split(512)])
    boxes, scores = boxes[clear], scores[clear]
    if len(boxes) < count:
        raise InputError(f"--iou: {made - len(boxes)} of {made} boxes are too near to {threshold}; take another one")
    return boxes[:count].contiguous(), scores[:count].contiguous()


@numba.njit(cache=True)
def numba_overlap(a: Floats, b: Floats) -> float:
    """The area that two boxes share: b clipped at the four edges of a (Sutherland and Hodgman, 1974), in a's frame."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    reach = (math.hypot(a[3], a[4]) + math.hypot(b[3], b[4])) / 2
    if dx * dx + dy * dy >= reach * reach:
        return 0.0
    cos, sin = math.cos(a[6]), math.sin(a[6])
    x, y = dx * cos + dy * sin, dy * cos - dx * sin
    cos, sin = math.cos(b[6] - a[6]), math.sin(b[6] - a[6])
    polygon, clipped = np.empty((8, 2)), np.empty((8, 2))
    for k in range(4):
        along = b[3] / 2 if k == 0 or k == 3 else -b[3] / 2
        across = b[4] / 2 if k < 2 else -b[4] / 2
        polygon[k, 0], polygon[k, 1] = x + along * cos - across * sin, y + along * sin + across * cos
    size = 4
    for edge in range(4):
        axis, sign = edge // 2, 1 - 2 * (edge % 2)
        limit = a[3 + axis] / 2
        made = 0
        for k in range(size):
            here, before = polygon[k], polygon[k - 1 if k else size - 1]
            side, last = limit - sign * here[axis], limit - sign * before[axis]
            if (side < 0) != (last < 0):
                t = last / (last - side)
                clipped[made, 0] = before[0] + t * (here[0] - before[0])
                clipped[made, 1] = before[1] + t * (here[1] - before[1])
                made += 1
            if side >= 0:
                clipped[made] = here
                made += 1
        polygon, clipped = clipped, polygon
        size = made
    twice = 0.0
    for k in range(size):
        before = polygon[k - 1 if k else size - 1]
        twice += before[0] * polygon[k, 1] - polygon[k, 0] * before[1]
    return max(twice / 2, 0.0)


@numba.njit(cache=True)
def numba_iou(a: Floats, b: Floats) -> Floats:
    """IoU (A, B) of boxes (A, 7) and (B, 7)."""
    iou = np.empty((len(a), len(b)))
    for i in range(len(a)):
        for j in range(len(b)):
            shared = numba_overlap(a[i], b[j])
            iou[i, j] = shared / (a[i, 3] * a[i, 4] + b[j, 3] * b[j, 4] - shared)
    return iou


@numba.njit(cache=True)
def numba_nms(boxes: Floats, order: NDArray[np.int64], threshold: float) -> NDArray[np.int64]:
    """Greedy NMS: each box that is kept drops the boxes after it; only pairs of boxes still there are compared."""
    dropped = np.zeros(len(order), np.bool_)
    kept = np.empty(len(order), np.int64)
    count = 0
    for i in range(len(order)):
        if dropped[i]:
            continue
        kept[count] = order[i]
        count += 1
        a = boxes[order[i]]
        for j in range(i + 1, len(order)):
            if not dropped[j]:
                b = boxes[order[j]]
                shared = numba_overlap(a, b)
                if shared > threshold * (a[3] * a[4] + b[3] * b[4] - shared):
                    dropped[j] = True
    return kept[:count]


def polygons(boxes: Floats) -> NDArray[np.object_]:
    """Shapely's polygons of boxes (M, 7)."""
    cos, sin = np.cos(boxes[:, 6:]), np.sin(boxes[:, 6:])
    along = boxes[:, 3:4] / 2 * np.array([1, -1, -1, 1])
    across = boxes[:, 4:5] / 2 * np.array([1, 1, -1, -1])
    corners = np.stack((along * cos - across * sin, along * sin + across * cos), axis=2)
    return shapely.polygons(corners + boxes[:, None, :2])


def shapely_iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU (A, B), clipping only the pairs whose bounds meet in shapely's tree."""
    first, second = polygons(a.double().cpu().numpy()), polygons(b.double().cpu().numpy())
    i, j = shapely.STRtree(second).query(first)
    shared = shapely.area(shapely.intersection(first[i], second[j]))
    iou = np.zeros((len(a), len(b)))
    iou[i, j] = shared / (shapely.area(first[i]) + shapely.area(second[j]) - shared)
    return torch.from_numpy(iou)


def shapely_nms(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """Greedy NMS; a box that is kept is clipped with those left of its neighbours in shapely's tree."""
    order = scores.argsort(descending=True, stable=True).cpu().numpy()
    shapes = polygons(boxes.double().cpu().numpy()[order])
    area = shapely.area(shapes)
    i, j = shapely.STRtree(shapes).query(shapes)
    i, j = i[i < j], j[i < j]
    by_box = np.argsort(i, kind="stable")
    starts = np.searchsorted(i[by_box], np.arange(len(order) + 1))
    j = j[by_box]
    dropped = np.zeros(len(order), bool)
    for k in range(len(order)):
        near = j[starts[k] : starts[k + 1]]
        near = near[~dropped[near]]
        if dropped[k] or not len(near):
            continue
        shared = shapely.area(shapely.intersection(shapes[k], shapes[near]))
        dropped[near[shared > threshold * (area[k] + area[near] - shared)]] = True
    return torch.from_numpy(order[~dropped])


def numba_iou_of(a: Tensor, b: Tensor) -> Tensor:
    """numba_iou of tensors."""
    return torch.from_numpy(numba_iou(a.double().cpu().numpy(), b.double().cpu().numpy()))


def numba_nms_of(boxes: Tensor, scores: Tensor, threshold: float) -> Tensor:
    """numba_nms of tensors."""
    order = scores.argsort(descending=True, stable=True).cpu().numpy()
    return torch.from_numpy(numba_nms(boxes.double().cpu().numpy(), order, threshold))


def bench_iou(bench: Bench, count: int, threshold: float) -> None:
    """The matrix of all candidates."""
    boxes = candidates(count, threshold)[0].to(bench.device)
    functions = {"hvnet": rotated_iou_bev, "numba twin": numba_iou_of}
    if shapely:
        functions["shapely, STRtree"] = shapely_iou
    if count <= REFERENCE_LIMIT:
        functions["reference, plain Python"] = reference.rotated_iou_bev
    want = numba_iou_of(boxes, boxes)
    for name, function in functions.items():
        agree(f"IoU, {name}", [function(boxes, boxes)], [want], **IOU)
    runs: dict[str, Run] = {name: partial(function, boxes, boxes) for name, function in functions.items()}
    bench.time(f"IoU matrix, {count:,} x {count:,}", runs, Work(2 * boxes.nbytes + 4 * count**2))


def bench_nms(bench: Bench, count: int, threshold: float) -> None:
    """NMS of all candidates in one pass; memory is that of torch's allocator, whose arrays Warp's kernels work on."""
    boxes, scores = (tensor.to(bench.device) for tensor in candidates(count, threshold))
    functions = {"hvnet": rotated_nms, "numba twin": numba_nms_of}
    if shapely:
        functions["shapely, STRtree"] = shapely_nms
    if count <= REFERENCE_LIMIT:
        functions["reference, plain Python"] = reference.rotated_nms
    want = numba_nms_of(boxes, scores, threshold)
    for name, function in functions.items():
        agree(f"NMS, {name}", [function(boxes, scores, threshold)], [want], 0, 0)
    runs: dict[str, Run] = {name: partial(function, boxes, scores, threshold) for name, function in functions.items()}
    bench.time(f"NMS, {count:,} boxes, {len(want):,} kept", runs)
    held = peak_memory(runs["hvnet"], bench.device) / 1e6
    print(f"  hvnet holds {held:.1f} MB at most; a float32 matrix of all pairs has {4 * count**2 / 1e6:.1f} MB")


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments = parser("rotated", __doc__, repeat=10)
    arguments.add_argument("--boxes", type=int, nargs="+", default=[1024, 4096, 10000], help="candidates of the NMS")
    arguments.add_argument("--matrix", type=int, nargs="+", default=[512, 2048], help="boxes of the IoU matrix")
    arguments.add_argument("--iou", type=float, default=0.4, help="threshold of the NMS (default: 0.4, a Car's)")
    args = arguments.parse_args(argv)
    if min(args.boxes + args.matrix) < 1 or not 0 <= args.iou < 1:
        raise InputError("--boxes, --matrix and --iou: want 1 or more boxes and a threshold of 0 to below 1")
    bench = start("rotated", args)
    bench.machine["iou"] = args.iou
    if not shapely:
        skipped("shapely", "not installed (pip install shapely)")
    for count in args.matrix:
        bench_iou(bench, count, args.iou)
    for count in args.boxes:
        bench_nms(bench, count, args.iou)
    bench.write(args.csv, args.json)


if __name__ == "__main__":
    run_command(main)
