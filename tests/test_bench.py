"""The benchmarks on tiny sizes: they compare their providers, write only where they are told to, time nothing wrong."""

import csv
import gc
import json
import math
import re
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cuda_kernels
import pytest
import timing
import torch
from cuda_kernels import PIP, find_kernels, tool

from hvnet.kernels import rotated, scatter, voxel
from hvnet.network.fused import FusedEncoder
from tests.helpers import ROOT

RESULTS = ROOT / "bench" / "results"
MACHINE = {"device", "threads", "copy_gb_s", "product_gflop_s", "python", "torch", "warp-lang", "torch-scatter"}

ARGUMENTS = {
    "voxel_encode": ["--max-points", "1000", "--no-compile"],
    "scatter": ["--max-points", "1000"],
    "rotated": ["--boxes", "128", "--matrix", "64"],
}
PROVIDERS = {"voxel_encode": "torch", "scatter": "torch scatter_reduce", "rotated": "numba twin"}
"""One that some case of a script must have."""


def in_a_process(script: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs a benchmark as a user does."""
    command = [sys.executable, f"bench/{script}.py", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


class Done(NamedTuple):
    """What a benchmark that has ended says."""

    returncode: int
    stdout: str
    stderr: str


Bench = Callable[..., Done]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Bench:
    """Runs a benchmark in this process, which has imported and compiled what it needs; what is saved goes to a folder
    of the test."""
    (tmp_path / "tracked").mkdir()
    monkeypatch.setattr(timing, "RESULTS", tmp_path / "tracked")

    def run(script: str, *arguments: str) -> Done:
        monkeypatch.setattr(sys, "argv", [f"bench/{script}.py", *arguments])
        code, words = 0, ""
        try:
            runpy.run_path(str(ROOT / "bench" / f"{script}.py"), run_name="__main__")
        except SystemExit as ended:  # with a message, the interpreter prints it and ends with 1
            code, words = (1, f"{ended.code}\n") if isinstance(ended.code, str) else (int(ended.code or 0), "")
        finally:
            gc.unfreeze()
        printed = capsys.readouterr()
        return Done(code, printed.out, printed.err + words)

    return run


def tables(printed: str) -> list[str]:
    """The lines of what a benchmark prints, without its command and the paths of what it wrote."""
    return [line for line in printed.splitlines()[1:] if not line.startswith("written: ")]


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(autouse=True)
def tracked_results_stay() -> Iterator[None]:
    """No test here may change bench/results."""
    before = {path: path.read_bytes() for path in RESULTS.iterdir() if path.is_file()}
    yield
    assert {path: path.read_bytes() for path in RESULTS.iterdir() if path.is_file()} == before


def test_only_prints_unless_told() -> None:
    """Where a file of this machine would go is tracked: the fixture above sees one that is changed or added."""
    done = in_a_process("scatter", "--max-points", "1000", "--repeat", "1")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "written" not in done.stdout


def test_saves_when_told(bench: Bench, tmp_path: Path) -> None:
    done = bench("rotated", *ARGUMENTS["rotated"], "--repeat", "1", "--save")
    assert done.returncode == 0, done.stdout + done.stderr
    assert list((tmp_path / "tracked").iterdir()) == [tmp_path / "tracked" / "rotated.csv"]
    assert {row["provider"] for row in read_rows(tmp_path / "tracked" / "rotated.csv")} >= {"hvnet", "numba twin"}
    both = bench("rotated", "--save", "--csv", str(tmp_path / "rows.csv"))
    assert both.returncode == 2
    assert "not allowed with" in both.stderr


def test_help_says_where_rows_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    text = timing.parser("scatter", "", 20).format_help()
    assert "the tracked bench/results/scatter.csv, on a GPU to scatter_cuda.csv" in text
    assert "(default: they are only printed)" in text


@pytest.mark.parametrize(("script", "provider"), PROVIDERS.items())
def test_measures_and_writes(bench: Bench, script: str, provider: str, tmp_path: Path) -> None:
    files = tmp_path / "new" / "rows.csv", tmp_path / "rows.json"
    done = bench(script, *ARGUMENTS[script], "--repeat", "2", "--csv", str(files[0]), "--json", str(files[1]))
    assert done.returncode == 0, done.stdout + done.stderr
    assert not list((tmp_path / "tracked").iterdir())
    assert max(map(len, tables(done.stdout))) <= 100
    rows = read_rows(files[0])
    assert set(rows[0]) >= MACHINE
    assert provider in {row["provider"] for row in rows}
    assert {row["threads"] for row in rows} == {"1"}
    for row in rows:
        assert 0 < float(row["p20_ms"]) <= float(row["median_ms"]) <= float(row["p80_ms"])
    tree = json.loads(files[1].read_text(encoding="utf-8"))
    assert [row["provider"] for row in tree["rows"]] == [row["provider"] for row in rows]
    firsts = {row["case"]: row for row in reversed(tree["rows"])}
    assert all(row["provider"].startswith(("hvnet", "PointPillars")) for row in firsts.values())
    assert all(row["ratio"] == 1 for row in firsts.values())


def test_plot(bench: Bench, tmp_path: Path) -> None:
    plot, saved = tmp_path / "plot.png", tmp_path / "tracked"
    done = bench("voxel_encode", "--max-points", "1000", "--repeat", "1", "--plot", str(plot), "--save")
    assert done.returncode == 0, done.stdout + done.stderr
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in saved.iterdir()] == ["voxel_encode_sweep.csv"]  # not the file of the stages
    rows = read_rows(saved / "voxel_encode_sweep.csv")
    assert {row["case"] for row in rows} >= {"1,000 points, forward", "5 scales, forward + backward"}
    assert all(float(row["peak_mb"]) > 0 for row in rows)


def wrong_step(real: Callable[..., Any], *given: Any) -> Any:
    """A mistake in the images, or in the maxima."""
    found = real(*given)
    (found if isinstance(found, list) else found[1])[0].add_(1)
    return found


# what is timed must be what ships: a mistake in either step of FusedEncoder is seen
@pytest.mark.parametrize(
    ("script", "place", "name", "wrong"),
    [
        ("scatter", scatter, "segment_max", lambda real, *given: (real(*given)[0] + 1, 0)),
        ("rotated", rotated, "rotated_nms", lambda real, *given: real(*given)[1:]),
        ("voxel_encode", voxel, "cursors", lambda real, *given: real(*given) + 1),
        ("voxel_encode", FusedEncoder, "point_features", wrong_step),
        ("voxel_encode", FusedEncoder, "voxel_features", wrong_step),
    ],
)
def test_a_wrong_provider_is_not_timed(
    bench: Bench, script: str, place: Any, name: str, wrong: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = getattr(place, name)
    monkeypatch.setattr(place, name, lambda *given: wrong(real, *given))
    done = bench(script, *ARGUMENTS[script], "--repeat", "1", "--csv", str(tmp_path / "rows.csv"))
    assert done.returncode == 1, done.stdout + done.stderr
    assert "no timing: " in done.stderr
    assert not (tmp_path / "rows.csv").exists()


def test_mistakes_are_named(bench: Bench) -> None:
    done = in_a_process("scatter", "--threads", "0")
    assert done.returncode == 2
    assert done.stderr == "error: --threads and --repeat: want 1 or more, got 0 and 20\n"
    if not torch.cuda.is_available():
        assert bench("rotated", "--device", "cuda").stderr == "error: --device cuda: torch sees no GPU here\n"


def test_shares() -> None:
    peak = timing.Peak(copy=100.0, product=10.0)
    assert peak.seconds(timing.Work(200.0, 10.0)) == 2.0
    assert peak.seconds(timing.Work(200.0, 50.0)) == 5.0
    for got in (torch.tensor([1.0, math.nan]), torch.tensor([1.0, 2.1]), torch.ones(3)):
        with pytest.raises(SystemExit, match="no timing"):
            timing.agree("sum", [got], [torch.tensor([1.0, 2.0])], 1e-4, 1e-4)
    timing.agree("sum", [torch.tensor([1.0, 2.0001])], [torch.tensor([1.0, 2.0])], 1e-4, 0)


def test_stages_of_the_detector(bench: Bench, tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    files = ["--csv", str(file), "--json", f"{file}.json"]
    done = bench("detect", "--configs", "demo", "--batch", "1", "2", "--repeat", "2", *files)
    assert done.returncode == 0, done.stdout + done.stderr
    assert max(map(len, tables(done.stdout))) <= 100
    rows = read_rows(file)
    written = json.loads(Path(f"{file}.json").read_text(encoding="utf-8"))["rows"]
    assert [row["p50_ms"] for row in written] == [row["p50_ms"] for row in rows]
    stages = ["read", "encode", "backbone", "heads", "decode", "NMS", "detector", "plain model"]
    assert [row["stage"] for row in rows] == 2 * stages
    assert all(0 < float(row["p50_ms"]) <= float(row["p95_ms"]) for row in rows)


def test_stages_of_training(bench: Bench, tmp_path: Path) -> None:
    file = tmp_path / "rows.csv"
    done = bench("train", "--configs", "demo", "--repeat", "2", "--csv", str(file), "--json", f"{file}.json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "frames/s" in done.stdout
    assert max(map(len, tables(done.stdout))) <= 100
    rows = {row["stage"]: float(row["p50_ms"]) for row in read_rows(file)}
    assert list(rows) == ["data", "encoder", "backbone and heads", "loss", "backward", "optimiser", "step"]
    tree = json.loads(Path(f"{file}.json").read_text(encoding="utf-8"))
    assert {row["stage"]: float(row["p50_ms"]) for row in tree["rows"]} == rows
    assert set(tree["machine"]) >= MACHINE
    assert 0.5 < rows.pop("step") / sum(rows.values()) < 1.5


def test_report_of_what_a_gpu_would_do(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if tool("cuobjdump") is None or tool("nvdisasm") is None:
        pytest.skip(f"cuobjdump or nvdisasm is missing: {PIP}")
    file, points = tmp_path / "report.json", tmp_path / "points.bin"
    points.write_bytes((torch.rand(3000, 4) * torch.tensor([60.0, 20.0, 1.0, 1.0])).numpy().tobytes())
    few = find_kernels()[:4]
    monkeypatch.setattr(cuda_kernels, "find_kernels", lambda: few)  # compiling takes its time
    done = bench("cuda_report", "--json", str(file), "--points", str(points))
    assert done.returncode == 0, done.stdout + done.stderr
    assert max(map(len, done.stdout.splitlines())) <= 120
    assert re.findall(r"(?:holds|does not hold)$", done.stdout, re.MULTILINE)[2:]
    tree = json.loads(file.read_text(encoding="utf-8"))
    assert [row["name"] for row in tree["kernels"]] == [each.name for each in few]
    assert all(row["registers"] > 0 and row["stack"] >= 0 for row in tree["kernels"])
    assert all(set(row["load_bytes"]) <= {"1", "2", "4", "8", "16"} for row in tree["kernels"])
    for part in ("frame", "training"):
        stages = {row["stage"]: row for row in tree[part]}
        assert len(stages) == len(tree[part])
        assert all(row["estimated_us"] >= row["floor_us"] >= 0 and row["launches"] > 0 for row in stages.values())
        # of the paper's backbone; the training step has four clouds, and boxes of positive anchors alone
        convolutions = stages["convolutions"]["flops"] / (4 if part == "training" else 1)
        assert (125e9 if part == "training" else 130e9) < convolutions < 170e9
    outside = [row["stage"] for row in tree["frame"] if not row["in_graph"]]
    assert outside == ["upload", "transfer"]
    assert [row["holds"] for row in tree["bounds"]] == [
        sum(row["estimated_us"] for row in tree["frame"]) <= 1000,
        sum(row["launches"] for row in tree["frame"]) < 150,
        next(row["estimated_us"] for row in tree["training"] if row["stage"] == "encode.backward") < 500,
    ]


def test_report_without_its_tools(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda_kernels, "tool", lambda name: None)
    done = bench("cuda_report")
    assert done.returncode == 2
    assert done.stderr.endswith("error: cuobjdump is missing: pip install nvidia-cuda-cuobjdump nvidia-cuda-nvdisasm\n")
    assert len(done.stderr.splitlines()) == 1
