"""The rows of a study: trained, scored and kept one by one, so that a study that was stopped goes on where it was."""

import contextlib
import hashlib
import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from hvnet.config import Config, config_to_dict
from hvnet.data.frame import Frames
from hvnet.data.kitti import KittiFrames
from hvnet.data.labels import no_results
from hvnet.evaluation.bootstrap import resample
from hvnet.evaluation.precision import evaluate
from hvnet.evaluation.scoring import labels_in_range, score
from hvnet.exceptions import InputError, Stopped
from hvnet.kernels.voxel import make_grid
from hvnet.network.detector import Detector, load
from hvnet.network.devices import device_name
from hvnet.network.model import HVNet
from hvnet.network.pillars import hard_voxels
from hvnet.studies.catalogue import Row
from hvnet.training.batches import Data
from hvnet.training.run import Run

MEASURES = ("bev", "3d", "aos")

REAL_RESAMPLES = 1000

Scores = dict[str, dict[str, list[float | None]]]  # class, measure, levels: AP in %
Samples = dict[str, dict[str, list[float]]]  # class, bev or 3d, resamples: moderate AP in %, NaN without ground truths


class RealFrames(NamedTuple):
    """The frames of --validate."""

    frames: KittiFrames
    groups: Sequence[str]  # of every frame, drawn together for the intervals: a drive, or the frame's own name


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
    real_dropped: float | None = None  # these three on the frames of --validate
    real: Scores | None = None
    real_samples: Samples | None = None

    def mean_ap(self, level: int = 1) -> float:
        """BEV mAP in % of easy, moderate or hard objects, over the classes that the frames hold."""
        return mean_of([table["bev"][level] for table in self.scores.values()])


def mean_of(values: Sequence[float | None]) -> float:
    """The mean of the values that there are; NaN of none."""
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else math.nan


def with_budget(config: Config, budget: str, frames: int) -> Config:
    """The config with the epochs of a budget "epochs=N", or "steps=N", rounded up to epochs of that many frames."""
    unit, _, number = budget.partition("=")
    if unit not in ("epochs", "steps") or not number.isdecimal() or int(number) == 0:
        raise InputError(f"--budget {budget}: want epochs=N or steps=N, such as steps=600")
    epochs = int(number)
    if unit == "steps":
        epochs = -(-epochs // max(1, config.train.repeat * frames // config.train.batch_size))
    return replace(config, train=replace(config.train, epochs=epochs))


def count_objects(config: Config, frames: Frames, name: str) -> int:
    """The moderate objects of a class in range: one of them is so many times less than 100 points of recall."""
    labels = [labels_in_range(frames[k], config) for k in range(len(frames))]
    nothing = [no_results()] * len(labels)
    return evaluate(labels, nothing, classes=[name])[name]["counts"]["ground_truths"][1]


def dropped_share(config: Config, frames: Frames) -> float:
    """The share of the points in range that the limits of hard voxels drop."""
    encoder = config.encoder
    if not encoder.point_limit:
        return 0.0
    grid = make_grid(encoder.point_range, encoder.voxel_size, 1.0)
    whole = kept = 0
    for k in range(len(frames)):
        points = frames[k].points
        sample = torch.zeros(len(points), dtype=torch.int64)
        whole += len(hard_voxels(points, sample, 1, grid, 0, 0).point)
        kept += len(hard_voxels(points, sample, 1, grid, encoder.point_limit, encoder.voxel_limit).point)
    return 1 - kept / max(1, whole)


def score_in_range(detector: Detector, frames: Frames) -> Scores:
    """Exact BEV and 3D AP and AOS on labelled frames; objects outside of the detector's range do not count."""
    return _exact(score(detector, frames, in_range=True, background=False))


def _exact(result: dict[str, dict[str, Any]]) -> Scores:
    none: list[float | None] = [None] * 3  # of a measure that the labels do not allow
    return {name: {m: table["exact"].get(m, none) for m in MEASURES} for name, table in result.items()}


def score_real(detector: Detector, real: RealFrames) -> tuple[Scores, Samples]:
    """As `score_in_range`, and the BEV and 3D AP of resamples, which are the same ones for every detector."""
    resampling = resample(REAL_RESAMPLES, real.groups)
    result = score(detector, real.frames, in_range=True, background=False, resampling=resampling)
    none = [None, np.full(REAL_RESAMPLES, np.nan)]
    samples = {
        name: {m: table["resampled"]["strict"]["exact"].get(m, none)[1].round(2).tolist() for m in ("bev", "3d")}
        for name, table in result.items()
    }
    return _exact(result), samples


def run_row(
    row: Row, config: Config, data: Data, real: RealFrames | None, folder: Path, device: torch.device
) -> Outcome:
    """Trains and scores a row in a folder, or takes up what of it there is. Raises Stopped if a signal comes."""
    checkpoint, file = folder / "checkpoint.pt", folder / "result.json"
    known = read_result(file)
    if "scores" not in known:
        begin, resumed = time.monotonic(), checkpoint.is_file()
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / "log.txt").open("a", encoding="utf-8") as log, contextlib.redirect_stdout(log):
            run = Run(config, data, folder, device, resume=resumed)
            run.train()
        if run.signals:  # came too late for the run to stop at, but there are further rows
            raise Stopped("", run.signals[0])
        seconds = None if resumed else time.monotonic() - begin
        options = config.train
        known = {
            "steps": options.epochs * max(1, options.repeat * len(data.train) // options.batch_size),
            "seconds": seconds,
            "parameters": sum(weight.numel() for weight in HVNet(config).parameters()),
            "device": describe(device),
            "dropped": dropped_share(config, data.val),
            "scores": score_in_range(load(checkpoint, str(device)), data.val),
        }
        write_result(file, known)
    of_real = {}
    if real is not None:
        scored = {"real_root": str(real.frames.root), "real_groups": list(real.groups)}
        if "real_samples" not in known or any(known.get(key) != value for key, value in scored.items()):
            known |= {**scored, "real_dropped": dropped_share(config, real.frames)}
            known["real"], known["real_samples"] = score_real(load(checkpoint, str(device)), real)
            write_result(file, known)
        of_real = {key: known[key] for key in ("real_dropped", "real", "real_samples")}
    found = {key: known[key] for key in ("steps", "seconds", "parameters", "dropped", "scores")}
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
