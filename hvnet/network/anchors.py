"""Anchors of a class, the boxes encoded against them (Sec. 3.5), and their matching."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from hvnet.boxes import bev_corners, limit_angle
from hvnet.config import ClassConfig, Config
from hvnet.kernels.launch import many_threads
from hvnet.kernels.rotated import rotated_match
from hvnet.network.grids import projection_grids, pyramid_depth

ORIENTATIONS = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)

MAX_SIZE = 40.0
"""Metres that a decoded length or width has at most, or twice the anchor's longer side if that is more.

An articulated bus is 20 m long.
"""
MAX_HEIGHT = 10.0
"""Metres that a decoded height has at most, or twice the anchor's if that is more; so far is it raised or lowered."""
MAX_SHIFT = 100.0
"""Metres along x and y that a decoded centre, or corner, is from the anchor's at most."""
MAX_OUTPUT = 50.0
"""Bound of the outputs that are logarithms or radians: exp(50) is finite."""


class Anchors(nn.Module):
    """The A anchors of all classes, class after class, and what matching asks of each; called with a label, its own."""

    boxes: Tensor  # (A, 7)
    labels: Tensor  # (A,) int64
    positive_iou: Tensor  # (A,)
    negative_iou: Tensor  # (A,)

    def __init__(
        self, boxes: Sequence[Tensor], classes: Sequence[ClassConfig], per_box: Sequence[int] | None = None
    ) -> None:
        """Anchors (A_k, 7) of every class. per_box is what `positives_per_box` gives for each; without it many threads
        have a row for every anchor."""
        super().__init__()
        self.counts, self.per_box = [len(own) for own in boxes], per_box

        def of_anchors(values: Sequence[float]) -> Tensor:
            return torch.cat([torch.full((count,), x) for count, x in zip(self.counts, values, strict=True)])

        self.register_buffer("boxes", torch.cat(list(boxes)), persistent=False)
        self.register_buffer("labels", of_anchors(range(len(classes))), persistent=False)
        for name in ("positive_iou", "negative_iou"):
            self.register_buffer(name, of_anchors([getattr(entry, name) for entry in classes]), persistent=False)

    def forward(self, label: int) -> Tensor:
        """Anchors (A_k, 7) of a class."""
        return self.boxes.split(self.counts)[label]


class Targets(NamedTuple):
    """Targets of the A anchors of all classes over a batch, and P rows for the positive ones, class after class, and
    within a class in the order of nonzero().

    One thread has as many rows as positive anchors. Many threads read no number from the device: they have as many rows
    as there can be, and the unused ones are anchors matched to themselves, whose targets are 0.
    """

    positive: Tensor  # (B, A) bool
    negative: Tensor  # (B, A) bool; anchors that are neither are ignored
    rows: tuple[Tensor, ...]  # of every class: (P_k,) int64, indices into the B * A_k anchors of its maps
    unused: Tensor  # (P,) bool
    location: Tensor  # (P, 8) metres, or (P, 5)
    vertical: Tensor  # (P, 2)
    direction: Tensor  # (P,) int64
    anchors: Tensor  # (P, 7)
    boxes: Tensor  # (P, 7) that they are matched to


def anchors_per_cell(entry: ClassConfig) -> int:
    """Anchors at each cell of a class's map: orientations times sizes."""
    return len(ORIENTATIONS) * len(entry.anchor_sizes)


def level_step(config: Config, entry: ClassConfig) -> int:
    """Cells of the finest pseudo-image along one cell of a class's map."""
    # the levels start at the third last block
    return config.backbone.stride * 2 ** (pyramid_depth(config.encoder) - 3 + entry.level)


def cell_size(config: Config, entry: ClassConfig) -> tuple[float, float]:
    """Metres along x and y between the anchors of a class."""
    grid, step = projection_grids(config.encoder)[0], level_step(config, entry)
    return grid.cell[0] * step, grid.cell[1] * step


def make_anchors(config: Config, entry: ClassConfig) -> Tensor:
    """Anchors (A, 7) of a class at the centres of its level's cells, in the order (x, y, size, orientation)."""
    grid, step, cell = projection_grids(config.encoder)[0], level_step(config, entry), cell_size(config, entry)
    x = grid.x_min + (torch.arange(grid.shape[0] // step, dtype=torch.float64) + 0.5) * cell[0]
    y = grid.y_min + (torch.arange(grid.shape[1] // step, dtype=torch.float64) + 0.5) * cell[1]
    sizes = torch.tensor(entry.anchor_sizes, dtype=torch.float64)
    yaw = limit_angle(torch.tensor(ORIENTATIONS, dtype=torch.float64))
    shape = (len(x), len(y), len(sizes), len(yaw))
    columns = [
        x[:, None, None, None],
        y[None, :, None, None],
        torch.tensor(entry.anchor_z, dtype=torch.float64),
        *(sizes[None, None, :, None, k] for k in range(3)),
        yaw,
    ]
    return torch.stack([column.expand(shape) for column in columns], dim=-1).reshape(-1, 7).float()


def encode(boxes: Tensor, anchors: Tensor, regression: str = "corners") -> tuple[Tensor, Tensor, Tensor]:
    """Boxes (P, 7) against anchors (P, 7): location (P, 8) or (P, 5), vertical (P, 2), direction (P,) int64.

    The location is that of the half-turn of the box that is nearer to the anchor; direction is 1 where that is not the
    box's own heading. The location of "corners" is their offsets in metres, that of "pose" (dx / diagonal, dy /
    diagonal, log(l / anchor length), log(w / anchor width), dtheta); vertical is (dz / anchor height, log(h / anchor
    height)). Pose and vertical are VoxelNet's.
    """
    turned = limit_angle(boxes[:, 6] - anchors[:, 6]).abs() > math.pi / 2
    nearer = boxes.clone()
    nearer[:, 6] = torch.where(turned, boxes[:, 6] + math.pi, boxes[:, 6])
    if regression == "corners":
        location = (bev_corners(nearer) - bev_corners(anchors)).flatten(1)
    else:
        shift = (boxes[:, :2] - anchors[:, :2]) / anchors[:, 3:5].norm(dim=1, keepdim=True)
        size = (boxes[:, 3:5] / anchors[:, 3:5]).log()
        location = torch.cat((shift, size, limit_angle(nearer[:, 6:] - anchors[:, 6:])), dim=1)
    height = anchors[:, 5]
    vertical = torch.stack(((boxes[:, 2] - anchors[:, 2]) / height, (boxes[:, 5] / height).log()), dim=1)
    return location, vertical, turned.long()


def decode(location: Tensor, vertical: Tensor, direction: Tensor | None, anchors: Tensor) -> Tensor:
    """Inverse of `encode`: boxes (P, 7), up to a half-turn if direction, (P,) int64, is None.

    Of corners (P, 8) the centre is the mean; the axis is the sum of the edges along the box; length and width are means
    of opposite edges. Whatever the outputs, infinite ones too, the box is finite and within MAX_SIZE, MAX_HEIGHT and
    MAX_SHIFT; only a NaN stays one, so that it is seen.
    """
    if location.shape[1] == 5:
        shift = location[:, :2] * anchors[:, 3:5].norm(dim=1, keepdim=True)
        centre = anchors[:, :2] + shift.clamp(-MAX_SHIFT, MAX_SHIFT)
        log_size, turn = location[:, 2:].clamp(-MAX_OUTPUT, MAX_OUTPUT).split((2, 1), dim=1)
        size, yaw = anchors[:, 3:5] * log_size.exp(), anchors[:, 6:] + turn
    else:
        offsets = location.clamp(-MAX_SHIFT, MAX_SHIFT).view(-1, 4, 2)
        front_left, front_right, rear_right, rear_left = (bev_corners(anchors) + offsets).unbind(1)
        centre = (front_left + front_right + rear_right + rear_left) / 4
        left, right = front_left - rear_left, front_right - rear_right
        front, rear = front_left - front_right, rear_left - rear_right
        length, width = (left.norm(dim=1) + right.norm(dim=1)) / 2, (front.norm(dim=1) + rear.norm(dim=1)) / 2
        size = torch.stack((length, width), dim=1)
        axis = left + right
        yaw = torch.atan2(axis[:, 1:], axis[:, :1])
    if direction is not None:
        yaw = yaw + math.pi * direction[:, None].to(yaw.dtype)
    height = anchors[:, 5:6]
    largest = (2 * anchors[:, 3:5].amax(dim=1, keepdim=True)).clamp(min=MAX_SIZE)
    highest = (2 * height).clamp(min=MAX_HEIGHT)
    z = anchors[:, 2:3] + torch.clamp(vertical[:, :1] * height, -highest, highest)
    h = vertical[:, 1:].clamp(-MAX_OUTPUT, MAX_OUTPUT).exp() * height
    sizes = (torch.clamp(size, max=largest), torch.clamp(h, max=highest))
    return torch.cat((centre, z, *sizes, limit_angle(yaw)), dim=1)


def positives_per_box(config: Config, entry: ClassConfig) -> int:
    """The most anchors of a class that one box, of whatever size, makes positive.

    Let r be half the anchor's diagonal and d > r the distance of the centres. Along the line through both, the box's
    area falls off from its centre to either side alike: at most r / (d + r) of it is within the anchor's reach. An IoU
    above t needs more than t of it, hence d < r (1 / t - 1).
    """
    count = 1  # the best anchor, whatever its IoU
    for length, width, _ in entry.anchor_sizes:
        reach = 1.001 * math.hypot(length, width) / 2 * max(1.0, 1 / entry.positive_iou - 1)  # more than any rounding
        cells = (math.floor(2 * reach / cell) + 1 for cell in cell_size(config, entry))
        count += len(ORIENTATIONS) * math.prod(cells)
    return count


def assign_targets(
    anchors: Anchors, boxes: Sequence[Tensor], labels: Sequence[Tensor], regression: str = "corners"
) -> Targets:
    """Matches anchors to the boxes (M_b, 7) of their class in every sample, by rotated IoU in bird's eye view.

    labels: (M_b,) int64 a sample; boxes of no class match nothing.

    Positive: IoU above the class's positive_iou, or the best anchor of a box (if it overlaps at all; of two boxes with
    one best anchor the first has it). Negative: IoU below its negative_iou.
    """
    device, in_sample, groups = anchors.boxes.device, len(anchors.boxes), len(anchors.counts) + 1
    # the boxes of a sample, class after class; the last group is of no class
    padded = pad_sequence(list(boxes), batch_first=True, padding_value=math.nan)  # (B, M, 7)
    group = pad_sequence(list(labels), batch_first=True, padding_value=-1).clamp(-1, groups - 1) % groups
    group = group + groups * torch.arange(len(group), device=device)[:, None]
    group, order = group.flatten().sort(stable=True)
    every, count = padded.view(-1, 7)[order], len(order)
    starts = torch.searchsorted(group, torch.arange(len(padded) * groups + 1, device=device))
    iou, match, best = rotated_match(anchors.boxes, every, starts, labels=anchors.labels, classes=groups)
    # the first box of those whose best anchor it is; `count` is none
    nearest = group // groups * in_sample + best.clamp(min=0)
    of_box = torch.arange(count, device=device).masked_fill(best < 0, count)
    forced = torch.full((iou.numel(),), count, dtype=torch.int64, device=device)
    forced = forced.scatter_reduce_(0, nearest, of_box, "amin").view_as(match)
    is_forced = forced < count
    match = torch.where(is_forced, forced, match)
    positive = (iou > anchors.positive_iou) | is_forced
    negative = (iou < anchors.negative_iou) & ~positive
    rows, unused, flat, first = [], [], [], 0
    for k, own in enumerate(positive.split(anchors.counts, dim=1)):
        most = own.numel() if anchors.per_box is None else sum(map(len, boxes)) * anchors.per_box[k]
        of_class, of_none = true_rows(own, most)
        rows.append(of_class)
        unused.append(of_none)
        # the same anchors among those of all classes
        flat.append(torch.add(of_class + first, of_class // own.shape[1], alpha=in_sample - own.shape[1]))
        first += own.shape[1]
    joined, no_row = torch.cat(flat), torch.cat(unused)
    of_positive = anchors.boxes[joined % in_sample]
    matched = every[match.flatten()[joined].clamp(min=0)] if count else of_positive
    matched = torch.where(no_row[:, None], of_positive, matched)
    encoded = encode(matched, of_positive, regression)
    return Targets(positive, negative, tuple(rows), no_row, *encoded, of_positive, matched)


def true_rows(mask: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """The indices (P,) int64 into the flat mask where it is true, and which of them are unused (P,) bool.

    Many threads, which read no number from the device, have min(most, size of the mask) of them, more than there are
    true ones; the unused ones are all different.
    """
    mask = mask.flatten()
    if not many_threads(mask.device):
        rows = mask.nonzero().squeeze(1)
        return rows, torch.zeros_like(rows, dtype=torch.bool)
    rows = mask.nonzero_static(size=min(most, len(mask))).squeeze(1)  # -1 behind the last
    unused = rows < 0
    return torch.where(unused, torch.arange(len(rows), device=mask.device), rows), unused
