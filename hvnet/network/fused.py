"""The encoder in inference: the same two steps as in training, with kernels that keep nothing for gradients."""

import contextlib
from collections.abc import Callable, Iterator
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


@contextlib.contextmanager
def products_in_tf32(device: torch.device) -> Iterator[None]:
    """Inside, a GPU multiplies float32 matrices by its tensor cores, which round what they multiply to 11 bits.

    docs/gpu.md has what that costs in AP.
    """
    precision = torch.backends.cuda.matmul.fp32_precision
    if device.type == "cuda":
        torch.backends.cuda.matmul.fp32_precision = "tf32"
    try:
        yield
    finally:
        if device.type == "cuda":
            torch.backends.cuda.matmul.fp32_precision = precision


class FusedEncoder:
    """Inference with the weights of an encoder: the same images, with batch norms folded and nothing kept for training.

    Nothing is read back from a GPU: arrays have the size of the points and counts stay on the device. The images are
    reused: they hold until the next call, which clears them. The weights are those that the encoder has when this is
    made.
    """

    @torch.no_grad()
    def __init__(self, encoder: HybridVoxelEncoder) -> None:
        """The encoder is one for which `is_fused` holds."""
        avfe, avfeo = encoder.avfe, encoder.avfeo
        assert isinstance(avfe, AttentiveVFE)
        assert isinstance(avfeo, AttentiveVFE)
        self.feature_grids, self.projection_grids = encoder.feature_grids, encoder.projection_grids
        self.grids = list(dict.fromkeys(self.feature_grids + self.projection_grids))
        self.finest = min(range(len(self.grids)), key=lambda k: self.grids[k].cell)
        self.relu = avfe.relu, avfeo.relu
        features = folded(avfe.features, avfe.features_norm, None)
        self.of_points, self.features_bias = features[:-1], features[-1]
        self.knowledge = folded(avfe.knowledge, avfe.knowledge_norm, None)
        # of H = [M, G'] of every feature scale: the halves in M as one matrix, those in G' scale by scale
        context = folded(avfeo.features, avfeo.features_norm, None)
        halves = context[:-1].chunk(2 * len(self.feature_grids))
        self.of_product, self.of_maxima, self.context_bias = torch.cat(halves[0::2]), halves[1::2], context[-1]
        self.image_knowledge = folded(avfeo.knowledge, avfeo.knowledge_norm, None)
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
        index = nested_index(points, sample, self.grids)
        scales, points = scales_of(index, points, self.finest)
        return IndexedPoints(points, index.voxel, dict(zip(self.grids, scales, strict=True)))

    def point_features(self, indexed: IndexedPoints) -> tuple[Tensor, list[Tensor]]:
        """AVFE: M (N, T q) of the T feature scales side by side, and G' (V, q) of each."""
        # not in TF32, which would move a point at 60 m by 3 cm
        features = torch.addmm(self.features_bias, indexed.points, self.of_points)
        product = features.new_empty(len(features), len(self.feature_grids) * features.shape[1])
        maxima = [
            encode_voxels(features, indexed.points, self.knowledge, indexed.scales[grid], self.relu[0], product, t)
            for t, grid in enumerate(self.feature_grids)
        ]
        return product, maxima

    def voxel_features(
        self, product: Tensor, maxima: list[Tensor], indexed: IndexedPoints, batch_size: int, dtype: torch.dtype
    ) -> list[Tensor]:
        """AVFEO and Eq. 3: M and G' of the feature scales to the images (B, N_H, N_L, N_W), finest first."""
        points = indexed.points
        scales = [indexed.scales[grid] for grid in self.feature_grids]
        with products_in_tf32(points.device):
            context = torch.addmm(self.context_bias, product, self.of_product)
            of_voxels = context.new_empty(len(scales), max(len(scale.mean) for scale in scales), context.shape[1])
            for t, (values, weight) in enumerate(zip(maxima, self.of_maxima, strict=True)):
                torch.mm(values, weight, out=of_voxels[t, : len(values)])
        add_of_voxels(context, of_voxels, indexed.voxel[: len(scales)], scales[0].kept)
        images = []
        for grid in self.projection_grids:
            scale = indexed.scales[grid]
            image = self.image(grid, scale, batch_size, context.shape[1], dtype, points.device)
            project_voxels(context, points, self.image_knowledge, scale, self.relu[1], image)
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
