"""The numbers of a point in a file that does not name them (.bin, .npy): what they are, and how they are found out.

Two things give them away in the files of real sensors: the reflectance, fourth, is never negative, and points next to
each other in the file are near each other. In doubt they are KITTI's four.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hvnet.config import COLUMNS, are_columns
from hvnet.exceptions import InputError

REFLECTANCE = ("i", "intensity", "reflectance", "reflectivity", "remission")
"""Names that other tools give to the reflectance, in any case; CloudCompare puts scalar_ before them."""
COUNTS = {3: ("x", "y", "z")} | {count: ("x", "y", "z", "i", *"_" * (count - 4)) for count in range(4, 17)}
"""What so many numbers a point are, unless the user says otherwise."""
WRITERS = {5: " as nuScenes writes them", 6: " as converters of Waymo's data write them"}
TYPES = {"<f4": "float32", "<f8": "float64", "<f2": "float16"}
LARGEST = {"<f4": 1e8, "<f8": 1e8, "<f2": 1e3}
"""Largest usual number: map coordinates; any bits are a float16 up to 65504."""
SAMPLED_ROWS = 4096
FEWEST_ROWS = 32
"""Points from which on a file can tell its columns."""
SMOOTH = 0.25
"""Distance of neighbours in the file to that of points taken at random: 0.002 to 0.1 in scan order, 1 in none."""
SMOOTHER = 0.5
"""Distance of neighbours to that with four columns."""
FEW_NEGATIVE = 0.005
"""Share of negative reflectances that may be mistakes."""


class Layout(NamedTuple):
    """The names of a point's numbers (x, y, z, i for the reflectance, _ for any other) and their type."""

    names: tuple[str, ...]
    dtype: str = "<f4"

    @property
    def size(self) -> int:
        """Bytes of a point."""
        return len(self.names) * np.dtype(self.dtype).itemsize

    def __str__(self) -> str:
        kind = "" if self.dtype == "<f4" else f" as {TYPES[self.dtype]}"
        return f"{len(self.names)} numbers a point{kind}"


FOUR = Layout(COUNTS[4])


class Fit(NamedTuple):
    """How well a layout fits a sample of a file."""

    possible: bool  # numbers such as coordinates have: neither huge nor tiny
    never_negative: bool  # the reflectance, while coordinates are
    step: float  # median distance of neighbouring points
    spread: float  # median distance of points taken at random

    @property
    def is_smooth(self) -> bool:
        """Whether points next to each other in the file are near each other."""
        return self.possible and self.step < SMOOTH * self.spread


def parse_columns(text: str) -> tuple[str, ...]:
    """The names of "5" or "x,y,z,i,_". Raises InputError for anything else."""
    if text.isdecimal():
        if int(text) not in COUNTS:
            raise InputError(f"--columns {text}: want {min(COUNTS)} to {max(COUNTS)} numbers a point, or their names")
        return COUNTS[int(text)]
    names = tuple("i" if is_reflectance(name.strip()) else name.strip().lower() for name in text.split(","))
    if not are_columns(names):
        raise InputError(f"--columns {text}: want a number such as 5, or names such as x,y,z,i,_: {COLUMNS}")
    return names


def is_reflectance(name: str) -> bool:
    """Whether a field of this name holds the reflectance."""
    return name.lower().removeprefix("scalar_") in REFLECTANCE


def read_numbers(data: bytes, path: Path, columns: Sequence[str] = ()) -> tuple[NDArray[np.floating], Layout]:
    """The numbers (N, C) of a .bin file, and what they are: these columns, or what the file looks like.

    Raises InputError for a number of bytes that is no whole number of points, or numbers that are no coordinates; the
    message names the layouts that fit.
    """
    layout = find_layout(data, columns)
    whole = len(data) % layout.size == 0
    if whole and (len(data) < layout.size * FEWEST_ROWS or fit(data, layout).possible):
        return np.frombuffer(data, dtype=layout.dtype).reshape(-1, len(layout.names)), layout
    if whole:
        wrong = f"{path}: its numbers, as {layout}, are no coordinates in metres; "
    else:
        what = "x, y, z, reflectance" if layout == FOUR else ", ".join(layout.names)
        wrong = f"{path}: {len(data)} bytes are no multiple of {layout.size}, the size of a point ({what} as float32); "
    if columns:
        raise InputError(f"{wrong}give other --columns, or leave them out")
    counts = dict.fromkeys(len(each.names) for each in possible_layouts(data) if each != FOUR)
    named = [f"{count} numbers a point{WRITERS.get(count, '')}: --columns {count}" for count in counts]
    remedy = f"it may hold {', or '.join(named)}" if named else "is the file cut off?"
    raise InputError(wrong + ("is it a cloud?" if whole and not named else remedy))


def find_layout(data: bytes, columns: Sequence[str] = ()) -> Layout:
    """The layout of a .bin file's content: of these columns, or the plainest; four float32 in doubt."""
    given = Layout(tuple(columns) or FOUR.names)
    whole = len(data) % given.size == 0
    own = fit(data, given) if whole else Fit(False, False, np.inf, 0.0)
    if own.is_smooth or (whole and len(data) < given.size * FEWEST_ROWS and not columns):
        return given
    if columns:
        fitting = possible_layouts(data, columns)
        return fitting[0] if fitting else given
    plain = []
    for other in possible_layouts(data):
        seen = fit(data, other)
        # eight numbers may be two points of four
        signed = seen.never_negative and not own.never_negative and len(other.names) < 8
        smooth = seen.is_smooth and (not own.possible or seen.step < SMOOTHER * own.step)
        if (signed or smooth) and len(data) >= other.size * FEWEST_ROWS:
            plain.append((seen.step, other))
    return min(plain)[1] if plain else given


def possible_layouts(data: bytes, columns: Sequence[str] = ()) -> list[Layout]:
    """The layouts in which the content is whole points with numbers such as coordinates have, of these columns or any.

    Those of the first type that has any: float32, then float64, then float16.
    """
    names = [tuple(columns)] if columns else [COUNTS[count] for count in (3, 4, 5, 6, 7, 8)]
    for dtype in TYPES:
        layouts = [Layout(each, dtype) for each in names] if data else []
        fitting = [each for each in layouts if len(data) % each.size == 0 and fit(data, each).possible]
        if fitting:
            return fitting
    return []


def fit(data: bytes, layout: Layout) -> Fit:
    """How well a layout fits the points of a file: all of them or, if they are many, four runs of them."""
    every = np.frombuffer(data, dtype=layout.dtype).reshape(-1, len(layout.names))
    starts = np.linspace(0, len(every) - SAMPLED_ROWS // 4, 4).astype(int) if len(every) > SAMPLED_ROWS else [0]
    length = SAMPLED_ROWS // 4 if len(every) > SAMPLED_ROWS else SAMPLED_ROWS
    xyz = [layout.names.index(axis) for axis in "xyz"]
    runs, steps = [], [np.empty(0)]
    with np.errstate(all="ignore"):
        for start in starts:
            rows = every[start : start + length].astype(np.float64)
            rows = rows[np.isfinite(rows[:, xyz]).all(axis=1) & (rows[:, xyz] != 0).any(axis=1)]  # 0, 0, 0: no echo
            runs.append(rows)
            steps.append(np.abs(np.diff(rows[:, xyz], axis=0)).sum(axis=1))
        rows = np.concatenate(runs)
        if len(rows) < 2:
            return Fit(True, False, np.inf, 0.0)
        size = np.abs(rows[:, [*xyz, *(k for k, name in enumerate(layout.names) if name == "i")]])
        possible = np.mean((size == 0) | ((size > 1e-7) & (size < LARGEST[layout.dtype])) | np.isnan(size)) > 0.99
        if layout.dtype == "<f4":  # the lower halves of float64 with few digits are zero
            zero = np.frombuffer(data, "<f4", len(data) // 8 * 2)[: 4 * SAMPLED_ROWS].reshape(-1, 2) == 0
            possible &= np.mean(zero[:, 0]) - np.mean(zero[:, 1]) < 0.4
        half = len(rows) // 2
        spread = np.median(np.abs(rows[:half, xyz] - rows[half : 2 * half, xyz]).sum(axis=1))
        signed = False
        if "i" in layout.names:
            negative = np.mean(rows[:, layout.names.index("i")] < 0)
            signed = bool(possible and negative < FEW_NEGATIVE and np.mean(rows[:, xyz] < 0) > 0.05)
        return Fit(bool(possible), signed, float(np.median(np.concatenate(steps))), float(spread))
