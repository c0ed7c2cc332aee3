"""The tests of kernels and of the encoder, once more with the threads of every launch in a random order."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

from tests.helpers import ROOT

KERNELS = sorted(path.stem for path in (ROOT / "kernels").glob("*.py"))
TESTED = [name for name in (*KERNELS, "encoder", "fused") if name not in ("reference", "shares")]
FILES = [f"tests/test_{name}.py" for name in TESTED] + [
    "tests/test_detector.py::test_the_same_boxes_as_the_plain_model"
]
SLOW = ("opcheck", "million", "gradcheck", "second_derivatives", "compiles")
"""Tests that show no more of the order of threads than the others do."""

PLANTED = """
import torch, warp as wp
from hvnet.kernels.launch import array, launch

@wp.kernel(enable_backward=False, module="unique")
def count(x: wp.array(dtype=wp.int64)):
    i = wp.tid()
    if i > 0:
        x[i] = x[i - 1] + wp.int64(1)

def test_count():
    x = torch.zeros(100, dtype=torch.int64)
    launch(count, 100, [array(x)], x.device)
    assert x.tolist() == list(range(100))
"""


def run_tests(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Runs pytest with the threads of every launch in a random order."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.thread_order", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def test_random_order() -> None:
    done = run_tests("-k", f"many-threads and not ({' or '.join(SLOW)})", *FILES)
    assert done.returncode == 0, done.stdout + done.stderr
    passed = re.search(r"(\d+) passed", done.stdout)
    assert passed is not None
    assert int(passed[1]) > 400


def test_a_kernel_that_needs_an_order_fails(tmp_path: Path) -> None:
    file = tmp_path / "test_planted.py"
    file.write_text(PLANTED)
    runpy.run_path(str(file))["test_count"]()  # one thread after the other
    done = run_tests(f"--rootdir={tmp_path}", str(file))
    assert done.returncode == 1, done.stdout + done.stderr
    assert "1 failed in" in done.stdout
