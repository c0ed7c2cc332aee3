"""Labels of generated scenes: they agree with the points, the geometry and what the camera sees."""

import math

import numpy as np
import pytest
import torch

from hvnet.boxes import box_corners, points_in_boxes
from hvnet.data.frame import IMAGE_SIZE
from hvnet.data.kitti import boxes_to_lidar
from hvnet.data.labels import DONTCARE
from hvnet.data.scenes import shapes
from hvnet.data.scenes.files import CAMERA, MIN_POINTS, make_labels, truncation
from hvnet.data.scenes.scanner import Scan
from hvnet.data.scenes.shapes import Material
from hvnet.data.scenes.street import assemble
from tests.scenes import FRAMES, car_at, scan_of, some_frames


def test_labelled_objects_have_points_of_their_own_in_their_boxes() -> None:
    own, inside = 0, 0
    for scene, measured, labels in some_frames():
        rows = labels.select(labels.name != DONTCARE)
        boxes = boxes_to_lidar(rows, CAMERA)
        roomy = boxes + np.array([0, 0, 0, 0.1, 0.1, 0.1, 0])  # for the noise of the range
        points = torch.from_numpy(measured.points).double()
        in_box = points_in_boxes(points, torch.from_numpy(roomy)).numpy()  # (N, M)
        for k, box in enumerate(boxes):
            within = in_box[:, k]
            which = int(np.linalg.norm(scene.boxes[:, :3] - box[:3], axis=1).argmin())
            assert rows.name[k] == scene.names[which]
            assert measured.hits[which] >= MIN_POINTS
            assert (measured.owner[within] == which).sum() > 0.9 * measured.hits[which]
            above = within & (measured.points[:, 2] > box[2] - box[5] / 2 + 0.25)  # not the ground
            own += int((measured.owner[above] == which).sum())
            inside += int(above.sum())
    assert own > 0.95 * inside


def test_2d_boxes_enclose_the_projected_corners() -> None:
    checked = 0
    for _, _, labels in some_frames():
        rows = labels.select((labels.name != DONTCARE) & (labels.truncation == 0))
        corners = box_corners(torch.from_numpy(boxes_to_lidar(rows, CAMERA))).numpy()  # (M, 8, 3)
        for bbox, corner in zip(rows.bbox, corners, strict=True):
            pixels, depth = CAMERA.project(corner)
            assert (depth > 0).all()
            expected = np.concatenate((pixels.min(axis=0), pixels.max(axis=0)))
            np.testing.assert_allclose(bbox, expected.clip(0, np.tile(np.array(IMAGE_SIZE) - 1, 2)), atol=0.1)
            checked += 1
    assert checked > 3 * FRAMES


def test_labels_are_within_their_ranges() -> None:
    for _, _, labels in some_frames():
        rows = labels.select(labels.name != DONTCARE)
        assert ((rows.truncation >= 0) & (rows.truncation <= 1)).all()
        assert np.isin(rows.occlusion, (0, 1, 2, 3)).all()
        np.testing.assert_allclose(
            np.cos(rows.alpha), np.cos(rows.rotation_y - np.arctan2(rows.location[:, 0], rows.location[:, 2]))
        )
        assert (np.abs(rows.alpha) <= math.pi).all()
        assert (rows.location[:, 2] > 0).all()


def test_a_free_car_is_neither_occluded_nor_truncated() -> None:
    measured, labels = scan_of(car_at(15.0, 1.0, 0.3))
    assert measured.hidden[0] == 0
    assert (labels.name.tolist(), labels.occlusion.tolist(), labels.truncation.tolist()) == (["Car"], [0], [0.0])


@pytest.mark.parametrize(("share", "occlusion"), [(0.08, 0), (0.3, 1), (0.7, 2), (0.93, 3)])
def test_a_wall_before_a_car_occludes_it(share: float, occlusion: int) -> None:
    """A post at x = 4.9 m hides this share of the car's rear, 1.7 m wide at 13 m, from the left side on."""
    width, left = share * 1.7 * 4.9 / 13, 0.85 * 4.9 / 13
    post = shapes.block((0.01, width + 0.1, 6), (4.905, left - width / 2 + 0.05, 0), Material.STONE)
    measured, labels = scan_of(car_at(15.0, 0.0), background=(post,))
    assert abs(measured.hidden[0] - share) < 0.05
    assert labels.occlusion.tolist() == [occlusion]


def test_a_hidden_car_is_not_labelled() -> None:
    wall = shapes.block((0.2, 6, 6), (8, 0, 0), Material.STONE)
    measured, labels = scan_of(car_at(15.0, 0.0), background=(wall,))
    assert measured.hidden[0] == 1
    assert measured.hits[0] == 0
    assert len(labels) == 0


def test_a_car_that_can_be_seen_with_too_few_points_is_a_dont_care_region() -> None:
    scene = assemble([], [car_at(30.0, 0.0)])
    measured = Scan(np.zeros((0, 4), np.float32), np.zeros(0, np.int64), np.array([0.2]), np.array([4]))
    labels = make_labels(scene, measured)
    assert labels.name.tolist() == [DONTCARE]
    assert (labels.bbox[:, 2:] > labels.bbox[:, :2]).all()
    assert (labels.truncation[0], labels.occlusion[0], labels.location[0, 0]) == (-1, -1, -1000)


def test_a_car_across_the_edge_of_the_image_is_truncated() -> None:
    # the left edge of the image is 40.2 degrees to the left: at x = 10 m, y = 8.45 m
    _, labels = scan_of(car_at(10.0, 8.45, math.pi / 2))
    assert 0.3 < labels.truncation[0] < 0.7
    assert labels.bbox[0, 0] == 0
    shares = truncation(np.array([[10, y, -0.98, 4, 1.7, 1.5, 0] for y in (0, 6, 8, 9, 30)], dtype=float))
    assert (np.diff(shares) >= 0).all()
    assert shares[0] == 0
    assert shares[-1] == 1


def test_a_car_outside_the_image_is_not_labelled() -> None:
    measured, labels = scan_of(car_at(10.0, 11.0))
    assert measured.hits[0] > 100
    assert len(labels) == 0
