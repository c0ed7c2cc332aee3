"""The backbone's pyramids."""

import pytest
import torch

from hvnet.config import BackboneConfig
from hvnet.network.backbone import FPN, Backbone, ConvReLU


@pytest.mark.parametrize(("pyramid", "levels"), [("none", 3), ("fpn", 3), ("ffpn", 3), ("upsampled", 1)])
@pytest.mark.parametrize("stride", [1, 2])
def test_pyramids(pyramid: str, levels: int, stride: int) -> None:
    config = BackboneConfig((8, 12, 16), (2, 2, 2), stride, pyramid, 10)  # type: ignore[arg-type]
    backbone = Backbone(config, 6, 1)
    maps = backbone([torch.randn(2, 6, 32, 16)])
    n_l, n_w = 32 // stride, 16 // stride
    assert [m.shape for m in maps] == [(2, backbone.channels, n_l >> k, n_w >> k) for k in range(levels)]


def test_fpn_adds_the_coarser_levels() -> None:
    """Lateral maps of ones and no smoothing: each level has one more than the level above it."""
    fpn = FPN((1, 1, 1), 1)
    for lateral in fpn.lateral:
        torch.nn.init.ones_(lateral.weight)
        torch.nn.init.zeros_(lateral.bias)
    fpn.smooth = torch.nn.ModuleList(torch.nn.Identity() for _ in range(3))
    levels = fpn([torch.ones(1, 1, 8, 4), torch.ones(1, 1, 4, 2), torch.ones(1, 1, 2, 1)])
    assert [level.unique().tolist() for level in levels] == [[3], [2], [1]]


def test_one_kernel_is_taken_where_it_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not where cuDNN has none, as on the CPU, nor where it reads what was in the output's memory before."""
    layer = ConvReLU(torch.nn.Conv2d(3, 4, 3, padding=1))
    features = torch.randn(1, 3, 6, 5, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        want = layer.convolution(features).relu()
        assert torch.equal(layer(features), want)
        assert not layer.has_one_kernel(features)
        for factor, taken in ((1.0, True), (1.01, False), (torch.nan, False)):
            monkeypatch.setattr(layer, "by_cudnn", lambda x, factor=factor: layer.convolution(x).relu() * factor)
            assert layer.has_one_kernel(features) == taken


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize(("kernel", "stride"), [(3, 1), (3, 2), (1, 1)])
def test_one_kernel_on_cuda(kernel: int, stride: int, dtype: torch.dtype) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    torch.manual_seed(0)
    layer = ConvReLU(torch.nn.Conv2d(64, 128, kernel, stride, padding=kernel // 2)).to("cuda", dtype)
    features = torch.randn(1, 64, 40, 56, device="cuda", dtype=dtype).to(memory_format=torch.channels_last)
    with torch.no_grad():
        want = torch.relu(layer.convolution(features))
        torch.testing.assert_close(layer(features), want, rtol=0.02, atol=0.02)
        assert list(layer.one_kernel) == [features.shape]
