"""One frame: what its camera sees, what is labelled in it, and the shapes that are refused."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hvnet.boxes import EDGES, box_corners
from hvnet.data.frame import IMAGE_SIZE, NEAR, Frame, Objects, object_names
from hvnet.exceptions import InputError
from tests.helpers import CAMERA

# --- the camera -------------------------------------------------------------------------------------------------------


def test_axes() -> None:
    xyz = np.array([[10.0, 2, -1]])
    assert CAMERA.to_camera(xyz).tolist() == [[-2, 1, 10]]
    assert CAMERA.to_lidar(np.array([[-2.0, 1, 10]])).tolist() == [[10, 2, -1]]
    uv, depth = CAMERA.project(xyz)
    np.testing.assert_allclose(uv, [[600 - 140, 180 + 70]])
    assert depth.tolist() == [10]


# boxes in CAMERA's view, where u = 600 - 700 y / x and v = 180 - 700 z / x
PROJECTED: dict[str, tuple[list[float], list[float] | None]] = {
    "ahead": ([20, 0, 0, 4, 2, 2, 0], [600 - 700 / 18, 180 - 700 / 18, 600 + 700 / 18, 180 + 700 / 18]),
    "cut by the left edge": ([10, 9, 0, 2, 2, 2, 0], [0, 180 - 700 / 9, 600 - 700 * 8 / 11, 180 + 700 / 9]),
    "around the camera": ([0, 0, 0, 8, 2, 2, 0], [0, 0, 1241, 374]),
    "half behind, to the left": ([0, 5, 0, 40, 2, 2, 0], [0, 0, 600 - 700 * 4 / 20, 374]),
    "behind": ([-20, 0, 0, 4, 2, 2, 0], None),
    "beside the image": ([10, 20, 0, 2, 2, 2, 0], None),
    "above the image": ([10, 0, 20, 2, 2, 2, 0], None),
}


@pytest.mark.parametrize("name", PROJECTED)
def test_project_boxes(name: str) -> None:
    box, expected = PROJECTED[name]
    bbox, visible = CAMERA.project_boxes(np.array([box], dtype=np.float64))
    assert visible.tolist() == [expected is not None]
    np.testing.assert_allclose(bbox, [expected or [0] * 4], atol=1e-9)


def test_project_no_boxes() -> None:
    bbox, visible = CAMERA.project_boxes(np.zeros((0, 7)))
    assert bbox.shape == (0, 4)
    assert visible.shape == (0,)


def test_boxes_are_clipped_to_the_size_of_the_image() -> None:
    camera = replace(CAMERA, size=(700, 200))
    bbox, visible = camera.project_boxes(np.array([[8.0, 0, 0, 6, 4, 2, 0], [20, -5, 0, 4, 2, 2, 0]]))
    assert bbox[0].tolist() == [600 - 700 * 2 / 5, 180 - 700 / 5, 699, 199]
    assert visible.tolist() == [True, False]  # the other is at u of 727 and more


def test_sees() -> None:
    pixels = [(0, 0), (1241.9, 374.9), (-0.1, 100), (1242.1, 100), (100, -0.1), (100, 375.1)]
    points = np.array([[10, (600 - u) / 70, (180 - v) / 70, 0] for u, v in pixels] + [[-10, 0, 0, 0], [0, 0, 0, 0]])
    # the first lies on the edge itself: a hair inside, as rounding would have it either way
    points[0, 1:3] -= 1e-9
    assert CAMERA.size == IMAGE_SIZE == (1242, 375)
    assert CAMERA.sees(points).tolist() == [True, True] + [False] * 6
    assert replace(CAMERA, size=(1300, 375)).sees(points).tolist() == [True, True, False, True] + [False] * 4


def test_read_image(tmp_path: Path) -> None:
    """In RGB, whatever the file has; None where there is none."""
    assert CAMERA.read_image() is None
    path = tmp_path / "a.png"
    camera = replace(CAMERA, image=path)
    with pytest.raises(InputError, match=re.escape(f"{path}: not an image, or cut off; replace or remove it")):
        camera.read_image()
    Image.new("L", (6, 4), 100).save(path)
    image = camera.read_image()
    assert image is not None
    assert image.shape == (4, 6, 3)
    assert (image == 100).all()
    path.write_bytes(path.read_bytes()[:50])
    with pytest.raises(InputError, match=re.escape(f"{path}: not an image, or cut off")):
        camera.read_image()


def test_a_damaged_image_is_an_error_of_the_file(tmp_path: Path) -> None:
    """Pillow has several kinds of error for them."""
    path = tmp_path / "a.png"
    Image.new("RGB", (30, 20), (1, 2, 3)).save(path)
    whole = path.read_bytes()
    for damaged in (whole.replace(b"\0\0\0\x0dIHDR", b"\0\0\0\x02IHDR"), whole.replace(b"IDAT", b"\xbd\xf8\xb6\x11")):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=re.escape(f"{path}: not an image")):
            replace(CAMERA, image=path).read_image()


# --- objects and frames -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("boxes", [np.arange(14.0).reshape(2, 7), torch.arange(14.0).view(2, 7), [[0] * 7, [1] * 7]])
def test_objects_take_arrays(boxes: object) -> None:
    objects = Objects(boxes, np.array(["Car", "traffic cone 2"]))  # type: ignore[arg-type]
    assert objects.boxes.dtype == torch.float32
    assert objects.boxes.shape == (2, 7)
    assert objects.boxes.tolist() == [list(map(float, row)) for row in boxes]  # type: ignore[attr-defined]
    assert objects.names == ("Car", "traffic cone 2")
    assert {type(name) for name in objects.names} == {str}
    assert objects.labels is None
    assert objects.of_classes(["Car", "Van"]).tolist() == objects.boxes[:1].tolist()
    assert objects.of_classes([]).shape == (0, 7)


@pytest.mark.parametrize("boxes", [[], np.zeros((0, 7)), torch.zeros(0), np.zeros((0, 3))])
def test_no_objects(boxes: object) -> None:
    objects = Objects(boxes, [])  # type: ignore[arg-type]
    assert objects.boxes.shape == (0, 7)
    assert objects.boxes.dtype == torch.float32
    assert objects.of_classes(["Car"]).shape == (0, 7)


@pytest.mark.parametrize("shape", [(7,), (2, 8), (7, 8), (2, 14), (1, 2, 7), (2, 6)])
def test_objects_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(
        ValueError, match=re.escape(f"boxes: want shape (M, 7) with x, y, z, l, w, h, yaw, got {shape}")
    ):
        Objects(torch.ones(shape), ["Car"] * 2)


def test_one_name_for_every_box() -> None:
    with pytest.raises(ValueError, match="names: want one for each of the 2 boxes, got 1"):
        Objects(torch.ones(2, 7), ["Car"])
    with pytest.raises(ValueError, match="names: want one for each of the 0 boxes, got 1"):
        Objects(torch.ones(0, 7), ["Car"])


@pytest.mark.parametrize("points", [np.arange(8.0).reshape(2, 4), torch.arange(8.0).view(2, 4), [[0, 1, 2, 3]] * 2])
def test_a_frame_takes_arrays(points: object) -> None:
    frame = Frame("a", points)  # type: ignore[arg-type]
    assert frame.points.dtype == torch.float32
    assert frame.points.shape == (2, 4)
    assert frame.points[0].tolist() == [0, 1, 2, 3]
    assert (frame.objects, frame.camera, frame.notes) == (None, None, [])
    assert frame.boxes_of(["Car"]).shape == (0, 7)
    assert Frame("b", np.zeros((0, 4))).points.shape == (0, 4)  # type: ignore[arg-type]


@pytest.mark.parametrize("shape", [(4,), (0,), (4, 3), (3, 5), (1, 2, 4)])
def test_points_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    message = f"points: want shape (N, 4) with x, y, z, reflectance, got {shape}"
    with pytest.raises(ValueError, match=re.escape(message)):
        Frame("a", torch.zeros(shape))


def test_boxes_of_some_classes() -> None:
    boxes = torch.arange(21.0).view(3, 7)
    frame = Frame("a", torch.zeros(0, 4), Objects(boxes, ["Car", "bicycle", "Car"]))
    assert torch.equal(frame.boxes_of(["Car"]), boxes[[0, 2]])
    assert torch.equal(frame.boxes_of(["bicycle", "Car"]), boxes)
    assert frame.boxes_of(["Truck"]).shape == (0, 7)


class Pair:
    """The least that frames are: the first is labelled, the second is not."""

    names = ("a", "b")

    def __len__(self) -> int:
        return 2

    def __getitem__(self, k: int) -> Frame:
        return Frame(self.names[k], torch.zeros(0, 4), None if k else Objects(torch.ones(1, 7), ["cone"]))


class Quick(Pair):
    """Knows its classes without reading a frame."""

    def object_names(self, k: int) -> Sequence[str] | None:
        return None if k else ["Truck"]


def test_object_names() -> None:
    assert [object_names(Pair(), k) for k in range(2)] == [("cone",), None]
    assert [object_names(Quick(), k) for k in range(2)] == [["Truck"], None]


# --- lines and faces in the image -------------------------------------------------------------------------------------

WIDE = replace(CAMERA, p2=np.array([[500.0, 0, 500, 0], [0, 500, 200, 0], [0, 0, 1, 0]]), size=(1000, 400))
"""A camera at the LiDAR: u = 500 - 500 y / x, v = 200 - 500 z / x."""
FRONT = [0, 1, 5, 4]

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
    lines, seen = WIDE.project_lines(np.array([begin], float), np.array([end], float))
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
    polygon = WIDE.project_polygon(np.array(corners, float))
    assert len(polygon) == count
    if bounds is not None:
        np.testing.assert_allclose((*polygon.min(axis=0), *polygon.max(axis=0)), bounds, rtol=0, atol=1e-9)


def test_the_2d_box_holds_what_is_drawn_of_a_box() -> None:
    """Boxes of any place, size and heading: nothing of their edges and faces is outside their 2D box."""
    generator = torch.Generator().manual_seed(0)
    scale, shift = torch.tensor([40.0, 30, 6, 6, 6, 6, 6]), torch.tensor([-10.0, -15, -3, 0.1, 0.1, 0.1, 0])
    boxes = (torch.rand(500, 7, generator=generator) * scale + shift).double()
    corners = box_corners(boxes).numpy()
    bbox, visible = WIDE.project_boxes(boxes.numpy())
    assert 100 < visible.sum() < 500
    for k in range(len(boxes)):
        lines, _ = WIDE.project_lines(corners[k, EDGES[:, 0]], corners[k, EDGES[:, 1]])
        face = WIDE.project_polygon(corners[k, FRONT])
        drawn = np.concatenate((lines.reshape(-1, 2), face))
        assert visible[k] or len(drawn) == 0
        assert (drawn >= bbox[k, :2] - 1e-6).all()
        assert (drawn <= bbox[k, 2:] + 1e-6).all()
