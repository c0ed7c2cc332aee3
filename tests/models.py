"""Small models that several tests share."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from hvnet.config import Config, config_to_dict, load_config
from hvnet.network.anchors import Anchors, Targets, assign_targets
from hvnet.network.checkpoint import save_checkpoint
from hvnet.network.model import HVNet

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
COARSE = ["encoder.voxel_size=[0.4, 0.4]", "loss.beta=1.0"]
NARROW = [*COARSE, "encoder.point_range=[0, -3.2, -3, 12.8, 3.2, 2]"]  # not square: 32 x 16 cells at the finest scale
TINY = [
    *COARSE,
    "encoder.point_range=[0, -6.4, -3, 25.6, 6.4, 2]",
    "encoder.feature_channels=4",
    "encoder.image_channels=8",
    "backbone.widths=[8, 8, 8]",
    "backbone.layers=[2, 2, 2]",
    "backbone.fusion_channels=8",
]
SMALL = [*TINY, "head.score_threshold=0.0", "head.candidates=50", "head.detections=5"]
QUICK = ["train.bfloat16=false", "train.batch_size=2", "synthetic={train_frames: 4, val_frames: 2}"]
SHORT = [
    *TINY,
    "head.score_threshold=0.001",
    "head.candidates=50",
    "head.detections=5",
    "train.epochs=2",
    "train.batch_size=2",
    "train.warmup_steps=3",
    "train.decay_epochs=[1]",
    "train.validate_every=1",
    "train.pictures=1",
]
"""A run of seconds, of the demo's config."""


def match_class(
    anchors: Tensor,
    boxes: Sequence[Tensor],
    positive_iou: float,
    negative_iou: float,
    regression: str = "corners",
) -> Targets:
    """Targets of anchors (A, 7) for the boxes (M_b, 7) of every sample, all of one class."""
    entry = load_config(CONFIGS / "demo.yaml").head.classes[0]
    entry = dataclasses.replace(entry, positive_iou=positive_iou, negative_iou=negative_iou)
    labels = [torch.zeros(len(own), dtype=torch.int64) for own in boxes]
    return assign_targets(Anchors([anchors], [entry]), boxes, labels, regression)


def save_untrained(path: Path, changes: Sequence[str], seed: int = 0) -> None:
    """Writes the checkpoint of an untrained demo model whose scores differ from anchor to anchor."""
    torch.manual_seed(seed)
    config = load_config(CONFIGS / "demo.yaml", changes)
    model = HVNet(config)
    for head in model.heads:
        torch.nn.init.normal_(head.score.weight, std=0.05)
    save_checkpoint(path, {"config": config_to_dict(config), "model": model.state_dict()})


def lively(config: Config, **head: object) -> HVNet:
    """A model whose maps differ from anchor to anchor, and whose batch norms do something; `head` changes its head."""
    torch.manual_seed(0)
    model = HVNet(dataclasses.replace(config, head=dataclasses.replace(config.head, **head)))  # type: ignore[arg-type]
    for each in model.heads:
        for branch in (each.score, each.location, each.vertical):
            torch.nn.init.normal_(branch.weight, std=0.05)
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
            torch.nn.init.uniform_(module.bias, -0.5, 0.5)
            module.momentum = 1.0
    with torch.no_grad():
        model.maps(*some_clouds(2), 2)
    return model.eval()


def some_points(count: int = 500, seed: int = 0) -> Tensor:
    """Random points (N, 4) in the range of NARROW."""
    low, high = torch.tensor([0.0, -3.2, -3.0, 0.0]), torch.tensor([12.8, 3.2, 2.0, 1.0])
    return low + torch.rand(count, 4, generator=torch.Generator().manual_seed(seed)) * (high - low)


def some_clouds(count: int, points: int = 500) -> tuple[Tensor, Tensor]:
    """Random points (count * points, 4) in the range of NARROW, and the clouds that they belong to."""
    return some_points(count * points, seed=count), torch.arange(count).repeat_interleave(points)
