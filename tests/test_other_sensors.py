"""Frames as other sensors see them: the beams of real scans are found, what is off changes nothing, boxes follow."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from hvnet.boxes import points_in_boxes
from hvnet.config import AugmentConfig
from hvnet.data.augment import augment
from hvnet.data.kitti import read_frame, read_split
from hvnet.data.other_sensors import find_beams, random_pitch, random_reflectance, unseen_by_fewer_beams
from tests.objects import unlabelled

STILL = AugmentConfig(flip=0, rotation=0, scaling=(1, 1), translation=(0, 0, 0))


def seeded(seed: int = 0) -> Generator:
    return Generator().manual_seed(seed)


def rings(count: int = 500) -> tuple[Tensor, Tensor]:
    """Points (64 * count, 4) of the 64 beams at random distances all round, and the beam of each."""
    beam = torch.arange(64).repeat_interleave(count)
    elevation = torch.where(beam < 32, 1.94 - 0.3435 * beam, -9.03 - 0.515 * (beam - 32)).deg2rad()
    apex = torch.where(beam < 32, 0.2, 0.12)
    distance = 2 + 60 * torch.rand(len(beam), generator=seeded())
    turn = 2 * math.pi * torch.rand(len(beam), generator=seeded(1))
    z = apex + distance * elevation.tan()
    return torch.stack((distance * turn.cos(), distance * turn.sin(), z, torch.full_like(z, 0.5)), dim=1), beam


def test_beams_of_cones() -> None:
    points, beam = rings()
    assert torch.equal(find_beams(points), beam)
    order = torch.randperm(len(points), generator=seeded())
    assert torch.equal(find_beams(points[order]), beam[order])


def test_beams_of_any_point() -> None:
    """Above all beams, below all, at the origin, and of a row that is gone."""
    points = torch.tensor([[5.0, 0, 5, 0], [5, 0, -9, 0], [0, 0, 0, 0], [math.nan] * 4])
    found = find_beams(points)
    assert found[:2].tolist() == [0, 63]
    assert ((found >= 0) & (found < 64)).all()
    assert find_beams(torch.zeros(0, 4)).shape == (0,)


def test_beams_of_real_scans(kitti_root: Path) -> None:
    """A file holds ring by ring, from the top, each beginning straight ahead: so the true beams are known."""
    for name in read_split(kitti_root, "train_first")[::4]:
        points = read_frame(kitti_root, name, crop=False).points
        turn = torch.atan2(points[:, 1], points[:, 0]) % (2 * math.pi)
        beam = torch.cat((torch.zeros(1, dtype=torch.int64), (turn.diff() < -math.pi).cumsum(0)))
        assert int(beam.max()) == 63
        assert (find_beams(points) != beam).float().mean() < 3e-4


def test_whole_beams_are_left_out() -> None:
    """20 to 40 stay, evenly spread; in half of the frames half of their points."""
    points, beam = rings()
    counts, shares = [], []
    for seed in range(200):
        seen = ~unseen_by_fewer_beams(points, seeded(seed))
        share = torch.zeros(64).index_add_(0, beam, seen.float()) / 500
        stays = share > 0
        counts.append(int(stays.sum()))
        shares.append(float(share[stays].mean()))
        assert ((share[stays] - shares[-1]).abs() < 0.15).all()  # no beam is torn
        assert stays[0]
        elevation = torch.where(
            torch.arange(64) < 32, 1.94 - 0.3435 * torch.arange(64), 7.45 - 0.515 * torch.arange(64)
        )
        gaps = -elevation[stays].diff()
        assert gaps.max() < 1.4 + 0.52
        assert gaps.mean() > 0.6
    assert (min(counts), max(counts)) == (20, 40)
    assert set(np.round(shares, 1)) == {0.5, 1.0}
    assert 0.4 < np.mean(np.array(shares) < 0.75) < 0.6


def test_inserted_objects_share_the_beams_of_the_street() -> None:
    """Points are thinned alike wherever they stand in the cloud, and by chance with the given probability."""
    points, _ = rings(100)
    options = replace(STILL, fewer_beams=0.5)
    thinned = []
    for seed in range(100):
        left, _, _ = augment(unlabelled(torch.cat((points, points))), None, options, seeded(seed), ())
        street, objects = left.chunk(2)
        assert torch.equal(street, objects)
        thinned.append(len(street) < len(points))
        assert not thinned[-1] or 0.1 < len(street) / len(points) < 0.7
    assert 0.35 < np.mean(thinned) < 0.65


def test_reflectance() -> None:
    points = torch.tensor([[1.0, 2, 3, 0.5], [1, 2, 3, 0.0], [4, 5, 6, 0.9], [math.nan] * 4])
    assert random_reflectance(points, 0.0, (1.0, 1.0), seeded()) is points
    doubled = random_reflectance(points, 0.0, (2.0, 2.0), seeded())
    torch.testing.assert_close(doubled[:, 3], torch.tensor([1.0, 0, 1, math.nan]), equal_nan=True)
    assert torch.equal(doubled[:3, :3], points[:3, :3])
    none = random_reflectance(points, 1.0, (2.0, 2.0), seeded())
    torch.testing.assert_close(none[:, 3], torch.tensor([0.0, 0, 0, math.nan]), equal_nan=True)
    assert points[0, 3] == 0.5  # not in place
    generator = seeded()
    found = [random_reflectance(points, 0.25, (0.5, 1.5), generator)[0, 3].item() for _ in range(400)]
    assert 0.18 < np.mean(np.array(found) == 0) < 0.32
    factors = np.array([value / 0.5 for value in found if value])
    assert 0.5 <= factors.min() < 0.52
    assert 1.48 < factors.max() <= 1.5


def test_pitch() -> None:
    points, boxes = torch.tensor([[10.0, 2, 0, 0.5]]), torch.tensor([[10.0, -3, 1, 4, 2, 1.5, 0.3]])
    generator, angles = seeded(), []
    for _ in range(200):
        turned, moved = random_pitch(points, boxes, 0.02, generator)
        angle = -math.atan2(turned[0, 2], turned[0, 0])
        angles.append(angle)
        cos, sin = math.cos(angle), math.sin(angle)
        torch.testing.assert_close(turned, torch.tensor([[10 * cos, 2, -10 * sin, 0.5]]))
        expected = torch.tensor([[10 * cos + sin, -3, cos - 10 * sin, 4, 2, 1.5, 0.3]])
        torch.testing.assert_close(moved, expected)
    assert -0.02 <= min(angles) < -0.019
    assert 0.019 < max(angles) <= 0.02
    assert random_pitch(points, boxes, 0.0, generator)[0] is points
    assert points[0, 2] == 0  # not in place


def test_points_of_real_boxes_stay_in_them(kitti_root: Path) -> None:
    """A box is not tilted: at 1 degree a few points at its ends leave it, most at its foot."""
    frame = read_frame(kitti_root, "000010")
    assert frame.objects is not None
    points, boxes = frame.points, frame.objects.boxes
    before = points_in_boxes(points, boxes).sum(dim=0)
    turned, moved = random_pitch(points, boxes, math.radians(1), seeded(3))
    after = points_in_boxes(turned, moved).sum(dim=0)
    assert not torch.equal(turned, points)
    assert ((after - before).abs() <= 3 + 0.1 * before).all()


@pytest.mark.parametrize("changes", [{}, {"fewer_beams": 0.0, "reflectance": (1.0, 1.0)}])
def test_what_is_off_draws_nothing(changes: dict[str, object]) -> None:
    """The bits are those of a frame that is flipped, turned, scaled and moved alone."""
    points, _ = rings(20)
    generator, plain = seeded(5), seeded(5)
    augment(unlabelled(points), None, AugmentConfig(**changes), generator, ())  # type: ignore[arg-type]
    torch.rand((), generator=plain)  # whether it is flipped
    torch.rand((), generator=plain)  # the rotation
    torch.rand((), generator=plain)  # the scaling
    torch.randn(3, generator=plain)
    assert torch.equal(torch.rand(3, generator=generator), torch.rand(3, generator=plain))
