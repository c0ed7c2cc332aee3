"""The encoder in inference: the images of the plain one, in the same two steps, and which encoders run so."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from hvnet.config import EncoderConfig
from hvnet.data.kitti import read_frame
from hvnet.network.fused import FusedEncoder, inference, is_fused
from hvnet.network.model import make_encoder
from tests.encoders import SCALES, SMALL, cloud, trained

pytestmark = pytest.mark.usefixtures("threads")
PILLARS = {"vfe": "pillar", "feature_scales": (1.0,), "projection_scales": (1.0,), "point_limit": 4, "voxel_limit": 9}


@pytest.mark.parametrize(("feature_scales", "projection_scales"), SCALES)
@pytest.mark.parametrize("relu", [True, False])
def test_fused_encoder_gives_the_same_images(
    feature_scales: tuple[float, ...], projection_scales: tuple[float, ...], relu: bool
) -> None:
    config = dataclasses.replace(
        SMALL, feature_scales=feature_scales, projection_scales=projection_scales, attention_relu=relu
    )
    encoder = trained(config)
    fused = inference(encoder)
    # the second cloud must find no trace of the first, an empty one and one point leave nothing else
    for points, sample in (cloud(400), cloud(100, seed=1), cloud(0), cloud(1, seed=4), cloud(400)):
        with torch.no_grad():
            expected = encoder(points, sample, 2)
        for image, plain in zip(fused(points, sample, 2), expected, strict=True):
            assert image.is_contiguous(memory_format=torch.channels_last)
            torch.testing.assert_close(image, plain, rtol=1e-4, atol=1e-4)  # products of two sums in float32


def test_the_two_steps_of_the_fused_encoder_give_its_images() -> None:
    encoder = trained(SMALL)
    fused, parts = FusedEncoder(encoder), FusedEncoder(encoder)
    points, sample = cloud(300)
    indexed = parts.index(points, sample, 2)
    product, maxima = parts.point_features(indexed)
    with torch.no_grad():
        images = parts.voxel_features(product, maxima, indexed, 2, torch.float32)
    assert product.shape == (len(indexed.points), len(SMALL.feature_scales) * SMALL.feature_channels)
    assert maxima.shape == (len(SMALL.feature_scales), indexed.scales.means.shape[1], SMALL.feature_channels)
    for image, whole in zip(images, fused(points, sample, 2), strict=True):
        assert torch.equal(image, whole)


@pytest.mark.parametrize(
    ("changes", "fused"),
    [
        ({}, True),
        ({"vfe": "plain"}, False),
        ({"point_limit": 4}, False),
        ({"feature_scales": (1.0, 1.5)}, False),  # they do not nest
        (PILLARS, False),
    ],
)
def test_which_encoders_are_fused(changes: dict[str, Any], fused: bool) -> None:
    encoder = make_encoder(dataclasses.replace(SMALL, **changes))
    assert is_fused(encoder, 1) is fused
    assert not is_fused(encoder, 2**30)  # more cells than a key has bits


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_fused_encoder_in_half_precision(dtype: torch.dtype) -> None:
    encoder = trained(SMALL)
    points, sample = cloud(300)
    with torch.no_grad():
        expected = encoder(points, sample, 2)
    for image, plain in zip(FusedEncoder(encoder)(points, sample, 2, dtype), expected, strict=True):
        assert image.dtype == dtype
        tolerance = torch.finfo(dtype).eps  # one rounding of the last step
        torch.testing.assert_close(image.float(), plain, rtol=2 * tolerance, atol=tolerance)


def test_fused_encoder_has_the_weights_of_when_it_was_made() -> None:
    encoder = trained(SMALL)
    fused = FusedEncoder(encoder)
    points, sample = cloud(300)
    before = [image.clone() for image in fused(points, sample, 2)]
    with torch.no_grad():
        encoder.avfeo.features_norm.weight.mul_(2)
        encoder.avfeo.features_norm.bias.mul_(2)
    assert all(torch.equal(image, old) for image, old in zip(fused(points, sample, 2), before, strict=True))
    for image, old in zip(FusedEncoder(encoder)(points, sample, 2), before, strict=True):
        torch.testing.assert_close(image, 2 * old)


def test_fused_encoder_on_a_real_frame(kitti_root: Path) -> None:
    encoder = trained(EncoderConfig())
    points = read_frame(kitti_root, "000008").points
    sample = torch.zeros(len(points), dtype=torch.int64)
    with torch.no_grad():
        expected = encoder(points, sample, 1)
    for image, plain in zip(FusedEncoder(encoder)(points, sample, 1), expected, strict=True):
        # coordinates up to 64 m go through sums that cancel: relative to the image's largest value
        assert (image - plain).abs().max() <= 2e-6 * plain.abs().max()
        assert torch.equal(image != 0, plain != 0)
