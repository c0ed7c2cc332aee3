"""Augmentation: points and boxes move together, samples repeat, and inserted objects follow SECOND's rules."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

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
from hvnet.data.gt_database import read_database
from hvnet.data.insert import TrainingFrame, sample_objects, sampler_of
from hvnet.data.kitti import read_frame
from tests.objects import CLASSES, COUNTS, car, make_objects, points_of, scene, seeded, unlabelled


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
    moved, moved_boxes, moved_labels = augment(
        TrainingFrame(points, boxes, labels), None, options, seeded(seed), CLASSES
    )
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
        augment(TrainingFrame(points, boxes, labels), database, options, seeded(seed), CLASSES) for seed in (7, 7, 8)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])


def test_augment_of_nothing() -> None:
    points, boxes, labels = augment(unlabelled(), None, AugmentConfig(), seeded(), CLASSES)
    assert points.shape == (0, 4)
    assert boxes.shape == (0, 7)
    assert labels.shape == (0,)


def test_mixed_sectors_meet_at_a_border() -> None:
    """Two rings of points: each side is of one frame, no point is there twice, and every box has all its points."""
    angle = torch.linspace(-1.5, 1.5, 600)
    ring = torch.stack((20 * angle.cos(), 20 * angle.sin(), torch.zeros(600), torch.zeros(600)), dim=1)
    other_ring = ring + torch.tensor([0, 0, 0, 1.0])
    around = [[20 * math.cos(a), 20 * math.sin(a), 0.0, 4.0, 2.0, 2.0, a + math.pi / 2] for a in (-0.6, 0.0, 0.6)]
    boxes, labels = torch.tensor(around), torch.tensor([0, 1, -1])
    outcomes = set()
    for seed in range(20):
        other = TrainingFrame(other_ring, boxes.clone(), labels + 20)
        points, kept, of_kept = mix_sectors(TrainingFrame(ring, boxes, labels), other, seeded(seed))[:3]
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
    assert len(outcomes) > 2


def test_mixing_with_an_empty_frame_leaves_a_side() -> None:
    points, boxes = scene()
    labels = torch.zeros(len(boxes), dtype=torch.int64)
    left, left_boxes, _ = mix_sectors(TrainingFrame(points, boxes, labels), unlabelled(), seeded(1))[:3]
    assert 0 < len(left) < len(points)
    assert 0 < len(left_boxes) < len(boxes)
    inside = points_in_boxes(points, left_boxes).any(1)
    assert points_in_boxes(left, left_boxes).any(1).sum() == inside.sum()


def test_many_threads_keep_rows_of_nan(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same points to the bit, in the same order, but for those in the rows of the points that are gone."""
    names = [*("Car", "Pedestrian", "Cyclist") * 6]
    objects = make_objects([(name, car(9.0 * (k % 6), 12.0 * (k // 6 - 1))) for k, name in enumerate(names)])
    options = AugmentConfig(
        objects=COUNTS, whole_frames=0.5, fewer_beams=0.5, no_reflectance=0.3, reflectance=(0.5, 2.0), pitch=0.02
    )

    def augmented(seed: int) -> tuple[Tensor, Tensor, Tensor]:
        generator, labels = seeded(seed), torch.arange(12) % 3
        frame, other = (TrainingFrame(*scene(each), labels) for each in (seed, seed + 50))
        return augment(
            mix_sectors(frame, other, generator), objects, options, generator, CLASSES, None if seed % 2 else -1.6
        )

    one = [augmented(seed) for seed in range(8)]
    monkeypatch.setattr("hvnet.kernels.launch.force_many_threads", True)
    for seed, (points, boxes, labels) in enumerate(one):
        found = augmented(seed)
        finite = found[0].isfinite()
        assert torch.equal(finite.any(dim=1), finite.all(dim=1))
        assert 200 < len(points) < len(finite)
        assert torch.equal(found[0][finite.all(dim=1)], points)
        assert torch.equal(found[1], boxes)
        assert torch.equal(found[2], labels)


def test_real_frame_with_the_real_database(kitti_root: Path) -> None:
    database = sampler_of(read_database(kitti_root / "gt_database.npz"))
    frame = read_frame(kitti_root, "000008")
    assert frame.objects is not None
    own_boxes, names = frame.objects.boxes, frame.objects.names
    labels = torch.tensor([CLASSES.index(name) if name in CLASSES else -1 for name in names])
    street = TrainingFrame(frame.points, own_boxes, labels)
    points, boxes, classes = sample_objects(street, database, COUNTS, seeded(), CLASSES)[:3]
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
