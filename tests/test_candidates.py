"""Keys, patches and decoding by many threads, against the steps of one thread."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from hvnet.config import Config, load_config
from hvnet.kernels.candidates import gather_patches, write_keys
from hvnet.network.anchors import MAX_HEIGHT, decode, make_anchors
from hvnet.network.detector import regression_weight
from hvnet.network.head import Head, regress, scores_of
from hvnet.network.static import BoxSteps
from tests.models import CONFIGS, NARROW

LARGEST = 2**31 - 1


def test_scores() -> None:
    """The geometric mean keeps the scale: half sure of both is half sure."""
    logits, iou = torch.tensor([0.0, 0.0, math.log(4.0)]), torch.tensor([0.0, 40.0, math.log(0.25)])
    torch.testing.assert_close(scores_of(logits, None), torch.tensor([0.5, 0.5, 0.8]))
    torch.testing.assert_close(scores_of(logits, iou), torch.tensor([0.5, math.sqrt(0.5), 0.4]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("has_iou", [False, True])
def test_keys(has_iou: bool, dtype: torch.dtype, device: torch.device) -> None:
    """The score above, the anchor below; negative at the threshold, below it, for NaN and where there is no anchor."""
    generator = torch.Generator().manual_seed(0)
    logits, iou = (torch.randn(2, 300, generator=generator).mul(3).to(dtype) for _ in range(2))
    logits[0, :4] = torch.tensor([0.0, math.nan, math.inf, -math.inf])
    iou[0, :4] = torch.tensor([0.0, 40.0, 40.0, 40.0])
    threshold = 0.5
    keys = torch.full((2, 3, 320), 7, dtype=torch.int64, device=device)
    write_keys(logits.to(device), iou.to(device) if has_iou else None, threshold, 1, keys)
    assert (keys[:, [0, 2]] == 7).all()
    keys = keys[:, 1].cpu()
    wanted = scores_of(logits.float(), iou.float() if has_iou else None)
    bits = (keys >> 32).int()
    torch.testing.assert_close(bits.view(torch.float32)[:, :300][keys[:, :300] >= 0], wanted[wanted > threshold])
    assert torch.equal(keys[:, :300] >= 0, wanted > threshold)
    assert (keys[:, 300:] < 0).all()
    assert keys[0, 0] < 0
    assert keys[0, 1] < 0
    assert keys[0, 2] >= 0
    anchor = LARGEST - (keys & LARGEST)
    assert torch.equal(anchor[keys >= 0], torch.arange(320).expand(2, -1)[keys >= 0])


def keys_of(anchors: Tensor, score: float = 0.5) -> Tensor:
    bits = torch.tensor(score).view(torch.int32).long()
    return (bits << 32) | (LARGEST - anchors)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_patches(dtype: torch.dtype, device: torch.device) -> None:
    """Every cell of a map that is not square, its borders included, for one class of three."""
    level = torch.randn(2, 5, 3, 6, generator=torch.Generator().manual_seed(0)).to(dtype)
    anchors = torch.randperm(5 * 3 * 8, generator=torch.Generator().manual_seed(1)).view(2, 1, 60)
    keys = keys_of(anchors).repeat(1, 3, 1)
    keys[1, 1, 50:] = -1
    patches = torch.full((3, 120, 54), 9.0, device=device)
    gather_patches(level.to(device), keys.to(device), 1, 8, patches)
    wide = torch.nn.functional.pad(level.float(), (0, 0, 1, 1, 1, 1))
    for b in range(2):
        for k in range(60):
            cell = int(anchors[b, 0, k]) // 8
            wanted = wide[b, cell // 3 : cell // 3 + 3, cell % 3 : cell % 3 + 3].flatten()
            if b == 1 and k >= 50:
                wanted = torch.full((54,), 9.0)  # left as it was
            assert torch.equal(patches[1, b * 60 + k].cpu(), wanted)
    assert (patches[[0, 2]] == 9).all()


@pytest.mark.parametrize("direction", [True, False])
@pytest.mark.parametrize("regression", ["corners", "pose"])
@pytest.mark.parametrize("scale", [0.05, 3.0, 1e30])
def test_boxes_are_those_of_one_thread(scale: float, regression: str, direction: bool, device: torch.device) -> None:
    """Classes with different anchors a cell, levels and numbers of candidates; outputs of any size, NaN among them."""
    torch.manual_seed(0)
    config: Config = load_config(CONFIGS / "demo.yaml", NARROW)
    head = dataclasses.replace(config.head, regression=regression, direction=direction, candidates=40)
    two_sizes = dataclasses.replace(head.classes[0], anchor_sizes=((3.9, 1.6, 1.5), (18.0, 2.5, 7.0)))
    head = dataclasses.replace(head, classes=(two_sizes, *head.classes[1:]))
    config = dataclasses.replace(config, head=head)
    heads = [Head(entry, 6, head) for entry in head.classes]
    for each in heads:
        for branch in (each.location, each.vertical, each.direction):
            if branch is not None:
                torch.nn.init.normal_(branch.weight, std=scale)
    torch.nn.init.constant_(heads[2].location.bias[:2], math.nan)
    torch.nn.init.constant_(heads[1].vertical.bias[:1], math.inf)
    anchors = [make_anchors(config, entry) for entry in head.classes]
    weights = [regression_weight(each) for each in heads]
    levels = [torch.randn(2, 6, 32 >> k, 16 >> k).to(memory_format=torch.channels_last) for k in range(3)]
    keys = torch.full((2, 3, max(map(len, anchors))), -1)
    for label, of_class in enumerate(anchors):
        scores = torch.rand(2, len(of_class))
        scores[:, ::2] = 0.75  # many ties
        some = torch.randperm(len(of_class))[: (200, 30, 10)[label]]
        bits = scores.view(torch.int32).long()
        keys[:, label, some] = ((bits << 32) | (LARGEST - torch.arange(len(of_class))))[:, some]
    steps = BoxSteps(head, [each.to(device) for each in weights], [each.to(device) for each in anchors])
    with torch.no_grad():
        rows = steps.candidates([level.to(device) for level in levels], keys.to(device))
    assert rows.table.shape == (2, 3, 40, 10)
    assert rows.counts.tolist() == [40, 30, 10] * 2
    for b in range(2):
        for label, entry in enumerate(head.classes):
            best = keys[b, label].sort(descending=True).values[:40]
            best = best[best >= 0]
            chosen = LARGEST - (best & LARGEST)
            with torch.no_grad():
                values = regress(levels[entry.level][b : b + 1], chosen, weights[label], 4 * len(entry.anchor_sizes))
            count = 8 if regression == "corners" else 5
            turns = values[:, count + 2 :].argmax(dim=1) if direction else None
            wanted = decode(values[:, :count], values[:, count : count + 2], turns, anchors[label][chosen])
            valid = wanted.isfinite().all(dim=1)
            found = rows.table[b, label, : len(best)].cpu()
            assert torch.equal(rows.valid[b, label, : len(best)].cpu(), valid)
            assert not rows.valid[b, label, len(best) :].any()
            torch.testing.assert_close(found[valid, :6], wanted[valid, :6], rtol=1e-4, atol=1e-4)
            turn = found[valid, 6] - wanted[valid, 6]
            assert (turn.sin().abs() < 1e-3).all()
            assert (turn.cos() > 0).all()
            assert (found[:, 6] >= -math.pi).all() or not valid.all()
            assert torch.equal(found[:, 7], (best >> 32).int().view(torch.float32))
            assert (found[:, 8] == label).all()
            assert (found[valid, 5] <= max(MAX_HEIGHT, 14.0)).all()
    assert rows.valid.any()
    assert not rows.valid.cpu()[:, 2, :10].all()
