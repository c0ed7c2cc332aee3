"""Anchors of a class, the boxes encoded against them (Sec. 3.5), and their matching."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hvnet.boxes import bev_corners, limit_angle
from hvnet.config import ClassConfig, Config
from hvnet.encoder import projection_grids, pyramid_depth
from hvnet.kernels.rotated import rotated_match

ORIENTATIONS = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)


class Targets(NamedTuple):
    """What the loss wants of the anchors of one class, over a batch."""

    positive: Tensor  # (B, A) bool
    negative: Tensor  # (B, A) bool; anchors that are neither count for nothing
    corners: Tensor  # (P, 8) metres, of the positive anchors in the order of positive.nonzero()
    vertical: Tensor  # (P, 2)
    direction: Tensor  # (P,) int64


def anchors_per_cell(entry: ClassConfig) -> int:
    """Anchors at each cell of a class's map: orientations times sizes."""
    return len(ORIENTATIONS) * len(entry.anchor_sizes)


def make_anchors(config: Config, entry: ClassConfig) -> Tensor:
    """Anchors (A, 7) of a class at the centres of its level's cells, in the order (x, y, size, orientation)."""
    grid = projection_grids(config.encoder)[0]
    step = 2 ** (pyramid_depth(config.encoder) - 3 + entry.level)  # the levels start at the third last block
    cell = (grid.cell[0] * step, grid.cell[1] * step)
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


def encode(boxes: Tensor, anchors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Boxes (P, 7) against anchors (P, 7): corner offsets (P, 8), vertical (P, 2), direction (P,) int64.

    Corners are offsets in metres of the half-turn of the box that is nearer to the anchor; direction is 1 where that is
    not the box's own heading. Vertical is (dz / anchor height, log(h / anchor height)) as in VoxelNet.
    """
    turned = limit_angle(boxes[:, 6] - anchors[:, 6]).abs() > math.pi / 2
    nearer = boxes.clone()
    nearer[:, 6] = torch.where(turned, boxes[:, 6] + math.pi, boxes[:, 6])
    corners = (bev_corners(nearer) - bev_corners(anchors)).flatten(1)
    height = anchors[:, 5]
    vertical = torch.stack(((boxes[:, 2] - anchors[:, 2]) / height, (boxes[:, 5] / height).log()), dim=1)
    return corners, vertical, turned.long()


def decode(corners: Tensor, vertical: Tensor, direction: Tensor | None, anchors: Tensor) -> Tensor:
    """Inverse of `encode`: boxes (P, 7), up to a half-turn if direction, (P,) int64, is None.

    Centre = mean of the corners; the axis is the sum of the edges along the box; length and width are means of opposite
    edges.
    """
    front_left, front_right, rear_right, rear_left = (bev_corners(anchors) + corners.view(-1, 4, 2)).unbind(1)
    centre = (front_left + front_right + rear_right + rear_left) / 4
    left, right = front_left - rear_left, front_right - rear_right
    front, rear = front_left - front_right, rear_left - rear_right
    axis = left + right
    yaw = torch.atan2(axis[:, 1], axis[:, 0])
    if direction is not None:
        yaw = yaw + math.pi * direction.to(yaw.dtype)
    height = anchors[:, 5]
    return torch.stack(
        (
            centre[:, 0],
            centre[:, 1],
            anchors[:, 2] + vertical[:, 0] * height,
            (left.norm(dim=1) + right.norm(dim=1)) / 2,
            (front.norm(dim=1) + rear.norm(dim=1)) / 2,
            vertical[:, 1].exp() * height,
            limit_angle(yaw),
        ),
        dim=1,
    )


def assign_targets(anchors: Tensor, boxes: list[Tensor], positive_iou: float, negative_iou: float) -> Targets:
    """Matches anchors (A, 7) of a class to its boxes, one (M_b, 7) a sample, by rotated IoU in bird's eye view.

    Positive: IoU above positive_iou, or the best anchor of a box (if it overlaps at all; of two boxes with one best
    anchor the first has it). Negative: IoU below negative_iou.
    """
    starts = torch.tensor([0, *(len(b) for b in boxes)], device=anchors.device).cumsum(0)
    every = torch.cat(boxes)
    iou, match, best = rotated_match(anchors, every, starts)
    sample = torch.repeat_interleave(torch.arange(len(boxes), device=anchors.device), starts.diff())
    overlapping = (best >= 0).nonzero().squeeze(1)
    forced = torch.full((iou.numel(),), len(every), dtype=torch.int64, device=anchors.device)
    forced.scatter_reduce_(0, (sample * len(anchors) + best)[overlapping], overlapping, "amin")
    forced = forced.view_as(match)
    is_forced = forced < len(every)
    match = torch.where(is_forced, forced, match)
    positive = (iou > positive_iou) | is_forced
    at = positive.nonzero()
    corners, vertical, direction = encode(every[match[positive]], anchors[at[:, 1]])
    return Targets(positive, (iou < negative_iou) & ~positive, corners, vertical, direction)
