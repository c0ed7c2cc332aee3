"""Detection head (Sec. 3.5): parallel 3x3 convolutions on a class's pyramid level."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hvnet.config import ClassConfig, HeadConfig
from hvnet.network.anchors import anchors_per_cell

PRIOR = 0.01  # probability of an object that an untrained head gives (RetinaNet)


class HeadMaps(NamedTuple):
    """The outputs of a head for the A anchors of its class, for every sample."""

    logits: Tensor  # (B, A)
    location: Tensor  # (B, A, 8) offsets of the corners in metres, or (B, A, 5), see `anchors.encode`
    vertical: Tensor  # (B, A, 2)
    direction: Tensor | None  # (B, A, 2) logits
    iou: Tensor | None = None  # (B, A) logits

    def of_sample(self, b: int) -> "HeadMaps":
        """The maps of one sample, without the first dimension."""
        return HeadMaps(*(None if part is None else part[b] for part in self))  # type: ignore[arg-type]


LOCATION_VALUES = {"corners": 8, "pose": 5}


class Head(nn.Module):
    """Branches phi_c, phi_l, phi_h of one class, and the optional two: two bins of direction, and the box's IoU."""

    def __init__(self, entry: ClassConfig, channels: int, config: HeadConfig) -> None:
        super().__init__()
        anchors = anchors_per_cell(entry)

        def branch(values: int) -> nn.Conv2d:
            return nn.Conv2d(channels, anchors * values, 3, padding=1)

        self.score = branch(1)
        self.location = branch(LOCATION_VALUES[config.regression])
        self.vertical = branch(2)
        self.direction = branch(2) if config.direction else None
        self.iou = branch(1) if config.iou else None
        nn.init.constant_(self.score.bias, -math.log((1 - PRIOR) / PRIOR))  # type: ignore[arg-type]

    def forward(self, level: Tensor) -> HeadMaps:
        """The class's pyramid level (B, C, N_L, N_W) to the outputs for its N_L * N_W * N_anc anchors."""
        return HeadMaps(
            anchor_rows(self.score(level), 1).squeeze(-1),
            anchor_rows(self.location(level), self.location.out_channels // self.score.out_channels),
            anchor_rows(self.vertical(level), 2),
            None if self.direction is None else anchor_rows(self.direction(level), 2),
            None if self.iou is None else anchor_rows(self.iou(level), 1).squeeze(-1),
        )


def scores_of(logits: Tensor, iou: Tensor | None) -> Tensor:
    """Scores in [0, 1] of the logits of a class, times the predicted IoU where there is one (supplement, Sec. 2)."""
    return logits.sigmoid() if iou is None else logits.sigmoid() * iou.sigmoid()


def anchor_rows(output: Tensor, values: int) -> Tensor:
    """A map (B, N_anc * values, N_L, N_W) as (B, N_L * N_W * N_anc, values) float32, the order of the anchors."""
    return output.permute(0, 2, 3, 1).reshape(output.shape[0], -1, values).to(torch.float32)
