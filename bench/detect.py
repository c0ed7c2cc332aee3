"""From a file to boxes, stage by stage: the detector that `hvnet.load` gives, against the plain model, in one run.

On a GPU the stages are timed one by one, but "detector" runs all of them, placing included, as one CUDA graph between
two copies: it takes less than their sum.

Frames are read and judged (reflectance, ground), encoded, sent through the backbone, scored, decoded and suppressed,
warm and synchronised, in turns with the plain model: float32, batch norms as they are, every anchor regressed. Before a
time is taken, both are checked to give the same boxes. `compact` and `standard` have the shipped weights. `hvnet`, the
paper's configuration, has none: its scores mean nothing, so its threshold is 0, which sends as many candidates into
decoding and NMS as there can be. With --all-round the detector also takes a whole scan: as it is, turned, in all
directions.
"""

import contextlib
import copy
import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from timing import agree, parser, read_scene, start, synchronise, write_json, write_rows
from torch import Tensor

from hvnet.cli import run_command
from hvnet.config import load_config
from hvnet.data.clouds import read_cloud
from hvnet.data.scenes.files import make_frame
from hvnet.data.scenes.street import Options
from hvnet.exceptions import InputError
from hvnet.network import fused
from hvnet.network.checkpoint import WEIGHTS, find_checkpoint, load_checkpoint, model_from_checkpoint
from hvnet.network.detector import Detector
from hvnet.network.model import HVNet

CONFIGS = Path(__file__).resolve().parent.parent / "configs"
GROUND = -1.66
"""Height of the road under KITTI's clouds, as a detector finds it."""
STAGES = ("read", "encode", "backbone", "heads", "decode", "NMS")
SHIPPED = sorted(path.stem for path in WEIGHTS.glob("*.pt"))
"""The configs that come with weights."""


def make_model(name: str) -> HVNet:
    """The shipped model, or an untrained one of a config."""
    if name in SHIPPED:
        path = find_checkpoint(name)
        return model_from_checkpoint(load_checkpoint(path), str(path))
    torch.manual_seed(0)
    config = load_config(CONFIGS / f"{name}.yaml")
    return HVNet(dataclasses.replace(config, head=dataclasses.replace(config.head, score_threshold=0.0))).eval()


def check(name: str, model: HVNet, points: Tensor, device: torch.device) -> None:
    """Ends the benchmark if the detector and the plain model, both in float32 and not in TF32, differ.

    Boxes are compared where weights are trained: the scores of others are so close that rounding gives their order.
    """
    plain_products = mock.patch.object(fused, "products_in_tf32", return_value=contextlib.nullcontext())
    sample = torch.zeros(len(points), dtype=torch.int64, device=device)
    plain, detector = copy.deepcopy(model).to(device), Detector(model, device, torch.float32)
    inputs = points.to(device), sample, 1
    with plain_products, torch.backends.cudnn.flags(enabled=True, allow_tf32=False), torch.no_grad():
        levels = plain.backbone(plain.encoder(*inputs))
        agree(f"{name}, maps", detector.backbone(detector.encode(*inputs)), levels, 1e-3, 1e-4)
        if name in SHIPPED:
            want, found = plain.detect(*inputs)[0], detector(points)
            agree(f"{name}, scores", [found.scores], [want.scores], 1e-3, 1e-4)
            agree(f"{name}, boxes", [found.boxes[:, :6]], [want.boxes[:, :6]], 1e-3, 1e-4)


def time_stages(detector: Detector, files: list[Path]) -> dict[str, float]:
    """Seconds of every stage of one call, and of the whole call as `Detector.batch` does it."""
    times: dict[str, float] = {}

    def timed(stage: str, run: Callable[[], Any]) -> Any:
        synchronise(detector.device)
        begin = time.perf_counter()
        result = run()
        synchronise(detector.device)
        times[stage] = time.perf_counter() - begin
        return result

    clouds = [read_cloud(file)[0] for file in files]
    placed = timed("read", lambda: [detector.place(read_cloud(file)[0]).clouds[0] for file in files])
    with torch.no_grad():
        points, sample = torch.cat(placed), samples(placed).to(detector.device)
        images = timed("encode", lambda: detector.encode(points, sample, len(files)))
        levels = timed("backbone", lambda: detector.backbone(images))
        levels, scores = timed("heads", lambda: detector.score(levels))
        candidates = timed("decode", lambda: detector.candidates(levels, scores))
        timed("NMS", lambda: detector.suppress(candidates))
    timed("detector", lambda: detector.batch(clouds))
    return times


def time_mounts(model: HVNet, device: torch.device, scan: Tensor, repeat: int) -> dict[str, list[float]]:
    """Seconds of the calls for a whole scan (N, 4): as it is, turned, and in all directions, in turns."""
    mounts: dict[str, dict[str, Any]] = {
        "whole scan": {},
        "whole scan, turned": {"turn": 180.0},
        "whole scan, all round": {"all_round": True},
    }
    detectors = {name: Detector(model, device, ground=GROUND, **mount) for name, mount in mounts.items()}
    times: dict[str, list[float]] = {name: [] for name in mounts}
    for turn in range(repeat + 2):
        for name, detector in detectors.items():
            synchronise(device)
            begin = time.perf_counter()
            detector(scan)
            synchronise(device)
            if turn >= 2:  # two to warm up
                times[name].append(time.perf_counter() - begin)
    return times


def print_times(
    title: str, times: dict[str, list[float]], stages: Sequence[str], batch: int, row: dict[str, object]
) -> list[dict[str, object]]:
    """Prints a table of stages, in seconds a call, and gives its rows; whole calls are compared with the first."""
    print(f"\n{title:<36}{'p50':>10}{'p95':>10} ms a call {'frames/s':>10}{'ratio':>8}")
    whole = [stage for stage in stages if stage not in STAGES]
    first = float(np.median(times[whole[0]]))
    rows = []
    for stage in stages:
        p50, p95 = (1e3 * float(value) for value in np.percentile(times[stage], (50, 95)))
        rate = f"{1e3 * batch / p50:10.1f}{p50 / (1e3 * first):7.2f}x" if stage in whole else ""
        print(f"  {stage:<34}{p50:10.2f}{p95:10.2f}           {rate}", flush=True)
        measured = {"p50_ms": f"{p50:.6g}", "p95_ms": f"{p95:.6g}", "calls": len(times[stage])}
        rows.append(row | {"stage": stage} | measured)
    return rows


def samples(clouds: Sequence[Tensor]) -> Tensor:
    """The sample of every point."""
    return torch.repeat_interleave(torch.arange(len(clouds)), torch.tensor([len(cloud) for cloud in clouds]))


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments = parser("detect", __doc__, repeat=20)
    arguments.add_argument("--points", type=Path, help="a velodyne .bin (default: a generated scene)")
    known = [*SHIPPED, "demo", "hvnet"]
    arguments.add_argument("--configs", nargs="+", default=["compact", "hvnet"], choices=known)
    arguments.add_argument("--batch", nargs="+", type=int, default=[1, 8], help="clouds at once (default: 1 8)")
    arguments.add_argument("--all-round", action="store_true", help="also a whole scan: turned, and all round")
    args = arguments.parse_args(argv)
    if min(args.batch) < 1:
        raise InputError(f"--batch: want 1 or more, got {min(args.batch)}")
    bench = start("detect", args)
    scene = read_scene(args.points)
    if args.points is None:
        scan = torch.from_numpy(make_frame(0, 0, Options(azimuth=180))[1].points)
    else:
        scan = torch.from_numpy(read_cloud(args.points)[0])
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cloud.bin"
        file.write_bytes(scene.numpy().tobytes())
        for name in args.configs:
            model = make_model(name)
            check(name, model, scene, bench.device)
            plain, detector = copy.deepcopy(model).to(bench.device), Detector(model, bench.device, ground=GROUND)
            for batch in args.batch:
                points, sample = scene.repeat(batch, 1).to(bench.device), samples([scene] * batch).to(bench.device)
                times: dict[str, list[float]] = {"plain model": []}
                repeat = args.repeat if batch == 1 else max(3, args.repeat // batch)
                for turn in range(repeat + 2):
                    found = time_stages(detector, [file] * batch)
                    synchronise(bench.device)
                    begin = time.perf_counter()
                    plain.detect(points, sample, batch)
                    synchronise(bench.device)
                    if turn >= 2:  # two to warm up
                        times["plain model"].append(time.perf_counter() - begin)
                        for stage, seconds in found.items():
                            times.setdefault(stage, []).append(seconds)
                title = f"{name}, batch {batch}, {str(detector.dtype).removeprefix('torch.')}"
                row = {"config": name, "batch": batch, "dtype": str(detector.dtype)}
                rows += print_times(title, times, (*STAGES, "detector", "plain model"), batch, row)
            if args.all_round:
                whole = time_mounts(model, bench.device, scan, args.repeat)
                row = {"config": name, "batch": 1, "dtype": str(detector.dtype)}
                rows += print_times(f"{name}, whole scan of {len(scan):,} points", whole, tuple(whole), 1, row)
    write_rows(args.csv, rows, bench.machine)
    write_json(args.json, rows, bench.machine)


if __name__ == "__main__":
    run_command(main)
