"""Users' own point clouds: .bin (KITTI), .npy, .pcd and .ply files as (N, 4) float32."""

import struct
import tokenize
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError
from pypcd4 import PointCloud

from hvnet.data.kitti import drop_non_finite, read_points
from hvnet.exceptions import InputError

SUFFIXES = (".bin", ".npy", ".pcd", ".ply")
REFLECTANCE = ("reflectance", "intensity", "reflectivity", "i", "scalar_intensity")
"""Names that other tools give to the reflectance."""


def read_cloud(path: Path) -> tuple[NDArray[np.float32], list[str]]:
    """Points (N, 4) x, y, z in metres and reflectance in [0, 1] of a file, and notes on what was changed while reading.

    A file without reflectance gets 0, one that counts it beyond 1 is divided by 255 or, if that is too little, by
    65535; points that are not finite are dropped. Raises InputError naming the file.
    """
    if path.suffix == ".bin":
        points = read_points(path)
    elif path.suffix == ".npy":
        points = _read_npy(path)
    elif path.suffix in (".pcd", ".ply"):
        points = _join(_read_fields(path), path)
    else:
        raise InputError(f"{path}: unknown kind of file; known: {', '.join(SUFFIXES)}")
    points, dropped = drop_non_finite(points)
    notes = [f"{path}: {dropped} points that are not finite were dropped"] if dropped else []
    if points.shape[1] == 3:
        points = np.concatenate((points, np.zeros_like(points[:, :1])), axis=1)
        notes.append(f"{path}: has no reflectance; 0 is used, which makes detection worse")
    highest = float(points[:, 3].max(initial=0))
    if highest > 1:
        scale = next((full for full in (255.0, 65535.0) if highest <= full), highest)  # 8 bits, 16 bits, else unknown
        points[:, 3] /= scale
        notes.append(f"{path}: reflectance up to {highest:g} was divided by {scale:g}")
    return points, notes


def _read_npy(path: Path) -> NDArray[np.float32]:
    try:
        with path.open("rb") as file:  # np.load would also accept other formats
            points = np.lib.format.read_array(file, allow_pickle=False)
    except (OSError, ValueError, MemoryError, tokenize.TokenError) as error:
        raise InputError(f"{path}: cannot be read as .npy ({error}); save it with numpy.save") from error
    if points.ndim != 2 or points.shape[1] < 3 or points.dtype.kind not in "fiu":
        raise InputError(f"{path}: want numbers (N, 3) or (N, 4), got {points.dtype} {points.shape}")
    return points[:, :4].astype(np.float32)


def _read_fields(path: Path) -> dict[str, NDArray]:
    """The columns of a .pcd or .ply file by name."""
    try:
        if path.suffix == ".pcd":
            cloud = PointCloud.from_path(path)
            return {name: cloud.pc_data[name].reshape(-1) for name in cloud.fields}
        vertices = PlyData.read(str(path))["vertex"]
        return {field.name: np.asarray(vertices[field.name]) for field in vertices.properties}
    except (OSError, ValueError, KeyError, IndexError, RuntimeError, struct.error, PlyParseError) as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path}: cannot be read as {path.suffix} ({what}); write it again or convert it") from error


def _join(fields: Mapping[str, NDArray], path: Path) -> NDArray[np.float32]:
    missing = [name for name in ("x", "y", "z") if name not in fields]
    if missing:
        raise InputError(f"{path}: has no field {missing[0]}; its fields are {', '.join(fields)}")
    names = ["x", "y", "z", *[name for name in fields if name.lower() in REFLECTANCE][:1]]
    return np.stack([np.asarray(fields[name], dtype=np.float32) for name in names], axis=1)
