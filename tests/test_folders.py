"""Folders of label and result files: which frames are scored, and what is refused."""

import re
from pathlib import Path

import numpy as np
import pytest

from hvnet.data.kitti import boxes_to_labels, write_labels, write_points
from hvnet.evaluation.folders import check_axes, read_folders, read_point_counts
from hvnet.evaluation.precision import evaluate
from hvnet.exceptions import InputError
from tests.helpers import LINE, write_folders


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Two frames with one car each, found in both."""
    return write_folders(tmp_path)


@pytest.mark.parametrize("line", [LINE + " nan", LINE, LINE + " x", LINE.replace("20.00", "inf") + " 1"])
def test_malformed_line_is_named(folders: tuple[Path, Path], line: str) -> None:
    (folders[1] / "000007.txt").write_text(f"{LINE} 0.5\n{line}\n")
    with pytest.raises(InputError, match=r"000007\.txt:2: "):
        read_folders(*folders)


def test_missing_as_empty_counts_the_ground_truths(folders: tuple[Path, Path]) -> None:
    (folders[1] / "000007.txt").unlink()
    with pytest.raises(InputError, match=r"no result file for 1 of 2 frames, the first is 000007\.txt.*--frames"):
        read_folders(*folders)
    frames, labels, predictions, missing = read_folders(*folders, missing_as_empty=True)
    assert frames == ["000003", "000007"]
    assert missing == ["000007"]
    assert [len(each) for each in predictions] == [1, 0]
    assert evaluate(labels, predictions)["Car"]["exact"]["3d"] == [50, 50, 50]


def test_files_are_counted_by_what_was_found(folders: tuple[Path, Path]) -> None:
    """In either case of the suffix."""
    (folders[1] / "000007.txt").rename(folders[1] / "000007.TXT")
    found = read_folders(*folders)
    assert found.missing == []
    assert [len(each) for each in found.predictions] == [1, 1]


def test_no_result_file_at_all(folders: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "log.csv").write_text("")
    with pytest.raises(InputError, match=r"empty: no \.txt file; it holds the result files"):
        read_folders(folders[0], tmp_path / "empty")
    found = read_folders(folders[0], tmp_path / "empty", missing_as_empty=True)
    assert found.missing == found.frames == ["000003", "000007"]
    assert evaluate(found.labels, found.predictions)["Car"]["counts"]["ground_truths"] == [2] * 3
    with pytest.raises(InputError, match="none: no such folder; it holds the result files"):
        read_folders(folders[0], tmp_path / "none", missing_as_empty=True)
    with pytest.raises(InputError, match=r"empty: no \.txt file; it holds the label files"):
        read_folders(tmp_path / "empty", folders[1], missing_as_empty=True)


def test_byte_order_marks(folders: tuple[Path, Path], tmp_path: Path) -> None:
    for folder, ending in zip(folders, ("", " 0.75"), strict=True):
        (folder / "000007.txt").write_text(LINE + ending, encoding="utf-8-sig")
    path = tmp_path / "frames.txt"
    path.write_text("000007\n", encoding="utf-8-sig")
    found = read_folders(*folders, frames_file=path)
    assert found.frames == ["000007"]
    assert found.labels[0].name.tolist() == found.predictions[0].name.tolist() == ["Car"]


NO_3D = LINE.replace("1.50 2.00 4.00 1.00 1.60 20.00", "-1 -1 -1 -1000 -1000 -1000")
NO_2D = LINE.replace("100.00 100.00 160.00 150.00", "-1 -1 -1 -1")
REGION = "DontCare -1 -1 -10 100 100 160 150 -1 -1 -1 -1000 -1000 -1000 -10"


@pytest.mark.parametrize(
    ("label", "result", "refused"),
    [
        (LINE, LINE, False),
        (NO_2D, NO_2D, False),
        (LINE, NO_2D, True),
        (NO_2D, LINE, True),
        (f"{NO_2D}\n{REGION}", LINE, True),  # a region is in the image, whatever the axes of the objects
        (f"{NO_2D}\n{REGION}", NO_2D, False),
        (f"{LINE}\n{NO_2D}", NO_2D, True),
        (LINE, NO_3D, False),  # nothing in 3D to compare
        (NO_3D, LINE, False),
        (NO_2D, NO_3D, False),
        (f"{NO_2D}\n{NO_3D}", LINE, False),
        (LINE, "", False),
    ],
)
def test_axes_of_labels_and_results(folders: tuple[Path, Path], label: str, result: str, refused: bool) -> None:
    for frame in ("000003", "000007"):
        (folders[0] / f"{frame}.txt").write_text(label)
        (folders[1] / f"{frame}.txt").write_text(f"{result} 0.5" if result else "")
    found = read_folders(*folders)
    if not refused:
        check_axes(*folders, found)
        return
    camera, bare = folders if LINE in label else folders[::-1]
    message = re.escape(f"{camera} has 2D boxes, so its 3D boxes are in a camera's axes; {bare} has none")
    with pytest.raises(InputError, match=f"^{message}.*detect in the KITTI root itself.*--same-axes$"):
        check_axes(*folders, found)


def test_empty_files_are_frames_without_objects(folders: tuple[Path, Path]) -> None:
    for folder in folders:
        (folder / "000007.txt").write_text("")
    _, labels, predictions, _ = read_folders(*folders)
    assert [len(each) for each in (*labels, *predictions)] == [1, 0, 1, 0]
    assert evaluate(labels, predictions)["Car"]["exact"]["3d"] == [100, 100, 100]


def test_prediction_for_a_frame_without_label(folders: tuple[Path, Path]) -> None:
    (folders[1] / "000009.txt").write_text("")
    with pytest.raises(InputError, match=r"results/000009\.txt: frame 000009 has no label file"):
        read_folders(*folders)


def test_frames_of_a_file(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """In its order; frames beside them may have labels or results, or not."""
    path = tmp_path / "frames.txt"
    path.write_text("000007\n\n 000003\n")
    assert read_folders(*folders, frames_file=path)[0] == ["000007", "000003"]
    path.write_text("000003\n")
    (folders[1] / "000007.txt").unlink()
    (folders[1] / "000009.txt").write_text("")
    assert read_folders(*folders, frames_file=path)[0] == ["000003"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"000003\n000008\n", r"frames\.txt:2: frame 000008 is not in .*label_2; add its labels or remove the line"),
        (b"000003\n000007\n000003\n", r"frames\.txt:3: frame 000003 is already on line 1; remove one"),
        (b"\n", r"frames\.txt: names no frame"),
        (b"\xff\xfe", r"frames\.txt: cannot be read as text"),
    ],
)
def test_wrong_frames_file(folders: tuple[Path, Path], tmp_path: Path, text: bytes, message: str) -> None:
    path = tmp_path / "frames.txt"
    path.write_bytes(text)
    with pytest.raises(InputError, match=message):
        read_folders(*folders, frames_file=path)


def test_duplicate_file(folders: tuple[Path, Path]) -> None:
    (folders[1] / "3.txt").write_text("")
    with pytest.raises(InputError, match=r"results/3\.txt: the same frame as .*000003\.txt"):
        read_folders(*folders)


def test_wrong_folders(folders: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none: no such folder; it holds the label files"):
        read_folders(tmp_path / "none", folders[1])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"empty: no \.txt file; it holds the result files"):
        read_folders(folders[0], tmp_path / "empty")


def test_point_counts_without_a_camera(folders: tuple[Path, Path], tmp_path: Path) -> None:
    """No calib beside the clouds: there is no camera, unless labels have 2D boxes."""
    root = tmp_path / "lidar"
    (root / "velodyne").mkdir(parents=True)
    boxes = np.array([[10.0, 1.0, -1.0, 4.0, 1.6, 1.5, 0.3], [-9.0, -3.0, -1.0, 4.0, 1.6, 1.5, 0.0]])
    write_labels(tmp_path / "label_2" / "000000.txt", boxes_to_labels(boxes, ["Car", "lorry"]))
    cloud = np.array([[-9, -3, -1, 0]] * 20 + [[np.nan] * 4], dtype=np.float32)
    write_points(root / "velodyne" / "000000.bin", cloud)
    labels = read_folders(*folders, missing_as_empty=True).labels
    assert [counts.tolist() for counts in read_point_counts(root, ["000000"], labels[:1])] == [[0, 20]]
    write_points(root / "velodyne" / "000003.bin", cloud)
    message = re.escape(f"{root / 'calib'}: no such folder, but the labels of frame 000003 have 2D boxes")
    with pytest.raises(InputError, match=message):
        read_point_counts(root, ["000003"], labels[1:2])
