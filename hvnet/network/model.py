"""HVNet: encoder, backbone and one head a class; `forward` returns the loss, `detect` boxes."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from hvnet.config import Config, EncoderConfig
from hvnet.kernels.rotated import rotated_nms
from hvnet.network.anchors import Anchors, assign_targets, decode, make_anchors, positives_per_box
from hvnet.network.backbone import Backbone
from hvnet.network.encoder import HybridVoxelEncoder
from hvnet.network.grids import projection_grids
from hvnet.network.head import Head, HeadMaps, scores_of
from hvnet.network.loss import total_loss
from hvnet.network.pillars import PillarEncoder


class Detections(NamedTuple):
    """Boxes of one cloud: class by class, within a class the best first."""

    boxes: Tensor  # (M, 7)
    scores: Tensor  # (M,)
    labels: Tensor  # (M,) int64, index into config.head.classes

    def select(self, rows: Tensor) -> "Detections":
        """The detections that a mask or an index tensor picks."""
        return Detections(self.boxes[rows], self.scores[rows], self.labels[rows])

    def names(self, classes: Sequence[str]) -> list[str]:
        """The classes (M,) by name."""
        return [classes[label] for label in self.labels.tolist()]


LOSS_TERMS = ("classification", "localization", "vertical", "direction", "iou")


def make_encoder(config: EncoderConfig) -> HybridVoxelEncoder | PillarEncoder:
    """The hybrid voxel encoder, or that of PointPillars."""
    if config.vfe == "pillar":
        grid = projection_grids(config)[0]
        return PillarEncoder(grid, config.image_channels, config.point_limit, config.voxel_limit)
    return HybridVoxelEncoder(config)


class HVNet(nn.Module):
    """The detector. A batch is all points (N, 4) of all samples in one tensor, and the sample (N,) of each point."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        self.encoder = make_encoder(config.encoder)
        self.backbone = Backbone(config.backbone, config.encoder.image_channels, len(config.encoder.projection_scales))
        self.heads = nn.ModuleList(Head(entry, self.backbone.channels, config.head) for entry in config.head.classes)
        self.log_variances = nn.ParameterDict()
        if config.loss.uncertainty:
            for name in LOSS_TERMS:
                if name not in ("direction", "iou") or getattr(config.head, name):
                    self.log_variances[name] = nn.Parameter(torch.zeros(()))
        classes = config.head.classes
        per_box = [positives_per_box(config, entry) for entry in classes]
        self.anchors = Anchors([make_anchors(config, entry) for entry in classes], classes, per_box)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, points: Tensor, sample: Tensor, boxes: list[Tensor], labels: list[Tensor]) -> dict[str, Tensor]:
        """Points (N, 4) of samples (N,), boxes (M_b, 7) and labels (M_b,) of every sample to the terms of the loss."""
        return self.loss(self.levels(self.encoder(points, sample, len(boxes))), boxes, labels)

    def levels(self, images: list[Tensor]) -> list[Tensor]:
        """Pseudo-images, finest first, to the levels of the pyramid (B, C, N_L, N_W) / 2^k."""
        with self.autocast(images[0].device):
            return self.backbone(images)

    def maps(self, points: Tensor, sample: Tensor, batch_size: int) -> list[HeadMaps]:
        """Points (N, 4) of samples (N,) to the maps of every class."""
        return self.maps_of(self.encoder(points, sample, batch_size))

    def maps_of(self, images: list[Tensor]) -> list[HeadMaps]:
        """Pseudo-images, finest first, to the maps of every class."""
        levels = self.levels(images)
        with self.autocast(images[0].device):
            return [head(levels[entry.level]) for head, entry in zip(self.heads, self.config.head.classes, strict=True)]

    def autocast(self, device: torch.device) -> torch.autocast:
        """In bfloat16 where a model is trained so."""
        return torch.autocast(device.type, torch.bfloat16, enabled=self.config.train.bfloat16 and self.training)

    def loss(self, levels: list[Tensor], boxes: list[Tensor], labels: list[Tensor]) -> dict[str, Tensor]:
        """Eq. 5: the terms summed over classes, for the boxes (M_b, 7) and labels (M_b,) of every sample.

        Only positive anchors have a box to learn, so that only theirs is calculated. With learnt weights a term L is
        exp(-s) L + s, s the logarithm of its variance (Kendall et al., CVPR 2018).
        """
        targets = assign_targets(self.anchors, boxes, labels, self.config.head.regression)
        heads = [cast(Head, head) for head in self.heads]
        at = [levels[entry.level] for entry in self.config.head.classes]
        with self.autocast(levels[0].device):
            logits = [head.logits(level) for head, level in zip(heads, at, strict=True)]
        found = [head.regress(level, rows) for head, level, rows in zip(heads, at, targets.rows, strict=True)]
        total = total_loss(logits, found, targets, self.config.head.classes, self.config.loss)
        for name, s in self.log_variances.items():
            total[name] = (-s).exp() * total[name] + s
        return total

    @torch.no_grad()
    def detect(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Detections]:
        """Boxes of every sample, in evaluation mode: scores above the threshold, then rotated NMS class by class.

        This is the plain way, in float32; `hvnet.network.detector` has the fast one.
        """
        if self.training:
            raise RuntimeError("detect: the model is in training mode; call eval() first")
        maps = self.maps(points, sample, batch_size)
        samples = []
        for b in range(batch_size):
            parts = [self._detect_class(label, of_class.of_sample(b)) for label, of_class in enumerate(maps)]
            samples.append(Detections(*(torch.cat(column) for column in zip(*parts, strict=True))))
        return samples

    def _detect_class(self, label: int, maps: HeadMaps) -> Detections:
        head = self.config.head
        scores = scores_of(maps.logits, maps.iou)
        at = (scores > head.score_threshold).nonzero().squeeze(1)
        best = torch.sort(scores[at], descending=True, stable=True).indices[: head.candidates]
        at = at[best]
        direction = None if maps.direction is None else maps.direction[at].argmax(dim=1)
        boxes = decode(maps.location[at], maps.vertical[at], direction, self.anchors(label)[at])
        finite = boxes.isfinite().all(dim=1)
        boxes, scores = boxes[finite], scores[at][finite]
        kept = rotated_nms(boxes, scores, head.classes[label].nms_iou)[: head.detections]
        return Detections(boxes[kept], scores[kept], torch.full_like(kept, label))
