"""A detector on frames: its scores are those of the evaluation of its boxes, and what is said of the frames."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.config import Config
from hvnet.data.frame import Camera, Frame, Objects
from hvnet.data.kitti import KittiFrames, boxes_to_labels, detections_to_labels, frame_labels
from hvnet.evaluation.precision import evaluate
from hvnet.evaluation.rules import config_rules, rule_for
from hvnet.evaluation.scoring import Detected, background_note, detect_frames, labels_in_range, print_once, score
from hvnet.network.detector import Detector
from hvnet.network.model import Detections
from tests.helpers import CAMERA

AHEAD, ASIDE, BEHIND = (
    [10.0, 1, -0.9, 4, 1.7, 1.5, 0.1],
    [9.0, 8, -0.9, 4, 1.7, 1.5, 0],
    [-9.0, 1, -0.9, 4, 1.7, 1.5, 0],
)


class Finder(Detector):
    """Finds in a cloud what its points say: each is the centre of a car, its reflectance the score."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.classes = tuple(entry.name for entry in config.head.classes)

    def __call__(self, points: torch.Tensor | np.ndarray) -> Detections:
        points = torch.as_tensor(points)
        boxes = torch.cat((points[:, :3], torch.tensor(AHEAD[3:]).expand(len(points), 4)), dim=1)
        return Detections(boxes, points[:, 3], torch.zeros(len(points), dtype=torch.int64))


class Few:
    """Frames of another format: boxes, what is found of them as points, a camera or none, and notes."""

    def __init__(self, camera: Camera | None = None, names: Sequence[str] = ("Car", "Car", "cone")) -> None:
        self.camera, self.of = camera, names
        self.names = ["a", "b"]

    def __len__(self) -> int:
        return 2

    def __getitem__(self, k: int) -> Frame:
        points = torch.tensor([[*AHEAD[:3], 0.9], [*BEHIND[:3], 0.8], [20, 0, -1, 0.7]])[k:]
        objects = Objects(torch.tensor([AHEAD, BEHIND, ASIDE]), self.of)
        return Frame(self.names[k], points, objects, self.camera, ["as ever", f"of {self.names[k]}"])


@pytest.fixture
def finder(demo: Config) -> Finder:
    return Finder(demo)


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_it_equals_the_evaluation_by_hand(finder: Finder, camera: Camera | None) -> None:
    frames = Few(camera)
    truths = [frame_labels(frames[k]) for k in range(2)]
    found = []
    for k in range(2):
        boxes, scores, labels = finder(frames[k].points)
        found.append(detections_to_labels(boxes, scores, ["Car"] * len(labels), camera))
    by_hand = evaluate(truths, found, classes=finder.classes, rules=config_rules(finder.config))
    result = score(finder, frames)
    assert list(result) == ["Car", "Pedestrian", "Cyclist"]
    for name in result:
        for key in ("R40", "R11", "exact", "loose", "counts", "report", "overlaps", "warnings"):
            assert result[name][key] == by_hand[name][key], (name, key)
    # with a camera the car behind and what is found there count for nothing
    assert result["Car"]["counts"]["ground_truths"] == ([2] * 3 if camera else [4] * 3)
    assert result["Car"]["counts"]["detections"] == (3 if camera else 5)


def test_generated_frames(finder: Finder, scenes: Path) -> None:
    """Of a KITTI root: the labels are those of its files, DontCare regions too."""
    frames = KittiFrames(scenes, ["000004", "000005"])
    seen = [detected.rows for detected in detect_frames(finder, frames)]
    by_hand = evaluate([frame_labels(frames[k]) for k in range(2)], seen)
    assert score(finder, frames)["Car"]["counts"] == by_hand["Car"]["counts"]


def test_rules_that_are_given(finder: Finder) -> None:
    rules = config_rules(finder.config) | {"Car": rule_for("Car", 4.0, 0.2)}
    assert score(finder, Few(), rules=rules)["Car"]["overlaps"]["strict"]["3d"] == 0.2


def test_labels_in_range(finder: Finder) -> None:
    """By their centres, whatever the axes of the labels; DontCare regions have no place and stay."""
    low, high = finder.config.encoder.point_range[:2], finder.config.encoder.point_range[3:5]
    assert low[0] <= AHEAD[0] < high[0]
    for camera in (None, CAMERA):
        frame = Few(camera)[0]
        assert labels_in_range(frame, finder.config).location[:, 2].tolist() == [10]
    assert score(finder, Few(), in_range=True)["Car"]["counts"]["ground_truths"] == [2] * 3
    edges = np.array([[low[0], 0, 0, 1, 1, 1, 0], [high[0], 0, 0, 1, 1, 1, 0], [5, low[1] + 0.1, 0, 1, 1, 1, 0]])
    near = labels_in_range(Frame("a", torch.zeros(0, 4), Objects(edges, ["Car", "Van", "cone"])), finder.config)
    assert near.name.tolist() == ["Car", "cone"]
    rows = boxes_to_labels(edges, ["Car", "DontCare", "DontCare"])
    rows = replace(rows, location=rows.location - 2000 * (rows.name == "DontCare")[:, None])
    frame = Frame("a", torch.zeros(0, 4), Objects(edges[:1], ["Car"], rows))
    assert labels_in_range(frame, finder.config).name.tolist() == ["Car", "DontCare", "DontCare"]


def test_notes_are_printed_once(finder: Finder, capsys: pytest.CaptureFixture[str]) -> None:
    seen: set[str] = set()
    score(finder, Few(), seen=seen)
    assert capsys.readouterr().out == (
        "as ever\nof a\nof b\nlabels of classes that the config does not have count as background: 2 cone\n"
    )
    score(finder, Few(), seen=seen)
    assert capsys.readouterr().out == ""
    print_once(["", "of c", "of a", "of c"], seen)
    assert capsys.readouterr().out == "of c\n"


def test_frames_are_visited_in_order(finder: Finder) -> None:
    visited: list[Detected] = []
    score(finder, Few(CAMERA), visit=visited.append)
    assert [(each.k, each.frame.name) for each in visited] == [(0, "a"), (1, "b")]
    assert [len(each.found.boxes) for each in visited] == [3, 2]
    assert [len(each.rows) for each in visited] == [2, 1]
    assert [each.k for each in detect_frames(finder, Few(), [1])] == [1]


def test_frames_that_nobody_labelled_are_not_scored(finder: Finder) -> None:
    """They can be detected in."""

    class Bare(Few):
        def __getitem__(self, k: int) -> Frame:
            return replace(super().__getitem__(k), objects=None)

    assert len(list(detect_frames(finder, Bare()))) == 2
    with pytest.raises(ValueError, match="frame a: has no labels"):
        score(finder, Bare())


def test_background_note() -> None:
    names = ["Car", "cone", "Van", "DontCare", "cone", "Car"]
    said = "labels of classes that the config does not have count as background: "
    assert background_note(names, ["Car", "Cyclist"]) == f"{said}2 cone, 1 Van"
    assert background_note(Counter(names), ["Car", "Cyclist"]) == f"{said}2 cone, 1 Van"
    assert background_note(names, ["Car", "cone", "Van"]) == ""
    assert background_note([], ["Car"]) == ""
