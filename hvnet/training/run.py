"""A training run as one object, from top to bottom: its step, its epochs, its checkpoints.

On a GPU the frames, the database and the augmentation live on the device. Several processes, started by torchrun, train
one model together: each takes its share of every batch, and rank 0 prints and writes.
"""

import contextlib
import copy
import hashlib
import json
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torch.utils.data import DataLoader
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from hvnet import ranks
from hvnet.config import Config, TrainConfig, config_from_dict, config_to_dict
from hvnet.data.frame import notes
from hvnet.data.insert import sampler_of
from hvnet.data.stamps import Change, Stamps, describe_changes, find_changes, take_stamps
from hvnet.evaluation.scoring import Detected, background_note, print_once, score
from hvnet.evaluation.tables import format_table
from hvnet.exceptions import InputError, Stopped
from hvnet.kernels.launch import many_threads
from hvnet.network.checkpoint import load_checkpoint, save_checkpoint
from hvnet.network.detector import Detector
from hvnet.network.model import HVNet
from hvnet.pictures.clouds import Subject, draw_bev
from hvnet.training.batches import (
    Batch,
    Data,
    EpochOrder,
    TrainingFrames,
    check_frames,
    collate,
    look_at_clouds,
    training_objects,
)

SAVE_SECONDS = 300.0
"""Seconds between saves within an epoch; a run is also saved after every epoch."""

CHANGEABLE = [
    f"train.{key}"
    for key in (
        "epochs",
        "learning_rate",
        "validate_every",
        "report_every",
        "pictures",
        "workers",
        "skip_corrupt",
        "skip_non_finite",
    )
]
"""Keys that may differ from the run being resumed; epochs only if neither the rate nor the data depend on them."""


class Progress(NamedTuple):
    """How far a run has got, and the sums of the losses in its current epoch."""

    epoch: int = 0  # epochs done, with their validation
    batch: int = 0  # batches done of the next one
    step: int = 0
    sums: dict[str, float] | None = None


class Step(NamedTuple):
    """A step whose losses have not been read from the device."""

    step: int
    names: list[str]  # of its frames
    terms: tuple[str, ...]
    numbers: Tensor  # the losses: their sum and the terms; the signals that have come; the norm of the gradient


class Run:
    """A training run: model, optimizer, data, progress and the signals that have come."""

    def __init__(
        self, config: Config, data: Data, out: Path, device: torch.device | str = "cpu", *, resume: bool = False
    ) -> None:
        """Checks the data, and resumes the run in the folder `out` or starts one there.

        Raises InputError for a mistake in the data or the checkpoint.
        """
        device = torch.device(device)
        if device.type == "cuda":  # frames are kept on the device, and worker processes have none
            config = replace(config, train=replace(config.train, workers=0))
        self.config, self.data, self.out, self.device = config, data, Path(out), device
        self.checkpoint = self.out / "checkpoint.pt"
        self.resumed = resume
        self.board: SummaryWriter | None = None  # open in `train`
        self.signals: list[int] = []
        self.unread: list[Step] = []
        self.seen: set[str] = set()  # notes that were printed
        self.stamps: dict[str, Stamps] = {}  # of the training and validation frames, where their formats have some
        if ranks.rank() == 0 and not resume and self.checkpoint.exists():
            raise InputError(f"{out}: holds a run; resume it, or give another folder")
        with deterministic():
            torch.manual_seed(config.train.seed)  # torch's own generator: it goes into the checkpoints
            known = [list(data.train.names), list(data.val.names), list(data.drives)]
            self.frames_id = hashlib.sha256(json.dumps(known if data.drives else known[:2]).encode()).hexdigest()
            if resume:  # before anything is written
                self.check_checkpoint()
            self.loader = self.make_loader()
            self.model = HVNet(config).to(device)
            self.averaged = copy.deepcopy(self.model).requires_grad_(False) if config.train.average else None
            self.joint = ranks.wrap_ddp(self.model)  # the model, with its gradients averaged over the ranks
            self.optimizer = torch.optim.Adam(
                self.model.parameters(),
                lr=config.train.learning_rate,
                weight_decay=config.train.weight_decay,
                fused=many_threads(device) or None,
            )
            self.progress = self.restore() if resume else Progress()
            # that a step which is not finite must not change; anchors are buffers as well, and constant
            kept = self.model.state_dict() if config.train.skip_non_finite else {}
            self.statistics = [name for name, _ in self.model.named_buffers() if name in kept]
        self.stamp_frames()
        self.say(
            f"{len(data.train)} frames to train, {len(data.val)} to validate, on {device}; the run is {out}", flush=True
        )
        if self.background:
            self.say(self.background)
        if ranks.rank() == 0:
            self.out.mkdir(parents=True, exist_ok=True)
            keep_metrics(self.out / "metrics.jsonl", self.progress.epoch)
            if data.root is not None:
                (self.out / "data.txt").write_text(f"{data.root.absolute()}\n", encoding="utf-8")

    def say(self, text: str, **options: Any) -> None:
        """Prints on the first rank."""
        if ranks.rank() == 0:
            print(text, **options)

    def make_loader(self) -> DataLoader:
        """The batches of the training frames, after a look at all frames."""
        config, data = self.config, self.data
        batch_size = config.train.batch_size
        if batch_size % ranks.size():
            raise InputError(f"train.batch_size: want a multiple of the {ranks.size()} ranks, got {batch_size}")
        if ranks.size() > 1 and (config.loss.uncertainty or config.encoder.vfe == "pillar"):
            raise InputError("loss.uncertainty and encoder.vfe=pillar: one process only; start without torchrun")
        # the order of a run that goes on must not depend on which frames can be read: the next one takes a place
        order = EpochOrder(config.train.repeat * len(data.train), batch_size, config.train.seed, data.drives)
        if order.count < ranks.size():
            raise InputError(f"{order.count} frames for {ranks.size()} ranks; start fewer")
        good, names = check_frames(data.train, config.train.skip_corrupt, self.say)
        names += check_frames(data.val, False, self.say)[1]
        classes = [entry.name for entry in config.head.classes]
        self.background = background_note(names, classes)
        self.sensor, sensor_notes = look_at_clouds(data.train, good, config)
        for note in (*notes(data.train), *notes(data.val), *sensor_notes):
            self.say(note)
        # worker processes do not use the GPU; without them the frames are kept on it
        place = self.device if config.train.workers == 0 else torch.device("cpu")
        objects = None
        if config.augment.objects or config.augment.whole_frames:
            objects = sampler_of(training_objects(data, good, self.say))
        # the height that the ground of every cloud is brought to; None: clouds stay as they are
        self.flat_ground = self.sensor["ground"] if config.encoder.flat_ground else None
        if config.encoder.flat_ground and self.flat_ground is None:
            self.say("no ground is found in the clouds, so that slopes stay; data.sensor_height tells its height")
        return DataLoader(
            TrainingFrames(data.train, config, objects, place, data.drives, self.flat_ground),
            batch_sampler=order,
            collate_fn=collate,
            generator=torch.Generator(),  # otherwise every new epoch would draw from torch's global generator
            num_workers=config.train.workers,
            persistent_workers=config.train.workers > 0,
            # a forked worker would inherit Warp, CUDA and the threads of this process
            multiprocessing_context="spawn" if config.train.workers else None,
            worker_init_fn=ignore_signals,
        )

    def stamp_frames(self) -> None:
        """Stamps the frames as they are now, on the first rank; says which have changed since the checkpoint."""
        if ranks.rank() > 0:
            return
        dataset, changes = self.loader.dataset, list[Change]()
        assert isinstance(dataset, TrainingFrames)
        # the clouds of the database have been read: their stamps tell what is in them
        cut = None if dataset.objects is None else dataset.objects.database.stamps
        for split, frames, known in (("train", self.data.train, cut), ("val", self.data.val, None)):
            before = self.stamps.pop(split, None)
            now = take_stamps(frames, known=before or known)
            if now is not None:
                self.stamps[split] = now
                changes += [] if before is None else find_changes(before, now)
        if changes:
            self.say(f"{self.checkpoint}: since it was written, {describe_changes(changes)}; they are used as they are")

    def step(self, batch: Batch) -> None:
        """One step of the optimizer. Its losses are kept for `read_steps`: a GPU is not waited for.

        A loss or gradient that is not finite changes nothing in the model.
        """
        config, model, progress = self.config.train, self.model, self.progress
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate(config, progress.step, progress.epoch, config.epochs * len(self.loader))
        print_once(batch.notes, self.seen)
        batch = batch.to(self.device)
        statistics = {name: model.get_buffer(name).clone() for name in self.statistics}
        terms = self.joint(batch.points, batch.sample, batch.boxes, batch.labels)
        loss = torch.stack(list(terms.values())).sum()
        self.optimizer.zero_grad(set_to_none=True)
        (ranks.size() * loss).backward()  # the ranks' gradients are averaged, the loss is their sum
        norm = torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
        parts = torch.stack([loss, *terms.values(), torch.full_like(loss, len(self.signals))]).detach()
        numbers = torch.cat((ranks.all_reduce(parts), norm[None]))
        finite = numbers[0].isfinite() & norm.isfinite()
        if many_threads(self.device):  # the device decides
            self.optimizer.found_inf = (~finite).float()  # type: ignore[attr-defined]  # read by the fused step
            self.optimizer.step()
        elif finite:
            self.optimizer.step()
        if many_threads(self.device) or not finite:
            for name, statistic in statistics.items():  # the batch norms have seen what is not finite
                buffer = model.get_buffer(name)
                buffer.copy_(torch.where(finite, buffer, statistic))
        if self.averaged is not None:  # at first over few steps, so that the weights of the start are soon forgotten
            decay = min(config.average, (1 + progress.step) / (10 + progress.step))
            update_average(self.averaged, model, decay)
        self.unread.append(Step(progress.step, batch.names, tuple(terms), numbers))

    def read_steps(self) -> list[dict[str, float]]:
        """The losses of the steps since the last call, summed over the ranks, by one read of the device.

        `stop` is not 0 if a signal has come, `batches` 1. A step that is not finite has no `batches`: it is noted, or
        ends the run.
        """
        steps, self.unread = self.unread, []
        read = []
        for each, (*losses, norm) in zip(steps, torch.stack([each.numbers for each in steps]).tolist(), strict=True):
            read.append(dict(zip(("loss", *each.terms, "stop"), losses, strict=True)))
            if math.isfinite(losses[0]) and math.isfinite(norm):
                read[-1]["batches"] = 1.0
            else:
                self.note_non_finite(each, losses[0], norm)
        return read

    def epoch(self) -> dict[str, Any]:
        """The rest of the epoch that is under way, its validation if one is due, and its record, which is kept.

        The record holds `epoch`, `step`, the means of the losses and, after a validation, `validation`: by class and
        measure (R40, exact) the AP. Raises Stopped, and has saved the run, if a signal comes.
        """
        number = self.progress.epoch + 1
        losses = self.run_batches()
        parts = (f"{name} {value:.6f}" for name, value in losses.items())
        self.say(f"epoch {number:3d}  " + "  ".join(parts), flush=True)
        record: dict[str, Any] = {"epoch": number, "step": self.progress.step, **losses}
        if number == self.config.train.epochs or number % self.config.train.validate_every == 0:
            scores = self.validate()
            self.say(format_table(scores), flush=True)
            record["validation"] = {
                name: {measure: table[measure] for measure in ("R40", "exact")} for name, table in scores.items()
            }
        self.write(record)
        self.progress = Progress(number, 0, self.progress.step)
        self.save()
        return record

    def run_batches(self) -> dict[str, float]:
        """The rest of an epoch's batches: the means of its losses. The run is then saved, before a validation."""
        epoch, batches, step, sums = self.progress
        sums = dict(sums or {})
        order = self.loader.batch_sampler
        assert isinstance(order, EpochOrder)
        order.epoch, order.begin = epoch, batches
        saved = time.monotonic()
        self.unread.clear()
        self.model.train()
        bar = tqdm(
            self.loader,
            total=len(self.loader),
            initial=batches,
            desc=f"epoch {epoch + 1}/{self.config.train.epochs}",
            unit="batch",
            leave=False,
            dynamic_ncols=True,
            disable=ranks.rank() > 0,
        )
        with deterministic():
            for batch in bar:
                if isinstance(batch, InputError):
                    if self.unread:  # one of these steps may have to be noted
                        self.read_steps()
                    raise batch
                self.step(batch)
                step, batches = step + 1, batches + 1
                self.progress = Progress(epoch, batches, step, sums)
                # several ranks have to agree on when they read
                urgent = self.signals or time.monotonic() - saved > SAVE_SECONDS
                is_due = len(self.unread) >= self.config.train.report_every or batches == len(self.loader)
                if not is_due and not (urgent and ranks.size() == 1):
                    continue
                stop = 0.0
                for losses in self.read_steps():
                    stop += losses.pop("stop")
                    if "batches" in losses:
                        for name, value in losses.items():
                            sums[name] = sums.get(name, 0.0) + value
                rate = self.config.train.batch_size * (bar.format_dict["rate"] or 0)
                bar.set_postfix(loss=f"{losses['loss']:.3f}", frames=f"{rate:.1f}/s")
                if stop:
                    bar.close()
                    self.save()
                    self.stop()
                if time.monotonic() - saved > SAVE_SECONDS:
                    self.save()
                    saved = time.monotonic()
        self.save()
        count = max(1.0, sums.get("batches", 0.0))
        return {name: total / count for name, total in sums.items() if name != "batches"}

    def validate(self) -> dict[str, dict[str, Any]]:
        """Detects in the validation frames, scores the boxes by KITTI's protocol and draws the first few frames."""
        detector = Detector(self.averaged or self.model, self.device, ground=self.flat_ground)
        classes, point_range = detector.classes, self.config.encoder.point_range

        def draw(detected: Detected) -> None:
            if detected.k < self.config.train.pictures:
                name = detected.frame.name
                subject = Subject(detected.frame, detected.found, classes)
                draw_bev(self.out / "pictures" / f"{name}.png", subject, point_range, f"frame {name}")

        with deterministic():
            return score(detector, self.data.val, visit=draw, seen=self.seen, title="validating", background=False)

    def train(self) -> None:
        """Runs the remaining epochs; writes checkpoint.pt, metrics.jsonl, tensorboard/ and pictures/.

        SIGTERM or SIGINT ends it after the step that is under way, with several ranks at the next report: the run is
        saved, and Stopped raised.
        """
        self.signals.clear()  # of an earlier call
        with caught_signals(self.signals), self.open_board():
            if not self.resumed:
                self.save()  # a run that fails in its first epoch can go on
            while self.progress.epoch < self.config.train.epochs:
                self.epoch()
                stop = torch.full((), float(len(self.signals)), device=self.device)
                if ranks.all_reduce(stop).item() > 0 and self.progress.epoch < self.config.train.epochs:
                    self.stop()
        self.say(f"checkpoint: {self.checkpoint}\npictures:   {self.out / 'pictures'}")

    @contextlib.contextmanager
    def open_board(self) -> Iterator[None]:
        """Inside, the first rank writes to TensorBoard's files as well."""
        if ranks.rank() > 0:
            yield
            return
        self.board = SummaryWriter(str(self.out / "tensorboard"), purge_step=self.progress.epoch + 1)
        try:
            yield
        finally:
            self.board.close()
            self.board = None

    def stop(self) -> None:
        """Raises Stopped, on all ranks."""
        ranks.broadcast(None)  # torchrun ends the others as soon as one has ended: not while the first still writes
        message = (
            f"stopped in epoch {self.progress.epoch + 1} after step {self.progress.step}; --resume continues from there"
        )
        raise Stopped(message if ranks.rank() == 0 else "", self.signals[0] if self.signals else signal.SIGTERM)

    def write(self, record: dict[str, Any]) -> None:
        """Adds an epoch to metrics.jsonl and to TensorBoard's files, on the first rank."""
        if ranks.rank() > 0:
            return
        if self.board is not None:
            for name, value in flatten(record):
                self.board.add_scalar(name, value, record["epoch"])
            self.board.flush()
        with (self.out / "metrics.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")

    def note_non_finite(self, of_step: Step, loss: float, norm: float) -> None:
        """Keeps the frames of a step whose loss or gradient is not finite in non_finite.jsonl; ends the run or not."""
        names = [name for share in ranks.all_gather(of_step.names) for name in share]
        path, epoch, step = self.out / "non_finite.jsonl", self.progress.epoch, of_step.step
        if ranks.rank() == 0:
            with path.open("a", encoding="utf-8") as file:
                line = {"epoch": epoch + 1, "step": step, "loss": str(loss), "gradient": str(norm), "frames": names}
                file.write(json.dumps(line) + "\n")
        what = f"the loss is {loss} and its gradient's norm {norm} at step {step}"
        if not self.config.train.skip_non_finite:
            remedy = "lower train.learning_rate, or set train.skip_non_finite, and --resume"
            raise InputError(f"{what}; its frames are in {path}; {remedy}")
        print_once([f"{what}: left out; its frames are in {path}"] if ranks.rank() == 0 else [], set())

    def save(self) -> None:
        """Writes a checkpoint: all that is needed to resume the run.

        `model` is what is validated and used: the averaged weights, if there are any; those trained are then `raw`.
        """
        if ranks.rank() == 0:
            content = {
                "config": config_to_dict(self.config),
                "model": (self.averaged or self.model).state_dict(),
                "optimizer": self.optimizer.state_dict(),
                "frames": self.frames_id,
                "stamps": {split: torch.from_numpy(stamps.numbers) for split, stamps in self.stamps.items()},
                "sensor": self.sensor,
                "random": torch.get_rng_state(),
                **self.progress._asdict(),
            }
            if self.averaged is not None:
                content["raw"] = self.model.state_dict()
            save_checkpoint(self.checkpoint, content)

    def check_checkpoint(self) -> None:
        """Raises InputError if the checkpoint is that of another run."""
        path, content = self.checkpoint, load_checkpoint(self.checkpoint)
        there = config_to_dict(config_from_dict(content["config"], str(path)))  # adds newer keys
        here = config_to_dict(self.config)
        changed = sorted({key for key, _ in set(_leaves(there)) ^ set(_leaves(here))})
        fixed = {"train.epochs"} if self.config.train.cosine or self.config.augment.fade_out else set()
        changed = [key for key in changed if key not in CHANGEABLE or key in fixed]
        if changed:
            raise InputError(f"{path}: was trained with another {changed[0]}; give its config, or another --out")
        if content.get("frames") != self.frames_id:
            raise InputError(f"{path}: was trained on other frames or drives; give its --data, or another --out")

    def restore(self) -> Progress:
        """Resumes the run from its checkpoint. Raises InputError if it is not whole."""
        path, content = self.checkpoint, load_checkpoint(self.checkpoint)
        try:
            self.model.load_state_dict(content["model" if self.averaged is None else "raw"])
            if self.averaged is not None:
                self.averaged.load_state_dict(content["model"])
            for group in content["optimizer"]["param_groups"]:  # a run may go on on another device
                group["fused"] = self.optimizer.defaults["fused"]
            self.optimizer.load_state_dict(content["optimizer"])
            torch.set_rng_state(content["random"])
            for split, numbers in content.get("stamps", {}).items():  # earlier versions keep none
                self.stamps[split] = Stamps(getattr(self.data, split).names, numbers.numpy())
            return Progress(*(content[key] for key in Progress._fields))
        except (KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            raise InputError(f"{path}: does not hold a whole run ({error}); start again with another --out") from error


def learning_rate(config: TrainConfig, step: int, epoch: int, steps: int) -> float:
    """Linear warm-up from warmup_ratio times the rate, then a decay at each of decay_epochs (Sec. 4.1) or a cosine.

    `steps` is the length of the run.
    """
    if config.cosine:
        done = (step - config.warmup_steps) / max(1, steps - config.warmup_steps)
        decayed = config.learning_rate * (1 + math.cos(math.pi * min(max(done, 0.0), 1.0))) / 2
    else:
        decayed = config.learning_rate * config.decay_ratio ** sum(epoch >= end for end in config.decay_epochs)
    if step < config.warmup_steps:
        return decayed * (config.warmup_ratio + (1 - config.warmup_ratio) * step / config.warmup_steps)
    return decayed


def update_average(averaged: nn.Module, model: nn.Module, decay: float) -> None:
    """Sets weights and running statistics to decay * averaged + (1 - decay) * those of the model, in place."""
    pairs = zip(averaged.state_dict().values(), model.state_dict().values(), strict=True)
    means, values = zip(*(pair for pair in pairs if pair[0].is_floating_point()), strict=True)
    get_ema_multi_avg_fn(decay)(means, values, None)


@contextlib.contextmanager
def deterministic() -> Iterator[None]:
    """Inside, torch gives the same bits on every run; its flags are restored afterwards."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # read once, when CUDA starts
    enabled, warn_only = (
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
    )
    fill, benchmark = torch.utils.deterministic.fill_uninitialized_memory, torch.backends.cudnn.benchmark  # type: ignore[attr-defined]
    torch.use_deterministic_algorithms(True, warn_only=True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # type: ignore[attr-defined]
    torch.backends.cudnn.benchmark = False
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(enabled, warn_only=warn_only)
        torch.utils.deterministic.fill_uninitialized_memory = fill  # type: ignore[attr-defined]
        torch.backends.cudnn.benchmark = benchmark


@contextlib.contextmanager
def caught_signals(signals: list[int]) -> Iterator[None]:
    """Inside, SIGTERM and SIGINT do not end the process: they are added to the list, and the loop looks there.

    A second signal ends it at once: it raises Stopped wherever the program is. Outside the main thread, where Python
    allows no handlers, signals are left alone.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(number: int, _: Any) -> None:
        if signals:
            raise Stopped("stopped immediately; --resume continues from the last checkpoint", number)
        signals.append(number)

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def ignore_signals(_: int) -> None:
    """For worker processes: this process handles a signal to the whole group, and they end with it."""
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)


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
