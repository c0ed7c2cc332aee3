"""Inference: every stage against the plain model, clouds of any kind, checkpoints, and the shipped weights."""

import copy
import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch._library.custom_ops import OPDEFS
from torch.utils._python_dispatch import TorchDispatchMode

from hvnet.config import ClassConfig, Config, config_to_dict, load_config
from hvnet.data.ground import flatten
from hvnet.data.kitti import read_frame
from hvnet.exceptions import InputError
from hvnet.kernels import launch
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.anchors import MAX_HEIGHT, MAX_SIZE
from hvnet.network.checkpoint import find_checkpoint, load_checkpoint, model_from_checkpoint, save_checkpoint
from hvnet.network.detector import (
    MAX_GRAPHS,
    Detector,
    detections,
    fold_batch_norms,
    load,
    regression_weight,
    turned,
    turns_all_round,
)
from hvnet.network.head import Head, regress
from hvnet.network.model import Detections, HVNet
from tests.models import CONFIGS, NARROW, lively, some_points

CPU = torch.device("cpu")
both_ways = pytest.mark.usefixtures("threads")


def same(found: Detections, want: Detections, tolerance: float = 1e-4) -> None:
    assert torch.equal(found.labels, want.labels)
    torch.testing.assert_close(found.scores, want.scores, rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(found.boxes[:, :6], want.boxes[:, :6], rtol=tolerance, atol=tolerance)
    turn = found.boxes[:, 6] - want.boxes[:, 6]
    assert (turn.sin().abs() < 10 * tolerance).all()
    assert (turn.cos() > 0.9).all()


@both_ways
@pytest.mark.parametrize("direction", [True, False])
@pytest.mark.parametrize("batch_size", [1, 3])
def test_the_same_boxes_as_the_plain_model(demo: Config, direction: bool, batch_size: int) -> None:
    model = lively(demo, direction=direction, score_threshold=0.02, candidates=200, detections=20)
    clouds = [some_points(400 + 50 * b, seed=b) for b in range(batch_size)]
    sample = torch.repeat_interleave(torch.arange(batch_size), torch.tensor([len(cloud) for cloud in clouds]))
    want = model.detect(torch.cat(clouds), sample, batch_size)
    found = Detector(model, CPU, torch.float32).batch(clouds)
    assert sum(len(one.boxes) for one in want) > 20 * batch_size
    for one, other in zip(found, want, strict=True):
        same(one, other)


def test_bfloat16_finds_the_same_objects(demo: Config) -> None:
    model = lively(demo, score_threshold=0.05, candidates=100, detections=10)
    want, found = (
        Detector(model, CPU, torch.float32)(some_points()),
        Detector(model, CPU, torch.bfloat16)(some_points()),
    )
    for label in range(3):
        best = want.boxes[want.labels == label][:3]
        overlap = rotated_iou_bev(best, found.boxes[found.labels == label])
        assert (overlap.max(dim=1).values > 0.8).all()


def test_folded_convolutions_give_the_same_maps(demo: Config) -> None:
    model = lively(demo)
    images = model.encoder(some_points(), torch.zeros(500, dtype=torch.int64), 1)
    folded = fold_batch_norms(model.backbone)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in folded.modules())
    assert any(isinstance(module, torch.nn.BatchNorm2d) for module in model.backbone.modules())
    with torch.no_grad():
        for found, want in zip(folded(images), model.backbone(images), strict=True):
            torch.testing.assert_close(found, want, rtol=1e-4, atol=1e-4)


def test_regression_of_chosen_anchors_equals_the_convolutions(demo: Config) -> None:
    """Every anchor of a map that is not square, its borders included."""
    torch.manual_seed(0)
    head = Head(
        dataclasses.replace(demo.head.classes[0], anchor_sizes=((3.9, 1.6, 1.5), (8.0, 2.5, 3.0))), 6, demo.head
    )
    level = torch.randn(1, 6, 5, 3)
    maps = head(level)
    assert maps.direction is not None
    want = torch.cat((maps.location[0], maps.vertical[0], maps.direction[0]), dim=1)
    at = torch.randperm(5 * 3 * 8)
    found = regress(level, at, regression_weight(head), 8)
    torch.testing.assert_close(found, want[at], rtol=1e-5, atol=1e-5)


@both_ways
@pytest.mark.parametrize(
    "changes",
    [
        {"head.regression": "pose"},
        {"head.iou": "true"},
        {"head.iou": "true", "head.direction": "false", "head.regression": "pose"},
        {"encoder.vfe": "plain"},
        {"encoder.point_limit": "1"},
        {"backbone.pyramid": "fpn"},
    ],
    ids=str,
)
def test_every_switch_detects_as_the_plain_model(changes: dict[str, str]) -> None:
    config = load_config(CONFIGS / "demo.yaml", [*NARROW, *(f"{key}={value}" for key, value in changes.items())])
    model = lively(config, score_threshold=0.02)
    points = some_points()
    want = model.detect(points, torch.zeros(500, dtype=torch.int64), 1)[0]
    found = Detector(model, CPU, torch.float32)(points)
    assert len(want.boxes) > 5
    same(found, want)


@both_ways
def test_training_does_not_change_a_detector(demo: Config) -> None:
    model = lively(demo, score_threshold=0.05)
    detector = Detector(model, CPU)
    before = detector(some_points())
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(1.5)
    for now, then in zip(detector(some_points()), before, strict=True):
        assert torch.equal(now, then)


@both_ways
@pytest.mark.parametrize("branch", ["location", "vertical"])
@pytest.mark.parametrize("value", [1e30, -1e30, math.inf, -math.inf])
@pytest.mark.parametrize("regression", ["corners", "pose"])
def test_boxes_of_outputs_without_bounds(demo: Config, regression: str, value: float, branch: str) -> None:
    """A head that has gone astray gives boxes that a street can hold."""
    model = lively(demo, regression=regression, score_threshold=0.02)
    for head in model.heads:
        torch.nn.init.constant_(getattr(head, branch).bias, value)
    points, detector = some_points(), Detector(model, CPU, torch.float32)
    plain = model.detect(points, torch.zeros(500, dtype=torch.int64), 1)[0]
    for found in (plain, detector(points)):
        assert set(found.labels.tolist()) == {0, 1, 2}
        assert found.boxes.isfinite().all()
        assert (found.boxes[:, 3:5] <= MAX_SIZE).all()
        assert (found.boxes[:, 5] <= MAX_HEIGHT).all()


@both_ways
@pytest.mark.parametrize("branch", ["score", "location", "vertical"])
@pytest.mark.parametrize("regression", ["corners", "pose"])
def test_what_is_not_a_number_is_not_reported(demo: Config, regression: str, branch: str) -> None:
    """The anchors of one orientation give NaN: the others are reported as if those did not exist."""
    model = lively(demo, regression=regression, score_threshold=0.02, candidates=30)
    without = copy.deepcopy(model)
    for head, other in zip(model.heads, without.heads, strict=True):
        bias = getattr(head, branch).bias
        torch.nn.init.constant_(bias[: len(bias) // 4], math.nan)
        if branch == "score":
            torch.nn.init.constant_(other.score.bias[:1], -100.0)
    points, sample = some_points(), torch.zeros(500, dtype=torch.int64)
    detector = Detector(model, CPU, torch.float32)
    plain = model.detect(points, sample, 1)[0]
    for found in (plain, detector(points)):
        assert len(found.boxes) > 5
        assert found.boxes.isfinite().all()
        assert found.scores.isfinite().all()
        same(found, plain)
    if branch == "score":
        same(plain, without.detect(points, sample, 1)[0])


@both_ways
@pytest.mark.parametrize("branch", ["score", "location", "vertical"])
def test_nothing_but_nan(demo: Config, branch: str) -> None:
    model = lively(demo, score_threshold=0.02)
    for head in model.heads:
        torch.nn.init.constant_(getattr(head, branch).bias, math.nan)
    points, detector = some_points(), Detector(model, CPU, torch.float32)
    plain = model.detect(points, torch.zeros(500, dtype=torch.int64), 1)[0]
    for found in (plain, detector(points)):
        assert found.boxes.shape == (0, 7)


# --- many threads ----------------------------------------------------------------------------------------------------


@pytest.fixture
def many_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "force_many_threads", True)


def both(detector: Detector, clouds: list[Tensor], monkeypatch: pytest.MonkeyPatch) -> list[list[Detections]]:
    """What a detector finds with one thread, and with many."""
    found = []
    for many in (False, True):
        monkeypatch.setattr(launch, "force_many_threads", many)
        found.append(detector.batch(clouds))
    return found


@pytest.mark.parametrize("candidates", [1, 7, 100, 10**6])
def test_equal_scores_at_the_border_of_the_candidates(
    demo: Config, candidates: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lower anchors are taken: all scores are one of two values."""
    model = lively(demo, candidates=candidates, detections=10**6, score_threshold=0.2)
    for head in model.heads:
        torch.nn.init.zeros_(head.score.weight)
        torch.nn.init.constant_(head.score.bias, 0.0)
        torch.nn.init.constant_(head.score.bias[1:2], 1.0)
    (one,), (many,) = both(Detector(model, CPU, torch.float32), [some_points()], monkeypatch)
    assert len(one.boxes) >= 3
    same(many, one)


def test_no_score_above_the_threshold(demo: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    model = lively(demo, score_threshold=0.999999)
    for found in both(Detector(model, CPU, torch.float32), [some_points(), some_points(7)], monkeypatch):
        assert [each.boxes.shape for each in found] == [(0, 7)] * 2


def test_no_more_than_the_detections_are_reported(demo: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    model = lively(demo, score_threshold=0.0, candidates=300, detections=4)
    one, many = both(Detector(model, CPU, torch.float32), [some_points(), some_points(900, 3)], monkeypatch)
    for found, want in zip(many, one, strict=True):
        same(found, want)
        assert found.labels.bincount().tolist() == [4, 4, 4]


@pytest.mark.usefixtures("many_threads")
def test_the_capacity_changes_no_bit(demo: Config) -> None:
    """In the smallest frame, in one that a larger cloud has been in, and in the frame of larger clouds."""
    detector = Detector(lively(demo, score_threshold=0.02), CPU, torch.float32)
    points = some_points(700)
    alone = detector(points)
    assert len(alone.boxes) > 5
    large = detector(some_points(8000, 5))
    assert not torch.equal(large.boxes, alone.boxes)
    detector.frames[1, 1024] = detector.frames.pop((1, 8192))
    for now, then in zip(detector(points), alone, strict=True):
        assert torch.equal(now, then)


@both_ways
def test_clouds_of_different_lengths_together(demo: Config) -> None:
    detector = Detector(lively(demo, score_threshold=0.02), CPU, torch.float32)
    clouds = [some_points(500), torch.zeros(0, 4), some_points(1300, 1), some_points(1, 2)]
    for found, cloud in zip(detector.batch(clouds), clouds, strict=True):
        same(found, detector(cloud))


@pytest.mark.usefixtures("many_threads")
def test_the_last_frames_are_kept(demo: Config) -> None:
    """No more than MAX_GRAPHS of them, the latest; each still gives what it gave."""
    detector = Detector(lively(demo, score_threshold=0.02), CPU, torch.float32)
    first = detector(some_points())
    for exponent in range(11, 11 + MAX_GRAPHS):
        detector(some_points(2**exponent))
    assert [capacity for _, capacity in detector.frames] == [2**exponent for exponent in range(11, 11 + MAX_GRAPHS)]
    same(detector(some_points()), first, 1e-6)
    assert len(detector.frames) == MAX_GRAPHS


@pytest.mark.usefixtures("many_threads")
def test_pillars_detect_with_many_threads(pillars: Path, street: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """An encoder that is not fused, and reads the device."""
    model = model_from_checkpoint(load_checkpoint(pillars), "pillars")
    head = dataclasses.replace(model.config.head, score_threshold=0.0, candidates=50)
    model.config = dataclasses.replace(model.config, head=head)
    (one,), (many,) = both(Detector(model, CPU, torch.float32), [street[:5000]], monkeypatch)
    assert len(one.boxes) > 20
    same(many, one)


READS = {
    "_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "_unique2", "unique_consecutive",
    "bincount", "repeat_interleave", "lift_fresh",
}  # fmt: skip
"""Ops that wait for the device, whose size depends on the data, or that bring a constant of the host to the device."""


class NoReads(TorchDispatchMode):
    """Fails on an op that a CUDA graph cannot hold; looks into the project's own ops too."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        space, name = func._schema.name.split("::")
        self.seen.add(name)
        if space == "hvnet":
            with self:
                return OPDEFS[func._schema.name]._init_fn(*args, **(kwargs or {}))
        assert name not in READS, name
        if name.startswith("index"):
            assert all(index is None or index.dtype != torch.bool for index in args[1]), "a mask"
        return func(*args, **(kwargs or {}))


@pytest.mark.usefixtures("many_threads")
@pytest.mark.parametrize(("changes", "height"), [
    ({}, "none"),
    ({}, "found"),
    ({"encoder.flat_ground": "true"}, "found"),
    ({"encoder.flat_ground": "true"}, 1.5),
    ({"head.iou": "true", "head.direction": "true", "head.regression": "pose"}, "found"),
])  # fmt: skip
def test_a_frame_reads_nothing_from_the_device(changes: dict[str, str], height: Any) -> None:
    config = load_config(CONFIGS / "demo.yaml", [*NARROW, *(f"{key}={value}" for key, value in changes.items())])
    detector = Detector(lively(config, score_threshold=0.02), CPU, ground=-1.7, sensor_height=height, all_round=True)
    clouds = [some_points(), some_points(900, 1)]
    want = detector.batch(clouds)
    frame = next(iter(detector.frames.values()))
    mode = NoReads()
    with torch.no_grad(), mode:
        row = detector.numbers(*frame.split(frame.buffer), frame.sample)
    assert {"topk", "nms_groups", "baddbmm"} <= mode.seen
    size = (2 * len(detector.turns), 3, detector.steps.kept, 10)
    table = row[: math.prod(size)].view(size)
    assert len(row) - math.prod(size) == 2 * len(clouds) + 2 * 14**2 * detector.is_flat
    assert len(want[0].boxes) > 0
    assert sum(len(each.boxes) for each in detections(table)) >= sum(len(each.boxes) for each in want)
    with pytest.raises(AssertionError, match="a mask"), mode:
        row[row > 0]
    with pytest.raises(AssertionError, match="_local_scalar_dense"), mode:
        float(row[0])


@pytest.mark.cuda
@pytest.mark.usefixtures("plain_float32")
def test_the_graph_gives_the_same_boxes(demo: Config, device: torch.device) -> None:
    if device.type != "cuda":
        pytest.skip("CUDA graphs need a GPU")
    model = lively(demo, score_threshold=0.05, candidates=100)
    detector, plain = Detector(model, device, torch.float32), Detector(model, CPU, torch.float32)
    for count in (500, 400, 1500, 0, 500):
        same(detector(some_points(count, count)), plain(some_points(count, count)), 1e-3)


@both_ways
@pytest.mark.parametrize("points", [torch.zeros(0, 4), torch.tensor([[5.0, 0, -1, 0]]), torch.full((3, 4), math.nan)])
def test_detector_takes_any_cloud(demo: Config, points: Tensor) -> None:
    found = Detector(HVNet(demo), torch.device("cpu"))(points)
    assert found.boxes.shape[1:] == (7,)
    assert len(found.boxes) == len(found.scores) == len(found.labels)


@both_ways
def test_detector_refuses_other_shapes(demo: Config) -> None:
    with pytest.raises(ValueError, match=r"points: want shape \(N, 4\).*got \(5, 3\)"):
        Detector(HVNet(demo), torch.device("cpu"))(torch.zeros(5, 3))


@both_ways
def test_papers_configuration_on_a_real_frame(kitti_root: Path) -> None:
    torch.manual_seed(0)
    config = load_config(CONFIGS / "hvnet.yaml")
    config = dataclasses.replace(config, head=dataclasses.replace(config.head, score_threshold=0.0))
    frame = read_frame(kitti_root, "000008")
    found = Detector(HVNet(config), torch.device("cpu"))(frame.points)
    assert set(found.labels.tolist()) == {0, 1, 2}
    assert found.boxes.isfinite().all()
    assert ((found.scores > 0) & (found.scores < 1)).all()


@both_ways
def test_checkpoint_gives_the_same_boxes(demo: Config, tmp_path: Path) -> None:
    torch.manual_seed(0)
    model = HVNet(demo).eval()
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"config": config_to_dict(demo), "model": model.state_dict()})
    again = load(path, "cpu")
    assert again.config == demo
    want = Detector(model, torch.device("cpu"))(some_points())
    for a, b in zip(again(some_points().numpy()), want, strict=True):
        assert torch.equal(a, b)


def test_bad_checkpoints(demo: Config, tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    with pytest.raises(InputError, match=r"checkpoint\.pt: no such checkpoint"):
        load(path)
    model = HVNet(demo)
    save_checkpoint(path, {"config": config_to_dict(demo), "model": model.state_dict()})
    whole = path.read_bytes()
    for size in (0, 10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"checkpoint\.pt: truncated"):
            load(path)
    torch.save({"weights": 1}, path)
    with pytest.raises(InputError, match="holds no config and model"):
        load(path)
    wider = config_to_dict(load_config(CONFIGS / "demo.yaml", [*NARROW, "encoder.image_channels=48"]))
    save_checkpoint(path, {"config": wider, "model": model.state_dict()})
    with pytest.raises(InputError, match="do not fit its config"):
        load(path)
    torch.save({"config": config_to_dict(demo), "model": ClassConfig}, path)
    with pytest.raises(InputError, match="truncated, or no checkpoint"):
        load(path)


# --- clouds of other sensors -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def street(kitti_root: Path) -> Tensor:
    """What KITTI's camera sees of a real frame."""
    return read_frame(kitti_root, "000008").points


def agree(found: Detections, want: Detections, labelled: Tensor | None = None) -> None:
    """The same sure boxes, but for the rounding of coordinates that were moved or turned.

    With `labelled` boxes (M, 7) headings are compared of these alone: what is no object has no front.
    """
    sure = want.select(want.scores > 0.5)
    iou = rotated_iou_bev(sure.boxes, found.boxes)
    best, which = iou.max(dim=1)
    assert len(sure.boxes) >= 5
    assert (best > 0.9).float().mean() > 0.8
    close = best > 0.9
    torch.testing.assert_close(found.boxes[which][close][:, 2], sure.boxes[close][:, 2], rtol=0, atol=0.1)
    turn = (found.boxes[which][close][:, 6] - sure.boxes[close][:, 6]).cos()
    assert turn.abs().min() > 0.99
    if labelled is not None:
        turn = turn[rotated_iou_bev(sure.boxes[close], labelled).amax(dim=1) > 0.5]
        assert len(turn) >= 5
    assert (turn > 0).float().mean() > 0.9  # a heading that is nearly a tie may be the other one


@both_ways
@pytest.mark.parametrize("height", [-5.0, 1.33, 4.0, 60.0])
def test_a_cloud_at_another_height_is_moved_and_its_boxes_are_moved_back(street: Tensor, height: float) -> None:
    moved = street + torch.tensor([0, 0, height, 0])
    want = load(device="cpu")(street)
    want = want._replace(boxes=want.boxes + torch.tensor([0, 0, height, 0, 0, 0, 0]))
    agree(load(device="cpu")(moved), want)
    if -height + 1.66 >= 0:
        agree(load(device="cpu", sensor_height=1.66 - height)(moved), want)
    left = load(device="cpu", sensor_height="none")(moved)
    assert len(left.select(left.scores > 0.5).boxes) < len(want.select(want.scores > 0.5).boxes) / 2


@both_ways
def test_a_cloud_at_the_usual_height_is_left_alone(street: Tensor) -> None:
    want = on_ground(flat=False, sensor_height="none")(street)
    for found in (on_ground(flat=False)(street), on_ground(flat=False, sensor_height=1.73)(street)):
        for column, wanted in zip(found, want, strict=True):
            assert torch.equal(column, wanted)
    detector = load(device="cpu")
    look = detector.look(street)
    assert (look.points, look.shift, look.reason) == (len(street), 0.0, "")
    assert look.ground == pytest.approx(-1.66, abs=0.1)
    assert detector.look(street + torch.tensor([0, 0, 1.33, 0])).shift == pytest.approx(-1.33, abs=0.1)


@both_ways
@pytest.mark.parametrize(("degrees", "flat"), [(-90.0, True), (180.0, True), (-90.0, False), (37.0, False)])
def test_a_turned_cloud(street: Tensor, degrees: float, flat: bool) -> None:
    """A sensor whose forward is elsewhere: `turn` brings it to x. At 37 degrees the cells of the ground are others."""
    mounted = turned(street, math.radians(-degrees))
    want = on_ground(flat)(street)
    boxes = turned(want.boxes, math.radians(-degrees))
    boxes[:, 6] -= math.radians(degrees)
    agree(on_ground(flat, turn=degrees)(mounted), want._replace(boxes=boxes))


@both_ways
def test_all_round(street: Tensor) -> None:
    """What is behind is found as well as what is in front, each object once, the best of a class first.

    The ground stays as it is: the street falls as much as it rises here, and a plane fits one of both.
    """
    both = torch.cat((street, turned(street, math.pi)))
    want = on_ground(flat=False)(street)
    detector = on_ground(flat=False, all_round=True)
    assert len(detector.turns) == 4
    found = detector(both)
    agree(found, want)
    behind = turned(want.boxes, math.pi)
    behind[:, 6] += math.pi
    agree(found, want._replace(boxes=behind))
    for label in range(3):
        own = found.select(found.labels == label)
        assert (own.scores.diff() <= 0).all()
        iou = rotated_iou_bev(own.boxes, own.boxes).fill_diagonal_(0)
        assert iou.max() <= detector.entries[label].nms_iou + 1e-6
        assert len(own.boxes) <= detector.config.head.detections
    assert (found.labels.diff() >= 0).all()
    assert detector.look(both).in_range > 1.8 * load(device="cpu").look(both).in_range


@both_ways
def test_clouds_at_different_heights_together(street: Tensor) -> None:
    """As if each were alone."""
    clouds = [street, street + torch.tensor([0, 0, 1.33, 0]), turned(street, math.pi)]
    for options in ({}, {"all_round": True, "turn": 10.0}):
        detector = load(device="cpu", **options)  # type: ignore[arg-type]
        for found, cloud in zip(detector.batch(clouds), clouds, strict=True):
            same(found, detector(cloud), 1e-3)


def on_ground(flat: bool = True, ground: float | None = -1.645, **options: Any) -> Detector:
    """The shipped weights with clouds that are flattened, or as they are, however they were trained."""
    model = model_from_checkpoint(load_checkpoint(find_checkpoint(None)), "shipped")
    model.config = dataclasses.replace(
        model.config, encoder=dataclasses.replace(model.config.encoder, flat_ground=flat)
    )
    return Detector(model, CPU, torch.float32, ground=ground, **options)


def sloped(rows: Tensor) -> Tensor:
    """Points or boxes on a road that rises by 0.4 % along x and falls by 0.3 % along y, from 0.2 m on."""
    return torch.cat(
        (rows[:, :2], rows[:, 2:3] + rows[:, :2] @ torch.tensor([[0.004], [-0.003]]) + 0.2, rows[:, 3:]), 1
    )


@both_ways
@pytest.mark.parametrize("options", [{}, {"all_round": True, "turn": 20.0}, {"sensor_height": 1.645}])
def test_a_slope_is_taken_out_and_put_back(kitti_root: Path, options: dict[str, Any]) -> None:
    frame = read_frame(kitti_root, "000008")
    want = on_ground(**options)(frame.points)
    found = on_ground(**options)(sloped(frame.points))
    agree(found, want._replace(boxes=sloped(want.boxes)), frame.boxes_of(["Car"]))


@both_ways
def test_all_round_finds_the_cars_of_the_front_on_any_ground(kitti_root: Path) -> None:
    """As the frame is, on level ground, and with either raised: the labelled cars that the front view finds, in the
    sensor's axes."""
    frame = read_frame(kitti_root, "000008")
    assert frame.objects is not None
    cars = frame.objects.boxes[[name == "Car" for name in frame.objects.names]].float()
    front, all_round = load(device="cpu"), load(device="cpu", all_round=True)
    assert front.is_flat
    assert all_round.is_flat
    level = flatten(frame.points, cars, -1.9, front.config.encoder.point_range)
    assert (level[1] - cars)[:, 2].abs().max() > 0.2
    for points, labelled in ((frame.points, cars), level):
        for height in (0.0, 1.33):
            up = torch.tensor([0, 0, height, 0])
            want = labelled + torch.tensor([0, 0, height, 0, 0, 0, 0])
            seen = [found.select((found.labels == 0) & (found.scores > 0.5)).boxes
                    for found in (front(points + up), all_round(points + up))]  # fmt: skip
            overlaps = [rotated_iou_bev(want, boxes) for boxes in seen]
            of_front = overlaps[0].amax(dim=1) > 0.5
            assert of_front.sum() >= 4
            assert (overlaps[1].amax(dim=1) > 0.5)[of_front].all()
            for overlap, boxes in zip(overlaps, seen, strict=True):
                z = boxes[overlap.argmax(dim=1)][:, 2]
                torch.testing.assert_close(z[of_front], want[of_front][:, 2], rtol=0, atol=0.2)


@both_ways
@pytest.mark.parametrize("options", [{"ground": None}, {"sensor_height": "none"}])
def test_a_slope_stays_where_no_ground_is_asked_for(street: Tensor, options: dict[str, Any]) -> None:
    detector = on_ground(**options)
    assert detector.place(sloped(street)).relief is None
    for column, wanted in zip(detector(sloped(street)), on_ground(flat=False, **options)(sloped(street)), strict=True):
        assert torch.equal(column, wanted)


@both_ways
def test_clouds_on_different_slopes_together(street: Tensor) -> None:
    """As if each were alone; the last two have no ground."""
    clouds = [street, sloped(street), street[:9000] + torch.tensor([0, 0, 2.0, 0]), street[:5], street[:0]]
    for options in ({}, {"all_round": True}):
        detector = on_ground(**options)
        for found, cloud in zip(detector.batch(clouds), clouds, strict=True):
            same(found, detector(cloud), 1e-3)


def test_many_threads_flatten_as_one(street: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    clouds = [sloped(street), street[:12000]]
    one, many = both(on_ground(), clouds, monkeypatch)
    for found, want in zip(many, one, strict=True):
        same(found, want, 1e-3)


@pytest.mark.parametrize(("point_range", "turns"), [
    ((0, -32, -3, 64, 32, 2), 4),
    ((0, -40, -3, 70.4, 40, 1), 4),
    ((0, -64, -3, 64, 64, 2), 2),
    ((0, -10, -3, 64, 10, 2), 14),
    ((-38.4, -38.4, -3, 38.4, 38.4, 2), 1),
    ((-64, -32, -3, 64, 32, 2), 4),
])  # fmt: skip
def test_turns_all_round(point_range: tuple[float, ...], turns: int) -> None:
    assert turns_all_round(point_range) == turns
    reach = 2 / 3 * point_range[3]
    assert turns == 1 or reach * math.sin(math.pi / turns) <= point_range[4]


def test_a_range_beside_the_sensor_cannot_look_all_round() -> None:
    with pytest.raises(InputError, match=r"point_range \[0, 1, -3, 64, 32, 2\]: is not around the x axis"):
        turns_all_round((0, 1, -3, 64, 32, 2))


@both_ways
def test_a_model_trained_without_reflectance_gets_none(demo: Config) -> None:
    model = lively(demo, score_threshold=0.02)
    points = some_points(400)
    dark = points.clone()
    dark[:, 3] = 0
    same(
        Detector(model, CPU, torch.float32, reflectance=False)(points), Detector(model, CPU, torch.float32)(dark), 1e-6
    )


@both_ways
def test_without_the_ground_of_the_training_data_nothing_is_moved(demo: Config, street: Tensor) -> None:
    """A checkpoint of an earlier version does not know it."""
    detector = Detector(lively(demo), CPU)
    assert detector.look(street + torch.tensor([0, 0, 1.33, 0])).shift == 0


@both_ways
def test_points_of_any_array(demo: Config) -> None:
    detector = Detector(lively(demo, score_threshold=0.02), CPU, torch.float32)
    points = some_points(400)
    want = detector(points)
    array = points.numpy()
    locked = array.copy()
    locked.flags.writeable = False
    for each in (array.astype(">f8"), array[::-1].copy()[::-1], locked, np.asfortranarray(array)):
        same(detector(each), want, 1e-6)
    with pytest.raises(ValueError, match="it is transposed"):
        detector(array.T)
    bright = points.clone()
    bright[:, 3] *= 255
    with pytest.raises(ValueError, match=r"want a reflectance from 0 to 1, got 2\d\d"):
        detector(bright)


@pytest.mark.parametrize(("options", "shift", "seen"), [
    ({}, 0.0, (0, -32, -3, 64, 32, 2)),
    ({}, -1.5, (0, -32, -1.5, 64, 32, 3.5)),
    ({"turn": -90.0}, 0.0, (-32, 0, -3, 32, 64, 2)),
    ({"all_round": True}, 1.0, (-64, -64, -4, 64, 64, 1)),
])  # fmt: skip
def test_seen_range(options: dict, shift: float, seen: tuple[float, ...]) -> None:
    assert load(device="cpu", **options).seen_range(shift) == pytest.approx(seen, abs=1e-9)


def test_nothing_is_lost_between_two_looks(street: Tensor) -> None:
    """Every sure car is found wherever it lies, on the border of two looks too; its box may change with the angle."""
    sure = load(device="cpu")(street)
    sure = sure.select((sure.scores > 0.6) & (sure.labels == 0))
    assert len(sure.boxes) >= 3
    overlaps = []
    for box in sure.boxes:
        azimuth = math.degrees(math.atan2(box[1], box[0]))
        for beside in (-1.0, 0.0, 1.0):
            found = load(device="cpu", all_round=True, turn=45 - azimuth + beside)(street)
            overlaps.append(rotated_iou_bev(box[None], found.boxes[found.labels == 0]).max())
    assert min(overlaps) > 0.3
    assert (torch.stack(overlaps) > 0.5).float().mean() > 0.9


@pytest.mark.parametrize("options", [
    {"sensor_height": math.nan}, {"sensor_height": "1.7"}, {"sensor_height": None}, {"sensor_height": True},
    {"turn": math.nan}, {"turn": "90"}, {"turn": None},
])  # fmt: skip
def test_options_that_are_no_numbers(options: dict) -> None:
    with pytest.raises(ValueError, match=f"^{next(iter(options))}: want "):
        load(device="cpu", **options)


@pytest.mark.parametrize("facts", [None, [1.0], {"ground": "x"}, {"ground": math.nan}, {"reflectance_scale": "255"}])
def test_damaged_facts_on_the_sensor(facts: object, tmp_path: Path) -> None:
    content = load_checkpoint(find_checkpoint(None)) | {"sensor": facts}
    save_checkpoint(tmp_path / "damaged.pt", content)
    with pytest.raises(InputError, match=r"damaged\.pt: its facts on the sensor are damaged"):
        load(tmp_path / "damaged.pt", "cpu")


def test_a_checkpoint_without_facts_on_the_sensor(tmp_path: Path, street: Tensor) -> None:
    """As version 0.1.0 wrote it: nothing is moved, and a height that would mean nothing is refused."""
    content = load_checkpoint(find_checkpoint(None))
    del content["sensor"]
    save_checkpoint(tmp_path / "old.pt", content)
    assert load(tmp_path / "old.pt", "cpu").look(street + torch.tensor([0, 0, 1.33, 0])).shift == 0
    with pytest.raises(InputError, match=r"old\.pt: does not know the ground of its training data"):
        load(tmp_path / "old.pt", "cpu", sensor_height=1.8)
