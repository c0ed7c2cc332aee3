"""Warp's start-up, the bridge from torch to Warp, and the checks at the boundary."""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

import functools
import os
from collections.abc import Sequence
from typing import Any

import torch
import warp as wp
from torch import Tensor

wp.config.log_level = wp.LOG_WARNING  # no banner, no line for every module that is loaded

FLOATS = (torch.float32, torch.float64)
WARP_FLOAT = {torch.float32: wp.float32, torch.float64: wp.float64}
LARGEST = wp.int32(0x7FFFFFFF)
LOW_BITS = wp.int64(0x7FFFFFFF)  # of a key with an index below and what is compared above
MAX_STRIDE = 2**31 - 1  # bytes: Warp keeps the strides of an array as int32

force_many_threads = False
"""Set by tests: the CPU runs what a GPU runs, with one thread after the other."""


def many_threads(device: torch.device) -> bool:
    """Whether work on a device is divided among many threads, and nothing is read back from it: so it is on a GPU.

    One thread takes other ways: it counts as it goes, compares only what is left and goes through whole vectors.
    """
    return force_many_threads or device.type == "cuda"


@functools.cache
def start() -> None:
    """Initialises Warp once. Without a GPU its native code prints a warning nobody can act on: it is kept back."""
    if torch.cuda.is_available():
        wp.init()
        return
    stderr = os.dup(2)
    silence = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silence, 2)
        wp.init()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(silence)


def cuda_problem() -> str | None:
    """Why CUDA tensors cannot be used where torch sees a GPU, and what to do; None if they can, or torch sees none."""
    if not torch.cuda.is_available():
        return None
    start()
    if wp.is_cuda_available():
        return None
    return (
        f"torch sees a GPU, but Warp {wp.__version__} does not: its wheels on PyPI need an NVIDIA driver of the 580 "
        "series or newer; update the driver, install the +cu12 wheel of Warp's GitHub releases, or use the CPU"
    )


def array(tensor: Tensor, lanes: int = 0) -> Any:
    """A Warp view of a contiguous tensor; with lanes > 0 its last dimension, (.., lanes), becomes one vector.

    It is a bare descriptor, made in half the time: a launch does not check its type, the public functions do.
    """
    start()
    if tensor.ndim > 1 and tensor.stride(0) * tensor.element_size() > MAX_STRIDE:
        raise ValueError(
            f"a tensor of shape {tuple(tensor.shape)}: its rows are more than 2 GiB apart; split the batch"
        )
    dtype = None
    if lanes:
        dtype = wp.types.vector(length=lanes, dtype=wp.dtype_from_torch(tensor.dtype))
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False, return_ctype=True)


def channels(tensor: Tensor, lanes: int) -> Any:
    """A Warp view (.., C / lanes) of vectors over a contiguous channels-last tensor (.., C)."""
    return array(tensor.view(*tensor.shape[:-1], tensor.shape[-1] // lanes, lanes), lanes)


def lanes_of(count: int, device: torch.device) -> int:
    """The channels that a thread takes of `count`.

    On a CPU the longest vector that divides them: vector-typed loops are the ones that compilers vectorise. On a GPU
    one: neighbouring threads then read neighbouring numbers.
    """
    return 1 if many_threads(device) else next(lanes for lanes in (16, 4, 1) if count % lanes == 0)


@functools.cache
def _warp_stream(device: str, handle: int) -> wp.Stream:
    """Warp's view of a stream of torch; made anew for every launch, it would make and destroy events as well."""
    return wp.Stream(device, cuda_stream=handle)


def current_stream(device: torch.device) -> wp.Stream:
    """Torch's current stream on a CUDA device."""
    stream = torch.cuda.current_stream(device)
    return _warp_stream(f"cuda:{stream.device_index}", stream.cuda_stream)


def launch(kernel: wp.Kernel, dim: int | Sequence[int], inputs: Sequence[object], device: torch.device) -> None:
    """Launches a kernel on the CPU, or on torch's current stream of a CUDA device."""
    start()
    if device.type == "cuda":
        if not wp.is_cuda_available():
            raise RuntimeError(cuda_problem() or "Warp sees no GPU")
        with torch.cuda.device(device):  # Warp leaves the device of the launch current
            wp.launch(kernel, dim=dim, inputs=inputs, stream=current_stream(device), record_tape=False)
    else:
        wp.launch(kernel, dim=dim, inputs=inputs, device="cpu", record_tape=False)


def check_tensor(
    name: str, value: object, dtypes: Sequence[torch.dtype], shape: Sequence[int | None], like: Tensor | None = None
) -> Tensor:
    """Checks an argument: a tensor of one of the dtypes, of the shape (None: any length), on the device of `like`.

    Raises TypeError (no tensor, wrong dtype) or ValueError (wrong shape or device), naming the argument.
    """
    if not isinstance(value, Tensor):
        raise TypeError(f"{name}: want a torch.Tensor, got {type(value).__name__}")
    if value.dtype not in dtypes:
        raise TypeError(f"{name}: want dtype {' or '.join(str(d) for d in dtypes)}, got {value.dtype}")
    if value.ndim != len(shape) or any(
        want is not None and got != want for got, want in zip(value.shape, shape, strict=False)
    ):
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise ValueError(f"{name}: want shape ({wanted}), got {tuple(value.shape)}")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name}: want device {like.device} as the other arguments, got {value.device}")
    return value


def check_index(name: str, index: Tensor, size: int) -> None:
    """Checks that every value of an index tensor is in [0, size); reads the device once."""
    if index.numel() == 0:
        return
    low, high = torch.stack(torch.aminmax(index)).tolist()
    check_bounds(name, low, high, size)


def check_bounds(name: str, low: int, high: int, size: int) -> None:
    """Checks that the least and the largest value of an index are in [0, size)."""
    if low < 0 or high >= size:
        raise ValueError(f"{name}: want values in [0, {size}), got {low} to {high}")
