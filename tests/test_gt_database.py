"""The ground-truth database: built from frames, written, read, compared with the real one, and refused when broken."""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.config import DataConfig
from hvnet.data.frame import Camera, Frame, Objects
from hvnet.data.gt_database import (
    LAYOUT,
    REMEDY,
    Database,
    build_database,
    load_database,
    object_points,
    read_database,
    write_database,
)
from hvnet.data.kitti import KittiFrames, read_points, read_split, write_calibration, write_points
from hvnet.exceptions import InputError
from tests.helpers import CAMERA, GivenFrames

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
    assert database.frame.tolist() == ["000003"] * 2 + ["000007"] * 2
    assert database.label_row.tolist() == [0, 2, 0, 2]
    assert database.offsets.tolist() == [0, 2, 3, 5, 6]
    assert database.centre_mm[:2].tolist() == [[10000, 2000, 0], [20000, -5000, 500]]
    assert database.xyz_mm[:, :3].T.tolist() == [[1, 2, 3], [-2000, -1000, -1000], [0, 0, 0]]
    assert database.reflectance[:3].tolist() == [0.25, 1, 0]
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
    read = read_database(root / "a.npz")
    assert_same(read, database)
    assert read.stamps is not None
    assert database.stamps is not None
    assert read.stamps.names == database.stamps.names == ["000003", "000005", "000007"]
    np.testing.assert_array_equal(read.stamps.numbers, database.stamps.numbers)
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
        ({"reflectance": np.full(6, np.inf, np.float32)}, "'reflectance' holds numbers that are not finite"),
        ({"reflectance": np.zeros(6)}, "'reflectance' is float64, expected float32"),
        ({"frame": np.zeros(4)}, "'frame' is float64, expected str"),
        ({"frame": np.zeros((4, 2), np.int32)}, "'frame' has shape (8,), expected (4,)"),
        ({"stamps": np.zeros((2, 4), np.int64)}, "has no array 'stamped'; build it with"),
        ({"stamped": np.array(["a"])}, "has no array 'stamps'; build it with"),
        (
            {"stamped": np.array(["a"]), "stamps": np.zeros((2, 4), np.int64)},
            "'stamps' has shape (2, 4), expected (1, 4)",
        ),
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


NAMES = ["1544425448401234", "15444254484012345678", "street", "7", "07", "2147483648"]


@pytest.mark.parametrize("name", NAMES)
def test_any_name_of_a_frame_is_kept_and_guarded(tmp_path: Path, name: str) -> None:
    """Of 4, 16 and 20 digits, of 32 bits and more, or none: its objects are left out where it is validated on."""
    others = [other for other in NAMES if other != name]
    for each in NAMES:
        write_frame(tmp_path, each, OBJECTS)
    load_database(tmp_path, NAMES, [])
    assert read_database(tmp_path / "gt_database.npz").frame.tolist() == [each for each in NAMES for _ in range(2)]
    said: list[str] = []
    rest = load_database(tmp_path, others, [name], said.append)
    assert rest.frame.tolist() == [each for each in others for _ in range(2)]
    assert said == [f"{tmp_path / 'gt_database.npz'}: 2 objects of validation frames are left out"]


@pytest.mark.parametrize("scale", [100, 255, 65535])
def test_reflectances_are_exact(tmp_path: Path, scale: int) -> None:
    """Every value of a sensor of so many steps, through a file and back."""
    values = (np.arange(scale + 1) / scale).astype(np.float32)
    points = np.tile(np.array([10.0, 2, 0, 0], np.float32), (len(values), 1))
    points[:, 3] = values

    class Car(Scans):
        def __getitem__(self, k: int) -> Frame:
            return Frame(self.names[k], points, Objects([[10, 2, 0, 4, 2, 2, 0]], ["Car"]))

    database = build_database(Car(names=("a",)))
    assert database.reflectance.dtype == np.float32
    np.testing.assert_array_equal(database.reflectance, values)
    write_database(tmp_path / "a.npz", database)
    np.testing.assert_array_equal(object_points(read_database(tmp_path / "a.npz"))[:, 3].numpy(), values)


def test_reflectances_of_a_root_that_counts_to_255(root: Path) -> None:
    """As the frames have them."""
    for path in (root / "training" / "velodyne").iterdir():
        points = read_points(path)
        points[:, 3] *= 255
        write_points(path, points)
    assert build_database(every_frame(root)).reflectance[:3].tolist() == [np.float32(63.75) / np.float32(255), 1, 0]


def write_old(path: Path, database: Database) -> None:
    """Writes a database as earlier versions did: frames are numbers, reflectances whole per cent, and no stamps."""
    arrays = {name: getattr(database, name) for name in LAYOUT}
    arrays["frame"] = database.frame.astype(np.int32)
    arrays["reflectance"] = (database.reflectance * 100).round().astype(np.uint8)
    np.savez(path, **arrays)


def test_a_file_of_an_earlier_version(root: Path) -> None:
    """It is read as what is written today; nothing is known of its frames, so that it is used as it is."""
    database = build_database(every_frame(root))
    path = root / "gt_database.npz"
    write_old(path, database)
    before = path.read_bytes()
    assert_same(read_database(path), database)
    assert read_database(path).stamps is None
    (root / "training" / "label_2" / "000003.txt").write_text("")
    said: list[str] = []
    assert_same(load_database(root, ["000003", "000005"], [], said.append), database)
    assert said == []
    # a root may name its frames 7, and the number was the same
    for name in ("000007", "7", "0000000007"):
        said.clear()
        assert load_database(root, ["000003"], [name, "street"], said.append).frame.tolist() == ["000003"] * 2
        assert said == [f"{path}: 2 objects of validation frames are left out"]
    assert path.read_bytes() == before


def test_reflectances_of_an_earlier_version_keep_their_bits(tmp_path: Path) -> None:
    count = 101
    columns = {name: np.zeros([{"K": 1, "K + 1": 2, "M": count}.get(each, each) for each in shape], kind)
               for name, (shape, kind) in LAYOUT.items()}  # fmt: skip
    columns |= {"offsets": np.array([0, count]), "frame": np.array([2**31 - 1], np.int32)}
    columns["reflectance"] = np.arange(count, dtype=np.uint8)
    np.savez(tmp_path / "old.npz", **columns)
    database = read_database(tmp_path / "old.npz")
    assert database.frame.tolist() == ["2147483647"]
    np.testing.assert_array_equal(database.reflectance, (np.arange(count) / 100).astype(np.float32))


def test_a_split_without_objects_is_named(tmp_path: Path) -> None:
    write_frame(tmp_path, "000005", "")
    with pytest.raises(InputError, match="no object is labelled in the 1 frames"):
        build_database(every_frame(tmp_path))


def test_frames_that_are_wanted(root: Path) -> None:
    frames = every_frame(root)
    database = build_database(frames, [2])
    assert database.frame.tolist() == ["000007"] * 2
    assert database.stamps is not None
    assert database.stamps.names == ["000007"]
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
    """Any class; what is behind a camera is cut out, too, as its points are there. Nothing is stamped."""
    database = build_database(Scans(camera))
    assert database.name.tolist() == ["cone", "Truck"] * 2
    assert database.frame.tolist() == ["1758271234567890"] * 2 + ["5"] * 2
    assert database.stamps is None
    assert database.label_row.tolist() == [0, 1, 0, 1]
    assert np.diff(database.offsets).tolist() == [1, 2, 1, 2]
    assert database.reflectance.tolist() == [0.25, 0.5, 1] * 2
    assert not database.bbox_height.any()
    assert not database.occlusion.any()
    np.testing.assert_array_equal(database.box[0], [-20, -5, 0.5, 1, 1, 1, 0])


def test_a_large_frame_takes_little_memory() -> None:
    """A million points and 150 boxes: a table of which is in which would take gigabytes."""
    resets, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    if not resets.exists():
        pytest.skip("no /proc")

    def peak() -> int:
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM"))

    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-60, 60, (10**6, 3)), rng.random(10**6)))
    boxes = np.column_stack((rng.uniform(-50, 50, (150, 3)), np.full((150, 3), 4.0), np.zeros(150)))
    frame = Frame("large", points, Objects(boxes, ["Car"] * 150))
    resets.write_text("5")  # the peak counts from now on
    before = peak()
    database = build_database(GivenFrames(frame))
    assert peak() - before < 100_000  # kB
    assert database.offsets[-1] == pytest.approx(150 * 10**6 * (4 / 120) ** 3, rel=0.1)


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


def test_load_database(root: Path) -> None:
    """It is built where the root has none, kept there, and leaves out what is validated on."""
    said: list[str] = []
    built = load_database(root, ["000003", "000005", "000007"], [], said.append)
    assert_same(built, read_database(root / "gt_database.npz"))
    assert_same(built, build_database(every_frame(root)))
    assert said == []
    rest = load_database(root, ["000003"], ["000007", "street"], said.append)
    assert said == [f"{root / 'gt_database.npz'}: 2 objects of validation frames are left out"]
    assert rest.frame.tolist() == ["000003"] * 2
    assert_same(rest, build_database(KittiFrames(root, ["000003"], crop=False)))


ALL = ["000003", "000005", "000007"]
LABELS = "labels, calibration or options of reading"


def change_labels(root: Path, name: str = "000003") -> None:
    path = root / "training" / "label_2" / f"{name}.txt"
    path.write_text(path.read_text().replace("Car 0.25", "Car 0.75"))


def change_cloud(root: Path, name: str = "000003") -> None:
    """Of the same size."""
    path = root / "training" / "velodyne" / f"{name}.bin"
    points = read_points(path)
    points[0, 3] = 0.5
    write_points(path, points)


def change_calibration(root: Path, name: str = "000003") -> None:
    path = root / "training" / "calib" / f"{name}.txt"
    path.write_text(path.read_text().replace("P2: 7.0", "P2: 8.0"))


def cut_cloud(root: Path, name: str = "000003") -> None:
    path = root / "training" / "velodyne" / f"{name}.bin"
    path.write_bytes(path.read_bytes()[:-32])


def touch(root: Path) -> None:
    """As if the root were copied."""
    for path in (root / "training" / "velodyne").iterdir():
        os.utime(path, ns=(10**18, 10**18))


def load_all(root: Path, names: Sequence[str] = ALL, reading: DataConfig | None = None) -> tuple[Database, list[str]]:
    """The database of these frames, and what is said."""
    said: list[str] = []
    return load_database(root, names, [], said.append, reading), said


@pytest.mark.parametrize(
    ("change", "what"),
    [(change_labels, LABELS), (change_calibration, LABELS), (change_cloud, "cloud"), (cut_cloud, "cloud")],
)
def test_a_database_is_built_again_after_a_change(root: Path, change: Callable[[Path], None], what: str) -> None:
    load_all(root)
    path = root / "gt_database.npz"
    change(root)
    database, said = load_all(root)
    assert said == [f"{path}: is built again, as frames have changed: 000003 ({what})"]
    assert_same(database, build_database(every_frame(root)))
    assert_same(read_database(path), database)
    assert load_all(root)[1] == []


def test_what_changed_is_counted(root: Path) -> None:
    load_all(root)
    change_labels(root)
    change_cloud(root)
    cut_cloud(root, "000005")
    change_labels(root, "000007")
    assert load_all(root)[1] == [
        f"{root / 'gt_database.npz'}: is built again, as frames have changed: 000003 ({LABELS}; cloud) and 2 more"
    ]


def test_other_options_of_reading_are_a_change(root: Path) -> None:
    load_all(root)
    database, said = load_all(root, reading=DataConfig(classes={"Pedestrian": "Person"}))
    assert said == [f"{root / 'gt_database.npz'}: is built again, as frames have changed: 000003 ({LABELS}) and 2 more"]
    assert database.name.tolist() == ["Car", "Person"] * 2


def test_a_database_that_fits_is_not_built_again(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is a cloud read to see that; those of a copied root are, as their times are others."""
    built, _ = load_all(root)
    path = root / "gt_database.npz"
    before = path.read_bytes()
    with monkeypatch.context() as patched:
        patched.delattr("hvnet.data.kitti.read_raw")
        patched.setattr("hvnet.data.stamps._crc32", lambda path: pytest.fail(f"{path} is read"))
        again, said = load_all(root)
    assert_same(again, built)
    assert said == []
    touch(root)
    with monkeypatch.context() as patched:
        patched.delattr("hvnet.data.kitti.read_raw")
        again, said = load_all(root)
    assert_same(again, built)
    assert said == []
    assert path.read_bytes() == before


def test_a_database_of_more_frames_is_not_built_again(root: Path) -> None:
    """What is not trained on may change; what is, is named, with what the user can do."""
    whole, _ = load_all(root)
    path = root / "gt_database.npz"
    before = path.read_bytes()
    change_labels(root, "000007")
    database, said = load_all(root, ["000003", "000005"])
    assert said == []
    assert_same(database, whole)
    change_cloud(root)
    database, said = load_all(root, ["000003", "000005"])
    assert said == [f"{path}: since it was built, frames have changed: 000003 (cloud); {REMEDY}"]
    assert_same(database, whole)
    assert path.read_bytes() == before


def test_a_database_of_fewer_frames_is_not_built_again(root: Path) -> None:
    load_all(root, ["000003"])
    path = root / "gt_database.npz"
    before = path.read_bytes()
    database, said = load_all(root)
    unknown = f"{path}: was built without 2 of the 3 training frames, such as 000005; {REMEDY}"
    assert said == [unknown]
    assert database.frame.tolist() == ["000003"] * 2
    change_labels(root)
    assert load_all(root)[1] == [
        f"{path}: since it was built, frames have changed: 000003 ({LABELS}); {REMEDY}",
        unknown,
    ]
    assert path.read_bytes() == before


def refuse(path: Path, database: Database) -> None:
    raise OSError(30, "Read-only file system", str(path))


def test_a_root_that_cannot_be_written_to(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is built is used, whether there was nothing or what no longer fits."""
    path = root / "gt_database.npz"
    kept = f"{path}: not kept (Read-only file system); it will be built again"
    with monkeypatch.context() as patched:
        patched.setattr("hvnet.data.gt_database.write_database", refuse)
        database, said = load_all(root, ["000003"])
        assert len(database) == 2
        assert said == [kept]
    load_all(root)
    change_labels(root)
    monkeypatch.setattr("hvnet.data.gt_database.write_database", refuse)
    for _ in range(2):
        database, said = load_all(root)
        assert database.truncation[:2].tolist() == [0.75, 0]
        assert said == [f"{path}: is built again, as frames have changed: 000003 ({LABELS})", kept]


def test_only_the_first_rank_looks_at_files(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, _ = load_all(root)
    monkeypatch.setattr("hvnet.ranks.rank", lambda: 1)
    monkeypatch.setattr("hvnet.ranks.broadcast", lambda _: first)
    said: list[str] = []
    assert load_database(root / "nowhere", ALL, ["000007"], said.append).frame.tolist() == ["000003"] * 2
