"""3D data augmentation (the paper's section 4.1): objects of other frames, then flip, rotation, scaling, translation.

Points (N, 4) and boxes (M, 7) are in LiDAR axes. Nothing is changed in place, and every random number comes from the
generator that is passed in: one that is seeded by (seed, epoch, index) makes a sample repeatable on its own.
"""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from hvnet.boxes import limit_angle, points_in_boxes
from hvnet.config import AugmentConfig
from hvnet.data.insert import ObjectSampler, TrainingFrame, drop, sample_frame, sample_objects, send
from hvnet.data.other_sensors import random_pitch, random_reflectance, unseen_by_fewer_beams


def augment(
    frame: TrainingFrame,
    objects: ObjectSampler | None,
    options: AugmentConfig,
    generator: Generator,
    classes: Sequence[str],
    ground: float | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Augments one frame: returns points (N, 4), boxes (M, 7) and labels (M,), which number the boxes' `classes`.

    ground: height of a flat ground, on which inserted objects stand; None: they keep their own height.

    The points may be on a GPU, from which nothing is read; boxes and labels stay on the host, because the random
    choices depend on them.

    Objects are inserted first, as in SECOND, which the paper follows, though it names the global changes first: objects
    keep the pose in which the scanner saw them, which is in the camera's view only before the frame is turned.
    """
    if objects is not None:
        if options.whole_frames and torch.rand((), generator=generator).item() < options.whole_frames:
            frame = sample_frame(frame, objects, generator, classes, ground)
        else:
            frame = sample_objects(frame, objects, options.objects, generator, classes, ground)
    points, boxes, labels = frame.points, frame.boxes, frame.labels
    # after the insertion, and before a point leaves the beam that saw it
    if options.fewer_beams and torch.rand((), generator=generator).item() < options.fewer_beams:
        points = drop(points, unseen_by_fewer_beams(points, generator))
    points = random_reflectance(points, options.no_reflectance, options.reflectance, generator)
    points, boxes = random_pitch(points, boxes, options.pitch, generator)
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


def mix_sectors(frame: TrainingFrame, other: TrainingFrame, generator: Generator) -> TrainingFrame:
    """Takes everything on one side of a direction from another frame, as PolarMix (Xiao et al., 2022) swaps sectors of
    scans.

    The direction is uniform within 30 degrees of straight ahead. A box belongs to the side of its centre and keeps its
    points beyond the border, where they replace the points of the frame on that side.
    """
    border = _uniform(-math.pi / 6, math.pi / 6, generator)
    left_from_other = torch.rand((), generator=generator).item() < 0.5

    def on_own_side(rows: Tensor) -> Tensor:
        return (torch.atan2(rows[:, 1], rows[:, 0]) > border) != left_from_other

    def within(cloud: Tensor, among: Tensor) -> Tensor:
        return points_in_boxes(cloud, send(among, cloud.device)).any(dim=1)

    kept, taken = on_own_side(frame.boxes), ~on_own_side(other.boxes)
    own, new = frame.boxes[kept], other.boxes[taken]
    in_own, in_new = within(frame.points, own), within(frame.points, new)
    from_own, from_new = within(other.points, own), within(other.points, new)
    stays = (in_own | on_own_side(frame.points)) & ~(in_new & ~in_own)
    comes = (from_new | ~on_own_side(other.points)) & ~(from_own & ~from_new)
    # half of an object that is removed with the other side must not stay behind
    stays &= ~within(frame.points, frame.boxes[~kept]) | in_own
    comes &= ~within(other.points, other.boxes[~taken]) | from_new
    obstacles = None
    if frame.obstacles is not None and other.obstacles is not None:
        own_obstacles, new_obstacles = on_own_side(frame.obstacles), ~on_own_side(other.obstacles)
        obstacles = torch.cat((frame.obstacles[own_obstacles], other.obstacles[new_obstacles]))
    return TrainingFrame(
        torch.cat((drop(frame.points, ~stays), drop(other.points, ~comes))),
        torch.cat((own, new)),
        torch.cat((frame.labels[kept], other.labels[taken])),
        obstacles,
        "\n".join(filter(None, (frame.note, other.note))),
        frame.name,
    )


def _uniform(low: float, high: float, generator: Generator) -> float:
    return low + (high - low) * torch.rand((), generator=generator).item()
