"""A page of what a detector gets wrong: `python -m hvnet.errors RUN`, one HTML file that opens from disk.

It holds the evaluation of the validation split, the curves of the training, and the worst misses and false positives,
each cut out of the bird's eye view and, with a camera, of its image. All pictures are inside the file.
"""

import argparse
import base64
import io
import json
import math
from collections.abc import Sequence
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

from hvnet.cli import InputError, add_device, make_parser, run_command
from hvnet.data.kitti import detections_to_labels, project_boxes, read_frame, read_split
from hvnet.detector import Detector, load
from hvnet.draw import CLASS_COLOURS, TRUTH_COLOUR, Camera, Subject, camera_at, show_bev, show_camera
from hvnet.evaluate import CLASSES, MIN_OVERLAPS, evaluate, format_table
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.mistakes import MISS, Mistake, find_mistakes, worst
from hvnet.model import Detections

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
{{ misses_in_all }} misses and {{ false_positives_in_all }} false positives.</p>

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
{% else %}<p>No metrics.jsonl lies beside the checkpoint.</p>{% endif %}

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


class Run(NamedTuple):
    """What there is of a training run."""

    checkpoint: Path
    metrics: list[dict[str, Any]]  # a record an epoch, none where there is no metrics.jsonl
    root: Path | None  # the KITTI root that it was trained on, if the run says so


class Crop(NamedTuple):
    """A mistake, its picture as a data URI, and what is to be said of it."""

    mistake: Mistake
    picture: str
    text: str


def find_run(path: Path) -> Run:
    """The run of a folder of hvnet.train, or of a checkpoint file. Raises InputError if it is neither."""
    if path.is_dir() and not (path / "checkpoint.pt").is_file():
        raise InputError(f"{path}: holds no checkpoint.pt; give the folder of a run of hvnet.train, or a checkpoint")
    if not path.exists():
        raise InputError(f"{path}: no such run; give the folder of a run of hvnet.train, or a checkpoint")
    checkpoint = path / "checkpoint.pt" if path.is_dir() else path
    data = checkpoint.parent / "data.txt"
    try:
        named = data.read_text(encoding="utf-8").strip() if data.is_file() else ""
    except UnicodeDecodeError as error:
        raise InputError(f"{data}: is no text that names a KITTI root; remove it, and give --data") from error
    root = Path(named) if named else None
    return Run(checkpoint, _read_metrics(checkpoint.parent / "metrics.jsonl"), root)


def _read_metrics(path: Path) -> list[dict[str, Any]]:
    records = []
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            record["epoch"]
            for table in record.get("validation", {}).values():
                table["exact"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}:{number}: no record of hvnet.train; remove the line") from error
        records.append(record)
    return records


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


def draw_crop(mistake: Mistake, subject: Subject, camera: Camera | None) -> bytes:
    """The neighbourhood of a mistake from above, the box inside a dashed line, as PNG; left of it in the image."""
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
        show_camera(axes, subject, camera)
        bbox, visible = project_boxes(mistake.box[None].numpy(), camera.calib, camera.size)
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


def make_crop(mistake: Mistake, detector: Detector, root: Path, found: Detections, min_score: float) -> Crop:
    """Reads the mistake's frame again and draws it."""
    frame = read_frame(root, mistake.frame)
    path = root / "training" / "image_2" / f"{mistake.frame}.png"
    camera = camera_at(frame.calib, frame.image_size, path)
    own = found.labels == detector.classes.index(mistake.name)
    shown = (found.scores >= min_score) | (own & (rotated_iou_bev(mistake.box[None], found.boxes)[0] > 0))
    found = Detections(found.boxes[shown], found.scores[shown], found.labels[shown])
    truth = frame.boxes[[name in detector.classes for name in frame.names]]
    subject = Subject(frame.points, truth, *found, detector.classes)
    text = describe(mistake, detector.config.encoder.point_range)
    return Crop(mistake, _data_uri("image/png", draw_crop(mistake, subject, camera)), text)


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
                    overlap = MIN_OVERLAPS[strictness][name][metric]
                    rows.append({"name": name, "metric": metric.upper(), "overlap": overlap, "figures": texts})
    return rows


def make_page(run: Run, detector: Detector, root: Path, count: int, min_score: float) -> str:
    """Detects in the validation split of a KITTI root, and writes the page, with `count` mistakes of each kind."""
    scored = [name for name in detector.classes if name in CLASSES]
    if not scored:
        raise InputError(f"{run.checkpoint}: finds none of {', '.join(CLASSES)}, and no other class is scored")
    names = read_split(root, "val")
    detections: dict[str, Detections] = {}
    labels, rows, mistakes = [], [], []
    for name in tqdm(names, desc="detecting", unit="frame", dynamic_ncols=True):
        frame = read_frame(root, name)
        found = detections[name] = detector(frame.points)
        classes = [detector.classes[label] for label in found.labels.tolist()]
        labels.append(frame.labels)
        rows.append(detections_to_labels(found.boxes, found.scores, classes, frame.calib, frame.image_size))
        mistakes += find_mistakes(frame, found, detector.classes, min_score)
    result = evaluate(labels, rows, classes=scored)
    chosen = worst(mistakes, count)
    bar = tqdm([each for kind in chosen for each in kind], desc="drawing", unit="crop", dynamic_ncols=True)
    crops = [make_crop(each, detector, root, detections[each.frame], min_score) for each in bar]
    misses, false_positives = crops[: len(chosen[0])], crops[len(chosen[0]) :]
    measures = ("exact", "R40")
    in_all = sum(each.kind == MISS for each in mistakes)
    return (
        Environment(autoescape=True)
        .from_string(PAGE)
        .render(
            checkpoint=run.checkpoint,
            root=root,
            frames=len(names),
            min_score=f"{min_score:g}",
            misses_in_all=in_all,
            false_positives_in_all=len(mistakes) - in_all,
            measures=measures,
            levels=next(iter(result.values()))["levels"],
            rows=summary_rows(result, measures),
            table=format_table(result),
            curves=_data_uri("image/svg+xml", draw_curves(run.metrics)) if run.metrics else None,
            truth_colour=TRUTH_COLOUR,
            colours=list(zip(detector.classes, CLASS_COLOURS * len(detector.classes), strict=False)),
            sections=[
                ("Misses", "Those with the most points in the box first.", misses),
                ("False positives", "Those with the best score first.", false_positives),
            ],
        )
    )


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is no score: want a number from 0 to 1")
    return value


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no count: want 1 or more")
    return int(text)


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "errors",
        "Writes a page (HTML, all pictures inside) of a run: its evaluation in the validation split, its curves, and "
        "the worst misses and false positives, from above and, with a camera, in the image.",
        [
            "runs/demo",
            "runs/compact --data /data/kitti --count 50 --min-score 0.3",
            "model.pt --data /data/kitti --out model.html",
        ],
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run of hvnet.train, or a checkpoint")
    parser.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: the one that the run names)")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="(default: errors.html in the run's folder, or here for a checkpoint)"
    )
    parser.add_argument("--count", type=_positive, default=20, metavar="N", help="of each kind (default: 20)")
    parser.add_argument(
        "--min-score", type=_share, default=0.5, metavar="X", help="detections below do not count (default: 0.5)"
    )
    add_device(parser)
    options = parser.parse_args(arguments)

    run = find_run(options.run)
    root = options.data or run.root
    if root is None:
        raise InputError(f"{options.run}: does not name the data that it was trained on; give a KITTI root with --data")
    out = options.out or (options.run if options.run.is_dir() else Path()) / "errors.html"
    if out.is_dir():
        raise InputError(f"{out}: is a folder; --out names the page, such as {out / 'errors.html'}")
    if not out.parent.is_dir() and (out.parent.exists() or not out.parent.parent.is_dir()):
        raise InputError(f"{out.parent}: no folder; --out names the page, such as errors.html")
    page = make_page(run, load(run.checkpoint, options.device), root, options.count, options.min_score)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page, encoding="utf-8")
    print(f"page: {out}")


if __name__ == "__main__":
    run_command(main)
