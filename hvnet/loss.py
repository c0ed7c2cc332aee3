"""Losses (Sec. 3.5, Eq. 5): focal, corners, vertical, and the optional direction."""

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from hvnet.anchors import Targets
from hvnet.config import ClassConfig, LossConfig
from hvnet.head import HeadMaps
from hvnet.ranks import joined


def focal_loss(logits: Tensor, positive: Tensor, negative: Tensor, alpha: float, gamma: float) -> Tensor:
    """Sum over the anchors (B, A) of -alpha (1 - p)^gamma log p; negatives have 1 - alpha and 1 - p in place."""
    signed = torch.where(positive, logits, -logits)  # of the probability of what is true
    weight = torch.where(positive, alpha, 1.0 - alpha) * (positive | negative)
    return (weight * torch.sigmoid(-signed).pow(gamma) * F.softplus(-signed)).sum()


def class_loss(maps: HeadMaps, targets: Targets, entry: ClassConfig, weights: LossConfig) -> dict[str, Tensor]:
    """The weighted terms of one class, each divided by max(1, positives of the class in the batch of all ranks)."""
    positives = joined(targets.positive.sum()).clamp(min=1)
    focal = focal_loss(maps.logits, targets.positive, targets.negative, entry.focal_alpha, entry.focal_gamma)
    at = targets.positive
    smooth_l1 = functools.partial(F.smooth_l1_loss, reduction="sum", beta=weights.beta)
    terms = {
        "classification": weights.classification * focal,
        "localization": weights.localization * smooth_l1(maps.corners[at], targets.corners),
        "vertical": weights.vertical * smooth_l1(maps.vertical[at], targets.vertical),
    }
    if maps.direction is not None:
        direction = F.cross_entropy(maps.direction[at], targets.direction, reduction="sum")
        terms["direction"] = weights.direction * direction
    return {name: term / positives for name, term in terms.items()}
