"""Calibration: where boxes are right half of the time, and a detector whose scores are moved there."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import hvnet
from hvnet.data.frame import Frame, Objects
from hvnet.data.kitti import KittiFrames, read_split
from hvnet.evaluation.rules import config_rules
from hvnet.network.detector import Detector
from hvnet.training.calibration import boundary, calibrate, judged_scores

CAR, PEDESTRIAN, CYCLIST = range(3)


@pytest.mark.parametrize("score", [0.3, 0.5, 0.62, 0.9])
def test_the_boundary_of_scores_whose_meaning_is_known(score: float) -> None:
    generator = torch.Generator().manual_seed(0)
    wanted = torch.tensor(score).logit()
    logits = 6 * torch.rand(20_000, generator=generator) - 3
    right = torch.rand(20_000, generator=generator) < (3 * (logits - wanted)).sigmoid()
    assert boundary(logits.sigmoid(), right) == pytest.approx(float(wanted), abs=0.05)


@pytest.mark.parametrize(
    ("scores", "right", "low", "high"),
    [
        ([], [], 0.5, 0.5),
        ([0.2, 0.9], [True, True], 0.5, 0.5),
        ([0.2, 0.9], [False, False], 0.5, 0.5),
        ([0.2, 0.6, 0.7, 0.9], [False, False, True, True], 0.6, 0.7),  # nothing in between
        ([0.2, 0.3, 0.7, 0.9], [True, True, False, False], 0.5, 0.5),  # upside down
        ([0.31 + 0.005 * k for k in range(100)] + [0.32], [False] * 100 + [True], 0.5, 0.5),
        ([0.31 + 0.005 * k for k in range(100)] + [0.85], [False] * 100 + [True], 0.8, 0.85),
        ([0.5, 0.5], [True, False], 0.5, 0.5),
        ([0.7, 0.7], [True, False], 0.5, 0.5),
        ([0.3, 0.7, 0.3, 0.7], [True, True, False, False], 0.5, 0.5),
        ([0.6] * 50, [True, False] * 25, 0.5, 0.5),
        ([0.6] * 9 + [0.7], [False] * 9 + [True], 0.6, 0.7),
        ([0.5, 0.5, 0.5, 0.5], [True, False, False, False], 0.5, 0.5),
        ([0.0, 0.4, 0.8, 1.0], [False, False, True, True], 0.4, 0.8),
    ],
)
def test_the_boundary_of_a_few(scores: list[float], right: list[bool], low: float, high: float) -> None:
    score = torch.tensor(boundary(torch.tensor(scores), torch.tensor(right, dtype=torch.bool))).sigmoid().item()
    assert low - 1e-6 <= score <= high + 1e-6


def shifted(shifts: Sequence[float]) -> Detector:
    """The default detector with other logits."""
    detector = hvnet.load(device="cpu", dtype=torch.float32)
    for label, shift in enumerate(shifts):
        detector.score_maps.score_bias(label).add_(shift)
    return detector


def biases(detector: Detector) -> list[float]:
    """Of every class, the mean over its anchors."""
    return [detector.score_maps.score_bias(label).mean().item() for label in range(len(detector.classes))]


def test_scores_that_are_off_are_put_right(kitti_root: Path) -> None:
    val = KittiFrames(kitti_root, read_split(kitti_root, "val"))
    with_people = [
        name for k, name in enumerate(val.names) if {"Pedestrian", "Cyclist"} & set(val.object_names(k) or [])
    ]
    frames = KittiFrames(kitti_root, with_people)
    found, before = [], []
    for shifts in ([0.8, 0.8, 0.8], [-0.4, -0.4, -0.4]):
        detector = shifted(shifts)
        before.append(biases(detector))
        moved = calibrate(detector, frames)
        assert biases(detector) == pytest.approx([a + b for a, b in zip(before[-1], moved, strict=True)], abs=1e-5)
        for scores, right in judged_scores(detector, frames, loose_rules(detector)):
            assert boundary(scores, right) == pytest.approx(0, abs=0.05)
        found.append(biases(detector))
    assert before[0] != pytest.approx(before[1], abs=1)
    assert found[0] == pytest.approx(found[1], abs=0.3)  # candidates near the threshold are others


def loose_rules(detector: Detector) -> dict:
    return {name: rule._replace(strict=rule.loose) for name, rule in config_rules(detector.config).items()}


class WithoutPeople(KittiFrames):
    """Frames in which cars alone are labelled."""

    def __getitem__(self, k: int) -> Frame:
        frame = super().__getitem__(k)
        assert frame.objects is not None
        assert frame.objects.labels is not None
        rows = frame.objects.labels.select(frame.objects.labels.name == "Car")
        return replace(frame, objects=Objects(frame.boxes_of(["Car"]), ["Car"] * len(rows.name), rows))


def test_a_class_without_right_boxes_is_left(kitti_root: Path) -> None:
    detector = shifted([1.0, 1.0, 1.0])
    before = biases(detector)
    shifts = calibrate(detector, WithoutPeople(kitti_root, read_split(kitti_root, "val")[:6]))
    assert shifts[CAR] < -0.3
    assert shifts[PEDESTRIAN] == shifts[CYCLIST] == 0
    assert biases(detector)[PEDESTRIAN:] == before[PEDESTRIAN:]


def test_frames_without_labels_are_refused(kitti_root: Path) -> None:
    frames = KittiFrames(kitti_root, read_split(kitti_root, "val")[:1])
    frame = replace(frames[0], objects=None)

    class Unlabelled(KittiFrames):
        def __getitem__(self, k: int) -> Frame:
            return frame

    with pytest.raises(ValueError, match=f"frame {frame.name}: has no labels"):
        calibrate(shifted([0, 0, 0]), Unlabelled(kitti_root, frames.names))


def test_a_detector_in_half_precision_is_refused(kitti_root: Path) -> None:
    frames = KittiFrames(kitti_root, read_split(kitti_root, "val")[:1])
    with pytest.raises(ValueError, match=r"want a detector in float32, got torch\.bfloat16"):
        calibrate(hvnet.load(device="cpu", dtype=torch.bfloat16), frames)
