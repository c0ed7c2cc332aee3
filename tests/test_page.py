"""The page of mistakes: HTML that parses, holds a picture of every mistake and nothing from elsewhere."""

import base64
import io
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from PIL import Image

from hvnet.data.kitti import read_frame, read_split
from hvnet.evaluation.mistakes import FALSE_POSITIVE, MISS, Mistake, find_mistakes, worst
from hvnet.evaluation.rules import config_rules
from hvnet.exceptions import InputError
from hvnet.mistakes import main
from hvnet.network.detector import load
from hvnet.pictures.page import describe
from tests.helpers import ROOT
from tests.models import TINY, save_untrained

AVERAGES = {"R40": {"bev": [1.0, 2.0, 3.0], "3d": [0.0, 1.0, 2.0]}, "exact": {"bev": [1.0, 2.0, 3.0]}}
METRICS = [
    {"epoch": 1, "step": 2, "loss": 2.0, "classification": 1.5, "localization": 0.5},
    {"epoch": 2, "step": 4, "loss": 1.0, "classification": 0.7, "localization": 0.3,
     "validation": {"Car": AVERAGES, "Cyclist": {"R40": {"bev": [None] * 3}, "exact": {"bev": [None] * 3}}}},
]  # fmt: skip


@pytest.fixture(scope="module")
def run(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of an untrained detector in a folder whose name has to be escaped in HTML."""
    out = tmp_path_factory.mktemp("runs") / "a <b> & c"
    out.mkdir()
    wide = ["encoder.point_range=[0, -12.8, -3, 25.6, 12.8, 2]", "head.score_threshold=0.0"]
    save_untrained(out / "checkpoint.pt", [*TINY, *wide, "head.candidates=100", "head.detections=6"])
    (out / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in METRICS))
    (out / "data.txt").write_text(f"{scenes}\n")
    return out


class Page(HTMLParser):
    """The tags of a page; every one that is opened is closed again, in order."""

    VOID = ("meta", "img")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data

    def images(self, kind: str | None) -> list[dict[str, str | None]]:
        return [attributes for tag, attributes in self.tags if tag == "img" and attributes.get("class") == kind]


def mistakes_of(run: Path, root: Path, min_score: float) -> list[Mistake]:
    detector = load(run / "checkpoint.pt", "cpu")
    frames = [read_frame(root, name) for name in read_split(root, "val")]
    found = [find_mistakes(frame, detector(frame.points), config_rules(detector.config), min_score) for frame in frames]
    return [each for of_frame in found for each in of_frame]


@pytest.mark.parametrize("count", [1, 7])
def test_the_page_holds_a_crop_of_every_mistake(run: Path, scenes: Path, tmp_path: Path, count: int) -> None:
    out = tmp_path / "new" / "page.html"
    main([str(run), "--out", str(out), "--count", str(count), "--min-score", "0", "--device", "cpu"])
    page = Page(out.read_text(encoding="utf-8"))
    mistakes = mistakes_of(run, scenes, 0.0)
    kinds = [sum(each.kind == kind for each in mistakes) for kind in (MISS, FALSE_POSITIVE)]
    assert min(kinds) > 7
    assert f"{kinds[0]} misses and {kinds[1]} false positives" in page.text.replace("\n", " ")
    chosen = [each for kind in worst(mistakes, count) for each in kind]
    crops = page.images("crop")
    assert len(crops) == len(chosen) == 2 * count
    detector = load(run / "checkpoint.pt", "cpu")
    assert [crop["alt"] for crop in crops] == [describe(each, detector.config.encoder.point_range) for each in chosen]
    for crop in crops:
        picture = base64.b64decode((crop["src"] or "").removeprefix("data:image/png;base64,"), validate=True)
        with Image.open(io.BytesIO(picture)) as image:
            assert image.format == "PNG"
            assert image.width > 2 * image.height
    assert "a <b> & c" in page.text
    for name in ("Car BEV", "Pedestrian 3D", "Cyclist BEV"):
        assert name in page.text


def test_a_page_of_pillars(pillars: Path, scenes: Path, tmp_path: Path) -> None:
    """An untrained model finds nothing: all is missed."""
    out = tmp_path / "page.html"
    main([str(pillars), "--data", str(scenes), "--out", str(out), "--count", "2", "--device", "cpu"])
    page = Page(out.read_text(encoding="utf-8"))
    assert len(page.images("crop")) == 2
    assert "0 false positives" in page.text


def test_any_class_has_mistakes(scenes: Path, tmp_path: Path) -> None:
    """Vans, which KITTI does not score, at the overlap of the command or of the anchors' size."""
    van = ["augment.objects={}", "head.classes.Cyclist.name=Van"]
    few = ["head.score_threshold=0.0", "head.candidates=50", "head.detections=5"]
    save_untrained(tmp_path / "model.pt", [*TINY, *few, *van])
    given = [str(tmp_path / "model.pt"), "--data", str(scenes), "--min-score", "0", "--device", "cpu"]
    main([*given, "--out", str(tmp_path / "page.html")])
    page = Page((tmp_path / "page.html").read_text())
    assert "Van detected" in page.text
    assert "Cyclist" not in page.text
    assert "Van BEV0.5" in page.text  # as small as the anchors of Cyclist
    main([*given, "--out", str(tmp_path / "other.html"), "--overlap", "Van=0.7"])
    assert "Van BEV0.7" in Page((tmp_path / "other.html").read_text()).text
    with pytest.raises(InputError, match=r"--overlap Cyclist=0\.7: no class Cyclist; there are Car, Pedestrian, Van"):
        main([*given, "--out", str(tmp_path / "third.html"), "--overlap", "Cyclist=0.7"])


def test_nothing_comes_from_elsewhere(run: Path) -> None:
    """The page is written to the run's folder, and all that it shows is inside."""
    main([str(run), "--count", "1", "--device", "cpu"])
    text = (run / "mistakes.html").read_text(encoding="utf-8")
    page = Page(text)
    assert {tag for tag, _ in page.tags} & {"script", "link", "iframe", "object"} == set()
    assert "http" not in text
    assert "url(" not in text
    for _, attributes in page.tags:
        assert (attributes.get("src") or "data:").startswith("data:")
        assert "href" not in attributes
    (curves,) = page.images(None)
    svg = base64.b64decode((curves["src"] or "").removeprefix("data:image/svg+xml;base64,"), validate=True)
    assert b"<svg" in svg


def test_a_checkpoint_alone(run: Path, scenes: Path, tmp_path: Path) -> None:
    """Without metrics there are no curves; where nothing is wrong there is no crop."""
    checkpoint = tmp_path / "model.pt"
    checkpoint.write_bytes((run / "checkpoint.pt").read_bytes())
    out = tmp_path / "page.html"
    main([str(checkpoint), "--data", str(scenes), "--out", str(out), "--min-score", "1", "--count", "1"])
    page = Page(out.read_text(encoding="utf-8"))
    assert page.images(None) == []
    assert "No metrics.jsonl" in page.text
    assert "None." in page.text  # no false positive has a score of 1


def test_descriptions() -> None:
    point_range = (0.0, -10.0, -3.0, 30.0, 10.0, 2.0)
    box = torch.tensor([20.0, 5.0, -1.0, 4.0, 2.0, 1.5, 0.0])
    miss = Mistake("1", MISS, "Car", box, 0.25, 20.6, 7, 0.5)
    assert describe(miss, point_range) == (
        "20.6 m away, 7 points in the box, best overlap 0.50, with a detection of score 0.25"
    )
    assert describe(miss._replace(overlap=0.0, score=0.0), point_range).endswith("no detection of its class there")
    wrong = miss._replace(kind=FALSE_POSITIVE, box=box + 12)
    assert describe(wrong, point_range) == (
        "score 0.25, 20.6 m away, 7 points in the box, outside the detector's range, best overlap with a label 0.50"
    )
    assert describe(wrong._replace(overlap=0.0), point_range).endswith("no label of its class there")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing"], "missing: no such run"),
        (["{empty}"], "holds no checkpoint.pt"),
        (["{checkpoint}"], "does not name the data that it was trained on; give a KITTI root with --data"),
        (["{run}", "--data", "{empty}"], "val.txt: no such file"),
        (["{run}", "--out", "{empty}"], "is a folder; --out names the page"),
        (["{binary}"], "data.txt: does not hold the path of a KITTI root"),
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
