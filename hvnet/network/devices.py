"""The device to run on, and what it is called."""

import platform
import sys
from pathlib import Path

import torch

from hvnet.exceptions import InputError
from hvnet.kernels.launch import cuda_problem


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
