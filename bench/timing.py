"""What the benchmarks share: providers timed in turns, the roofline, tables, files and the points to run on."""

import argparse
import csv
import gc
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # the memory profiler announces itself otherwise

import numpy as np
import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from hvnet.data.kitti import drop_non_finite, read_frame, read_points
from hvnet.data.scenes.files import make_frame
from hvnet.data.scenes.street import Options
from hvnet.exceptions import InputError
from hvnet.network.devices import device_name

RESULTS = Path(__file__).resolve().parent / "results"
PACKAGES = ("torch", "warp-lang", "torch-scatter", "numba", "shapely")
WARM_UP = 2  # calls a provider that are not timed; one if it takes longer than SLOW
SLOW = 1.0  # seconds
PATIENCE = 10.0  # seconds a provider from which on it gets fewer repetitions, but three at least

Run = Callable[[], object]


class Work(NamedTuple):
    """The least that any implementation of a computation must move and calculate."""

    bytes: float
    operations: float = 0.0


class Peak(NamedTuple):
    """What this machine does at best, measured: the roof over every `Work`."""

    copy: float  # bytes a second, read and written
    product: float  # operations a second of a float32 matrix product

    def seconds(self, work: Work) -> float:
        """The time under the roofline."""
        return max(work.bytes / self.copy, work.operations / self.product)


@dataclass(frozen=True)
class Row:
    """One provider at one case."""

    case: str
    provider: str
    median_ms: float
    p20_ms: float
    p80_ms: float
    ratio: float  # to the case's first provider, which is this project
    roofline: float | None  # share of the roofline: 1 is as fast as the machine's copy or matrix product allows
    repetitions: int
    peak_mb: float | None = None  # memory that a call adds at its highest


@dataclass
class Bench:
    """One run of a benchmark: the machine and the rows so far; tables are printed as they come."""

    device: torch.device
    repeat: int
    peak: Peak
    machine: dict[str, str | int | float]
    rows: list[Row] = field(default_factory=list)

    def time(
        self, case: str, providers: dict[str, Run], work: Work | None = None, memory: dict[str, float] | None = None
    ) -> list[Row]:
        """Times the providers of a case in turns and prints them; the first one is this project.

        `memory` is the peak in bytes of each provider, where it was measured.
        """
        times = in_turns(providers, self.repeat, self.device)
        first = float(np.median(next(iter(times.values()))))
        roof = self.peak.seconds(work) if work else None
        last = "peak MB" if memory else "roofline" if roof else ""
        print(f"\n{case:<46}{'median':>10}{'p20':>10}{'p80':>10} ms {'ratio':>8}{last:>11}")
        rows = []
        for provider, seconds in times.items():
            p20, median, p80 = (float(value) for value in np.percentile(seconds, (20, 50, 80)))
            share = roof / median if roof else None
            held = memory[provider] / 1e6 if memory else None
            row = Row(case, provider, 1e3 * median, 1e3 * p20, 1e3 * p80, median / first, share, len(seconds), held)
            rows.append(row)
            shown = f"{held:11.1f}" if held is not None else f"{share:11.1%}" if share is not None else ""
            print(
                f"  {provider:<44}{row.median_ms:10.3f}{row.p20_ms:10.3f}{row.p80_ms:10.3f}    {row.ratio:7.2f}x{shown}"
            )
        self.rows += rows
        sys.stdout.flush()
        return rows

    def write(self, csv_file: Path | None, json_file: Path | None) -> None:
        """Writes every row with the machine's columns, and the same as JSON, where a file is given."""
        rows = [
            {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in asdict(row).items()}
            for row in self.rows
        ]
        write_rows(csv_file, rows, self.machine)
        write_json(json_file, [asdict(row) for row in self.rows], self.machine)


def in_turns(providers: dict[str, Run], repeat: int, device: torch.device) -> dict[str, list[float]]:
    """Seconds of every call; the providers take turns, so that what else runs on the machine hits all alike."""
    rounds = {}
    for name, run in providers.items():
        for _ in range(WARM_UP):
            seconds = timed(run, device)
            if seconds > SLOW:
                break
        rounds[name] = min(repeat, max(3, int(PATIENCE / max(seconds, 1e-9))))
    times: dict[str, list[float]] = {name: [] for name in providers}
    gc.collect()
    gc.disable()
    try:
        for turn in range(repeat):
            for name, run in providers.items():
                if turn < rounds[name]:
                    times[name].append(timed(run, device))
    finally:
        gc.enable()
    return times


def timed(run: Run, device: torch.device) -> float:
    """Seconds of one call, to the end of its work on the device."""
    if device.type == "cuda":
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        torch.cuda.synchronize(device)
        start.record()
        run()
        end.record()
        end.synchronize()
        return start.elapsed_time(end) / 1e3
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def synchronise(device: torch.device) -> None:
    """Waits for the device."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def write_rows(path: Path | None, rows: list[dict[str, object]], machine: dict[str, str | int | float]) -> None:
    """Writes rows that have the same columns, each with the machine's; nothing without a path."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*rows[0], *machine])
        writer.writeheader()
        writer.writerows(row | machine for row in rows)
    print(f"\nwritten: {path}")


def write_json(path: Path | None, rows: list[dict[str, object]], machine: dict[str, str | int | float]) -> None:
    """Writes rows and the machine as JSON; nothing without a path."""
    if path is not None:
        path.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n", encoding="utf-8")
        print(f"written: {path}")


def peak_memory(run: Run, device: torch.device) -> float:
    """Bytes that torch's allocator holds more than before at the highest moment of a call."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
        before = torch.cuda.memory_allocated(device)
        torch.cuda.reset_peak_memory_stats(device)
        run()
        torch.cuda.synchronize(device)
        return torch.cuda.max_memory_allocated(device) - before
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as record:
        run()
    events = [event for event in record.profiler.kineto_results.events() if event.name() == "[memory]"]
    events.sort(key=lambda event: event.start_ns())
    held = np.cumsum([event.nbytes() for event in events])
    return float(held.max(initial=0))


def free_memory(device: torch.device) -> float:
    """Bytes that can still be allocated."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    info = Path("/proc/meminfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    free = [1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable")]
    return free[0] if free else float("inf")


def measure_peak(device: torch.device) -> Peak:
    """The best copy and the best float32 matrix product of ten."""
    large = device.type == "cuda"
    source = torch.ones(2**28 if large else 2**24, device=device)
    target = torch.empty_like(source)
    matrix = torch.ones(4096 if large else 1024, 4096 if large else 1024, device=device)
    copy = min(timed(lambda: target.copy_(source), device) for _ in range(10))
    return Peak(2 * source.numel() * source.element_size() / copy, measure_product(matrix, "ieee"))


def measure_product(matrix: Tensor, precision: str) -> float:
    """Operations a second of the best of ten products of a matrix with itself: in "ieee" float32, or in "tf32".

    A GPU's environment may have chosen either, so that it is said here.
    """
    products = torch.backends.cuda.matmul
    before, products.fp32_precision = products.fp32_precision, precision
    try:
        seconds = min(timed(lambda: matrix @ matrix, matrix.device) for _ in range(10))
    finally:
        products.fp32_precision = before
    return 2 * len(matrix) ** 3 / seconds


def agree(what: str, got: Sequence[Tensor], want: Sequence[Tensor], rtol: float, atol: float) -> None:
    """Ends the benchmark if two providers differ by more than rtol * |want| + atol * max |want|: no speed then."""
    if len(got) != len(want):
        sys.exit(f"no timing: {what}: {len(got)} tensors, expected {len(want)}")
    for k, (a, b) in enumerate(zip(got, want, strict=True)):
        if a.shape != b.shape:
            sys.exit(f"no timing: {what}: tensor {k} has shape {tuple(a.shape)}, expected {tuple(b.shape)}")
        a, b = a.detach().double().cpu(), b.detach().double().cpu()
        largest = float(b.abs().max()) if b.numel() else 0.0
        if not torch.allclose(a, b, rtol=rtol, atol=atol * largest):
            error = float((a - b).abs().max())
            sys.exit(f"no timing: {what}: tensor {k} is off by {error:.3g}, its largest value being {largest:.3g}")


def agree_in_norm(what: str, got: Sequence[Tensor], want: Sequence[Tensor], tolerance: float) -> None:
    """`agree` for gradients through a maximum: |got - want| <= tolerance * |want| in the Euclidean norm of a tensor.

    Where two points tie but for rounding, another one is the largest, and its whole gradient goes elsewhere.
    """
    for k, (a, b) in enumerate(zip(got, want, strict=True)):
        error, norm = float((a.double() - b.double()).norm()), float(b.double().norm())
        if not error <= tolerance * norm:
            sys.exit(f"no timing: {what}: tensor {k} is off by {error / norm:.3g} of its norm, allowed {tolerance:g}")


def skipped(provider: str, reason: str) -> None:
    """One line for a provider that cannot run here."""
    print(f"skipped: {provider}: {' '.join(reason.split())[:200]}")


def parser(name: str, doc: str | None, repeat: int) -> argparse.ArgumentParser:
    """The arguments of every benchmark."""
    made = argparse.ArgumentParser(prog=f"bench/{name}.py", description=doc)
    made.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    made.add_argument("--threads", type=int, default=1, help="torch's threads on the CPU (default: 1)")
    made.add_argument("--repeat", type=int, default=repeat, help=f"timed calls a provider (default: {repeat})")
    target = made.add_mutually_exclusive_group()
    target.add_argument(
        "--csv", type=Path, metavar="FILE", help="write the rows there (default: they are only printed)"
    )
    target.add_argument(
        "--save",
        action="store_true",
        help=f"write the rows to the tracked bench/results/{name}.csv, on a GPU to {name}_cuda.csv",
    )
    made.add_argument("--json", type=Path, metavar="FILE", help="write the rows there as JSON")
    return made


def start(name: str, args: argparse.Namespace) -> Bench:
    """Sets threads, measures the roofline and prints the machine; --save makes args.csv the tracked file."""
    if args.threads < 1 or args.repeat < 1:
        raise InputError(f"--threads and --repeat: want 1 or more, got {args.threads} and {args.repeat}")
    if args.device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: torch sees no GPU here")
    if args.save:
        args.csv = RESULTS / (f"{name}.csv" if args.device == "cpu" else f"{name}_cuda.csv")
    gc.collect()
    gc.freeze()  # what is imported lives on: no collection between timings has to look at it
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    device = torch.device(args.device)
    peak = measure_peak(device)
    machine: dict[str, str | int | float] = {
        "device": device_name(device),
        "threads": args.threads,
        "copy_gb_s": round(peak.copy / 1e9, 1),
        "product_gflop_s": round(peak.product / 1e9, 1),
        "python": platform.python_version(),
    }
    if device.type == "cuda":
        machine["tf32_gflop_s"] = round(measure_product(torch.ones(4096, 4096, device=device), "tf32") / 1e9, 1)
    for package in PACKAGES:
        try:
            machine[package] = version(package)
        except PackageNotFoundError:
            machine[package] = ""
    print(", ".join(f"{key} {value}" for key, value in machine.items() if value != ""))
    return Bench(device, args.repeat, peak, machine)


def read_scene(file: Path | None) -> Tensor:
    """Points (N, 4) float32 of a velodyne .bin, cropped to what the camera sees; without a file, of a generated scene.

    Where there is no calibration in KITTI's layout next to the file, the view is assumed to be x > 0, |y| < x.
    """
    if file is None:
        return torch.from_numpy(make_frame(0, 0, Options(azimuth=41))[1].points)
    folder = file.parent.parent
    if (folder / "calib" / f"{file.stem}.txt").is_file() and file.parent.name == "velodyne":
        return read_frame(folder.parent, file.stem, folder.name, labelled=False).points
    points = torch.from_numpy(drop_non_finite(read_points(file))[0])
    return points[(points[:, 0] > 0) & (points[:, 1].abs() < points[:, 0])]
