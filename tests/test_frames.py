"""A data format of one's own, and classes of one's own: a class of a few lines trains, detects, is scored and drawn."""

import json
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hvnet import evaluate
from hvnet.config import Config, load_config
from hvnet.data.frame import Frame, Objects
from hvnet.data.gt_database import build_database
from hvnet.data.kitti import KittiFrames, boxes_to_labels, frame_labels, write_labels
from hvnet.evaluation.scoring import score
from hvnet.exceptions import InputError, Stopped
from hvnet.network.detector import load
from hvnet.pictures.clouds import Subject, draw_bev
from hvnet.pictures.page import make_page
from hvnet.training.batches import Data
from hvnet.training.run import Run
from tests.helpers import ROOT, GivenFrames, contents
from tests.models import TINY

CLASSES = {"Truck": [7.0, 2.5, 3.0], "bicycle": [1.7, 0.6, 1.5]}


class MyFrames:
    """A format of its own: clouds with a truck and a bicycle, and a cone that no config names."""

    def __init__(self, seeds: Sequence[int]) -> None:
        self.names = [f"scan {seed}" for seed in seeds]
        self.seeds = seeds

    def __len__(self) -> int:
        return len(self.seeds)

    def __getitem__(self, k: int) -> Frame:
        rng = np.random.default_rng(self.seeds[k])
        boxes = np.array([[9, 2, -0.3, 7, 2.5, 3, 0.1], [14, -2, -1, 1.7, 0.6, 1.5, 1.5], [6, -3, -1, 0.4, 0.4, 1, 0]])
        boxes[:, :2] += rng.normal(0, 0.5, (3, 2))
        parts = [box[:3] + (rng.random((60, 3)) - 0.5) * box[3:6] for box in boxes]
        ground = rng.uniform((2, -6, -1.8), (24, 6, -1.7), (300, 3))
        xyz = np.concatenate([*parts, ground])
        points = np.column_stack((xyz, rng.random(len(xyz))))
        return Frame(self.names[k], points, Objects(boxes, ["Truck", "bicycle", "cone"]))


@pytest.fixture(scope="module")
def config() -> Config:
    """The demo's, with classes that KITTI scores not, or does not have."""
    entries = [
        f"{{name: {name}, level: 0, anchor_sizes: [{size}], anchor_z: -0.8, positive_iou: 0.4, negative_iou: 0.3, "
        "focal_alpha: 0.5, focal_gamma: 2.0, nms_iou: 0.1}"
        for name, size in CLASSES.items()
    ]
    changes = [*TINY, f"head.classes=[{', '.join(entries)}]", "augment.objects={Truck: 2, bicycle: 3}"]
    changes += ["train.epochs=2", "train.batch_size=2", "train.validate_every=1", "train.warmup_steps=0"]
    return load_config(ROOT / "configs" / "demo.yaml", [*changes, "head.score_threshold=0.001", "train.repeat=5"])


@pytest.fixture(scope="module")
def trained(config: Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run on frames of the format above."""
    out = tmp_path_factory.mktemp("own") / "run"
    Run(config, Data(MyFrames(range(4)), MyFrames(range(4, 6))), out).train()
    return out


def test_it_trains_and_validates(trained: Path) -> None:
    first, second = (json.loads(line) for line in (trained / "metrics.jsonl").read_text().splitlines())
    assert second["loss"] < first["loss"]
    assert set(second["validation"]) == set(CLASSES)
    assert len(list((trained / "pictures").iterdir())) == 2


def test_labels_of_another_class_are_said_once(
    config: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Run(config, Data(MyFrames(range(4)), MyFrames(range(4, 6))), tmp_path / "run")
    said = "labels of classes that the config does not have count as background: 6 cone"
    assert capsys.readouterr().out.count(said) == 1


def test_it_is_scored_and_drawn(trained: Path, tmp_path: Path) -> None:
    detector, frames = load(trained / "checkpoint.pt", "cpu"), MyFrames(range(6, 9))
    result = score(detector, frames)
    assert list(result) == ["Truck", "bicycle"]
    assert [result[name]["overlaps"]["strict"]["bev"] for name in result] == [0.7, 0.5]  # by size
    assert result["Truck"]["counts"]["ground_truths"] == [3, 3, 3]
    frame = frames[0]
    found = detector(frame.points)
    draw_bev(tmp_path / "a.png", Subject(frame, found, detector.classes), (0, -10, -3, 20, 10, 2), frame.name)
    page = make_page(trained, [], detector, frames, of="my clouds", count=2, min_score=0.0)
    assert "frame scan 6" in page


def test_its_files_are_scored_by_the_command(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command takes files of any class, by KITTI's protocol; what it is not to score it counts."""
    detector, frames = load(trained / "checkpoint.pt", "cpu"), MyFrames(range(6, 9))
    for folder in ("labels", "results"):
        (tmp_path / folder).mkdir()
    for k in range(len(frames)):
        found = detector(frames[k].points)
        rows = boxes_to_labels(found.boxes.numpy(), found.names(detector.classes), None, found.scores.double().numpy())
        write_labels(tmp_path / "labels" / f"{k}.txt", frame_labels(frames[k]))
        write_labels(tmp_path / "results" / f"{k}.txt", rows)
    given = ["--labels", str(tmp_path / "labels"), "--predictions", str(tmp_path / "results")]
    evaluate.main([*given, "--classes", "Truck", "bicycle", "--overlap", "Truck=0.4", "--json", str(tmp_path / "a")])
    printed = capsys.readouterr().out
    assert "labels of classes that are not scored: 3 cone" in printed
    table = json.loads((tmp_path / "a").read_text())
    assert table["Truck"]["overlaps"] == {
        "strict": {"2d": 0.4, "bev": 0.4, "3d": 0.4},
        "loose": {"2d": 0.4, "bev": 0.2, "3d": 0.2},
    }
    evaluate.main(given)  # all classes are named by the labels and the results alone
    titles = {line.partition(" ")[0] for line in capsys.readouterr().out.splitlines()}
    assert titles >= {"Truck:", "bicycle:", "cone:"}


class Wrong(MyFrames):
    """The same with a mistake in the second frame."""

    def __init__(self, mistake: dict[str, Any]) -> None:
        super().__init__(range(3))
        self.mistake = mistake

    def __getitem__(self, k: int) -> Frame:
        frame = super().__getitem__(k)
        assert frame.objects is not None
        given = {"points": frame.points, "boxes": frame.objects.boxes, "names": frame.objects.names}
        given |= self.mistake if k == 1 else {}
        return Frame(frame.name, given["points"], Objects(given["boxes"], given["names"]))


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        ({"points": np.zeros((5, 3))}, r"points: want shape \(N, 4\)"),
        ({"boxes": np.zeros((3, 8))}, r"boxes: want shape \(M, 7\)"),
        ({"boxes": np.full((3, 7), np.nan)}, r"boxes: want finite numbers and sizes of 0 or more, row 0 is \[nan"),
        ({"boxes": [[1, 1, 0, 4, 2, 1, 0], [9, 1, 0, 4, -2, 1, 0], [1] * 7]}, "boxes: want finite .* row 1 is"),
        ({"names": ["Truck"]}, "names: want one for each of the 3 boxes, got 1"),
    ],
)
def test_a_mistake_in_a_format_names_the_frame(
    mistake: dict[str, Any], message: str, config: Config, trained: Path, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"^frame scan 1: {message}"):
        Run(config, Data(Wrong(mistake), MyFrames([7])), tmp_path / "run")
    with pytest.raises(InputError, match=f"^frame scan 1: {message}"):
        score(load(trained / "checkpoint.pt", "cpu"), Wrong(mistake))
    assert not (tmp_path / "run").exists()


def test_two_frames_of_one_name(config: Config, trained: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^2 frames are named scan 0; rename all but one"):
        Run(config, Data(MyFrames([0, 1, 0]), MyFrames([7])), tmp_path / "run")
    with pytest.raises(InputError, match=r"^2 frames are named scan 5;"):
        score(load(trained / "checkpoint.pt", "cpu"), MyFrames([5, 5]))


def test_a_run_is_not_begun_over_another(config: Config, trained: Path) -> None:
    before = contents(trained)
    with pytest.raises(InputError, match="holds a run; resume it, or give another folder"):
        Run(config, Data(MyFrames(range(4)), MyFrames(range(4, 6))), trained)
    assert contents(trained) == before


def test_a_stopped_run_goes_on_in_the_same_process(
    config: Config, trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a signal, and after a validation that was broken off: the record is that of a run in one go."""
    run = Run(config, Data(MyFrames(range(4)), MyFrames(range(4, 6))), tmp_path / "run")
    step, validate = Run.step, Run.validate
    monkeypatch.setattr(Run, "step", lambda self, batch: (signal.raise_signal(signal.SIGTERM), step(self, batch))[1])
    with pytest.raises(Stopped):
        run.train()
    monkeypatch.setattr(Run, "step", step)
    monkeypatch.setattr(Run, "validate", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run.train()
    monkeypatch.setattr(Run, "validate", validate)
    run.train()
    assert (tmp_path / "run" / "metrics.jsonl").read_text() == (trained / "metrics.jsonl").read_text()


def test_a_run_in_another_thread(config: Config, trained: Path, tmp_path: Path) -> None:
    run = Run(config, Data(MyFrames(range(4)), MyFrames(range(4, 6))), tmp_path / "run")
    thread = threading.Thread(target=run.train)
    thread.start()
    thread.join()
    assert (tmp_path / "run" / "metrics.jsonl").read_text() == (trained / "metrics.jsonl").read_text()


def test_a_run_leaves_torch_as_it_was(trained: Path, config: Config, tmp_path: Path) -> None:
    def flags() -> tuple[bool, ...]:
        return (
            torch.are_deterministic_algorithms_enabled(),
            torch.is_deterministic_algorithms_warn_only_enabled(),
            torch.utils.deterministic.fill_uninitialized_memory,
            torch.backends.cudnn.benchmark,
        )

    before = flags()
    run = Run(config, Data(MyFrames(range(2)), MyFrames(range(4, 5))), tmp_path / "run")
    assert flags() == before
    record = run.epoch()
    assert flags() == before
    assert (record["epoch"], record["step"], run.progress[:3]) == (1, 5, (1, 0, 5))
    assert record["loss"] > 0
    assert set(record["validation"]) == set(CLASSES)
    again = Run(config, Data(MyFrames(range(2)), MyFrames(range(4, 5))), tmp_path / "run", resume=True)
    assert again.epoch()["epoch"] == 2
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2


def test_kitti_is_such_a_format(scenes: Path) -> None:
    frames = KittiFrames(scenes, ["000000", "000001"])
    assert len(frames) == 2
    assert frames[1].name == frames.names[1] == "000001"


def test_objects_that_fit_into_no_file_are_scored() -> None:
    """A name of two words, a box of size 0: labels of a format of one's own, which no label file could hold."""
    boxes = torch.tensor([[10.0, 0, -1, 4, 2, 1.5, 0], [20.0, 0, -1, 0, 0, 0, 0]])
    frame = Frame("a", torch.zeros(0, 4), Objects(boxes, ["tow truck", "Car"]))
    assert frame_labels(frame).name.tolist() == ["tow truck", "Car"]
    assert build_database(GivenFrames(frame)).name.tolist() == ["tow truck", "Car"]
