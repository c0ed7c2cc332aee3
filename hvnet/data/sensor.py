"""The one judge of a cloud: its reflectance, its ground, and what of it is in range, for files, roots and arrays alike.

docs/sensors.md has the rules, and what they give on real sensors.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvnet.kernels.launch import many_threads
from hvnet.kernels.place import (
    ABOVE_ORIGIN,
    FAR,
    FEWEST_CELLS,
    FEWEST_POINTS,
    GROUND_SHARE,
    LOWEST_GROUND,
    NEAR,
    NEAREST,
    PLAIN_CELLS,
    SAMPLED,
    TOLERANCE,
    UNDERGROUND,
    WINDOW,
    ground_heights,
)

Floats = NDArray[np.float32]

FULL_SCALES = (1.0, 255.0, 65535.0)
"""Largest reflectance of sensors that count up to 1, in 8 bits and in 16 bits."""
OUTLIER = 20.0
"""A reflectance that is so many times the 95 % quantile says nothing about the scale."""
LEFT_OUT = "reflectance left out"

CELL = 1.0  # metres
GROUND_TOLERANCE = 0.4
"""Metres by which the ground may differ from that of the training data before a cloud is moved; KITTI's own frames
differ by 0.25 at most."""
FEW_IN_RANGE = 0.02
"""Share of a cloud's points in range below which the reason is wanted: it is 0.5 of KITTI's whole scans."""


class Reflectance(NamedTuple):
    """The reflectance of a cloud, and what was found out about it."""

    values: Floats  # (N,) in [0, 1]
    scale: float  # what it was divided by; 0 if there is none
    highest: float = 0.0  # before that
    missing: str = ""  # why there is none

    @property
    def fact(self) -> str:
        """What was done, in the same words for all clouds of a sensor."""
        if not self.scale:
            return self.missing
        return "reflectance as is" if self.scale == 1 else f"reflectance / {self.scale:g}"

    @property
    def note(self) -> str:
        """What a user should know of all clouds of a sensor; empty if nothing was done but what was asked for."""
        if not self.scale:
            return "" if self.missing == LEFT_OUT else f"has {self.missing}; 0 is used, which makes detection worse"
        return "" if self.scale == 1 else f"reflectance was divided by {self.scale:g}"


def highest_reflectance(values: NDArray) -> float:
    """The 99 % quantile of reflectances (N,), outliers left out: what tells the scale. 0 if there is none."""
    values = values[np.isfinite(values) & (values > 0)].astype(np.float64)
    if not len(values):
        return 0.0
    values = values[values / OUTLIER <= np.quantile(values, 0.95, method="lower")]
    return float(np.quantile(values, 0.99, method="higher"))


def full_scale(highest: float) -> float:
    """The scale of reflectances up to `highest`: 1, 255, 65535 or, beyond that, the highest itself."""
    return next((full for full in FULL_SCALES if highest <= full + TOLERANCE * (full == 1)), highest)


def has_reflectance(values: NDArray) -> bool:
    """Whether reflectances (N,) mean anything: they are not all the same."""
    finite = values[np.isfinite(values)]
    return len(values) == 0 or (len(finite) > 0 and (len(finite) < FEWEST_POINTS or finite.min() < finite.max()))


def judge_reflectance(values: NDArray | None, count: int, scale: float) -> Reflectance:
    """The reflectance (N,) of `count` points as a detector takes it: divided by the scale, outliers clipped.

    0 where it is NaN, and everywhere if there is none, if it is the same everywhere, or if the scale is 0.
    """
    if values is None or scale == 0 or not has_reflectance(values):
        missing = "no reflectance" if values is None else LEFT_OUT if scale == 0 else "a constant reflectance"
        return Reflectance(np.zeros(count, np.float32), 0.0, missing=missing)
    with np.errstate(all="ignore"):
        highest = float(values.max(initial=0, where=np.isfinite(values)))
        scaled = values if scale == 1 else (values / np.float32(scale)).astype(np.float32)
        if not (scaled.min(initial=0) >= 0 and scaled.max(initial=0) <= 1):  # nearly never: spares the copy
            scaled = np.nan_to_num(scaled, nan=0.0).clip(0, 1)
    return Reflectance(scaled.astype(np.float32, copy=False), scale, highest)


def dropped_note(count: int) -> str:
    """What to say of points that were dropped."""
    return f"{count} points that are not finite were dropped"


def check_points(points: object, device: torch.device | str | None = None) -> Tensor:
    """Points of any array as a float32 tensor (N, 4), on a device or where they are.

    Raises ValueError for another shape, or numbers that are not real.
    """
    if isinstance(points, np.ndarray):
        if points.dtype.kind not in "fiu":
            raise ValueError(f"points: want real numbers, got {points.dtype}")
        # torch takes neither a foreign byte order nor a negative stride, and warns of read-only memory
        with np.errstate(over="ignore"):
            points = np.require(points, np.float32, ["C", "W"])
    if isinstance(points, Tensor) and points.is_complex():
        raise ValueError(f"points: want real numbers, got {points.dtype}")
    tensor = torch.as_tensor(points, dtype=torch.float32, device=device)
    if tensor.ndim != 2 or tensor.shape[1] != 4:
        transposed = tensor.ndim == 2 and (tensor.shape[0] == 4 or 3 <= tensor.shape[0] <= 16 < tensor.shape[1])
        hint = ": it is transposed, give points.T" if transposed else ""
        raise ValueError(f"points: want shape (N, 4) with x, y, z, reflectance, got {tuple(tensor.shape)}{hint}")
    return tensor


def as_points(points: object, device: torch.device | str = "cpu") -> Tensor:
    """Points of any array as a float32 tensor (N, 4) on a device: x, y, z in metres, reflectance in [0, 1].

    A reflectance that is NaN, or the same everywhere, is 0: there is none. Raises ValueError for another shape, or
    numbers that are not real.
    """
    tensor = check_points(points, device)
    reflectance = tensor[:, 3]
    clean = reflectance.nan_to_num(0.0, math.inf, -math.inf).clamp(min=0)
    if len(tensor) >= FEWEST_POINTS:
        unknown = reflectance.isnan()
        low, high = (clean.where(~unknown, bound) for bound in (math.inf, -math.inf))
        clean = clean.where(low.amin() < high.amax(), 0.0)
    if not many_threads(tensor.device) and torch.equal(clean, reflectance):
        return tensor
    return torch.cat((tensor[:, :3], clean[:, None]), dim=1)


def inside(points: Tensor, point_range: Sequence[float]) -> Tensor:
    """Which of the points (N, 3 or more) are in the range x_min, y_min, z_min, x_max, y_max, z_max: (N,) bool."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    x_min, y_min, z_min, x_max, y_max, z_max = point_range
    return (x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max) & (z >= z_min) & (z < z_max)


def too_bright(points: Tensor, point_range: Sequence[float]) -> Tensor:
    """The largest reflectance of the points (N, 4) in range if it is more than a tolerance above 1, else 0: ()."""
    if not len(points):
        return points.new_zeros(())
    bright = points[:, 3] > 1 + TOLERANCE
    if not many_threads(points.device) and not bright.any():  # nearly always
        return points.new_zeros(())
    return points[:, 3].where(bright & inside(points, point_range), 0.0).amax()


def reflectance_error(largest: float) -> str:
    """What to say of reflectances up to `largest` in an array."""
    return f"points: want a reflectance from 0 to 1, got {largest:g}; divide column 4 by its scale, or clip outliers"


def find_ground(points: Tensor) -> Tensor:
    """Height in metres of the ground around the sensor in a cloud (N, 3 or more): (), NaN where none is found.

    In every cell of 1 m the lowest twentieth of the points is skipped; the ground is where most cells agree on the next
    one. On many threads it is found by `ground_heights`, which reads nothing from the device.
    """
    if many_threads(points.device):
        if points.shape[1] == 3:
            points = torch.cat((points, points[:, 2:]), dim=1)  # a reflectance, which is not looked at
        cloud = points[:, :4].float().contiguous()[None]
        counts = torch.full((1,), len(points), dtype=torch.int32, device=points.device)
        return ground_heights(cloud, counts)[0].to(points.dtype)
    points = points[:: max(1, len(points) // SAMPLED), :3]
    height, enough = common_height(low_heights(points, NEAR), points)
    if not enough:
        wide, enough_wide = common_height(low_heights(points, FAR), points)
        height = wide.where(enough_wide, math.nan)
    return height.to(points.dtype)


def low_heights(points: Tensor, far: float) -> Tensor:
    """The low points' height in metres in every cell (C,) up to a distance from the sensor; infinite in empty cells."""
    x, y, z = points.unbind(1)
    distance = (x.square() + y.square()).sqrt()
    # false for NaN
    ring = (distance >= NEAREST) & (distance < far) & (z > LOWEST_GROUND) & (z < LOWEST_GROUND + 1000)
    x, y, z = x[ring], y[ring], z[ring]
    side = math.ceil(2 * far / CELL)
    cell = ((x + far) / CELL).int().clamp(0, side - 1) * side + ((y + far) / CELL).int().clamp(0, side - 1)
    # cell and height, to the centimetre, in one number, which is sorted once; the last one is of no point
    levels = 2**17
    key = cell * levels + ((z - LOWEST_GROUND) * 100).int()
    key = torch.cat((key, key.new_full((1,), side * side * levels))).sort().values
    starts = torch.searchsorted(key, torch.arange(side * side + 1, device=points.device, dtype=torch.int32) * levels)
    counts = starts[1:] - starts[:-1]
    low = key[starts[:-1] + counts // 20] % levels
    return torch.where(counts > 0, low / 100 + LOWEST_GROUND, math.inf)


def common_height(low: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """The height () that most of the low heights (C,) of points (N, 3) are near, and whether it is the ground's."""
    low = low.sort().values
    total = low.isfinite().sum()
    last = torch.searchsorted(low, low + WINDOW, right=True)
    counts = (last.minimum(total) - torch.arange(low.shape[0], device=low.device)).clamp(min=0)
    best = counts.argmax()
    height = low[best + counts[best] // 2]
    enough = (total >= FEWEST_CELLS) & (counts[best] >= GROUND_SHARE * total)
    below = (points[:, 2] < height - WINDOW).sum() / torch.ones_like(points[:, 2]).sum().clamp(min=1)
    return height, enough & ((height < ABOVE_ORIGIN) | ((total >= PLAIN_CELLS) & (below < UNDERGROUND)))


def shift_to(ground: Tensor, wanted: float) -> Tensor:
    """By how many metres () a cloud has to be raised, so that its ground lies where it is wanted; 0 if it nearly does,
    or is not known."""
    shift = wanted - ground
    return shift.where(shift.abs() > GROUND_TOLERANCE, 0.0)


class Look(NamedTuple):
    """What a detector sees of a cloud."""

    points: int
    in_range: int
    ground: float  # height in metres, NaN where none is found
    shift: float  # metres by which the cloud was raised
    reason: str = ""  # why few or none of the points are in range

    def text(self) -> str:
        """In a few words."""
        ground = "no ground found" if math.isnan(self.ground) else f"ground at {self.ground + 0.0:.2f} m"
        moved = f", moved to {self.ground + self.shift:.2f} m" if self.shift else ""
        return f"{self.points:,} points, {self.in_range:,} in range; {ground}{moved}"


def summary(looks: Sequence[Look], reflectances: Sequence[str]) -> str:
    """What was seen of all clouds of a call, and what was done to their reflectances, in one line."""
    points = [look.points for look in looks]
    shares = [100 * look.in_range / max(look.points, 1) for look in looks]
    grounds = [look.ground for look in looks if not math.isnan(look.ground)]
    parts = [f"{_span(points, '{:,.0f}')} points", f"{_span(shares, '{:.0f}')} % in range"]
    parts.append(f"ground {_span(grounds, '{:.2f}')} m" if grounds else "no ground found")
    moved = [look.shift for look in looks if look.shift]
    if moved:
        parts.append(f"{len(moved)} of {len(looks)} moved by {_span(moved, '{:+.2f}')} m")
    return ", ".join(parts + sorted(set(reflectances)))


def _span(values: Sequence[float], form: str) -> str:
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"


def range_reason(points: Tensor, point_range: Sequence[float]) -> str:
    """Why few or none of the points (N, 4) are in range, with the remedy."""
    finite = points[:, :3][points[:, :3].isfinite().all(dim=1)].double()
    if not len(finite):
        return "the cloud has no points"
    middle = finite.median(dim=0).values
    distance, size = float(middle[:2].norm()), float((finite[:, :2] - middle[:2]).norm(dim=1).median())
    reach = max(abs(value) for value in point_range)
    if distance > max(3 * size, 2 * reach):
        where = ", ".join(f"{value:.0f}" for value in middle)
        return f"they lie around {where}, as map coordinates do; subtract the sensor's position"
    if size > 5 * reach:
        unit = "millimetres" if size > 50 * reach else "centimetres"
        return f"half of them are further than {size:,.0f} from the sensor, as in {unit}; metres are wanted"
    if float((finite[:, :2].norm(dim=1) > point_range[3]).double().mean()) > 0.9:
        return f"they are further from the sensor than {point_range[3]:g} m"
    low, high = (float(value) for value in np.quantile(finite[:, 2].numpy(), [0.05, 0.95]))
    if high < point_range[2] or low >= point_range[5]:
        wanted = f"{point_range[2]:g} to {point_range[5]:g} m are seen"
        return f"their heights above the sensor are {low:.1f} to {high:.1f} m, {wanted}; give another --sensor-height"
    return "they lie behind or beside the sensor; --turn or --all-round shows the detector that side"
