"""The scenes: objects of the right sizes that stand on the ground and keep apart."""

import math

import numpy as np
import torch

from hvnet.boxes import boxes_collide
from hvnet.data.scenes import shapes
from hvnet.data.scenes.street import SIZES, _size
from hvnet.kernels.raycast import raycast
from tests.scenes import FRAMES, some_frames


def test_boxes_enclose_their_meshes_tightly() -> None:
    for scene, _, _ in some_frames():
        for k, box in enumerate(scene.boxes):
            offset = scene.vertices[np.unique(scene.faces[scene.owner == k])] - box[:3]
            cos, sin = math.cos(box[6]), math.sin(box[6])
            local = offset @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
            np.testing.assert_allclose(local.max(axis=0), box[3:6] / 2, atol=1e-6)
            np.testing.assert_allclose(local.min(axis=0), -box[3:6] / 2, atol=1e-6)


def test_the_front_of_a_car_is_lower_than_its_rear_half() -> None:
    for style in shapes.CAR_STYLES:
        vertices = shapes.car(style).vertices
        assert vertices[vertices[:, 0] > 0.3, 2].max() < 0.75
        assert vertices[np.abs(vertices[:, 0] + 0.15) < 0.2, 2].max() > 0.9


def test_objects_do_not_overlap() -> None:
    for scene, _, _ in some_frames():
        boxes = torch.from_numpy(scene.boxes)
        assert boxes_collide(boxes, boxes).equal(torch.eye(len(boxes), dtype=torch.bool))


def test_objects_stand_on_the_ground() -> None:
    """Rays straight down from the middle of each object to what belongs to no object."""
    for scene, _, _ in some_frames():
        start = torch.from_numpy(scene.boxes[:, :3]).float()
        down = torch.tensor([[0.0, 0, -1]]).expand(len(start), 3)
        ground = torch.from_numpy(scene.faces[scene.owner < 0])
        distance, _, _ = raycast(torch.from_numpy(scene.vertices).float(), ground, start, down, 10.0)
        np.testing.assert_allclose(distance.numpy(), scene.boxes[:, 5] / 2, atol=0.1)


def test_sizes_follow_the_statistics() -> None:
    rng = np.random.default_rng(0)
    for name, (mean, deviation, _) in SIZES.items():
        sizes = np.array([_size(rng, name) for _ in range(500)])
        np.testing.assert_allclose(sizes.mean(axis=0), mean, atol=0.2 * max(deviation))
        np.testing.assert_allclose(sizes.std(axis=0), deviation, rtol=0.2)
        assert sizes.min() > 0.1


def test_every_class_and_both_directions_appear() -> None:
    names = np.concatenate([labels.name for _, _, labels in some_frames()])
    assert (names == "Car").sum() >= 3 * FRAMES
    assert (names == "Pedestrian").sum() >= FRAMES
    assert (names == "Cyclist").sum() >= FRAMES / 2
    assert (names == "Van").any()
    yaws = np.concatenate([scene.boxes[[name == "Car" for name in scene.names], 6] for scene, _, _ in some_frames()])
    assert (np.abs(yaws) < 0.6).mean() > 0.2  # as the sensor
    assert (np.abs(yaws) > math.pi - 0.6).mean() > 0.2  # oncoming
