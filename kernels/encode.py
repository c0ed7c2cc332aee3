"""Attentive voxel feature encoding in one kernel (Sec. 3.2): knowledge, its Linear, the product and the maximum.

For a point in its voxel, attention a = W g + b with g = (x - mean x, f, mean p) of Eq. 2, product M = features * a, and
G' = the maximum of M over the voxel. Neither g nor a is ever written: both are made again from the point and the mean
of its voxel wherever they are needed, and so is the rest in the backward pass. Batch norms are folded into W and b.
"""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type,type-var"

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import FLOATS, WARP_FLOAT, array, channels, check_tensor, lanes_of, launch, many_threads
from hvnet.kernels.scatter import Segments
from hvnet.kernels.shares import CHUNK, cut_voxel, ends_of, order_array, point_at, share_of, tasks_of
from hvnet.kernels.voxel import NestedIndex

ROWS = 1024  # rows that are summed as one block
LAYER = 11  # rows of a layer: of g, x - mean x (3), f, mean p (4) and the bias; scale and shift of the features
VOXELS = 32  # voxels whose gradient of the layer is summed as one block


def attend(
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
    voxels: Segments,
    relu: bool = False,
    keep: bool = True,
) -> tuple[Tensor, Tensor]:
    """M (N, C) and its maxima G' (V, C) for features (N, C) of points (N, 4) in voxels of means (V, 4).

    The layer (11, C) holds the transposed W of g and its bias b (9 rows), and scale and shift of the features (their
    batch norm). With relu, features and attention go through a ReLU before the product. M is (0, C) unless it is to be
    kept. A tie goes to the last point of the segment. Gradients go to features and layer; the points are given. Raises
    TypeError or ValueError naming the argument.
    """
    check_tensor("features", features, FLOATS, (None, None))
    count = features.shape[1]
    check_tensor("points", points, (features.dtype,), (features.shape[0], 4), like=features)
    check_tensor("mean", mean, (features.dtype,), (voxels.starts.shape[0] - 1, 4), like=features)
    check_tensor("layer", layer, (features.dtype,), (LAYER, count), like=features)
    product, values, _ = _attend(features, points, mean, layer, voxels.voxel, voxels.order, voxels.starts, relu, keep)
    return product, values


def column_sums(rows: Tensor) -> tuple[Tensor, Tensor]:
    """Sums (C,) of the columns of rows (N, C) and of their squares, in float64 and in a fixed order."""
    check_tensor("rows", rows, FLOATS, (None, None))
    return _column_sums(rows)


def write_image(features: Tensor, cursor: Tensor, cells: int) -> Tensor:
    """Eq. 3: the rows of features (V, C) at their cursors (V,) int64, no two alike, of an image (cells, C) of zeros."""
    check_tensor("features", features, FLOATS, (None, None))
    check_tensor("cursor", cursor, (torch.int64,), (features.shape[0],), like=features)
    return _write_image(features, cursor, cells)


class Scales(NamedTuple):
    """The voxels of S nested scales in arrays of fixed size, for inference."""

    voxels: NestedIndex
    means: Tensor  # (S, V, 4) float32, of the points of each voxel
    rows: list[int]  # of every scale as many voxels or more, known on the host


def scales_of(index: NestedIndex, points: Tensor, finest: int, cells: Sequence[int]) -> tuple[Scales, Tensor]:
    """The scales of an index of points (N, 4) float32, and the points in its order.

    finest: the finest scale; cells: of the grids of all samples, by scale

    On a CPU the counts are at hand and bound the work; for many threads the numbers of points and of cells do, and
    nothing is read.
    """
    capacity = len(index.order)
    rows = [min(capacity, most) for most in cells]
    kept = capacity
    if not many_threads(points.device):
        *rows, kept = index.counts.tolist()
    points = points[index.order[:kept]]
    return Scales(index, voxel_means(points, index, finest, max(rows)), rows), points


def voxel_means(points: Tensor, index: NestedIndex, finest: int, rows: int) -> Tensor:
    """Means (S, rows, 4) of the points (N, 4) float32, in the order of the index, of each voxel of its S scales.

    The sums of a coarser voxel are those of its children at the finest scale.
    """
    scales, size = len(index.counts) - 1, _chunk_of(points.device)
    tasks = tasks_of(size, len(points))
    means = points.new_empty(scales, rows, 4)
    sums = points.new_empty(rows, 4, dtype=torch.float64)
    ends = points.new_empty(2, tasks, 4, dtype=torch.float64)
    indexed = [array(index.starts), array(index.voxel), array(index.counts), finest]
    inputs = [*indexed, size, array(ends, 4), array(sums, 4)]
    launch(_sums, tasks, [array(points, 4), *inputs], points.device)
    launch(_sums_join, tasks, inputs, points.device)
    launch(_means, (scales, rows), [*indexed, array(sums, 4), array(means, 4)], points.device)
    return means


def _chunk_of(device: torch.device) -> int:
    """The points of a task: one thread takes as many as leave their features in its cache."""
    return CHUNK if many_threads(device) else 256


def encode_voxels(
    features: Tensor, points: Tensor, weight: Tensor, scales: Scales, which: Tensor, relu: bool
) -> tuple[Tensor, Tensor]:
    """`attend` without gradients, at T scales at once: M (N, T C), side by side, and G' (T, V, C).

    which: (T,) int32, the scales
    weight: (9, C) of g and its bias; the batch norm of the features (N, C) is in them already
    """
    count, rows = features.shape[1], scales.means.shape[1]
    product = features.new_empty(len(features), len(which) * count)
    values = features.new_empty(len(which) * rows, count)
    _encode(features, points, weight, scales, which, scales.voxels.counts[:0], relu, product, values)
    return product, values.view(len(which), rows, count)


def project_voxels(
    features: Tensor,
    points: Tensor,
    weight: Tensor,
    scales: Scales,
    which: Tensor,
    first: Tensor,
    relu: bool,
    image: Tensor,
) -> None:
    """`attend` and Eq. 3 without gradients: writes G' to the cells of images (cells, C), float of any width, which lie
    one after the other.

    which: (T,) int32, their scales; first: (T,) int64, their first cells
    weight: (9, C) of g and its bias; the batch norm of the features (N, C) is in them already
    """
    _encode(features, points, weight, scales, which, first, relu, features[:0], image)


def _encode(
    features: Tensor,
    points: Tensor,
    weight: Tensor,
    scales: Scales,
    which: Tensor,
    first: Tensor,
    relu: bool,
    product: Tensor,
    values: Tensor,
) -> None:
    """Writes M to the product, if it has rows, and G' to the rows of values that the cursor gives, from the first of a
    scale on; without first rows, to those of the voxels (T, V)."""
    count, size = features.shape[1], _chunk_of(features.device)
    lanes, tasks = lanes_of(count, features.device), tasks_of(size, len(points))
    index = scales.voxels
    ends = channels(features.new_empty(2 * len(which), tasks, count), lanes)
    inputs = [
        array(index.starts),
        array(index.voxel),
        array(index.counts),
        array(index.cursor),
        array(which),
        array(first),
    ]
    inputs += [size, ends, channels(values, lanes)]
    of_points = [channels(features, lanes), array(points, 4), array(scales.means, 4), channels(weight, lanes)]
    of_points += [int(relu), channels(product, lanes)]
    kernels = _inference_kernels(lanes, wp.dtype_from_torch(values.dtype))
    threads = len(which), tasks, count // lanes
    launch(kernels.encode, threads, inputs + of_points, features.device)
    launch(kernels.join, threads, inputs, features.device)


def add_of_voxels(features: Tensor, of_voxels: Tensor, scales: Scales) -> None:
    """Adds to the features (N, C) of each point the rows (T, V, C) of the voxels of the first T scales it lies in."""
    scale, rows, count = of_voxels.shape
    lanes = lanes_of(count, features.device)
    # flat: the stride of a third dimension would leave int32 with four million rows
    inputs = [channels(of_voxels.flatten(0, 1), lanes), rows, scale, array(scales.voxels.voxel)]
    inputs += [array(scales.voxels.counts), channels(features, lanes)]
    launch(_context_kernel(lanes), (features.shape[0], count // lanes), inputs, features.device)


def clear_voxels(image: Tensor, scales: Scales, which: Tensor, first: Tensor) -> None:
    """Sets the cells that `project_voxels` has written to zero."""
    count = image.shape[1]
    lanes = lanes_of(count, image.device)
    kernel = _clear_kernel(lanes, wp.dtype_from_torch(image.dtype))
    inputs = [array(scales.voxels.cursor), array(scales.voxels.counts), array(which), array(first)]
    rows = scales.means.shape[1]
    launch(kernel, (len(which), rows, count // lanes), [*inputs, channels(image, lanes)], image.device)


def knowledge(points: Tensor, mean: Tensor, voxel: Tensor) -> Tensor:
    """Eq. 2 and a 1 for the bias: (x - mean x, f, mean p, 1) of points (N, 4) in voxels (N,), means (V, 4): (N, 9)."""
    of_point = mean[voxel]
    return torch.cat((points[:, :3] - of_point[:, :3], points[:, 3:], of_point, torch.ones_like(points[:, :1])), dim=1)


@functools.cache
def _functions(dtype: Any, lanes: int) -> SimpleNamespace:
    """What the kernels of training and of inference share, for one floating type and vector length."""
    vec = wp.types.vector(length=lanes, dtype=dtype)
    point = wp.types.vector(length=4, dtype=dtype)

    @wp.func
    def of_voxel(w4: vec, w5: vec, w6: vec, w7: vec, bias: vec, mean: point):
        """The part of the attention that all points of a voxel share."""
        return bias + mean[0] * w4 + mean[1] * w5 + mean[2] * w6 + mean[3] * w7

    @wp.func
    def of_point(w0: vec, w1: vec, w2: vec, w3: vec, p: point, mean: point):
        return (p[0] - mean[0]) * w0 + (p[1] - mean[1]) * w1 + (p[2] - mean[2]) * w2 + p[3] * w3

    @wp.func
    def attended(row: vec, attention: vec, relu: int):
        """The product of a row of features and its attention."""
        a = attention
        b = row
        if relu != 0:
            a = wp.max(a, vec())
            b = wp.max(b, vec())
        return wp.cw_mul(b, a)

    return SimpleNamespace(of_voxel=of_voxel, of_point=of_point, attended=attended)


@functools.cache
def _kernels(dtype: Any, lanes: int) -> SimpleNamespace:
    """The kernels of training for one floating type and vector length, in a module of their own."""
    vec = wp.types.vector(length=lanes, dtype=dtype)
    point = wp.types.vector(length=4, dtype=dtype)
    int_vec = wp.types.vector(length=lanes, dtype=wp.int32)
    wide = wp.types.vector(length=lanes, dtype=wp.float64)
    module = wp.Module(f"hvnet_encode_{dtype.__name__}_{lanes}", None)
    functions = _functions(dtype, lanes)
    of_voxel, of_point, attended = functions.of_voxel, functions.of_point, functions.attended
    zero = dtype(0.0)

    @wp.func
    def largest_of(
        features: wp.array2d(dtype=vec),
        points: wp.array(dtype=point),
        order: wp.array(dtype=wp.int64),
        relu: int,
        product: wp.array2d(dtype=vec),
        begin: int,
        end: int,
        is_first: bool,
        c: int,
        centre: point,
        shared: vec,
        w0: vec,
        w1: vec,
        w2: vec,
        w3: vec,
        scale: vec,
        shift: vec,
    ):
        """Writes the product of a voxel's points, or of a part that may be its first; returns maximum and arg-max."""
        best = vec()
        if not is_first:
            best = vec(-dtype(wp.inf))  # a NaN stays the maximum only where a voxel begins with it
        of_best = int_vec(-1)
        for k in range(begin, end):
            i = point_at(order, k)
            attention = shared + of_point(w0, w1, w2, w3, points[i], centre)
            row = attended(wp.cw_mul(features[i, c], scale) + shift, attention, relu)
            if product.shape[0] > 0:
                product[i, c] = row
            if is_first and k == begin:
                best = row
                of_best = int_vec(i)
            for lane in range(lanes):
                if row[lane] >= best[lane]:
                    best[lane] = row[lane]
                    of_best[lane] = i
        return best, of_best

    @wp.kernel(enable_backward=False, module=module)
    def forward(
        features: wp.array2d(dtype=vec),
        points: wp.array(dtype=point),
        mean: wp.array(dtype=point),
        weight: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        relu: int,
        product: wp.array2d(dtype=vec),
        values: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
    ):
        v, c = wp.tid()
        centre = mean[v]
        shared = of_voxel(weight[4, c], weight[5, c], weight[6, c], weight[7, c], weight[8, c], centre)
        w0, w1, w2, w3, w9, w10 = weight[0, c], weight[1, c], weight[2, c], weight[3, c], weight[9, c], weight[10, c]
        begin, end = int(starts[v]), int(starts[v + 1])
        best, of_best = largest_of(
            features, points, order, relu, product, begin, end, True, c, centre, shared, w0, w1, w2, w3, w9, w10
        )
        values[v, c] = best
        argmax[v, c] = of_best

    @wp.kernel(enable_backward=False, module=module)
    def forward_of_chunk(
        features: wp.array2d(dtype=vec),
        points: wp.array(dtype=point),
        mean: wp.array(dtype=point),
        weight: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        relu: int,
        product: wp.array2d(dtype=vec),
        values: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
        voxel: wp.array(dtype=wp.int64),
        ends: wp.array3d(dtype=vec),
        ends_argmax: wp.array3d(dtype=int_vec),
    ):
        task, c = wp.tid()
        share = share_of(task, CHUNK, points.shape[0], mean.shape[0], voxel, order)
        first, last = share[0], share[1]
        w0 = weight[0, c]
        w1 = weight[1, c]
        w2 = weight[2, c]
        w3 = weight[3, c]
        w4 = weight[4, c]
        w5 = weight[5, c]
        w6 = weight[6, c]
        w7 = weight[7, c]
        w8 = weight[8, c]
        w9 = weight[9, c]
        w10 = weight[10, c]
        for v in range(share[2], share[3]):
            begin, end = int(starts[v]), int(starts[v + 1])
            centre = mean[v]
            shared = of_voxel(w4, w5, w6, w7, w8, centre)
            best, of_best = largest_of(
                features,
                points,
                order,
                relu,
                product,
                wp.max(begin, first),
                wp.min(end, last),
                begin >= first,
                c,
                centre,
                shared,
                w0,
                w1,
                w2,
                w3,
                w9,
                w10,
            )
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
    def forward_join(
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        values: wp.array2d(dtype=vec),
        argmax: wp.array2d(dtype=int_vec),
        voxel: wp.array(dtype=wp.int64),
        ends: wp.array3d(dtype=vec),
        ends_argmax: wp.array3d(dtype=int_vec),
    ):
        task, c = wp.tid()
        v = cut_voxel(task, CHUNK, voxel.shape[0], voxel, order, starts)
        if v < 0:
            return
        best = ends[1, task, c]
        of_best = ends_argmax[1, task, c]
        k = task + 1
        while k * CHUNK < int(starts[v + 1]):
            row = ends[0, k, c]
            of_row = ends_argmax[0, k, c]
            for lane in range(lanes):
                if row[lane] >= best[lane] and of_row[lane] >= 0:
                    best[lane] = row[lane]
                    of_best[lane] = of_row[lane]
            k += 1
        values[v, c] = best
        argmax[v, c] = of_best

    @wp.kernel(enable_backward=False, module=module)
    def backward(
        grad_product: wp.array2d(dtype=vec),
        grad_values: wp.array2d(dtype=vec),
        features: wp.array2d(dtype=vec),
        points: wp.array(dtype=point),
        mean: wp.array(dtype=point),
        weight: wp.array2d(dtype=vec),
        order: wp.array(dtype=wp.int64),
        starts: wp.array(dtype=wp.int64),
        voxel: wp.array(dtype=wp.int64),
        size: int,
        argmax: wp.array2d(dtype=int_vec),
        relu: int,
        grad_features: wp.array2d(dtype=vec),
        grad_weight: wp.array3d(dtype=vec),
    ):
        """The gradient of the features, and for a block that of the layer: one loop, in a fixed order.

        A block has `size` points, or VOXELS voxels where the size is 0.
        """
        block, c = wp.tid()
        share = wp.vec4i(0, points.shape[0], block * VOXELS, wp.min((block + 1) * VOXELS, mean.shape[0]))
        if size > 0:
            share = share_of(block, size, points.shape[0], mean.shape[0], voxel, order)
        w0 = weight[0, c]
        w1 = weight[1, c]
        w2 = weight[2, c]
        w3 = weight[3, c]
        w4 = weight[4, c]
        w5 = weight[5, c]
        w6 = weight[6, c]
        w7 = weight[7, c]
        w8 = weight[8, c]
        scale = weight[9, c]
        shift = weight[10, c]
        g0, g1, g2, g3 = vec(), vec(), vec(), vec()
        g4, g5, g6, g7, g8 = vec(), vec(), vec(), vec(), vec()
        g9, g10 = vec(), vec()
        for v in range(share[2], share[3]):
            centre = mean[v]
            shared = of_voxel(w4, w5, w6, w7, w8, centre)
            given = grad_values[v, c]
            of_best = argmax[v, c]
            total = vec()
            for k in range(wp.max(int(starts[v]), share[0]), wp.min(int(starts[v + 1]), share[1])):
                i = point_at(order, k)
                p = points[i]
                attention = shared + of_point(w0, w1, w2, w3, p, centre)
                raw = features[i, c]
                row = wp.cw_mul(raw, scale) + shift
                taken = vec()
                if grad_product.shape[0] > 0:
                    taken = grad_product[i, c]
                for lane in range(lanes):
                    if of_best[lane] == i:
                        taken[lane] = taken[lane] + given[lane]
                to_row = taken
                to_attention = taken
                if relu != 0:
                    for lane in range(lanes):
                        if not (row[lane] > zero):
                            to_row[lane] = zero
                        if not (attention[lane] > zero):
                            to_attention[lane] = zero
                    row = wp.max(row, vec())
                    attention = wp.max(attention, vec())
                to_row = wp.cw_mul(to_row, attention)
                to_attention = wp.cw_mul(to_attention, row)
                grad_features[i, c] = wp.cw_mul(to_row, scale)
                g0 += (p[0] - centre[0]) * to_attention
                g1 += (p[1] - centre[1]) * to_attention
                g2 += (p[2] - centre[2]) * to_attention
                g3 += p[3] * to_attention
                total += to_attention
                g9 += wp.cw_mul(to_row, raw)
                g10 += to_row
            g4 += centre[0] * total
            g5 += centre[1] * total
            g6 += centre[2] * total
            g7 += centre[3] * total
            g8 += total
        grad_weight[block, 0, c] = g0
        grad_weight[block, 1, c] = g1
        grad_weight[block, 2, c] = g2
        grad_weight[block, 3, c] = g3
        grad_weight[block, 4, c] = g4
        grad_weight[block, 5, c] = g5
        grad_weight[block, 6, c] = g6
        grad_weight[block, 7, c] = g7
        grad_weight[block, 8, c] = g8
        grad_weight[block, 9, c] = g9
        grad_weight[block, 10, c] = g10

    @wp.kernel(enable_backward=False, module=module)
    def sums(rows: wp.array2d(dtype=vec), total: wp.array2d(dtype=wide), squares: wp.array2d(dtype=wide)):
        block, c = wp.tid()
        a = wide()
        b = wide()
        for i in range(block * ROWS, wp.min((block + 1) * ROWS, rows.shape[0])):
            row = rows[i, c]
            for lane in range(lanes):
                value = wp.float64(row[lane])
                a[lane] = a[lane] + value
                b[lane] = b[lane] + value * value
        total[block, c] = a
        squares[block, c] = b

    return SimpleNamespace(
        forward=forward,
        forward_of_chunk=forward_of_chunk,
        forward_join=forward_join,
        backward=backward,
        sums=sums,
    )


@functools.cache
def _inference_kernels(lanes: int, image_dtype: Any) -> SimpleNamespace:
    """`forward` without arg-max, for G' or a pseudo-image of one floating type."""
    vec = wp.types.vector(length=lanes, dtype=wp.float32)
    pixel = wp.types.vector(length=lanes, dtype=image_dtype)
    functions = _functions(wp.float32, lanes)
    of_voxel, of_point, attended = functions.of_voxel, functions.of_point, functions.attended
    module = wp.Module(f"hvnet_inference_{image_dtype.__name__}_{lanes}", None)

    @wp.func
    def rounded(best: vec):
        narrow = pixel()
        for lane in range(lanes):
            narrow[lane] = image_dtype(best[lane])
        return narrow

    @wp.func
    def row_of(cursor: wp.array2d(dtype=wp.int64), first: wp.array(dtype=wp.int64), rows: int, t: int, s: int, v: int):
        """The row of a voxel in what is written: its cell in an image, or its own."""
        row = t * rows + v
        if first.shape[0] > 0:
            row = int(first[t] + cursor[s, v])
        return row

    @wp.kernel(enable_backward=False, module=module)
    def encode(
        starts: wp.array2d(dtype=wp.int64),
        voxel: wp.array2d(dtype=wp.int64),
        counts: wp.array(dtype=wp.int64),
        cursor: wp.array2d(dtype=wp.int64),
        which: wp.array(dtype=int),
        first_row: wp.array(dtype=wp.int64),
        size: int,
        ends: wp.array3d(dtype=vec),
        values: wp.array2d(dtype=pixel),
        features: wp.array2d(dtype=vec),
        points: wp.array(dtype=wp.vec4),
        means: wp.array2d(dtype=wp.vec4),
        weight: wp.array2d(dtype=vec),
        relu: int,
        product: wp.array2d(dtype=vec),
    ):
        """M goes into columns of the product, if there is one; a task has `size` points, and every voxel has some."""
        t, task, c = wp.tid()
        s = which[t]
        first = task * size
        last = wp.min(first + size, int(counts[starts.shape[0]]))
        if first >= last:
            return
        column = t * weight.shape[1] + c
        w0 = weight[0, c]
        w1 = weight[1, c]
        w2 = weight[2, c]
        w3 = weight[3, c]
        w4 = weight[4, c]
        w5 = weight[5, c]
        w6 = weight[6, c]
        w7 = weight[7, c]
        w8 = weight[8, c]
        for v in range(int(voxel[s, first]), int(voxel[s, last - 1]) + 1):
            begin, end = int(starts[s, v]), int(starts[s, v + 1])
            centre = means[s, v]
            shared = of_voxel(w4, w5, w6, w7, w8, centre)
            best = vec(-wp.inf)
            for k in range(wp.max(begin, first), wp.min(end, last)):
                attention = shared + of_point(w0, w1, w2, w3, points[k], centre)
                row = attended(features[k, c], attention, relu)
                if product.shape[0] > 0:
                    product[k, column] = row
                best = wp.max(best, row)
            if begin < first:
                ends[2 * t, task, c] = best
            elif end > last:
                ends[2 * t + 1, task, c] = best
            else:
                values[row_of(cursor, first_row, values.shape[0] // which.shape[0], t, s, v), c] = rounded(best)

    @wp.kernel(enable_backward=False, module=module)
    def join(
        starts: wp.array2d(dtype=wp.int64),
        voxel: wp.array2d(dtype=wp.int64),
        counts: wp.array(dtype=wp.int64),
        cursor: wp.array2d(dtype=wp.int64),
        which: wp.array(dtype=int),
        first_row: wp.array(dtype=wp.int64),
        size: int,
        ends: wp.array3d(dtype=vec),
        values: wp.array2d(dtype=pixel),
    ):
        t, task, c = wp.tid()
        s = which[t]
        v = cut_voxel(task, size, int(counts[starts.shape[0]]), voxel[s], voxel[s, 0:0], starts[s])
        if v < 0:
            return
        best = ends[2 * t + 1, task, c]
        k = task + 1
        while k * size < int(starts[s, v + 1]):
            best = wp.max(best, ends[2 * t, k, c])
            k += 1
        values[row_of(cursor, first_row, values.shape[0] // which.shape[0], t, s, v), c] = rounded(best)

    return SimpleNamespace(encode=encode, join=join)


@wp.kernel(enable_backward=False, module="unique")
def _sums(
    points: wp.array(dtype=wp.vec4),
    starts: wp.array2d(dtype=wp.int64),
    voxel: wp.array2d(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
    finest: int,
    size: int,
    ends: wp.array2d(dtype=wp.vec4d),
    sums: wp.array(dtype=wp.vec4d),
):
    """Sums of the points of every voxel of the finest scale."""
    task = wp.tid()
    first = task * size
    last = wp.min(first + size, int(counts[starts.shape[0]]))
    if first >= last:
        return
    for v in range(int(voxel[finest, first]), int(voxel[finest, last - 1]) + 1):
        begin, end = int(starts[finest, v]), int(starts[finest, v + 1])
        total = wp.vec4d()
        for k in range(wp.max(begin, first), wp.min(end, last)):
            total += wp.vec4d(points[k])
        if begin < first:
            ends[0, task] = total
        elif end > last:
            ends[1, task] = total
        else:
            sums[v] = total


@wp.kernel(enable_backward=False, module="unique")
def _sums_join(
    starts: wp.array2d(dtype=wp.int64),
    voxel: wp.array2d(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
    finest: int,
    size: int,
    ends: wp.array2d(dtype=wp.vec4d),
    sums: wp.array(dtype=wp.vec4d),
):
    task = wp.tid()
    v = cut_voxel(task, size, int(counts[starts.shape[0]]), voxel[finest], voxel[finest, 0:0], starts[finest])
    if v < 0:
        return
    total = ends[1, task]
    k = task + 1
    while k * size < int(starts[finest, v + 1]):
        total += ends[0, k]
        k += 1
    sums[v] = total


@wp.kernel(enable_backward=False, module="unique")
def _means(
    starts: wp.array2d(dtype=wp.int64),
    voxel: wp.array2d(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
    finest: int,
    sums: wp.array(dtype=wp.vec4d),
    means: wp.array2d(dtype=wp.vec4),
):
    s, v = wp.tid()
    if wp.int64(v) >= counts[s]:
        return
    start, end = int(starts[s, v]), int(starts[s, v + 1])
    total = wp.vec4d()
    for child in range(int(voxel[finest, start]), int(voxel[finest, end - 1]) + 1):
        total += sums[child]
    # rounded to float32 before the division, as segment_mean does
    means[s, v] = wp.vec4(total) / float(end - start)


@functools.cache
def _context_kernel(lanes: int) -> wp.Kernel:
    vec = wp.types.vector(length=lanes, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module=wp.Module(f"hvnet_context_{lanes}", None))
    def context(
        of_voxels: wp.array2d(dtype=vec),
        rows: int,
        scales: int,
        voxel: wp.array2d(dtype=wp.int64),
        counts: wp.array(dtype=wp.int64),
        features: wp.array2d(dtype=vec),
    ):
        """Adds to the features of each point what the voxels that it lies in give, scale after scale."""
        i, c = wp.tid()
        if wp.int64(i) >= counts[voxel.shape[0]]:
            return
        total = features[i, c]
        for s in range(scales):
            total += of_voxels[s * rows + int(voxel[s, i]), c]
        features[i, c] = total

    return context


@functools.cache
def _clear_kernel(lanes: int, image_dtype: Any) -> wp.Kernel:
    pixel = wp.types.vector(length=lanes, dtype=image_dtype)

    @wp.kernel(enable_backward=False, module=wp.Module(f"hvnet_clear_{image_dtype.__name__}_{lanes}", None))
    def clear(
        cursor: wp.array2d(dtype=wp.int64),
        counts: wp.array(dtype=wp.int64),
        which: wp.array(dtype=int),
        first: wp.array(dtype=wp.int64),
        image: wp.array2d(dtype=pixel),
    ):
        t, v, c = wp.tid()
        s = which[t]
        if wp.int64(v) < counts[s]:
            image[int(first[t] + cursor[s, v]), c] = pixel()

    return clear


def _attend_outputs(
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
    voxel: Tensor,
    order: Tensor | None,
    starts: Tensor,
    relu: bool,
    keep: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    count = features.shape[1]
    product = features.new_empty(features.shape[0] if keep else 0, count)
    values = features.new_empty(mean.shape[0], count)
    return product, values, features.new_empty(mean.shape[0], count, dtype=torch.int32)


@torch.library.custom_op("hvnet::attend", mutates_args=())
def _attend(
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
    voxel: Tensor,
    order: Tensor | None,
    starts: Tensor,
    relu: bool,
    keep: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    count, lanes = features.shape[1], lanes_of(features.shape[1], features.device)
    outputs = _attend_outputs(features, points, mean, layer, voxel, order, starts, relu, keep)
    division = [order_array(order, starts), array(starts.contiguous())]
    results = [channels(output, lanes) for output in outputs]
    inputs = [channels(features.contiguous(), lanes), array(points.contiguous(), 4), array(mean.contiguous(), 4)]
    inputs += [channels(layer.contiguous(), lanes), *division, int(relu), *results]
    kernels = _kernels(WARP_FLOAT[features.dtype], lanes)
    if many_threads(features.device):
        tasks = tasks_of(CHUNK, len(points))
        ends = [ends_of(tasks, features), ends_of(tasks, features, torch.int32)]
        cut = [array(voxel.contiguous()), *(channels(each, lanes) for each in ends)]
        launch(kernels.forward_of_chunk, (tasks, count // lanes), [*inputs, *cut], features.device)
        launch(kernels.forward_join, (tasks, count // lanes), [*division, *results[1:], *cut], features.device)
    else:
        launch(kernels.forward, (len(mean), count // lanes), inputs, features.device)
    return outputs


_attend.register_fake(_attend_outputs)


def _attend_backward_outputs(
    grad_product: Tensor | None,
    grad_values: Tensor,
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
    voxel: Tensor,
    order: Tensor | None,
    starts: Tensor,
    argmax: Tensor,
    relu: bool,
) -> tuple[Tensor, Tensor]:
    return features.new_empty(features.shape), layer.new_empty(layer.shape)


@torch.library.custom_op("hvnet::attend_backward", mutates_args=())
def _attend_backward(
    grad_product: Tensor | None,
    grad_values: Tensor,
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
    voxel: Tensor,
    order: Tensor | None,
    starts: Tensor,
    argmax: Tensor,
    relu: bool,
) -> tuple[Tensor, Tensor]:
    count, lanes = features.shape[1], lanes_of(features.shape[1], features.device)
    size = CHUNK if many_threads(features.device) else 0
    blocks = tasks_of(size, len(points)) if size else -(-len(mean) // VOXELS)
    grad_features, grad_layer = _attend_backward_outputs(
        grad_product, grad_values, features, points, mean, layer, voxel, order, starts, argmax, relu
    )
    of_blocks = features.new_empty(blocks, LAYER, count)
    given = features.new_empty(0, count) if grad_product is None else grad_product.contiguous()
    inputs = [
        channels(given, lanes),
        channels(grad_values.contiguous(), lanes),
        channels(features.contiguous(), lanes),
        array(points.contiguous(), 4),
        array(mean.contiguous(), 4),
        channels(layer.contiguous(), lanes),
        order_array(order, starts),
        array(starts.contiguous()),
        array(voxel.contiguous()),
        size,
        channels(argmax.contiguous(), lanes),
        int(relu),
        channels(grad_features, lanes),
        array(of_blocks.view(blocks, LAYER, count // lanes, lanes), lanes),
    ]
    launch(_kernels(WARP_FLOAT[features.dtype], lanes).backward, (blocks, count // lanes), inputs, features.device)
    torch.sum(of_blocks, dim=0, out=grad_layer)
    return grad_features, grad_layer


_attend_backward.register_fake(_attend_backward_outputs)


def _save(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor, Tensor]) -> None:
    *tensors, ctx.relu, ctx.keep = inputs
    ctx.mark_non_differentiable(output[2])
    ctx.set_materialize_grads(False)
    ctx.save_for_backward(*tensors, output[2])


def _backward(ctx: Any, grad_product: Tensor | None, grad_values: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
    features, points, mean, layer, voxel, order, starts, argmax = ctx.saved_tensors
    if grad_values is None:
        grad_values = features.new_zeros(mean.shape[0], features.shape[1])
    given = grad_product if ctx.keep else None
    grad_features, grad_layer = _attend_backward(
        given, grad_values, features, points, mean, layer, voxel, order, starts, argmax, ctx.relu
    )
    return grad_features, None, None, grad_layer, None, None, None, None, None


_attend.register_autograd(_backward, setup_context=_save)


def _column_sums_outputs(rows: Tensor) -> tuple[Tensor, Tensor]:
    count = rows.shape[1]
    return rows.new_empty(count, dtype=torch.float64), rows.new_empty(count, dtype=torch.float64)


@torch.library.custom_op("hvnet::column_sums", mutates_args=())
def _column_sums(rows: Tensor) -> tuple[Tensor, Tensor]:
    count, lanes = rows.shape[1], lanes_of(rows.shape[1], rows.device)
    blocks = -(-rows.shape[0] // ROWS)
    outputs = _column_sums_outputs(rows)
    of_blocks = [rows.new_empty(blocks, count, dtype=torch.float64) for _ in outputs]
    inputs = [channels(rows.contiguous(), lanes), *(channels(sums, lanes) for sums in of_blocks)]
    launch(_kernels(WARP_FLOAT[rows.dtype], lanes).sums, (blocks, count // lanes), inputs, rows.device)
    for sums, output in zip(of_blocks, outputs, strict=True):
        torch.sum(sums, dim=0, out=output)
    return outputs


_column_sums.register_fake(_column_sums_outputs)


def _save_rows(ctx: Any, inputs: tuple, output: tuple[Tensor, Tensor]) -> None:
    ctx.save_for_backward(*inputs)


def _column_sums_backward(ctx: Any, grad_total: Tensor, grad_squares: Tensor) -> Tensor:
    (rows,) = ctx.saved_tensors
    return torch.addcmul(grad_total.to(rows.dtype), rows, 2 * grad_squares.to(rows.dtype))


_column_sums.register_autograd(_column_sums_backward, setup_context=_save_rows)


@torch.library.custom_op("hvnet::write_image", mutates_args=())
def _write_image(features: Tensor, cursor: Tensor, cells: int) -> Tensor:
    shape = (cells, features.shape[1])
    if many_threads(features.device):
        image = features.new_zeros(shape)
    else:
        # from calloc: most pages hold no voxel and are never written
        image = torch.from_numpy(np.zeros(shape, dtype=np.float32 if features.dtype == torch.float32 else np.float64))
    return image.index_copy_(0, cursor, features)


@_write_image.register_fake
def _(features: Tensor, cursor: Tensor, cells: int) -> Tensor:
    return features.new_empty(cells, features.shape[1])


def _save_cursor(ctx: Any, inputs: tuple, output: Tensor) -> None:
    ctx.save_for_backward(inputs[1])


def _write_image_backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
    (cursor,) = ctx.saved_tensors
    return grad.index_select(0, cursor), None, None


_write_image.register_autograd(_write_image_backward, setup_context=_save_cursor)
