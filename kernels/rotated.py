"""Rotated boxes (x, y, z, l, w, h, yaw): overlap and IoU in BEV and 3D, NMS, and matching of anchors to boxes.

The intersection of two rectangles is exact: in the frame of rectangle a, Green's theorem turns its area into the
integral of clamp(x, -l/2, l/2) dy along the edges of b where |y| <= w/2. That has no list of vertices and no special
case, and it is continuous, so that touching, identical and nearly parallel edges are as exact as any other.
"""

import functools
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import FLOATS, WARP_FLOAT, array, check_tensor, launch

WORD = 64  # boxes a word of the NMS mask


@functools.cache
def _kernels(dtype: Any) -> SimpleNamespace:
    """The kernels for one floating type, in a module of their own."""
    zero, half, one = dtype(0.0), dtype(0.5), dtype(1.0)
    module = wp.Module(f"hvnet_rotated_{dtype.__name__}", None)

    @wp.func
    def edge_area(x0: dtype, y0: dtype, x1: dtype, y1: dtype, l: dtype, w: dtype):
        """The integral of clamp(x, -l, l) dy along one edge where |y| <= w (l, w: half sizes)."""
        area = zero
        low = wp.clamp(y0, -w, w)
        high = wp.clamp(y1, -w, w)
        if low != high:
            slope = (x1 - x0) / (y1 - y0)
            start = x0 + (low - y0) * slope
            end = x1 - (y1 - high) * slope
            near = wp.clamp(start, -l, l)
            far = wp.clamp(end, -l, l)
            mean = near
            if near != far:
                # the weights of the part between the clamp's two values and of the parts that it flattens
                span = end - start
                between = (far - near) / span
                before = (near - start) / span
                mean = between * half * (near + far) + before * near + (one - between - before) * far
            area = mean * (high - low)
        return area

    @wp.func
    def overlap(a: wp.array2d(dtype=dtype), i: int, b: wp.array2d(dtype=dtype), j: int):
        """The area that boxes a[i] and b[j] share in BEV; 0 where a value is not finite."""
        dx = b[j, 0] - a[i, 0]
        dy = b[j, 1] - a[i, 1]
        reach = half * (wp.length(wp.vector(a[i, 3], a[i, 4])) + wp.length(wp.vector(b[j, 3], b[j, 4])))
        if not (dx * dx + dy * dy < reach * reach):
            return zero
        cos_a = wp.cos(a[i, 6])
        sin_a = wp.sin(a[i, 6])
        x = dx * cos_a + dy * sin_a
        y = dy * cos_a - dx * sin_a
        cos = wp.cos(b[j, 6] - a[i, 6])
        sin = wp.sin(b[j, 6] - a[i, 6])
        l = half * a[i, 3]
        w = half * a[i, 4]
        bl = half * b[j, 3]
        bw = half * b[j, 4]
        # separating axes: boxes that lie apart share exactly nothing, not the rounding residue of four integrals
        if wp.abs(x) >= l + bl * wp.abs(cos) + bw * wp.abs(sin) or wp.abs(y) >= w + bl * wp.abs(sin) + bw * wp.abs(cos):
            return zero
        if wp.abs(x * cos + y * sin) >= bl + l * wp.abs(cos) + w * wp.abs(sin):
            return zero
        if wp.abs(y * cos - x * sin) >= bw + l * wp.abs(sin) + w * wp.abs(cos):
            return zero
        lx = bl * cos
        ly = bl * sin
        wx = -bw * sin
        wy = bw * cos
        area = (
            edge_area(x + lx + wx, y + ly + wy, x - lx + wx, y - ly + wy, l, w)
            + edge_area(x - lx + wx, y - ly + wy, x - lx - wx, y - ly - wy, l, w)
            + edge_area(x - lx - wx, y - ly - wy, x + lx - wx, y + ly - wy, l, w)
            + edge_area(x + lx - wx, y + ly - wy, x + lx + wx, y + ly + wy, l, w)
        )
        if not (area > zero):
            area = zero
        return area

    @wp.func
    def iou_bev(a: wp.array2d(dtype=dtype), i: int, b: wp.array2d(dtype=dtype), j: int):
        inter = overlap(a, i, b, j)
        iou = zero
        if inter > zero:
            iou = wp.min(inter / (a[i, 3] * a[i, 4] + b[j, 3] * b[j, 4] - inter), one)
        return iou

    @wp.func
    def iou_3d(a: wp.array2d(dtype=dtype), i: int, b: wp.array2d(dtype=dtype), j: int):
        top = wp.min(a[i, 2] + half * a[i, 5], b[j, 2] + half * b[j, 5])
        bottom = wp.max(a[i, 2] - half * a[i, 5], b[j, 2] - half * b[j, 5])
        iou = zero
        if top > bottom:
            # the heights of equal boxes, not their rounded difference: a box with itself is exactly 1
            height = wp.min(top - bottom, wp.min(a[i, 5], b[j, 5]))
            if a[i, 2] == b[j, 2]:
                height = wp.min(a[i, 5], b[j, 5])
            inter = overlap(a, i, b, j) * height
            if inter > zero:
                volume = a[i, 3] * a[i, 4] * a[i, 5] + b[j, 3] * b[j, 4] * b[j, 5]
                iou = wp.min(inter / (volume - inter), one)
        return iou

    @wp.kernel(enable_backward=False, module=module)
    def matrix_bev(a: wp.array2d(dtype=dtype), b: wp.array2d(dtype=dtype), iou: wp.array2d(dtype=dtype)):
        i, j = wp.tid()
        iou[i, j] = iou_bev(a, i, b, j)

    @wp.kernel(enable_backward=False, module=module)
    def matrix_3d(a: wp.array2d(dtype=dtype), b: wp.array2d(dtype=dtype), iou: wp.array2d(dtype=dtype)):
        i, j = wp.tid()
        iou[i, j] = iou_3d(a, i, b, j)

    @wp.kernel(enable_backward=False, module=module)
    def pairs(a: wp.array2d(dtype=dtype), b: wp.array2d(dtype=dtype), area: wp.array(dtype=dtype)):
        i = wp.tid()
        area[i] = overlap(a, i, b, i)

    @wp.kernel(enable_backward=False, module=module)
    def nms_mask(boxes: wp.array2d(dtype=dtype), threshold: dtype, mask: wp.array2d(dtype=wp.int64)):
        i, word = wp.tid()
        bits = wp.int64(0)
        for bit in range(WORD):
            j = word * WORD + bit
            if j > i and j < boxes.shape[0] and iou_bev(boxes, i, boxes, j) > threshold:
                bits = bits | (wp.int64(1) << wp.int64(bit))
        mask[i, word] = bits

    @wp.kernel(enable_backward=False, module=module)
    def nms_greedy(boxes: wp.array2d(dtype=dtype), threshold: dtype, keep: wp.array(dtype=wp.bool)):
        """One thread goes through the boxes from the best on; each that is kept drops those that it overlaps."""
        for i in range(boxes.shape[0]):
            if keep[i]:
                for j in range(i + 1, boxes.shape[0]):
                    if keep[j] and iou_bev(boxes, i, boxes, j) > threshold:
                        keep[j] = False

    @wp.kernel(enable_backward=False, module=module)
    def match(
        anchors: wp.array2d(dtype=dtype),
        boxes: wp.array2d(dtype=dtype),
        starts: wp.array(dtype=wp.int64),
        iou: wp.array2d(dtype=dtype),
        box: wp.array2d(dtype=wp.int64),
        best: wp.array(dtype=wp.int64),
    ):
        sample, i = wp.tid()
        highest = zero
        at = int(-1)
        for j in range(int(starts[sample]), int(starts[sample + 1])):
            value = iou_bev(anchors, i, boxes, j)
            if value > highest:
                highest = value
                at = j
            if value > zero:
                # the order of the maximum does not matter: bits of the IoU above, then the lowest anchor
                key = wp.int64(wp.cast(wp.float32(value), wp.int32)) << wp.int64(32)
                wp.atomic_max(best, j, key | wp.int64(0x7FFFFFFF - i))
        iou[sample, i] = highest
        box[sample, i] = wp.int64(at)

    return SimpleNamespace(
        matrix_bev=matrix_bev, matrix_3d=matrix_3d, pairs=pairs, nms_mask=nms_mask, nms_greedy=nms_greedy, match=match
    )


@wp.kernel(enable_backward=False, module="unique")
def _nms_sweep(mask: wp.array2d(dtype=wp.int64), removed: wp.array(dtype=wp.int64), keep: wp.array(dtype=wp.bool)):
    """Goes through the boxes from the best on; each that is kept removes those that its mask names."""
    for i in range(mask.shape[0]):
        word = i // WORD
        kept = ((removed[word] >> wp.int64(i - word * WORD)) & wp.int64(1)) == wp.int64(0)
        keep[i] = kept
        if kept:
            for k in range(word, mask.shape[1]):
                removed[k] = removed[k] | mask[i, k]


def rotated_iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """IoU in bird's eye view of boxes a (A, 7) and b (B, 7), float32 or float64: (A, B) in [0, 1]."""
    _check_pair(a, b)
    return _matrix("matrix_bev", a, b)


def rotated_iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """IoU in 3D of boxes a (A, 7) and b (B, 7), float32 or float64: (A, B) in [0, 1]."""
    _check_pair(a, b)
    return _matrix("matrix_3d", a, b)


def rotated_overlap_pairs(a: Tensor, b: Tensor) -> Tensor:
    """Area in bird's eye view that box a[i] shares with box b[i], both (P, 7): (P,) square metres."""
    _check_pair(a, b)
    check_tensor("b", b, FLOATS, (len(a), 7))
    area = a.new_empty(len(a))
    kernels = _kernels(WARP_FLOAT[a.dtype])
    launch(kernels.pairs, len(a), [array(a.contiguous()), array(b.contiguous()), array(area)], a.device)
    return area


def rotated_nms(boxes: Tensor, scores: Tensor, iou_threshold: float) -> Tensor:
    """Greedy NMS: indices (K,) of the boxes (M, 7) kept, best score first; equal scores keep the lower index first.

    A box is dropped iff its BEV IoU with a kept better box is above the threshold (Sec. 4.1 of the paper).
    """
    order, keep = nms_order(boxes, scores, iou_threshold)
    return order[keep]


def nms_order(boxes: Tensor, scores: Tensor, iou_threshold: float) -> tuple[Tensor, Tensor]:
    """`rotated_nms` in arrays of fixed size: the indices (M,) of all boxes, best score first, and which of these are
    kept (M,) bool. Nothing is read from the device."""
    check_tensor("boxes", boxes, FLOATS, (None, 7))
    check_tensor("scores", scores, FLOATS, (len(boxes),), like=boxes)
    order = torch.sort(scores, descending=True, stable=True).indices
    keep = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    dtype = WARP_FLOAT[boxes.dtype]
    ranked = array(boxes[order].contiguous())
    if boxes.device.type == "cpu":  # one thread compares only boxes that are still there
        launch(_kernels(dtype).nms_greedy, 1, [ranked, dtype(iou_threshold), array(keep)], boxes.device)
    else:  # many threads compare all pairs into a mask of bits, one thread sweeps it
        words = -(-len(boxes) // WORD)
        mask = torch.empty(len(boxes), words, dtype=torch.int64, device=boxes.device)
        removed = torch.zeros(words, dtype=torch.int64, device=boxes.device)
        inputs = [ranked, dtype(iou_threshold), array(mask)]
        launch(_kernels(dtype).nms_mask, (len(boxes), words), inputs, boxes.device)
        launch(_nms_sweep, 1, [array(mask), array(removed), array(keep)], boxes.device)
    return order, keep


def rotated_match(anchors: Tensor, boxes: Tensor, starts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Matches anchors (A, 7) to the boxes (M, 7) of B samples by BEV IoU; sample b owns boxes starts[b]:starts[b+1].

    Returns the best IoU of every anchor (B, A), the box that gives it (B, A) int64 (ties: the lowest box; -1: no
    overlap), and the anchor that overlaps each box most (M,) int64 (ties, to the bit of float32: the lowest anchor;
    -1: no overlap). No matrix of anchors times boxes is made.
    """
    _check_pair(anchors, boxes, "anchors", "boxes")
    check_tensor("starts", starts, (torch.int64,), (None,), like=boxes)
    if len(anchors) >= 2**31:
        raise ValueError(f"anchors: want fewer than 2^31, got {len(anchors)}")
    if len(starts) == 0 or starts[0] != 0 or starts[-1] != len(boxes) or (starts.diff() < 0).any():
        raise ValueError(f"starts: want ascending values from 0 to {len(boxes)}, got {starts.tolist()}")
    batch = len(starts) - 1
    iou = anchors.new_empty(batch, len(anchors))
    match = torch.empty(batch, len(anchors), dtype=torch.int64, device=anchors.device)
    best = torch.full((len(boxes),), -1, dtype=torch.int64, device=anchors.device)
    inputs = [array(t.contiguous()) for t in (anchors, boxes, starts)] + [array(iou), array(match), array(best)]
    launch(_kernels(WARP_FLOAT[anchors.dtype]).match, (batch, len(anchors)), inputs, anchors.device)
    return iou, match, torch.where(best < 0, best, 0x7FFFFFFF - (best & 0x7FFFFFFF))


def _matrix(name: str, a: Tensor, b: Tensor) -> Tensor:
    iou = a.new_empty(len(a), len(b))
    kernel = getattr(_kernels(WARP_FLOAT[a.dtype]), name)
    launch(kernel, (len(a), len(b)), [array(a.contiguous()), array(b.contiguous()), array(iou)], a.device)
    return iou


def _check_pair(a: Tensor, b: Tensor, name_a: str = "a", name_b: str = "b") -> None:
    check_tensor(name_a, a, FLOATS, (None, 7))
    check_tensor(name_b, b, (a.dtype,), (None, 7), like=a)
