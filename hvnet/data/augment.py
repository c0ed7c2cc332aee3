"""3D data augmentation (the paper's section 4.1): ground-truth sampling, then flip, rotation, scaling, translation.

Points (N, 4) and boxes (M, 7) are in LiDAR axes. Nothing is changed in place, and every random number comes from the
generator that is passed in: one that is seeded by (seed, epoch, index) makes a sample repeatable on its own.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from hvnet.boxes import boxes_collide, limit_angle, points_in_boxes
from hvnet.config import AugmentConfig
from hvnet.data.gt_database import Database, object_points
from hvnet.kernels.launch import many_threads

MIN_POINTS = 5
"""Objects of fewer points are not inserted, as in SECOND."""


class ObjectSampler(NamedTuple):
    """A ground-truth database that is ready to draw from."""

    database: Database
    points: Tensor  # (M, 4) of all objects, on the device of the frames
    of_class: dict[str, np.ndarray]  # rows of each class that `sample_objects` draws from
    of_frame: list[np.ndarray]  # rows of each frame that `sample_frame` inserts


def sampler_of(database: Database, device: torch.device) -> ObjectSampler:
    """The database with its points on a device, and its rows by class and by frame."""
    has_points = np.diff(database.offsets) >= MIN_POINTS
    # rated by KITTI: easy, moderate or hard; SECOND leaves out the others. Without a camera there are no heights
    high = (database.bbox_height > 25) | (not database.bbox_height.any())
    rated = high & (database.occlusion <= 2) & (database.truncation <= 0.5)
    of_class = {str(n): np.flatnonzero(rated & has_points & (database.name == n)) for n in np.unique(database.name)}
    by_frame = np.argsort(database.frame, kind="stable")
    _, starts = np.unique(database.frame[by_frame], return_index=True)
    of_frame = [rows[has_points[rows]] for rows in np.split(by_frame, starts[1:])]
    return ObjectSampler(database, object_points(database).to(device), of_class, of_frame)


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


def augment(
    points: Tensor,
    boxes: Tensor,
    labels: Tensor,
    objects: ObjectSampler | None,
    options: AugmentConfig,
    generator: Generator,
    classes: Sequence[str],
) -> tuple[Tensor, Tensor, Tensor]:
    """Augments one frame: points (N, 4), boxes (M, 7) and labels (M,), which number the boxes' classes in `classes`.

    The points may be on a GPU, from which nothing is read; boxes and labels stay on the host, because the random
    choices depend on them.

    Objects are inserted first, as in SECOND, which the paper follows, though it names the global changes first: objects
    keep the pose in which the scanner saw them, which is in the camera's view only before the frame is turned.
    """
    if objects is not None:
        if options.whole_frames and torch.rand((), generator=generator).item() < options.whole_frames:
            points, boxes, labels = sample_frame(points, boxes, labels, objects, generator, classes)
        else:
            points, boxes, labels = sample_objects(points, boxes, labels, objects, options.objects, generator, classes)
    points, boxes = random_flip(points, boxes, options.flip, generator)
    points, boxes = random_rotation(points, boxes, options.rotation, generator)
    points, boxes = random_scaling(points, boxes, options.scaling, generator)
    points, boxes = random_translation(points, boxes, options.translation, generator)
    return points, boxes, labels


def random_flip(points: Tensor, boxes: Tensor, probability: float, generator: Generator) -> tuple[Tensor, Tensor]:
    """Mirrors left and right, y to -y, with the given probability."""
    if torch.rand((), generator=generator).item() >= probability:
        return points, boxes
    points, boxes = points.clone(), boxes.clone()
    points[:, 1] *= -1
    boxes[:, 1] *= -1
    boxes[:, 6] = limit_angle(-boxes[:, 6])
    return points, boxes


def random_rotation(points: Tensor, boxes: Tensor, limit: float, generator: Generator) -> tuple[Tensor, Tensor]:
    """Rotates everything about the LiDAR's z axis by an angle uniform in [-limit, limit], radians."""
    angle = _uniform(-limit, limit, generator)
    cos, sin = math.cos(angle), math.sin(angle)
    points, boxes = points.clone(), boxes.clone()
    for rows in (points, boxes):
        x, y = rows[:, 0].clone(), rows[:, 1].clone()
        rows[:, 0] = x * cos - y * sin
        rows[:, 1] = x * sin + y * cos
    boxes[:, 6] = limit_angle(boxes[:, 6] + angle)
    return points, boxes


def random_scaling(
    points: Tensor, boxes: Tensor, limits: tuple[float, float], generator: Generator
) -> tuple[Tensor, Tensor]:
    """Scales everything about the LiDAR by a factor uniform between the limits."""
    factor = _uniform(*limits, generator)
    points, boxes = points.clone(), boxes.clone()
    points[:, :3] *= factor
    boxes[:, :6] *= factor
    return points, boxes


def random_translation(
    points: Tensor, boxes: Tensor, deviation: tuple[float, float, float], generator: Generator
) -> tuple[Tensor, Tensor]:
    """Moves everything by a normal sample with mean 0 and the given standard deviations along x, y and z, metres."""
    shift = torch.randn(3, generator=generator) * torch.tensor(deviation)
    points, boxes = points.clone(), boxes.clone()
    points[:, :3] += send(shift, points.device)
    boxes[:, :3] += shift
    return points, boxes


def mix_sectors(
    points: Tensor, boxes: Tensor, labels: Tensor, others: tuple[Tensor, Tensor, Tensor], generator: Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Takes everything on one side of a direction from another frame (points, boxes, labels), as PolarMix (Xiao et al.,
    2022) swaps sectors of scans.

    The direction is uniform within 30 degrees of straight ahead. A box belongs to the side of its centre and keeps its
    points beyond the border, where they replace the points of the frame on that side.
    """
    border = _uniform(-math.pi / 6, math.pi / 6, generator)
    left_from_other = torch.rand((), generator=generator).item() < 0.5

    def left(rows: Tensor) -> Tensor:
        return torch.atan2(rows[:, 1], rows[:, 0]) > border

    kept_boxes, other_boxes = left(boxes) != left_from_other, left(others[1]) == left_from_other
    own, own_labels = boxes[kept_boxes], labels[kept_boxes]
    new, new_labels = others[1][other_boxes], others[2][other_boxes]

    def within(cloud: Tensor, among: Tensor) -> Tensor:
        return points_in_boxes(cloud, send(among, cloud.device)).any(dim=1)

    in_own, in_new = within(points, own), within(points, new)
    from_own, from_new = within(others[0], own), within(others[0], new)
    stays = (in_own | (left(points) != left_from_other)) & ~(in_new & ~in_own)
    comes = (from_new | (left(others[0]) == left_from_other)) & ~(from_own & ~from_new)
    # half of an object that is removed with the other side must not stay behind
    stays &= ~within(points, boxes[~kept_boxes]) | in_own
    comes &= ~within(others[0], others[1][~other_boxes]) | from_new
    cloud = torch.cat((drop(points, ~stays), drop(others[0], ~comes)))
    return cloud, torch.cat((own, new)), torch.cat((own_labels, new_labels))


def sample_objects(
    points: Tensor,
    boxes: Tensor,
    labels: Tensor,
    objects: ObjectSampler,
    counts: Mapping[str, int],
    generator: Generator,
    classes: Sequence[str],
) -> tuple[Tensor, Tensor, Tensor]:
    """Ground-truth sampling of SECOND: inserts objects of other frames at their original positions.

    labels (M,) int64 number the boxes' classes in `classes`; boxes of any other number only block their place. For each
    class in `counts`, objects are drawn without replacement until the frame has that many of them.
    """
    drawn: list[np.ndarray] = [np.empty(0, np.int64)]
    drawn_labels: list[int] = []
    for name, count in counts.items():
        label = classes.index(name)
        missing = max(0, count - int((labels == label).sum()))
        known = objects.of_class.get(name, drawn[0])
        picked = torch.randperm(len(known), generator=generator)[:missing].numpy()
        drawn.append(known[picked])
        drawn_labels += [label] * len(picked)
    return _insert(points, boxes, labels, objects, np.concatenate(drawn), drawn_labels)


def sample_frame(
    points: Tensor, boxes: Tensor, labels: Tensor, objects: ObjectSampler, generator: Generator, classes: Sequence[str]
) -> tuple[Tensor, Tensor, Tensor]:
    """Inserts all objects of one frame of the database into points (N, 4), boxes (M, 7) and labels (M,).

    They keep their arrangement: a queue at a light, cars along a kerb. Those of other classes have label -1.
    """
    drawn = objects.of_frame[int(torch.randint(len(objects.of_frame), (), generator=generator))]
    drawn_labels = [classes.index(name) if name in classes else -1 for name in objects.database.name[drawn]]
    return _insert(points, boxes, labels, objects, drawn, drawn_labels)


def _insert(
    points: Tensor,
    boxes: Tensor,
    labels: Tensor,
    objects: ObjectSampler,
    drawn: np.ndarray,
    drawn_labels: Sequence[int],
) -> tuple[Tensor, Tensor, Tensor]:
    """Inserts rows of the database, in this order, into a frame.

    An object that collides in bird's eye view with a box of the frame or with one inserted before is skipped, not
    replaced. Points of the frame inside an inserted box give way to the object's own.
    """
    drawn_boxes = torch.from_numpy(objects.database.box[drawn])
    collides = boxes_collide(drawn_boxes, torch.cat((boxes, drawn_boxes))).numpy()
    standing = np.arange(len(boxes) + len(drawn)) < len(boxes)
    for k in range(len(drawn)):
        standing[len(boxes) + k] = not (collides[k] & standing).any()
    inserted = np.flatnonzero(standing[len(boxes) :])
    if len(inserted) == 0:
        return points, boxes, labels
    new_boxes = drawn_boxes[inserted]
    points = drop(points, points_in_boxes(points, send(new_boxes, points.device)).any(dim=1))
    offsets = objects.database.offsets
    points = torch.cat([points, *(objects.points[offsets[k] : offsets[k + 1]] for k in drawn[inserted])])
    return points, torch.cat((boxes, new_boxes)), torch.cat((labels, labels.new_tensor(drawn_labels)[inserted]))


def _uniform(low: float, high: float, generator: Generator) -> float:
    return low + (high - low) * torch.rand((), generator=generator).item()
