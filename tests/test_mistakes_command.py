"""The command of the page of mistakes: what it reads, where it writes, and what it says of a mistake."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hvnet.exceptions import InputError
from hvnet.mistakes import main
from tests.helpers import ROOT
from tests.models import TINY, save_untrained
from tests.pages import METRICS, Page, write_run


@pytest.fixture(scope="module")
def run(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("runs") / "run", scenes)


def test_a_run_has_its_page(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In its own folder, or in one that is made; with the data, the curves and the count that are wanted."""
    main([str(run), "--count", "1", "--device", "cpu"])
    assert capsys.readouterr().out.endswith(f"page: {run / 'mistakes.html'}\n")
    page = Page((run / "mistakes.html").read_text(encoding="utf-8"))
    assert len(page.images(None)) == 1
    out = tmp_path / "new" / "page.html"
    main([str(run), "--out", str(out), "--count", "7", "--min-score", "0", "--device", "cpu"])
    assert len(Page(out.read_text(encoding="utf-8")).images("crop")) == 14


def test_the_validation_split_is_that_of_the_run(copied: Path, tmp_path: Path) -> None:
    (copied / "ImageSets" / "held.txt").write_text("000005\n")
    save_untrained(tmp_path / "model.pt", [*TINY, "train.val_split=held"])
    main([str(tmp_path / "model.pt"), "--data", str(copied), "--out", str(tmp_path / "page.html"), "--count", "1"])
    text = Page((tmp_path / "page.html").read_text(encoding="utf-8")).text
    assert "in the 1 frames of the validation split of" in text.replace("\n", " ")
    assert "frame 000005" in text


def test_a_checkpoint_alone(run: Path, scenes: Path, tmp_path: Path) -> None:
    """Without metrics there are no curves; where nothing is wrong there is no crop."""
    checkpoint = tmp_path / "model.pt"
    checkpoint.write_bytes((run / "checkpoint.pt").read_bytes())
    out = tmp_path / "page.html"
    main([str(checkpoint), "--data", str(scenes), "--out", str(out), "--min-score", "1", "--count", "1"])
    page = Page(out.read_text(encoding="utf-8"))
    assert page.images(None) == []
    assert "metrics.jsonl" in page.text
    assert "None." in page.text  # no false positive has a score of 1


def test_any_class_has_mistakes(scenes: Path, tmp_path: Path) -> None:
    """Vans, which KITTI does not score, at the overlap of the command or of the anchors' size."""
    van = ["augment.objects={}", "head.classes.Cyclist.name=Van"]
    few = ["head.score_threshold=0.0", "head.candidates=50", "head.detections=5"]
    save_untrained(tmp_path / "model.pt", [*TINY, *few, *van])
    given = [str(tmp_path / "model.pt"), "--data", str(scenes), "--min-score", "0", "--count", "2"]
    main([*given, "--out", str(tmp_path / "page.html")])
    page = Page((tmp_path / "page.html").read_text())
    assert "Van detected" in page.text
    assert "Cyclist BEV" not in page.text
    assert re.search(r"Labels of classes that the config does not have count as background: \d+ Cyclist\.", page.text)
    assert "Van BEV0.5" in page.text  # as small as the anchors of Cyclist
    main([*given, "--out", str(tmp_path / "other.html"), "--overlap", "Van=0.7"])
    assert "Van BEV0.7" in Page((tmp_path / "other.html").read_text()).text
    with pytest.raises(InputError, match=r"--overlap Cyclist=0\.7: no class Cyclist; there are Car, Pedestrian, Van"):
        main([*given, "--out", str(tmp_path / "third.html"), "--overlap", "Cyclist=0.7"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing"], "missing: no such run"),
        (["{empty}"], "holds no checkpoint.pt"),
        (["{checkpoint}"], "does not name the data that it was trained on; give a KITTI root with --data"),
        (["{run}", "--data", "{empty}"], "val.txt: no such file"),
        (["{run}", "--out", "{empty}"], "is a folder; --out names the page"),
        (["{binary}"], "data.txt: does not hold the path of a KITTI root; remove it"),
        (["{shallow}", "--data", "{empty}"], "metrics.jsonl:1: not a record of hvnet.train; remove the line"),
        (["{run}", "--out", "{run}/checkpoint.pt/x.html"], "checkpoint.pt: no folder; --out names the page"),
        (["{broken}", "--data", "{empty}"], "metrics.jsonl:2: not a record of hvnet.train; remove the line"),
    ],
)
def test_mistakes_of_the_user(run: Path, tmp_path: Path, arguments: list[str], message: str) -> None:
    for name in ("empty", "broken", "alone"):
        (tmp_path / name).mkdir()
    for name in ("broken", "alone"):
        (tmp_path / name / "checkpoint.pt").write_bytes((run / "checkpoint.pt").read_bytes())
    for name, data in (("binary", b"\xff\xfe"), ("shallow", None)):
        (tmp_path / name).mkdir()
        shutil.copy(run / "checkpoint.pt", tmp_path / name)
        if data:
            (tmp_path / name / "data.txt").write_bytes(data)
    (tmp_path / "shallow" / "metrics.jsonl").write_text('{"epoch": 1, "validation": {"Car": {}}}\n')
    (tmp_path / "broken" / "metrics.jsonl").write_text(json.dumps(METRICS[0]) + '\n{"epo')
    places = {"run": run, "checkpoint": tmp_path / "alone" / "checkpoint.pt"}
    places |= {name: tmp_path / name for name in ("empty", "broken", "binary", "shallow")}
    with pytest.raises(InputError, match=re.escape(message)):
        main([each.format(**places) for each in [*arguments, "--device", "cpu"]])


@pytest.mark.parametrize(
    "option", [["--count", "0"], ["--count", "a"], ["--min-score", "x"], ["--min-score", "2"], ["--min-score", "nan"]]
)
def test_options_that_mean_nothing(option: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as raised:
        main(["missing", *option])
    assert raised.value.code == 2
    assert f"argument {option[0]}: " in capsys.readouterr().err.splitlines()[-1]


def test_a_mistake_is_one_line() -> None:
    command = [sys.executable, "-m", "hvnet.mistakes", "missing"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("error: missing: no such run; give ")
    assert done.stderr.count("\n") == 1
