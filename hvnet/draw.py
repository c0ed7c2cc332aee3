"""Pictures, drawn without a screen."""

from collections.abc import Sequence
from pathlib import Path

import torch
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from torch import Tensor

from hvnet.boxes import bev_corners

TRUTH_COLOUR = "#1a9850"
SHOWN_SCORE = 0.5
"""Detections below are left out of pictures, which they would only fill."""
CLASS_COLOURS = ("#d62728", "#1f77b4", "#ff7f0e", "#9467bd")


def draw_bev(
    path: Path,
    points: Tensor,
    point_range: Sequence[float],
    truth: Tensor,
    boxes: Tensor,
    scores: Tensor,
    labels: Tensor,
    classes: Sequence[str],
    title: str,
) -> None:
    """Writes a bird's eye view: points (N, 4) coloured by height, true boxes (T, 7) and detections (M, 7).

    A line from each box's centre to its front shows the heading; detections carry their scores (M,), and labels (M,)
    index the class names; those of scores below SHOWN_SCORE are not drawn, nor boxes whose centre is outside the range.
    """
    truth = truth[_is_near(truth, point_range)]
    shown = (scores >= SHOWN_SCORE) & _is_near(boxes, point_range)
    boxes, scores, labels = boxes[shown], scores[shown], labels[shown]
    x_min, y_min, z_min, x_max, y_max, z_max = point_range
    inside = (points[:, 0] >= x_min) & (points[:, 0] < x_max) & (points[:, 1] >= y_min) & (points[:, 1] < y_max)
    x, y, z = points[inside, :3].cpu().numpy().T
    width = 8.0
    height = min(max(width * (x_max - x_min) / (y_max - y_min), 2.0), 50.0)  # inches; matplotlib has its limits
    figure = Figure(figsize=(width, 0.9 + height), layout="constrained")
    axes = figure.add_subplot()
    axes.scatter(-y, x, s=0.4, c=z, cmap="viridis", vmin=z_min, vmax=min(z_max, 1.0), linewidths=0)
    handles = []
    if len(truth):
        handles.append(axes.add_collection(_outlines(truth, TRUTH_COLOUR, 2.2, f"labelled ({len(truth)})")))
    for label, name in enumerate(classes):
        own = labels == label
        if own.any():
            colour = CLASS_COLOURS[label % len(CLASS_COLOURS)]
            handles.append(axes.add_collection(_outlines(boxes[own], colour, 1.2, f"{name} ({int(own.sum())})")))
            for box, score in zip(boxes[own].tolist(), scores[own].tolist(), strict=True):
                reach = max(box[3], box[4]) / 2
                axes.text(
                    -box[1], box[0] + reach + 0.3, f"{score:.2f}", color=colour, fontsize=6, ha="center", clip_on=True
                )
    axes.set_xlim(-y_max, -y_min)
    axes.set_ylim(x_min, x_max)
    axes.set_aspect("equal")
    axes.set_xlabel("to the right (m)")
    axes.set_ylabel("forward (m)")
    axes.set_title(f"{title}, score ≥ {SHOWN_SCORE}")
    if handles:
        axes.legend(handles=handles, loc="upper right", fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _is_near(boxes: Tensor, point_range: Sequence[float]) -> Tensor:
    """Which boxes (M, 7) have their centre in the range and a size that can be drawn."""
    low, high = boxes.new_tensor(point_range).view(2, 3)[:, :2]
    inside = ((boxes[:, :2] >= low) & (boxes[:, :2] < high)).all(dim=1)
    return inside & (boxes[:, 3:5] < 10 * (high - low).max()).all(dim=1)


def _outlines(boxes: Tensor, colour: str, width: float, label: str) -> LineCollection:
    """Outline and heading of boxes (M, 7), as they are seen from above with x up and y to the left."""
    corners = bev_corners(boxes.cpu())  # (M, 4, 2)
    centre, front = boxes[:, None, :2].cpu(), corners[:, :2].mean(dim=1, keepdim=True)
    outlines = torch.cat((corners, corners[:, :1]), dim=1)
    headings = torch.cat((centre, front), dim=1)
    lines = [line.flip(-1).mul(line.new_tensor([-1.0, 1.0])).numpy() for line in (*outlines, *headings)]
    return LineCollection(lines, colors=colour, linewidths=width, label=label)
