"""The drives of frames: how the file is read, what is wrong with it, and what a frame of a long drive counts."""

import re
from pathlib import Path

import pytest

from hvnet.data.drives import drive_weights, read_drives
from hvnet.data.kitti import read_split
from hvnet.exceptions import InputError


def test_drives_are_read_by_name(tmp_path: Path) -> None:
    path = tmp_path / "drives.csv"
    lines = [
        b"\xef\xbb\xbfindex,drive,frame",
        b"7,street, 000003",
        b'0,"a, b",000001',
        b"1,other,000002",
        b"7,street,000003",
    ]
    path.write_bytes(b"\r\n".join(lines))
    assert read_drives(path, ["000001", "000003"]) == ["a, b", "street"]
    assert read_drives(path, []) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "drives.csv: no such file; give a CSV file with the columns frame,drive"),
        ("", "drives.csv:1: has no column frame; the first line is to be frame,drive"),
        ("drive,index\n", "drives.csv:1: has no column frame; "),
        ("frame,street\n1,a\n", "drives.csv:1: has no column drive; "),
        ("frame,drive\n1,a\n", "drives.csv: has no drive for 1 of 2 frames, such as 2; add a line for each"),
        ("frame,drive\n1\n2,a\n", "drives.csv:2: want a frame and its drive; complete or remove the line"),
        ("frame,drive\n,a\n", "drives.csv:2: want a frame and its drive; "),
        ("frame,drive\n1,a\n2,a\n1,b\n", "drives.csv:4: frame 1 is already in drive a; remove a line"),
        (b"frame,drive\n1,\xff\n", "drives.csv: cannot be read ('utf-8' codec"),
    ],
)
def test_mistakes(tmp_path: Path, text: str | bytes | None, message: str) -> None:
    path = tmp_path / "drives.csv"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=re.escape(message)):
        read_drives(path, ["1", "2"])


def test_a_folder_in_its_place(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(f"{tmp_path}: cannot be read (Is a directory)")):
        read_drives(tmp_path, [])


def test_weights() -> None:
    assert drive_weights(["a", "b", "a", "c", "a", "a"]).tolist() == [0.5, 1, 0.5, 1, 0.5, 0.5]
    assert drive_weights([]).tolist() == []


def test_drives_of_real_frames(kitti_root: Path) -> None:
    """No drive is on both sides of the split; the longest has a quarter of the frames, and a tenth of what is drawn."""
    drives = {name: read_drives(kitti_root / "drives.csv", read_split(kitti_root, name)) for name in ("train", "val")}
    assert not set(drives["train"]) & set(drives["val"])
    longest = [drive == max(drives["train"], key=drives["train"].count) for drive in drives["train"]]
    assert sum(longest) == 51
    weights = drive_weights(drives["train"])
    assert (weights[longest].sum() / weights.sum()).item() == pytest.approx(0.103, abs=0.001)
