"""Insertion follows SECOND's rules, and puts objects on the ground where they land."""

from typing import Any

import pytest
import torch

from hvnet.boxes import points_in_boxes
from hvnet.data.insert import TrainingFrame, sample_frame, sample_objects
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
