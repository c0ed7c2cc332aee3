"""The ground-truth database of SECOND (Yan et al., 2018): the points of every labelled object, for other frames.

    python -m hvnet.data.database --data KITTI_ROOT

One compressed .npz file holds the objects of a split, in the order of its frames and of their label files. Points are
kept in millimetres around the box's centre, the LiDAR's own resolution: seven bytes a point, and exact.
"""

import os
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from hvnet.boxes import points_in_boxes
from hvnet.cli import InputError, make_parser, run_command
from hvnet.data.kitti import read_frame, read_split

FILE_NAME = "gt_database.npz"


@dataclass(frozen=True)
class Database:
    """K objects of M points in all, LiDAR axes (x forward, y left, z up)."""

    xyz_mm: NDArray[np.int16]  # (3, M) millimetres from `centre_mm`
    reflectance: NDArray[np.uint8]  # (M,) per cent
    offsets: NDArray[np.int64]  # (K + 1,) object k has the points offsets[k]:offsets[k + 1]
    centre_mm: NDArray[np.int32]  # (K, 3) centre of the box, millimetres
    box: NDArray[np.float32]  # (K, 7) x, y, z of the centre, length, width, height, yaw
    name: NDArray[np.str_]  # (K,) KITTI class
    frame: NDArray[np.int32]  # (K,) frame id
    label_row: NDArray[np.int16]  # (K,) row of the frame's label file
    truncation: NDArray[np.float32]  # (K,) as in the label file
    occlusion: NDArray[np.int8]  # (K,) as in the label file
    bbox_height: NDArray[np.float32]  # (K,) height of the 2D box, pixels

    def __len__(self) -> int:
        return len(self.name)

    def select(self, objects: NDArray[np.bool_]) -> "Database":
        """The objects (K,) that are marked, and their points."""
        lengths = np.diff(self.offsets)
        points = np.repeat(objects, lengths)
        rows = {name: getattr(self, name)[objects] for name, (shape, _) in LAYOUT.items() if shape[0] == "K"}
        offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(lengths[objects])))
        return Database(self.xyz_mm[:, points], self.reflectance[points], offsets, **rows)


# K objects, M points; the length of a name is free
LAYOUT = {
    "xyz_mm": ((3, "M"), "i2"),
    "reflectance": (("M",), "u1"),
    "offsets": (("K + 1",), "i8"),
    "centre_mm": (("K", 3), "i4"),
    "box": (("K", 7), "f4"),
    "name": (("K",), "U"),
    "frame": (("K",), "i4"),
    "label_row": (("K",), "i2"),
    "truncation": (("K",), "f4"),
    "occlusion": (("K",), "i1"),
    "bbox_height": (("K",), "f4"),
}


def object_points(database: Database) -> Tensor:
    """Points (M, 4) float32 of all objects, where they were seen: x, y, z in metres, reflectance in [0, 1].

    Object k has the rows offsets[k]:offsets[k + 1].
    """
    lengths = np.diff(database.offsets)
    points = np.empty((len(database.reflectance), 4), np.float32)
    for axis in range(3):
        points[:, axis] = (database.xyz_mm[axis] + np.repeat(database.centre_mm[:, axis], lengths)) / 1000
    points[:, 3] = database.reflectance / 100
    return torch.from_numpy(points)


def build_database(root: Path, names: Sequence[str]) -> Database:
    """Cuts every labelled object out of these frames of a KITTI root.

    An object's points are those in or on its box, of the whole cloud: a truncated one has points beside the image.
    """
    columns: dict[str, list[NDArray]] = {field.name: [] for field in fields(Database) if field.name != "offsets"}
    counts: list[int] = []
    for frame_id in tqdm(names, desc="objects", unit="frame"):
        if not frame_id.isdecimal():
            raise InputError(f"{root}: frame '{frame_id}' is no number; the database keeps numbers")
        frame = read_frame(root, frame_id, crop=False)
        rows = np.flatnonzero(frame.labels.name != "DontCare")
        labels = frame.labels.select(rows)
        centre_mm = (frame.boxes[:, :3].double() * 1000).round()
        for row, centre, inside in zip(rows, centre_mm, points_in_boxes(frame.points, frame.boxes).T, strict=True):
            points = frame.points[inside].double()
            xyz_mm = (points[:, :3] * 1000).round() - centre
            if len(points) and xyz_mm.abs().max() > np.iinfo(np.int16).max:
                raise InputError(f"frame {frame_id} of {root}: the object of label row {row} is over 65 m long")
            if ((points[:, 3] < 0) | (points[:, 3] > 1)).any():
                what = f"the object of label row {row} has reflectances to {points[:, 3].abs().max():g}, want 0 to 1"
                raise InputError(f"frame {frame_id} of {root}: {what}; divide the clouds' by their scale, such as 255")
            columns["xyz_mm"].append(xyz_mm.T.numpy())
            columns["reflectance"].append((points[:, 3] * 100).round().numpy())
            counts.append(len(points))
        columns["centre_mm"].append(centre_mm.numpy())
        columns["box"].append(frame.boxes.numpy())
        columns["name"].append(labels.name)
        columns["frame"].append(np.full(len(rows), int(frame_id)))
        columns["label_row"].append(rows)
        columns["truncation"].append(labels.truncation)
        columns["occlusion"].append(labels.occlusion)
        columns["bbox_height"].append(labels.bbox[:, 3] - labels.bbox[:, 1])
    if not counts:
        raise InputError(f"{root}: no object is labelled in its {len(names)} frames")
    arrays = {name: np.concatenate(parts, axis=-1 if name == "xyz_mm" else 0) for name, parts in columns.items()}
    arrays["offsets"] = np.cumsum([0, *counts])
    return Database(**{name: array.astype(LAYOUT[name][1]) for name, array in arrays.items()})


def write_database(path: Path, database: Database) -> None:
    """Writes the database; the file is whole or not there at all (OSError if it cannot be written)."""
    path = Path(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            np.savez_compressed(file, **{name: getattr(database, name) for name in LAYOUT})
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_database(path: Path) -> Database:
    """Reads a database and checks that its arrays fit together."""
    path = Path(path)
    remedy = "build it with python -m hvnet.data.database --data KITTI_ROOT"
    if not path.is_file():
        raise InputError(f"{path}: no such file; {remedy}")
    try:
        with zipfile.ZipFile(path):  # np.load takes other files too, and guesses what they are
            pass
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in LAYOUT if name in archive}
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a whole .npz file ({error}); {remedy}") from error
    missing = [name for name in LAYOUT if name not in arrays]
    if missing:
        raise InputError(f"{path}: has no array '{missing[0]}'; {remedy}")
    sizes = {"K": arrays["name"].size, "K + 1": arrays["name"].size + 1, "M": arrays["reflectance"].size}
    for name, (shape, kind) in LAYOUT.items():
        array = arrays[name]
        expected = tuple(sizes[size] if isinstance(size, str) else size for size in shape)
        if array.shape != expected:
            raise InputError(f"{path}: '{name}' has shape {array.shape}, expected {expected}")
        if array.dtype.kind != "U" if kind == "U" else array.dtype != np.dtype(kind):
            raise InputError(f"{path}: '{name}' is {array.dtype}, expected {'str' if kind == 'U' else np.dtype(kind)}")
    offsets = arrays["offsets"]
    if offsets[0] != 0 or offsets[-1] != sizes["M"] or (np.diff(offsets) < 0).any():
        raise InputError(f"{path}: 'offsets' does not rise from 0 to the number of points, {sizes['M']}")
    if not np.isfinite(arrays["box"]).all():
        raise InputError(f"{path}: 'box' holds numbers that are not finite")
    return Database(**arrays)


def main(arguments: Sequence[str] | None = None) -> None:
    """Builds the database of a split and writes it."""
    parser = make_parser(
        "data.database",
        "Cuts every labelled object out of a KITTI split: the ground-truth database for augmentation. Training builds "
        "it by itself where the root holds none.",
        ["--data /data/kitti", "--data /data/kitti --split trainval --out trainval.npz"],
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="a KITTI root")
    parser.add_argument("--split", default="train", metavar="NAME", help="of the list in ImageSets (default: train)")
    parser.add_argument("--out", type=Path, metavar="FILE", help=f"(default: {FILE_NAME} in the KITTI root)")
    options = parser.parse_args(arguments)
    out: Path = options.out or options.data / FILE_NAME
    if out.exists():
        raise InputError(f"{out}: exists already; remove it or name another file with --out")
    if not os.access(out.parent, os.W_OK):  # known before the minutes of work, not after
        raise InputError(f"{out.parent}: no folder that can be written to; name a file elsewhere with --out")
    database = build_database(options.data, read_split(options.data, options.split))
    try:
        write_database(out, database)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    print(f"{out}: {len(database)} objects, {len(database.reflectance)} points")
    for name, count in zip(*np.unique(database.name, return_counts=True), strict=True):
        print(f"{count:8d} {name}")


if __name__ == "__main__":
    run_command(main)
