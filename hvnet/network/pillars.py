"""Hard voxels, and PointPillars' encoder on them (Lang et al., CVPR 2019), with which the paper compares its own.

A hard voxel has places for a fixed number of points: those beyond it are dropped, and places without a point are
calculated all the same.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from hvnet.kernels.encode import write_image
from hvnet.kernels.scatter import scatter_max, scatter_mean
from hvnet.kernels.voxel import Grid, voxel_index

POINT_FEATURES = 9  # x, y, z, reflectance; offsets to the mean of the points, 3, and to the middle of the pillar, 2


class HardVoxels(NamedTuple):
    """The points that find a place."""

    point: Tensor  # (K,) int64, indices into the points given, voxel by voxel
    voxel: Tensor  # (K,) int64 in [0, V)
    place: Tensor  # (K,) int64 in [0, point_limit)
    cursor: Tensor  # (V,) int64, Eq. 1 plus sample * N_L * N_W


def hard_voxels(
    points: Tensor, sample: Tensor, batch_size: int, grid: Grid, point_limit: int, voxel_limit: int
) -> HardVoxels:
    """The first `point_limit` points of a voxel, in the order of the cloud, and of each sample the first `voxel_limit`
    voxels, in the order of their first points; a limit of 0 is none. Points (N, 4) of samples (N,).

    VoxelNet and PointPillars choose at random which points stay. The first ones are the same in every run, but they are
    no fair sample where a scanner gives its rings one after the other: KITTI's begin at the top.
    """
    index = voxel_index(points, sample, batch_size, [grid])
    cursor, (voxel, starts, by_voxel) = index.scales[0]
    order = index.order
    if by_voxel is not None:  # the index is hashed
        order, voxel = order[by_voxel], voxel[by_voxel]
    kept = torch.ones_like(voxel, dtype=torch.bool)
    # within one grid the order of the points of a voxel is that of the cloud
    place = torch.arange(len(voxel), device=voxel.device) - starts[voxel]
    if point_limit:
        kept &= place < point_limit
    if voxel_limit:
        of_sample = cursor // (grid.shape[0] * grid.shape[1])
        first = order[starts[:-1]] + of_sample * len(points)
        rank = torch.empty_like(first)
        rank[first.argsort()] = torch.arange(len(first), device=first.device)
        before = torch.bincount(of_sample, minlength=batch_size).cumsum(0)
        rank -= torch.cat((before.new_zeros(1), before[:-1]))[of_sample]
        taken = rank < voxel_limit
        kept &= taken[voxel]
        voxel, cursor = (taken.cumsum(0) - 1)[voxel], cursor[taken]
    return HardVoxels(order[kept], voxel[kept], place[kept], cursor)


class PillarEncoder(nn.Module):
    """PointPillars' encoder: one scale, hard voxels, 9 features of a point, Linear, batch norm, ReLU, maximum.

    A place without a point has nine zeros, and like all others it counts in the batch norm and in the maximum. In
    inference all places are calculated, as PointPillars does; in training, with the same result, only those with points
    are, since what becomes of zeros is known.
    """

    def __init__(self, grid: Grid, channels: int = 64, point_limit: int = 100, voxel_limit: int = 12000) -> None:
        super().__init__()
        self.grid, self.point_limit, self.voxel_limit = grid, point_limit, voxel_limit
        self.linear = nn.Linear(POINT_FEATURES, channels, bias=False)
        self.norm = nn.BatchNorm1d(channels, eps=1e-3, momentum=0.01)

    def forward(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Tensor]:
        """Points (N, 4) of samples (N,) to the one pseudo-image (B, C, N_L, N_W), channels-last."""
        hard = hard_voxels(points, sample, batch_size, self.grid, self.point_limit, self.voxel_limit)
        maxima = self.maxima_of_points(points, hard) if self.training else self.maxima(points, hard)
        image = write_image(maxima, hard.cursor, batch_size * self.grid.shape[0] * self.grid.shape[1])
        return [image.view(batch_size, *self.grid.shape, -1).permute(0, 3, 1, 2)]

    def features(self, points: Tensor, hard: HardVoxels) -> Tensor:
        """The features (K, 9) of the points (N, 4) that have a place."""
        grid, (n_l, n_w) = self.grid, self.grid.shape
        kept = points[hard.point]
        mean = scatter_mean(kept[:, :3].contiguous(), hard.voxel, len(hard.cursor))
        column = torch.stack((hard.cursor // n_w % n_l, hard.cursor % n_w), dim=1)
        centre = (column + 0.5) * points.new_tensor(grid.cell) + points.new_tensor((grid.x_min, grid.y_min))
        return torch.cat((kept, kept[:, :3] - mean[hard.voxel], kept[:, :2] - centre[hard.voxel]), dim=1)

    def maxima(self, points: Tensor, hard: HardVoxels) -> Tensor:
        """The maxima (V, C) over all places of the voxels."""
        rows = self.features(points, hard)
        places = rows.new_zeros(len(hard.cursor), self.point_limit, POINT_FEATURES)
        places = places.index_put((hard.voxel, hard.place), rows)
        features = self.norm(self.linear(places).flatten(0, 1)).relu()
        return features.view(*places.shape[:2], features.shape[1]).amax(1)

    def maxima_of_points(self, points: Tensor, hard: HardVoxels) -> Tensor:
        """The maxima (V, C), calculated at the places with points."""
        features = self.linear(self.features(points, hard))
        places = len(hard.cursor) * self.point_limit
        norm = self.norm
        mean, variance = norm.get_buffer("running_mean"), norm.get_buffer("running_var")
        if places > 1:
            mean = features.sum(0) / places
            squares = (features - mean).square().sum(0) + (places - len(features)) * mean.square()
            with torch.no_grad():
                norm.get_buffer("running_mean").lerp_(mean, norm.momentum or 0.1)
                norm.get_buffer("running_var").lerp_(squares / (places - 1), norm.momentum or 0.1)
                norm.get_buffer("num_batches_tracked").add_(1)
            variance = squares / places
        scale = norm.weight * torch.rsqrt(variance + norm.eps)
        shift = norm.bias - mean * scale
        maxima, _ = scatter_max((features * scale + shift).relu(), hard.voxel, len(hard.cursor))
        full = torch.bincount(hard.voxel, minlength=len(hard.cursor)) == self.point_limit
        return torch.where(full[:, None], maxima, torch.maximum(maxima, shift.relu()))
