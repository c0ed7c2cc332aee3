"""Generated scenes: deterministic, in KITTI's layout, with labels that agree with the points and the geometry."""

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.boxes import box_corners, boxes_collide, points_in_boxes
from hvnet.cli import InputError
from hvnet.data import shapes, synthetic
from hvnet.data.kitti import IMAGE_SIZE, Labels, boxes_to_lidar, in_image, read_frame, read_labels, read_split
from hvnet.data.shapes import Material
from hvnet.data.synthetic import CALIBRATION, Object, Options, Scan, Scene, assemble, generate, make_frame
from hvnet.kernels.raycast import raycast

FRAMES = 10


@pytest.fixture(scope="module")
def frames() -> list[tuple[Scene, Scan, Labels]]:
    return [make_frame(0, index, Options()) for index in range(FRAMES)]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "kitti"
    generate(folder, 2, 1, seed=0)
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def car_at(x: float, y: float, yaw: float = 0.0) -> Object:
    mesh = shapes.car("saloon").fitted(4, 1.7, 1.5).moved(x, y, -1.73, yaw)
    return Object("Car", np.array([x, y, -0.98, 4, 1.7, 1.5, yaw]), mesh, tint=1.0)


def scan_of(*objects: Object, background: tuple[shapes.Mesh, ...] = ()) -> tuple[Scan, Labels]:
    ground = shapes.block((200, 200, 1), (0, 0, -2.23), Material.ASPHALT)
    scene = assemble([(mesh, 1.0) for mesh in (ground, *background)], objects)
    measured = synthetic.scan(scene, np.random.default_rng(0), Options())
    return measured, synthetic.make_labels(scene, measured)


# --- determinism and files -------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not(root: Path, tmp_path: Path) -> None:
    generate(tmp_path / "again", 2, 1, seed=0)
    assert contents(tmp_path / "again") == contents(root)
    generate(tmp_path / "other", 1, 0, seed=1)
    cloud = "training/velodyne/000000.bin"
    assert contents(tmp_path / "other")[cloud] != contents(root)[cloud]


def test_a_frame_does_not_depend_on_the_number_of_frames(root: Path) -> None:
    _, measured, _ = make_frame(0, 2, Options())
    assert measured.points.tobytes() == (root / "training" / "velodyne" / "000002.bin").read_bytes()


def test_the_kitti_reader_reads_what_was_made(root: Path) -> None:
    assert read_split(root, "train") == ["000000", "000001"]
    assert read_split(root, "val") == ["000002"]
    scene, measured, labels = make_frame(0, 0, Options())
    frame = read_frame(root, "000000")
    assert frame.points.equal(torch.from_numpy(measured.points[in_image(measured.points, CALIBRATION, IMAGE_SIZE)]))
    assert frame.names == tuple(labels.name[labels.name != "DontCare"].tolist())
    # label files hold two decimals
    nearest = np.linalg.norm(frame.boxes[:, None, :6].numpy() - scene.boxes[None, :, :6], axis=2).min(axis=1)
    assert len(nearest)
    assert nearest.max() < 0.02


def test_a_complete_folder_is_left_as_it_is_and_a_partial_one_completed(root: Path, tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    generate(root, 2, 1, seed=0)
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before

    generate(tmp_path, 2, 1, seed=0)
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps(meta | {"complete": False}))
    (tmp_path / "training" / "label_2" / "000001.txt").unlink()
    generate(tmp_path, 2, 1, seed=0)
    assert contents(tmp_path) == contents(root)


def test_a_folder_of_something_else_is_refused_and_untouched(root: Path, tmp_path: Path) -> None:
    before = contents(root)
    with pytest.raises(InputError, match=r"other options.*meta\.json"):
        generate(root, 2, 1, seed=5)
    with pytest.raises(InputError, match="other options"):
        generate(root, 2, 1, seed=0, options=Options(cars=(1, 1)))
    assert contents(root) == before
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        generate(tmp_path, 1, 1, seed=0)
    with pytest.raises(InputError, match="not empty"):
        generate(tmp_path / "notes.txt", 1, 1, seed=0)
    assert contents(tmp_path) == {"notes.txt": b"mine"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (Options(azimuth=20), "azimuth 20"),
        (Options(distance=(10, 5)), "distance 10 to 5"),
        (Options(cars=(3, 1)), "cars 3 to 1"),
    ],
)
def test_impossible_options_are_refused(options: Options, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        generate(tmp_path / "out", 1, 1, seed=0, options=options)
    with pytest.raises(InputError, match="negative"):
        generate(tmp_path / "out", -1, 1, seed=0)
    assert not (tmp_path / "out").exists()


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    synthetic.main(["--out", str(tmp_path), "--train", "1", "--val", "1", "--seed", "3", "--distance", "30"])
    assert "2 frames" in capsys.readouterr().out
    for frame_id in ("000000", "000001"):
        labels = read_labels(tmp_path / "training" / "label_2" / f"{frame_id}.txt")
        boxes = boxes_to_lidar(labels.select(labels.name != "DontCare"), CALIBRATION)
        assert (np.hypot(boxes[:, 0], boxes[:, 1]) < 30.1).all()
    with pytest.raises(SystemExit, match="0"):
        synthetic.main(["--help"])


# --- scenes ----------------------------------------------------------------------------------------------------------


def test_boxes_enclose_their_meshes_tightly(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    for scene, _, _ in frames:
        for k, box in enumerate(scene.boxes):
            offset = scene.vertices[np.unique(scene.faces[scene.owner == k])] - box[:3]
            cos, sin = math.cos(box[6]), math.sin(box[6])
            local = offset @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
            np.testing.assert_allclose(local.max(axis=0), box[3:6] / 2, atol=1e-6)
            np.testing.assert_allclose(local.min(axis=0), -box[3:6] / 2, atol=1e-6)


def test_the_front_of_a_car_is_lower_than_its_rear_half() -> None:
    for style in shapes.CAR_STYLES:
        vertices = shapes.car(style).vertices
        assert vertices[vertices[:, 0] > 0.3, 2].max() < 0.75
        assert vertices[np.abs(vertices[:, 0] + 0.15) < 0.2, 2].max() > 0.9


def test_objects_do_not_overlap(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    for scene, _, _ in frames:
        boxes = torch.from_numpy(scene.boxes)
        assert boxes_collide(boxes, boxes).equal(torch.eye(len(boxes), dtype=torch.bool))


def test_objects_stand_on_the_ground(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    """Rays straight down from the middle of each object to what belongs to no object."""
    for scene, _, _ in frames:
        start = torch.from_numpy(scene.boxes[:, :3]).float()
        down = torch.tensor([[0.0, 0, -1]]).expand(len(start), 3)
        ground = torch.from_numpy(scene.faces[scene.owner < 0])
        distance, _, _ = raycast(torch.from_numpy(scene.vertices).float(), ground, start, down, 10.0)
        np.testing.assert_allclose(distance.numpy(), scene.boxes[:, 5] / 2, atol=0.1)


def test_sizes_follow_the_statistics() -> None:
    rng = np.random.default_rng(0)
    for name, (mean, deviation, _) in synthetic.SIZES.items():
        sizes = np.array([synthetic._size(rng, name) for _ in range(500)])
        np.testing.assert_allclose(sizes.mean(axis=0), mean, atol=0.2 * max(deviation))
        np.testing.assert_allclose(sizes.std(axis=0), deviation, rtol=0.2)
        assert sizes.min() > 0.1


def test_every_class_and_both_directions_appear(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    names = np.concatenate([labels.name for _, _, labels in frames])
    assert (names == "Car").sum() >= 3 * FRAMES
    assert (names == "Pedestrian").sum() >= FRAMES
    assert (names == "Cyclist").sum() >= FRAMES / 2
    assert (names == "Van").any()
    yaws = np.concatenate([scene.boxes[[name == "Car" for name in scene.names], 6] for scene, _, _ in frames])
    assert (np.abs(yaws) < 0.6).mean() > 0.2  # as the sensor
    assert (np.abs(yaws) > math.pi - 0.6).mean() > 0.2  # oncoming


# --- the sensor ------------------------------------------------------------------------------------------------------


def test_points_look_like_those_of_a_velodyne(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    for _, measured, _ in frames:
        xyz, reflectance = measured.points[:, :3].astype(np.float64), measured.points[:, 3].astype(np.float64)
        assert 10_000 < in_image(xyz, CALIBRATION, IMAGE_SIZE).sum() < 25_000  # KITTI: 15,000 to 23,000
        np.testing.assert_allclose(xyz, xyz.round(3), atol=1e-5)
        np.testing.assert_allclose(reflectance, reflectance.round(2), atol=1e-6)
        assert reflectance.min() >= 0
        assert reflectance.max() <= 1
        distance = np.linalg.norm(xyz, axis=1)
        elevation = np.degrees(np.arcsin(xyz[:, 2] / distance))
        assert elevation.min() > -24.6
        assert elevation.max() < 2.3
        assert distance.max() < 121
        assert np.abs(np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0]))).max() < 50.3


def test_points_lie_on_the_surface_that_the_beam_meets() -> None:
    wall = shapes.block((1, 60, 20), (20.5, 0, 0), Material.FACADE)
    measured, _ = scan_of(background=(wall,))
    on_wall = measured.points[measured.points[:, 2] > -1.5, 0]
    assert len(on_wall) > 10_000
    assert abs(on_wall.mean() - 20) < 0.01
    assert 0.01 < on_wall.std() < 0.03


def test_a_whole_turn_is_scanned_if_asked() -> None:
    _, measured, _ = make_frame(0, 0, replace(Options(), azimuth=180.0))
    azimuth = np.degrees(np.arctan2(measured.points[:, 1], measured.points[:, 0]))
    counts, _ = np.histogram(azimuth, bins=36, range=(-180, 180))
    assert counts.min() > 1500
    assert 80_000 < len(measured.points) < 133_000  # KITTI: 108,000 to 127,000


def test_points_become_fewer_with_the_distance() -> None:
    counts = [int(scan_of(car_at(x, 0.0))[0].hits[0]) for x in (8, 16, 32, 64)]
    # four times fewer at twice the distance, and a loss for weak returns
    for near, far in pairwise(counts):
        assert 2.5 < near / far < 12
    assert 300 < counts[1] < 1200  # the middle 80 % of KITTI's cars at 10 to 20 m have 193 to 1116
    assert 30 < counts[2] < 290


# --- labels ----------------------------------------------------------------------------------------------------------


def test_labelled_objects_have_points_of_their_own_in_their_boxes(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    own, inside = 0, 0
    for scene, measured, labels in frames:
        rows = labels.select(labels.name != "DontCare")
        boxes = boxes_to_lidar(rows, CALIBRATION)
        roomy = boxes + np.array([0, 0, 0, 0.1, 0.1, 0.1, 0])  # for the noise of the range
        points = torch.from_numpy(measured.points).double()
        in_box = points_in_boxes(points, torch.from_numpy(roomy)).numpy()  # (N, M)
        for k, box in enumerate(boxes):
            within = in_box[:, k]
            which = int(np.linalg.norm(scene.boxes[:, :3] - box[:3], axis=1).argmin())
            assert rows.name[k] == scene.names[which]
            assert measured.hits[which] >= synthetic.MIN_POINTS
            assert (measured.owner[within] == which).sum() > 0.9 * measured.hits[which]
            above = within & (measured.points[:, 2] > box[2] - box[5] / 2 + 0.25)  # not the ground
            own += int((measured.owner[above] == which).sum())
            inside += int(above.sum())
    assert own > 0.95 * inside


def test_2d_boxes_enclose_the_projected_corners(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    checked = 0
    for _, _, labels in frames:
        rows = labels.select((labels.name != "DontCare") & (labels.truncation == 0))
        corners = box_corners(torch.from_numpy(boxes_to_lidar(rows, CALIBRATION))).numpy()  # (M, 8, 3)
        for bbox, corner in zip(rows.bbox, corners, strict=True):
            pixels, depth = CALIBRATION.project(corner)
            assert (depth > 0).all()
            expected = np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))
            np.testing.assert_allclose(bbox, expected.clip(0, np.tile(np.array(IMAGE_SIZE) - 1, 2)), atol=0.1)
            checked += 1
    assert checked > 3 * FRAMES


def test_labels_are_within_their_ranges(frames: list[tuple[Scene, Scan, Labels]]) -> None:
    for _, _, labels in frames:
        rows = labels.select(labels.name != "DontCare")
        assert ((rows.truncation >= 0) & (rows.truncation <= 1)).all()
        assert np.isin(rows.occlusion, (0, 1, 2, 3)).all()
        np.testing.assert_allclose(
            np.cos(rows.alpha), np.cos(rows.rotation_y - np.arctan2(rows.location[:, 0], rows.location[:, 2]))
        )
        assert (np.abs(rows.alpha) <= math.pi).all()
        assert (rows.location[:, 2] > 0).all()


def test_a_free_car_is_neither_occluded_nor_truncated() -> None:
    measured, labels = scan_of(car_at(15.0, 1.0, 0.3))
    assert measured.hidden[0] == 0
    assert (labels.name.tolist(), labels.occlusion.tolist(), labels.truncation.tolist()) == (["Car"], [0], [0.0])


@pytest.mark.parametrize(("share", "occlusion"), [(0.08, 0), (0.3, 1), (0.7, 2), (0.93, 3)])
def test_a_wall_before_a_car_occludes_it(share: float, occlusion: int) -> None:
    """A post at x = 4.9 m hides this share of the car's rear, 1.7 m wide at 13 m, from the left side on."""
    width, left = share * 1.7 * 4.9 / 13, 0.85 * 4.9 / 13
    post = shapes.block((0.01, width + 0.1, 6), (4.905, left - width / 2 + 0.05, 0), Material.STONE)
    measured, labels = scan_of(car_at(15.0, 0.0), background=(post,))
    assert abs(measured.hidden[0] - share) < 0.05
    assert labels.occlusion.tolist() == [occlusion]


def test_a_hidden_car_is_not_labelled() -> None:
    wall = shapes.block((0.2, 6, 6), (8, 0, 0), Material.STONE)
    measured, labels = scan_of(car_at(15.0, 0.0), background=(wall,))
    assert measured.hidden[0] == 1
    assert measured.hits[0] == 0
    assert len(labels) == 0


def test_a_car_that_can_be_seen_with_too_few_points_is_a_dont_care_region() -> None:
    scene = assemble([], [car_at(30.0, 0.0)])
    measured = Scan(np.zeros((0, 4), np.float32), np.zeros(0, np.int64), np.array([0.2]), np.array([4]))
    labels = synthetic.make_labels(scene, measured)
    assert labels.name.tolist() == ["DontCare"]
    assert (labels.bbox[:, 2:] > labels.bbox[:, :2]).all()
    assert (labels.truncation[0], labels.occlusion[0], labels.location[0, 0]) == (-1, -1, -1000)


def test_a_car_across_the_edge_of_the_image_is_truncated() -> None:
    # the left edge of the image is 40.2 degrees to the left: at x = 10 m, y = 8.45 m
    _, labels = scan_of(car_at(10.0, 8.45, math.pi / 2))
    assert 0.3 < labels.truncation[0] < 0.7
    assert labels.bbox[0, 0] == 0
    shares = synthetic.truncation(np.array([[10, y, -0.98, 4, 1.7, 1.5, 0] for y in (0, 6, 8, 9, 30)], dtype=float))
    assert (np.diff(shares) >= 0).all()
    assert shares[0] == 0
    assert shares[-1] == 1


def test_a_car_outside_the_image_is_not_labelled() -> None:
    measured, labels = scan_of(car_at(10.0, 11.0))
    assert measured.hits[0] > 100
    assert len(labels) == 0
