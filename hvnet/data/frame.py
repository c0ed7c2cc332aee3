"""One frame of any sensor: its points, what is labelled in it, and the camera next to the LiDAR, if there is one.

Everything is in LiDAR axes: x forward, y left, z up, metres. Only `Camera` deals with pixels.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from hvnet.boxes import EDGES, box_corners
from hvnet.data.labels import Labels
from hvnet.data.sensor import as_points, dropped_note
from hvnet.exceptions import InputError

Floats = NDArray[np.float64]

IMAGE_SIZE = (1242, 375)
"""Width and height in pixels assumed for a camera without an image: those of most KITTI frames."""
IMAGE_ERRORS = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
"""What Pillow raises for files that are damaged or not images."""
NEAR = 0.1
"""Distance of the near plane in metres: nothing closer to the camera is projected."""


@dataclass(frozen=True)
class Camera:
    """A rectified camera and where it is, as KITTI's calib files have it, the size of its image and the image itself.

    The pixel of a LiDAR point is p2 (r0_rect velo_to_cam x), divided by its depth. Numbers so large that they overflow
    raise no warning: what they belong to is not visible.
    """

    p2: Floats  # (3, 4) rectified camera axes to pixels
    r0_rect: Floats  # (3, 3) camera 0 to rectified camera axes
    velo_to_cam: Floats  # (3, 4) LiDAR to camera 0
    size: tuple[int, int] = IMAGE_SIZE  # width, height in pixels
    image: Path | None = None  # file of the image

    def read_image(self) -> NDArray[np.uint8] | None:
        """The image (H, W, 3) in RGB, None where there is none. Raises InputError naming the file."""
        if self.image is None:
            return None
        try:
            with Image.open(self.image) as image:
                return np.asarray(image.convert("RGB"))
        except IMAGE_ERRORS as error:
            raise InputError(f"{self.image}: not an image, or cut off; replace or remove it") from error

    def _lidar_to_rectified(self) -> tuple[Floats, Floats]:
        return self.r0_rect @ self.velo_to_cam[:, :3], self.r0_rect @ self.velo_to_cam[:, 3]

    @np.errstate(all="ignore")
    def to_camera(self, xyz: NDArray[np.floating]) -> Floats:
        """Points (N, 3) in LiDAR axes to rectified camera axes (x right, y down, z forward): (N, 3)."""
        rotation, shift = self._lidar_to_rectified()
        return xyz @ rotation.T + shift

    @np.errstate(all="ignore")
    def to_lidar(self, xyz: NDArray[np.floating]) -> Floats:
        """Points (N, 3) in rectified camera axes to LiDAR axes (N, 3): the inverse of `to_camera`."""
        rotation, shift = self._lidar_to_rectified()
        # the printed rotations have seven digits: their transpose is not quite their inverse
        return (xyz - shift) @ np.linalg.inv(rotation).T

    @np.errstate(all="ignore")
    def homogeneous(self, xyz: NDArray[np.floating]) -> Floats:
        """Homogeneous pixels (N, 3) = (u * depth, v * depth, depth) of points (N, 3) in LiDAR axes."""
        rotation, shift = self._lidar_to_rectified()
        # coordinate by coordinate in memory, 7 times as fast as xyz @ matrix.T
        columns = (self.p2[:, :3] @ rotation) @ xyz.T.astype(np.float64)
        columns += (self.p2[:, :3] @ shift + self.p2[:, 3])[:, None]
        return columns.T

    @np.errstate(all="ignore")
    def project(self, xyz: NDArray[np.floating]) -> tuple[Floats, Floats]:
        """Pixels (N, 2) and depth (N,) in metres of points (N, 3) in LiDAR axes.

        The pixel of a point that is not in front of the camera (depth <= 0) means nothing.
        """
        projected = self.homogeneous(xyz)
        depth = projected[:, 2]
        return projected[:, :2] / depth[:, None], depth

    def sees(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Which of the points (N, 3 or more) in LiDAR axes are in front of the camera and inside the image: (N,)."""
        uv, depth = self.project(points[:, :3])
        u, v = uv.T
        in_front = (depth > 0) & (depth < np.inf)
        return in_front & (u >= 0) & (u < self.size[0]) & (v >= 0) & (v < self.size[1])

    @np.errstate(all="ignore")
    def project_boxes(self, boxes: NDArray[np.floating]) -> tuple[Floats, NDArray[np.bool_]]:
        """2D boxes (M, 4) = left, top, right, bottom of boxes (M, 7), clipped to the image, and which are visible (M,).

        The 2D box encloses the projection of the part of the box in front of the camera: its corners there, and the
        points where its edges pass the near plane. It is visible if some of the 2D box is in the image; otherwise it is
        zero.
        """
        corners = box_corners(torch.from_numpy(boxes.astype(np.float64))).numpy()
        corners = self.homogeneous(corners.reshape(-1, 3)).reshape(-1, 8, 3)
        begin, end = corners[:, EDGES[:, 0]], corners[:, EDGES[:, 1]]  # (M, 12, 3)
        crosses = (begin[..., 2] < NEAR) != (end[..., 2] < NEAR)
        share = np.where(crosses, NEAR - begin[..., 2], 0) / np.where(crosses, end[..., 2] - begin[..., 2], 1)
        outline = np.concatenate((corners, begin + share[..., None] * (end - begin)), axis=1)  # (M, 20, 3)
        front = np.concatenate((corners[..., 2] >= NEAR, crosses), axis=1)
        pixels = outline[..., :2] / np.where(front, outline[..., 2], 1)[..., None]
        least = np.where(front[..., None], pixels, np.inf).min(axis=1)
        most = np.where(front[..., None], pixels, -np.inf).max(axis=1)
        limit = np.array(self.size, dtype=np.float64) - 1
        visible = ((most > 0) & (least < limit)).all(axis=1)
        bbox = np.concatenate((least.clip(0, limit), most.clip(0, limit)), axis=1)
        return np.where(visible[:, None], bbox, 0), visible

    @np.errstate(all="ignore")
    def project_lines(self, begin: Floats, end: Floats) -> tuple[Floats, NDArray[np.bool_]]:
        """Pixels (K, 2, 2) of what the camera sees of lines from begin (S, 3) to end (S, 3), and which it sees (S,).

        The lines are cut at the near plane and at the image's borders (Liang and Barsky 1984), all five of which are
        planes through homogeneous pixels, before they are projected.
        """
        begin, end = self.homogeneous(begin), self.homogeneous(end)
        a, b = self._distances(begin), self._distances(end)  # (S, 5)
        share = a / (a - b)
        first = np.where((a < 0) & (b >= 0), share, 0).max(axis=1)[:, None]
        last = np.where((a >= 0) & (b < 0), share, 1).min(axis=1)[:, None]
        seen = ~((a < 0) & (b < 0)).any(axis=1) & (first < last)[:, 0]
        parts = np.stack((begin + first * (end - begin), begin + last * (end - begin)), axis=1)[seen]  # (K, 2, 3)
        lines = parts[..., :2] / parts[..., 2:]
        finite = np.isfinite(lines).all(axis=(1, 2))
        seen[seen] = finite
        return lines[finite], seen

    @np.errstate(all="ignore")
    def project_polygon(self, corners: Floats) -> Floats:
        """Pixels (Q, 2) of what the camera sees of a convex polygon (P, 3), none if nothing (Sutherland, Hodgman)."""
        polygon = self.homogeneous(corners)
        for plane in range(5):
            values = self._distances(polygon)[:, plane]
            kept: list[Floats] = []
            for k in range(len(polygon)):
                before = k - 1
                if (values[before] < 0) != (values[k] < 0):
                    share = values[before] / (values[before] - values[k])
                    kept.append(polygon[before] + share * (polygon[k] - polygon[before]))
                if values[k] >= 0:
                    kept.append(polygon[k])
            polygon = np.array(kept).reshape(-1, 3)
        pixels = polygon[:, :2] / polygon[:, 2:]
        return pixels if np.isfinite(pixels).all() else pixels[:0]

    def _distances(self, pixels: Floats) -> Floats:
        """How far homogeneous pixels (S, 3) are inside the near plane and the image's four borders: (S, 5)."""
        width, height = self.size
        u, v, depth = pixels.T
        return np.column_stack((depth - NEAR, u, (width - 1) * depth - u, v, (height - 1) * depth - v))


@dataclass(frozen=True)
class Objects:
    """What is labelled in a frame: M objects. Arrays are converted to tensors."""

    boxes: Tensor  # (M, 7) float32 x, y, z of the centre, length, width, height, yaw
    names: Sequence[str]  # M classes, whatever the labels call them
    labels: Labels | None = None  # the rows of a KITTI label file (K >= M) that they come from, including regions

    def __post_init__(self) -> None:
        boxes = torch.as_tensor(self.boxes, dtype=torch.float32)
        if not boxes.numel():
            boxes = boxes.new_zeros(0, 7)  # whatever the shape of nothing
        if boxes.ndim != 2 or boxes.shape[1] != 7:
            raise ValueError(f"boxes: want shape (M, 7) with x, y, z, l, w, h, yaw, got {tuple(boxes.shape)}")
        if len(boxes) != len(self.names):
            raise ValueError(f"names: want one for each of the {len(boxes)} boxes, got {len(self.names)}")
        wrong = ~boxes.isfinite().all(dim=1) | (boxes[:, 3:6] < 0).any(dim=1)
        if wrong.any():
            row = int(wrong.nonzero()[0])
            raise ValueError(f"boxes: want finite numbers and sizes of 0 or more, row {row} is {boxes[row].tolist()}")
        object.__setattr__(self, "boxes", boxes)
        object.__setattr__(self, "names", tuple(str(name) for name in self.names))

    def of_classes(self, classes: Sequence[str]) -> Tensor:
        """The boxes (T, 7) of some classes."""
        return self.boxes[[name in classes for name in self.names]]


@dataclass(frozen=True)
class Frame:
    """One frame, whatever it was read from. Arrays are converted to tensors.

    Points that are not finite are dropped, which is noted; a reflectance that is NaN, or the same everywhere, is 0.
    """

    name: str
    points: Tensor  # (N, 4) float32 x, y, z in metres, reflectance in [0, 1]; finite
    objects: Objects | None = None  # None where nothing is labelled
    camera: Camera | None = None  # None where there is none
    notes: list[str] = field(default_factory=list)  # what a user should know of the frame's files
    reflectance: str = "reflectance as is"  # what was done to it
    in_view: str = ""  # how many of the points a camera sees

    def __post_init__(self) -> None:
        points = as_points(self.points)
        finite = points.isfinite().all(dim=1)
        if not finite.all():
            points = points[finite]
            self.notes.append(f"frame {self.name}: {dropped_note(int((~finite).sum()))}")
        object.__setattr__(self, "points", points)

    def boxes_of(self, classes: Sequence[str]) -> Tensor:
        """The labelled boxes (T, 7) of some classes, none where nothing is labelled."""
        return torch.zeros(0, 7) if self.objects is None else self.objects.of_classes(classes)


class Frames(Protocol):
    """A sequence of frames: what training, validation, detection, evaluation, viewer and figures take.

    A data format is a class with these three. It may also have a method `object_names(k)` that reads less than `[k]`,
    `notes`, what a user should know of all frames, a method `stamp(k)`, which tells whether files have changed (see the
    functions of these names, the last one `hvnet.data.stamps.stamp_of`), and `scales`, what the reflectances of its
    sensors were divided by.
    """

    @property
    def names(self) -> Sequence[str]:
        """The names of the frames, without duplicates."""

    def __len__(self) -> int: ...

    def __getitem__(self, k: int) -> Frame: ...


def object_names(frames: Frames, k: int) -> Sequence[str] | None:
    """The classes of the objects of frame k, None where nothing is labelled.

    This is how frames are checked before a long run: a mistake in the files of frame k raises InputError.
    """
    own = getattr(frames, "object_names", None)
    if own is not None:
        return own(k)
    objects = frame_at(frames, k).objects
    return None if objects is None else objects.names


def notes(frames: Frames) -> Sequence[str]:
    """What a user should know of all frames together."""
    return getattr(frames, "notes", ())


def frame_at(frames: Frames, k: int) -> Frame:
    """Frame k; what is wrong with its arrays raises InputError with its name."""
    try:
        return frames[k]
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"frame {frames.names[k]}: {error}") from error


def check_names(frames: Frames) -> None:
    """Raises InputError if two frames have one name: pictures and mistakes go by it."""
    for name, count in Counter(frames.names).items():
        if count > 1:
            raise InputError(f"{count} frames are named {name}; rename all but one")
