"""The benchmarks on tiny sizes: they compare their providers, write only where they are told to, time nothing wrong."""

import csv
import json
import math
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from cuda_kernels import PIP, find_kernels, tool

from tests.helpers import ROOT

RESULTS = ROOT / "bench" / "results"
MACHINE = {"device", "threads", "copy_gb_s", "product_gflop_s", "python", "torch", "warp-lang", "torch-scatter"}

# script, arguments, and a provider that some case must have
SCRIPTS = [
    ("voxel_encode", ["--max-points", "1000", "--no-compile"], "torch"),
    ("scatter", ["--max-points", "1000"], "torch scatter_reduce"),
    ("rotated", ["--boxes", "128", "--matrix", "64"], "numba twin"),
]


def bench(script: str, *arguments: str, first: str = "") -> subprocess.CompletedProcess[str]:
    """Runs a benchmark in a process, after some Python."""
    code = f"import runpy, sys\nsys.path.insert(0, 'bench')\n{first}\n"
    code += f"runpy.run_path('bench/{script}.py', run_name='__main__')"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, check=False
    )


def saving_to(folder: Path) -> str:
    return f"import pathlib, timing; timing.RESULTS = pathlib.Path({str(folder)!r})"


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


def test_only_prints_unless_told(tmp_path: Path) -> None:
    done = bench("rotated", "--boxes", "128", "--matrix", "64", "--repeat", "1", first=saving_to(tmp_path))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "written" not in done.stdout
    assert not list(tmp_path.iterdir())


def test_saves_when_told(tmp_path: Path) -> None:
    arguments = next(arguments for name, arguments, _ in SCRIPTS if name == "rotated")
    done = bench("rotated", *arguments, "--repeat", "1", "--save", first=saving_to(tmp_path))
    assert done.returncode == 0, done.stdout + done.stderr
    assert list(tmp_path.iterdir()) == [tmp_path / "rotated.csv"]
    assert {row["provider"] for row in read_rows(tmp_path / "rotated.csv")} >= {"hvnet", "numba twin"}
    both = bench("rotated", "--save", "--csv", str(tmp_path / "rows.csv"))
    assert both.returncode == 2
    assert "not allowed with" in both.stderr


def test_help_says_where_rows_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "bench")
    monkeypatch.setenv("COLUMNS", "200")
    timing = runpy.run_path(str(ROOT / "bench" / "timing.py"))
    text = timing["parser"]("scatter", "", 20).format_help()
    assert "the tracked bench/results/scatter.csv, on a GPU to scatter_cuda.csv" in text
    assert "(default: they are only printed)" in text


@pytest.mark.parametrize(("script", "arguments", "provider"), SCRIPTS)
def test_measures_and_writes(script: str, arguments: list[str], provider: str, tmp_path: Path) -> None:
    files = tmp_path / "new" / "rows.csv", tmp_path / "rows.json"
    given = [*arguments, "--repeat", "2", "--csv", str(files[0]), "--json", str(files[1])]
    done = bench(script, *given, first=saving_to(tmp_path / "tracked"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert not (tmp_path / "tracked").exists()
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


def test_plot(tmp_path: Path) -> None:
    plot, saved = tmp_path / "plot.png", tmp_path / "saved"
    arguments = ["--max-points", "1000", "--repeat", "1", "--plot", str(plot), "--save"]
    done = bench("voxel_encode", *arguments, first=saving_to(saved))
    assert done.returncode == 0, done.stdout + done.stderr
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in saved.iterdir()] == ["voxel_encode_sweep.csv"]  # not the file of the stages
    rows = read_rows(saved / "voxel_encode_sweep.csv")
    assert {row["case"] for row in rows} >= {"1,000 points, forward", "5 scales, forward + backward"}
    assert all(float(row["peak_mb"]) > 0 for row in rows)


# what is timed must be what ships: a mistake in either step of FusedEncoder is seen
WRONG_STEP = """
from hvnet.network.fused import FusedEncoder as m
f = m.{step}
def wrong(*given):
    found = f(*given)
    (found if isinstance(found, list) else found[1])[0].add_(1)
    return found
m.{step} = wrong
"""


@pytest.mark.parametrize(
    ("script", "wrong"),
    [
        (
            "scatter",
            "import hvnet.kernels.scatter as m; f = m.segment_max; m.segment_max = lambda *a: (f(*a)[0] + 1, 0)",
        ),
        ("rotated", "import hvnet.kernels.rotated as m; f = m.rotated_nms; m.rotated_nms = lambda *a: f(*a)[1:]"),
        ("voxel_encode", "import hvnet.kernels.voxel as m; f = m.cursors; m.cursors = lambda *a: f(*a) + 1"),
        *(("voxel_encode", WRONG_STEP.format(step=step)) for step in ("point_features", "voxel_features")),
    ],
)
def test_a_wrong_provider_is_not_timed(script: str, wrong: str, tmp_path: Path) -> None:
    arguments = next(arguments for name, arguments, _ in SCRIPTS if name == script)
    file = tmp_path / "rows.csv"
    done = bench(script, *arguments, "--repeat", "1", "--csv", str(file), first=wrong)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "no timing: " in done.stderr
    assert not file.exists()


def test_mistakes_are_named() -> None:
    done = bench("scatter", "--threads", "0")
    assert done.returncode == 2
    assert done.stderr == "error: --threads and --repeat: want 1 or more, got 0 and 20\n"
    if not torch.cuda.is_available():
        assert bench("rotated", "--device", "cuda").stderr == "error: --device cuda: torch sees no GPU here\n"


def test_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(ROOT / "bench")
    timing = runpy.run_path(str(ROOT / "bench" / "timing.py"))
    peak = timing["Peak"](copy=100.0, product=10.0)
    assert peak.seconds(timing["Work"](200.0, 10.0)) == 2.0
    assert peak.seconds(timing["Work"](200.0, 50.0)) == 5.0
    for got in (torch.tensor([1.0, math.nan]), torch.tensor([1.0, 2.1]), torch.ones(3)):
        with pytest.raises(SystemExit, match="no timing"):
            timing["agree"]("sum", [got], [torch.tensor([1.0, 2.0])], 1e-4, 1e-4)
    timing["agree"]("sum", [torch.tensor([1.0, 2.0001])], [torch.tensor([1.0, 2.0])], 1e-4, 0)


def test_stages_of_the_detector(tmp_path: Path) -> None:
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


def test_stages_of_training(tmp_path: Path) -> None:
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


def test_report_of_what_a_gpu_would_do(tmp_path: Path) -> None:
    if tool("cuobjdump") is None or tool("nvdisasm") is None:
        pytest.skip(f"cuobjdump or nvdisasm is missing: {PIP}")
    file, points = tmp_path / "report.json", tmp_path / "points.bin"
    points.write_bytes((torch.rand(3000, 4) * torch.tensor([60.0, 20.0, 1.0, 1.0])).numpy().tobytes())
    few = "import cuda_kernels as m; f = m.find_kernels; m.find_kernels = lambda: f()[:4]"  # compiling takes its time
    done = bench("cuda_report", "--json", str(file), "--points", str(points), first=few)
    assert done.returncode == 0, done.stdout + done.stderr
    assert max(map(len, done.stdout.splitlines())) <= 120
    assert re.findall(r"(?:holds|does not hold)$", done.stdout, re.MULTILINE)[2:]
    tree = json.loads(file.read_text(encoding="utf-8"))
    assert [row["name"] for row in tree["kernels"]] == [each.name for each in find_kernels()[:4]]
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


def test_report_without_its_tools() -> None:
    first = "import cuda_kernels; cuda_kernels.tool = lambda name: None"
    done = bench("cuda_report", first=first)
    assert done.returncode == 2
    assert done.stderr.endswith("error: cuobjdump is missing: pip install nvidia-cuda-cuobjdump nvidia-cuda-nvdisasm\n")
    assert len(done.stderr.splitlines()) == 1
