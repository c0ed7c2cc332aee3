"""KITTI's own layout: points, calibration, labels, result files and splits (Geiger et al., CVPR 2012).

Files are read into numpy. Camera axes (x right, y down, z forward) end here: boxes are converted once, on reading and
on writing, and a `Frame` is in LiDAR axes.
"""

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from hvnet.boxes import limit_angle
from hvnet.config import DataConfig
from hvnet.data.clouds import find_scales, read_raw, read_scaled
from hvnet.data.frame import IMAGE_ERRORS, IMAGE_SIZE, Camera, Frame, Objects
from hvnet.data.labels import DONTCARE, Floats, Labels, rename
from hvnet.data.stamps import Stamp, stamp_files
from hvnet.exceptions import InputError

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
"""The classes of KITTI's label files."""
IMAGES = (".png", ".jpg", ".jpeg")
FEW_SEEN = 0.02
"""Share of a cloud's points below which the camera's view is suspicious: KITTI's sees 0.15 of whole scans."""

# camera axes at the LiDAR, looking along its x: those of the labels if there is no camera
AT_LIDAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


class KittiFrames:
    """Frames of a KITTI root, training/ or testing/: a `Frames`.

    labelled: True requires and reads the labels, False does not read them, None reads those that there are; one that
    cannot be read is then noted, and its frame counts as not labelled.
    crop: keep only the points in the camera's view, where objects are labelled.
    reading: how clouds and labels are read; what it does not say is found out.
    """

    def __init__(
        self,
        root: Path,
        names: Sequence[str],
        split_dir: str = "training",
        *,
        labelled: bool | None = True,
        crop: bool = True,
        reading: DataConfig | None = None,
    ) -> None:
        self.root, self.names, self.split_dir = Path(root), list(names), split_dir
        self.labelled, self.crop, self.reading = labelled, crop, reading or DataConfig()
        self.folder = self.root / split_dir

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, k: int) -> Frame:
        name = self.names[k]
        labels, note = self.labels(k)
        camera = frame_camera(self.folder, name, labels or _labels([]))
        path = find_file(self.folder / "velodyne", name, ".bin")
        raw, cloud = read_scaled(path, self.reading, self.scales)
        points, in_view = cloud.points, ""
        notes = [f"frame {name}: {text}" for text in cloud.notes]
        # the same for all clouds, so that they are said once
        facts_of_all = [f"{self.folder / 'velodyne'}: {text}" for text in (raw.note, cloud.reflectance.note) if text]
        notes += [note] * bool(note) + facts_of_all
        if self.crop and camera is not None:
            seen = camera.sees(points)
            in_view = f"{seen.sum():,} of {len(seen):,} points in the camera's view"
            if reason := view_reason(camera, seen):
                notes.append(f"frame {name}: {reason}")
            points = points[seen]
        objects = None
        if labels is not None:
            rows = labels.select(labels.name != DONTCARE)
            boxes = torch.from_numpy(boxes_to_lidar(rows, camera)).float()
            try:
                objects = Objects(boxes, rows.name.tolist(), labels)
            except ValueError as error:
                wrong = f"{find_file(self.folder / 'label_2', name, '.txt')}: {error}"
                if self.labelled:
                    raise InputError(wrong) from error
                notes.append(f"{wrong}; the frame counts as not labelled")
        return Frame(name, torch.from_numpy(points), objects, camera, notes, cloud.reflectance.fact, in_view)

    def labels(self, k: int) -> tuple[Labels | None, str]:
        """The labels of frame k, None if it has none, and what is wrong with a file that cannot be read.

        Raises InputError for such a file if frames have to be labelled.
        """
        path = find_file(self.folder / "label_2", self.names[k], ".txt")
        if self.labelled is False or (self.labelled is None and not path.is_file()):
            return None, ""
        try:
            labels = rename(read_labels(path), self.reading.classes)
            if not has_camera(self.folder):
                check_without_camera(self.folder, self.names[k], labels)
            return labels, ""
        except InputError as error:
            if self.labelled:
                raise
            return None, f"{error}; the frame counts as not labelled"

    def object_names(self, k: int) -> list[str] | None:
        """See `frame.object_names`: reads the small files of frame k, and only the size of its cloud."""
        labels, _ = self.labels(k)
        frame_camera(self.folder, self.names[k], labels or _labels([]))
        points = find_file(self.folder / "velodyne", self.names[k], ".bin")
        if not points.is_file() or points.stat().st_size % 16:
            read_raw(points, self.reading.columns)  # which says what is wrong
        return None if labels is None else [str(each) for each in labels.name if each != DONTCARE]

    def stamp(self, k: int) -> Stamp:
        """See `stamps.stamp_of`: which label file, calibration and cloud frame k is read from, and how."""
        name = self.names[k]
        small = [find_file(self.folder / folder, name, ".txt") for folder in ("label_2", "calib")]
        reading = self.reading.columns, sorted(set(self.scales.values())), sorted(self.reading.classes.items())
        return stamp_files(small, repr(reading), find_file(self.folder / "velodyne", name, ".bin"))

    @cached_property
    def scales(self) -> dict[str, float]:
        """The scale of the reflectance of every sensor among the root's clouds: see `clouds.sensor_of`."""
        return find_scales(cloud_files(self.folder), self.reading)

    @property
    def notes(self) -> list[str]:
        """See `frame.notes`: how many frames have no image, if there are images."""
        folder = self.folder / "image_2"
        missing = sum(not find_file(folder, name, *IMAGES).is_file() for name in self.names) if folder.is_dir() else 0
        size = f"{IMAGE_SIZE[0]} x {IMAGE_SIZE[1]}"
        note = f"{folder}: has no image of {missing} of {len(self)} frames; their size is taken to be {size}"
        return [note] if missing else []


def read_split_frames(root: Path, name: str, reading: DataConfig | None = None) -> KittiFrames:
    """The labelled frames of ImageSets/NAME.txt of a KITTI root."""
    return KittiFrames(root, read_split(root, name), reading=reading)


def read_frame(
    root: Path, frame_id: str, split_dir: str = "training", crop: bool = True, labelled: bool = True
) -> Frame:
    """Reads one frame of a KITTI root; `crop` keeps only the points in the camera's view, where objects are labelled.

    The size of the image is that of image_2/ID.png (or .jpg); without this file it is taken to be 1242 x 375. Where
    there is no folder calib there is no camera: all points are kept, and labels are in camera axes at the LiDAR
    (AT_LIDAR).
    """
    return KittiFrames(root, [frame_id], split_dir, labelled=labelled, crop=crop)[0]


def find_file(folder: Path, name: str, *suffixes: str) -> Path:
    """The file of this name with one of the suffixes, in lower, upper or title case; if none is there, the first."""
    paths = [folder / (name + each) for suffix in suffixes for each in (suffix, suffix.upper(), suffix.title())]
    return next((path for path in paths if path.is_file()), paths[0])


def cloud_files(folder: Path) -> list[Path]:
    """The clouds of a folder such as training/, sorted."""
    return sorted(file for file in (folder / "velodyne").glob("*") if file.suffix in (".bin", ".BIN", ".Bin"))


def view_reason(camera: Camera, seen: NDArray[np.bool_]) -> str:
    """Why a camera sees next to nothing of a cloud (N,), with the remedy; empty if it sees something."""
    if seen.sum() >= FEW_SEEN * len(seen) and len(seen):
        return ""
    if not len(seen):
        return "the cloud has no points"
    what = f"its camera sees {seen.sum():,} of {len(seen):,} points"
    remedy = "give the calibration of these clouds or, without a camera, remove calib"
    if np.allclose(camera.velo_to_cam[:, :3], np.eye(3), atol=0.01):
        return f"{what}: Tr_velo_to_cam is the identity, and a camera's axes are x right, y down, z forward; {remedy}"
    if camera.image is None:
        return f"{what}: its image, whose size would count, is missing, or its calibration is another's; {remedy}"
    return f"{what}; {remedy}"


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
        image = find_file(folder / "image_2", frame_id, *IMAGES)
        camera = read_calibration(find_file(folder / "calib", frame_id, ".txt"))
        return replace(camera, size=_image_size(image), image=image) if image.is_file() else camera
    check_without_camera(folder, frame_id, labels)
    return None


def check_without_camera(folder: Path, frame_id: str, labels: Labels) -> None:
    """Raises InputError for labels with 2D boxes, whose axes must be those of a camera that is not there."""
    if (labels.bbox[:, 2:] > labels.bbox[:, :2]).any():
        raise InputError(
            f"{folder / 'calib'}: no such folder, but the labels of frame {frame_id} have 2D boxes; "
            "add it, or, without a camera, make the 2D boxes -1"
        )


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
            file = find_file(Path(root) / split_dir / folder, frame_id, suffix)
            if not file.is_file():
                raise InputError(f"{path}:{number}: frame {frame_id} has no {file}; add the file or remove the line")
        lines[frame_id] = number
    if not lines:
        raise InputError(f"{path}: names no frame; write one id a line")
    return list(lines)


def read_points(path: Path) -> NDArray[np.float32]:
    """Points (N, 4) of a velodyne .bin file as they are: x, y, z in metres and the reflectance, 0 if there is none."""
    raw = read_raw(Path(path))
    reflectance = np.zeros(len(raw.xyz), np.float32) if raw.reflectance is None else raw.reflectance
    return np.column_stack((raw.xyz, reflectance))


def write_points(path: Path, points: NDArray[np.float32]) -> None:
    """Writes points (N, 4) as a velodyne .bin file. Raises ValueError for another shape, and for what is no number."""
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 4:
        raise ValueError(f"points: want shape (N, 4) with x, y, z, reflectance, got {points.shape}")
    _check_real("points", points)
    with np.errstate(over="ignore"):  # what is too large for float32 becomes infinite, and the reader drops it
        Path(path).write_bytes(np.ascontiguousarray(points, dtype="<f4").tobytes())


def drop_non_finite(points: NDArray[np.float32]) -> tuple[NDArray[np.float32], int]:
    """The points (N, 4) whose four numbers are finite, and how many are not."""
    if np.isfinite(points).all():  # nearly always: spares the copy
        return points, 0
    finite = np.isfinite(points).all(axis=1)
    return points[finite], int((~finite).sum())


def read_labels(path: Path, scored: bool = False, *, needs_3d: bool = True) -> Labels:
    """Reads a label file, or a result file, whose lines end with a score (`scored`). An empty file means no objects.

    A 16th field in a label file, such as a score or an id of another tool, is ignored. Results may come without 3D
    boxes; so may labels, their three dimensions not positive, unless `needs_3d`.
    """
    lines = _read_lines(path, "the objects of a frame, one a line")
    rows = [line.split() for line in lines]
    sizes = (16,) if scored else (15, 16)
    for number, row in enumerate(rows, 1):
        if row and len(row) not in sizes:
            expected = "16 (class, 14 numbers and a score)" if scored else "15 (class, 14 numbers; a 16th is ignored)"
            raise InputError(f"{path}:{number}: {len(row)} fields, expected {expected}")
    rows = [row[: sizes[0]] for row in rows]
    try:
        labels = _labels([row for row in rows if row], scored)
    except ValueError:
        for number, row in enumerate(rows, 1):
            for field, text in enumerate(row[1:], 2):
                if not _is_number(text, whole=field == 3):
                    kind = "whole number" if field == 3 else "finite number"
                    raise InputError(f"{path}:{number}: field {field} is '{text[:60]}', not a {kind}") from None
        raise
    flat = (labels.dimensions <= 0) & (labels.name != DONTCARE)[:, None]
    wrong = flat.any(axis=1) & (needs_3d | ~flat.all(axis=1))
    if wrong.any() and not scored:
        number = [number for number, row in enumerate(rows, 1) if row][wrong.argmax()]
        raise InputError(
            f"{path}:{number}: height, width or length (fields 9 to 11) is not positive; give the object's size in "
            "metres, or remove the line"
        )
    return labels


def _labels(rows: list[list[str]], scored: bool = False) -> Labels:
    """Labels of the fields of every line; ValueError if one that should be a number is none."""
    values = np.array([[float(text) for text in row[1:]] for row in rows]).reshape(len(rows), 15 if scored else 14)
    occlusion = values[:, 1]
    if not np.isfinite(values).all() or (occlusion != np.trunc(occlusion)).any() or (np.abs(occlusion) > 2**31).any():
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
    return math.isfinite(value) and (not whole or (value == math.trunc(value) and abs(value) <= 2**31))


def write_labels(path: Path, labels: Labels) -> None:
    """Writes a label file with two decimals, as KITTI's are, or, where there are scores, a result file with four.

    Raises ValueError, and writes nothing, for what could not be read: a class that is not one word, a number that is
    not finite, an occlusion that is not whole, and in a label file a size of an object that is 0.00 or less.
    """
    _check_names("labels", labels.name.tolist())
    for field in fields(labels):
        column = getattr(labels, field.name)
        if column is not None and field.name != "name":
            _check_finite(f"labels.{field.name}", column)
    whole = labels.occlusion == np.trunc(labels.occlusion)
    if not whole.all():
        raise ValueError(f"labels.occlusion: want whole numbers, got {labels.occlusion[~whole][0]}")
    digits = 2 if labels.score is None else 4
    lines = []
    for k in range(len(labels)):
        # KITTI writes a number that is unknown, and all of DontCare but its 2D box, as a whole one
        unknown = labels.name[k] == DONTCARE
        after = 0 if unknown else digits
        numbers = [f"{labels.truncation[k]:.{0 if labels.truncation[k] < 0 else 2}f}", f"{int(labels.occlusion[k])}"]
        numbers.append(f"{labels.alpha[k]:.{after}f}")
        numbers += [f"{value:.{digits}f}" for value in labels.bbox[k]]
        size = [f"{value:.{after}f}" for value in labels.dimensions[k]]
        if labels.score is None and not unknown and min(map(float, size)) <= 0:
            raise ValueError(f"labels.dimensions: want sizes of 0.01 and more in row {k}, got {labels.dimensions[k]}")
        numbers += size
        numbers += [f"{value:.{after}f}" for value in (*labels.location[k], labels.rotation_y[k])]
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
        with np.errstate(all="ignore"):
            is_rotation = abs(np.linalg.det(found[key][:, :3]) - 1) <= 0.01
        if key != "P2" and not is_rotation:
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

    Raises ValueError for another shape or number, for a name that is not one word, for numbers that are not finite and
    for a label whose size is not above 0.
    """
    boxes = np.asarray(boxes)
    if boxes.ndim != 2 or boxes.shape[1] != 7:
        raise ValueError(f"boxes: want shape (M, 7) with x, y, z, l, w, h, yaw, got {boxes.shape}")
    _check_finite("boxes", boxes)
    if len(names) != len(boxes):
        raise ValueError(f"names: want one for each of the {len(boxes)} boxes, got {len(names)}")
    _check_names("names", names)
    if scores is not None:
        scores = np.asarray(scores)
        if scores.shape != (len(boxes),):
            raise ValueError(f"scores: want one for each of the {len(boxes)} boxes, got shape {scores.shape}")
        _check_finite("scores", scores)
    elif (flat := (boxes[:, 3:6] <= 0).any(axis=1)).any():
        raise ValueError(f"boxes: want l, w, h above 0, got {boxes[flat.argmax(), 3:6]} in row {flat.argmax()}")
    return box_rows(boxes, names, camera, scores)


def box_rows(
    boxes: NDArray[np.floating], names: Sequence[str], camera: Camera | None = None, scores: Floats | None = None
) -> Labels:
    """What `boxes_to_labels` returns, of objects that need not fit into a file: any name, sizes of 0."""
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


def _check_names(argument: str, names: Sequence[str]) -> None:
    split = [name for name in names if str(name).split() != [str(name)]]
    if split:
        raise ValueError(f"{argument}: want classes of one word each, got '{split[0]}'")


def _check_real(argument: str, values: NDArray) -> None:
    if values.dtype.kind not in "fiu":
        raise ValueError(f"{argument}: want real numbers, got dtype {values.dtype}")


def _check_finite(argument: str, values: NDArray) -> None:
    _check_real(argument, values)
    if not np.isfinite(values).all():
        raise ValueError(f"{argument}: want finite numbers, got {values[~np.isfinite(values)][0]}")


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
    return box_rows(frame.objects.boxes.double().numpy(), frame.objects.names, frame.camera)


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
        return Path(path).read_text(encoding="utf-8-sig").splitlines()  # some editors begin with a byte order mark
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; it holds {content}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file") from error
