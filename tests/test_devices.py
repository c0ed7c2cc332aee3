"""Which device a name means, what is said where torch sees a GPU and Warp does not, what memory is kept."""

import ctypes
import os
import platform
import re
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import warp as wp

import hvnet
from hvnet.exceptions import InputError
from hvnet.kernels.launch import cuda_problem, launch
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network import devices
from hvnet.network.devices import device_name, select_device
from tests.helpers import ROOT


def test_names() -> None:
    assert select_device("cpu") == torch.device("cpu")
    assert device_name(torch.device("cpu"))
    if not torch.cuda.is_available():
        assert select_device("auto") == torch.device("cpu")
        assert cuda_problem() is None
        with pytest.raises(InputError, match=r"^device cuda: torch sees no CUDA device; use cpu$"):
            hvnet.load(device="cuda")  # no word of an option that nobody typed


@pytest.mark.parametrize("name", ["tpu", "", "cpu:x", "cuda:x"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=rf"^device {re.escape(name)}: "):
        select_device(name)


def test_a_gpu_that_warp_does_not_see(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One line that says what to do; `auto` goes on with the CPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    problem = cuda_problem()
    assert problem is not None
    assert "driver of the 580 series or newer" in problem
    assert "\n" not in problem
    assert select_device("auto") == torch.device("cpu")
    assert capsys.readouterr().err == f"{problem}; going on with the CPU\n"
    with pytest.raises(InputError, match=r"^device cuda: torch sees a GPU, but Warp \S+ does not: "):
        select_device("cuda")
    with pytest.raises(RuntimeError) as caught:  # a kernel that is called by itself, on a tensor that torch put there
        launch(None, 1, [], torch.device("cuda"))
    assert str(caught.value) == problem
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert select_device("cpu") == torch.device("cpu")
        assert rotated_iou_bev(torch.ones(1, 7), torch.ones(1, 7)).item() == 1


FAULTS = """
import resource
import torch, hvnet

torch.set_num_threads(1)
detector = hvnet.load(device="cpu")
points = torch.rand(20000, 4, generator=torch.Generator().manual_seed(0)) * torch.tensor([60.0, 50.0, 2.0, 1.0])
points -= torch.tensor([0.0, 25.0, 1.8, 0.0])

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        detector(points)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
print(faults())
"""


HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator: what it keeps is not known")
@pytest.mark.skipif(HUGE_PAGES.is_file() and "[always]" in HUGE_PAGES.read_text(), reason="huge pages: few are touched")
def test_a_detector_asks_for_memory_once() -> None:
    """Warm calls touch no new pages: without `keep_memory` five of them touch some 25,000."""
    environment = {name: value for name, value in os.environ.items() if name not in devices.MALLOC_SETTINGS}
    command = [sys.executable, "-c", FAULTS]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 1000


@pytest.mark.parametrize(
    ("system", "variable", "refused", "kept"),
    [
        ("linux", "", False, [(-3, 2**25), (-1, 2**28)]),
        ("linux", "", True, [(-3, 2**25)]),  # nothing is set then: glibc goes on adapting both
        ("linux", "MALLOC_TRIM_THRESHOLD_", False, []),
        ("linux", "GLIBC_TUNABLES", False, []),
        ("darwin", "", False, []),
        ("win32", "", False, []),
    ],
)
def test_who_decides_what_memory_is_kept(
    system: str, variable: str, refused: bool, kept: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[tuple[int, int]] = []

    def mallopt(name: int, value: int) -> int:
        called.append((name, value))
        return int(not refused)

    for name in devices.MALLOC_SETTINGS:
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, "1")
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(mallopt=mallopt))
    devices.keep_memory()
    assert called == kept
    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace())  # musl has none
    devices.keep_memory()
