"""What a detector gets wrong in labelled frames: objects that it misses, and boxes where nothing is labelled."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hvnet.boxes import indices_in_boxes
from hvnet.data.frame import Frame
from hvnet.data.kitti import frame_labels
from hvnet.data.labels import DONTCARE
from hvnet.evaluation.rules import Rule
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.model import Detections

MISS, FALSE_POSITIVE = "miss", "false positive"


class Mistake(NamedTuple):
    """A labelled box that is not found, or a detection without an object."""

    frame: str
    kind: str  # MISS or FALSE_POSITIVE
    name: str  # the class
    box: Tensor  # (7,) float32, LiDAR axes
    score: float  # of the detection; for a miss: of the best-overlapping detection of its class, or 0
    distance: float  # of the box's centre from the LiDAR on the ground, in metres
    points: int  # of the frame's cloud, inside the box
    overlap: float  # best BEV IoU with a detection (for a miss) or a label (for a false positive) of the class


class Verdicts(NamedTuple):
    """Which detections (M,) in a labelled frame are right and which are wrong. The others are not scored."""

    right: Tensor  # (M,) bool
    wrong: Tensor  # (M,) bool
    overlaps: Tensor  # (M,) best BEV IoU with a label of the class


def judge(frame: Frame, detections: Detections, rules: Mapping[str, Rule]) -> Verdicts:
    """Which detections in a labelled frame are right: they reach the BEV IoU of their class's rule with a label of it.

    `rules` are those of the classes, in the order that the detections' labels (M,) number.

    The others are wrong, unless KITTI does not score them: where a Van is under a Car or a Person_sitting under a
    Pedestrian, where more than half of the 2D box is in a DontCare region, or where none of it is in the image.

    Raises ValueError for a frame without labels.
    """
    labels, unscored = frame_labels(frame), torch.zeros(len(detections.boxes), dtype=torch.bool)
    if frame.camera is not None:
        bbox, visible = frame.camera.project_boxes(detections.boxes.double().numpy())
        regions = labels.bbox[labels.name == DONTCARE]
        unscored = torch.from_numpy(~visible | (_largest_share(bbox, regions) > 0.5))
    right, overlaps = torch.zeros_like(unscored), torch.zeros(len(unscored))
    for label, (name, rule) in enumerate(rules.items()):
        own, enough = detections.labels == label, rule.strict["bev"]
        boxes = detections.boxes[own]
        overlaps[own], _ = _largest(rotated_iou_bev(frame.boxes_of([name]), boxes), dim=0)
        right[own] = overlaps[own] >= enough
        if rule.neighbour is not None and rule.neighbour not in rules:
            near, _ = _largest(rotated_iou_bev(frame.boxes_of([rule.neighbour]), boxes), dim=0)
            unscored[own] |= near >= enough
    return Verdicts(right, ~right & ~unscored, overlaps)


def find_mistakes(frame: Frame, detections: Detections, rules: Mapping[str, Rule], min_score: float) -> list[Mistake]:
    """The mistakes of the detections in a labelled frame, misses first, class by class.

    `rules` are those of the classes, in the order that the detections' labels (M,) number.

    A labelled box of one of the classes is missed if no detection of its class with score >= min_score reaches the BEV
    IoU of the class's rule. A miss with an overlap above it was found, with a lower score. Where there is a camera, a
    box with nothing in the image is no miss, as `frame_labels` leaves it out.

    A detection with score >= min_score is a false positive if it is wrong by `judge`.
    """
    verdicts, counts = judge(frame, detections, rules), detections.scores >= min_score
    objects = frame.objects
    assert objects is not None
    in_image = torch.ones(len(objects.boxes), dtype=torch.bool)
    if frame.camera is not None and objects.labels is None:
        in_image = torch.from_numpy(frame.camera.project_boxes(objects.boxes.double().numpy())[1])
    found: dict[str, list[Mistake]] = {MISS: [], FALSE_POSITIVE: []}

    def note(kind: str, name: str, boxes: Tensor, scores: Tensor, overlaps: Tensor) -> None:
        points = [len(inside) for inside in indices_in_boxes(frame.points, boxes)]
        distances = torch.linalg.vector_norm(boxes[:, :2], dim=1)
        rows = zip(boxes, scores.tolist(), distances.tolist(), points, overlaps.tolist(), strict=True)
        found[kind] += [Mistake(frame.name, kind, name, *row) for row in rows]

    for label, (name, rule) in enumerate(rules.items()):
        own = detections.labels == label
        scores = detections.scores[own]
        of_class = torch.tensor([each == name for each in objects.names], dtype=torch.bool)
        truth = objects.boxes[of_class]
        iou = rotated_iou_bev(truth, detections.boxes[own])  # (T, M_own)

        missed = (_largest(iou[:, counts[own]], dim=1)[0] < rule.strict["bev"]) & in_image[of_class]
        overlaps, best = _largest(iou, dim=1)
        score_of_best = torch.where(overlaps > 0, scores[best] if len(scores) else 0.0, 0.0)
        note(MISS, name, truth[missed], score_of_best[missed], overlaps[missed])

        wrong = own & counts & verdicts.wrong
        note(FALSE_POSITIVE, name, detections.boxes[wrong], detections.scores[wrong], verdicts.overlaps[wrong])
    return found[MISS] + found[FALSE_POSITIVE]


def worst(mistakes: Iterable[Mistake], count: int) -> tuple[list[Mistake], list[Mistake]]:
    """The first `count` misses, those with the most points in the box first, and false positives, best score first."""
    both = list(mistakes)
    misses = sorted((each for each in both if each.kind == MISS), key=lambda each: -each.points)
    false_positives = sorted((each for each in both if each.kind == FALSE_POSITIVE), key=lambda each: -each.score)
    return misses[:count], false_positives[:count]


def _largest(iou: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """The largest value along a dimension and its index, both 0 where that dimension is empty."""
    if iou.shape[dim]:
        values, at = iou.max(dim=dim)
        return values, at
    none = iou.sum(dim=dim)
    return none, none.long()


def _largest_share(bbox: NDArray[np.float64], regions: NDArray[np.float64]) -> NDArray[np.float64]:
    """The largest share of each 2D box (M, 4) that lies in one of the regions (R, 4): (M,)."""
    size = np.minimum(bbox[:, None, 2:], regions[:, 2:]) - np.maximum(bbox[:, None, :2], regions[:, :2])  # (M, R, 2)
    area = (bbox[:, 2:] - bbox[:, :2]).prod(axis=1)
    return size.clip(min=0).prod(axis=2).max(axis=1, initial=0) / np.where(area > 0, area, 1)
