"""The rows of KITTI's label and result files, which its evaluation compares."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvnet.exceptions import InputError

Floats = NDArray[np.float64]

DONTCARE = "DontCare"
"""The class of a region of the image where nothing is labelled."""


@dataclass(frozen=True)
class Labels:
    """K objects of one label or result file, as in the file: camera axes, metres, pixels, radians."""

    name: NDArray[np.str_]  # (K,)
    truncation: Floats  # (K,) 0 to 1, the share outside the image; -1 unknown
    occlusion: NDArray[np.int64]  # (K,) 0 visible, 1 partly, 2 largely occluded, 3 unknown; -1 in result files
    alpha: Floats  # (K,) observation angle
    bbox: Floats  # (K, 4) left, top, right, bottom
    dimensions: Floats  # (K, 3) height, width, length
    location: Floats  # (K, 3) centre of the bottom
    rotation_y: Floats  # (K,)
    score: Floats | None = None  # (K,) only in result files

    def __len__(self) -> int:
        return len(self.name)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> "Labels":
        """The rows that a mask or an index array picks."""
        columns: dict[str, Any] = {}
        for field in fields(self):
            column = getattr(self, field.name)
            columns[field.name] = None if column is None else column[rows]
        return Labels(**columns)

    def bev_boxes(self) -> Floats:
        """Boxes (K, 7) in upright axes of their own, for overlaps alone: z counts down from the camera's height."""
        height, width, length = self.dimensions.T
        x, y, z = self.location.T  # y points down, hence the minus of the angle
        return np.column_stack((x, z, y - height / 2, length, width, height, -self.rotation_y))

    def vertical(self) -> tuple[Floats, Floats]:
        """Top and bottom (K,) of the boxes, counted downwards."""
        bottom = self.location[:, 1]
        return bottom - self.dimensions[:, 0], bottom

    def has_2d(self) -> NDArray[np.bool_]:
        """Which have a 2D box (K,): one with an area."""
        return (self.bbox[:, 2] > self.bbox[:, 0]) & (self.bbox[:, 3] > self.bbox[:, 1])

    def has_3d(self) -> NDArray[np.bool_]:
        """Which have a 3D box (K,): one with a volume, at a place that is not -1000, KITTI's unknown."""
        return (self.location != -1000).all(axis=1) & (self.dimensions > 0).all(axis=1)

    def ground_distance(self) -> Floats:
        """Distance (K,) from the camera on the ground, in metres; inf without a 3D box."""
        return np.where(self.has_3d(), np.hypot(self.location[:, 0], self.location[:, 2]), np.inf)


def concatenate(parts: Sequence[Labels]) -> Labels:
    """The rows of all parts; scores only if all have them."""
    columns: dict[str, Any] = {}
    for field in fields(Labels):
        arrays = [getattr(part, field.name) for part in parts]
        columns[field.name] = None if any(array is None for array in arrays) else np.concatenate(arrays)
    return Labels(**columns)


def no_results() -> Labels:
    """The rows of a result file in which nothing is found."""
    none = np.empty(0)
    whole = np.empty(0, np.int64)
    three = np.empty((0, 3))
    return Labels(np.empty(0, np.str_), none, whole, none, np.empty((0, 4)), three, three, none, score=none)


def count_others(names: Iterable[str], classes: Iterable[str]) -> str:
    """How many names are neither of these classes nor DontCare, such as "91 Van, 14 Truck"; empty if none.

    names: one per object, or a Counter of them.
    """
    known = {*classes, DONTCARE}
    return ", ".join(f"{count} {name}" for name, count in Counter(names).most_common() if name not in known)


def class_map(texts: Sequence[str]) -> dict[str, str]:
    """The classes that other names count as, of texts such as "bicycle=Cyclist"; several may stand in one, with commas.

    Raises InputError for anything else, for DontCare, and for a name given twice.
    """
    classes: dict[str, str] = {}
    for text in (part for each in texts for part in each.split(",")):
        name, _, meant = text.partition("=")
        if name.split() != [name] or meant.split() != [meant] or "=" in meant:
            raise InputError(f"--classes {text}: want NAME=CLASS, such as bicycle=Cyclist")
        if DONTCARE in (name, meant):
            raise InputError(f"--classes {text}: {DONTCARE} is a region of the image, no class")
        if name in classes:
            raise InputError(f"--classes {text}: {name} is given twice; leave one out")
        classes[name] = meant
    return classes


def rename(labels: Labels, classes: Mapping[str, str]) -> Labels:
    """The labels, with the names in `classes` replaced by the class that they count as."""
    if not classes:
        return labels
    return replace(labels, name=np.array([classes.get(name, name) for name in labels.name.tolist()], dtype=np.str_))
