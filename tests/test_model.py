"""Backbone, heads, anchors, losses and the whole detector."""

import copy
import dataclasses
import math

import pytest
import torch
from torch import Tensor

from hvnet.boxes import bev_corners
from hvnet.config import BackboneConfig, Config, LossConfig, load_config
from hvnet.kernels import reference
from hvnet.network.anchors import assign_targets, decode, encode, make_anchors
from hvnet.network.backbone import FPN, Backbone
from hvnet.network.head import HeadMaps, anchor_rows
from hvnet.network.loss import class_loss, focal_loss
from hvnet.network.model import Detections, HVNet
from tests.models import CONFIGS, some_points


def random_boxes(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    low = torch.tensor([0.0, -30.0, -2.0, 0.3, 0.3, 0.5, -math.pi])
    high = torch.tensor([64.0, 30.0, 1.0, 8.0, 3.0, 3.0, math.pi])
    return low + torch.rand(count, 7, generator=generator) * (high - low)


def test_shapes_of_every_stage(demo: Config) -> None:
    model = HVNet(demo)
    points, sample = some_points(), torch.arange(500) % 2
    images = model.encoder(points, sample, 2)
    assert [i.shape for i in images] == [(2, 32, 32, 16), (2, 32, 16, 8), (2, 32, 8, 4)]
    stream = model.backbone.main_stream(images)
    assert [b.shape for b in stream] == [(2, 16, 32, 16), (2, 32, 16, 8), (2, 64, 8, 4)]
    levels = model.backbone.pyramid(stream)
    assert [level.shape for level in levels] == [(2, 32, 32, 16), (2, 32, 16, 8), (2, 32, 8, 4)]
    maps = model(points, sample, 2)
    for k, (of_class, entry) in enumerate(zip(maps, demo.head.classes, strict=True)):
        anchors = 4 * (32 >> entry.level) * (16 >> entry.level)
        assert model.anchors(k).shape == (anchors, 7)
        assert of_class.logits.shape == (2, anchors)
        assert of_class.location.shape == (2, anchors, 8)
        assert of_class.vertical.shape == (2, anchors, 2)
        assert of_class.direction is not None
        assert of_class.direction.shape == (2, anchors, 2)


@pytest.mark.parametrize("scales", [1, 2, 3, 4, 5])
def test_one_to_five_projection_scales(scales: int) -> None:
    blocks = max(3, scales)
    changes = [
        "encoder.point_range=[0, -6.4, -3, 25.6, 6.4, 2]",
        f"encoder.projection_scales={[2.0**r for r in range(scales)]}",
        f"backbone.widths={[8] * blocks}",
        f"backbone.layers={[2] * blocks}",
    ]
    config = load_config(CONFIGS / "demo.yaml", changes)
    model = HVNet(config)
    maps = model(some_points(), torch.zeros(500, dtype=torch.int64), 1)
    for k, of_class in enumerate(maps):
        assert of_class.logits.shape == (1, len(model.anchors(k)))


def test_papers_configuration_has_563200_anchors() -> None:
    config = load_config(CONFIGS / "hvnet.yaml")
    counts = {entry.name: len(make_anchors(config, entry)) for entry in config.head.classes}
    assert counts == {"Car": 51_200, "Pedestrian": 409_600, "Cyclist": 102_400}
    assert sum(counts.values()) == 563_200


def test_papers_numbers() -> None:
    """Section 4.1, number by number."""
    config = load_config(CONFIGS / "hvnet.yaml")
    assert config.encoder.point_range == (0, -32, -3, 64, 32, 2)
    assert config.encoder.voxel_size == (0.2, 0.2)
    assert config.encoder.feature_scales == (0.5, 1, 2)
    assert config.encoder.projection_scales == (1, 2, 4)
    assert (config.encoder.feature_channels, config.encoder.image_channels) == (64, 128)
    by_name = {entry.name: entry for entry in config.head.classes}
    sizes = {name: entry.anchor_sizes for name, entry in by_name.items()}
    assert sizes == {
        "Pedestrian": ((0.8, 0.8, 1.7),),
        "Cyclist": ((1.8, 0.8, 1.5),),
        "Car": ((3.5, 1.7, 1.56), (6.0, 2.0, 1.56)),
    }
    for name, positive, negative, alpha, nms in (
        ("Pedestrian", 0.35, 0.25, 0.75, 0.02),
        ("Cyclist", 0.35, 0.25, 0.75, 0.02),
        ("Car", 0.5, 0.35, 0.25, 0.4),
    ):
        entry = by_name[name]
        assert (entry.positive_iou, entry.negative_iou) == (positive, negative)
        assert (entry.focal_alpha, entry.focal_gamma, entry.nms_iou) == (alpha, 2, nms)
    assert config.head.score_threshold == 0.2
    assert not config.head.direction
    assert (config.loss.localization, config.loss.classification, config.loss.vertical) == (1, 1, 1.5)
    train = config.train
    assert (train.epochs, train.learning_rate, train.weight_decay) == (70, 2e-4, 1e-4)
    assert (train.warmup_steps, train.warmup_ratio) == (300, pytest.approx(1 / 3))
    assert (train.decay_epochs, train.decay_ratio) == ((40, 60), 0.1)
    augment = config.augment
    assert (augment.flip, augment.rotation, augment.scaling) == (0.5, pytest.approx(math.pi / 2), (0.95, 1.05))
    assert augment.translation == (0.2, 0.2, 0.2)
    assert augment.objects == {"Car": 15, "Pedestrian": 8, "Cyclist": 8}


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


def test_anchors_stand_at_cell_centres(demo: Config) -> None:
    entry = demo.head.classes[0]
    anchors = make_anchors(demo, entry)
    assert entry.level == 1
    expected = torch.tensor([[0.4, -2.8], [0.4, -2.0], [1.2, -2.8]])  # of the cells (0, 0), (0, 1) and (1, 0) of 0.8 m
    torch.testing.assert_close(anchors[[0, 4, 4 * 8], :2], expected)
    torch.testing.assert_close(anchors[:4, 6], torch.tensor([0, math.pi / 4, math.pi / 2, 3 * math.pi / 4]))
    assert (anchors[:, 2] == entry.anchor_z).all()


def test_anchor_rows_have_the_order_of_the_anchors() -> None:
    """A map that holds its own x, y and channel shows where each row comes from."""
    n_l, n_w, per_cell, values = 3, 5, 4, 2
    x, y, c = torch.meshgrid(torch.arange(n_l), torch.arange(n_w), torch.arange(per_cell * values), indexing="ij")
    output = (100 * x + 10 * y + c).permute(2, 0, 1)[None].float()
    rows = anchor_rows(output, values)[0]
    assert rows.shape == (n_l * n_w * per_cell, values)
    assert rows[(1 * n_w + 3) * per_cell + 2].tolist() == [100 + 30 + 4, 100 + 30 + 5]


def test_decode_is_the_inverse_of_encode() -> None:
    boxes, anchors = random_boxes(10_000).double(), random_boxes(10_000, seed=1).double()
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
    boxes, anchors = random_boxes(10_000).double(), random_boxes(10_000, seed=1).double()
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


def test_assign_targets_by_hand() -> None:
    anchors = torch.tensor([[x, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0] for x in (0.0, 1.0, 2.0, 10.0, 20.0)])
    boxes = torch.tensor([[0.4, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], [13.9, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    # IoU with box 0, shifted by d: (4 - d) / (4 + d): 0.818, 0.739, 0.429, 0, 0; box 1 overlaps only anchor 3: 0.013
    targets = assign_targets(anchors, [boxes, boxes[:0]], 0.75, 0.6)
    assert targets.positive.tolist() == [[True, False, False, True, False], [False] * 5]
    assert targets.negative.tolist() == [[False, False, True, False, True], [True] * 5]
    torch.testing.assert_close(targets.location, torch.tensor([[0.4, 0.0] * 4, [3.9, 0.0] * 4]))


def test_two_boxes_with_one_best_anchor() -> None:
    anchors = torch.tensor([[0.0, 0, 0, 4, 2, 1.5, 0], [50.0, 0, 0, 4, 2, 1.5, 0]])
    boxes = torch.tensor([[1.0, 0, 0, 4, 2, 1.5, 0], [0.5, 0, 0, 4, 2, 1.5, 0]])
    targets = assign_targets(anchors, [boxes], 0.9, 0.3)
    assert targets.positive.tolist() == [[True, False]]
    torch.testing.assert_close(targets.location, torch.tensor([[1.0, 0.0] * 4]))


def test_assign_targets_is_the_matrix_version(demo: Config) -> None:
    entry = demo.head.classes[0]
    anchors = make_anchors(demo, entry)
    boxes = random_boxes(6)
    boxes[:, :2] = torch.tensor([[2.0, 0.0], [4.0, 2.0], [8.0, -2.0], [10.0, 1.0], [6.0, 0.0], [11.0, -1.0]])
    targets = assign_targets(anchors, [boxes[:4], boxes[4:]], 0.5, 0.35)
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


def test_focal_loss_by_hand() -> None:
    logits = torch.tensor([[0.0, math.log(3), -math.log(3), 5.0]])  # p = 1/2, 3/4, 1/4, ignored
    positive = torch.tensor([[True, True, False, False]])
    negative = torch.tensor([[False, False, True, False]])
    expected = -0.25 * (0.5**2 * math.log(0.5) + 0.25**2 * math.log(0.75)) - 0.75 * 0.25**2 * math.log(0.75)
    assert focal_loss(logits, positive, negative, 0.25, 2.0).item() == pytest.approx(expected, rel=1e-6)


def test_class_loss_by_hand(demo: Config) -> None:
    entry = dataclasses.replace(demo.head.classes[0], focal_gamma=0.0, focal_alpha=0.5)
    anchors = torch.tensor([[0.0, 0, 0, 4, 2, 1.5, 0], [0.1, 0, 0, 4, 2, 1.5, 0], [50.0, 0, 0, 4, 2, 1.5, 0]])
    targets = assign_targets(anchors, [torch.tensor([[0.0, 0, 0.3, 4, 2, 1.5, 0]])], 0.5, 0.35)
    assert targets.positive.tolist() == [[True, True, False]]
    maps = HeadMaps(torch.zeros(1, 3), torch.zeros(1, 3, 8), torch.zeros(1, 3, 2), torch.zeros(1, 3, 2))
    terms = class_loss(maps, targets, entry, LossConfig())
    assert terms["classification"].item() == pytest.approx(3 * 0.5 * math.log(2) / 2)
    assert terms["localization"].item() == pytest.approx(4 * 0.5 * 0.1**2 / 2)  # four x offsets of -0.1 m
    assert terms["vertical"].item() == pytest.approx(1.5 * 2 * 0.5 * 0.2**2 / 2)
    assert terms["direction"].item() == pytest.approx(0.2 * math.log(2))
    terms = class_loss(maps, targets, entry, LossConfig(beta=0.05))  # from 0.05 on linear
    assert terms["localization"].item() == pytest.approx(4 * (0.1 - 0.025) / 2)
    assert terms["vertical"].item() == pytest.approx(1.5 * 2 * (0.2 - 0.025) / 2)


def test_loss_without_boxes_is_finite(demo: Config) -> None:
    model = HVNet(demo)
    maps = model(some_points(), torch.zeros(500, dtype=torch.int64), 1)
    terms = model.loss(maps, [torch.zeros(0, 7)], [torch.zeros(0, dtype=torch.int64)])
    loss = torch.stack(list(terms.values())).sum()
    loss.backward()
    assert loss.isfinite()
    assert terms["localization"] == 0


def by_score(found: Detections) -> Detections:
    order = found.scores.argsort(descending=True)
    return Detections(found.boxes[order], found.scores[order], found.labels[order])


def mirror(model: HVNet) -> HVNet:
    """The network that does to a scene mirrored in y what the model does to the scene: every weight has its image.

    Kernels are flipped. A convolution of stride 2 sees the inputs 2i - 1, 2i, 2i + 1, whose mirror image it cannot see:
    the model must not use the first of them.
    """
    image = copy.deepcopy(model)
    with torch.no_grad():
        for module in image.modules():
            if isinstance(module, torch.nn.Conv2d | torch.nn.ConvTranspose2d):
                module.weight.copy_(module.weight.flip(-1))
            if isinstance(module, torch.nn.Conv2d) and module.stride == (2, 2):
                module.weight.copy_(module.weight.roll(1, dims=-1))
        image.encoder.avfe.features.weight[:, 1] *= -1  # y of (x, y, z, f)
        for layer in (image.encoder.avfe, image.encoder.avfeo):
            layer.knowledge.weight[:, [1, 5]] *= -1  # y - mean y and mean y of Eq. 2
        for head in image.heads:
            mirror_channels(head.score, 1)
            mirror_channels(head.location, 8)
            mirror_channels(head.vertical, 2)
            if head.direction is not None:
                mirror_channels(head.direction, 2, is_direction=True)
    return image


def mirror_channels(conv: torch.nn.Conv2d, values: int, is_direction: bool = False) -> None:
    """Gives each anchor's channels to its mirror image.

    An anchor at 0 degrees is its own image, left and right corners swapped. At 90 degrees it is its own image turned by
    pi, one at 45 degrees is that of 135 degrees turned by pi: there front and rear corners swap, and the direction.
    """
    weight, bias = conv.weight.clone(), conv.bias.clone()
    for orientation, partner in enumerate((0, 3, 2, 1)):
        for value in range(values):
            sign, source = 1.0, value
            if values == 8:
                corner = (3, 2, 1, 0) if orientation else (1, 0, 3, 2)
                source = 2 * corner[value // 2] + value % 2
                sign = -1.0 if value % 2 else 1.0  # of y
            elif is_direction and orientation:
                source = 1 - value
            conv.weight[orientation * values + value] = sign * weight[partner * values + source]
            conv.bias[orientation * values + value] = sign * bias[partner * values + source]


@pytest.mark.parametrize("direction", [True, False])
def test_flipped_scene_gives_flipped_detections(demo: Config, direction: bool) -> None:
    torch.manual_seed(0)
    config = dataclasses.replace(
        demo, head=dataclasses.replace(demo.head, direction=direction, score_threshold=0.012, candidates=300)
    )
    model = HVNet(config)
    for head in model.heads:
        torch.nn.init.normal_(head.score.weight, std=0.05)
    for module in model.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            module.momentum = 1.0  # one pass gives the statistics, so that the signal reaches the heads
        if isinstance(module, torch.nn.Conv2d) and module.stride == (2, 2):
            torch.nn.init.zeros_(module.weight[..., 0])
    points = some_points(800)
    model(points, torch.zeros(800, dtype=torch.int64), 1)
    sample = torch.zeros(800, dtype=torch.int64)
    found = by_score(model.eval().detect(points, sample, 1)[0])
    flipped = points * torch.tensor([1.0, -1.0, 1.0, 1.0])
    other = by_score(mirror(model).eval().detect(flipped, sample, 1)[0])
    assert len(found.boxes) > 10
    torch.testing.assert_close(found.scores, other.scores, rtol=1e-4, atol=1e-6)
    assert torch.equal(found.labels, other.labels)
    same = [0, 2, 3, 4, 5]
    torch.testing.assert_close(found.boxes[:, same], other.boxes[:, same], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(found.boxes[:, 1], -other.boxes[:, 1], rtol=1e-3, atol=1e-3)
    turn = found.boxes[:, 6] + other.boxes[:, 6]
    assert (torch.sin(turn).abs() < 2e-3).all()
    if direction:
        assert (torch.cos(turn) > 0.99).all()


def test_detections_are_the_best_after_nms(demo: Config) -> None:
    model = HVNet(dataclasses.replace(demo, head=dataclasses.replace(demo.head, score_threshold=0.0, detections=7)))
    model.eval()
    found = model.detect(some_points(), torch.arange(500) % 3, 3)
    assert len(found) == 3
    for one in found:
        for k, entry in enumerate(demo.head.classes):
            own = one.boxes[one.labels == k]
            scores = one.scores[one.labels == k]
            assert 0 < len(own) <= 7
            assert (scores.diff() <= 0).all()
            iou = reference.rotated_iou_bev(own.double(), own.double())
            assert (iou - torch.eye(len(own)) <= entry.nms_iou + 1e-5).all()


def test_batch_of_samples_is_each_alone(demo: Config) -> None:
    model = HVNet(demo).eval()
    points, sample = some_points(), (torch.arange(500) * 3) // 500
    with torch.no_grad():
        together = model(points, sample, 3)
        for b in range(3):
            own = points[sample == b]
            alone = model(own, torch.zeros(len(own), dtype=torch.int64), 1)
            for a, t in zip(alone, together, strict=True):
                torch.testing.assert_close(a.logits[0], t.logits[b], rtol=1e-4, atol=1e-4)
                torch.testing.assert_close(a.location[0], t.location[b], rtol=1e-4, atol=1e-4)
