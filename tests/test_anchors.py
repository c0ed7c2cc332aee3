"""Anchors: where they are, boxes encoded against them, and their matching."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from hvnet.boxes import bev_corners
from hvnet.config import Config
from hvnet.kernels import reference
from hvnet.network.anchors import (
    MAX_HEIGHT,
    MAX_SHIFT,
    MAX_SIZE,
    Anchors,
    assign_targets,
    decode,
    encode,
    make_anchors,
    positives_per_box,
)
from tests.models import match_class


def any_boxes(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low = torch.tensor([0.0, -30.0, -2.0, 0.3, 0.3, 0.5, -math.pi])
    high = torch.tensor([64.0, 30.0, 1.0, 8.0, 3.0, 3.0, math.pi])
    return low + torch.rand(count, 7, generator=generator) * (high - low)


def test_anchors_stand_at_cell_centres(demo: Config) -> None:
    entry = demo.head.classes[0]
    anchors = make_anchors(demo, entry)
    assert entry.level == 1
    expected = torch.tensor([[0.4, -2.8], [0.4, -2.0], [1.2, -2.8]])  # of the cells (0, 0), (0, 1) and (1, 0) of 0.8 m
    torch.testing.assert_close(anchors[[0, 4, 4 * 8], :2], expected)
    torch.testing.assert_close(anchors[:4, 6], torch.tensor([0, math.pi / 4, math.pi / 2, 3 * math.pi / 4]))
    assert (anchors[:, 2] == entry.anchor_z).all()


def test_decode_is_the_inverse_of_encode() -> None:
    boxes, anchors = any_boxes(10_000).double(), any_boxes(10_000, seed=1).double()
    corners, vertical, direction = encode(boxes, anchors)
    decoded = decode(corners, vertical, direction, anchors)
    torch.testing.assert_close(decoded[:, :6], boxes[:, :6], rtol=0, atol=1e-9)
    assert (torch.sin(decoded[:, 6] - boxes[:, 6]).abs() < 1e-9).all()
    assert (torch.cos(decoded[:, 6] - boxes[:, 6]) > 0.999).all()
    modulo_pi = decode(corners, vertical, None, anchors)
    assert (torch.sin(modulo_pi[:, 6] - boxes[:, 6]).abs() < 1e-9).all()
    assert (torch.cos(modulo_pi[:, 6] - anchors[:, 6]) > -1e-9).all()  # the half-turn nearer to the anchor
    assert ((decoded[:, 6] >= -math.pi) & (decoded[:, 6] < math.pi)).all()


def test_pose_is_inverted_and_by_hand() -> None:
    """VoxelNet's residuals, of the half-turn that is nearer to the anchor."""
    boxes, anchors = any_boxes(10_000).double(), any_boxes(10_000, seed=1).double()
    location, vertical, direction = encode(boxes, anchors, "pose")
    assert location.shape == (10_000, 5)
    assert (location[:, 4].abs() <= math.pi / 2 + 1e-9).all()
    decoded = decode(location, vertical, direction, anchors)
    torch.testing.assert_close(decoded[:, :6], boxes[:, :6], rtol=0, atol=1e-9)
    assert (torch.cos(decoded[:, 6] - boxes[:, 6]) > 1 - 1e-9).all()
    anchor = torch.tensor([[10.0, 0.0, -1.0, 4.0, 3.0, 1.5, 0.0]])
    box = torch.tensor([[11.0, 0.5, -1.0, 8.0, 3.0, 1.5, math.pi - 0.2]])
    location, _, direction = encode(box, anchor, "pose")
    torch.testing.assert_close(location, torch.tensor([[0.2, 0.1, math.log(2), 0.0, -0.2]]))
    assert direction.tolist() == [1]


def test_encode_by_hand() -> None:
    anchor = torch.tensor([[10.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0]])
    box = torch.tensor([[11.0, 0.5, -0.7, 4.0, 2.0, 3.0, math.pi]])  # backwards: its front is the anchor's rear
    corners, vertical, direction = encode(box, anchor)
    torch.testing.assert_close(corners, torch.tensor([[1.0, 0.5] * 4]), atol=1e-5, rtol=0)
    torch.testing.assert_close(vertical, torch.tensor([[0.2, math.log(2)]]))
    assert direction.tolist() == [1]
    assert bev_corners(anchor)[0].tolist() == [[12, 1], [12, -1], [8, -1], [8, 1]]


HUGE = [100.0, 1e4, 1e30, 3.4e38, math.inf]


@pytest.mark.parametrize("values", [8, 5])
@pytest.mark.parametrize("value", [*HUGE, *(-each for each in HUGE)])
def test_decoded_boxes_are_bounded(values: int, value: float, device: torch.device) -> None:
    """Every output huge, and one output at a time with the others 0; the gradient is finite, too."""
    anchors = any_boxes(values + 3).to(device)
    outputs = torch.zeros(values + 3, values + 2, device=device)
    outputs[0] = value
    outputs[1:].fill_diagonal_(value)
    outputs.requires_grad_()
    boxes = decode(outputs[:, :values], outputs[:, values:], None, anchors)
    assert boxes.isfinite().all()
    assert ((boxes[:, 3:5] >= 0) & (boxes[:, 3:5] <= MAX_SIZE)).all()
    assert ((boxes[:, 5] >= 0) & (boxes[:, 5] <= MAX_HEIGHT)).all()
    assert ((boxes[:, 2] - anchors[:, 2]).abs() <= MAX_HEIGHT + 1e-5).all()
    assert ((boxes[:, :2] - anchors[:, :2]).abs() <= MAX_SHIFT + 1e-4).all()
    assert ((boxes[:, 6] >= -math.pi) & (boxes[:, 6] < math.pi)).all()
    boxes.sum().backward()
    assert outputs.grad is not None
    assert outputs.grad.isfinite().all()


def test_bounds_by_hand() -> None:
    """At a bound, beyond it, and with an anchor that is larger than the bounds."""
    small, large = [0.0, 0, 0, 4, 2, 2, 0], [0.0, 0, 0, 50, 3, 12, 0]
    anchors = torch.tensor([small, small, large, large])
    sizes = torch.tensor([[39, 3, 9], [41, 41, 11], [50, 90, 12], [110, 3, 25.0]])
    vertical = torch.stack((torch.tensor([4.9, 6, 1, -3]), (sizes[:, 2] / anchors[:, 5]).log()), dim=1)
    want = torch.tensor([[9.8, 39, 3, 9], [10, 40, 40, 10], [12, 50, 90, 12], [-24, 100, 3, 24]])
    boxes = torch.cat((torch.zeros(4, 3), sizes, torch.zeros(4, 1)), dim=1)
    for regression in ("corners", "pose"):
        location, _, _ = encode(boxes, anchors, regression)
        torch.testing.assert_close(decode(location, vertical, None, anchors)[:, 2:6], want, rtol=1e-5, atol=1e-5)
    location = torch.tensor([[120.0, -99] * 4, [-70, 101] * 4, [0, 0] * 4, [0, 0] * 4])
    centres = decode(location, vertical, None, anchors)[:, :2]
    assert centres.tolist() == [[100, -99], [-70, 100], [0, 0], [0, 0]]


@pytest.mark.parametrize("values", [8, 5])
def test_inside_the_bounds_nothing_is_changed(
    values: int, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bits and the same gradients as without bounds."""
    generator = torch.Generator().manual_seed(values)
    anchors, weight = any_boxes(3000).to(device), torch.randn(7, generator=generator).to(device)
    outputs = (torch.randn(3000, values + 2, generator=generator) * 0.5).to(device).requires_grad_()

    def boxes_and_gradient() -> tuple[Tensor, Tensor]:
        boxes = decode(outputs[:, :values], outputs[:, values:], None, anchors)
        return boxes, torch.autograd.grad((boxes * weight).sum(), outputs)[0]

    found = boxes_and_gradient()
    for name in ("MAX_SIZE", "MAX_HEIGHT", "MAX_SHIFT", "MAX_OUTPUT"):
        monkeypatch.setattr(f"hvnet.network.anchors.{name}", math.inf)
    want = boxes_and_gradient()
    inside = (want[0][:, 3:5].amax(dim=1) < MAX_SIZE) & (want[0][:, 5] < MAX_HEIGHT)
    assert inside.float().mean() > 0.99
    assert torch.equal(found[0][inside], want[0][inside])
    assert torch.equal(found[1][inside], want[1][inside])


@pytest.mark.parametrize("values", [8, 5])
def test_a_nan_stays_one(values: int) -> None:
    """Any output that is NaN makes a box that is not finite."""
    outputs = torch.zeros(values + 2, values + 2).fill_diagonal_(math.nan)
    boxes = decode(outputs[:, :values], outputs[:, values:], None, any_boxes(values + 2))
    assert boxes.isnan().any(dim=1).all()
    assert decode(outputs[:0, :values], outputs[:0, values:], None, any_boxes(0)).shape == (0, 7)


def test_assign_targets_by_hand(threads: None) -> None:
    anchors = torch.tensor([[x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0] for x in (0.0, 1.0, 2.0, 10.0, 20.0)])
    boxes = torch.tensor([[0.4, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], [13.9, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    # IoU with box 0, shifted by d: (4 - d) / (4 + d): 0.818, 0.739, 0.429, 0, 0; box 1 overlaps only anchor 3: 0.013
    targets = match_class(anchors, [boxes, boxes[:0]], 0.75, 0.6)
    assert targets.positive.tolist() == [[True, False, False, True, False], [False] * 5]
    assert targets.negative.tolist() == [[False, False, True, False, True], [True] * 5]
    torch.testing.assert_close(targets.location[~targets.unused], torch.tensor([[0.4, 0.0] * 4, [3.9, 0.0] * 4]))
    assert targets.rows[0][~targets.unused].tolist() == [0, 3]
    assert targets.boxes[~targets.unused].tolist() == boxes.tolist()


def test_two_boxes_with_one_best_anchor(threads: None) -> None:
    anchors = torch.tensor([[0.0, 0, 0, 4, 2, 1.5, 0], [50.0, 0, 0, 4, 2, 1.5, 0]])
    boxes = torch.tensor([[1.0, 0, 0, 4, 2, 1.5, 0], [0.5, 0, 0, 4, 2, 1.5, 0]])
    targets = match_class(anchors, [boxes], 0.9, 0.3)
    assert targets.positive.tolist() == [[True, False]]
    torch.testing.assert_close(targets.location[~targets.unused], torch.tensor([[1.0, 0.0] * 4]))


def test_assign_targets_is_the_matrix_version(demo: Config, threads: None) -> None:
    entry = demo.head.classes[0]
    anchors = make_anchors(demo, entry)
    boxes = any_boxes(6)
    boxes[:, :2] = torch.tensor([[2.0, 0.0], [4.0, 2.0], [8.0, -2.0], [10.0, 1.0], [6.0, 0.0], [11.0, -1.0]])
    targets = match_class(anchors, [boxes[:4], boxes[4:]], 0.5, 0.35)
    for b, own in enumerate((boxes[:4], boxes[4:])):
        iou = reference.rotated_iou_bev(anchors.double(), own.double())
        near = ((iou - 0.5).abs() < 1e-5).any(1) | ((iou - 0.35).abs() < 1e-5).any(1)
        forced = iou == iou.amax(0)
        positive = (iou.amax(1) > 0.5) | forced.any(1)
        # anchors tied for the best of a box: only one of them is forced
        tied = (iou > iou.amax(0) - 1e-6).any(1) & ~(iou.amax(1) > 0.5)
        compared = ~near & ~tied
        assert torch.equal(targets.positive[b][compared], positive[compared])
        assert torch.equal(targets.negative[b][compared], (iou.amax(1) < 0.35)[compared])
        for m in range(len(own)):
            assert targets.positive[b][iou[:, m] > iou[:, m].amax() - 1e-6].any()


def boxes_of_classes(demo: Config) -> tuple[list[Tensor], list[Tensor]]:
    """Boxes of three samples, some of no class; the second sample has none."""
    sizes = torch.tensor([each.anchor_sizes[0] for each in demo.head.classes] * 2)
    boxes = [any_boxes(24, seed) * torch.tensor([0.2, 0.1, 1, 1, 1, 1, 1]) for seed in range(3)]
    labels = [torch.arange(24) % 4 - 1 for _ in boxes]
    for own, of_own in zip(boxes, labels, strict=True):
        own[:, 3:6] = sizes[of_own] * (0.9 + 0.02 * own[:, 3:6])
    return [boxes[0], boxes[1][:0], boxes[2]], [labels[0], labels[1][:0], labels[2]]


def test_targets_of_classes_are_those_of_each_alone(demo: Config, threads: None) -> None:
    """The same bits, class after class."""
    classes, (boxes, labels) = demo.head.classes, boxes_of_classes(demo)
    grids = [make_anchors(demo, entry) for entry in classes]
    anchors = Anchors(grids, classes, [positives_per_box(demo, entry) for entry in classes])
    joint = assign_targets(anchors, boxes, labels)
    positive, negative = (mask.split(anchors.counts, dim=1) for mask in joint[:2])
    used = [~unused for unused in joint.unused.split([len(rows) for rows in joint.rows])]
    split_by_class = [values.split([len(rows) for rows in joint.rows]) for values in joint[4:]]
    for k, entry in enumerate(classes):
        assert torch.equal(anchors(k), grids[k])
        own = [each[of_each == k] for each, of_each in zip(boxes, labels, strict=True)]
        alone = match_class(grids[k], own, entry.positive_iou, entry.negative_iou)
        assert torch.equal(positive[k], alone.positive)
        assert torch.equal(negative[k], alone.negative)
        assert torch.equal(joint.rows[k][used[k]], alone.rows[0][~alone.unused])
        assert used[k].sum() > 5
        for values, want in zip(split_by_class, alone[4:], strict=True):
            assert torch.equal(values[k][used[k]], want[~alone.unused])


@pytest.mark.parametrize("regression", ["corners", "pose"])
def test_targets_of_many_threads_are_those_of_one(
    demo: Config, regression: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bits in the rows that are used; the others are different anchors, matched to themselves."""
    classes, (boxes, labels) = demo.head.classes, boxes_of_classes(demo)
    per_box = [positives_per_box(demo, entry) for entry in classes]
    anchors = Anchors([make_anchors(demo, entry) for entry in classes], classes, per_box)
    one = assign_targets(anchors, boxes, labels, regression)
    monkeypatch.setattr("hvnet.kernels.launch.force_many_threads", True)
    many = assign_targets(anchors, boxes, labels, regression)
    used = ~many.unused
    assert torch.equal(one.positive, many.positive)
    assert torch.equal(one.negative, many.negative)
    assert 0 < used.sum() < len(used)
    assert not one.unused.any()
    for rows, want, of_class in zip(many.rows, one.rows, used.split([len(rows) for rows in many.rows]), strict=True):
        assert torch.equal(rows[of_class], want)
        assert rows[~of_class].unique().shape == rows[~of_class].shape
    for values, want in zip(many[4:], one[4:], strict=True):
        assert torch.equal(values[used], want)
    for values in (many.location, many.vertical, many.direction):
        assert not values[~used].any()
    assert torch.equal(many.anchors[~used], many.boxes[~used])


@pytest.mark.parametrize("positive_iou", [0.25, 0.35, 0.5, 0.7])
def test_no_box_has_more_positive_anchors(demo: Config, positive_iou: float, threads: None) -> None:
    """Boxes like the anchors, which have the most, and of all sizes."""
    entry = dataclasses.replace(demo.head.classes[1], positive_iou=positive_iou)  # the anchors are 0.4 m apart
    anchors, most = make_anchors(demo, entry), positives_per_box(demo, entry)
    generator = torch.Generator().manual_seed(0)
    boxes = anchors[torch.randint(len(anchors), (600,), generator=generator)].clone()
    boxes[:, :2] += (torch.rand(600, 2, generator=generator) - 0.5) * 0.4
    boxes[300:, 3:5] *= 4 ** (2 * torch.rand(300, 2, generator=generator) - 1)
    boxes[:, 6] = torch.rand(600, generator=generator) * math.pi
    positive = match_class(anchors, list(boxes[:, None]), positive_iou, 0.05).positive.sum(dim=1)
    assert most / 20 < positive.max() <= most
