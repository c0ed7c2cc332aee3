"""A cloud is judged in the same way whatever door it comes in by: a table of doors, and of what is wrong with clouds.

Every door takes what a sensor gave, (N, 4) at the sensor's own scale, and gives the points that the network sees of it,
or what a user is told.
"""

import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hvnet import train
from hvnet.config import DataConfig, load_config
from hvnet.data import database as database_command
from hvnet.data.frame import Frame, Frames, Objects
from hvnet.data.gt_database import build_database, object_points, read_database
from hvnet.data.kitti import KittiFrames, boxes_to_labels, read_split, write_calibration, write_labels
from hvnet.data.sources import find_frames
from hvnet.evaluation.scoring import detect_frame
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import load_checkpoint
from hvnet.network.detector import Detector, load
from hvnet.network.model import Detections
from hvnet.training.batches import TrainingFrames
from tests.helpers import CAMERA, GivenFrames
from tests.models import CONFIGS, QUICK, SHORT

Points = NDArray[np.float32]
Door = Callable[[Points, Path], Points]
BOX = (20.0, 0.0, 0.0, 30.0, 30.0, 5.0, 0.0)
"""A labelled object around all points, so that the database has them all."""


def some_points(count: int = 500) -> Points:
    """In the camera's view and in range; half of the database's millimetres away from rounding."""
    generator = np.random.default_rng(0)
    points = np.column_stack((generator.uniform(10, 30, count), generator.uniform(-5, 5, count),
                              generator.uniform(-2, 1, count), np.linspace(0, 1, count)))  # fmt: skip
    points[:, :3] = points[:, :3].round(3)
    return points.astype(np.float32)


def root_of(points: Points, folder: Path, camera: bool = False) -> Path:
    """A KITTI root with one frame, labelled, in both splits."""
    training = folder / "root" / "training"
    for name in ("velodyne", "label_2", *["calib"] * camera):
        (training / name).mkdir(parents=True)
    (training / "velodyne" / "000000.bin").write_bytes(points.astype("<f4").tobytes())
    rows = boxes_to_labels(np.array([BOX]), ["Car"], CAMERA if camera else None)
    write_labels(training / "label_2" / "000000.txt", rows)
    if camera:
        write_calibration(training / "calib" / "000000.txt", CAMERA)
    (folder / "root" / "ImageSets").mkdir()
    for split in ("train", "val"):
        (folder / "root" / "ImageSets" / f"{split}.txt").write_text("000000\n")
    return folder / "root"


def binary_file(points: Points, folder: Path) -> Points:
    path = folder / "cloud.bin"
    path.write_bytes(points.astype("<f4").tobytes())
    return find_frames([path])[0].points.numpy()


def numpy_file(points: Points, folder: Path) -> Points:
    np.save(folder / "cloud.NPY", points)
    (folder / "cloud.NPY.npy").rename(folder / "cloud.NPY")
    return find_frames([folder / "cloud.NPY"])[0].points.numpy()


def text_file(points: Points, folder: Path) -> Points:
    """An ascii .pcd."""
    lines = ["FIELDS x y z Intensity", "SIZE 4 4 4 4", "TYPE F F F F", f"POINTS {len(points)}", "DATA ascii"]
    lines += [" ".join(f"{float(value):.9g}" for value in row) for row in points]
    (folder / "cloud.pcd").write_text("\n".join(lines) + "\n")
    return find_frames([folder])[0].points.numpy()


def root(points: Points, folder: Path) -> Points:
    return find_frames([root_of(points, folder)])[0].points.numpy()


def root_with_camera(points: Points, folder: Path) -> Points:
    return find_frames([root_of(points, folder, camera=True)])[0].points.numpy()


def training(points: Points, folder: Path) -> Points:
    frames = KittiFrames(root_of(points, folder), ["000000"])
    return trained(frames)


def trained(frames: Frames) -> Points:
    return (
        TrainingFrames(frames, load_config(CONFIGS / "compact.yaml"), None, torch.device("cpu")).read(0).points.numpy()
    )


def database(points: Points, folder: Path) -> Points:
    return object_points(build_database(KittiFrames(root_of(points, folder), ["000000"], crop=False))).numpy()


class Watched(Detector):
    """Keeps the points that the network sees, and detects nothing."""

    def __init__(self) -> None:
        self.__dict__.update(load(device="cpu", sensor_height="none").__dict__)

    def maps(self, points: torch.Tensor, *_: object) -> tuple[list, list]:
        self.seen = points
        return [], []

    def candidates(self, *_: object) -> list:
        return []

    def suppress(self, *_: object) -> list[Detections]:
        return [Detections(torch.zeros(0, 7), torch.zeros(0), torch.zeros(0, dtype=torch.int64))]


def array(points: Points, folder: Path) -> Points:
    detector = Watched()
    detector(points)
    return detector.seen[detector.seen.isfinite().all(dim=1)].numpy()  # the encoder ignores the others


def own_format(points: Points, folder: Path) -> Points:
    detector = Watched()
    detect_frame(detector, Frame("mine", points))  # type: ignore[arg-type]
    return detector.seen.numpy()


def own_format_in_training(points: Points, folder: Path) -> Points:
    return trained(GivenFrames(Frame("mine", points, Objects([BOX], ["Car"]))))  # type: ignore[arg-type]


def own_format_in_the_database(points: Points, folder: Path) -> Points:
    frames = GivenFrames(Frame("mine", points, Objects([BOX], ["Car"])))  # type: ignore[arg-type]
    return object_points(build_database(frames)).numpy()


def viewer(points: Points, folder: Path) -> Points:
    pytest.importorskip("viser")
    from hvnet.pictures.viewer import Viewer, start_server

    server = start_server("127.0.0.1", 0)
    try:
        return Viewer(server, load(device="cpu"), find_frames([root_of(points, folder)])).frame.points.numpy()
    finally:
        server.stop()


FILES = {
    door.__name__: door
    for door in (binary_file, numpy_file, text_file, root, root_with_camera, training, database, viewer)
}
ARRAYS = {door.__name__: door for door in (array, own_format, own_format_in_training, own_format_in_the_database)}


class Case(NamedTuple):
    """What is wrong with a cloud, and what becomes of it."""

    change: Callable[[Points], Points]
    expect: Callable[[Points], Points] = lambda points: points
    arrays_say: str | None = None  # what an array, which has no file to find the scale of, is refused with


def with_value(row: int, column: int, value: float) -> Callable[[Points], Points]:
    def change(points: Points) -> Points:
        changed = points.copy()
        changed[row, column] = value
        return changed

    return change


def with_reflectance(scale: float, shift: float = 0) -> Callable[[Points], Points]:
    return lambda points: np.column_stack((points[:, :3], points[:, 3] * np.float32(scale) + np.float32(shift)))


def without(row: int) -> Callable[[Points], Points]:
    return lambda points: np.delete(points, row, axis=0)


CASES = {
    "nothing": Case(lambda points: points),
    "8 bits": Case(with_reflectance(255), arrays_say="want a reflectance from 0 to 1, got 255; divide"),
    "16 bits": Case(with_reflectance(65535), arrays_say="want a reflectance from 0 to 1, got 65535; divide"),
    "the same reflectance everywhere": Case(with_reflectance(0, 0.5), with_reflectance(0)),
    "the same reflectance of 8 bits everywhere": Case(with_reflectance(0, 77), with_reflectance(0)),
    "no reflectance": Case(with_reflectance(0), with_reflectance(0)),
    "NaN as reflectance": Case(with_value(7, 3, np.nan), with_value(7, 3, 0)),
    "a negative reflectance": Case(with_value(7, 3, -1), with_value(7, 3, 0)),
    "a reflectance of 65,535 among small ones": Case(
        with_value(7, 3, 65535), with_value(7, 3, 1), "want a reflectance from 0 to 1, got 65535"
    ),
    "a reflectance of 1e30 among small ones": Case(
        with_value(7, 3, 1e30), with_value(7, 3, 1), r"want a reflectance from 0 to 1, got 1e\+30"
    ),
    "a reflectance just above 1": Case(with_value(7, 3, 1.04), with_value(7, 3, 1)),
    "an infinite reflectance": Case(with_value(7, 3, np.inf), without(7), "got inf"),
    "NaN as coordinate": Case(with_value(7, 0, np.nan), without(7)),
    "an infinite height": Case(with_value(7, 2, np.inf), without(7)),
}


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    yield tmp_path
    shutil.rmtree(tmp_path, ignore_errors=True)


@pytest.mark.parametrize("door", FILES)
@pytest.mark.parametrize("case", CASES)
def test_files(door: str, case: str, folder: Path) -> None:
    given = some_points()
    found = FILES[door](CASES[case].change(given), folder)
    wanted = CASES[case].expect(given)
    assert found.dtype == np.float32
    tolerance = 1e-6 if "bits" in case else 0  # k / 255 * 255 in float32
    np.testing.assert_allclose(found[:, 3], wanted[:, 3], rtol=tolerance, atol=0)
    np.testing.assert_allclose(found[:, :3], wanted[:, :3], rtol=0, atol=2e-6 if door == "database" else 0)


@pytest.mark.parametrize("door", ARRAYS)
@pytest.mark.parametrize("case", CASES)
def test_arrays(door: str, case: str, folder: Path) -> None:
    given, said = some_points(), CASES[case].arrays_say
    if said is not None and not (case == "an infinite reflectance" and door != "array"):
        with pytest.raises(ValueError, match=said):
            ARRAYS[door](CASES[case].change(given), folder)
        return
    found, wanted = ARRAYS[door](CASES[case].change(given), folder), CASES[case].expect(given)
    if case == "a reflectance just above 1":
        wanted = CASES[case].change(given)  # within the tolerance
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("door", [root, root_with_camera, training, database, viewer, binary_file])
def test_five_numbers_a_point(door: Door, folder: Path) -> None:
    """As nuScenes writes them: in the order of the scan, the ring as fifth."""
    points = some_points()[np.lexsort(some_points().T[:2])]
    five = np.column_stack((points, np.arange(len(points)) % 32)).astype(np.float32)
    np.testing.assert_allclose(door(five, folder), points, rtol=0, atol=2e-6 if door is database else 0)


# --- what training keeps for detection -------------------------------------------------------------------------------


def test_a_run_keeps_what_its_clouds_are_like(copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The height of their ground and the scale of their reflectance: 8 bits, and a sensor 1.33 m higher up."""
    for path in (copied / "training" / "velodyne").iterdir():
        points = np.fromfile(path, "<f4").reshape(-1, 4) * np.float32([1, 1, 1, 255]) - np.float32([0, 0, 1.33, 0])
        path.write_bytes(points.astype("<f4").tobytes())
    arguments = ["--config", str(CONFIGS / "demo.yaml"), "--data", str(copied), "--device", "cpu"]
    arguments += [part for each in (*SHORT, *QUICK, "train.epochs=1", "train.repeat=1") for part in ("--set", each)]
    train.main([*arguments, "--out", str(tmp_path / "run")])
    printed = capsys.readouterr().out
    content = load_checkpoint(tmp_path / "run" / "checkpoint.pt")
    assert content["sensor"]["reflectance_scale"] == 255
    assert content["sensor"]["ground"] == pytest.approx(-1.73 - 1.33, abs=0.15)
    assert "clouds: " in printed
    assert re.search(r"the ground lies at -(2\.9|3\.0)\d m, where the anchors do not stand; better: ", printed)
    assert re.search(r"--set head\.classes\.Car\.anchor_z=-2\.\d\d --set head", printed)
    detector = load(tmp_path / "run" / "checkpoint.pt", "cpu")
    assert detector.ground == content["sensor"]["ground"]
    assert detector.reflectance

    given = ["--sensor-height", "3.1", "--reflectance-scale", "none", "--columns", "x,y,z,i"]
    train.main([*arguments, *given, "--out", str(tmp_path / "dark")])
    content = load_checkpoint(tmp_path / "dark" / "checkpoint.pt")
    assert content["sensor"] == {"ground": -3.1, "reflectance_scale": 0.0}
    assert content["config"]["data"] == {
        "columns": ["x", "y", "z", "i"], "reflectance_scale": 0.0, "sensor_height": 3.1, "classes": {}
    }  # fmt: skip
    assert not load(tmp_path / "dark" / "checkpoint.pt", "cpu").reflectance
    with pytest.raises(InputError, match="--sensor-height none: training moves no cloud"):
        train.main([*arguments, "--sensor-height", "none", "--out", str(tmp_path / "none")])


def test_columns_are_read_in_training_as_they_are_said(copied: Path, tmp_path: Path) -> None:
    """Five numbers a point whose order nothing tells, in every cloud of the root."""
    generator = np.random.default_rng(0)
    plain = KittiFrames(copied, read_split(copied, "train"))
    wanted = plain[0].points
    for path in (copied / "training" / "velodyne").iterdir():
        points = np.fromfile(path, "<f4").reshape(-1, 4)
        extra = generator.uniform(-1, 1, (len(points), 1))
        path.write_bytes(np.concatenate((extra, points[:, [3, 0, 1, 2]]), axis=1).astype("<f4").tobytes())
    reading = DataConfig(columns=("_", "i", "x", "y", "z"))
    frames = KittiFrames(copied, read_split(copied, "train"), reading=reading)
    assert torch.equal(frames[0].points, wanted)
    assert trained(frames).shape == wanted.shape
    out = tmp_path / "objects.npz"
    database_command.main(["--data", str(copied), "--out", str(out), "--columns", "_,i,x,y,z"])
    assert len(read_database(out)) > 0
