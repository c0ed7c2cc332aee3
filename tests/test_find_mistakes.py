"""Mistakes: tables of labelled boxes and detections, and what KITTI does not score."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.data.frame import Camera, Frame, Objects
from hvnet.data.kitti import boxes_to_camera, read_frame
from hvnet.data.labels import Labels
from hvnet.evaluation.mistakes import FALSE_POSITIVE, MISS, Mistake, find_mistakes, judge, worst
from hvnet.evaluation.rules import KITTI, Rule, rule_for
from hvnet.network.model import Detections
from tests import helpers

CLASSES = tuple(KITTI)
CAMERA = replace(helpers.CAMERA, p2=np.array([[500.0, 0, 500, 0], [0, 500, 200, 0], [0, 0, 1, 0]]), size=(1000, 400))
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
    dimensions, location, rotation_y = boxes_to_camera(boxes.numpy(), CAMERA)
    bbox, _ = CAMERA.project_boxes(boxes.numpy())
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
    return Frame("000007", torch.nn.functional.pad(cloud, (0, 1)), Objects(boxes, names, labels), CAMERA)


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
    mistakes = find_mistakes(make_frame(objects, POINTS), detections(*found), KITTI, 0.5)
    assert summary(mistakes) == expected
    for each in mistakes:
        assert each.frame == "000007"
        assert each.distance == pytest.approx(each.box[:2].norm().item())


@pytest.mark.parametrize(("share", "count"), [(0.0, 1), (0.45, 1), (0.55, 0), (1.0, 0)])
def test_dontcare_covers_more_than_half(share: float, count: int) -> None:
    box = car(20)
    left, top, right, bottom = CAMERA.project_boxes(np.array([box]))[0][0]
    region = [left, top, left + share * (right - left), bottom]
    frame = make_frame([], [], [region, [0, 0, 1, 1]])
    assert len(find_mistakes(frame, detections(("Car", box, 0.9)), KITTI, 0.5)) == count


def test_worst_come_first() -> None:
    objects = [("Car", car(30)), ("Car", car(10)), ("Car", car(50))]
    found = detections(("Car", car(70), 0.6), ("Car", car(80), 0.8), ("Pedestrian", car(90), 0.7))
    mistakes = find_mistakes(make_frame(objects, POINTS), found, KITTI, 0.5)
    misses, wrong = worst(mistakes, 2)
    assert [each.points for each in misses] == [2, 1]
    assert [round(each.score, 1) for each in wrong] == [0.8, 0.7]
    assert [len(each) for each in worst(mistakes, 20)] == [3, 3]


def test_a_neighbour_that_is_scored_itself() -> None:
    """Where vans are scored, one that is not found is a miss, and a car found there is wrong."""
    frame = make_frame([("Van", car(10)), ("Car", car(30))], POINTS)
    rules = {"Car": KITTI["Car"], "Van": rule_for("Van", 5.0)}
    found = Detections(torch.tensor([car(10), car(30)]), torch.tensor([0.9, 0.8]), torch.tensor([0, 0]))
    assert summary(find_mistakes(frame, found, rules, 0.5)) == [
        (MISS, "Van", 10, 0, 0, 2),
        (FALSE_POSITIVE, "Car", 10, 0.9, 0, 2),
    ]
    assert find_mistakes(frame, found, KITTI, 0.5) == []


OWN = {"excavator": rule_for("excavator", 4.0), "bicycle": rule_for("bicycle", 1.8, 0.25)}


def found_as(*rows: tuple[int, list[float]]) -> Detections:
    boxes = torch.tensor([box for _, box in rows]).view(-1, 7)
    return Detections(boxes, torch.full((len(rows),), 0.9), torch.tensor([label for label, _ in rows]).long())


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_any_class_by_its_rule(camera: Camera | None) -> None:
    """Frames of another format: without rows of a label file, with or without a camera."""
    objects = Objects(torch.tensor([car(10), car(30), car(50)]), ["excavator", "bicycle", "cone"])
    frame = Frame("a", torch.zeros(0, 4), objects, camera)
    found = found_as((0, shifted(10, 0.65)), (1, shifted(30, 0.3)))
    assert [(each.kind, each.name) for each in find_mistakes(frame, found, OWN, 0.5)] == [
        (MISS, "excavator"),
        (FALSE_POSITIVE, "excavator"),
    ]
    wide = OWN | {"excavator": Rule(dict.fromkeys(("2d", "bev", "3d"), 0.6), {})}
    assert find_mistakes(frame, found, wide, 0.5) == []


@pytest.mark.parametrize(
    ("label", "box", "right", "wrong"),
    [
        (0, shifted(10, 0.71), True, False),
        (0, shifted(10, 0.69), False, True),
        (1, car(10), False, True),  # of another class
        (0, car(30), False, False),  # a van
        (1, car(30), False, True),
        (0, car(50), False, False),  # in a region that nobody labelled
        (0, car(-30), False, False),  # behind the camera
        (0, car(20, 8), False, True),
    ],
)
def test_right_wrong_or_not_scored(label: int, box: list[float], right: bool, wrong: bool) -> None:
    region, _ = CAMERA.project_boxes(np.array([car(50)]))
    frame = make_frame([("Car", car(10)), ("Van", car(30))], [], region.tolist())
    verdicts = judge(frame, found_as((label, box)), KITTI)
    assert (verdicts.right.tolist(), verdicts.wrong.tolist()) == ([right], [wrong])
    nothing = judge(frame, found_as(), KITTI)
    assert [len(part) for part in nothing] == [0, 0, 0]


def test_what_is_outside_the_image_is_no_mistake() -> None:
    """As in the evaluation, where boxes that the camera does not see have no row; without a camera all are seen."""
    objects = Objects(torch.tensor([car(-10), car(10)]), ["excavator", "excavator"])
    nothing = found_as()
    seen = find_mistakes(Frame("a", torch.zeros(0, 4), objects, CAMERA), nothing, OWN, 0.5)
    assert [each.box[0].item() for each in seen] == [10]
    every = find_mistakes(Frame("a", torch.zeros(0, 4), objects), nothing, OWN, 0.5)
    assert [each.box[0].item() for each in every] == [-10, 10]
    behind = found_as((0, car(-30)))
    empty = Objects(torch.zeros(0, 7), [])
    assert find_mistakes(Frame("a", torch.zeros(0, 4), empty, CAMERA), behind, OWN, 0.5) == []
    assert len(find_mistakes(Frame("a", torch.zeros(0, 4), empty), behind, OWN, 0.5)) == 1


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_a_frame_without_labels_is_refused(camera: Camera | None) -> None:
    """What nobody labelled cannot be found wrong."""
    with pytest.raises(ValueError, match="frame a: has no labels"):
        find_mistakes(Frame("a", torch.zeros(0, 4), None, camera), found_as((0, car(10))), OWN, 0.5)


def test_labels_as_detections_are_no_mistakes(kitti_root: Path) -> None:
    """In real frames: none if all labels are detected, and as many as there are labels if nothing is."""
    for name in (kitti_root / "ImageSets" / "val.txt").read_text().split():
        frame = read_frame(kitti_root, name)
        assert frame.objects is not None
        known = [each for each in frame.objects.names if each in CLASSES]
        labels = torch.tensor([CLASSES.index(each) for each in known]).long()
        perfect = Detections(frame.boxes_of(CLASSES), torch.ones(len(labels)), labels)
        assert find_mistakes(frame, perfect, KITTI, 0.5) == []
        nothing = find_mistakes(frame, detections(), KITTI, 0.5)
        assert [each.kind for each in nothing] == [MISS] * len(labels)
