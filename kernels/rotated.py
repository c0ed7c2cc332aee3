"""Rotated boxes (x, y, z, l, w, h, yaw): overlap and IoU in BEV and 3D, NMS, and matching of anchors to boxes.

The same for boxes (cx, cy, w, h, angle) as torchvision and detectron2 have them. Nothing here has gradients.

The intersection of two rectangles is exact: in the frame of rectangle a, Green's theorem turns its area into the
integral of clamp(x, -l/2, l/2) dy along the edges of b where |y| <= w/2. That has no list of vertices and no special
case, and it is continuous, so that touching, identical and nearly parallel edges are as exact as any other.
"""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

import functools
from itertools import pairwise
from numbers import Real
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import FLOATS, WARP_FLOAT, array, check_index, check_tensor, launch, many_threads

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

    @wp.func
    def iou_in_group(boxes: wp.array3d(dtype=dtype), g: int, i: int, j: int):
        return iou_bev(boxes[g], i, boxes[g], j)

    @wp.kernel(enable_backward=False, module=module)
    def nms_mask(
        boxes: wp.array3d(dtype=dtype),
        counts: wp.array(dtype=wp.int32),
        thresholds: wp.array(dtype=dtype),
        mask: wp.array3d(dtype=wp.int64),
        keep: wp.array2d(dtype=wp.bool),
    ):
        """Which of the WORD boxes of a word box i overlaps; what no sweep reads is not written."""
        g, i, word = wp.tid()
        if word == 0:
            keep[g, i] = False  # until the sweep says otherwise
        count = wp.min(counts[g], boxes.shape[1])
        if i < count and word >= i // WORD and word * WORD < count:
            threshold = thresholds[g % thresholds.shape[0]]
            bits = wp.int64(0)
            for bit in range(WORD):
                j = word * WORD + bit
                if j > i and j < count and iou_in_group(boxes, g, i, j) > threshold:
                    bits = bits | (wp.int64(1) << wp.int64(bit))
            mask[g, i, word] = bits

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
        labels: wp.array(dtype=wp.int64),
        classes: int,
        iou: wp.array2d(dtype=dtype),
        box: wp.array2d(dtype=wp.int64),
        best: wp.array(dtype=wp.int64),
    ):
        sample, i = wp.tid()
        highest = zero
        of_highest = int(-1)
        group = sample * classes
        if classes > 1:
            group += wp.clamp(int(labels[i]), 0, classes - 1)
        for j in range(wp.max(int(starts[group]), 0), wp.min(int(starts[group + 1]), boxes.shape[0])):
            value = iou_bev(anchors, i, boxes, j)
            if value > highest:
                highest = value
                of_highest = j
            if value > zero:
                # the order of the maximum does not matter: bits of the IoU above, then the lowest anchor
                key = wp.int64(wp.cast(wp.float32(value), wp.int32)) << wp.int64(32)
                wp.atomic_max(best, j, key | wp.int64(0x7FFFFFFF - i))
        iou[sample, i] = highest
        box[sample, i] = wp.int64(of_highest)

    return SimpleNamespace(
        matrix_bev=matrix_bev, matrix_3d=matrix_3d, pairs=pairs, nms_mask=nms_mask, nms_greedy=nms_greedy, match=match
    )


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
return __shfl_sync(0xffffffffu, value, lane);
#else
return value;
#endif
"""
)
def _of_lane(value: wp.int64, lane: int) -> wp.int64: ...  # type: ignore[empty-body]


@wp.kernel(enable_backward=False, module="unique")
def _nms_sweep(
    mask: wp.array3d(dtype=wp.int64),
    valid: wp.array2d(dtype=wp.bool),
    counts: wp.array(dtype=wp.int32),
    limit: int,
    lanes: int,
    removed: wp.array2d(dtype=wp.int64),
    keep: wp.array2d(dtype=wp.bool),
):
    """Goes through the boxes of a group, best first; each that is kept removes those that its mask names.

    The lanes of a warp share the words: each marks in its own what is removed, and shows the others the word that the
    walk has come to.
    """
    g, lane = wp.tid()
    count = wp.min(counts[g], valid.shape[1])
    words = (count + WORD - 1) // WORD
    for k in range(lane, words, lanes):
        removed[g, k] = wp.int64(0)
    kept = int(0)
    word = int(0)
    while word < words and kept < limit:
        gone = wp.int64(0)
        if word % lanes == lane:
            gone = removed[g, word]
        gone = _of_lane(gone, word % lanes)
        for bit in range(WORD):
            i = word * WORD + bit
            if i < count and kept < limit and ((gone >> wp.int64(bit)) & wp.int64(1)) == wp.int64(0) and valid[g, i]:
                kept += 1
                gone = gone | mask[g, i, word]
                if lane == 0:
                    keep[g, i] = True
                for k in range(word + 1 + (lane + lanes - (word + 1) % lanes) % lanes, words, lanes):
                    removed[g, k] = removed[g, k] | mask[g, i, k]
        word += 1


def rotated_iou_bev(a: Tensor, b: Tensor) -> Tensor:
    """IoU in bird's eye view of boxes a (A, 7) and b (B, 7), float32 or float64: (A, B) in [0, 1].

    Raises TypeError or ValueError naming the argument, also for a negative size.
    """
    _check_pair(a, b)
    return _iou_bev(a.detach(), b.detach())


def rotated_iou_3d(a: Tensor, b: Tensor) -> Tensor:
    """IoU in 3D of boxes a (A, 7) and b (B, 7), float32 or float64: (A, B) in [0, 1].

    Raises TypeError or ValueError naming the argument, also for a negative size.
    """
    _check_pair(a, b)
    return _iou_3d(a.detach(), b.detach())


def rotated_overlap_pairs(a: Tensor, b: Tensor) -> Tensor:
    """Area in bird's eye view that box a[i] shares with box b[i], both (P, 7): (P,) square metres.

    Raises TypeError or ValueError naming the argument, also for a negative length or width; heights are not read.
    """
    _check_pair(a, b)
    check_tensor("b", b, FLOATS, (a.shape[0], 7))
    return _overlap_pairs(a.detach(), b.detach())


def rotated_nms(boxes: Tensor, scores: Tensor, iou_threshold: float) -> Tensor:
    """Greedy NMS: indices (K,) int64 of the boxes (M, 7) kept, best score first; equal scores keep the lower index
    first, and a NaN score is never kept.

    A box is dropped iff its BEV IoU with a kept better box is above the threshold (Sec. 4.1 of the paper). Raises
    TypeError or ValueError naming the argument, also for a negative size.
    """
    _check_scored(boxes, scores, iou_threshold, 7)
    return _nms(boxes.detach(), scores.detach(), None, float(iou_threshold))


def nms_order(boxes: Tensor, scores: Tensor, iou_threshold: float) -> tuple[Tensor, Tensor]:
    """`rotated_nms` in arrays of fixed size: the indices (M,) int64 of all boxes, best score first (NaN before all),
    and which of these are kept (M,) bool.

    Nothing is read from the device, so that on CUDA a negative size is not seen; on the CPU it is a ValueError.
    """
    _check_scored(boxes, scores, iou_threshold, 7)
    return _nms_order(boxes.detach(), scores.detach(), float(iou_threshold))


def nms_groups(boxes: Tensor, valid: Tensor, counts: Tensor, iou_thresholds: Tensor, limit: int) -> Tensor:
    """Greedy NMS of G groups of boxes at once, each with its best box first: which are kept (G, M) bool.

    boxes: (G, M, 7 or more), float32 or float64; what follows a box is not read
    valid: (G, M) bool; a box that is not is not kept and drops none
    counts: (G,) int32: the boxes of each group, those after them only fill up the array
    iou_thresholds: (T,) of the boxes' dtype; group g has the threshold g % T
    limit: how many boxes of a group are kept at most

    Nothing is read from the device. Raises TypeError or ValueError naming the argument.
    """
    check_tensor("boxes", boxes, FLOATS, (None, None, None))
    if boxes.shape[2] < 7:
        raise ValueError(f"boxes: want 7 columns or more, got {boxes.shape[2]}")
    check_tensor("valid", valid, (torch.bool,), tuple(boxes.shape[:2]), like=boxes)
    check_tensor("counts", counts, (torch.int32,), (boxes.shape[0],), like=boxes)
    check_tensor("iou_thresholds", iou_thresholds, (boxes.dtype,), (None,), like=boxes)
    if len(iou_thresholds) == 0:
        raise ValueError("iou_thresholds: want one or more, got none")
    if limit < 0:
        raise ValueError(f"limit: want 0 or more, got {limit}")
    return _nms_groups(
        boxes.detach().contiguous(), valid.contiguous(), counts.contiguous(), iou_thresholds.contiguous(), limit
    )


def rotated_match(
    anchors: Tensor, boxes: Tensor, starts: Tensor, *, labels: Tensor | None = None, classes: int = 1
) -> tuple[Tensor, Tensor, Tensor]:
    """Matches anchors (A, 7) to the boxes (M, 7) of B samples by BEV IoU; sample b owns boxes starts[b]:starts[b+1].

    labels: the class of every anchor (A,), int64 in [0, classes), where there are several. Boxes are then in the order
    of samples and classes, and starts has B * classes + 1 values: an anchor sees starts[g]:starts[g+1] of sample b, g
    its class + b * classes.

    Returns the best IoU of every anchor (B, A), the box that gives it (B, A) int64 (ties: the lowest box; -1: no
    overlap), and the anchor that overlaps each box most (M,) int64 (ties, to the bit of float32: the lowest anchor;
    -1: no overlap). A box that is not finite overlaps nothing. No matrix of anchors times boxes is made.

    Raises TypeError or ValueError naming the argument; on the CPU also for a negative size, for a label that is no
    class, and for starts that do not ascend from 0 to M. On CUDA nothing is read from the device, so that these are not
    seen.
    """
    _check_pair(anchors, boxes, "anchors", "boxes")
    check_tensor("starts", starts, (torch.int64,), (None,), like=boxes)
    if anchors.shape[0] >= 2**31:
        raise ValueError(f"anchors: want fewer than 2^31, got {anchors.shape[0]}")
    if classes < 1 or (classes > 1 and labels is None):
        raise ValueError(f"classes: want 1, or with labels 1 or more, got {classes}")
    if labels is not None:
        check_tensor("labels", labels, (torch.int64,), (anchors.shape[0],), like=boxes)
    if starts.shape[0] == 0 or (starts.shape[0] - 1) % classes:
        raise ValueError(f"starts: want {classes} for every sample and one more, got {starts.shape[0]}")
    return _match(anchors.detach(), boxes.detach(), starts, labels, classes)


def box_iou_rotated(a: Tensor, b: Tensor, *, degrees: bool = True) -> Tensor:
    """IoU of boxes a (A, 5) and b (B, 5), float32 or float64: (A, B) in [0, 1].

    A box is (cx, cy, w, h, angle) as in torchvision and detectron2: in an image, whose y points down, w lies along x
    and h along y before the box is turned by the angle, counter-clockwise as it is seen; in degrees, or in radians
    with degrees=False. Raises TypeError or ValueError naming the argument, also for a negative size.
    """
    _check_pair(a, b, columns=5)
    return _iou_bev(_upright(a.detach(), degrees), _upright(b.detach(), degrees))


def nms_rotated(boxes: Tensor, scores: Tensor, iou_threshold: float, *, degrees: bool = True) -> Tensor:
    """`rotated_nms` of boxes (M, 5) as `box_iou_rotated` has them: indices (K,) int64 kept, best score first.

    A box is dropped iff its IoU with a kept better box is above the threshold.
    """
    _check_scored(boxes, scores, iou_threshold, 5)
    return _nms(_upright(boxes.detach(), degrees), scores.detach(), None, float(iou_threshold))


def batched_nms_rotated(
    boxes: Tensor, scores: Tensor, idxs: Tensor, iou_threshold: float, *, degrees: bool = True
) -> Tensor:
    """`nms_rotated` in which a box is dropped only by a better one of the same group (a class, an image).

    idxs: (M,) int32 or int64, the group of each box

    Returns the indices (K,) int64 kept of all groups, best score first. The boxes are compared where they are, not
    moved apart group by group, so that the result is that of one `nms_rotated` a group to the bit.
    """
    _check_scored(boxes, scores, iou_threshold, 5)
    check_tensor("idxs", idxs, (torch.int32, torch.int64), (boxes.shape[0],), like=boxes)
    return _nms(_upright(boxes.detach(), degrees), scores.detach(), idxs.long(), float(iou_threshold))


def _upright(boxes: Tensor, degrees: bool) -> Tensor:
    """Boxes (M, 7) of (cx, cy, w, h, angle) (M, 5).

    Where y points down, counter-clockwise is a negative yaw. The sign is of no matter to a box alone, but it is to two
    of them with different centres.
    """
    angle = torch.deg2rad(boxes[:, 4:]) if degrees else boxes[:, 4:]
    flat = torch.zeros_like(angle)
    return torch.cat((boxes[:, :2], flat, boxes[:, 2:4], flat, -angle), dim=1)


def _check_pair(a: Tensor, b: Tensor, name_a: str = "a", name_b: str = "b", columns: int = 7) -> None:
    check_tensor(name_a, a, FLOATS, (None, columns))
    check_tensor(name_b, b, (a.dtype,), (None, columns), like=a)


def _check_scored(boxes: Tensor, scores: Tensor, iou_threshold: float, columns: int) -> None:
    check_tensor("boxes", boxes, FLOATS, (None, columns))
    check_tensor("scores", scores, FLOATS, (boxes.shape[0],), like=boxes)
    if not isinstance(iou_threshold, Real) or isinstance(iou_threshold, bool):
        raise TypeError(f"iou_threshold: want a number, got {type(iou_threshold).__name__}")


def _check_sizes(name: str, boxes: Tensor, count: int = 3) -> None:
    """Checks that length, width and (count 3) height are not negative; NaN is let through. Reads the device."""
    sizes = boxes[:, 3 : 3 + count]
    if sizes.numel() and not sizes.min() >= 0:  # below 0, or NaN, which hides the others
        smallest = sizes.nan_to_num(nan=0.0).min().item()
        if smallest < 0:
            raise ValueError(f"{name}: want sizes of 0 or more, got {smallest:g}")


def _iou_outputs(a: Tensor, b: Tensor) -> Tensor:
    return a.new_empty(a.shape[0], b.shape[0])


@torch.library.custom_op("hvnet::rotated_iou_bev", mutates_args=())
def _iou_bev(a: Tensor, b: Tensor) -> Tensor:
    return _fill_matrix("matrix_bev", a, b)


@torch.library.custom_op("hvnet::rotated_iou_3d", mutates_args=())
def _iou_3d(a: Tensor, b: Tensor) -> Tensor:
    return _fill_matrix("matrix_3d", a, b)


_iou_bev.register_fake(_iou_outputs)
_iou_3d.register_fake(_iou_outputs)


def _fill_matrix(name: str, a: Tensor, b: Tensor) -> Tensor:
    _check_sizes("a", a)
    _check_sizes("b", b)
    iou = _iou_outputs(a, b)
    kernel = getattr(_kernels(WARP_FLOAT[a.dtype]), name)
    launch(kernel, iou.shape, [array(a.contiguous()), array(b.contiguous()), array(iou)], a.device)
    return iou


def _overlap_pairs_outputs(a: Tensor, b: Tensor) -> Tensor:
    return a.new_empty(a.shape[0])


@torch.library.custom_op("hvnet::rotated_overlap_pairs", mutates_args=())
def _overlap_pairs(a: Tensor, b: Tensor) -> Tensor:
    _check_sizes("a", a, 2)
    _check_sizes("b", b, 2)
    area = _overlap_pairs_outputs(a, b)
    kernel = _kernels(WARP_FLOAT[a.dtype]).pairs
    launch(kernel, len(a), [array(a.contiguous()), array(b.contiguous()), array(area)], a.device)
    return area


_overlap_pairs.register_fake(_overlap_pairs_outputs)


def _nms_order_outputs(boxes: Tensor, scores: Tensor, iou_threshold: float) -> tuple[Tensor, Tensor]:
    count = boxes.shape[0]
    return boxes.new_empty(count, dtype=torch.int64), boxes.new_empty(count, dtype=torch.bool)


@torch.library.custom_op("hvnet::nms_order", mutates_args=())
def _nms_order(boxes: Tensor, scores: Tensor, iou_threshold: float) -> tuple[Tensor, Tensor]:
    if not many_threads(boxes.device):  # it reads the device
        _check_sizes("boxes", boxes)
    order, keep = _rank(boxes, scores, iou_threshold)
    _suppress(boxes[order], iou_threshold, keep)
    return order, keep


_nms_order.register_fake(_nms_order_outputs)


@torch.library.custom_op("hvnet::rotated_nms", mutates_args=())
def _nms(boxes: Tensor, scores: Tensor, group: Tensor | None, iou_threshold: float) -> Tensor:
    _check_sizes("boxes", boxes)
    order, keep = _rank(boxes, scores, iou_threshold)
    if group is None:
        _suppress(boxes[order], iou_threshold, keep)
    else:
        group, by_group = torch.sort(group[order], stable=True)  # group after group, each with its best box first
        sizes = torch.unique_consecutive(group, return_counts=True)[1].tolist()
        keep_by_group = keep[by_group]
        for rows, of_group in zip(boxes[order[by_group]].split(sizes), keep_by_group.split(sizes), strict=True):
            _suppress(rows, iou_threshold, of_group)
        keep[by_group] = keep_by_group
    return order[keep]


@_nms.register_fake
def _(boxes: Tensor, scores: Tensor, group: Tensor | None, iou_threshold: float) -> Tensor:
    return boxes.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.int64)


def _rank(boxes: Tensor, scores: Tensor, iou_threshold: float) -> tuple[Tensor, Tensor]:
    """The indices of the boxes, best score first, and which of these may be kept: all but those of a NaN score."""
    order, keep = _nms_order_outputs(boxes, scores, iou_threshold)
    ranked = torch.empty_like(scores)
    torch.sort(scores, descending=True, stable=True, out=(ranked, order))
    torch.eq(ranked, ranked, out=keep)
    return order, keep


def _suppress(boxes: Tensor, iou_threshold: float, keep: Tensor) -> None:
    """Greedy NMS of boxes (M, 7), the best first: one that is kept clears keep (M,) bool of the worse it overlaps."""
    if many_threads(boxes.device):
        _suppress_in_parallel(boxes, iou_threshold, keep)
    else:
        _suppress_serially(boxes, iou_threshold, keep)


def _suppress_serially(boxes: Tensor, iou_threshold: float, keep: Tensor) -> None:
    """One thread compares only boxes that are still there."""
    dtype = WARP_FLOAT[boxes.dtype]
    launch(_kernels(dtype).nms_greedy, 1, [array(boxes), dtype(iou_threshold), array(keep)], boxes.device)


def _suppress_in_parallel(boxes: Tensor, iou_threshold: float, keep: Tensor) -> None:
    """Many threads compare all pairs into a mask of bits, which one warp sweeps."""
    counts = torch.full((1,), len(boxes), dtype=torch.int32, device=boxes.device)
    threshold = torch.full((1,), iou_threshold, dtype=boxes.dtype, device=boxes.device)
    keep.copy_(_nms_groups(boxes[None].contiguous(), keep[None], counts, threshold, len(boxes))[0])


def _nms_groups_outputs(boxes: Tensor, valid: Tensor, counts: Tensor, iou_thresholds: Tensor, limit: int) -> Tensor:
    return torch.empty_like(valid, memory_format=torch.contiguous_format)


@torch.library.custom_op("hvnet::nms_groups", mutates_args=())
def _nms_groups(boxes: Tensor, valid: Tensor, counts: Tensor, iou_thresholds: Tensor, limit: int) -> Tensor:
    keep = _nms_groups_outputs(boxes, valid, counts, iou_thresholds, limit)
    groups, count = valid.shape
    words = -(-count // WORD)
    mask = torch.empty(groups, count, words, dtype=torch.int64, device=boxes.device)
    removed = torch.empty(groups, words, dtype=torch.int64, device=boxes.device)
    inputs = [array(boxes), array(counts), array(iou_thresholds), array(mask), array(keep)]
    launch(_kernels(WARP_FLOAT[boxes.dtype]).nms_mask, mask.shape, inputs, boxes.device)
    lanes = 32 if boxes.device.type == "cuda" else 1
    inputs = [array(mask), array(valid), array(counts), limit, lanes, array(removed), array(keep)]
    launch(_nms_sweep, (groups, lanes), inputs, boxes.device)
    return keep


_nms_groups.register_fake(_nms_groups_outputs)


def _match_outputs(
    anchors: Tensor, boxes: Tensor, starts: Tensor, labels: Tensor | None, classes: int
) -> tuple[Tensor, Tensor, Tensor]:
    shape = ((starts.shape[0] - 1) // classes, anchors.shape[0])
    iou, match = anchors.new_empty(shape), anchors.new_empty(shape, dtype=torch.int64)
    return iou, match, anchors.new_empty(boxes.shape[0], dtype=torch.int64)


@torch.library.custom_op("hvnet::rotated_match", mutates_args=())
def _match(
    anchors: Tensor, boxes: Tensor, starts: Tensor, labels: Tensor | None, classes: int
) -> tuple[Tensor, Tensor, Tensor]:
    if not many_threads(boxes.device):  # the checks read the device
        ends = starts.tolist()
        if ends[0] != 0 or ends[-1] != len(boxes) or any(end < start for start, end in pairwise(ends)):
            raise ValueError(f"starts: want ascending values from 0 to {len(boxes)}, got {ends}")
        _check_sizes("anchors", anchors)
        _check_sizes("boxes", boxes)
        if labels is not None:
            check_index("labels", labels, classes)
    iou, match, best = _match_outputs(anchors, boxes, starts, labels, classes)
    best.fill_(-1)
    inputs = [array(t.contiguous()) for t in (anchors, boxes, starts, starts[:0] if labels is None else labels)]
    outputs = [array(iou), array(match), array(best)]
    launch(_kernels(WARP_FLOAT[anchors.dtype]).match, iou.shape, [*inputs, classes, *outputs], anchors.device)
    best.copy_(torch.where(best < 0, best, 0x7FFFFFFF - (best & 0x7FFFFFFF)))  # from keys to anchors
    return iou, match, best


_match.register_fake(_match_outputs)
