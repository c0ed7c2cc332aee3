"""A page of what a detector gets wrong: one HTML file that opens from disk, all pictures inside.

It holds the evaluation, the curves of the training, and the worst misses and false positives, each cut out of the
bird's eye view and, with a camera, of its image.
"""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jinja2 import Environment
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from hvnet.data.frame import Frame, Frames
from hvnet.evaluation.mistakes import MISS, Mistake, find_mistakes, worst
from hvnet.evaluation.rules import Rule, config_rules
from hvnet.evaluation.scoring import Detected, background_note, score
from hvnet.evaluation.tables import format_table
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.detector import Detector
from hvnet.network.model import Detections
from hvnet.pictures.clouds import CLASS_COLOURS, TRUTH_COLOUR, Subject, show_bev, show_camera

REACH = 8.0
"""Metres that a crop from above shows to every side of the box."""
DASHED: dict[str, Any] = {
    "fill": False,
    "edgecolor": "#111111",
    "linestyle": "--",
    "path_effects": [withStroke(linewidth=2.5, foreground="white")],
}
"""The line around the box in question."""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<title>Mistakes of {{ checkpoint }}</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 1160px; margin: 2em auto;
  padding: 0 1em }
h2 { margin-top: 2em; border-bottom: 1px solid #ccc }
table { border-collapse: collapse; margin: 1em 0 }
th, td { padding: .2em .8em; text-align: right; border-bottom: 1px solid #ddd; font-variant-numeric: tabular-nums }
th[scope=row], td.name { text-align: left }
th[colspan] { text-align: center }
pre { font-size: 12px; overflow-x: auto }
img { max-width: 100%; height: auto }
.crops { display: grid; grid-template-columns: repeat(auto-fill, minmax(520px, 1fr)); gap: 1.2em }
figure { margin: 0; border: 1px solid #ddd; padding: .6em }
figcaption { margin-top: .3em }
.key { display: inline-block; width: 1.6em; height: .3em; margin: 0 .3em .2em .8em }
</style>
</head>
<body>
<h1>What the detector gets wrong</h1>
<p>{{ checkpoint }} in the {{ frames }} frames of the validation split of {{ root }}, at score {{ min_score }} or more:
{{ misses_in_all }} misses and {{ false_positives_in_all }} false positives.
{%- if background %} {{ background[0]|upper }}{{ background[1:] }}.{% endif %}</p>

<h2>Evaluation</h2>
<table>
<tr><th></th><th></th>{% for measure in measures %}<th colspan="{{ levels|length }}">{{ measure }}</th>{% endfor %}</tr>
<tr><th scope="row">AP in %</th><th scope="row">overlap</th>
{%- for measure in measures %}{% for level in levels %}<th>{{ level }}</th>{% endfor %}{% endfor %}</tr>
{%- for row in rows %}
<tr><th scope="row">{{ row.name }} {{ row.metric }}</th><td class="name">{{ row.overlap }}</td>
{%- for figure in row.figures %}<td>{{ figure }}</td>{% endfor %}</tr>
{%- endfor %}
</table>
<details><summary>all figures</summary><pre>{{ table }}</pre></details>

<h2>Training</h2>
{% if curves %}<img alt="losses and validation AP by epoch" src="{{ curves }}">
{% else %}<p>There is no metrics.jsonl next to the checkpoint.</p>{% endif %}

<p>In every picture: <span class="key" style="background: {{ truth_colour }}"></span>labelled
{%- for name, colour in colours %}<span class="key" style="background: {{ colour }}"></span>{{ name }} detected
{%- endfor %}. Shown are detections at score {{ min_score }} or more, and all of the class that overlap the box in
question, which is the one inside the dashed line. All labelled objects count, those too that KITTI finds too hard to
score.</p>
{% for title, order, crops in sections %}
<h2>{{ title }}</h2>
<p>{% if crops %}{{ order }}{% else %}None.{% endif %}</p>
<div class="crops">
{%- for crop in crops %}
<figure><img class="crop" alt="{{ crop.text }}" src="{{ crop.picture }}">
<figcaption><b>{{ loop.index }}. {{ crop.mistake.name }}</b>, frame {{ crop.mistake.frame }}: {{ crop.text }}
</figcaption></figure>
{%- endfor %}
</div>
{% endfor %}
</body>
</html>
"""


class Crop(NamedTuple):
    """A mistake, its picture as a data URI, and what is to be said of it."""

    mistake: Mistake
    picture: str
    text: str


def draw_curves(metrics: Sequence[dict[str, Any]]) -> bytes:
    """Losses and validation AP (exact, moderate, BEV and 3D) by epoch, as SVG."""
    figure = Figure(figsize=(10.5, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True)
    epochs = [record["epoch"] for record in metrics]
    for name in (name for name in metrics[0] if name not in ("epoch", "step", "validation")):
        width = 2.0 if name == "loss" else 1.0
        left.plot(epochs, [record.get(name) for record in metrics], label=name, linewidth=width, marker=".")
    validated = [record for record in metrics if "validation" in record]
    for k, name in enumerate(validated[0]["validation"] if validated else []):
        for metric, style in (("bev", "-"), ("3d", ":")):
            values = [record["validation"][name]["exact"].get(metric, [None] * 3)[1] for record in validated]
            if any(value is not None for value in values):
                at = [record["epoch"] for record in validated]
                colour = CLASS_COLOURS[k % len(CLASS_COLOURS)]
                right.plot(at, values, style, color=colour, marker=".", label=f"{name} {metric.upper()}")
    left.set(title="mean loss of the epoch", xlabel="epoch", yscale="log")
    right.set(title="validation, exact AP, moderate (%)", xlabel="epoch", ylim=(0, 100))
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if axes.lines:
            axes.legend(fontsize=8)
    file = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "hvnet"}):
        figure.savefig(file, format="svg", metadata={"Date": None})
    return file.getvalue()


def draw_crop(mistake: Mistake, subject: Subject) -> bytes:
    """The neighbourhood of a mistake from above, the box inside a dashed line, as PNG; left of it in the image."""
    camera = subject.frame.camera
    wide = 2.8 if camera is None else 7.6
    figure = Figure(figsize=(wide, 2.7), dpi=120)
    # places in parts of the figure: 4.8 by 2.4 inches and 2.4 by 2.4; a layout that is found takes half as long again
    above = figure.add_axes((1 - 2.45 / wide, 0.093, 2.4 / wide, 0.889))
    show_bev(above, subject, _around(mistake))
    above.set(xlabel="", ylabel="")
    above.tick_params(labelsize=7)
    x, y, _, length, width, *_ = mistake.box.tolist()
    above.add_patch(Circle((-y, x), math.hypot(length, width) / 2 + 0.4, **DASHED))
    if camera is not None:
        axes = figure.add_axes((0.05 / wide, 0.093, 4.8 / wide, 0.889))
        show_camera(axes, subject)
        bbox, visible = camera.project_boxes(mistake.box[None].numpy())
        if visible[0]:
            _zoom_in(axes, bbox[0], camera.size)
    canvas, file = FigureCanvasAgg(figure), io.BytesIO()
    canvas.draw()
    # a palette takes a third of the bytes, and a page holds many crops; an octree's keeps the colours of thin lines
    whole = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    whole.quantize(256, Image.Quantize.FASTOCTREE).save(file, format="PNG")
    return file.getvalue()


def _zoom_in(axes: Axes, bbox: NDArray[np.float64], size: tuple[int, int]) -> None:
    """Shows the neighbourhood of a 2D box (4,) of an image, the box inside a dashed line."""
    x, y, width, height = _window(bbox, size)
    axes.set_xlim(x, x + width)
    axes.set_ylim(y + height, y)
    margin = 0.03 * height
    wide, high = bbox[2:] - bbox[:2] + 2 * margin
    axes.add_patch(Rectangle(tuple(bbox[:2] - margin), wide, high, **DASHED))


def _around(mistake: Mistake) -> tuple[float, ...]:
    """The range from above: least x, y, z, then greatest."""
    x, y = mistake.box[:2].tolist()
    return x - REACH, y - REACH, -3.0, x + REACH, y + REACH, 1.0


def _window(bbox: NDArray[np.float64], size: tuple[int, int]) -> tuple[float, float, float, float]:
    """Left, top, width and height of a piece of the image, twice as wide as high, with a 2D box in its middle."""
    wide, high = bbox[2:] - bbox[:2]
    height = min(max(60.0, 2.2 * high, 1.2 * wide), size[1])
    width = min(2 * height, size[0])
    x, y = (bbox[:2] + bbox[2:] - (width, height)) / 2
    return min(max(x, 0.0), size[0] - width), min(max(y, 0.0), size[1] - height), width, height


def describe(mistake: Mistake, point_range: Sequence[float]) -> str:
    """A sentence on a mistake."""
    where = f"{mistake.distance:.1f} m away, {mistake.points} points in the box"
    low, high = point_range[:2], point_range[3:5]
    at = mistake.box[:2].tolist()
    if any(not least <= value < most for least, value, most in zip(low, at, high, strict=True)):
        where += ", outside the detector's range"
    if mistake.kind != MISS:
        near = (
            f"best overlap with a label {mistake.overlap:.2f}" if mistake.overlap > 0 else "no label of its class there"
        )
        return f"score {mistake.score:.2f}, {where}, {near}"
    near = f"best overlap {mistake.overlap:.2f}, with a detection of score {mistake.score:.2f}"
    return f"{where}, {near if mistake.overlap > 0 else 'no detection of its class there'}"


def make_crop(mistake: Mistake, detector: Detector, frame: Frame, found: Detections, min_score: float) -> Crop:
    """Draws a mistake in its frame."""
    own = found.labels == detector.classes.index(mistake.name)
    shown = (found.scores >= min_score) | (own & (rotated_iou_bev(mistake.box[None], found.boxes)[0] > 0))
    subject = Subject(frame, found.select(shown), detector.classes)
    text = describe(mistake, detector.config.encoder.point_range)
    return Crop(mistake, _data_uri("image/png", draw_crop(mistake, subject)), text)


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


def summary_rows(result: dict[str, dict[str, Any]], measures: Sequence[str]) -> list[dict[str, Any]]:
    """Rows of the summary: class, metric, overlap, and the AP of every measure and level as text."""
    rows = []
    for name, scored in result.items():
        for strictness, table in (("strict", scored), ("loose", scored["loose"])):
            for metric in ("bev", "3d"):
                if metric in table["R40"]:
                    figures = [value for measure in measures for value in table[measure][metric]]
                    texts = ["-" if value is None else f"{value:.1f}" for value in figures]
                    overlap = scored["overlaps"][strictness][metric]
                    rows.append({"name": name, "metric": metric.upper(), "overlap": overlap, "figures": texts})
    return rows


def make_page(
    checkpoint: Path,
    metrics: list[dict[str, Any]],
    detector: Detector,
    frames: Frames,
    *,
    of: str,
    count: int,
    min_score: float,
    rules: Mapping[str, Rule] | None = None,
) -> str:
    """Detects in labelled frames, those `of` a data set, and writes the page, with `count` mistakes of each kind.

    metrics: the records of the training, none if there are none.
    """
    rules = rules or config_rules(detector.config)
    detections: dict[str, Detections] = {}
    mistakes: list[Mistake] = []
    labelled: list[str] = []

    def visit(detected: Detected) -> None:
        labelled.extend(detected.frame.objects.names if detected.frame.objects else ())
        detections[detected.frame.name] = detected.found
        mistakes.extend(find_mistakes(detected.frame, detected.found, rules, min_score))

    result = score(detector, frames, rules=rules, visit=visit, title="detecting")
    chosen = worst(mistakes, count)
    bar = tqdm([each for kind in chosen for each in kind], desc="drawing", unit="crop", dynamic_ncols=True)
    place = {name: k for k, name in enumerate(frames.names)}
    crops = [make_crop(each, detector, frames[place[each.frame]], detections[each.frame], min_score) for each in bar]
    misses, false_positives = crops[: len(chosen[0])], crops[len(chosen[0]) :]
    measures = ("exact", "R40")
    in_all = sum(each.kind == MISS for each in mistakes)
    return (
        Environment(autoescape=True)
        .from_string(PAGE)
        .render(
            checkpoint=checkpoint,
            root=of,
            frames=len(frames),
            min_score=f"{min_score:g}",
            background=background_note(labelled, detector.classes),
            misses_in_all=in_all,
            false_positives_in_all=len(mistakes) - in_all,
            measures=measures,
            levels=next(iter(result.values()))["levels"],
            rows=summary_rows(result, measures),
            table=format_table(result),
            curves=_data_uri("image/svg+xml", draw_curves(metrics)) if metrics else None,
            truth_colour=TRUTH_COLOUR,
            colours=list(zip(detector.classes, CLASS_COLOURS * len(detector.classes), strict=False)),
            sections=[
                ("Misses", "Those with the most points in the box first.", misses),
                ("False positives", "Those with the best score first.", false_positives),
            ],
        )
    )
