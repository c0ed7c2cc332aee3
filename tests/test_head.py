"""The head's maps as rows of anchors."""

import dataclasses

import pytest
import torch

from hvnet.config import Config
from hvnet.network.head import Head, ScoreMaps, anchor_rows


def test_anchor_rows_have_the_order_of_the_anchors() -> None:
    """A map that holds its own x, y and channel shows where each row comes from."""
    n_l, n_w, per_cell, values = 3, 5, 4, 2
    x, y, c = torch.meshgrid(torch.arange(n_l), torch.arange(n_w), torch.arange(per_cell * values), indexing="ij")
    output = (100 * x + 10 * y + c).permute(2, 0, 1)[None].float()
    rows = anchor_rows(output, values)[0]
    assert rows.shape == (n_l * n_w * per_cell, values)
    assert rows[(1 * n_w + 3) * per_cell + 2].tolist() == [100 + 30 + 4, 100 + 30 + 5]


@pytest.mark.parametrize("optional", [False, True])
def test_chosen_anchors_have_the_values_and_gradients_of_the_maps(optional: bool, demo: Config) -> None:
    """Of two samples on a level that is not square, in any order and one of them twice."""
    torch.manual_seed(0)
    entry = dataclasses.replace(demo.head.classes[0], anchor_sizes=((3.9, 1.6, 1.5), (8.0, 2.5, 3.0)))
    head = Head(entry, 6, dataclasses.replace(demo.head, direction=optional, iou=optional)).double()
    level = torch.randn(2, 6, 5, 3, dtype=torch.float64, requires_grad=True)
    chosen = torch.cat((torch.randperm(2 * 5 * 3 * 8), torch.tensor([7])))
    maps, found = head(level), head.regress(level, chosen)
    assert (found.direction is None, found.iou is None) == (not optional, not optional)
    given = [
        (own, of_map.flatten(0, 1)[chosen]) for own, of_map in zip(found, maps[1:], strict=True) if own is not None
    ]
    for own, of_map in given:
        torch.testing.assert_close(own, of_map, rtol=1e-5, atol=1e-6)  # both are float32
    leaves = [level, head.location.weight, head.location.bias, head.vertical.weight]
    gradients = [
        torch.autograd.grad(torch.stack([each.square().sum() for each in side]).sum(), leaves, retain_graph=True)
        for side in zip(*given, strict=True)
    ]
    for own, of_map in zip(*gradients, strict=True):
        torch.testing.assert_close(own, of_map, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("iou", [False, True])
def test_classes_of_a_level_share_a_convolution(iou: bool, demo: Config) -> None:
    """With other numbers of anchors and levels in another order, all have the maps of their own branches."""
    torch.manual_seed(0)
    config, entry = dataclasses.replace(demo.head, iou=iou), demo.head.classes[0]
    sizes = (((3.9, 1.6, 1.5), (8.0, 2.5, 3.0)), ((0.8, 0.8, 1.7),), ((1.8, 0.8, 1.7),))
    heads = [Head(dataclasses.replace(entry, anchor_sizes=own), 6, config) for own in sizes]
    levels = [torch.randn(2, 6, 8, 4), torch.randn(2, 6, 4, 2), torch.randn(2, 6, 2, 1)]
    level_of_class = (1, 0, 1)
    state = torch.get_rng_state()
    score_maps = ScoreMaps(heads, level_of_class)
    assert torch.equal(torch.get_rng_state(), state)  # a run that is validated goes on as one that is not
    assert len(score_maps.layers) == 2
    for shift in (0.0, 0.5):
        heads[2].score.get_parameter("bias").data += shift
        score_maps.score_bias(2).add_(shift)
        for head, level, maps in zip(heads, level_of_class, score_maps(levels), strict=True):
            branches = [head.score] if head.iou is None else [head.score, head.iou]
            for branch, found in zip(branches, maps, strict=True):
                torch.testing.assert_close(found, branch(levels[level]))
