"""The studies: every row builds, trains a step and detects; the command, its tables, and that it goes on."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hvnet import study
from hvnet.cli import InputError
from hvnet.config import load_config
from hvnet.data.kitti import read_frame, read_split
from hvnet.detector import Detector
from hvnet.model import HVNet
from hvnet.study import STUDIES, Outcome, Row, agreement, main, with_budget
from tests.test_config import CONFIGS

CPU = torch.device("cpu")
ROWS = [(name, row.name) for name, each in STUDIES.items() for row in each.rows]
SMALL = [
    "encoder.point_range=[0, -6.4, -3, 25.6, 6.4, 2]",
    "encoder.feature_channels=4",
    "encoder.image_channels=8",
    "backbone.widths=[8, 8, 8]",
    "backbone.layers=[2, 2, 2]",
    "backbone.fusion_channels=8",
    "head.score_threshold=0.0",
    "head.candidates=50",
    "head.detections=5",
]
QUICK = ["train.bfloat16=false", "train.batch_size=2", "synthetic={train_frames: 4, val_frames: 2}"]


@pytest.mark.parametrize(("name", "row"), ROWS, ids=lambda value: value)
def test_every_row_builds_trains_a_step_and_detects(name: str, row: str, scenes: Path) -> None:
    config = load_config(CONFIGS / "studies" / name / f"{row}.yaml", SMALL)
    torch.manual_seed(0)
    model = HVNet(config).train()
    frames = [read_frame(scenes, at) for at in read_split(scenes, "val")]
    points = torch.cat([frame.points for frame in frames])
    sample = torch.repeat_interleave(torch.arange(2), torch.tensor([len(frame.points) for frame in frames]))
    classes = [entry.name for entry in config.head.classes]
    boxes, labels = [], []
    for frame in frames:
        near = (frame.boxes[:, 0] < 25.6) & (frame.boxes[:, 1].abs() < 6.4)
        known = [k for k, at in enumerate(frame.names) if at in classes and near[k]]
        boxes.append(frame.boxes[known])
        labels.append(torch.tensor([classes.index(frame.names[k]) for k in known]).long())
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
    scores = {name: {"bev": [ap] * 3, "3d": [ap] * 3, "aos": [ap] * 3} for name in ("Car", "Pedestrian")}
    return Outcome(Row(row, row), seed, Path(), 1, 1.0, 1, 0.0, scores, None)


def test_agreement_of_seeds() -> None:
    """Rows a < b < c with one seed and b < a < c with the other: two of three pairs; spreads 3, 1 and 0."""
    first = {"a": 1.0, "b": 3.0, "c": 9.0}
    second = {"a": 4.0, "b": 2.0, "c": 9.0}
    outcomes = [outcome(row, seed, values[row]) for seed, values in enumerate((first, second)) for row in "abc"]
    assert agreement(outcomes) == (2, 3, 1.0)


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
    real_train = study.train

    def train(config, root, out, *rest):  # type: ignore[no-untyped-def]
        trained.append(out)
        real_train(config, root, out, *rest)

    monkeypatch.setattr(study, "train", train)
    main(arguments(tmp_path, "--data", str(scenes), "--budget", "steps=2", "--validate", str(scenes)))
    assert len(trained) == 2  # the second seed; what was there is scored on the further frames
    out = capsys.readouterr().out
    assert "[1/2] density/lossless, seed 0" in first
    assert "[4/4] density/limit-8, seed 1" in out
    table = (tmp_path / "density.md").read_text()
    assert table in out
    assert max(len(line) for line in table.splitlines() if line.startswith("|")) < 160
    assert re.search(r"\| every point \|.*\| 0\.0 \|.*\| 1\.00 \|", table)
    assert re.search(r"The 2 seeds agree on the order of [01] of 1 pairs of rows", table)
    with (tmp_path / "density.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["row"], row["seed"], row["steps"]) for row in rows] == [
        ("lossless", "0", "2"),
        ("lossless", "1", "2"),
        ("limit-8", "0", "2"),
        ("limit-8", "1", "2"),
    ]
    assert 0.01 < float(rows[2]["dropped"]) < 0.9
    assert rows[0]["Car bev"] == rows[0]["real Car bev"]  # the same frames
    assert {row["train frames"] for row in rows} == {"4"}
    with Image.open(tmp_path / "density.png") as picture:
        assert picture.size[0] > 400
    for file in (tmp_path / "rows").glob("*/result.json"):
        assert json.loads(file.read_text())["steps"] == 2


def test_speed_is_labelled_with_the_devices(tmp_path: Path, scenes: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [part for each in SMALL for part in ("--set", each)]
    main(["speed", "--out", str(tmp_path), "--data", str(scenes), "--device", "cpu", *settings])
    out = capsys.readouterr().out
    assert "| row | RTX 2080 Ti (the paper's), ms |" in out
    assert re.search(r"\| hybrid voxels by index, one class \| 32\.0 \| \d+\.\d \|", out)
    assert "| another device: RTX 2080 Ti (the paper's), one class | 32.0 | - | 12.0 | 11.0 | 9.0 |" in out
    with (tmp_path / "speed.csv").open(newline="") as file:
        assert [row["row"] for row in csv.DictReader(file)] == ["vfe", "hsv", "multi-class"]
    assert (tmp_path / "speed.png").is_file()


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--list"])
    out = capsys.readouterr().out
    for name, each in STUDIES.items():
        assert f"\n{name}\n  shows  {each.shows}\n" in "\n" + out
    assert "8 rows a seed, each 600 steps of 2 generated scenes" in out
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
    ],
)
def test_mistakes(given: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        main([*given, "--out", str(tmp_path / "out"), "--set", "synthetic={train_frames: 1, val_frames: 1}"])
