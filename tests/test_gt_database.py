"""The ground-truth database: built from frames, written, read, compared with the real one, and refused when broken."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.data.frame import Camera, Frame, Objects
from hvnet.data.gt_database import (
    LAYOUT,
    Database,
    build_database,
    load_database,
    object_points,
    read_database,
    write_database,
)
from hvnet.data.kitti import KittiFrames, read_points, read_split, write_calibration, write_points
from hvnet.exceptions import InputError
from tests.helpers import CAMERA

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
    write_calibration(root / "training" / "calib" / f"{frame_id}.txt", CAMERA)
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


def every_frame(root: Path, split: str = "train") -> KittiFrames:
    return KittiFrames(root, read_split(root, split), crop=False)


def assert_same(a: Database, b: Database) -> None:
    for name in LAYOUT:
        assert getattr(a, name).dtype == getattr(b, name).dtype, name
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def test_build_database(root: Path) -> None:
    database = build_database(every_frame(root))
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
    database = build_database(every_frame(root))
    points = object_points(database)
    assert points.dtype == torch.float32
    assert torch.equal(points[database.offsets[2] : database.offsets[3]], torch.from_numpy(POINTS[[0, 2]]))


def test_write_and_read(root: Path) -> None:
    database = build_database(every_frame(root))
    write_database(root / "a.npz", database)
    assert_same(read_database(root / "a.npz"), database)
    assert not list(root.glob("*.partial"))


def test_a_failed_write_leaves_nothing(root: Path) -> None:
    (root / "folder.npz").mkdir()
    with pytest.raises(OSError, match=re.escape("folder.npz")):
        write_database(root / "folder.npz", build_database(every_frame(root)))
    assert not list(root.glob("*.partial"))


def test_real_database_is_reproduced(kitti_root: Path) -> None:
    """Every point, its order and its reflectance; the yaw may differ in the last bit of its float32."""
    built = build_database(every_frame(kitti_root, "train_first"))
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
    database = build_database(every_frame(root))
    path = root / "broken.npz"
    arrays = {name: getattr(database, name) for name in LAYOUT} | changes
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=re.escape(f"{path}: {message}")):
        read_database(path)


def test_broken_files_are_named(root: Path) -> None:
    path = root / "a.npz"
    with pytest.raises(InputError, match=re.escape(f"{path}: no such file; build it with")):
        read_database(path)
    write_database(path, build_database(every_frame(root)))
    whole = path.read_bytes()
    damaged = whole[:60] + bytes(20) + whole[80:]
    for content in (b"", b"no archive", whole[: len(whole) // 2], damaged):
        path.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(f"{path}: not a whole .npz file")):
            read_database(path)


def test_a_frame_that_is_no_number_is_named(root: Path) -> None:
    write_frame(root, "street", OBJECTS)
    with pytest.raises(InputError, match="frame 'street': is no number below"):
        build_database(every_frame(root))


@pytest.mark.parametrize("scale", [255, -1])
def test_reflectance_of_another_scale_is_refused(root: Path, scale: int) -> None:
    path = root / "training" / "velodyne" / "000003.bin"
    points = read_points(path)
    points[:, 3] *= scale
    write_points(path, points)
    with pytest.raises(InputError, match="frame 000003: the object of label row") as raised:
        build_database(KittiFrames(root, ["000003"], crop=False))
    assert "want 0 to 1; divide the clouds' by their scale, such as 255" in str(raised.value)


def test_a_split_without_objects_is_named(tmp_path: Path) -> None:
    write_frame(tmp_path, "000005", "")
    with pytest.raises(InputError, match="no object is labelled in the 1 frames"):
        build_database(every_frame(tmp_path))


def test_frames_that_are_wanted(root: Path) -> None:
    frames = every_frame(root)
    assert build_database(frames, [2]).frame.tolist() == [7, 7]
    with pytest.raises(InputError, match="no object is labelled in the 3 frames"):
        build_database(frames, [1])


class Scans:
    """Frames of another format: two of a cone and a truck, with times for names."""

    def __init__(self, camera: Camera | None = None, names: tuple[str, ...] = ("1758271234567890", "5")) -> None:
        self.camera, self.names = camera, names

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, k: int) -> Frame:
        boxes = [[-20.0, -5, 0.5, 1, 1, 1, 0], [10, 2, 0, 4, 2, 2, 0]]
        points = torch.tensor([[-20.0, -5, 0.5, 0.25], [10, 2, 0, 0.5], [10.5, 2, 0, 1]])
        return Frame(self.names[k], points, Objects(torch.tensor(boxes), ["cone", "Truck"]), self.camera)


@pytest.mark.parametrize("camera", [None, CAMERA])
def test_frames_of_another_format(camera: Camera | None) -> None:
    """Any class, by the places of the frames; what is behind a camera is cut out, too, as its points are there."""
    database = build_database(Scans(camera))
    assert database.name.tolist() == ["cone", "Truck"] * 2
    assert database.frame.tolist() == [0, 0, 1, 1]
    assert database.label_row.tolist() == [0, 1, 0, 1]
    assert np.diff(database.offsets).tolist() == [1, 2, 1, 2]
    assert database.reflectance.tolist() == [25, 50, 100] * 2
    assert not database.bbox_height.any()
    assert not database.occlusion.any()
    np.testing.assert_array_equal(database.box[0], [-20, -5, 0.5, 1, 1, 1, 0])


def test_a_region_is_no_object_in_another_format_either() -> None:
    class Regions(Scans):
        def __getitem__(self, k: int) -> Frame:
            frame = super().__getitem__(k)
            assert frame.objects is not None
            return replace(frame, objects=Objects(frame.objects.boxes, ["DontCare", "Truck"]))

    database = build_database(Regions())
    assert database.name.tolist() == ["Truck", "Truck"]
    assert database.label_row.tolist() == [1, 1]
    assert database.box[:, 0].tolist() == [10, 10]


def test_a_frame_without_labels_is_named(root: Path) -> None:
    """An empty label file is one without objects; no label file is a mistake."""
    unlabelled = KittiFrames(root, ["000003", "000005"], labelled=False)
    with pytest.raises(InputError, match="frame 000003: has no labels to cut objects out"):
        build_database(unlabelled)
    assert len(build_database(KittiFrames(root, ["000003", "000005"]))) == 2


def test_a_number_that_is_too_large_is_named(root: Path) -> None:
    write_frame(root, "2147483648", OBJECTS)
    with pytest.raises(InputError, match=r"frame '2147483648': is no number below 2\*\*31; the database keeps numbers"):
        build_database(every_frame(root))


def test_load_database(root: Path) -> None:
    """It is built where the root has none, kept there, and leaves out what is validated on."""
    said: list[str] = []
    built = load_database(root, ["000003", "000005", "000007"], [], said.append)
    assert_same(built, read_database(root / "gt_database.npz"))
    assert_same(built, build_database(every_frame(root)))
    assert said == []
    rest = load_database(root, ["000003"], ["000007", "street"], said.append)
    assert said == [f"{root / 'gt_database.npz'}: 2 objects of validation frames are left out"]
    assert rest.frame.tolist() == [3, 3]
    assert_same(rest, build_database(KittiFrames(root, ["000003"], crop=False)))


def test_a_root_that_cannot_be_written_to(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, database: Database) -> None:
        raise OSError(30, "Read-only file system", str(path))

    monkeypatch.setattr("hvnet.data.gt_database.write_database", refuse)
    said: list[str] = []
    assert len(load_database(root, ["000003"], [], said.append)) == 2
    assert said == [f"{root / 'gt_database.npz'}: not kept (Read-only file system); it will be built again"]
