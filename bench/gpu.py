"""The CUDA tests, the benchmarks, and whether the aims hold, in ten minutes.

It writes a page and a JSON, named after the device, into bench/results/gpu/. A part that fails, runs out of time or
lacks a package is reported as such, and the rest goes on. The exit code is 1 if a part failed or an aim is missed.
--sanitize runs every op under NVIDIA's compute-sanitizer instead, and writes nothing.
"""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import torch

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "bench" / "results" / "gpu"
WAITS = "test_a_step_waits_no_more_than_twice"
"""The test that counts how often a step of training waits for the device."""
SANITIZED = "test_opcheck or test_images_of_a_detector or test_place or test_candidates"
"""The tests that call every op, and the kernels that only inference uses."""
NAMED = 10  # tests that failed; the others are counted
TOOLS = ("memcheck", "racecheck", "synccheck")  # not initcheck: the tests fill new memory with NaN, and see that


class Part(NamedTuple):
    """A script that is run, and the seconds that it may take."""

    name: str
    arguments: tuple[str, ...]  # of python; FILE stands for the file of results
    seconds: float


def bench(name: str, seconds: float, *arguments: str) -> Part:
    """A benchmark on the GPU."""
    return Part(name, (f"bench/{name}.py", "--device", "cuda", "--json", "FILE", *arguments), seconds)


PYTEST = ("-m", "pytest", "-q", "-m", "cuda", "-p", "no:cacheprovider", "--continue-on-collection-errors")
PARTS = (
    Part("tests", (*PYTEST, "-n", "8", "--junitxml=FILE", "tests"), 250),  # one process would not end in time
    bench("voxel_encode", 90, "--no-compile"),
    bench("scatter", 60, "--order", "voxel"),
    bench("rotated", 50, "--boxes", "4096", "10000", "--matrix", "2048"),  # the plain-Python reference is left out
    bench("detect", 75, "--all-round"),
    bench("train", 65, "--configs", "compact", "hvnet"),
)


class Done(NamedTuple):
    """What a process left."""

    code: int | None  # None: it ran out of time
    output: str


Runner = Callable[[Sequence[str], float], Done]


@dataclass
class Result:
    """A part that was run."""

    name: str
    seconds: float
    failure: str = ""
    """Why it has no result, or which tests failed; empty if all is well."""
    numbers: dict[str, float] = field(default_factory=dict)  # of the tests: passed, failed, skipped, waits
    machine: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)


class Aim(NamedTuple):
    """What is wanted of a number, and what was measured; None: nothing was."""

    name: str
    wanted: str
    limit: float
    measured: float | None
    at_least: bool = False

    def holds(self) -> bool:
        """Whether the number is as wanted."""
        if self.measured is None:
            return False
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit


def run_process(command: Sequence[str], seconds: float) -> Done:
    """Runs a process in the root of the repository, with this package in its path; its output is shown at the end."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as output:
        process = subprocess.Popen(
            command, cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            code: int | None = process.wait(seconds)
        except subprocess.TimeoutExpired:
            code = None
        finally:
            if process.poll() is None:  # with what it started: nothing else may be on the GPU when the next part runs
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        output.seek(0)
        return Done(code, output.read())


def measure(part: Part, folder: Path, run: Runner) -> Result:
    """Runs a part and reads its results."""
    file = folder / f"{part.name}.out"
    command = [sys.executable, *(given.replace("FILE", str(file)) for given in part.arguments)]
    begin = time.perf_counter()
    done = run(command, part.seconds)
    result = Result(part.name, round(time.perf_counter() - begin, 1))
    sys.stdout.write(done.output)
    result.failure = why_it_failed(done, part.seconds)
    if file.is_file() and done.code is not None:
        text = file.read_text(encoding="utf-8")
        if part.name == "tests":
            result.numbers, failed = read_tests(text)
            if failed:
                named = [*failed[:NAMED], *([f"{len(failed) - NAMED} more"] if len(failed) > NAMED else [])]
                lacking = f"; {missing_packages(done.output)}" if missing_packages(done.output) else ""
                result.failure = f"{len(failed)} failed: {', '.join(named)}{lacking}"
            elif not result.numbers["passed"]:
                result.failure = result.failure or "no test ran"
        else:
            tree = json.loads(text)
            result.machine, result.rows = tree["machine"], tree["rows"]
    return result


def why_it_failed(done: Done, seconds: float) -> str:
    """The reason in one line; empty if the process ended well."""
    if done.code is None:
        return f"ran out of time after {seconds:g} s"
    if done.code == 0:
        return ""
    if missing := missing_packages(done.output):
        return missing
    lines = [line.strip() for line in done.output.splitlines() if line.strip()]
    return f"exit code {done.code}: {lines[-1][:200] if lines else 'no output'}"


def missing_packages(output: str) -> str:
    """The packages that Python did not find, in words; empty if it found all."""
    missing = sorted(set(re.findall(r"No module named '(\w+)", output)))
    return f"not installed: {', '.join(missing)}" if missing else ""


def read_tests(text: str) -> tuple[dict[str, float], list[str]]:
    """The numbers of tests in pytest's JUnit file and of waits a step, and the names of the tests that failed."""
    numbers = {"passed": 0.0, "failed": 0.0, "skipped": 0.0}
    failed = []
    for case in ElementTree.fromstring(text).iter("testcase"):
        outcome = "passed"
        if case.find("failure") is not None or case.find("error") is not None:
            outcome = "failed"
            failed.append(case.get("name", ""))
        elif case.find("skipped") is not None:
            outcome = "skipped"
        numbers[outcome] += 1
        if case.get("name") == WAITS:
            for each in case.iter("property"):
                numbers[each.get("name", "")] = float(each.get("value", "nan"))
    return numbers, failed


def check_aims(results: Sequence[Result]) -> list[Aim]:
    """The aims, and what was measured."""
    rows = {result.name: result.rows for result in results}
    tests = next((result for result in results if result.name == "tests"), Result("tests", 0))

    def milliseconds(part: str, column: str, **wanted: object) -> float | None:
        found = [row for row in rows.get(part, []) if all(row[key] == value for key, value in wanted.items())]
        return float(found[0][column]) if found else None

    encoder = milliseconds("voxel_encode", "median_ms", case="encoder, forward", provider="hvnet, CUDA graph")
    frame = milliseconds("detect", "p50_ms", config="hvnet", batch=1, stage="whole scan")
    steps = [row for row in rows.get("train", []) if row["config"] == "hvnet" and row["stage"] == "step"]
    rate = 1e3 * steps[0]["batch"] / float(steps[0]["p50_ms"]) if steps else None
    failed = tests.numbers["failed"] if tests.numbers.get("passed") else None
    return [
        Aim("CUDA tests that fail", "0", 0, failed),
        Aim("encoder, inference, the paper's setting", "0.10 ms", 0.10, encoder),
        Aim("whole scan to boxes, the paper's setting: at first", "2 ms", 2.0, frame),
        Aim("whole scan to boxes, the paper's setting", "1 ms", 1.0, frame),
        Aim("training, the paper's setting", "220 frames/s", 220, rate, at_least=True),
        Aim("waits for the device, a step of training", "2", 2, tests.numbers.get("waits")),
    ]


def line_of(row: dict[str, Any]) -> tuple[str, str, float, float | None]:
    """Case, what ran, milliseconds and share of the roofline of a row of any benchmark."""
    if "case" in row:
        return row["case"], row["provider"], float(row["median_ms"]), row["roofline"]
    return f"{row['config']}, batch {row['batch']}", row["stage"], float(row["p50_ms"]), None


def make_page(device: dict[str, Any], results: Sequence[Result], aims: Sequence[Aim]) -> str:
    """The page, in markdown: aims, parts and every row."""
    lines = [f"# {device['name']}", "", ", ".join(f"{key} {value}" for key, value in device.items() if key != "name")]
    lines += ["", "| aim | wanted | measured | |", "| --- | --- | --- | --- |"]
    for aim in aims:
        measured = "nothing" if aim.measured is None else f"{aim.measured:.4g}"
        lines.append(f"| {aim.name} | {aim.wanted} | {measured} | {'holds' if aim.holds() else '**missed**'} |")
    lines += ["", "| part | seconds | |", "| --- | --- | --- |"]
    for result in results:
        said = ", ".join(f"{value:g} {name}" for name, value in result.numbers.items())
        shown = f"**{result.failure.replace('|', '/')}**" if result.failure else said or f"{len(result.rows)} rows"
        lines.append(f"| {result.name} | {result.seconds:.0f} | {shown} |")
    for machine in [result.machine for result in results if result.machine][:1]:
        roofs = {"a copy": ("copy_gb_s", "GB/s"), "a float32 product": ("product_gflop_s", "GFLOP/s")}
        roofs["a TF32 product"] = "tf32_gflop_s", "GFLOP/s"
        known = [f"{name} {machine[key]} {unit}" for name, (key, unit) in roofs.items() if key in machine]
        lines += ["", f"Roofs: {', '.join(known)}. A share of 100 % is as fast as the first two allow."]
    lines += ["", "| part | case | what | ms | share |", "| --- | --- | --- | --- | --- |"]
    for result in results:
        for case, what, milliseconds, share in map(line_of, result.rows):
            shown = "" if share is None else f"{share:.0%}"
            lines.append(f"| {result.name} | {case} | {what} | {milliseconds:.4g} | {shown} |")
    return "\n".join(lines) + "\n"


def describe_device() -> dict[str, Any]:
    """The GPU and the versions."""
    properties = torch.cuda.get_device_properties(0)
    found: dict[str, Any] = {
        "name": properties.name,
        "capability": f"{properties.major}.{properties.minor}",
        "memory GB": round(properties.total_memory / 1e9),
        "CUDA": torch.version.cuda,
        "python": sys.version.split()[0],
    }
    for package in ("torch", "warp-lang"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def report(device: dict[str, Any], parts: Sequence[Part], run: Runner, out: Path) -> bool:
    """Runs the parts and writes what they gave, after each of them; returns whether all is well."""
    results: list[Result] = []
    out.mkdir(parents=True, exist_ok=True)
    stem = out / re.sub(r"[^a-z0-9]+", "-", str(device["name"]).lower()).strip("-")
    with tempfile.TemporaryDirectory() as folder:
        for part in parts:
            print(f"\n== {part.name}", flush=True)
            results.append(measure(part, Path(folder), run))
            aims = check_aims(results)
            tree = {
                "device": device,
                "aims": [aim._asdict() | {"holds": aim.holds()} for aim in aims],
                "parts": [asdict(result) for result in results],
            }
            stem.with_suffix(".json").write_text(json.dumps(tree, indent=1) + "\n", encoding="utf-8")
            stem.with_suffix(".md").write_text(make_page(device, results, aims), encoding="utf-8")
    print()
    failed = [f"{result.name}: {result.failure}" for result in results if result.failure]
    failed += [f"{aim.name}: wanted {aim.wanted}, got {aim.measured}" for aim in aims if not aim.holds()]
    for line in failed:
        print(f"failed: {line}")
    print(f"written: {stem.with_suffix('.md')} and {stem.with_suffix('.json')}")
    return not failed


def sanitize(run: Runner) -> bool:
    """Runs every op under each tool of compute-sanitizer; returns whether none complains."""
    program = shutil.which("compute-sanitizer")
    if program is None:
        sys.exit("error: --sanitize: compute-sanitizer is not in the PATH; it comes with the CUDA toolkit")
    # memory from torch's cache would hide what is beyond a tensor's end
    os.environ["PYTORCH_NO_CUDA_MEMORY_CACHING"] = "1"
    well = True
    for tool in TOOLS:
        print(f"\n== {tool}", flush=True)
        tests = [sys.executable, *PYTEST, "-k", SANITIZED, "tests"]
        done = run([program, "--tool", tool, "--error-exitcode", "9", "--target-processes", "all", *tests], 600)
        sys.stdout.write(done.output)
        reason = why_it_failed(done, 600)
        print(f"{tool}: {reason or 'no complaint'}")
        well &= not reason
    return well


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments = argparse.ArgumentParser(prog="bench/gpu.py", description=__doc__)
    arguments.add_argument("--sanitize", action="store_true", help="every op under compute-sanitizer, instead")
    args = arguments.parse_args(argv)
    if not torch.cuda.is_available():
        sys.exit("error: bench/gpu.py: torch sees no GPU here")
    well = sanitize(run_process) if args.sanitize else report(describe_device(), PARTS, run_process, RESULTS)
    sys.exit(0 if well else 1)


if __name__ == "__main__":
    main()
