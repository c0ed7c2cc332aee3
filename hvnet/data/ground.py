"""The ground of a frame: where an object stands that is put there."""

import torch
from torch import Tensor

CELL = 2.0
"""Metres along a cell in which one point is looked for that lies on the ground."""
LOW = 0.05
"""Quantile of a cell's heights that is taken for the ground: the lowest points may be reflections from below it."""
FEWEST = 3
"""Points of a cell that tells anything."""
SPREAD = 0.7
"""Metres around the median of the low points within which the first guess takes them for ground."""
NOISE = 0.15
"""Metres by which ground points leave a plane; walls and cars rise further."""
LARGEST = 0.6
"""Metres between the plane and the ground beside it at most."""
REACH = 3.0
"""Metres around a place in which the ground says how high it is there."""


def ground_points(points: Tensor) -> Tensor:
    """Of points (N, 3 or more) those (G, 3) float64 that may lie on the ground: a low one of every cell."""
    xyz = points[:, :3].double()
    xyz = xyz[xyz.isfinite().all(dim=1)]
    cell = (xyz[:, :2] / CELL).floor().long()
    key = cell[:, 0] * 2**24 + cell[:, 1]
    by_height = xyz[:, 2].argsort(stable=True)
    order = by_height[key[by_height].argsort(stable=True)]
    _, count = key[order].unique_consecutive(return_counts=True)
    low = count.cumsum(0) - count + (LOW * (count - 1)).long()
    return xyz[order[low[count >= FEWEST]]]


def ground_under(ground: Tensor, places: Tensor) -> Tensor:
    """Heights (M,) float64 of the ground at places (M, 2), by the points (G, 3) of `ground_points`; NaN for too few.

    A plane is fitted to the lower ones, which walls and roofs are not among; then what the points nearby leave of it is
    added, the lower ones with more weight.
    """
    ground, places = ground.double(), places.double()
    rows = torch.cat((ground[:, :2], torch.ones_like(ground[:, :1])), dim=1)
    height = ground[:, 2]
    weight = ((height - height.median()).abs() < SPREAD).to(height.dtype) if len(height) else height
    if weight.sum() < 6:
        return places.new_full((len(places),), torch.nan)
    # level where the points lie on a line and say nothing across it
    level = torch.diag(height.new_tensor([1.0, 1.0, 1e-5]))
    for _ in range(6):
        weighed = rows.T * weight
        plane = torch.linalg.solve(weighed @ rows + level, weighed @ height)
        left = height - rows @ plane
        weight = 1 / (1 + (left / torch.where(left > 0, NOISE, 2 * NOISE)).pow(4))
    near = left.abs() < LARGEST
    left, ground = left[near], ground[near]
    weight = torch.exp(-torch.cdist(places, ground[:, :2]).square() / (2 * REACH**2))
    weight = weight * torch.exp(-left.clamp(min=0) / NOISE)
    residual = (weight @ left) / (weight.sum(dim=1) + LOW)
    return places @ plane[:2] + plane[2] + residual
