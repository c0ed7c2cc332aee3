"""Cursors (Eq. 1 and 3), the voxels of every scale and the hash table, by hand and against their twins."""

import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from hvnet.kernels import launch, reference, voxel

INF, NAN = math.inf, math.nan
RANGE = (0.0, -16.0, -3.0, 64.0, 16.0, 1.0)  # twice as long as wide, so that a transpose shows
NESTED = (0.2, 0.4, 0.8, 1.6, 3.2)


def grids_of(scales: Sequence[float], point_range: tuple[float, ...] = RANGE, multiple: int = 1) -> list[voxel.Grid]:
    return [voxel.make_grid(point_range, (1.0, 1.0), scale, multiple) for scale in scales]


def cloud(count: int, seed: int = 0, point_range: tuple[float, ...] = RANGE, margin: float = 0.1) -> Tensor:
    """Points (count, 4), some of them (a margin of the range at every side) outside."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor(point_range[:3]), torch.tensor(point_range[3:])
    xyz = low + (torch.rand(count, 3, generator=generator) * (1 + 2 * margin) - margin) * (high - low)
    return torch.cat((xyz, torch.rand(count, 1, generator=generator)), dim=1)


def at(*xyz: Sequence[float]) -> Tensor:
    """Points (N, 4) at the given x, y, z."""
    return torch.tensor([[*point, 0.5] for point in xyz], dtype=torch.float32)


def zeros(count: int, device: torch.device | None = None) -> Tensor:
    return torch.zeros(count, dtype=torch.int64, device=device)


def check_index(
    points: Tensor, sample: Tensor, batch_size: int, grids: Sequence[voxel.Grid], device: torch.device
) -> voxel.VoxelIndex:
    """Compares with the twin through cursors: the numbering of voxels and the order of points are free."""
    actual = voxel.voxel_index(points.to(device), sample.to(device), batch_size, grids)
    expected = reference.voxel_index(points, sample, batch_size, grids)
    order = actual.order.cpu()
    assert order.dtype == torch.int64
    assert torch.equal(order.sort().values, expected.order)
    assert len(actual.scales) == len(grids)
    for grid, voxels, twin in zip(grids, actual.scales, expected.scales, strict=True):
        cursor, index, starts = voxels.cursor.cpu(), voxels.segments.voxel.cpu(), voxels.segments.starts.cpu()
        assert cursor.dtype == index.dtype == starts.dtype == torch.int64
        assert torch.equal(cursor.sort().values, twin.cursor)
        assert torch.equal(cursor[index], reference.cursors(points, sample, grid)[order])
        assert torch.equal(starts.diff(), torch.bincount(index, minlength=len(cursor)))
        assert starts[0] == 0
        segments = torch.arange(len(order)) if voxels.segments.order is None else voxels.segments.order.cpu()
        assert segments.dtype == torch.int64
        assert torch.equal(index[segments], torch.arange(len(cursor)).repeat_interleave(starts.diff()))
        assert torch.equal(segments, index.argsort(stable=True))  # so ascending within each voxel
    return actual


@pytest.mark.parametrize(
    ("extent", "cell", "cells"),
    [
        (64.0, 0.1, 640),  # 64 // 0.1 is 639
        (64.0, 0.2, 320),
        (64.0, 0.3, 214),  # the last cell is partly outside
        (70.4, 0.2, 352),
        (69.12, 0.16, 432),
        (79.36, 0.16, 496),
        (1.0, 1.0, 1),
        (1.0, 3.0, 1),
    ],
)
def test_number_of_cells(extent: float, cell: float, cells: int) -> None:
    grid = voxel.make_grid((-extent / 2, -10.0, -3.0, extent / 2, 10.0, 1.0), (cell, 2.0), 1.0)
    assert grid.cells == grid.shape == (cells, 10)
    grid = voxel.make_grid((0.0, 0.0, -3.0, 10.0, extent, 1.0), (4.0, 2 * cell), 0.5)
    assert grid.cells == grid.shape == (5, cells)


def test_grid() -> None:
    grid = voxel.make_grid(RANGE, (0.2, 0.4), 1.5, multiple=4)
    assert (grid.x_min, grid.y_min, grid.z_min, grid.z_max) == (0.0, -16.0, -3.0, 1.0)
    assert grid.cell == pytest.approx((0.3, 0.6))
    assert grid.cells == (214, 54)
    assert grid.shape == (216, 56)
    assert voxel.make_grid(RANGE, (0.2, 0.2), 1.0, multiple=4).shape == (320, 160)


@pytest.mark.parametrize(
    ("point_range", "voxel_size", "scale", "match"),
    [
        (RANGE, (0.2, 0.2), 0.0, "scale.*0"),
        (RANGE, (0.2, 0.2), -1.0, r"scale.*-1"),
        (RANGE, (0.0, 0.2), 1.0, "voxel_size"),
        (RANGE, (0.2, -0.2), 1.0, r"voxel_size.*-0\.2"),
        ((0.0, -16.0, -3.0, 0.0, 16.0, 1.0), (0.2, 0.2), 1.0, "range"),
        ((0.0, 16.0, -3.0, 64.0, -16.0, 1.0), (0.2, 0.2), 1.0, "range"),
        ((0.0, -16.0, 1.0, 64.0, 16.0, 1.0), (0.2, 0.2), 1.0, "range"),
    ],
)
def test_impossible_grid(
    point_range: tuple[float, ...], voxel_size: tuple[float, float], scale: float, match: str
) -> None:
    with pytest.raises(ValueError, match=match):
        voxel.make_grid(point_range, voxel_size, scale)


def test_cursors_by_hand(device: torch.device) -> None:
    """Eq. 1 on 320 x 160 cells of 0.2 m: x before y, samples before both."""
    (grid,) = grids_of([0.2])
    points = at((0, -16, 0), (0.1, -15.7, 0), (0.3, -15.9, 0), (63.9, 15.9, 0), (63.9, 15.9, 0), (10.1, 0.1, -3))
    sample = torch.tensor([0, 0, 0, 0, 2, 1])
    expected = [0, 1, 160, 320 * 160 - 1, 3 * 320 * 160 - 1, 320 * 160 + 50 * 160 + 80]
    assert voxel.cursors(points.to(device), sample.to(device), grid).tolist() == expected
    assert reference.cursors(points, sample, grid).tolist() == expected


def test_edges_of_the_range(device: torch.device) -> None:
    (grid,) = grids_of([0.2])
    below = [float(torch.nextafter(torch.tensor(edge), torch.tensor(-INF))) for edge in (64.0, 16.0, 1.0, -3.0, -16.0)]
    inside = [
        (0.0, -16.0, -3.0),
        (-0.0, -16.0, -0.0),  # no negative cell
        (below[0], 0.0, 0.0),
        (1.0, 1.0, below[2]),
        (1.0, -0.0, 0.0),
    ]
    outside = [
        (64.0, 0.0, 0.0),
        (0.0, 16.0, 0.0),
        (0.0, below[1], 0.0),  # below 16, but 16 m further it rounds to 32: cell 160, which is the next row's cell 0
        (0.0, 0.0, 1.0),
        (0.0, 0.0, below[3]),
        (0.0, below[4], 0.0),
        (-1e-9, 0.0, 0.0),  # int() would round it up to cell 0
        (-0.1, 0.0, 0.0),
        (0.0, -16.1, 0.0),
        (1e30, 0.0, 0.0),  # beyond every integer
        (0.0, -1e30, 0.0),
        (3e9, 0.0, 0.0),  # beyond 32 bits
        (2.0**32 * 0.2, 0.0, 0.0),  # would wrap to cell 0
        *[(value, 0.0, 0.0) for value in (NAN, INF, -INF)],
        *[(0.0, value, 0.0) for value in (NAN, INF, -INF)],
        *[(0.0, 0.0, value) for value in (NAN, INF, -INF)],
        *[(0.0, 0.0, 0.0)] * 3,
    ]
    points = at(*inside, *outside)
    points[-3:, 3] = torch.tensor([NAN, INF, -INF])  # a point without a reflectance is no point either
    cursor = voxel.cursors(points.to(device), zeros(len(points), device), grid)
    assert cursor.tolist() == [0, 0, 319 * 160 + 80, 5 * 160 + 85, 5 * 160 + 80, *[-1] * len(outside)]
    assert torch.equal(cursor.cpu(), reference.cursors(points, zeros(len(points)), grid))
    index = check_index(points, zeros(len(points)), 1, [grid], device)
    assert sorted(index.order.tolist()) == [0, 1, 2, 3, 4]


def test_just_below_a_range_from_zero(device: torch.device) -> None:
    """Where nothing is subtracted, nextafter(32, 0) is in the last cell."""
    grid = voxel.make_grid((0.0, 0.0, -3.0, 64.0, 32.0, 1.0), (0.2, 0.2), 1.0)
    last = torch.nextafter(torch.tensor(32.0), torch.tensor(0.0))
    points = torch.stack((last, last, torch.tensor(0.0), torch.tensor(0.0)))[None]
    assert voxel.cursors(points.to(device), zeros(1, device), grid).tolist() == [159 * 160 + 159]


@pytest.mark.parametrize("millimetres", [100, 200, 400, 50])
def test_every_millimetre(millimetres: int, device: torch.device) -> None:
    """Multiplying by the rounded reciprocal misplaces none of them; dividing by 0.1f misplaces 76."""
    k = torch.arange(64_000)
    points = torch.zeros(64_000, 4)
    points[:, 0], points[:, 1] = k / 1000, k.flip(0) / 1000
    grid = voxel.make_grid((0.0, 0.0, -3.0, 64.0, 64.0, 1.0), (0.001 * millimetres, 0.001 * millimetres), 1.0)
    cursor = voxel.cursors(points.to(device), zeros(64_000, device), grid).cpu()
    assert torch.equal(cursor // grid.shape[1], k // millimetres)
    assert torch.equal(cursor % grid.shape[1], k.flip(0) // millimetres)


@pytest.mark.parametrize("multiple", [1, 4])
def test_scale_that_does_not_divide_the_range(multiple: int, device: torch.device) -> None:
    """At 0.3 m the points of [63.9, 64) have a cell of their own, and padding moves no point to another."""
    (grid,) = grids_of([0.3], multiple=multiple)
    rows = grid.shape[1]
    points = at((63.95, -16, 0), (63.85, -16, 0), (0, 15.95, 0), (0, 15.75, 0), (63.95, 15.95, 0), (64.3, 0, 0))
    expected = [213 * rows, 212 * rows, 106, 105, 213 * rows + 106, -1]  # the last is in the padding or beyond
    assert voxel.cursors(points.to(device), zeros(6, device), grid).tolist() == expected
    points = cloud(5000, margin=0.0)
    assert (voxel.cursors(points.to(device), zeros(5000, device), grid) >= 0).all()  # nothing in the range is lost


@pytest.mark.parametrize("scale", [0.1, 0.2, 0.3, 0.37, 5.0])
@pytest.mark.parametrize("multiple", [1, 8])
def test_cursors_equal_twin(scale: float, multiple: int, device: torch.device) -> None:
    (grid,) = grids_of([scale], (-40.3, -7.7, -3.0, 25.1, 30.2, 1.5), multiple)
    points = cloud(20_000, 1, (-40.3, -7.7, -3.0, 25.1, 30.2, 1.5))
    sample = torch.arange(20_000) % 5
    cursor = voxel.cursors(points.to(device), sample.to(device), grid)
    assert cursor.dtype == torch.int64
    assert torch.equal(cursor.cpu(), reference.cursors(points, sample, grid))
    assert (cursor >= 0).any()
    assert (cursor < 0).any()


def test_cell_of_a_cursor(device: torch.device) -> None:
    """Eq. 3 on a range longer than wide with cells longer than wide: the cell holds the point."""
    grid = voxel.make_grid(RANGE, (0.5, 0.2), 1.0, multiple=3)
    assert grid.shape == (129, 162)
    points, sample = cloud(5000, margin=0.0), torch.arange(5000) % 3
    cursor = voxel.cursors(points.to(device), sample.to(device), grid).cpu()
    length, width = grid.shape
    assert torch.equal(cursor // (length * width), sample)
    for cell, axis, low in (((cursor // width) % length, 0, 0.0), (cursor % width, 1, -16.0)):
        inside = points[:, axis].double() - low - cell * grid.cell[axis]
        assert (inside >= -1e-5).all()  # a few roundings of a float32 of up to 64 m
        assert (inside <= grid.cell[axis] + 1e-5).all()


def test_coarse_cells_are_shifted_fine_cells(device: torch.device) -> None:
    points = cloud(20_000, margin=0.0)
    cells = []
    for grid in grids_of(NESTED):
        cursor = voxel.cursors(points.to(device), zeros(20_000, device), grid)
        cells.append((cursor // grid.shape[1], cursor % grid.shape[1]))
    for k, (ix, iy) in enumerate(cells):
        assert torch.equal(ix, cells[0][0] >> k)
        assert torch.equal(iy, cells[0][1] >> k)


@pytest.mark.parametrize(
    "scales",
    [
        (0.2,),
        NESTED[:2],
        NESTED[:3],
        NESTED[:4],
        NESTED,
        (0.8, 0.2, 0.4),  # in any order
        (0.2, 0.8),  # with a scale left out
        (0.2, 0.2),
        (0.3, 0.6, 1.2),  # nested, but no divisor of the range
        (0.2, 0.3),  # not nested
        (0.2, 0.6),
        (0.2, 0.3, 0.4),
    ],
    ids=str,
)
@pytest.mark.parametrize("multiple", [1, 4])
def test_index_equals_twin(scales: tuple[float, ...], multiple: int, device: torch.device) -> None:
    grids = grids_of(scales, multiple=multiple)
    check_index(cloud(3000), torch.arange(3000) % 3, 3, grids, device)  # samples interleaved
    dense = torch.cat((cloud(500), at((5, 5, 0)).expand(500, 4), cloud(500, 3)))
    sample = torch.tensor([0, 1, 3]).repeat_interleave(500)  # sample 2 is empty, and so is sample 4
    check_index(dense, sample, 5, grids, device)
    check_index(dense, sample.flip(0), 5, grids, device)


@pytest.mark.parametrize("voxel_size", [(0.2, 0.4), (0.4, 0.16)])
def test_cells_that_are_not_square(voxel_size: tuple[float, float], device: torch.device) -> None:
    grids = [voxel.make_grid(RANGE, voxel_size, scale) for scale in (0.5, 1.0, 2.0)]
    check_index(cloud(3000), torch.arange(3000) % 2, 2, grids, device)


@pytest.mark.parametrize("shift", [(0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.5)])
def test_grids_of_different_ranges(shift: tuple[float, float, float], device: torch.device) -> None:
    """Cells twice as large do not nest where the grid starts elsewhere; a point outside one grid is in none."""
    moved = tuple(value + offset for value, offset in zip(RANGE, shift * 2, strict=True))
    grids = [*grids_of([0.2]), *grids_of([0.4], moved)]
    check_index(cloud(3000), zeros(3000), 1, grids, device)


@pytest.mark.parametrize("scales", [(0.2,), NESTED, (0.2, 0.3)], ids=str)
def test_few_points(scales: tuple[float, ...], device: torch.device) -> None:
    grids = grids_of(scales)
    index = check_index(torch.zeros(0, 4), zeros(0), 2, grids, device)
    assert len(index.order) == 0
    assert all(voxels.segments.starts.tolist() == [0] for voxels in index.scales)
    index = check_index(at((5, 5, 0)), torch.tensor([1]), 2, grids, device)
    assert index.order.tolist() == [0]
    assert all(voxels.segments.starts.tolist() == [0, 1] for voxels in index.scales)
    assert len(check_index(at((-5, 5, 0), (5, 5, NAN)), zeros(2), 1, grids, device).order) == 0  # none kept
    assert check_index(at((-5, 5, 0), (5, 5, 0), (5, 99, 0)), zeros(3), 1, grids, device).order.tolist() == [1]
    assert len(check_index(torch.zeros(0, 4), zeros(0), 0, grids, device).order) == 0  # no sample at all


@pytest.mark.parametrize("scales", [(0.2, 0.4), (0.2, 0.3)], ids=str)
def test_a_million_points_in_one_voxel(scales: tuple[float, ...], device: torch.device) -> None:
    count = 1_000_000
    points = at((5.1, 5.1, 0)).repeat(count, 1)
    points[:, :2] += torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * 0.08
    index = check_index(points, zeros(count), 1, grids_of(scales), device)
    assert all(voxels.segments.starts.tolist() == [0, count] for voxels in index.scales)


@pytest.mark.parametrize(
    ("point_range", "batch_size"),
    [
        ((0.0, 0.0, -1.0, 2.0**20, 2.0**20, 1.0), 2**22),  # cursors of 62 bits
        ((0.0, 0.0, -1.0, 2.0**24, 4.0, 1.0), 2**20),  # long and narrow: interleaved bits are wasted on y
        ((0.0, 0.0, -1.0, 4.0, 2.0**24, 1.0), 2**20),
        ((0.0, 0.0, -1.0, 2.0**15, 2.0**15, 1.0), 2),  # 31 bits
        ((0.0, 0.0, -1.0, 2.0**16, 2.0**16, 1.0), 1),  # 32 bits
        ((0.0, 0.0, -1.0, 2.0**16, 2.0**16, 1.0), 3),
    ],
)
@pytest.mark.parametrize("scales", [(1.0, 2.0), (1.0, 3.0)], ids=str)
def test_grid_too_large_for_a_key(
    scales: tuple[float, ...], point_range: tuple[float, ...], batch_size: int, device: torch.device
) -> None:
    points = cloud(2000, 2, point_range, margin=0.01)
    points = torch.cat((points, points.flip(0)))  # every voxel twice or more
    generator = torch.Generator().manual_seed(0)
    sample = torch.randint(batch_size, (2000,), generator=generator)
    sample[:20] = batch_size - 1
    check_index(points, torch.cat((sample, sample.flip(0))), batch_size, grids_of(scales, point_range), device)


@pytest.mark.parametrize("scales", [NESTED, (0.2, 0.3)], ids=str)
def test_same_bits_on_every_run(scales: tuple[float, ...], device: torch.device) -> None:
    """Twice on the device, and once on the CPU."""
    points, sample, grids = cloud(20_000, 4), torch.arange(20_000) % 2, grids_of(scales)

    def results(device: torch.device) -> list[Tensor]:
        index = voxel.voxel_index(points.to(device), sample.to(device), 2, grids)
        parts = [index.order]
        for voxels in index.scales:
            parts += [voxels.cursor, voxels.segments.voxel, voxels.segments.starts] + (
                [] if voxels.segments.order is None else [voxels.segments.order]
            )
        return [part.cpu() for part in parts]

    for first, second, on_cpu in zip(results(device), results(device), results(torch.device("cpu")), strict=True):
        assert torch.equal(first, second)
        assert torch.equal(first, on_cpu)


@pytest.mark.parametrize("scales", [NESTED, (0.2, 0.3)], ids=str)
def test_order_of_points_does_not_number_voxels(scales: tuple[float, ...], device: torch.device) -> None:
    points, sample, grids = cloud(3000).to(device), zeros(3000, device), grids_of(scales)
    shuffle = torch.randperm(3000, generator=torch.Generator().manual_seed(0)).to(device)
    ordered = voxel.voxel_index(points, sample, 1, grids)
    shuffled = voxel.voxel_index(points[shuffle], sample, 1, grids)
    for first, second in zip(ordered.scales, shuffled.scales, strict=True):
        assert torch.equal(first.cursor, second.cursor)
        assert torch.equal(first.segments.starts, second.segments.starts)


def test_layout_does_not_matter(device: torch.device) -> None:
    points, sample, (grid,) = cloud(1000).to(device), (torch.arange(1000) % 2).to(device), grids_of([0.2])
    wide = torch.full((2000, 9), 7.0, device=device)
    wide[::2, 1:5] = points
    long = torch.full((2000,), 7, device=device)
    long[::2] = sample
    for view in (wide[::2, 1:5], points.t().contiguous().t()):
        assert torch.equal(voxel.cursors(view, long[::2], grid), voxel.cursors(points, sample, grid))
        index, expected = voxel.voxel_index(view, long[::2], 2, [grid]), voxel.voxel_index(points, sample, 2, [grid])
        assert torch.equal(index.order, expected.order)
        assert torch.equal(index.scales[0].segments.voxel, expected.scales[0].segments.voxel)
    of_one_sample = torch.ones(1, dtype=torch.int64, device=device).expand(1000)
    assert torch.equal(voxel.cursors(points, of_one_sample, grid), voxel.cursors(points, of_one_sample.clone(), grid))


INVERSE = pow(11400714819323198485, -1, 2**64)  # of the hash's multiplier: keys can be made for a chosen slot


def keys_for_slot(high: int) -> Tensor:
    """About 1500 keys, each twice, whose product with the multiplier has the 32 high bits given: one slot for all."""
    keys = [INVERSE * ((high << 32) + low) % 2**64 for low in range(1, 3001)]
    return torch.tensor([key for key in keys if key < 2**63]).repeat(2)


HASH_CASES = {
    "random": torch.randint(5000, (20_000,), generator=torch.Generator().manual_seed(0)),
    "distinct": torch.randperm(10_000, generator=torch.Generator().manual_seed(0)),
    "one key": torch.full((10_000,), 42),
    "one point": torch.tensor([7]),
    "none": torch.zeros(0, dtype=torch.int64),
    "zero": torch.zeros(5, dtype=torch.int64),
    "descending": torch.arange(3000).flip(0),
    "the largest": torch.tensor([2**63 - 1, 0, 2**63 - 1, 2**63 - 2, 2**62, 2**32, 2**32 - 1, 2**31]),
    "equal low 20 bits": torch.arange(4096).repeat(2) << 20,
    "equal low 32 bits": torch.arange(4096).repeat(2) << 32,
    "equal low 40 bits": (torch.arange(4096).repeat(2) << 40) + 5,
    "equal low 50 bits": (torch.arange(4096).repeat(2) << 50) + 2**49,
    "all in the first slot": keys_for_slot(0),
    "all in the last slot": keys_for_slot(2**32 - 1),  # so that probing goes on at the first
    "powers of two": (torch.ones(63, dtype=torch.int64) << torch.arange(63)).repeat(3),
    "wide random": torch.randint(2**62, (20_000,), generator=torch.Generator().manual_seed(1)),
}


@pytest.mark.parametrize("name", HASH_CASES)
def test_hash_index(name: str, device: torch.device) -> None:
    cursor = HASH_CASES[name]
    unique, index = voxel.hash_index(cursor.to(device))
    expected = reference.hash_index(cursor)
    assert unique.dtype == index.dtype == torch.int64
    assert torch.equal(unique.cpu(), expected[0])
    assert torch.equal(index.cpu(), expected[1])


def test_hash_index_of_a_view(device: torch.device) -> None:
    cursor = HASH_CASES["random"].to(device)
    unique, index = voxel.hash_index(cursor[::3])
    assert torch.equal(unique[index], cursor[::3])


BAD_ARGUMENTS = [
    (TypeError, "points", {"points": [[0.0] * 4] * 3}),
    (TypeError, "points.*float64", {"points": torch.zeros(3, 4, dtype=torch.float64)}),
    (ValueError, "points.*3", {"points": torch.zeros(3, 3)}),
    (ValueError, "points", {"points": torch.zeros(4)}),
    (TypeError, "sample", {"sample": [0, 0, 0]}),
    (TypeError, "sample.*int32", {"sample": torch.zeros(3, dtype=torch.int32)}),
    (ValueError, "sample.*2", {"sample": torch.zeros(2, dtype=torch.int64)}),
    (ValueError, "sample", {"sample": torch.zeros(3, 1, dtype=torch.int64)}),
    (ValueError, "sample.*meta", {"sample": torch.zeros(3, dtype=torch.int64, device="meta")}),
]


@pytest.mark.parametrize(("error", "match", "changed"), BAD_ARGUMENTS)
def test_bad_points(error: type[Exception], match: str, changed: dict[str, object]) -> None:
    given = {"points": torch.zeros(3, 4), "sample": zeros(3)} | changed
    grids = grids_of([0.2])
    with pytest.raises(error, match=match):
        voxel.cursors(**given, grid=grids[0])
    with pytest.raises(error, match=match):
        voxel.voxel_index(**given, batch_size=1, grids=grids)


def test_bad_batch(device: torch.device) -> None:
    points, grids = torch.zeros(3, 4, device=device), grids_of([0.2])
    with pytest.raises(ValueError, match=r"sample.*2"):
        voxel.voxel_index(points, torch.tensor([0, 2, 1], device=device), 2, grids)
    with pytest.raises(ValueError, match=r"sample.*-1"):
        voxel.voxel_index(points, torch.tensor([0, -1, 1], device=device), 2, grids)
    with pytest.raises(ValueError, match="grids"):
        voxel.voxel_index(points, zeros(3, device), 2, [])


def test_bad_hash_keys(device: torch.device) -> None:
    with pytest.raises(TypeError, match=r"cursor.*int32"):
        voxel.hash_index(torch.zeros(3, dtype=torch.int32, device=device))
    with pytest.raises(ValueError, match="cursor"):
        voxel.hash_index(torch.zeros(3, 1, dtype=torch.int64, device=device))
    with pytest.raises(ValueError, match=r"cursor.*-1"):
        voxel.hash_index(torch.tensor([3, -1], device=device))


@pytest.mark.parametrize("scales", [[0.1], [0.1, 0.2, 0.4, 0.8], [0.4, 0.2]])
@pytest.mark.parametrize("count", [0, 1, 5000])
def test_one_thread_and_many_give_the_same_index(
    scales: list[float], count: int, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of points outside, and where the scales that follow each other are not in the order of their size."""
    grids = grids_of(scales)
    points, sample = cloud(count), torch.arange(count) % 3
    cursor = voxel.cursors(points, sample, min(grids, key=lambda grid: grid.cell))
    for grid in grids:  # a coarser grid may reach further than the finest, none less far
        assert (voxel.cursors(points, sample, grid) >= 0)[cursor >= 0].all()
    serial = voxel.nested_index(points, sample, grids)
    monkeypatch.setattr(launch, "force_many_threads", True)
    parallel = voxel.nested_index(points.to(device), sample.to(device), grids)
    assert torch.equal(serial.counts, parallel.counts.cpu())
    *voxels, kept = serial.counts.tolist()
    assert kept == int((cursor >= 0).sum())
    assert torch.equal(serial.order[:kept], parallel.order[:kept].cpu())
    for s, v in enumerate(voxels):
        assert torch.equal(serial.voxel[s, :kept], parallel.voxel[s, :kept].cpu())
        assert torch.equal(serial.starts[s, : v + 1], parallel.starts[s, : v + 1].cpu())
        assert torch.equal(serial.cursor[s, :v], parallel.cursor[s, :v].cpu())


def test_opcheck(device: torch.device) -> None:
    points, sample = cloud(200).to(device), (torch.arange(200) % 2).to(device)
    (grid,) = grids_of([0.4])
    numbers = voxel._numbers([grid])
    torch.library.opcheck(torch.ops.hvnet.cursors, (points, sample, numbers))
    torch.library.opcheck(torch.ops.hvnet.hash_index, (voxel.cursors(points, sample, grid).clamp(min=0),))
    for scales in ([0.2, 0.4], [0.2, 0.3]):  # that nest, and that do not
        numbers = voxel._numbers(grids_of(scales))
        torch.library.opcheck(torch.ops.hvnet.voxel_index, (points, sample, 2, numbers))


@pytest.mark.parametrize("scales", [[0.2, 0.4], [0.2, 0.3]])
def test_compiles_into_one_graph(scales: list[float]) -> None:
    """aot_eager needs no C++ compiler."""
    grids = grids_of(scales)

    def function(points: Tensor, sample: Tensor) -> tuple[Tensor, ...]:
        cursor = voxel.cursors(points, sample, grids[0])
        index = voxel.voxel_index(points, sample, 2, grids)
        starts = [part.segments.starts for part in index.scales]
        return cursor, *voxel.hash_index(cursor.clamp(min=0)), index.order, *starts

    compiled = torch.compile(function, fullgraph=True, backend="aot_eager", dynamic=True)
    for count in (500, 400):
        arguments = cloud(count), torch.arange(count) % 2
        for got, expected in zip(compiled(*arguments), function(*arguments), strict=True):
            assert torch.equal(got, expected)
    with pytest.raises(ValueError, match="sample"):
        compiled(cloud(400), torch.full((400,), 2))
