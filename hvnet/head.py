"""Detection head (Sec. 3.5): parallel 3x3 convolutions on a class's pyramid level."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hvnet.anchors import anchors_per_cell
from hvnet.config import ClassConfig

PRIOR = 0.01  # probability of an object that an untrained head gives (RetinaNet)


class HeadMaps(NamedTuple):
    """What a head says of the A anchors of its class, for every sample."""

    logits: Tensor  # (B, A)
    corners: Tensor  # (B, A, 8) offsets of the corners in metres
    vertical: Tensor  # (B, A, 2)
    direction: Tensor | None  # (B, A, 2) logits

    def of_sample(self, b: int) -> "HeadMaps":
        """The maps of one sample, without the first dimension."""
        direction = None if self.direction is None else self.direction[b]
        return HeadMaps(self.logits[b], self.corners[b], self.vertical[b], direction)


class Head(nn.Module):
    """Branches phi_c, phi_l, phi_h of one class, and the optional two-bin direction branch."""

    def __init__(self, entry: ClassConfig, channels: int, direction: bool) -> None:
        super().__init__()
        anchors = anchors_per_cell(entry)
        self.score = nn.Conv2d(channels, anchors, 3, padding=1)
        self.corners = nn.Conv2d(channels, anchors * 8, 3, padding=1)
        self.vertical = nn.Conv2d(channels, anchors * 2, 3, padding=1)
        self.direction = nn.Conv2d(channels, anchors * 2, 3, padding=1) if direction else None
        nn.init.constant_(self.score.bias, -math.log((1 - PRIOR) / PRIOR))  # type: ignore[arg-type]

    def forward(self, level: Tensor) -> HeadMaps:
        """The class's pyramid level (B, C, N_L, N_W) to what is said of its N_L * N_W * N_anc anchors."""
        return HeadMaps(
            anchor_rows(self.score(level), 1).squeeze(-1),
            anchor_rows(self.corners(level), 8),
            anchor_rows(self.vertical(level), 2),
            None if self.direction is None else anchor_rows(self.direction(level), 2),
        )


def anchor_rows(output: Tensor, values: int) -> Tensor:
    """A map (B, N_anc * values, N_L, N_W) as (B, N_L * N_W * N_anc, values) float32, the order of the anchors."""
    return output.permute(0, 2, 3, 1).reshape(len(output), -1, values).to(torch.float32)
