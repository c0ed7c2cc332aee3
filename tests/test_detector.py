"""Inference: every stage against the plain model, clouds of any kind, checkpoints, and the shipped weights."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hvnet.config import ClassConfig, Config, config_to_dict, load_config
from hvnet.data.kitti import read_frame
from hvnet.exceptions import InputError
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.checkpoint import save_checkpoint
from hvnet.network.detector import Detector, fold_batch_norms, load, regress, regression_weight
from hvnet.network.head import Head
from hvnet.network.model import Detections, HVNet
from tests.models import CONFIGS, NARROW, lively, some_points

CPU = torch.device("cpu")


def same(found: Detections, want: Detections, tolerance: float = 1e-4) -> None:
    assert torch.equal(found.labels, want.labels)
    torch.testing.assert_close(found.scores, want.scores, rtol=tolerance, atol=tolerance)
    torch.testing.assert_close(found.boxes[:, :6], want.boxes[:, :6], rtol=tolerance, atol=tolerance)
    turn = found.boxes[:, 6] - want.boxes[:, 6]
    assert (turn.sin().abs() < 10 * tolerance).all()
    assert (turn.cos() > 0.9).all()


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


def test_arrays_of_fixed_size_give_the_same_boxes(demo: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """A GPU takes the best anchors, whatever their score, and marks those above the threshold: here on the CPU."""
    model = lively(demo, score_threshold=0.05, candidates=100)
    detector = Detector(model, CPU, torch.float32)
    points = some_points()
    want = detector(points)
    with torch.no_grad():
        levels, logits = detector.maps(points, torch.zeros(500, dtype=torch.int64), 1)
        detector.device = torch.device("cuda")  # from here on as on a GPU
        candidates = detector.candidates(levels, logits)
    assert all(len(each.boxes) == 100 for each in candidates[0])
    assert any(not each.valid.all() for each in candidates[0])
    found = detector.suppress(candidates)[0]
    assert len(want.boxes) > 3
    same(found, want, 1e-6)


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
    found = regress(level[0], at, regression_weight(head), 8)
    torch.testing.assert_close(found, want[at], rtol=1e-5, atol=1e-5)


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


def test_training_does_not_change_a_detector(demo: Config) -> None:
    model = lively(demo, score_threshold=0.05)
    detector = Detector(model, CPU)
    before = detector(some_points())
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(1.5)
    for now, then in zip(detector(some_points()), before, strict=True):
        assert torch.equal(now, then)


@pytest.mark.cuda
def test_the_graph_gives_the_same_boxes(demo: Config, device: torch.device) -> None:
    if device.type != "cuda":
        pytest.skip("CUDA graphs need a GPU")
    model = lively(demo, score_threshold=0.05, candidates=100)
    detector, plain = Detector(model, device, torch.float32), Detector(model, CPU, torch.float32)
    for count in (500, 400, 1500, 0, 500):
        same(detector(some_points(count, count)), plain(some_points(count, count)), 1e-3)


@pytest.mark.parametrize("points", [torch.zeros(0, 4), torch.tensor([[5.0, 0, -1, 0]]), torch.full((3, 4), math.nan)])
def test_detector_takes_any_cloud(demo: Config, points: Tensor) -> None:
    found = Detector(HVNet(demo), torch.device("cpu"))(points)
    assert found.boxes.shape[1:] == (7,)
    assert len(found.boxes) == len(found.scores) == len(found.labels)


def test_detector_refuses_other_shapes(demo: Config) -> None:
    with pytest.raises(ValueError, match=r"points: want shape \(N, 4\).*got \(5, 3\)"):
        Detector(HVNet(demo), torch.device("cpu"))(torch.zeros(5, 3))


def test_papers_configuration_on_a_real_frame(kitti_root: Path) -> None:
    torch.manual_seed(0)
    config = load_config(CONFIGS / "hvnet.yaml")
    config = dataclasses.replace(config, head=dataclasses.replace(config.head, score_threshold=0.0))
    frame = read_frame(kitti_root, "000008")
    found = Detector(HVNet(config), torch.device("cpu"))(frame.points)
    assert set(found.labels.tolist()) == {0, 1, 2}
    assert found.boxes.isfinite().all()
    assert ((found.scores > 0) & (found.scores < 1)).all()


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
