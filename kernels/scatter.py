"""Scatter and gather between points and voxels (Sec. "Efficient Index-based Implementation"), with gradients.

An index is turned into segments, the points of each voxel one after the other. One thread goes through voxel after
voxel; of many each takes as many consecutive points, however long the voxels are, and a second kernel joins what of a
voxel was cut. There are no atomics and the order is fixed: the same bits on every run, and maxima, arg-max and integers
are the same on a CPU and on a GPU. Features are channels-last, and on a CPU the loops run over vectors of channels.
"""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import (
    FLOATS,
    WARP_FLOAT,
    array,
    channels,
    check_index,
    check_tensor,
    lanes_of,
    launch,
    many_threads,
)
from hvnet.kernels.shares import CHUNK, cut_voxel, ends_of, order_array, point_at, share_of, tasks_of


class Segments(NamedTuple):
    """The points of every voxel: voxel j owns order[starts[j]:starts[j + 1]], in ascending order of the points."""

    voxel: Tensor  # (N,) int64, the voxel of each point
    starts: Tensor  # (V + 1,) int64
    order: Tensor | None  # (N,) int64, points sorted by voxel; None: they already are


def segments(index: Tensor, dim_size: int) -> Segments:
    """The segments of an index (N,) int64 with values in [0, dim_size).

    Raises TypeError or ValueError naming the argument; reads the device once.
    """
    check_tensor("index", index, (torch.int64,), (None,))
    if dim_size < 0:
        raise ValueError(f"dim_size: want 0 or more, got {dim_size}")
    return Segments(index, *_segments(index, dim_size))


def scatter_max(src: Tensor, index: Tensor, dim_size: int) -> tuple[Tensor, Tensor]:
    """Maximum of the rows of src (N, C) that share an index (N,): values (dim_size, C), arg-max (dim_size, C) int64.

    A tie goes to the largest point index, a NaN is the maximum of its row, an empty row has value 0 and arg-max N.
    The gradient goes to the arg-max point alone, and is differentiable itself (a gather). Raises TypeError or
    ValueError naming the argument.
    """
    return segment_max(src, _segments_of(src, index, dim_size))


def scatter_mean(src: Tensor, index: Tensor, dim_size: int) -> Tensor:
    """Mean of the rows of src (N, C) that share an index (N,): (dim_size, C); an empty row is 0 (Eq. 2's means)."""
    return segment_mean(src, _segments_of(src, index, dim_size))


def gather(src: Tensor, index: Tensor) -> Tensor:
    """The rows src[index]: (V, C) and (N,) int64 give (N, C); the gradient is a sum in a fixed order."""
    check_tensor("src", src, FLOATS, (None, None))
    check_tensor("index", index, (torch.int64,), (None,), like=src)
    return segment_gather(src, segments(index, src.shape[0]))


def segment_max(src: Tensor, voxels: Segments) -> tuple[Tensor, Tensor]:
    """`scatter_max` over segments that are at hand: src (N, C) gives values and arg-max (V, C)."""
    check_tensor("src", src, FLOATS, (voxels.voxel.shape[0], None), like=voxels.voxel)
    values, argmax = _segment_max(src, voxels.voxel, voxels.order, voxels.starts)
    return values, argmax.long()


def segment_mean(src: Tensor, voxels: Segments) -> Tensor:
    """`scatter_mean` over segments that are at hand: src (N, C) gives (V, C)."""
    check_tensor("src", src, FLOATS, (voxels.voxel.shape[0], None), like=voxels.voxel)
    count = voxels.starts.diff().clamp(min=1).unsqueeze(1)
    return _segment_sum(src, voxels.voxel, voxels.order, voxels.starts) / count


def segment_gather(src: Tensor, voxels: Segments) -> Tensor:
    """`gather` over segments that are at hand: src (V, C) gives (N, C)."""
    check_tensor("src", src, FLOATS, (voxels.starts.shape[0] - 1, None), like=voxels.voxel)
    return _gather(src, voxels.voxel, voxels.order, voxels.starts)


def segment_add(base: Tensor, src: Tensor, voxels: Segments) -> Tensor:
    """base (N, C) plus the rows of src (V, C) that belong to its points, in one pass: base + segment_gather(src)."""
    check_tensor("base", base, FLOATS, (voxels.voxel.shape[0], None), like=voxels.voxel)
    check_tensor("src", src, (base.dtype,), (voxels.starts.shape[0] - 1, base.shape[1]), like=base)
    return _gather_add(base, src, voxels.voxel, voxels.order, voxels.starts)


def _segments_of(src: Tensor, index: Tensor, dim_size: int) -> Segments:
    check_tensor("src", src, FLOATS, (None, None))
    check_tensor("index", index, (torch.int64,), (src.shape[0],), like=src)
    return segments(index, dim_size)


@functools.cache
def _kernels(dtype: Any, lanes: int) -> SimpleNamespace:
    """The kernels for one floating type and vector length, in a module of their own."""
    vec = wp.types.vector(length=lanes, dtype=dtype)
    int_vec = wp.types.vector(length=lanes, dtype=wp.int32)  # as wide as float32: the lanes stay in step
    wide = wp.types.vector(length=lanes, dtype=wp.float64)
    module = wp.Module(f"hvnet_scatter_{dtype.__name__}_{lanes}", None)

    @wp.func
    def largest_of(src: wp.array2d(dtype=vec), order: wp.array(dtype=wp.int64), begin: int, end: int, c: int):
        best = vec()
        of_best = int_vec(src.shape[0])
        if begin < end:
            i = point_at(order, begin)
            best = src[i, c]
            of_best = int_vec(i)
        nonfinite = best - best  # stays 0 unless a value is not finite
        for k in range(begin + 1, end):
            i = point_at(order, k)
            row = src[i, c]
            nonfinite += row - row
            for lane in range(lanes):
                if row[lane] >= best[lane]:
                    best[lane] = row[lane]
                    of_best[lane] = i
        if wp.dot(nonfinite, nonfinite) != dtype(0.0):
            of_best = int_vec(-1)  # left to maximum_with_nan: its branches would slow down this loop fourfold
        return best, of_best

    @wp.kernel(enable_backward=False, module=module)
    def maximum(
        src: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        values: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
    ):
        v, c = wp.tid()
        best, of_best = largest_of(src, order, int(starts[v]), int(starts[v + 1]), c)
        values[v, c] = best
        argmax[v, c] = of_best

    @wp.kernel(enable_backward=False, module=module)
    def maximum_of_chunk(
        src: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        voxel: wp.array(dtype=wp.int64),
        ends: wp.array3d(dtype=vec),
        ends_argmax: wp.array3d(dtype=int_vec),
        values: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
    ):
        task, c = wp.tid()
        share = share_of(task, CHUNK, src.shape[0], values.shape[0], voxel, order)
        first, last = share[0], share[1]
        for v in range(share[2], share[3]):
            begin, end = int(starts[v]), int(starts[v + 1])
            best, of_best = largest_of(src, order, wp.max(begin, first), wp.min(end, last), c)
            if begin < first:
                ends[0, task, c] = best
                ends_argmax[0, task, c] = of_best
            elif end > last:
                ends[1, task, c] = best
                ends_argmax[1, task, c] = of_best
            else:
                values[v, c] = best
                argmax[v, c] = of_best

    @wp.kernel(enable_backward=False, module=module)
    def maximum_join(
        src: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        voxel: wp.array(dtype=wp.int64),
        ends: wp.array3d(dtype=vec),
        ends_argmax: wp.array3d(dtype=int_vec),
        values: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
    ):
        task, c = wp.tid()
        v = cut_voxel(task, CHUNK, src.shape[0], voxel, order, starts)
        if v < 0:
            return
        best = ends[1, task, c]
        of_best = ends_argmax[1, task, c]
        lowest = of_best  # below 0 if a part was left to maximum_with_nan
        k = task + 1
        while k * CHUNK < int(starts[v + 1]):
            row = ends[0, k, c]
            of_row = ends_argmax[0, k, c]
            lowest = wp.min(lowest, of_row)
            for lane in range(lanes):
                if row[lane] >= best[lane]:
                    best[lane] = row[lane]
                    of_best[lane] = of_row[lane]
            k += 1
        if wp.min(lowest) < 0:
            of_best = int_vec(-1)
        values[v, c] = best
        argmax[v, c] = of_best

    @wp.kernel(enable_backward=False, module=module)
    def maximum_with_nan(
        src: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        values: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
    ):
        voxel, c = wp.tid()
        if argmax[voxel, c][0] >= 0:
            return
        start = int(starts[voxel])
        i = point_at(order, start)
        best = src[i, c]
        of_best = int_vec(i)
        for k in range(start + 1, int(starts[voxel + 1])):
            i = point_at(order, k)
            row = src[i, c]
            for lane in range(lanes):
                # a later point wins unless it is below, or the best is a NaN and it is not
                if not (row[lane] < best[lane]) and (row[lane] != row[lane] or best[lane] == best[lane]):
                    best[lane] = row[lane]
                    of_best[lane] = i
        values[voxel, c] = best
        argmax[voxel, c] = of_best

    @wp.kernel(enable_backward=False, module=module)
    def maximum_backward(
        grad: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
        index: wp.array(dtype=wp.int64),
        grad_src: wp.array2d(dtype=vec),
    ):
        i, c = wp.tid()
        voxel = int(index[i])
        given = grad[voxel, c]
        of_best = argmax[voxel, c]
        taken = vec()
        for lane in range(lanes):
            if of_best[lane] == i:
                taken[lane] = given[lane]
        grad_src[i, c] = taken

    @wp.func
    def sum_of(src: wp.array2d(dtype=vec), order: wp.array(dtype=wp.int64), begin: int, end: int, c: int):
        # in float64: a million float32 summed one by one would be off by a hundredth
        value = wide()
        for k in range(begin, end):
            row = src[point_at(order, k), c]
            for lane in range(lanes):
                value[lane] = value[lane] + wp.float64(row[lane])
        return value

    @wp.func
    def rounded(value: wide):
        narrow = vec()
        for lane in range(lanes):
            narrow[lane] = dtype(value[lane])
        return narrow

    @wp.kernel(enable_backward=False, module=module)
    def total(
        src: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        values: wp.array2d(dtype=vec),
    ):
        v, c = wp.tid()
        values[v, c] = rounded(sum_of(src, order, int(starts[v]), int(starts[v + 1]), c))

    @wp.kernel(enable_backward=False, module=module)
    def total_of_chunk(
        src: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        voxel: wp.array(dtype=wp.int64),
        ends: wp.array3d(dtype=wide),
        values: wp.array2d(dtype=vec),
    ):
        task, c = wp.tid()
        share = share_of(task, CHUNK, src.shape[0], values.shape[0], voxel, order)
        first, last = share[0], share[1]
        for v in range(share[2], share[3]):
            begin, end = int(starts[v]), int(starts[v + 1])
            value = sum_of(src, order, wp.max(begin, first), wp.min(end, last), c)
            if begin < first:
                ends[0, task, c] = value
            elif end > last:
                ends[1, task, c] = value
            else:
                values[v, c] = rounded(value)

    @wp.kernel(enable_backward=False, module=module)
    def total_join(
        src: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        voxel: wp.array(dtype=wp.int64),
        ends: wp.array3d(dtype=wide),
        values: wp.array2d(dtype=vec),
    ):
        task, c = wp.tid()
        v = cut_voxel(task, CHUNK, src.shape[0], voxel, order, starts)
        if v < 0:
            return
        value = ends[1, task, c]
        k = task + 1
        while k * CHUNK < int(starts[v + 1]):
            value += ends[0, k, c]
            k += 1
        values[v, c] = rounded(value)

    @wp.kernel(enable_backward=False, module=module)
    def gather_add(
        base: wp.array2d(dtype=vec),
        src: wp.array2d(dtype=vec),
        voxel: wp.array(dtype=wp.int64),
        values: wp.array2d(dtype=vec),
    ):
        i, c = wp.tid()
        values[i, c] = base[i, c] + src[int(voxel[i]), c]

    return SimpleNamespace(
        gather_add=gather_add,
        maximum=maximum,
        maximum_of_chunk=maximum_of_chunk,
        maximum_join=maximum_join,
        maximum_with_nan=maximum_with_nan,
        maximum_backward=maximum_backward,
        total=total,
        total_of_chunk=total_of_chunk,
        total_join=total_join,
    )


def _segments_outputs(index: Tensor, dim_size: int) -> tuple[Tensor, Tensor]:
    return index.new_empty(dim_size + 1), index.new_empty(index.shape[0])


@torch.library.custom_op("hvnet::segments", mutates_args=())
def _segments(index: Tensor, dim_size: int) -> tuple[Tensor, Tensor]:
    """The starts and the order of `Segments`."""
    starts, order = _segments_outputs(index, dim_size)
    values = torch.empty_like(order)
    torch.sort(index, stable=True, out=(values, order))
    check_index("index", values[:: max(len(values) - 1, 1)], dim_size)  # the least and the largest
    torch.searchsorted(values, torch.arange(dim_size + 1, device=index.device), out=starts)
    return starts, order


_segments.register_fake(_segments_outputs)


def _segment_max_outputs(src: Tensor, index: Tensor, order: Tensor | None, starts: Tensor) -> tuple[Tensor, Tensor]:
    shape = (starts.shape[0] - 1, src.shape[1])
    return src.new_empty(shape), src.new_empty(shape, dtype=torch.int32)


@torch.library.custom_op("hvnet::segment_max", mutates_args=())
def _segment_max(src: Tensor, index: Tensor, order: Tensor | None, starts: Tensor) -> tuple[Tensor, Tensor]:
    count, lanes = src.shape[1], lanes_of(src.shape[1], src.device)
    values, argmax = _segment_max_outputs(src, index, order, starts)
    kernels = _kernels(WARP_FLOAT[src.dtype], lanes)
    inputs = [channels(src.contiguous(), lanes), order_array(order, starts), array(starts.contiguous())]
    outputs = [channels(values, lanes), channels(argmax, lanes)]
    if many_threads(src.device):
        tasks = tasks_of(CHUNK, len(src))
        ends = ends_of(tasks, src), ends_of(tasks, src, torch.int32)
        chunked = [*inputs, array(index.contiguous()), *(channels(each, lanes) for each in ends), *outputs]
        for kernel in (kernels.maximum_of_chunk, kernels.maximum_join):
            launch(kernel, (tasks, count // lanes), chunked, src.device)
    else:
        launch(kernels.maximum, (len(values), count // lanes), [*inputs, *outputs], src.device)
    launch(kernels.maximum_with_nan, (len(values), count // lanes), [*inputs, *outputs], src.device)
    return values, argmax


_segment_max.register_fake(_segment_max_outputs)


def _segment_max_backward_outputs(grad: Tensor, argmax: Tensor, index: Tensor) -> Tensor:
    return grad.new_empty(index.shape[0], grad.shape[1])


@torch.library.custom_op("hvnet::segment_max_backward", mutates_args=())
def _segment_max_backward(grad: Tensor, argmax: Tensor, index: Tensor) -> Tensor:
    count, lanes = grad.shape[1], lanes_of(grad.shape[1], grad.device)
    grad_src = _segment_max_backward_outputs(grad, argmax, index)
    inputs = [channels(grad.contiguous(), lanes), channels(argmax.contiguous(), lanes), array(index.contiguous())]
    inputs += [channels(grad_src, lanes)]
    kernel = _kernels(WARP_FLOAT[grad.dtype], lanes).maximum_backward
    launch(kernel, (index.shape[0], count // lanes), inputs, grad.device)
    return grad_src


_segment_max_backward.register_fake(_segment_max_backward_outputs)


def _segment_sum_outputs(src: Tensor, index: Tensor, order: Tensor | None, starts: Tensor) -> Tensor:
    return src.new_empty(starts.shape[0] - 1, src.shape[1])


@torch.library.custom_op("hvnet::segment_sum", mutates_args=())
def _segment_sum(src: Tensor, index: Tensor, order: Tensor | None, starts: Tensor) -> Tensor:
    count, lanes = src.shape[1], lanes_of(src.shape[1], src.device)
    values = _segment_sum_outputs(src, index, order, starts)
    kernels = _kernels(WARP_FLOAT[src.dtype], lanes)
    inputs = [channels(src.contiguous(), lanes), order_array(order, starts), array(starts.contiguous())]
    if many_threads(src.device):
        tasks = tasks_of(CHUNK, len(src))
        ends = channels(ends_of(tasks, src, torch.float64), lanes)
        inputs += [array(index.contiguous()), ends, channels(values, lanes)]
        for kernel in (kernels.total_of_chunk, kernels.total_join):
            launch(kernel, (tasks, count // lanes), inputs, src.device)
    else:
        launch(kernels.total, (len(values), count // lanes), [*inputs, channels(values, lanes)], src.device)
    return values


_segment_sum.register_fake(_segment_sum_outputs)


def _gather_outputs(src: Tensor, index: Tensor, order: Tensor | None, starts: Tensor) -> Tensor:
    return src.new_empty(index.shape[0], src.shape[1])


@torch.library.custom_op("hvnet::gather", mutates_args=())
def _gather(src: Tensor, index: Tensor, order: Tensor | None, starts: Tensor) -> Tensor:
    # a plain slice is fast enough, as the paper says; its own gradient is not
    return torch.index_select(src, 0, index, out=_gather_outputs(src, index, order, starts))


_gather.register_fake(_gather_outputs)


def _gather_add_outputs(base: Tensor, src: Tensor, voxel: Tensor, order: Tensor | None, starts: Tensor) -> Tensor:
    return base.new_empty(base.shape)


@torch.library.custom_op("hvnet::gather_add", mutates_args=())
def _gather_add(base: Tensor, src: Tensor, voxel: Tensor, order: Tensor | None, starts: Tensor) -> Tensor:
    count, lanes = base.shape[1], lanes_of(base.shape[1], base.device)
    values = _gather_add_outputs(base, src, voxel, order, starts)
    inputs = [channels(base.contiguous(), lanes), channels(src.contiguous(), lanes), array(voxel.contiguous())]
    inputs += [channels(values, lanes)]
    launch(_kernels(WARP_FLOAT[base.dtype], lanes).gather_add, (base.shape[0], count // lanes), inputs, base.device)
    return values


_gather_add.register_fake(_gather_add_outputs)


def _save_max(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(output[1], inputs[1])


def _max_backward(ctx: Any, grad: Tensor, _: Any) -> tuple[Tensor, None, None, None]:
    argmax, index = ctx.saved_tensors
    return _segment_max_backward(grad, argmax, index), None, None, None


def _save_argmax(ctx: Any, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(inputs[1])


def _max_double_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
    (argmax,) = ctx.saved_tensors
    padded = torch.cat((grad, grad.new_zeros(1, grad.shape[1])))  # an empty row's arg-max is N
    return padded.gather(0, argmax.long()), None, None


def _save_segments(ctx: Any, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(*inputs[1:])


def _sum_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
    return _gather(grad.contiguous(), *ctx.saved_tensors), None, None, None


def _gather_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:
    return _segment_sum(grad.contiguous(), *ctx.saved_tensors), None, None, None


def _save_added(ctx: Any, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(*inputs[2:])


def _gather_add_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, None, None]:
    return grad, _segment_sum(grad.contiguous(), *ctx.saved_tensors), None, None, None


_gather_add.register_autograd(_gather_add_backward, setup_context=_save_added)
_segment_max.register_autograd(_max_backward, setup_context=_save_max)
_segment_max_backward.register_autograd(_max_double_backward, setup_context=_save_argmax)
_segment_sum.register_autograd(_sum_backward, setup_context=_save_segments)
_gather.register_autograd(_gather_backward, setup_context=_save_segments)
