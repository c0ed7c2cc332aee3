"""What hides what: walls, roads and objects in front of each other, and real frames, whose points are all seen."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hvnet.boxes import points_in_boxes
from hvnet.data.kitti import read_frame, read_split
from hvnet.data.occlusion import COLUMNS, MARGIN, ROWS, hidden, nearest_points, rays_to

BOTTOM = torch.tensor([-1.7])


def wall(x: float, y: tuple[float, float], z: tuple[float, float] = (-1.7, 0.3)) -> Tensor:
    """Points (N, 3) on a wall across the x axis, closer together than cells are wide."""
    size = 0.004 * x
    across = torch.cartesian_prod(torch.arange(y[0], y[1] + 1e-4, size), torch.arange(z[0], z[1] + 1e-4, size))
    return torch.cat((torch.full((len(across), 1), x), across), dim=1)


def hides(points: Tensor, obstacles: Tensor, bottom: Tensor = BOTTOM) -> Tensor:
    """Which points (N, 3) of one object are hidden by obstacles."""
    return hidden(rays_to(points), torch.zeros(len(points)).long(), bottom, rays_to(obstacles))


@pytest.mark.parametrize(
    ("point", "column", "row", "distance"),
    [
        ((10.0, 0.0, 0.0), COLUMNS // 2, ROWS // 2, 10.0),
        ((3.0, 4.0, -0.501), 582, ROWS // 2 - 11, 5.0),  # 53.13 degrees to the left, 0.1002 down a metre
        ((0.0, -2.0, 1.0), 225, ROWS // 2 + 50, 2.0),
        ((-8.0, 0.0, -30.0), COLUMNS - 1, 0, 8.0),
        ((0.0, 0.0, 1.0), COLUMNS // 2, ROWS - 1, 0.0),
    ],
)
def test_rays(point: tuple[float, ...], column: int, row: int, distance: float) -> None:
    rays = rays_to(torch.tensor([point]))
    assert rays.cell.tolist() == [row * COLUMNS + column]
    assert rays.distance.tolist() == pytest.approx([distance])


def test_points_that_are_blanked_lie_behind_nothing() -> None:
    points = torch.tensor([[math.nan] * 3, [20.0, 0.1, 0.1]])
    assert rays_to(points).behind(rays_to(torch.tensor([[10.0, 0.05, 0.05]])).image()).tolist() == [False, True]


def test_the_nearest_point_of_every_cell() -> None:
    points = torch.tensor([[20.0, 0.01, 0.01], [10, 0.01, 0.01], [10, 5, 0.01], [10.1, 0.01, 0.01]])
    want = points[[1, 2]]
    assert torch.equal(nearest_points(points), want)
    assert torch.equal(nearest_points(points.flip(0)), want)
    assert nearest_points(points[:0]).shape == (0, 3)


def test_a_wall_is_hidden_where_an_object_stands_in_front() -> None:
    """The shadow of what is 2 m wide at 10 m is 4 m wide at 20 m, to the width of a cell."""
    shown, image = wall(20.0, (-5, 5)), rays_to(wall(10.0, (-1, 1))).image()
    behind = rays_to(shown).behind(image)
    inside = (shown[:, 1].abs() < 2) & (shown[:, 2] > -3.4) & (shown[:, 2] < 0.6)
    assert behind[inside].all()
    assert not behind[shown[:, 1].abs() > 2.2].any()
    assert not rays_to(wall(9.0, (-5, 5))).behind(image).any()
    assert not rays_to(wall(10.0 + 0.9 * MARGIN, (-1, 1))).behind(image).any()


def test_an_object_is_hidden_behind_a_wall() -> None:
    """... whose edge is at 3 m to the left of the object's distance: half of the object."""
    car = wall(20.0, (0, 6))
    obstacles = wall(10.0, (-4, 1.5), (-1.7, 1.0))
    found = hides(car, obstacles)
    high = car[:, 2] > -1.2  # the rest is where the road would be
    assert found[high & (car[:, 1] < 2.9)].all()
    assert not found[car[:, 1] > 3.2].any()
    assert not hides(car, car + torch.tensor([5.0, 0, 0])).any()
    assert not hides(car, obstacles[:0]).any()


@pytest.mark.parametrize("slope", [-0.02, 0.0, 0.02])
def test_a_road_hides_nothing_that_stands_on_it(slope: float) -> None:
    places = torch.cartesian_prod(torch.arange(3, 60, 0.1), torch.arange(-3, 3, 0.1))
    road = torch.cat((places, slope * places[:, :1] - 1.7), dim=1)
    for x in (8.0, 25.0, 50.0):
        bottom = slope * x - 1.7
        assert not hides(wall(x, (-1, 1), (bottom, bottom + 1.5)), road, torch.tensor([bottom])).any()


def test_of_two_objects_the_further_is_hidden() -> None:
    near, far = wall(10.0, (-1, 1)), wall(20.0, (-3, 3))
    beside = wall(15.0, (4, 5))
    points = torch.cat((far, near, beside))
    of_object = torch.arange(3).repeat_interleave(torch.tensor([len(far), len(near), len(beside)]))
    found = hidden(rays_to(points), of_object, BOTTOM.expand(3), rays_to(points[:0]))
    assert not found[of_object > 0].any()
    assert found[: len(far)][far[:, 1].abs() < 2].all()
    assert not found[: len(far)][far[:, 1].abs() > 2.2].any()


def test_an_object_does_not_hide_itself() -> None:
    """The scanner saw all its points, also those behind others: through a window."""
    car = torch.cat((wall(10.0, (-1, 1)), wall(13.0, (-1, 1))))
    assert not hides(car, car[:0]).any()


def test_objects_of_real_frames_are_seen(kitti_root: Path) -> None:
    """Of the points of labelled objects, all of which were seen, 2 % or fewer would be hidden by the rest."""
    count, found = 0, 0
    for name in read_split(kitti_root, "val")[::3]:
        frame = read_frame(kitti_root, name)
        assert frame.objects is not None
        boxes = frame.objects.boxes
        inside = points_in_boxes(frame.points, boxes)
        for box, own in zip(boxes, inside.T, strict=True):
            others = rays_to(nearest_points(frame.points[~own]))
            of_object = torch.zeros(int(own.sum())).long()
            gone = hidden(rays_to(frame.points[own]), of_object, box[2:3] - box[5:6] / 2, others)
            count, found = count + len(gone), found + int(gone.sum())
    assert count > 10_000
    assert found <= 0.02 * count
