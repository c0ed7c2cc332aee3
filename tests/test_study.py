"""The studies: every row builds, trains a step and detects; the command, its tables, and that it goes on."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hvnet.config import load_config
from hvnet.data.frame import Objects
from hvnet.data.kitti import KittiFrames, boxes_to_labels, read_split_frames, write_labels
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import load_checkpoint
from hvnet.network.detector import Detector
from hvnet.network.model import Detections, HVNet
from hvnet.studies.catalogue import STUDIES, Row, Study
from hvnet.studies.rows import Outcome, count_cars, score_in_range, with_budget
from hvnet.studies.study import locked
from hvnet.studies.tables import agreement, trained_table
from hvnet.study import main
from hvnet.training.run import Run
from tests.models import CONFIGS, QUICK, SMALL

CPU = torch.device("cpu")
ROWS = [(name, row.name) for name, each in STUDIES.items() for row in each.rows]


@pytest.mark.parametrize(("name", "row"), ROWS, ids=lambda value: value)
def test_every_row_builds_trains_a_step_and_detects(name: str, row: str, scenes: Path) -> None:
    config = load_config(CONFIGS / "studies" / name / f"{row}.yaml", SMALL)
    torch.manual_seed(0)
    model = HVNet(config).train()
    frames = list(read_split_frames(scenes, "val"))
    points = torch.cat([frame.points for frame in frames])
    sample = torch.repeat_interleave(torch.arange(2), torch.tensor([len(frame.points) for frame in frames]))
    classes = [entry.name for entry in config.head.classes]
    boxes, labels = [], []
    for frame in frames:
        objects = frame.objects or Objects(torch.zeros(0, 7), [])
        near = (objects.boxes[:, 0] < 25.6) & (objects.boxes[:, 1].abs() < 6.4)
        known = [k for k, each in enumerate(objects.names) if each in classes and near[k]]
        boxes.append(objects.boxes[known])
        labels.append(torch.tensor([classes.index(objects.names[k]) for k in known]).long())
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    losses = []
    for _ in range(2):
        terms = model.loss(model(points, sample, 2), boxes, labels)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(map(len, labels)) > 3
    assert np.isfinite(losses).all()
    assert losses[1] < losses[0]
    here = [model.heads[label] for label in torch.cat(labels).unique().tolist()]  # of classes that the frames hold
    for weight in (weight for part in (*here, model.encoder) for weight in part.parameters()):
        assert weight.grad is not None
        assert weight.grad.any()
    found = Detector(model.eval(), CPU)(frames[0].points)
    assert set(found.labels.tolist()) == set(range(len(classes)))
    assert found.boxes.isfinite().all()


def test_rows_are_differences_to_their_bases() -> None:
    """Every row has a file, every file a row, and each but one of a study's chain names a base."""
    files = {(path.parent.name, path.stem) for path in (CONFIGS / "studies").glob("*/*.yaml")}
    assert files == set(ROWS)
    for path in (CONFIGS / "studies").rglob("*.yaml"):
        assert re.search(r"^base: \S+\.yaml$", path.read_text(), flags=re.MULTILINE), path
        assert len(path.read_text().splitlines()) < (40 if path.stem == "base" else 15), path


@pytest.mark.parametrize(
    ("row", "changes"),
    [
        ("baseline", {"vfe": "plain", "scales": (1, 1), "pyramid": "none", "alpha": 0.25}),
        ("attention", {"vfe": "attentive", "scales": (1, 1), "pyramid": "none", "alpha": 0.25}),
        ("fpn", {"vfe": "attentive", "scales": (1, 1), "pyramid": "fpn", "alpha": 0.25}),
        ("ffpn", {"vfe": "attentive", "scales": (1, 1), "pyramid": "ffpn", "alpha": 0.25}),
        ("focal", {"vfe": "attentive", "scales": (1, 1), "pyramid": "ffpn", "alpha": 0.75}),
        ("scale-2-feature", {"vfe": "attentive", "scales": (2, 1), "pyramid": "ffpn", "alpha": 0.75}),
        ("scale-2", {"vfe": "attentive", "scales": (2, 2), "pyramid": "ffpn", "alpha": 0.75}),
        ("scale-3", {"vfe": "attentive", "scales": (3, 3), "pyramid": "ffpn", "alpha": 0.75}),
    ],
)
def test_the_ablation_table(row: str, changes: dict[str, object]) -> None:
    """The eight rows as the paper's table ticks them."""
    config = load_config(CONFIGS / "studies" / "components" / f"{row}.yaml")
    assert config.encoder.vfe == changes["vfe"]
    assert (len(config.encoder.feature_scales), len(config.encoder.projection_scales)) == changes["scales"]
    assert config.encoder.feature_scales == (0.5, 1.0, 2.0)[: len(config.encoder.feature_scales)]
    assert config.encoder.projection_scales == (1.0, 2.0, 4.0)[: len(config.encoder.projection_scales)]
    assert config.backbone.pyramid == changes["pyramid"]
    assert [entry.focal_alpha for entry in config.head.classes] == [0.25, changes["alpha"], changes["alpha"]]


def test_the_scale_rows() -> None:
    for n in range(1, 6):
        by_t = load_config(CONFIGS / "studies" / "scales" / f"nt{n}.yaml")
        by_r = load_config(CONFIGS / "studies" / "scales" / f"nr{n}.yaml")
        assert (len(by_t.encoder.feature_scales), len(by_t.encoder.projection_scales)) == (n, 1)
        assert (len(by_r.encoder.feature_scales), len(by_r.encoder.projection_scales)) == (3, n)
        assert len(HVNet(by_r).backbone.main_stream.blocks) == max(3, n)


def outcome(row: str, seed: int, ap: float) -> Outcome:
    """Two classes whose moderate BEV AP are ap - 1 and ap + 1, and one that the frames do not hold."""
    scores = {
        "Car": {"bev": [0.0, ap - 1, 0.0], "3d": [7.0] * 3, "aos": [8.0] * 3},
        "Pedestrian": {"bev": [90.0, ap + 1, 0.0], "3d": [7.0] * 3, "aos": [8.0] * 3},
        "Cyclist": {measure: [None] * 3 for measure in ("bev", "3d", "aos")},
    }
    return Outcome(Row(row, row), seed, Path(f"{row}-{seed}"), 1, 1.0, 1, "cpu", 0.0, scores)


def test_agreement_of_seeds() -> None:
    """Rows a < b < c with one seed and b < a < c with the other: two of three pairs; spreads 3, 1 and 0."""
    first = {"a": 1.0, "b": 3.0, "c": 9.0}
    second = {"a": 4.0, "b": 2.0, "c": 9.0}
    outcomes = [outcome(row, seed, values[row]) for seed, values in enumerate((first, second)) for row in "abc"]
    assert agreement(outcomes) == (2, 3, 1.0)
    assert outcomes[0].mean_ap() == 1.0
    assert outcomes[0].mean_ap(level=0) == 45.0
    shared = [each._replace(row=Row("d", "d")) for each in outcomes if each.row.name == "a"]
    assert agreement(outcomes + shared) == (2, 3, 1.0)  # a row that is another's training is no further row
    even = [outcome(row, seed, 5.0) for seed in range(2) for row in "ab"]
    assert agreement(even) == (0, 1, 0.0)  # a tie is no order
    assert agreement(outcomes[1:]) == (3, 3, 0.0)  # without a's first seed
    assert agreement([outcomes[0], outcomes[4]])[:2] == (0, 0)  # no seed that both have
    empty = outcome("a", 0, 5.0)._replace(scores={"Car": {"bev": [None] * 3}})
    assert agreement([empty])[:2] == (0, 0)


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
    cars = count_cars(config, frames)
    assert 0 < cars < sum(list(frames.object_names(k) or ()).count("Car") for k in range(len(frames))) + 1
    for folder in ("velodyne", "label_2"):
        shutil.copytree(scenes / "training" / folder, tmp_path / "training" / folder)
    boxes = np.array([[x, 0.0, -1.0, 4.0, 1.6, 1.5, 0.0] for x in (5.0, 10.0, 20.0)])
    write_labels(tmp_path / "training" / "label_2" / f"{frames.names[0]}.txt", boxes_to_labels(boxes, ["Car"] * 3))
    assert count_cars(config, KittiFrames(tmp_path, frames.names[:1])) == 2  # no camera, one of three out of range


def test_every_seed_has_its_column() -> None:
    rows = (Row("a", "a"), Row("b", "b"))
    outcomes = [outcome("a", 0, 5.0), outcome("a", 1, 6.0), outcome("b", 1, 7.0)]
    times = {"a": (1.0, 1.0, 2.0), "b": (1.0, 1.0, 0.0)}
    table = trained_table(Study("", "", rows), outcomes, times, {"a", "b"})
    assert table[0].startswith("| row | mAP | seed 0 | seed 1 | Car |")
    assert table[2].startswith("| a | 5.5 | 5.0 | 6.0 | 4.5 |")
    assert table[3].startswith("| b | 7.0 | - | 7.0 | 6.0 |")
    assert table[3].endswith("| 0.50 |")


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


def arguments(out: Path, *more: str) -> list[str]:
    settings = [part for each in (*SMALL, *QUICK) for part in ("--set", each)]
    return ["density", "--rows", "lossless", "limit-8", "--out", str(out), "--device", "cpu", *settings, *more]


def test_a_study_is_written_and_goes_on(
    tmp_path: Path, scenes: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    main(arguments(tmp_path, "--data", str(scenes), "--budget", "steps=2", "--seeds", "1"))
    first = capsys.readouterr().out
    trained: list[Path] = []
    real_train = Run.train

    def train(run: Run) -> None:
        trained.append(run.out)
        real_train(run)

    monkeypatch.setattr(Run, "train", train)
    main(arguments(tmp_path, "--data", str(scenes), "--budget", "steps=2", "--validate", str(scenes)))
    assert len(trained) == 2  # the second seed; what was there is scored on the further frames
    out = capsys.readouterr().out
    assert "[1/2] density/lossless, seed 0" in first
    assert "[4/4] density/limit-8, seed 1" in out
    table = (tmp_path / "density.md").read_text()
    assert re.search(r"^every point +\d+\.\d +\d+\.\d$", out, flags=re.MULTILINE)
    assert max(len(line) for line in out.splitlines() if str(tmp_path) not in line) <= 100
    assert max(len(line) for line in table.splitlines() if line.startswith("|")) < 160
    assert re.search(r"\| every point \|.*\| 0\.0 \| 0\.0 \|.*\| 1\.00 \|", table)
    assert re.search(r"\| 8 points a voxel \|.*\d\* \|", table)  # is not fused
    assert re.search(r"All 2 seeds agree on the order of [01] of 1 pairs of rows", table)
    assert re.search(r"Real: 2 frames, which hold \d+ moderate cars", table)
    with (tmp_path / "density.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["row"], row["seed"], row["steps"]) for row in rows] == [
        ("lossless", "0", "2"),
        ("lossless", "1", "2"),
        ("limit-8", "0", "2"),
        ("limit-8", "1", "2"),
    ]
    assert 0.01 < float(rows[2]["dropped"]) < 0.9
    assert rows[2]["dropped"] == rows[2]["real dropped"]  # the same frames
    assert {row["train frames"] for row in rows} == {"4"}
    with Image.open(tmp_path / "density.png") as picture:
        assert picture.size[0] > 400
    files = sorted((tmp_path / "rows").glob("*/result.json"))
    assert [json.loads(file.read_text())["steps"] for file in files] == [2] * 4
    for file in files:  # damaged: scored again from its checkpoint, which is whole; another row is left out
        whole = file.read_text()
        file.write_text("")
        main([*arguments(tmp_path, "--data", str(scenes), "--budget", "steps=2"), "--rows", "limit-8"])
        assert "[2/2] density/limit-8, seed 1" in capsys.readouterr().out
        assert "| every point |" in (tmp_path / "density.md").read_text()  # of a row not named: what there is
        file.write_text(whole)
    other = shutil.copytree(scenes, tmp_path / "elsewhere" / scenes.name)  # other data under the same name
    count = len(trained)
    main(arguments(tmp_path, "--data", str(other), "--budget", "steps=2", "--seeds", "1"))
    assert len(trained) == count + 2


def test_speed_is_labelled_with_the_devices(tmp_path: Path, scenes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [part for each in SMALL for part in ("--set", each)]
    main(["speed", "--out", str(tmp_path), "--data", str(scenes), "--device", "cpu", *settings])
    out = capsys.readouterr().out
    assert re.search(r"^hybrid voxels by index, one class( +\d+\.\d){4} +32\.0$", out, flags=re.MULTILINE)
    assert re.search(r"ms a cloud +2080 Ti, ms$", out, flags=re.MULTILINE)
    table = (tmp_path / "speed.md").read_text()
    assert "| row | RTX 2080 Ti (the paper's), ms |" in table
    assert re.search(r"\| hybrid voxels by index, one class \| 32\.0 \| \d+\.\d \|", table)
    assert "| another device: RTX 2080 Ti (the paper's), one class | 32.0 | - | 12.0 | 11.0 | 9.0 |" in table
    with (tmp_path / "speed.csv").open(newline="") as file:
        assert [row["row"] for row in csv.DictReader(file)] == ["vfe", "hsv", "multi-class"]
    assert (tmp_path / "speed.png").is_file()


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--list"])
    out = capsys.readouterr().out
    for name, each in STUDIES.items():
        assert f"\n{name}\n  shows  {each.shows}\n" in "\n" + out
    assert "8 rows of 600 steps: about 16 minutes a seed" in out
    assert max(map(len, out.splitlines())) <= 120


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["loss", "--rows", "lossless"], r"--rows lossless: no row of loss; there are corners, pose"),
        (["loss", "--seeds", "0"], "--seeds 0: want 1 or more"),
        (["loss", "--budget", "minutes=3"], "--budget minutes=3: want epochs=N or steps=N"),
        (["loss", "--base", "none.yaml"], r"none\.yaml: cannot be read"),
        (["loss", "--set", "head.iou"], "--set head.iou: want KEY=VALUE"),
        (["loss", "--data", "nowhere"], r"nowhere/ImageSets/train\.txt"),
        (["loss", "--validate", "nowhere"], r"nowhere/ImageSets/val\.txt"),
        (["loss", "--base", str(CONFIGS / "hvnet.yaml")], r"hvnet\.yaml: has no key synthetic"),
        (["speed", "--budget", "steps=1"], "--budget: is not for speed"),
    ],
)
def test_mistakes(given: list[str], message: str, tmp_path: Path) -> None:
    scenes = [] if "--base" in given else ["--set", "synthetic={train_frames: 1, val_frames: 1}"]
    with pytest.raises(InputError, match=message):
        main([*given, "--out", str(tmp_path / "out"), *scenes])


def test_one_study_at_a_time(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(InputError, match="another study is at work there"):
        main(["speed", "--out", str(tmp_path)])


def test_a_study_that_is_stopped_goes_on(tmp_path: Path, scenes: Path) -> None:
    """SIGTERM in the middle of a row: it says so, ends, and the same command ends with the row of a run in one go."""
    given = ["loss", "--rows", "corners", "--seeds", "1", "--data", str(scenes), "--device", "cpu", "--budget"]
    given += ["epochs=12", *(part for each in (*SMALL, *QUICK) for part in ("--set", each))]
    command = [sys.executable, "-m", "hvnet.study", *given, "--out", str(tmp_path / "a")]
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}  # the bits depend on it
    process = subprocess.Popen(
        command, cwd=CONFIGS.parent, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    while process.poll() is None and not list((tmp_path / "a" / "rows").glob("*/checkpoint.pt")):
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGTERM
    assert "stopped; the same command continues from here" in out
    main([*given, "--out", str(tmp_path / "a")])
    main([*given, "--out", str(tmp_path / "b")])
    stopped, whole = (json.loads(next((tmp_path / at).glob("rows/*/result.json")).read_text()) for at in "ab")
    assert stopped["scores"] == whole["scores"]
    assert stopped["seconds"] is None
    weights = [load_checkpoint(next((tmp_path / at).glob("rows/*/checkpoint.pt")))["model"] for at in "ab"]
    assert all(torch.equal(a, b) for a, b in zip(weights[0].values(), weights[1].values(), strict=True))
