"""The page of mistakes: HTML that parses, holds a picture of every mistake and nothing from elsewhere."""

import base64
import io
from pathlib import Path

import pytest
import torch
from PIL import Image

from hvnet.data.frame import Frame, Frames, Objects
from hvnet.data.kitti import KittiFrames, read_frame, read_split, read_split_frames
from hvnet.evaluation.mistakes import FALSE_POSITIVE, MISS, Mistake, find_mistakes, worst
from hvnet.evaluation.rules import config_rules
from hvnet.network.detector import load
from hvnet.pictures.page import describe, make_page
from hvnet.training.folder import find_run
from tests.helpers import CAMERA, GivenFrames
from tests.models import TINY, save_untrained
from tests.pages import Page, write_run


@pytest.fixture(scope="module")
def run(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in a folder whose name has to be escaped in HTML."""
    return write_run(tmp_path_factory.mktemp("runs") / "a <b> & c", scenes)


def page_of(run: Path, frames: Frames, count: int, min_score: float) -> str:
    found = find_run(run)
    detector = load(found.checkpoint, "cpu")
    return make_page(
        found.checkpoint, found.metrics, detector, frames, of=str(found.root), count=count, min_score=min_score
    )


def mistakes_of(run: Path, root: Path, min_score: float) -> list[Mistake]:
    detector = load(run / "checkpoint.pt", "cpu")
    frames = [read_frame(root, name) for name in read_split(root, "val")]
    found = [find_mistakes(frame, detector(frame.points), config_rules(detector.config), min_score) for frame in frames]
    return [each for of_frame in found for each in of_frame]


@pytest.mark.parametrize("count", [1, 7])
def test_the_page_holds_a_crop_of_every_mistake(run: Path, scenes: Path, count: int) -> None:
    page = Page(page_of(run, read_split_frames(scenes, "val"), count, 0.0))
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


def test_a_page_of_pillars(pillars: Path, scenes: Path) -> None:
    """An untrained model finds nothing: all is missed."""
    page = Page(page_of(pillars, read_split_frames(scenes, "val"), 2, 0.5))
    assert len(page.images("crop")) == 2
    assert "0 false positives" in page.text


def test_frames_of_another_format(tmp_path: Path) -> None:
    """Of a class that KITTI does not know; with a camera the crop is in the image as well."""
    own = ["augment.objects={}", "head.classes.Cyclist.name=excavator"]
    few = ["head.score_threshold=0.0", "head.candidates=50", "head.detections=1"]
    save_untrained(tmp_path / "model.pt", [*TINY, *few, *own])
    points = torch.rand(500, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor([10, 10, 10, 1])
    objects = Objects(torch.tensor([[10.0, 0, -1, 4, 2, 1.5, 0]]), ["excavator"])
    frames = GivenFrames(Frame("first", points, objects, CAMERA), Frame("second", points, objects))
    page = Page(page_of(tmp_path / "model.pt", frames, 2, 1.0))
    assert "2 misses and 0 false positives" in page.text
    assert "excavator BEV0.5" in page.text
    for name in frames.names:
        assert f"excavator, frame {name}" in page.text
    widths = []
    for crop in page.images("crop"):
        picture = base64.b64decode((crop["src"] or "").removeprefix("data:image/png;base64,"), validate=True)
        with Image.open(io.BytesIO(picture)) as image:
            widths.append(image.width)
    assert sorted(widths) == [336, 912]  # 2.8 and 7.6 inches


def test_a_real_frame(run: Path, kitti_root: Path) -> None:
    """With its image: crops of the labelled objects that an untrained detector misses."""
    name = sorted((kitti_root / "training" / "image_2").iterdir())[0].stem
    page = Page(page_of(run, KittiFrames(kitti_root, [name]), 3, 1.0))
    frame = read_frame(kitti_root, name)
    known = len(frame.boxes_of(["Car", "Pedestrian", "Cyclist"]))
    assert f"{known} misses and 0 false positives" in page.text
    assert len(page.images("crop")) == min(known, 3)


def test_nothing_comes_from_elsewhere(run: Path, scenes: Path) -> None:
    """All that the page shows is inside."""
    text = page_of(run, read_split_frames(scenes, "val"), 1, 0.5)
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


def test_without_metrics_and_mistakes(run: Path, scenes: Path, tmp_path: Path) -> None:
    """There are no curves; where nothing is wrong there is no crop."""
    (tmp_path / "model.pt").write_bytes((run / "checkpoint.pt").read_bytes())
    page = Page(page_of(tmp_path / "model.pt", read_split_frames(scenes, "val"), 1, 1.0))
    assert page.images(None) == []
    assert "metrics.jsonl" in page.text
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
