"""The ground-truth database: built from frames, written, read, compared with the real one, and refused when broken."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.cli import InputError
from hvnet.data.database import (
    LAYOUT,
    Database,
    build_database,
    main,
    object_points,
    read_database,
    write_database,
)
from hvnet.data.kitti import Calibration, read_points, read_split, write_calibration, write_points

# a camera at the LiDAR's origin that looks along +x
CALIB = Calibration(
    p2=np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    r0_rect=np.eye(3),
    velo_to_cam=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]),
)
# boxes in LiDAR axes: (10, 2, 0, 4, 2, 2, 0) and (20, -5, 0.5, 1, 1, 1, 0)
OBJECTS = (
    "Car 0.25 1 0 100 120 300 240.5 2 2 4 -2 1 10 -1.5707963267948966\n"
    "DontCare -1 -1 -10 0 0 10 10 -1 -1 -1 -1000 -1000 -1000 -10\n"
    "Pedestrian 0 0 0 100 120 300 160 1 1 1 5 0 20 -1.5707963267948966\n"
)
POINTS = np.array(
    [
        [10.001, 2.002, 0.003, 0.25],  # in the car
        [20, -5, 0.5, 0],  # in the pedestrian
        [8, 1, -1, 1],  # a corner of the car
        [7.99, 1, -1, 1],  # just outside
        [np.nan, 2, 0, 1],
    ],
    dtype=np.float32,
)


def write_frame(root: Path, frame_id: str, labels: str) -> None:
    for folder in ("velodyne", "calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True, exist_ok=True)
    write_points(root / "training" / "velodyne" / f"{frame_id}.bin", POINTS)
    write_calibration(root / "training" / "calib" / f"{frame_id}.txt", CALIB)
    (root / "training" / "label_2" / f"{frame_id}.txt").write_text(labels)
    (root / "ImageSets").mkdir(exist_ok=True)
    with (root / "ImageSets" / "train.txt").open("a") as file:
        file.write(f"{frame_id}\n")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_frame(tmp_path, "000003", OBJECTS)
    write_frame(tmp_path, "000005", "")
    write_frame(tmp_path, "000007", OBJECTS)
    return tmp_path


def assert_same(a: Database, b: Database) -> None:
    for name in LAYOUT:
        assert getattr(a, name).dtype == getattr(b, name).dtype, name
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_build_database(root: Path) -> None:
    database = build_database(root, read_split(root, "train"))
    assert len(database) == 4
    assert database.name.tolist() == ["Car", "Pedestrian"] * 2
    assert database.frame.tolist() == [3, 3, 7, 7]
    assert database.label_row.tolist() == [0, 2, 0, 2]
    assert database.offsets.tolist() == [0, 2, 3, 5, 6]
    assert database.centre_mm[:2].tolist() == [[10000, 2000, 0], [20000, -5000, 500]]
    assert database.xyz_mm[:, :3].T.tolist() == [[1, 2, 3], [-2000, -1000, -1000], [0, 0, 0]]
    assert database.reflectance[:3].tolist() == [25, 100, 0]
    assert database.truncation[:2].tolist() == [0.25, 0]
    assert database.occlusion[:2].tolist() == [1, 0]
    assert database.bbox_height[:2].tolist() == [120.5, 40]
    np.testing.assert_allclose(database.box[0], [10, 2, 0, 4, 2, 2, 0], atol=1e-6)
    np.testing.assert_allclose(database.box[1], [20, -5, 0.5, 1, 1, 1, 0], atol=1e-6)


def test_object_points(root: Path) -> None:
    database = build_database(root, read_split(root, "train"))
    points = object_points(database)
    assert points.dtype == torch.float32
    assert torch.equal(points[database.offsets[2] : database.offsets[3]], torch.from_numpy(POINTS[[0, 2]]))


def test_write_and_read(root: Path) -> None:
    database = build_database(root, read_split(root, "train"))
    write_database(root / "a.npz", database)
    assert_same(read_database(root / "a.npz"), database)
    assert not list(root.glob("*.partial"))


def test_a_failed_write_leaves_nothing(root: Path) -> None:
    (root / "folder.npz").mkdir()
    with pytest.raises(OSError, match=re.escape("folder.npz")):
        write_database(root / "folder.npz", build_database(root, read_split(root, "train")))
    assert not list(root.glob("*.partial"))


def test_real_database_is_reproduced(kitti_root: Path) -> None:
    """Every point, its order and its reflectance; the yaw may differ in the last bit of its float32."""
    built = build_database(kitti_root, read_split(kitti_root, "train"))
    real = read_database(kitti_root / "gt_database.npz")
    rows = np.flatnonzero(np.isin(real.frame, built.frame))
    assert len(rows) == len(built) == 153
    for name in LAYOUT:
        if name == "box":
            np.testing.assert_allclose(built.box, real.box[rows], atol=5e-7)
        elif name not in ("xyz_mm", "reflectance", "offsets"):
            np.testing.assert_array_equal(getattr(built, name), getattr(real, name)[rows], err_msg=name)
    points, real_points = object_points(built), object_points(real)
    for k, row in enumerate(rows):
        mine = points[built.offsets[k] : built.offsets[k + 1]]
        assert torch.equal(mine, real_points[real.offsets[row] : real.offsets[row + 1]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"box": None}, "has no array 'box'; build it with"),
        ({"box": np.zeros((4, 6), np.float32)}, "'box' has shape (4, 6), expected (4, 7)"),
        ({"offsets": np.arange(4)}, "'offsets' has shape (4,), expected (5,)"),
        ({"xyz_mm": np.zeros((6, 3), np.int16)}, "'xyz_mm' has shape (6, 3), expected (3, 6)"),
        ({"xyz_mm": np.zeros((3, 6))}, "'xyz_mm' is float64, expected int16"),
        ({"name": np.arange(4)}, "'name' is int64, expected str"),
        ({"name": np.array("Car")}, "'offsets' has shape (5,), expected (2,)"),
        ({"offsets": np.array([0, 2, 1, 5, 6])}, "'offsets' does not rise from 0 to the number of points, 6"),
        ({"offsets": np.array([0, 2, 3, 5, 7])}, "'offsets' does not rise from 0 to the number of points, 6"),
        ({"box": np.full((4, 7), np.nan, np.float32)}, "'box' holds numbers that are not finite"),
    ],
)
def test_broken_arrays_are_named(root: Path, changes: dict[str, np.ndarray | None], message: str) -> None:
    database = build_database(root, read_split(root, "train"))
    path = root / "broken.npz"
    arrays = {name: getattr(database, name) for name in LAYOUT} | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=re.escape(f"{path}: {message}")):
        read_database(path)


def test_broken_files_are_named(root: Path) -> None:
    path = root / "a.npz"
    with pytest.raises(InputError, match=re.escape(f"{path}: no such file; build it with")):
        read_database(path)
    write_database(path, build_database(root, read_split(root, "train")))
    whole = path.read_bytes()
    damaged = whole[:60] + bytes(20) + whole[80:]
    for content in (b"", b"no archive", whole[: len(whole) // 2], damaged):
        path.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(f"{path}: not a whole .npz file")):
            read_database(path)


def test_a_frame_that_is_no_number_is_named(root: Path) -> None:
    write_frame(root, "street", OBJECTS)
    with pytest.raises(InputError, match=re.escape(f"{root}: frame 'street' is no number")):
        build_database(root, read_split(root, "train"))


@pytest.mark.parametrize("scale", [255, -1])
def test_reflectance_of_another_scale_is_refused(root: Path, scale: int) -> None:
    path = root / "training" / "velodyne" / "000003.bin"
    points = read_points(path)
    points[:, 3] *= scale
    write_points(path, points)
    with pytest.raises(InputError, match=re.escape(f"frame 000003 of {root}: the object of label row")) as raised:
        build_database(root, ["000003"])
    assert "want 0 to 1; divide the clouds' by their scale, such as 255" in str(raised.value)


def test_a_split_without_objects_is_named(tmp_path: Path) -> None:
    write_frame(tmp_path, "000005", "")
    with pytest.raises(InputError, match=re.escape(f"{tmp_path}: no object is labelled in its 1 frames")):
        build_database(tmp_path, read_split(tmp_path, "train"))


def test_command(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--data", str(root)])
    path = root / "gt_database.npz"
    assert_same(read_database(path), build_database(root, read_split(root, "train")))
    assert "4 objects, 6 points" in capsys.readouterr().out
    with pytest.raises(InputError, match=re.escape(f"{path}: exists already")):
        main(["--data", str(root)])
    with pytest.raises(InputError, match=re.escape(f"{root / 'none'}: no folder that can be written")):
        main(["--data", str(root), "--out", str(root / "none" / "a.npz")])
    with pytest.raises(InputError, match=r"val\.txt: no such file"):
        main(["--data", str(root), "--split", "val", "--out", str(root / "b.npz")])
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "--split" in capsys.readouterr().out
