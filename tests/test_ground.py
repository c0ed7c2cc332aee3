"""The ground of a frame: slopes, steps, walls, and the labelled boxes of real frames, which stand on it."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hvnet.boxes import points_in_boxes
from hvnet.data.ground import CELL, ground_points, ground_under
from hvnet.data.kitti import read_frame, read_split

PLACES = torch.tensor([[5.0, 0.0], [20.0, -6.0], [40.0, 10.0]])


def grid(x: tuple[float, float], y: tuple[float, float], step: float = 0.5) -> Tensor:
    """Places (N, 2) of a rectangle."""
    return torch.cartesian_prod(torch.arange(*x, step), torch.arange(*y, step))


def surface(height: Tensor, places: Tensor, seed: int = 0) -> Tensor:
    """Points (N, 3) at places (N, 2) with heights (N,) and a noise of 2 cm."""
    noise = torch.randn(len(places), generator=torch.Generator().manual_seed(seed)) * 0.02
    return torch.cat((places, (height + noise)[:, None]), dim=1)


@pytest.mark.parametrize("base", [-1.7, 0.0, 3.0])
def test_a_slope_under_a_wall_and_a_roof(base: float) -> None:
    """Two degrees up and one to the side; a wall, a row of cars and a roof above are not taken for ground."""
    places = grid((0.0, 60.0), (-20.0, 20.0))
    slope = base + 0.035 * places[:, 0] - 0.017 * places[:, 1]
    wall = torch.cat((grid((0.0, 60.0), (15.0, 15.5)), torch.linspace(base, base + 4, 120)[:, None]), dim=1)
    roofs = grid((10.0, 30.0), (-8.0, -6.0))
    roofs = torch.cat((roofs, torch.full((len(roofs), 1), base + 1.5)), dim=1)
    ground = ground_points(torch.cat((surface(slope, places), wall, roofs)))
    want = base + 0.035 * PLACES[:, 0] - 0.017 * PLACES[:, 1]
    assert (ground_under(ground, PLACES) - want).abs().max() < 0.05


def test_a_pavement_beside_the_road() -> None:
    """A step of 0.15 m is followed but for what is near it."""
    places = grid((0.0, 60.0), (-20.0, 20.0))
    ground = ground_points(surface(torch.where(places[:, 1] > 6, -1.55, -1.7), places))
    found = ground_under(ground, torch.tensor([[20.0, -4.0], [20.0, 14.0]]))
    torch.testing.assert_close(found, found.new_tensor([-1.7, -1.55]), atol=0.05, rtol=0)


def test_reflections_below_the_ground_are_skipped() -> None:
    """One point in forty lies a metre too low."""
    places = grid((0.0, 40.0), (-10.0, 10.0), 0.25)
    points = surface(torch.full((len(places),), -1.7), places)
    points[::40, 2] -= 1
    assert (ground_under(ground_points(points), PLACES) + 1.7).abs().max() < 0.08


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_points_tell_nothing(count: int) -> None:
    ground = ground_points(torch.rand(20 * count, 3) + CELL * torch.arange(count).repeat_interleave(20)[:, None])
    assert len(ground) <= 4 * count
    assert ground_under(ground[:5], PLACES).isnan().all()
    assert ground_under(ground[:5], PLACES[:0]).shape == (0,)


def test_points_that_are_not_finite_are_ignored() -> None:
    places = grid((0.0, 40.0), (-10.0, 10.0))
    points = surface(torch.full((len(places),), -1.7), places)
    broken = points.clone()
    broken[::7, 0], broken[3::7, 2] = math.nan, math.inf
    whole = points[broken.isfinite().all(dim=1)]
    assert torch.equal(ground_points(broken), ground_points(whole))


def test_labelled_boxes_of_real_frames_stand_on_it(kitti_root: Path) -> None:
    """Half of them within 6 cm, nine of ten within 20 cm; the points in the boxes are not looked at."""
    left = []
    for name in read_split(kitti_root, "val"):
        frame = read_frame(kitti_root, name)
        assert frame.objects is not None
        boxes = frame.objects.boxes
        points = frame.points[~points_in_boxes(frame.points, boxes).any(dim=1)]
        left.append((boxes[:, 2] - boxes[:, 5] / 2 - ground_under(ground_points(points), boxes[:, :2])).abs())
    every = torch.cat(left)
    assert len(every) > 150
    assert every.median() < 0.06
    assert every.quantile(0.9) < 0.2
