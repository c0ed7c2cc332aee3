"""Insertion follows SECOND's rules, and puts objects on the ground and behind what hides them."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hvnet.boxes import points_in_boxes
from hvnet.data.augment import mix_sectors
from hvnet.data.gt_database import read_database
from hvnet.data.insert import MIN_POINTS, ObjectSampler, TrainingFrame, sample_frame, sample_objects, sampler_of
from hvnet.data.kitti import read_frame
from hvnet.data.occlusion import nearest_points
from tests.objects import CLASSES, COUNTS, car, make_objects, points_of, scene, seeded, unlabelled


def test_sampling_tops_up_to_the_count() -> None:
    database = make_objects([("Car", car(10.0 * k, 50)) for k in range(10)])
    boxes = torch.tensor([car(0, 0), car(10, 0), car(20, 0)])
    labels = torch.tensor([0, 0, -1])  # the third is no Car
    points, boxes, labels = sample_objects(
        TrainingFrame(torch.zeros(0, 4), boxes, labels), database, {"Car": 5}, seeded(), CLASSES
    )[:3]
    assert labels.tolist() == [0, 0, -1, 0, 0, 0]
    assert len(boxes) == 6
    assert len(boxes.unique(dim=0)) == 6  # drawn without replacement
    assert len(points) == 30
    full = sample_objects(TrainingFrame(points, boxes, labels), database, {"Car": 4}, seeded(), CLASSES)
    assert torch.equal(full.boxes, boxes)


def test_sampling_takes_what_there_is() -> None:
    database = make_objects([("Car", car(10, 0))])
    _, boxes, labels = sample_objects(unlabelled(), database, COUNTS, seeded(), CLASSES)[:3]
    assert boxes.tolist() == [car(10, 0)]
    assert labels.tolist() == [0]


def test_inserted_object_keeps_its_pose_and_points() -> None:
    database = make_objects([("Pedestrian", [10, 5, -0.5, 0.8, 0.6, 1.8, 0.7])])
    cloud = torch.tensor([[10.0, 5, -0.5, 0.1], [30, 5, -0.5, 0.1], [10, 5, 3, 0.1]])
    points, boxes, labels = sample_objects(unlabelled(cloud), database, COUNTS, seeded(), CLASSES)[:3]
    # the point of the frame inside the box gives way to the object's
    assert torch.equal(points, torch.cat((cloud[1:], points_of(database, 0))))
    assert torch.equal(boxes, torch.from_numpy(database.database.box))
    assert labels.tolist() == [1]


def test_sampled_object_that_collides_is_given_up() -> None:
    database = make_objects([("Car", car(10, 0)), ("Car", car(30, 0))])
    van = torch.tensor([car(12, 1, 0.5)])
    cloud = torch.tensor([[10.0, 0, -1, 0.1]])
    points, boxes, labels = sample_objects(
        TrainingFrame(cloud, van, torch.tensor([-1])), database, COUNTS, seeded(), CLASSES
    )[:3]
    assert boxes.tolist() == [van[0].tolist(), car(30, 0)]
    assert labels.tolist() == [-1, 0]
    assert torch.equal(points, torch.cat((cloud, points_of(database, 1))))


def test_of_two_sampled_objects_that_collide_one_is_inserted() -> None:
    database = make_objects([("Car", car(10, 0)), ("Cyclist", car(11, 0)), ("Car", car(10, 1))])
    for seed in range(10):
        _, boxes, labels = sample_objects(unlabelled(), database, COUNTS, seeded(seed), CLASSES)[:3]
        assert labels.tolist() == [0]
        assert boxes.shape == (1, 7)


def test_objects_that_are_hardly_seen_are_not_inserted() -> None:
    objects = [("Car", car(10.0 * k, 0)) for k in range(4)]
    columns: dict[str, Any] = {
        "truncation": [0, 0.51, 0, 0.5],
        "occlusion": [3, 0, 0, 2],
        "bbox_height": [40, 40, 25, 25.5],
    }
    database = make_objects(objects, **columns)
    _, boxes, _ = sample_objects(unlabelled(), database, COUNTS, seeded(), CLASSES)[:3]
    assert boxes.tolist() == [car(30, 0)]
    database = make_objects(objects, **columns | {"bbox_height": [0] * 4})  # without a camera
    _, boxes, _ = sample_objects(unlabelled(), database, COUNTS, seeded(), CLASSES)[:3]
    assert boxes[:, 0].sort().values.tolist() == [20, 30]
    for points_each, inserted in ((4, 0), (5, 4)):
        database = make_objects(objects, points_each)
        _, boxes, _ = sample_objects(unlabelled(), database, COUNTS, seeded(), CLASSES)[:3]
        assert len(boxes) == inserted


def test_no_objects_asked_for() -> None:
    points, boxes = scene()
    labels = torch.zeros(len(boxes), dtype=torch.int64)
    database = make_objects([("Car", car(100, 0))])
    frame = TrainingFrame(points, boxes, labels)
    assert sample_objects(frame, database, {}, seeded(), CLASSES) is frame


def test_a_whole_frame_keeps_together() -> None:
    objects = [("Car", car(10.0 * k, 0)) for k in range(4)] + [("Van", car(50, 0)), ("Pedestrian", car(60, 0))]
    database = make_objects(objects, frame=[3, 7, 7, 3, 7, 7])
    found = set()
    for seed in range(10):
        points, boxes, labels = sample_frame(unlabelled(), database, seeded(seed), CLASSES)[:3]
        assert len(points) == 10 * len(boxes)
        found.add((tuple(boxes[:, 0].tolist()), tuple(labels.tolist())))
    assert found == {((0.0, 30.0), (0, 0)), ((10.0, 20.0, 50.0, 60.0), (0, 0, -1, 1))}


@pytest.mark.parametrize("threads", ["one", "many"])
def test_objects_stand_on_a_flat_ground(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Box and points are raised and lowered alike; the database does not change."""
    monkeypatch.setattr("hvnet.kernels.launch.force_many_threads", threads == "many")
    database = make_objects([("Car", car(10, 0)), ("Pedestrian", [30, 5, -0.5, 0.8, 0.6, 1.8, 0.7])])
    before, was = torch.from_numpy(database.database.box).clone(), database.points.clone()
    points, boxes, labels = sample_objects(unlabelled(), database, COUNTS, seeded(), CLASSES, ground=-1.6)[:3]
    assert labels.tolist() == [0, 1]
    torch.testing.assert_close(boxes[:, 2] - boxes[:, 5] / 2, torch.tensor([-1.6, -1.6]))
    same = [0, 1, 3, 4, 5, 6]
    assert torch.equal(boxes[:, same], before[:, same])
    torch.testing.assert_close(points[:, 2] - was[:, 2], (boxes[:, 2] - before[:, 2]).repeat_interleave(10))
    assert torch.equal(points[:, [0, 1, 3]], was[:, [0, 1, 3]])
    assert points_in_boxes(points, boxes).any(dim=1).all()
    assert torch.equal(database.points, was)
    assert torch.equal(torch.from_numpy(database.database.box), before)


def facing(name: str, x: float, y: float) -> tuple[str, list[float]]:
    """An object 2 m wide and 1.6 m high on a road at -1.6 m, seen from behind."""
    return name, [x, y, -0.8, 4.0, 2.0, 1.6, 0.0]


def rear(x: float, y: float) -> Tensor:
    """Points (800, 4) on the rear of the object of `facing`, on the side of the sensor."""
    across = torch.cartesian_prod(torch.linspace(-0.95, 0.95, 40) + y, torch.linspace(-1.55, -0.05, 20))
    return torch.cat((torch.full((800, 1), x - 1.9), across, torch.full((800, 1), 0.5)), dim=1)


def fully_seen(*objects: tuple[str, float, float]) -> ObjectSampler:
    """A database of objects (class, x, y) with all points of their rears."""
    database = make_objects([facing(*each) for each in objects], points_each=800)
    return database._replace(points=torch.cat([rear(x, y) for _, x, y in objects]))


def wall(x: float, y: tuple[float, float]) -> Tensor:
    """Points (N, 4) of a wall across the x axis, from the road up to 3 m."""
    across = torch.cartesian_prod(torch.arange(*y, 0.05), torch.arange(-1.6, 1.4, 0.05))
    return torch.cat((torch.full((len(across), 1), x), across, torch.zeros(len(across), 1)), dim=1)


@pytest.mark.parametrize("threads", ["one", "many"])
def test_objects_hide_and_are_hidden(threads: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a car, a pedestrian behind it and a cyclist behind a wall the car is inserted, and what is behind it goes."""
    monkeypatch.setattr("hvnet.kernels.launch.force_many_threads", threads == "many")
    database = fully_seen(("Car", 12, 0), ("Pedestrian", 24, 0), ("Cyclist", 24, 10))
    cloud = torch.cat((wall(40.0, (-12, 12)), wall(15.0, (4, 8)), rear(24, -10), rear(30, 0.1)))
    boxes = torch.tensor([facing("Car", 24, -10)[1], facing("Car", 30, 0.1)[1]])  # the latter is behind the car, too
    frame = TrainingFrame(cloud, boxes, torch.tensor([0, 0]), nearest_points(cloud))
    points, found, labels, *_ = sample_objects(frame, database, COUNTS, seeded(), CLASSES)
    assert labels.tolist() == [0, 0]
    assert torch.equal(found, torch.stack((boxes[0], torch.tensor(facing("Car", 12, 0)[1]))))
    points = points[points.isfinite().all(dim=1)]
    assert torch.equal(points[-800:], rear(12, 0))
    behind = (points[:, 0] > 25) & (points[:, 2] < -0.2)
    # 0.95 m at 10.1 m, seen at 40 m, to the width of a cell
    assert points[behind & (points[:, 1].abs() < 3.7)].shape == (0, 4)
    kept = (cloud[:, 0] < 25) | (cloud[:, 1].abs() > 4.1)
    assert len(points) - 800 >= int(kept.sum())
    plain = sample_objects(frame._replace(obstacles=None), database, COUNTS, seeded(), CLASSES)
    assert len(plain.boxes) == 5
    assert len(plain.points) == len(cloud) + 3 * 800


def test_an_object_that_is_partly_hidden_loses_points() -> None:
    database = fully_seen(("Car", 24, 0))
    cloud = wall(11.05, (0, 4))  # half as far as the car's rear
    frame = unlabelled(cloud)._replace(obstacles=nearest_points(cloud))
    points, boxes, _, *_ = sample_objects(frame, database, COUNTS, seeded(), CLASSES)
    assert len(boxes) == 1
    assert torch.equal(points[: len(cloud)], cloud)
    left = points[len(cloud) :]
    high = left[:, 2] > -1.1  # nothing is hidden further down, where the road would be
    assert left[high, 1].max() < 0.2
    assert 0.45 * 14 * 40 < int(high.sum()) <= 0.6 * 14 * 40


def test_mixed_frames_hide_what_each_does_on_its_side() -> None:
    cloud = torch.cat((wall(10.0, (-5, 5)), wall(20.0, (-10, 10))))
    frame = unlabelled(cloud)._replace(obstacles=nearest_points(cloud))
    mixed = mix_sectors(frame, unlabelled()._replace(obstacles=torch.zeros(0, 3)), seeded(1))
    assert mixed.obstacles is not None
    assert 0 < len(mixed.obstacles) < len(nearest_points(cloud))
    assert torch.equal(mixed.obstacles, nearest_points(mixed.points))
    assert mix_sectors(unlabelled(cloud), unlabelled(), seeded(1)).obstacles is None


def test_a_real_frame_with_occlusion(kitti_root: Path) -> None:
    """Some boxes fewer are inserted, all of which have MIN_POINTS or more, and no point is made."""
    database = sampler_of(read_database(kitti_root / "gt_database.npz"))
    read = read_frame(kitti_root, "000008")
    assert read.objects is not None
    labels = torch.tensor([CLASSES.index(name) if name in CLASSES else -1 for name in read.objects.names])
    frame = TrainingFrame(read.points, read.objects.boxes, labels, nearest_points(read.points))
    hidden_too = sample_objects(frame, database, COUNTS, seeded(), CLASSES)
    plain = sample_objects(frame._replace(obstacles=None), database, COUNTS, seeded(), CLASSES)
    assert 10 < len(hidden_too.boxes) < len(plain.boxes)
    assert set(map(tuple, hidden_too.boxes.tolist())) < set(map(tuple, plain.boxes.tolist()))
    counts = points_in_boxes(hidden_too.points, hidden_too.boxes).sum(dim=0)
    assert counts.min() >= MIN_POINTS
    assert len(read.points) / 2 < len(hidden_too.points) < len(plain.points)
    known = set(map(tuple, torch.cat((plain.points, read.points)).tolist()))
    assert set(map(tuple, hidden_too.points.tolist())) < known
