"""KITTI's own layout: points, calibration, labels, result files and splits (Geiger et al., CVPR 2012).

Files are read into numpy. Camera axes (x right, y down, z forward) end here: boxes are converted once, on reading and
on writing, and a `Frame` is in LiDAR axes.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from hvnet.boxes import limit_angle
from hvnet.data.frame import IMAGE_ERRORS, IMAGE_SIZE, Camera, Frame, Objects
from hvnet.data.labels import DONTCARE, Floats, Labels
from hvnet.exceptions import InputError

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
"""The classes of KITTI's label files."""

# camera axes at the LiDAR, looking along its x: those of the labels if there is no camera
AT_LIDAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


class KittiFrames:
    """Frames of a KITTI root, training/ or testing/: a `Frames`.

    labelled: True requires and reads the labels, False does not read them, None reads those that exist.
    crop: keep only the points in the camera's view, where objects are labelled.
    """

    def __init__(
        self,
        root: Path,
        names: Sequence[str],
        split_dir: str = "training",
        *,
        labelled: bool | None = True,
        crop: bool = True,
    ) -> None:
        self.root, self.names, self.split_dir = Path(root), list(names), split_dir
        self.labelled, self.crop = labelled, crop

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, k: int) -> Frame:
        labelled = self.is_labelled(k)
        return read_frame(self.root, self.names[k], self.split_dir, labelled=labelled, crop=self.crop)

    def is_labelled(self, k: int) -> bool:
        """Whether frame k has, or must have, a label file."""
        if self.labelled is not None:
            return self.labelled
        return (self.root / self.split_dir / "label_2" / f"{self.names[k]}.txt").is_file()

    def object_names(self, k: int) -> list[str] | None:
        """See `frame.object_names`: reads the small files of frame k, and only the size of its cloud."""
        folder, name = self.root / self.split_dir, self.names[k]
        labels = read_labels(folder / "label_2" / f"{name}.txt") if self.is_labelled(k) else _labels([])
        frame_camera(folder, name, labels)
        points = folder / "velodyne" / f"{name}.bin"
        if not points.is_file() or points.stat().st_size % 16:
            read_points(points)  # which says what is wrong
        return [str(each) for each in labels.name if each != DONTCARE] if self.is_labelled(k) else None


def read_split_frames(root: Path, name: str) -> KittiFrames:
    """The labelled frames of ImageSets/NAME.txt of a KITTI root."""
    return KittiFrames(root, read_split(root, name))


def read_frame(
    root: Path, frame_id: str, split_dir: str = "training", crop: bool = True, labelled: bool = True
) -> Frame:
    """Reads one frame of a KITTI root; `crop` keeps only the points in the camera's view, where objects are labelled.

    The size of the image is that of image_2/ID.png; without this file it is taken to be 1242 x 375. Where there is no
    folder calib there is no camera: all points are kept, and labels are in camera axes at the LiDAR (AT_LIDAR).
    """
    folder = Path(root) / split_dir
    labels = read_labels(folder / "label_2" / f"{frame_id}.txt") if labelled else _labels([])
    camera = frame_camera(folder, frame_id, labels)
    points, dropped = drop_non_finite(read_points(folder / "velodyne" / f"{frame_id}.bin"))
    if crop and camera is not None:
        points = points[camera.sees(points)]
    notes = [f"frame {frame_id}: {dropped} points that are not finite were dropped"] if dropped else []
    objects = None
    if labelled:
        rows = labels.select(labels.name != DONTCARE)
        boxes = torch.from_numpy(boxes_to_lidar(rows, camera)).float()
        try:
            objects = Objects(boxes, rows.name.tolist(), labels)
        except ValueError as error:
            raise InputError(f"{folder / 'label_2' / frame_id}.txt: {error}") from error
    return Frame(frame_id, torch.from_numpy(points), objects, camera, notes)


def has_camera(folder: Path) -> bool:
    """Whether a folder such as training/ holds calibrations: else its clouds are those of a LiDAR without a camera.

    Raises InputError where they seem to be missing: a camera's images are there.
    """
    calib = folder / "calib"
    if calib.is_dir():
        return True
    if calib.exists() or calib.is_symlink():
        raise InputError(f"{calib}: is no folder of calibrations; fix it, or remove it if there is no camera")
    if (folder / "image_2").is_dir():
        raise InputError(f"{calib}: no such folder, but there is image_2; add the calibrations, or remove the images")
    return False


def frame_camera(folder: Path, frame_id: str, labels: Labels) -> Camera | None:
    """The camera of a frame with these labels, None without one.

    Raises InputError where labels have 2D boxes and there is no calibration: their axes are those of a camera.
    """
    if has_camera(folder):
        image = folder / "image_2" / f"{frame_id}.png"
        camera = read_calibration(folder / "calib" / f"{frame_id}.txt")
        return replace(camera, size=_image_size(image), image=image) if image.is_file() else camera
    if (labels.bbox[:, 2:] > labels.bbox[:, :2]).any():
        raise InputError(
            f"{folder / 'calib'}: no such folder, but the labels of frame {frame_id} have 2D boxes; "
            "add it, or, without a camera, make the 2D boxes -1"
        )
    return None


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
            raise InputError(f"{path}:{number}: frame {frame_id} is already on line {lines[frame_id]}; remove one")
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
    try:
        labels = _labels([row for row in rows if row], scored)
    except ValueError:
        for number, row in enumerate(rows, 1):
            for field, text in enumerate(row[1:], 2):
                if not _is_number(text, whole=field == 3):
                    kind = "whole number" if field == 3 else "finite number"
                    raise InputError(f"{path}:{number}: field {field} is '{text[:60]}', not a {kind}") from None
        raise
    flat = (labels.dimensions <= 0).any(axis=1) & (labels.name != DONTCARE)
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
    """Writes a label file with two decimals, as KITTI's are, or, where there are scores, a result file with four.

    Raises ValueError for a class that is not one word: such a file could not be read.
    """
    split = [str(name) for name in labels.name if len(str(name).split()) != 1]
    if split:
        raise ValueError(f"labels: want classes of one word each, got '{split[0]}'")
    digits = 2 if labels.score is None else 4
    lines = []
    for k in range(len(labels)):
        # KITTI writes a number that is unknown, and all of DontCare but its 2D box, as a whole one
        unknown = labels.name[k] == DONTCARE
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


def read_calibration(path: Path) -> Camera:
    """Reads P2, R0_rect and Tr_velo_to_cam of a KITTI calib file."""
    shapes = {"P2": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}
    found: dict[str, Floats] = {}
    for number, line in enumerate(_read_lines(path, "a KITTI calibration"), 1):
        key, _, text = line.partition(":")
        if key not in shapes:
            continue
        if key in found:
            raise InputError(f"{path}:{number}: {key} is given twice")
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
    return Camera(found["P2"], found["R0_rect"], found["Tr_velo_to_cam"])


def write_calibration(path: Path, camera: Camera) -> None:
    """Writes a whole KITTI calib file: the other three cameras are given P2's matrix."""
    identity = np.eye(3, 4)
    matrices = {f"P{number}": camera.p2 for number in range(4)}
    matrices |= {"R0_rect": camera.r0_rect, "Tr_velo_to_cam": camera.velo_to_cam, "Tr_imu_to_velo": identity}
    lines = [f"{key}: {' '.join(f'{value:.12e}' for value in matrix.ravel())}\n" for key, matrix in matrices.items()]
    Path(path).write_text("".join(lines), encoding="utf-8")


def boxes_to_lidar(labels: Labels, camera: Camera | None) -> Floats:
    """Boxes (K, 7) in LiDAR axes of labels in camera axes; DontCare rows have none: leave them out first.

    The centre of the bottom is moved to LiDAR axes and raised by half the height along LiDAR's z, as in SECOND.
    """
    height, width, length = labels.dimensions.T
    centre = centres_to_lidar(labels, camera)
    centre[:, 2] += height / 2
    return np.column_stack((centre, length, width, height, _turn(labels.rotation_y)))


def centres_to_lidar(labels: Labels, camera: Camera | None) -> Floats:
    """The centres (K, 3) of the bottoms of labels in LiDAR axes."""
    return labels.location @ AT_LIDAR + 0.0 if camera is None else camera.to_lidar(labels.location)


def boxes_to_camera(boxes: NDArray[np.floating], camera: Camera | None) -> tuple[Floats, Floats, Floats]:
    """Dimensions (M, 3), location (M, 3) and rotation_y (M,) of boxes (M, 7): the inverse of `boxes_to_lidar`."""
    values: Floats = boxes.astype(np.float64)
    bottom = values[:, :3].copy()
    bottom[:, 2] -= values[:, 5] / 2
    # + 0.0: no minus zero
    location = bottom @ AT_LIDAR.T + 0.0 if camera is None else camera.to_camera(bottom)
    return values[:, [5, 4, 3]], location, _turn(values[:, 6])


def _turn(angle: Floats) -> Floats:
    """Turns rotation_y (about the camera's y, down) to yaw (about LiDAR's z, up), and back: it is its own inverse."""
    return _wrap(-angle - math.pi / 2)


def _wrap(angle: Floats) -> Floats:
    return limit_angle(torch.from_numpy(angle)).numpy()


def boxes_to_labels(
    boxes: NDArray[np.floating], names: Sequence[str], camera: Camera | None = None, scores: Floats | None = None
) -> Labels:
    """The rows of a label file for boxes (M, 7) and their classes, or with scores (M,) of a result file: K <= M.

    Labels are neither truncated nor occluded; of results nothing is known about that. A box with nothing in the image
    is left out: nothing is labelled there. Without a camera there are no 2D boxes: they are -1.
    """
    bbox, visible = np.full((len(boxes), 4), -1.0), np.ones(len(boxes), dtype=np.bool_)
    if camera is not None:
        bbox, visible = camera.project_boxes(boxes)
    dimensions, location, rotation_y = boxes_to_camera(boxes, camera)
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


def detections_to_labels(boxes: Tensor, scores: Tensor, names: Sequence[str], camera: Camera | None) -> Labels:
    """The rows of a result file for detected boxes (M, 7) with scores (M,) and classes: K <= M are in the image."""
    values = boxes.detach().cpu().double().numpy()
    return boxes_to_labels(values, names, camera, scores.detach().cpu().double().numpy())


def frame_labels(frame: Frame) -> Labels:
    """The rows that KITTI's evaluation takes for the objects of a labelled frame, whatever its format."""
    if frame.objects is None:
        raise ValueError(f"frame {frame.name}: has no labels")
    if frame.objects.labels is not None:
        return frame.objects.labels
    return boxes_to_labels(frame.objects.boxes.double().numpy(), frame.objects.names, frame.camera)


def _image_size(path: Path) -> tuple[int, int]:
    if not path.is_file():
        return IMAGE_SIZE
    try:
        with Image.open(path) as image:  # reads the header only
            return image.size
    except IMAGE_ERRORS as error:
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
