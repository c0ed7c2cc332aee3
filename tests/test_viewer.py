"""The viewer: what it computes, what it shows of a frame, and what its controls do, without a browser."""

import contextlib
import itertools
import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from hvnet.data.frame import Frame, Frames, Objects
from hvnet.data.kitti import KittiFrames, boxes_to_labels, write_labels
from hvnet.data.sources import find_frames
from hvnet.evaluation.mistakes import FALSE_POSITIVE, MISS, Mistake
from hvnet.evaluation.rules import config_rules
from hvnet.exceptions import InputError
from hvnet.kernels.voxel import make_grid
from hvnet.network.detector import Detector, load
from hvnet.network.model import Detections
from hvnet.pictures.viewer import (
    Viewer,
    box_lines,
    brighter,
    camera_for,
    ground_height,
    mistake_line,
    norm_image,
    paragraph,
    points_per_voxel,
    shades,
    start_server,
)
from tests.browser import shown
from tests.helpers import CAMERA, GivenFrames

SCORES = [0.9, 0.5, 0.1]


@pytest.fixture(scope="module")
def detector() -> Detector:
    return load(device="cpu")


@pytest.fixture
def serve(detector: Detector) -> Iterator[Callable[[Path | Frames], Viewer]]:
    """Makes viewers of inputs, or of frames of any format."""
    pytest.importorskip("viser")
    servers = []

    def start(given: Path | Frames) -> Viewer:
        servers.append(start_server("127.0.0.1", 0))
        return Viewer(servers[-1], detector, find_frames([given]) if isinstance(given, Path) else given)

    yield start
    for server in servers:
        server.stop()


@pytest.fixture
def viewer(serve: Callable[[Path], Viewer], scenes: Path) -> Viewer:
    """The viewer of the six generated frames."""
    return serve(scenes)


# --- what is computed ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("score", "kept"), [(0.0, [0, 1, 2]), (0.1, [0, 1, 2]), (0.5, [0, 1]), (0.51, [0]), (1, [])])
def test_detections_are_filtered_by_score(score: float, kept: list[int]) -> None:
    found = Detections(torch.rand(3, 7), torch.tensor(SCORES, dtype=torch.float64), torch.tensor([2, 0, 1]))
    for column, all_rows in zip(found.select(found.scores >= score), found, strict=True):
        assert torch.equal(column, all_rows[kept])


def test_shades_go_from_dark_to_bright_and_stop_there() -> None:
    colours = shades(np.array([-9.0, 0, 1, 2, 9]), 0, 2)
    assert colours.dtype == np.uint8
    assert colours[[0, 1, 3, 4]].tolist() == [[68, 1, 84]] * 2 + [[253, 231, 36]] * 2  # viridis' ends
    assert (np.diff(colours[1:4].astype(int).sum(axis=1)) > 0).all()
    assert shades(np.zeros(0), 0, 1).shape == (0, 3)


def test_colours_are_brighter_on_dark_ground() -> None:
    assert [brighter(colour) for colour in ("#000000", "#ff0000", "#ffffff")] == ["#4c4c4c", "#ff4c4c", "#ffffff"]


@pytest.mark.parametrize(("yaw", "front"), [(0, (12, 5)), (math.pi / 2, (10, 7)), (-math.pi, (8, 5))])
def test_lines_of_a_box(yaw: float, front: tuple[float, float]) -> None:
    """Twelve edges, and one line on the top from the middle to the front."""
    lines = box_lines(torch.tensor([[10.0, 5, -1, 4, 2, 1.5, yaw]]))
    assert lines.shape == (1, 13, 2, 3)
    lengths = np.linalg.norm(lines[0, :, 0] - lines[0, :, 1], axis=1)
    np.testing.assert_allclose(sorted(lengths), [1.5] * 4 + [2] * 5 + [4] * 4, rtol=1e-5)
    np.testing.assert_allclose(lines[0, 12], [(10, 5, -0.25), (*front, -0.25)], atol=1e-5)
    assert box_lines(torch.zeros(0, 7)).shape == (0, 13, 2, 3)


def test_points_per_voxel() -> None:
    grid = make_grid((0.0, -2.0, -3.0, 4.0, 2.0, 1.0), (0.5, 0.5), 1.0)
    xyz = [(0.1, 0.1, 0), (0.4, 0.4, -2), (0.6, 0.1, 0), (0.2, 0.3, 0.5), (9, 0, 0), (0.1, 0.1, 1.5), (3.9, -1.9, 0)]
    points = torch.cat((torch.tensor(xyz), torch.zeros(len(xyz), 1)), dim=1)
    assert points_per_voxel(points, grid).tolist() == [3, 3, 1, 3, 0, 0, 1]
    assert points_per_voxel(points[:0], grid).tolist() == []


def test_norm_image_has_x_to_the_right_and_y_down() -> None:
    image = torch.zeros(2, 3, 5, dtype=torch.bfloat16)
    image[:, 1, 4] = torch.tensor([3.0, 4.0])
    image[:, 2, 0] = torch.tensor([0.0, 1.0])
    colours = norm_image(image)
    assert colours.shape == (5, 3, 4)
    assert np.argwhere(colours[..., 3]).tolist() == [[0, 2], [4, 1]]
    assert colours[4, 1, :3].sum() > colours[0, 2, :3].sum()  # a larger norm is brighter
    assert not norm_image(torch.zeros(2, 3, 5))[..., 3].any()


def test_the_ground_is_below_nearly_all_points() -> None:
    z = torch.cat((torch.linspace(-1.7, 1, 1000), torch.tensor([-50.0])))
    points = torch.stack((torch.zeros_like(z), torch.zeros_like(z), z, torch.zeros_like(z)), dim=1)
    assert -1.75 < ground_height(points) < -1.6
    assert ground_height(points[:0]) == 0


@pytest.mark.parametrize(
    ("centre", "stand"),
    [((30, 0, -1), (20, 0, 5)), ((0, 30, -1), (0, 20, 5)), ((-30, -40, 1), (-24, -32, 7)), ((0, 0, 0), (-10, 0, 6))],
)
def test_the_camera_comes_from_the_sensor(centre: tuple[float, ...], stand: tuple[float, ...]) -> None:
    position, look_at = camera_for(torch.tensor([*centre, 4, 2, 1.5, 0.3], dtype=torch.float32))
    np.testing.assert_allclose(position, stand, atol=1e-5)
    np.testing.assert_allclose(look_at, centre)


@pytest.mark.parametrize(
    ("kind", "line"), [(MISS, "Car, 7 points, 12 m, 000003"), (FALSE_POSITIVE, "Car, score 0.82, 12 m, 000003")]
)
def test_a_mistake_in_words(kind: str, line: str) -> None:
    assert mistake_line(Mistake("000003", kind, "Car", torch.zeros(7), 0.824, 12.3, 7, 0.4)) == line


def test_text_is_no_html() -> None:
    assert "a&lt;b&gt;.bin: bad<br>&amp;" in paragraph("a<b>.bin: bad", "&")


# --- what a frame shows ----------------------------------------------------------------------------------------------


def test_what_a_frame_shows(serve: Callable[[Path], Viewer], scenes: Path, tmp_path: Path) -> None:
    """Its image where there is one, its labels where there are some; what cannot be read is said."""
    root = tmp_path / "kitti"
    shutil.copytree(scenes / "training", root / "training")
    (root / "training" / "label_2" / "000001.txt").unlink()
    images = root / "training" / "image_2"
    images.mkdir()
    Image.new("L", (30, 20)).save(images / "000000.png")
    (images / "000002.png").write_text("no image")
    viewer = serve(root)
    assert viewer.camera.visible
    assert viewer.picture.image.shape == (20, 30, 3)
    assert viewer.frame.objects is not None
    viewer.go(1)
    assert not viewer.camera.visible
    assert viewer.frame.objects is None
    viewer.go(2)
    assert "000002.png: not an image" in viewer.info.content
    viewer = serve(root / "training" / "velodyne")
    assert len(viewer.frame.points) * 16 == (root / "training" / "velodyne" / "000000.bin").stat().st_size
    assert viewer.frame.objects is None
    assert not viewer.camera.visible


def test_a_frame_without_a_camera(serve: Callable[[Path], Viewer], scenes: Path, tmp_path: Path) -> None:
    folder = tmp_path / "training"
    for name in ("velodyne", "label_2"):
        (folder / name).mkdir(parents=True)
    shutil.copy(scenes / "training" / "velodyne" / "000000.bin", folder / "velodyne")
    boxes = np.array([[-9.0, -3.0, -0.9, 0.8, 0.7, 1.7, -2.0]])
    write_labels(folder / "label_2" / "000000.txt", boxes_to_labels(boxes, ["Pedestrian"]))
    frame = serve(tmp_path).frame
    assert len(frame.points) * 16 == (folder / "velodyne" / "000000.bin").stat().st_size
    assert frame.objects is not None
    np.testing.assert_allclose(frame.objects.boxes.numpy(), boxes, atol=0.01)
    assert frame.camera is None


def test_a_real_frame_with_its_image(serve: Callable[[Path | Frames], Viewer], kitti_root: Path) -> None:
    """The first of KITTI's frames that has one: image, labels and the crop to the view."""
    name = sorted((kitti_root / "training" / "image_2").iterdir())[0].stem
    viewer = serve(KittiFrames(kitti_root, [name]))
    camera, objects = viewer.frame.camera, viewer.frame.objects
    assert camera is not None
    assert objects is not None
    assert viewer.camera.visible
    assert viewer.picture.image.shape == (camera.size[1], camera.size[0], 3)
    assert camera.sees(viewer.frame.points.numpy()).all()
    assert f"{len(objects.boxes)} labelled" in viewer.info.content
    names = [text.text for text, _ in viewer.texts]
    assert names[: len(objects.names)] == list(objects.names)


def test_frames_of_another_format(serve: Callable[[Path | Frames], Viewer], viewer: Viewer, tmp_path: Path) -> None:
    """What its arrays or its image have wrong is said where the frame is chosen, and other frames can be chosen."""
    points, objects = viewer.frame.points, Objects(torch.tensor([[10.0, 0, -1, 4, 2, 1.5, 0]]), ["Car"])
    damaged = replace(CAMERA, image=tmp_path / "image.png")
    (tmp_path / "image.png").write_text("no image")
    other = serve(
        GivenFrames(
            Frame("a", points, objects),
            Frame("b", points, objects, damaged),
            ValueError("points: want shape (N, 4)"),
            Frame("d", points, Objects(torch.zeros(0, 7), [])),
        )
    )
    other.search()
    assert "4 of 4 frames searched at score 0.5<br>1 cannot be read" in other.progress.content
    assert set(other.mistakes) == {0, 1, 3}
    other.go(1)
    assert "image.png: not an image" in other.info.content
    assert shown(other.info.content) == (0, 0)
    other.go(2)
    assert "frame frame 2: points: want shape (N, 4)" in other.info.content
    other.go(3)
    assert shown(other.info.content)[1] > 0
    assert "0 labelled" in other.info.content
    with pytest.raises(InputError, match="2 frames are named a"):
        serve(GivenFrames(Frame("a", points), Frame("a", points)))


# --- controls ---------------------------------------------------------------------------------------------------------


def test_the_slider_filters_boxes_and_names(viewer: Viewer) -> None:
    scores = viewer.detections.scores
    assert len(scores) > 3
    for score in (0.1, 0.3, float(scores.median()), 0.7, 1.0):
        viewer.score.value = score
        kept = int((scores >= viewer.score.value).sum())
        assert shown(viewer.info.content) == (kept, len(scores))
        names = [text for text, _ in viewer.texts if text.visible]
        assert len(names) == kept + len(viewer.frame.boxes_of(["Car", "Pedestrian", "Cyclist", "Van"]))
    viewer.named.value = False
    assert not any(text.visible for text, _ in viewer.texts)


def test_frames_follow_each_other_round(viewer: Viewer) -> None:
    names = [f"{k:06d}" for k in range(6)]
    seen = []
    for _ in range(7):
        assert viewer.frame.objects is not None
        assert viewer.frame.name == viewer.chooser.value
        seen.append(viewer.chooser.value)
        viewer.go(viewer.wanted + 1)
    assert seen == [*names, names[0]]
    viewer.go(-1)
    assert viewer.chooser.value == names[-1]


def test_all_colours_and_pseudo_images_can_be_drawn(viewer: Viewer) -> None:
    scene = viewer.server.scene
    for colour in viewer.colour.options:
        viewer.colour.value = colour
        node: Any = scene.get_handle_by_name("/points")
        assert node.colors.shape == viewer.frame.points[:, :3].shape
        assert len(np.unique(node.colors, axis=0)) > 5
    assert scene.get_handle_by_name("/pseudo-image") is None
    sizes = []
    for scale in viewer.overlay.options[1:]:
        viewer.overlay.value = scale
        node = scene.get_handle_by_name("/pseudo-image")
        sizes.append((node.render_width, node.render_height, *node.position[:2]))
    assert sizes == [(64, 64, 32, 0)] * 3  # metres: the range of the shipped weights
    viewer.overlay.value = "off"
    assert scene.get_handle_by_name("/pseudo-image") is None


def test_pillars_have_one_grid(pillars: Path, scenes: Path) -> None:
    pytest.importorskip("viser")
    server = start_server("127.0.0.1", 0)
    try:
        viewer = Viewer(server, load(pillars, "cpu"), find_frames([scenes]))
        assert viewer.colour.options[2:] == ("points in its 0.16 m voxel",)
        assert viewer.overlay.options[1:] == ("0.16 m",)
        viewer.colour.value, viewer.overlay.value = viewer.colour.options[2], viewer.overlay.options[1]
        node: Any = server.scene.get_handle_by_name("/pseudo-image")
        np.testing.assert_allclose((node.render_width, node.render_height, *node.position[:2]), (25.6, 25.6, 12.8, 0))
    finally:
        server.stop()


def test_the_worst_mistakes_are_listed_and_shown(viewer: Viewer) -> None:
    viewer.search()
    assert "6 of 6 frames searched at score 0.5" in viewer.progress.content
    for column, mistakes in zip(viewer.buttons, viewer.listed, strict=True):
        assert mistakes
        lines = [button.label for button in column if button.visible]
        assert lines == [mistake_line(mistake) for mistake in mistakes]
    misses, false_positives = viewer.listed
    assert all(a.points >= b.points for a, b in itertools.pairwise(misses))
    assert all(a.score >= b.score for a, b in itertools.pairwise(false_positives))
    for mistake in (misses[0], false_positives[-1]):
        client: Any = SimpleNamespace(camera=SimpleNamespace(), atomic=contextlib.nullcontext)
        viewer.jump(mistake, client)
        np.testing.assert_allclose(client.camera.look_at, mistake.box[:3], rtol=1e-6)
        assert viewer.chooser.value == mistake.frame
        node: Any = viewer.server.scene.get_handle_by_name("/chosen")
        np.testing.assert_allclose(node.points.mean(axis=(0, 1))[:2], mistake.box[:2], atol=0.2)
    viewer.go(viewer.wanted + 1)
    assert viewer.server.scene.get_handle_by_name("/chosen") is None


def test_mistakes_by_the_rules_that_are_given(detector: Detector, viewer: Viewer, scenes: Path) -> None:
    """With a lower overlap no more is missed, and less is wrong."""
    server = start_server("127.0.0.1", 0)
    try:
        rules = config_rules(detector.config, dict.fromkeys(detector.classes, 0.05))
        lenient = Viewer(server, detector, find_frames([scenes]), rules)
        for each in (viewer, lenient):
            each.search()
        counts = [sum(map(len, each.mistakes.values())) for each in (viewer, lenient)]
        assert counts[1] < counts[0]
    finally:
        server.stop()


def test_a_frame_that_cannot_be_read_is_named_and_left_again(
    serve: Callable[[Path], Viewer], scenes: Path, tmp_path: Path
) -> None:
    shutil.copytree(scenes, tmp_path / "kitti")
    (tmp_path / "kitti" / "training" / "velodyne" / "000001.bin").write_bytes(bytes(15))
    viewer = serve(tmp_path / "kitti")
    viewer.search()
    assert "6 of 6 frames searched at score 0.5<br>1 cannot be read" in viewer.progress.content
    viewer.go(1)
    assert "000001.bin: 15 bytes" in viewer.info.content
    assert shown(viewer.info.content) == (0, 0)
    viewer.go(2)
    assert shown(viewer.info.content)[1] > 0


def test_frames_with_and_without_labels(serve: Callable[[Path], Viewer], scenes: Path, tmp_path: Path) -> None:
    """Those without are counted, wherever they stand; the mistakes are those of the others."""
    folder = tmp_path / "kitti" / "training"
    shutil.copytree(scenes / "training", folder)
    for k in (0, 1, 5):
        (folder / "label_2" / f"{k:06d}.txt").unlink()
    (folder / "velodyne" / "000002.bin").write_bytes(bytes(15))
    viewer = serve(tmp_path / "kitti")
    viewer.search()
    assert "6 of 6 frames searched at score 0.5<br>3 have no labels<br>1 cannot be read" in viewer.progress.content
    assert all(folder.visible for folder in viewer.folders)
    assert set(viewer.mistakes) == {3, 4}
    assert {mistake.frame for column in viewer.listed for mistake in column} <= {"000003", "000004"}


def test_labels_of_frames_that_cannot_be_read(serve: Callable[[Path], Viewer], scenes: Path, tmp_path: Path) -> None:
    """Where no frame with labels can be read there is nothing to list."""
    folder = tmp_path / "kitti" / "training"
    shutil.copytree(scenes / "training", folder)
    for file in sorted((folder / "label_2").iterdir())[:5]:
        file.unlink()
    (folder / "velodyne" / "000005.bin").write_bytes(bytes(15))
    viewer = serve(tmp_path / "kitti")
    viewer.search()
    assert not any(each.visible for each in viewer.folders)
    assert "5 have no labels<br>1 cannot be read" in viewer.progress.content


def test_clouds_without_labels_have_no_mistakes(serve: Callable[[Path], Viewer], scenes: Path) -> None:
    viewer = serve(scenes / "training" / "velodyne")
    viewer.search()
    assert not any(folder.visible for folder in viewer.folders)
    assert list(viewer.found) == [0]  # where nothing can be missed, nothing is searched
    assert "no mistakes are known" in viewer.progress.content
    assert viewer.listed == ([], [])
    assert shown(viewer.info.content)[1] > 0
    assert "labelled" not in viewer.info.content
