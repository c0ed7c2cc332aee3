"""Files of point clouds: .bin (KITTI and others), .npy, .pcd and .ply, as (N, 4) float32."""

import struct
import textwrap
import tokenize
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError

from hvnet.config import DataConfig
from hvnet.data.columns import COUNTS, FOUR, is_reflectance, read_numbers
from hvnet.data.pcd import read_pcd
from hvnet.data.sensor import (
    Floats,
    Reflectance,
    dropped_note,
    full_scale,
    has_reflectance,
    highest_reflectance,
    judge_reflectance,
)
from hvnet.exceptions import InputError

SUFFIXES = (".bin", ".npy", ".pcd", ".ply")
SAMPLED_FILES = 16
"""Files of a call or a root that tell the scale of the reflectance."""
SAMPLED_POINTS = 20_000
"""... and points of each."""
NO_ECHO = 10
"""From so many points at 0, 0, 0 on they are beams without an echo."""


class RawCloud(NamedTuple):
    """What a file holds, as it is."""

    xyz: Floats  # (N, 3) metres
    reflectance: Floats | None  # (N,) at the scale of the sensor; None if there is none
    columns: str  # what its numbers are; files of one sensor have the same
    note: str = ""  # what a user should know of how it was read


class Cloud(NamedTuple):
    """The points of a file."""

    points: Floats  # (N, 4) x, y, z in metres, finite; reflectance in [0, 1]
    reflectance: Reflectance
    notes: list[str]  # on points that were dropped


def is_cloud(path: Path) -> bool:
    """Whether a file has the suffix of a cloud, in any case."""
    return path.suffix.lower() in SUFFIXES


def read_cloud(path: Path, reading: DataConfig | None = None) -> tuple[Floats, list[str]]:
    """Points (N, 4) x, y, z in metres and reflectance in [0, 1] of a file, and notes on what was changed while reading.

    A file without reflectance gets 0, one that counts it beyond 1 is divided by 255 or, if that is too little, by
    65535; points that are not finite are dropped. Raises InputError naming the file.
    """
    raw = read_raw(path, () if reading is None else reading.columns)
    cloud = judge(raw, find_scale([raw], reading))
    note = cloud.reflectance.note.replace("reflectance was", f"reflectance up to {cloud.reflectance.highest:g} was")
    notes = cloud.notes + [text for text in (raw.note, note) if text]
    return cloud.points, [f"{path}: {note}" for note in notes]


def read_raw(path: Path, columns: Sequence[str] = ()) -> RawCloud:
    """What a file holds; `columns` name the numbers of a .bin or .npy, else they are found out.

    Raises InputError naming the file.
    """
    suffix = path.suffix.lower()
    if suffix == ".bin":
        rows, layout = read_numbers(_read_bytes(path), path, columns)
        note = ""
        if layout.dtype != FOUR.dtype if columns else layout != FOUR:
            note = f"read as {layout}: {', '.join(layout.names)}" + "; --columns says otherwise" * (not columns)
        return _raw({name: rows[:, k] for k, name in enumerate(layout.names) if name != "_"}, str(layout), note)
    if suffix == ".npy":
        return _read_npy(path, columns)
    if suffix in (".pcd", ".ply"):
        return _pick(read_pcd(path) if suffix == ".pcd" else _read_ply(path), path)
    raise InputError(f"{path}: unknown kind of file; known: {', '.join(SUFFIXES)}")


def find_scale(clouds: Sequence[RawCloud], reading: DataConfig | None = None) -> float:
    """What the reflectance of these clouds of one sensor is to be divided by, unless the user says it."""
    if reading is not None and reading.reflectance_scale is not None:
        return reading.reflectance_scale
    values = [cloud.reflectance for cloud in clouds if cloud.reflectance is not None]
    values = [each[:: max(1, len(each) // SAMPLED_POINTS)] for each in values if has_reflectance(each)]
    return full_scale(highest_reflectance(np.concatenate(values))) if values else 1.0


def sensor_of(path: Path, raw: RawCloud) -> str:
    """What tells the sensor of a file: the folder, the kind of file and the columns."""
    return f"{path.parent}, {path.suffix.lower()}, {raw.columns}"


def find_scales(paths: Sequence[Path], reading: DataConfig) -> dict[str, float]:
    """The scale of every sensor among these files (`sensor_of`): one sensor has one scale, however dark a cloud is.

    Of many files some are looked at. A file that cannot be read tells nothing here: it is named when its turn comes.
    """
    step = max(1, len(paths) // SAMPLED_FILES)
    sensors: dict[str, list[RawCloud]] = {}
    for path in paths[::step]:
        try:
            raw = read_raw(path, reading.columns)
        except (InputError, OSError):
            continue
        sensors.setdefault(sensor_of(path, raw), []).append(raw)
    return {sensor: find_scale(clouds, reading) for sensor, clouds in sensors.items()}


def read_scaled(path: Path, reading: DataConfig, scales: Mapping[str, float]) -> tuple[RawCloud, Cloud]:
    """A file as it is, and its points at the scale of its sensor; the file's own where `scales` do not have it."""
    raw = read_raw(path, reading.columns)
    sensor = sensor_of(path, raw)
    return raw, judge(raw, scales[sensor] if sensor in scales else find_scale([raw], reading))


def judge(raw: RawCloud, scale: float) -> Cloud:
    """The points of a file, its reflectance divided by the scale. Points that are not finite are dropped.

    A reflectance that is NaN counts as none, and its point stays.
    """
    kept = np.asarray(np.isfinite(raw.xyz).all(axis=1))
    if raw.reflectance is not None:
        kept &= ~np.isinf(raw.reflectance)
    dropped = int(len(kept) - kept.sum())
    at_origin = (raw.xyz == 0).all(axis=1)
    no_echo = int(at_origin.sum()) if at_origin.sum() >= NO_ECHO else 0
    if no_echo:
        kept &= ~at_origin
    if dropped or no_echo:
        raw = raw._replace(xyz=raw.xyz[kept], reflectance=None if raw.reflectance is None else raw.reflectance[kept])
    reflectance = judge_reflectance(raw.reflectance, len(raw.xyz), scale)
    notes = [dropped_note(dropped)] if dropped else []
    notes += [f"{no_echo} points at 0, 0, 0, where no echo came back, were dropped"] if no_echo else []
    return Cloud(np.column_stack((raw.xyz, reflectance.values)), reflectance, notes)


def _read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def _read_npy(path: Path, columns: Sequence[str]) -> RawCloud:
    try:
        with path.open("rb") as file:  # np.load would also accept other formats
            rows = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, MemoryError, tokenize.TokenError) as error:
        raise InputError(f"{path}: cannot be read as .npy ({error}); save it with numpy.save") from error
    if rows.ndim != 2 or rows.shape[1] < 3 or rows.dtype.kind not in "fiu":
        raise InputError(f"{path}: want numbers (N, 3) or (N, 4), got {rows.dtype} {rows.shape}")
    count = rows.shape[1]
    if 3 <= rows.shape[0] <= 16 < count:
        raise InputError(f"{path}: is transposed, {rows.shape}; save its .T, which is {rows.shape[::-1]}")
    if columns and len(columns) != count:
        raise InputError(f"{path}: has {count} numbers a point, and --columns names {len(columns)}")
    names = columns or COUNTS[min(count, 4)]
    return _raw({name: rows[:, k] for k, name in enumerate(names) if name != "_"}, f"{count} numbers a point")


def _read_ply(path: Path) -> dict[str, NDArray]:
    """The columns of a .ply file by name."""
    try:
        vertices = PlyData.read(str(path))["vertex"]
        return {field.name: np.asarray(vertices[field.name]) for field in vertices.properties}
    except (OSError, ValueError, KeyError, IndexError, RuntimeError, struct.error, PlyParseError) as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: cannot be read as .ply ({what}); write it again or convert it") from error


def _pick(fields: Mapping[str, NDArray], path: Path) -> RawCloud:
    """The coordinates and the reflectance among the fields of a file."""
    lower = {name.lower(): name for name in reversed(list(fields))}
    missing = [axis for axis in "xyz" if axis not in lower]
    if missing:
        raise InputError(f"{path}: has no field {missing[0]}; its fields are {_listed(fields)}")
    chosen = {axis: fields[lower[axis]] for axis in "xyz"}
    named = [name for name in fields if is_reflectance(name)]
    if named:
        chosen["i"] = fields[named[0]]
    others = [name for name in fields if name.lower() not in ("x", "y", "z")]
    note = ""
    if not named and others:
        note = f"none of the fields {_listed(others)} has a name of the reflectance, such as intensity"
    return _raw(chosen, ", ".join(fields), note)


def _listed(names: Iterable[str]) -> str:
    """Names of fields, as many as a line holds."""
    return textwrap.shorten(", ".join(names), 200, placeholder=" ...")


def _raw(chosen: Mapping[str, NDArray], columns: str, note: str = "") -> RawCloud:
    with np.errstate(all="ignore"):  # numbers too large for float32 are infinite, and dropped
        xyz = np.stack([np.asarray(chosen[axis], dtype=np.float32) for axis in "xyz"], axis=1)
        reflectance = np.asarray(chosen["i"], dtype=np.float32) if "i" in chosen else None
    return RawCloud(xyz, reflectance, columns, note)
