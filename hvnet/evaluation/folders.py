"""Folders of label and result files."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from hvnet.data.clouds import judge, read_raw
from hvnet.data.kitti import find_file, frame_camera, read_labels
from hvnet.data.labels import DONTCARE, Labels, no_results
from hvnet.evaluation.matching import Integers
from hvnet.evaluation.precision import count_points
from hvnet.exceptions import InputError


class Folders(NamedTuple):
    """What is read of a folder of label files and one of result files, frame by frame."""

    frames: list[str]  # names
    labels: list[Labels]
    predictions: list[Labels]
    missing: list[str]  # the frames without a result file, whose predictions are empty


def read_folders(
    label_dir: Path, prediction_dir: Path, frames_file: Path | None = None, missing_as_empty: bool = False
) -> Folders:
    """Reads the frames of all label files, or those that a file names, one a line.

    Raises InputError for a frame without a result file, unless `missing_as_empty`.
    """
    label_files = _frame_files(label_dir, "label files")
    prediction_files = _frame_files(prediction_dir, "result files", may_be_empty=missing_as_empty)
    if frames_file is None:
        frames = sorted(label_files)
        stray = sorted(prediction_files.keys() - label_files.keys())
        if stray:
            raise InputError(
                f"{prediction_files[stray[0]]}: frame {stray[0]} has no label file in {label_dir}; add it, or choose "
                "the frames to score with --frames"
            )
    else:
        frames = _read_frames(frames_file, label_files, label_dir)
    missing = [frame for frame in frames if frame not in prediction_files]
    if missing and not missing_as_empty:
        raise InputError(
            f"{prediction_dir}: no result file for {len(missing)} of {len(frames)} frames, the first is "
            f"{missing[0]}.txt; leave them out with --frames, or count them as empty with --missing-as-empty"
        )
    labels, predictions = [], []
    for frame in tqdm(frames, "reading", disable=None, leave=False):
        labels.append(read_labels(label_files[frame], needs_3d=False))
        if frame in prediction_files:
            predictions.append(read_labels(prediction_files[frame], scored=True))
        else:
            predictions.append(no_results())
    return Folders(frames, labels, predictions, missing)


def check_axes(label_dir: Path, prediction_dir: Path, folders: Folders) -> None:
    """Raises InputError where the 3D boxes of labels and results seem to be in different axes.

    What has 2D boxes is in a camera's axes; what has none, as that of bare clouds, is in camera axes at the LiDAR.
    """
    objects = [label.select(label.name != DONTCARE) for label in folders.labels]
    if not all(any(frame.has_3d().any() for frame in rows) for rows in (objects, folders.predictions)):
        return
    of_labels, of_results = (any(frame.has_2d().any() for frame in rows) for rows in (objects, folders.predictions))
    if of_labels != of_results:
        camera, bare = (label_dir, prediction_dir) if of_labels else (prediction_dir, label_dir)
        raise InputError(
            f"{camera} has 2D boxes, so its 3D boxes are in a camera's axes; {bare} has none, as those in axes at the "
            "LiDAR; detect in the KITTI root itself that the labels belong to or, if both are in the same axes all the "
            "same, add --same-axes"
        )


def _frame_files(folder: Path, content: str, may_be_empty: bool = False) -> dict[str, Path]:
    """The .txt files of a folder by frame; KITTI names frames by number, and one number must not come twice."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; it holds the {content}, one FRAME.txt a frame")
    files: dict[str, Path] = {}
    numbers: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() == ".txt":
            number = path.stem.lstrip("0") if path.stem.isdigit() else path.stem
            if number in numbers:
                raise InputError(f"{path}: the same frame as {numbers[number]}; remove one of them")
            numbers[number] = files[path.stem] = path
    if not files and not may_be_empty:
        raise InputError(f"{folder}: no .txt file; it holds the {content}, one FRAME.txt a frame")
    return files


def _read_frames(path: Path, label_files: dict[str, Path], label_dir: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text; it names the frames to score, one a line") from error
    seen: dict[str, int] = {}
    for number, line in enumerate(lines, 1):
        frame = line.strip()
        if not frame:
            continue
        if frame in seen:
            raise InputError(f"{path}:{number}: frame {frame} is already on line {seen[frame]}; remove one")
        if frame not in label_files:
            raise InputError(f"{path}:{number}: frame {frame} is not in {label_dir}; add its labels or remove the line")
        seen[frame] = number
    if not seen:
        raise InputError(f"{path}: names no frame; write one a line")
    return list(seen)


def read_point_counts(
    folder: Path, frames: Sequence[str], labels: Sequence[Labels], columns: Sequence[str] = ()
) -> list[Integers]:
    """The points (K,) in the boxes of every frame's labels, of the clouds of a folder with velodyne/ and calib/.

    columns: the numbers of a point; they are found out if none are given.
    """
    counts = []
    for frame, label in zip(tqdm(frames, "counting points", disable=None, leave=False), labels, strict=True):
        raw = read_raw(find_file(folder / "velodyne", frame, ".bin"), columns)
        counts.append(count_points(judge(raw, 1.0).points, label, frame_camera(folder, frame, label)))
    return counts
