"""Pictures: what the camera sees of lines and boxes, what is drawn of a cloud, and files in every format."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from hvnet.boxes import box_corners
from hvnet.data.kitti import AT_LIDAR, EDGES, NEAR, Calibration, project_boxes, read_frame, read_image, read_split
from hvnet.draw import (
    FRONT,
    Camera,
    Features,
    Subject,
    draw_bev,
    draw_features,
    draw_frame,
    project_lines,
    project_polygon,
    show_bev,
    show_camera,
)

RANGE = (0.0, -10.0, -3.0, 30.0, 10.0, 2.0)
CLASSES = ("Car", "Pedestrian")


def picture(path: Path, points: Tensor, truth: Tensor, boxes: Tensor, labels: Tensor) -> np.ndarray:
    scores = torch.linspace(0.9, 0.1, len(boxes))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_bev(path, Subject(points, truth, boxes, scores, labels, CLASSES), RANGE, "a frame")
    with Image.open(path) as image:
        assert image.format == "PNG"
        assert (image.width, image.height) == (880, int(110 * (0.9 + 8 * 30 / 20)))
        return np.asarray(image.convert("RGB")).astype(int)


def near(image: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Where (H, W) the image has a colour; 60 of 255 allow for smoothed edges."""
    return (np.abs(image - np.array(colour)).sum(axis=2)) < 60


NONE = torch.zeros(0, 7)
NO_LABEL = torch.zeros(0, dtype=torch.int64)
CAR = torch.tensor([[20.0, 5.0, -1.0, 4.0, 2.0, 1.5, 0.3]])
RED, GREEN = (214, 39, 40), (26, 152, 80)

# --- from above -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [torch.zeros(0, 4), torch.rand(200, 4) * 10, torch.full((5, 4), 1e6)])
@pytest.mark.parametrize("truth", [NONE, CAR])
@pytest.mark.parametrize("boxes", [NONE, CAR])
def test_any_number_of_points_and_boxes(tmp_path: Path, points: Tensor, truth: Tensor, boxes: Tensor) -> None:
    labels = torch.zeros(len(boxes), dtype=torch.int64)
    image = picture(tmp_path / "new" / "folder" / "a.png", points, truth, boxes, labels)
    assert near(image, GREEN).any() == (len(truth) > 0)
    assert near(image, RED).any() == (len(boxes) > 0)


def test_a_box_stands_where_it_is(tmp_path: Path) -> None:
    """x is up and y to the left: a box far ahead on the left is in the upper left of the picture."""
    image = picture(tmp_path / "a.png", torch.zeros(0, 4), NONE, CAR, torch.zeros(1, dtype=torch.int64))
    rows, columns = near(image, RED).nonzero()
    drawn = rows > 150  # below the legend
    assert columns[drawn].max() < image.shape[1] / 2
    assert rows[drawn].max() < image.shape[0] / 2


def test_boxes_outside_the_range_do_not_shrink_the_picture(tmp_path: Path) -> None:
    away = torch.tensor([[2000.0, 0.0, 0.0, 4.0, 2.0, 1.5, math.pi / 4], [0.0, -2000.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    points = torch.rand(2000, 4) * torch.tensor([30.0, 20.0, 2.0, 1.0]) - torch.tensor([0.0, 10.0, 1.0, 0.0])
    without = picture(tmp_path / "a.png", points, NONE, NONE, NO_LABEL)
    image = picture(tmp_path / "b.png", points, away, away, torch.tensor([0, 1]))
    legend = np.zeros(image.shape[:2], dtype=bool)
    legend[:200, 500:] = True
    assert (image == without)[~legend].all()


def collections(axes: object, kind: type) -> list:
    return [each for each in axes.collections if isinstance(each, kind)]


def subject(points: Tensor = NONE[:, :4], truth: Tensor = NONE, boxes: Tensor = NONE) -> Subject:
    """Detections take turns in class and are ever less certain."""
    labels = torch.arange(len(boxes)) % len(CLASSES)
    return Subject(points, truth, boxes, torch.linspace(0.9, 0.5, len(boxes)), labels, CLASSES)


def test_what_is_drawn_from_above() -> None:
    """Labels and detections are told apart, each detection has its score, and each ring its radius."""
    axes = Figure().add_subplot()
    boxes = CAR.repeat(3, 1) + torch.tensor([[0.0] * 7, [-5.0] + [0.0] * 6, [-10.0] + [0.0] * 6])
    points = torch.rand(50, 4) * 10
    scattered = show_bev(axes, subject(points, CAR, boxes), RANGE)
    assert len(scattered.get_offsets()) == 50
    lines = {each.get_label(): each for each in collections(axes, LineCollection)}
    assert set(lines) == {"labelled (1)", "Car (2)", "Pedestrian (1)"}
    assert [len(each.get_segments()) for each in lines.values()] == [2, 4, 2]  # an outline and a heading each
    assert len({tuple(each.get_colors()[0]) for each in lines.values()}) == 3
    heading = lines["labelled (1)"].get_segments()[1]
    np.testing.assert_allclose(heading, [[-5, 20], [-5 - 2 * math.sin(0.3), 20 + 2 * math.cos(0.3)]], rtol=1e-6)
    texts = [each.get_text() for each in axes.texts]
    assert [each for each in texts if "m" not in each] == ["0.90", "0.50", "0.70"]  # class by class
    radii = [each.get_radius() for each in axes.patches]
    assert radii == [5, 10, 15, 20, 25, 30]
    shown = [text for text in texts if "m" in text]
    assert shown == [f"{radius:g} m" for radius in radii][: len(shown)]
    assert len(shown) >= 5


def test_points_by_height_and_by_reflectance() -> None:
    points = torch.tensor([[5.0, 0.0, -1.0, 0.25], [6.0, 0.0, 0.5, 0.75]])
    for colour, values in (("height", [-1.0, 0.5]), ("reflectance", [0.25, 0.75])):
        scattered = show_bev(Figure().add_subplot(), subject(points), RANGE, colour)
        assert scattered.get_array().tolist() == values


# --- in the image -----------------------------------------------------------------------------------------------------

SIZE = (1000, 400)
CALIB = Calibration(
    p2=np.array([[500.0, 0, 500, 0], [0, 500, 200, 0], [0, 0, 1, 0]]),
    r0_rect=AT_LIDAR.r0_rect,
    velo_to_cam=AT_LIDAR.velo_to_cam,
)
"""The camera at the LiDAR: u = 500 - 500 y / x, v = 200 - 500 z / x."""

# begin and end in LiDAR axes, what is seen of the line in pixels
LINES = {
    "in the image": ((10, 0, 0), (10, 1, 0.5), ((500, 200), (450, 175))),
    "behind the camera": ((-10, 0, 0), (-1, 0, 0), None),
    "before the near plane": ((NEAR / 2, 0, 0), (-1, 0, 0), None),
    "cut at the near plane": ((10, 0, 0.01), (-10, 0, 0.01), ((500, 199.5), (500, 150))),
    "the other way round": ((-10, 0, 0.01), (10, 0, 0.01), ((500, 150), (500, 199.5))),
    "cut at the top on its way behind": ((10, 0, 0), (-10, 0, 1), ((500, 200), (500, 0))),
    "cut at the left": ((10, 0, 0), (10, 20, 0), ((500, 200), (0, 200))),
    "cut at the right": ((10, 0, 0), (10, -20, 0), ((500, 200), (999, 200))),
    "cut at the bottom": ((10, 0, 0), (10, 0, -20), ((500, 200), (500, 399))),
    "cut on both sides": ((10, 20, 0), (10, -20, 0), ((0, 200), (999, 200))),
    "beside the image": ((10, 20, 0), (10, 30, 0), None),
    "past a corner": ((10, 12, 3), (10, 9, 6), None),
    "beside the camera": ((5, 8, 0), (-5, 8, 0), None),
}


@pytest.mark.parametrize("case", LINES)
def test_lines(case: str) -> None:
    begin, end, expected = LINES[case]
    lines, seen = project_lines(np.array([begin], float), np.array([end], float), CALIB, SIZE)
    assert seen.tolist() == [expected is not None]
    np.testing.assert_allclose(lines, np.reshape(expected or [], (-1, 2, 2)), rtol=0, atol=1e-9)


# corners in LiDAR axes, number of corners that are seen, and left, top, right, bottom in pixels
POLYGONS = {
    "in the image": ([(10, 1, -1), (10, -1, -1), (10, -1, 1), (10, 1, 1)], 4, (450, 150, 550, 250)),
    "over the right border": ([(10, -8, -1), (10, -12, -1), (10, -12, 1), (10, -8, 1)], 4, (900, 150, 999, 250)),
    "over a corner": ([(10, 8, 2), (10, 11, 2), (10, 8, 5)], 5, (0, 0, 100, 100)),
    "larger than the image": ([(10, 90, -90), (10, -90, -90), (10, -90, 90), (10, 90, 90)], 4, (0, 0, 999, 399)),
    "behind the camera": ([(-9, 1, -1), (-9, -1, -1), (-9, -1, 1), (-9, 1, 1)], 0, None),
    "the road under the camera": ([(10, 1, -1), (10, -1, -1), (-10, -1, -1), (-10, 1, -1)], 4, (301, 250, 699, 399)),
}


@pytest.mark.parametrize("case", POLYGONS)
def test_polygons(case: str) -> None:
    corners, count, bounds = POLYGONS[case]
    polygon = project_polygon(np.array(corners, float), CALIB, SIZE)
    assert len(polygon) == count
    if bounds is not None:
        np.testing.assert_allclose((*polygon.min(axis=0), *polygon.max(axis=0)), bounds, rtol=0, atol=1e-9)


# a box, and how many of its edges, faces in front and 2D boxes the camera sees
BOXES = {
    "in front": ([20, 0, 0, 4, 2, 1.5, 0.3], (12, 1, 1)),
    "half behind the camera": ([0, 3, 0, 20, 2, 2, 0], (8, 1, 1)),
    "wholly behind the camera": ([-20, 0, 0, 4, 2, 1.5, 0], (0, 0, 0)),
    "larger than the image": ([7, 0, 0, 4, 100, 100, 0], (0, 1, 1)),
    "around the camera": ([0, 0, 0, 40, 100, 100, 0], (0, 1, 1)),
    "beside the image": ([5, 12, 0, 2, 2, 2, 0], (0, 0, 0)),
    "without a size that is known": ([20, 0, 0, math.inf, 2, 2, 0], (0, 0, 0)),
}


@pytest.mark.parametrize("case", BOXES)
@pytest.mark.parametrize("with_image", [False, True])
def test_boxes_in_the_image(case: str, with_image: bool) -> None:
    box, counts = BOXES[case]
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8) if with_image else None
    axes = Figure().add_subplot()
    show_camera(axes, subject(boxes=torch.tensor([box])), Camera(CALIB, SIZE, image))
    lines, polygons = collections(axes, LineCollection), collections(axes, PolyCollection)
    segments = [segment for each in lines for segment in each.get_segments()]
    paths = [len(each.get_paths()) for each in polygons] or [0, 0]
    assert (len(segments), *paths) == counts
    assert [each.get_text() for each in axes.texts] == ["0.90"] * counts[2]
    assert len(axes.images) == with_image
    if segments:
        pixels = np.array(segments).round(6)
        assert (pixels >= 0).all()
        assert (pixels <= [SIZE[0] - 1, SIZE[1] - 1]).all()


def test_the_2d_box_holds_what_is_drawn_of_a_box() -> None:
    """Boxes of any place, size and heading: nothing of their edges and faces is outside their 2D box."""
    generator = torch.Generator().manual_seed(0)
    scale, shift = torch.tensor([40.0, 30, 6, 6, 6, 6, 6]), torch.tensor([-10.0, -15, -3, 0.1, 0.1, 0.1, 0])
    boxes = (torch.rand(500, 7, generator=generator) * scale + shift).double()
    corners = box_corners(boxes).numpy()
    bbox, visible = project_boxes(boxes.numpy(), CALIB, SIZE)
    assert 100 < visible.sum() < 500
    for k in range(len(boxes)):
        lines, _ = project_lines(corners[k, EDGES[:, 0]], corners[k, EDGES[:, 1]], CALIB, SIZE)
        face = project_polygon(corners[k, FRONT], CALIB, SIZE)
        drawn = np.concatenate((lines.reshape(-1, 2), face))
        assert visible[k] or len(drawn) == 0
        assert (drawn >= bbox[k, :2] - 1e-6).all()
        assert (drawn <= bbox[k, 2:] + 1e-6).all()


def test_the_face_in_front_is_in_front() -> None:
    axes = Figure().add_subplot()
    box = torch.tensor([[20.0, 0.0, 0.0, 4.0, 2.0, 1.5, math.pi]])  # it comes towards the camera
    show_camera(axes, subject(truth=box), Camera(CALIB, SIZE, None))
    face = collections(axes, PolyCollection)[0].get_paths()[0].vertices
    np.testing.assert_allclose(np.ptp(face, axis=0), [500 * 2 / 18, 500 * 1.5 / 18], rtol=1e-5)
    assert len(FRONT) == 4


def test_points_stand_for_an_image() -> None:
    """Those in front of the camera, by their depth, where there is no image; none upon an image."""
    points = torch.tensor([[10.0, 1.0, 0.5, 0.0], [-10.0, 1.0, 0.5, 0.0], [1.0, 5.0, 0.0, 0.0]])
    scattered = show_camera(Figure().add_subplot(), subject(points), Camera(CALIB, SIZE, None))
    assert scattered is not None
    assert scattered.get_offsets().tolist() == [[450, 175]]
    assert scattered.get_array().tolist() == [10]
    image = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
    assert show_camera(Figure().add_subplot(), subject(points), Camera(CALIB, SIZE, image)) is None


# --- files ------------------------------------------------------------------------------------------------------------

MAGIC = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


@pytest.mark.parametrize("suffix", MAGIC)
def test_formats_and_the_same_bits(tmp_path: Path, suffix: str) -> None:
    paths = [tmp_path / f"{name}.{suffix}" for name in "ab"]
    for path in paths:
        camera = Camera(CALIB, SIZE, None)
        draw_frame(path, subject(torch.ones(9, 4), CAR, CAR), RANGE, camera, "a frame")
    assert paths[0].read_bytes().startswith(MAGIC[suffix])
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_real_and_generated_frames(kitti_root: Path, scenes: Path, tmp_path: Path) -> None:
    """With an image, without one in a real root, and without one in a generated scene."""
    images = sorted((kitti_root / "training" / "image_2").glob("*.png"))
    blind = next(name for name in read_split(kitti_root, "val") if name not in {path.stem for path in images})
    for root, name in ((kitti_root, images[0].stem), (kitti_root, blind), (scenes, "000000")):
        frame = read_frame(root, name)
        path = root / "training" / "image_2" / f"{name}.png"
        camera = Camera(frame.calib, frame.image_size, read_image(path) if path.is_file() else None)
        shown = subject(frame.points, frame.boxes, frame.boxes)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            draw_frame(tmp_path / f"{name}.png", shown, (0, -32, -3, 64, 32, 2), camera, name)
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.width == 1200
            assert image.height > image.width


@pytest.mark.parametrize("count", [1, 2])
def test_features(tmp_path: Path, count: int) -> None:
    """One model or two, of different grids; an image that is empty is drawn as well."""
    images = [torch.rand(1, 3, 40, 24), torch.zeros(2, 3, 20, 12)]
    first = Features("with attention", images, [(0.4, 0.4), (0.8, 0.8)], (0.0, -4.8))
    second = Features("without", [torch.randn(1, 2, 32, 32)], [(0.5, 0.5)], (0.0, -8.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_features(tmp_path / "a.png", [first, second][:count], "a cloud")
    with Image.open(tmp_path / "a.png") as image:
        assert image.height == int(110 * (0.5 + 3.2 * 2))
        assert image.width == pytest.approx(110 * max(8, 6.8 * count), abs=1)


def test_a_feature_stands_where_its_cell_is(tmp_path: Path) -> None:
    """x is up and y to the left: the last cell of both is in the upper left of its image."""
    values = torch.zeros(1, 1, 40, 40)
    values[0, 0, 30:, 30:] = 1
    draw_features(tmp_path / "a.png", [Features("one", [values], [(0.5, 0.5)], (0.0, -10.0))], "a cloud")
    with Image.open(tmp_path / "a.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    dark_red = near(pixels, (103, 0, 31))[:, : pixels.shape[1] * 3 // 8]  # without the bar of colours
    rows, columns = dark_red.nonzero()
    assert len(rows) > 1000
    assert rows.max() < pixels.shape[0] / 2
    assert columns.max() < pixels.shape[1] / 4
