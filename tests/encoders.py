"""Small encoders, and clouds for them, that several tests share."""

import torch
from torch import Tensor

from hvnet.config import EncoderConfig
from hvnet.network.encoder import HybridVoxelEncoder

# not square, so that a transpose of x and y would be seen
SMALL = EncoderConfig(
    point_range=(0.0, -3.2, -3.0, 12.8, 3.2, 2.0), voxel_size=(0.4, 0.4), feature_channels=8, image_channels=12
)
SCALES = [
    ((0.5, 1.0, 2.0), (1.0, 2.0, 4.0)),
    ((1.0,), (1.0,)),
    ((0.5, 1.0), (2.0,)),
    ((0.25, 0.5, 1.0, 2.0, 4.0), (0.5, 1.0, 2.0, 4.0, 8.0)),
    ((1.0, 1.5), (1.5, 3.0)),  # do not nest, and 0.6 m divides neither 12.8 nor 6.4 m
]


def cloud(count: int, seed: int = 0, samples: int = 2) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.tensor([-1.0, -4.0, -3.5, 0.0]), torch.tensor([14.0, 4.0, 2.5, 1.0])
    points = low + torch.rand(count, 4, generator=generator) * (high - low)
    return points, torch.randint(samples, (count,), generator=generator).sort().values


def restless(encoder: HybridVoxelEncoder) -> HybridVoxelEncoder:
    """With running statistics and weights that are not those of the start."""
    for module in encoder.modules():
        if isinstance(module, torch.nn.BatchNorm1d):
            module.running_mean.normal_()
            module.running_var.uniform_(0.5, 2)
            torch.nn.init.normal_(module.weight)
            torch.nn.init.normal_(module.bias)
    return encoder


def trained(config: EncoderConfig) -> HybridVoxelEncoder:
    """An encoder whose statistics and weights are not those of the start, in evaluation mode."""
    torch.manual_seed(5)
    return restless(HybridVoxelEncoder(config)).eval()
