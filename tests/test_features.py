"""Pictures of pseudo-images: sizes, and where a cell is drawn."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from hvnet.pictures.features import Features, draw_features


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
    dark_red = (np.abs(pixels - np.array((103, 0, 31))).sum(axis=2) < 60)[
        :, : pixels.shape[1] * 3 // 8
    ]  # without the bar of colours
    rows, columns = dark_red.nonzero()
    assert len(rows) > 1000
    assert rows.max() < pixels.shape[0] / 2
    assert columns.max() < pixels.shape[1] / 4
