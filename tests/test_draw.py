"""Pictures: a PNG of the range's shape, whatever it holds."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from hvnet.draw import draw_bev

RANGE = (0.0, -10.0, -3.0, 30.0, 10.0, 2.0)
CLASSES = ("Car", "Pedestrian")


def picture(path: Path, points: Tensor, truth: Tensor, boxes: Tensor, labels: Tensor) -> np.ndarray:
    scores = torch.linspace(0.9, 0.1, len(boxes))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_bev(path, points, RANGE, truth, boxes, scores, labels, CLASSES, "a frame")
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
