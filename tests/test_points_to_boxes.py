"""detector.onnx: points to boxes in standard operators, against the detector, and its NMS against the kernel's twin."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import hvnet
from hvnet.config import load_config
from hvnet.data.kitti import read_frame, read_split
from hvnet.kernels import reference
from hvnet.network.checkpoint import find_checkpoint, load_checkpoint, save_checkpoint
from hvnet.network.detector import Detector
from hvnet.network.export import DETECTOR_OPSET, write_detector
from hvnet.network.model import Detections
from hvnet.network.points_to_boxes import iou_of_pairs, suppress
from tests.helpers import ROOT, random_boxes
from tests.models import NARROW, lively, some_points

onnx = pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: pip install '.[test]'")

from export import Difference, compare, edge_cases, main, run, session_of  # noqa: E402  of bench, which needs onnxruntime

CPU = torch.device("cpu")
SMALL = [*NARROW, "head.score_threshold=0.02"]
EDGES = tuple(edge_cases(torch.zeros(9, 4)))


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """The default weights, with more boxes than they report."""
    content = load_checkpoint(find_checkpoint(None))
    content["config"]["head"]["score_threshold"] = 0.2
    path = tmp_path_factory.mktemp("weights") / "many.pt"
    save_checkpoint(path, content)
    return hvnet.load(path, device="cpu", dtype=torch.float32)


@pytest.fixture(scope="module")
def file(detector: Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("onnx") / "detector.onnx"
    write_detector(detector, path)
    return path


@pytest.fixture(scope="module")
def session(file: Path) -> onnxruntime.InferenceSession:
    return session_of(file, 1)


@pytest.fixture(scope="module")
def edges(kitti_root: Path) -> dict[str, Tensor]:
    """Made of the frame that bench/export.py takes with --data.

    In another (000008, 1.3 m higher) rounding decides which of two boxes NMS keeps.
    """
    return edge_cases(read_frame(kitti_root, read_split(kitti_root, "val")[0]).points)


def assert_same(found: Detections, want: Detections) -> None:
    """The same set of boxes, to 1 mm and 1e-4 of score."""
    difference = compare(found, want)
    assert len(found.boxes) == len(want.boxes)
    assert difference.unmatched == 0, difference


def test_on_real_frames(session: onnxruntime.InferenceSession, detector: Detector, kitti_root: Path) -> None:
    boxes = 0
    for name in read_split(kitti_root, "val")[::4]:
        points = read_frame(kitti_root, name).points
        want = detector(points)
        assert_same(run(session, points), want)
        boxes += len(want.boxes)
    assert boxes > 200


@pytest.mark.parametrize("case", EDGES)
def test_at_the_edges(
    case: str, session: onnxruntime.InferenceSession, detector: Detector, edges: dict[str, Tensor]
) -> None:
    """As many boxes as from the street where it is hardly changed, none where nothing is left of it."""
    want = detector(edges[case])
    assert_same(run(session, edges[case]), want)
    nothing = case.startswith(("no point", "one point", "nine", "all points", "points at one"))
    assert (len(want.boxes) == 0) == nothing


def test_the_same_with_several_threads(file: Path, detector: Detector, kitti_root: Path) -> None:
    """Every time: sums and maxima in onnxruntime's ScatterND are not."""
    points = read_frame(kitti_root, "000008").points
    session, want = session_of(file, 2), detector(points)
    first = run(session, points)
    assert_same(first, want)
    for _ in range(5):
        assert all(torch.equal(*pair) for pair in zip(run(session, points), first, strict=True))


def test_the_file_is_standard(file: Path, detector: Detector) -> None:
    model = onnx.load(file)
    onnx.checker.check_model(model, full_check=True)
    assert [(each.domain, each.version) for each in model.opset_import] == [("", DETECTOR_OPSET)]
    kinds: list[str] = []
    graphs = [model.graph]
    while graphs:
        graph = graphs.pop()
        for node in graph.node:
            assert node.domain == ""
            kinds.append(node.op_type)
            reduces = any(each.name == "reduction" and each.s != b"none" for each in node.attribute)
            assert not (reduces and node.op_type == "ScatterND")
            graphs += [each.g for each in node.attribute if each.type == onnx.AttributeProto.GRAPH]
    assert "BatchNormalization" not in kinds
    assert kinds.count("Loop") == 1
    shapes = {
        each.name: [axis.dim_param or axis.dim_value for axis in each.type.tensor_type.shape.dim]
        for each in (*model.graph.input, *model.graph.output)
    }
    assert shapes == {"points": ["points", 4], "boxes": ["boxes", 7], "scores": ["boxes"], "labels": ["boxes"]}
    assert [each.name for each in model.graph.output] == ["boxes", "scores", "labels"]
    assert {each.key: each.value for each in model.metadata_props} == {
        "classes": "\n".join(detector.classes),
        "nms": "yes",
    }
    assert str(ROOT).encode() not in file.read_bytes()
    assert file.stat().st_size < 6e6


def test_without_nms_it_gives_the_candidates(detector: Detector, kitti_root: Path, tmp_path: Path) -> None:
    points = read_frame(kitti_root, "000008").points
    write_detector(detector, tmp_path / "candidates.onnx", nms=False)
    found = run(session_of(tmp_path / "candidates.onnx", 1), points)
    placed = detector.place(points)
    sample = torch.zeros(len(placed.clouds[0]), dtype=torch.int64)
    with torch.no_grad():
        candidates = detector.candidates(*detector.maps(placed.clouds[0], sample, 1))
    assert isinstance(candidates, list)
    for label, (boxes, scores, valid) in enumerate(candidates[0]):
        want = Detections(boxes[valid], scores[valid], torch.full_like(scores[valid], label).long())
        want = detector.take_back([want], placed.move)
        assert len(want.boxes) > 20
        own = found.select(found.labels == label)
        assert_same(own, want)
        assert (own.scores.diff() <= 0).all()


@pytest.mark.parametrize(
    ("ground", "changes"),
    [
        (None, ("head.regression=pose", "head.iou=true", "head.direction=false")),
        (-1.7, ("backbone.pyramid=fpn", "encoder.projection_scales=[1, 2, 4, 8]", "encoder.attention_relu=true")),
        (None, ("backbone.pyramid=none", "head.candidates=40", "head.detections=3")),
        (-1.7, ("encoder.feature_scales=[0.5, 0.75, 2]", "encoder.vfe=plain", "encoder.flat_ground=true")),
        (None, ("head.classes.Car.anchor_sizes=[[3.9, 1.6, 1.56], [9, 2.5, 3]]",)),
        (None, ("encoder.voxel_size=[0.3, 0.3]",)),  # whose last cells reach past the range
    ],
    ids=str,
)
def test_every_switch(ground: float | None, changes: tuple[str, ...], tmp_path: Path) -> None:
    model = lively(load_config(ROOT / "configs" / "demo.yaml", [*SMALL, *changes]))
    detector = Detector(model, CPU, torch.float32, ground=ground, reflectance=ground is None)
    write_detector(detector, tmp_path / "detector.onnx")
    session = session_of(tmp_path / "detector.onnx", 1)
    x_max, y_max = model.config.encoder.point_range[3:5]
    border = some_points(3000)
    border[::5, 0] = torch.linspace(x_max - 0.1, x_max + 0.4, 600)
    border[1::5, 1] = torch.linspace(y_max - 0.1, y_max + 0.4, 600)
    for points in (some_points(), border, some_points(3)):
        want = detector(points)
        assert_same(run(session, points), want)
    assert all(weight.requires_grad for weight in model.parameters())


def test_a_fixed_height_of_the_sensor(tmp_path: Path) -> None:
    model = lively(load_config(ROOT / "configs" / "demo.yaml", SMALL))
    detector = Detector(model, CPU, torch.float32, ground=-1.7, sensor_height=2.9)
    write_detector(detector, tmp_path / "detector.onnx")
    points = some_points() - torch.tensor([0.0, 0.0, 1.2, 0.0])
    want = detector(points)
    assert len(want.boxes) > 2
    assert_same(run(session_of(tmp_path / "detector.onnx", 1), points), want)


def test_iou_of_pairs() -> None:
    """As the twin in float64; exactly 0 where boxes are apart or only touch, and 1 for a box with itself."""
    a, b = random_boxes(300, 0), random_boxes(300, 1)
    a[:40, 6], b[:40, 6] = 0.0, torch.arange(40) % 4 * np.pi / 2  # parallel edges
    want = reference.rotated_iou_bev(a, b).diagonal()
    found = iou_of_pairs(a, b)
    assert ((want > 0) & (want < 1)).sum() > 50
    torch.testing.assert_close(found, want, rtol=0, atol=1e-9)
    assert torch.equal(found == 0, want == 0)
    torch.testing.assert_close(iou_of_pairs(a, a), torch.ones(300, dtype=torch.float64), rtol=0, atol=1e-12)
    car = torch.tensor([[0.0, 0, 0, 4, 2, 1.5, 0]])
    beside = torch.tensor([[0.0, 2, 0, 4, 2, 1.5, 0]])
    assert iou_of_pairs(car, beside).item() == 0.0
    assert iou_of_pairs(car, torch.tensor([[0.0, 1, 0, 4, 2, 1.5, np.pi]])).item() == pytest.approx(1 / 3)


@pytest.mark.parametrize("limit", [3, 100])
def test_suppress(limit: int) -> None:
    """Class by class, as the twin, whose boxes come in the order of their scores."""
    boxes = random_boxes(120, 0, spread=12.0)
    labels = torch.arange(120) // 50
    thresholds = torch.tensor([0.1, 0.3, 0.02])
    want = []
    for label, threshold in enumerate(thresholds.tolist()):
        own = (labels == label).nonzero().squeeze(1)
        kept = reference.rotated_nms(boxes[own], torch.linspace(1, 0, len(own)), threshold)
        assert len(kept) < len(own)
        want.append(own[kept[:limit]])
    assert torch.equal(suppress(boxes, labels, thresholds, limit), torch.cat(want))
    assert len(suppress(boxes[:0], labels[:0], thresholds, limit)) == 0


def test_the_table(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """What docs/deploy.md has, on two scenes: equality, speed and where the time goes."""
    monkeypatch.setattr("export.edge_cases", lambda street: {"no point": street[:0]})
    main(["--data", str(scenes), "--repeat", "1", "--csv", str(tmp_path / "rows.csv")])
    printed = capsys.readouterr().out
    assert re.search(r"^2 frames +[1-9]\d* +0 +\d\.\de-\d\d +\d\.\de-\d\d$", printed, re.MULTILINE)
    assert re.search(r"^no point +0 +0 ", printed, re.MULTILINE)
    assert re.search(r"^detector\.onnx +\d+\.\d +\d+\.\d\dx$", printed, re.MULTILINE)
    with (tmp_path / "rows.csv").open() as file:
        rows = {row["what"]: row for row in csv.DictReader(file)}
    shares = [float(row["share"]) for row in rows.values() if row["share"]]
    assert len(shares) == 5
    assert sum(shares) == pytest.approx(1, abs=0.01)
    assert float(rows["hvnet.load()"]["ms"]) > 0


@pytest.mark.parametrize("dtype", ["float32", torch.int32])
def test_a_dtype_that_is_none(dtype: object) -> None:
    with pytest.raises(ValueError, match=r"dtype: want a floating type of torch, such as torch\.float32, got"):
        hvnet.load(device="cpu", dtype=dtype)  # type: ignore[arg-type]


def test_compare_sees_what_differs() -> None:
    """The comparison of the benchmark and of these tests can fail."""
    boxes = torch.tensor([[10.0, 0, -1, 4, 2, 1.5, 3.14159], [20, 0, -1, 4, 2, 1.5, 0]])
    want = Detections(boxes, torch.tensor([0.9, 0.5]), torch.tensor([0, 1]))
    turned = boxes.clone()
    turned[0, 6] = -3.14159
    assert compare(Detections(turned, want.scores, want.labels).select(torch.tensor([1, 0])), want).unmatched == 0
    moved = boxes + torch.tensor([0.0, 0, 0.002, 0, 0, 0, 0])
    assert compare(want._replace(boxes=moved), want) == Difference(2, 4, 0.0, 0.0)
    assert compare(want._replace(scores=want.scores + 2e-4), want).unmatched == 4
    assert compare(want._replace(labels=1 - want.labels), want).unmatched == 4
    assert compare(want.select(torch.tensor([0])), want).unmatched == 1
    assert compare(want.select(torch.tensor([0, 1, 0, 1])), want).unmatched == 2
    assert compare(want.select(torch.zeros(0, dtype=torch.int64)), want).unmatched == 2
