"""Backbone (Sec. 3.4): the main stream with multi-scale aggregation and the feature fusion pyramid network (FFPN).

The pyramids that the paper compares it with have the same interface: B_1, B_2, B_3 to the levels that the heads see.
"""

from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hvnet.config import BackboneConfig
from hvnet.ranks import BatchNorm2d


class Convolution(nn.Conv2d):
    """A convolution; that of single cells is a product of matrices in training.

    With one thread torch has a slow way for it that takes 4 times as long.
    """

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, C, H, W) to (B, C', H', W')."""
        if self.kernel_size != (1, 1) or not self.training or features.device.type != "cpu":
            return super().forward(features)
        return F.linear(features.permute(0, 2, 3, 1), self.weight.flatten(1)).permute(0, 3, 1, 2)


def conv_bn_relu(in_channels: int, out_channels: int, kernel: int, stride: int = 1) -> nn.Sequential:
    """Convolution that keeps the size (divided by the stride), batch norm, ReLU."""
    return nn.Sequential(
        Convolution(in_channels, out_channels, kernel, stride, padding=kernel // 2, bias=False),
        BatchNorm2d(out_channels),
        nn.ReLU(inplace=True),
    )


def deconv_bn_relu(in_channels: int, out_channels: int, stride: int) -> nn.Sequential:
    """Transposed convolution that enlarges a map `stride` times, batch norm, ReLU."""
    return nn.Sequential(
        nn.ConvTranspose2d(in_channels, out_channels, stride, stride, bias=False),
        BatchNorm2d(out_channels),
        nn.ReLU(inplace=True),
    )


class ConvReLU(nn.Module):
    """A convolution with a bias and its ReLU, in inference: on CUDA one kernel, where cuDNN has one that fits."""

    def __init__(self, convolution: nn.Conv2d) -> None:
        super().__init__()
        self.convolution = convolution
        self.one_kernel: dict[torch.Size, bool] = {}  # by the size of the input, whose first call on CUDA tries it

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, C, H, W) to (B, C', H', W')."""
        on_cuda = features.device.type == "cuda" and not torch.compiler.is_compiling()
        if on_cuda and torch.backends.cudnn.is_available():
            if features.shape not in self.one_kernel:
                self.one_kernel[features.shape] = self.has_one_kernel(features)
            if self.one_kernel[features.shape]:
                return self.by_cudnn(features)
        return F.relu_(self.convolution(features))

    def by_cudnn(self, features: Tensor) -> Tensor:
        """As forward, by cuDNN's fused kernel."""
        layer = self.convolution
        padding = cast(tuple[int, ...], layer.padding)  # numbers, not "same"
        return torch.cudnn_convolution_relu(
            features, layer.weight, layer.bias, layer.stride, padding, layer.dilation, layer.groups
        )

    def has_one_kernel(self, features: Tensor) -> bool:
        """Whether cuDNN's fused kernel exists for this layer and gives what the two give. Reads the device."""
        features = torch.randn_like(features)  # the frame that is captured first is empty
        wanted = F.relu_(self.convolution(features))
        # memory that the next output takes: cuDNN is given it as an addend too, with a weight of 0
        torch.full_like(wanted, torch.nan)
        try:
            found = self.by_cudnn(features)
        except RuntimeError:  # no engine for these shapes, or this type
            return False
        # 16 bits round twice what cuDNN rounds once
        tolerance = 2e-3 if wanted.dtype == torch.float32 else 0.05
        return bool(((found - wanted).abs() <= tolerance * wanted.abs().amax()).all())


class Block(nn.Module):
    """A block of the main stream; a pseudo-image of its resolution joins after the first layer by concatenation."""

    def __init__(self, in_channels: int, image_channels: int, width: int, layers: int, stride: int) -> None:
        super().__init__()
        self.first = conv_bn_relu(in_channels, width, 3, stride)
        joined = [width + image_channels] + [width] * (layers - 2)
        self.rest = nn.Sequential(*(conv_bn_relu(channels, width, 3) for channels in joined))

    def forward(self, features: Tensor, image: Tensor | None) -> Tensor:
        """Features (B, C, H, W), image (B, N_H, H / stride, W / stride) or None: (B, width, H / stride, W / stride)."""
        features = self.first(features)
        if image is not None:
            features = torch.cat((features, image), dim=1)
        return self.rest(features)


def extended(values: tuple[int, ...], blocks: int) -> tuple[int, ...]:
    """The values of the blocks; those of blocks that have none are the last."""
    return values + values[-1:] * (blocks - len(values))


class MainStream(nn.Module):
    """Blocks 1, 2, ...: each but the first halves the map and takes in the next pseudo-image (Sec. 3.4).

    The first halves it only with a stride of 2, as that of PointPillars.
    """

    def __init__(self, config: BackboneConfig, image_channels: int, images: int) -> None:
        super().__init__()
        self.widths = extended(config.widths, images)
        blocks = []
        before = image_channels
        for k, (width, layers) in enumerate(zip(self.widths, extended(config.layers, images), strict=True)):
            joins = image_channels if 0 < k < images else 0
            blocks.append(Block(before, joins, width, layers, config.stride if k == 0 else 2))
            before = width
        self.blocks = nn.ModuleList(blocks)

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """Pseudo-images, finest first, to the outputs B_1, B_2, B_3 of the last three blocks."""
        features, outputs = images[0], []
        for k, block in enumerate(self.blocks):
            features = block(features, images[k] if 0 < k < len(images) else None)
            outputs.append(features)
        return outputs[-3:]


class FFPN(nn.Module):
    """Eq. 4: B_f concatenates Psi_i([B_i, Gamma_{i+1}(B_{i+1})]) at the finest scale; Upsilon gives a map a level.

    Gamma is a deconvolution to the next finer map, Psi a convolution and a deconvolution to the finest one, Upsilon a
    chain of convolutions of strides 1, 2, 2.
    """

    def __init__(self, widths: tuple[int, ...], channels: int) -> None:
        super().__init__()
        fine, middle, coarse = widths
        self.gamma = nn.ModuleList([deconv_bn_relu(middle, fine, 2), deconv_bn_relu(coarse, middle, 2)])
        self.psi = nn.ModuleList(
            [
                conv_bn_relu(2 * fine, channels, 1),
                nn.Sequential(conv_bn_relu(2 * middle, channels, 1), deconv_bn_relu(channels, channels, 2)),
                nn.Sequential(conv_bn_relu(coarse, channels, 1), deconv_bn_relu(channels, channels, 4)),
            ]
        )
        self.upsilon = nn.ModuleList(
            [
                conv_bn_relu(3 * channels, channels, 1),
                conv_bn_relu(channels, channels, 3, 2),
                conv_bn_relu(channels, channels, 3, 2),
            ]
        )

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        """B_1, B_2, B_3 to the pyramid levels B_o at 1/1, 1/2 and 1/4 of B_1, `channels` each."""
        fine, middle, coarse = maps
        scales = [
            torch.cat((fine, self.gamma[0](middle)), dim=1),
            torch.cat((middle, self.gamma[1](coarse)), dim=1),
            coarse,
        ]
        fused = torch.cat([psi(scale) for psi, scale in zip(self.psi, scales, strict=True)], dim=1)  # B_f
        levels = []
        for upsilon in self.upsilon:
            fused = upsilon(fused)
            levels.append(fused)
        return levels


class FPN(nn.Module):
    """Lin et al., CVPR 2017: 1 x 1 convolutions of the maps, the coarser sum enlarged and added, 3 x 3 convolutions."""

    def __init__(self, widths: tuple[int, ...], channels: int) -> None:
        super().__init__()
        self.lateral = nn.ModuleList(nn.Conv2d(width, channels, 1) for width in widths)
        self.smooth = nn.ModuleList(conv_bn_relu(channels, channels, 3) for _ in widths)

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        """B_1, B_2, B_3 to levels of the same resolutions, `channels` each."""
        sums = [lateral(each) for lateral, each in zip(self.lateral, maps, strict=True)]
        for k in (1, 0):
            sums[k] = sums[k] + F.interpolate(sums[k + 1], scale_factor=2.0, mode="nearest")
        return [smooth(each) for smooth, each in zip(self.smooth, sums, strict=True)]


class NoPyramid(nn.Module):
    """The SSD-like backbone of the paper's baseline: each level is a map of the main stream, brought to `channels`."""

    def __init__(self, widths: tuple[int, ...], channels: int) -> None:
        super().__init__()
        self.reduce = nn.ModuleList(conv_bn_relu(width, channels, 1) for width in widths)

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        """B_1, B_2, B_3 to levels of the same resolutions, `channels` each."""
        return [reduce(each) for reduce, each in zip(self.reduce, maps, strict=True)]


class Upsampled(nn.Module):
    """PointPillars (Lang et al., CVPR 2019): every map is enlarged to the finest by a deconvolution and joined."""

    def __init__(self, widths: tuple[int, ...], channels: int) -> None:
        super().__init__()
        self.up = nn.ModuleList(deconv_bn_relu(width, channels, 2**k) for k, width in enumerate(widths))

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        """B_1, B_2, B_3 to one level of B_1's resolution, 3 x `channels`."""
        return [torch.cat([up(each) for up, each in zip(self.up, maps, strict=True)], dim=1)]


PYRAMIDS = {"ffpn": FFPN, "fpn": FPN, "none": NoPyramid, "upsampled": Upsampled}


class Backbone(nn.Module):
    """Main stream and pyramid: pseudo-images to the pyramid's levels."""

    def __init__(self, config: BackboneConfig, image_channels: int, images: int) -> None:
        super().__init__()
        self.main_stream = MainStream(config, image_channels, images)
        self.pyramid = PYRAMIDS[config.pyramid](self.main_stream.widths[-3:], config.fusion_channels)
        self.channels = config.fusion_channels * (3 if config.pyramid == "upsampled" else 1)  # of every level

    def forward(self, images: list[Tensor]) -> list[Tensor]:
        """Pseudo-images (B, N_H, N_L, N_W) / 2^r to levels (B, channels, N_L, N_W) / 2^k, three but for "upsampled"."""
        return self.pyramid(self.main_stream(images))
