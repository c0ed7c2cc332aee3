"""The backbone's pyramids."""

import pytest
import torch

from hvnet.config import BackboneConfig
from hvnet.network.backbone import FPN, Backbone


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
