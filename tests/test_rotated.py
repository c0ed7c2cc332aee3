"""Rotated IoU, NMS and matching against shapely in float64, hand-made cases and their twins."""

import functools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import torch
from torch import Tensor

from hvnet.kernels import reference, rotated
from hvnet.kernels.launch import many_threads
from tests.helpers import random_boxes

DTYPES = (torch.float32, torch.float64)
# float64: the reference itself rounds corners at 1e4 m to 2e-12 m. float32: sine, cosine and corners about the centre
# carry a few 6e-8 of the box's length, times its outline over its area (up to 10 here)
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}


def polygons(boxes: Tensor) -> np.ndarray:
    """Shapely polygons (M,) of boxes (M, 7), of the very numbers given, in float64."""
    x, y, _, length, width, _, yaw = boxes.double().numpy().T
    along, across = np.array([1, -1, -1, 1]) / 2 * length[:, None], np.array([1, 1, -1, -1]) / 2 * width[:, None]
    cos, sin = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    corners = np.stack((x[:, None] + along * cos - across * sin, y[:, None] + along * sin + across * cos), axis=-1)
    return shapely.polygons(corners)


def shapely_iou(a: Tensor, b: Tensor, heights: bool = False) -> Tensor:
    """IoU (A, B) float64 in BEV, or in 3D."""
    shared = torch.from_numpy(shapely.area(shapely.intersection(polygons(a)[:, None], polygons(b)[None])))
    a, b = a.double()[:, None], b.double()[None]
    size_a, size_b = a[..., 3] * a[..., 4], b[..., 3] * b[..., 4]
    if heights:
        top = torch.minimum(a[..., 2] + a[..., 5] / 2, b[..., 2] + b[..., 5] / 2)
        bottom = torch.maximum(a[..., 2] - a[..., 5] / 2, b[..., 2] - b[..., 5] / 2)
        shared, size_a, size_b = shared * (top - bottom).clamp(min=0), size_a * a[..., 5], size_b * b[..., 5]
    return shared / (size_a + size_b - shared)


def box(
    x: float, y: float, length: float, width: float, yaw: float = 0.0, z: float = 0.0, height: float = 1.0
) -> Tensor:
    return torch.tensor([[x, y, z, length, width, height, yaw]], dtype=torch.float64)


def equals(actual: Tensor, expected: Tensor, tolerance: float) -> None:
    torch.testing.assert_close(actual.cpu().double(), expected.double(), rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(
    ("scale", "centre"),
    [(1, 0), (1e-3, 0), (1e3, 0), (1, 1e4), (1e-3, 1)],
    ids=["near", "tiny", "huge", "far", "tiny off"],
)
def test_random_boxes(scale: float, centre: float, dtype: torch.dtype, device: torch.device) -> None:
    """3,600 pairs. Far boxes are as exact as near ones: the difference of two near floats has no rounding."""
    a, b = random_boxes(60, 1, 4, scale, centre).to(dtype), random_boxes(60, 2, 4, scale, centre).to(dtype)
    bev, solid = rotated.rotated_iou_bev(a.to(device), b.to(device)), rotated.rotated_iou_3d(a.to(device), b.to(device))
    assert bev.dtype == solid.dtype == dtype
    for actual, heights in ((bev, False), (solid, True)):
        expected = shapely_iou(a, b, heights)
        assert (expected > 0).any()
        assert (expected == 0).any()
        assert actual.min() >= 0
        assert actual.max() <= 1
        equals(actual, expected, TOLERANCE[dtype])
    equals(bev, reference.rotated_iou_bev(a.double(), b.double()), TOLERANCE[dtype])
    equals(solid, reference.rotated_iou_3d(a.double(), b.double()), TOLERANCE[dtype])
    equals(rotated.rotated_iou_bev(b.to(device), a.to(device)).T, bev.cpu(), TOLERANCE[dtype])


@functools.cache
def boxes_that_overlap(scale: float, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes (M, 7), and by shapely which pairs (M, M) are apart and which share an area."""
    boxes = random_boxes(300, 14, 10, scale).to(dtype)
    area = polygons(boxes)
    apart = torch.from_numpy(shapely.distance(area[:, None], area[None]) > 1e-3 * scale)
    shared = torch.from_numpy(shapely.area(shapely.intersection(area[:, None], area[None])) > 1e-6 * scale**2)
    return boxes, apart, shared


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("scale", [1e-3, 1, 1e3])
def test_overlap_is_seen_exactly(scale: float, dtype: torch.dtype, device: torch.device) -> None:
    """A thousandth of a scale apart is an IoU of 0, not a rounding: matching and NMS ask whether it is above 0."""
    boxes, apart, shared = boxes_that_overlap(scale, dtype)
    for iou in (rotated.rotated_iou_bev, rotated.rotated_iou_3d):
        assert not iou(boxes.to(device), boxes.to(device)).cpu()[apart].any()
    assert rotated.rotated_iou_bev(boxes.to(device), boxes.to(device)).cpu()[shared].all()
    first, second = apart.nonzero().unbind(1)
    assert not rotated.rotated_overlap_pairs(boxes[first].to(device), boxes[second].to(device)).any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_overlap_of_pairs(dtype: torch.dtype, device: torch.device) -> None:
    a, b = random_boxes(2000, 3).to(dtype), random_boxes(2000, 4).to(dtype)
    areas = rotated.rotated_overlap_pairs(a.to(device), b.to(device))
    assert areas.shape == (2000,)
    expected = torch.from_numpy(shapely.area(shapely.intersection(polygons(a), polygons(b))))
    equals(areas, expected, 25 * TOLERANCE[dtype])  # in square metres: up to 25
    equals(areas, reference.rotated_overlap_pairs(a.double(), b.double()), 25 * TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("centre", [0, 37.3, 1e4])
def test_identical_boxes(centre: float, dtype: torch.dtype, device: torch.device) -> None:
    """Exactly 1 for equal numbers; a half-turn gives the same rectangle, a quarter-turn of a square too."""
    boxes = random_boxes(200, 5, 50, centre=centre).to(device, dtype)
    boxes[:4, 6] = torch.tensor([0, math.pi / 2, -math.pi, math.pi / 4])
    one = torch.ones(200, dtype=torch.float64)
    for iou in (rotated.rotated_iou_bev, rotated.rotated_iou_3d):
        assert torch.equal(iou(boxes, boxes).diagonal().cpu().double(), one)
    turned = boxes.clone()
    turned[:, 6] += math.pi  # in float32 a yaw of up to 2 pi is off by 5e-7
    equals(rotated.rotated_iou_bev(boxes, turned).diagonal(), one, TOLERANCE[dtype])
    equals(rotated.rotated_iou_3d(boxes, turned).diagonal(), one, TOLERANCE[dtype])
    square = boxes.clone()
    square[:, 4] = square[:, 3]
    turned = square.clone()
    turned[:, 6] += math.pi / 2
    equals(rotated.rotated_iou_bev(square, turned).diagonal(), one, TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("yaw", [0.0, 0.3, math.pi / 4, math.pi / 2, -2.0, math.pi])
def test_hand_made_pairs(yaw: float, dtype: torch.dtype, device: torch.device) -> None:
    """Known areas, with the whole scene turned by yaw about the origin."""
    pairs = [
        (box(0, 0, 4, 2), box(0, 0, 2, 1), 2.0),  # contained
        (box(0, 0, 4, 2), box(1, 0.5, 2, 1), 2.0),  # contained, in a corner
        (box(0, 0, 4, 2), box(4, 0, 4, 2), 0.0),  # touching edges
        (box(0, 0, 4, 2), box(4, 2, 4, 2), 0.0),  # touching corners
        (box(0, 0, 4, 2), box(1, 0, 4, 2), 6.0),  # two edges in line
        (box(0, 0, 4, 2), box(0, 0, 2, 4), 4.0),  # a cross
        (box(0, 0, 2, 2), box(0, 0, 2, 2, math.pi / 4), 8 * (math.sqrt(2) - 1)),  # an octagon
        (box(0, 0, 2, 2), box(1, 1, 2, 2, math.pi / 4), 1.0),  # the centre of each on an edge or corner of the other
        (box(0, 0, 2, 2), box(1 + math.sqrt(2), 0, 2, 2, math.pi / 4), 0.0),  # a corner touches an edge
        (box(0, 0, 2, 2), box(3, 3, 2, 2, math.pi / 4), 0.0),  # apart, though their upright bounds meet
        (box(0, 0, 100, 0.5), box(0, 0, 0.5, 100), 0.25),  # slender
    ]
    turn = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]], dtype=torch.float64)
    a, b = (torch.cat([pair[side] for pair in pairs]) for side in (0, 1))
    area = torch.tensor([pair[2] for pair in pairs], dtype=torch.float64)
    for boxes in (a, b):
        boxes[:, :2] = boxes[:, :2] @ turn.T
        boxes[:, 6] += yaw
    a, b = a.to(device, dtype), b.to(device, dtype)
    equals(rotated.rotated_overlap_pairs(a, b), area, 2 * TOLERANCE[dtype])
    union = (a[:, 3] * a[:, 4] + b[:, 3] * b[:, 4]).cpu().double() - area
    equals(rotated.rotated_iou_bev(a, b).diagonal(), area / union, TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", DTYPES)
def test_almost_equal_boxes(dtype: torch.dtype, device: torch.device) -> None:
    """Edges that almost coincide are where clipping by point-in-box tests loses corners."""
    generator = np.random.default_rng(6)
    a = random_boxes(3000, 7)
    noise = generator.normal(size=(3000, 7)) * 10.0 ** generator.uniform(-12, -2, (3000, 1))
    b = a + torch.from_numpy(noise * (generator.random((3000, 7)) < 0.4))
    b[::3, 6] += math.pi
    a, b = a.to(dtype), b.to(dtype)
    actual = rotated.rotated_overlap_pairs(a.to(device), b.to(device))
    expected = reference.rotated_overlap_pairs(a.double(), b.double())
    equals(actual, expected, 25 * TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", DTYPES)
def test_slender_boxes(dtype: torch.dtype, device: torch.device) -> None:
    """100 m by 1 cm: a rounding of the yaw (3e-8) moves the ends by 1.5e-6 m of the 0.01 m."""
    a, b = random_boxes(60, 8), random_boxes(60, 9)
    for boxes in (a, b):
        boxes[:, 3], boxes[:, 4] = 100, 0.01
    b[:30, :2], b[:30, 6] = a[:30, :2], a[:30, 6]
    b[10:20, 1] += 0.003
    b[20:30, 6] += 1e-4
    a, b = a.to(dtype), b.to(dtype)
    actual = rotated.rotated_iou_bev(a.to(device), b.to(device))
    equals(actual, shapely_iou(a, b), 200 * TOLERANCE[dtype])


@pytest.mark.parametrize("dtype", DTYPES)
def test_boxes_without_area(dtype: torch.dtype, device: torch.device) -> None:
    flat = torch.cat((box(0, 0, 0, 0), box(0, 0, 4, 0), box(0, 0, 0, 2, 0.7), box(0, 0, 4, 2, height=0.0)))
    flat, whole = flat.to(device, dtype), box(0, 0, 4, 2).to(device, dtype)
    for other in (flat, whole):
        assert not rotated.rotated_iou_bev(flat[:3], other).any()
        assert not rotated.rotated_iou_3d(flat, other).any()
        assert not rotated.rotated_iou_bev(other, flat[:3]).any()
        assert not rotated.rotated_iou_3d(other, flat).any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_heights(dtype: torch.dtype, device: torch.device) -> None:
    """z is the box's centre."""
    a = box(0, 0, 4, 2, z=-1.0, height=2.0)
    b = torch.cat([box(0, 0, 4, 2, z=z, height=h) for z, h in ((-1, 2), (0, 2), (1, 2), (1.5, 2), (-1, 1), (9, 1))])
    iou = rotated.rotated_iou_3d(a.to(device, dtype), b.to(device, dtype))
    equals(iou, torch.tensor([[1, 1 / 3, 0, 0, 0.5, 0]]), 1e-7)


def test_no_boxes(device: torch.device) -> None:
    none, some = torch.zeros(0, 7, device=device), random_boxes(3, 10).float().to(device)
    for iou in (rotated.rotated_iou_bev, rotated.rotated_iou_3d):
        assert iou(none, some).shape == (0, 3)
        assert iou(some, none).shape == (3, 0)
        assert iou(none, none).shape == (0, 0)
    assert rotated.rotated_overlap_pairs(none, none).shape == (0,)
    kept = rotated.rotated_nms(none, torch.zeros(0, device=device), 0.5)
    assert kept.shape == (0,)
    assert kept.dtype == torch.int64


def test_layout_does_not_matter(device: torch.device) -> None:
    a, b = random_boxes(20, 11).float().to(device), random_boxes(20, 12).float().to(device)
    scores = torch.rand(20, generator=torch.Generator().manual_seed(0)).to(device)
    wide = torch.full((20, 14), 9.0, device=device)
    wide[:, ::2] = a
    for view in (wide[:, ::2], a.t().contiguous().t()):
        assert torch.equal(rotated.rotated_iou_bev(view, b), rotated.rotated_iou_bev(a, b))
        assert torch.equal(rotated.rotated_iou_3d(b, view), rotated.rotated_iou_3d(b, a))
        assert torch.equal(rotated.rotated_overlap_pairs(view, b), rotated.rotated_overlap_pairs(a, b))
        two = torch.stack((scores, scores), dim=1)[:, 0]
        assert torch.equal(rotated.rotated_nms(view, two, 0.2), rotated.rotated_nms(a, scores, 0.2))
        starts = torch.tensor([0, 9, 5, 9, 20, 9], device=device)[::2]
        for first, second in zip(
            rotated.rotated_match(view, b, starts), rotated.rotated_match(a, b, starts.clone()), strict=True
        ):
            assert torch.equal(first, second)


@functools.cache
def boxes_to_suppress(count: int, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes (M, 7), scores (M,), and the IoU (M, M) by the twin."""
    boxes = random_boxes(count, 14, spread=10).to(dtype)
    scores = torch.rand(count, generator=torch.Generator().manual_seed(count)).to(dtype)
    return boxes, scores, reference.rotated_iou_bev(boxes.double(), boxes.double())


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("threshold", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("count", [1, 2, 63, 64, 65, 129, 400])
def test_nms_equals_twin(count: int, threshold: float, dtype: torch.dtype, device: torch.device) -> None:
    boxes, scores, iou = boxes_to_suppress(count, dtype)
    if threshold:  # no pair so near to the threshold that rounding decides
        assert not ((iou - threshold).abs() < 1e-5).any()
    kept = rotated.rotated_nms(boxes.to(device), scores.to(device), threshold)
    assert kept.dtype == torch.int64
    assert kept.tolist() == reference.rotated_nms(boxes, scores, threshold).tolist()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("count", [0, 1, 64, 65, 300])
def test_nms_of_one_thread_and_of_many(count: int, dtype: torch.dtype, device: torch.device) -> None:
    """The CPU goes through the boxes in one thread, a GPU masks them in many: here both ways on one device."""
    boxes = random_boxes(count, 26, spread=8).to(device, dtype)
    keep = torch.rand(count, generator=torch.Generator().manual_seed(0)).to(device) > 0.2  # some have a NaN score
    serial, parallel = keep.clone(), keep.clone()
    rotated._suppress_serially(boxes, 0.1, serial)
    rotated._suppress_in_parallel(boxes, 0.1, parallel)
    assert torch.equal(serial, parallel)
    assert not (serial & ~keep).any()


@functools.cache
def groups_to_suppress(dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    """Boxes (6, 130, 7), which of them are valid (6, 130), how many count (6,), and of every group the IoU by the twin.

    Groups without a box, with a few, with one word and one more, and full ones.
    """
    counts = torch.tensor([0, 1, 64, 65, 130, 999], dtype=torch.int32)  # the last: all that there are
    boxes = random_boxes(6 * 130, 31, spread=9).to(dtype).view(6, 130, 7)
    valid = torch.rand(6, 130, generator=torch.Generator().manual_seed(0)) > 0.1
    boxes[2, ~valid[2]] = torch.nan
    ious = [reference.rotated_iou_bev(*[group.double().nan_to_num(0.0)] * 2) for group in boxes]
    for b in range(6):  # what only fills up the array would change the result, were it looked at
        boxes[b, counts[b] :] = boxes[b, 0].nan_to_num(1.0)
    return boxes, valid, counts, ious


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("limit", [0, 7, 200])
@pytest.mark.parametrize("thresholds", [(0.1,), (0.02, 0.4, 0.7)])
def test_nms_of_groups_equals_twin(
    thresholds: tuple[float, ...], limit: int, dtype: torch.dtype, device: torch.device
) -> None:
    """Each group has its own threshold."""
    boxes, valid, counts, ious = groups_to_suppress(dtype)
    for iou, threshold in zip(ious, thresholds * 6, strict=False):  # no pair that rounding decides
        assert not ((iou - threshold).abs() < 1e-5).any()
    given = boxes, valid, counts, torch.tensor(thresholds, dtype=dtype)
    kept = rotated.nms_groups(*(each.to(device) for each in given), limit)
    assert torch.equal(kept.cpu(), reference.nms_groups(*given, limit))
    assert kept.sum(dim=1).tolist()[:2] == [0, int(valid[1, 0]) * min(limit, 1)]
    assert kept.sum(dim=1).max() <= limit
    if limit == 200:
        assert 10 < kept[5].sum() < 120
    wide = torch.cat((boxes, torch.full((6, 130, 3), torch.nan, dtype=dtype)), dim=2)
    for rows in (wide, wide[..., :7]):
        assert torch.equal(kept, rotated.nms_groups(rows.to(device), *(each.to(device) for each in given[1:]), limit))


def test_bad_groups() -> None:
    boxes, valid, counts = torch.ones(2, 3, 7), torch.ones(2, 3, dtype=torch.bool), torch.ones(2, dtype=torch.int32)
    for change, error, said in (
        ({"boxes": boxes[0]}, ValueError, r"boxes: want shape \(any, any, any\)"),
        ({"boxes": boxes[..., :6]}, ValueError, "boxes: want 7 columns or more, got 6"),
        ({"valid": valid[:1]}, ValueError, r"valid: want shape \(2, 3\)"),
        ({"valid": counts}, TypeError, "valid: want dtype"),
        ({"counts": counts.long()}, TypeError, "counts: want dtype"),
        ({"iou_thresholds": torch.ones(2).double()}, TypeError, "iou_thresholds: want dtype"),
        ({"iou_thresholds": torch.ones(0)}, ValueError, "iou_thresholds: want one or more"),
        ({"limit": -1}, ValueError, "limit: want 0 or more"),
    ):
        given = {"boxes": boxes, "valid": valid, "counts": counts, "iou_thresholds": torch.ones(2), "limit": 9}
        with pytest.raises(error, match=said):
            rotated.nms_groups(**(given | change))  # type: ignore[arg-type]


@pytest.mark.parametrize("dtype", DTYPES)
def test_nms_by_hand(dtype: torch.dtype, device: torch.device) -> None:
    def kept(boxes: list[Tensor], scores: list[float], threshold: float) -> list[int]:
        given = torch.cat(boxes).to(device, dtype), torch.tensor(scores, dtype=dtype, device=device)
        return rotated.rotated_nms(*given, threshold).tolist()

    chain = [box(1.5 * k, 0, 4, 2) for k in range(5)]  # neighbours 5/11, next but one 1/7
    assert kept(chain, [5, 4, 3, 2, 1], 0.3) == [0, 2, 4]  # what 1 would drop is kept: 0 has dropped 1
    assert kept(chain, [1, 5, 2, 4, 3], 0.3) == [1, 3]
    assert kept(chain, [5, 4, 3, 2, 1], 0.1) == [0, 3]
    same = [box(0, 0, 4, 2, 0.3)] * 4
    assert kept(same, [0.5] * 4, 0.5) == [0]  # equal scores: the lower index
    assert kept(same, [-0.0, 0.0, -0.0, 0.0], 0.5) == [0]  # zeros are equal
    assert kept(same, [0.5, 0.7, 0.7, 0.1], 0.5) == [1]
    assert kept(same, [0.1, 0.2, 0.3, 0.4], 1.0) == [3, 2, 1, 0]  # an IoU of 1 is not above 1
    assert kept(same, [math.nan, 0.2, math.nan, 0.4], 0.5) == [3]  # NaN is never kept, and drops nothing
    assert kept(same, [math.nan] * 4, 0.5) == []
    apart = [box(10.0 * k, 0, 4, 2) for k in range(6)]
    assert kept(apart, [1, 2, 2, 0, 2, 1], 0.5) == [1, 2, 4, 0, 5, 3]
    assert kept(apart, [0, math.inf, -math.inf, -5, 5, 0], 0.5) == [1, 4, 0, 5, 3, 2]
    touching = [box(0, 0, 4, 2), box(4, 0, 4, 2)]
    assert kept(touching, [1, 2], 0.0) == [1, 0]
    half = [box(0, 0, 2, 2), box(0, 0, 2, 1)]
    assert kept(half, [1, 2], 0.5) == [1, 0]  # dropped above the threshold, not at it
    assert kept(half, [1, 2], 0.49) == [1]


@pytest.mark.parametrize("dtype", DTYPES)
def test_match_by_hand(dtype: torch.dtype, device: torch.device) -> None:
    anchors = torch.cat([box(0, 0, 4, 2), box(2, 0, 4, 2), box(2, 0, 4, 2), box(50, 0, 4, 2)])
    boxes = torch.cat(
        [
            box(1, 0, 4, 2),  # sample 0: 3/5 with anchors 0, 1 and 2, a tie
            box(1, 0, 4, 2),  # the same again: a tie for the anchors
            box(-90, 0, 4, 2),  # overlaps nothing
            box(2, 0, 2, 4),  # sample 2: 1/3 with anchors 1 and 2, 1/7 with 0
            box(3, 0, 4, 2),  # 3/5 with anchors 1 and 2, 1/7 with 0: a tie for anchor 0
        ]
    )
    starts = torch.tensor([0, 3, 3, 5])
    iou, match, best = rotated.rotated_match(anchors.to(device, dtype), boxes.to(device, dtype), starts.to(device))
    expected = torch.tensor([[3 / 5, 3 / 5, 3 / 5, 0], [0, 0, 0, 0], [1 / 7, 3 / 5, 3 / 5, 0]])
    equals(iou, expected, 1e-7)
    assert iou.dtype == dtype
    assert match.tolist() == [[0, 0, 0, -1], [-1] * 4, [3, 4, 4, -1]]
    assert best.tolist() == [0, 0, -1, 1, 1]


@pytest.mark.parametrize("dtype", DTYPES)
def test_match_equals_matrix(dtype: torch.dtype, device: torch.device) -> None:
    anchors, boxes = random_boxes(700, 14, 30).to(dtype), random_boxes(40, 15, 30).to(dtype)
    starts = torch.tensor([0, 15, 15, 33, 40])
    anchors[350:] = anchors[:350]  # every anchor twice: the first wins
    actual = rotated.rotated_match(anchors.to(device), boxes.to(device), starts.to(device))
    expected = reference.rotated_match(anchors.double(), boxes.double(), starts)
    equals(actual[0], expected[0], TOLERANCE[dtype])
    assert (expected[0] > 0.3).any()
    assert torch.equal(actual[1].cpu(), expected[1])
    assert torch.equal(actual[2].cpu(), expected[2])
    assert actual[2].max() < 350


def test_match_agrees_with_iou(device: torch.device) -> None:
    """The same arithmetic as the matrix, for more anchors than one block or one launch holds."""
    anchors, boxes = random_boxes(70_001, 16, 60).float().to(device), random_boxes(6, 17, 60).float().to(device)
    iou, match, best = rotated.rotated_match(anchors, boxes, torch.tensor([0, 6], device=device))
    matrix = rotated.rotated_iou_bev(anchors, boxes)
    assert torch.equal(iou[0], matrix.amax(1))
    assert torch.equal(match[0], matrix.argmax(1).where(matrix.amax(1) > 0, -1))
    assert torch.equal(best, matrix.argmax(0))


def test_match_of_boxes_that_are_not_finite(device: torch.device, threads: None) -> None:
    """They match nothing, and the others as without them."""
    anchors, boxes = random_boxes(200, 16, 8).float().to(device), random_boxes(12, 17, 8).float().to(device)
    padded = torch.full((24, 7), math.nan, device=device)
    padded[1::2] = boxes
    padded[0, 0], padded[2, 6], padded[4, 3] = 0.0, math.inf, math.inf
    iou, match, best = rotated.rotated_match(anchors, boxes, torch.tensor([0, 5, 12], device=device))
    found = rotated.rotated_match(anchors, padded, torch.tensor([0, 10, 24], device=device))
    assert torch.equal(found[0], iou)
    assert torch.equal(found[1], torch.where(match < 0, -1, 2 * match + 1))
    assert torch.equal(found[2][1::2], best)
    assert (found[2][0::2] == -1).all()


@pytest.mark.parametrize("dtype", DTYPES)
def test_match_of_classes(dtype: torch.dtype, device: torch.device, threads: None) -> None:
    """What each class has alone, and what the twin says; a class without anchors, and one without boxes."""
    anchors, boxes = random_boxes(600, 14, 12).to(dtype), random_boxes(40, 15, 12).to(dtype)
    labels, starts = torch.arange(600) % 3 * 2 % 5, torch.tensor([0, 8, 12, 12, 15, 20, 20, 26, 27, 30, 40])
    given = (anchors.to(device), boxes.to(device), starts.to(device))
    iou, match, best = rotated.rotated_match(*given, labels=labels.to(device), classes=5)
    expected = reference.rotated_match(anchors.double(), boxes.double(), starts, labels=labels, classes=5)
    equals(iou, expected[0], TOLERANCE[dtype])
    assert torch.equal(match.cpu(), expected[1])
    assert torch.equal(best.cpu(), expected[2])
    for sample in range(2):
        for k in range(5):
            of_class, (start, end) = labels == k, starts[5 * sample + k :][:2].tolist()
            alone = rotated.rotated_match(
                anchors[of_class].to(device), boxes[start:end].to(device), torch.tensor([0, end - start], device=device)
            )
            assert torch.equal(iou[sample, of_class], alone[0][0])
            assert torch.equal(match[sample, of_class], torch.where(alone[1][0] < 0, -1, alone[1][0] + start))
            rows = of_class.nonzero()[:, 0].to(device)
            none = best[start:end] < 0
            assert torch.equal(none, alone[2] < 0)
            assert torch.equal(best[start:end][~none], rows[alone[2][~none]])


def test_match_reads_no_box_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many threads check no start, because that would read the device."""
    monkeypatch.setattr("hvnet.kernels.launch.force_many_threads", True)
    anchors, boxes = random_boxes(20, 16, 4), random_boxes(3, 17, 4)
    expected = rotated.rotated_match(anchors, boxes, torch.tensor([0, 3]))
    found = rotated.rotated_match(anchors, boxes, torch.tensor([-(2**30), 2**30]))
    for mine, want in zip(found, expected, strict=True):
        assert torch.equal(mine, want)
    starts, labels = torch.tensor([0, 0, 3]), torch.arange(20) % 2
    expected = rotated.rotated_match(anchors, boxes, starts, labels=labels, classes=2)
    found = rotated.rotated_match(anchors, boxes, starts, labels=labels * 2**20 - 1, classes=2)
    for mine, want in zip(found, expected, strict=True):
        assert torch.equal(mine, want)


def test_match_without_boxes_or_anchors(device: torch.device) -> None:
    some, none = random_boxes(3, 18).float().to(device), torch.zeros(0, 7, device=device)
    iou, match, best = rotated.rotated_match(some, none, torch.tensor([0, 0, 0], device=device))
    assert iou.tolist() == [[0] * 3] * 2
    assert match.tolist() == [[-1] * 3] * 2
    assert best.shape == (0,)
    iou, match, best = rotated.rotated_match(none, some, torch.tensor([0, 3], device=device))
    assert iou.shape == match.shape == (1, 0)
    assert best.tolist() == [-1] * 3


def test_same_bits_on_every_run(device: torch.device) -> None:
    boxes = random_boxes(300, 19, spread=10).float().to(device)
    scores = torch.rand(300, generator=torch.Generator().manual_seed(0)).to(device)
    starts = torch.tensor([0, 100, 300], device=device)

    def results() -> list[Tensor]:
        ious = [rotated.rotated_iou_bev(boxes, boxes), rotated.rotated_iou_3d(boxes, boxes)]
        return [*ious, rotated.rotated_nms(boxes, scores, 0.1), *rotated.rotated_match(boxes, boxes, starts)]

    for first, second in zip(results(), results(), strict=True):
        assert torch.equal(first, second)


@pytest.mark.parametrize("name", ["rotated_iou_bev", "rotated_iou_3d", "rotated_overlap_pairs"])
def test_bad_pairs(name: str) -> None:
    function, good = getattr(rotated, name), torch.ones(2, 7)
    bad = [
        (TypeError, [[1.0] * 7]),
        (TypeError, torch.ones(2, 7, dtype=torch.int64)),
        (TypeError, torch.ones(2, 7, dtype=torch.float16)),
        (ValueError, torch.ones(7)),
        (ValueError, torch.ones(2, 6)),
        (ValueError, torch.ones(2, 7, device="meta")),
    ]
    for error, value in bad:
        with pytest.raises(error, match=r"\bb\b"):
            function(good, value)
        if not (isinstance(value, Tensor) and value.is_meta):  # of two devices, the second is the odd one
            with pytest.raises(error, match=r"\ba\b"):
                function(value, good)
    with pytest.raises((TypeError, ValueError), match=r"\bb\b.*float64"):
        function(good, torch.ones(2, 7, dtype=torch.float64))


def test_pairs_of_different_length() -> None:
    with pytest.raises(ValueError, match=r"\bb\b.*3"):
        rotated.rotated_overlap_pairs(torch.ones(2, 7), torch.ones(3, 7))


def test_bad_nms() -> None:
    boxes, scores = torch.ones(3, 7), torch.ones(3)
    with pytest.raises(ValueError, match=r"boxes.*8"):
        rotated.rotated_nms(torch.ones(3, 8), scores, 0.5)
    with pytest.raises(TypeError, match="boxes"):
        rotated.rotated_nms(boxes.long(), scores, 0.5)
    with pytest.raises(ValueError, match=r"scores.*2"):
        rotated.rotated_nms(boxes, torch.ones(2), 0.5)
    with pytest.raises(ValueError, match="scores"):
        rotated.rotated_nms(boxes, torch.ones(3, 1), 0.5)
    with pytest.raises(TypeError, match="scores"):
        rotated.rotated_nms(boxes, scores.long(), 0.5)


def test_bad_match() -> None:
    anchors, boxes, starts = torch.ones(3, 7), torch.ones(2, 7), torch.tensor([0, 1, 2])
    with pytest.raises(ValueError, match="anchors"):
        rotated.rotated_match(torch.ones(3, 6), boxes, starts)
    with pytest.raises(ValueError, match="boxes"):
        rotated.rotated_match(anchors, torch.ones(7), starts)
    with pytest.raises(TypeError, match=r"starts.*int32"):
        rotated.rotated_match(anchors, boxes, starts.int())
    for wrong in ([0, 1], [1, 2], [0, 2, 1, 2], [0, 3], []):
        with pytest.raises(ValueError, match="starts"):
            rotated.rotated_match(anchors, boxes, torch.tensor(wrong, dtype=torch.int64))
    labels = torch.tensor([0, 1, 1])
    with pytest.raises(ValueError, match=r"starts.*2.*got 4"):
        rotated.rotated_match(anchors, boxes, torch.tensor([0, 0, 1, 2]), labels=labels, classes=2)
    for classes in (0, 2):
        with pytest.raises(ValueError, match=rf"classes.*{classes}"):
            rotated.rotated_match(anchors, boxes, starts, classes=classes)
    with pytest.raises(TypeError, match=r"labels.*int32"):
        rotated.rotated_match(anchors, boxes, starts, labels=labels.int(), classes=2)
    with pytest.raises(ValueError, match="labels"):
        rotated.rotated_match(anchors, boxes, starts, labels=labels[:2], classes=2)
    for wrong in (-1, 2):
        with pytest.raises((ValueError, IndexError), match=rf"labels.*{wrong}"):
            rotated.rotated_match(anchors, boxes, starts, labels=labels * wrong, classes=2)


def test_bad_threshold() -> None:
    for function, columns in ((rotated.rotated_nms, 7), (rotated.nms_order, 7), (rotated.nms_rotated, 5)):
        with pytest.raises(TypeError, match=r"iou_threshold.*str"):
            function(torch.ones(3, columns), torch.ones(3), "0.5")


@pytest.mark.parametrize("name", ["rotated_iou_bev", "rotated_iou_3d", "rotated_overlap_pairs"])
def test_negative_size_of_pairs(name: str, device: torch.device) -> None:
    function, good = getattr(rotated, name), random_boxes(3, 20).to(device)
    for column in range(3, 6):
        bad = good.clone()
        bad[1, column] = -1.5
        bad[0, 3] = math.nan  # hides nothing
        if column == 5 and name == "rotated_overlap_pairs":  # an area has no height
            assert torch.equal(function(bad, good), function(bad[:, [0, 1, 2, 3, 4, 3, 6]], good))
            continue
        with pytest.raises(ValueError, match=r"\ba\b.*0 or more.*-1\.5"):
            function(bad, good)
        with pytest.raises(ValueError, match=r"\bb\b.*0 or more.*-1\.5"):
            function(good, bad)
    assert function(good * 0, good * -0.0).sum() == 0  # zeros of either sign are no negative sizes


def test_negative_size_of_many(device: torch.device) -> None:
    good, scores, starts = random_boxes(3, 21).to(device), torch.ones(3, device=device), torch.tensor([0, 3])
    for column in range(3, 6):
        bad = good.clone()
        bad[2, column] = -1.0
        with pytest.raises(ValueError, match=r"boxes.*-1"):
            rotated.rotated_nms(bad, scores, 0.5)
        if not many_threads(device):  # else these read nothing
            with pytest.raises(ValueError, match=r"anchors.*-1"):
                rotated.rotated_match(bad, good, starts.to(device))
            with pytest.raises(ValueError, match=r"boxes.*-1"):
                rotated.rotated_match(good, bad, starts.to(device))
            with pytest.raises(ValueError, match=r"boxes.*-1"):
                rotated.nms_order(bad, scores, 0.5)


def test_a_nan_score_is_not_kept_and_suppresses_nothing(device: torch.device) -> None:
    """Of boxes that are all the same, in every way that there is to suppress them."""
    boxes, flat = box(0, 0, 4, 2).repeat(4, 1).float().to(device), torch.ones(4, 5, device=device)
    scores, group = torch.tensor([math.nan, 0.2, math.nan, 0.4], device=device), torch.zeros(4, dtype=torch.int64)
    order, keep = rotated.nms_order(boxes, scores, 0.5)
    for kept in (
        rotated.rotated_nms(boxes, scores, 0.5),
        order[keep],
        rotated.nms_rotated(flat, scores, 0.5),
        rotated.batched_nms_rotated(flat, scores, group.to(device), 0.5),
    ):
        assert kept.tolist() == [3]
    boxes[3], flat[3] = math.nan, math.nan  # nor does a box that is not a number
    assert rotated.rotated_nms(boxes, scores, 0.5).tolist() == [3, 1]
    assert rotated.nms_rotated(flat, scores, 0.5).tolist() == [3, 1]


def test_nms_order_has_fixed_sizes(device: torch.device) -> None:
    boxes = random_boxes(50, 22, spread=6).to(device)
    scores = torch.rand(50, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).to(device)
    scores[7] = math.nan
    order, keep = rotated.nms_order(boxes, scores, 0.1)
    assert order.shape == keep.shape == (50,)
    assert (order.dtype, keep.dtype) == (torch.int64, torch.bool)
    assert order[0] == 7
    assert not keep[0]
    assert torch.equal(order[keep], rotated.rotated_nms(boxes, scores, 0.1))


def image_boxes(count: int, seed: int) -> Tensor:
    """Boxes (count, 5) float64 of (cx, cy, w, h, angle) in pixels and degrees."""
    generator = np.random.default_rng(seed)
    columns = [generator.uniform(0, 60, (count, 2)), generator.uniform(5, 40, (count, 2))]
    return torch.from_numpy(np.concatenate([*columns, generator.uniform(-400, 400, (count, 1))], axis=1))


def image_polygons(boxes: Tensor) -> np.ndarray:
    """Shapely polygons (M,) of boxes (M, 5), by the formula in the documentation of detectron2's RotatedBoxes."""
    corners = []
    for x_c, y_c, w, h, angle in boxes.double().tolist():
        theta, found = angle * math.pi / 180, []
        for x, y in ((-w / 2, -h / 2), (w / 2, -h / 2), (w / 2, h / 2), (-w / 2, h / 2)):  # less the centre
            y_r = math.cos(theta) * y - math.sin(theta) * x + y_c
            x_r = math.sin(theta) * y + math.cos(theta) * x + x_c
            found.append((x_r, y_r))
        corners.append(found)
    return shapely.polygons(corners)


def image_iou(a: Tensor, b: Tensor) -> Tensor:
    first, second = image_polygons(a)[:, None], image_polygons(b)[None]
    shared = shapely.area(shapely.intersection(first, second))
    return torch.from_numpy(shared / (shapely.area(first) + shapely.area(second) - shared))


@pytest.mark.parametrize("dtype", DTYPES)
def test_box_iou_rotated(dtype: torch.dtype, device: torch.device) -> None:
    a, b = image_boxes(60, 0).to(dtype), image_boxes(50, 1).to(dtype)
    expected = image_iou(a, b)
    assert (expected > 0.2).any()
    assert (image_iou(a * torch.tensor([1, 1, 1, 1, -1]), b) - expected).abs().max() > 0.1  # the sign matters
    tolerance = 10 * TOLERANCE[dtype]  # an angle of 400 degrees is rounded to 5e-7 radians
    iou = rotated.box_iou_rotated(a.to(device), b.to(device))
    assert iou.dtype == dtype
    equals(iou, expected, tolerance)
    equals(iou, reference.box_iou_rotated(a.double(), b.double()), tolerance)
    a[:, 4], b[:, 4] = a[:, 4].deg2rad(), b[:, 4].deg2rad()
    equals(rotated.box_iou_rotated(a.to(device), b.to(device), degrees=False), expected, tolerance)
    equals(reference.box_iou_rotated(a.double(), b.double(), degrees=False), expected, tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("function", [rotated.box_iou_rotated, reference.box_iou_rotated])
def test_box_iou_rotated_by_hand(function: Callable[..., Tensor], dtype: torch.dtype, device: torch.device) -> None:
    """The boxes that detectron2's documentation draws, and two of which only one turn makes them meet."""
    upright = torch.tensor([[5, 3, 4, 2, 0]], dtype=dtype, device=device)
    turned = torch.tensor([[5.0, 3, 4, 2, angle] for angle in (0, 90, -90, 180, 360)], dtype=dtype, device=device)
    equals(function(upright, turned), torch.tensor([[1, 1 / 3, 1 / 3, 1, 1]]), 1e-6)
    # as it is seen, a long box turned by 45 degrees goes from the lower left to the upper right, where y is less
    long = torch.tensor([[0, 0, 10, 1, 45.0]], dtype=dtype, device=device)
    corners = torch.tensor([[3.0, -3, 1, 1, 45], [3, 3, 1, 1, 45]], dtype=dtype, device=device)
    equals(function(long, corners), torch.tensor([[0.1, 0]]), 1e-6)
    radians = torch.tensor([[0, 0, 10, 1, math.pi / 4]], dtype=dtype, device=device)
    corners[:, 4] = math.pi / 4
    equals(function(radians, corners, degrees=False), torch.tensor([[0.1, 0]]), 1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degrees", [True, False])
def test_nms_rotated(degrees: bool, dtype: torch.dtype, device: torch.device) -> None:
    boxes = image_boxes(80, 2)
    assert not ((image_iou(boxes, boxes) - 0.3).abs() < 1e-5).any()  # no pair that rounding decides
    scores = torch.rand(80, generator=torch.Generator().manual_seed(0)).to(dtype)
    scores[3] = math.nan
    overlaps, order = image_iou(boxes, boxes) > 0.3, [k for k in scores.argsort(descending=True).tolist() if k != 3]
    expected: list[int] = []
    for k in order:
        if not any(overlaps[k, better] for better in expected):
            expected.append(k)
    assert 5 < len(expected) < 70
    if not degrees:
        boxes[:, 4] = boxes[:, 4].deg2rad()
    kept = rotated.nms_rotated(boxes.to(device, dtype), scores.to(device), 0.3, degrees=degrees)
    assert kept.dtype == torch.int64
    assert kept.tolist() == expected
    assert reference.nms_rotated(boxes, scores, 0.3, degrees=degrees).tolist() == expected


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("index_dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("groups", [1, 4, 200])
def test_batched_nms_rotated(groups: int, index_dtype: torch.dtype, dtype: torch.dtype, device: torch.device) -> None:
    """One nms_rotated a group, merged by score; far boxes too, which a shift group by group would round."""
    generator = torch.Generator().manual_seed(groups)
    boxes = image_boxes(150, 3).to(dtype)
    boxes[:, :2] += 1e4
    scores = (torch.rand(150, generator=generator) * 20).round().to(dtype)  # many ties
    scores[5] = math.nan
    idxs = (torch.randint(groups, (150,), generator=generator) * 1_000_003 - 7).to(index_dtype)
    given = boxes.to(device), scores.to(device), idxs.to(device)
    kept = rotated.batched_nms_rotated(*given, 0.2)
    merged = []
    for group in idxs.unique().tolist():
        members = (idxs == group).nonzero()[:, 0].to(device)
        merged.append(members[rotated.nms_rotated(given[0][members], given[1][members], 0.2)])
    expected = sorted(torch.cat(merged).tolist(), key=lambda k: (-scores[k].item(), k))
    assert kept.dtype == torch.int64
    assert kept.tolist() == expected
    assert reference.batched_nms_rotated(boxes.double(), scores, idxs, 0.2).tolist() == expected
    radians = torch.cat((given[0][:, :4], given[0][:, 4:].deg2rad()), dim=1)
    assert rotated.batched_nms_rotated(radians, *given[1:], 0.2, degrees=False).tolist() == expected


def test_batched_nms_by_hand(device: torch.device) -> None:
    boxes = torch.tensor([[0, 0, 4, 2, 30.0]], device=device).repeat(5, 1)
    scores = torch.tensor([0.1, 0.5, 0.5, 0.9, math.nan], device=device)
    kept = rotated.batched_nms_rotated(boxes, scores, torch.tensor([2, 7, 2, 7, 9], device=device), 0.5)
    assert kept.tolist() == [3, 2]
    none = torch.zeros(0, 5, device=device)
    for module in (rotated, reference):
        empty = module.batched_nms_rotated(none, none[:, 0], torch.zeros(0, dtype=torch.int64, device=device), 0.5)
        assert (empty.shape, empty.dtype) == ((0,), torch.int64)
        assert module.nms_rotated(none, none[:, 0], 0.5).shape == (0,)
        assert module.box_iou_rotated(none, boxes).shape == (0, 5)


def test_example_of_the_docs() -> None:
    text = (Path(__file__).resolve().parents[1] / "docs" / "kernels.md").read_text(encoding="utf-8")
    (example,) = (
        each for each in re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL) if "nms" in each
    )
    scope: dict[str, Tensor] = {}
    exec(compile(example, "docs/kernels.md", "exec"), scope)
    assert scope["kept"].tolist() == [0, 2]
    equals(scope["iou"], image_iou(scope["boxes"], scope["boxes"]), 1e-5)


def test_bad_image_boxes() -> None:
    boxes, scores, idxs = torch.ones(3, 5), torch.ones(3), torch.zeros(3, dtype=torch.int64)
    with pytest.raises(ValueError, match=r"\bb\b.*5.*7"):
        rotated.box_iou_rotated(boxes, torch.ones(3, 7))
    with pytest.raises(TypeError, match=r"\ba\b.*int64"):
        rotated.box_iou_rotated(boxes.long(), boxes)
    with pytest.raises(ValueError, match=r"\ba\b.*-1"):
        rotated.box_iou_rotated(-boxes, boxes)
    with pytest.raises(ValueError, match=r"\bb\b.*-1"):
        rotated.box_iou_rotated(boxes, -boxes)
    with pytest.raises(ValueError, match=r"boxes.*-1"):
        rotated.nms_rotated(-boxes, scores, 0.5)
    with pytest.raises(ValueError, match=r"boxes.*-1"):
        rotated.batched_nms_rotated(-boxes, scores, idxs, 0.5)
    with pytest.raises(ValueError, match=r"scores.*2"):
        rotated.nms_rotated(boxes, scores[:2], 0.5)
    with pytest.raises(TypeError, match=r"idxs.*float32"):
        rotated.batched_nms_rotated(boxes, scores, idxs.float(), 0.5)
    with pytest.raises(ValueError, match=r"idxs.*2"):
        rotated.batched_nms_rotated(boxes, scores, idxs[:2], 0.5)
    with pytest.raises(TypeError):  # a bare boolean says nothing
        rotated.box_iou_rotated(boxes, boxes, False)  # type: ignore[misc]


def test_no_gradients(device: torch.device) -> None:
    """Boxes that want a gradient are taken as they are, and what comes back wants none."""
    boxes, scores = random_boxes(6, 23).to(device).requires_grad_(), torch.rand(6, device=device, requires_grad=True)
    starts = torch.tensor([0, 6], device=device)
    results = [
        rotated.rotated_iou_bev(boxes, boxes),
        rotated.rotated_iou_3d(boxes, boxes),
        rotated.rotated_overlap_pairs(boxes, boxes),
        rotated.rotated_nms(boxes, scores, 0.1),
        *rotated.nms_order(boxes, scores, 0.1),
        rotated.nms_groups(boxes[None], *groups_of(1, 6, boxes.dtype, device)),
        *rotated.rotated_match(boxes, boxes, starts),
        rotated.box_iou_rotated(boxes[:, :5].abs(), boxes[:, :5].abs()),
    ]
    assert not any(result.requires_grad for result in results)


def groups_of(groups: int, count: int, dtype: torch.dtype, device: torch.device | str = "cpu") -> tuple[Any, ...]:
    """What `nms_groups` takes besides the boxes (groups, count, 7)."""
    valid = torch.ones(groups, count, dtype=torch.bool, device=device)
    counts = torch.arange(groups, dtype=torch.int32, device=device).add(1).clamp(max=count)
    return valid, counts, torch.full((1,), 0.2, dtype=dtype, device=device), 2


@pytest.mark.parametrize("dtype", DTYPES)
def test_opcheck(dtype: torch.dtype, device: torch.device) -> None:
    """torch.library's own checks of the ops: schema, fake tensors, compilation with shapes that change."""
    a, b = random_boxes(6, 24).to(device, dtype), random_boxes(5, 25).to(device, dtype)
    scores, group = torch.rand(6, device=device), torch.tensor([0, 1, 1, 0, 0, 1], device=device)
    ops = torch.ops.hvnet
    for op, arguments in (
        (ops.rotated_iou_bev, (a, b)),
        (ops.rotated_iou_3d, (a, b)),
        (ops.rotated_overlap_pairs, (a[:5], b)),
        (ops.nms_order, (a, scores, 0.3)),
        (ops.rotated_nms, (a, scores, None, 0.3)),
        (ops.rotated_nms, (a, scores, group, 0.3)),
        (ops.nms_groups, (a.view(2, 3, 7), *groups_of(2, 3, dtype, device))),
        (ops.rotated_match, (a, b, torch.tensor([0, 2, 5], device=device), None, 1)),
        (ops.rotated_match, (a, b, torch.tensor([0, 2, 5], device=device), torch.arange(len(a), device=device) % 2, 2)),
    ):
        torch.library.opcheck(op, arguments)


def compiled_cases() -> dict[str, tuple[Callable[..., object], Callable[[int], tuple[Any, ...]]]]:
    """Every public function with arguments for a number of boxes."""

    def boxes(count: int) -> Tensor:
        return random_boxes(count, count).float()

    def scored(count: int) -> tuple[Tensor, Tensor]:
        return boxes(count), torch.rand(count, generator=torch.Generator().manual_seed(count))

    def in_image(count: int) -> tuple[Tensor, Tensor, Tensor]:
        return image_boxes(count, count).float(), scored(count)[1], torch.arange(count) % 3

    return {
        "rotated_iou_bev": (rotated.rotated_iou_bev, lambda n: (boxes(n), boxes(n + 1))),
        "rotated_iou_3d": (rotated.rotated_iou_3d, lambda n: (boxes(n), boxes(n + 1))),
        "rotated_overlap_pairs": (rotated.rotated_overlap_pairs, lambda n: (boxes(n), boxes(n).flip(0))),
        "rotated_nms": (rotated.rotated_nms, lambda n: (*scored(n), 1 / n)),
        "nms_order": (rotated.nms_order, lambda n: (*scored(n), 1 / n)),
        "nms_groups": (
            rotated.nms_groups,
            lambda n: (boxes(2 * n).view(2, n, 7), *groups_of(2, n, torch.float32)),
        ),
        "rotated_match": (
            lambda a, b, starts, labels: (
                *rotated.rotated_match(a, b, starts),
                *rotated.rotated_match(a, b, starts, labels=labels, classes=2),
            ),
            lambda n: (boxes(n + 7), boxes(n), torch.tensor([0, 3, n]), torch.arange(n + 7) % 2),
        ),
        "box_iou_rotated": (rotated.box_iou_rotated, lambda n: (in_image(n)[0], in_image(n + 1)[0])),
        "nms_rotated": (lambda b, s, _: rotated.nms_rotated(b, s, 0.2), in_image),
        "batched_nms_rotated": (lambda b, s, i: rotated.batched_nms_rotated(b, s, i, 0.2, degrees=False), in_image),
    }


def test_compiled_cases_are_all() -> None:
    public = {name for name, value in vars(rotated).items() if getattr(value, "__module__", None) == rotated.__name__}
    assert {name for name in public if not name.startswith("_")} == set(compiled_cases())


@pytest.mark.parametrize("name", compiled_cases())
def test_compiles_into_one_graph(name: str) -> None:
    """Without a graph break and without a flag of the user; aot_eager needs no C++ compiler."""
    function, arguments = compiled_cases()[name]
    compiled = torch.compile(function, fullgraph=True, backend="aot_eager", dynamic=True)
    for count in (12, 9):
        actual, expected = compiled(*arguments(count)), function(*arguments(count))
        pairs = zip(actual, expected, strict=True) if isinstance(expected, tuple) else [(actual, expected)]
        assert all(torch.equal(first, second) for first, second in pairs)
