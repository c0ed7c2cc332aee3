"""What hides what from the sensor, in a range image: cells of equal azimuth and slope, each with its nearest point."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

AZIMUTH, SLOPE = math.radians(0.4), 0.01
"""Size of a cell: radians, and metres up per metre ahead. An object's points lie closer: its cells leave no gaps."""
COLUMNS, ROWS = 900, 200
"""Cells all around; what rises or falls by more than 45 degrees is in the last rows."""
MARGIN = 0.3
"""Metres by which a point is nearer than another that it hides."""
CLEARANCE = 0.4
"""Metres above an object's bottom below which nothing hides it: far away the road before an object is in its cells,
some metres nearer."""


class Rays(NamedTuple):
    """Points as the sensor sees them."""

    cell: Tensor  # (N,) int64
    distance: Tensor  # (N,) metres, horizontally

    def image(self) -> Tensor:
        """The distance of the nearest point of every cell (ROWS * COLUMNS,), infinite where none is."""
        empty = self.distance.new_full((ROWS * COLUMNS,), math.inf)
        return empty.scatter_reduce(0, self.cell, self.distance, "amin")

    def behind(self, image: Tensor) -> Tensor:
        """Which points lie behind the nearest ones of an image: (N,) bool."""
        return self.distance > image[self.cell] + MARGIN

    def select(self, mask: Tensor) -> "Rays":
        """Those of a mask (N,)."""
        return Rays(self.cell[mask], self.distance[mask])


def rays_to(points: Tensor) -> Rays:
    """The rays to points (N, 3 or more). One that is not finite has a distance of NaN, and lies behind nothing."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    distance = torch.hypot(x, y)
    column = (torch.atan2(y, x) + math.pi) / AZIMUTH
    row = z / distance / SLOPE + ROWS / 2
    row, column = (
        each.nan_to_num(0.0).clamp(0, last).long() for each, last in ((row, ROWS - 1), (column, COLUMNS - 1))
    )
    return Rays(row * COLUMNS + column, distance)


def nearest_points(points: Tensor) -> Tensor:
    """Of points (N, 3 or more) the nearest (S, 3) of every cell: what may hide others."""
    cell, distance = rays_to(points)
    by_distance = distance.argsort(stable=True)
    order = by_distance[cell[by_distance].argsort(stable=True)]
    first = torch.ones(len(order), dtype=torch.bool, device=points.device)
    first[1:] = cell[order].diff() != 0
    return points[order[first], :3]


def hidden(rays: Rays, of_object: Tensor, bottom: Tensor, obstacles: Rays) -> Tensor:
    """Which points (N,) of K objects are hidden by another one or by obstacles: (N,) bool.

    of_object (N,) is the object of each point, bottom (K,) the objects' lowest heights. Of the obstacles those hide an
    object that lie before all of its points and are not the road that it stands on.
    """
    cell, distance = rays
    begin = distance.new_full((len(bottom),), math.inf).scatter_reduce(0, of_object, distance, "amin")
    # where the lowest ray of the cell comes down to the clearance; one that rises does not
    slope = (cell // COLUMNS - ROWS // 2) * SLOPE
    road = torch.where(slope < 0, (bottom[of_object] + CLEARANCE) / slope, math.inf)
    by_obstacle = obstacles.image()[cell] < torch.minimum(begin[of_object] - MARGIN, road)
    # distance, in millimetres, and object of the nearest point in one number
    key = (distance * 1000).long() * len(bottom) + of_object
    nearest = key.new_full((ROWS * COLUMNS,), 2**62).scatter_reduce(0, cell, key, "amin")[cell]
    by_object = (nearest % len(bottom) != of_object) & (nearest // len(bottom) < (distance - MARGIN) * 1000)
    return by_obstacle | by_object
