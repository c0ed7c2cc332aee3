"""Voxels of every scale: cursors (Eq. 1), one sort for all nested scales, a hash table for the others."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import array, check_index, check_tensor, launch
from hvnet.kernels.scatter import Segments

KEY_BITS = 62  # of a sort key in int64


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
    cursor = torch.empty(len(points), dtype=torch.int64, device=points.device)
    inputs = [
        array(points.contiguous()),
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


def voxel_index(points: Tensor, sample: Tensor, batch_size: int, grids: Sequence[Grid]) -> VoxelIndex:
    """The voxels of points (N, 4) float32 of samples (N,) int64 in [0, batch_size) at every scale.

    A point is kept iff it is inside every grid. Where each cell is a power of two times the finest, one sort by the
    Morton key of the finest grid makes every voxel of every scale a run of consecutive points; other scales, and grids
    too large for a key, go through the hash table.
    """
    _check_points(points, sample)
    check_index("sample", sample, batch_size)
    if not grids:
        raise ValueError("grids: want at least one grid, got none")
    for grid in grids:
        if batch_size * grid.shape[0] * grid.shape[1] >= 2**63:
            raise ValueError(f"grids: {batch_size} samples of {grid.shape} cells have cursors beyond int64")
    by_scale = [cursors(points, sample, grid) for grid in grids]
    inside = by_scale[0].ge(0)
    for cursor in by_scale[1:]:
        inside &= cursor.ge(0)
    kept = inside.nonzero().squeeze(1)
    finest = min(range(len(grids)), key=lambda k: grids[k].cell)
    bits = max(max(grids[finest].cells) - 1, 1).bit_length()
    nested = all(_nests(grid, grids[finest]) for grid in grids)
    if not (nested and 2 * bits + batch_size.bit_length() <= KEY_BITS):
        return VoxelIndex(kept, [_hashed_voxels(cursor[kept]) for cursor in by_scale])
    order = kept[torch.sort(_morton_keys(by_scale[finest][kept], grids[finest], bits), stable=True).indices]
    return VoxelIndex(order, [_sorted_voxels(cursor[order]) for cursor in by_scale])


def hash_index(cursor: Tensor) -> tuple[Tensor, Tensor]:
    """The distinct cursors in ascending order (V,), and the place of each of the cursors (N,) >= 0 among them (N,).

    Open addressing; the table's layout depends on the order of insertion, and sorting the voxels removes that.
    """
    check_tensor("cursor", cursor, (torch.int64,), (None,))
    check_index("cursor", cursor, 2**63)
    capacity = 1 << max(2 * len(cursor) - 1, 1).bit_length()
    table = torch.full((capacity,), -1, dtype=torch.int64, device=cursor.device)
    slot = torch.empty_like(cursor)
    launch(_insert_kernel, len(cursor), [array(cursor.contiguous()), array(table), array(slot)], cursor.device)
    occupied = table.ge(0).nonzero().squeeze(1)
    unique, by_cursor = torch.sort(table[occupied])
    table[occupied[by_cursor]] = torch.arange(len(unique), device=cursor.device)  # from here on: slot -> voxel
    return unique, table[slot]


def _nests(grid: Grid, finest: Grid) -> bool:
    """Whether the cells of a grid are a power of two times the finest ones, to the bit, so that runs stay runs."""
    ratio = grid.cell[0] / finest.cell[0]
    same_origin = (grid.x_min, grid.y_min) == (finest.x_min, finest.y_min)
    return same_origin and math.frexp(ratio)[0] == 0.5 and grid.cell[1] / finest.cell[1] == ratio


def _morton_keys(cursor: Tensor, grid: Grid, bits: int) -> Tensor:
    keys = torch.empty_like(cursor)
    shape = wp.int64(grid.shape[0]), wp.int64(grid.shape[1])
    launch(_morton_kernel, len(cursor), [array(cursor), *shape, bits, array(keys)], cursor.device)
    return keys


def _sorted_voxels(cursor: Tensor) -> Voxels:
    """Voxels of points whose cursors (K,) stand in runs."""
    first = torch.ones(len(cursor) + 1, dtype=torch.bool, device=cursor.device)
    first[1:-1] = cursor[1:] != cursor[:-1]
    starts = first.nonzero().squeeze(1) if len(cursor) else first.new_zeros(1, dtype=torch.int64)
    return Voxels(cursor[starts[:-1]], Segments(first[:-1].cumsum(0) - 1, starts, None))


def _hashed_voxels(cursor: Tensor) -> Voxels:
    unique, index = hash_index(cursor)
    values, order = torch.sort(index, stable=True)
    starts = torch.searchsorted(values, torch.arange(len(unique) + 1, device=cursor.device))
    return Voxels(unique, Segments(index, starts, order))


def _check_points(points: Tensor, sample: Tensor) -> None:
    check_tensor("points", points, (torch.float32,), (None, 4))
    check_tensor("sample", sample, (torch.int64,), (len(points),), like=points)


@wp.kernel(enable_backward=False, module="unique")
def _cursor_kernel(
    points: wp.array2d(dtype=wp.float32),
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
    x = wp.floor((points[i, 0] - low[0]) * reciprocal[0])
    y = wp.floor((points[i, 1] - low[1]) * reciprocal[1])
    z = points[i, 2]
    value = wp.int64(-1)
    # compared as floats: infinities and NaN fail here and are never cast
    inside = x >= 0.0 and x < float(cells[0]) and y >= 0.0 and y < float(cells[1])
    if inside and z >= height[0] and z < height[1] and wp.isfinite(points[i, 3]):
        value = (sample[i] * n_l + wp.int64(x)) * n_w + wp.int64(y)
    cursor[i] = value


@wp.func
def _spread(value: wp.int64, bits: int):
    """The bits of a value, one place apart."""
    spread = wp.int64(0)
    for bit in range(bits):
        spread = spread | (((value >> wp.int64(bit)) & wp.int64(1)) << wp.int64(2 * bit))
    return spread


@wp.kernel(enable_backward=False, module="unique")
def _morton_kernel(
    cursor: wp.array(dtype=wp.int64), n_l: wp.int64, n_w: wp.int64, bits: int, keys: wp.array(dtype=wp.int64)
):
    i = wp.tid()
    y = cursor[i] % n_w
    row = cursor[i] / n_w
    sample = row / n_l
    keys[i] = (sample << wp.int64(2 * bits)) | (_spread(row % n_l, bits) << wp.int64(1)) | _spread(y, bits)


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
