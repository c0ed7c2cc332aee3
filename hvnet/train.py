"""Training, from top to bottom: `python -m hvnet.train`. Without arguments it trains the demo on generated scenes.

On a GPU the frames, the database and the augmentation live on the device. Several processes, started by torchrun, train
one model together: each takes its share of every batch, and rank 0 prints and writes.
"""

import contextlib
import hashlib
import json
import math
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from hvnet import ranks
from hvnet.cli import InputError, add_changes, add_device, check_empty, make_parser, run_command
from hvnet.config import Config, TrainConfig, config_to_dict, load_config
from hvnet.data.augment import Objects, augment, mix_sectors, objects_of
from hvnet.data.database import FILE_NAME, Database, build_database, read_database, write_database
from hvnet.data.kitti import (
    Labels,
    detections_to_labels,
    frame_calibration,
    read_frame,
    read_labels,
    read_points,
    read_split,
)
from hvnet.data.synthetic import Options, generate
from hvnet.detector import Detector
from hvnet.draw import Subject, draw_bev
from hvnet.evaluate import CLASSES, evaluate, format_table
from hvnet.model import HVNet, load_checkpoint, save_checkpoint, select_device

DEMO = Path(__file__).resolve().parent / "configs" / "demo.yaml"
SAVE_SECONDS = 300.0
"""A run is saved after every epoch, and within one after so many seconds."""

CHANGEABLE = [
    f"train.{key}"
    for key in ("epochs", "learning_rate", "validate_every", "pictures", "workers", "skip_corrupt", "skip_non_finite")
]
"""What may differ from the run that --resume takes up; the epochs only if the learning rate does not depend on them."""

ROOM = 100 * 2**20
"""Bytes beside the checkpoints that a run may need on the disk."""


class Batch(NamedTuple):
    """Several frames in one: all points, the sample of each, and the boxes of every sample."""

    points: Tensor  # (N, 4)
    sample: Tensor  # (N,) int64
    boxes: list[Tensor]  # (M_b, 7) each
    labels: list[Tensor]  # (M_b,) int64 each, index into the config's classes
    notes: list[str]  # what is to be said of the frames' files, once
    names: list[str]  # of the frames

    def to(self, device: torch.device) -> "Batch":
        """The batch on a device."""
        boxes, labels = [b.to(device) for b in self.boxes], [at.to(device) for at in self.labels]
        return self._replace(points=self.points.to(device), sample=self.sample.to(device), boxes=boxes, labels=labels)


class Sample(NamedTuple):
    """One frame."""

    points: Tensor  # (N, 4), on a GPU where it is trained on one
    boxes: Tensor  # (M, 7)
    labels: Tensor  # (M,) int64, index into the config's classes, or -1
    note: str
    name: str


class TrainingFrames(Dataset[Sample]):
    """The frames of a split, augmented on a device; item (epoch, k) depends on the seed, the epoch and k alone."""

    def __init__(
        self, root: Path, ids: list[str], config: Config, objects: Objects | None, device: torch.device
    ) -> None:
        self.root, self.ids, self.config, self.objects, self.device = root, ids, config, objects, device
        self.classes = [entry.name for entry in config.head.classes]
        self.kept: dict[int, Sample] = {}

    def __getitem__(self, item: tuple[int, int]) -> Sample:
        epoch, k = item
        options = self.config.augment
        generator = seeded(self.config.train.seed, epoch, k)
        frame = self.read(k % len(self.ids))
        points, boxes, labels, note = frame.points, frame.boxes, frame.labels, frame.note
        if options.mix and torch.rand((), generator=generator).item() < options.mix:
            other = self.read(int(torch.randint(len(self.ids), (), generator=generator)))
            others = (other.points, other.boxes, other.labels)
            points, boxes, labels = mix_sectors(points, boxes, labels, others, generator)
            note = "\n".join(filter(None, (note, other.note)))
        points, boxes, labels = augment(points, boxes, labels, self.objects, options, generator, self.classes)
        low, high = boxes.new_tensor(self.config.encoder.point_range).view(2, 3)
        inside = ((boxes[:, :2] >= low[:2]) & (boxes[:, :2] < high[:2])).all(dim=1) & (labels >= 0)
        return Sample(points, boxes[inside], labels[inside], note, frame.name)

    def read(self, k: int) -> Sample:
        """Frame k as it is; boxes of classes that are not trained have label -1.

        Where frames that cannot be read are to be skipped, the next one that can be takes the place.
        """
        if k in self.kept:
            return self.kept[k]
        notes = ""
        for name in self.ids[k:] + self.ids[:k]:
            try:
                frame = read_frame(self.root, name)
                break
            except (InputError, OSError) as error:
                if not self.config.train.skip_corrupt:
                    raise
                notes += f"frame {name} is skipped: {error}\n"
        else:
            raise InputError(f"{self.root}: no frame can be read; the last: {notes.splitlines()[-1]}")
        labels = torch.tensor([self.classes.index(n) if n in self.classes else -1 for n in frame.names]).long()
        note = (notes + (frame.note or "")).strip()
        sample = Sample(frame.points.to(self.device), frame.boxes, labels, note, name)
        if self.config.train.workers == 0:  # read once; several workers would each keep all frames
            self.kept[k] = sample
        return sample


class EpochOrder(Sampler[list[tuple[int, int]]]):
    """Batches of items (epoch, k), shuffled by seed and epoch: of each, from the batch `begin` on, a rank's share.

    The last frames of an epoch that do not fill a batch are left out, unless there are no others.
    """

    def __init__(self, count: int, batch_size: int, seed: int) -> None:
        self.count, self.batch_size, self.seed, self.epoch, self.begin = count, batch_size, seed, 0, 0

    def __len__(self) -> int:
        return max(1, self.count // self.batch_size)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        order = torch.randperm(self.count, generator=seeded(self.seed, self.epoch)).tolist()
        for batch in range(self.begin, len(self)):
            items = order[batch * self.batch_size : (batch + 1) * self.batch_size]
            yield [(self.epoch, k) for k in items[ranks.rank() :: ranks.size()]]


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
    points, boxes, labels, notes, names = zip(*samples, strict=True)
    sample = torch.repeat_interleave(torch.arange(len(points)), torch.tensor([len(p) for p in points]))
    return Batch(torch.cat(points), sample, list(boxes), list(labels), list(notes), list(names))


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


class Progress(NamedTuple):
    """How far a run has come, and the sums of its losses in the epoch that is under way."""

    epoch: int = 0  # epochs done, with their validation
    batch: int = 0  # batches done of the next one
    step: int = 0
    sums: dict[str, float] | None = None


def train_epoch(
    model: HVNet,
    joint: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
    loader: DataLoader,
    progress: Progress,
    out: Path,
    said: set[str],
    signals: list[int],
    save: Callable[[Progress], None],
) -> tuple[Progress, bool]:
    """The rest of an epoch's batches, and whether a signal has come: then it ends early.

    `joint` is the model, with its gradients averaged over the ranks.
    """
    device = next(model.parameters()).device
    config = model.config.train
    model.train()
    saved = time.monotonic()
    epoch, batches, step = progress.epoch, progress.batch, progress.step
    sums = dict(progress.sums or {})
    assert isinstance(loader.batch_sampler, EpochOrder)
    loader.batch_sampler.epoch, loader.batch_sampler.begin = epoch, batches
    bar = tqdm(
        read_batches(loader),
        total=len(loader),
        initial=batches,
        desc=f"epoch {epoch + 1}/{config.epochs}",
        unit="batch",
        leave=False,
        dynamic_ncols=True,
        disable=ranks.rank() > 0,
    )
    for batch in bar:
        for group in optimizer.param_groups:
            group["lr"] = learning_rate(config, step, epoch, config.epochs * len(loader))
        say_once(batch.notes, said)
        batch = batch.to(device)
        statistics = {name: buffer.clone() for name, buffer in model.named_buffers() if config.skip_non_finite}
        terms = model.loss(joint(batch.points, batch.sample, len(batch.boxes)), batch.boxes, batch.labels)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        (ranks.size() * loss).backward()  # the ranks' gradients are averaged, the loss is their sum
        norm = torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
        parts = torch.stack([loss, *terms.values(), torch.full_like(loss, len(signals))]).detach()
        *losses, stop = ranks.joined(parts).tolist()
        if math.isfinite(losses[0] + norm.item()):
            optimizer.step()
            for name, value in zip(("loss", *terms), losses, strict=True):
                sums[name] = sums.get(name, 0.0) + value
            sums["batches"] = sums.get("batches", 0.0) + 1
        else:
            note_non_finite(out, epoch, step, losses[0], norm.item(), batch.names, config.skip_non_finite)
            for name, buffer in model.named_buffers():  # the batch norms have seen what is not finite
                buffer.copy_(statistics[name])
        step, batches = step + 1, batches + 1
        bar.set_postfix(loss=f"{losses[0]:.3f}", frames=f"{config.batch_size * (bar.format_dict['rate'] or 0):.1f}/s")
        if stop:
            bar.close()
            return Progress(epoch, batches, step, sums), True
        if time.monotonic() - saved > SAVE_SECONDS:
            save(Progress(epoch, batches, step, sums))
            saved = time.monotonic()
    return Progress(epoch, batches, step, sums), False


def note_non_finite(out: Path, epoch: int, step: int, loss: float, norm: float, names: list[str], skip: bool) -> None:
    """Keeps the frames of a step whose loss or gradient is not finite in non_finite.jsonl, and ends the run or not."""
    names = [name for share in ranks.gathered(names) for name in share]
    path = out / "non_finite.jsonl"
    if ranks.rank() == 0:
        with path.open("a", encoding="utf-8") as file:
            line = {"epoch": epoch + 1, "step": step, "loss": str(loss), "gradient": str(norm), "frames": names}
            file.write(json.dumps(line) + "\n")
    what = f"the loss is {loss} and its gradient's norm {norm} at step {step}"
    if not skip:
        raise InputError(
            f"{what}; its frames are in {path}; lower train.learning_rate, or set train.skip_non_finite, and --resume"
        )
    if ranks.rank() == 0:
        tqdm.write(f"{what}: left out; its frames are in {path}")


def validate(model: HVNet, root: Path, ids: list[str], pictures: Path, said: set[str]) -> dict[str, dict[str, Any]]:
    """Detects in the frames of a split and scores the boxes as KITTI does; draws the first few into a folder.

    Each rank takes its share of the frames; the scores are those of all.
    """
    detector = Detector(model, next(model.parameters()).device)
    classes = list(detector.classes)
    found_here: list[tuple[Labels, Labels]] = []
    for k in share_of_rank(len(ids)):
        name = ids[k]
        frame = read_frame(root, name)
        say_once([frame.note], said)
        found = detector(frame.points)
        names = [classes[label] for label in found.labels.tolist()]
        rows = detections_to_labels(found.boxes, found.scores, names, frame.calib, frame.image_size)
        found_here.append((frame.labels, rows))
        if k < model.config.train.pictures:
            truth = frame.boxes[[n in classes for n in frame.names]]
            point_range = model.config.encoder.point_range
            subject = Subject(frame.points, truth, *found, classes)
            draw_bev(pictures / f"{name}.png", subject, point_range, f"frame {name}")
    shares = ranks.gathered(found_here)
    both = [shares[k % len(shares)][k // len(shares)] for k in range(len(ids))]  # in the order of the frames
    return evaluate([labels for labels, _ in both], [rows for _, rows in both], classes=classes)


def share_of_rank(count: int) -> Iterable[int]:
    """This rank's share of the numbers below count, with a progress bar."""
    share = range(ranks.rank(), count, ranks.size())
    hidden = ranks.rank() > 0
    return tqdm(share, desc="validating", unit="frame", leave=False, dynamic_ncols=True, disable=hidden)


def train(config: Config, root: Path, out: Path, device: torch.device, resume: bool, signals: list[int]) -> None:
    """Trains on a KITTI root, validates, and writes checkpoint.pt, metrics.jsonl, data.txt, tensorboard/, pictures/.

    If one of the `signals` comes, the run is saved after the step that is under way, and ends.
    """
    make_deterministic(config.train.seed)
    if device.type == "cuda":  # the frames lie on the device, and worker processes have none
        config = replace(config, train=replace(config.train, workers=0))
    say = print if ranks.rank() == 0 else lambda *_, **__: None
    batch_size = config.train.batch_size
    if batch_size % ranks.size():
        raise InputError(f"train.batch_size: want a multiple of the {ranks.size()} ranks, got {batch_size}")
    if ranks.size() > 1 and (config.loss.uncertainty or config.encoder.vfe == "pillar"):
        raise InputError("loss.uncertainty and encoder.vfe=pillar: are for one process; start without torchrun")
    train_ids = read_split(root, config.train.train_split)
    val_ids = read_split(root, config.train.val_split)
    frames = hashlib.sha256(json.dumps([train_ids, val_ids]).encode()).hexdigest()
    good_ids = check_frames(root, train_ids, config.train.skip_corrupt, say)
    check_frames(root, val_ids, False, say)
    samples = config.augment.objects or config.augment.whole_frames
    database = load_database(root, good_ids, val_ids, say) if samples else None
    # the order of a run that goes on must not depend on which frames can be read: the next one takes a place
    order = EpochOrder(config.train.repeat * len(train_ids), batch_size, config.train.seed)
    if order.count < ranks.size():
        raise InputError(f"{root}: {order.count} frames for {ranks.size()} ranks; start fewer")
    # worker processes know no GPU; without them the frames lie on it
    place = device if config.train.workers == 0 else torch.device("cpu")
    loader: DataLoader = DataLoader(
        TrainingFrames(root, train_ids, config, objects_of(database, place) if database else None, place),
        batch_sampler=order,
        collate_fn=collate,
        generator=torch.Generator(),  # or every epoch that is begun would draw from torch's own
        num_workers=config.train.workers,
        persistent_workers=config.train.workers > 0,
        # a forked worker would inherit Warp, CUDA and the threads of this process
        multiprocessing_context="spawn" if config.train.workers else None,
        worker_init_fn=ignore_signals,
    )
    model = HVNet(config).to(device)
    optimizer = torch.optim.Adam(
        model.parameters(), lr=config.train.learning_rate, weight_decay=config.train.weight_decay
    )
    checkpoint = out / "checkpoint.pt"
    progress = restore(checkpoint, model, optimizer, frames) if resume else Progress()
    say(f"{len(train_ids)} frames to train, {len(val_ids)} to validate, on {device}; the run is {out}", flush=True)

    def save(progress: Progress) -> None:
        if ranks.rank() == 0:
            save_run(checkpoint, model, optimizer, frames, progress)

    board = None
    if ranks.rank() == 0:
        out.mkdir(parents=True, exist_ok=True)
        if not resume:
            save(progress)  # a run that fails in its first epoch can go on
        keep_metrics(out / "metrics.jsonl", progress.epoch)
        (out / "data.txt").write_text(f"{root.absolute()}\n", encoding="utf-8")
        board = SummaryWriter(str(out / "tensorboard"), purge_step=progress.epoch + 1)
    said: set[str] = set()
    joint = ranks.parallel(model)
    stop = False
    while progress.epoch < config.train.epochs:
        epoch = progress.epoch
        if not stop:
            progress, stop = train_epoch(model, joint, optimizer, loader, progress, out, said, signals, save)
            save(progress)  # before the validation
        if stop:
            ranks.of_first(None)  # torchrun ends the others as soon as one has ended: not while the first still writes
            say(f"stopped in epoch {epoch + 1} after step {progress.step}; --resume goes on from there", flush=True)
            sys.exit(128 + signals[0] if signals else 1)
        sums = dict(progress.sums or {})
        count = max(1.0, sums.pop("batches", 0.0))
        losses = {name: total / count for name, total in sums.items()}
        say(f"epoch {epoch + 1:3d}  " + "  ".join(f"{name} {value:.6f}" for name, value in losses.items()), flush=True)
        record: dict[str, Any] = {"epoch": epoch + 1, "step": progress.step, **losses}
        last = epoch + 1 == config.train.epochs
        if last or (epoch + 1) % config.train.validate_every == 0:
            scores = validate(model, root, val_ids, out / "pictures", said)
            say(format_table(scores), flush=True)
            record["validation"] = {
                name: {measure: table[measure] for measure in ("R40", "exact")} for name, table in scores.items()
            }
        if board:
            for name, value in flatten(record):
                board.add_scalar(name, value, epoch + 1)
            board.flush()
            with (out / "metrics.jsonl").open("a", encoding="utf-8") as file:
                file.write(json.dumps(record) + "\n")
        progress = Progress(epoch + 1, 0, progress.step)
        save(progress)
        stop = ranks.joined(torch.full((), float(len(signals)), device=device)).item() > 0
    if board:
        board.close()
    say(f"checkpoint: {checkpoint}\npictures:   {out / 'pictures'}")


@contextlib.contextmanager
def caught_signals() -> Iterator[list[int]]:
    """Inside, SIGTERM and SIGINT do not end the process: they are added to the list, and the loop looks there.

    A second signal ends it at once.
    """
    signals: list[int] = []

    def note(number: int, _: Any) -> None:
        if signals:
            sys.exit(128 + number)
        signals.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ignore_signals(_: int) -> None:
    """For worker processes: a signal to the whole group is this process's matter, and they end with it."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


def check_room(out: Path, model: HVNet) -> None:
    """Raises InputError if the disk has no room for a run: two checkpoints with weights and both moments of Adam."""
    folder = next(path for path in (out, *out.absolute().parents) if path.exists())
    free = shutil.disk_usage(folder).free
    wanted = 2 * 3 * sum(weight.numel() * weight.element_size() for weight in model.parameters()) + ROOM
    if free < wanted:
        raise InputError(
            f"{folder}: {free / 1e6:.0f} MB free, the run wants {wanted / 1e6:.0f} MB; free some, or give another --out"
        )


def check_frames(root: Path, names: list[str], skip: bool, say: Callable[..., None]) -> list[str]:
    """The frames whose small files can be read; the first that cannot ends the run, or is named and skipped."""
    good = []
    hidden = ranks.rank() > 0
    for name in tqdm(names, desc="checking", unit="frame", leave=False, dynamic_ncols=True, disable=hidden):
        try:
            check_frame(root, name)
            good.append(name)
        except (InputError, OSError) as error:
            if not skip:
                raise
            say(f"frame {name} is skipped: {error}")
    if not good:
        raise InputError(f"{root}: no frame of the split can be read")
    return good


def check_frame(root: Path, name: str) -> None:
    """Reads the small files of a frame, so that a mistake in one of them is found now and not epochs later."""
    folder = root / "training"
    frame_calibration(folder, name, read_labels(folder / "label_2" / f"{name}.txt"))
    points = folder / "velodyne" / f"{name}.bin"
    if points.stat().st_size % 16:
        read_points(points)  # which says what is wrong


def load_database(root: Path, train_ids: list[str], val_ids: list[str], say: Callable[..., None] = print) -> Database:
    """The root's ground-truth database without objects of validation frames.

    Where there is none it is built of the training frames, by the first rank, and kept in the root if that can be
    written.
    """
    path = root / FILE_NAME
    built = None
    if ranks.rank() == 0 and not path.is_file():
        built = build_database(root, train_ids)
        try:
            write_database(path, built)
        except OSError as error:
            say(f"{path}: not kept ({error.strerror}); it will be built again")
    built = ranks.of_first(built)
    database = built if built is not None else read_database(path)
    leaked = np.isin(database.frame, [int(name) for name in val_ids if name.isdecimal()])
    if leaked.any():
        say(f"{path}: {int(leaked.sum())} objects of validation frames are left out")
        database = database.select(~leaked)
    return database


def make_deterministic(seed: int) -> None:
    """Seeds torch, and asks of it the same bits on every run."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.manual_seed(seed)
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.backends.cudnn.benchmark = False


def save_run(path: Path, model: HVNet, optimizer: torch.optim.Optimizer, frames: str, progress: Progress) -> None:
    """Writes a checkpoint: all that a run needs to go on."""
    content = {
        "config": config_to_dict(model.config),
        "model": model.state_dict(),
        "optimizer": optimizer.state_dict(),
        "frames": frames,
        "random": torch.get_rng_state(),
        **progress._asdict(),
    }
    save_checkpoint(path, content)


def restore(path: Path, model: HVNet, optimizer: torch.optim.Optimizer, frames: str) -> Progress:
    """Takes up a run where its checkpoint left it."""
    content = load_checkpoint(path)
    here = config_to_dict(model.config)
    changed = sorted(key for key, _ in set(_leaves(content["config"])) ^ set(_leaves(here)))
    fixed = {"train.epochs"} if model.config.train.cosine else set()
    changed = [key for key in changed if key not in CHANGEABLE or key in fixed]
    if changed:
        raise InputError(f"{path}: was trained with another {changed[0]}; give its config, or another --out")
    if content.get("frames") != frames:
        raise InputError(f"{path}: was trained on other frames; give its --data, or another --out")
    try:
        model.load_state_dict(content["model"])
        optimizer.load_state_dict(content["optimizer"])
        torch.set_rng_state(content["random"])
        return Progress(*(content[key] for key in Progress._fields))
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


def keep_metrics(path: Path, epochs: int) -> None:
    """Leaves a line for each epoch that is done: a run may have stopped in or after a line, before its checkpoint."""
    if path.is_file():
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
        if len(lines) > epochs:
            partial = path.with_suffix(".partial")
            partial.write_text("".join(lines[:epochs]), encoding="utf-8")
            partial.replace(path)


def generated_scenes(config: Config, folder: Path) -> Path:
    """A KITTI root in the folder, of the scenes that the config asks for; what is there already is taken."""
    assert config.synthetic is not None
    scenes, reach, seed = config.synthetic, config.encoder.point_range[3], config.train.seed
    root = folder / f"scenes-{scenes.train_frames}-{scenes.val_frames}-{reach:g}m-{seed}"
    generate(root, scenes.train_frames, scenes.val_frames, seed, Options(distance=(4.0, min(reach - 2, 80.0))))
    return root


def check_classes(config: Config, source: Path) -> None:
    """Raises InputError, naming the source, for a class that validation cannot score."""
    for k, entry in enumerate(config.head.classes):
        if entry.name not in CLASSES:
            where = f"{source}: head.classes[{k}].name"
            raise InputError(f"{where}: unknown class '{entry.name}'; known are {', '.join(CLASSES)}")


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
    if not resume:
        check_empty(out, "give another --out, or --resume to go on with the run in it")
    return out


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "train",
        "Trains HVNet, validates it as KITTI does, and writes checkpoint.pt, metrics.jsonl, tensorboard/, pictures/ "
        "and data.txt (where the data are) to the run's folder. To train on 8 GPUs, put torchrun --nproc-per-node 8 "
        "in the place of python.",
        [
            "",
            "--config configs/compact.yaml --data /data/kitti --set train.batch_size=2",
            "--out runs/demo --resume",
        ],
    )
    parser.add_argument("--config", type=Path, default=DEMO, metavar="FILE", help="YAML (default: configs/demo.yaml)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: scenes are generated)")
    parser.add_argument("--out", metavar="DIR", help="folder of the run (default: runs/NAME of the config)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out (default: the latest)")
    add_device(parser)
    add_changes(parser, "override a config value, such as train.epochs=3")
    options = parser.parse_args(arguments)

    config = load_config(options.config, options.set)
    check_classes(config, options.config)
    device = ranks.start(select_device(options.device))
    out = ranks.of_first(choose_out(options.out, options.config, options.resume) if ranks.rank() == 0 else None)
    if ranks.rank() == 0:
        check_room(out, HVNet(config))
    root = options.data
    if root is None:
        if config.synthetic is None:
            raise InputError(f"{options.config}: has no key synthetic, so it needs --data with a KITTI root")
        root = ranks.of_first(generated_scenes(config, out.parent) if ranks.rank() == 0 else None)
    with caught_signals() as signals:
        train(config, root, out, device, options.resume, signals)
    ranks.stop()  # not after an error: the others are still at work, and torchrun ends them


if __name__ == "__main__":
    run_command(main)
