"""Every kernel, found without a list, compiles for GPUs without spilling and without arrays of its own."""

import functools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cuda_kernels
import pytest
import warp as wp
from cuda_kernels import Found, builtins_of, find_kernels, made_kernels, resource_faults, tool, written_kernels

from hvnet.kernels.launch import start

ARCHS = (80, 90)
needs_cuobjdump = pytest.mark.skipif(tool("cuobjdump") is None, reason=f"cuobjdump is missing: {cuda_kernels.PIP}")
vec = wp.types.vector(length=16, dtype=wp.float32)


@wp.func
def twice(x: float):
    return wp.sin(x) * 2.0


@functools.cache
def made(dtype: Any) -> SimpleNamespace:
    @wp.kernel(enable_backward=False, module=wp.Module(f"test_cuda_kernels_{dtype.__name__}", None))
    def scale(x: wp.array(dtype=dtype)):
        i = wp.tid()
        x[i] = x[i] + x[i]

    return SimpleNamespace(scale=scale, note="no kernel")


@functools.cache
def made_of_what(colour: int) -> wp.Kernel:
    @wp.kernel(enable_backward=False, module="unique")
    def paint(x: wp.array(dtype=int)):
        x[wp.tid()] = 0

    return paint


@functools.cache
def no_kernel(colour: int) -> int:
    return colour


@wp.kernel(enable_backward=False, module="unique")
def planted_array(where: wp.array(dtype=int), x: wp.array(dtype=float)):
    """An index that is not known when it is compiled puts the vector into memory."""
    taken = vec()
    for k in range(where.shape[0]):
        taken[where[k]] = taken[where[k]] + x[k]
    for k in range(16):
        x[k] = taken[k]


@wp.kernel(enable_backward=False, module="unique")
def planted_spill(x: wp.array2d(dtype=vec), y: wp.array2d(dtype=vec)):
    """More vectors live at a time than registers hold."""
    i = wp.tid()
    a, b, c, d, e, f = x[i, 0], x[i, 1], x[i, 2], x[i, 3], x[i, 4], x[i, 5]
    g, h, j, k, l, m = vec(), vec(), vec(), vec(), vec(), vec()
    for n in range(y.shape[1]):
        row = y[i, n]
        g += wp.cw_mul(a, row)
        h += wp.cw_mul(b, row)
        j += wp.cw_mul(c, row)
        k += wp.cw_mul(d, row)
        l += wp.cw_mul(e, row)
        m += wp.cw_mul(f, row)
    y[i, 0] = g
    y[i, 1] = h
    y[i, 2] = j
    y[i, 3] = k
    y[i, 4] = l
    y[i, 5] = m


@wp.kernel(enable_backward=False, module="unique")
def sine(x: wp.array(dtype=float)):
    i = wp.tid()
    x[i] = twice(x[i])


def test_every_kernel_that_is_written_is_found() -> None:
    found = find_kernels()
    assert {each.name for each in found} == written_kernels()
    assert len({id(each.kernel) for each in found}) == len(found) > len(written_kernels())


def test_a_function_that_makes_kernels_is_called_with_all_values() -> None:
    start()
    kernels = dict((parameters["dtype"], kernel) for kernel, parameters in made_kernels(made))
    assert set(kernels) == {wp.float32, wp.float64}
    assert kernels[wp.float32] is made(wp.float32).scale
    assert list(made_kernels(no_kernel)) == []


def test_a_parameter_that_is_not_known_is_named() -> None:
    with pytest.raises(TypeError, match=r"test_cuda_kernels.made_of_what: what colour .*DOMAINS"):
        list(made_kernels(made_of_what))


def test_what_a_kernel_takes_from_warp() -> None:
    assert {"sin", "tid"} <= builtins_of(sine)
    assert "cos" not in builtins_of(sine)


@needs_cuobjdump
def test_no_kernel_spills(tmp_path: Path) -> None:
    assert resource_faults(find_kernels(), ARCHS, tmp_path) == []


@needs_cuobjdump
def test_planted_spills_are_found(tmp_path: Path) -> None:
    start()
    planted = [Found(kernel.key, kernel, {}) for kernel in (planted_array, planted_spill, sine, made(wp.float32).scale)]
    faults = resource_faults(planted, ARCHS, tmp_path)
    assert [fault.split(":")[0].split()[-1] for fault in faults] == 2 * [planted_array.key, planted_spill.key]
