"""The encoder as a good PyTorch user writes it, the baseline of voxel_encode.py; none of this project's kernels.

Dynamic voxelisation: cursors by tensor arithmetic, voxel numbers by torch.unique (or none: dense buffers over the whole
grid), then scatter of torch or of torch_scatter. Weights have the names of hvnet.network.encoder's, so that its
state loads. Below it is hard voxelisation, as PointPillars and SECOND have it.
"""

from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hvnet.config import EncoderConfig
from hvnet.kernels.voxel import Grid
from hvnet.network.encoder import HybridVoxelEncoder

try:
    import torch_scatter
except ImportError:
    torch_scatter = None

Reduce = Callable[[Tensor, Tensor, int], Tensor]  # src (N, C), index (N,), rows -> (rows, C)


class Scatter(NamedTuple):
    """The two reductions of a library."""

    mean: Reduce
    maximum: Reduce


class Ids(NamedTuple):
    """The voxels of one scale."""

    voxel: Tensor  # (N,) of each point
    cursor: Tensor | None  # (V,) of each voxel; None: a voxel's number is its cursor
    size: int  # V


def torch_mean(src: Tensor, index: Tensor, size: int) -> Tensor:
    """Mean by index_add, which is faster than scatter_reduce's."""
    count = torch.bincount(index, minlength=size).clamp_(min=1)
    return src.new_zeros(size, src.shape[1]).index_add_(0, index, src) / count[:, None]


def torch_max(src: Tensor, index: Tensor, size: int) -> Tensor:
    """Maximum by scatter_reduce; an empty row is 0."""
    rows = index[:, None].expand(-1, src.shape[1])
    return src.new_zeros(size, src.shape[1]).scatter_reduce(0, rows, src, "amax", include_self=False)


def library(name: str) -> Scatter | None:
    """The reductions of "torch" or "torch_scatter"; None where it is not installed."""
    if name == "torch":
        return Scatter(torch_mean, torch_max)
    if torch_scatter is None:
        return None
    return Scatter(
        lambda src, index, size: torch_scatter.scatter_mean(src, index, dim=0, dim_size=size),
        lambda src, index, size: torch_scatter.scatter_max(src, index, dim=0, dim_size=size)[0],
    )


def cursors(points: Tensor, sample: Tensor, grids: list[Grid]) -> tuple[Tensor, list[Tensor]]:
    """Which points (N,) are inside every grid, and the cursors (N,) at every scale; -1 outside of its grid."""
    z = points[:, 2]
    inside = (z >= grids[0].z_min) & (z < grids[0].z_max) & points[:, 3].isfinite()
    found = []
    for grid in grids:
        x = ((points[:, 0] - grid.x_min) * (1 / grid.cell[0])).floor()
        y = ((points[:, 1] - grid.y_min) * (1 / grid.cell[1])).floor()
        within = (x >= 0) & (x < grid.cells[0]) & (y >= 0) & (y < grid.cells[1])
        cursor = (sample * grid.shape[0] + x.long()) * grid.shape[1] + y.long()
        found.append((within, cursor))
    for within, _ in found:
        inside = inside & within
    return inside, [cursor.where(inside, -1) for _, cursor in found]


def number(cursor: Tensor, grid: Grid, batch_size: int, dense: bool) -> Ids:
    """The voxels of cursors (N,)."""
    if dense:
        return Ids(cursor, None, batch_size * grid.shape[0] * grid.shape[1])
    unique, voxel = torch.unique(cursor, return_inverse=True)
    return Ids(voxel, unique, len(unique))


def knowledge(points: Tensor, ids: Ids, scatter: Scatter) -> Tensor:
    """Eq. 2: g (N, 2d) = (x - mean x, f, mean p)."""
    mean = scatter.mean(points, ids.voxel, ids.size)[ids.voxel]
    return torch.cat((points[:, :3] - mean[:, :3], points[:, 3:], mean), dim=1)


class TorchVFE(nn.Module):
    """AVFE and AVFEO (Fig. 3)."""

    def __init__(self, in_channels: int, out_channels: int, relu: bool) -> None:
        super().__init__()
        self.features = nn.Linear(in_channels, out_channels, bias=False)
        self.features_norm = nn.BatchNorm1d(out_channels)
        self.knowledge = nn.Linear(8, out_channels, bias=False)
        self.knowledge_norm = nn.BatchNorm1d(out_channels)
        self.relu = relu

    def forward(
        self, features: Tensor, given: list[Tensor], scales: list[Ids], scatter: Scatter
    ) -> list[tuple[Tensor, Tensor]]:
        """M (N, q) and its maxima (V, q) at every scale."""
        weighed = self.features_norm(self.features(features))
        attention = self.knowledge_norm(self.knowledge(torch.cat(given)))
        if self.relu:
            weighed, attention = weighed.relu(), attention.relu()
        products = [weighed * rows for rows in attention.chunk(len(given))]
        return [(m, scatter.maximum(m, ids.voxel, ids.size)) for m, ids in zip(products, scales, strict=True)]


class TorchEncoder(nn.Module):
    """HVFE with the weights of a HybridVoxelEncoder."""

    def __init__(self, config: EncoderConfig, like: HybridVoxelEncoder, scatter: Scatter, dense: bool = False) -> None:
        super().__init__()
        self.feature_grids, self.projection_grids = like.feature_grids, like.projection_grids
        self.scatter, self.dense = scatter, dense
        channels = config.feature_channels
        self.avfe = TorchVFE(4, channels, config.attention_relu)
        self.avfeo = TorchVFE(2 * channels * len(config.feature_scales), config.image_channels, config.attention_relu)
        self.load_state_dict(like.state_dict())
        self.train(like.training)
        self.to(next(like.parameters()).device)

    def index(self, points: Tensor, sample: Tensor, batch_size: int) -> tuple[Tensor, dict[Grid, Ids]]:
        """The points that are kept, and the voxels at every scale."""
        grids = list(dict.fromkeys(self.feature_grids + self.projection_grids))
        inside, found = cursors(points, sample, grids)
        return points[inside], {
            grid: number(cursor[inside], grid, batch_size, self.dense)
            for grid, cursor in zip(grids, found, strict=True)
        }

    def context(self, encoded: list[tuple[Tensor, Tensor]], at: list[Ids]) -> Tensor:
        """H (N, e): M and the maxima of its voxel, of every feature scale."""
        parts = [part for (m, maxima), ids in zip(encoded, at, strict=True) for part in (m, maxima[ids.voxel])]
        return torch.cat(parts, dim=1)

    def forward(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Tensor]:
        """The images (B, N_H, N_L, N_W), channels-last, finest first."""
        points, ids = self.index(points, sample, batch_size)
        given = {grid: knowledge(points, of, self.scatter) for grid, of in ids.items()}
        at = [ids[grid] for grid in self.feature_grids]
        encoded = self.avfe(points, [given[grid] for grid in self.feature_grids], at, self.scatter)
        context = self.context(encoded, at)
        at = [ids[grid] for grid in self.projection_grids]
        projected = self.avfeo(context, [given[grid] for grid in self.projection_grids], at, self.scatter)
        images = []
        for (_, maxima), of, grid in zip(projected, at, self.projection_grids, strict=True):
            if of.cursor is not None:
                image = maxima.new_zeros(batch_size * grid.shape[0] * grid.shape[1], maxima.shape[1])
                maxima = image.index_put((of.cursor,), maxima)
            images.append(maxima.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2))
        return images


@numba.njit(cache=True)
def hard_voxels(
    cursor: NDArray[np.int64], points: NDArray[np.float32], cells: int, limit: int
) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.int64]]:
    """Voxels (V, limit, 4) of the first `limit` points of each, padded with zeros; how many (V,); cursors (V,)."""
    place = np.full(cells, -1, np.int64)
    voxels = np.zeros((len(points), limit, 4), np.float32)
    count = np.zeros(len(points), np.int64)
    at = np.empty(len(points), np.int64)
    made = 0
    for i in range(len(points)):
        if cursor[i] < 0:
            continue
        voxel = place[cursor[i]]
        if voxel < 0:
            voxel = made
            place[cursor[i]] = voxel
            at[voxel] = cursor[i]
            made += 1
        if count[voxel] < limit:
            voxels[voxel, count[voxel]] = points[i]
            count[voxel] += 1
    return voxels[:made], count[:made], at[:made]


class PillarEncoder(nn.Module):
    """PointPillars' encoder (Lang et al., CVPR 2019): one scale, 32 points a pillar, 9 features, Linear, BN, ReLU, max.

    Another network than HVNet's, and a smaller one: it is there as the usual price of an encoder. One sample.
    """

    def __init__(self, grid: Grid, channels: int = 64, limit: int = 32) -> None:
        super().__init__()
        self.grid, self.limit = grid, limit
        self.linear = nn.Linear(9, channels, bias=False)
        self.norm = nn.BatchNorm1d(channels)

    def forward(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Tensor]:
        """The image (1, C, N_L, N_W); the voxels are made on the CPU, as in SECOND and PointPillars."""
        grid, device = self.grid, points.device
        n_l, n_w = grid.shape
        (cursor,) = cursors(points, sample, [grid])[1]
        made = hard_voxels(cursor.cpu().numpy(), points.cpu().numpy(), batch_size * n_l * n_w, self.limit)
        voxels, count, at = (torch.from_numpy(part).to(device) for part in made)
        mean = voxels[:, :, :3].sum(1, keepdim=True) / count[:, None, None]
        column = torch.stack((at // n_w % n_l, at % n_w), dim=1)
        centre = (column + 0.5) * voxels.new_tensor(grid.cell) + voxels.new_tensor((grid.x_min, grid.y_min))
        rows = torch.cat((voxels, voxels[:, :, :3] - mean, voxels[:, :, :2] - centre[:, None]), dim=2)
        rows = rows * (torch.arange(self.limit, device=device) < count[:, None])[:, :, None]
        normed = self.norm(self.linear(rows).flatten(0, 1)).relu().view(len(voxels), self.limit, -1)
        image = normed.new_zeros(batch_size * n_l * n_w, normed.shape[2]).index_put((at,), normed.amax(1))
        return [image.view(batch_size, n_l, n_w, -1).permute(0, 3, 1, 2)]
