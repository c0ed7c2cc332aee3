"""Pictures, drawn without a screen: clouds with boxes from above and in the camera's image.

`show_*` draw into matplotlib axes, `draw_*` write a file: .png, or .svg and .pdf, in which the points are a raster.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from torch import Tensor

from hvnet.boxes import EDGES, bev_corners, box_corners
from hvnet.data.frame import Frame
from hvnet.network.model import Detections

FORMATS = ("png", "svg", "pdf")
TRUTH_COLOUR = "#1a9850"
SHOWN_SCORE = 0.5
"""Detections below this score are not drawn: they would clutter the picture."""
CLASS_COLOURS = ("#d62728", "#1f77b4", "#ff7f0e", "#9467bd")
FRONT = [0, 1, 5, 4]
"""A box's face in front, in the order of box_corners."""
WIDTH = 8.0
"""Width of a picture in inches."""

Colour = Literal["height", "reflectance"]


class Subject(NamedTuple):
    """What a picture shows: a frame with its labels, and what a detector found in it."""

    frame: Frame
    found: Detections
    classes: Sequence[str]  # of the detector; labels of others are not shown

    def at_score(self, score: float) -> "Subject":
        """Without the detections below a score."""
        return self._replace(found=self.found.select(self.found.scores >= score))


# --- pictures ---------------------------------------------------------------------------------------------------------


def draw_bev(path: Path, subject: Subject, point_range: Sequence[float], title: str, colour: Colour = "height") -> None:
    """Writes a bird's eye view of a range (x, y, z least, x, y, z greatest) with detections from SHOWN_SCORE on."""
    figure = Figure(figsize=(WIDTH, 0.9 + _bev_height(point_range)), layout="constrained")
    axes = figure.add_subplot()
    _whole_bev(axes, subject.at_score(SHOWN_SCORE), point_range, colour)
    axes.set_title(f"{title}, score ≥ {SHOWN_SCORE}", parse_math=False)
    write_figure(figure, path, dpi=110)


def draw_frame(
    path: Path, subject: Subject, point_range: Sequence[float], title: str, colour: Colour = "height"
) -> None:
    """Writes the camera's picture above and the bird's eye view below, with detections from SHOWN_SCORE on."""
    camera = subject.frame.camera
    assert camera is not None
    heights = (0.92 * WIDTH * camera.size[1] / camera.size[0], 0.92 * _bev_height(point_range))  # labels take the rest
    figure = Figure(figsize=(WIDTH, 1.0 + sum(heights)), layout="compressed")
    above, below = figure.subplots(2, 1, height_ratios=heights)
    subject = subject.at_score(SHOWN_SCORE)
    points = show_camera(above, subject)
    if points is not None:
        _colour_bar(points, above.inset_axes((0.77, 0.91, 0.2, 0.03)), "depth (m)")
    above.set_title(f"{title}, score ≥ {SHOWN_SCORE}", parse_math=False)
    _whole_bev(below, subject, point_range, colour)
    write_figure(figure, path, dpi=150)


# --- from above -------------------------------------------------------------------------------------------------------


def show_bev(axes: Axes, subject: Subject, point_range: Sequence[float], colour: Colour = "height") -> PathCollection:
    """Draws a bird's eye view, x up and y to the left: points, boxes with their heading, and rings of distance.

    A line from each box's centre to its front shows the heading; detections carry their scores. Boxes whose centre is
    outside the range are not drawn. Returns the points.
    """
    x_min, y_min, z_min, x_max, y_max, z_max = point_range
    points = subject.frame.points.cpu()
    inside = (points[:, 0] >= x_min) & (points[:, 0] < x_max) & (points[:, 1] >= y_min) & (points[:, 1] < y_max)
    x, y, z, reflectance = points[inside].numpy().T
    values, limits = (z, (z_min, min(z_max, z_min + 4))) if colour == "height" else (reflectance, (0.0, 1.0))
    scattered = _scatter(axes, -y, x, values, limits, "cividis_r", 70 / (x_max - x_min + y_max - y_min))
    _rings(axes, point_range)
    for boxes, texts, tint, width, label in _groups(subject, point_range):
        axes.add_collection(_outlines(boxes, tint, width, f"{label} ({len(boxes)})"))
        top = bev_corners(boxes)[..., 0].amax(dim=1)
        for x, y, text in zip((top + 0.3).tolist(), boxes[:, 1].tolist(), texts, strict=True):
            _write_text(axes, -y, x, text, tint, "bottom")
    axes.set_xlim(-y_max, -y_min)
    axes.set_ylim(x_min, x_max)
    axes.set_aspect("equal")
    axes.set_xlabel("to the right (m)")
    axes.set_ylabel("forward (m)")
    return scattered


def _whole_bev(axes: Axes, subject: Subject, point_range: Sequence[float], colour: Colour) -> None:
    """A bird's eye view with a legend, and a bar of its colours in a corner that a camera does not see."""
    points = show_bev(axes, subject, point_range, colour)
    _colour_bar(points, axes.inset_axes((0.03, 0.05, 0.2, 0.012)), "height (m)" if colour == "height" else colour)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", fontsize=8)


def _bev_height(point_range: Sequence[float]) -> float:
    x_min, y_min, _, x_max, y_max, _ = point_range
    return min(max(WIDTH * (x_max - x_min) / (y_max - y_min), 2.0), 50.0)  # inches; matplotlib has its limits


def _rings(axes: Axes, point_range: Sequence[float]) -> None:
    """Circles around the sensor, each with its radius where it passes on the left of the range's middle."""
    x_min, y_min, _, x_max, y_max, _ = point_range
    far = np.hypot(max(abs(x_min), abs(x_max)), max(abs(y_min), abs(y_max)))
    middle = (x_min + x_max) / 2, (y_min + 3 * y_max) / 4
    away = np.hypot(*middle) or 1.0
    for radius in MaxNLocator(nbins=8, steps=[1, 2, 5, 10]).tick_values(0, far):
        if 0 < radius <= far:
            axes.add_patch(Circle((0, 0), radius, fill=False, color="#888888", linewidth=0.5, zorder=0.5))
            x, y = radius * middle[0] / away, radius * middle[1] / away
            margin = 0.03 * (x_max - x_min), 0.05 * (y_max - y_min)
            if x_min + margin[0] < x < x_max - margin[0] and y_min + margin[1] < y < y_max - margin[1]:
                _write_text(axes, -y, x, f"{radius:g} m", "#555555", "center")


def _outlines(boxes: Tensor, colour: str, width: float, label: str) -> LineCollection:
    """Outline and heading of boxes (M, 7), as they are seen from above with x up and y to the left."""
    corners = bev_corners(boxes)  # (M, 4, 2)
    centre, front = boxes[:, None, :2], corners[:, :2].mean(dim=1, keepdim=True)
    outlines = torch.cat((corners, corners[:, :1]), dim=1)
    headings = torch.cat((centre, front), dim=1)
    lines = [line.flip(-1).mul(line.new_tensor([-1.0, 1.0])).numpy() for line in (*outlines, *headings)]
    return LineCollection(lines, colors=colour, linewidths=width, label=label)


# --- in the image -----------------------------------------------------------------------------------------------------


def show_camera(axes: Axes, subject: Subject) -> PathCollection | None:
    """Draws the camera's image with the boxes: edges, the face in front tinted, and the 2D box dotted.

    Without an image the points are drawn and returned, coloured by their depth. Nothing is drawn of what is behind the
    camera or outside the image.
    """
    camera = subject.frame.camera
    assert camera is not None
    width, height = camera.size
    drawn, image = None, camera.read_image()
    if image is not None:
        axes.imshow(image, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
    else:
        points = subject.frame.points.cpu().numpy()
        points = points[camera.sees(points)]
        pixels, depth = camera.project(points[:, :3])
        drawn = _scatter(axes, pixels[:, 0], pixels[:, 1], depth, (0.0, 60.0), "turbo", 1.5)
        axes.set_aspect("equal")
    for boxes, texts, tint, line_width, label in _groups(subject):
        values = boxes.double().numpy()
        corners = box_corners(boxes.double()).numpy()  # (M, 8, 3)
        begin, end = corners[:, EDGES[:, 0]].reshape(-1, 3), corners[:, EDGES[:, 1]].reshape(-1, 3)
        lines, _ = camera.project_lines(begin, end)
        halo = [withStroke(linewidth=line_width + 1.2, foreground=(1, 1, 1, 0.55))] if image is not None else []
        edges = LineCollection(list(lines), colors=tint, linewidths=line_width, label=label, path_effects=halo)
        axes.add_collection(edges)
        fronts = [camera.project_polygon(each[FRONT]) for each in corners]
        axes.add_collection(PolyCollection([face for face in fronts if len(face)], facecolors=to_rgba(tint, 0.18)))
        bbox, visible = camera.project_boxes(values)
        rectangles = bbox[visible][:, [[0, 1], [2, 1], [2, 3], [0, 3]]]  # (V, 4, 2)
        around = PolyCollection(list(rectangles), facecolors="none", edgecolors=tint, linewidths=0.7, linestyles=":")
        axes.add_collection(around)
        for k in np.flatnonzero(visible):
            _write_text(axes, bbox[k, [0, 2]].mean(), bbox[k, 1] - 2, texts[k], tint, "bottom")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_xticks([])
    axes.set_yticks([])
    return drawn


# --- for both ---------------------------------------------------------------------------------------------------------


def _groups(
    subject: Subject, point_range: Sequence[float] | None = None
) -> Iterator[tuple[Tensor, list[str], str, float, str]]:
    """Boxes (M, 7), their M scores as text, colour, width of line and name: the labels, then class by class."""
    truth = subject.frame.boxes_of(subject.classes).cpu()
    truth = truth[_is_drawable(truth, point_range)]
    if len(truth):
        yield truth, [""] * len(truth), TRUTH_COLOUR, 2.2, "labelled"
    boxes, scores, labels = (part.cpu() for part in subject.found)
    for label, name in enumerate(subject.classes):
        own = (labels == label) & _is_drawable(boxes, point_range)
        if own.any():
            texts = [f"{score:.2f}" for score in scores[own].tolist()]
            yield boxes[own], texts, CLASS_COLOURS[label % len(CLASS_COLOURS)], 1.2, name


def _is_drawable(boxes: Tensor, point_range: Sequence[float] | None) -> Tensor:
    """Which boxes (M, 7) have a size that can be drawn and, where there is a range, their centre in it."""
    finite = boxes.isfinite().all(dim=1)
    if point_range is None:
        return finite
    low, high = boxes.new_tensor(point_range).view(2, 3)[:, :2]
    inside = ((boxes[:, :2] >= low) & (boxes[:, :2] < high)).all(dim=1)
    return finite & inside & (boxes[:, 3:5] < 10 * (high - low).max()).all(dim=1)


def _scatter(
    axes: Axes,
    x: NDArray[np.floating],
    y: NDArray[np.floating],
    values: NDArray[np.floating],
    limits: tuple[float, float],
    cmap: str,
    size: float,
) -> PathCollection:
    return axes.scatter(
        x, y, s=size, c=values, cmap=cmap, vmin=limits[0], vmax=limits[1], linewidths=0, rasterized=True, zorder=0.8
    )


def _colour_bar(points: PathCollection, place: Axes, label: str) -> None:
    figure = place.get_figure(root=True)
    assert figure is not None
    figure.colorbar(points, cax=place, orientation="horizontal")
    place.set_xlabel(label, fontsize=7, labelpad=1)
    place.tick_params(labelsize=7)


def _write_text(axes: Axes, x: float, y: float, text: str, colour: str, vertical: str) -> None:
    if text:  # labels have no score
        halo = [withStroke(linewidth=1.5, foreground="white")]
        axes.text(x, y, text, color=colour, fontsize=6.5, ha="center", va=vertical, clip_on=True, path_effects=halo)


def write_figure(figure: Figure, path: Path, dpi: float) -> None:
    """Writes a figure in the format of the path's suffix, the same bits for the same figure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    without_date = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix)
    with matplotlib.rc_context({"svg.hashsalt": "hvnet"}):
        figure.savefig(path, dpi=dpi, metadata=without_date)
