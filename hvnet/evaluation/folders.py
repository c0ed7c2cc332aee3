"""Folders of label and result files."""

from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from hvnet.data.kitti import drop_non_finite, frame_camera, read_labels, read_points
from hvnet.data.labels import Labels, no_results
from hvnet.evaluation.matching import Integers
from hvnet.evaluation.precision import count_points
from hvnet.exceptions import InputError


def read_folders(
    label_dir: Path, prediction_dir: Path, frames_file: Path | None = None, missing_as_empty: bool = False
) -> tuple[list[str], list[Labels], list[Labels]]:
    """The frames' names, labels and predictions: of all label files, or of the frames that a file names, one a line."""
    label_files = _frame_files(label_dir, "label files")
    prediction_files = _frame_files(prediction_dir, "result files")
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
        labels.append(read_labels(label_files[frame]))
        if frame in prediction_files:
            predictions.append(read_labels(prediction_files[frame], scored=True))
        else:
            predictions.append(no_results())
    return frames, labels, predictions


def _frame_files(folder: Path, content: str) -> dict[str, Path]:
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
    if not files:
        raise InputError(f"{folder}: no .txt file; it holds the {content}, one FRAME.txt a frame")
    return files


def _read_frames(path: Path, label_files: dict[str, Path], label_dir: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
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


def read_point_counts(folder: Path, frames: Sequence[str], labels: Sequence[Labels]) -> list[Integers]:
    """The points (K,) in the boxes of every frame's labels, of the clouds of a folder with velodyne/ and calib/."""
    counts = []
    for frame, label in zip(tqdm(frames, "counting points", disable=None, leave=False), labels, strict=True):
        points, _ = drop_non_finite(read_points(folder / "velodyne" / f"{frame}.bin"))
        counts.append(count_points(points, label, frame_camera(folder, frame, label)))
    return counts
