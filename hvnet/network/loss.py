"""Losses (Sec. 3.5, Eq. 5): focal, location, vertical, the optional direction, and what the supplement tried."""

import functools
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from hvnet.boxes import bev_corners
from hvnet.config import ClassConfig, LossConfig
from hvnet.network.anchors import Targets, decode
from hvnet.network.head import Regressed
from hvnet.ranks import all_reduce

IGNORED = -100  # the direction of an unused row


def focal_loss(logits: Tensor, positive: Tensor, negative: Tensor, alpha: float, gamma: float) -> Tensor:
    """Sum over the anchors (B, A) of -alpha (1 - p)^gamma log p; negatives have 1 - alpha and 1 - p in place."""
    wrong = logits * torch.where(positive, -1.0, 1.0)  # of the probability of what is not true
    weight = torch.where(positive, alpha, (1.0 - alpha) * negative)
    return (weight * torch.sigmoid(wrong).pow(gamma) * F.softplus(wrong)).sum()


def total_loss(
    logits: Sequence[Tensor],
    found: Sequence[Regressed],
    targets: Targets,
    classes: Sequence[ClassConfig],
    weights: LossConfig,
) -> dict[str, Tensor]:
    """The weighted terms summed over the classes, each divided by max(1, positives of its class in the batch of all
    ranks).

    Of every class: logits (B, A_k), and what was found for the rows of the targets.
    """
    sizes, anchors = [len(rows) for rows in targets.rows], [own.shape[1] for own in logits]
    used, location = ~targets.unused, joined([own.location for own in found], targets)
    vertical = joined([own.vertical for own in found], targets)

    def by_class(loss: Callable[..., Tensor], *rows: Tensor) -> list[Tensor]:
        """The loss of every class's rows, of all rows (P, ...).

        One by one: sums and the ends of vectors round by position, and so a class's bits do not depend on the others.
        """
        return [loss(*own) for own in zip(*(each.split(sizes) for each in rows), strict=True)]

    def overlap(generalized: bool = False) -> Tensor:
        return iou_pairs(targets.boxes, decode(location, vertical, None, targets.anchors), generalized)

    masks = (mask.split(anchors, dim=1) for mask in (targets.positive, targets.negative))
    smooth_l1 = functools.partial(F.smooth_l1_loss, reduction="sum", beta=weights.beta)
    if weights.box == "smooth_l1":
        box = by_class(smooth_l1, location, targets.location)
    else:
        box = by_class(torch.sum, (1 - overlap(weights.box == "giou")).masked_fill(targets.unused, 0.0))
    terms = {
        "classification": [
            focal_loss(own, positive, negative, entry.focal_alpha, entry.focal_gamma)
            for own, positive, negative, entry in zip(logits, *masks, classes, strict=True)
        ],
        "localization": box,
        "vertical": by_class(smooth_l1, vertical, targets.vertical),
    }
    directions = [own.direction for own in found if own.direction is not None]
    if directions:
        bins = targets.direction.masked_fill(targets.unused, IGNORED)
        cross_entropy = functools.partial(F.cross_entropy, reduction="sum", ignore_index=IGNORED)
        terms["direction"] = by_class(cross_entropy, joined(directions, targets), bins)
    ious = [own.iou for own in found if own.iou is not None]
    if ious:
        with torch.no_grad():
            wanted = overlap()
        cross_entropy = functools.partial(F.binary_cross_entropy_with_logits, reduction="sum")
        terms["iou"] = by_class(cross_entropy, joined(ious, targets), wanted, used.float())
    positives = all_reduce(torch.stack(by_class(torch.sum, used))).clamp(min=1)
    weighted = torch.stack([getattr(weights, name) * torch.stack(of_classes) for name, of_classes in terms.items()])
    totals = functools.reduce(torch.add, (weighted / positives).unbind(1))
    return dict(zip(terms, totals.unbind(), strict=True))


def joined(parts: Sequence[Tensor], targets: Targets) -> Tensor:
    """The rows (P, ...) of all classes; unused ones are 0, as their targets are, and pass no gradient on."""
    rows = torch.cat(list(parts))
    return rows.masked_fill(targets.unused if rows.ndim == 1 else targets.unused[:, None], 0.0)


def iou_pairs(a: Tensor, b: Tensor, generalized: bool = False) -> Tensor:
    """BEV IoU (P,) of boxes a (P, 7) with boxes b (P, 7), with a gradient in both; generalized: GIoU, in [-1, 1].

    The formula is that of `kernels/rotated.py` (Green's theorem in the frame of a). GIoU (Rezatofighi et al., CVPR
    2019) subtracts what neither covers of the rectangle along a that encloses both.
    """
    corners = bev_corners(b.double()) - a[:, None, :2].double()  # (P, 4, 2)
    cos, sin = a[:, 6, None].double().cos(), a[:, 6, None].double().sin()
    x, y = corners[..., 0] * cos + corners[..., 1] * sin, corners[..., 1] * cos - corners[..., 0] * sin
    half_l, half_w = a[:, 3, None].double() / 2, a[:, 4, None].double() / 2
    # corners are clockwise, an area is positive the other way round: the edges go from a corner to the one before it
    shared = _edge_areas(x, y, x.roll(1, 1), y.roll(1, 1), half_l, half_w).sum(dim=1).clamp(min=0)
    union = (a[:, 3] * a[:, 4] + b[:, 3] * b[:, 4]).double() - shared
    iou = shared / union
    if generalized:
        length = torch.maximum(x.amax(1), half_l[:, 0]) - torch.minimum(x.amin(1), -half_l[:, 0])
        width = torch.maximum(y.amax(1), half_w[:, 0]) - torch.minimum(y.amin(1), -half_w[:, 0])
        iou = iou - 1 + union / (length * width)
    return iou.to(a.dtype)


def _edge_areas(x0: Tensor, y0: Tensor, x1: Tensor, y1: Tensor, l: Tensor, w: Tensor) -> Tensor:
    """The integrals of clamp(x, -l, l) dy along edges (x0, y0) to (x1, y1), all (P, 4), where |y| <= w."""
    rise = y1 - y0
    steep = rise.abs() > 1e-9
    slope = torch.where(steep, (x1 - x0) / rise.where(steep, 1.0), 0.0)
    low, high = torch.clamp(y0, -w, w), torch.clamp(y1, -w, w)
    start, end = x0 + (low - y0) * slope, x1 - (y1 - high) * slope
    span = end - start
    long = span.abs() > 1e-6

    def integral(x: Tensor) -> Tensor:
        """The integral of clamp(t, -l, l) from 0 to x."""
        return torch.where(x.abs() <= l, x.square() / 2, l * x.abs() - l.square() / 2)

    mean = torch.where(long, (integral(end) - integral(start)) / span.where(long, 1.0), torch.clamp(start, -l, l))
    return mean * (high - low)
