"""Training frames as other sensors see them: of fewer beams, with another reflectance, mounted at another pitch.

Points (N, 4) and boxes (M, 7) are in LiDAR axes. Points may be on a GPU, from which nothing is read. What is off
draws no random number.
"""

import math

import torch
from torch import Generator, Tensor

UPPER_APEX, LOWER_APEX = 0.20, 0.12
"""Metres above the origin from which the beams of a block come."""
UPPER_TOP, UPPER_STEP, LOWER_TOP, LOWER_STEP = 1.94, 0.3435, -9.03, 0.515
"""Elevation of the first beam of a block and the angle between two, degrees.

KITTI's Velodyne HDL-64E has two blocks of 32 beams. In its whole scans each beam draws a cone to within 0.004 degrees,
and all 64 lie within 0.2 degrees of these.
"""
BEAM_SPACING = (0.7, 1.4)
"""Degrees between the beams that stay, at random: 40 of them to 20. An HDL-32E has 1.33."""
AZIMUTH_STEP = 0.1728
"""Degrees between the points of a beam; at 20 turns a second sensors have twice as many."""


def find_beams(points: Tensor) -> Tensor:
    """The beam (N,) int64 of an HDL-64E that sees each point: 0 is the highest, 63 the lowest. A row of NaN has any.

    The order of the points does not matter: inserted objects, which keep their pose, share the beams of the street.
    """
    distance = torch.hypot(points[:, 0], points[:, 1])

    def beams_below_top(apex: float, top: float, step: float) -> Tensor:
        return (top - torch.atan2(points[:, 2] - apex, distance).rad2deg()) / step

    upper = beams_below_top(UPPER_APEX, UPPER_TOP, UPPER_STEP)
    lower = beams_below_top(LOWER_APEX, LOWER_TOP, LOWER_STEP)
    # what lies between the blocks belongs to the lower one
    return torch.where(upper < 31.5, upper, 32 + lower.clamp(min=0)).nan_to_num().round().long().clamp(0, 63)


def unseen_by_fewer_beams(points: Tensor, generator: Generator) -> Tensor:
    """Which points (N,) bool of an HDL-64E a sensor of 20 to 40 beams does not see.

    The angle between the beams that stay is random (BEAM_SPACING): of each step of that size the first one stays, in
    half of the frames only with every second point of its own.
    """
    spacing = torch.empty(()).uniform_(*BEAM_SPACING, generator=generator).item()
    phase, turn = torch.rand(2, generator=generator).tolist()
    block = torch.arange(32, device=points.device)
    elevation = torch.cat((UPPER_TOP - UPPER_STEP * block, LOWER_TOP - LOWER_STEP * block))
    step = (phase - elevation / spacing).floor()
    unseen = (step.diff(prepend=step[:1] - 1) == 0)[find_beams(points)]
    if turn < 0.5:
        azimuth = torch.atan2(points[:, 1], points[:, 0]).rad2deg()
        unseen |= (azimuth / AZIMUTH_STEP).floor() % 2 == 1
    return unseen


def random_reflectance(points: Tensor, none: float, scaling: tuple[float, float], generator: Generator) -> Tensor:
    """Multiplies the reflectance by a factor uniform between the limits, up to 1; with the probability `none` by 0.

    0 is what a cloud has whose reflectance is missing or constant (`hvnet.data.sensor`).
    """
    if none and torch.rand((), generator=generator).item() < none:
        factor = 0.0
    elif scaling != (1.0, 1.0):
        factor = torch.empty(()).uniform_(*scaling, generator=generator).item()
    else:
        return points
    return torch.cat((points[:, :3], (points[:, 3:] * factor).clamp(max=1)), dim=1)


def random_pitch(points: Tensor, boxes: Tensor, limit: float, generator: Generator) -> tuple[Tensor, Tensor]:
    """Turns everything about the LiDAR's y axis by an angle uniform in [-limit, limit], radians; up is negative.

    Boxes only move: a box has no tilt, which is neglected. At 1 degree that is 4 cm at the ends of a car.
    """
    if limit == 0:
        return points, boxes
    angle = torch.empty(()).uniform_(-limit, limit, generator=generator).item()
    cos, sin = math.cos(angle), math.sin(angle)
    points, boxes = points.clone(), boxes.clone()
    for rows in (points, boxes):
        x, z = rows[:, 0].clone(), rows[:, 2].clone()
        rows[:, 0] = x * cos + z * sin
        rows[:, 2] = z * cos - x * sin
    return points, boxes
