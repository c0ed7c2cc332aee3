"""Box geometry against hand-made tables and shapely's polygons."""

import math

import pytest
import torch
from shapely.geometry import Polygon

from hvnet.boxes import (
    MAX_PAIRS,
    bev_corners,
    box_corners,
    boxes_collide,
    indices_in_boxes,
    limit_angle,
    points_in_boxes,
)
from tests.helpers import random_boxes

ANGLES = [
    (0.0, 0.0),
    (math.pi, -math.pi),
    (-math.pi, -math.pi),
    (3 * math.pi, -math.pi),
    (math.pi / 2, math.pi / 2),
    (1.5 * math.pi, -math.pi / 2),
    (-1.5 * math.pi, math.pi / 2),
    (7 * math.pi + 1, 1 - math.pi),
]


@pytest.mark.parametrize(("angle", "wrapped"), ANGLES)
def test_limit_angle(angle: float, wrapped: float) -> None:
    torch.testing.assert_close(
        limit_angle(torch.tensor(angle, dtype=torch.float64)), torch.tensor(wrapped, dtype=torch.float64)
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_limit_angle_is_half_open(dtype: torch.dtype) -> None:
    pi = torch.tensor(math.pi, dtype=dtype)
    edges = torch.stack([pi, -pi, pi.nextafter(pi + 1), (-pi).nextafter(-pi - 1), pi.nextafter(pi - 1), -pi - 1e-30])
    tiny = torch.tensor([-1e-30, -1e-8, 1e-30, 0.0, -0.0], dtype=dtype)
    wrapped = limit_angle(torch.cat((edges, tiny)))
    assert (wrapped >= -math.pi).all()
    assert (wrapped < math.pi).all()
    assert (wrapped[-5:].abs() < 1e-6).all()


def test_corners_are_front_left_front_right_rear_right_rear_left() -> None:
    box = torch.tensor([[10.0, 5.0, 1.0, 4.0, 2.0, 1.5, 0.0]])
    assert bev_corners(box).tolist() == [[[12, 6], [12, 4], [8, 4], [8, 6]]]
    corners = box_corners(box)
    assert corners[0, :4, :2].tolist() == corners[0, 4:, :2].tolist() == [[12, 6], [12, 4], [8, 4], [8, 6]]
    assert corners[0, :, 2].tolist() == [0.25] * 4 + [1.75] * 4


def test_corners_turn_to_the_left() -> None:
    box = torch.tensor([10.0, 5.0, 1.0, 4.0, 2.0, 1.5, math.pi / 2])
    expected = torch.tensor([[9.0, 7], [11, 7], [11, 3], [9, 3]])
    torch.testing.assert_close(bev_corners(box), expected)


def test_points_in_boxes_counts_the_faces() -> None:
    box = torch.tensor([[0.0, 0.0, 0.0, 4.0, 2.0, 1.0, 0.0]])
    points = torch.tensor([[2.0, 1, 0.5], [-2, -1, -0.5], [2.01, 0, 0], [0, 1.01, 0], [0, 0, 0.51], [0, 0, 0]])
    assert points_in_boxes(points, box)[:, 0].tolist() == [True, True, False, False, False, True]


def test_points_in_boxes_agrees_with_the_corners() -> None:
    """A point is inside iff it is a combination of the box's edges with shares between 0 and 1."""
    boxes = random_boxes(20, seed=0, spread=2)
    points = (torch.rand(500, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5) * 8
    corners = box_corners(boxes)
    origin = corners[:, 2]
    edges = torch.stack((corners[:, 1] - origin, corners[:, 3] - origin, corners[:, 6] - origin), dim=-1)
    shares = torch.linalg.solve(edges[None], (points[:, None] - origin[None])[..., None])[..., 0]
    expected = ((shares >= 0) & (shares <= 1)).all(-1)
    assert expected.sum() > 50
    assert torch.equal(points_in_boxes(points, boxes), expected)


def test_points_in_boxes_of_nothing() -> None:
    assert points_in_boxes(torch.zeros(0, 4), torch.zeros(3, 7)).shape == (0, 3)
    assert points_in_boxes(torch.zeros(5, 4), torch.zeros(0, 7)).shape == (5, 0)


def whole_mask(points: torch.Tensor, boxes: torch.Tensor) -> torch.Tensor:
    """`points_in_boxes` of all points and boxes at once."""
    x, y, z = (points[:, axis, None] - boxes[:, axis] for axis in range(3))
    cos, sin = boxes[:, 6].cos(), boxes[:, 6].sin()
    along, across = (x * cos + y * sin).abs() * 2, (y * cos - x * sin).abs() * 2
    return (along <= boxes[:, 3]) & (across <= boxes[:, 4]) & (z.abs() * 2 <= boxes[:, 5])


@pytest.mark.parametrize("centre", [0.0, 3e5])
@pytest.mark.parametrize("dtypes", [(torch.float32, torch.float32), (torch.float32, torch.float64)])
def test_points_in_boxes_part_by_part(
    device: torch.device, centre: float, dtypes: tuple[torch.dtype, torch.dtype]
) -> None:
    """The same bits as all at once, at the corners too, and far away, where float32 has steps of 0.03 m."""
    boxes = random_boxes(40, seed=4, spread=6, centre=centre).to(dtypes[1])
    boxes[:5, 6] = 0
    generator = torch.Generator().manual_seed(5)
    spread = (torch.rand(MAX_PAIRS // 40 * 2 + 7, 3, generator=generator, dtype=torch.float64) - 0.5) * 16
    spread[:, :2] += centre
    corners = box_corners(boxes).reshape(-1, 3).double()
    points = torch.cat((corners, spread, torch.tensor([[math.nan, 0, 0], [centre, math.inf, 0]])))
    points, boxes = points.to(dtypes[0]).to(device), boxes.to(device)
    expected = whole_mask(points, boxes)
    assert (expected.sum(dim=0) > 0).all()
    assert torch.equal(points_in_boxes(points, boxes), expected)
    found = indices_in_boxes(points, boxes)
    assert len(found) == 40
    for inside, mask in zip(found, expected.T, strict=True):
        assert torch.equal(inside, mask.nonzero()[:, 0])


def test_indices_in_boxes() -> None:
    """Of every box in their order; a point may be in several boxes, and a box without a size has none."""
    boxes = torch.tensor([[0.0, 0, 0, 4, 2, 1, 0], [1, 0, 0, 4, 2, 1, math.pi / 2], [0, 0, 0, -1, -1, -1, 0]])
    points = torch.tensor([[1.0, 1.9, 0, 9], [0.5, 0.5, 0.5, 9], [-2, 0, 0, 9], [9, 9, 9, 9], [0, 0, 0, 9]])
    assert [inside.tolist() for inside in indices_in_boxes(points, boxes)] == [[1, 2, 4], [0, 1, 4], []]
    assert [len(inside) for inside in indices_in_boxes(points[:0], boxes)] == [0, 0, 0]
    assert indices_in_boxes(points, boxes[:0]) == []


def test_boxes_collide_as_polygons_overlap() -> None:
    a, b = random_boxes(40, seed=2, spread=6), random_boxes(30, seed=3, spread=6)
    polygons_a, polygons_b = ([Polygon(corners.tolist()) for corners in bev_corners(boxes)] for boxes in (a, b))
    expected = torch.tensor([[p.intersection(q).area > 1e-9 for q in polygons_b] for p in polygons_a])
    assert 0.1 < expected.double().mean() < 0.9
    assert torch.equal(boxes_collide(a, b), expected)
    assert torch.equal(boxes_collide(b, a), expected.T)


def test_boxes_that_touch_do_not_collide() -> None:
    box = torch.tensor([[0.0, 0, 0, 4, 2, 1, 0]])
    others = torch.tensor(
        [[4.0, 0, 0, 4, 2, 1, 0], [3.99, 0, 0, 4, 2, 1, 0], [0, 2, 9, 4, 2, 1, 0], [0, 0, 9, 1, 1, 1, 1]]
    )
    assert boxes_collide(box, others).tolist() == [[False, True, False, True]]
    assert boxes_collide(box, others[:0]).shape == (1, 0)
