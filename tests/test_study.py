"""The command of the studies: what it writes, that it goes on where it was stopped, and what it says of a mistake."""

import contextlib
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
from types import SimpleNamespace

import pytest
import torch
from PIL import Image

from hvnet.exceptions import InputError, Stopped
from hvnet.network.checkpoint import load_checkpoint
from hvnet.studies import rows, study
from hvnet.studies.catalogue import STUDIES
from hvnet.studies.study import locked
from hvnet.study import main
from hvnet.training.run import Run
from tests.models import CONFIGS, QUICK, SMALL


def arguments(out: Path, *more: str) -> list[str]:
    settings = [part for each in (*SMALL, *QUICK) for part in ("--set", each)]
    return ["density", "--rows", "lossless", "limit-8", "--out", str(out), "--device", "cpu", *settings, *more]


def test_a_study_is_written_and_goes_on(
    tmp_path: Path, scenes: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rows, "REAL_RESAMPLES", 50)  # of two frames
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
    assert re.search(r"Real: 2 frames, which hold \d+ moderate objects of Car", table)
    figures = r"( \+?-?\d+\.\d \[-?\d+\.\d, -?\d+\.\d\] \|| - \|){4}"
    assert re.search(rf"^\| real \| Car \|.*\n.*\n\| every point \|{figures}$", table, flags=re.MULTILINE)
    assert re.search(rf"^\| real: less the.*\n.*\n\| 8 points a voxel \|{figures}$", table, flags=re.MULTILINE)
    with (tmp_path / "density.csv").open(newline="") as file:
        table_rows = list(csv.DictReader(file))
    assert [(row["row"], row["seed"], row["steps"]) for row in table_rows] == [
        ("lossless", "0", "2"),
        ("lossless", "1", "2"),
        ("limit-8", "0", "2"),
        ("limit-8", "1", "2"),
    ]
    assert 0.01 < float(table_rows[2]["dropped"]) < 0.9
    assert table_rows[2]["dropped"] == table_rows[2]["real dropped"]  # the same frames
    assert {row["train frames"] for row in table_rows} == {"4"}
    with Image.open(tmp_path / "density.png") as picture:
        assert picture.size[0] > 400
    files = sorted((tmp_path / "rows").glob("*/result.json"))
    assert [json.loads(file.read_text())["steps"] for file in files] == [2] * 4
    # damaged: scored again from its checkpoint, which is whole; another row is left out. One file of either row
    results = {}
    for file in files:
        encoder = load_checkpoint(file.with_name("checkpoint.pt"))["config"]["encoder"]
        results[encoder["point_limit"]] = file
    assert results.keys() == {0, 8}
    for file in results.values():
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
        (["loss", "--groups", "drives.csv"], r"--groups drives\.csv: is for --validate; add it"),
        (["loss", "--base", str(CONFIGS / "hvnet.yaml")], r"hvnet\.yaml: has no key synthetic"),
        (["speed", "--budget", "steps=1"], "--budget: is not for speed"),
    ],
)
def test_mistakes(given: list[str], message: str, tmp_path: Path) -> None:
    scenes = [] if "--base" in given else ["--set", "synthetic={train_frames: 1, val_frames: 1}"]
    with pytest.raises(InputError, match=message):
        main([*given, "--out", str(tmp_path / "out"), *scenes])


@pytest.mark.parametrize("taken", [False, True])
def test_the_lock_of_windows(taken: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there is no fcntl."""
    calls = []

    def locking(file: int, mode: int, count: int) -> None:
        calls.append((mode, count))
        if taken:
            raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(study, "sys", SimpleNamespace(platform="win32"))
    monkeypatch.setitem(sys.modules, "fcntl", None)
    monkeypatch.setitem(sys.modules, "msvcrt", SimpleNamespace(LK_NBLCK=2, locking=locking))  # type: ignore[arg-type]
    expected = pytest.raises(InputError, match="another study") if taken else contextlib.nullcontext()
    with expected, locked(tmp_path):
        assert not taken
    assert calls == [(2, 1)]


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


def test_a_signal_in_the_last_validation_stops_the_study(
    tmp_path: Path, scenes: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """There the run is done, but not the rows; the same command goes on with what is left."""
    trained: list[Path] = []
    real_train = Run.train

    def train(run: Run) -> None:
        trained.append(run.out)
        real_train(run)
        if len(trained) == 1:
            run.signals.append(signal.SIGTERM)

    monkeypatch.setattr(Run, "train", train)
    given = arguments(tmp_path, "--data", str(scenes), "--budget", "steps=2", "--seeds", "1")
    with pytest.raises(Stopped, match="stopped; the same command continues from here") as raised:
        main(given)
    assert raised.value.signal == signal.SIGTERM
    assert len(trained) == 1
    assert not (tmp_path / "density.md").exists()
    main(given)
    assert trained[1] == trained[0]  # it is whole: nothing is left but to score it
    assert len(set(trained)) == 2
    assert "[2/2] density/limit-8, seed 0: mAP" in capsys.readouterr().out
    assert (tmp_path / "density.md").is_file()
