"""Rows of label files: those that are picked, put together, and what is worked out of them."""

import numpy as np
import pytest

from hvnet.data.kitti import boxes_to_labels
from hvnet.data.labels import Labels, concatenate, no_results

BOXES = np.array([[10.0, 1.0, -1.0, 4.0, 1.6, 1.5, 0.3], [-9.0, -3.0, -0.9, 0.8, 0.7, 1.7, -2.0]])


def some_labels(scores: list[float] | None = None) -> Labels:
    return boxes_to_labels(BOXES, ["Car", "traffic_cone"], None, None if scores is None else np.array(scores))


def test_select_takes_masks_and_indices() -> None:
    labels = some_labels([0.5, 0.25])
    for rows in (np.array([False, True]), np.array([1])):
        second = labels.select(rows)
        assert second.name.tolist() == ["traffic_cone"]
        assert second.bbox.shape == (1, 4)
        assert second.score is not None
        assert second.score.tolist() == [0.25]
    assert some_labels().select(np.array([1, 0])).name.tolist() == ["traffic_cone", "Car"]
    assert some_labels().select(np.array([1])).score is None
    assert len(labels.select(np.zeros(0, np.int64))) == 0


def test_concatenate() -> None:
    both = concatenate([some_labels([0.5, 0.25]), no_results(), some_labels([1.0, 0.0])])
    assert both.name.tolist() == ["Car", "traffic_cone"] * 2
    assert both.score is not None
    assert both.score.tolist() == [0.5, 0.25, 1, 0]
    np.testing.assert_array_equal(both.location[2:], both.location[:2])
    assert concatenate([some_labels(), no_results()]).score is None  # not all have them


def test_no_results() -> None:
    nothing = no_results()
    assert len(nothing) == 0
    assert nothing.bbox.shape == (0, 4)
    assert nothing.dimensions.shape == nothing.location.shape == (0, 3)
    assert nothing.score is not None
    assert nothing.bev_boxes().shape == (0, 7)


def test_boxes_for_overlaps() -> None:
    """The camera's x and z, and the height counted downwards; turning from z to x is from x to -z."""
    labels = some_labels()
    boxes, (top, bottom) = labels.bev_boxes(), labels.vertical()
    np.testing.assert_allclose(boxes[:, :2], [[-1, 10], [3, -9]], atol=1e-12)  # right, ahead
    np.testing.assert_allclose(boxes[:, 2], [1.0, 0.9])  # below the sensor
    np.testing.assert_allclose(boxes[:, 3:6], BOXES[:, 3:6])
    np.testing.assert_allclose(boxes[:, 6], -labels.rotation_y)
    np.testing.assert_allclose(top, [1 - 0.75, 0.9 - 0.85])
    np.testing.assert_allclose(bottom, [1 + 0.75, 0.9 + 0.85])
    assert labels.ground_distance() == pytest.approx(np.hypot(BOXES[:, 0], BOXES[:, 1]))
