"""The encoder in inference: the same two steps as in training, with kernels that keep nothing for gradients."""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from hvnet.kernels.encode import (
    Scales,
    add_of_voxels,
    clear_voxels,
    encode_voxels,
    project_voxels,
    scales_of,
)
from hvnet.kernels.launch import many_threads
from hvnet.kernels.voxel import is_nested, nested_index
from hvnet.network.encoder import AttentiveVFE, HybridVoxelEncoder, folded
from hvnet.network.pillars import PillarEncoder


class IndexedPoints(NamedTuple):
    """Points in the order of their voxels, and these voxels at every scale."""

    points: Tensor  # (N, 4)
    scales: Scales


class Images(NamedTuple):
    """The pseudo-images of every projection scale, one after the other."""

    cells: Tensor  # (cells, C)
    first: Tensor  # (R,) int64, the first cell of every image


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
        device = self.knowledge.device
        self.encoded = torch.arange(len(self.feature_grids), dtype=torch.int32, device=device)
        projected = [self.grids.index(grid) for grid in self.projection_grids]
        self.projected = torch.tensor(projected, dtype=torch.int32, device=device)
        self.written: dict[tuple, tuple[Images, Scales | None]] = {}  # images, and the voxels that were written last

    @torch.no_grad()
    def __call__(
        self, points: Tensor, sample: Tensor, batch_size: int, dtype: torch.dtype = torch.float32
    ) -> list[Tensor]:
        """As HybridVoxelEncoder in evaluation mode; the images are of the dtype, float32, float16 or bfloat16."""
        indexed = self.index(points, sample, batch_size)
        return self.voxel_features(*self.point_features(indexed), indexed, batch_size, dtype)

    def index(self, points: Tensor, sample: Tensor, batch_size: int) -> IndexedPoints:
        """The voxels of points (N, 4) of samples (N,)."""
        index = nested_index(points, sample, self.grids)
        scales, points = scales_of(index, points, self.finest, [batch_size * math.prod(g.shape) for g in self.grids])
        return IndexedPoints(points, scales)

    def point_features(self, indexed: IndexedPoints) -> tuple[Tensor, Tensor]:
        """AVFE: M (N, T q) of the T feature scales side by side, and G' (T, V, q)."""
        # not in TF32, which would move a point at 60 m by 3 cm
        features = torch.addmm(self.features_bias, indexed.points, self.of_points)
        return encode_voxels(features, indexed.points, self.knowledge, indexed.scales, self.encoded, self.relu[0])

    def voxel_features(
        self, product: Tensor, maxima: Tensor, indexed: IndexedPoints, batch_size: int, dtype: torch.dtype
    ) -> list[Tensor]:
        """AVFEO and Eq. 3: M and G' of the feature scales to the images (B, N_H, N_L, N_W), finest first."""
        points, scales = indexed
        with products_in_tf32(points.device):
            context = torch.addmm(self.context_bias, product, self.of_product)
            of_voxels = context.new_empty(*maxima.shape[:2], context.shape[1])
            for t, weight in enumerate(self.of_maxima):
                torch.mm(maxima[t, : scales.rows[t]], weight, out=of_voxels[t, : scales.rows[t]])
        add_of_voxels(context, of_voxels, scales)
        images = self.images(scales, batch_size, context.shape[1], dtype, points.device)
        project_voxels(
            context, points, self.image_knowledge, scales, self.projected, images.first, self.relu[1], images.cells
        )
        parts = images.cells.split(self.cells(batch_size))
        return [
            part.view(batch_size, *grid.shape, -1).permute(0, 3, 1, 2)
            for part, grid in zip(parts, self.projection_grids, strict=True)
        ]

    def cells(self, batch_size: int) -> list[int]:
        """The cells of the image of every projection scale."""
        return [batch_size * math.prod(grid.shape) for grid in self.projection_grids]

    def images(
        self, scales: Scales, batch_size: int, channels: int, dtype: torch.dtype, device: torch.device
    ) -> Images:
        """The images, all zero, to be written at the voxels of the scales."""
        key = (batch_size, dtype, device)
        if key in self.written:
            images, last = self.written[key]
            if last is None:
                images.cells.zero_()  # a graph replays what was captured: it would not know the cells written last
            else:
                clear_voxels(images.cells, last, self.projected, images.first)
        else:
            cells = self.cells(batch_size)
            first = torch.tensor([sum(cells[:k]) for k in range(len(cells))], device=device)
            images = Images(torch.zeros(sum(cells), channels, dtype=dtype, device=device), first)
        self.written[key] = images, None if many_threads(device) else scales  # which would keep a graph's memory
        return images


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
