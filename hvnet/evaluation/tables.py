"""The result of an evaluation in readable form: a table, the curves as CSV, and a plot of them."""

import csv
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hvnet.evaluation.bootstrap import CONFIDENCE
from hvnet.evaluation.matching import Counts
from hvnet.evaluation.precision import MEASURES, best_to_the_right
from hvnet.evaluation.rules import METRICS

INTERVAL_WIDTH = 22
"""Columns of a figure with its interval."""


def format_table(result: dict[str, dict[str, Any]]) -> str:
    """The result of `evaluate` as text, at most 100 columns wide with four levels or fewer.

    Of a bootstrap every figure has its interval beside it.
    """
    lines = []
    for name, scored in result.items():
        counts, levels = scored["counts"], scored["levels"]
        lines.append(f"{name}: {counts['detections']} detections in {counts['frames']} frames, AP in %")
        if not counts["detections"]:
            totals = ", ".join(f"{total} {level}" for level, total in zip(levels, counts["ground_truths"], strict=True))
            lines[-1] = f"{name}: no detections; ground truths: {totals}"
            lines += _warning_lines(scored["warnings"])
            continue
        bootstrap = scored.get("bootstrap")
        lines += [*_bootstrap_lines(bootstrap, counts["frames"]), ""] if bootstrap else [""]
        width = INTERVAL_WIDTH if bootstrap else 9
        side_by_side = [MEASURES] if len(levels) <= 3 and not bootstrap else [(measure,) for measure in MEASURES]
        for measures in side_by_side:
            lines.append(f"{'':10}" + "  ".join(f"{measure:>{width * len(levels)}}" for measure in measures))
            lines.append(f"{'overlap':10}" + "  ".join([_cells(levels, width)] * len(measures)))
            lines += [*_rows(scored, "strict", measures), *_rows(scored, "loose", measures), ""]
        lines += _warning_lines(scored["warnings"]) + [""] * bool(scored["warnings"])
        lines += [*_report_lines(scored["report"], levels), ""]
    return "\n".join(lines).rstrip()


def _warning_lines(warnings: Sequence[str]) -> list[str]:
    return [line for warning in warnings for line in textwrap.wrap(f"! {warning}", 100, subsequent_indent="  ")]


def _bootstrap_lines(bootstrap: dict[str, Any], frames: int) -> list[str]:
    kind = "frames" if bootstrap["groups"] == frames else "groups of frames"
    drawn = f"{bootstrap['resamples']} resamples of {bootstrap['groups']} {kind}"
    holding = ", ".join(map(str, bootstrap["groups_with_ground_truths"]))
    return textwrap.wrap(f"[low, high]: {CONFIDENCE} % of {drawn}; {holding} of them hold ground truths", 100)


def _rows(scored: dict[str, Any], strictness: str, measures: Sequence[str]) -> list[str]:
    """The lines of a class at strict or loose overlaps, with intervals where there are any."""
    rows = []
    table, ends = scored, scored["bootstrap"]["intervals"] if "bootstrap" in scored else None
    if strictness == "loose":
        table, ends = table["loose"], ends and ends["loose"]
    for key in _keys(table["R40"], scored["overlaps"], strictness):
        parts = []
        for measure in measures:
            figures = [_figure(value) for value in table[measure][key]]
            if ends is None:
                parts.append(_cells(figures))
            else:
                shown = map(_with_interval, figures, ends[measure][key])
                parts.append(_cells(shown, INTERVAL_WIDTH))
        rows.append(_row_title(key, scored["overlaps"][strictness]) + "  ".join(parts))
    return rows


def _keys(table: Iterable[str], overlaps: dict[str, dict[str, float]], strictness: str) -> list[str]:
    """The metrics of a table; of loose overlaps those that differ from the strict."""
    differ = {metric for metric, overlap in overlaps["loose"].items() if overlap != overlaps["strict"][metric]}
    return [key for key in table if strictness == "strict" or _metric(key) in differ]


def _metric(key: str) -> str:
    return "2d" if key == "aos" else key


def _row_title(key: str, overlaps: dict[str, float]) -> str:
    return f"{key:4}{overlaps[_metric(key)]:<6.2f}"


def _with_interval(figure: str, ends: Sequence[float] | None) -> str:
    return figure if ends is None else f"{figure} [{ends[0]:.1f}, {ends[1]:.1f}]"


def format_differences(
    result: dict[str, dict[str, Any]], differences: dict[str, dict[str, dict[str, list[list[float] | None]]]]
) -> str:
    """What `differences` finds of a result and another, as text."""
    lines = []
    for name, found in differences.items():
        scored = result[name]
        lines.append(f"{name:10}{_cells(scored['levels'], INTERVAL_WIDTH)}")
        for strictness, table in found.items():
            for key in _keys(table, scored["overlaps"], strictness):
                cells = ["-" if each is None else _with_interval(f"{each[0]:+.2f}", each[1:]) for each in table[key]]
                lines.append(_row_title(key, scored["overlaps"][strictness]) + _cells(cells, INTERVAL_WIDTH))
    return "\n".join(lines)


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
