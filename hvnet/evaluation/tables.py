"""The result of an evaluation in readable form: a table, the curves as CSV, and a plot of them."""

import csv
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hvnet.evaluation.matching import Counts
from hvnet.evaluation.precision import MEASURES, best_to_the_right
from hvnet.evaluation.rules import METRICS


def format_table(result: dict[str, dict[str, Any]]) -> str:
    """The result of `evaluate` as text, at most 100 columns wide with four levels or fewer."""
    lines = []
    for name, scored in result.items():
        counts, levels = scored["counts"], scored["levels"]
        lines.append(f"{name}: {counts['detections']} detections in {counts['frames']} frames, AP in %")
        if not counts["detections"]:
            totals = ", ".join(f"{total} {level}" for level, total in zip(levels, counts["ground_truths"], strict=True))
            lines[-1] = f"{name}: no detections; ground truths: {totals}"
            lines += _warning_lines(scored["warnings"])
            continue
        lines.append("")
        side_by_side = [MEASURES] if len(levels) <= 3 else [(measure,) for measure in MEASURES]
        for measures in side_by_side:
            width = 9 * len(levels)
            lines.append(f"{'':10}" + "  ".join(f"{measure:>{width}}" for measure in measures))
            lines.append(f"{'overlap':10}" + "  ".join([_cells(levels)] * len(measures)))
            lines += _rows(scored["overlaps"], scored, "strict", measures)
            lines += [*_rows(scored["overlaps"], scored["loose"], "loose", measures), ""]
        lines += _warning_lines(scored["warnings"]) + [""] * bool(scored["warnings"])
        lines += [*_report_lines(scored["report"], levels), ""]
    return "\n".join(lines).rstrip()


def _warning_lines(warnings: Sequence[str]) -> list[str]:
    return [line for warning in warnings for line in textwrap.wrap(f"! {warning}", 100, subsequent_indent="  ")]


def _rows(
    overlaps: dict[str, dict[str, float]], table: dict[str, Any], strictness: str, measures: Sequence[str]
) -> list[str]:
    rows = []
    for key in table["R40"]:
        metric = "2d" if key == "aos" else key
        overlap, loose = overlaps[strictness][metric], overlaps["loose"][metric]
        if strictness == "strict" or loose != overlaps["strict"][metric]:
            cells = "  ".join(_cells([_figure(value) for value in table[measure][key]]) for measure in measures)
            rows.append(f"{key:4}{overlap:<6.2f}{cells}")
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
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("class", "metric", "overlap", "level", "score", "recall", "precision", "orientation"))
        for name, strictness, metric, level, curve in _curves(result):
            overlap = result[name]["overlaps"][strictness][metric]
            for row in zip(curve.score, curve.recall, curve.precision, curve.orientation, strict=True):
                writer.writerow((name, metric, overlap, level, *(f"{value:.6g}" for value in row)))


def _curves(result: dict[str, dict[str, Any]]) -> Iterable[tuple[str, str, str, str, Counts]]:
    """Every curve, with its class, strictness, metric and level; a loose one only where it differs from the strict."""
    for name, scored in result.items():
        for strictness, metrics in scored["curves"].items():
            for metric, curves in metrics.items():
                overlaps = [scored["overlaps"][kind][metric] for kind in ("strict", "loose")]
                if strictness == "strict" or overlaps[0] != overlaps[1]:
                    for level, curve in zip(scored["levels"], curves, strict=True):
                        yield name, strictness, metric, level, curve


def plot(path: Path, result: dict[str, dict[str, Any]]) -> None:
    """Draws the precision-recall curves: a row for every class, a column for every metric."""
    from matplotlib.figure import Figure  # imported here because it takes a second

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
        overlap, average = result[name]["overlaps"][strictness][metric], table["exact"][metric][index]
        if average is None:
            continue
        # the interpolated curve is level up to each recall, and falls there
        recall = np.concatenate(([0], curve.recall, curve.recall[-1:]))
        best = best_to_the_right(np.concatenate((curve.precision[:1], curve.precision, [0])))
        axis = axes[classes.index(name), METRICS.index(metric)]
        style = {"color": f"C{index}", "linestyle": "-" if strictness == "strict" else ":", "drawstyle": "steps-pre"}
        axis.plot(recall, best, label=f"{level}, overlap {overlap}: AP {average:.1f}", **style)
    for axis in axes.flat:
        if axis.lines:
            axis.legend(fontsize=7, loc="lower left", title="exact AP in %", title_fontsize=7)
    figure.savefig(path, dpi=120)
