"""A study from its configs to its files."""

import contextlib
import itertools
import sys
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from hvnet.config import Config, SyntheticConfig, load_config
from hvnet.data.drives import read_drives
from hvnet.data.frame import object_names
from hvnet.data.kitti import read_split_frames
from hvnet.evaluation.rules import config_rules
from hvnet.evaluation.scoring import background_note
from hvnet.exceptions import InputError, Stopped
from hvnet.network.detector import Detector, load
from hvnet.network.model import HVNet
from hvnet.studies.catalogue import STUDIES
from hvnet.studies.rows import (
    Outcome,
    RealFrames,
    count_objects,
    describe,
    read_result,
    row_folder,
    run_row,
    with_budget,
)
from hvnet.studies.tables import (
    REAL_LEGEND,
    UNFUSED,
    agreement_legend,
    draw_speed,
    draw_trained,
    real_table,
    short_table,
    shown,
    speed_legend,
    speed_table,
    trained_table,
    write_csv,
)
from hvnet.studies.timing import TIMED_CLOUDS, Times, time_stages
from hvnet.training.batches import Data, generated_scenes, kitti_data

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "studies"


@dataclass(frozen=True)
class Options:
    """How a study is run."""

    out: Path
    data: Path | None = None  # a KITTI root; None: scenes are generated
    validate: Path | None = None  # a KITTI root whose validation frames score every row as well
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    budget: str | None = None  # epochs=N or steps=N
    seeds: int = 2
    rows: Sequence[str] = ()  # those to train; of the others what is done is shown; empty: all
    base: Path | None = None  # config under the rows
    changes: Sequence[str] = ()  # overrides of every row
    groups: Path | None = None  # the drives of the frames of `validate`: a CSV file


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
            _lock(file.fileno())
        except OSError as error:
            raise InputError(f"{out}: another study is at work there; wait for it, or give another --out") from error
        yield


def _lock(file: int) -> None:
    """Locks an open file until it is closed. Raises OSError if another process has it."""
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


class StudyData(NamedTuple):
    """What the rows of a study are trained, scored and timed on."""

    name: str
    frames: Data
    clouds: list[Tensor]  # to time: the first to validate

    @property
    def names(self) -> list[list[str]]:
        """The names of the frames to train and to validate."""
        return [list(self.frames.train.names), list(self.frames.val.names)]


def read_data(name: str, config: Config, options: Options) -> StudyData:
    """The KITTI root that was given, or generated scenes."""
    if options.data is None and name == "speed" and config.synthetic is None:
        config = replace(config, synthetic=SyntheticConfig(1, TIMED_CLOUDS))
    if options.data is None and config.synthetic is None:
        raise InputError(f"{options.base}: has no key synthetic, so the study needs --data with a KITTI root")
    frames = kitti_data(options.data or generated_scenes(config, options.out), config)
    clouds = [frames.val[k].points for k in range(min(TIMED_CLOUDS, len(frames.val)))]
    title = options.data.name if options.data else f"generated scenes, seed {config.train.seed}"
    return StudyData(title, frames, clouds)


def run_rows(
    name: str, configs: dict[str, Config], data: StudyData, real: RealFrames | None, options: Options
) -> list[Outcome]:
    """Trains the rows that are wanted, seed after seed; of the others it takes what there is already."""
    root = data.frames.root
    assert root is not None
    wanted = options.rows or list(configs)
    outcomes: list[Outcome] = []
    count = options.seeds * len(wanted)
    done = 0
    for seed, row in itertools.product(range(options.seeds), STUDIES[name].rows):
        config = configs[row.name]
        if options.budget:
            config = with_budget(config, options.budget, len(data.frames.train))
        config = replace(config, train=replace(config.train, seed=config.train.seed + seed))
        folder = row_folder(options.out / "rows", config, str(root) if options.data else root.name, data.names)
        if row.name not in wanted:
            if "scores" in read_result(folder / "result.json"):
                outcomes.append(run_row(row, config, data.frames, real, folder, options.device))
            continue
        done += 1
        print(f"[{done}/{count}] {name}/{row.name}, seed {seed}: ", end="", flush=True)
        try:
            outcomes.append(run_row(row, config, data.frames, real, folder, options.device))
        except Stopped as stop:
            raise Stopped("stopped; the same command continues from here", stop.signal) from stop
        print(f"mAP {outcomes[-1].mean_ap():.1f}, trained in {shown(outcomes[-1].seconds, 0)} s", flush=True)
    return outcomes


def time_rows(configs: dict[str, Config], data: StudyData, device: torch.device) -> tuple[dict[str, Times], list[str]]:
    """The study of speed: the times of its rows, and the text."""
    torch.manual_seed(0)
    times = time_stages({row: Detector(HVNet(config).eval(), device) for row, config in configs.items()}, data.clouds)
    legend = speed_legend(data.clouds, data.name, next(iter(configs.values())))
    return times, [*speed_table(STUDIES["speed"], times, describe(device)), "", legend]


def train_rows(
    name: str, configs: dict[str, Config], data: StudyData, real: RealFrames | None, options: Options
) -> tuple[list[Outcome], dict[str, Times], list[str]]:
    """Every other study: its rows, their times, and the text."""
    first = next(iter(configs.values()))
    every = [data.frames.train, data.frames.val, *([real.frames] if real else [])]
    names = [each for frames in every for k in range(len(frames)) for each in object_names(frames, k) or ()]
    if note := background_note(names, [entry.name for entry in first.head.classes]):
        print(note)
    outcomes = run_rows(name, configs, data, real, options)
    detectors: dict[str, Detector] = {}
    for outcome in outcomes:  # of the first seed that there is
        if outcome.row.name not in detectors:
            detectors[outcome.row.name] = load(outcome.checkpoint, str(options.device))
    times = time_stages(detectors, data.clouds)
    fused = {row for row, detector in detectors.items() if detector.is_fused(1)}
    steps = " or ".join(map(str, sorted({outcome.steps for outcome in outcomes})))
    trained_on = " and ".join(sorted({outcome.device for outcome in outcomes}))
    overlaps = ", ".join(f"{rule.strict['bev']:g} ({name})" for name, rule in config_rules(first).items())
    lines = [
        *trained_table(STUDIES[name], outcomes, times, fused),
        "",
        f"mAP and the classes: exact AP in bird's eye view, moderate, in %, at an overlap of {overlaps}, of the "
        f"objects in range. {data.name}: {len(data.frames.train)} frames to train, {len(data.frames.val)} to validate; "
        f"{steps} steps of {first.train.batch_size} frames; trained on {trained_on}.",
        "",
        f"Time: of a cloud on {describe(options.device)}; the first row is 1." + UNFUSED * (fused < set(detectors)),
    ]
    if real:
        lines += ["", *real_table(STUDIES[name], outcomes)]
        if len(times) > 1:
            lines += ["", *real_table(STUDIES[name], outcomes, less_first=True)]
        first_class = first.head.classes[0].name
        count = count_objects(first, real.frames, first_class)
        held = f"{len(real.frames)} frames, which hold {count} moderate objects of {first_class} in range"
        lines += ["", f"Real: {held}. {REAL_LEGEND}"]
    if options.seeds > 1 and len(times) > 1:
        lines += ["", agreement_legend(outcomes, options.seeds)]
    return outcomes, times, lines


def run_study(name: str, options: Options) -> None:
    """Runs a study and writes its table, its CSV file and its picture."""
    study, device = STUDIES[name], options.device
    unknown = [row for row in options.rows if row not in [each.name for each in study.rows]]
    if unknown:
        known = ", ".join(row.name for row in study.rows)
        raise InputError(f"--rows {unknown[0]}: no row of {name}; there are {known}")
    if options.groups and not options.validate:
        raise InputError(f"--groups {options.groups}: is for --validate; add it")
    for option in ("base", "budget", "validate"):
        if name == "speed" and getattr(options, option) is not None:
            raise InputError(f"--{option}: is not for speed, which trains nothing and rests on configs/hvnet.yaml")
    base = (CONFIGS / "base.yaml", options.base) if options.base else None
    configs = {row.name: load_config(CONFIGS / name / f"{row.name}.yaml", options.changes, base) for row in study.rows}
    first = next(iter(configs.values()))
    if options.budget:
        with_budget(first, options.budget, 1)  # a mistake in it is said before the scenes are made
    data = read_data(name, first, options)
    real = None
    if options.validate:
        frames = read_split_frames(options.validate, first.train.val_split, first.data)
        real = RealFrames(frames, read_drives(options.groups, frames.names) if options.groups else frames.names)
    outcomes: list[Outcome] = []
    if name == "speed":
        times, lines = time_rows({row: configs[row] for row in options.rows or configs}, data, device)
        draw_speed(options.out / f"{name}.png", times, describe(device))
    else:
        outcomes, times, lines = train_rows(name, configs, data, real, options)
        draw_trained(options.out / f"{name}.png", name, outcomes, times)
    where: dict[str, object] = {"data": data.name, "train frames": len(data.frames.train)}
    where |= {
        "val frames": len(data.frames.val),
        "real frames": len(real.frames) if real else 0,
        "timed on": describe(device),
    }
    write_csv(options.out / f"{name}.csv", name, outcomes, times, where)
    text = [f"# {name}: {study.shows}", "", f"In the paper: {study.source}.", "", *lines]
    (options.out / f"{name}.md").write_text("\n".join(text) + "\n", encoding="utf-8")
    summary = [*short_table(study, outcomes, times), lines[-1]]
    print("\n" + "\n".join(textwrap.fill(line, 100) for line in summary) + "\n")
    for suffix, title in (("md", "table"), ("csv", "rows"), ("png", "picture")):
        print(f"{title + ':':<9}{options.out / f'{name}.{suffix}'}")
