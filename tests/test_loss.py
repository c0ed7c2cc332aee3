"""IoU and GIoU of pairs of boxes with a gradient; learnt weights."""

import dataclasses
import math

import pytest
import torch
from torch import Tensor

from hvnet.config import Config, LossConfig, load_config
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.anchors import Targets, assign_targets
from hvnet.network.head import LOCATION_VALUES, HeadMaps, Regressed
from hvnet.network.loss import focal_loss, iou_pairs, total_loss
from hvnet.network.model import HVNet
from tests.models import CONFIGS, match_class, some_points


def box(x: float, y: float, l: float, w: float, yaw: float = 0.0) -> Tensor:
    return torch.tensor([[x, y, 0.0, l, w, 1.5, yaw]], dtype=torch.float64)


@pytest.mark.parametrize(
    ("other", "iou", "giou"),
    [
        (box(0, 0, 4, 2), 1.0, 1.0),
        (box(0, 0, 4, 2, math.pi), 1.0, 1.0),
        (box(2, 0, 4, 2), 1 / 3, 1 / 3),  # the enclosing rectangle is the union
        (box(2, 1, 4, 2), 2 / 14, 2 / 14 - (18 - 14) / 18),
        (box(0, 0, 2, 4), 4 / 12, 4 / 12 - (16 - 12) / 16),
        (box(0, 0, 4, 2, math.pi / 2), 4 / 12, 4 / 12 - (16 - 12) / 16),
        (box(0, 0, 2, 1), 1 / 4, 1 / 4),
        (box(6, 0, 4, 2), 0.0, -(20 - 16) / 20),
        (box(0, 0, math.sqrt(2), math.sqrt(2), math.pi / 4), 2 / 8, 2 / 8),
    ],
)
def test_iou_by_hand(other: Tensor, iou: float, giou: float) -> None:
    one = box(0, 0, 4, 2)
    assert iou_pairs(one, other).item() == pytest.approx(iou, abs=1e-9)
    assert iou_pairs(one, other, generalized=True).item() == pytest.approx(giou, abs=1e-9)
    assert iou_pairs(other, one).item() == pytest.approx(iou, abs=1e-9)


def pairs(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, count, 7, generator=generator, dtype=torch.float64)
    for boxes in (a, b):
        boxes[:, 3:6] += 0.5
        boxes[:, 6] = (boxes[:, 6] - 0.5) * 2 * math.pi
    return a, b


def test_iou_is_that_of_the_kernel() -> None:
    a, b = pairs(500)
    expected = rotated_iou_bev(a, b).diagonal()
    torch.testing.assert_close(iou_pairs(a, b), expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(iou_pairs(a.float(), b.float()), expected.float(), rtol=0, atol=1e-5)


@pytest.mark.parametrize("generalized", [False, True])
def test_gradient(generalized: bool) -> None:
    a, b = (boxes.requires_grad_() for boxes in pairs(40))
    assert torch.autograd.gradcheck(lambda a, b: iou_pairs(a, b, generalized), (a, b), atol=1e-6)


def test_gradients_of_equal_and_of_distant_boxes_are_finite() -> None:
    for other in (box(0, 0, 4, 2), box(50, 0, 4, 2), box(0, 0, 4, 2, math.pi / 2)):
        moved = other.clone().requires_grad_()
        iou_pairs(box(0, 0, 4, 2), moved, generalized=True).sum().backward()
        assert moved.grad is not None
        assert moved.grad.isfinite().all()


def at_targets(maps: list[HeadMaps], targets: Targets) -> list[Regressed]:
    """The rows of the targets of every class, out of the maps of all anchors."""
    parts = [
        [None if each is None else each.flatten(0, 1)[rows] for each in of_class[1:]]
        for of_class, rows in zip(maps, targets.rows, strict=True)
    ]
    return [Regressed(*own) for own in parts]  # type: ignore[arg-type]


def loss_of_maps(model: HVNet, maps: list[HeadMaps], boxes: list[Tensor], labels: list[Tensor]) -> dict[str, Tensor]:
    """`HVNet.loss` of maps that are given."""
    targets = assign_targets(model.anchors, boxes, labels, model.config.head.regression)
    logits = [of_class.logits for of_class in maps]
    return total_loss(logits, at_targets(maps, targets), targets, model.config.head.classes, model.config.loss)


def test_iou_losses_of_a_class_by_hand(threads: None) -> None:
    """One positive anchor: 1 - IoU = 2/5, 1 - GIoU, and the branch, whose target is the IoU of 3/5."""
    entry = load_config(CONFIGS / "demo.yaml").head.classes[0]
    anchors = torch.tensor([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], [50.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    targets = match_class(anchors, [torch.tensor([[1.0, 1.0, 0.0, 4.0, 2.0, 1.5, 0.0]])], 0.2, 0.1)
    assert targets.positive.tolist() == [[True, False]]
    location = torch.zeros(1, 2, 8)
    location[..., 0::2] = 1.0
    location[..., 1::2] = 0.5  # the box stands at (1, 0.5): 4 x 1.5 of 4 x 2.5 are shared
    maps = HeadMaps(torch.zeros(1, 2), location, torch.zeros(1, 2, 2), None, torch.tensor([[2.0, -3.0]]))
    (found,) = at_targets([maps], targets)
    weights = LossConfig(localization=2.0, iou=3.0)
    terms = total_loss([maps.logits], [found], targets, [entry], dataclasses.replace(weights, box="iou"))
    assert terms["localization"].item() == pytest.approx(2.0 * (1 - 6 / 10), abs=1e-5)
    branch = math.log(1 + math.exp(2.0)) - 2.0 * 6 / 10  # cross-entropy of the logit 2 with the target 0.6
    assert terms["iou"].item() == pytest.approx(3.0 * branch, abs=1e-5)
    location[..., 0::2] = 3.0  # at (3, 0.5): 2 x 1.5 shared, 13 covered, 6 x 2.5 enclosed
    (found,) = at_targets([maps], targets)
    terms = total_loss([maps.logits], [found], targets, [entry], dataclasses.replace(weights, box="giou"))
    assert terms["localization"].item() == pytest.approx(2.0 * (1 - (3 / 13 - 2 / 15)), abs=1e-5)


def test_learnt_weights_by_hand(threads: None) -> None:
    """L exp(-s) + s for every term, with one s a term."""
    config = load_config(CONFIGS / "demo.yaml", ["encoder.point_range=[0, -3.2, -3, 12.8, 3.2, 2]"])
    learnt = dataclasses.replace(config, loss=dataclasses.replace(config.loss, uncertainty=True))
    torch.manual_seed(0)
    plain = HVNet(config)
    model = HVNet(learnt)
    model.load_state_dict(plain.state_dict(), strict=False)
    assert set(model.log_variances) == {"classification", "localization", "vertical", "direction"}
    points, sample = torch.rand(300, 4) * 6, torch.zeros(300, dtype=torch.int64)
    boxes, labels = [torch.tensor([[4.0, 0.0, -1.0, 3.9, 1.6, 1.5, 0.0]])], [torch.tensor([0])]
    with torch.no_grad():
        for k, name in enumerate(model.log_variances):
            model.log_variances[name].fill_(0.5 * k)
    terms = plain(points, sample, boxes, labels)
    weighed = model(points, sample, boxes, labels)
    for k, name in enumerate(model.log_variances):
        assert weighed[name].item() == pytest.approx(math.exp(-0.5 * k) * terms[name].item() + 0.5 * k, rel=1e-5)
    torch.stack(list(weighed.values())).sum().backward()
    for k, name in enumerate(model.log_variances):
        s = model.log_variances[name]
        assert s.grad is not None
        assert s.grad.item() == pytest.approx(1 - math.exp(-0.5 * k) * terms[name].item(), rel=1e-4)


def test_focal_loss_by_hand() -> None:
    logits = torch.tensor([[0.0, math.log(3), -math.log(3), 5.0]])  # p = 1/2, 3/4, 1/4, ignored
    positive = torch.tensor([[True, True, False, False]])
    negative = torch.tensor([[False, False, True, False]])
    expected = -0.25 * (0.5**2 * math.log(0.5) + 0.25**2 * math.log(0.75)) - 0.75 * 0.25**2 * math.log(0.75)
    assert focal_loss(logits, positive, negative, 0.25, 2.0).item() == pytest.approx(expected, rel=1e-6)


def test_loss_of_a_class_by_hand(demo: Config, threads: None) -> None:
    entry = dataclasses.replace(demo.head.classes[0], focal_gamma=0.0, focal_alpha=0.5)
    anchors = torch.tensor([[0.0, 0, 0, 4, 2, 1.5, 0], [0.1, 0, 0, 4, 2, 1.5, 0], [50.0, 0, 0, 4, 2, 1.5, 0]])
    targets = match_class(anchors, [torch.tensor([[0.0, 0, 0.3, 4, 2, 1.5, 0]])], 0.5, 0.35)
    assert targets.positive.tolist() == [[True, True, False]]
    maps = HeadMaps(torch.zeros(1, 3), torch.zeros(1, 3, 8), torch.zeros(1, 3, 2), torch.zeros(1, 3, 2))
    found = at_targets([maps], targets)
    terms = total_loss([maps.logits], found, targets, [entry], LossConfig())
    assert terms["classification"].item() == pytest.approx(3 * 0.5 * math.log(2) / 2)
    assert terms["localization"].item() == pytest.approx(4 * 0.5 * 0.1**2 / 2)  # four x offsets of -0.1 m
    assert terms["vertical"].item() == pytest.approx(1.5 * 2 * 0.5 * 0.2**2 / 2)
    assert terms["direction"].item() == pytest.approx(0.2 * math.log(2))
    terms = total_loss([maps.logits], found, targets, [entry], LossConfig(beta=0.05))  # from 0.05 on linear
    assert terms["localization"].item() == pytest.approx(4 * (0.1 - 0.025) / 2)
    assert terms["vertical"].item() == pytest.approx(1.5 * 2 * (0.2 - 0.025) / 2)


def test_loss_without_boxes_is_finite(demo: Config, threads: None) -> None:
    model = HVNet(demo)
    none = [torch.zeros(0, 7)], [torch.zeros(0, dtype=torch.int64)]
    terms = model(some_points(), torch.zeros(500, dtype=torch.int64), *none)
    loss = torch.stack(list(terms.values())).sum()
    loss.backward()
    assert loss.isfinite()
    assert terms["localization"] == 0


def losses_of(demo: Config, box: str, regression: str) -> tuple[HVNet, list[list[Tensor]], list[Tensor], list[Tensor]]:
    """A model with every term, maps of three samples class by class, and their boxes and labels."""
    head = dataclasses.replace(demo.head, direction=True, iou=True, regression=regression)
    model = HVNet(dataclasses.replace(demo, head=head, loss=dataclasses.replace(demo.loss, box=box)))
    generator = torch.Generator().manual_seed(0)
    boxes = [torch.cat([model.anchors(k)[5 * b + 40 :: 60][:4] for k in range(3)]) for b in range(3)]
    for own in boxes:
        own[:, 3:] *= 0.9 + 0.2 * torch.rand(own[:, 3:].shape, generator=generator)
    labels = [torch.arange(12) // 4 for _ in boxes]
    boxes[1], labels[1] = boxes[1][:0], labels[1][:0]
    maps, of_anchors = [], ((), (LOCATION_VALUES[regression],), (2,), (2,), ())
    for k in range(3):
        shapes = [(3, len(model.anchors(k)), *of_anchor) for of_anchor in of_anchors]
        maps.append([torch.randn(shape, generator=generator) * 0.1 for shape in shapes])
    return model, maps, boxes, labels


@pytest.mark.parametrize("box", ["smooth_l1", "iou", "giou"])
@pytest.mark.parametrize("regression", ["corners", "pose"])
def test_losses_are_the_sums_of_those_of_the_classes(box: str, regression: str, demo: Config) -> None:
    """The same bits, and those of the gradients, as of one class after the other; the second one has no box."""
    model, maps, boxes, labels = losses_of(demo, box, regression)
    labels = [of_own.where(of_own != 1, -1) for of_own in labels]
    leaves = [[part.requires_grad_() for part in of_class] for of_class in maps]
    found = loss_of_maps(model, [HeadMaps(*of_class) for of_class in leaves], boxes, labels)
    want: dict[str, Tensor] = {}
    for k, entry in enumerate(demo.head.classes):
        own = [each[of_each == k] for each, of_each in zip(boxes, labels, strict=True)]
        thresholds = (entry.positive_iou, entry.negative_iou)
        targets = match_class(model.anchors(k), own, *thresholds, regression=regression)
        rows = at_targets([HeadMaps(*leaves[k])], targets)
        terms = total_loss([leaves[k][0]], rows, targets, [entry], model.config.loss)
        want = {name: want[name] + term if want else term for name, term in terms.items()}
    assert found == want
    assert all(term > 0 for term in found.values())
    flat = [part for of_class in leaves for part in of_class]
    gradients = (torch.autograd.grad(torch.stack(list(terms.values())).sum(), flat) for terms in (found, want))
    for mine, of_classes in zip(*gradients, strict=True):
        assert torch.equal(mine, of_classes)


@pytest.mark.parametrize("box", ["smooth_l1", "iou", "giou"])
@pytest.mark.parametrize("regression", ["corners", "pose"])
def test_losses_of_many_threads_are_those_of_one(
    box: str, regression: str, demo: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every term, and the gradients of every map, though there is no number at all where no anchor is positive."""
    model, maps, boxes, labels = losses_of(demo, box, regression)

    def terms_and_gradients() -> tuple[dict[str, Tensor], list[Tensor]]:
        leaves = [part.clone().requires_grad_() for of_class in maps for part in of_class]
        terms = loss_of_maps(model, [HeadMaps(*leaves[k : k + 5]) for k in (0, 5, 10)], boxes, labels)
        return terms, list(torch.autograd.grad(torch.stack(list(terms.values())).sum(), leaves))

    terms, gradients = terms_and_gradients()
    assert all(term > 0 for term in terms.values())
    for k, of_class in enumerate(maps):  # all but the logits, where the one way has no gradient
        for part, gradient in zip(of_class[1:], gradients[5 * k + 1 : 5 * k + 5], strict=True):
            part[(gradient == 0).flatten(2).all(dim=2) if gradient.ndim > 2 else gradient == 0] = math.nan
    monkeypatch.setattr("hvnet.kernels.launch.force_many_threads", True)
    found, found_gradients = terms_and_gradients()
    torch.testing.assert_close(found, terms, rtol=1e-6, atol=0)
    for mine, want in zip(found_gradients, gradients, strict=True):
        torch.testing.assert_close(mine, want, rtol=1e-6, atol=1e-9)
