"""Pictures: what the camera sees of lines and boxes, what is drawn of a cloud, and files in every format."""

import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from hvnet.data.frame import Camera, Frame, Objects
from hvnet.data.kitti import read_frame, read_split
from hvnet.network.model import Detections
from hvnet.pictures.clouds import FRONT, Subject, draw_bev, draw_frame, show_bev, show_camera
from tests.helpers import CAMERA

RANGE = (0.0, -10.0, -3.0, 30.0, 10.0, 2.0)
CLASSES = ("Car", "Pedestrian")


def picture(path: Path, points: Tensor, truth: Tensor, boxes: Tensor, labels: Tensor) -> np.ndarray:
    scores = torch.linspace(0.9, 0.1, len(boxes))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frame = Frame("a frame", points, Objects(truth, ["Car"] * len(truth)))
        draw_bev(path, Subject(frame, Detections(boxes, scores, labels), CLASSES), RANGE, "a frame")
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


def subject(
    points: Tensor = NONE[:, :4], truth: Tensor = NONE, boxes: Tensor = NONE, camera: Camera | None = None
) -> Subject:
    """Detections take turns in class and are ever less certain."""
    labels = torch.arange(len(boxes)) % len(CLASSES)
    frame = Frame("a frame", points, Objects(truth, ["Car"] * len(truth)), camera)
    return Subject(frame, Detections(boxes, torch.linspace(0.9, 0.5, len(boxes)), labels), CLASSES)


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
SEEN = replace(CAMERA, p2=np.array([[500.0, 0, 500, 0], [0, 500, 200, 0], [0, 0, 1, 0]]), size=SIZE)
"""A camera at the LiDAR: u = 500 - 500 y / x, v = 200 - 500 z / x."""


@pytest.fixture(scope="module")
def pictured(tmp_path_factory: pytest.TempPathFactory) -> Camera:
    """The camera with an image."""
    path = tmp_path_factory.mktemp("image") / "black.png"
    Image.new("RGB", SIZE).save(path)
    return replace(SEEN, image=path)


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
def test_boxes_in_the_image(case: str, with_image: bool, pictured: Camera) -> None:
    box, counts = BOXES[case]
    axes = Figure().add_subplot()
    show_camera(axes, subject(boxes=torch.tensor([box]), camera=pictured if with_image else SEEN))
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


def test_the_face_in_front_is_in_front() -> None:
    axes = Figure().add_subplot()
    box = torch.tensor([[20.0, 0.0, 0.0, 4.0, 2.0, 1.5, math.pi]])  # it comes towards the camera
    show_camera(axes, subject(truth=box, camera=SEEN))
    face = collections(axes, PolyCollection)[0].get_paths()[0].vertices
    np.testing.assert_allclose(np.ptp(face, axis=0), [500 * 2 / 18, 500 * 1.5 / 18], rtol=1e-5)
    assert len(FRONT) == 4


def test_points_stand_for_an_image(pictured: Camera) -> None:
    """Those in front of the camera, by their depth, where there is no image; none upon an image."""
    points = torch.tensor([[10.0, 1.0, 0.5, 0.0], [-10.0, 1.0, 0.5, 0.0], [1.0, 5.0, 0.0, 0.0]])
    scattered = show_camera(Figure().add_subplot(), subject(points, camera=SEEN))
    assert scattered is not None
    assert scattered.get_offsets().tolist() == [[450, 175]]
    assert scattered.get_array().tolist() == [10]
    assert show_camera(Figure().add_subplot(), subject(points, camera=pictured)) is None


# --- files ------------------------------------------------------------------------------------------------------------

MAGIC = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


@pytest.mark.parametrize("suffix", MAGIC)
def test_formats_and_the_same_bits(tmp_path: Path, suffix: str) -> None:
    paths = [tmp_path / f"{name}.{suffix}" for name in "ab"]
    for path in paths:
        draw_frame(path, subject(torch.ones(9, 4), CAR, CAR, SEEN), RANGE, "a frame")
    assert paths[0].read_bytes().startswith(MAGIC[suffix])
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_real_and_generated_frames(kitti_root: Path, scenes: Path, tmp_path: Path) -> None:
    """With an image, without one in a real root, and without one in a generated scene."""
    images = sorted((kitti_root / "training" / "image_2").glob("*.png"))
    blind = next(name for name in read_split(kitti_root, "val_first") if name not in {path.stem for path in images})
    for root, name in ((kitti_root, images[0].stem), (kitti_root, blind), (scenes, "000000")):
        frame = read_frame(root, name)
        assert frame.objects is not None
        shown = subject(frame.points, frame.objects.boxes, frame.objects.boxes, frame.camera)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            draw_frame(tmp_path / f"{name}.png", shown, (0, -32, -3, 64, 32, 2), name)
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.width == 1200
            assert image.height > image.width
