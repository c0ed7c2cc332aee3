"""KITTI's files: what is read, what is written back, the conversions between axes, and what is refused."""

import math
import re
import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hvnet.boxes import points_in_boxes
from hvnet.data.frame import IMAGE_SIZE, Frame, Objects
from hvnet.data.kitti import (
    KittiFrames,
    boxes_to_camera,
    boxes_to_labels,
    boxes_to_lidar,
    centres_to_lidar,
    detections_to_labels,
    drop_non_finite,
    frame_labels,
    read_calibration,
    read_frame,
    read_labels,
    read_points,
    read_split,
    write_calibration,
    write_labels,
    write_points,
)
from hvnet.data.labels import Labels
from hvnet.exceptions import InputError
from tests.helpers import CAMERA

CAR = "Car 0.25 1 -1.50 100.00 120.50 300.25 240.75 1.50 1.60 4.00 2.00 1.70 10.00 -1.30"
DONT_CARE = "DontCare -1 -1 -10 800.38 163.67 825.45 184.07 -1 -1 -1 -1000 -1000 -1000 -10"

BOXES = np.array([[10.0, 1.0, -1.0, 4.0, 1.6, 1.5, 0.3], [-9.0, -3.0, -0.9, 0.8, 0.7, 1.7, -2.0]])


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A KITTI root with frames 000000 and 000001, one labelled car and one DontCare each."""
    for folder in ("velodyne", "calib", "label_2", "image_2"):
        (tmp_path / "training" / folder).mkdir(parents=True)
    (tmp_path / "ImageSets").mkdir()
    (tmp_path / "ImageSets" / "train.txt").write_text("000000\n000001\n")
    points = np.array([[10, 0, 0, 0.5], [-10, 0, 0, 0.5], [10, 20, 0, 0.5], [np.nan, 0, 0, 0.5]], dtype=np.float32)
    for frame_id in ("000000", "000001"):
        write_points(tmp_path / "training" / "velodyne" / f"{frame_id}.bin", points)
        write_calibration(tmp_path / "training" / "calib" / f"{frame_id}.txt", CAMERA)
        (tmp_path / "training" / "label_2" / f"{frame_id}.txt").write_text(f"{CAR}\n{DONT_CARE}\n")
    return tmp_path


def overlap_2d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """IoU of 2D boxes (K, 4), row by row."""
    common = (np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2])).clip(0).prod(axis=1)
    return common / ((a[:, 2:] - a[:, :2]).prod(axis=1) + (b[:, 2:] - b[:, :2]).prod(axis=1) - common)


def test_read_labels(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    path.write_text(f"{CAR}\n\n{DONT_CARE}\n")
    labels = read_labels(path)
    assert len(labels) == 2
    assert labels.name.tolist() == ["Car", "DontCare"]
    assert labels.truncation.tolist() == [0.25, -1]
    assert labels.occlusion.tolist() == [1, -1]
    assert labels.alpha.tolist() == [-1.5, -10]
    assert labels.bbox[0].tolist() == [100, 120.5, 300.25, 240.75]
    assert labels.dimensions[0].tolist() == [1.5, 1.6, 4]
    assert labels.location[0].tolist() == [2, 1.7, 10]
    assert labels.rotation_y.tolist() == [-1.3, -10]
    assert labels.score is None
    assert labels.select(labels.name == "Car").name.tolist() == ["Car"]


def test_read_scored_labels(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    path.write_text(f"{CAR} 0.75\n")
    score = read_labels(path, scored=True).score
    assert score is not None
    assert score.tolist() == [0.75]


@pytest.mark.parametrize("scored", [False, True])
def test_empty_label_file_means_no_objects(tmp_path: Path, scored: bool) -> None:
    path = tmp_path / "000000.txt"
    path.write_text("")
    labels = read_labels(path, scored)
    assert len(labels) == 0
    assert labels.bbox.shape == (0, 4)
    assert boxes_to_lidar(labels, CAMERA).shape == (0, 7)
    write_labels(path, labels)
    assert path.read_text() == ""


BAD_LABELS = [
    (CAR.rsplit(" ", 1)[0], False, "14 fields, expected 15"),
    (f"{CAR} 0.5 7", False, "17 fields, expected 15"),
    (CAR, True, "15 fields, expected 16"),
    (CAR.replace("10.00", "ten"), False, "field 14 is 'ten', not a finite number"),
    (CAR.replace("10.00", "nan"), False, "field 14 is 'nan', not a finite number"),
    (f"{CAR} inf", True, "field 16 is 'inf', not a finite number"),
    (CAR.replace("0.25 1 ", "0.25 1.5 "), False, "field 3 is '1.5', not a whole number"),
    (CAR.replace("1.60 4.00", "0.00 4.00"), False, "height, width or length (fields 9 to 11) is not positive"),
]


def test_a_sixteenth_field_of_labels_is_ignored(tmp_path: Path) -> None:
    """Other tools write a score or an id there."""
    path = tmp_path / "000000.txt"
    path.write_text(f"{CAR} track_7\n{DONT_CARE}\n{CAR} nan\n")
    labels = read_labels(path)
    assert labels.name.tolist() == ["Car", "DontCare", "Car"]
    assert labels.score is None
    assert labels.rotation_y.tolist() == [-1.3, -10, -1.3]


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    path.write_text(f"{CAR} 0.5\n", encoding="utf-8-sig")
    assert read_labels(path).name.tolist() == read_labels(path, scored=True).name.tolist() == ["Car"]
    write_calibration(path, CAMERA)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[2:]), encoding="utf-8-sig")  # P2 first
    assert np.array_equal(read_calibration(path).p2, CAMERA.p2)


NO_3D = "Car 0 0 0.5 100 120 300 240 -1 -1 -1 -1000 -1000 -1000 -10"


def test_labels_without_a_3d_box(root: Path) -> None:
    """For 2D alone they are read; whoever needs 3D boxes refuses them."""
    path = root / "training" / "label_2" / "000000.txt"
    path.write_text(f"{CAR}\n{NO_3D}\n{NO_3D.replace('-1 -1 -1 -1000', '0 0 0 -1000')}\n{DONT_CARE}\n")
    labels = read_labels(path, needs_3d=False)
    assert labels.has_3d().tolist() == [True, False, False, False]
    assert labels.has_2d().tolist() == [True] * 4
    message = re.escape(f"{path}:2: height, width or length (fields 9 to 11) is not positive; give the object's size")
    for read in (read_labels, lambda _: read_frame(root, "000000"), lambda _: KittiFrames(root, ["000000"])[0]):
        with pytest.raises(InputError, match=message):
            read(path)
    with pytest.raises(InputError, match=message):
        KittiFrames(root, ["000000"]).object_names(0)
    path.write_text(f"{NO_3D}\n{CAR.replace('1.60 4.00', '-1 -1')}\n")  # some of them are a mistake all the same
    with pytest.raises(InputError, match=re.escape(f"{path}:2: height, width or length")):
        read_labels(path, needs_3d=False)
    path.write_text(f"{NO_3D} 0.5\n")
    assert not read_labels(path, scored=True).has_3d().any()


@pytest.mark.parametrize(("line", "scored", "message"), BAD_LABELS)
def test_bad_label_line_is_named(tmp_path: Path, line: str, scored: bool, message: str) -> None:
    path = tmp_path / "000007.txt"
    path.write_text(f"{CAR}{' 0.5' if scored else ''}\n\n{line}\n")
    with pytest.raises(InputError, match=re.escape(f"{path}:3: {message}")):
        read_labels(path, scored)


def test_missing_or_binary_label_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "000007.txt"
    with pytest.raises(InputError, match=re.escape(f"{path}: no such file")):
        read_labels(path)
    path.write_bytes(b"\xff\xfe\x80")
    with pytest.raises(InputError, match=re.escape(f"{path}: not a text file")):
        read_labels(path)
    with pytest.raises(InputError, match=re.escape(f"{tmp_path}: cannot be read")):
        read_labels(tmp_path)


def test_labels_are_written_as_they_were_read(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    path.write_text(f"{CAR}\n{DONT_CARE}\n")
    write_labels(tmp_path / "copy.txt", read_labels(path))
    assert (tmp_path / "copy.txt").read_text() == path.read_text()


def test_result_files_keep_their_digits(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    line = "Car -1 -1 -1.2346 100.1234 120.5678 300.2512 240.7578 1.5012 1.6034 4.0056 2.0078 1.7012 10.1234 -1.3012"
    path.write_text(f"{line} 0.123457\n")
    write_labels(tmp_path / "copy.txt", read_labels(path, scored=True))
    assert (tmp_path / "copy.txt").read_text() == path.read_text()


def test_calibration_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "000000.txt"
    write_calibration(path, CAMERA)
    keys = [line.split(":")[0] for line in path.read_text().splitlines()]
    assert keys == ["P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"]
    copy = read_calibration(path)
    for name in ("p2", "r0_rect", "velo_to_cam"):
        assert np.array_equal(getattr(copy, name), getattr(CAMERA, name))
    assert (copy.size, copy.image) == (IMAGE_SIZE, None)


BAD_CALIBRATION = [
    ("P2: 1 2 3", "4: P2 has 3 numbers, expected 12"),
    ("R0_rect: 1 0 0 0 1 0 0 0 one", "4: R0_rect holds 'one', not a finite number"),
    ("R0_rect: 1 0 0 0 1 0 0 0 nan", "4: R0_rect holds 'nan', not a finite number"),
    ("R0_rect: 0 0 0 0 0 0 0 0 0", "4: R0_rect is no rotation"),
    ("Tr_velo_to_cam: 0 0 0 1 0 0 0 1 0 0 0 1", "4: Tr_velo_to_cam is no rotation"),
    ("P2: 700 0 600 0 0 700 180 0 0 0 1 0\nP2: 700 0 600 0 0 700 180 0 0 0 1 0", "5: P2 is given twice"),
    ("", " no line 'P2: ...'"),
]


@pytest.mark.parametrize(("lines", "message"), BAD_CALIBRATION)
def test_bad_calibration_is_named(tmp_path: Path, lines: str, message: str) -> None:
    path = tmp_path / "000007.txt"
    write_calibration(path, CAMERA)
    key = lines.split(":")[0] or "P2"
    kept = [line for line in path.read_text().splitlines() if not line.startswith(key)]
    path.write_text("\n".join([*kept[:3], lines, *kept[3:]]) + "\n")
    with pytest.raises(InputError, match=re.escape(f"{path}:{message}")):
        read_calibration(path)


def test_missing_calibration_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(f"{tmp_path / '000007.txt'}: no such file")):
        read_calibration(tmp_path / "000007.txt")


def test_points_round_trip(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    write_points(tmp_path / "a.bin", points[::2])
    assert np.array_equal(read_points(tmp_path / "a.bin"), points[::2])
    write_points(tmp_path / "b.bin", points[:0])
    assert read_points(tmp_path / "b.bin").shape == (0, 4)


def test_cut_off_points_are_named(tmp_path: Path) -> None:
    path = tmp_path / "000007.bin"
    path.write_bytes(bytes(33))
    with pytest.raises(InputError, match=re.escape(f"{path}: 33 bytes are no multiple of 16")):
        read_points(path)
    with pytest.raises(InputError, match=re.escape(f"{tmp_path / 'none.bin'}: cannot be read")):
        read_points(tmp_path / "none.bin")


def test_non_finite_points_are_dropped_and_counted() -> None:
    points = np.zeros((5, 4), np.float32)
    assert drop_non_finite(points) == (points, 0)
    points[1, 3], points[2, 0], points[4, 2] = np.nan, np.inf, -np.inf
    kept, dropped = drop_non_finite(points)
    assert kept.shape == (2, 4)
    assert dropped == 3


def test_boxes_to_lidar() -> None:
    labels = Labels(
        name=np.array(["Car", "Car"]),
        truncation=np.zeros(2),
        occlusion=np.zeros(2, np.int64),
        alpha=np.zeros(2),
        bbox=np.zeros((2, 4)),
        dimensions=np.array([[1.5, 1.6, 4.0], [1.5, 1.6, 4.0]]),
        location=np.array([[-2.0, 1.7, 10.0], [0.0, 1.7, 10.0]]),
        rotation_y=np.array([-math.pi / 2, math.pi / 2]),  # away from the camera, towards it
    )
    boxes = boxes_to_lidar(labels, CAMERA)
    expected = [[10, 2, -1.7 + 0.75, 4, 1.6, 1.5, 0], [10, 0, -1.7 + 0.75, 4, 1.6, 1.5, -math.pi]]
    np.testing.assert_allclose(boxes, expected, atol=1e-12)


def test_box_conversions_are_inverse_to_each_other(kitti_root: Path) -> None:
    calib = read_calibration(kitti_root / "training" / "calib" / "000008.txt")
    random = np.random.default_rng(0)
    boxes = random.uniform(-1, 1, (200, 7)) * [50, 50, 3, 4, 4, 4, math.pi]
    boxes[:, 3:6] = abs(boxes[:, 3:6]) + 0.1
    boxes[:3, 6] = -math.pi, 0, math.nextafter(math.pi, 0)
    dimensions, location, rotation_y = boxes_to_camera(boxes, calib)
    zeros = np.zeros(200)
    labels = Labels(
        np.full(200, "Car"), zeros, zeros.astype(int), zeros, np.zeros((200, 4)), dimensions, location, rotation_y
    )
    back = boxes_to_lidar(labels, calib)
    np.testing.assert_allclose(back[:, :6], boxes[:, :6], atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * back[:, 6]), np.exp(1j * boxes[:, 6]), atol=1e-12)
    assert (rotation_y >= -math.pi).all()
    assert (rotation_y < math.pi).all()


def test_read_frame(root: Path) -> None:
    frame = read_frame(root, "000000")
    assert frame.name == "000000"
    assert frame.points.tolist() == [[10, 0, 0, 0.5]]
    assert frame.objects is not None
    assert frame.points.dtype == frame.objects.boxes.dtype == torch.float32
    assert frame.notes == ["frame 000000: 1 points that are not finite were dropped"]
    assert frame.objects.names == ("Car",)
    assert frame.objects.boxes.shape == (1, 7)
    assert frame.objects.labels is not None
    assert frame.objects.labels.name.tolist() == ["Car", "DontCare"]
    assert frame.camera is not None
    assert (frame.camera.size, frame.camera.image) == (IMAGE_SIZE, None)
    whole = read_frame(root, "000000", crop=False)
    assert len(whole.points) == 3
    write_points(root / "training" / "velodyne" / "000000.bin", whole.points.numpy())
    assert read_frame(root, "000000").notes == []


def test_read_frame_without_labels(root: Path) -> None:
    """That nothing is labelled is something else than that there are no labels."""
    path = root / "training" / "label_2" / "000000.txt"
    path.write_text("")
    empty = read_frame(root, "000000")
    assert empty.objects is not None
    assert empty.objects.boxes.shape == (0, 7)
    assert empty.objects.names == ()
    assert len(frame_labels(empty)) == 0
    path.unlink()
    frame = read_frame(root, "000000", labelled=False)
    assert frame.objects is None
    assert frame.boxes_of(["Car"]).shape == (0, 7)
    with pytest.raises(ValueError, match="frame 000000: has no labels"):
        frame_labels(frame)
    with pytest.raises(InputError, match=re.escape(f"{path}: no such file")):
        read_frame(root, "000000")


def test_frames_of_a_root(root: Path) -> None:
    """As a sequence: labels that are wanted, those that there are, or none."""
    (root / "training" / "label_2" / "000001.txt").unlink()
    names = ["000000", "000001"]
    frames = KittiFrames(root, names, labelled=None)
    assert len(frames) == 2
    assert frames.names == names
    assert [frames[k].name for k in range(2)] == names
    assert [frames[k].objects is None for k in range(2)] == [False, True]
    assert [frames.object_names(k) for k in range(2)] == [["Car"], None]
    assert len(KittiFrames(root, names, crop=False)[0].points) == 3
    without = KittiFrames(root, names, labelled=False)
    assert without[0].objects is None
    assert without.object_names(0) is None
    wanted = KittiFrames(root, names)
    with pytest.raises(InputError, match=r"label_2.000001\.txt: no such file"):
        wanted[1]
    with pytest.raises(InputError, match=r"label_2.000001\.txt: no such file"):
        wanted.object_names(1)


def test_names_of_objects_check_the_files(root: Path) -> None:
    """Without reading the points: what is missing or cut off is found before a long run."""
    frames = KittiFrames(root, ["000000", "000001"], labelled=None)
    path = root / "training" / "velodyne" / "000000.bin"
    path.write_bytes(bytes(33))
    with pytest.raises(InputError, match=re.escape(f"{path}: 33 bytes are no multiple of 16")):
        frames.object_names(0)
    path.unlink()
    with pytest.raises(InputError, match=re.escape(f"{path}: cannot be read (No such file")):
        frames.object_names(0)
    (root / "training" / "calib" / "000001.txt").unlink()
    with pytest.raises(InputError, match=r"calib.000001\.txt: no such file"):
        frames.object_names(1)


def test_image_size_comes_from_the_image(root: Path) -> None:
    path = root / "training" / "image_2" / "000000.png"
    Image.new("RGB", (1224, 370)).save(path)
    camera = read_frame(root, "000000").camera
    assert camera is not None
    assert (camera.size, camera.image) == ((1224, 370), path)
    image = camera.read_image()
    assert image is not None
    assert image.shape == (370, 1224, 3)
    whole = path.read_bytes()
    for content in (b"no image", whole.replace(b"\0\0\0\x0dIHDR", b"\0\0\0\x02IHDR")):
        path.write_bytes(content)
        with pytest.raises(InputError, match=re.escape(f"{path}: not an image")):
            read_frame(root, "000000")


def test_read_split(root: Path) -> None:
    assert read_split(root, "train") == ["000000", "000001"]
    path = root / "ImageSets" / "val.txt"
    with pytest.raises(InputError, match=re.escape(f"{path}: no such file; it holds the frames of split 'val'")):
        read_split(root, "val")
    path.write_text("\n\n")
    with pytest.raises(InputError, match=re.escape(f"{path}: names no frame")):
        read_split(root, "val")
    path.write_text("000000\n\n000001\n000000\n")
    with pytest.raises(InputError, match=re.escape(f"{path}:4: frame 000000 is already on line 1; remove one")):
        read_split(root, "val")


@pytest.mark.parametrize("file", ["velodyne/000001.bin", "calib/000001.txt", "label_2/000001.txt"])
def test_split_names_a_missing_frame(root: Path, file: str) -> None:
    missing = root / "training" / file
    missing.unlink()
    message = f"{root / 'ImageSets' / 'train.txt'}:2: frame 000001 has no {missing}; add the file or remove the line"
    with pytest.raises(InputError, match=re.escape(message)):
        read_split(root, "train")
    if "label" in file:
        assert read_split(root, "train", labelled=False) == ["000000", "000001"]


def test_detections_to_labels() -> None:
    boxes = torch.tensor([[20.0, 0, 0, 4, 2, 2, 0], [-20, 0, 0, 4, 2, 2, 0], [20, 20, 0, 4, 2, 2, math.pi / 4]])
    scores = torch.tensor([0.5, 0.75, 0.25])
    labels = detections_to_labels(boxes, scores, ["Car", "Van", "Cyclist"], replace(CAMERA, size=(1400, 375)))
    assert labels.name.tolist() == ["Car"]
    labels = detections_to_labels(boxes[[0, 2]].requires_grad_(), scores[[0, 2]], ["Car", "Cyclist"], CAMERA)
    assert labels.name.tolist() == ["Car"]
    assert labels.score is not None
    assert labels.score.tolist() == [0.5]
    assert labels.truncation.tolist() == labels.occlusion.tolist() == [-1]
    np.testing.assert_allclose(labels.location, [[0, 1, 20]], atol=1e-12)
    np.testing.assert_allclose(labels.dimensions, [[2, 2, 4]])
    np.testing.assert_allclose([labels.rotation_y[0], labels.alpha[0]], [-math.pi / 2] * 2)
    assert len(detections_to_labels(boxes[:0], scores[:0], [], CAMERA)) == 0


def test_alpha_is_the_angle_from_the_line_of_sight() -> None:
    """A car that drives along the line of sight has the alpha of one straight ahead that drives away."""
    box = torch.tensor([[20.0, 10, 0, 4, 2, 2, math.atan2(10, 20)]])
    labels = detections_to_labels(box, torch.ones(1), ["Car"], CAMERA)
    np.testing.assert_allclose(labels.alpha, [-math.pi / 2], atol=1e-6)


def test_real_files_are_written_as_they_were_read(kitti_root: Path, tmp_path: Path) -> None:
    for path in sorted((kitti_root / "training" / "label_2").iterdir()):
        write_labels(tmp_path / "label.txt", read_labels(path))
        assert (tmp_path / "label.txt").read_text() == path.read_text()
    for path in sorted((kitti_root / "training" / "calib").iterdir()):
        calib = read_calibration(path)
        write_calibration(tmp_path / "calib.txt", calib)
        lines = path.read_text().splitlines()
        kept = [line for line in lines if line.split(":")[0] in ("P2", "R0_rect", "Tr_velo_to_cam")]
        written = (tmp_path / "calib.txt").read_text().splitlines()
        assert all(line in written for line in kept)


def test_real_frame(kitti_root: Path) -> None:
    frame = read_frame(kitti_root, "000008")
    whole = read_frame(kitti_root, "000008", crop=False)
    assert frame.objects is not None
    assert frame.objects.names == ("Car",) * 6
    assert 0.14 < len(frame.points) / len(whole.points) < 0.18
    boxes = frame.objects.boxes
    counts = points_in_boxes(frame.points, boxes).sum(dim=0)
    assert (counts >= 50).all()  # every labelled car was hit
    # the cars stand on the ground, 1.73 m below the scanner, which looks along +x
    assert ((boxes[:, 2] - boxes[:, 5] / 2).abs() - 1.73).abs().max() < 0.5
    assert (boxes[:, 0] > 0).all()


def test_real_boxes_project_to_their_2d_labels(kitti_root: Path) -> None:
    """A frame without its image counts as 1242 x 375, which moves the 2D boxes of cars that reach beyond its edge."""
    untruncated: list[np.ndarray] = []
    truncated: dict[bool, list[np.ndarray]] = {True: [], False: []}  # with the image, without
    alphas = []
    for split in ("train_first", "val_first"):
        for frame_id in read_split(kitti_root, split):
            frame = read_frame(kitti_root, frame_id, crop=False)
            labels = frame_labels(frame)
            cars = labels.select(labels.name == "Car")
            assert frame.camera is not None
            found = detections_to_labels(
                torch.from_numpy(boxes_to_lidar(cars, frame.camera)),
                torch.ones(len(cars)),
                cars.name.tolist(),
                frame.camera,
            )
            assert len(found) == len(cars)  # what is labelled is in the image
            np.testing.assert_allclose(found.location, cars.location, atol=1e-9)
            np.testing.assert_allclose(found.rotation_y, cars.rotation_y, atol=1e-9)
            alphas.append(np.abs(np.angle(np.exp(1j * (found.alpha - cars.alpha)))))
            overlap = overlap_2d(found.bbox, cars.bbox)
            untruncated.append(overlap[cars.truncation == 0])
            truncated[frame.camera.image is not None].append(overlap[cars.truncation > 0])
    assert np.concatenate(untruncated).min() > 0.98
    assert np.concatenate(truncated[True]).min() > 0.98
    assert np.concatenate(truncated[False]).min() > 0.89
    assert np.concatenate(alphas).max() < 0.04


def lidar_alone(root: Path) -> Path:
    """A root of one frame without a camera; some of its points and objects are behind the sensor."""
    folder = root / "training"
    for name in ("velodyne", "label_2"):
        (folder / name).mkdir(parents=True)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "val.txt").write_text("000000\n")
    points = np.random.default_rng(0).uniform((-20, -20, -2, 0), (20, 20, 1, 1), (100, 4)).astype(np.float32)
    write_points(folder / "velodyne" / "000000.bin", points)
    write_labels(folder / "label_2" / "000000.txt", boxes_to_labels(BOXES, ["Car", "Cyclist"]))
    return root


def test_without_a_camera(tmp_path: Path) -> None:
    """A root without calib: every point is kept, boxes keep their place, and nothing has a 2D box."""
    labels = boxes_to_labels(BOXES, ["Car", "Cyclist"])
    assert (labels.bbox == -1).all()
    assert labels.location[0] == pytest.approx([-1.0, 1.75, 10.0])  # right, down, ahead; the middle of the bottom
    root = lidar_alone(tmp_path)
    assert read_split(root, "val") == ["000000"]
    frame = read_frame(root, "000000")
    assert frame.camera is None
    assert frame.objects is not None
    np.testing.assert_array_equal(frame.points.numpy(), read_points(root / "training" / "velodyne" / "000000.bin"))
    assert (frame.points[:, 0] < 0).any()
    np.testing.assert_allclose(frame.objects.boxes.numpy(), BOXES, atol=0.01)
    (root / "training" / "calib").mkdir()
    with pytest.raises(InputError, match=r"frame 000000 has no .*calib.000000\.txt"):
        read_split(root, "val")


def test_a_missing_calibration_is_no_missing_camera(tmp_path: Path, scenes: Path) -> None:
    """Where there are images, or labels with 2D boxes, there was a camera."""
    root = lidar_alone(tmp_path)
    folder = root / "training"
    (folder / "calib").symlink_to("gone")
    with pytest.raises(InputError, match=r"training.calib: is no folder of calibrations"):
        read_split(root, "val")
    (folder / "calib").unlink()
    (folder / "image_2").mkdir()
    with pytest.raises(InputError, match=r"training.calib: no such folder, but there is image_2; add"):
        read_frame(root, "000000")
    (folder / "image_2").rmdir()
    shutil.copy(scenes / "training" / "label_2" / "000000.txt", folder / "label_2")
    with pytest.raises(InputError, match=r"calib: no such folder, but the labels of frame 000000 have 2D boxes; add"):
        read_frame(root, "000000")


def test_labels_of_boxes_with_a_camera() -> None:
    labels = boxes_to_labels(BOXES, ["Car", "Cyclist"], CAMERA)
    assert labels.name.tolist() == ["Car"]  # the other is behind the camera
    np.testing.assert_allclose(labels.bbox, CAMERA.project_boxes(BOXES[:1])[0])
    np.testing.assert_allclose(boxes_to_lidar(labels, CAMERA), BOXES[:1])
    assert (labels.truncation.tolist(), labels.occlusion.tolist(), labels.score) == ([0.0], [0], None)
    assert len(boxes_to_labels(BOXES, ["Car", "Cyclist"])) == 2  # for want of a camera


def test_labels_of_a_frame_of_another_format() -> None:
    """Without rows of a label file they are made of the boxes; with a camera, of those that are in its image."""
    objects = Objects(torch.from_numpy(BOXES), ["Car", "cone"])
    points = torch.zeros(0, 4)
    every = frame_labels(Frame("a", points, objects))
    assert every.name.tolist() == ["Car", "cone"]
    assert (every.bbox == -1).all()
    np.testing.assert_allclose(boxes_to_lidar(every, None), BOXES, atol=1e-6)
    seen = frame_labels(Frame("a", points, objects, CAMERA))
    assert seen.name.tolist() == ["Car"]
    np.testing.assert_allclose(seen.bbox, CAMERA.project_boxes(BOXES[:1])[0], atol=1e-3)
    assert len(frame_labels(Frame("a", points, Objects(torch.zeros(0, 7), []), CAMERA))) == 0
    rows = boxes_to_labels(BOXES, ["Car", "cone"])
    assert frame_labels(Frame("a", points, Objects(objects.boxes, objects.names, rows), CAMERA)) is rows


def test_no_minus_zero_without_a_camera(tmp_path: Path) -> None:
    """Straight ahead and behind, at the sensor's height, and at the sensor itself."""
    centres = [[10.0, 0, 0.75], [-9.0, 0, -1], [0, 0, 0], [-0.0, -0.0, -0.0], [-5.0, 0, 0.75]]
    boxes = np.array([[*centre, 4, 2, 1.5, yaw] for centre in centres for yaw in (-np.pi / 2, 0, np.pi / 2)])
    for scores in (None, np.ones(len(boxes))):
        labels = boxes_to_labels(boxes, ["Car"] * len(boxes), None, scores)
        write_labels(tmp_path / "a.txt", labels)
        words = (tmp_path / "a.txt").read_text().split()
        assert not {"-0", "-0.00", "-0.0000"} & set(words)
        again = read_labels(tmp_path / "a.txt", scored=scores is not None)
        for places in (centres_to_lidar(again, None), boxes_to_lidar(again, None)):
            assert not (np.signbit(places) & (places == 0)).any()


CLASSES = ["car", "lorry3", "Traffic_cone", "e-scooter", "3wheeler", "Fußgänger"]


@pytest.mark.parametrize("scored", [False, True])
def test_any_word_is_a_class(root: Path, scored: bool) -> None:
    """Lower case, digits, whatever: which of them counts is for the config, not for the reader."""
    path = root / "training" / "label_2" / "000000.txt"
    ending = " 0.500000" if scored else ""
    path.write_text("".join(f"{name} {CAR.partition(' ')[2]}{ending}\n" for name in CLASSES), encoding="utf-8")
    labels = read_labels(path, scored)
    assert labels.name.tolist() == CLASSES
    write_labels(root / "copy.txt", labels)
    assert read_labels(root / "copy.txt", scored).name.tolist() == CLASSES
    if not scored:
        assert (root / "copy.txt").read_bytes() == path.read_bytes()
        frame = read_frame(root, "000000")
        assert frame.objects is not None
        assert frame.objects.names == tuple(CLASSES) == tuple(KittiFrames(root, ["000000"]).object_names(0) or ())


@pytest.mark.parametrize("name", ["traffic cone", "", " "])
def test_a_class_that_is_no_word_is_not_written(tmp_path: Path, name: str) -> None:
    """Its file could not be read."""
    labels = boxes_to_labels(BOXES, ["Car", "Cyclist"])
    with pytest.raises(ValueError, match=f"labels: want classes of one word each, got '{name}'"):
        write_labels(tmp_path / "a.txt", replace(labels, name=np.array(["Car", name])))
    assert not (tmp_path / "a.txt").exists()
    with pytest.raises(ValueError, match=f"names: want classes of one word each, got '{name}'"):
        boxes_to_labels(BOXES, ["Car", name])


BAD_COLUMNS = [
    ("occlusion", np.array([0, 1.5]), "labels.occlusion: want whole numbers, got 1.5"),
    ("occlusion", np.array([0, np.nan]), "labels.occlusion: want finite numbers, got nan"),
    ("truncation", np.array([np.inf, 0]), "labels.truncation: want finite numbers, got inf"),
    ("alpha", np.array([0, -np.inf]), "labels.alpha: want finite numbers, got -inf"),
    ("bbox", np.full((2, 4), np.nan), "labels.bbox: want finite numbers, got nan"),
    ("location", np.full((2, 3), np.nan), "labels.location: want finite numbers, got nan"),
    ("rotation_y", np.array([0, 1j]), "labels.rotation_y: want real numbers, got dtype complex128"),
    ("score", np.array([0.5, np.nan]), "labels.score: want finite numbers, got nan"),
    (
        "dimensions",
        np.array([[1.5, 1.6, 4], [1.5, 0.004, 4]]),
        "labels.dimensions: want sizes of 0.01 and more in row 1",
    ),
]


@pytest.mark.parametrize(("column", "values", "message"), BAD_COLUMNS)
def test_labels_that_could_not_be_read_are_not_written(
    tmp_path: Path, column: str, values: np.ndarray, message: str
) -> None:
    labels = replace(boxes_to_labels(BOXES, ["Car", "Cyclist"]), **{column: values})
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        write_labels(tmp_path / "a.txt", labels)
    assert not (tmp_path / "a.txt").exists()


def test_what_may_be_written(tmp_path: Path) -> None:
    """A size that rounds up to 0.01, an occlusion of another dtype, a region; and results without 3D boxes."""
    labels = boxes_to_labels(BOXES, ["Car", "DontCare"])
    sizes = np.array([[1.5, 0.0051, 4], [-1, -1, -1]])
    labels = replace(labels, dimensions=sizes, occlusion=np.array([2.0, -1.0]))
    write_labels(tmp_path / "a.txt", labels)
    again = read_labels(tmp_path / "a.txt")
    assert again.dimensions.tolist() == [[1.5, 0.01, 4], [-1, -1, -1]]
    assert again.occlusion.tolist() == [2, -1]
    results = replace(labels, name=np.array(["Car", "Van"]), score=np.array([0.5, 0.25]))
    write_labels(tmp_path / "b.txt", results)
    assert read_labels(tmp_path / "b.txt", scored=True).has_3d().tolist() == [True, False]


NO_BOX = np.zeros((2, 6))


@pytest.mark.parametrize(
    ("boxes", "names", "scores", "message"),
    [
        (NO_BOX, ["Car"] * 2, None, "boxes: want shape (M, 7) with x, y, z, l, w, h, yaw, got (2, 6)"),
        (BOXES[0], ["Car"] * 2, None, "boxes: want shape (M, 7) with x, y, z, l, w, h, yaw, got (7,)"),
        (BOXES * np.nan, ["Car"] * 2, None, "boxes: want finite numbers, got nan"),
        (BOXES.astype(str), ["Car"] * 2, None, "boxes: want real numbers, got dtype"),
        (BOXES, ["Car"], None, "names: want one for each of the 2 boxes, got 1"),
        (BOXES, ["Car"] * 2, np.ones(3), "scores: want one for each of the 2 boxes, got shape (3,)"),
        (BOXES, ["Car"] * 2, np.ones((2, 1)), "scores: want one for each of the 2 boxes, got shape (2, 1)"),
        (BOXES, ["Car"] * 2, np.array([1, np.inf]), "scores: want finite numbers, got inf"),
        (BOXES * [1, 1, 1, 1, 0, 1, 1], ["Car"] * 2, None, "boxes: want l, w, h above 0, got [4.  0.  1.5] in row 0"),
    ],
)
def test_boxes_that_are_no_labels(boxes: np.ndarray, names: list[str], scores: np.ndarray | None, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        boxes_to_labels(boxes, names, None, scores)


def test_detections_without_a_size_are_results() -> None:
    assert len(boxes_to_labels(BOXES * [1, 1, 1, 0, 0, 0, 1], ["Car"] * 2, None, np.ones(2))) == 2


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((5, 3)), "points: want shape (N, 4) with x, y, z, reflectance, got (5, 3)"),
        (np.zeros(4), "points: want shape (N, 4) with x, y, z, reflectance, got (4,)"),
        (np.zeros((5, 4), np.complex64), "points: want real numbers, got dtype complex64"),
        (np.zeros((5, 4)).astype(str), "points: want real numbers, got dtype <U"),
    ],
)
def test_points_that_are_none(tmp_path: Path, points: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        write_points(tmp_path / "a.bin", points)
    assert not (tmp_path / "a.bin").exists()


@pytest.mark.filterwarnings("error")
def test_points_of_any_number(tmp_path: Path) -> None:
    """What is not finite, also once it is float32, is for the reader to drop, who says so."""
    write_points(tmp_path / "a.bin", np.array([[1, 2, 3, 0], [np.nan, 0, 0, 0], [1e300, 0, 0, 0]]))
    np.testing.assert_array_equal(read_points(tmp_path / "a.bin")[:, 0], [1, np.nan, np.inf])
    write_points(tmp_path / "b.bin", np.array([[1, 2, 3, 0]] * 3))
    assert read_points(tmp_path / "b.bin").tolist() == [[1, 2, 3, 0]] * 3


@pytest.mark.parametrize("occlusion", ["1e30", "-1e30", "0.5"])
def test_an_occlusion_that_no_whole_number_holds(tmp_path: Path, occlusion: str) -> None:
    path = tmp_path / "000000.txt"
    path.write_text(CAR.replace(" 1 ", f" {occlusion} ", 1) + "\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=f":1: field 3 is '{occlusion}', not a whole number"):
            read_labels(path)


@pytest.mark.parametrize("name", ["Car\n", " Car", "two words", ""])
def test_a_name_that_a_file_would_not_give_back(name: str) -> None:
    with pytest.raises(ValueError, match="names: want classes of one word each"):
        boxes_to_labels(np.array([[10.0, 0, 0, 4, 2, 1.5, 0]]), [name])
