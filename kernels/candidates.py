"""From the heads' maps to the boxes that go into NMS, for all classes and samples in one go, by many threads.

An anchor that may be reported is a key: its score above, below it what is left of an int after its index, so that the
largest keys are the best scores and, of equal ones, the lowest anchors. Arrays have a fixed size and nothing is read
from the device, so that a CUDA graph captures it. The twin is what a detector does with one thread.
"""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

import functools
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import LARGEST, LOW_BITS, array, launch

PI = 3.14159265358979


class AnchorTable(NamedTuple):
    """The anchors of C classes in one array, and what their boxes are decoded by."""

    boxes: Tensor  # (A, 9) float32: box (7), cosine and sine of its yaw
    starts: Tensor  # (C,) int32, the first of every class
    per_cell: Tensor  # (C,) int32, anchors at a cell of the class's map
    values: int  # that are regressed for an anchor: location, vertical and, if there is one, direction
    pose: bool  # the location is a pose (5), not corners (8)
    direction: bool
    limits: tuple[float, float, float, float]
    """MAX_SIZE, MAX_HEIGHT, MAX_SHIFT and MAX_OUTPUT of `anchors.decode`."""


def write_keys(logits: Tensor, iou: Tensor | None, threshold: float, label: int, keys: Tensor) -> None:
    """Writes the keys of the A anchors of a class to keys (B, C, A' >= A) int64; negative where there is no candidate.

    logits, iou: (B, A), of float32, float16 or bfloat16; the score is the geometric mean of their sigmoids. It has
    to be above the threshold, which is not negative; NaN is not.
    """
    other = logits if iou is None else iou
    inputs = [array(logits), array(other), int(iou is not None), threshold, label, array(keys)]
    size = (keys.shape[0], keys.shape[2])
    launch(_kernels(wp.dtype_from_torch(logits.dtype)).write_keys, size, inputs, logits.device)


def gather_patches(level: Tensor, keys: Tensor, label: int, per_cell: int, patches: Tensor) -> None:
    """Writes the 3 x 3 cells of a level (B, N_L, N_W, C) around the anchors of a class to patches (classes, B K, 9 C).

    keys: (B, classes, K) int64. Cells beyond the map are 0, rows of no candidate are left as they are.
    """
    inputs = [array(level), array(keys), label, per_cell, array(patches)]
    size = (keys.shape[0], keys.shape[2], patches.shape[2])
    launch(_kernels(wp.dtype_from_torch(level.dtype)).gather_patches, size, inputs, level.device)


def decode_candidates(values: Tensor, keys: Tensor, anchors: AnchorTable, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Writes the candidates as rows (B, C, K, 10) of box (7), score and label; the last number is left.

    values: (C, B K, anchors per cell * values) float32, what the head of a class gives at the cells
    keys: (B, C, K) int64, the largest first

    Returns which may be reported (B, C, K) bool: all that are candidates and whose box is finite; and how many
    candidates every class of a sample has (B C,) int32: they come first.
    """
    valid = torch.empty(keys.shape, dtype=torch.bool, device=keys.device)
    counts = torch.empty(keys.shape[0] * keys.shape[1], dtype=torch.int32, device=keys.device)
    inputs = [array(values), array(keys), array(anchors.boxes), array(anchors.starts), array(anchors.per_cell)]
    inputs += [anchors.values, int(anchors.pose), int(anchors.direction), wp.vec4(*anchors.limits)]
    launch(_decode, keys.shape, [*inputs, array(rows), array(valid), array(counts)], keys.device)
    return valid, counts


@wp.func
def _sigmoid(logit: float):
    return 1.0 / (1.0 + wp.exp(-logit))


@functools.cache
def _kernels(map_dtype: Any) -> SimpleNamespace:
    """The kernels that read maps of one floating type, in a module of their own."""
    module = wp.Module(f"hvnet_candidates_{map_dtype.__name__}", None)

    @wp.kernel(enable_backward=False, module=module)
    def write_keys(
        logits: wp.array2d(dtype=map_dtype),
        iou: wp.array2d(dtype=map_dtype),
        has_iou: int,
        threshold: float,
        label: int,
        keys: wp.array3d(dtype=wp.int64),
    ):
        b, a = wp.tid()
        key = wp.int64(-1)
        if a < logits.shape[1]:
            score = _sigmoid(float(logits[b, a]))
            if has_iou != 0:
                score = wp.sqrt(score * _sigmoid(float(iou[b, a])))
            if score > threshold:  # and so above 0: the order of its bits is that of its value
                key = (wp.int64(wp.cast(score, wp.int32)) << wp.int64(32)) | wp.int64(LARGEST - a)
        keys[b, label, a] = key

    @wp.kernel(enable_backward=False, module=module)
    def gather_patches(
        level: wp.array4d(dtype=map_dtype),
        keys: wp.array3d(dtype=wp.int64),
        label: int,
        per_cell: int,
        patches: wp.array3d(dtype=wp.float32),
    ):
        b, k, column = wp.tid()
        key = keys[b, label, k]
        if key < wp.int64(0):
            return
        channels = level.shape[3]
        cell = _anchor_of(key) // per_cell
        step = column // channels
        x = cell // level.shape[2] + step // 3 - 1
        y = cell % level.shape[2] + step % 3 - 1
        value = float(0.0)
        if x >= 0 and x < level.shape[1] and y >= 0 and y < level.shape[2]:
            value = float(level[b, x, y, column % channels])
        patches[label, b * keys.shape[2] + k, column] = value

    return SimpleNamespace(write_keys=write_keys, gather_patches=gather_patches)


@wp.func
def _anchor_of(key: wp.int64):
    return LARGEST - wp.int32(key & LOW_BITS)


@wp.func
def _bounded(value: float, low: float, high: float):
    """Clamps a value; a NaN stays one."""
    bounded = value
    if value < low:
        bounded = low
    if value > high:
        bounded = high
    return bounded


@wp.func
def _limit_angle(angle: float):
    """As `boxes.limit_angle`."""
    wrapped = wp.mod(angle + PI, 2.0 * PI)
    if wrapped < 0.0:
        wrapped += 2.0 * PI
    wrapped -= PI
    if wrapped >= PI:
        wrapped -= 2.0 * PI
    return wrapped


@wp.kernel(enable_backward=False, module="unique")
def _decode(
    values: wp.array3d(dtype=wp.float32),
    keys: wp.array3d(dtype=wp.int64),
    anchors: wp.array2d(dtype=wp.float32),
    starts: wp.array(dtype=wp.int32),
    per_cell: wp.array(dtype=wp.int32),
    count: int,
    pose: int,
    direction: int,
    limits: wp.vec4,
    rows: wp.array4d(dtype=wp.float32),
    valid: wp.array3d(dtype=wp.bool),
    counts: wp.array(dtype=wp.int32),
):
    """As `anchors.decode`, operation by operation."""
    b, label, k = wp.tid()
    size = keys.shape[2]
    if k == 0:  # the keys descend: their number is where they turn negative
        first = int(0)
        last = size
        while first < last:
            middle = (first + last) // 2
            if keys[b, label, middle] < wp.int64(0):
                last = middle
            else:
                first = middle + 1
        counts[b * keys.shape[1] + label] = first
    for column in range(10):
        rows[b, label, k, column] = 0.0
    valid[b, label, k] = False
    key = keys[b, label, k]
    if key < wp.int64(0):
        return

    anchor = _anchor_of(key)
    row = b * size + k
    v = (anchor % per_cell[label]) * count
    a = starts[label] + anchor
    length = anchors[a, 3]
    width = anchors[a, 4]
    height = anchors[a, 5]
    largest = wp.max(2.0 * wp.max(length, width), limits[0])
    highest = wp.max(2.0 * height, limits[1])
    far = limits[2]
    most = limits[3]

    x = float(0.0)
    y = float(0.0)
    yaw = float(0.0)
    next = v
    if pose != 0:
        diagonal = wp.length(wp.vec2(length, width))
        x = anchors[a, 0] + _bounded(values[label, row, v] * diagonal, -far, far)
        y = anchors[a, 1] + _bounded(values[label, row, v + 1] * diagonal, -far, far)
        length = length * wp.exp(_bounded(values[label, row, v + 2], -most, most))
        width = width * wp.exp(_bounded(values[label, row, v + 3], -most, most))
        yaw = anchors[a, 6] + _bounded(values[label, row, v + 4], -most, most)
        next = v + 5
    else:
        cos = anchors[a, 7]
        sin = anchors[a, 8]
        along = wp.vec2(0.5 * length * cos, 0.5 * length * sin)
        across = wp.vec2(-(0.5 * width * sin), 0.5 * width * cos)
        centre = wp.vec2(anchors[a, 0], anchors[a, 1])
        front_left = centre + along + across + _offset(values, label, row, v, far)
        front_right = centre + along - across + _offset(values, label, row, v + 2, far)
        rear_right = centre - along - across + _offset(values, label, row, v + 4, far)
        rear_left = centre - along + across + _offset(values, label, row, v + 6, far)
        centre = (front_left + front_right + rear_right + rear_left) / 4.0
        x = centre[0]
        y = centre[1]
        left = front_left - rear_left
        right = front_right - rear_right
        length = (wp.length(left) + wp.length(right)) / 2.0
        width = (wp.length(front_left - front_right) + wp.length(rear_left - rear_right)) / 2.0
        yaw = wp.atan2(left[1] + right[1], left[0] + right[0])
        next = v + 8
    if direction != 0:
        forward = values[label, row, next + 2]
        backward = values[label, row, next + 3]
        # the first of the largest, and a NaN is larger than any number
        if backward > forward or (wp.isnan(backward) and not wp.isnan(forward)):
            yaw += PI
    z = anchors[a, 2] + _bounded(values[label, row, next] * height, -highest, highest)
    h = wp.exp(_bounded(values[label, row, next + 1], -most, most)) * height
    length = _bounded(length, -wp.inf, largest)
    width = _bounded(width, -wp.inf, largest)
    h = _bounded(h, -wp.inf, highest)
    yaw = _limit_angle(yaw)

    rows[b, label, k, 0] = x
    rows[b, label, k, 1] = y
    rows[b, label, k, 2] = z
    rows[b, label, k, 3] = length
    rows[b, label, k, 4] = width
    rows[b, label, k, 5] = h
    rows[b, label, k, 6] = yaw
    rows[b, label, k, 7] = wp.cast(int(key >> wp.int64(32)), wp.float32)
    rows[b, label, k, 8] = float(label)
    valid[b, label, k] = wp.abs(x + y + z + length + width + h + yaw) < wp.inf  # each is bounded but for a NaN


@wp.func
def _offset(values: wp.array3d(dtype=wp.float32), label: int, row: int, v: int, far: float):
    return wp.vec2(_bounded(values[label, row, v], -far, far), _bounded(values[label, row, v + 1], -far, far))
