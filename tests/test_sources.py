"""The clouds that a user names: files, folders and KITTI roots as one sequence, and every name but once."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from hvnet.data.frame import Frames, object_names
from hvnet.data.kitti import read_points
from hvnet.data.sources import CloudFiles, JoinedFrames, find_frames
from hvnet.exceptions import InputError


def write_cloud(path: Path, count: int = 3) -> Path:
    path.parent.mkdir(exist_ok=True)
    np.save(path, np.full((count, 4), 0.5, np.float32))
    return path


def test_files_and_folders_in_order(tmp_path: Path) -> None:
    """Files as they are named, those of a folder by name; other files of a folder do not matter."""
    last = write_cloud(tmp_path / "z.npy", 1)
    folder = tmp_path / "clouds"
    for name, count in (("b.npy", 3), ("a.npy", 2)):
        write_cloud(folder / name, count)
    (folder / "c.bin").write_bytes(bytes(64))
    (folder / "notes.txt").write_text("not a cloud")
    frames = find_frames([last, folder])
    assert frames.names == ["z", "a", "b", "c"]
    assert len(frames) == 4
    assert [len(frames[k].points) for k in range(4)] == [1, 2, 3, 4]
    assert [frames[k].name for k in range(4)] == frames.names
    for k in range(4):
        assert (frames[k].objects, frames[k].camera, object_names(frames, k)) == (None, None, None)


def test_notes_come_with_their_frames(tmp_path: Path) -> None:
    path = tmp_path / "cloud.npy"
    np.save(path, np.array([[1.0, 2, 3], [np.nan, 0, 0]]))
    frame = find_frames([path])[0]
    assert frame.points.tolist() == [[1, 2, 3, 0]]
    assert [note.split(": ")[1][:10] for note in frame.notes] == ["1 points t", "has no ref"]


def test_a_file_that_cannot_be_read_is_named_when_it_is_its_turn(tmp_path: Path) -> None:
    (tmp_path / "cut.bin").write_bytes(b"123")
    frames = find_frames([tmp_path])
    with pytest.raises(InputError, match=r"cut\.bin: 3 bytes are no multiple of 16"):
        frames[0]


def test_kitti_roots(scenes: Path, tmp_path: Path) -> None:
    """All their frames, or those of a split; labels where there are any."""
    every = find_frames([scenes])
    assert every.names == [f"{k:06d}" for k in range(6)]
    val = find_frames([scenes], "val")
    assert val.names == every.names[4:]
    frame = val[0]
    assert frame.name == "000004"
    assert frame.camera is not None
    assert frame.objects is not None
    assert list(frame.objects.names) == list(object_names(val, 0) or ())
    whole = read_points(scenes / "training" / "velodyne" / "000004.bin")
    assert len(frame.points) == frame.camera.sees(whole).sum()
    root = Path(shutil.copytree(scenes, tmp_path / "kitti"))
    (root / "training" / "label_2" / "000004.txt").unlink()
    (root / "training" / "label_2" / "000005.txt").write_text("")
    some = find_frames([root], "val")
    assert some[0].objects is None
    assert object_names(some, 0) is None
    assert some[1].objects is not None
    assert object_names(some, 1) == []


def test_the_test_set(scenes: Path, tmp_path: Path) -> None:
    """Its folder is testing, it has no labels, and KITTI's own download names its frames nowhere."""
    root = tmp_path / "kitti"
    for folder in ("velodyne", "calib"):
        (root / "testing" / folder).mkdir(parents=True)
        for path in sorted((scenes / "training" / folder).iterdir())[:2]:
            shutil.copy(path, root / "testing" / folder)
    for split in (None, "test"):
        frames = find_frames([root], split)
        assert frames.names == ["000000", "000001"]
        assert (frames[0].objects, object_names(frames, 0)) == (None, None)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "test.txt").write_text("000001\n")
    assert find_frames([root], "test").names == ["000001"]
    (root / "training").mkdir()
    with pytest.raises(InputError, match=r"training.velodyne: holds no \.bin file"):
        find_frames([root])
    assert find_frames([root], "test").names == ["000001"]
    (root / "training").rmdir()
    (root / "testing" / "calib" / "000001.txt").unlink()
    with pytest.raises(InputError, match=r"calib.000001\.txt: no such file; each frame needs one"):
        find_frames([root])


def test_a_root_without_a_camera(scenes: Path, tmp_path: Path) -> None:
    root = tmp_path / "lidar"
    (root / "training" / "velodyne").mkdir(parents=True)
    shutil.copy(scenes / "training" / "velodyne" / "000000.bin", root / "training" / "velodyne" / "a scan.bin")
    (frame,) = find_frames([root])
    assert (frame.name, frame.camera, frame.objects) == ("a scan", None, None)
    assert len(frame.points) == len(read_points(root / "training" / "velodyne" / "a scan.bin"))
    (root / "training" / "image_2").mkdir()
    with pytest.raises(InputError, match=r"training.calib: no such folder, but there is image_2"):
        find_frames([root])


def test_inputs_of_several_kinds(scenes: Path, tmp_path: Path) -> None:
    frames = find_frames([write_cloud(tmp_path / "a.npy"), scenes], "val")
    assert frames.names == ["a", "000004", "000005"]
    assert [frame.camera is None for frame in frames] == [True, False, False]


def test_mistakes(scenes: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "cloud.xyz").touch()
    good, same = write_cloud(tmp_path / "one" / "cloud.npy"), write_cloud(tmp_path / "two" / "cloud.npy")
    for inputs, message in (
        ([tmp_path / "none"], r"none: no such file or folder"),
        ([good, tmp_path / "none.bin"], r"none\.bin: no such file or folder"),
        ([good, tmp_path / "cloud.xyz"], r"cloud\.xyz: unknown kind of file; known: \.bin, \.npy, \.pcd, \.ply"),
        ([empty], r"empty: holds no cloud \(\.bin, \.npy, \.pcd, \.ply\) and is no KITTI root"),
        ([good, tmp_path / "two"], r"two.cloud\.npy: the name cloud is taken by .*one.cloud\.npy; rename one"),
        ([good, good], r"cloud\.npy: the name cloud is taken by .*cloud\.npy; rename one"),
        ([scenes, scenes], re.escape(f"{scenes}: the name 000000 is taken by {scenes}; rename one")),
    ):
        with pytest.raises(InputError, match=message):
            find_frames(inputs)
    with pytest.raises(InputError, match=r"none\.txt: no such file; it holds the frames of split 'none'"):
        find_frames([scenes], "none")
    with pytest.raises(InputError, match=r"^--split val: none of the inputs is a KITTI root$"):
        find_frames([same], "val")


def test_joined_frames(tmp_path: Path) -> None:
    """What is read is read when it is asked for; joined ones are such a sequence again."""
    parts = [CloudFiles([write_cloud(tmp_path / f"{name}.npy")]) for name in "ab"]
    joined = JoinedFrames([JoinedFrames(parts), CloudFiles([tmp_path / "missing.npy"])])
    assert joined.names == ["a", "b", "missing"]
    assert joined[1].name == "b"
    with pytest.raises(InputError, match=r"missing\.npy: cannot be read"):
        joined[2]
    assert len(JoinedFrames([])) == 0


# --- the scale of the reflectance ------------------------------------------------------------------------------------


def a_cloud(count: int, highest: float, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).uniform(-20, 20, (count, 4))
    points[:, 3] = np.linspace(0, highest, count)
    return points.astype(np.float32)


def brightest(frames: Frames) -> list[float]:
    return [float(frames[k].points[:, 3].max()) for k in range(len(frames))]


def test_one_sensor_has_one_scale(tmp_path: Path) -> None:
    """However dark a cloud is; files of another kind, or in another folder, are another sensor's."""
    for name, highest in (("a", 60000.0), ("b", 200.0), ("c", 0.9)):
        np.save(tmp_path / f"{name}.npy", a_cloud(500, highest))
    (tmp_path / "other").mkdir()
    np.save(tmp_path / "other" / "d.npy", a_cloud(500, 255.0))
    (tmp_path / "e.bin").write_bytes(a_cloud(500, 1.0).tobytes())
    frames = find_frames([tmp_path, tmp_path / "other"])
    wanted = {"a": 60000 / 65535, "b": 200 / 65535, "c": 0.9 / 65535, "d": 1.0, "e": 1.0}
    assert dict(zip(frames.names, brightest(frames), strict=True)) == pytest.approx(wanted, rel=1e-5)


def test_a_small_file_with_an_outlier_changes_no_other(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", a_cloud(500, 1.0))
    small = a_cloud(15, 1.0)
    small[7, 3] = 1e30
    np.save(tmp_path / "b.npy", small)
    assert brightest(find_frames([tmp_path])) == [1.0, 1.0]
    assert brightest(find_frames([tmp_path / "b.npy"])) == [1.0]


def test_paths_of_any_kind_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "a.npy", a_cloud(500, 255.0))
    (tmp_path / "there").mkdir()
    np.save(tmp_path / "there" / "b.npy", a_cloud(500, 255.0))
    monkeypatch.chdir(tmp_path)
    frames = find_frames([Path("a.npy"), tmp_path / "there" / "b.npy"])
    notes = [frames[k].notes for k in range(2)]
    assert notes == [["a.npy: reflectance was divided by 255"],
                     [f"{tmp_path / 'there' / 'b.npy'}: reflectance was divided by 255"]]  # fmt: skip


def test_beams_without_an_echo(tmp_path: Path) -> None:
    points = a_cloud(500, 1.0)
    points[100:300, :3] = 0
    np.save(tmp_path / "a.npy", points)
    frame = find_frames([tmp_path / "a.npy"])[0]
    assert len(frame.points) == 300
    assert frame.notes == [f"{tmp_path / 'a.npy'}: 200 points at 0, 0, 0, where no echo came back, were dropped"]
    points[100:291, :3] = 1
    np.save(tmp_path / "a.npy", points)
    assert len(find_frames([tmp_path / "a.npy"])[0].points) == 500  # nine points may be anything
