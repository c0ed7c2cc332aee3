"""Geometry of boxes (x, y, z, length, width, height, yaw) in LiDAR axes: x forward, y left, z up, metres.

z is the height of the box's centre; yaw turns about +z, is 0 along +x and lies in [-pi, pi).
"""

import math

import numpy as np
import torch
from torch import Tensor

MAX_PAIRS = 2**20
"""Points times boxes that are compared at a time: what is worked out of them takes 8 MB a number in float64."""
# pairs of corners, in the order of box_corners: four edges at the bottom, four at the top, four between them
EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]])


def limit_angle(angle: Tensor) -> Tensor:
    """Wraps angles in radians to [-pi, pi)."""
    wrapped = torch.remainder(angle + math.pi, 2 * math.pi) - math.pi
    # remainder of a tiny negative number rounds up to the modulus itself
    return torch.where(wrapped >= math.pi, wrapped - 2 * math.pi, wrapped)


def bev_corners(boxes: Tensor) -> Tensor:
    """Corners of boxes (..., 7) in bird's eye view: (..., 4, 2), front-left, front-right, rear-right, rear-left."""
    x, y, length, width, yaw = (boxes[..., k] for k in (0, 1, 3, 4, 6))
    cos, sin = yaw.cos(), yaw.sin()
    length, width = length / 2, width / 2
    ahead_x, ahead_y, side_x, side_y = length * cos, length * sin, width * sin, width * cos
    front_x, front_y, rear_x, rear_y = x + ahead_x, y + ahead_y, x - ahead_x, y - ahead_y
    corners = [front_x - side_x, front_y + side_y, front_x + side_x, front_y - side_y]
    corners += [rear_x + side_x, rear_y - side_y, rear_x - side_x, rear_y + side_y]
    return torch.stack(corners, dim=-1).unflatten(-1, (4, 2))


def box_corners(boxes: Tensor) -> Tensor:
    """Corners of boxes (..., 7) in 3D: (..., 8, 3), the four of `bev_corners` at the bottom, then at the top."""
    bev = bev_corners(boxes)
    half = boxes[..., 5:6] / 2
    corners = []
    for z in (boxes[..., 2:3] - half, boxes[..., 2:3] + half):
        corners.append(torch.cat((bev, z.unsqueeze(-2).expand(*bev.shape[:-1], 1)), dim=-1))
    return torch.cat(corners, dim=-2)


def points_in_boxes(points: Tensor, boxes: Tensor) -> Tensor:
    """Which of the points (N, 3 or more) lie in or on which of the boxes (M, 7): bool (N, M)."""
    cos, sin = boxes[:, 6].cos(), boxes[:, 6].sin()
    inside = torch.empty(len(points), len(boxes), dtype=torch.bool, device=points.device)
    # a part of the points at a time: what is worked out besides the result would take many times its memory
    rows = max(1, MAX_PAIRS // max(1, len(boxes)))
    for begin in range(0, len(points), rows):
        inside[begin : begin + rows] = _inside(points[begin : begin + rows], boxes, cos, sin)
    return inside


def indices_in_boxes(points: Tensor, boxes: Tensor) -> list[Tensor]:
    """For each of the boxes (M, 7) the indices, ascending, of the points (N, 3 or more) in or on it.

    The same as `points_in_boxes`, without its (N, M) mask.
    """
    cos, sin = boxes[:, 6].cos(), boxes[:, 6].sin()
    # no point in a box is further from its centre in x; the tenth is far more than any rounding
    reach = (boxes[:, 3] + boxes[:, 4]) * 0.55
    x = points[:, 0].to(torch.promote_types(points.dtype, boxes.dtype)).contiguous()
    found = []
    for k in range(len(boxes)):
        one = slice(k, k + 1)  # not k, whose scalars would not widen the points to the dtype of the boxes
        near = ((x - boxes[one, 0]).abs() <= reach[one]).nonzero()[:, 0]
        found.append(near[_inside(points[near], boxes[one], cos[one], sin[one])[:, 0]])
    return found


def _inside(points: Tensor, boxes: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """The mask (N, M) of `points_in_boxes`; cosine and sine (M,) are those of the boxes' yaw."""
    # one coordinate at a time: three times as fast as a (N, M, 3) tensor
    x, y, z = (points[:, axis, None] - boxes[:, axis] for axis in range(3))  # (N, M)
    inside = (x * cos + y * sin).abs() * 2 <= boxes[:, 3]
    inside &= (y * cos - x * sin).abs() * 2 <= boxes[:, 4]
    return inside & (z.abs() * 2 <= boxes[:, 5])


def boxes_collide(a: Tensor, b: Tensor) -> Tensor:
    """Whether boxes a (A, 7) and b (B, 7) overlap in bird's eye view: bool (A, B); touching does not count.

    Separating axes: two rectangles are apart iff their projections on one of the four edge directions are.
    """
    corners_a, corners_b = bev_corners(a), bev_corners(b)
    apart = torch.zeros(len(a), len(b), dtype=torch.bool, device=a.device)
    yaws = (a[:, 6, None].expand(-1, len(b)), b[None, :, 6].expand(len(a), -1))
    for yaw in yaws:
        for axis in (torch.stack((yaw.cos(), yaw.sin()), -1), torch.stack((-yaw.sin(), yaw.cos()), -1)):  # (A, B, 2)
            on_a = torch.einsum("akd,abd->abk", corners_a, axis)
            on_b = torch.einsum("bkd,abd->abk", corners_b, axis)
            apart |= (on_a.amax(-1) <= on_b.amin(-1)) | (on_b.amax(-1) <= on_a.amin(-1))
    return ~apart
