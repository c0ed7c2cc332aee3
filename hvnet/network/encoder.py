"""Hybrid voxel feature extraction (Sec. 3.1 and 3.2): points to pseudo-images, at voxel scales S_T and S_R."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from hvnet.config import EncoderConfig
from hvnet.kernels.encode import attend, column_sums, knowledge, write_image
from hvnet.kernels.scatter import Segments, segment_add, segment_max, segment_mean
from hvnet.kernels.voxel import Grid, Voxels, make_grid, voxel_index
from hvnet.network.grids import projection_grids
from hvnet.network.pillars import hard_voxels
from hvnet.ranks import all_reduce, size

POINT_CHANNELS = 4  # d: x, y, z, reflectance


def moments(rows: Tensor) -> Tensor:
    """Sums of products of the columns of rows (R, k), the last of them 1, in float64: (k, k)."""
    wide = rows.double()
    return wide.T @ wide


def has_variance(training: bool, rows: Tensor) -> bool:
    """Whether the rows (N, C) of all ranks give the statistics of a batch norm: one or none has no variance."""
    if not training or size() == 1:
        return training and rows.shape[0] > 1
    return all_reduce(torch.full((), rows.shape[0], device=rows.device)).item() > 1


def folded(linear: nn.Linear, norm: nn.BatchNorm1d, row_moments: Tensor | None) -> Tensor:
    """Linear and batch norm as one affine map (in + 1, out), the bias last.

    In training the statistics of Linear(rows) follow from the moments (in + 1, in + 1) of the rows, as W mean and
    W cov W': the output is not needed for them. Without moments (in evaluation, and where there are too few rows for a
    variance) the running statistics serve.
    """
    weight = linear.weight
    if row_moments is None:
        mean, variance = norm.get_buffer("running_mean"), norm.get_buffer("running_var")
    else:
        count = row_moments[-1, -1]
        centre = row_moments[-1, :-1] / count
        covariance = (row_moments[:-1, :-1] / count - torch.outer(centre, centre)).to(weight.dtype)
        mean = weight @ centre.to(weight.dtype)
        variance = ((weight @ covariance) * weight).sum(dim=1).clamp(min=0)
        update_statistics(norm, mean.detach(), variance.detach() * (count / (count - 1)).to(weight.dtype))
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    return torch.vstack(((weight * scale.unsqueeze(1)).T, norm.bias - mean * scale))


def update_statistics(norm: nn.BatchNorm1d, mean: Tensor, variance: Tensor) -> None:
    """Moves the running statistics of a batch norm as torch does: by its momentum, towards the unbiased variance."""
    momentum = norm.momentum or 0.1
    norm.get_buffer("running_mean").lerp_(mean, momentum)
    norm.get_buffer("running_var").lerp_(variance, momentum)
    norm.get_buffer("num_batches_tracked").add_(1)


class ScaleOfPoints(NamedTuple):
    """The voxels of one scale, and what all layers need of their points."""

    cursor: Tensor  # (V,) int64
    segments: Segments
    mean: Tensor  # (V, d)
    moments: Tensor  # (2d + 1, 2d + 1) float64, of g


class AttentiveVFE(nn.Module):
    """The layer inside AVFE and AVFEO (Fig. 3): M = BN(Linear(features)) * BN(Linear(g)), then the maximum a voxel.

    One set of weights serves all scales. The batch norm of g takes its statistics over all scales together: running
    statistics that mix scales would differ from those of any one scale in training.
    """

    def __init__(self, in_channels: int, out_channels: int, relu: bool) -> None:
        super().__init__()
        self.features = nn.Linear(in_channels, out_channels, bias=False)
        self.features_norm = nn.BatchNorm1d(out_channels)
        self.knowledge = nn.Linear(2 * POINT_CHANNELS, out_channels, bias=False)
        self.knowledge_norm = nn.BatchNorm1d(out_channels)
        self.relu = relu

    def forward(
        self, features: Tensor, norm: Tensor, points: Tensor, voxels: list[ScaleOfPoints], keep: bool
    ) -> list[tuple[Tensor, Tensor]]:
        """Linear(features) (N, q), scale and shift of its batch norm (2, q), points (N, d): M and G' of every scale.

        M is (N, q), or (0, q) unless it is to be kept, G' (V, q).
        """
        row_moments = None
        if has_variance(self.training, points):
            row_moments = all_reduce(torch.stack([scale.moments for scale in voxels]).sum(dim=0))
        layer = torch.vstack((folded(self.knowledge, self.knowledge_norm, row_moments), norm))
        return [attend(features, points, scale.mean, layer, scale.segments, self.relu, keep) for scale in voxels]


class VFE(nn.Module):
    """VoxelNet's layer (Zhou and Tuzel, CVPR 2018) in the place of AttentiveVFE: M = ReLU(BN(Linear([features, g]))).

    The batch norm takes its statistics over all scales together, as that of the attentive layer.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.features = nn.Linear(in_channels, out_channels, bias=False)  # the two halves of one Linear
        self.knowledge = nn.Linear(2 * POINT_CHANNELS, out_channels, bias=False)
        self.norm = nn.BatchNorm1d(out_channels)

    def forward(self, features: Tensor, points: Tensor, voxels: list[ScaleOfPoints]) -> list[tuple[Tensor, Tensor]]:
        """Linear(features) (N, q) and points (N, d) to M (N, q) and its maxima (V, q) in the voxels of every scale."""
        given = [knowledge(points, at.mean, at.segments.voxel)[:, :-1] for at in voxels]
        rows = [features + self.knowledge(g) for g in given]
        scale, shift = batch_norm(self.norm, torch.cat(rows))
        products = [torch.relu(each * scale + shift) for each in rows]
        return [(each, segment_max(each, at.segments)[0]) for each, at in zip(products, voxels, strict=True)]


class HybridVoxelEncoder(nn.Module):
    """HVFE: points are encoded in the voxels of every feature scale and projected into every projection scale."""

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.limits = (config.point_limit, config.voxel_limit)
        self.limited_grid = make_grid(config.point_range, config.voxel_size, 1.0)
        self.projection_grids = projection_grids(config)
        shared = dict(zip(config.projection_scales, self.projection_grids, strict=True))
        self.feature_grids = [
            shared.get(scale) or make_grid(config.point_range, config.voxel_size, scale)
            for scale in config.feature_scales
        ]
        channels = config.feature_channels
        context = 2 * channels * len(config.feature_scales)
        self.avfe: AttentiveVFE | VFE
        self.avfeo: AttentiveVFE | VFE
        if config.vfe == "plain":
            self.avfe, self.avfeo = VFE(POINT_CHANNELS, channels), VFE(context, config.image_channels)
        else:
            self.avfe = AttentiveVFE(POINT_CHANNELS, channels, config.attention_relu)
            self.avfeo = AttentiveVFE(context, config.image_channels, config.attention_relu)

    def forward(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Tensor]:
        """Points (N, 4) of samples (N,) to the images I^{s_r} (B, N_H, N_L, N_W), channels-last, finest first."""
        grids = list(dict.fromkeys(self.feature_grids + self.projection_grids))
        if self.limits[0]:
            kept = hard_voxels(points, sample, batch_size, self.limited_grid, *self.limits).point
            points, sample = points[kept], sample[kept]
        index = voxel_index(points, sample, batch_size, grids)
        points = points[index.order]
        scales = {grid: scale_of_points(points, voxels) for grid, voxels in zip(grids, index.scales, strict=True)}
        projected = self.voxel_features(self.point_features(points, scales), points, scales)
        images = []
        for maxima, grid in zip(projected, self.projection_grids, strict=True):
            image = write_image(maxima, scales[grid].cursor, batch_size * grid.shape[0] * grid.shape[1])
            images.append(image.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2))
        return images

    def point_features(self, points: Tensor, scales: dict[Grid, ScaleOfPoints]) -> list[tuple[Tensor, Tensor]]:
        """AVFE: points (N, d) to M (N, q) and G' (V, q) of every feature scale."""
        at = [scales[grid] for grid in self.feature_grids]
        if isinstance(self.avfe, VFE):
            return self.avfe(self.avfe.features(points), points, at)
        ones = torch.ones_like(points[:, :1])
        training = has_variance(self.training, points)
        row_moments = all_reduce(moments(torch.cat((points, ones), dim=1))) if training else None
        weight = folded(self.avfe.features, self.avfe.features_norm, row_moments)
        features = torch.addmm(weight[-1], points, weight[:-1])
        as_it_is = torch.vstack((torch.ones_like(weight[-1]), torch.zeros_like(weight[-1])))
        return self.avfe(features, as_it_is, points, at, keep=True)

    def voxel_features(
        self, encoded: list[tuple[Tensor, Tensor]], points: Tensor, scales: dict[Grid, ScaleOfPoints]
    ) -> list[Tensor]:
        """AVFEO: M and G' of every feature scale to G' (V, N_H) of every projection scale."""
        context = self.linear_of_context(encoded, [scales[grid] for grid in self.feature_grids])
        at = [scales[grid] for grid in self.projection_grids]
        if isinstance(self.avfeo, VFE):
            projected = self.avfeo(context, points, at)
        else:
            norm = batch_norm(self.avfeo.features_norm, context)
            projected = self.avfeo(context, norm, points, at, keep=False)
        return [maxima for _, maxima in projected]

    def linear_of_context(self, encoded: list[tuple[Tensor, Tensor]], voxels: list[ScaleOfPoints]) -> Tensor:
        """Linear(H), H (N, e) = [M, G'] of every feature scale, without H: the half in G' is one row a voxel."""
        weights = self.avfeo.features.weight.chunk(2 * len(encoded), dim=1)
        total = torch.cat([product for product, _ in encoded], dim=1) @ torch.cat(weights[0::2], dim=1).T
        for (_, maxima), at, weight in zip(encoded, voxels, weights[1::2], strict=True):
            total = segment_add(total, maxima @ weight.T, at.segments)
        return total


def scale_of_points(points: Tensor, voxels: Voxels) -> ScaleOfPoints:
    """Means and moments of the points (N, d) in the voxels of a scale."""
    mean = segment_mean(points, voxels.segments)
    return ScaleOfPoints(voxels.cursor, voxels.segments, mean, moments(knowledge(points, mean, voxels.segments.voxel)))


def batch_norm(norm: nn.BatchNorm1d, rows: Tensor) -> Tensor:
    """Scale and shift (2, C) of the batch norm of all ranks' rows (N, C), from sums that no number of threads changes.

    A batch of fewer than two rows has no variance and takes the running one.
    """
    if not has_variance(norm.training, rows):
        mean, variance = norm.get_buffer("running_mean"), norm.get_buffer("running_var")
    else:
        total, squares = column_sums(rows)
        sums = all_reduce(torch.cat((total, squares, torch.full_like(total[:1], rows.shape[0]))))
        (total, squares), count = sums[:-1].chunk(2), sums[-1].detach()
        mean = total / count
        variance = (squares / count - mean.square()).clamp(min=0).to(rows.dtype)
        mean = mean.to(rows.dtype)
        update_statistics(norm, mean.detach(), variance.detach() * (count / (count - 1)).to(rows.dtype))
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    return torch.vstack((scale, norm.bias - mean * scale))
