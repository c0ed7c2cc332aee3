"""Clouds made ready for the network by many threads: the height of their ground, and their points raised and turned.

Arrays have a fixed size, counts stay on the device and nothing is read from it, so that a CUDA graph captures it. One
thread finds the ground as `hvnet.data.sensor` says, which is the twin; these are its steps, with one launch each.
"""

# inside a kernel Warp's types are calls, and its tensors have no types that mypy knows
# mypy: disable-error-code="valid-type,attr-defined,no-untyped-def,name-defined,misc,operator,index,arg-type"

from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from hvnet.kernels.launch import LARGEST, LOW_BITS, array, check_tensor, launch

NEAREST, NEAR, FAR = 3.0, 15.0, 50.0
"""Metres from the sensor: the ground is looked for between the first two, and up to the third where few points are."""
WINDOW = 0.6
"""Metres of height that hold the lowest points of most cells, which are of 1 m, of a street."""
FEWEST_CELLS = 30
GROUND_SHARE = 0.3
"""Share of the cells whose lowest points must agree; in KITTI's frames it is 0.55 and more."""
SAMPLED = 40_000
"""Points that are looked at: more of them tell the same."""
LOWEST_GROUND = -100.0
"""Metres from the sensor's origin from which on the ground is looked for, up to 1 km above."""
ABOVE_ORIGIN = 0.5
"""Metres from which on ground is above the sensor's origin, as with heights of a map: it has to be plainer then."""
PLAIN_CELLS = 100
UNDERGROUND = 0.05
"""Share of the points that may lie below ground that is above the origin: else it is a ceiling, or treetops."""
FEWEST_POINTS = 10
"""From so many points on a reflectance that is the same everywhere means nothing."""
TOLERANCE = 0.1
"""By how much a reflectance may exceed 1."""

LEVELS = 2**17  # centimetres of height in a key
SIDE = 100  # cells of 1 m along a side of the wider search
CELLS = SIDE * SIDE
STRIDE = 2048  # threads that go through a cloud for a sum or an extreme: few, since they end in one place


def ground_heights(points: Tensor, counts: Tensor) -> Tensor:
    """The height in metres of the ground of B clouds (B, N, 4) float32, NaN where none is found: (B,).

    counts (B,) int32: how many points each has; those after them only fill up the array. See `sensor.find_ground`.
    """
    _check_clouds(points, counts)
    clouds, capacity = points.shape[:2]
    device = points.device
    rows = min(capacity, 2 * SAMPLED)  # as many as there can be with the stride of any count
    keys = torch.empty(clouds, 2, rows, dtype=torch.int32, device=device)
    low = torch.empty(clouds, 2, CELLS, device=device)
    votes = torch.zeros(clouds, 2, 2, dtype=torch.int64, device=device)
    ground = torch.empty(clouds, device=device)
    launch(_ground_keys, keys.shape, [_vectors(points), array(counts), array(keys)], device)
    keys = torch.sort(keys, dim=2).values
    launch(_low_heights, low.shape, [array(keys), array(low)], device)
    low = torch.sort(low, dim=2).values
    launch(_count_votes, low.shape, [array(low), array(votes)], device)
    inputs = [_vectors(points), array(counts), array(low), array(votes)]
    launch(_count_below, (clouds, 2, min(rows, STRIDE)), inputs, device)
    launch(_decide_ground, clouds, [array(counts), array(low), array(votes), array(ground)], device)
    return ground


def place_points(
    points: Tensor, counts: Tensor, shift: Tensor, views: Tensor, point_range: Sequence[float], reflectance: bool
) -> tuple[Tensor, Tensor]:
    """Clouds (B, N, 4) float32 as the network sees them in V views: (B, V, N, 4), and the largest reflectance in range
    if it is more than a tolerance above 1, else 0: (B,).

    counts: (B,) int32, the points of each cloud; the others become NaN
    shift: (B,) metres by which each is raised
    views: (V, 3) cosine and sine of their turns, counter-clockwise, and -1 if y is mirrored after that, else 1

    A reflectance that is NaN or negative, or the same everywhere, is 0, as all are without `reflectance`.
    """
    _check_clouds(points, counts)
    check_tensor("shift", shift, (torch.float32,), (points.shape[0],), like=points)
    check_tensor("views", views, (torch.float32,), (None, 3), like=points)
    clouds, capacity = points.shape[:2]
    placed = torch.empty(clouds, len(views), capacity, 4, device=points.device)
    extremes = torch.zeros(clouds, 3, dtype=torch.int32, device=points.device)
    threads = (clouds, min(capacity, STRIDE))
    launch(_find_extremes, threads, [_vectors(points), array(counts), array(extremes)], points.device)
    low, high = wp.vec3(*point_range[:3]), wp.vec3(*point_range[3:])
    inputs = [_vectors(points), array(counts), array(shift), array(views, 3), low, high, int(reflectance)]
    outputs = [array(extremes), array(placed, 4)]
    launch(_place, (clouds, capacity), [*inputs, *outputs], points.device)
    return placed, extremes[:, 2].view(torch.float32)


def _check_clouds(points: Tensor, counts: Tensor) -> None:
    check_tensor("points", points, (torch.float32,), (None, None, 4))
    check_tensor("counts", counts, (torch.int32,), (points.shape[0],), like=points)


def _vectors(points: Tensor) -> object:
    return array(points, 4)


@wp.func
def _sampled(count: int, row: int):
    """The row-th point that is looked at of `count`, or a negative number where there are no more."""
    i = row * wp.max(count // SAMPLED, 1)
    if i >= count:
        i = -1
    return i


@wp.kernel(enable_backward=False, module="unique")
def _ground_keys(points: wp.array2d(dtype=wp.vec4), counts: wp.array(dtype=wp.int32), keys: wp.array3d(dtype=wp.int32)):
    """Cell and height to the centimetre of a point in one number, for the narrow search and the wide one."""
    b, which, row = wp.tid()
    far = wp.where(which == 0, NEAR, FAR)
    key = CELLS * LEVELS
    i = _sampled(counts[b], row)
    if i >= 0:
        p = points[b, i]
        distance = wp.length(wp.vec2(p[0], p[1]))
        # false for NaN
        if distance >= NEAREST and distance < far and p[2] > LOWEST_GROUND and p[2] < LOWEST_GROUND + 1000.0:
            side = int(2.0 * far)
            x = wp.clamp(int(p[0] + far), 0, side - 1)
            y = wp.clamp(int(p[1] + far), 0, side - 1)
            key = (x * side + y) * LEVELS + int((p[2] - LOWEST_GROUND) * 100.0)
    keys[b, which, row] = key


@wp.func
def _first_key(keys: wp.array3d(dtype=wp.int32), b: int, which: int, value: int):
    """The first of the ascending keys that is not below the value."""
    first = int(0)
    last = keys.shape[2]
    while first < last:
        middle = (first + last) // 2
        if keys[b, which, middle] < value:
            first = middle + 1
        else:
            last = middle
    return first


@wp.kernel(enable_backward=False, module="unique")
def _low_heights(keys: wp.array3d(dtype=wp.int32), low: wp.array3d(dtype=wp.float32)):
    """The height that a twentieth of the points of a cell are below; infinite in empty cells."""
    b, which, cell = wp.tid()
    start = _first_key(keys, b, which, cell * LEVELS)
    count = _first_key(keys, b, which, (cell + 1) * LEVELS) - start
    height = wp.inf
    if count > 0:
        height = float(keys[b, which, start + count // 20] % LEVELS) / 100.0 + LOWEST_GROUND
    low[b, which, cell] = height


@wp.func
def _first_above(low: wp.array3d(dtype=wp.float32), b: int, which: int, value: float):
    """The first of the ascending heights that is above the value."""
    first = int(0)
    last = low.shape[2]
    while first < last:
        middle = (first + last) // 2
        if low[b, which, middle] > value:
            last = middle
        else:
            first = middle + 1
    return first


@wp.kernel(enable_backward=False, module="unique")
def _count_votes(low: wp.array3d(dtype=wp.float32), votes: wp.array3d(dtype=wp.int64)):
    """The most heights within a window, and the lowest height at which one with so many starts, in one number."""
    b, which, i = wp.tid()
    height = low[b, which, i]
    if height < wp.inf:
        count = _first_above(low, b, which, height + WINDOW) - i
        wp.atomic_max(votes, b, which, 0, (wp.int64(count) << wp.int64(32)) | wp.int64(LARGEST - i))


@wp.func
def _voted(low: wp.array3d(dtype=wp.float32), votes: wp.array3d(dtype=wp.int64), b: int, which: int):
    """The height in the middle of the window with the most votes, and how many these are."""
    vote = votes[b, which, 0]
    count = int(vote >> wp.int64(32))
    height = wp.inf
    if count > 0:
        height = low[b, which, LARGEST - wp.int32(vote & LOW_BITS) + count // 2]
    return height, count


@wp.kernel(enable_backward=False, module="unique")
def _count_below(
    points: wp.array2d(dtype=wp.vec4),
    counts: wp.array(dtype=wp.int32),
    low: wp.array3d(dtype=wp.float32),
    votes: wp.array3d(dtype=wp.int64),
):
    """How many points lie below the window's height by more than a window."""
    b, which, thread = wp.tid()
    height, _count = _voted(low, votes, b, which)
    if height < ABOVE_ORIGIN or height == wp.inf:  # asked for only where ground is above the origin
        return
    below = int(0)
    row = thread
    i = _sampled(counts[b], row)
    while i >= 0:
        if points[b, i][2] < height - WINDOW:
            below += 1
        row += STRIDE
        i = _sampled(counts[b], row)
    if below > 0:
        wp.atomic_add(votes, b, which, 1, wp.int64(below))


@wp.kernel(enable_backward=False, module="unique")
def _decide_ground(
    counts: wp.array(dtype=wp.int32),
    low: wp.array3d(dtype=wp.float32),
    votes: wp.array3d(dtype=wp.int64),
    ground: wp.array(dtype=wp.float32),
):
    """The height of the narrow search if it is the ground's, else that of the wide one, else NaN."""
    b = wp.tid()
    stride = wp.max(counts[b] // SAMPLED, 1)
    looked_at = (counts[b] + stride - 1) // stride
    found = float(wp.nan)
    for which in range(1, -1, -1):
        height, count = _voted(low, votes, b, which)
        total = _first_above(low, b, which, 1e30)
        enough = total >= FEWEST_CELLS and float(count) >= GROUND_SHARE * float(total)
        if height >= ABOVE_ORIGIN:
            below = float(votes[b, which, 1]) / float(looked_at)
            enough = enough and total >= PLAIN_CELLS and below < UNDERGROUND
        if enough:
            found = height
    ground[b] = found


@wp.kernel(enable_backward=False, module="unique")
def _find_extremes(
    points: wp.array2d(dtype=wp.vec4), counts: wp.array(dtype=wp.int32), extremes: wp.array2d(dtype=wp.int32)
):
    """The least and largest known reflectance as the bits of a float >= 0, the least subtracted from the largest int:
    0 where none is known."""
    b, thread = wp.tid()
    low = int(0)
    high = int(0)
    for i in range(thread, counts[b], STRIDE):
        value = points[b, i][3]
        if value == value:
            bits = int(0)
            if value > 0.0:
                bits = wp.cast(value, wp.int32)
            low = wp.max(low, LARGEST - bits)
            high = wp.max(high, bits)
    if low > 0:
        wp.atomic_max(extremes, b, 0, low)
        wp.atomic_max(extremes, b, 1, high)


@wp.kernel(enable_backward=False, module="unique")
def _place(
    points: wp.array2d(dtype=wp.vec4),
    counts: wp.array(dtype=wp.int32),
    shift: wp.array(dtype=wp.float32),
    views: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    high: wp.vec3,
    reflectance: int,
    extremes: wp.array2d(dtype=wp.int32),
    placed: wp.array3d(dtype=wp.vec4),
):
    b, i = wp.tid()
    p = wp.vec4(wp.nan, wp.nan, wp.nan, 0.0)
    if i < counts[b]:
        p = points[b, i]
        means_nothing = counts[b] >= FEWEST_POINTS and LARGEST - extremes[b, 0] >= extremes[b, 1]
        if reflectance == 0 or means_nothing or not p[3] > 0.0:
            p[3] = 0.0
    z = p[2] + shift[b]
    for v in range(views.shape[0]):
        x = views[v][0] * p[0] - views[v][1] * p[1]
        y = views[v][2] * (views[v][1] * p[0] + views[v][0] * p[1])
        placed[b, v, i] = wp.vec4(x, y, z, p[3])
        inside = x >= low[0] and x < high[0] and y >= low[1] and y < high[1] and z >= low[2] and z < high[2]
        if inside and p[3] > 1.0 + TOLERANCE:
            wp.atomic_max(extremes, b, 2, wp.cast(p[3], wp.int32))
