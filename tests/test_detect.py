"""Detection on files, folders and KITTI roots: the same boxes from every kind of file, results that KITTI can read."""

import csv
import dataclasses
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from hvnet import evaluate
from hvnet.boxes import limit_angle
from hvnet.config import config_to_dict
from hvnet.data.frame import Camera, Frame
from hvnet.data.kitti import (
    boxes_to_lidar,
    detections_to_labels,
    read_calibration,
    read_labels,
    read_points,
    write_labels,
)
from hvnet.data.labels import Labels
from hvnet.detect import check_results, csv_rows, main, result_rows, submission_rows
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import load_checkpoint, save_checkpoint
from hvnet.network.detector import load
from hvnet.network.model import Detections
from tests.helpers import ROOT, contents
from tests.models import TINY, save_untrained


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained detector that reports its 8 best boxes a class, whatever it sees."""
    path = tmp_path_factory.mktemp("model") / "checkpoint.pt"
    save_untrained(path, [*TINY, "head.score_threshold=0.0", "head.candidates=100", "head.detections=8"])
    return path


@pytest.fixture(scope="module")
def cloud(scenes: Path) -> NDArray[np.float32]:
    points = read_points(scenes / "training" / "velodyne" / "000000.bin")
    points[:, 3] = (points[:, 3] * 255).round() / 255
    points[0, 3] = 1.0
    return points


def detect(checkpoint: Path, out: Path, *inputs: Path, options: tuple[str, ...] = ()) -> None:
    arguments = [str(path) for path in inputs]
    main([*arguments, "--checkpoint", str(checkpoint), "--out", str(out), "--device", "cpu", *options])


def table(out: Path) -> list[dict[str, str]]:
    with (out / "boxes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def boxes_of(rows: list[dict[str, str]]) -> NDArray[np.float64]:
    keys = ("x", "y", "z", "length", "width", "height", "yaw")
    return np.array([[float(row[key]) for key in keys] for row in rows]).reshape(-1, 7)


def rows_of(found: Detections, camera: Camera | None, classes: tuple[str, ...]) -> Labels:
    """What a result file holds of detections."""
    rows = detections_to_labels(found.boxes, found.scores, found.names(classes), camera)
    return result_rows(rows, Frame("000000", torch.zeros(0, 4), camera=camera))


def assert_agrees(out: Path, name: str, rows: list[dict[str, str]], camera: Camera | None) -> None:
    """The result file NAME.txt says what rows of boxes.csv say, once taken to LiDAR axes."""
    labels = read_labels(out / "results" / f"{name}.txt", scored=True)
    assert labels.score is not None
    assert labels.name.tolist() == [row["class"] for row in rows]
    np.testing.assert_allclose(labels.score, [float(row["score"]) for row in rows], rtol=0, atol=6e-5)  # 4 digits
    difference = boxes_to_lidar(labels, camera) - boxes_of(rows)
    difference[:, 6] = limit_angle(torch.from_numpy(difference[:, 6])).numpy()
    # half of the last digit of the table, 1 mm, and of the file, 0.1 mm, whose axes are turned
    assert np.abs(difference).max(initial=0) < 0.5e-3 + 1e-4


def write_all(folder: Path, points: NDArray[np.float32]) -> list[Path]:
    """One cloud in each of the kinds of file."""
    folder.mkdir()
    paths = [folder / f"as_{suffix}.{suffix}" for suffix in ("bin", "npy", "pcd", "ply")]
    paths[0].write_bytes(points.tobytes())
    np.save(paths[1], points)
    PointCloud.from_xyzi_points(points).save(paths[2], encoding=Encoding.BINARY_COMPRESSED)
    rows = np.array([tuple(row) for row in points], dtype=[(name, "f4") for name in ("x", "y", "z", "intensity")])
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(paths[3]))
    return paths


# --- files and folders ------------------------------------------------------------------------------------------------


def test_every_kind_of_file_gives_the_same_boxes(
    checkpoint: Path, cloud: NDArray[np.float32], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = write_all(tmp_path / "clouds", cloud)
    (tmp_path / "clouds" / "notes.txt").write_text("not a cloud")
    detect(checkpoint, tmp_path / "files", *paths, options=("--pictures", "1"))
    printed = capsys.readouterr().out
    rows = table(tmp_path / "files")
    assert f"{len(rows)} boxes in 4 clouds" in printed
    by_name = [[list(row.values())[1:] for row in rows if row["cloud"] == path.stem] for path in paths]
    assert len(by_name[0]) > 10
    assert {row[0] for row in by_name[0]} == {"Car", "Pedestrian", "Cyclist"}
    assert by_name[1:] == by_name[:1] * 3
    results = [(tmp_path / "files" / "results" / f"{path.stem}.txt").read_bytes() for path in paths]
    assert results[1:] == results[:1] * 3
    assert [path.name for path in (tmp_path / "files" / "pictures").iterdir()] == ["as_bin.png"]
    with Image.open(tmp_path / "files" / "pictures" / "as_bin.png") as image:
        assert image.format == "PNG"

    # the folder gives the same again, byte for byte
    detect(checkpoint, tmp_path / "folder", tmp_path / "clouds", options=("--pictures", "1"))
    assert contents(tmp_path / "folder") == contents(tmp_path / "files")


def test_boxes_are_those_of_the_detector(checkpoint: Path, cloud: NDArray[np.float32], tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", cloud)
    detect(checkpoint, tmp_path / "out", tmp_path / "cloud.npy")
    found = load(checkpoint, "cpu")(cloud)
    # three decimals, and float32 of 25 m
    np.testing.assert_allclose(boxes_of(table(tmp_path / "out")), found.boxes.numpy(), rtol=0, atol=0.501e-3)


def test_results_without_calibration(checkpoint: Path, cloud: NDArray[np.float32], tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", cloud)
    detect(checkpoint, tmp_path / "out", tmp_path / "cloud.npy", options=("--pictures", "0"))
    labels = read_labels(tmp_path / "out" / "results" / "cloud.txt", scored=True)
    assert (labels.bbox == -1).all()
    assert (labels.truncation == -1).all()
    assert (labels.occlusion == -1).all()
    assert (np.abs(labels.alpha) <= 3.1416).all()
    assert_agrees(tmp_path / "out", "cloud", table(tmp_path / "out"), None)
    assert not (tmp_path / "out" / "pictures").exists()


def test_what_was_changed_in_reading_is_said(
    checkpoint: Path, cloud: NDArray[np.float32], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cloud = cloud.copy()
    cloud[:7, 0] = np.nan
    np.save(tmp_path / "cloud.npy", cloud[:, :3])
    detect(checkpoint, tmp_path / "out", tmp_path / "cloud.npy", options=("--pictures", "0"))
    printed = capsys.readouterr().out
    assert printed.count("cloud.npy: 7 points that are not finite were dropped") == 1
    assert printed.count("cloud.npy: has no reflectance") == 1


@pytest.mark.parametrize("points", [np.zeros((0, 4)), np.array([[5, 0, -1, 0.5]]), np.full((3, 4), 500.0)])
def test_odd_clouds(checkpoint: Path, tmp_path: Path, points: NDArray) -> None:
    """None, one point, and none in range."""
    np.save(tmp_path / "cloud.npy", points)
    detect(checkpoint, tmp_path / "out", tmp_path / "cloud.npy")
    assert (tmp_path / "out" / "pictures" / "cloud.png").is_file()
    assert_agrees(tmp_path / "out", "cloud", table(tmp_path / "out"), None)


def test_no_detections(checkpoint: Path, cloud: NDArray[np.float32], tmp_path: Path) -> None:
    content = load_checkpoint(checkpoint)
    config = load(checkpoint, "cpu").config
    config = dataclasses.replace(config, head=dataclasses.replace(config.head, score_threshold=0.99))
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"config": config_to_dict(config), "model": content["model"]})
    np.save(tmp_path / "cloud.npy", cloud)
    detect(path, tmp_path / "out", tmp_path / "cloud.npy")
    assert table(tmp_path / "out") == []
    assert (tmp_path / "out" / "boxes.csv").read_text().startswith("cloud,class,score,x,y,z,length,width,height,yaw")
    assert len(read_labels(tmp_path / "out" / "results" / "cloud.txt", scored=True)) == 0


# --- KITTI roots ------------------------------------------------------------------------------------------------------


def test_kitti_root(checkpoint: Path, scenes: Path, tmp_path: Path) -> None:
    detect(checkpoint, tmp_path / "all", scenes)
    names = [f"{k:06d}" for k in range(6)]
    assert sorted(path.stem for path in (tmp_path / "all" / "results").iterdir()) == names
    assert sorted(path.stem for path in (tmp_path / "all" / "pictures").iterdir()) == names
    rows = table(tmp_path / "all")
    for name in names:
        own = [row for row in rows if row["cloud"] == name]
        camera = read_calibration(scenes / "training" / "calib" / f"{name}.txt")
        bbox, visible = camera.project_boxes(boxes_of(own))
        seen = [row for row, is_seen in zip(own, visible, strict=True) if is_seen]
        assert_agrees(tmp_path / "all", name, seen, camera)
        labels = read_labels(tmp_path / "all" / "results" / f"{name}.txt", scored=True)
        large = (bbox[visible, 2:] - bbox[visible, :2] < 400).all(axis=1)  # next to the camera 1 mm is many pixels
        np.testing.assert_allclose(labels.bbox[large], bbox[visible][large], rtol=0, atol=1.0)
        assert (labels.bbox >= 0).all()
        assert (labels.bbox <= [1241, 374, 1241, 374]).all()

    detect(checkpoint, tmp_path / "val", scenes, options=("--split", "val", "--pictures", "0"))
    for name in names[4:]:
        results = Path("results") / f"{name}.txt"
        assert (tmp_path / "val" / results).read_bytes() == (tmp_path / "all" / results).read_bytes()
    assert table(tmp_path / "val") == [row for row in rows if row["cloud"] in names[4:]]
    assert len(list((tmp_path / "val" / "results").iterdir())) == 2


def test_a_frame_with_an_image_has_it_in_its_picture(checkpoint: Path, scenes: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(scenes, tmp_path / "kitti"))
    (root / "training" / "image_2").mkdir()
    Image.new("RGB", (1242, 375), (255, 0, 255)).save(root / "training" / "image_2" / "000005.png")
    detect(checkpoint, tmp_path / "out", root, options=("--split", "val"))
    magenta = {}
    for name in ("000004", "000005"):
        with Image.open(tmp_path / "out" / "pictures" / f"{name}.png") as image:
            magenta[name] = int((np.asarray(image.convert("RGB")) == [255, 0, 255]).all(axis=2).sum())
    assert magenta["000004"] == 0
    assert magenta["000005"] > 50_000
    (root / "training" / "image_2" / "000005.png").write_bytes(
        (root / "training" / "image_2" / "000005.png").read_bytes()[:100]
    )
    with pytest.raises(InputError, match=r"image_2.000005\.png: not an image, or cut off"):
        detect(checkpoint, tmp_path / "again", root, options=("--split", "val"))


def test_boxes_outside_the_image_are_in_the_table_alone(scenes: Path) -> None:
    camera = read_calibration(scenes / "training" / "calib" / "000000.txt")
    size = [4.0, 1.7, 1.5, 0.0]
    boxes = torch.tensor([[10.0, 0.0, -1.0, *size], [-10.0, 0.0, -1.0, *size], [5.0, 12.0, -1.0, *size]])
    found = Detections(boxes, torch.tensor([0.9, 0.8, 0.7]), torch.tensor([1, 0, 0]))
    rows = rows_of(found, camera, ("Car", "Van"))
    assert rows.name.tolist() == ["Van"]
    assert rows.score == pytest.approx([0.9])
    assert len(rows_of(found, None, ("Car", "Van"))) == 3
    assert [row[:3] for row in csv_rows("a", found, ("Car", "Van"))] == [
        ["a", "Van", "0.9000"],
        ["a", "Car", "0.8000"],
        ["a", "Car", "0.7000"],
    ]


def test_kitti_root_without_labels(checkpoint: Path, scenes: Path, tmp_path: Path) -> None:
    """The test set: its folder is testing, and it has no labels."""
    root = tmp_path / "kitti"
    for folder in ("velodyne", "calib"):
        (root / "testing" / folder).mkdir(parents=True)
        for path in sorted((scenes / "training" / folder).iterdir())[:2]:
            shutil.copy(path, root / "testing" / folder)
    detect(checkpoint, tmp_path / "all", root, options=("--pictures", "1"))
    assert len(list((tmp_path / "all" / "results").iterdir())) == 2
    (root / "training").mkdir()
    with pytest.raises(InputError, match=r"velodyne: holds no \.bin file"):
        detect(checkpoint, tmp_path / "none", root)
    (root / "testing" / "calib" / "000001.txt").unlink()
    (root / "training").rmdir()
    with pytest.raises(InputError, match=r"calib.000001\.txt: no such file"):
        detect(checkpoint, tmp_path / "none", root)


def test_labelled_frames_are_scored(
    checkpoint: Path, scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The table is that of `hvnet.evaluate` for the files written."""
    detect(checkpoint, tmp_path / "out", scenes, options=("--split", "val", "--pictures", "0"))
    printed = capsys.readouterr().out
    label_dir, results, frames = scenes / "training" / "label_2", tmp_path / "out" / "results", scenes / "ImageSets"
    evaluate.main(["--labels", str(label_dir), "--predictions", str(results), "--frames", str(frames / "val.txt")])
    table = capsys.readouterr().out.partition("\n\n2 frames scored")[0]
    assert len(table) > 100
    assert table in printed


def test_labelled_frames_are_scored_with_intervals(
    checkpoint: Path, scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `hvnet.evaluate` does; a mistake in the groups is said before anything is detected."""
    groups = tmp_path / "drives.csv"
    groups.write_text("frame,drive\n000004,a\n")
    given = ("--bootstrap", "100", "--groups", str(groups))
    options = ("--split", "val", "--pictures", "0", *given)
    with pytest.raises(InputError, match=r"drives\.csv: has no drive for .* such as 000005"):
        detect(checkpoint, tmp_path / "out", scenes, options=options)
    assert not (tmp_path / "out").exists()
    groups.write_text("frame,drive\n000004,a\n000005,b\n")
    detect(checkpoint, tmp_path / "out", scenes, options=options)
    printed = capsys.readouterr().out
    labels, frames = scenes / "training" / "label_2", scenes / "ImageSets" / "val.txt"
    results = tmp_path / "out" / "results"
    evaluate.main(["--labels", str(labels), "--predictions", str(results), "--frames", str(frames), *given])
    table = capsys.readouterr().out.partition("\n\n2 frames scored")[0]
    assert "[low, high]: 95 % of 100 resamples of 2 frames" in table
    assert table in printed
    with pytest.raises(InputError, match="--bootstrap 100: no frame has labels, so nothing is scored"):
        detect(checkpoint, tmp_path / "none", scenes / "training" / "velodyne", options=("--bootstrap", "100"))


# --- the test set -----------------------------------------------------------------------------------------------------


@pytest.fixture
def test_set(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A KITTI root whose test set has 3 frames, as if KITTI's had; without ImageSets, as it is downloaded."""
    monkeypatch.setattr("hvnet.detect.TEST_FRAMES", 3)
    root = tmp_path / "kitti"
    for folder in ("velodyne", "calib"):
        (root / "testing" / folder).mkdir(parents=True)
        for path in sorted((scenes / "training" / folder).iterdir())[:3]:
            shutil.copy(path, root / "testing" / folder)
    (root / "testing" / "image_2").mkdir()
    Image.new("RGB", (1224, 370)).save(root / "testing" / "image_2" / "000000.png")
    return root


def test_a_submission_wants_2d_boxes(checkpoint: Path, test_set: Path, tmp_path: Path) -> None:
    shutil.rmtree(test_set / "testing" / "calib")
    with pytest.raises(InputError, match=r"testing.calib: no such folder, but there is image_2; add the calibrations"):
        detect(checkpoint, tmp_path / "out", test_set, options=("--split", "test"))
    shutil.rmtree(test_set / "testing" / "image_2")
    with pytest.raises(InputError, match=r"testing.calib: no such folder, and the KITTI server wants 2D boxes; add it"):
        detect(checkpoint, tmp_path / "out", test_set, options=("--split", "test"))
    detect(checkpoint, tmp_path / "out", test_set, options=("--split", "test", "--partial"))  # as of a LiDAR alone
    assert (read_labels(tmp_path / "out" / "results" / "000000.txt", scored=True).bbox == -1).all()


def test_submission(checkpoint: Path, test_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    detect(checkpoint, tmp_path / "out", test_set, options=("--split", "test", "--pictures", "0"))
    printed = capsys.readouterr().out
    assert "2 frames have no file in image_2; their 2D boxes are clipped to 1242 x 375" in printed
    assert f"submission: {tmp_path / 'out' / 'submission.zip'}" in printed
    with zipfile.ZipFile(tmp_path / "out" / "submission.zip") as archive:
        packed = {name: archive.read(name) for name in archive.namelist()}
    assert list(packed) == ["000000.txt", "000001.txt", "000002.txt"]
    assert packed == contents(tmp_path / "out" / "results")
    for name, content in packed.items():
        width, height = (1224, 370) if name == "000000.txt" else (1242, 375)
        rows = [line.split(" ") for line in content.decode().splitlines()]
        assert len(rows) > 0
        assert {row[0] for row in rows} <= {"Car", "Pedestrian", "Cyclist"}
        numbers = np.array([row[1:] for row in rows], np.float64)
        assert numbers.shape[1] == 15
        assert np.isfinite(numbers).all()
        assert (np.abs(numbers[:, [2, 13]]) <= np.pi).all()
        left, top, right, bottom = numbers[:, 3:7].T
        assert ((left >= 0) & (left < right) & (right <= width - 1)).all()
        assert ((top >= 0) & (top < bottom) & (bottom <= height - 1)).all()
        assert (numbers[:, 7:10] > 0).all()

    # the same again is the same zip, byte for byte; a list of frames in any order does not matter
    (test_set / "ImageSets").mkdir()
    (test_set / "ImageSets" / "test.txt").write_text("000002\n000000\n000001\n")
    detect(checkpoint, tmp_path / "again", test_set, options=("--split", "test", "--pictures", "0"))
    assert (tmp_path / "again" / "submission.zip").read_bytes() == (tmp_path / "out" / "submission.zip").read_bytes()


def test_a_part_of_the_test_set_is_no_submission(
    checkpoint: Path, test_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    (test_set / "testing" / "velodyne" / "000001.bin").unlink()
    message = "wants the frames 000000 to 000002; 1 of them are missing, the first is 000001. .*--partial"
    with pytest.raises(InputError, match=message):
        detect(checkpoint, out, test_set, options=("--split", "test"))
    assert not out.exists()
    with pytest.raises(InputError, match="--partial: is for --split test"):
        detect(checkpoint, out, test_set, options=("--partial",))
    detect(checkpoint, out, test_set, options=("--split", "test", "--partial", "--pictures", "0"))
    assert sorted(path.name for path in out.iterdir()) == ["boxes.csv", "results"]
    assert [path.name for path in sorted((out / "results").iterdir())] == ["000000.txt", "000002.txt"]
    assert "no submission" in capsys.readouterr().out


def test_a_frame_that_the_server_does_not_know(
    checkpoint: Path, test_set: Path, cloud: NDArray[np.float32], tmp_path: Path
) -> None:
    np.save(tmp_path / "cloud.npy", cloud)
    with pytest.raises(InputError, match="000000 to 000002; not cloud"):
        detect(checkpoint, tmp_path / "out", test_set, tmp_path / "cloud.npy", options=("--split", "test"))
    assert not (tmp_path / "out").exists()


def test_submission_of_a_class_that_is_not_scored(scenes: Path, tmp_path: Path) -> None:
    """A van is left out, and angles that would be rounded to more than pi are not."""
    camera = read_calibration(scenes / "training" / "calib" / "000000.txt")
    boxes = torch.tensor([[10.0, 0, -1, 4, 1.7, 1.5, np.pi / 2], [15, 0, -1, 4, 1.7, 1.5, 0]])
    found = Detections(boxes, torch.tensor([0.9, 0.8]), torch.tensor([0, 1]))
    rows = rows_of(found, camera, ("Car", "Van"))
    assert rows.name.tolist() == ["Car", "Van"]
    write_labels(tmp_path / "000000.txt", rows)
    with pytest.raises(InputError, match=r"000000\.txt:2: a class that is not scored"):
        check_results(tmp_path / "000000.txt", (1242, 375))
    rows = submission_rows(rows)
    assert rows.name.tolist() == ["Car"]
    assert abs(rows.rotation_y[0]) == pytest.approx(np.pi, abs=1e-4)
    write_labels(tmp_path / "000000.txt", rows)
    check_results(tmp_path / "000000.txt", (1242, 375))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (0, "Bus", "a class that is not scored"),
        (0, "DontCare", "a class that is not scored"),
        (4, "nan", "not a finite number"),
        (15, "inf", "not a finite number"),
        (15, "", "15 fields, expected 16"),
        (4, "-0.1", "a 2D box outside the image"),
        (6, "1241.5", "a 2D box outside the image"),
        (7, "375", "a 2D box outside the image"),
        (6, "100", "a 2D box without area"),
        (8, "0", "a 3D box without volume"),
        (3, "-3.1416", "an angle outside"),
        (14, "3.2", "an angle outside"),
    ],
)
def test_results_that_the_server_would_reject(tmp_path: Path, field: int, value: str, message: str) -> None:
    line = "Car -1 -1 0.1 100 100 1241 374 1.5 2 4 1 1.6 20 0.1 0.75"
    path = tmp_path / "000000.txt"
    path.write_text(f"{line}\n")
    check_results(path, (1242, 375))
    fields = line.split()
    fields[field] = value
    path.write_text(f"{line}\n{' '.join(fields)}\n")
    with pytest.raises(InputError, match=rf"000000\.txt:2: .*{message}"):
        check_results(path, (1242, 375))


def test_box_with_a_sliver_in_the_image_is_not_reported(scenes: Path) -> None:
    """Its 2D box is 0.004 pixels wide, which four digits would make a line or nothing."""
    camera = read_calibration(scenes / "training" / "calib" / "000000.txt")
    box = np.array([[12.0, 9.0, -1, 4, 1.7, 1.5, 0]])
    low, high = 5.0, 30.0  # metres to the left, partly in the image and outside
    for _ in range(60):
        box[0, 1] = (low + high) / 2
        bbox, visible = camera.project_boxes(box)
        low, high = (box[0, 1], high) if visible[0] and bbox[0, 2] > 0.004 else (low, box[0, 1])
    box[0, 1] = low
    assert 0 < camera.project_boxes(box)[0][0, 2] < 0.01
    found = Detections(torch.from_numpy(box), torch.tensor([0.9]), torch.tensor([0]))
    assert len(rows_of(found, camera, ("Car",))) == 0


# --- mistakes ---------------------------------------------------------------------------------------------------------


def test_mistakes_leave_nothing_behind(checkpoint: Path, scenes: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    (tmp_path / "cloud.xyz").touch()
    (tmp_path / "cut.bin").write_bytes(b"123")
    for path in (tmp_path / "one" / "cloud.npy", tmp_path / "two" / "cloud.npy"):
        path.parent.mkdir()
        np.save(path, np.zeros((3, 4)))
    good = tmp_path / "one" / "cloud.npy"
    for inputs, message in (
        ([tmp_path / "none"], "none: no such file or folder"),
        ([good, tmp_path / "none.bin"], r"none\.bin: no such file or folder"),
        ([good, tmp_path / "cloud.xyz"], r"cloud\.xyz: unknown kind of file; known: \.bin, \.npy, \.pcd, \.ply"),
        ([tmp_path / "cut.bin"], r"cut\.bin: 3 bytes are no multiple of 16"),
        ([empty], r"empty: holds no cloud \(\.bin, \.npy, \.pcd, \.ply\) and is no KITTI root"),
        ([good, tmp_path / "two"], r"two.cloud\.npy: the name cloud is taken by .*one.cloud\.npy; rename one"),
        ([good, good], r"the name cloud is taken by"),
    ):
        with pytest.raises(InputError, match=message):
            detect(checkpoint, tmp_path / "out", *inputs)
        assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=r"none\.txt: no such file"):
        detect(checkpoint, tmp_path / "out", scenes, options=("--split", "none"))
    with pytest.raises(InputError, match=r"none\.pt: no such checkpoint"):
        detect(tmp_path / "none.pt", tmp_path / "out", good)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_not_empty_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "cloud.npy", np.zeros((3, 4)))
    out = tmp_path / "out"
    detect(checkpoint, out, tmp_path / "cloud.npy")
    before = contents(out)
    with pytest.raises(InputError, match=r"out: is not empty; give another --out"):
        detect(checkpoint, out, tmp_path / "cloud.npy")
    assert contents(out) == before
    with pytest.raises(InputError, match=re.escape("cloud.npy: is not empty")):
        detect(checkpoint, tmp_path / "cloud.npy", tmp_path / "cloud.npy")


def test_the_command(checkpoint: Path, tmp_path: Path) -> None:
    def command(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "hvnet.detect", *arguments], cwd=ROOT, capture_output=True, text=True, check=False
        )

    helped = command("--help")
    assert helped.returncode == 0
    assert "usage: python -m hvnet.detect" in helped.stdout
    assert helped.stderr == ""

    missing = str(tmp_path / "none.bin")
    failed = command(missing, "--checkpoint", str(checkpoint), "--out", str(tmp_path / "out"), "--device", "cpu")
    assert failed.returncode == 2
    assert failed.stdout == ""
    assert failed.stderr == f"error: {missing}: no such file or folder\n"


# --- clouds of other sensors, and labels that are not as they should be ----------------------------------------------


def printed_by(capsys: pytest.CaptureFixture[str]) -> str:
    """What was printed, without progress bars."""
    out, err = capsys.readouterr()
    return out + "".join(line + "\n" for line in re.split(r"[\r\n]", err) if "detecting" not in line)


def test_labels_never_stop_a_detection(
    checkpoint: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What cannot be read is said before the first frame, and left out of the scoring, as is a frame without labels."""
    labels = copied / "training" / "label_2"
    (labels / "000001.txt").write_text("Car 0 0\n")
    (labels / "000002.txt").unlink()
    (labels / "000003.txt").write_bytes(b"\xff\xfe\x00garbage")
    detect(checkpoint, tmp_path / "out", copied)
    printed = printed_by(capsys)
    assert printed.count(f"{labels / '000001.txt'}:1: 3 fields, expected 15") == 1
    assert printed.count(f"{labels / '000003.txt'}: not a text file; the frame counts as not labelled") == 1
    assert printed.index("000003.txt") < printed.index("Car: ")
    assert "3 of 6 frames are scored; no labels: 000001, 000002, 000003" in printed
    assert "Car: 24 detections in 3 frames" in printed
    assert sorted(path.stem for path in (tmp_path / "out" / "results").iterdir()) == [f"{k:06d}" for k in range(6)]


def test_labels_whose_calibration_is_missing(
    checkpoint: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder in ("calib", "image_2"):
        shutil.rmtree(copied / "training" / folder, ignore_errors=True)
    detect(checkpoint, tmp_path / "out", copied)
    printed = printed_by(capsys)
    assert "no such folder, but the labels of frame 000000 have 2D boxes" in printed
    assert "Car: 48 detections" not in printed
    assert len(list((tmp_path / "out" / "results").iterdir())) == 6


def test_classes_by_other_names(
    checkpoint: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    detect(checkpoint, tmp_path / "a", copied)
    wanted = printed_by(capsys)
    for path in (copied / "training" / "label_2").iterdir():
        path.write_text(re.sub("^Car ", "car ", path.read_text(), flags=re.M).replace("Cyclist", "bicycle"))
    detect(checkpoint, tmp_path / "b", copied)
    printed = " ".join(printed_by(capsys).split())
    assert "count as background: " in printed
    assert "--classes car=Car counts them" in printed
    detect(checkpoint, tmp_path / "c", copied, options=("--classes", "bicycle=Cyclist", "--classes", "car=Car"))
    renamed = printed_by(capsys)
    assert renamed.replace(str(tmp_path / "c"), "") == wanted.replace(str(tmp_path / "a"), "")
    with pytest.raises(InputError, match="--classes bicycle=Bike: no class Bike; there are Car, Pedestrian, Cyclist"):
        detect(checkpoint, tmp_path / "d", copied, options=("--classes", "bicycle=Bike"))


def test_lines_of_clouds(tmp_path: Path, capsys: pytest.CaptureFixture[str], kitti_root: Path) -> None:
    """One line a cloud with --verbose, one line a call without."""
    points = read_points(kitti_root / "training" / "velodyne" / "000008.bin") * np.float32([1, 1, 1, 255])
    np.save(tmp_path / "a.npy", points + np.float32([0, 0, 1.4, 0]))
    np.save(tmp_path / "b.npy", points[::2])
    line = r"clouds:     61,278 to 122,555 points, \d\d % in range, ground -1.\d\d to -0.\d\d m, 1 of 2 moved by "
    line += r"-1.\d\d m, reflectance / 255\n"
    moved = re.escape(f"moved to {load(device='cpu').ground:.2f} m")  # the ground that the weights were trained with
    first = rf"a: 122,555 points, \d\d,\d\d\d in range; ground at -0.\d\d m, {moved}; reflectance / 255\n"
    for options in ((), ("--verbose",)):
        out = tmp_path / f"out{len(options)}"
        main([str(tmp_path), "--out", str(out), "--device", "cpu", "--pictures", "0", *options])
        printed = printed_by(capsys)
        assert len(re.findall(line, printed)) == 1
        assert printed.count("reflectance was divided by 255") == 1
        assert len(re.findall(first, printed)) == len(options)
        assert len(re.findall(r"b: 61,278 points, ", printed)) == len(options)


@pytest.mark.parametrize(("scale", "shift", "said"), [
    (1000, 0, "as in millimetres; metres are wanted"),
    (1, 500_000, "as map coordinates do; subtract the sensor's position"),
])  # fmt: skip
def test_why_nothing_is_in_range(
    scale: float, shift: float, said: str, tmp_path: Path, checkpoint: Path, cloud: NDArray[np.float32],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    np.save(tmp_path / "far.npy", cloud * np.float32([scale, scale, scale, 1]) + np.float32([shift, shift, 0, 0]))
    detect(checkpoint, tmp_path / "out", tmp_path / "far.npy")
    assert re.search(rf"far: \d+ of [\d,]+ points are in range: .*{said}", printed_by(capsys))


def test_a_calibration_that_is_the_identity(
    checkpoint: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As converters write it for data without a camera: its z, which is up, is taken for the depth."""
    for path in (copied / "training" / "calib").iterdir():
        identity = "1 0 0 0 0 1 0 0 0 0 1 0"
        path.write_text(f"P2: {identity}\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {identity}\n")
    detect(checkpoint, tmp_path / "out", copied)
    assert "Tr_velo_to_cam is the identity, and a camera's axes are x right, y down, z forward" in printed_by(capsys)


def test_frames_without_image(
    checkpoint: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = copied / "training" / "image_2"
    images.mkdir(exist_ok=True)
    for path in images.iterdir():
        path.unlink()
    Image.new("RGB", (1242, 375)).save(images / "000000.JPG", format="jpeg")
    Image.new("RGB", (1242, 375)).save(images / "000001.jpeg")
    detect(checkpoint, tmp_path / "out", copied)
    said = f"{images}: has no image of 4 of 6 frames; their size is taken to be 1242 x 375"
    assert printed_by(capsys).count(said) == 1


def test_suffixes_in_any_case(checkpoint: Path, copied: Path, tmp_path: Path) -> None:
    detect(checkpoint, tmp_path / "a", copied)
    training = copied / "training"
    for folder, suffix in (("velodyne", ".BIN"), ("label_2", ".TXT"), ("calib", ".Txt")):
        for path in list((training / folder).iterdir()):
            path.rename(path.with_suffix(suffix))
    detect(checkpoint, tmp_path / "b", copied)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_all_round_takes_the_whole_cloud(tmp_path: Path, kitti_root: Path) -> None:
    """Of a frame with a camera too: its results are those in the image, boxes.csv has all."""
    for name in ("velodyne", "calib", "label_2"):
        (tmp_path / "root" / "training" / name).mkdir(parents=True)
        file = next((kitti_root / "training" / name).glob("000008.*"))
        shutil.copy(file, tmp_path / "root" / "training" / name)
    options = ["--device", "cpu", "--pictures", "1"]
    main([str(tmp_path / "root"), "--out", str(tmp_path / "ahead"), *options])
    main([str(tmp_path / "root"), "--out", str(tmp_path / "round"), "--all-round", *options])
    ahead, around = table(tmp_path / "ahead"), table(tmp_path / "round")
    assert all(float(row["x"]) > -3 for row in ahead)
    assert sum(float(row["x"]) < -3 and float(row["score"]) > 0.3 for row in around) >= 3
    results = read_labels(tmp_path / "round" / "results" / "000008.txt", scored=True)
    assert 0 < len(results) < len(around)
    assert (results.location[:, 2] > -3).all()


@pytest.mark.parametrize(("options", "said"), [
    (("--columns", "2"), "--columns 2: want 3 to 16"),
    (("--columns", "x,y"), "--columns x,y: want a number"),
    (("--reflectance-scale", "0"), "--reflectance-scale 0: want a number above 0, or none"),
    (("--reflectance-scale", "nan"), "--reflectance-scale nan: want"),
    (("--reflectance-scale", "bright"), "--reflectance-scale bright: want"),
    (("--sensor-height", "-2000"), "--sensor-height -2000: want metres, 1000 at most, or none"),
    (("--sensor-height", "high"), "--sensor-height high: want metres"),
    (("--turn", "left"), "--turn left: want degrees from -360 to 360"),
    (("--turn", "nan"), "--turn nan: want degrees"),
    (("--classes", "bicycle"), "--classes bicycle: want NAME=CLASS"),
])  # fmt: skip
def test_options_that_mean_nothing(options: tuple[str, str], said: str, checkpoint: Path, scenes: Path) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        detect(checkpoint, scenes / "never", scenes, options=(f"{options[0]}={options[1]}",))


def test_labels_whose_boxes_are_not_finite(
    checkpoint: Path, copied: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Numbers that a label file may hold and a float32 may not."""
    path = copied / "training" / "label_2" / "000001.txt"
    path.write_text("Car 0 0 0 100 100 200 200 1.5 1.6 4 1e39 1.7 20 0\n")
    detect(checkpoint, tmp_path / "out", copied)
    printed = printed_by(capsys)
    assert f"{path}: boxes: want finite numbers" in printed
    assert "5 of 6 frames are scored; no labels: 000001" in printed
