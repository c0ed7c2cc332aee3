"""Hybrid voxel feature extraction (Sec. 3.1 and 3.2): points to pseudo-images, at voxel scales S_T and S_R."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from hvnet.config import EncoderConfig
from hvnet.kernels.encode import (
    Scale,
    add_of_voxels,
    attend,
    clear_voxels,
    column_sums,
    encode_voxels,
    knowledge,
    project_voxels,
    scales_of,
    voxel_means,
    write_image,
)
from hvnet.kernels.scatter import Segments, segment_add, segment_max, segment_mean
from hvnet.kernels.voxel import Grid, Voxels, is_nested, make_grid, nested_index, voxel_index
from hvnet.pillars import PillarEncoder, hard_voxels
from hvnet.ranks import joined, size

POINT_CHANNELS = 4  # d: x, y, z, reflectance


def pyramid_depth(config: EncoderConfig) -> int:
    """Blocks of the main stream: three, or one a projection scale; each but the first halves the map."""
    return max(3, len(config.projection_scales))


def projection_grids(config: EncoderConfig) -> list[Grid]:
    """The grids of S_R, finest first; the finest is padded so that every block of the backbone may halve it evenly."""
    finest = make_grid(config.point_range, config.voxel_size, config.projection_scales[0], 2 ** pyramid_depth(config))
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


def moments(rows: Tensor) -> Tensor:
    """Sums of products of the columns of rows (R, k), the last of them 1, in float64: (k, k)."""
    wide = rows.double()
    return wide.T @ wide


def has_variance(training: bool, rows: Tensor) -> bool:
    """Whether the rows (N, C) of all ranks give the statistics of a batch norm: one or none has no variance."""
    if not training or size() == 1:
        return training and rows.shape[0] > 1
    return joined(torch.full((), rows.shape[0], device=rows.device)).item() > 1


def folded(linear: nn.Linear, norm: nn.BatchNorm1d, of_rows: Tensor | None) -> Tensor:
    """Linear and batch norm as one affine map (in + 1, out), the bias last.

    In training the statistics of Linear(rows) follow from the moments (in + 1, in + 1) of the rows, as W mean and
    W cov W': the output is not needed for them. Without moments (in evaluation, and where there are too few rows for a
    variance) the running statistics serve.
    """
    weight = linear.weight
    if of_rows is None:
        mean, variance = norm.get_buffer("running_mean"), norm.get_buffer("running_var")
    else:
        count = of_rows[-1, -1]
        centre = of_rows[-1, :-1] / count
        covariance = (of_rows[:-1, :-1] / count - torch.outer(centre, centre)).to(weight.dtype)
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
        self, features: Tensor, norm: Tensor, points: Tensor, voxels: list[ScaleOfPoints], keep: bool
    ) -> list[tuple[Tensor, Tensor]]:
        """Linear(features) (N, q), scale and shift of its batch norm (2, q), points (N, d): M and G' of every scale.

        M is (N, q), or (0, q) unless it is to be kept, G' (V, q).
        """
        of_rows = None
        if has_variance(self.training, points):
            of_rows = joined(torch.stack([scale.moments for scale in voxels]).sum(dim=0))
        layer = torch.vstack((folded(self.knowledge, self.knowledge_norm, of_rows), norm))
        return [attend(features, points, scale.mean, layer, scale.segments, self.relu, keep) for scale in voxels]


class VFE(nn.Module):
    """VoxelNet's layer (Zhou and Tuzel, CVPR 2018) in the place of AttentiveVFE: M = ReLU(BN(Linear([features, g]))).

    The batch norm takes its statistics over all scales at once, as that of the attentive layer.
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
        of_rows = joined(moments(torch.cat((points, ones), dim=1))) if training else None
        weight = folded(self.avfe.features, self.avfe.features_norm, of_rows)
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
        sums = joined(torch.cat((total, squares, torch.full_like(total[:1], rows.shape[0]))))
        (total, squares), count = sums[:-1].chunk(2), sums[-1].detach()
        mean = total / count
        variance = (squares / count - mean.square()).clamp(min=0).to(rows.dtype)
        mean = mean.to(rows.dtype)
        update_statistics(norm, mean.detach(), variance.detach() * (count / (count - 1)).to(rows.dtype))
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    return torch.vstack((scale, norm.bias - mean * scale))


class FusedEncoder:
    """Inference with the weights of an encoder: the same images, with batch norms folded and nothing kept for training.

    Where the scales nest, nothing is read back from a GPU: arrays have the size of the points and counts stay on the
    device. The images are reused: they hold until the next call, which clears them. An encoder whose scales do not
    nest, that has no attention or drops points, runs as it is.
    """

    def __init__(self, encoder: HybridVoxelEncoder | PillarEncoder) -> None:
        self.encoder = encoder
        self.written: dict[tuple, tuple[Tensor, Scale]] = {}  # every image, and the voxels that were written last

    @torch.no_grad()
    def __call__(
        self, points: Tensor, sample: Tensor, batch_size: int, dtype: torch.dtype = torch.float32
    ) -> list[Tensor]:
        """As HybridVoxelEncoder in evaluation mode; the images are of the dtype, float32, float16 or bfloat16."""
        encoder = self.encoder
        if not self.is_fused(batch_size):
            training = encoder.training
            images = encoder.eval()(points, sample, batch_size)
            encoder.train(training)
            return [image.to(dtype) for image in images]
        assert isinstance(encoder, HybridVoxelEncoder)
        avfe, avfeo = encoder.avfe, encoder.avfeo
        assert isinstance(avfe, AttentiveVFE)
        assert isinstance(avfeo, AttentiveVFE)
        grids = list(dict.fromkeys(encoder.feature_grids + encoder.projection_grids))
        index = nested_index(points, sample, grids)
        parts, kept, rows = scales_of(index)
        points = points[index.order[:rows]]
        scales = dict(zip(grids, parts, strict=True))
        means = {grid: voxel_means(points, scale) for grid, scale in scales.items()}

        weight = folded(avfe.features, avfe.features_norm, None)
        features = torch.addmm(weight[-1], points, weight[:-1])
        weight = folded(avfe.knowledge, avfe.knowledge_norm, None)
        count = features.shape[1]
        at = [scales[grid] for grid in encoder.feature_grids]
        product = features.new_empty(points.shape[0], len(at) * count)  # M of every feature scale
        maxima = [
            encode_voxels(features, points, means[grid], weight, scales[grid], avfe.relu, product, t)
            for t, grid in enumerate(encoder.feature_grids)
        ]
        weight = folded(avfeo.features, avfeo.features_norm, None)
        halves = weight[:-1].chunk(2 * len(at))
        context = torch.addmm(weight[-1], product, torch.cat(halves[0::2]))
        of_voxels = context.new_empty(len(at), max(scale.rows for scale in at), context.shape[1])
        for t, (values, half) in enumerate(zip(maxima, halves[1::2], strict=True)):
            torch.mm(values, half, out=of_voxels[t, : len(values)])
        add_of_voxels(context, of_voxels, index.voxel[: len(at)], kept)
        weight = folded(avfeo.knowledge, avfeo.knowledge_norm, None)
        images = []
        for grid in encoder.projection_grids:
            image = self.image(grid, scales[grid], batch_size, context.shape[1], dtype, points.device)
            project_voxels(context, points, means[grid], weight, scales[grid], avfeo.relu, image)
            images.append(image.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2))
        return images

    def is_fused(self, batch_size: int) -> bool:
        """Whether one sort serves all scales of an attentive encoder, so that nothing is read from the device."""
        encoder = self.encoder
        if isinstance(encoder, PillarEncoder) or isinstance(encoder.avfe, VFE) or encoder.limits[0]:
            return False
        return is_nested(encoder.feature_grids + encoder.projection_grids, batch_size)

    def image(
        self, grid: Grid, scale: Scale, batch_size: int, channels: int, dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        """The image (B N_L N_W, C) of a grid, all zero, to be written at the voxels of the scale."""
        key = (grid, batch_size, dtype, device)
        if key in self.written:
            image, last = self.written[key]
            if device.type == "cuda":
                image.zero_()  # a graph replays what was captured: it would not know the cells written last
            else:
                clear_voxels(image, last)
        else:
            image = torch.zeros(batch_size * grid.shape[0] * grid.shape[1], channels, dtype=dtype, device=device)
        self.written[key] = image, scale
        return image
