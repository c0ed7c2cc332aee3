"""Frames a second of training, and what fills the time: data, encoder, backbone and heads, loss, backward, optimiser.

It runs `hvnet.training.run.Run`, that of `python -m hvnet.train`, in a folder that is deleted afterwards. Every other
step is stopped where a stage ends, and waits there for the device; the steps between are timed as a whole. "data" is
what the loader lets the step wait for, and the way to the device; "backward" has the gradient's norm with it.
"""

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from timing import parser, start, synchronise, write_json, write_rows

from hvnet.cli import run_command
from hvnet.config import load_config
from hvnet.data.scenes.files import generate
from hvnet.exceptions import InputError
from hvnet.training.batches import Batch, EpochOrder, TrainingFrames, kitti_data
from hvnet.training.run import Run, deterministic

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
STAGES = ("data", "encoder", "backbone and heads", "loss", "backward", "optimiser")
WARM_UP = 2  # steps of either kind that are not timed


class Clock:
    """Seconds of every stage of a step, added up until the next begins; off, it costs a step nothing."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.on = device, False
        self.seconds: dict[str, float] = {}
        self.last = 0.0

    def begin(self) -> None:
        """A step begins."""
        synchronise(self.device)
        self.seconds, self.last = dict.fromkeys(STAGES, 0.0), time.perf_counter()

    def end(self, stage: str) -> None:
        """A stage, or a part of it, ends here."""
        if self.on:
            synchronise(self.device)
            now = time.perf_counter()
            self.seconds[stage] += now - self.last
            self.last = now


def batches(run: Run) -> Iterator[Batch]:
    """The run's batches, epoch after epoch."""
    order = run.loader.batch_sampler
    assert isinstance(order, EpochOrder)
    while True:
        for batch in run.loader:
            if isinstance(batch, InputError):
                raise batch
            yield batch
        order.epoch += 1


def time_steps(run: Run, repeat: int) -> dict[str, list[float]]:
    """Seconds of every stage and of the whole step, `repeat` times."""
    frames = run.loader.dataset
    assert isinstance(frames, TrainingFrames)
    if run.config.train.workers == 0:
        for k in range(len(run.data.train)):
            frames.read(k)  # the files are read once, in the first epoch
    times: dict[str, list[float]] = {stage: [] for stage in (*STAGES, "step")}
    clock, model, loss_of = Clock(run.device), run.model.train(), run.model.loss

    def timed_loss(*args: Any) -> dict[str, torch.Tensor]:
        clock.end("backbone and heads")
        terms = loss_of(*args)
        clock.end("loss")
        return terms

    model.encoder.register_forward_pre_hook(lambda *_: clock.end("data"))
    model.encoder.register_forward_hook(lambda *_: clock.end("encoder"))
    run.optimizer.register_step_pre_hook(lambda *_: clock.end("backward"))
    stream = batches(run)
    with deterministic(), mock.patch.object(model, "loss", timed_loss):
        for turn in range(repeat + WARM_UP):
            clock.on = True
            clock.begin()
            run.step(next(stream))
            run.read_steps()
            clock.end("optimiser")
            clock.on = False
            synchronise(run.device)
            begin = time.perf_counter()
            run.step(next(stream))
            run.read_steps()
            synchronise(run.device)
            if turn >= WARM_UP:
                times["step"].append(time.perf_counter() - begin)
                for stage, seconds in clock.seconds.items():
                    times[stage].append(seconds)
    return times


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments = parser("train", __doc__, repeat=10)
    arguments.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: scenes are generated)")
    known = ["compact", "demo", "hvnet", "standard"]
    arguments.add_argument("--configs", nargs="+", default=["compact"], choices=known)
    arguments.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of hvnet.train")
    args = arguments.parse_args(argv)
    bench = start("train", args)
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder:
        root = args.data
        if root is None:
            root = Path(folder) / "scenes"
            generate(root, 16, 1, 0)
        for name in args.configs:
            config = load_config(CONFIGS / f"{name}.yaml", args.set)
            if not config.augment.objects:
                raise InputError(f"{name}: augment.objects is empty; the benchmark wants ground-truth sampling")
            run = Run(config, kitti_data(root, config), Path(folder) / name, bench.device)
            times = time_steps(run, args.repeat)
            batch = config.train.batch_size
            half = ", bfloat16" if config.train.bfloat16 else ""
            whole = sum(float(np.median(times[stage])) for stage in STAGES)
            print(f"\n{f'{name}, batch {batch}{half}':<36}{'p50':>10}{'p95':>10} ms {'share':>9}")
            for stage in (*STAGES, "step"):
                p50, p95 = (1e3 * float(value) for value in np.percentile(times[stage], (50, 95)))
                rate = f"{1e3 * batch / p50:8.1f} frames/s" if stage == "step" else f"{p50 / (1e3 * whole):9.1%}"
                print(f"  {stage:<34}{p50:10.2f}{p95:10.2f}    {rate}")
                row = {"config": name, "batch": batch, "bfloat16": config.train.bfloat16, "stage": stage}
                rows.append(row | {"p50_ms": f"{p50:.6g}", "p95_ms": f"{p95:.6g}", "steps": args.repeat})
            sys.stdout.flush()
    write_rows(args.csv, rows, bench.machine)
    write_json(args.json, rows, bench.machine)


if __name__ == "__main__":
    run_command(main)
