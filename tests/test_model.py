"""The whole network: shapes of every stage, the paper's numbers, mirrored scenes, batches."""

import copy
import dataclasses
import math

import pytest
import torch

from hvnet.config import Config, load_config
from hvnet.kernels import reference
from hvnet.network.anchors import make_anchors
from hvnet.network.model import Detections, HVNet
from tests.models import CONFIGS, some_points


def test_shapes_of_every_stage(demo: Config) -> None:
    model = HVNet(demo)
    points, sample = some_points(), torch.arange(500) % 2
    images = model.encoder(points, sample, 2)
    assert [i.shape for i in images] == [(2, 32, 32, 16), (2, 32, 16, 8), (2, 32, 8, 4)]
    stream = model.backbone.main_stream(images)
    assert [b.shape for b in stream] == [(2, 16, 32, 16), (2, 32, 16, 8), (2, 64, 8, 4)]
    levels = model.backbone.pyramid(stream)
    assert [level.shape for level in levels] == [(2, 32, 32, 16), (2, 32, 16, 8), (2, 32, 8, 4)]
    maps = model.maps(points, sample, 2)
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
    maps = model.maps(some_points(), torch.zeros(500, dtype=torch.int64), 1)
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
    model.maps(points, torch.zeros(800, dtype=torch.int64), 1)
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
        together = model.maps(points, sample, 3)
        for b in range(3):
            own = points[sample == b]
            alone = model.maps(own, torch.zeros(len(own), dtype=torch.int64), 1)
            for a, t in zip(alone, together, strict=True):
                torch.testing.assert_close(a.logits[0], t.logits[b], rtol=1e-4, atol=1e-4)
                torch.testing.assert_close(a.location[0], t.location[b], rtol=1e-4, atol=1e-4)
