"""The judge of clouds: reflectance, ground, and what is in range."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from hvnet.data.clouds import read_cloud
from hvnet.data.sensor import (
    GROUND_TOLERANCE,
    Look,
    as_points,
    find_ground,
    full_scale,
    has_reflectance,
    highest_reflectance,
    inside,
    judge_reflectance,
    range_reason,
    shift_to,
    summary,
    too_bright,
)
from tests.helpers import SHARED

RANGE = (0.0, -32.0, -3.0, 64.0, 32.0, 2.0)


def street(ground: float = -1.73, count: int = 6000, seed: int = 0) -> Tensor:
    """Points (count, 4) of a flat road with things on it and noise below."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 4, generator=generator) * torch.tensor([60.0, 60, 0.04, 1])
    points[:, :2] -= 30
    points[: count // 4, 2] += 3 * torch.rand(count // 4, generator=generator)
    points[-count // 50 :, 2] -= 2  # reflections
    points[:, 2] += ground
    return points


# --- reflectance -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("highest", "scale"), [(0, 1), (0.4, 1), (1, 1), (1.05, 1), (1.5, 255), (40, 255), (255, 255),
                                                (256, 65535), (65535, 65535), (1e6, 1e6)])  # fmt: skip
def test_scales(highest: float, scale: float) -> None:
    values = np.linspace(0, highest, 60)
    assert full_scale(highest_reflectance(values)) == pytest.approx(scale)


@pytest.mark.parametrize("outlier", [65535.0, 1e30, np.inf, np.nan])
@pytest.mark.parametrize("count", [60, 20_000])
@pytest.mark.parametrize("scale", [1.0, 255.0])
def test_an_outlier_changes_no_scale(outlier: float, count: int, scale: float) -> None:
    values = np.linspace(0, scale, count, dtype=np.float32)
    values[count // 2] = outlier
    assert full_scale(highest_reflectance(values)) == scale
    found = judge_reflectance(values, count, scale)
    wanted = (np.linspace(0, scale, count, dtype=np.float32) / np.float32(scale)).astype(np.float32)
    rest = np.arange(count) != count // 2
    np.testing.assert_array_equal(found.values[rest], wanted[rest])
    assert found.values[count // 2] == (0 if np.isnan(outlier) else 1)


def test_dark_clouds_of_mostly_nothing() -> None:
    """Most points of some sensors have an intensity of 0."""
    values = np.zeros(1000)
    values[::50] = np.linspace(20, 90, 20)
    assert full_scale(highest_reflectance(values)) == 255


def test_a_reflectance_that_never_changes_is_none() -> None:
    assert not has_reflectance(np.full(100, 7.0))
    assert not has_reflectance(np.full(5, np.nan))
    assert has_reflectance(np.full(5, 7.0))  # too few to tell
    assert has_reflectance(np.array([7.0] * 99 + [8.0]))
    found = judge_reflectance(np.full(100, 7.0, np.float32), 100, 255)
    assert (found.values == 0).all()
    assert found.note == "has a constant reflectance; 0 is used, which makes detection worse"
    assert judge_reflectance(None, 3, 1).note == "has no reflectance; 0 is used, which makes detection worse"
    assert judge_reflectance(np.float32([0, 1]), 2, 0).fact == "reflectance left out"


# --- arrays ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("threads")
def test_every_kind_of_array_gives_the_same_points() -> None:
    points = street(count=50).numpy()
    read_only = points.copy()
    read_only.flags.writeable = False
    mirrored = points[::-1].copy()[::-1]
    kinds = {
        "big-endian": points.astype(">f4"),
        "float64": points.astype(np.float64),
        "read-only": read_only,
        "negative strides": mirrored,
        "every second column": np.repeat(points, 2, axis=1)[:, ::2],
        "Fortran order": np.asfortranarray(points),
        "tensor": torch.from_numpy(points),
        "list": points.tolist(),
    }
    for kind, array in kinds.items():
        found = as_points(array)
        assert found.dtype == torch.float32, kind
        np.testing.assert_array_equal(found.numpy(), points, err_msg=kind)
    assert torch.equal(as_points(points.round().astype(np.int64)), torch.from_numpy(points.round()))


@pytest.mark.parametrize(("array", "said"), [
    (np.zeros((4, 100)), r"got \(4, 100\): it is transposed, give points\.T"),
    (torch.zeros(4, 5), r"got \(4, 5\): it is transposed"),
    (np.zeros((100, 3)), r"want shape \(N, 4\).*got \(100, 3\)$"),
    (np.zeros((100, 5)), r"got \(100, 5\)$"),
    (np.zeros(4), r"got \(4,\)$"),
    (np.zeros((2, 4), complex), "want real numbers, got complex128"),
    (torch.zeros(2, 4, dtype=torch.complex64), "want real numbers, got torch.complex64"),
    (np.array([["a"] * 4]), "want real numbers, got <U1"),
])  # fmt: skip
def test_arrays_that_are_no_points(array: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        as_points(array)


def test_reflectance_of_arrays() -> None:
    points = street(count=100)
    assert as_points(points) is points  # nothing to do, nothing copied
    spoilt = points.clone()
    spoilt[3, 3], spoilt[4, 3] = torch.nan, -1
    wanted = points.clone()
    wanted[3:5, 3] = 0
    assert torch.equal(as_points(spoilt), wanted)
    same = points.clone()
    same[:, 3] = 0.5
    assert (as_points(same)[:, 3] == 0).all()
    assert (as_points(same[:9])[:, 3] == 0.5).all()  # too few to tell


def test_too_bright_is_what_is_in_range() -> None:
    points = torch.tensor([[5.0, 0, 0, 0.5], [5, 0, 0, 1.05], [-5, 0, 0, 200], [5, 0, 9, 300], [torch.nan, 0, 0, 400]])
    assert too_bright(points, RANGE) == 0
    points[0, 3] = 1.2
    assert too_bright(points, RANGE) == pytest.approx(1.2)
    assert too_bright(points[:0], RANGE) == 0


# --- ground ----------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("ground", [-3.2, -1.73, -0.33, 0.0, 12.0])
def test_the_ground_is_found(ground: float) -> None:
    found = find_ground(street(ground))
    assert found.dtype == torch.float32
    assert float(found) == pytest.approx(ground, abs=0.05)


@pytest.mark.usefixtures("threads")
def test_the_ground_of_a_sensor_high_up() -> None:
    """Which sees it from 20 m on only."""
    points = street(-6.0)
    assert float(find_ground(points[torch.hypot(points[:, 0], points[:, 1]) > 20])) == pytest.approx(-6, abs=0.05)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("points", [
    torch.zeros(0, 4),
    torch.full((10, 4), torch.nan),
    torch.zeros(5000, 4),  # all at the sensor
    street()[:20],
    torch.rand(3000, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor([60.0, 60, 40, 1]) - 30,  # anywhere
    street() + 1e6,
    street(3.0)[:400],  # little, and above the sensor
    torch.cat((street(4.0), street(-1.7)[:3000] * torch.tensor([0.1, 0.1, 1, 1]))),  # a ceiling; the floor is near
])  # fmt: skip
def test_no_ground(points: Tensor) -> None:
    assert math.isnan(find_ground(points))


def test_points_that_are_not_finite_are_not_in_the_way() -> None:
    points = street()
    points[::7, 2], points[1::7, 0], points[2::7, 1] = torch.nan, torch.inf, -torch.inf
    assert float(find_ground(points)) == pytest.approx(-1.73, abs=0.05)


def test_a_cloud_is_moved_by_more_than_a_little() -> None:
    for off in (0.0, GROUND_TOLERANCE - 0.01, 0.01 - GROUND_TOLERANCE, math.nan):
        assert float(shift_to(torch.tensor(-1.66 + off), -1.66)) == 0
    assert float(shift_to(torch.tensor(-0.33), -1.66)) == pytest.approx(-1.33)
    assert float(shift_to(torch.tensor(-3.0), -1.66)) == pytest.approx(1.34)


def test_kitti_is_not_moved(kitti_root: Path) -> None:
    """Whole scans and what the camera sees."""
    for file in sorted((kitti_root / "training" / "velodyne").glob("*.bin")):
        ground = find_ground(torch.from_numpy(read_cloud(file)[0]))
        assert abs(float(ground) + 1.66) < 0.3, file


@pytest.mark.parametrize(("name", "height"), [
    ("nuscenes.pcd.bin", -1.84), ("argoverse2.npy", -0.33), ("padded_fields.pcd", -1.55),
])  # fmt: skip
def test_the_ground_of_other_sensors(name: str, height: float) -> None:
    if not (SHARED / "clouds").is_dir():
        pytest.skip("no clouds of other sensors")
    assert float(find_ground(torch.from_numpy(read_cloud(SHARED / "clouds" / name)[0]))) == pytest.approx(
        height, abs=0.15
    )


# --- range -----------------------------------------------------------------------------------------------------------


def test_inside() -> None:
    points = torch.tensor([[0.0, 0, 0], [64, 0, 0], [1, -32, 0], [1, 32, 0], [1, 0, -3], [1, 0, 2], [torch.nan, 0, 0]])
    assert inside(points, RANGE).tolist() == [True, False, True, False, True, False, False]


@pytest.mark.parametrize(("change", "said"), [
    (lambda p: p + torch.tensor([4.5e5, 5.4e6, 110, 0]), r"they lie around 450\d\d\d, 5400\d\d\d, 10\d, as map coord"),
    (lambda p: p * 1000, "as in millimetres; metres are wanted"),
    (lambda p: p + torch.tensor([100.0, 0, 0, 0]), "they are further from the sensor than 64 m"),
    (lambda p: p * 100, "as in centimetres; metres are wanted"),
    (lambda p: p + torch.tensor([0, 0, 30.0, 0]), r"their heights .* are .* m, -3 to 2 m are seen; give"),
    (lambda p: p * torch.tensor([0, 1, 1, 1]) - torch.tensor([20.0, 0, 0, 0]), "behind or beside the sensor; --turn"),
    (lambda p: p[:0], "the cloud has no points"),
    (lambda p: p * torch.nan, "the cloud has no points"),
])  # fmt: skip
def test_reasons(change: Callable[[Tensor], Tensor], said: str) -> None:
    assert re.search(said, range_reason(change(street()), RANGE))


def test_lines() -> None:
    looks = [Look(100, 90, -1.7, 0.0), Look(2000, 1000, -0.33, -1.33), Look(5, 0, math.nan, 0.0)]
    assert looks[0].text() == "100 points, 90 in range; ground at -1.70 m"
    assert looks[1].text() == "2,000 points, 1,000 in range; ground at -0.33 m, moved to -1.66 m"
    assert looks[2].text() == "5 points, 0 in range; no ground found"
    assert summary(looks, ["reflectance as is"] * 2 + ["no reflectance"]) == (
        "5 to 2,000 points, 0 to 90 % in range, ground -1.70 to -0.33 m, 1 of 3 moved by -1.33 m, no reflectance, "
        "reflectance as is"
    )
    assert summary(looks[:1], ["reflectance as is"]) == "100 points, 90 % in range, ground -1.70 m, reflectance as is"
