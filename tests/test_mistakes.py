"""Mistakes: tables of labelled boxes and detections, and what KITTI does not score."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.data.kitti import AT_LIDAR, Calibration, Frame, Labels, boxes_to_camera, project_boxes, read_frame
from hvnet.mistakes import FALSE_POSITIVE, MISS, Mistake, find_mistakes, worst
from hvnet.model import Detections

CLASSES = ("Car", "Pedestrian", "Cyclist")
SIZE = (1000, 400)
CALIB = Calibration(
    p2=np.array([[500.0, 0, 500, 0], [0, 500, 200, 0], [0, 0, 1, 0]]),
    r0_rect=AT_LIDAR.r0_rect,
    velo_to_cam=AT_LIDAR.velo_to_cam,
)
LENGTH = 4.0


def car(x: float, y: float = 0.0) -> list[float]:
    return [x, y, 0.0, LENGTH, 2.0, 1.5, 0.0]


def shifted(x: float, iou: float) -> list[float]:
    """A car whose BEV IoU with car(x) is as given: l - d shared of l + d."""
    return car(x + LENGTH * (1 - iou) / (1 + iou))


def make_frame(
    objects: list[tuple[str, list[float]]], points: list[list[float]], dontcare: list[list[float]] | None = None
) -> Frame:
    boxes = torch.tensor([box for _, box in objects]).view(-1, 7)
    regions = np.array(dontcare or []).reshape(-1, 4)
    dimensions, location, rotation_y = boxes_to_camera(boxes.numpy(), CALIB)
    bbox, _ = project_boxes(boxes.numpy(), CALIB, SIZE)
    count, extra = len(objects), len(regions)
    labels = Labels(
        name=np.array([name for name, _ in objects] + ["DontCare"] * extra, dtype=np.str_),
        truncation=np.zeros(count + extra),
        occlusion=np.zeros(count + extra, np.int64),
        alpha=np.zeros(count + extra),
        bbox=np.concatenate((bbox, regions)),
        dimensions=np.concatenate((dimensions, np.full((extra, 3), -1.0))),
        location=np.concatenate((location, np.full((extra, 3), -1000.0))),
        rotation_y=np.concatenate((rotation_y, np.full(extra, -10.0))),
    )
    names = tuple(name for name, _ in objects)
    cloud = torch.tensor(points).view(-1, 3)
    return Frame("000007", torch.nn.functional.pad(cloud, (0, 1)), boxes, names, labels, CALIB, SIZE, 0)


def detections(*rows: tuple[str, list[float], float]) -> Detections:
    return Detections(
        torch.tensor([box for _, box, _ in rows]).view(-1, 7),
        torch.tensor([score for _, _, score in rows]),
        torch.tensor([CLASSES.index(name) for name, _, _ in rows], dtype=torch.int64),
    )


def summary(mistakes: list[Mistake]) -> list[tuple[str, str, float, float, float, int]]:
    return [
        (each.kind, each.name, each.box[0].item(), round(each.score, 3), round(each.overlap, 3), each.points)
        for each in mistakes
    ]


# what is labelled, what is detected, the mistakes: kind, class, x, score, overlap, points
TABLE = {
    "found": ([("Car", car(10))], [("Car", shifted(10, 0.75), 0.9)], []),
    "nothing detected": ([("Car", car(10))], [], [(MISS, "Car", 10, 0, 0, 2)]),
    "too far off": (
        [("Car", car(10))],
        [("Car", car(11), 0.9)],
        [(MISS, "Car", 10, 0.9, 0.6, 2), (FALSE_POSITIVE, "Car", 11, 0.9, 0.6, 2)],
    ),
    "near enough for a cyclist": ([("Cyclist", car(10))], [("Cyclist", shifted(10, 0.6), 0.9)], []),
    "score too low": ([("Car", car(10))], [("Car", shifted(10, 1), 0.4)], [(MISS, "Car", 10, 0.4, 1, 2)]),
    "of another class": (
        [("Car", car(10))],
        [("Cyclist", car(10), 0.9)],
        [(MISS, "Car", 10, 0, 0, 2), (FALSE_POSITIVE, "Cyclist", 10, 0.9, 0, 2)],
    ),
    "nothing labelled": ([], [("Car", car(30), 0.9)], [(FALSE_POSITIVE, "Car", 30, 0.9, 0, 1)]),
    "on a van": ([("Van", car(10))], [("Car", car(10), 0.9)], []),
    "beside a van": ([("Van", car(10))], [("Car", car(12), 0.9)], [(FALSE_POSITIVE, "Car", 12, 0.9, 0, 2)]),
    "someone who sits": ([("Person_sitting", car(10))], [("Pedestrian", car(10), 0.9)], []),
    "a cyclist who sits": (
        [("Person_sitting", car(10))],
        [("Cyclist", car(10), 0.9)],
        [(FALSE_POSITIVE, "Cyclist", 10, 0.9, 0, 2)],
    ),
    "a class that is not detected": ([("Tram", car(10))], [], []),
    "behind the camera": ([], [("Car", car(-10), 0.9)], []),
    "twice": ([("Car", car(10))], [("Car", car(10), 0.9), ("Car", shifted(10, 0.8), 0.6)], []),
}
POINTS = [[10.0, 0.5, 0.0], [10.5, -0.5, 0.0], [30.0, 0.0, 0.0], [10.0, 1.5, 0.0]]


@pytest.mark.parametrize("case", TABLE)
def test_table(case: str) -> None:
    objects, found, expected = TABLE[case]
    mistakes = find_mistakes(make_frame(objects, POINTS), detections(*found), CLASSES, 0.5)
    assert summary(mistakes) == expected
    for each in mistakes:
        assert each.frame == "000007"
        assert each.distance == pytest.approx(each.box[:2].norm().item())


@pytest.mark.parametrize(("share", "count"), [(0.0, 1), (0.45, 1), (0.55, 0), (1.0, 0)])
def test_dontcare_covers_more_than_half(share: float, count: int) -> None:
    box = car(20)
    left, top, right, bottom = project_boxes(np.array([box]), CALIB, SIZE)[0][0]
    region = [left, top, left + share * (right - left), bottom]
    frame = make_frame([], [], [region, [0, 0, 1, 1]])
    assert len(find_mistakes(frame, detections(("Car", box, 0.9)), CLASSES, 0.5)) == count


def test_worst_come_first() -> None:
    objects = [("Car", car(30)), ("Car", car(10)), ("Car", car(50))]
    found = detections(("Car", car(70), 0.6), ("Car", car(80), 0.8), ("Pedestrian", car(90), 0.7))
    mistakes = find_mistakes(make_frame(objects, POINTS), found, CLASSES, 0.5)
    misses, wrong = worst(mistakes, 2)
    assert [each.points for each in misses] == [2, 1]
    assert [round(each.score, 1) for each in wrong] == [0.8, 0.7]
    assert [len(each) for each in worst(mistakes, 20)] == [3, 3]


def test_a_class_that_kitti_does_not_score_has_none() -> None:
    frame = make_frame([("Van", car(10)), ("Car", car(30))], POINTS)
    mistakes = find_mistakes(frame, detections(("Car", car(20), 0.9)), ("Van", *CLASSES[1:], "Car"), 0.5)
    assert summary(mistakes) == [(MISS, "Car", 30, 0, 0, 1)]


def test_labels_as_detections_are_no_mistakes(kitti_root: Path) -> None:
    """In real frames: none if all labels are detected, and as many as there are labels if nothing is."""
    for name in (kitti_root / "ImageSets" / "val.txt").read_text().split():
        frame = read_frame(kitti_root, name)
        known = [each in CLASSES for each in frame.names]
        labels = torch.tensor([CLASSES.index(each) for each in frame.names if each in CLASSES]).long()
        perfect = Detections(frame.boxes[known], torch.ones(len(labels)), labels)
        assert find_mistakes(frame, perfect, CLASSES, 0.5) == []
        nothing = find_mistakes(frame, detections(), CLASSES, 0.5)
        assert [each.kind for each in nothing] == [MISS] * len(labels)
