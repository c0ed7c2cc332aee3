"""Test-time augmentation: a cloud seen in several ways, and the boxes of all of them as one.

Turned by a little, the same objects lie differently in the cells. The boxes are joined by weighted box fusion (Solovyev
et al., Image and Vision Computing, 2021).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from hvnet.boxes import limit_angle
from hvnet.config import HeadConfig
from hvnet.kernels.rotated import rotated_iou_bev, rotated_nms
from hvnet.network.model import Detections


class View(NamedTuple):
    """A way to see a cloud: turned counter-clockwise by an angle in radians, then mirrored or not, y to -y."""

    angle: float
    mirrored: bool = False

    def see(self, rows: Tensor) -> Tensor:
        """Points (N, 4), or boxes (M, 7) whose yaw stays as it is, with their x and y as they are seen."""
        rows = turned(rows, self.angle)
        return torch.cat((rows[:, :1], -rows[:, 1:2], rows[:, 2:]), dim=1) if self.mirrored else rows

    def take_back(self, boxes: Tensor) -> Tensor:
        """Boxes (M, 7) that were seen so, in the axes of the cloud."""
        if self.mirrored:
            boxes = boxes * boxes.new_tensor([1, -1, 1, 1, 1, 1, -1])
        boxes = turned(boxes, -self.angle).clone()
        boxes[:, 6] = limit_angle(boxes[:, 6] - self.angle)
        return boxes


PLAIN = (View(0.0),)
TURN = math.radians(4.0)
AUGMENTED = (View(0.0), View(0.0, mirrored=True), View(TURN), View(-TURN, mirrored=True))
"""The mirrored cloud gives the same four, so that its boxes are the mirrored ones; docs/sensors.md has the gain."""


def turned(rows: Tensor, angle: float) -> Tensor:
    """Points (N, 4) or boxes (M, 7) with their x and y turned by an angle in radians, counter-clockwise."""
    if not angle:
        return rows
    x, y = rows[:, :1], rows[:, 1:2]
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.cat((cos * x - sin * y, sin * x + cos * y, rows[:, 2:]), dim=1)


def fuse(
    found: Sequence[Detections], views: Sequence[View], head: HeadConfig, point_range: Sequence[float]
) -> Detections:
    """What was found in every view of a cloud, on the host, in the axes of the cloud: every object once.

    Boxes of a class that overlap a better one by more than its NMS allows are averaged with it, weighted by their
    scores. The score is the mean over the views that have the place in their range, 0 in those that did not find it.
    """
    boxes = torch.cat([view.take_back(each.boxes) for each, view in zip(found, views, strict=True)])
    scores, labels = torch.cat([each.scores for each in found]), torch.cat([each.labels for each in found])
    source = torch.repeat_interleave(torch.arange(len(found)), torch.tensor([len(each.boxes) for each in found]))
    low, high = boxes.new_tensor(point_range[:2]), boxes.new_tensor(point_range[3:5])
    parts = []
    for label, entry in enumerate(head.classes):
        own = (labels == label).nonzero().squeeze(1)
        if len(own):
            best = rotated_nms(boxes[own], scores[own], entry.nms_iou)
            which = rotated_iou_bev(boxes[own], boxes[own[best]]).argmax(dim=1)  # the best box that is the same object
            mean = _average(boxes[own], scores[own], best, which)
            highest = scores.new_zeros(len(found) * len(best))
            highest.scatter_reduce_(0, source[own] * len(best) + which, scores[own], "amax")
            highest = highest.view(len(found), len(best))
            places = torch.stack([view.see(mean)[:, :2] for view in views])
            seen = ((places >= low) & (places < high)).all(dim=2) | (highest > 0)
            score = highest.sum(dim=0) / seen.sum(dim=0)
            fused = Detections(mean, score, torch.full_like(best, label)).select(score > head.score_threshold)
            kept = rotated_nms(fused.boxes, fused.scores, entry.nms_iou)  # averages may overlap
            parts.append(fused.select(kept[: head.detections]))
    return Detections(*(torch.cat(column) for column in zip(*parts, strict=True))) if parts else found[0]


def _average(boxes: Tensor, scores: Tensor, best: Tensor, which: Tensor) -> Tensor:
    """The means (K, 7) of boxes (M, 7), weighted by scores (M,): of each of the best (K,) and the boxes with its number
    in `which` (M,). The heading is the one of the two along the mean axis that has more weight."""
    weights = torch.nn.functional.one_hot(which, len(best)).T * scores
    weights = weights / weights.sum(dim=1, keepdim=True)
    yaw = boxes[best, 6]
    turn = boxes[:, 6] - yaw[:, None]  # (K, M)
    axis = yaw + (weights * limit_angle(2 * turn) / 2).sum(dim=1)
    reverse = (weights * turn.cos()).sum(dim=1) < 0
    return torch.cat((weights @ boxes[:, :6], limit_angle(axis + math.pi * reverse)[:, None]), dim=1)
