"""Twins of the kernels in plain torch and numpy, for tests and benchmarks only.

The names and signatures are those of the kernels. Twins aim to be obvious, not fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from .scatter import Segments
    from .voxel import Grid

Box = Sequence[float]  # x, y, z, l, w, h, yaw in metres and radians
Polygon = list[tuple[float, float]]  # corners in metres, counter-clockwise


class Voxels(NamedTuple):
    """The voxels of one scale; see voxel.Voxels. Here they are numbered by ascending cursor."""

    cursor: Tensor  # (V,) int64
    voxel: Tensor  # (K,) int64
    starts: Tensor  # (V + 1,) int64
    order: Tensor | None  # (K,) int64


class VoxelIndex(NamedTuple):
    """The voxels of every scale; see voxel.VoxelIndex. Here the kept points stay in the order of the input."""

    order: Tensor  # (K,) int64
    scales: list[Voxels]


def cursors(points: Tensor, sample: Tensor, grid: Grid) -> Tensor:
    """Eq. 1: the cell (N,) int64 of each point (N, 4) float32 in metres, in sample (N,) int64; -1 outside the grid.

    A point that is not finite is outside.
    """
    reciprocal = torch.tensor([1 / grid.cell[0], 1 / grid.cell[1]], dtype=torch.float32, device=points.device)
    origin = torch.tensor([grid.x_min, grid.y_min], dtype=torch.float32, device=points.device)
    cell = torch.floor((points[:, :2] - origin) * reciprocal)  # (N, 2) float32: the range is tested before the cast
    inside = (cell >= 0).all(1) & (cell[:, 0] < grid.cells[0]) & (cell[:, 1] < grid.cells[1])
    inside &= (points[:, 2] >= grid.z_min) & (points[:, 2] < grid.z_max) & points[:, 3].isfinite()
    ix, iy = cell.where(inside[:, None], 0).long().unbind(1)
    return ((sample * grid.shape[0] + ix) * grid.shape[1] + iy).where(inside, -1)


def hash_index(cursor: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct cursors (V,) in ascending order, and which of them each of the cursors (N,) int64 is: (N,) int64."""
    return torch.unique(cursor, return_inverse=True)


def voxel_index(points: Tensor, sample: Tensor, batch_size: int, grids: Sequence[Grid]) -> VoxelIndex:
    """The voxels that points (N, 4) of samples (N,) fill in every grid; a point outside one grid leaves all of them."""
    of_grid = [cursors(points, sample, grid) for grid in grids]
    order = torch.stack([cursor >= 0 for cursor in of_grid]).all(0).nonzero()[:, 0]
    scales = []
    for cursor in of_grid:
        unique, index = hash_index(cursor[order])
        ends = torch.bincount(index, minlength=len(unique)).cumsum(0)
        scales.append(Voxels(unique, index, torch.cat((ends.new_zeros(1), ends)), index.argsort(stable=True)))
    return VoxelIndex(order, scales)


def scatter_max(src: Tensor, index: Tensor, dim_size: int) -> tuple[Tensor, Tensor]:
    """The largest of src (N, C) in each row that index (N,) names: values and arg-max, both (dim_size, C).

    A NaN is the maximum of its row, a tie goes to the largest point index, an empty row is 0 with arg-max N.
    """
    count, channels = src.shape
    rows = index[:, None].expand(-1, channels)
    lowest = src.new_full((dim_size, channels), -torch.inf)
    largest = lowest.scatter_reduce(0, rows, src.detach(), "amax")  # NaN where a row holds one
    wins = (src == largest[index]) | src.isnan()
    position = torch.arange(count, device=src.device)[:, None].where(wins, -1)
    argmax = torch.full_like(largest, -1, dtype=torch.int64).scatter_reduce(0, rows, position, "amax")
    argmax = argmax.where(argmax >= 0, count)
    return torch.cat((src, src.new_zeros(1, channels))).gather(0, argmax), argmax


def scatter_mean(src: Tensor, index: Tensor, dim_size: int) -> Tensor:
    """The mean of src (N, C) in each row that index (N,) names: (dim_size, C); an empty row is 0."""
    total = src.new_zeros(dim_size, src.shape[1]).index_add(0, index, src)
    return total / torch.bincount(index, minlength=dim_size).clamp(min=1)[:, None]


def gather(src: Tensor, index: Tensor) -> Tensor:
    """The rows of src (V, C) that index (N,) names: (N, C)."""
    return src[index]


def _corners(box: Box, x: float, y: float) -> Polygon:
    """Corners of a box in bird's eye view with its centre moved to (x, y)."""
    cos, sin = math.cos(box[6]), math.sin(box[6])
    half = ((box[3] / 2, box[4] / 2), (-box[3] / 2, box[4] / 2), (-box[3] / 2, -box[4] / 2), (box[3] / 2, -box[4] / 2))
    return [(x + along * cos - across * sin, y + along * sin + across * cos) for along, across in half]


def _clip(polygon: Polygon, start: tuple[float, float], end: tuple[float, float]) -> Polygon:
    """The part of a convex polygon on the left of the line from start to end (Sutherland and Hodgman, 1974)."""
    dx, dy = end[0] - start[0], end[1] - start[1]
    side = [dx * (y - start[1]) - dy * (x - start[0]) for x, y in polygon]
    clipped = []
    for k, (x, y) in enumerate(polygon):
        if (side[k - 1] < 0) != (side[k] < 0):
            before_x, before_y = polygon[k - 1]
            t = side[k - 1] / (side[k - 1] - side[k])
            clipped.append((before_x + t * (x - before_x), before_y + t * (y - before_y)))
        if side[k] >= 0:
            clipped.append((x, y))
    return clipped


def _overlap(a: Box, b: Box) -> float:
    """Area in square metres that two boxes share in bird's eye view, in coordinates about the centre of a."""
    if list(a[:2]) == list(b[:2]) and list(a[3:5]) == list(b[3:5]) and a[6] == b[6]:
        return a[3] * a[4]  # so that a box's IoU with itself is exactly 1
    x, y = b[0] - a[0], b[1] - a[1]
    if math.hypot(x, y) > (math.hypot(a[3], a[4]) + math.hypot(b[3], b[4])) / 2:
        return 0.0
    polygon, window = _corners(a, 0.0, 0.0), _corners(b, x, y)
    for k in range(4):
        polygon = _clip(polygon, window[k - 1], window[k])
    twice = sum(polygon[k - 1][0] * polygon[k][1] - polygon[k][0] * polygon[k - 1][1] for k in range(len(polygon)))
    return max(twice / 2, 0.0)


def _ratio(shared: float, a: float, b: float) -> float:
    """Intersection over union of two sizes, 0 where one of them is 0."""
    return min(shared / (a + b - shared), 1.0) if a > 0 and b > 0 else 0.0


def _iou_bev(a: Box, b: Box) -> float:
    return _ratio(_overlap(a, b), a[3] * a[4], b[3] * b[4])


def _iou_3d(a: Box, b: Box) -> float:
    height = max(min(a[5], b[5], (a[5] + b[5]) / 2 - abs(a[2] - b[2])), 0.0)
    return _ratio(_overlap(a, b) * height, a[3] * a[4] * a[5], b[3] * b[4] * b[5])


def attend(
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
    voxels: Segments,
    relu: bool = False,
    keep: bool = True,
) -> tuple[Tensor, Tensor]:
    """M (N, C) and its maxima (V, C): features (N, C) times the attention W g + b of points (N, 4) in their voxels.

    The layer (11, C) is that of g = (x - mean x, f, mean p) of Eq. 2, its bias, and the scale and shift of the
    features; see encode.attend.
    """
    attention = knowledge(points, mean, voxels.voxel) @ layer[:9]
    features = features * layer[9] + layer[10]
    if relu:
        features, attention = features.relu(), attention.relu()
    product = features * attention
    values, _ = scatter_max(product, voxels.voxel, len(mean))
    return product if keep else product[:0], values


def write_image(features: Tensor, cursor: Tensor, cells: int) -> Tensor:
    """Eq. 3: features (V, C) at their cursors (V,) of an image (cells, C) of zeros."""
    return features.new_zeros(cells, features.shape[1]).index_copy(0, cursor, features)


def column_sums(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Sums (C,) of the columns of rows (N, C), and of their squares, in float64."""
    return rows.double().sum(dim=0), rows.double().square().sum(dim=0)


def knowledge(points: Tensor, mean: Tensor, voxel: Tensor) -> Tensor:
    """Eq. 2 and a 1 for the bias (N, 9), of points (N, 4) in voxels (N,) of means (V, 4)."""
    rows = [
        torch.cat((p[:3] - mean[v, :3], p[3:], mean[v], p.new_ones(1)))
        for p, v in zip(points, voxel.tolist(), strict=True)
    ]
    return torch.stack(rows) if rows else points.new_zeros(0, 9)


def rotated_overlap_pairs(a: Tensor, b: Tensor) -> Tensor:
    """Areas (P,) in square metres that the boxes a (P, 7) and b (P, 7) share pairwise in bird's eye view."""
    return a.new_tensor([_overlap(p, q) for p, q in zip(a.tolist(), b.tolist(), strict=True)])


def rotated_iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """IoU (A, B) of boxes a (A, 7) and b (B, 7) in bird's eye view, by polygon clipping in float64."""
    return a.new_tensor([[_iou_bev(p, q) for q in b.tolist()] for p in a.tolist()]).reshape(len(a), len(b))


def rotated_iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """IoU (A, B) of boxes a (A, 7) and b (B, 7) in 3D: the shared area times the shared height."""
    return a.new_tensor([[_iou_3d(p, q) for q in b.tolist()] for p in a.tolist()]).reshape(len(a), len(b))


def rotated_nms(boxes: Tensor, scores: Tensor, iou_threshold: float) -> Tensor:
    """Indices (K,) of the boxes (M, 7) kept, best of the scores (M,) first; of equal scores the lower index is better.

    A box is dropped iff its IoU in bird's eye view with a better box that is kept exceeds the threshold, or if its
    score is NaN.
    """
    rows, is_number = boxes.tolist(), scores == scores
    kept: list[int] = []
    for k in scores.argsort(descending=True, stable=True).tolist():
        if is_number[k] and all(_iou_bev(rows[k], rows[better]) <= iou_threshold for better in kept):
            kept.append(k)
    return torch.tensor(kept, dtype=torch.int64, device=boxes.device)


def nms_groups(boxes: Tensor, valid: Tensor, counts: Tensor, iou_thresholds: Tensor, limit: int) -> Tensor:
    """Which boxes (G, M, 7 or more) are kept (G, M).

    From the first on, of the first counts[g] of a group g that are valid, all whose IoU with those kept before does not
    exceed iou_thresholds[g % T], `limit` at most.
    """
    keep = torch.zeros_like(valid)
    for g, rows in enumerate(boxes.tolist()):
        kept: list[int] = []
        for k in valid[g, : int(counts[g])].nonzero()[:, 0].tolist():
            threshold = iou_thresholds[g % len(iou_thresholds)]
            if len(kept) < limit and all(_iou_bev(rows[k], rows[better]) <= threshold for better in kept):
                kept.append(k)
        keep[g, kept] = True
    return keep


def _box_of(row: Sequence[float], degrees: bool) -> Box:
    """The box of (cx, cy, w, h, angle), with the y axis of an image, which points down, turned up."""
    cx, cy, w, h, angle = row
    return [cx, -cy, 0.0, w, h, 0.0, math.radians(angle) if degrees else angle]


def box_iou_rotated(a: Tensor, b: Tensor, *, degrees: bool = True) -> Tensor:
    """IoU (A, B) of boxes a (A, 5) and b (B, 5), (cx, cy, w, h, angle) as torchvision and detectron2 have them."""
    first, second = ([_box_of(row, degrees) for row in boxes.tolist()] for boxes in (a, b))
    return a.new_tensor([[_iou_bev(p, q) for q in second] for p in first]).reshape(len(a), len(b))


def nms_rotated(boxes: Tensor, scores: Tensor, iou_threshold: float, *, degrees: bool = True) -> Tensor:
    """`rotated_nms` of boxes (M, 5) as `box_iou_rotated` has them."""
    turned = torch.tensor([_box_of(row, degrees) for row in boxes.tolist()], dtype=torch.float64).reshape(-1, 7)
    return rotated_nms(turned, scores.cpu(), iou_threshold).to(boxes.device)


def batched_nms_rotated(
    boxes: Tensor, scores: Tensor, idxs: Tensor, iou_threshold: float, *, degrees: bool = True
) -> Tensor:
    """One `nms_rotated` for each of the groups that idxs (M,) names; the indices kept of all, best score first."""
    kept = []
    for group in idxs.unique():
        members = (idxs == group).nonzero()[:, 0]
        kept.append(members[nms_rotated(boxes[members], scores[members], iou_threshold, degrees=degrees)])
    merged = torch.cat(kept).sort().values if kept else torch.zeros_like(idxs, dtype=torch.int64)
    return merged[scores[merged].argsort(descending=True, stable=True)]


def rotated_match(
    anchors: Tensor, boxes: Tensor, starts: Tensor, *, labels: Tensor | None = None, classes: int = 1
) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs anchors (A, 7) with the boxes (M, 7) of every sample b, which are boxes[starts[b]:starts[b + 1]].

    With labels (A,) of the anchors, those of class k see boxes[starts[g]:starts[g + 1]], g = b * classes + k.

    Returns each anchor's highest IoU in bird's eye view (B, A) and the index of that box (B, A), and each box's best
    anchor (M,). Ties go to the lowest index; what overlaps nothing has IoU 0 and index -1.
    """
    if labels is None:
        labels = torch.zeros(len(anchors), dtype=torch.int64, device=anchors.device)
    iou = rotated_iou_bev(anchors, boxes)  # (A, M)
    highest = iou.new_zeros((len(starts) - 1) // classes, len(anchors))
    match = torch.full_like(highest, -1, dtype=torch.int64)
    for group, (start, end) in enumerate(pairwise(starts.tolist())):
        sample, seeing = group // classes, labels == group % classes
        iou[~seeing, start:end] = 0
        if end > start:
            best_iou, box = iou[seeing, start:end].max(1)  # of equal ones the first
            highest[sample, seeing] = best_iou
            match[sample, seeing] = (box + start).where(best_iou > 0, -1)
    best = torch.full((len(boxes),), -1, dtype=torch.int64, device=iou.device)
    if len(anchors):
        best = iou.argmax(0).where(iou.amax(0) > 0, best)
    return highest, match, best


def raycast(
    vertices: Tensor, faces: Tensor, origins: Tensor, directions: Tensor, max_range: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The first of the faces (F, 3) over vertices (V, 3) that each of R rays meets: every ray against every face.

    Distance (R,), face (R,) and normal (R, 3); inf, -1 and 0 where nothing is met (Moeller and Trumbore, 1997).
    """
    a, b, c = vertices.double()[faces.long()].unbind(1)  # (F, 3) each
    ab, ac = b - a, c - a
    ray = directions.double()[:, None]  # (R, 1, 3)
    offset = origins.double()[:, None] - a  # (R, F, 3)
    across = torch.linalg.cross(ray.expand_as(offset), ac.expand_as(offset))
    along = torch.linalg.cross(offset, ab.expand_as(offset))
    scale = (across * ab).sum(-1)  # (R, F), 0 where the ray is parallel to the face
    u, v, t = (across * offset).sum(-1) / scale, (along * ray).sum(-1) / scale, (along * ac).sum(-1) / scale
    meets = (scale != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t < max_range)
    none = torch.full((len(origins), 1), math.inf, dtype=torch.float64, device=vertices.device)
    distance, face = torch.cat((none, t.where(meets, math.inf)), dim=1).min(dim=1)  # column 0: nothing met
    face -= 1
    normals = torch.nn.functional.normalize(torch.linalg.cross(ab, ac), dim=1)  # (F, 3)
    normal = torch.zeros(len(origins), 3, dtype=torch.float64, device=vertices.device)
    normal[face >= 0] = normals[face[face >= 0]]
    return distance.float(), face, normal.float()
