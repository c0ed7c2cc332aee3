"""The command for a GPU, with made-up parts: what it reads, what it checks, what it writes."""

import importlib.util
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from tests.helpers import ROOT

DEVICE = {"name": "NVIDIA H200 (test)", "capability": "9.0"}
MACHINE = {"device": "NVIDIA H200", "copy_gb_s": 4000.0, "product_gflop_s": 50000.0, "tf32_gflop_s": 300000.0}
JUNIT = """<testsuites><testsuite name="pytest" errors="{errors}" failures="0" tests="3">
<testcase classname="tests.test_cuda" name="test_a_step_waits_no_more_than_twice">
<properties><property name="waits" value="{waits}"/></properties></testcase>
<testcase classname="tests.test_scatter" name="test_table[cuda]">{inside}</testcase>
<testcase classname="tests.test_cuda" name="test_a_second_device"><skipped message="one device"/></testcase>
</testsuite></testsuites>"""


def rows(encoder: float = 0.09, frame: float = 0.9, step: float = 18.0) -> dict[str, list[dict[str, Any]]]:
    """What the benchmarks measured, as they write it."""
    row = {"case": "encoder, forward", "provider": "hvnet, CUDA graph", "median_ms": encoder, "roofline": 0.5}
    stages = [("hvnet", 8, 9.0), ("compact", 1, 0.3), ("hvnet", 1, frame)]
    return {
        "voxel_encode": [row | {"provider": "hvnet", "median_ms": 7.0}, row],
        "scatter": [row | {"case": "max, 64 channels", "roofline": None}],
        "rotated": [row | {"case": "NMS"}],
        "detect": [{"config": c, "batch": b, "stage": "whole scan", "p50_ms": f"{ms}"} for c, b, ms in stages],
        "train": [{"config": "hvnet", "batch": 4, "stage": "step", "p50_ms": f"{step}"}],
    }


@pytest.fixture(scope="module")
def gpu() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench_gpu", ROOT / "bench" / "gpu.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Runner:
    """In the place of processes: writes made-up results to the file that the command names."""

    def __init__(self, gpu: ModuleType, measured: dict[str, list[dict[str, Any]]], junit: str) -> None:
        self.gpu, self.measured, self.junit = gpu, measured, junit
        self.ends: dict[str, Any] = {}  # how some parts end
        self.seen: list[str] = []

    def __call__(self, command: Sequence[str], seconds: float) -> Any:
        if "pytest" in command:
            name, file = "tests", next(each for each in command if "--junitxml" in each).partition("=")[2]
        else:
            name, file = Path(command[1]).stem, command[command.index("--json") + 1]
        self.seen.append(name)
        end = self.ends.get(name, self.gpu.Done(0, f"{name} ran\n"))
        if name == "tests" and end.code in (0, 1):
            Path(file).write_text(self.junit)
        elif end.code == 0:
            Path(file).write_text(json.dumps({"machine": MACHINE, "rows": self.measured[name]}))
        return end


def passing(waits: float = 1.9) -> str:
    return JUNIT.format(errors=0, waits=waits, inside="")


def run(gpu: ModuleType, runner: Runner, out: Path) -> tuple[bool, dict[str, Any], str]:
    """Whether all is well, the JSON and the page."""
    well = gpu.report(DEVICE, gpu.PARTS, runner, out)
    assert runner.seen == [part.name for part in gpu.PARTS]  # whatever happens, the rest goes on
    assert sorted(path.name for path in out.iterdir()) == ["nvidia-h200-test.json", "nvidia-h200-test.md"]
    tree = json.loads((out / "nvidia-h200-test.json").read_text())
    return well, tree, (out / "nvidia-h200-test.md").read_text()


def missed(tree: dict[str, Any]) -> list[str]:
    return [aim["name"] for aim in tree["aims"] if not aim["holds"]]


def test_all_is_well(gpu: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    well, tree, page = run(gpu, Runner(gpu, rows(), passing()), tmp_path / "gpu")
    assert well
    assert missed(tree) == []
    assert [aim["measured"] for aim in tree["aims"]] == [0, 0.09, 0.9, 0.9, pytest.approx(222.2, abs=0.1), 1.9]
    assert tree["device"] == DEVICE
    assert [part["name"] for part in tree["parts"]] == [part.name for part in gpu.PARTS]
    assert page.startswith("# NVIDIA H200 (test)\n")
    assert "| encoder, inference, the paper's setting | 0.10 ms | 0.09 | holds |" in page
    assert "| tests | 0 | 2 passed, 0 failed, 1 skipped, 1.9 waits |" in page
    assert "| voxel_encode | encoder, forward | hvnet, CUDA graph | 0.09 | 50% |" in page
    assert "| detect | hvnet, batch 1 | whole scan | 0.9 |  |" in page
    assert "Roofs: a copy 4000.0 GB/s, a float32 product 50000.0 GFLOP/s, a TF32 product 300000.0 GFLOP/s." in page
    assert "failed" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("measured", "waits", "names"),
    [
        ({"encoder": 0.11}, 1, ["encoder, inference, the paper's setting"]),
        ({"frame": 1.5}, 1, ["whole scan to boxes, the paper's setting"]),
        (
            {"frame": 2.5},
            1,
            ["whole scan to boxes, the paper's setting: at first", "whole scan to boxes, the paper's setting"],
        ),
        ({"step": 18.2}, 1, ["training, the paper's setting"]),
        ({}, 2.1, ["waits for the device, a step of training"]),
    ],
)
def test_a_missed_aim(
    gpu: ModuleType,
    measured: dict[str, float],
    waits: float,
    names: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    well, tree, page = run(gpu, Runner(gpu, rows(**measured), passing(waits)), tmp_path)
    assert not well
    assert missed(tree) == names
    assert page.count("**missed**") == len(names)
    printed = capsys.readouterr().out
    assert all(f"failed: {name}: wanted " in printed for name in names)


def test_parts_that_fail(gpu: ModuleType, tmp_path: Path) -> None:
    """A timeout, a package that is missing, another error and a test: each in one line, with its aims."""
    runner = Runner(gpu, rows(), JUNIT.format(errors=1, waits=2, inside='<error message="x">trace</error>'))
    runner.ends = {
        "tests": gpu.Done(1, "E   ModuleNotFoundError: No module named 'shapely'\n1 error\n"),
        "voxel_encode": gpu.Done(None, "half of it\n"),
        "rotated": gpu.Done(1, "Traceback\nModuleNotFoundError: No module named 'numba.core'\n"),
        "detect": gpu.Done(1, "skipped\nno timing: boxes: tensor 0 is off | by much\n"),
        "train": gpu.Done(-9, ""),
    }
    well, tree, page = run(gpu, runner, tmp_path)
    assert not well
    assert {part["name"]: part["failure"] for part in tree["parts"]} == {
        "tests": "1 failed: test_table[cuda]; not installed: shapely",
        "voxel_encode": "ran out of time after 90 s",
        "scatter": "",
        "rotated": "not installed: numba",
        "detect": "exit code 1: no timing: boxes: tensor 0 is off | by much",
        "train": "exit code -9: no output",
    }
    assert len(missed(tree)) == 5
    assert [aim["measured"] for aim in tree["aims"]] == [1, None, None, None, None, 2]
    assert "| voxel_encode | 0 | **ran out of time after 90 s** |" in page
    assert "is off / by much" in page
    assert "| scatter | max, 64 channels |" in page


def test_no_test_ran(gpu: ModuleType, tmp_path: Path) -> None:
    """Green is not enough: where all tests were skipped, nothing is known."""
    runner = Runner(gpu, rows(), '<testsuite><testcase name="a"><skipped/></testcase></testsuite>')
    well, tree, _ = run(gpu, runner, tmp_path)
    assert not well
    assert tree["parts"][0]["failure"] == "no test ran"
    assert missed(tree) == ["CUDA tests that fail", "waits for the device, a step of training"]


def test_results_are_kept_as_they_come(gpu: ModuleType, tmp_path: Path) -> None:
    """Who stops it half-way has half of it."""

    class Stopped(Runner):
        def __call__(self, command: Sequence[str], seconds: float) -> Any:
            if "bench/scatter.py" in command:
                raise KeyboardInterrupt
            return super().__call__(command, seconds)

    with pytest.raises(KeyboardInterrupt):
        gpu.report(DEVICE, gpu.PARTS, Stopped(gpu, rows(), passing()), tmp_path)
    tree = json.loads((tmp_path / "nvidia-h200-test.json").read_text())
    assert [part["name"] for part in tree["parts"]] == ["tests", "voxel_encode"]


def test_parts_fit_into_ten_minutes(gpu: ModuleType) -> None:
    assert sum(part.seconds for part in gpu.PARTS) <= 600
    for part in gpu.PARTS[1:]:
        assert (ROOT / part.arguments[0]).is_file()
        assert part.arguments[1:5] == ("--device", "cuda", "--json", "FILE")


def test_processes(gpu: ModuleType) -> None:
    """Output and exit code; one that takes too long is ended, with what it started, and leaves what it has printed."""
    assert gpu.run_process([sys.executable, "-c", "import hvnet, sys; print('out'); sys.exit(3)"], 60) == (3, "out\n")
    code = "import subprocess, sys; print('begun', flush=True); subprocess.run([sys.executable, '-c', {!r}])"
    child = "import time; print('child', flush=True); time.sleep(60)"
    begin = time.monotonic()
    done = gpu.run_process([sys.executable, "-c", code.format(child)], 2)
    assert done == (None, "begun\nchild\n")
    assert time.monotonic() - begin < 20


def test_the_benchmarks_take_its_arguments(gpu: ModuleType) -> None:
    """Without a GPU each ends with one line; a wrong option would be argparse's error."""
    if torch.cuda.is_available():
        pytest.skip("it would run them all")
    code = """if True:
        import runpy, sys
        sys.path.insert(0, "bench")
        for given in eval(sys.argv[1]):
            sys.argv = list(given)
            try:
                runpy.run_path(given[0], run_name="__main__")
            except SystemExit as end:
                print(given[0], end.code)
    """
    given = repr([part.arguments for part in gpu.PARTS[1:]])
    done = subprocess.run([sys.executable, "-c", code, given], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == [f"{part.arguments[0]} 2" for part in gpu.PARTS[1:]]
    assert done.stderr == 5 * "error: --device cuda: torch sees no GPU here\n"


@pytest.mark.parametrize("arguments", [[], ["--sanitize"]])
def test_without_a_gpu(arguments: list[str]) -> None:
    if torch.cuda.is_available():
        pytest.skip("there is one")
    done = subprocess.run(
        [sys.executable, "bench/gpu.py", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: bench/gpu.py: torch sees no GPU here\n"


def test_sanitizer(gpu: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    seen: list[Sequence[str]] = []

    def complain(command: Sequence[str], seconds: float) -> Any:
        seen.append(command)
        return gpu.Done(9 if "racecheck" in command else 0, "ERROR SUMMARY: 1 error\n")

    monkeypatch.setenv("PYTORCH_NO_CUDA_MEMORY_CACHING", "")  # so that it is restored
    monkeypatch.setattr(gpu.shutil, "which", lambda name: None)
    with pytest.raises(SystemExit, match="compute-sanitizer is not in the PATH"):
        gpu.sanitize(complain)
    monkeypatch.setattr(gpu.shutil, "which", lambda name: f"/cuda/bin/{name}")
    assert not gpu.sanitize(complain)
    assert [command[2] for command in seen] == ["memcheck", "racecheck", "synccheck"]
    assert "racecheck: exit code 9: ERROR SUMMARY: 1 error" in capsys.readouterr().out
    for file in ("encode", "raycast", "rotated", "scatter", "voxel"):
        assert "def test_opcheck(" in (ROOT / "tests" / f"test_{file}.py").read_text()
    assert "def test_images_of_a_detector(" in (ROOT / "tests" / "test_cuda.py").read_text()
    assert gpu.SANITIZED == "test_opcheck or test_images_of_a_detector or test_place or test_candidates"
    assert gpu.WAITS in (ROOT / "tests" / "test_cuda.py").read_text()
