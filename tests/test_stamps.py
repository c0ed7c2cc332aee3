"""Stamps of frames: which bytes they are made of, what is read for them, and what counts as a change."""

import io
import os
import shutil
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.config import DataConfig
from hvnet.data.kitti import KittiFrames
from hvnet.data.stamps import (
    CHUNK,
    CLOUD,
    LABELS,
    Change,
    Stamp,
    Stamps,
    describe_changes,
    find_changes,
    stamp_files,
    stamp_of,
    take_stamps,
)
from tests.helpers import GivenFrames

IDS = ["000000", "000001", "000002"]


@pytest.fixture
def files(tmp_path: Path) -> tuple[list[Path], Path]:
    """Two small files and a cloud of more than a chunk."""
    small, cloud = [tmp_path / "label.txt", tmp_path / "calib.txt"], tmp_path / "cloud.bin"
    small[0].write_bytes(b"Car")
    small[1].write_bytes(b"P2: 1")
    cloud.write_bytes(bytes(range(256)) * (CHUNK // 256) + b"rest")
    os.utime(cloud, ns=(5, 1544425448401234567))
    return small, cloud


def test_what_a_stamp_says(files: tuple[list[Path], Path]) -> None:
    stamp = stamp_files(files[0], "options", files[1])
    assert stamp.labels == zlib.crc32(b"options3:Car5:P2: 1")
    assert (stamp.size, stamp.modified) == (CHUNK + 4, 1544425448401234567)
    assert stamp.content() == zlib.crc32(files[1].read_bytes())


def test_the_small_files_and_the_options_are_told_apart(files: tuple[list[Path], Path]) -> None:
    """A byte that moves from one file to the next, an empty file, and none."""
    small, cloud = files
    seen = {stamp_files(small, "", cloud).labels, stamp_files(small, "columns", cloud).labels}
    for contents in [(b"CarP", b"2: 1"), (b"", b"P2: 1"), (None, b"P2: 1"), (b"Car", b""), (b"Car", None)]:
        for path, content in zip(small, contents, strict=True):
            path.unlink(missing_ok=True)
            if content is not None:
                path.write_bytes(content)
        seen.add(stamp_files(small, "", cloud).labels)
    assert len(seen) == 7


def test_a_cloud_that_is_not_there(files: tuple[list[Path], Path]) -> None:
    small, cloud = files
    stamp = stamp_files(small, "", cloud)
    cloud.unlink()
    assert stamp.content() == 0
    missing = stamp_files(small, "", cloud)
    assert (missing.size, missing.modified, missing.content()) == (-1, 0, 0)


def test_the_stamp_of_a_kitti_frame(copied: Path) -> None:
    """Of its label file, calibration and cloud, and of the options of reading; not of how much of it is kept."""
    frames = KittiFrames(copied, IDS)
    first, training = stamp_of(frames, 1), copied / "training"
    assert first is not None
    assert first.size == (training / "velodyne" / "000001.bin").stat().st_size
    assert first.content() == zlib.crc32((training / "velodyne" / "000001.bin").read_bytes())
    assert stamp_of(KittiFrames(copied, IDS, crop=False), 1)[:3] == first[:3]  # type: ignore[index]
    assert frames.stamp(0).labels != first.labels
    assert KittiFrames(copied, IDS, reading=DataConfig(classes={"Van": "Car"})).stamp(1).labels != first.labels
    (training / "label_2" / "000001.txt").rename(training / "label_2" / "000001.TXT")
    assert frames.stamp(1).labels == first.labels
    for path in (training / "label_2" / "000001.TXT", training / "calib" / "000001.txt"):
        before = frames.stamp(1).labels
        path.write_bytes(path.read_bytes() + b"\n")
        assert frames.stamp(1).labels != before


def test_formats_without_stamps() -> None:
    frames = GivenFrames(ValueError("unread"))
    assert stamp_of(frames, 0) is None
    assert take_stamps(frames) is None


def test_a_cloud_is_read_where_size_or_time_is_not_known() -> None:
    read: list[str] = []

    class Own(GivenFrames):
        def stamp(self, k: int) -> Stamp:
            return Stamp(k, 10 + k, 20, lambda: read.append(self.names[k]) or 30)

    frames = Own(*[ValueError("unread")] * 4)
    now = take_stamps(frames)
    assert now is not None
    assert now.names == read == ["frame 0", "frame 1", "frame 2", "frame 3"]
    np.testing.assert_array_equal(now.numbers, [[0, 10, 20, 30], [1, 11, 20, 30], [2, 12, 20, 30], [3, 13, 20, 30]])
    read.clear()
    known = Stamps(["frame 1", "frame 3", "frame 2"], np.array([[7, 11, 20, 6], [3, 13, 21, 6], [2, 11, 20, 6]]))
    again = take_stamps(frames, [3, 2, 1], known)
    assert again is not None
    assert again.names == ["frame 3", "frame 2", "frame 1"]
    assert again.numbers[:, 3].tolist() == [30, 30, 6]
    assert read == ["frame 3", "frame 2"]


def test_what_is_a_change() -> None:
    before = Stamps(list("abcdef"), np.array([[1, 2, 3, 4]] * 6))
    rows = [[1, 2, 9, 4], [9, 2, 3, 4], [1, 9, 3, 4], [1, 2, 3, 9], [9, 9, 9, 9], [9, 9, 9, 9]]
    now = Stamps(list("abcdez"), np.array(rows))
    both = f"{LABELS}; {CLOUD}"
    changes = [Change("b", LABELS), Change("c", CLOUD), Change("d", CLOUD), Change("e", both)]
    assert find_changes(before, now) == changes
    assert describe_changes(changes) == f"frames have changed: b ({LABELS}) and 3 more"
    assert describe_changes(changes[3:]) == f"frames have changed: e ({both})"


def test_a_copied_root_has_not_changed(copied: Path, tmp_path: Path) -> None:
    before = take_stamps(KittiFrames(copied, IDS))
    other = shutil.copytree(copied, tmp_path / "other", copy_function=shutil.copyfile)
    for path in (other / "training" / "velodyne").iterdir():
        os.utime(path, ns=(0, 0))
    now = take_stamps(KittiFrames(other, IDS), known=before)
    assert before is not None
    assert now is not None
    assert (before.numbers[:, 2] != now.numbers[:, 2]).all()
    np.testing.assert_array_equal(before.numbers[:, [0, 1, 3]], now.numbers[:, [0, 1, 3]])
    assert find_changes(before, now) == []


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"numbers: want shape \(2, 4\), got \(1, 4\)"):
        Stamps(["a", "b"], np.zeros((1, 4), np.int64))


def test_all_of_kitti_is_small() -> None:
    """7,481 frames in a checkpoint take less than 300 kB."""
    rng = np.random.default_rng(0)
    stamps = Stamps([f"{k:06d}" for k in range(7481)], rng.integers(2**62, size=(7481, 4)))
    file = io.BytesIO()
    torch.save({"stamps": torch.from_numpy(stamps.numbers)}, file)
    assert len(file.getvalue()) < 300_000
