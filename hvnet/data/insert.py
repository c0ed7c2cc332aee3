"""Ground-truth sampling (SECOND, Yan et al., 2018): objects of other frames are inserted into a frame.

Points (N, 4) and boxes (M, 7) are in LiDAR axes. Nothing is changed in place, and every random number comes from the
generator that is passed in.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from hvnet.boxes import boxes_collide, points_in_boxes
from hvnet.data.gt_database import Database, object_points
from hvnet.data.occlusion import hidden, rays_to
from hvnet.kernels.launch import many_threads

MIN_POINTS = 5
"""Objects of fewer points are not inserted, as in SECOND."""


class TrainingFrame(NamedTuple):
    """A frame as training reads it. All but the points is on the host."""

    points: Tensor  # (N, 4), on the GPU when training on one
    boxes: Tensor  # (M, 7)
    labels: Tensor  # (M,) int64, index into the config's classes, or -1
    obstacles: Tensor | None = None  # (S, 3) of `nearest_points`, if inserted objects hide and are hidden
    note: str = ""
    name: str = ""


class ObjectSampler(NamedTuple):
    """A ground-truth database that is ready to draw from."""

    database: Database
    points: Tensor  # (M, 4) of all objects
    of_class: dict[str, np.ndarray]  # rows of each class that `sample_objects` draws from
    of_frame: list[np.ndarray]  # rows of each frame that `sample_frame` inserts


def sampler_of(database: Database) -> ObjectSampler:
    """The database with its points, and its rows by class and by frame."""
    has_points = np.diff(database.offsets) >= MIN_POINTS
    # rated by KITTI: easy, moderate or hard; SECOND leaves out the others. Without a camera there are no heights
    high = (database.bbox_height > 25) | (not database.bbox_height.any())
    rated = high & (database.occlusion <= 2) & (database.truncation <= 0.5)
    of_class = {str(n): np.flatnonzero(rated & has_points & (database.name == n)) for n in np.unique(database.name)}
    by_frame = np.argsort(database.frame, kind="stable")
    _, starts = np.unique(database.frame[by_frame], return_index=True)
    of_frame = [rows[has_points[rows]] for rows in np.split(by_frame, starts[1:])]
    return ObjectSampler(database, object_points(database), of_class, of_frame)


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """A tensor of the host on a device. For a GPU it is copied from pinned memory, so that the host does not wait."""
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def drop(points: Tensor, gone: Tensor) -> Tensor:
    """The points (N, 4) without those of a mask (N,).

    Many threads, which read no number from the device, leave rows of NaN for them: such points are in no voxel.
    """
    if many_threads(points.device):
        return points.masked_fill(gone[:, None], math.nan)
    return points[~gone]


def sample_objects(
    frame: TrainingFrame,
    objects: ObjectSampler,
    counts: Mapping[str, int],
    generator: Generator,
    classes: Sequence[str],
    ground: float | None = None,
) -> TrainingFrame:
    """Ground-truth sampling of SECOND: inserts objects of other frames at their original positions.

    The frame's labels number `classes`; boxes of any other number only block their place. For each class in `counts`,
    objects are drawn without replacement until the frame has that many of them.
    """
    drawn: list[np.ndarray] = [np.empty(0, np.int64)]
    drawn_labels: list[int] = []
    for name, count in counts.items():
        label = classes.index(name)
        missing = max(0, count - int((frame.labels == label).sum()))
        known = objects.of_class.get(name, drawn[0])
        picked = torch.randperm(len(known), generator=generator)[:missing].numpy()
        drawn.append(known[picked])
        drawn_labels += [label] * len(picked)
    return _insert(frame, objects, np.concatenate(drawn), drawn_labels, ground)


def sample_frame(
    frame: TrainingFrame,
    objects: ObjectSampler,
    generator: Generator,
    classes: Sequence[str],
    ground: float | None = None,
) -> TrainingFrame:
    """Inserts all objects of one frame of the database.

    They keep their arrangement: a queue at a light, cars along a kerb. Those of other classes have label -1.
    """
    drawn = objects.of_frame[int(torch.randint(len(objects.of_frame), (), generator=generator))]
    drawn_labels = [classes.index(name) if name in classes else -1 for name in objects.database.name[drawn]]
    return _insert(frame, objects, drawn, drawn_labels, ground)


def _insert(
    frame: TrainingFrame,
    objects: ObjectSampler,
    drawn: np.ndarray,
    drawn_labels: Sequence[int],
    ground: float | None,
) -> TrainingFrame:
    """Inserts rows of the database, in this order, into a frame.

    An object that collides in bird's eye view with a box of the frame or with one inserted before is skipped, not
    replaced. Points of the frame inside an inserted box give way to the object's own. On a flat ground an object is
    raised or lowered to stand on it. Where obstacles are known, what the sensor would not see is taken out: points of
    an object behind others or behind obstacles, points of the frame behind objects, and boxes of both that this leaves
    few points.
    """
    points, boxes, labels, device = frame.points, frame.boxes, frame.labels, frame.points.device
    new_boxes = torch.from_numpy(objects.database.box[drawn])
    inserted = _free_places(new_boxes, boxes)
    if len(inserted) == 0:
        return frame
    new_boxes, new_labels = new_boxes[inserted], labels.new_tensor(drawn_labels)[inserted]
    offsets = objects.database.offsets
    parts = [objects.points[offsets[k] : offsets[k + 1]] for k in drawn[inserted]]
    new_points = torch.cat(parts)
    of_object = torch.arange(len(parts)).repeat_interleave(torch.tensor([len(part) for part in parts]))
    if ground is not None:
        rise = ground - (new_boxes[:, 2] - new_boxes[:, 5] / 2)
        new_boxes[:, 2] += rise
        new_points[:, 2] += rise[of_object]
    gone = torch.zeros((), dtype=torch.bool, device=device)
    if frame.obstacles is not None:
        rays, obstacles = rays_to(new_points), rays_to(frame.obstacles)
        seen = ~hidden(rays, of_object, new_boxes[:, 2] - new_boxes[:, 5] / 2, obstacles)
        stays = torch.bincount(of_object[seen], minlength=len(parts)) >= MIN_POINTS
        seen &= stays[of_object]
        new_boxes, new_labels, new_points = new_boxes[stays], new_labels[stays], new_points[seen]
        image = rays.select(seen).image()
        gone = rays_to(points).behind(send(image, device))
        covered, of_box = obstacles.behind(image)[:, None], points_in_boxes(frame.obstacles, boxes)
        stays = ((of_box & ~covered).sum(dim=0) >= MIN_POINTS) | ~(of_box & covered).any(dim=0)
        boxes, labels = boxes[stays], labels[stays]
    points = drop(points, gone | points_in_boxes(points, send(new_boxes, device)).any(dim=1))
    return frame._replace(
        points=torch.cat((points, send(new_points, device))),
        boxes=torch.cat((boxes, new_boxes)),
        labels=torch.cat((labels, new_labels)),
    )


def _free_places(new_boxes: Tensor, boxes: Tensor) -> np.ndarray:
    """Which of new boxes (K, 7), ascending, collide neither with boxes (M, 7) nor with one of these before them."""
    collides = boxes_collide(new_boxes, torch.cat((boxes, new_boxes))).numpy()
    standing = np.arange(len(boxes) + len(new_boxes)) < len(boxes)
    for k in range(len(new_boxes)):
        standing[len(boxes) + k] = not (collides[k] & standing).any()
    return np.flatnonzero(standing[len(boxes) :])
