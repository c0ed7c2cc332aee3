"""Training, from top to bottom: `python -m hvnet.train`. Without arguments it trains the demo on generated scenes."""

import argparse
import hashlib
import json
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from hvnet.cli import InputError, run_command
from hvnet.config import Config, TrainConfig, config_to_dict, load_config
from hvnet.data.augment import augment, mix_sectors
from hvnet.data.database import FILE_NAME, Database, build_database, read_database, write_database
from hvnet.data.kitti import (
    Frame,
    detections_to_labels,
    read_calibration,
    read_frame,
    read_labels,
    read_points,
    read_split,
)
from hvnet.data.synthetic import Options, generate
from hvnet.detector import Detector
from hvnet.draw import draw_bev
from hvnet.evaluate import CLASSES, evaluate, format_table
from hvnet.model import HVNet, load_checkpoint, save_checkpoint, select_device

DEMO = Path(__file__).resolve().parent.parent / "configs" / "demo.yaml"
CHANGEABLE = [f"train.{key}" for key in ("epochs", "learning_rate", "validate_every", "pictures", "workers")]
"""What may differ from the run that --resume takes up."""


class Batch(NamedTuple):
    """Several frames in one: all points, the sample of each, and the boxes of every sample."""

    points: Tensor  # (N, 4)
    sample: Tensor  # (N,) int64
    boxes: list[Tensor]  # (M_b, 7) each
    labels: list[Tensor]  # (M_b,) int64 each, index into the config's classes
    notes: list[str]  # what is to be said of the frames' files, once

    def to(self, device: torch.device) -> "Batch":
        """The batch on a device."""
        boxes, labels = [b.to(device) for b in self.boxes], [at.to(device) for at in self.labels]
        return Batch(self.points.to(device), self.sample.to(device), boxes, labels, self.notes)


Sample = tuple[Tensor, Tensor, Tensor, str]


class TrainingFrames(Dataset[Sample]):
    """The frames of a split, augmented; item (epoch, k) depends on the seed, the epoch and k alone."""

    def __init__(self, root: Path, ids: list[str], config: Config, database: Database | None) -> None:
        self.root, self.ids, self.config, self.database = root, ids, config, database
        self.classes = [entry.name for entry in config.head.classes]
        self.kept: dict[int, Frame] = {}

    def __getitem__(self, item: tuple[int, int]) -> Sample:
        epoch, k = item
        options = self.config.augment
        generator = seeded(self.config.train.seed, epoch, k)
        points, boxes, labels, note = self.read(k % len(self.ids))
        if options.mix and torch.rand((), generator=generator).item() < options.mix:
            other = int(torch.randint(len(self.ids), (), generator=generator))
            points, boxes, labels = mix_sectors(points, boxes, labels, self.read(other)[:3], generator)
        points, boxes, labels = augment(points, boxes, labels, self.database, options, generator, self.classes)
        low, high = boxes.new_tensor(self.config.encoder.point_range).view(2, 3)
        inside = ((boxes[:, :2] >= low[:2]) & (boxes[:, :2] < high[:2])).all(dim=1) & (labels >= 0)
        return points, boxes[inside], labels[inside], note

    def read(self, k: int) -> Sample:
        """Frame k as it is; boxes of classes that are not trained have label -1."""
        frame = self.kept.get(k) or read_frame(self.root, self.ids[k])
        if self.config.train.workers == 0:  # read once; several workers would each keep all frames
            self.kept[k] = frame
        labels = torch.tensor([self.classes.index(n) if n in self.classes else -1 for n in frame.names]).long()
        return frame.points, frame.boxes, labels, frame.note


class EpochOrder(Sampler[tuple[int, int]]):
    """The items (epoch, k) of an epoch, shuffled by seed and epoch."""

    def __init__(self, count: int, seed: int) -> None:
        self.count, self.seed, self.epoch = count, seed, 0

    def __len__(self) -> int:
        return self.count

    def __iter__(self) -> Iterator[tuple[int, int]]:
        order = torch.randperm(self.count, generator=seeded(self.seed, self.epoch)).tolist()
        return iter([(self.epoch, k) for k in order])


def seeded(*numbers: int) -> torch.Generator:
    """A generator that depends on all of the numbers and on nothing else."""
    seed = 0
    for number in numbers:
        seed = (seed * 6364136223846793005 + number + 1442695040888963407) % 2**63
    return torch.Generator().manual_seed(seed)


def say_once(notes: list[str], said: set[str]) -> None:
    """Prints the notes that were not said before."""
    for text in notes:
        if text and text not in said:
            said.add(text)
            tqdm.write(text)


def collate(samples: Sequence[Sample]) -> Batch:
    """Joins samples into a batch."""
    points, boxes, labels, notes = zip(*samples, strict=True)
    sample = torch.repeat_interleave(torch.arange(len(points)), torch.tensor([len(p) for p in points]))
    return Batch(torch.cat(points), sample, list(boxes), list(labels), list(notes))


def learning_rate(config: TrainConfig, step: int, epoch: int, steps: int) -> float:
    """Linear warm-up from warmup_ratio times the rate, then a decay at each of decay_epochs (Sec. 4.1) or a cosine.

    `steps` is the length of the run.
    """
    if config.cosine:
        done = (step - config.warmup_steps) / max(1, steps - config.warmup_steps)
        decayed = config.learning_rate * (1 + math.cos(math.pi * min(max(done, 0.0), 1.0))) / 2
    else:
        decayed = config.learning_rate * config.decay_ratio ** sum(epoch >= at for at in config.decay_epochs)
    if step < config.warmup_steps:
        return decayed * (config.warmup_ratio + (1 - config.warmup_ratio) * step / config.warmup_steps)
    return decayed


def read_batches(loader: DataLoader) -> Iterator[Batch]:
    """The batches; of a mistake that a worker finds in a file, only the last line of its traceback is passed on."""
    try:
        yield from loader
    except InputError as error:
        raise InputError(str(error).strip().splitlines()[-1].removeprefix("hvnet.cli.InputError: ")) from error


def train_epoch(
    model: HVNet, optimizer: torch.optim.Optimizer, loader: DataLoader, epoch: int, step: int, said: set[str]
) -> tuple[dict[str, float], int]:
    """One epoch from a step on; returns the mean of every loss and the step that comes next."""
    device = next(model.parameters()).device
    config = model.config.train
    model.train()
    sums: dict[str, Tensor] = {}
    count = 0
    title = f"epoch {epoch + 1}/{config.epochs}"
    bar = tqdm(read_batches(loader), total=len(loader), desc=title, unit="batch", leave=False, dynamic_ncols=True)
    for batch in bar:
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(config, step, epoch, config.epochs * len(loader))
        say_once(batch.notes, said)
        batch = batch.to(device)
        terms = model.loss(model(batch.points, batch.sample, len(batch.boxes)), batch.boxes, batch.labels)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
        if not math.isfinite(loss.item() + norm.item()):
            what = f"the loss is {loss.item()} and its gradient's norm {norm.item()} at step {step}"
            raise InputError(f"{what}; lower train.learning_rate and --resume")
        optimizer.step()
        step, count = step + 1, count + 1
        for name, term in {"loss": loss, **terms}.items():
            sums[name] = sums.get(name, torch.zeros((), device=device)) + term.detach()
        bar.set_postfix(loss=f"{loss.item():.3f}", frames=f"{config.batch_size * (bar.format_dict['rate'] or 0):.1f}/s")
    return {name: total.item() / count for name, total in sums.items()}, step


def validate(model: HVNet, root: Path, ids: list[str], pictures: Path, said: set[str]) -> dict[str, dict[str, Any]]:
    """Detects in the frames of a split and scores the boxes as KITTI does; draws the first few into a folder."""
    device = next(model.parameters()).device
    classes = [entry.name for entry in model.config.head.classes]
    detector = Detector(model, device)
    labels, predictions = [], []
    for k, name in enumerate(tqdm(ids, desc="validating", unit="frame", leave=False, dynamic_ncols=True)):
        frame = read_frame(root, name)
        say_once([frame.note], said)
        found = detector(frame.points)
        names = [classes[label] for label in found.labels.tolist()]
        labels.append(frame.labels)
        predictions.append(detections_to_labels(found.boxes, found.scores, names, frame.calib, frame.image_size))
        if k < model.config.train.pictures:
            truth = frame.boxes[[n in classes for n in frame.names]]
            point_range = model.config.encoder.point_range
            draw_bev(pictures / f"{name}.png", frame.points, point_range, truth, *found, classes, f"frame {name}")
    return evaluate(labels, predictions, classes=classes)


def train(config: Config, root: Path, out: Path, device: torch.device, resume: bool) -> None:
    """Trains on a KITTI root, validates, and writes checkpoint.pt, metrics.jsonl, tensorboard/ and pictures/."""
    make_deterministic(config.train.seed)
    train_ids = read_split(root, config.train.train_split)
    val_ids = read_split(root, config.train.val_split)
    for name in tqdm([*train_ids, *val_ids], desc="checking", unit="frame", leave=False, dynamic_ncols=True):
        check_frame(root, name)
    database = load_database(root, config, val_ids) if config.augment.objects else None
    order = EpochOrder(config.train.repeat * len(train_ids), config.train.seed)
    loader: DataLoader = DataLoader(
        TrainingFrames(root, train_ids, config, database),
        batch_size=config.train.batch_size,
        sampler=order,
        collate_fn=collate,
        drop_last=len(order) >= config.train.batch_size,
        num_workers=config.train.workers,
        persistent_workers=config.train.workers > 0,
        # a forked worker would inherit Warp, CUDA and the threads of this process
        multiprocessing_context="spawn" if config.train.workers else None,
    )
    model = HVNet(config).to(device)
    optimizer = torch.optim.Adam(
        model.parameters(), lr=config.train.learning_rate, weight_decay=config.train.weight_decay
    )
    frames = hashlib.sha256(json.dumps([train_ids, val_ids]).encode()).hexdigest()
    first_epoch, step = restore(out / "checkpoint.pt", model, optimizer, frames) if resume else (0, 0)
    print(f"{len(train_ids)} frames to train, {len(val_ids)} to validate, on {device}; the run is {out}", flush=True)

    out.mkdir(parents=True, exist_ok=True)
    metrics = keep_metrics(out / "metrics.jsonl", first_epoch)
    board = SummaryWriter(str(out / "tensorboard"), purge_step=first_epoch + 1)
    if not resume:
        save_run(out, model, optimizer, frames, 0, 0)  # so that a run which fails in its first epoch can be resumed
    said: set[str] = set()
    for epoch in range(first_epoch, config.train.epochs):
        order.epoch = epoch
        losses, step = train_epoch(model, optimizer, loader, epoch, step, said)
        print(
            f"epoch {epoch + 1:3d}  " + "  ".join(f"{name} {value:.6f}" for name, value in losses.items()), flush=True
        )
        record: dict[str, Any] = {"epoch": epoch + 1, "step": step, **losses}
        last = epoch + 1 == config.train.epochs
        if last or (epoch + 1) % config.train.validate_every == 0:
            scores = validate(model, root, val_ids, out / "pictures", said)
            print(format_table(scores), flush=True)
            record["validation"] = {
                name: {measure: table[measure] for measure in ("R40", "exact")} for name, table in scores.items()
            }
        for name, value in flatten(record):
            board.add_scalar(name, value, epoch + 1)
        board.flush()
        with metrics.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        save_run(out, model, optimizer, frames, epoch + 1, step)
    board.close()
    print(f"checkpoint: {out / 'checkpoint.pt'}\npictures:   {out / 'pictures'}")


def check_frame(root: Path, name: str) -> None:
    """Reads the small files of a frame, so that a mistake in one of them is found now and not epochs later."""
    folder = root / "training"
    read_calibration(folder / "calib" / f"{name}.txt")
    read_labels(folder / "label_2" / f"{name}.txt")
    points = folder / "velodyne" / f"{name}.bin"
    if points.stat().st_size % 16:
        read_points(points)  # which says what is wrong


def load_database(root: Path, config: Config, val_ids: list[str]) -> Database:
    """The root's ground-truth database without objects of validation frames.

    Where there is none it is built, and kept in the root if that can be written.
    """
    path = root / FILE_NAME
    if path.is_file():
        database = read_database(path)
    else:
        database = build_database(root, config.train.train_split)
        try:
            write_database(path, database)
        except OSError as error:
            print(f"{path}: not kept ({error.strerror}); it will be built again")
    leaked = np.isin(database.frame, [int(name) for name in val_ids if name.isdecimal()])
    if leaked.any():
        print(f"{path}: {int(leaked.sum())} objects of validation frames are left out")
        database = database.select(~leaked)
    return database


def make_deterministic(seed: int) -> None:
    """Seeds torch, and asks of it the same bits on every run."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.manual_seed(seed)
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.backends.cudnn.benchmark = False


def save_run(out: Path, model: HVNet, optimizer: torch.optim.Optimizer, frames: str, epochs: int, steps: int) -> None:
    """Writes checkpoint.pt: all that a run needs to go on after so many epochs and steps."""
    content = {
        "config": config_to_dict(model.config),
        "model": model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "frames": frames,
        "epoch": epochs,
        "step": steps,
        "random": torch.get_rng_state(),
    }
    save_checkpoint(out / "checkpoint.pt", content)


def restore(path: Path, model: HVNet, optimizer: torch.optim.Optimizer, frames: str) -> tuple[int, int]:
    """Takes up a run where its checkpoint left it; returns the epochs and steps done."""
    content = load_checkpoint(path)
    here = config_to_dict(model.config)
    changed = sorted(key for key, _ in set(_leaves(content["config"])) ^ set(_leaves(here)))
    changed = [key for key in changed if key not in CHANGEABLE]
    if changed:
        raise InputError(f"{path}: was trained with another {changed[0]}; give its config, or another --out")
    if content.get("frames") != frames:
        raise InputError(f"{path}: was trained on other frames; give its --data, or another --out")
    try:
        model.load_state_dict(content["model"])
        optimizer.load_state_dict(content["optimizer"])
        torch.set_rng_state(content["random"])
        return int(content["epoch"]), int(content["step"])
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"{path}: does not hold a whole run ({error}); start anew with another --out") from error


def _leaves(tree: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """The values of a config with their dotted keys."""
    if isinstance(tree, dict):
        for name, value in tree.items():
            yield from _leaves(value, f"{key}.{name}" if key else name)
    else:
        yield key, json.dumps(tree)


def flatten(record: Any, key: str = "") -> Iterator[tuple[str, float]]:
    """The numbers of a nested record with their paths, as TensorBoard names them."""
    if isinstance(record, dict):
        for name, value in record.items():
            yield from flatten(value, f"{key}/{name}" if key else name)
    elif isinstance(record, list):
        for name, value in zip(("easy", "moderate", "hard"), record, strict=False):
            yield from flatten(value, f"{key}/{name}")
    elif record is not None:
        yield key, float(record)


def keep_metrics(path: Path, epochs: int) -> Path:
    """Leaves a line for each epoch that is done: a run may have stopped in or after a line, before its checkpoint."""
    if path.is_file():
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        path.write_text("".join(lines[:epochs]), encoding="utf-8")
    return path


def choose_out(given: str | None, config: Path, resume: bool) -> Path:
    """The run's folder: the one given, or runs/NAME, runs/NAME-2, ... after the config."""
    if given is not None:
        out = Path(given)
    else:
        names = [Path("runs") / (config.stem if k == 1 else f"{config.stem}-{k}") for k in range(1, 10_000)]
        free = next(k for k, path in enumerate(names) if not path.exists())
        out = names[max(free - 1, 0) if resume else free]
    if resume and not (out / "checkpoint.pt").is_file():
        raise InputError(f"{out}: holds no checkpoint.pt to resume; give the run's folder with --out, or no --resume")
    if not resume and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is not empty; give another --out, or --resume to go on with the run in it")
    return out


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m hvnet.train",
        description="Trains HVNet, validates it as KITTI does, and writes checkpoint.pt, metrics.jsonl, tensorboard/"
        " and pictures/ to the run's folder.",
        epilog="examples:\n  python -m hvnet.train\n"
        "  python -m hvnet.train --config configs/compact.yaml --data /data/kitti --set train.batch_size=2\n"
        "  python -m hvnet.train --out runs/demo --resume",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--config", type=Path, default=DEMO, metavar="FILE", help="YAML (default: configs/demo.yaml)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: scenes are generated)")
    parser.add_argument("--out", metavar="DIR", help="folder of the run (default: runs/NAME of the config)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out (default: the latest)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override a config value, such as train.epochs=3",
    )
    options = parser.parse_args(arguments)

    config = load_config(options.config, options.set)
    for k, entry in enumerate(config.head.classes):
        if entry.name not in CLASSES:
            where = f"{options.config}: head.classes[{k}].name"
            raise InputError(f"{where}: unknown class '{entry.name}'; known are {', '.join(CLASSES)}")
    device = select_device(options.device)
    out = choose_out(options.out, options.config, options.resume)
    root = options.data
    if root is None:
        if config.synthetic is None:
            raise InputError(f"{options.config}: has no key synthetic, so it needs --data with a KITTI root")
        scenes, reach = config.synthetic, config.encoder.point_range[3]
        root = out.parent / f"scenes-{scenes.train_frames}-{scenes.val_frames}-{reach:g}m-{config.train.seed}"
        generate(
            root,
            scenes.train_frames,
            scenes.val_frames,
            config.train.seed,
            Options(distance=(4.0, min(reach - 2, 80.0))),
        )
    train(config, root, out, device, options.resume)


if __name__ == "__main__":
    run_command(main)
