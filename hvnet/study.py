"""The paper's tables and figures as studies: `python -m hvnet.study NAME` trains the rows, prints both side by side.

A row is a config, configs/studies/NAME/ROW.yaml, that holds its difference to another. Rows are trained one by one, for
one seed after the other, and kept: a study that was stopped goes on where it was, and rows that studies share are
trained once.
"""

import argparse
import contextlib
import csv
import fcntl
import hashlib
import itertools
import json
import math
import textwrap
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from hvnet.cli import InputError, add_changes, add_device, make_parser, run_command
from hvnet.config import Config, SyntheticConfig, config_to_dict, load_config
from hvnet.data.kitti import Frame, Labels, detections_to_labels, read_frame, read_split
from hvnet.detector import Detector, load
from hvnet.evaluate import CLASSES, evaluate
from hvnet.kernels.voxel import make_grid
from hvnet.model import HVNet, device_name, select_device
from hvnet.pillars import hard_voxels
from hvnet.train import caught_signals, check_classes, generated_scenes, train

CONFIGS = Path(__file__).resolve().parent / "configs" / "studies"
TIMED_CLOUDS = 10
TIMED_ROUNDS = 3
STAGES = ("encoder", "backbone", "head and NMS")
MEASURES = ("bev", "3d", "aos")


class Row(NamedTuple):
    """One line of a table: its config is configs/studies/STUDY/NAME.yaml."""

    name: str
    label: str
    paper: float | None = None  # BEV mAP, moderate, in %; ms in the study of speed


class Study(NamedTuple):
    """One table or figure."""

    shows: str
    source: str  # where in the paper
    rows: tuple[Row, ...]
    curves: tuple[tuple[str, ...], ...] = ()  # rows that the picture joins, where it shows mAP against time


STUDIES = {
    "components": Study(
        "what each part adds, from one scale without attention to the whole network",
        "ablation table, BEV mAP on KITTI's validation set",
        (
            Row("baseline", "baseline: VFE layers, no pyramid", 71.7),
            Row("attention", "+ attention", 73.76),
            Row("fpn", "+ FPN", 74.34),
            Row("ffpn", "+ FFPN instead", 75.18),
            Row("focal", "focal alpha 0.75 for pedestrians, cyclists", 75.71),
            Row("scale-2-feature", "+ scale 2*: two feature scales", 76.88),
            Row("scale-2", "+ scale 2: two projection scales, too", 77.88),
            Row("scale-3", "+ scale 3: three of both", 78.59),
        ),
    ),
    "scales": Study(
        "how many feature scales N_T and projection scales N_R are worth their time",
        "figure of N_T = 1..5 at N_R = 1 and N_R = 1..5 at N_T = 3; it prints no figures",
        tuple(Row(f"nt{n}", f"N_T = {n}, N_R = 1") for n in range(1, 6))
        + tuple(Row(f"nr{n}", f"N_T = 3, N_R = {n}") for n in range(1, 6)),
        (tuple(f"nt{n}" for n in range(1, 6)), tuple(f"nr{n}" for n in range(1, 6))),
    ),
    "voxel-size": Study(
        "PointPillars with its hard pillars against HVNet, over the size of a voxel",
        "figure of mAP against time; it prints no figures",
        (
            Row("pillars-0.16", "PointPillars, 0.16 m"),
            Row("pillars-0.20", "PointPillars, 0.20 m"),
            Row("pillars-0.24", "PointPillars, 0.24 m"),
            Row("hvnet-0.2", "HVNet, {0.1, 0.2} to 0.2 m"),
            Row("hvnet-0.3", "HVNet, {0.2, 0.3} to 0.3 m"),
            Row("hvnet-0.4", "HVNet, {0.2, 0.4} to 0.4 m"),
        ),
        (("pillars-0.16", "pillars-0.20", "pillars-0.24"), ("hvnet-0.2", "hvnet-0.3", "hvnet-0.4")),
    ),
    "speed": Study(
        "the time of an untrained network at the paper's setting, in all and stage by stage; trains nothing",
        "table of speed: ms on an RTX 2080 Ti",
        (
            Row("vfe", "PointPillars' VFE layer, one class", 34.0),
            Row("hsv", "hybrid voxels by index, one class", 32.0),
            Row("multi-class", "hybrid voxels by index, three classes", 35.0),
        ),
    ),
    "loss": Study(
        "corners against pose, and the losses and branches that the supplement tried",
        "supplement: mean of the classes' BEV AP on KITTI's validation set",
        (
            Row("corners", "corner loss", (88.90 + 69.76 + 77.13) / 3),
            Row("pose", "pose loss: x, y, l, w, theta", (87.67 + 68.37 + 73.34) / 3),
            Row("pose-10", "pose loss at ten times the weight"),
            Row("iou-branch", "+ IoU branch"),
            Row("iou-loss", "IoU loss"),
            Row("giou-loss", "GIoU loss"),
            Row("uncertainty", "learnt weights of the losses"),
            Row("direction", "+ direction branch"),
        ),
    ),
    "density": Study(
        "what the point limit of hard voxels costs, in points and in AP",
        "none: the paper only says that HVNet's voxels lose no point",
        (
            Row("lossless", "every point"),
            Row("limit-100", "100 points a voxel"),
            Row("limit-32", "32 points a voxel"),
            Row("limit-16", "16 points a voxel"),
            Row("limit-8", "8 points a voxel"),
        ),
    ),
}
UNFUSED = (
    " Rows with * have an encoder without fused kernels (these are for attention, voxels that nest, and all points): "
    "their times say nothing about the row's idea."
)
PAPER_STAGES = (12.0, 11.0, 9.0)
"""Encoder, backbone, head with NMS of the paper's 32 ms for one class on an RTX 2080 Ti (Sec. 4.3)."""

Times = tuple[float, float, float]  # milliseconds of the STAGES
Scores = dict[str, dict[str, list[float | None]]]  # class, measure, levels: AP in %


class Outcome(NamedTuple):
    """A row that was trained with one seed."""

    row: Row
    seed: int
    checkpoint: Path
    steps: int
    seconds: float | None  # None if the training was stopped in between
    parameters: int
    device: str
    dropped: float  # share of the points in range that no voxel has a place for, in the validation frames
    scores: Scores
    real_dropped: float | None = None  # both on the frames of --validate
    real: Scores | None = None

    def mean_ap(self, level: int = 1) -> float:
        """BEV mAP in % of easy, moderate or hard objects, over the classes that the frames hold."""
        return mean_of([table["bev"][level] for table in self.scores.values()])


def mean_of(values: Sequence[float | None]) -> float:
    """The mean of the values that there are; NaN of none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else math.nan


def short_table(study: Study, outcomes: Sequence[Outcome], times: dict[str, Times]) -> list[str]:
    """What of a study fits a terminal: mAP, or the stages where nothing is trained, and the time."""
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


def with_budget(config: Config, budget: str, frames: int) -> Config:
    """The config with the epochs of a budget "epochs=N", or "steps=N", rounded up to epochs of that many frames."""
    unit, _, number = budget.partition("=")
    if unit not in ("epochs", "steps") or not number.isdecimal() or int(number) == 0:
        raise InputError(f"--budget {budget}: want epochs=N or steps=N, such as steps=600")
    epochs = int(number)
    if unit == "steps":
        epochs = -(-epochs // max(1, config.train.repeat * frames // config.train.batch_size))
    return replace(config, train=replace(config.train, epochs=epochs))


def score(detector: Detector, root: Path, ids: Sequence[str]) -> Scores:
    """Exact BEV and 3D AP and AOS on frames of a KITTI root; objects outside of the detector's range do not count."""
    truths, found = [], []
    for name in tqdm(ids, desc="scoring", unit="frame", leave=False, dynamic_ncols=True):
        frame = read_frame(root, name)
        boxes = detector(frame.points)
        names = [detector.classes[label] for label in boxes.labels.tolist()]
        found.append(detections_to_labels(boxes.boxes, boxes.scores, names, frame.calib, frame.image_size))
        truths.append(labels_in_range(frame, detector.config))
    result = evaluate(truths, found, classes=detector.classes)
    none: list[float | None] = [None] * 3  # of a measure that the labels do not allow
    return {name: {m: table["exact"].get(m, none) for m in MEASURES} for name, table in result.items()}


def labels_in_range(frame: Frame, config: Config) -> Labels:
    """The labels whose centre is in the config's range, and DontCare."""
    low, high = np.reshape(config.encoder.point_range, (2, 3))[:, :2]
    centres = frame.calib.to_lidar(frame.labels.location)[:, :2]
    near = ((centres >= low) & (centres < high)).all(axis=1)
    return frame.labels.select(near | (frame.labels.name == "DontCare"))


def count_cars(config: Config, root: Path, ids: Sequence[str]) -> int:
    """The moderate cars in range: one of them is so many times less than 100 points of recall."""
    labels = [labels_in_range(read_frame(root, name), config) for name in ids]
    nothing = [Labels(**{**vars(each.select(np.zeros(0, np.int64))), "score": np.zeros(0)}) for each in labels]
    return evaluate(labels, nothing, classes=["Car"])["Car"]["counts"]["ground_truths"][1]


def dropped_share(config: Config, root: Path, ids: Sequence[str]) -> float:
    """The share of the points in range that the limits of hard voxels drop."""
    encoder = config.encoder
    if not encoder.point_limit:
        return 0.0
    grid = make_grid(encoder.point_range, encoder.voxel_size, 1.0)
    whole = kept = 0
    for name in ids:
        points = read_frame(root, name).points
        sample = torch.zeros(len(points), dtype=torch.int64)
        whole += len(hard_voxels(points, sample, 1, grid, 0, 0).point)
        kept += len(hard_voxels(points, sample, 1, grid, encoder.point_limit, encoder.voxel_limit).point)
    return 1 - kept / max(1, whole)


def run_row(row: Row, config: Config, root: Path, real: Path | None, folder: Path, device: torch.device) -> Outcome:
    """Trains and scores a row in a folder, or takes up what of it there is."""
    checkpoint, file = folder / "checkpoint.pt", folder / "result.json"
    known = read_result(file)
    if "scores" not in known:
        begin, resumed = time.monotonic(), checkpoint.is_file()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            with (
                (folder / "log.txt").open("a", encoding="utf-8") as log,
                contextlib.redirect_stdout(log),
                caught_signals() as signals,
            ):
                train(config, root, folder, device, resumed, signals)
        except SystemExit:
            print("stopped; the same command goes on from here", flush=True)
            raise
        seconds = None if resumed else time.monotonic() - begin
        train_ids, val_ids = (read_split(root, at) for at in (config.train.train_split, config.train.val_split))
        known = {
            "steps": config.train.epochs * max(1, config.train.repeat * len(train_ids) // config.train.batch_size),
            "seconds": seconds,
            "parameters": sum(weight.numel() for weight in HVNet(config).parameters()),
            "device": describe(device),
            "dropped": dropped_share(config, root, val_ids),
            "scores": score(load(checkpoint, str(device)), root, val_ids),
        }
        write_result(file, known)
    if real is not None and (known.get("real_root") != str(real) or "real_dropped" not in known):
        ids = read_split(real, config.train.val_split)
        known |= {"real_root": str(real), "real_dropped": dropped_share(config, real, ids)}
        known |= {"real": score(load(checkpoint, str(device)), real, ids)}
        write_result(file, known)
    found = {key: known[key] for key in ("steps", "seconds", "parameters", "dropped", "scores")}
    of_real = {key: known[key] for key in ("real_dropped", "real")} if real is not None else {}
    where = known.get("device", describe(device))
    return Outcome(row, config.train.seed, checkpoint, device=where, **found, **of_real)


def row_folder(rows: Path, config: Config, data: str, frames: Sequence[Sequence[str]]) -> Path:
    """The folder of a row: config, data and frames are in its name."""
    identity = json.dumps([config_to_dict(config), data, frames])
    return rows / hashlib.sha256(identity.encode()).hexdigest()[:16]


def read_result(file: Path) -> dict[str, Any]:
    """What is known of a row; nothing if the file is not there or damaged."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


def write_result(file: Path, known: dict[str, Any]) -> None:
    """Writes what is known of a row, whole or not at all."""
    partial = file.with_suffix(".partial")
    partial.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    partial.replace(file)


def describe(device: torch.device) -> str:
    """The device, its threads, and the version of torch."""
    threads = f", {torch.get_num_threads()} thread(s)" if device.type == "cpu" else ""
    return f"{device_name(device)}{threads}, torch {torch.__version__}"


def time_stages(detectors: dict[str, Detector], clouds: Sequence[Tensor]) -> dict[str, Times]:
    """Median milliseconds of the STAGES of every detector, cloud by cloud in turns."""
    times: dict[str, list[tuple[float, ...]]] = {name: [] for name in detectors}
    for turn in range(-1, TIMED_ROUNDS):  # the first to warm up
        for points in clouds[: 2 if turn < 0 else None]:
            for name, detector in detectors.items():
                marks = [mark(detector.device)]
                with torch.no_grad():
                    inside = points.to(detector.device)
                    images = detector.encode(inside, torch.zeros(len(inside), dtype=torch.int64).to(inside.device), 1)
                    marks.append(mark(detector.device))
                    levels = detector.backbone(images)
                    marks.append(mark(detector.device))
                    detector.suppress(detector.candidates(*detector.score(levels)))
                    marks.append(mark(detector.device))
                if turn >= 0:
                    times[name].append(tuple(1e3 * (b - a) for a, b in itertools.pairwise(marks)))
    medians = {name: np.median(np.array(rows), axis=0).tolist() for name, rows in times.items()}
    return {name: (encoder, backbone, head) for name, (encoder, backbone, head) in medians.items()}


def mark(device: torch.device) -> float:
    """The time in seconds at which the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def agreement(outcomes: Sequence[Outcome]) -> tuple[int, int, float]:
    """Of how many pairs of rows all seeds agree which is better, of how many pairs, and how far the seeds of a row are
    apart in the median, in points of mAP."""
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
    measures = [(name, "bev") for name in outcomes[0].scores] + [("Car", "3d")]
    measures += [("Car", "aos")] if any(row.name == "direction" for row in study.rows) else []
    measures = [(name, measure) for name, measure in measures if name in outcomes[0].scores]
    head = ["row", *["paper mAP"] * any(row.paper for row in study.rows), "mAP", *(f"seed {seed}" for seed in seeds)]
    head += [name if measure == "bev" else f"{name} {measure.upper()}" for name, measure in measures]
    head += ["dropped %"] * limited + ["real: dropped %"] * (limited and real) + ["real: Car"] * real + ["time"]
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
        cars = [each.real["Car"]["bev"][1] for each in own if each.real and "Car" in each.real]
        cells += [shown(mean_of(cars))] * real
        lines.append("| " + " | ".join([*cells, f"{whole / first:.2f}" + "*" * (row.name not in fused)]) + " |")
    return lines


def speed_table(study: Study, times: dict[str, Times], device: str) -> list[str]:
    """The Markdown table of the study of speed: this device beside the paper's."""
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


def draw_trained(path: Path, name: str, outcomes: Sequence[Outcome], times: dict[str, Times]) -> None:
    """Every seed of every row: mAP by rows, or against time with the study's curves."""
    study = STUDIES[name]
    rows = [row for row in study.rows if row.name in times]
    means = {row.name: mean_of([o.mean_ap() for o in outcomes if o.row.name == row.name]) for row in rows}
    figure = Figure(figsize=(8, 5 if study.curves else 1.4 + 0.45 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    if study.curves:
        for curve, colour, side in zip(study.curves, ("#1f77b4", "#d62728"), (-13, 6), strict=True):
            shown = [row for row in rows if row.name in curve]
            x = [sum(times[row.name]) for row in shown]
            axes.plot(x, [means[row.name] for row in shown], "o-", color=colour)
            for row, at in zip(shown, x, strict=True):
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
                for name, measure in itertools.product(CLASSES, MEASURES):
                    value = scores[name][measure][1] if name in scores else None
                    line[f"{prefix}{name} {measure}"] = shown(value, 3)
            lines.append(common | line | stages | where | {"trained on": outcome.device})
        if not own:
            lines.append(common | stages | where)
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(lines[0]))
        table.writeheader()
        table.writerows(lines)


def list_studies() -> str:
    """What each study shows and costs, for --list."""
    lines = []
    for name, study in STUDIES.items():
        lines += [f"{name}", f"  shows  {study.shows}", f"  paper  {study.source}"]
        if name == "speed":
            lines.append(f"  costs  {len(study.rows)} rows, timed; nothing is trained")
        else:
            config = load_config(CONFIGS / "base.yaml")
            scenes = config.synthetic.train_frames if config.synthetic else 0
            steps = config.train.epochs * (scenes // config.train.batch_size)
            minutes = sum(5 if row.name.startswith("pillars") else 2 for row in study.rows)
            cost = f"{len(study.rows)} rows of {steps} steps: about {minutes} minutes a seed on one core of an AMD EPYC"
            lines.append(f"  costs  {cost}")
        lines += [f"    {row.name:<17}{row.label}" for row in study.rows]
    lines.append("Rows that studies share are trained once. By default every row is trained with two seeds.")
    return "\n".join(lines)


@contextlib.contextmanager
def locked(out: Path) -> Iterator[None]:
    """One study at a time writes into a folder. Raises InputError if another is at it."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{out}: another study is at work there; wait for it, or give another --out") from error
        yield


def run_rows(
    name: str, configs: dict[str, Config], root: Path, frames: Sequence[Sequence[str]], options: argparse.Namespace
) -> list[Outcome]:
    """Trains the rows that are wanted, seed after seed; of the others it takes what there is already."""
    device = select_device(options.device)
    wanted = options.rows or list(configs)
    outcomes: list[Outcome] = []
    count = options.seeds * len(wanted)
    done = 0
    for seed, row in itertools.product(range(options.seeds), STUDIES[name].rows):
        config = configs[row.name]
        if options.budget:
            config = with_budget(config, options.budget, len(frames[0]))
        config = replace(config, train=replace(config.train, seed=config.train.seed + seed))
        folder = row_folder(options.out / "rows", config, str(root) if options.data else root.name, frames)
        if row.name not in wanted:
            if "scores" in read_result(folder / "result.json"):
                outcomes.append(run_row(row, config, root, options.validate, folder, device))
            continue
        done += 1
        print(f"[{done}/{count}] {name}/{row.name}, seed {seed}: ", end="", flush=True)
        outcomes.append(run_row(row, config, root, options.validate, folder, device))
        print(f"mAP {outcomes[-1].mean_ap():.1f}, trained in {shown(outcomes[-1].seconds, 0)} s", flush=True)
    return outcomes


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


class Data(NamedTuple):
    """What the rows of a study are trained, scored and timed on."""

    name: str
    root: Path
    frames: list[list[str]]  # to train, to validate
    clouds: list[Tensor]  # to time: the first to validate


def read_data(name: str, config: Config, options: argparse.Namespace) -> Data:
    """The KITTI root that was given, or generated scenes."""
    if options.data is None and name == "speed" and config.synthetic is None:
        config = replace(config, synthetic=SyntheticConfig(1, TIMED_CLOUDS))
    if options.data is None and config.synthetic is None:
        raise InputError(f"{options.base}: has no key synthetic, so the study needs --data with a KITTI root")
    root = options.data or generated_scenes(config, options.out)
    frames = [read_split(root, split) for split in (config.train.train_split, config.train.val_split)]
    clouds = [read_frame(root, at).points for at in frames[1][:TIMED_CLOUDS]]
    return Data(root.name if options.data else f"generated scenes, seed {config.train.seed}", root, frames, clouds)


def time_rows(configs: dict[str, Config], data: Data, device: torch.device) -> tuple[dict[str, Times], list[str]]:
    """The study of speed: the times of its rows, and the text."""
    torch.manual_seed(0)
    times = time_stages({row: Detector(HVNet(config).eval(), device) for row, config in configs.items()}, data.clouds)
    legend = speed_legend(data.clouds, data.name, next(iter(configs.values())))
    return times, [*speed_table(STUDIES["speed"], times, describe(device)), "", legend]


def train_rows(
    name: str, configs: dict[str, Config], data: Data, real: Sequence[str], options: argparse.Namespace
) -> tuple[list[Outcome], dict[str, Times], list[str]]:
    """Every other study: its rows, their times, and the text. The frames `real` are those of --validate."""
    device, first = select_device(options.device), next(iter(configs.values()))
    outcomes = run_rows(name, configs, data.root, data.frames, options)
    detectors: dict[str, Detector] = {}
    for outcome in outcomes:  # of the first seed that there is
        if outcome.row.name not in detectors:
            detectors[outcome.row.name] = load(outcome.checkpoint, str(device))
    times = time_stages(detectors, data.clouds)
    fused = {row for row, detector in detectors.items() if detector.encoder.is_fused(1)}
    steps = " or ".join(map(str, sorted({outcome.steps for outcome in outcomes})))
    trained_on = " and ".join(sorted({outcome.device for outcome in outcomes}))
    lines = [
        *trained_table(STUDIES[name], outcomes, times, fused),
        "",
        "mAP and the classes: exact AP in bird's eye view, moderate, in %, at an overlap of 0.7 (Car) and 0.5, of the "
        f"objects in range. {data.name}: {len(data.frames[0])} frames to train, {len(data.frames[1])} to validate; "
        f"{steps} steps of {first.train.batch_size} frames; trained on {trained_on}.",
        "",
        f"Time: of a cloud on {describe(device)}; the first row is 1." + UNFUSED * (fused < set(detectors)),
    ]
    if real:
        cars = count_cars(first, options.validate, real)
        lines += ["", f"Real: {len(real)} frames, which hold {cars} moderate cars in range."]
    if options.seeds > 1 and len(times) > 1:
        lines += ["", agreement_legend(outcomes, options.seeds)]
    return outcomes, times, lines


def run_study(name: str, options: argparse.Namespace) -> None:
    """Runs a study and writes its table, its CSV file and its picture."""
    study = STUDIES[name]
    unknown = [row for row in options.rows or () if row not in [each.name for each in study.rows]]
    if unknown:
        known = ", ".join(row.name for row in study.rows)
        raise InputError(f"--rows {unknown[0]}: no row of {name}; there are {known}")
    for option in ("base", "budget", "validate"):
        if name == "speed" and getattr(options, option) is not None:
            raise InputError(f"--{option}: is not for speed, which trains nothing and rests on configs/hvnet.yaml")
    instead = (CONFIGS / "base.yaml", options.base) if options.base else None
    configs = {row.name: load_config(CONFIGS / name / f"{row.name}.yaml", options.set, instead) for row in study.rows}
    first = next(iter(configs.values()))
    check_classes(first, options.base or CONFIGS / "base.yaml")
    if options.budget:
        with_budget(first, options.budget, 1)  # a mistake in it is said before the scenes are made
    device = select_device(options.device)
    data = read_data(name, first, options)
    real = read_split(options.validate, first.train.val_split) if options.validate else []
    outcomes: list[Outcome] = []
    if name == "speed":
        times, lines = time_rows({row: configs[row] for row in options.rows or configs}, data, device)
        draw_speed(options.out / f"{name}.png", times, describe(device))
    else:
        outcomes, times, lines = train_rows(name, configs, data, real, options)
        draw_trained(options.out / f"{name}.png", name, outcomes, times)
    where: dict[str, object] = {"data": data.name, "train frames": len(data.frames[0])}
    where |= {"val frames": len(data.frames[1]), "real frames": len(real), "timed on": describe(device)}
    write_csv(options.out / f"{name}.csv", name, outcomes, times, where)
    text = [f"# {name}: {study.shows}", "", f"In the paper: {study.source}.", "", *lines]
    (options.out / f"{name}.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    summary = [*short_table(study, outcomes, times), lines[-1]]
    print("\n" + "\n".join(textwrap.fill(line, 100) for line in summary) + "\n")
    for suffix, title in (("md", "table"), ("csv", "rows"), ("png", "picture")):
        print(f"{title + ':':<9}{options.out / f'{name}.{suffix}'}")


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "study",
        "Runs a study of the paper: trains its rows and writes a table beside the paper's figures (.md), all rows "
        "(.csv) and a picture (.png). What is done already is kept, so that a study can be stopped and begun again "
        "with the same command.",
        [
            "--list",
            "speed",
            "components --budget steps=600",
            "density --rows lossless limit-8 --validate /data/kitti",
            "components --data /data/kitti --base configs/hvnet.yaml --device cuda",
        ],
    )
    parser.add_argument("name", nargs="?", choices=[*STUDIES], metavar="NAME", help=", ".join(STUDIES))
    parser.add_argument("--list", action="store_true", help="say what each study shows and what it costs")
    parser.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: scenes are generated)")
    parser.add_argument(
        "--validate", type=Path, metavar="DIR", help="a KITTI root whose validation frames score every row, too"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/studies"), metavar="DIR", help="(default: runs/studies)")
    add_device(parser)
    parser.add_argument("--budget", metavar="epochs=N|steps=N", help="length of every training (default: the config's)")
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="trainings of every row (default: 2)")
    parser.add_argument(
        "--rows", nargs="+", metavar="ROW", help="train only these rows; of the others show what is done already"
    )
    parser.add_argument(
        "--base", type=Path, metavar="FILE", help="config under the rows (default: configs/studies/base.yaml)"
    )
    add_changes(parser, "override a config value in every row")
    options = parser.parse_args(arguments)

    if options.list:
        print(list_studies())
        return
    if options.name is None:
        parser.error("want the NAME of a study, or --list")
    if options.seeds < 1:
        raise InputError(f"--seeds {options.seeds}: want 1 or more")
    options.data, options.validate = (path.resolve() if path else None for path in (options.data, options.validate))
    with locked(options.out):
        run_study(options.name, options)


if __name__ == "__main__":
    run_command(main)
