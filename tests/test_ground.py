"""The ground under a cloud: slopes, steps, walls, and the labelled boxes of real frames, which stand on it."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hvnet.data import ground
from hvnet.data.ground import CELL, FEWEST, FEWEST_CELLS, cells_of, flatten, ground_map, heights_at, reach_of, solve
from hvnet.data.kitti import read_frame, read_split

REACH = 64.0
PLACES = torch.tensor([[[5.0, 0.0], [20.0, -6.0], [40.0, 10.0]]])


def grid(x: tuple[float, float], y: tuple[float, float], step: float = 0.5) -> Tensor:
    """Places (N, 2) of a rectangle."""
    return torch.cartesian_prod(torch.arange(*x, step), torch.arange(*y, step))


def surface(height: Tensor, places: Tensor, seed: int = 0) -> Tensor:
    """Points (N, 3) at places (N, 2) with heights (N,) and a noise of 2 cm."""
    noise = torch.randn(len(places), generator=torch.Generator().manual_seed(seed)) * 0.02
    return torch.cat((places, (height + noise)[:, None]), dim=1)


def street(base: float = -1.7) -> tuple[Tensor, Tensor]:
    """Points (N, 3) of a slope, two degrees up and one to the side, with a wall and a roof, and its heights at PLACES.

    The roof hides the ground in a row of cells.
    """
    places = grid((0.0, 60.0), (-20.0, 20.0))
    slope = base + 0.035 * places[:, 0] - 0.017 * places[:, 1]
    wall = torch.cat((grid((0.0, 60.0), (15.0, 15.5)), torch.linspace(base, base + 4, 120)[:, None]), dim=1)
    hidden = (places[:, 0] > 10) & (places[:, 0] < 30) & (places[:, 1] > -10) & (places[:, 1] < -8)
    points = surface(torch.where(hidden, slope + 1.5, slope), places)
    return torch.cat((points, wall)), base + 0.035 * PLACES[..., 0] - 0.017 * PLACES[..., 1]


def ground_at(points: Tensor, places: Tensor) -> Tensor:
    """Heights (P,) of the ground under points (N, 3) at places (P, 2)."""
    return heights_at(ground_map(points[None], REACH), places[None])[0]


@pytest.mark.parametrize("base", [-1.7, 0.0, 3.0])
def test_a_slope_beside_a_wall_and_under_a_roof(base: float, threads: None) -> None:
    points, want = street(base)
    assert (ground_at(points, PLACES[0]) - want[0]).abs().max() < 0.06


def test_a_pavement_beside_the_road() -> None:
    """A step of 0.15 m is followed but for what is near it."""
    places = grid((0.0, 60.0), (-20.0, 20.0))
    points = surface(torch.where(places[:, 1] > 6, -1.55, -1.7), places)
    found = ground_at(points, torch.tensor([[20.0, -4.0], [20.0, 14.0]]))
    torch.testing.assert_close(found, torch.tensor([-1.7, -1.55]), atol=0.06, rtol=0)


def test_reflections_below_the_ground_are_skipped() -> None:
    """One point in forty lies a metre too low."""
    places = grid((0.0, 40.0), (-10.0, 10.0), 0.25)
    points = surface(torch.full((len(places),), -1.7), places)
    points[::40, 2] -= 1
    assert (ground_at(points, PLACES[0]) + 1.7).abs().max() < 0.08


def test_clouds_of_a_batch_are_each_alone() -> None:
    """Rows of NaN fill the shorter one up."""
    long, short = street()[0], street(0.5)[0][:9000]
    filled = torch.full_like(long, math.nan)
    filled[: len(short)] = short
    both = ground_map(torch.stack((long, filled)), REACH)
    assert both.shape == (2, cells_of(REACH), cells_of(REACH))
    torch.testing.assert_close(both, torch.cat([ground_map(each[None], REACH) for each in (long, short)]))


@pytest.mark.parametrize("cells", [0, 1, FEWEST_CELLS - 1, FEWEST_CELLS])
def test_too_few_cells_tell_nothing(cells: int) -> None:
    places = CELL * torch.arange(cells).repeat_interleave(FEWEST)[:, None] + torch.tensor([0.5, 0.5])
    points = torch.cat((places, torch.full((len(places), 1), -1.0)), dim=1)
    assert ground_map(points[None], REACH).isnan().all() == (cells < FEWEST_CELLS)
    assert heights_at(ground_map(points[None], REACH), PLACES[:, :0]).shape == (1, 0)


def test_points_that_are_not_finite_are_ignored() -> None:
    points, _ = street()
    broken = points.clone()
    broken[::7, 0], broken[3::7, 2] = math.nan, math.inf
    whole = points[broken.isfinite().all(dim=1)]
    assert torch.equal(ground_map(broken[None], REACH), ground_map(whole[None], REACH))


def test_places_beyond_the_map_have_the_height_of_its_border() -> None:
    heights = torch.arange(16.0).view(1, 4, 4)
    assert heights_at(heights, torch.tensor([[[-9.0, -9.0], [9.0, 9.0], [0.0, 0.0], [1.0, -3.0]]])).tolist() == [
        [0, 15, 7.5, 8]
    ]


def test_systems_of_three() -> None:
    half = torch.rand(5, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    matrix, values = half @ half.mT + torch.eye(3), torch.rand(5, 3, dtype=torch.float64)
    torch.testing.assert_close(solve(matrix, values), torch.linalg.solve(matrix, values))


def test_a_flattened_frame() -> None:
    """Boxes move as the points around them; a frame without ground stays as it is."""
    points, want = street()
    points = torch.cat((points, torch.ones_like(points[:, :1])), dim=1)
    boxes = torch.cat((PLACES[0], (want[0] + 0.8)[:, None], torch.tensor([[3.9, 1.6, 1.6, 0.3]] * 3)), dim=1)
    limits = (0.0, -32.0, -3.0, 64.0, 32.0, 2.0)
    assert reach_of(limits) == 64
    flat, moved = flatten(points, boxes, -1.6, limits)
    assert (moved[:, 2] - moved[:, 5] / 2 + 1.6).abs().max() < 0.06
    assert torch.equal(moved[:, [0, 1, 3, 4, 5, 6]], boxes[:, [0, 1, 3, 4, 5, 6]])
    assert torch.equal(flat[:, [0, 1, 3]], points[:, [0, 1, 3]])
    assert -1.6 <= flat[:, 2].quantile(0.5) < -1.5  # the ground is a low point of a cell, along which it rises by 7 cm
    for before, after in zip((points[:5], boxes), flatten(points[:5], boxes, -1.6, limits), strict=True):
        assert torch.equal(before, after)


@pytest.fixture(scope="module")
def real_frames(kitti_root: Path) -> list[tuple[Tensor, Tensor]]:
    """Points (N, 4) and labelled boxes (M, 7) of the frames to validate."""
    frames = [read_frame(kitti_root, name) for name in read_split(kitti_root, "val")]
    return [(frame.points, frame.objects.boxes) for frame in frames if frame.objects is not None]


def test_labelled_boxes_of_real_frames_stand_on_it(real_frames: list[tuple[Tensor, Tensor]]) -> None:
    """Half of them within 6 cm, nine of ten within 20 cm."""
    bottoms = [boxes[:, 2] - boxes[:, 5] / 2 for _, boxes in real_frames]
    left = [bottom - ground_at(points, boxes[:, :2])
            for bottom, (points, boxes) in zip(bottoms, real_frames, strict=True)]  # fmt: skip
    every = torch.cat(left).abs()
    assert len(every) > 150
    assert every.median() < 0.06
    assert every.quantile(0.9) < 0.2


def test_five_fits_of_the_plane_are_enough(
    real_frames: list[tuple[Tensor, Tensor]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under labelled objects the ground lies within 3 cm of where 20 fits put it; two fits are too few."""
    found = {}
    for fits in (2, ground.ITERATIONS, 20):
        monkeypatch.setattr(ground, "ITERATIONS", fits)
        found[fits] = torch.cat([ground_at(points, boxes[:, :2]) for points, boxes in real_frames])
    off = {fits: (heights - found[20]).abs().max() for fits, heights in found.items()}
    assert off[5] < 0.03
    assert off[2] > 0.2
