"""What a study writes: its tables, its CSV file, its picture."""

import csv
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from hvnet.config import Config
from hvnet.evaluation.bootstrap import CONFIDENCE, interval
from hvnet.evaluation.matching import Floats
from hvnet.evaluation.rules import KITTI
from hvnet.studies.catalogue import STUDIES, Study
from hvnet.studies.rows import MEASURES, REAL_RESAMPLES, Outcome, mean_of
from hvnet.studies.timing import STAGES, TIMED_ROUNDS, Times

UNFUSED = (
    " Rows with * have an encoder without fused kernels (these are for attention, voxels that nest, and all points): "
    "their times say nothing about the row's idea."
)
REAL_LEGEND = (
    f"Their tables: exact AP, moderate, in BEV and in 3D, the mean of the seeds, with the {CONFIDENCE} % interval of "
    f"{REAL_RESAMPLES} resamples of the frames or their groups, and the gain over the first row, resample by resample. "
    "The intervals say nothing of other seeds."
)
PAPER_STAGES = (12.0, 11.0, 9.0)
"""Encoder, backbone, head with NMS of the paper's 32 ms for one class on an RTX 2080 Ti (Sec. 4.3)."""


def short_table(study: Study, outcomes: Sequence[Outcome], times: dict[str, Times]) -> list[str]:
    """A study's table for the terminal: mAP, or the stages if nothing is trained, and the time."""
    paper = any(row.paper is not None for row in study.rows)
    stages = [stage.replace(" and", ",") for stage in STAGES]
    what = ["mAP, mean", *["paper's"] * paper, "ms a cloud"] if outcomes else [*stages, "ms a cloud", "2080 Ti, ms"]
    wide = max(len(row.label) for row in study.rows)
    lines = [" " * wide + "".join(f"{title:>12}" for title in what)]
    for row in study.rows:
        if row.name in times:
            own = [outcome.mean_ap() for outcome in outcomes if outcome.row.name == row.name]
            whole = sum(times[row.name])
            trained = [mean_of(own), *[row.paper] * paper, whole]
            values = trained if outcomes else [*times[row.name], whole, row.paper]
            lines.append(f"{row.label:<{wide}}" + "".join(f"{shown(value):>12}" for value in values))
    return lines


def agreement(outcomes: Sequence[Outcome]) -> tuple[int, int, float]:
    """The pairs of rows whose order all seeds agree on, all pairs, and the median spread of a row's seeds in mAP."""
    of_row: dict[str, dict[int, float]] = {}
    seen: set[Path] = set()
    for outcome in outcomes:
        if outcome.checkpoint not in seen and not math.isnan(outcome.mean_ap()):  # two rows may be one training
            seen.add(outcome.checkpoint)
            of_row.setdefault(outcome.row.name, {})[outcome.seed] = outcome.mean_ap()
    alike = pairs = 0
    for a, b in itertools.combinations(of_row.values(), 2):
        differences = [a[seed] - b[seed] for seed in a.keys() & b.keys()]
        if differences:
            alike += min(differences) > 0 or max(differences) < 0
            pairs += 1
    spread = [max(values.values()) - min(values.values()) for values in of_row.values()]
    return alike, pairs, float(np.median(spread)) if spread else math.nan


def shown(value: float | None, digits: int = 1) -> str:
    """A figure of a table; a dash where there is none."""
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def trained_table(study: Study, outcomes: Sequence[Outcome], times: dict[str, Times], fused: set[str]) -> list[str]:
    """The Markdown table of a study whose rows were trained."""
    seeds = sorted({outcome.seed for outcome in outcomes})
    real = all(outcome.real is not None for outcome in outcomes)
    limited = any(outcome.dropped > 0 for outcome in outcomes)
    first_class = next(iter(outcomes[0].scores))
    measures = [(name, "bev") for name in outcomes[0].scores] + [(first_class, "3d")]
    measures += [(first_class, "aos")] if any(row.name == "direction" for row in study.rows) else []
    head = ["row", *["paper mAP"] * any(row.paper for row in study.rows), "mAP", *(f"seed {seed}" for seed in seeds)]
    head += [name if measure == "bev" else f"{name} {measure.upper()}" for name, measure in measures]
    head += (
        ["dropped %"] * limited + ["real: dropped %"] * (limited and real) + [f"real: {first_class}"] * real + ["time"]
    )
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    first = None
    for row in study.rows:
        own = [outcome for outcome in outcomes if outcome.row.name == row.name]
        if not own:
            continue
        whole = sum(times[row.name])
        first = first or whole
        cells = [row.label, *[shown(row.paper)] * any(row.paper for row in study.rows)]
        cells += [shown(mean_of([each.mean_ap() for each in own]))]
        of_seed = {each.seed: each.mean_ap() for each in own}
        cells += [shown(of_seed.get(seed)) for seed in seeds]
        cells += [shown(mean_of([each.scores[name][measure][1] for each in own])) for name, measure in measures]
        cells += [shown(100 * own[0].dropped)] * limited
        cells += [shown(100 * (own[0].real_dropped or 0.0))] * (limited and real)
        of_real = [each.real[first_class]["bev"][1] for each in own if each.real]
        cells += [shown(mean_of(of_real))] * real
        lines.append("| " + " | ".join([*cells, f"{whole / first:.2f}" + "*" * (row.name not in fused)]) + " |")
    return lines


def real_table(study: Study, outcomes: Sequence[Outcome], *, less_first: bool = False) -> list[str]:
    """The Markdown table of a study's rows on real frames, with intervals; or how much they are above the first row."""
    figures = {}
    for row in study.rows:
        if own := [outcome for outcome in outcomes if outcome.row.name == row.name]:
            figures[row.label] = _real_figures(own)
    base = next(iter(figures.values()))
    head = ["real: less the first row" if less_first else "real", *base]
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * len(base)]
    for label, columns in list(figures.items())[less_first:]:
        cells = [label]
        for title, (value, samples) in columns.items():
            if less_first:
                value, samples = value - base[title][0], samples - base[title][1]
            ends = interval(samples)
            sign = "+" if less_first and value >= 0 else ""
            cells.append("-" if ends is None else f"{sign}{value:.1f} [{ends[0]:.1f}, {ends[1]:.1f}]")
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def _real_figures(own: Sequence[Outcome]) -> dict[str, tuple[float, Floats]]:
    """By class the mean of a row's seeds on real frames, and that of each resample (N,)."""
    figures = {}
    classes = list(own[0].real or ())
    for name, measure in [*((name, "bev") for name in classes), (classes[0], "3d")]:
        value = mean_of([each.real[name][measure][1] for each in own if each.real])
        samples = np.mean([each.real_samples[name][measure] for each in own if each.real_samples], axis=0)
        figures[name if measure == "bev" else f"{name} 3D"] = value, samples
    return figures


def speed_table(study: Study, times: dict[str, Times], device: str) -> list[str]:
    """The Markdown table of the study of speed: this device next to the paper's."""
    lines = [
        f"| row | RTX 2080 Ti (the paper's), ms | {device}, ms | " + " | ".join(STAGES) + " |",
        "| --- |" + " ---: |" * (2 + len(STAGES)),
    ]
    for row in study.rows:
        if row.name in times:
            stages = times[row.name]
            cells = [row.label, shown(row.paper), shown(sum(stages)), *map(shown, stages)]
            lines.append("| " + " | ".join(cells) + " |")
    cells = [
        "another device: RTX 2080 Ti (the paper's), one class",
        shown(sum(PAPER_STAGES)),
        "-",
        *map(shown, PAPER_STAGES),
    ]
    return [*lines, "| " + " | ".join(cells) + " |"]


def speed_legend(clouds: Sequence[Tensor], data: str, config: Config) -> str:
    """What was timed."""
    points = int(np.median([len(each) for each in clouds]))
    return (
        f"Medians over {len(clouds)} clouds of {data} ({points:,} points in the median), {TIMED_ROUNDS} times each, "
        "rows in turns. The networks are untrained and their threshold is 0, so that "
        f"{config.head.candidates:,} candidates a class go through NMS, the most there can be."
    )


def agreement_legend(outcomes: Sequence[Outcome], seeds: int) -> str:
    """What the seeds say of the order of the rows."""
    alike, pairs, spread = agreement(outcomes)
    return (
        f"All {seeds} seeds agree on the order of {alike} of {pairs} pairs of rows (chance alone would make "
        f"{pairs / 2 ** (seeds - 1):.0f}); the seeds of a row span {spread:.1f} points of mAP in the median. Smaller "
        "differences mean nothing here."
    )


def draw_trained(path: Path, name: str, outcomes: Sequence[Outcome], times: dict[str, Times]) -> None:
    """Every seed of every row: mAP by rows, or against time with the study's curves."""
    study = STUDIES[name]
    rows = [row for row in study.rows if row.name in times]
    means = {row.name: mean_of([o.mean_ap() for o in outcomes if o.row.name == row.name]) for row in rows}
    figure = Figure(figsize=(8, 5 if study.curves else 1.4 + 0.45 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    if study.curves:
        for curve, colour, side in zip(study.curves, ("#1f77b4", "#d62728"), (-13, 6), strict=True):
            joined = [row for row in rows if row.name in curve]
            x = [sum(times[row.name]) for row in joined]
            axes.plot(x, [means[row.name] for row in joined], "o-", color=colour)
            for row, at in zip(joined, x, strict=True):
                seeds = [outcome.mean_ap() for outcome in outcomes if outcome.row.name == row.name]
                axes.plot([at] * len(seeds), seeds, "_", color=colour, alpha=0.6)
                axes.annotate(row.name, (at, means[row.name]), (5, side), textcoords="offset points", fontsize=8)
        axes.set_xlabel(f"ms a cloud on {outcomes[0].device} (dots: means, dashes: seeds)")
        axes.set_ylabel("BEV mAP, moderate (%)")
        axes.margins(x=0.2, y=0.1)
    else:
        for k, row in enumerate(rows):
            seeds = [outcome.mean_ap() for outcome in outcomes if outcome.row.name == row.name]
            here = axes.plot(seeds, [k] * len(seeds), "|", color="#1f77b4", markersize=12, label="a seed here")
            mean = axes.plot(means[row.name], k, "o", color="#1f77b4", label="mean here")
            handles = [*mean, *here]
        if any(row.paper for row in rows):
            papers = [(row.paper, k) for k, row in enumerate(rows) if row.paper is not None]
            handles += axes.plot(*zip(*papers, strict=True), "D", color="#7f7f7f", label="the paper, on KITTI")
        axes.set_yticks(range(len(rows)), [row.label for row in rows])
        axes.invert_yaxis()
        axes.grid(axis="x", alpha=0.3)
        axes.set_xlabel("BEV mAP, moderate (%)")
        figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.suptitle(f"{name}: {study.shows}", fontsize=10)
    figure.savefig(path, dpi=110)


def draw_speed(path: Path, times: dict[str, Times], device: str) -> None:
    """The stages of every row, and of the paper's, each as a share of its whole: the devices are not the same."""
    study = STUDIES["speed"]
    bars = [(row.label, times[row.name]) for row in study.rows if row.name in times]
    bars.append(("the paper's, one class", PAPER_STAGES))
    figure = Figure(figsize=(8, 1.6 + 0.5 * len(bars)), layout="constrained")
    axes = figure.add_subplot()
    colours = ("#1f77b4", "#ff7f0e", "#2ca02c")
    for k, (_, stages) in enumerate(bars):
        left = 0.0
        for stage, value, colour in zip(STAGES, stages, colours, strict=True):
            share = 100 * value / sum(stages)
            axes.barh(k, share, left=left, color=colour, label=stage if k == 0 else None)
            if share > 6:  # or the text finds no room
                axes.text(left + share / 2, k, f"{value:.0f} ms", ha="center", va="center", fontsize=8, color="white")
            left += share
    axes.set_yticks(range(len(bars)), [label for label, _ in bars])
    axes.invert_yaxis()
    axes.set_xlim(0, 100)
    axes.set_xlabel(f"share of the time (%)\n{device}; the last: RTX 2080 Ti")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, frameon=False, fontsize=8)
    figure.savefig(path, dpi=110)


def write_csv(
    path: Path,
    study: str,
    outcomes: Sequence[Outcome],
    times: dict[str, Times],
    where: dict[str, object],
) -> None:
    """Every row with every seed, or every row of the study of speed; `where` goes into every line."""
    lines: list[dict[str, object]] = []
    classes = list(dict.fromkeys([*KITTI, *(name for outcome in outcomes for name in outcome.scores)]))
    for row in STUDIES[study].rows:
        if row.name not in times:
            continue
        stages = dict(zip((f"{stage} ms" for stage in STAGES), (f"{t:.4g}" for t in times[row.name]), strict=True))
        common = {"study": study, "row": row.name, "paper": shown(row.paper, 2)}
        own = [outcome for outcome in outcomes if outcome.row.name == row.name]
        for outcome in own:
            line: dict[str, object] = {"seed": outcome.seed, "steps": outcome.steps}
            line |= {"train seconds": shown(outcome.seconds, 0), "parameters": outcome.parameters}
            line |= {"dropped": f"{outcome.dropped:.5f}", "real dropped": shown(outcome.real_dropped, 5)}
            for level, title in enumerate(("easy", "moderate", "hard")):
                line[f"mAP {title}"] = shown(outcome.mean_ap(level), 3)
            for prefix, scores in (("", outcome.scores), ("real ", outcome.real or {})):
                for name, measure in itertools.product(classes, MEASURES):
                    value = scores[name][measure][1] if name in scores else None
                    line[f"{prefix}{name} {measure}"] = shown(value, 3)
            for name, measure in itertools.product(classes, ("bev", "3d")):
                samples = (outcome.real_samples or {}).get(name, {}).get(measure, [])
                ends = interval(np.array(samples)) or (None, None)
                line[f"real {name} {measure} low"], line[f"real {name} {measure} high"] = (shown(e, 3) for e in ends)
            lines.append(common | line | stages | where | {"trained on": outcome.device})
        if not own:
            lines.append(common | stages | where)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(lines[0]))
        table.writeheader()
        table.writerows(lines)
