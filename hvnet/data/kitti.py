"""KITTI's own layout: points, calibration, labels, result files and splits (Geiger et al., CVPR 2012).

Files are read into numpy. A `Frame`, which goes on to the network, holds torch tensors in LiDAR axes (x forward,
y left, z up, metres). Camera axes (x right, y down, z forward) end here: boxes are converted once, on reading and on
writing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from hvnet.boxes import box_corners, limit_angle
from hvnet.cli import InputError

Floats = NDArray[np.float64]

CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
IMAGE_SIZE = (1242, 375)
"""Width and height in pixels that a frame without an image is taken to have: most KITTI frames have them."""

NEAR = 0.1
"""Metres in front of the camera from where on a box is projected."""

# corners in the order of boxes.box_corners: four at the bottom, four at the top
EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]])


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
        return Labels(
            name=self.name[rows],
            truncation=self.truncation[rows],
            occlusion=self.occlusion[rows],
            alpha=self.alpha[rows],
            bbox=self.bbox[rows],
            dimensions=self.dimensions[rows],
            location=self.location[rows],
            rotation_y=self.rotation_y[rows],
            score=None if self.score is None else self.score[rows],
        )


@dataclass(frozen=True)
class Calibration:
    """Calibration of the left colour camera (camera 2) and the LiDAR, as in KITTI's calib files."""

    p2: Floats  # (3, 4) rectified camera axes to pixels
    r0_rect: Floats  # (3, 3) camera 0 to rectified camera axes
    velo_to_cam: Floats  # (3, 4) LiDAR to camera 0

    def _lidar_to_rectified(self) -> tuple[Floats, Floats]:
        return self.r0_rect @ self.velo_to_cam[:, :3], self.r0_rect @ self.velo_to_cam[:, 3]

    def to_camera(self, xyz: NDArray[np.floating]) -> Floats:
        """Points (N, 3) in LiDAR axes to rectified camera axes (N, 3)."""
        rotation, shift = self._lidar_to_rectified()
        return xyz @ rotation.T + shift

    def to_lidar(self, xyz: NDArray[np.floating]) -> Floats:
        """Points (N, 3) in rectified camera axes to LiDAR axes (N, 3): the inverse of `to_camera`."""
        rotation, shift = self._lidar_to_rectified()
        # the printed rotations have seven digits: their transpose is not quite their inverse
        return (xyz - shift) @ np.linalg.inv(rotation).T

    def project(self, xyz: NDArray[np.floating]) -> tuple[Floats, Floats]:
        """Pixels (N, 2) and depth (N,) in metres of points (N, 3) in LiDAR axes.

        The pixel of a point that is not in front of the camera (depth <= 0) means nothing.
        """
        projected = self.homogeneous(xyz)
        depth = projected[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return projected[:, :2] / depth[:, None], depth

    def homogeneous(self, xyz: NDArray[np.floating]) -> Floats:
        """Homogeneous pixels (N, 3) = (u * depth, v * depth, depth) of points (N, 3) in LiDAR axes."""
        rotation, shift = self._lidar_to_rectified()
        # coordinate by coordinate in memory, 7 times as fast as xyz @ matrix.T
        columns = (self.p2[:, :3] @ rotation) @ xyz.T.astype(np.float64)
        columns += (self.p2[:, :3] @ shift + self.p2[:, 3])[:, None]
        return columns.T


NO_IMAGE = (0, 0)
"""The size of the image where there is no camera: then everything is seen, and the 2D boxes are -1."""
AT_LIDAR = Calibration(
    p2=np.eye(3, 4), r0_rect=np.eye(3), velo_to_cam=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
)
"""Camera axes that stand in the LiDAR and look along its x, where there is no camera."""


@dataclass(frozen=True)
class Frame:
    """One frame, ready for the pipeline: tensors in LiDAR axes, and the labels as in the file for evaluation."""

    id: str
    points: Tensor  # (N, 4) float32 x, y, z, reflectance; finite
    boxes: Tensor  # (M, 7) float32 x, y, z of the centre, length, width, height, yaw; DontCare rows left out
    names: tuple[str, ...]  # M classes
    labels: Labels  # all K >= M rows of the label file; none if the frame was read without labels
    calib: Calibration
    image_size: tuple[int, int]  # width, height in pixels; NO_IMAGE without a camera
    dropped: int  # points of the file that were not finite

    @property
    def note(self) -> str:
        """What a user should know of the frame's points; empty if nothing."""
        return f"frame {self.id}: {self.dropped} points that are not finite were dropped" if self.dropped else ""


def read_frame(
    root: Path, frame_id: str, split_dir: str = "training", crop: bool = True, labelled: bool = True
) -> Frame:
    """Reads one frame of a KITTI root; `crop` keeps only the points in the camera's view, where objects are labelled.

    The size of the image is that of image_2/ID.png; without this file it is taken to be 1242 x 375. Where there is no
    folder calib there is no camera: all points are kept, and labels are in the axes of AT_LIDAR.
    """
    folder = Path(root) / split_dir
    labels = read_labels(folder / "label_2" / f"{frame_id}.txt") if labelled else _labels([])
    calib = frame_calibration(folder, frame_id, labels)
    image_size = NO_IMAGE if calib is AT_LIDAR else _image_size(folder / "image_2" / f"{frame_id}.png")
    points, dropped = drop_non_finite(read_points(folder / "velodyne" / f"{frame_id}.bin"))
    if crop:
        points = points[in_image(points, calib, image_size)]
    objects = labels.select(labels.name != "DontCare")
    boxes = torch.from_numpy(boxes_to_lidar(objects, calib)).float()
    names = tuple(objects.name.tolist())
    return Frame(frame_id, torch.from_numpy(points), boxes, names, labels, calib, image_size, dropped)


def has_camera(folder: Path) -> bool:
    """Whether a folder such as training/ holds calibrations: else its clouds are those of a LiDAR without a camera.

    Raises InputError where they seem to be missing: a camera's images are there.
    """
    calib = folder / "calib"
    if calib.is_dir():
        return True
    if calib.exists() or calib.is_symlink():
        raise InputError(f"{calib}: is no folder of calibrations; mend it, or remove it if there is no camera")
    if (folder / "image_2").is_dir():
        raise InputError(f"{calib}: no such folder, but there is image_2; add the calibrations, or remove the images")
    return False


def frame_calibration(folder: Path, frame_id: str, labels: Labels) -> Calibration:
    """The calibration of a frame with these labels; AT_LIDAR without a camera.

    Raises InputError where labels have 2D boxes and there is no calibration: their axes are those of a camera.
    """
    if has_camera(folder):
        return read_calibration(folder / "calib" / f"{frame_id}.txt")
    if (labels.bbox[:, 2:] > labels.bbox[:, :2]).any():
        raise InputError(
            f"{folder / 'calib'}: no such folder, but the labels of frame {frame_id} have 2D boxes; "
            "add it, or, without a camera, make the 2D boxes -1"
        )
    return AT_LIDAR


def read_split(root: Path, name: str, split_dir: str = "training", labelled: bool = True) -> list[str]:
    """Frame ids of ImageSets/NAME.txt, one a line; every one of them has its points, calibration and label file.

    Where there is no folder calib, no frame needs a calibration (see `has_camera`).
    """
    path = Path(root) / "ImageSets" / f"{name}.txt"
    suffixes = {"velodyne": ".bin"} | ({"label_2": ".txt"} if labelled else {})
    if has_camera(Path(root) / split_dir):
        suffixes["calib"] = ".txt"
    lines: dict[str, int] = {}
    for number, line in enumerate(_read_lines(path, f"the frames of split '{name}', one id a line"), 1):
        frame_id = line.strip()
        if not frame_id:
            continue
        if frame_id in lines:
            raise InputError(f"{path}:{number}: frame {frame_id} stands on line {lines[frame_id]} already; remove one")
        for folder, suffix in suffixes.items():
            file = Path(root) / split_dir / folder / (frame_id + suffix)
            if not file.is_file():
                raise InputError(f"{path}:{number}: frame {frame_id} has no {file}; add the file or remove the line")
        lines[frame_id] = number
    if not lines:
        raise InputError(f"{path}: names no frame; write one id a line")
    return list(lines)


def read_points(path: Path) -> NDArray[np.float32]:
    """Points (N, 4) of a velodyne .bin file: x, y, z in metres and reflectance in [0, 1], float32 little-endian."""
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if len(data) % 16:
        raise InputError(
            f"{path}: {len(data)} bytes are no multiple of 16, the size of a point (x, y, z, reflectance as float32); "
            "is the file cut off?"
        )
    return np.frombuffer(bytearray(data), dtype="<f4").reshape(-1, 4)


def write_points(path: Path, points: NDArray[np.float32]) -> None:
    """Writes points (N, 4) as a velodyne .bin file."""
    Path(path).write_bytes(np.ascontiguousarray(points, dtype="<f4").tobytes())


def drop_non_finite(points: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """The points (N, 4) whose four numbers are finite, and how many are not."""
    if np.isfinite(points).all():  # nearly always: spares the copy
        return points, 0
    finite = np.isfinite(points).all(axis=1)
    return points[finite], int((~finite).sum())


def read_labels(path: Path, scored: bool = False) -> Labels:
    """Reads a label file, or a result file, whose lines end with a score (`scored`). An empty file means no objects."""
    lines = _read_lines(path, "the objects of a frame, one a line")
    rows = [line.split() for line in lines]
    size = 16 if scored else 15
    for number, row in enumerate(rows, 1):
        if row and len(row) != size:
            expected = f"{size} (class, 14 numbers{' and a score' if scored else ''})"
            raise InputError(f"{path}:{number}: {len(row)} fields, expected {expected}")
        if row and row[0] not in CLASSES:
            raise InputError(f"{path}:{number}: unknown class '{row[0]}'; known are {', '.join(CLASSES)}")
    try:
        labels = _labels([row for row in rows if row], scored)
    except ValueError:
        for number, row in enumerate(rows, 1):
            for field, text in enumerate(row[1:], 2):
                if not _is_number(text, whole=field == 3):
                    kind = "whole number" if field == 3 else "finite number"
                    raise InputError(f"{path}:{number}: field {field} is '{text[:60]}', not a {kind}") from None
        raise
    flat = (labels.dimensions <= 0).any(axis=1) & (labels.name != "DontCare")
    if flat.any() and not scored:  # results may come without 3D boxes
        number = [number for number, row in enumerate(rows, 1) if row][flat.argmax()]
        raise InputError(f"{path}:{number}: height, width or length (fields 9 to 11) is not positive")
    return labels


def _labels(rows: list[list[str]], scored: bool = False) -> Labels:
    """Labels of the fields of every line; ValueError if one that should be a number is none."""
    values = np.array([[float(text) for text in row[1:]] for row in rows]).reshape(len(rows), 15 if scored else 14)
    if not np.isfinite(values).all() or (values[:, 1] != np.trunc(values[:, 1])).any():
        raise ValueError
    return Labels(
        name=np.array([row[0] for row in rows], dtype=np.str_),
        truncation=values[:, 0],
        occlusion=values[:, 1].astype(np.int64),
        alpha=values[:, 2],
        bbox=values[:, 3:7],
        dimensions=values[:, 7:10],
        location=values[:, 10:13],
        rotation_y=values[:, 13],
        score=values[:, 14] if scored else None,
    )


def _is_number(text: str, whole: bool) -> bool:
    try:
        value = float(text)
    except ValueError:
        return False
    return math.isfinite(value) and (not whole or value == math.trunc(value))


def write_labels(path: Path, labels: Labels) -> None:
    """Writes a label file with two decimals, as KITTI's are, or, where there are scores, a result file with four."""
    digits = 2 if labels.score is None else 4
    lines = []
    for k in range(len(labels)):
        # KITTI writes a number that is unknown, and all of DontCare but its 2D box, as a whole one
        unknown = labels.name[k] == "DontCare"
        after = 0 if unknown else digits
        numbers = [f"{labels.truncation[k]:.{0 if labels.truncation[k] < 0 else 2}f}", f"{labels.occlusion[k]}"]
        numbers.append(f"{labels.alpha[k]:.{after}f}")
        numbers += [f"{value:.{digits}f}" for value in labels.bbox[k]]
        for value in (*labels.dimensions[k], *labels.location[k], labels.rotation_y[k]):
            numbers.append(f"{value:.{after}f}")
        if labels.score is not None:
            numbers.append(f"{labels.score[k]:.6f}")
        lines.append(" ".join((labels.name[k], *numbers)) + "\n")
    Path(path).write_text("".join(lines), encoding="utf-8")


def read_calibration(path: Path) -> Calibration:
    """Reads P2, R0_rect and Tr_velo_to_cam of a KITTI calib file."""
    shapes = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}
    found: dict[str, Floats] = {}
    for number, line in enumerate(_read_lines(path, "a KITTI calibration"), 1):
        key, _, text = line.partition(":")
        if key not in shapes:
            continue
        if key in found:
            raise InputError(f"{path}:{number}: {key} stands there twice")
        rows, columns = shapes[key]
        texts = text.split()
        if len(texts) != rows * columns:
            raise InputError(f"{path}:{number}: {key} has {len(texts)} numbers, expected {rows * columns}")
        for value in texts:
            if not _is_number(value, whole=False):
                raise InputError(f"{path}:{number}: {key} holds '{value[:60]}', not a finite number")
        found[key] = np.array([float(value) for value in texts]).reshape(rows, columns)
        if key != "P2" and abs(np.linalg.det(found[key][:, :3]) - 1) > 0.01:
            raise InputError(f"{path}:{number}: {key} is no rotation: its determinant is not 1")
    missing = [key for key in shapes if key not in found]
    if missing:
        raise InputError(f"{path}: no line '{missing[0]}: ...'; a KITTI calibration has {', '.join(shapes)}")
    return Calibration(found["P2"], found["R0_rect"], found["Tr_velo_to_cam"])


def write_calibration(path: Path, calib: Calibration) -> None:
    """Writes a whole KITTI calib file: the cameras that a `Calibration` does not hold are given P2's matrix."""
    identity = np.eye(3, 4)
    matrices = {f"P{camera}": calib.p2 for camera in range(4)}
    matrices |= {"R0_rect": calib.r0_rect, "Tr_velo_to_cam": calib.velo_to_cam, "Tr_imu_to_velo": identity}
    lines = [f"{key}: {' '.join(f'{value:.12e}' for value in matrix.ravel())}\n" for key, matrix in matrices.items()]
    Path(path).write_text("".join(lines), encoding="utf-8")


def boxes_to_lidar(labels: Labels, calib: Calibration) -> Floats:
    """Boxes (K, 7) in LiDAR axes of labels in camera axes; DontCare rows have none: leave them out first.

    The centre of the bottom is moved to LiDAR axes and raised by half the height along LiDAR's z, as in SECOND.
    """
    height, width, length = labels.dimensions.T
    centre = calib.to_lidar(labels.location)
    centre[:, 2] += height / 2
    yaw = _turn(labels.rotation_y)
    return np.column_stack((centre, length, width, height, yaw))


def boxes_to_camera(boxes: NDArray[np.floating], calib: Calibration) -> tuple[Floats, Floats, Floats]:
    """Dimensions (M, 3), location (M, 3) and rotation_y (M,) of boxes (M, 7): the inverse of `boxes_to_lidar`."""
    values: Floats = boxes.astype(np.float64)
    bottom = values[:, :3].copy()
    bottom[:, 2] -= values[:, 5] / 2
    return values[:, [5, 4, 3]], calib.to_camera(bottom), _turn(values[:, 6])


def _turn(angle: Floats) -> Floats:
    """Turns rotation_y (about the camera's y, down) to yaw (about LiDAR's z, up), and back: it is its own inverse."""
    return _wrap(-angle - math.pi / 2)


def _wrap(angle: Floats) -> Floats:
    return limit_angle(torch.from_numpy(angle)).numpy()


def project_boxes(
    boxes: NDArray[np.floating], calib: Calibration, image_size: tuple[int, int]
) -> tuple[Floats, NDArray[np.bool_]]:
    """2D boxes (M, 4) = left, top, right, bottom of boxes (M, 7), clipped to the image, and which are visible (M,).

    The 2D box encloses the projection of the part of the box in front of the camera: its corners there, and the points
    where its edges pass the near plane. It is visible if some of the 2D box lies in the image; else it is zero. With
    NO_IMAGE all are visible, and their 2D boxes -1.
    """
    if image_size == NO_IMAGE:
        return np.full((len(boxes), 4), -1.0), np.ones(len(boxes), dtype=np.bool_)
    corners = box_corners(torch.from_numpy(boxes.astype(np.float64))).numpy()
    corners = calib.homogeneous(corners.reshape(-1, 3)).reshape(-1, 8, 3)
    begin, end = corners[:, EDGES[:, 0]], corners[:, EDGES[:, 1]]  # (M, 12, 3)
    crosses = (begin[..., 2] < NEAR) != (end[..., 2] < NEAR)
    share = np.where(crosses, NEAR - begin[..., 2], 0) / np.where(crosses, end[..., 2] - begin[..., 2], 1)
    with np.errstate(all="ignore"):  # of boxes that are beyond all measure
        outline = np.concatenate((corners, begin + share[..., None] * (end - begin)), axis=1)  # (M, 20, 3)
    front = np.concatenate((corners[..., 2] >= NEAR, crosses), axis=1)
    pixels = outline[..., :2] / np.where(front, outline[..., 2], 1)[..., None]
    least = np.where(front[..., None], pixels, np.inf).min(axis=1)
    most = np.where(front[..., None], pixels, -np.inf).max(axis=1)
    limit = np.array(image_size, dtype=np.float64) - 1
    visible = ((most > 0) & (least < limit)).all(axis=1)
    bbox = np.concatenate((least.clip(0, limit), most.clip(0, limit)), axis=1)
    return np.where(visible[:, None], bbox, 0), visible


def in_image(points: NDArray[np.floating], calib: Calibration, image_size: tuple[int, int]) -> NDArray[np.bool_]:
    """Which of the points (N, 3 or more) in LiDAR axes the camera sees: in front of it, inside the image.

    All of them with NO_IMAGE.
    """
    if image_size == NO_IMAGE:
        return np.ones(len(points), dtype=np.bool_)
    uv, depth = calib.project(points[:, :3])
    u, v = uv.T
    return (depth > 0) & (u >= 0) & (u < image_size[0]) & (v >= 0) & (v < image_size[1])


def boxes_to_labels(
    boxes: NDArray[np.floating],
    names: Sequence[str],
    calib: Calibration = AT_LIDAR,
    image_size: tuple[int, int] = NO_IMAGE,
    scores: Floats | None = None,
) -> Labels:
    """The rows of a label file for boxes (M, 7) and their classes, or with scores (M,) of a result file: K <= M.

    Labels are neither truncated nor occluded; of results nothing is known about that. A box with nothing in the image
    is left out: nothing is labelled there. Raises ValueError for a calibration without the size of its image, or a size
    alone.
    """
    if (image_size == NO_IMAGE) != (calib is AT_LIDAR):  # a file may hold the same numbers, with an image
        raise ValueError(f"image_size {image_size}: want a calibration and the size of its image, or neither")
    bbox, visible = project_boxes(boxes, calib, image_size)
    dimensions, location, rotation_y = boxes_to_camera(boxes, calib)
    rating = 0 if scores is None else -1
    labels = Labels(
        name=np.array(names, dtype=np.str_),
        truncation=np.full(len(boxes), float(rating)),
        occlusion=np.full(len(boxes), rating),
        alpha=_wrap(rotation_y - np.arctan2(location[:, 0], location[:, 2])),
        bbox=bbox,
        dimensions=dimensions,
        location=location,
        rotation_y=rotation_y,
        score=scores,
    )
    return labels.select(visible)


def detections_to_labels(
    boxes: Tensor, scores: Tensor, names: Sequence[str], calib: Calibration, image_size: tuple[int, int]
) -> Labels:
    """The rows of a result file for detected boxes (M, 7) with scores (M,) and classes: K <= M are in the image."""
    values = boxes.detach().cpu().double().numpy()
    return boxes_to_labels(values, names, calib, image_size, scores.detach().cpu().double().numpy())


def read_image(path: Path) -> NDArray[np.uint8]:
    """A picture (H, W, 3) in RGB. Raises InputError naming the file."""
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except OSError as error:
        raise InputError(f"{path}: not an image, or cut off; replace or remove it") from error


def _image_size(path: Path) -> tuple[int, int]:
    if not path.is_file():
        return IMAGE_SIZE
    try:
        with Image.open(path) as image:  # reads the header only
            return image.size
    except OSError as error:
        raise InputError(f"{path}: not an image; replace or remove it") from error


def _read_lines(path: Path, content: str) -> list[str]:
    try:
        return Path(path).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; it holds {content}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file") from error
