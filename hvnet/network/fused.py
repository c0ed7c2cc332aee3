"""The encoder in inference: the same two steps as in training, with kernels that keep nothing for gradients."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from hvnet.kernels.encode import (
    Scale,
    add_of_voxels,
    clear_voxels,
    encode_voxels,
    project_voxels,
    scales_of,
)
from hvnet.kernels.launch import many_threads
from hvnet.kernels.voxel import Grid, is_nested, nested_index
from hvnet.network.encoder import AttentiveVFE, HybridVoxelEncoder, folded
from hvnet.network.pillars import PillarEncoder


class IndexedPoints(NamedTuple):
    """Points in the order of their voxels, and these voxels at every scale."""

    points: Tensor  # (N, 4)
    voxel: Tensor  # (S, N) int64, the voxel of each point
    scales: dict[Grid, Scale]


def is_fused(encoder: HybridVoxelEncoder | PillarEncoder, batch_size: int) -> bool:
    """Whether `FusedEncoder` takes an encoder: an attentive one that keeps all points, whose scales one sort serves."""
    if isinstance(encoder, PillarEncoder) or not isinstance(encoder.avfe, AttentiveVFE) or encoder.limits[0]:
        return False
    return is_nested(encoder.feature_grids + encoder.projection_grids, batch_size)


class FusedEncoder:
    """Inference with the weights of an encoder: the same images, with batch norms folded and nothing kept for training.

    Nothing is read back from a GPU: arrays have the size of the points and counts stay on the device. The images are
    reused: they hold until the next call, which clears them.
    """

    def __init__(self, encoder: HybridVoxelEncoder) -> None:
        """The encoder is one for which `is_fused` holds."""
        assert isinstance(encoder.avfe, AttentiveVFE)
        assert isinstance(encoder.avfeo, AttentiveVFE)
        self.encoder, self.avfe, self.avfeo = encoder, encoder.avfe, encoder.avfeo
        self.written: dict[tuple, tuple[Tensor, Scale]] = {}  # every image, and the voxels that were written last

    @torch.no_grad()
    def __call__(
        self, points: Tensor, sample: Tensor, batch_size: int, dtype: torch.dtype = torch.float32
    ) -> list[Tensor]:
        """As HybridVoxelEncoder in evaluation mode; the images are of the dtype, float32, float16 or bfloat16."""
        indexed = self.index(points, sample)
        return self.voxel_features(*self.point_features(indexed), indexed, batch_size, dtype)

    def index(self, points: Tensor, sample: Tensor) -> IndexedPoints:
        """The voxels of points (N, 4) of samples (N,)."""
        grids = list(dict.fromkeys(self.encoder.feature_grids + self.encoder.projection_grids))
        index = nested_index(points, sample, grids)
        finest = min(range(len(grids)), key=lambda k: grids[k].cell)
        scales, points = scales_of(index, points, finest)
        return IndexedPoints(points, index.voxel, dict(zip(grids, scales, strict=True)))

    def point_features(self, indexed: IndexedPoints) -> tuple[Tensor, list[Tensor]]:
        """AVFE: M (N, T q) of the T feature scales side by side, and G' (V, q) of each."""
        avfe, points = self.avfe, indexed.points
        weight = folded(avfe.features, avfe.features_norm, None)
        features = torch.addmm(weight[-1], points, weight[:-1])
        weight = folded(avfe.knowledge, avfe.knowledge_norm, None)
        grids = self.encoder.feature_grids
        product = features.new_empty(points.shape[0], len(grids) * features.shape[1])
        maxima = [
            encode_voxels(features, points, weight, indexed.scales[grid], avfe.relu, product, t)
            for t, grid in enumerate(grids)
        ]
        return product, maxima

    def voxel_features(
        self, product: Tensor, maxima: list[Tensor], indexed: IndexedPoints, batch_size: int, dtype: torch.dtype
    ) -> list[Tensor]:
        """AVFEO and Eq. 3: M and G' of the feature scales to the images (B, N_H, N_L, N_W), finest first."""
        avfeo, points = self.avfeo, indexed.points
        scales = [indexed.scales[grid] for grid in self.encoder.feature_grids]
        weight = folded(avfeo.features, avfeo.features_norm, None)
        halves = weight[:-1].chunk(2 * len(scales))
        context = torch.addmm(weight[-1], product, torch.cat(halves[0::2]))
        of_voxels = context.new_empty(len(scales), max(len(scale.mean) for scale in scales), context.shape[1])
        for t, (values, half) in enumerate(zip(maxima, halves[1::2], strict=True)):
            torch.mm(values, half, out=of_voxels[t, : len(values)])
        add_of_voxels(context, of_voxels, indexed.voxel[: len(scales)], scales[0].kept)
        weight = folded(avfeo.knowledge, avfeo.knowledge_norm, None)
        images = []
        for grid in self.encoder.projection_grids:
            scale = indexed.scales[grid]
            image = self.image(grid, scale, batch_size, context.shape[1], dtype, points.device)
            project_voxels(context, points, weight, scale, avfeo.relu, image)
            images.append(image.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2))
        return images

    def image(
        self, grid: Grid, scale: Scale, batch_size: int, channels: int, dtype: torch.dtype, device: torch.device
    ) -> Tensor:
        """The image (B N_L N_W, C) of a grid, all zero, to be written at the voxels of the scale."""
        key = (grid, batch_size, dtype, device)
        if key in self.written:
            image, last = self.written[key]
            if many_threads(device):
                image.zero_()  # a graph replays what was captured: it would not know the cells written last
            else:
                clear_voxels(image, last)
        else:
            image = torch.zeros(batch_size * grid.shape[0] * grid.shape[1], channels, dtype=dtype, device=device)
        self.written[key] = image, scale
        return image


def inference(encoder: HybridVoxelEncoder | PillarEncoder) -> Callable[..., list[Tensor]]:
    """How an encoder in evaluation mode runs in inference: as `FusedEncoder` where it can be one, else as it is.

    The function returned has the arguments of FusedEncoder.__call__.
    """
    fused = FusedEncoder(encoder) if isinstance(encoder, HybridVoxelEncoder) and is_fused(encoder, 1) else None

    @torch.no_grad()
    def encode(points: Tensor, sample: Tensor, batch_size: int, dtype: torch.dtype = torch.float32) -> list[Tensor]:
        if fused is not None and is_fused(encoder, batch_size):
            return fused(points, sample, batch_size, dtype)
        return [image.to(dtype) for image in encoder(points, sample, batch_size)]

    return encode
