"""Attentive voxel feature encoding in one kernel (Sec. 3.2): knowledge, its Linear, the product and the maximum.

For a point in its voxel, attention a = W g + b with g = (x - mean x, f, mean p) of Eq. 2, product M = features * a, and
G' = the maximum of M over the voxel. Neither g nor a is ever written: both are made again from the point and the mean
of its voxel wherever they are needed, and so is the rest in the backward pass. Batch norms are folded into W and b.
"""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import FLOATS, WARP_FLOAT, array, channels, check_tensor, lanes_of, launch, many_threads
from hvnet.kernels.scatter import Segments
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
    product, values, _ = _attend(features, points, mean, layer, voxels.order, voxels.starts, relu, keep)
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


class Scale(NamedTuple):
    """The voxels of one scale in arrays of fixed size, for inference."""

    voxel: Tensor  # (N,) int64, the voxel of each point
    starts: Tensor  # int64, where each voxel's points start
    cursor: Tensor  # int64, cursor of each voxel
    counts: Tensor  # (1,) int64, number of voxels, on the device
    rows: int  # as many voxels or more, known on the host


def scales_of(index: NestedIndex) -> tuple[list[Scale], Tensor, int]:
    """The scales of an index, the number of points kept on the device (1,), and a bound of it on the host.

    On a CPU the counts are at hand and bound the work; for many threads the number of points does, and nothing is read.
    """
    scales, capacity = len(index.counts) - 1, len(index.order)
    *rows, kept = [capacity] * (scales + 1) if many_threads(index.counts.device) else index.counts.tolist()
    parts = [
        Scale(index.voxel[s], index.starts[s], index.cursor[s], index.counts[s : s + 1], rows[s]) for s in range(scales)
    ]
    return parts, index.counts[scales:], kept


def voxel_means(points: Tensor, scale: Scale) -> Tensor:
    """Means (rows, 4) of the points (N, 4) float32 of each voxel."""
    mean = points.new_empty(scale.rows, 4)
    inputs = [array(points, 4), array(scale.starts), array(scale.counts), array(mean, 4)]
    launch(_means, scale.rows, inputs, points.device)
    return mean


def encode_voxels(
    features: Tensor, points: Tensor, mean: Tensor, weight: Tensor, scale: Scale, relu: bool, product: Tensor, part: int
) -> Tensor:
    """`attend` without gradients: writes M to the part-th C columns of product (N, T C), returns G' (rows, C).

    The weight (9, C) is that of g and its bias; the batch norm of the features (N, C) is in them already.
    """
    count = features.shape[1]
    lanes = lanes_of(count, features.device)
    values = features.new_empty(scale.rows, count)
    inputs = [channels(features, lanes), array(points, 4), array(mean, 4), channels(weight, lanes)]
    inputs += [array(scale.starts), array(scale.counts), int(relu), part * count // lanes]
    inputs += [channels(product, lanes), channels(values, lanes)]
    launch(_kernels(wp.float32, lanes).encode, (scale.rows, count // lanes), inputs, features.device)
    return values


def add_of_voxels(features: Tensor, of_voxels: Tensor, voxel: Tensor, kept: Tensor) -> None:
    """Adds to the features (N, C) of each point the rows of_voxels[t, voxel[t]] (T, V, C) of the voxels it lies in."""
    scales, rows, count = of_voxels.shape
    lanes = lanes_of(count, features.device)
    wide = array(of_voxels.view(scales, rows, count // lanes, lanes), lanes)
    inputs = [wide, array(voxel), array(kept), channels(features, lanes)]
    launch(_context_kernel(lanes), (features.shape[0], count // lanes), inputs, features.device)


def project_voxels(
    features: Tensor, points: Tensor, mean: Tensor, weight: Tensor, scale: Scale, relu: bool, image: Tensor
) -> None:
    """`attend` and Eq. 3 without gradients: writes G' to the cells of the image (B N_L N_W, C), float of any width.

    The weight (9, C) is that of g and its bias; the batch norm of the features (N, C) is in them already.
    """
    count = features.shape[1]
    lanes = lanes_of(count, features.device)
    inputs = [channels(features, lanes), array(points, 4), array(mean, 4), channels(weight, lanes)]
    inputs += [array(scale.starts), array(scale.counts), array(scale.cursor), int(relu), channels(image, lanes)]
    kernel = _project_kernel(lanes, wp.dtype_from_torch(image.dtype))
    launch(kernel, (scale.rows, count // lanes), inputs, features.device)


def clear_voxels(image: Tensor, scale: Scale) -> None:
    """Sets the cells of these voxels of an image (B N_L N_W, C) to zero."""
    count = image.shape[1]
    lanes = lanes_of(count, image.device)
    kernel = _clear_kernel(lanes, wp.dtype_from_torch(image.dtype))
    inputs = [array(scale.cursor), array(scale.counts), channels(image, lanes)]
    launch(kernel, (scale.rows, count // lanes), inputs, image.device)


def knowledge(points: Tensor, mean: Tensor, voxel: Tensor) -> Tensor:
    """Eq. 2 and a 1 for the bias: (x - mean x, f, mean p, 1) of points (N, 4) in voxels (N,), means (V, 4): (N, 9)."""
    of_point = mean[voxel]
    return torch.cat((points[:, :3] - of_point[:, :3], points[:, 3:], of_point, torch.ones_like(points[:, :1])), dim=1)


@functools.cache
def _kernels(dtype: Any, lanes: int) -> SimpleNamespace:
    """The kernels for one floating type and vector length, in a module of their own."""
    vec = wp.types.vector(length=lanes, dtype=dtype)
    point = wp.types.vector(length=4, dtype=dtype)
    int_vec = wp.types.vector(length=lanes, dtype=wp.int32)
    wide = wp.types.vector(length=lanes, dtype=wp.float64)
    module = wp.Module(f"hvnet_encode_{dtype.__name__}_{lanes}", None)
    zero = dtype(0.0)

    @wp.func
    def of_voxel(weight: wp.array2d(dtype=vec), c: int, mean: point):
        """The part of the attention that all points of a voxel share."""
        shared = weight[8, c] + mean[0] * weight[4, c] + mean[1] * weight[5, c]
        return shared + mean[2] * weight[6, c] + mean[3] * weight[7, c]

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

    @wp.func
    def point_at(order: wp.array(dtype=wp.int64), k: int):
        i = k
        if order.shape[0] > 0:
            i = int(order[k])
        return i

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
        voxel, c = wp.tid()
        centre = mean[voxel]
        shared = of_voxel(weight, c, centre)
        w0, w1, w2, w3 = weight[0, c], weight[1, c], weight[2, c], weight[3, c]
        scale, shift = weight[9, c], weight[10, c]
        best = vec()
        at = int_vec(-1)
        start = int(starts[voxel])
        for k in range(start, int(starts[voxel + 1])):
            i = point_at(order, k)
            attention = shared + of_point(w0, w1, w2, w3, points[i], centre)
            row = attended(wp.cw_mul(features[i, c], scale) + shift, attention, relu)
            if product.shape[0] > 0:
                product[i, c] = row
            if k == start:
                best = row
                at = int_vec(i)
            for lane in range(lanes):
                if row[lane] >= best[lane]:
                    best[lane] = row[lane]
                    at[lane] = i
        values[voxel, c] = best
        argmax[voxel, c] = at

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
        argmax: wp.array2d(dtype=int_vec),
        relu: int,
        grad_features: wp.array2d(dtype=vec),
        grad_weight: wp.array3d(dtype=vec),
    ):
        """The gradient of the features, and for a block of voxels that of the layer: one loop, in a fixed order."""
        block, c = wp.tid()
        w0, w1, w2, w3 = weight[0, c], weight[1, c], weight[2, c], weight[3, c]
        scale, shift = weight[9, c], weight[10, c]
        g0, g1, g2, g3 = vec(), vec(), vec(), vec()
        g4, g5, g6, g7, g8 = vec(), vec(), vec(), vec(), vec()
        g9, g10 = vec(), vec()
        for voxel in range(block * VOXELS, wp.min((block + 1) * VOXELS, mean.shape[0])):
            centre = mean[voxel]
            shared = of_voxel(weight, c, centre)
            given = grad_values[voxel, c]
            at = argmax[voxel, c]
            total = vec()
            for k in range(int(starts[voxel]), int(starts[voxel + 1])):
                i = point_at(order, k)
                p = points[i]
                attention = shared + of_point(w0, w1, w2, w3, p, centre)
                raw = features[i, c]
                row = wp.cw_mul(raw, scale) + shift
                taken = vec()
                if grad_product.shape[0] > 0:
                    taken = grad_product[i, c]
                for lane in range(lanes):
                    if at[lane] == i:
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
    def encode(
        features: wp.array2d(dtype=vec),
        points: wp.array(dtype=point),
        mean: wp.array(dtype=point),
        weight: wp.array2d(dtype=vec),
        starts: wp.array(dtype=wp.int64),
        counts: wp.array(dtype=wp.int64),
        relu: int,
        column: int,
        product: wp.array2d(dtype=vec),
        values: wp.array2d(dtype=vec),
    ):
        """`forward` for inference: M goes into columns of H, no arg-max; voxels beyond the count are left out."""
        voxel, c = wp.tid()
        if wp.int64(voxel) >= counts[0]:
            return
        centre = mean[voxel]
        shared = of_voxel(weight, c, centre)
        w0, w1, w2, w3 = weight[0, c], weight[1, c], weight[2, c], weight[3, c]
        start = int(starts[voxel])
        best = vec()
        for i in range(start, int(starts[voxel + 1])):
            attention = shared + of_point(w0, w1, w2, w3, points[i], centre)
            row = attended(features[i, c], attention, relu)
            product[i, column + c] = row
            if i == start:
                best = row
            best = wp.max(best, row)
        values[voxel, c] = best

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
        backward=backward,
        encode=encode,
        sums=sums,
        of_voxel=of_voxel,
        of_point=of_point,
        attended=attended,
    )


@functools.cache
def _project_kernel(lanes: int, image_dtype: Any) -> wp.Kernel:
    """The kernel from features to a pseudo-image of one floating type."""
    vec = wp.types.vector(length=lanes, dtype=wp.float32)
    pixel = wp.types.vector(length=lanes, dtype=image_dtype)
    kernels = _kernels(wp.float32, lanes)
    of_voxel, of_point, attended = kernels.of_voxel, kernels.of_point, kernels.attended

    @wp.kernel(enable_backward=False, module=wp.Module(f"hvnet_project_{image_dtype.__name__}_{lanes}", None))
    def project(
        features: wp.array2d(dtype=vec),
        points: wp.array(dtype=wp.vec4),
        mean: wp.array(dtype=wp.vec4),
        weight: wp.array2d(dtype=vec),
        starts: wp.array(dtype=wp.int64),
        counts: wp.array(dtype=wp.int64),
        cursor: wp.array(dtype=wp.int64),
        relu: int,
        image: wp.array2d(dtype=pixel),
    ):
        voxel, c = wp.tid()
        if wp.int64(voxel) >= counts[0]:
            return
        centre = mean[voxel]
        shared = of_voxel(weight, c, centre)
        w0, w1, w2, w3 = weight[0, c], weight[1, c], weight[2, c], weight[3, c]
        start = int(starts[voxel])
        best = vec()
        for i in range(start, int(starts[voxel + 1])):
            attention = shared + of_point(w0, w1, w2, w3, points[i], centre)
            row = attended(features[i, c], attention, relu)
            if i == start:
                best = row
            best = wp.max(best, row)
        rounded = pixel()
        for lane in range(lanes):
            rounded[lane] = image_dtype(best[lane])
        image[int(cursor[voxel]), c] = rounded

    return project


@wp.kernel(enable_backward=False, module="unique")
def _means(
    points: wp.array(dtype=wp.vec4),
    starts: wp.array(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
    mean: wp.array(dtype=wp.vec4),
):
    voxel = wp.tid()
    if wp.int64(voxel) >= counts[0]:
        return
    start, end = int(starts[voxel]), int(starts[voxel + 1])
    total = wp.vec4d()
    for i in range(start, end):
        total += wp.vec4d(points[i])
    # rounded to float32 before the division, as segment_mean does
    mean[voxel] = wp.vec4(total) / float(end - start)


@functools.cache
def _context_kernel(lanes: int) -> wp.Kernel:
    vec = wp.types.vector(length=lanes, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module=wp.Module(f"hvnet_context_{lanes}", None))
    def context(
        of_voxels: wp.array3d(dtype=vec),
        voxel: wp.array2d(dtype=wp.int64),
        kept: wp.array(dtype=wp.int64),
        features: wp.array2d(dtype=vec),
    ):
        """Adds to the features of each point what the voxels that it lies in give, scale after scale."""
        i, c = wp.tid()
        if wp.int64(i) >= kept[0]:
            return
        total = features[i, c]
        for s in range(of_voxels.shape[0]):
            total += of_voxels[s, int(voxel[s, i]), c]
        features[i, c] = total

    return context


@functools.cache
def _clear_kernel(lanes: int, image_dtype: Any) -> wp.Kernel:
    pixel = wp.types.vector(length=lanes, dtype=image_dtype)

    @wp.kernel(enable_backward=False, module=wp.Module(f"hvnet_clear_{image_dtype.__name__}_{lanes}", None))
    def clear(cursor: wp.array(dtype=wp.int64), counts: wp.array(dtype=wp.int64), image: wp.array2d(dtype=pixel)):
        voxel, c = wp.tid()
        if wp.int64(voxel) < counts[0]:
            image[int(cursor[voxel]), c] = pixel()

    return clear


def _attend_outputs(
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
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
    order: Tensor | None,
    starts: Tensor,
    relu: bool,
    keep: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    count, lanes = features.shape[1], lanes_of(features.shape[1], features.device)
    outputs = _attend_outputs(features, points, mean, layer, order, starts, relu, keep)
    inputs = [
        channels(features.contiguous(), lanes),
        array(points.contiguous(), 4),
        array(mean.contiguous(), 4),
        channels(layer.contiguous(), lanes),
        array(starts.new_empty(0) if order is None else order.contiguous()),
        array(starts.contiguous()),
        int(relu),
        *(channels(output, lanes) for output in outputs),
    ]
    kernel = _kernels(WARP_FLOAT[features.dtype], lanes).forward
    launch(kernel, (mean.shape[0], count // lanes), inputs, features.device)
    return outputs


_attend.register_fake(_attend_outputs)


def _attend_backward_outputs(
    grad_product: Tensor | None,
    grad_values: Tensor,
    features: Tensor,
    points: Tensor,
    mean: Tensor,
    layer: Tensor,
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
    order: Tensor | None,
    starts: Tensor,
    argmax: Tensor,
    relu: bool,
) -> tuple[Tensor, Tensor]:
    count, lanes = features.shape[1], lanes_of(features.shape[1], features.device)
    blocks = -(-mean.shape[0] // VOXELS)
    grad_features, grad_layer = _attend_backward_outputs(
        grad_product, grad_values, features, points, mean, layer, order, starts, argmax, relu
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
        array(starts.new_empty(0) if order is None else order.contiguous()),
        array(starts.contiguous()),
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
    features, points, mean, layer, order, starts, argmax = ctx.saved_tensors
    if grad_values is None:
        grad_values = features.new_zeros(mean.shape[0], features.shape[1])
    given = grad_product if ctx.keep else None
    grad_features, grad_layer = _attend_backward(
        given, grad_values, features, points, mean, layer, order, starts, argmax, ctx.relu
    )
    return grad_features, None, None, grad_layer, None, None, None, None


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
