"""The rows of a study: how long they are trained, what they score, and that a signal stops them."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.config import load_config
from hvnet.data.frame import Objects
from hvnet.data.kitti import KittiFrames, boxes_to_labels, read_split_frames, write_labels
from hvnet.exceptions import InputError
from hvnet.network.detector import Detector
from hvnet.network.model import Detections
from hvnet.studies.rows import count_objects, score_in_range, with_budget
from tests.models import CONFIGS


def test_score_counts_objects_in_range(scenes: Path, tmp_path: Path) -> None:
    """A detector that says what is labelled scores 100, also if it knows nothing of what lies beyond its range."""
    config = load_config(CONFIGS / "studies" / "base.yaml", ["encoder.point_range=[0, -12.8, -3, 15, 12.8, 2]"])
    frames = read_split_frames(scenes, "val")
    known_objects = iter([frame.objects or Objects(torch.zeros(0, 7), []) for frame in frames] * 2)
    classes = ["Car", "Pedestrian", "Cyclist"]

    def detector(miss: int) -> Detector:
        def detect(_: torch.Tensor) -> Detections:
            objects = next(known_objects)
            known = [k for k, name in enumerate(objects.names) if name in classes and objects.boxes[k, 0] < 15]
            known = known[miss:]
            labels = torch.tensor([classes.index(objects.names[k]) for k in known])
            return Detections(objects.boxes[known], torch.full((len(known),), 0.9), labels)

        detect.config, detect.classes = config, classes  # type: ignore[attr-defined]
        return detect  # type: ignore[return-value]

    scores = score_in_range(detector(0), frames)
    figures = [value for table in scores.values() for value in table["bev"] if value is not None]
    assert len(figures) > 3
    assert figures == pytest.approx([100.0] * len(figures))
    worse = score_in_range(detector(2), frames)
    assert sum(table["bev"][2] or 0.0 for table in worse.values()) < 290
    cars = count_objects(config, frames, "Car")
    assert 0 < cars < sum(list(frames.object_names(k) or ()).count("Car") for k in range(len(frames))) + 1
    for folder in ("velodyne", "label_2"):
        shutil.copytree(scenes / "training" / folder, tmp_path / "training" / folder)
    boxes = np.array([[x, 0.0, -1.0, 4.0, 1.6, 1.5, 0.0] for x in (5.0, 10.0, 20.0)])
    write_labels(tmp_path / "training" / "label_2" / f"{frames.names[0]}.txt", boxes_to_labels(boxes, ["Car"] * 3))
    assert (
        count_objects(config, KittiFrames(tmp_path, frames.names[:1]), "Car") == 2
    )  # no camera, one of three out of range


@pytest.mark.parametrize(
    ("budget", "epochs"),
    [("epochs=7", 7), ("steps=1", 1), ("steps=50", 1), ("steps=51", 2), ("steps=600", 12)],
)
def test_budget(budget: str, epochs: int) -> None:
    config = load_config(CONFIGS / "demo.yaml")  # batches of 4
    assert with_budget(config, budget, 200).train.epochs == epochs


@pytest.mark.parametrize("budget", ["600", "steps=", "steps=0", "hours=3", "steps=-1"])
def test_bad_budgets(budget: str) -> None:
    with pytest.raises(InputError, match=r"--budget .*want epochs=N or steps=N"):
        with_budget(load_config(CONFIGS / "demo.yaml"), budget, 200)
