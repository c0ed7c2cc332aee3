"""Augmentation: points and boxes move together, samples repeat, and inserted objects follow SECOND's rules."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from hvnet.boxes import bev_corners, boxes_collide, points_in_boxes
from hvnet.config import AugmentConfig
from hvnet.data.augment import (
    augment,
    mix_sectors,
    random_flip,
    random_rotation,
    random_scaling,
    random_translation,
)
from hvnet.data.ground import ground_points
from hvnet.data.gt_database import Database, read_database
from hvnet.data.insert import ObjectSampler, sample_frame, sample_objects, sampler_of
from hvnet.data.kitti import read_frame

CLASSES = ("Car", "Pedestrian", "Cyclist")
COUNTS = {"Car": 15, "Pedestrian": 8, "Cyclist": 8}
NO_GROUND = torch.zeros(0, 3)


def seeded(seed: int = 0) -> Generator:
    return Generator().manual_seed(seed)


def scene(seed: int = 0) -> tuple[Tensor, Tensor]:
    """2000 points (N, 4) and 12 boxes (M, 7), with points inside every box."""
    generator = seeded(seed)
    boxes = torch.rand(12, 7, generator=generator)
    boxes = (boxes - 0.5) * torch.tensor([60.0, 60, 2, 0, 0, 0, 2 * math.pi]) + torch.tensor([30.0, 0, 0, 4, 2, 2, 0])
    points = torch.rand(2000, 4, generator=generator)
    points[:, :3] = (points[:, :3] - 0.5) * 3
    points[:, :3] += boxes[torch.arange(2000) % 12, :3]
    return points, boxes


def make_objects(objects: list[tuple[str, list[float]]], points_each: int = 10, **columns: list) -> ObjectSampler:
    """A database of objects (class, box) with `points_each` points along their middles."""
    count = len(objects)
    box = np.array([box for _, box in objects], dtype=np.float32).reshape(-1, 7)
    xyz_mm = np.zeros((3, count * points_each), dtype=np.int16)
    xyz_mm[0] = np.tile(np.arange(points_each), count)
    arrays = {"truncation": [0.0] * count, "occlusion": [0] * count, "bbox_height": [40.0] * count}
    arrays |= {"frame": [0] * count} | columns
    database = Database(
        xyz_mm=xyz_mm,
        reflectance=np.full(count * points_each, 50, dtype=np.uint8),
        offsets=np.arange(count + 1) * points_each,
        centre_mm=(box[:, :3] * 1000).round().astype(np.int32),
        box=box,
        name=np.array([name for name, _ in objects], dtype=np.str_),
        frame=np.array(arrays["frame"], dtype=np.int32),
        label_row=np.arange(count, dtype=np.int16),
        truncation=np.array(arrays["truncation"], dtype=np.float32),
        occlusion=np.array(arrays["occlusion"], dtype=np.int8),
        bbox_height=np.array(arrays["bbox_height"], dtype=np.float32),
    )
    return sampler_of(database, torch.device("cpu"))


def points_of(objects: ObjectSampler, k: int) -> Tensor:
    return objects.points[objects.database.offsets[k] : objects.database.offsets[k + 1]]


def car(x: float, y: float, yaw: float = 0.0) -> list[float]:
    return [x, y, -1.0, 4.0, 2.0, 1.5, yaw]


def no_boxes() -> tuple[Tensor, Tensor]:
    return torch.zeros(0, 7), torch.zeros(0, dtype=torch.int64)


def test_flip() -> None:
    points = torch.tensor([[1.0, 2, 3, 0.5]])
    boxes = torch.tensor([[1.0, 2, 3, 4, 5, 6, 0.5], [1, -2, 3, 4, 5, 6, -math.pi]])
    flipped_points, flipped_boxes = random_flip(points, boxes, 1.0, seeded())
    assert flipped_points.tolist() == [[1, -2, 3, 0.5]]
    torch.testing.assert_close(flipped_boxes, torch.tensor([[1.0, -2, 3, 4, 5, 6, -0.5], [1, 2, 3, 4, 5, 6, -math.pi]]))
    assert points.tolist() == [[1, 2, 3, 0.5]]  # not in place
    same_points, same_boxes = random_flip(points, boxes, 0.0, seeded())
    assert torch.equal(same_points, points)
    assert torch.equal(same_boxes, boxes)


def test_flip_happens_with_its_probability() -> None:
    points, boxes = scene()
    generator = seeded()
    flips = [not torch.equal(random_flip(points, boxes, 0.25, generator)[0], points) for _ in range(400)]
    assert 0.18 < np.mean(flips) < 0.32


def test_rotation_turns_to_the_left_within_its_limit() -> None:
    points = torch.tensor([[1.0, 0, 3, 0.5]])
    boxes = torch.tensor([[1.0, 0, 3, 4, 5, 6, 0.0]])
    generator = seeded()
    angles = []
    for _ in range(300):
        turned, turned_boxes = random_rotation(points, boxes, math.pi / 2, generator)
        angle = math.atan2(turned[0, 1], turned[0, 0])
        angles.append(angle)
        expected = torch.tensor([[math.cos(angle), math.sin(angle), 3, 4, 5, 6, angle]])
        torch.testing.assert_close(turned_boxes, expected)
        assert turned[0, 2:].tolist() == [3, 0.5]
    assert max(map(abs, angles)) <= math.pi / 2
    assert min(angles) < -1.4
    assert max(angles) > 1.4


def test_rotation_keeps_the_yaw_in_its_interval() -> None:
    _, boxes = random_rotation(*scene(), math.pi / 2, seeded(3))
    assert (boxes[:, 6] >= -math.pi).all()
    assert (boxes[:, 6] < math.pi).all()


def test_scaling() -> None:
    points, boxes = torch.tensor([[1.0, 2, 3, 0.5]]), torch.tensor([[1.0, 2, 3, 4, 5, 6, 0.5]])
    scaled, scaled_boxes = random_scaling(points, boxes, (2.0, 2.0), seeded())
    assert scaled.tolist() == [[2, 4, 6, 0.5]]
    assert scaled_boxes.tolist() == [[2, 4, 6, 8, 10, 12, 0.5]]
    generator = seeded()
    factors = [random_scaling(points, boxes, (0.95, 1.05), generator)[0][0, 0].item() for _ in range(300)]
    assert 0.95 <= min(factors) < 0.955
    assert 1.045 < max(factors) <= 1.05


def test_translation() -> None:
    points, boxes = torch.zeros(1, 4), torch.zeros(1, 7)
    generator = seeded()
    shifts = []
    for _ in range(1000):
        moved, moved_boxes = random_translation(points, boxes, (0.2, 0.4, 0.0), generator)
        assert torch.equal(moved[0, :3], moved_boxes[0, :3])
        assert moved[0, 3] == 0
        assert not moved_boxes[0, 3:].any()
        shifts.append(moved[0, :3])
    torch.testing.assert_close(torch.stack(shifts).std(0), torch.tensor([0.2, 0.4, 0.0]), atol=0.02, rtol=0)
    torch.testing.assert_close(torch.stack(shifts).mean(0), torch.zeros(3), atol=0.04, rtol=0)


@pytest.mark.parametrize("seed", range(5))
def test_points_stay_in_their_boxes(seed: int) -> None:
    points, boxes = scene(seed)
    before = points_in_boxes(points, boxes)
    assert before.sum() > 300
    options = AugmentConfig(flip=1.0)
    labels = torch.zeros(len(boxes), dtype=torch.int64)
    moved, moved_boxes, moved_labels = augment(points, boxes, labels, NO_GROUND, None, options, seeded(seed), CLASSES)
    assert not torch.allclose(moved[:, :3], points[:, :3], atol=0.1)
    assert torch.equal(moved[:, 3], points[:, 3])
    assert torch.equal(moved_labels, labels)
    # what lies on a face may pass it by rounding
    margin = torch.tensor([0, 0, 0, 1e-3, 1e-3, 1e-3, 0])
    assert not (points_in_boxes(moved, moved_boxes - margin) & ~before).any()
    assert not (before & ~points_in_boxes(moved, moved_boxes + margin)).any()


def test_augment_repeats_with_its_seed() -> None:
    points, boxes = scene()
    labels = torch.zeros(len(boxes), dtype=torch.int64)
    database = make_objects([("Car", car(x, 60.0)) for x in range(0, 60, 6)])
    options = AugmentConfig(objects={"Car": 15})
    first, again, other = (
        augment(points, boxes, labels, NO_GROUND, database, options, seeded(seed), CLASSES) for seed in (7, 7, 8)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])


def test_augment_of_nothing() -> None:
    points, boxes, labels = augment(torch.zeros(0, 4), *no_boxes(), NO_GROUND, None, AugmentConfig(), seeded(), CLASSES)
    assert points.shape == (0, 4)
    assert boxes.shape == (0, 7)
    assert labels.shape == (0,)


def test_sampling_tops_up_to_the_count() -> None:
    database = make_objects([("Car", car(10.0 * k, 50)) for k in range(10)])
    boxes = torch.tensor([car(0, 0), car(10, 0), car(20, 0)])
    labels = torch.tensor([0, 0, -1])  # the third is no Car
    points, boxes, labels = sample_objects(torch.zeros(0, 4), boxes, labels, database, {"Car": 5}, seeded(), CLASSES)
    assert labels.tolist() == [0, 0, -1, 0, 0, 0]
    assert len(boxes) == 6
    assert len(boxes.unique(dim=0)) == 6  # drawn without replacement
    assert len(points) == 30
    full = sample_objects(points, boxes, labels, database, {"Car": 4}, seeded(), CLASSES)
    assert torch.equal(full[1], boxes)


def test_sampling_takes_what_there_is() -> None:
    database = make_objects([("Car", car(10, 0))])
    _, boxes, labels = sample_objects(torch.zeros(0, 4), *no_boxes(), database, COUNTS, seeded(), CLASSES)
    assert boxes.tolist() == [car(10, 0)]
    assert labels.tolist() == [0]


def test_inserted_object_keeps_its_pose_and_points() -> None:
    database = make_objects([("Pedestrian", [10, 5, -0.5, 0.8, 0.6, 1.8, 0.7])])
    cloud = torch.tensor([[10.0, 5, -0.5, 0.1], [30, 5, -0.5, 0.1], [10, 5, 3, 0.1]])
    points, boxes, labels = sample_objects(cloud, *no_boxes(), database, COUNTS, seeded(), CLASSES)
    # the point of the frame inside the box gives way to the object's
    assert torch.equal(points, torch.cat((cloud[1:], points_of(database, 0))))
    assert torch.equal(boxes, torch.from_numpy(database.database.box))
    assert labels.tolist() == [1]


def test_sampled_object_that_collides_is_given_up() -> None:
    database = make_objects([("Car", car(10, 0)), ("Car", car(30, 0))])
    van = torch.tensor([car(12, 1, 0.5)])
    cloud = torch.tensor([[10.0, 0, -1, 0.1]])
    points, boxes, labels = sample_objects(cloud, van, torch.tensor([-1]), database, COUNTS, seeded(), CLASSES)
    assert boxes.tolist() == [van[0].tolist(), car(30, 0)]
    assert labels.tolist() == [-1, 0]
    assert torch.equal(points, torch.cat((cloud, points_of(database, 1))))


def test_of_two_sampled_objects_that_collide_one_is_inserted() -> None:
    database = make_objects([("Car", car(10, 0)), ("Cyclist", car(11, 0)), ("Car", car(10, 1))])
    for seed in range(10):
        _, boxes, labels = sample_objects(torch.zeros(0, 4), *no_boxes(), database, COUNTS, seeded(seed), CLASSES)
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
    _, boxes, _ = sample_objects(torch.zeros(0, 4), *no_boxes(), database, COUNTS, seeded(), CLASSES)
    assert boxes.tolist() == [car(30, 0)]
    database = make_objects(objects, **columns | {"bbox_height": [0] * 4})  # without a camera
    _, boxes, _ = sample_objects(torch.zeros(0, 4), *no_boxes(), database, COUNTS, seeded(), CLASSES)
    assert boxes[:, 0].sort().values.tolist() == [20, 30]
    for points_each, inserted in ((4, 0), (5, 4)):
        database = make_objects(objects, points_each)
        _, boxes, _ = sample_objects(torch.zeros(0, 4), *no_boxes(), database, COUNTS, seeded(), CLASSES)
        assert len(boxes) == inserted


def test_no_objects_asked_for() -> None:
    points, boxes = scene()
    labels = torch.zeros(len(boxes), dtype=torch.int64)
    database = make_objects([("Car", car(100, 0))])
    sampled = sample_objects(points, boxes, labels, database, {}, seeded(), CLASSES)
    assert all(a is b for a, b in zip(sampled, (points, boxes, labels), strict=True))


def test_a_whole_frame_keeps_together() -> None:
    objects = [("Car", car(10.0 * k, 0)) for k in range(4)] + [("Van", car(50, 0)), ("Pedestrian", car(60, 0))]
    database = make_objects(objects, frame=[3, 7, 7, 3, 7, 7])
    found = set()
    for seed in range(10):
        points, boxes, labels = sample_frame(torch.zeros(0, 4), *no_boxes(), database, seeded(seed), CLASSES)
        assert len(points) == 10 * len(boxes)
        found.add((tuple(boxes[:, 0].tolist()), tuple(labels.tolist())))
    assert found == {((0.0, 30.0), (0, 0)), ((10.0, 20.0, 50.0, 60.0), (0, 0, -1, 1))}


def test_mixed_sectors_meet_at_a_border() -> None:
    """Two rings of points: each side is of one frame, no point is there twice, and every box has all its points."""
    angle = torch.linspace(-1.5, 1.5, 600)
    ring = torch.stack((20 * angle.cos(), 20 * angle.sin(), torch.zeros(600), torch.zeros(600)), dim=1)
    other_ring = ring + torch.tensor([0, 0, 0, 1.0])
    around = [[20 * math.cos(a), 20 * math.sin(a), 0.0, 4.0, 2.0, 2.0, a + math.pi / 2] for a in (-0.6, 0.0, 0.6)]
    boxes, labels = torch.tensor(around), torch.tensor([0, 1, -1])
    outcomes = set()
    for seed in range(20):
        others = (other_ring, boxes.clone(), labels + 20, other_ring[:, :3] + 1)
        points, kept, of_kept, ground = mix_sectors(ring, boxes, labels, ring[:, :3], others, seeded(seed))
        own = of_kept < 10
        assert len(kept) == 3  # the two frames have boxes at the same three places
        outcomes.add(tuple(sorted(of_kept.tolist())))
        for box, is_own in zip(kept, own, strict=True):
            inside = points[points_in_boxes(points, box[None])[:, 0]]
            assert (inside[:, 3] == (0.0 if is_own else 1.0)).all()
            assert len(inside) == int(points_in_boxes(ring, box[None]).sum())
        order = torch.atan2(points[:, 1], points[:, 0]).argsort()
        assert (points[order, 3].diff() != 0).sum() <= 3
        assert len(points[:, :3].unique(dim=0)) == len(points)
        assert len(ground) == 600  # of either frame on its side
        assert (ground[ground[:, :2].norm(dim=1).argsort()][:, 2] >= 0).all()
    assert len(outcomes) > 2


def test_mixing_with_an_empty_frame_leaves_a_side() -> None:
    points, boxes = scene()
    labels = torch.zeros(len(boxes), dtype=torch.int64)
    nothing = (torch.zeros(0, 4), *no_boxes(), torch.zeros(0, 3))
    left, left_boxes, _, _ = mix_sectors(points, boxes, labels, torch.zeros(0, 3), nothing, seeded(1))
    assert 0 < len(left) < len(points)
    assert 0 < len(left_boxes) < len(boxes)
    inside = points_in_boxes(points, left_boxes).any(1)
    assert points_in_boxes(left, left_boxes).any(1).sum() == inside.sum()


def test_many_threads_keep_rows_of_nan(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same points to the bit, in the same order, but for those in the rows of the points that are gone."""
    names = [*("Car", "Pedestrian", "Cyclist") * 6]
    objects = make_objects([(name, car(9.0 * (k % 6), 12.0 * (k // 6 - 1))) for k, name in enumerate(names)])
    options = AugmentConfig(objects=COUNTS, whole_frames=0.5)

    def augmented(seed: int) -> tuple[Tensor, Tensor, Tensor]:
        generator, labels = seeded(seed), torch.arange(12) % 3
        ground = [ground_points(scene(each)[0]) for each in (seed, seed + 50)]
        others = (*scene(seed + 50), labels, ground[1])
        mixed = mix_sectors(*scene(seed), labels, ground[0], others, generator)
        return augment(*mixed, objects, options, generator, CLASSES)

    one = [augmented(seed) for seed in range(8)]
    monkeypatch.setattr("hvnet.kernels.launch.force_many_threads", True)
    for seed, (points, boxes, labels) in enumerate(one):
        found = augmented(seed)
        finite = found[0].isfinite()
        assert torch.equal(finite.any(dim=1), finite.all(dim=1))
        assert 500 < len(points) < len(finite)
        assert torch.equal(found[0][finite.all(dim=1)], points)
        assert torch.equal(found[1], boxes)
        assert torch.equal(found[2], labels)


def test_real_frame_with_the_real_database(kitti_root: Path) -> None:
    database = sampler_of(read_database(kitti_root / "gt_database.npz"), torch.device("cpu"))
    frame = read_frame(kitti_root, "000008")
    assert frame.objects is not None
    own_boxes, names = frame.objects.boxes, frame.objects.names
    labels = torch.tensor([CLASSES.index(name) if name in CLASSES else -1 for name in names])
    points, boxes, classes = sample_objects(frame.points, own_boxes, labels, database, COUNTS, seeded(), CLASSES)
    inserted = boxes[len(own_boxes) :]
    assert 15 < len(inserted) <= 25
    assert torch.equal(boxes[: len(own_boxes)], own_boxes)
    assert all((classes == CLASSES.index(name)).sum() <= count for name, count in COUNTS.items())
    collisions = boxes_collide(boxes, boxes)
    # the frame's own boxes may touch; an inserted one meets none but itself
    assert collisions[len(own_boxes) :].sum() == len(inserted)
    own = points_in_boxes(frame.points, own_boxes).sum(0)
    assert torch.equal(points_in_boxes(points, own_boxes).sum(0), own)
    # all that is in an inserted box came with it
    begun = len(frame.points) - points_in_boxes(frame.points, inserted).any(1).sum()
    assert not points_in_boxes(points[:begun], inserted).any()
    assert points_in_boxes(points, inserted).any(0).all()
    assert len(points) - begun == sum(
        len(points_of(database, int(np.flatnonzero((database.database.box == box.numpy()).all(1))[0])))
        for box in inserted
    )
    assert torch.isfinite(bev_corners(boxes)).all()
