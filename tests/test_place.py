"""Clouds placed by many threads, against what one thread does with `hvnet.data.sensor`."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hvnet.data.clouds import read_cloud
from hvnet.data.sensor import as_points, find_ground, too_bright
from hvnet.kernels.place import SAMPLED, ground_heights, place_points
from hvnet.network.views import View
from tests.helpers import SHARED
from tests.test_sensor import street

RANGE = (0.0, -32.0, -3.0, 64.0, 32.0, 2.0)
CLOUDS = {
    "street": street(),
    "from afar": street(-6.0)[torch.hypot(*street(-6.0)[:, :2].T) > 20],
    "above the sensor": street(12.0),
    "little, and above the sensor": street(3.0)[:400],
    "a ceiling": torch.cat((street(4.0), street(-1.7)[:3000] * torch.tensor([0.1, 0.1, 1, 1]))),
    "none": torch.zeros(0, 4),
    "not finite": torch.full((10, 4), torch.nan),
    "all at the sensor": torch.zeros(5000, 4),
    "few": street()[:20],
    "anywhere": torch.rand(3000, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor([60.0, 60, 40, 1]) - 30,
    "sampled one by one": street(-2.0, 2 * SAMPLED - 1),
    "every second": street(-2.0, 2 * SAMPLED),
    "every third": street(1.0, 3 * SAMPLED + 5),
}


def padded(clouds: list[Tensor], device: torch.device, capacity: int = 0) -> tuple[Tensor, Tensor]:
    """Clouds in one array, filled up with points that would change every result, and how many points each has."""
    points = torch.tensor([5.0, 5.0, -90.0, 7.0]).repeat(len(clouds), max(capacity, *map(len, clouds)), 1)
    for b, cloud in enumerate(clouds):
        points[b, : len(cloud)] = cloud
    counts = torch.tensor([len(cloud) for cloud in clouds], dtype=torch.int32)
    return points.to(device), counts.to(device)


@pytest.mark.parametrize("extra", [0, 1, 70_000])
@pytest.mark.parametrize("name", CLOUDS)
def test_the_ground_is_that_of_one_thread(name: str, extra: int, device: torch.device) -> None:
    cloud = CLOUDS[name]
    found = ground_heights(*padded([cloud], device, len(cloud) + extra)).cpu()
    assert torch.equal(found.isnan(), find_ground(cloud)[None].isnan())
    torch.testing.assert_close(found, find_ground(cloud)[None], rtol=0, atol=1e-5, equal_nan=True)


def test_the_grounds_of_several_clouds(device: torch.device) -> None:
    wanted = torch.stack([find_ground(cloud) for cloud in CLOUDS.values()])
    assert wanted.isnan().any()
    assert wanted.isfinite().sum() >= 6
    found = ground_heights(*padded(list(CLOUDS.values()), device)).cpu()
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5, equal_nan=True)


def test_the_grounds_of_real_clouds(kitti_root: Path, device: torch.device) -> None:
    files = sorted((kitti_root / "training" / "velodyne").glob("*.bin"))[:12] + sorted(
        (SHARED / "clouds").glob("*.bin")
    )
    clouds = [torch.from_numpy(read_cloud(file)[0]) for file in files]
    wanted = torch.stack([find_ground(cloud) for cloud in clouds])
    torch.testing.assert_close(ground_heights(*padded(clouds, device)).cpu(), wanted, rtol=0, atol=1e-5, equal_nan=True)


def spoilt(reflectance: list[float], count: int = 40) -> Tensor:
    """Points some of which have another reflectance."""
    points = street(count=count)
    points[: len(reflectance), 3] = torch.tensor(reflectance)
    return points


@pytest.mark.parametrize("reflectance", [True, False])
@pytest.mark.parametrize("views", [(View(0.0),), (View(0.3), View(-2.0, True), View(math.pi), View(0.0, True))])
def test_points_are_those_of_one_thread(views: tuple[View, ...], reflectance: bool, device: torch.device) -> None:
    same = street(count=50)
    same[:, 3] = 0.5
    clouds = [
        street(),
        spoilt([math.nan, -1.0, -0.0, math.inf, -math.inf]),
        same,
        same[:9],  # too few to tell
        torch.cat((same, torch.tensor([[1.0, 1, 1, math.nan], [1, 1, 1, -math.inf]]))),
        torch.cat((same * torch.tensor([1, 1, 1, 0]), torch.tensor([[1.0, 1, 1, -3.0]]))),  # 0 everywhere
        torch.tensor([[9.0, 1, 0, 1.05], [9, 1, 0, 1.2], [9, 2, 0, 1.5], [9, 1, 90, 300], [-9, 1, 0, 200]]),
        torch.full((12, 4), math.nan),
        torch.zeros(0, 4),
    ]
    shift = torch.linspace(-2, 2, len(clouds))
    rows = torch.tensor([[math.cos(angle), math.sin(angle), 1 - 2 * mirrored] for angle, mirrored in views])
    points, counts = padded(clouds, device)
    placed, bright = place_points(points, counts, shift.to(device), rows.to(device), RANGE, reflectance)
    assert placed.shape == (len(clouds), len(views), points.shape[1], 4)
    for b, cloud in enumerate(clouds):
        moved = as_points(cloud) + torch.stack((shift[b] * 0, shift[b] * 0, shift[b], shift[b] * 0))
        if not reflectance:
            moved[:, 3] = 0
        wanted = torch.stack([view.see(moved) for view in views])
        found = placed[b, :, : len(cloud)].cpu()
        torch.testing.assert_close(found, wanted, rtol=0, atol=2e-5, equal_nan=True)
        assert torch.equal(found[..., 3], wanted[..., 3])
        assert placed[b, :, len(cloud) :, :3].isnan().all()
        assert bright[b].item() == max(float(too_bright(each, RANGE)) for each in wanted)
    assert bright.any() == reflectance


def test_other_arrays_are_refused() -> None:
    points, counts = padded([street(count=5)], torch.device("cpu"))
    with pytest.raises(ValueError, match="points: want shape"):
        ground_heights(points[0], counts)
    with pytest.raises(TypeError, match=r"counts: want dtype torch\.int32"):
        ground_heights(points, counts.long())
    with pytest.raises(ValueError, match="shift: want shape"):
        place_points(points, counts, torch.zeros(2), torch.zeros(1, 3), RANGE, True)
    with pytest.raises(ValueError, match="views: want shape"):
        place_points(points, counts, torch.zeros(1), torch.zeros(1, 2), RANGE, True)
