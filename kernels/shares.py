"""How many threads share the points of segments: each takes as many, however long the voxels are.

What a thread finds of a voxel that is cut, at the beginning and at the end of its share, it leaves in `ends_of`; a
second kernel, with a thread for every share, joins the parts of the voxel that `cut_voxel` gives it.
"""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

from typing import Any

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import array

CHUNK = wp.constant(32)
"""Consecutive points that one of many threads takes."""


@wp.func
def point_at(order: wp.array(dtype=wp.int64), k: int):
    """The k-th point in the order of the voxels; an empty order is that of the points."""
    i = k
    if order.shape[0] > 0:
        i = int(order[k])
    return i


@wp.func
def share_of(
    task: int,
    size: int,
    count: int,
    voxels: int,
    voxel: wp.array(dtype=wp.int64),
    order: wp.array(dtype=wp.int64),
):
    """A task's `size` of `count` points: from, to; and its voxels: from, to. Ends are not included.

    Voxels without points belong to the task of the next point, those after the last point to the last task.
    """
    first = task * size
    last = wp.min(first + size, count)
    share = wp.vec4i(first, last, 0, voxels)
    if first >= last and task > 0:
        share = wp.vec4i(0, 0, 0, 0)
    elif first < last:
        begin = int(0)
        end = voxels
        if task > 0:
            begin = wp.min(int(voxel[point_at(order, first - 1)]) + 1, int(voxel[point_at(order, first)]))
        if last < count:
            end = int(voxel[point_at(order, last - 1)]) + 1
        share = wp.vec4i(first, last, begin, end)
    return share


@wp.func
def cut_voxel(
    task: int,
    size: int,
    count: int,
    voxel: wp.array(dtype=wp.int64),
    order: wp.array(dtype=wp.int64),
    starts: wp.array(dtype=wp.int64),
):
    """The voxel that begins in a task's share and goes on beyond it; -1 if there is none."""
    cut = int(-1)
    last = (task + 1) * size
    if last < count:
        v = int(voxel[point_at(order, last - 1)])
        if int(starts[v]) >= task * size and int(starts[v + 1]) > last:
            cut = v
    return cut


def tasks_of(size: int, points: int) -> int:
    """The tasks that share the points, one at least: voxels without points are its work as well."""
    return max(1, -(-points // size))


def ends_of(tasks: int, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Room (2, tasks, C) for what a task finds of a voxel that began before it, and of one that goes on after it."""
    return like.new_empty(2, tasks, like.shape[1], dtype=dtype)


def order_array(order: Tensor | None, like: Tensor) -> Any:
    """A Warp view of an order (N,), empty where the points are in order already."""
    return array(like.new_empty(0) if order is None else order.contiguous())
