"""The ground-truth database of SECOND (Yan et al., 2018): the points of every labelled object, for other frames.

One compressed .npz file holds the objects of a split, in the order of its frames and of their label files. Points are
kept in millimetres around the box's centre, the LiDAR's own resolution: seven bytes a point, and exact.
"""

import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from hvnet import ranks
from hvnet.boxes import points_in_boxes
from hvnet.data.frame import Frames
from hvnet.data.kitti import KittiFrames, boxes_to_labels
from hvnet.data.labels import DONTCARE
from hvnet.exceptions import InputError

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
    frame: NDArray[np.int32]  # (K,) number of the frame
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


def build_database(frames: Frames, wanted: Sequence[int] | None = None) -> Database:
    """Cuts every labelled object out of these frames, or those of them that are wanted.

    An object's points are those in or on its box, of the whole cloud: a truncated one has points outside the image.
    The database keeps numbers of frames: their names in a KITTI root, whose database is a file, else their places.
    Raises InputError for a name in a KITTI root that is no number.
    """
    columns: dict[str, list[NDArray]] = {field.name: [] for field in fields(Database) if field.name != "offsets"}
    counts: list[int] = []
    for k in tqdm(range(len(frames)) if wanted is None else wanted, desc="objects", unit="frame"):
        name = frames.names[k]
        number = k
        if isinstance(frames, KittiFrames):
            if not name.isdecimal() or int(name) >= 2**31:
                raise InputError(f"frame '{name}': is no number below 2**31; the database keeps numbers")
            number = int(name)
        frame = frames[k]
        if frame.objects is None:
            raise InputError(f"frame {name}: has no labels to cut objects out")
        boxes, every = frame.objects.boxes, frame.objects.labels
        if every is None:
            every = boxes_to_labels(boxes.double().numpy(), frame.objects.names)
        rows = np.flatnonzero(every.name != DONTCARE)
        labels = every.select(rows)
        if frame.objects.labels is None:
            boxes = boxes[rows]
        centre_mm = (boxes[:, :3].double() * 1000).round()
        for row, centre, inside in zip(rows, centre_mm, points_in_boxes(frame.points, boxes).T, strict=True):
            points = frame.points[inside].double()
            xyz_mm = (points[:, :3] * 1000).round() - centre
            if len(points) and xyz_mm.abs().max() > np.iinfo(np.int16).max:
                raise InputError(f"frame {name}: the object of label row {row} is over 65 m long")
            if ((points[:, 3] < 0) | (points[:, 3] > 1)).any():
                what = f"the object of label row {row} has reflectances to {points[:, 3].abs().max():g}, want 0 to 1"
                raise InputError(f"frame {name}: {what}; divide the clouds' by their scale, such as 255")
            columns["xyz_mm"].append(xyz_mm.T.numpy())
            columns["reflectance"].append((points[:, 3] * 100).round().numpy())
            counts.append(len(points))
        columns["centre_mm"].append(centre_mm.numpy())
        columns["box"].append(boxes.numpy())
        columns["name"].append(labels.name)
        columns["frame"].append(np.full(len(rows), number))
        columns["label_row"].append(rows)
        columns["truncation"].append(labels.truncation)
        columns["occlusion"].append(labels.occlusion)
        columns["bbox_height"].append(labels.bbox[:, 3] - labels.bbox[:, 1])
    if not counts:
        raise InputError(f"no object is labelled in the {len(frames)} frames")
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


def load_database(
    root: Path, train_ids: Sequence[str], val_ids: Sequence[str], say: Callable[..., None] = print
) -> Database:
    """The database of a KITTI root without objects of validation frames.

    Where there is none it is built of the training frames, by the first rank, and kept in the root if that can be
    written.
    """
    path = root / FILE_NAME
    built = None
    if ranks.rank() == 0 and not path.is_file():
        built = build_database(KittiFrames(root, train_ids, crop=False))
        try:
            write_database(path, built)
        except OSError as error:
            say(f"{path}: not kept ({error.strerror}); it will be built again")
    built = ranks.broadcast(built)
    database = built if built is not None else read_database(path)
    leaked = np.isin(database.frame, [int(name) for name in val_ids if name.isdecimal()])
    if leaked.any():
        say(f"{path}: {int(leaked.sum())} objects of validation frames are left out")
        database = database.select(~leaked)
    return database
