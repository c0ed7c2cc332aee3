"""The ground-truth database of SECOND (Yan et al., 2018): the points of every labelled object, for other frames.

One compressed .npz file holds the objects of a split, in the order of its frames and of their label files, and the
stamps of these frames. Points are kept in millimetres around the box's centre: that is the resolution of KITTI's
LiDAR, and the points of others are rounded to it. Reflectances and names of frames are kept as they are.
"""

import os
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from hvnet import ranks
from hvnet.boxes import indices_in_boxes
from hvnet.config import DataConfig
from hvnet.data.frame import Frames, frame_at
from hvnet.data.kitti import KittiFrames, box_rows
from hvnet.data.labels import DONTCARE
from hvnet.data.sensor import TOLERANCE, reflectance_error
from hvnet.data.stamps import Stamps, describe_changes, find_changes, take_stamps
from hvnet.exceptions import InputError

FILE_NAME = "gt_database.npz"
REMEDY = "remove it, or build it again with python -m hvnet.data.database"


@dataclass(frozen=True)
class Database:
    """K objects of M points in all, LiDAR axes (x forward, y left, z up)."""

    xyz_mm: NDArray[np.int16]  # (3, M) millimetres from `centre_mm`
    reflectance: NDArray[np.float32]  # (M,) in [0, 1]
    offsets: NDArray[np.int64]  # (K + 1,) object k has the points offsets[k]:offsets[k + 1]
    centre_mm: NDArray[np.int32]  # (K, 3) centre of the box, millimetres
    box: NDArray[np.float32]  # (K, 7) x, y, z of the centre, length, width, height, yaw
    name: NDArray[np.str_]  # (K,) KITTI class
    frame: NDArray[np.str_]  # (K,) name of the frame
    label_row: NDArray[np.int16]  # (K,) row of the frame's label file
    truncation: NDArray[np.float32]  # (K,) as in the label file
    occlusion: NDArray[np.int8]  # (K,) as in the label file
    bbox_height: NDArray[np.float32]  # (K,) height of the 2D box, pixels
    stamps: Stamps | None = None  # of the frames that it was built from; None if their format has none

    def __len__(self) -> int:
        return len(self.name)

    def select(self, objects: NDArray[np.bool_]) -> "Database":
        """The objects (K,) that are marked, and their points."""
        lengths = np.diff(self.offsets)
        points = np.repeat(objects, lengths)
        rows = {name: getattr(self, name)[objects] for name, (shape, _) in LAYOUT.items() if shape[0] == "K"}
        offsets = np.concatenate((np.zeros(1, np.int64), np.cumsum(lengths[objects])))
        return Database(self.xyz_mm[:, points], self.reflectance[points], offsets, **rows, stamps=self.stamps)


# K objects, M points, F frames; the length of a name is free
LAYOUT = {
    "xyz_mm": ((3, "M"), "i2"),
    "reflectance": (("M",), "f4"),
    "offsets": (("K + 1",), "i8"),
    "centre_mm": (("K", 3), "i4"),
    "box": (("K", 7), "f4"),
    "name": (("K",), "U"),
    "frame": (("K",), "U"),
    "label_row": (("K",), "i2"),
    "truncation": (("K",), "f4"),
    "occlusion": (("K",), "i1"),
    "bbox_height": (("K",), "f4"),
}
STAMPS_LAYOUT = {"stamped": (("F",), "U"), "stamps": (("F", 4), "i8")}
"""The names and the numbers of the stamps, which files of earlier versions have not."""


def object_points(database: Database) -> Tensor:
    """Points (M, 4) float32 of all objects, where they were seen: x, y, z in metres, reflectance in [0, 1].

    Object k has the rows offsets[k]:offsets[k + 1].
    """
    lengths = np.diff(database.offsets)
    points = np.empty((len(database.reflectance), 4), np.float32)
    for axis in range(3):
        points[:, axis] = (database.xyz_mm[axis] + np.repeat(database.centre_mm[:, axis], lengths)) / 1000
    points[:, 3] = database.reflectance
    return torch.from_numpy(points)


def build_database(frames: Frames, wanted: Sequence[int] | None = None) -> Database:
    """Cuts every labelled object out of these frames, or those of them that are wanted.

    An object's points are those in or on its box, of the whole cloud: a truncated one has points outside the image.
    Raises InputError for a frame without labels, and where no object is labelled.
    """
    columns: dict[str, list[NDArray]] = {name: [] for name in LAYOUT if name != "offsets"}
    counts: list[int] = []
    stamps = take_stamps(frames, wanted)  # before a frame is read: a change from now on shows
    for k in tqdm(range(len(frames)) if wanted is None else wanted, desc="objects", unit="frame"):
        name = frames.names[k]
        frame = frame_at(frames, k)
        if frame.objects is None:
            raise InputError(f"frame {name}: has no labels to cut objects out")
        if len(frame.points) and (highest := float(frame.points[:, 3].amax())) > 1 + TOLERANCE:
            raise InputError(f"frame {name}: {reflectance_error(highest)}")
        boxes, every = frame.objects.boxes, frame.objects.labels
        if every is None:
            every = box_rows(boxes.double().numpy(), frame.objects.names)
        rows = np.flatnonzero(every.name != DONTCARE)
        labels = every.select(rows)
        if frame.objects.labels is None:
            boxes = boxes[rows]
        centre_mm = (boxes[:, :3].double() * 1000).round()
        for row, centre, inside in zip(rows, centre_mm, indices_in_boxes(frame.points, boxes), strict=True):
            points = frame.points[inside]
            xyz_mm = (points[:, :3].double() * 1000).round() - centre
            if len(points) and xyz_mm.abs().max() > np.iinfo(np.int16).max:
                raise InputError(f"frame {name}: the object of label row {row} is over 65 m long")
            columns["xyz_mm"].append(xyz_mm.T.numpy())
            columns["reflectance"].append(points[:, 3].numpy())
            counts.append(len(points))
        columns["centre_mm"].append(centre_mm.numpy())
        columns["box"].append(boxes.numpy())
        columns["name"].append(labels.name)
        columns["frame"].append(np.full(len(rows), name))
        columns["label_row"].append(rows)
        columns["truncation"].append(labels.truncation)
        columns["occlusion"].append(labels.occlusion)
        columns["bbox_height"].append(labels.bbox[:, 3] - labels.bbox[:, 1])
    if not counts:
        raise InputError(f"no object is labelled in the {len(frames)} frames")
    arrays = {name: np.concatenate(parts, axis=-1 if name == "xyz_mm" else 0) for name, parts in columns.items()}
    arrays["offsets"] = np.cumsum([0, *counts])
    return Database(**{name: array.astype(LAYOUT[name][1]) for name, array in arrays.items()}, stamps=stamps)


def write_database(path: Path, database: Database) -> None:
    """Writes the database; the file is whole or not there at all (OSError if it cannot be written)."""
    path = Path(path)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    arrays = {name: getattr(database, name) for name in LAYOUT}
    if database.stamps is not None:
        arrays |= {"stamped": np.array(database.stamps.names, np.str_), "stamps": database.stamps.numbers}
    try:
        with partial.open("wb") as file:
            np.savez_compressed(file, **arrays)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_database(path: Path) -> Database:
    """Reads a database and checks that its arrays fit together.

    Files of earlier versions, in which frames are numbers, reflectances whole per cent, and nothing is stamped, are
    converted: frame 7 is 000007, as KITTI names it.
    """
    path = Path(path)
    remedy = "build it with python -m hvnet.data.database --data KITTI_ROOT"
    if not path.is_file():
        raise InputError(f"{path}: no such file; {remedy}")
    try:
        with zipfile.ZipFile(path):  # np.load takes other files too, and guesses what they are
            pass
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in LAYOUT | STAMPS_LAYOUT if name in archive}
    except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: not a whole .npz file ({error}); {remedy}") from error
    layout = LAYOUT | (STAMPS_LAYOUT if STAMPS_LAYOUT.keys() & arrays.keys() else {})
    missing = [name for name in layout if name not in arrays]
    if missing:
        raise InputError(f"{path}: has no array '{missing[0]}'; {remedy}")
    if arrays["frame"].dtype == np.int32:
        arrays["frame"] = np.array([f"{number:06d}" for number in arrays["frame"].ravel().tolist()], np.str_)
    if arrays["reflectance"].dtype == np.uint8:
        arrays["reflectance"] = (arrays["reflectance"] / 100).astype(np.float32)
    sizes = {"K": arrays["name"].size, "K + 1": arrays["name"].size + 1, "M": arrays["reflectance"].size}
    sizes |= {"F": arrays["stamped"].size if "stamped" in arrays else 0}
    for name, (shape, kind) in layout.items():
        array = arrays[name]
        expected = tuple(sizes[size] if isinstance(size, str) else size for size in shape)
        if array.shape != expected:
            raise InputError(f"{path}: '{name}' has shape {array.shape}, expected {expected}")
        if array.dtype.kind != "U" if kind == "U" else array.dtype != np.dtype(kind):
            raise InputError(f"{path}: '{name}' is {array.dtype}, expected {'str' if kind == 'U' else np.dtype(kind)}")
    offsets = arrays["offsets"]
    if offsets[0] != 0 or offsets[-1] != sizes["M"] or (np.diff(offsets) < 0).any():
        raise InputError(f"{path}: 'offsets' does not rise from 0 to the number of points, {sizes['M']}")
    for name in ("box", "reflectance"):
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"{path}: '{name}' holds numbers that are not finite")
    stamps = Stamps(arrays["stamped"].tolist(), arrays["stamps"]) if "stamps" in arrays else None
    return Database(**{name: arrays[name] for name in LAYOUT}, stamps=stamps)


def load_database(
    root: Path,
    train_ids: Sequence[str],
    val_ids: Sequence[str],
    say: Callable[..., None] = print,
    reading: DataConfig | None = None,
) -> Database:
    """The database of a KITTI root without objects of validation frames.

    Where there is none it is built of the training frames and kept in the root if that can be written. It is built
    again if it was built of just these frames and their labels or clouds have changed since; one that was built of
    other frames stays, and what does not fit is said. Only the first rank looks at files.

    reading: how the training frames are read.
    """
    path = Path(root) / FILE_NAME
    current = None
    if ranks.rank() == 0:
        frames = KittiFrames(root, train_ids, crop=False, reading=reading)
        current = _read_current(path, frames, say) if path.is_file() else None
        if current is None:
            current = _build_and_keep(path, frames, say)
    database: Database = ranks.broadcast(current)
    names = set(val_ids)
    if database.stamps is None:  # a file of an earlier version kept numbers
        names |= {f"{int(name):06d}" for name in val_ids if name.isdecimal()}
    leaked = np.array([name in names for name in database.frame.tolist()], np.bool_)
    if leaked.any():
        say(f"{path}: {int(leaked.sum())} objects of validation frames are left out")
        database = database.select(~leaked)
    return database


def _read_current(path: Path, frames: KittiFrames, say: Callable[..., None]) -> Database | None:
    """The database in a file, None if these frames, which it was built of, have changed since."""
    database = read_database(path)
    if database.stamps is None:  # of an earlier version: nothing is known of its frames
        return database
    now = take_stamps(frames, known=database.stamps)
    assert now is not None
    changes = find_changes(database.stamps, now)
    known = set(database.stamps.names)
    if changes and known == set(frames.names):
        say(f"{path}: is built again, as {describe_changes(changes)}")
        return None
    if changes:
        say(f"{path}: since it was built, {describe_changes(changes)}; {REMEDY}")
    unknown = [name for name in frames.names if name not in known]
    if unknown:
        count = f"{len(unknown)} of the {len(frames)} training frames"
        say(f"{path}: was built without {count}, such as {unknown[0]}; {REMEDY}")
    return database


def _build_and_keep(path: Path, frames: KittiFrames, say: Callable[..., None]) -> Database:
    database = build_database(frames)
    try:
        write_database(path, database)
    except OSError as error:
        say(f"{path}: not kept ({error.strerror}); it will be built again")
    return database
