"""Detection head (Sec. 3.5): parallel 3x3 convolutions on a class's pyramid level."""

import copy
import math
from collections.abc import Sequence
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


class Regressed(NamedTuple):
    """What the branches but the score's give for P anchors: in training for the positive ones alone."""

    location: Tensor  # (P, 8) or (P, 5)
    vertical: Tensor  # (P, 2)
    direction: Tensor | None  # (P, 2) logits
    iou: Tensor | None  # (P,) logits


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

    def logits(self, level: Tensor) -> Tensor:
        """The class's pyramid level (B, C, N_L, N_W) to the logits (B, A) of its A = N_L * N_W * N_anc anchors."""
        return anchor_rows(self.score(level), 1).squeeze(-1)

    def regress(self, level: Tensor, chosen: Tensor) -> Regressed:
        """What the other branches give for the chosen ones (P,) of the B * A anchors of a level (B, C, N_L, N_W)."""
        optional = [branch for branch in (self.direction, self.iou) if branch is not None]
        branches = [self.location, self.vertical, *optional]
        anchors = self.score.out_channels
        values = regress(level, chosen, weight_of(branches, anchors), anchors)
        sizes = [branch.out_channels // anchors for branch in branches]
        location, vertical, *rest = values.split(sizes, dim=1)
        direction = None if self.direction is None else rest.pop(0)
        return Regressed(location, vertical, direction, None if self.iou is None else rest.pop(0).squeeze(1))

    def forward(self, level: Tensor) -> HeadMaps:
        """The class's pyramid level (B, C, N_L, N_W) to the outputs for all of its anchors."""
        return HeadMaps(
            self.logits(level),
            anchor_rows(self.location(level), self.location.out_channels // self.score.out_channels),
            anchor_rows(self.vertical(level), 2),
            None if self.direction is None else anchor_rows(self.direction(level), 2),
            None if self.iou is None else anchor_rows(self.iou(level), 1).squeeze(-1),
        )


class ScoreMaps(nn.Module):
    """The score and IoU branches of all classes, for inference: one convolution a pyramid level.

    A branch has so few channels that several together take hardly more time than one.
    """

    def __init__(self, heads: Sequence[Head], levels: Sequence[int]) -> None:
        """levels: the pyramid level of every head."""
        super().__init__()
        self.level_of_class = [str(level) for level in levels]  # keys of `layers`
        self.channels: list[list[slice]] = []
        """Of every class, in its level's convolution: those of the score, those of the IoU."""
        branches: dict[str, list[nn.Conv2d]] = {level: [] for level in self.level_of_class}
        for head, level in zip(heads, self.level_of_class, strict=True):
            self.channels.append([])
            for branch in (head.score, head.iou):
                if branch is not None:
                    first = sum(each.out_channels for each in branches[level])
                    self.channels[-1].append(slice(first, first + branch.out_channels))
                    branches[level].append(branch)
        self.layers = nn.ModuleDict({level: join_convolutions(own) for level, own in branches.items()})

    def forward(self, levels: Sequence[Tensor]) -> list[list[Tensor]]:
        """Pyramid levels (B, C, N_L, N_W) / 2^k to the logits (B, N_anc, N_L, N_W) of every class: score, IoU."""
        maps = {level: layer(levels[int(level)]) for level, layer in self.layers.items()}
        return [
            [maps[level][:, part] for part in parts]
            for level, parts in zip(self.level_of_class, self.channels, strict=True)
        ]

    def score_bias(self, label: int) -> Tensor:
        """The bias (N_anc,) of a class's score branch: a view, so that writing to it changes the layer."""
        bias = self.layers[self.level_of_class[label]].get_parameter("bias")
        return bias.data[self.channels[label][0]]


def join_convolutions(branches: Sequence[nn.Conv2d]) -> nn.Conv2d:
    """Branches of heads as one convolution, whose outputs are theirs, one after the other."""
    layer = copy.deepcopy(branches[0])  # a new one would draw its weights, and so change what training draws next
    layer.out_channels = sum(branch.out_channels for branch in branches)
    weight = torch.cat([branch.weight.detach() for branch in branches])
    layer.weight = nn.Parameter(weight.contiguous(memory_format=torch.channels_last))
    layer.bias = nn.Parameter(torch.cat([branch.get_parameter("bias").detach() for branch in branches]))
    return layer


def weight_of(branches: Sequence[nn.Conv2d], anchors: int) -> Tensor:
    """Branches of a head as one matrix (9 C + 1, N_anc * values) float32: 3 x 3 cells, then the bias."""
    parts = []
    for branch in branches:
        assert branch.bias is not None
        weight = branch.weight.permute(2, 3, 1, 0).flatten(0, 2)  # (9 C, N_anc * values)
        whole = torch.cat((weight, branch.bias[None]))
        parts.append(whole.view(len(whole), anchors, -1))
    return torch.cat(parts, dim=2).flatten(1).float()


def regress(level: Tensor, chosen: Tensor, weight: Tensor, anchors: int) -> Tensor:
    """The outputs of a head's 3 x 3 convolutions for the chosen ones (K,) of the anchors of a level (B, C, N_L, N_W).

    weight: of `weight_of`. Returns (K, values) float32.
    """
    _, channels, n_l, n_w = level.shape
    rows = level.permute(0, 2, 3, 1).reshape(-1, channels)
    cell = chosen // anchors
    step = torch.arange(-1, 2, device=chosen.device)
    x = (cell // n_w % n_l)[:, None, None] + step[:, None]
    y = (cell % n_w)[:, None, None] + step
    inside = (x >= 0) & (x < n_l) & (y >= 0) & (y < n_w)
    first = (cell // (n_l * n_w) * n_l)[:, None, None]  # the first row of cells of the sample
    at = (first + x.clamp(0, n_l - 1)) * n_w + y.clamp(0, n_w - 1)
    patches = rows.index_select(0, at.flatten()).float().view(-1, 9, channels)
    patches = patches * inside.view(-1, 9, 1)
    values = torch.addmm(weight[-1], patches.flatten(1), weight[:-1]).view(-1, anchors, weight.shape[1] // anchors)
    return values[torch.arange(chosen.shape[0], device=chosen.device), chosen % anchors]


def scores_of(logits: Tensor, iou: Tensor | None) -> Tensor:
    """Scores in [0, 1] of the logits of a class; with a predicted IoU, the geometric mean of both sigmoids.

    The product (supplement, Sec. 2) ranks the same but lowers scores: 0.7 times 0.7 is 0.49.
    """
    return logits.sigmoid() if iou is None else (logits.sigmoid() * iou.sigmoid()).sqrt()


def anchor_rows(output: Tensor, values: int) -> Tensor:
    """A map (B, N_anc * values, N_L, N_W) as (B, N_L * N_W * N_anc, values) float32, the order of the anchors."""
    return output.permute(0, 2, 3, 1).reshape(output.shape[0], -1, values).to(torch.float32)
