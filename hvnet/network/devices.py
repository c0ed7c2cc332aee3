"""The device to run on, what it is called, and what a CPU's allocator keeps."""

import ctypes
import os
import platform
import sys
from pathlib import Path

import torch

from hvnet.exceptions import InputError
from hvnet.kernels.launch import cuda_problem

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Of glibc's mallopt: more free memory at the heap's end, and a larger block, go back to the system."""
KEPT, KEPT_BLOCK = 2**28, 2**25
"""Bytes for both. The largest block of one cloud is 20 MB with `standard`; glibc may refuse more than 32 MiB."""
MALLOC_SETTINGS = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
"""Environment variables by which a user decides."""


def select_device(name: str) -> torch.device:
    """The device named auto, cpu or cuda (or cuda:1, ...); auto is CUDA where there is a GPU that torch and Warp see.

    Raises InputError.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
        if name == "cuda" and (problem := cuda_problem()):
            print(f"{problem}; going on with the CPU", file=sys.stderr)
            name = "cpu"
    elif name.startswith("cuda"):
        if not torch.cuda.is_available():
            raise InputError(f"device {name}: torch sees no CUDA device; use cpu")
        if problem := cuda_problem():
            raise InputError(f"device {name}: {problem}")
    if name.partition(":")[0] not in ("cpu", "cuda"):
        raise InputError(f"device {name}: want auto, cpu or cuda")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError(f"device {name}: want auto, cpu, cuda or cuda:N") from error


def device_name(device: torch.device) -> str:
    """The name of the GPU or of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def keep_memory() -> None:
    """Lets this process keep freed blocks of up to 32 MiB, where the allocator is glibc's and the user has not set it.

    By default glibc returns large blocks to the system, which has to clear their pages again for the next cloud.
    """
    if sys.platform != "linux" or any(name in os.environ for name in MALLOC_SETTINGS):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    # either of them ends what glibc would adapt by itself: both or none
    if mallopt is not None and mallopt(M_MMAP_THRESHOLD, KEPT_BLOCK):
        mallopt(M_TRIM_THRESHOLD, KEPT)
