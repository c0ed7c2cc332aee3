"""Frames a second of training, and what fills the time: data, encoder, backbone and heads, loss, backward, optimiser.

A step is that of `python -m hvnet.train`, stage by stage and synchronised, with ground-truth sampling from the scenes'
own objects; the whole step is timed again without stops between the stages.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from timing import parser, start, synchronise, write_rows

from hvnet.cli import InputError, run_command
from hvnet.config import Config, load_config
from hvnet.data.augment import objects_of
from hvnet.data.kitti import read_split
from hvnet.data.synthetic import generate
from hvnet.model import HVNet
from hvnet.train import Batch, TrainingFrames, collate, load_database

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
STAGES = ("data", "encoder", "backbone and heads", "loss", "backward", "optimiser")


def time_steps(config: Config, root: Path, device: torch.device, repeat: int) -> dict[str, list[float]]:
    """Seconds of every stage and of the whole step, `repeat` times."""
    ids = read_split(root, config.train.train_split)
    database = load_database(root, ids, [])
    frames = TrainingFrames(root, ids, config, objects_of(database, device), device)
    torch.manual_seed(0)
    model = HVNet(config).to(device).train()
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    times: dict[str, list[float]] = {stage: [] for stage in (*STAGES, "step")}

    def timed(stage: str, run: Callable[[], Any]) -> Any:
        synchronise(device)
        begin = time.perf_counter()
        result = run()
        synchronise(device)
        times[stage].append(time.perf_counter() - begin)
        return result

    def data(turn: int) -> Batch:
        count = config.train.batch_size
        return collate([frames[turn, (turn * count + k) % len(ids)] for k in range(count)]).to(device)

    def loss_of(batch: Batch, maps: Any) -> torch.Tensor:
        return torch.stack(list(model.loss(maps, batch.boxes, batch.labels).values())).sum()

    def update() -> None:
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.train.gradient_clip)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)

    def stages(turn: int) -> None:
        batch = timed("data", lambda: data(turn))
        images = timed("encoder", lambda: model.encoder(batch.points, batch.sample, len(batch.boxes)))
        maps = timed("backbone and heads", lambda: model.maps_of(images))
        loss = timed("loss", lambda: loss_of(batch, maps))
        timed("backward", loss.backward)
        timed("optimiser", update)

    def step(turn: int) -> None:
        batch = data(turn)
        loss_of(batch, model(batch.points, batch.sample, len(batch.boxes))).backward()
        update()

    for k in range(len(ids)):
        frames.read(k)  # the files are read once, in the first epoch
    for turn in range(repeat + 2):
        stages(turn)
        timed("step", lambda turn=turn: step(turn))
    return {stage: seconds[2:] for stage, seconds in times.items()}  # two to warm up


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments: argparse.ArgumentParser = parser("train", __doc__, repeat=10)
    arguments.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: scenes are generated)")
    arguments.add_argument("--configs", nargs="+", default=["compact"], choices=["compact", "demo", "hvnet"])
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
            times = time_steps(config, root, bench.device, args.repeat)
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


if __name__ == "__main__":
    run_command(main)
