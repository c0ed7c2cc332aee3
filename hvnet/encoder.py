"""Hybrid voxel feature extraction (Sec. 3.1 and 3.2): points to pseudo-images, at voxel scales S_T and S_R."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hvnet.config import EncoderConfig
from hvnet.kernels.encode import (
    Scale,
    add_of_voxels,
    attend,
    clear_voxels,
    encode_voxels,
    project_voxels,
    scales_of,
    voxel_means,
)
from hvnet.kernels.scatter import segment_gather, segment_mean
from hvnet.kernels.voxel import Grid, Voxels, is_nested, make_grid, nested_index, voxel_index

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


def attention_knowledge(points: Tensor, mean: Tensor, voxels: Voxels) -> Tensor:
    """Eq. 2: g = (x - mean x, f, mean p) of every point (N, d), from the means (V, d) of the voxels: (N, 2d)."""
    of_point = mean[voxels.segments.voxel]
    return torch.cat((points[:, :3] - of_point[:, :3], points[:, 3:], of_point), dim=1)


def folded(linear: nn.Linear, norm: nn.BatchNorm1d, rows: Tensor | None) -> tuple[Tensor, Tensor]:
    """Linear and batch norm as one affine map: the weight (in, out) and the bias (out,) that come to the same.

    In training the statistics of Linear(rows) follow from those of the rows (R, in) themselves, W mean and W cov W':
    the output is not needed for them. Rows are None where there are too few for a variance, and in evaluation: then
    the running statistics serve.
    """
    weight = linear.weight
    if rows is None:
        mean, variance = norm.get_buffer("running_mean"), norm.get_buffer("running_var")
    else:
        wide = rows.double()
        centre = wide.mean(dim=0)
        offset = wide - centre
        covariance = (offset.T @ offset / len(rows)).to(weight.dtype)
        mean = weight @ centre.to(weight.dtype)
        variance = ((weight @ covariance) * weight).sum(dim=1)
        update_statistics(norm, mean.detach(), variance.detach() * (len(rows) / (len(rows) - 1)))
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    return (weight * scale.unsqueeze(1)).T, norm.bias - mean * scale


def update_statistics(norm: nn.BatchNorm1d, mean: Tensor, variance: Tensor) -> None:
    """Moves the running statistics of a batch norm as torch does: by its momentum, towards the unbiased variance."""
    momentum = norm.momentum or 0.1
    norm.get_buffer("running_mean").lerp_(mean, momentum)
    norm.get_buffer("running_var").lerp_(variance, momentum)
    norm.get_buffer("num_batches_tracked").add_(1)


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

    def forward(
        self, features: Tensor, points: Tensor, means: list[Tensor], voxels: list[Voxels]
    ) -> list[tuple[Tensor, Tensor]]:
        """BN(Linear(features)) (N, q), points (N, d), means (V, d) a scale: M (N, q), its maxima G' (V, q) a scale."""
        rows = None
        if self.training and len(points) > 1:
            knowledge = zip(means, voxels, strict=True)
            rows = torch.cat([attention_knowledge(points, mean, at) for mean, at in knowledge])
        weight = torch.vstack(folded(self.knowledge, self.knowledge_norm, rows))
        return [
            attend(features, points, mean, weight, at.segments, self.relu)
            for mean, at in zip(means, voxels, strict=True)
        ]


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
        means = {grid: segment_mean(points, voxels[grid].segments) for grid in grids}

        at = [voxels[grid] for grid in self.feature_grids]
        norm = self.avfe.features_norm
        weight, bias = folded(self.avfe.features, norm, points if self.training and len(points) > 1 else None)
        encoded = self.avfe(points @ weight + bias, points, [means[grid] for grid in self.feature_grids], at)
        context = batch_norm(self.avfeo.features_norm, self.linear_of_context(encoded, at))
        at = [voxels[grid] for grid in self.projection_grids]
        projected = self.avfeo(context, points, [means[grid] for grid in self.projection_grids], at)
        return [
            project(maxima, scale.cursor, grid, batch_size)
            for (_, maxima), scale, grid in zip(projected, at, self.projection_grids, strict=True)
        ]

    def linear_of_context(self, encoded: list[tuple[Tensor, Tensor]], voxels: list[Voxels]) -> Tensor:
        """Linear(H), H (N, e) = [M, G'] of every feature scale, without H: the half in G' is one row a voxel."""
        weights = self.avfeo.features.weight.chunk(2 * len(encoded), dim=1)
        total = torch.cat([product for product, _ in encoded], dim=1) @ torch.cat(weights[0::2], dim=1).T
        for (_, maxima), at, weight in zip(encoded, voxels, weights[1::2], strict=True):
            total = total + segment_gather(maxima @ weight.T, at.segments)
        return total


def batch_norm(norm: nn.BatchNorm1d, rows: Tensor) -> Tensor:
    """Batch norm of rows (N, C); a batch of fewer than two rows has no variance and takes the running one."""
    if norm.training and len(rows) < 2:
        return F.batch_norm(rows, norm.running_mean, norm.running_var, norm.weight, norm.bias, False, 0.0, norm.eps)
    return norm(rows)


def project(features: Tensor, cursor: Tensor, grid: Grid, batch_size: int) -> Tensor:
    """Eq. 3: writes voxel features (V, C) at x = cursor div N_W, y = cursor mod N_W of a zero (B, C, N_L, N_W)."""
    image = features.new_zeros(batch_size * grid.shape[0] * grid.shape[1], features.shape[1])
    image = image.index_copy(0, cursor, features)
    return image.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2)


class FusedEncoder:
    """Inference with the weights of an encoder: the same images, with batch norms folded and nothing kept for training.

    Where the scales nest, nothing is read back from a GPU: arrays have the size of the points and counts stay on the
    device. The images are reused: they hold until the next call, which clears the cells that this one wrote.
    """

    def __init__(self, encoder: HybridVoxelEncoder) -> None:
        self.encoder = encoder
        self.written: dict[tuple, tuple[Tensor, Scale]] = {}  # every image, and the voxels that were written last

    @torch.no_grad()
    def __call__(
        self, points: Tensor, sample: Tensor, batch_size: int, dtype: torch.dtype = torch.float32
    ) -> list[Tensor]:
        """As HybridVoxelEncoder in evaluation mode; the images are of the dtype, float32, float16 or bfloat16."""
        encoder, avfe, avfeo = self.encoder, self.encoder.avfe, self.encoder.avfeo
        grids = list(dict.fromkeys(encoder.feature_grids + encoder.projection_grids))
        if not is_nested(grids, batch_size):
            return [image.to(dtype) for image in encoder.eval()(points, sample, batch_size)]
        index = nested_index(points, sample, grids)
        parts, kept, rows = scales_of(index)
        points = points[index.order[:rows]]
        scales = dict(zip(grids, parts, strict=True))
        means = {grid: voxel_means(points, scale) for grid, scale in scales.items()}

        weight, bias = folded(avfe.features, avfe.features_norm, None)
        features = torch.addmm(bias, points, weight)
        knowledge = torch.vstack(folded(avfe.knowledge, avfe.knowledge_norm, None))
        count = features.shape[1]
        at = [scales[grid] for grid in encoder.feature_grids]
        product = features.new_empty(len(points), len(at) * count)  # M of every feature scale
        maxima = [
            encode_voxels(features, points, means[grid], knowledge, scales[grid], avfe.relu, product, t)
            for t, grid in enumerate(encoder.feature_grids)
        ]
        weight, bias = folded(avfeo.features, avfeo.features_norm, None)
        halves = weight.chunk(2 * len(at))
        context = torch.addmm(bias, product, torch.cat(halves[0::2]))
        of_voxels = context.new_empty(len(at), max(scale.rows for scale in at), context.shape[1])
        for t, (values, half) in enumerate(zip(maxima, halves[1::2], strict=True)):
            torch.mm(values, half, out=of_voxels[t, : len(values)])
        add_of_voxels(context, of_voxels, index.voxel[: len(at)], kept)
        knowledge = torch.vstack(folded(avfeo.knowledge, avfeo.knowledge_norm, None))
        images = []
        for grid in encoder.projection_grids:
            image = self.image(grid, scales[grid], batch_size, context.shape[1], dtype, points.device)
            project_voxels(context, points, means[grid], knowledge, scales[grid], avfeo.relu, image)
            images.append(image.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2))
        return images

    def image(
        self, grid: Grid, scale: Scale, batch_size: int, channels: int, dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        """The image (B N_L N_W, C) of a grid, all zero, to be written at the voxels of the scale."""
        key = (grid, batch_size, dtype, device)
        if key in self.written:
            image, last = self.written[key]
            clear_voxels(image, last)
        else:
            image = torch.zeros(batch_size * grid.shape[0] * grid.shape[1], channels, dtype=dtype, device=device)
        self.written[key] = image, scale
        return image
