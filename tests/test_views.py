"""Views of a cloud, and the boxes of several as one."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

import hvnet
from hvnet.config import Config
from hvnet.data.frame import Frame
from hvnet.data.kitti import read_frame
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.detector import Detector, Move
from hvnet.network.model import Detections
from hvnet.network.views import AUGMENTED, View, fuse
from tests.models import lively, some_points

CPU = torch.device("cpu")
MIRROR = torch.tensor([1.0, -1, 1, 1, 1, 1, -1])
RANGE = (0.0, -32.0, -3.0, 64.0, 32.0, 2.0)
TWO = (View(0.0), View(0.0))
"""The same view twice, so that a table may hold boxes as they are."""
both_ways = pytest.mark.usefixtures("threads")


@pytest.mark.parametrize(
    ("view", "box", "seen"),
    [
        (View(0.0), (3, 1, -1, 4, 2, 1, 0.5), (3, 1)),
        (View(math.pi / 2), (3, 1, -1, 4, 2, 1, 0.5), (-1, 3)),
        (View(0.0, mirrored=True), (3, 1, -1, 4, 2, 1, 0.5), (3, -1)),
        (View(math.pi / 2, mirrored=True), (3, 1, -1, 4, 2, 1, 0.5), (-1, -3)),
        (View(math.pi / 2, mirrored=True), (3, 1, -1, 4, 2, 1, -3.0), (-1, -3)),
    ],
)
def test_a_view(view: View, box: tuple[float, ...], seen: tuple[float, float]) -> None:
    """First turned, then mirrored; a box that is seen so is taken back."""
    boxes = torch.tensor([box])
    found = view.see(boxes)
    torch.testing.assert_close(found[0, :2], torch.tensor(seen, dtype=torch.float32))
    found = found.clone()
    found[:, 6] = (found[:, 6] + view.angle) * (-1 if view.mirrored else 1)
    torch.testing.assert_close(view.take_back(found), boxes)


def test_the_views_are_those_of_the_mirrored_cloud() -> None:
    points = some_points(50)
    seen = [view.see(points) for view in AUGMENTED]
    for view in AUGMENTED:
        mirrored = view.see(points * MIRROR[:4])
        assert sum(torch.equal(mirrored, each) for each in seen) == 1


def table(*rows: tuple[float, float, float, float, int]) -> Detections:
    """Cars of 4 m by 2 m at (x, y), with yaw, score and label."""
    x, y, yaw, scores, labels = torch.tensor(rows).reshape(-1, 5).T
    ones = torch.ones_like(x)
    return Detections(torch.stack((x, y, -ones, 4 * ones, 2 * ones, 1.5 * ones, yaw), dim=1), scores, labels.long())


@pytest.mark.parametrize(
    ("one", "other", "wanted"),
    [
        # weighted by the scores; the score is the mean
        ([(10, 0, 0, 0.6, 0)], [(11, 0, 0, 0.2, 0)], [(10.25, 0, 0, 0.4, 0)]),
        # found in one view alone: half the score, and nothing below the threshold of 0.1
        ([(10, 0, 0, 0.6, 0)], [], [(10, 0, 0, 0.3, 0)]),
        ([(10, 0, 0, 0.18, 0)], [], []),
        ([], [], []),
        # classes are apart, and the best of a class comes first
        (
            [(10, 0, 0, 0.6, 1), (30, 0, 0, 0.2, 0)],
            [(10, 0, 0, 0.8, 0), (30, 0, 0, 0.8, 0)],
            [(30, 0, 0, 0.5, 0), (10, 0, 0, 0.4, 0), (10, 0, 0, 0.3, 1)],
        ),
        # of two boxes in one view that the other view joins, the better one counts
        (
            [(10, -0.95, 0, 0.4, 0), (10, 0.95, 0, 0.3, 0)],
            [(10, 0, 0, 0.5, 0)],
            [(10, (0.95 * 0.3 - 0.95 * 0.4) / 1.2, 0, 0.45, 0)],
        ),
        # a mean across the border of the angles, and headings that disagree
        ([(10, 0, 3.1, 0.5, 0)], [(10, 0, -3.1, 0.5, 0)], [(10, 0, -math.pi, 0.5, 0)]),
        ([(10, 0, 0.1, 0.4, 0)], [(10, 0, 0.2 - math.pi, 0.6, 0)], [(10, 0, 0.16 - math.pi, 0.5, 0)]),
    ],
)
def test_fused_boxes(demo: Config, one: list, other: list, wanted: list) -> None:
    found, want = fuse([table(*one), table(*other)], TWO, demo.head, RANGE), table(*wanted)
    assert torch.equal(found.labels, want.labels)
    torch.testing.assert_close(found.scores, want.scores)
    torch.testing.assert_close(found.boxes[:, :6], want.boxes[:, :6])
    assert ((found.boxes[:, 6] - want.boxes[:, 6]).cos() > 1 - 1e-6).all()


def test_a_view_that_has_a_place_out_of_range_does_not_count(demo: Config) -> None:
    box = table((20, 31, 0, 0.6, 0))
    away = View(0.3)  # turned out of the range to the left
    for views, wanted in (((View(0.0), away), 0.6), ((View(0.0), View(-0.3)), 0.3)):
        assert fuse([box, table()], views, demo.head, RANGE).scores.tolist() == pytest.approx([wanted])


def test_no_more_than_the_detections_are_reported(demo: Config) -> None:
    many = table(*((6.0 * k, 0, 0, 0.2 + 0.1 * k, 0) for k in range(5)))
    head = dataclasses.replace(demo.head, detections=2)
    assert fuse([many, many], TWO, head, RANGE).scores.tolist() == pytest.approx([0.6, 0.5])


@pytest.fixture(scope="module")
def frame(kitti_root: Path) -> Frame:
    return read_frame(kitti_root, "000008")


@pytest.fixture(scope="module")
def street(frame: Frame) -> Tensor:
    return frame.points


@both_ways
def test_a_mirrored_cloud_gives_the_mirrored_boxes(street: Tensor) -> None:
    detector = hvnet.load(device="cpu", tta=True)
    found, want = detector(street * MIRROR[:4]), detector(street)
    assert len(want.boxes) > 5
    assert torch.equal(found.labels, want.labels)
    torch.testing.assert_close(found.scores, want.scores, rtol=0, atol=1e-3)
    torch.testing.assert_close((found.boxes * MIRROR)[:, :6], want.boxes[:, :6], rtol=0, atol=1e-2)
    assert ((found.boxes * MIRROR - want.boxes)[:, 6].cos() > 1 - 1e-3).all()
    plain = hvnet.load(device="cpu")
    one, other = plain(street * MIRROR[:4]), plain(street)
    assert not torch.allclose(one.scores[:5], other.scores[:5], rtol=0, atol=1e-3)  # which holds by itself


@both_ways
def test_the_same_cars_are_found(frame: Frame, street: Tensor) -> None:
    """Turned, at another height, all round and with others, too; each object once.

    What one view takes for a car, and is none, the others need not find: only cars that are labelled count.

    Found means an overlap of 0.5, as on the clouds of other sensors: turned by 10 degrees, a car that the
    sensor sees from beside, at 4 m, has another length.
    """
    want = hvnet.load(device="cpu")(street)
    is_car = rotated_iou_bev(want.boxes, frame.boxes_of(["Car"])).amax(dim=1) > 0.5
    sure = want.select((want.scores > 0.5) & (want.labels == 0) & is_car)
    assert len(sure.boxes) >= 3
    raised = street + torch.tensor([0, 0, 1.33, 0])
    for options in ({}, {"all_round": True, "turn": 10.0}):
        detector = hvnet.load(device="cpu", tta=True, **options)  # type: ignore[arg-type]
        assert len(detector.views) == 4 * len(detector.turns)
        alone = detector(street)
        low, high = detector.batch([street, raised])
        torch.testing.assert_close(low.scores, alone.scores, rtol=0, atol=1e-3)
        for found, height in ((low, 0.0), (high, 1.33)):
            cars = found.select(found.labels == 0)
            iou = rotated_iou_bev(sure.boxes, cars.boxes)
            assert (iou.amax(dim=1) > 0.5).all()
            own = cars.boxes[iou.argmax(dim=1)]
            torch.testing.assert_close(own[:, 2], sure.boxes[:, 2] + height, rtol=0, atol=0.3)
            iou = rotated_iou_bev(cars.boxes, cars.boxes).fill_diagonal_(0)
            assert iou.max() <= detector.entries[0].nms_iou + 1e-6


@both_ways
@pytest.mark.parametrize("points", [torch.zeros(0, 4), torch.tensor([[5.0, 0, -1, 0]]), torch.full((3, 4), math.nan)])
def test_any_cloud(demo: Config, points: Tensor) -> None:
    found = Detector(lively(demo), CPU, tta=True)(points)
    assert found.boxes.shape == (len(found.scores), 7)


@both_ways
def test_without_it_a_detector_has_one_view(demo: Config) -> None:
    """The untouched cloud, and the boxes as NMS leaves them: no bit is changed."""
    detector = Detector(lively(demo, score_threshold=0.02), CPU, torch.float32)
    points = some_points()
    assert detector.views == [View(0.0)]
    assert torch.equal(detector.place(points).clouds[0], points)
    found = Detections(torch.rand(3, 7), torch.rand(3), torch.zeros(3).long())
    assert detector.take_back([found], Move(0.0, 0.0, None)) is found
