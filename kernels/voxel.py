"""Voxels of every scale: cursors (Eq. 1), one sort for all nested scales, a hash table for the others."""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import array, check_bounds, check_index, check_tensor, launch, many_threads
from hvnet.kernels.scatter import Segments, segments

KEY_BITS = 31  # of a sort key: it shares an int64 with the number of its point
DIGIT_BITS = wp.constant(11)  # of a pass of the radix sort
DIGITS = wp.constant(1 << 11)
KEYS = wp.constant(1 << KEY_BITS)
OUTSIDE = wp.constant(1 << 62)  # the key of a point outside, after all others


class Grid(NamedTuple):
    """The voxel grid of one scale; a voxel is as high as the range."""

    x_min: float
    y_min: float
    z_min: float
    z_max: float
    cell: tuple[float, float]  # v_L s, v_W s, metres
    cells: tuple[int, int]  # N_L, N_W that cover the range
    shape: tuple[int, int]  # N_L, N_W in memory: cells, padded


class Voxels(NamedTuple):
    """The voxels of one scale that hold points, as segments of the kept points."""

    cursor: Tensor  # (V,) int64, Eq. 1 plus sample * N_L * N_W
    segments: Segments


class VoxelIndex(NamedTuple):
    """The points that lie inside every grid, in a new order, and their voxels at every scale."""

    order: Tensor  # (K,) int64, indices into the points given
    scales: list[Voxels]


class NestedIndex(NamedTuple):
    """The voxels of S nested scales in arrays of fixed size, so that no length has to be read from the device.

    Of N points the first `kept` in the new order are inside every grid; scale s has `counts[s]` voxels. The rest is
    not set.
    """

    order: Tensor  # (N,) int64, indices into the points given
    voxel: Tensor  # (S, N) int64, the voxel of each point in the new order
    starts: Tensor  # (S, N + 1) int64
    cursor: Tensor  # (S, N) int64
    counts: Tensor  # (S + 1,) int64: voxels of every scale, then the points kept


def make_grid(point_range: Sequence[float], voxel_size: Sequence[float], scale: float, multiple: int = 1) -> Grid:
    """The grid of voxels of voxel_size (v_L, v_W) times scale over (x_min, y_min, z_min, x_max, y_max, z_max).

    The last cell may reach past the range (0.3 m does not divide 64 m); the shape in memory is padded to `multiple`.
    """
    x_min, y_min, z_min, x_max, y_max, z_max = point_range
    if not (x_max > x_min and y_max > y_min and z_max > z_min):
        raise ValueError(f"point_range: want every maximum above its minimum, got {tuple(point_range)}")
    if not (min(voxel_size) > 0 and scale > 0):
        raise ValueError(f"voxel_size and scale: want values above 0, got {tuple(voxel_size)} and {scale}")
    cell = (voxel_size[0] * scale, voxel_size[1] * scale)
    # 64 / 0.1 is 640.0000000000001 or 639.9999999999999 as the case may be: a millionth of a cell is no cell
    extent = (x_max - x_min, y_max - y_min)
    cells = (max(1, math.ceil(extent[0] / cell[0] - 1e-6)), max(1, math.ceil(extent[1] / cell[1] - 1e-6)))
    shape = (-(-cells[0] // multiple) * multiple, -(-cells[1] // multiple) * multiple)
    return Grid(x_min, y_min, z_min, z_max, cell, cells, shape)


def cursors(points: Tensor, sample: Tensor, grid: Grid) -> Tensor:
    """Eq. 1: the cursor (N,) int64 of points (N, 4) float32 that belong to samples (N,) int64; -1 outside the grid.

    The cursor is x * N_W + y, plus sample * N_L * N_W. A point is inside iff its integer index is inside the grid's
    cells and z in [z_min, z_max); a point that is not finite is outside.
    """
    _check_points(points, sample)
    return _cursors(points.detach(), sample, _numbers([grid]))


def _cursors_outputs(points: Tensor, sample: Tensor, flat: Sequence[float]) -> Tensor:
    return sample.new_empty(points.shape[0])


@torch.library.custom_op("hvnet::cursors", mutates_args=())
def _cursors(points: Tensor, sample: Tensor, flat: Sequence[float]) -> Tensor:
    (grid,) = _grids(flat)
    cursor = _cursors_outputs(points, sample, flat)
    inputs = [
        array(points.contiguous(), 4),
        array(sample.contiguous()),
        wp.vec2(grid.x_min, grid.y_min),
        wp.vec2(grid.z_min, grid.z_max),
        wp.vec2(1.0 / grid.cell[0], 1.0 / grid.cell[1]),
        wp.vec2i(*grid.cells),
        wp.int64(grid.shape[0]),
        wp.int64(grid.shape[1]),
        array(cursor),
    ]
    launch(_cursor_kernel, len(points), inputs, points.device)
    return cursor


_cursors.register_fake(_cursors_outputs)


def voxel_index(points: Tensor, sample: Tensor, batch_size: int, grids: Sequence[Grid]) -> VoxelIndex:
    """The voxels of points (N, 4) float32 of samples (N,) int64 in [0, batch_size) at every scale.

    A point is kept iff it is inside every grid. Where each cell is a power of two times the finest, one sort by the
    Morton key of the finest grid makes every voxel of every scale a run of consecutive points; other scales, and grids
    too large for a key (more than 2^31 cells, were they a square, in all samples), go through the hash table.
    """
    _check_points(points, sample)
    if not grids:
        raise ValueError("grids: want at least one grid, got none")
    order, *parts = _voxel_index(points, sample, batch_size, _numbers(grids))
    width = len(parts) // len(grids)  # 3, or 4 with an order of its own
    scales = [parts[k : k + width] for k in range(0, len(parts), width)]
    return VoxelIndex(order, [Voxels(s[0], Segments(s[1], s[2], s[3] if width == 4 else None)) for s in scales])


@torch.library.custom_op("hvnet::voxel_index", mutates_args=())
def _voxel_index(points: Tensor, sample: Tensor, batch_size: int, flat: Sequence[float]) -> list[Tensor]:
    """Order, then cursor, voxel and starts of every scale, and its order where the scales do not nest."""
    grids = _grids(flat)
    for grid in grids:
        if batch_size * grid.shape[0] * grid.shape[1] >= 2**63:
            raise ValueError(f"grids: {batch_size} samples of {grid.shape} cells have cursors beyond int64")
    if is_nested(grids, batch_size):
        nested = nested_index(points, sample, grids)
        bounds = torch.stack(torch.aminmax(sample)) if len(sample) else sample.new_zeros(2)
        low, high, *counts, kept = torch.cat((bounds, nested.counts)).tolist()  # the one wait for the device
        if len(sample):
            check_bounds("sample", low, high, batch_size)
        parts = [nested.order[:kept].clone()]
        for s, v in enumerate(counts):
            parts += [nested.cursor[s, :v].clone(), nested.voxel[s, :kept].clone(), nested.starts[s, : v + 1].clone()]
        return parts
    check_index("sample", sample, batch_size)
    by_scale = [cursors(points, sample, grid) for grid in grids]
    inside = by_scale[0].ge(0)
    for cursor in by_scale[1:]:
        inside &= cursor.ge(0)
    order = inside.nonzero().squeeze(1)
    return [order, *(part for cursor in by_scale for part in _hashed_voxels(cursor[order]))]


@_voxel_index.register_fake
def _(points: Tensor, sample: Tensor, batch_size: int, flat: Sequence[float]) -> list[Tensor]:
    sizes = torch.library.get_ctx()
    kept = sizes.new_dynamic_size(min=2)  # what is compiled is for clouds, not for none or a single point
    parts = [sample.new_empty(kept)]
    grids = _grids(flat)
    for _ in grids:
        voxels = sizes.new_dynamic_size(min=1)
        parts += [sample.new_empty(voxels), sample.new_empty(kept), sample.new_empty(voxels + 1)]
        if not is_nested(grids, batch_size):
            parts.append(sample.new_empty(kept))
    return parts


def _numbers(grids: Sequence[Grid]) -> list[float]:
    """Ten numbers a grid, all in a row: an op takes no tuple."""
    return [float(value) for grid in grids for value in (*grid[:4], *grid.cell, *grid.cells, *grid.shape)]


def _grids(flat: Sequence[float]) -> list[Grid]:
    """The grids of `_numbers`."""
    rows = [flat[k : k + 10] for k in range(0, len(flat), 10)]
    return [Grid(r[0], r[1], r[2], r[3], (r[4], r[5]), (int(r[6]), int(r[7])), (int(r[8]), int(r[9]))) for r in rows]


def is_nested(grids: Sequence[Grid], batch_size: int) -> bool:
    """Whether one sort serves all grids: each cell a power of two times the finest, to the bit, and keys that fit."""
    finest = min(grids, key=lambda grid: grid.cell)
    fits = 2 * _bits(finest) + (batch_size - 1).bit_length() <= KEY_BITS
    return fits and all(_level(grid, finest) is not None for grid in grids)


def nested_index(points: Tensor, sample: Tensor, grids: Sequence[Grid]) -> NestedIndex:
    """The voxels of points (N, 4) float32 of samples (N,) int64 in grids that nest; nothing is read from the device."""
    device = points.device
    of_grid, of_scales, bits = _nesting(tuple(grids), device)
    inputs = [array(points.contiguous(), 4), array(sample.contiguous()), *of_grid]
    if not many_threads(device):
        return _serial_index(inputs, len(points), of_scales)
    keys = torch.empty(len(points), dtype=torch.int32, device=device)
    launch(_key_kernel, len(points), [*inputs, array(keys)], device)
    return _parallel_index(keys, of_scales, bits)


@functools.cache
def _nesting(grids: tuple[Grid, ...], device: torch.device) -> tuple[list[object], Tensor, int]:
    """The kernels' inputs for grids that nest: the finest grid, then of every scale (S, 3) the bits of a Morton key to
    drop, N_L and N_W, and the bits of a key. Cached so that no frame triggers a
    host-to-device copy."""
    finest = min(grids, key=lambda grid: grid.cell)
    levels = [_level(grid, finest) or 0 for grid in grids]
    # inside every grid: the finest index, cut to a coarser grid's cells, is compared with each
    cells = wp.vec2i(*(min(g.cells[axis] << level for g, level in zip(grids, levels, strict=True)) for axis in (0, 1)))
    height = wp.vec2(max(grid.z_min for grid in grids), min(grid.z_max for grid in grids))
    low, reciprocal = wp.vec2(finest.x_min, finest.y_min), wp.vec2(1.0 / finest.cell[0], 1.0 / finest.cell[1])
    bits = 2 * _bits(finest)
    rows = [(2 * level, *grid.shape) for grid, level in zip(grids, levels, strict=True)]
    return [low, height, reciprocal, cells, wp.int64(bits)], torch.tensor(rows, device=device), bits


def _parallel_index(keys: Tensor, of_scales: Tensor, bits: int) -> NestedIndex:
    """The index of points with these keys (N,), for many threads: a sort, a sum over the first points, a write."""
    count, scales = len(keys), len(of_scales)
    keys, order = torch.sort(keys, stable=True)
    first = torch.empty(scales, count, dtype=torch.int32, device=keys.device)
    launch(_first_kernel, first.shape, [array(keys), array(of_scales), array(first)], keys.device)
    # one sum over all scales: torch gives a row of a sum along rows to one block of threads alone
    numbers = first.view(-1).cumsum(0, dtype=torch.int32).view_as(first)
    voxel, cursor = (torch.empty(scales, count, dtype=torch.int64, device=keys.device) for _ in range(2))
    zeros = torch.zeros(scales * (count + 1) + scales + 1, dtype=torch.int64, device=keys.device)  # in one launch
    starts, counts = zeros[: -scales - 1].view(scales, count + 1), zeros[-scales - 1 :]
    inputs = [array(keys), array(of_scales), array(numbers), wp.int64(bits)]
    inputs += [array(tensor) for tensor in (voxel, starts, cursor, counts)]
    launch(_fill_kernel, first.shape, inputs, keys.device)
    return NestedIndex(order, voxel, starts, cursor, counts)


def _serial_index(inputs: list[object], count: int, of_scales: Tensor) -> NestedIndex:
    """The same for one thread: a radix sort of the points inside, then one walk over them for all scales."""
    scales = len(of_scales)
    order, work = torch.empty(count, dtype=torch.int64), torch.empty(2, count, dtype=torch.int64)
    voxel, cursor = (torch.empty(scales, count, dtype=torch.int64) for _ in range(2))
    starts, counts = torch.empty(scales, count + 1, dtype=torch.int64), torch.zeros(scales + 1, dtype=torch.int64)
    digits = torch.zeros(DIGITS, dtype=torch.int64)
    outputs = [array(tensor) for tensor in (of_scales, work, digits, order, voxel, starts, cursor, counts)]
    launch(_serial_kernel, 1, [*inputs, *outputs], order.device)
    return NestedIndex(order, voxel, starts, cursor, counts)


def _bits(grid: Grid) -> int:
    return max(max(grid.cells) - 1, 1).bit_length()


def _level(grid: Grid, finest: Grid) -> int | None:
    """log2 of the grid's cell over the finest cell, if it is whole and the grids start at the same place."""
    mantissa, exponent = math.frexp(grid.cell[0] / finest.cell[0])
    same_ratio = grid.cell[1] / finest.cell[1] == grid.cell[0] / finest.cell[0]
    same_origin = (grid.x_min, grid.y_min) == (finest.x_min, finest.y_min)
    return exponent - 1 if mantissa == 0.5 and same_ratio and same_origin else None


def hash_index(cursor: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct cursors in ascending order (V,), and the place of each of the cursors (N,) >= 0 among them (N,).

    Open addressing; the table's layout depends on the order of insertion, and sorting the voxels removes that.
    """
    check_tensor("cursor", cursor, (torch.int64,), (None,))
    return _hash_index(cursor)


@torch.library.custom_op("hvnet::hash_index", mutates_args=())
def _hash_index(cursor: Tensor) -> tuple[Tensor, Tensor]:
    check_index("cursor", cursor, 2**63)
    capacity = 1 << max(2 * len(cursor) - 1, 1).bit_length()
    table = torch.full((capacity,), -1, dtype=torch.int64, device=cursor.device)
    slot = torch.empty_like(cursor)
    launch(_insert_kernel, len(cursor), [array(cursor.contiguous()), array(table), array(slot)], cursor.device)
    occupied = table.ge(0).nonzero().squeeze(1)
    unique, by_cursor = torch.sort(table[occupied])
    table[occupied[by_cursor]] = torch.arange(len(unique), device=cursor.device)  # from here on: slot -> voxel
    return unique, table[slot]


@_hash_index.register_fake
def _(cursor: Tensor) -> tuple[Tensor, Tensor]:
    return cursor.new_empty(torch.library.get_ctx().new_dynamic_size()), cursor.new_empty(cursor.shape[0])


def _hashed_voxels(cursor: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cursors (V,) in ascending order, and the segments of the points (voxel, starts, order)."""
    unique, index = hash_index(cursor)
    voxels = segments(index, len(unique))
    assert voxels.order is not None
    return unique, voxels.voxel, voxels.starts, voxels.order


def _check_points(points: Tensor, sample: Tensor) -> None:
    check_tensor("points", points, (torch.float32,), (None, 4))
    check_tensor("sample", sample, (torch.int64,), (points.shape[0],), like=points)


@wp.func
def _is_inside(point: wp.vec4, x: float, y: float, height: wp.vec2, cells: wp.vec2i):
    """Whether (x, y) in cells is in the grid, z in range and the reflectance finite; NaN fails every comparison."""
    inside = x >= 0.0 and x < float(cells[0]) and y >= 0.0 and y < float(cells[1])
    return inside and point[2] >= height[0] and point[2] < height[1] and wp.abs(point[3]) < wp.inf


@wp.kernel(enable_backward=False, module="unique")
def _cursor_kernel(
    points: wp.array(dtype=wp.vec4),
    sample: wp.array(dtype=wp.int64),
    low: wp.vec2,
    height: wp.vec2,
    reciprocal: wp.vec2,
    cells: wp.vec2i,
    n_l: wp.int64,
    n_w: wp.int64,
    cursor: wp.array(dtype=wp.int64),
):
    i = wp.tid()
    x = (points[i][0] - low[0]) * reciprocal[0]
    y = (points[i][1] - low[1]) * reciprocal[1]
    value = wp.int64(-1)
    if _is_inside(points[i], x, y, height, cells):
        value = (sample[i] * n_l + wp.int64(x)) * n_w + wp.int64(y)
    cursor[i] = value


@wp.func
def _interleave(x: wp.int64, y: wp.int64):
    """The Morton code of two values of 16 bits: both are spread together, each in its half of the word."""
    v = (x << wp.int64(32)) | y
    v = (v | (v << wp.int64(8))) & wp.int64(0x00FF00FF00FF00FF)
    v = (v | (v << wp.int64(4))) & wp.int64(0x0F0F0F0F0F0F0F0F)
    v = (v | (v << wp.int64(2))) & wp.int64(0x3333333333333333)
    v = (v | (v << wp.int64(1))) & wp.int64(0x5555555555555555)
    return (v | (v >> wp.int64(31))) & wp.int64(0xFFFFFFFF)


@wp.func
def _cursor_of_key(key: wp.int64, bits: wp.int64, n_l: wp.int64, n_w: wp.int64):
    """Eq. 1 for a key of `bits` bits below its sample: the inverse of _interleave."""
    code = key & ((wp.int64(1) << bits) - wp.int64(1))
    v = (code | (code << wp.int64(31))) & wp.int64(0x5555555555555555)
    v = (v | (v >> wp.int64(1))) & wp.int64(0x3333333333333333)
    v = (v | (v >> wp.int64(2))) & wp.int64(0x0F0F0F0F0F0F0F0F)
    v = (v | (v >> wp.int64(4))) & wp.int64(0x00FF00FF00FF00FF)
    v = (v | (v >> wp.int64(8))) & wp.int64(0x0000FFFF0000FFFF)
    return ((key >> bits) * n_l + (v >> wp.int64(32))) * n_w + (v & wp.int64(0xFFFF))


@wp.func
def _key(
    points: wp.array(dtype=wp.vec4),
    sample: wp.array(dtype=wp.int64),
    i: int,
    low: wp.vec2,
    height: wp.vec2,
    reciprocal: wp.vec2,
    cells: wp.vec2i,
    bits: wp.int64,
):
    """The Morton key of a point, below its sample; OUTSIDE for a point that is not inside."""
    x = (points[i][0] - low[0]) * reciprocal[0]
    y = (points[i][1] - low[1]) * reciprocal[1]
    key = wp.int64(OUTSIDE)
    if _is_inside(points[i], x, y, height, cells):
        key = (sample[i] << bits) | _interleave(wp.int64(x), wp.int64(y))
    return key


@wp.kernel(enable_backward=False, module="unique")
def _key_kernel(
    points: wp.array(dtype=wp.vec4),
    sample: wp.array(dtype=wp.int64),
    low: wp.vec2,
    height: wp.vec2,
    reciprocal: wp.vec2,
    cells: wp.vec2i,
    bits: wp.int64,
    keys: wp.array(dtype=int),
):
    """Keys of 31 bits as negative numbers, and 0 for a point outside: half as many bits to sort as in int64."""
    i = wp.tid()
    key = _key(points, sample, i, low, height, reciprocal, cells, bits)
    keys[i] = int(wp.min(key - wp.int64(KEYS), wp.int64(0)))


@wp.kernel(enable_backward=False, module="unique")
def _first_kernel(keys: wp.array(dtype=int), scales: wp.array2d(dtype=wp.int64), first: wp.array2d(dtype=int)):
    """1 for the first point of every voxel among the sorted keys."""
    s, i = wp.tid()
    is_first = int(0)
    if keys[i] < 0 and (i == 0 or (keys[i] ^ keys[i - 1]) >> int(scales[s, 0]) != 0):
        is_first = 1
    first[s, i] = is_first


@wp.kernel(enable_backward=False, module="unique")
def _fill_kernel(
    keys: wp.array(dtype=int),
    scales: wp.array2d(dtype=wp.int64),
    numbers: wp.array2d(dtype=int),
    bits: wp.int64,
    voxel: wp.array2d(dtype=wp.int64),
    starts: wp.array2d(dtype=wp.int64),
    cursor: wp.array2d(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
):
    """The voxels of the sorted points, which are numbered on from scale to scale and from 1."""
    s, i = wp.tid()
    if keys[i] >= 0:
        return
    before = int(0)
    if s > 0:
        before = numbers[s - 1, keys.shape[0] - 1]
    v = numbers[s, i] - before - 1
    voxel[s, i] = wp.int64(v)
    if i == 0 or numbers[s, i] != numbers[s, i - 1]:
        drop = scales[s, 0]
        key = wp.int64(keys[i]) + wp.int64(KEYS)
        starts[s, v] = wp.int64(i)
        cursor[s, v] = _cursor_of_key(key >> drop, bits - drop, scales[s, 1], scales[s, 2])
    if i + 1 == keys.shape[0] or keys[i + 1] >= 0:
        starts[s, v + 1] = wp.int64(i + 1)
        counts[s] = wp.int64(v + 1)
        if s == 0:
            counts[scales.shape[0]] = wp.int64(i + 1)


@wp.kernel(enable_backward=False, module="unique")
def _serial_kernel(
    points: wp.array(dtype=wp.vec4),
    sample: wp.array(dtype=wp.int64),
    low: wp.vec2,
    height: wp.vec2,
    reciprocal: wp.vec2,
    cells: wp.vec2i,
    bits: wp.int64,
    scales: wp.array2d(dtype=wp.int64),
    work: wp.array2d(dtype=wp.int64),
    digits: wp.array(dtype=wp.int64),
    order: wp.array(dtype=wp.int64),
    voxel: wp.array2d(dtype=wp.int64),
    starts: wp.array2d(dtype=wp.int64),
    cursor: wp.array2d(dtype=wp.int64),
    counts: wp.array(dtype=wp.int64),
):
    # a word is a key and below it, in 32 bits, the number of its point; a pass goes from one row of the work to the
    # other (`while`, because it compiles to a plainer loop than `range`)
    kept = int(0)
    largest = wp.int64(0)
    i = int(0)
    while i < points.shape[0]:
        key = _key(points, sample, i, low, height, reciprocal, cells, bits)
        if key != wp.int64(OUTSIDE):
            work[0, kept] = (key << wp.int64(32)) | wp.int64(i)
            kept += 1
            largest = wp.max(largest, key)
            d = int(key & wp.int64(DIGITS - 1))
            digits[d] = digits[d] + wp.int64(1)
        i += 1
    side = int(0)
    shift = wp.int64(0)
    while (largest >> shift) != wp.int64(0):
        total = wp.int64(0)
        for d in range(DIGITS):
            own = digits[d]
            digits[d] = total
            total += own
        i = int(0)
        while i < kept:
            word = work[side, i]
            d = int((word >> (shift + wp.int64(32))) & wp.int64(DIGITS - 1))
            position = int(digits[d])
            digits[d] = wp.int64(position + 1)
            work[1 - side, position] = word
            i += 1
        side = 1 - side
        shift += wp.int64(DIGIT_BITS)
        if (largest >> shift) != wp.int64(0):
            for d in range(DIGITS):
                digits[d] = wp.int64(0)
            i = int(0)
            while i < kept:
                d = int((work[side, i] >> (shift + wp.int64(32))) & wp.int64(DIGITS - 1))
                digits[d] = digits[d] + wp.int64(1)
                i += 1
    i = int(0)
    while i < kept:
        order[i] = work[side, i] & wp.int64(0xFFFFFFFF)
        i += 1
    counts[scales.shape[0]] = wp.int64(kept)
    for s in range(scales.shape[0]):
        # whether or not a voxel begins, its key and its end are written: a branch that chance decides costs more
        drop = scales[s, 0]
        v = int(-1)
        before = wp.int64(-1)
        starts[s, 0] = wp.int64(0)
        i = int(0)
        while i < kept:
            key = work[side, i] >> (drop + wp.int64(32))
            v += wp.where(key == before, 0, 1)
            before = key
            voxel[s, i] = wp.int64(v)
            cursor[s, v] = key
            i += 1
            starts[s, v + 1] = wp.int64(i)
        counts[s] = wp.int64(v + 1)
        u = int(0)
        while u <= v:
            cursor[s, u] = _cursor_of_key(cursor[s, u], bits - drop, scales[s, 1], scales[s, 2])
            u += 1


@wp.kernel(enable_backward=False, module="unique")
def _insert_kernel(cursor: wp.array(dtype=wp.int64), table: wp.array(dtype=wp.int64), slot: wp.array(dtype=wp.int64)):
    i = wp.tid()
    key = cursor[i]
    mask = wp.uint64(table.shape[0] - 1)
    # Fibonacci hashing: the high half of the product depends on all bits of the key
    place = ((wp.uint64(key) * wp.uint64(11400714819323198485)) >> wp.uint64(32)) & mask
    free = wp.int64(-1)
    found = wp.atomic_cas(table, int(place), free, key)
    while found != free and found != key:
        place = (place + wp.uint64(1)) & mask
        found = wp.atomic_cas(table, int(place), free, key)
    slot[i] = wp.int64(place)
