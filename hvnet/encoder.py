"""Hybrid voxel feature extraction (Sec. 3.1 and 3.2): points to pseudo-images, at voxel scales S_T and S_R."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hvnet.config import EncoderConfig
from hvnet.kernels.scatter import segment_gather, segment_max, segment_mean
from hvnet.kernels.voxel import Grid, Voxels, make_grid, voxel_index

POINT_CHANNELS = 4  # d: x, y, z, reflectance


def pyramid_depth(config: EncoderConfig) -> int:
    """Blocks of the main stream: three, or one a projection scale; each but the first halves the map."""
    return max(3, len(config.projection_scales))


def projection_grids(config: EncoderConfig) -> list[Grid]:
    """The grids of S_R, finest first; the finest is padded so that every block of the backbone halves it evenly."""
    finest = make_grid(
        config.point_range, config.voxel_size, config.projection_scales[0], 2 ** (pyramid_depth(config) - 1)
    )
    grids = [finest]
    for _ in config.projection_scales[1:]:
        last = grids[-1]
        grids.append(
            last._replace(
                cell=(2 * last.cell[0], 2 * last.cell[1]),
                cells=(-(-last.cells[0] // 2), -(-last.cells[1] // 2)),
                shape=(last.shape[0] // 2, last.shape[1] // 2),
            )
        )
    return grids


def attention_knowledge(points: Tensor, voxels: Voxels) -> Tensor:
    """Eq. 2: g = (x - mean x, f, mean p) of every point (N, d) in its voxel: (N, 2d)."""
    mean = segment_mean(points, voxels.segments)[voxels.segments.voxel]
    return torch.cat((points[:, :3] - mean[:, :3], points[:, 3:], mean), dim=1)


def batch_norm(norm: nn.BatchNorm1d, rows: Tensor) -> Tensor:
    """Batch norm of rows (N, C); a batch of fewer than two rows has no variance and takes the running one."""
    if norm.training and len(rows) < 2:
        return F.batch_norm(rows, norm.running_mean, norm.running_var, norm.weight, norm.bias, False, 0.0, norm.eps)
    return norm(rows)


class AttentiveVFE(nn.Module):
    """The layer inside AVFE and AVFEO (Fig. 3): M = BN(Linear(features)) * BN(Linear(g)), then the maximum a voxel.

    One set of weights serves all scales. The batch norm of g takes its statistics over all scales at once: running
    statistics that mix scales would differ from those of any one scale in training.
    """

    def __init__(self, in_channels: int, out_channels: int, relu: bool) -> None:
        super().__init__()
        self.features = nn.Linear(in_channels, out_channels, bias=False)
        self.features_norm = nn.BatchNorm1d(out_channels)
        self.knowledge = nn.Linear(2 * POINT_CHANNELS, out_channels, bias=False)
        self.knowledge_norm = nn.BatchNorm1d(out_channels)
        self.relu = relu

    def forward(self, features: Tensor, knowledge: list[Tensor], voxels: list[Voxels]) -> list[tuple[Tensor, Tensor]]:
        """Features (N, C) and g (N, 2d) of every scale give M (N, q) and its maxima G' (V, q) of every scale."""
        weighed = batch_norm(self.features_norm, self.features(features))
        attention = batch_norm(self.knowledge_norm, self.knowledge(torch.cat(knowledge)))
        if self.relu:
            weighed, attention = weighed.relu(), attention.relu()
        scales = []
        for rows, at in zip(attention.chunk(len(knowledge)), voxels, strict=True):
            product = weighed * rows
            scales.append((product, segment_max(product, at.segments)[0]))
        return scales


class HybridVoxelEncoder(nn.Module):
    """HVFE: points are encoded in the voxels of every feature scale and projected into every projection scale."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.projection_grids = projection_grids(config)
        shared = dict(zip(config.projection_scales, self.projection_grids, strict=True))
        self.feature_grids = [
            shared.get(scale) or make_grid(config.point_range, config.voxel_size, scale)
            for scale in config.feature_scales
        ]
        channels = config.feature_channels
        self.avfe = AttentiveVFE(POINT_CHANNELS, channels, config.attention_relu)
        self.avfeo = AttentiveVFE(
            2 * channels * len(config.feature_scales), config.image_channels, config.attention_relu
        )

    def forward(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Tensor]:
        """Points (N, 4) of samples (N,) to the images I^{s_r} (B, N_H, N_L, N_W), channels-last, finest first."""
        grids = list(dict.fromkeys(self.feature_grids + self.projection_grids))
        index = voxel_index(points, sample, batch_size, grids)
        points = points[index.order]
        voxels = dict(zip(grids, index.scales, strict=True))
        knowledge = {grid: attention_knowledge(points, voxels[grid]) for grid in grids}

        at = [voxels[grid] for grid in self.feature_grids]
        encoded = self.avfe(points, [knowledge[grid] for grid in self.feature_grids], at)
        context = torch.cat(  # H (N, e): [M, G'] of every feature scale
            [
                part
                for (product, maxima), scale in zip(encoded, at, strict=True)
                for part in (product, segment_gather(maxima, scale.segments))
            ],
            dim=1,
        )
        at = [voxels[grid] for grid in self.projection_grids]
        projected = self.avfeo(context, [knowledge[grid] for grid in self.projection_grids], at)
        return [
            project(maxima, scale.cursor, grid, batch_size)
            for (_, maxima), scale, grid in zip(projected, at, self.projection_grids, strict=True)
        ]


def project(features: Tensor, cursor: Tensor, grid: Grid, batch_size: int) -> Tensor:
    """Eq. 3: writes voxel features (V, C) at x = cursor div N_W, y = cursor mod N_W of a zero (B, C, N_L, N_W)."""
    image = features.new_zeros(batch_size * grid.shape[0] * grid.shape[1], features.shape[1])
    image = image.index_copy(0, cursor, features)
    return image.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2)
