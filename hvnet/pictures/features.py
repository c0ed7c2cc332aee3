"""Pictures of pseudo-images: what the encoder makes of a cloud."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import AsinhNorm
from matplotlib.figure import Figure
from torch import Tensor

from hvnet.network.detector import Detector
from hvnet.pictures.clouds import WIDTH, write_figure


class Features(NamedTuple):
    """The pseudo-images of a model for one cloud."""

    name: str  # of the model
    images: Sequence[Tensor]  # (B, C, N_L, N_W) each, of which the first sample is drawn
    cells: Sequence[tuple[float, float]]  # length and width of a cell of each image, in metres
    corner: tuple[float, float]  # least x and y of all images, in metres


def features_of(detector: Detector, points: Tensor, name: str) -> Features:
    """The pseudo-images that a detector makes of points (N, 4), under the name of its model."""
    config = detector.config.encoder
    points = points.to(detector.device)
    sample = torch.zeros(len(points), dtype=torch.int64, device=detector.device)
    images = [image.to("cpu", torch.float32, copy=True) for image in detector.encode(points, sample, 1)]
    length, width = config.voxel_size
    cells = [(length * scale, width * scale) for scale in config.projection_scales]
    return Features(name, images, cells, config.point_range[:2])


def draw_features(path: Path, models: Sequence[Features], title: str) -> None:
    """Writes the pseudo-images of one or several models: a row for each projection scale, finest first.

    The columns are the first channel of every model, as in the paper, then the norm over the channels.
    """
    rows = max(len(model.images) for model in models)
    width = max(3.4 * 2 * len(models), WIDTH)
    figure = Figure(figsize=(width, 0.5 + 3.2 * rows), layout="compressed")
    axes = figure.subplots(rows, 2 * len(models), squeeze=False)
    for axis in axes.flat:
        axis.axis("off")
    for at, model in enumerate(models):
        for row, (image, cell) in enumerate(zip(model.images, model.cells, strict=True)):
            channels = image[0].detach().float().cpu()  # (C, N_L, N_W)
            for column, values in ((at, channels[0]), (len(models) + at, channels.norm(dim=0))):
                _show_feature(axes[row, column], values, cell, model.corner, column < len(models))
                what = "first channel" if column < len(models) else "norm"
                lines = f"{model.name}\n" if len(models) > 1 else ""
                axes[row, column].set_title(f"{lines}{what}, cells of {cell[0]:g} m", fontsize=9, parse_math=False)
    figure.suptitle(title, parse_math=False)
    write_figure(figure, path, dpi=110)


def _show_feature(
    axes: Axes, values: Tensor, cell: tuple[float, float], corner: tuple[float, float], signed: bool
) -> None:
    """An image (N_L, N_W) as seen from above, up to the 99.5th percentile of what is not zero.

    Below their median the values are coloured linearly, above by their logarithm: few cells hold the greatest.
    """
    length, width = (count * size for count, size in zip(values.shape, cell, strict=True))
    x, y = corner
    known = values[values != 0].abs().numpy()
    median, most = np.percentile(known, (50, 99.5)) if len(known) else (1.0, 1.0)
    image = axes.imshow(
        values.flip(1).numpy(),
        origin="lower",
        extent=(-(y + width), -y, x, x + length),
        cmap="RdBu_r" if signed else "magma",
        norm=AsinhNorm(median, -most if signed else 0.0, most),
        interpolation="nearest" if max(values.shape) < 300 else "antialiased",
    )
    axes.axis("on")
    axes.tick_params(labelsize=7)
    figure = axes.get_figure(root=True)
    assert figure is not None
    ticks = [0, median, most]
    bar = figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02, ticks=[-most, -median, *ticks] if signed else ticks)
    bar.ax.yaxis.set_major_formatter("{x:.2g}")
    bar.ax.tick_params(labelsize=7)
    bar.minorticks_off()
