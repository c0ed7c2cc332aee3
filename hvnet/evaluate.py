"""KITTI's object evaluation over result files of any detector: AP in 2D, bird's eye view and 3D, and AOS.

The protocol is that of the official C++ devkit (evaluate_object_3d_offline; Geiger et al., CVPR 2012), with 40 and
with 11 recall positions. `exact` is the area under the interpolated precision-recall curve of all detections: the
devkit takes at most one score a ground truth, so with n <= 40 of them no detector gets past (n - 1) / 40 in its R40.
"""

import argparse
import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from hvnet.boxes import points_in_boxes
from hvnet.cli import InputError, make_parser, run_command
from hvnet.data.kitti import (
    Calibration,
    Labels,
    boxes_to_lidar,
    drop_non_finite,
    frame_calibration,
    read_labels,
    read_points,
)
from hvnet.matching import (
    LEVELS,
    LEVELS_WITHOUT_2D,
    METRICS,
    Candidates,
    Counts,
    Floats,
    Integers,
    Level,
    Mask,
    Matching,
    clean_data,
    count,
    distance_levels,
    find_candidates,
    found_scores,
    ground_distance,
    match_at,
    select_truths,
)

CLASSES = ("Car", "Pedestrian", "Cyclist")
MEASURES = ("R40", "R11", "exact")
MIN_OVERLAPS = {
    "strict": {
        "Car": {"2d": 0.7, "bev": 0.7, "3d": 0.7},
        "Pedestrian": {"2d": 0.5, "bev": 0.5, "3d": 0.5},
        "Cyclist": {"2d": 0.5, "bev": 0.5, "3d": 0.5},
    },
    "loose": {
        "Car": {"2d": 0.7, "bev": 0.5, "3d": 0.5},
        "Pedestrian": {"2d": 0.5, "bev": 0.25, "3d": 0.25},
        "Cyclist": {"2d": 0.5, "bev": 0.25, "3d": 0.25},
    },
}
RECALL_STEPS = 40
CURVE_STEPS = 200
DISTANCES = {"0-20 m": (0, 20), "20-40 m": (20, 40), "40-60 m": (40, 60)}
POINT_COUNTS = {"0-9 points": (0, 10), "10-49": (10, 50), "50-199": (50, 200), "200 or more": (200, math.inf)}


def evaluate(
    labels: Sequence[Labels],
    predictions: Sequence[Labels],
    *,
    classes: Sequence[str] = CLASSES,
    levels: Sequence[Level] | None = None,
    score_threshold: float | None = None,
    points: Sequence[Integers] | None = None,
) -> dict[str, dict[str, Any]]:
    """Scores the predictions for frames against their labels; one `Labels` a frame in both.

    For every class: `R40`, `R11` and `exact`, in each `2d`, `aos`, `bev` and `3d` (those that the boxes allow), in each
    a list of one figure in per cent for every level, None where there is no ground truth; `loose`, the same at the
    loose overlaps; `levels`, their names; `counts`; `report`, what is missed and what is found wrongly at one score,
    `score_threshold` or that of the best F1; `warnings`; and `curves`, for strict and loose overlaps and every metric
    one `Counts` a level, thinned to CURVE_STEPS.

    `levels` are by default KITTI's, without their least height in the image where no label has a 2D box. `points` are
    for every frame the numbers of points in the boxes of its labels (K,), see `count_points`; without them the report's
    recall by points is None.
    """
    if len(labels) != len(predictions):
        raise ValueError(f"predictions: want one for each of the {len(labels)} labels, got {len(predictions)}")
    if not labels:
        raise ValueError("labels: want at least one frame, got none")
    unknown = [name for name in classes if name not in CLASSES]
    if unknown:
        raise ValueError(f"classes: want some of {', '.join(CLASSES)}, got {unknown[0]!r}")
    if points is not None and [len(frame) for frame in points] != [len(frame) for frame in labels]:
        raise ValueError("points: want one number for every row of every frame's labels, DontCare too")
    candidates = find_candidates(labels, predictions)
    notes = []
    if levels is None:
        levels = LEVELS
        if not _has(candidates.truths if len(candidates.truths) else candidates.detections, "2d"):
            levels = LEVELS_WITHOUT_2D
            notes = ["no label has a 2D box: the levels go by occlusion and truncation alone"]
    all_points = None if points is None else np.concatenate(points)
    result = {}
    for name in classes:
        result[name] = _evaluate_class(candidates, name, levels, score_threshold, all_points)
        result[name]["counts"]["frames"] = len(labels)
        result[name]["warnings"] = notes + result[name]["warnings"]
    return result


def count_points(points: NDArray[np.float32], labels: Labels, calib: Calibration) -> Integers:
    """How many of the points (N, 4) in LiDAR axes lie in the box of each label: (K,), 0 for DontCare."""
    objects = labels.name != "DontCare"
    boxes = torch.from_numpy(boxes_to_lidar(labels.select(objects), calib))
    counts = np.zeros(len(labels), np.int64)
    counts[objects] = points_in_boxes(torch.from_numpy(points), boxes).sum(dim=0).numpy()
    return counts


def _evaluate_class(
    candidates: Candidates, name: str, levels: Sequence[Level], score_threshold: float | None, points: Integers | None
) -> dict[str, Any]:
    truths = candidates.truths.select(candidates.truths.name == name)
    detections = candidates.detections.select(candidates.detections.name == name)
    metrics = [metric for metric in METRICS if _has(truths, metric) and _has(detections, metric)]
    oriented = not (detections.alpha == -10).any()  # the devkit's mark of an unknown angle
    tables: dict[str, Any] = {}
    curves: dict[str, dict[str, list[Counts]]] = {}
    for strictness, overlaps in MIN_OVERLAPS.items():
        table: dict[str, dict[str, list[float | None]]] = {measure: {} for measure in MEASURES}
        curves[strictness] = {metric: [] for metric in metrics}
        for metric in metrics:
            for level in levels:
                matching = clean_data(candidates, name, metric, overlaps[name][metric], level)
                counts = count(matching, candidates)
                samples = _samples(matching, counts, found_scores(matching, candidates))
                quality = {metric: counts.precision}
                if metric == "2d" and oriented:
                    quality["aos"] = counts.orientation
                for key, values in quality.items():
                    for measure, average in _averages(counts.recall, values, samples).items():
                        found = average if matching.truths.any() else None
                        table[measure].setdefault(key, []).append(found)
                curves[strictness][metric].append(_thin(counts))
        tables[strictness] = table
    truth_counts = [int(select_truths(candidates.truths, name, level).sum()) for level in levels]
    report = None
    if metrics:
        metric = metrics[-1]
        overlap = MIN_OVERLAPS["strict"][name][metric]
        matchings = [clean_data(candidates, name, metric, overlap, level) for level in levels]
        chosen_by = "best F1" if score_threshold is None else "given"
        threshold = _best_score(curves["strict"][metric]) if score_threshold is None else score_threshold
        report = {"metric": metric, "overlap": overlap, "score_threshold": threshold, "chosen_by": chosen_by}
        report |= _report(candidates, matchings, threshold, points)
    return {
        **tables["strict"],
        "loose": tables["loose"],
        "levels": [level.name for level in levels],
        "counts": {"ground_truths": truth_counts, "detections": len(detections)},
        "report": report,
        "warnings": _warnings(truths, detections, levels, truth_counts),
        "curves": curves,
    }


def _has(labels: Labels, metric: str) -> bool:
    """Whether boxes of this kind are given: at least once, as in the devkit, or nothing is given at all."""
    if metric == "2d":
        given = (labels.bbox[:, 0] >= 0) & (labels.bbox[:, 2:] > labels.bbox[:, :2]).all(axis=1)
    elif metric == "bev":
        given = (labels.location[:, [0, 2]] != -1000).all(axis=1) & (labels.dimensions[:, 1:] > 0).all(axis=1)
    else:
        given = (labels.location != -1000).all(axis=1) & (labels.dimensions > 0).all(axis=1)
    return bool(given.any()) or not len(labels)


def _samples(matching: Matching, counts: Counts, scores: Floats) -> Integers:
    """Rows of the counts (at most 41,) at the devkit's thresholds.

    Of the true positives' scores, highest first, those whose recall is nearest to 0, 1/40, 2/40, ...
    """
    total = matching.truths.sum()
    chosen, target = [], 0.0
    for k, score in enumerate(scores):
        last = k == len(scores) - 1
        recall, following = (k + 1) / total, (k + 2) / total
        if last or following - target >= target - recall:
            chosen.append(score)
            target += 1 / RECALL_STEPS
    return np.searchsorted(-counts.score, -np.array(chosen))


def _best_to_the_right(values: Floats) -> Floats:
    return np.maximum.accumulate(values[::-1])[::-1]


def _averages(recall: Floats, values: Floats, samples: Integers) -> dict[str, float]:
    """Averages over recall, in per cent, of precision or orientation (S,): sampled as the devkit does, and exact."""
    sampled = np.zeros(RECALL_STEPS + 1)
    sampled[: len(samples)] = _best_to_the_right(values[samples])
    order = np.argsort(recall, kind="stable")
    area = np.diff(recall[order], prepend=0) @ _best_to_the_right(values[order])
    averages = {"R40": sampled[1:].mean(), "R11": sampled[::4].mean(), "exact": area}
    return {measure: 100 * float(average) for measure, average in averages.items()}


def _thin(counts: Counts) -> Counts:
    """The counts where recall first reaches each of CURVE_STEPS steps; with fewer ground truths, each of theirs."""
    steps = np.floor(counts.recall * CURVE_STEPS + 1e-9)
    return counts.select(np.flatnonzero(np.diff(np.maximum.accumulate(steps), prepend=0) > 0))


def _best_score(curves: Sequence[Counts]) -> float:
    """The score of the best F1 at the middle level, else at the first level where something is found."""
    for curve in (curves[len(curves) // 2], *curves):
        if len(curve.score):
            wrong = curve.false_positives + curve.misses
            f1 = 2 * curve.true_positives / (2 * curve.true_positives + wrong)
            return float(curve.score[f1.argmax()])
    return 0.0


def _report(
    candidates: Candidates, matchings: Sequence[Matching], threshold: float, points: Integers | None
) -> dict[str, Any]:
    """What is missed and what is found wrongly when the detections below a score are dropped."""
    counts: dict[str, list[int]] = {"ground_truths": [], "misses": [], "false_positives": []}
    distance = ground_distance(candidates.truths)
    groups = {"recall_by_distance": {band: _between(distance, limits) for band, limits in DISTANCES.items()}}
    if points is not None:
        groups["recall_by_points"] = {band: _between(points, limits) for band, limits in POINT_COUNTS.items()}
    recalls: dict[str, Any] = {"recall_by_distance": {}, "recall_by_points": None if points is None else {}}
    for matching in matchings:
        matched, taken = match_at(matching, candidates, threshold)
        missed = matching.truths & (matched < 0)
        found = matching.truths & (matched >= 0)
        found[found] = ~matching.ignored[matched[found]]
        wrong = matching.countable & (candidates.score >= threshold) & ~taken
        counts["ground_truths"].append(int(matching.truths.sum()))
        counts["misses"].append(int(missed.sum()))
        counts["false_positives"].append(int(wrong.sum()))
        for group, bands in groups.items():
            for band, inside in bands.items():
                row = recalls[group].setdefault(band, {"ground_truths": [], "recall": []})
                hits, total = int((found & inside).sum()), int(((found | missed) & inside).sum())
                row["ground_truths"].append(total)
                row["recall"].append(100 * hits / total if total else None)
    return {**counts, **recalls}


def _between(values: NDArray, limits: tuple[float, float]) -> Mask:
    return (values >= limits[0]) & (values < limits[1])


def _warnings(truths: Labels, detections: Labels, levels: Sequence[Level], counts: Sequence[int]) -> list[str]:
    """What a reader of the figures has to know; truths and detections are those of the class."""
    warnings = []
    if any(level.min_height > 0 for level in levels):
        for objects, kind in ((truths, "label"), (detections, "detection")):
            if len(objects) and not _has(objects, "2d"):
                warnings.append(f"no {kind} has a 2D box, as these levels ask: see hvnet.evaluate --no-2d-filter")
        flat = int((truths.bbox[:, 3] <= truths.bbox[:, 1]).sum())
        if 0 < flat < len(truths):
            of = f"{flat} of {len(truths)} labels have"
            warnings.append(f"{of} no 2D box, as these levels ask: see hvnet.evaluate --no-2d-filter")
    for level, total in zip(levels, counts, strict=True):
        if 0 < total <= RECALL_STEPS:
            # one threshold a ground truth at most, the first of which stands at recall 0
            best = (100 * (total - 1) / RECALL_STEPS, 100 * math.ceil(total / 4) / 11)
            warnings.append(
                f"{level.name}: {total} ground truths cap R40 at {best[0]:.2f} and R11 at {best[1]:.2f}: read 'exact'"
            )
    return warnings


def format_table(result: dict[str, dict[str, Any]]) -> str:
    """The result of `evaluate` for people, at most 100 columns wide with four levels or fewer."""
    lines = []
    for name, scored in result.items():
        counts, levels = scored["counts"], scored["levels"]
        lines.append(f"{name}: {counts['detections']} detections in {counts['frames']} frames, AP in %")
        if not counts["detections"]:
            totals = ", ".join(f"{total} {level}" for level, total in zip(levels, counts["ground_truths"], strict=True))
            lines[-1] = f"{name}: no detections; ground truths: {totals}"
            continue
        lines.append("")
        side_by_side = [MEASURES] if len(levels) <= 3 else [(measure,) for measure in MEASURES]
        for measures in side_by_side:
            width = 9 * len(levels)
            lines.append(f"{'':10}" + "  ".join(f"{measure:>{width}}" for measure in measures))
            lines.append(f"{'overlap':10}" + "  ".join([_cells(levels)] * len(measures)))
            lines += _rows(name, scored, "strict", measures) + _rows(name, scored["loose"], "loose", measures) + [""]
        lines += [f"! {warning}" for warning in scored["warnings"]] + [""] * bool(scored["warnings"])
        lines += [*_report_lines(scored["report"], levels), ""]
    return "\n".join(lines).rstrip()


def _rows(name: str, table: dict[str, Any], strictness: str, measures: Sequence[str]) -> list[str]:
    rows = []
    for key in table["R40"]:
        overlaps = {kind: MIN_OVERLAPS[kind][name]["2d" if key == "aos" else key] for kind in MIN_OVERLAPS}
        if strictness == "strict" or overlaps["loose"] != overlaps["strict"]:
            cells = "  ".join(_cells([_figure(value) for value in table[measure][key]]) for measure in measures)
            rows.append(f"{key:4}{overlaps[strictness]:<6.2f}{cells}")
    return rows


def _report_lines(report: dict[str, Any] | None, levels: Sequence[str]) -> list[str]:
    if report is None:
        return ["no boxes that could be compared"]
    score = f"score >= {report['score_threshold']:.4g} ({report['chosen_by']})"
    title = f"{report['metric']} overlap {report['overlap']}, {score}"
    lines = [f"{title:44}{_cells(levels, 14)}"]
    for key in ("ground_truths", "misses", "false_positives"):
        lines.append(f"{'  ' + key.replace('_', ' '):44}{_cells(report[key], 14)}")
    for key in ("recall_by_distance", "recall_by_points"):
        title = key.replace("_", " ")
        if report[key] is None:
            lines.append(f"  {title}: not known without the clouds")
            continue
        for band, row in report[key].items():
            cells = [
                "-" if recall is None else f"{recall:.1f} of {total}"
                for recall, total in zip(row["recall"], row["ground_truths"], strict=True)
            ]
            lines.append(f"  {title + ' (%)':26}{band:16}{_cells(cells, 14)}")
    return lines


def _cells(values: Iterable[object], width: int = 9) -> str:
    return "".join(f"{value!s:>{width}}" for value in values)


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def write_csv(path: Path, result: dict[str, dict[str, Any]]) -> None:
    """Writes the precision-recall curves, one line for every point."""
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("class", "metric", "overlap", "level", "score", "recall", "precision", "orientation"))
        for name, strictness, metric, level, curve in _curves(result):
            overlap = MIN_OVERLAPS[strictness][name][metric]
            for row in zip(curve.score, curve.recall, curve.precision, curve.orientation, strict=True):
                writer.writerow((name, metric, overlap, level, *(f"{value:.6g}" for value in row)))


def _curves(result: dict[str, dict[str, Any]]) -> Iterable[tuple[str, str, str, str, Counts]]:
    """Every curve, with its class, strictness, metric and level; a loose one only where it differs from the strict."""
    for name, scored in result.items():
        for strictness, metrics in scored["curves"].items():
            for metric, curves in metrics.items():
                overlaps = [MIN_OVERLAPS[kind][name][metric] for kind in ("strict", "loose")]
                if strictness == "strict" or overlaps[0] != overlaps[1]:
                    for level, curve in zip(scored["levels"], curves, strict=True):
                        yield name, strictness, metric, level, curve


def plot(path: Path, result: dict[str, dict[str, Any]]) -> None:
    """Draws the precision-recall curves: a row for every class, a column for every metric."""
    from matplotlib.figure import Figure  # here, for it takes a second to import

    classes = [name for name, scored in result.items() if scored["counts"]["detections"]] or list(result)
    figure = Figure(figsize=(4 * len(METRICS), 3.4 * len(classes)), layout="constrained")
    axes = figure.subplots(len(classes), len(METRICS), squeeze=False, sharex=True, sharey=True)
    for axis, (name, metric) in zip(axes.flat, ((name, metric) for name in classes for metric in METRICS), strict=True):
        axis.set(title=f"{name}, {metric.upper()}", xlim=(0, 1), ylim=(0, 1.02), xlabel="recall", ylabel="precision")
        axis.grid(alpha=0.3)
        if metric not in result[name]["R40"]:
            axis.text(0.5, 0.5, "not evaluated", ha="center")
    for name, strictness, metric, level, curve in _curves(result):
        if name not in classes:
            continue
        table = result[name] if strictness == "strict" else result[name]["loose"]
        index = result[name]["levels"].index(level)
        overlap, average = MIN_OVERLAPS[strictness][name][metric], table["exact"][metric][index]
        if average is None:
            continue
        # the interpolated curve is level up to each recall, and falls there
        recall = np.concatenate(([0], curve.recall, curve.recall[-1:]))
        best = _best_to_the_right(np.concatenate((curve.precision[:1], curve.precision, [0])))
        axis = axes[classes.index(name), METRICS.index(metric)]
        style = {"color": f"C{index}", "linestyle": "-" if strictness == "strict" else ":", "drawstyle": "steps-pre"}
        axis.plot(recall, best, label=f"{level}, overlap {overlap}: AP {average:.1f}", **style)
    for axis in axes.flat:
        if axis.lines:
            axis.legend(fontsize=7, loc="lower left", title="exact AP in %", title_fontsize=7)
    figure.savefig(path, dpi=120)


def read_folders(
    label_dir: Path, prediction_dir: Path, frames_file: Path | None = None, missing_as_empty: bool = False
) -> tuple[list[str], list[Labels], list[Labels]]:
    """The frames' names, labels and predictions: of all label files, or of the frames that a file names, one a line."""
    label_files = _frame_files(label_dir, "label files")
    prediction_files = _frame_files(prediction_dir, "result files")
    if frames_file is None:
        frames = sorted(label_files)
        stray = sorted(prediction_files.keys() - label_files.keys())
        if stray:
            raise InputError(
                f"{prediction_files[stray[0]]}: frame {stray[0]} has no label file in {label_dir}; add it, or choose "
                "the frames to score with --frames"
            )
    else:
        frames = _read_frames(frames_file, label_files, label_dir)
    missing = [frame for frame in frames if frame not in prediction_files]
    if missing and not missing_as_empty:
        raise InputError(
            f"{prediction_dir}: no result file for {len(missing)} of {len(frames)} frames, the first is "
            f"{missing[0]}.txt; leave them out with --frames, or count them as empty with --missing-as-empty"
        )
    labels, predictions = [], []
    for frame in tqdm(frames, "reading", disable=None, leave=False):
        labels.append(read_labels(label_files[frame]))
        if frame in prediction_files:
            predictions.append(read_labels(prediction_files[frame], scored=True))
        else:
            empty = labels[-1].select(np.zeros(0, np.int64))
            predictions.append(Labels(**{**vars(empty), "score": np.zeros(0)}))
    return frames, labels, predictions


def _frame_files(folder: Path, content: str) -> dict[str, Path]:
    """The .txt files of a folder by frame; KITTI names frames by number, and one number must not come twice."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; it holds the {content}, one FRAME.txt a frame")
    files: dict[str, Path] = {}
    numbers: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() == ".txt":
            number = path.stem.lstrip("0") if path.stem.isdigit() else path.stem
            if number in numbers:
                raise InputError(f"{path}: the same frame as {numbers[number]}; remove one of them")
            numbers[number] = files[path.stem] = path
    if not files:
        raise InputError(f"{folder}: no .txt file; it holds the {content}, one FRAME.txt a frame")
    return files


def _read_frames(path: Path, label_files: dict[str, Path], label_dir: Path) -> list[str]:
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text; it names the frames to score, one a line") from error
    seen: dict[str, int] = {}
    for number, line in enumerate(lines, 1):
        frame = line.strip()
        if not frame:
            continue
        if frame in seen:
            raise InputError(f"{path}:{number}: frame {frame} stands on line {seen[frame]} already; remove one")
        if frame not in label_files:
            raise InputError(f"{path}:{number}: frame {frame} is not in {label_dir}; add its labels or remove the line")
        seen[frame] = number
    if not seen:
        raise InputError(f"{path}: names no frame; write one a line")
    return list(seen)


def _read_point_counts(folder: Path, frames: Sequence[str], labels: Sequence[Labels]) -> list[Integers]:
    counts = []
    for frame, label in zip(tqdm(frames, "counting points", disable=None, leave=False), labels, strict=True):
        points, _ = drop_non_finite(read_points(folder / "velodyne" / f"{frame}.bin"))
        counts.append(count_points(points, label, frame_calibration(folder, frame, label)))
    return counts


def _band(text: str) -> tuple[float, float]:
    near, dash, far = text.partition("-")
    try:
        band = float(near), float(far)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no band such as 20-40") from None
    if not (dash and 0 <= band[0] < band[1]):
        raise argparse.ArgumentTypeError(f"'{text}' is no band such as 20-40")
    return band


def main(argv: Sequence[str] | None) -> None:
    """The command `python -m hvnet.evaluate`."""
    parser = make_parser(
        "evaluate",
        "Scores KITTI result files of any detector as KITTI's devkit does, and reports what is missed.",
        [
            "--labels KITTI/training/label_2 --predictions results --frames val.txt",
            "--labels labels --predictions results --json val.json --plot val.png",
            "--labels labels --predictions results --no-2d-filter",
            "--labels labels --predictions results --distance-bands 0-20 20-40",
            "--labels labels --predictions results --score 0.5 --classes Car",
        ],
    )
    parser.add_argument("--labels", type=Path, required=True, metavar="DIR", help="label files (KITTI's label_2)")
    parser.add_argument("--predictions", type=Path, required=True, metavar="DIR", help="result files with scores")
    parser.add_argument("--frames", type=Path, metavar="FILE", help="names of the frames to score, one a line")
    parser.add_argument(
        "--missing-as-empty", action="store_true", help="a frame without result file has no detections (else an error)"
    )
    parser.add_argument(
        "--classes", nargs="+", choices=CLASSES, default=CLASSES, metavar="CLASS", help="(default: all)"
    )
    parser.add_argument(
        "--no-2d-filter",
        action="store_true",
        help="levels from occlusion and truncation alone, without the height of 2D boxes: for data without images",
    )
    parser.add_argument(
        "--distance-bands",
        type=_band,
        nargs="+",
        metavar="FROM-TO",
        help="levels from the distance in metres alone, such as 0-20 20-40 40-60",
    )
    parser.add_argument(
        "--score", type=float, metavar="X", help="the report counts detections from this score (default: best F1)"
    )
    parser.add_argument(
        "--clouds",
        type=Path,
        metavar="DIR",
        help="folder with velodyne/ and calib/ (none without a camera): adds the recall by number of points in the box",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the precision-recall curves")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw these curves (.png, .pdf, .svg)")
    args = parser.parse_args(argv)
    if args.plot and args.plot.suffix not in (".png", ".pdf", ".svg"):
        raise InputError(f"{args.plot}: not the name of a picture; let it end in .png, .pdf or .svg")
    if args.score is not None and not math.isfinite(args.score):
        raise InputError(f"--score {args.score}: want a finite number")
    levels: Sequence[Level] | None = LEVELS_WITHOUT_2D if args.no_2d_filter else None
    if args.distance_bands:
        levels = distance_levels(args.distance_bands)
    frames, labels, predictions = read_folders(args.labels, args.predictions, args.frames, args.missing_as_empty)
    points = _read_point_counts(args.clouds, frames, labels) if args.clouds else None
    result = evaluate(
        labels, predictions, classes=args.classes, levels=levels, score_threshold=args.score, points=points
    )
    print(format_table(result))
    without = sum(not (args.predictions / f"{frame}.txt").is_file() for frame in frames)
    empty = f", {without} of them without a result file, counted as empty" if without else ""
    print(f"\n{len(frames)} frame{'s' * (len(frames) != 1)} scored{empty}")
    figures = {name: {key: scored[key] for key in scored if key != "curves"} for name, scored in result.items()}
    try:
        if args.json:
            args.json.write_text(json.dumps(figures, indent=1) + "\n")
        if args.csv:
            write_csv(args.csv, result)
        if args.plot:
            plot(args.plot, result)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be written ({error.strerror})") from error


if __name__ == "__main__":
    run_command(main)
