"""The simulated sensor: its points look like those of a Velodyne and lie where its beams meet something."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from hvnet.data.scenes import shapes
from hvnet.data.scenes.files import CAMERA, make_frame
from hvnet.data.scenes.shapes import Material
from hvnet.data.scenes.street import Options
from tests.scenes import car_at, scan_of, some_frames


def test_points_look_like_those_of_a_velodyne() -> None:
    for _, measured, _ in some_frames():
        xyz, reflectance = measured.points[:, :3].astype(np.float64), measured.points[:, 3].astype(np.float64)
        assert 10_000 < CAMERA.sees(xyz).sum() < 25_000  # KITTI: 15,000 to 23,000
        np.testing.assert_allclose(xyz, xyz.round(3), atol=1e-5)
        np.testing.assert_allclose(reflectance, reflectance.round(2), atol=1e-6)
        assert reflectance.min() >= 0
        assert reflectance.max() <= 1
        distance = np.linalg.norm(xyz, axis=1)
        elevation = np.degrees(np.arcsin(xyz[:, 2] / distance))
        assert elevation.min() > -24.6
        assert elevation.max() < 2.3
        assert distance.max() < 121
        assert np.abs(np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))).max() < 50.3


def test_points_lie_on_the_surface_that_the_beam_meets() -> None:
    wall = shapes.block((1, 60, 20), (20.5, 0, 0), Material.FACADE)
    measured, _ = scan_of(background=(wall,))
    on_wall = measured.points[measured.points[:, 2] > -1.5, 0]
    assert len(on_wall) > 10_000
    assert abs(on_wall.mean() - 20) < 0.01
    assert 0.01 < on_wall.std() < 0.03


def test_a_whole_turn_is_scanned_if_asked() -> None:
    _, measured, _ = make_frame(0, 0, replace(Options(), azimuth=180.0))
    azimuth = np.degrees(np.arctan2(measured.points[:, 1], measured.points[:, 0]))
    counts, _ = np.histogram(azimuth, bins=36, range=(-180, 180))
    assert counts.min() > 1500
    assert 80_000 < len(measured.points) < 133_000  # KITTI: 108,000 to 127,000


def test_points_become_fewer_with_the_distance() -> None:
    counts = [int(scan_of(car_at(x, 0.0))[0].hits[0]) for x in (8, 16, 32, 64)]
    # four times fewer at twice the distance, and a loss for weak returns
    for near, far in pairwise(counts):
        assert 2.5 < near / far < 12
    assert 300 < counts[1] < 1200  # the middle 80 % of KITTI's cars at 10 to 20 m have 193 to 1116
    assert 30 < counts[2] < 290
