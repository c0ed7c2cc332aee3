"""Points to boxes in operators that every runtime has: what detector.onnx holds.

The kernels have no part in it. What they do with an index of voxels is done here with scatters, and every voxel has the
number of one of its points, so that nothing is sorted and no length depends on how many voxels there are. The maxima
and sums go by ScatterElements, which is defined for indices that repeat; onnxruntime's ScatterND has threads that
overwrite each other's results then.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hvnet.data.ground import lower
from hvnet.data.sensor import common_height, low_heights, shift_to
from hvnet.kernels.place import FAR, FEWEST_POINTS, NEAR, SAMPLED
from hvnet.kernels.voxel import Grid
from hvnet.network.anchors import anchors_per_cell, decode, level_step
from hvnet.network.detector import Detector
from hvnet.network.encoder import VFE, AttentiveVFE, HybridVoxelEncoder, folded
from hvnet.network.grids import projection_grids
from hvnet.network.head import LOCATION_VALUES, regress, scores_of


class PointVoxels(NamedTuple):
    """The voxels of one scale that points are in."""

    cell: Tensor  # (N,) int64, Eq. 1
    voxel: Tensor  # (N,) int64, the last point in the voxel of each point
    knowledge: Tensor  # (N, 8) of Eq. 2: offsets to the voxel's mean, reflectance, the mean


class Layer:
    """AVFE, AVFEO or VoxelNet's layer in evaluation, its batch norms folded in."""

    @torch.no_grad()
    def __init__(self, layer: AttentiveVFE | VFE) -> None:
        self.attentive = isinstance(layer, AttentiveVFE)
        if isinstance(layer, AttentiveVFE):
            self.relu = layer.relu
            self.features = folded(layer.features, layer.features_norm, None)
            self.knowledge = folded(layer.knowledge, layer.knowledge_norm, None)
        else:
            self.relu = True
            self.features = folded(layer.features, layer.norm, None)
            # the bias is that of the features
            knowledge = folded(layer.knowledge, layer.norm, None)
            self.knowledge = torch.vstack((knowledge[:-1], torch.zeros_like(knowledge[-1:])))

    def __call__(self, features: Tensor, voxels: PointVoxels) -> Tensor:
        """M (N, q) of a scale from what `features` makes of the rows (N, q)."""
        attention = torch.addmm(self.knowledge[-1], voxels.knowledge, self.knowledge[:-1])
        if not self.attentive:
            return torch.relu(features + attention)
        return features.relu() * attention.relu() if self.relu else features * attention


class Place(nn.Module):
    """A cloud made ready, as `Detector.place`, and its boxes taken back."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.detector = detector
        assert isinstance(detector.encoder, HybridVoxelEncoder)
        # the last cells may reach past the range; which points are in them is for the encoder to say
        self.past = max(max(grid.cell) for grid in detector.encoder.feature_grids + detector.encoder.projection_grids)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points (N, 4) to those near the range in x and y, the shift () and the relief (1, S, S)."""
        detector = self.detector
        xyz, reflectance = points[:, :3], known_reflectance(points[:, 3])
        if not detector.reflectance:
            reflectance = torch.zeros_like(reflectance)
        shift = detector.fixed_shift[0]
        if detector.ground is not None and detector.sensor_height == "found":
            shift = shift_to(ground_height(sampled(xyz, SAMPLED)), detector.ground)
        xyz = torch.cat((xyz[:, :2], xyz[:, 2:] + shift), dim=1)
        relief = detector.relief(xyz[None]) if detector.is_flat else torch.zeros(1, 2, 2)
        x_min, y_min, _, x_max, y_max, _ = detector.config.encoder.point_range
        x, y = xyz[:, 0], xyz[:, 1]
        x_max, y_max = x_max + self.past, y_max + self.past
        kept = ((x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max)).nonzero().squeeze(1)
        xyz, reflectance = xyz.index_select(0, kept), reflectance.index_select(0, kept)
        if detector.is_flat:
            xyz = lower(xyz[None], relief)[0]
        return torch.cat((xyz, reflectance[:, None]), dim=1), shift, relief

    def take_back(self, boxes: Tensor, shift: Tensor, relief: Tensor) -> Tensor:
        """Boxes (K, 7) at the heights of the cloud, as `Detector.take_back`."""
        if self.detector.is_flat:
            boxes = lower(boxes[None], -relief)[0]
        return torch.cat((boxes[:, :2], boxes[:, 2:3] - shift, boxes[:, 3:]), dim=1)


class Encoder(nn.Module):
    """An encoder that keeps all points, in evaluation."""

    def __init__(self, encoder: HybridVoxelEncoder) -> None:
        super().__init__()
        self.feature_grids, self.projection_grids = encoder.feature_grids, encoder.projection_grids
        self.avfe, self.avfeo = Layer(encoder.avfe), Layer(encoder.avfeo)
        halves = self.avfeo.features[:-1].chunk(2 * len(encoder.feature_grids))
        self.product_weight, self.maxima_weights = torch.cat(halves[0::2]), halves[1::2]

    def forward(self, points: Tensor) -> list[Tensor]:
        """Placed points (N, 4) to the pseudo-images (1, N_H, N_L, N_W), finest first."""
        grids = list(dict.fromkeys(self.feature_grids + self.projection_grids))
        cells = [cells_of(points, grid) for grid in grids]
        kept = (torch.stack(cells).amin(dim=0) >= 0).nonzero().squeeze(1)
        points = points.index_select(0, kept)
        voxels = {
            grid: voxels_of(points, cell.index_select(0, kept), grid) for grid, cell in zip(grids, cells, strict=True)
        }
        features = torch.addmm(self.avfe.features[-1], points, self.avfe.features[:-1])
        products = [self.avfe(features, voxels[grid]) for grid in self.feature_grids]
        context = torch.addmm(self.avfeo.features[-1], torch.cat(products, dim=1), self.product_weight)
        for product, grid, weight in zip(products, self.feature_grids, self.maxima_weights, strict=True):
            voxel = voxels[grid].voxel
            maxima = row_maxima(product, voxel, torch.zeros_like(product)) @ weight
            context = context + maxima.index_select(0, voxel)
        images = []
        for grid in self.projection_grids:
            empty = context.new_zeros(grid.shape[0] * grid.shape[1], context.shape[1])
            image = row_maxima(self.avfeo(context, voxels[grid]), voxels[grid].cell, empty)
            images.append(image.view(1, *grid.shape, -1).permute(0, 3, 1, 2))
        return images


class Candidates(nn.Module):
    """The head of a class: the best of its anchors above the threshold, regressed and decoded."""

    def __init__(self, detector: Detector, label: int) -> None:
        super().__init__()
        config, self.label = detector.config, label
        self.head, self.entry = config.head, config.head.classes[label]
        self.weight = detector.regression_weights[label]
        self.per_cell = anchors_per_cell(self.entry)
        cells = [length // level_step(config, self.entry) for length in projection_grids(config.encoder)[0].shape]
        self.columns = cells[1]
        # what is the same in every cell is written to the file once
        anchors = detector.anchors[label].view(*cells, self.per_cell, 7)
        self.x, self.y = anchors[:, 0, 0, :1].clone(), anchors[0, :, 0, 1:2].clone()
        self.cell_anchors = anchors[0, 0, :, 2:].clone()

    def forward(self, level: Tensor, maps: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """The pyramid level (1, C, N_L, N_W) and the maps of the score and the IoU, if there is one, to boxes (K, 7),
        scores (K,) and labels (K,), the best first.

        As `Detector.candidates`; boxes that are not finite are left out.
        """
        head, rows = self.head, [each.permute(0, 2, 3, 1).flatten() for each in maps]
        scores = scores_of(rows[0], rows[1] if len(rows) > 1 else None)
        chosen = (scores > head.score_threshold).nonzero().squeeze(1)
        scores, best = best_of(scores.index_select(0, chosen), head.candidates)
        chosen = chosen.index_select(0, best)
        values = regress(level, chosen, self.weight, self.per_cell)
        count = LOCATION_VALUES[head.regression]
        direction = values[:, count + 2 :].argmax(dim=1) if head.direction else None
        cell = chosen // self.per_cell
        x = self.x.index_select(0, cell // self.columns)
        y = self.y.index_select(0, cell % self.columns)
        anchors = torch.cat((x, y, self.cell_anchors.index_select(0, chosen % self.per_cell)), dim=1)
        boxes = decode(values[:, :count], values[:, count : count + 2], direction, anchors)
        # the sum is finite if all of them are, which are bounded but for a NaN
        finite = (boxes.sum(dim=1).abs() < math.inf).nonzero().squeeze(1)
        boxes, scores = boxes.index_select(0, finite), scores.index_select(0, finite)
        return boxes, scores, torch.full_like(scores, self.label, dtype=torch.int64)


class PointsToBoxes(nn.Module):
    """A detector for one cloud: points (N, 4) to boxes (K, 7), scores (K,) and labels (K,) int64.

    As `Detector.__call__`, but for a reflectance above 1, which is taken as it is. Without `nms` these are the
    candidates, class after class, the best first.
    """

    def __init__(self, detector: Detector, nms: bool = True) -> None:
        """The detector has one view of the cloud, float32, and an encoder that keeps all points."""
        super().__init__()
        assert isinstance(detector.encoder, HybridVoxelEncoder)
        entries = detector.entries
        self.nms, self.detections = nms, detector.config.head.detections
        self.nms_iou = torch.tensor([entry.nms_iou for entry in entries])
        self.place, self.encoder, self.backbone = Place(detector), Encoder(detector.encoder), detector.backbone
        self.score_maps = detector.score_maps
        self.heads = nn.ModuleList([Candidates(detector, label) for label in range(len(entries))])
        self.levels = [entry.level for entry in entries]

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points (N, 4): x, y, z in metres and reflectance in [0, 1]."""
        points, shift, relief = self.place(points)
        levels = self.backbone(self.encoder(points))
        maps = self.score_maps(levels)
        parts = [head(levels[level], own) for head, level, own in zip(self.heads, self.levels, maps, strict=True)]
        boxes, scores, labels = (torch.cat(column) for column in zip(*parts, strict=True))
        if self.nms:
            kept = suppress(boxes, labels, self.nms_iou, self.detections)
            boxes, scores, labels = (each.index_select(0, kept) for each in (boxes, scores, labels))
        return self.place.take_back(boxes, shift, relief), scores, labels


def known_reflectance(values: Tensor) -> Tensor:
    """As `sensor.as_points`: reflectances (N,), 0 where it is NaN, and everywhere if it is the same everywhere."""
    clean = values.nan_to_num(0.0, math.inf, -math.inf).clamp(min=0)
    both = torch.stack((clean, -clean)).masked_fill(values.isnan(), math.inf)
    # with one more column there is a least value of no points, too
    least, negative_of_largest = torch.cat((both, torch.full((2, 1), math.inf)), dim=1).amin(dim=1).unbind()
    few = torch.ones_like(values).sum() < FEWEST_POINTS
    return torch.where(few | (least < -negative_of_largest), clean, 0.0)


@torch.jit.script_if_tracing
def sampled(points: Tensor, count: int) -> Tensor:
    """The points that `sensor.find_ground` looks at, about `count`."""
    return points[:: max(1, points.size(0) // count)]


def ground_height(points: Tensor) -> Tensor:
    """As `sensor.find_ground`, for the sampled points (N, 3)."""
    near, enough = common_height(low_heights(points, NEAR), points)
    far, enough_far = common_height(low_heights(points, FAR), points)
    return torch.where(enough, near, torch.where(enough_far, far, math.nan))


def cells_of(points: Tensor, grid: Grid) -> Tensor:
    """As `voxel.cursors`: the cell (N,) int64 of points (N, 4) in a grid, -1 outside."""
    origin = points.new_tensor([grid.x_min, grid.y_min])
    reciprocal = points.new_tensor([1 / grid.cell[0], 1 / grid.cell[1]])
    x, y = torch.floor((points[:, :2] - origin) * reciprocal).unbind(1)
    z, reflectance = points[:, 2], points[:, 3]
    inside = (x >= 0) & (x < grid.cells[0]) & (y >= 0) & (y < grid.cells[1])
    inside = inside & (z >= grid.z_min) & (z < grid.z_max) & (reflectance.abs() < math.inf)
    x, y = (torch.where(inside, each, 0.0).long() for each in (x, y))
    return torch.where(inside, x * grid.shape[1] + y, -1)


def voxels_of(points: Tensor, cell: Tensor, grid: Grid) -> PointVoxels:
    """The voxels of points (N, 4) in cells (N,) of a grid, and Eq. 2."""
    number = torch.ones_like(cell)[:, None].cumsum(0) - 1
    # as a column, since a table of one dimension would be written to the file
    table = number.new_zeros(grid.shape[0] * grid.shape[1], number.shape[1])
    voxel = table.scatter_reduce(0, cell[:, None], number, "amax").index_select(0, cell).squeeze(1)
    rows = torch.cat((points, torch.ones_like(points[:, :1])), dim=1)
    sums = torch.zeros_like(rows).scatter_add(0, voxel[:, None].expand(-1, 5), rows)
    sums = sums.index_select(0, voxel)
    mean = sums[:, :4] / sums[:, 4:]
    return PointVoxels(cell, voxel, torch.cat((points[:, :3] - mean[:, :3], points[:, 3:], mean), dim=1))


def row_maxima(rows: Tensor, index: Tensor, zeros: Tensor) -> Tensor:
    """The largest of rows (N, C) with each index (N,): of the shape of `zeros` (R, C), and 0 where there is none.

    In one dimension, where onnxruntime's scatter takes two thirds of the time.
    """
    channels = zeros.shape[1]
    flat = index[:, None] * channels + torch.arange(channels)
    lowest = torch.full_like(zeros, -math.inf).flatten()
    largest = lowest.scatter_reduce(0, flat.flatten(), rows.flatten(), "amax").view(-1, channels)
    return torch.where(largest == -math.inf, 0.0, largest)


@torch.jit.script_if_tracing
def best_of(scores: Tensor, limit: int) -> tuple[Tensor, Tensor]:
    """The largest of the scores (N,), at most `limit`, and their indices; in ONNX, of equal ones the first is first."""
    return torch.topk(scores, min(limit, scores.size(0)))


@torch.jit.script_if_tracing
def suppress(boxes: Tensor, labels: Tensor, nms_iou: Tensor, limit: int) -> Tensor:
    """As `rotated.rotated_nms` of every class: the indices of the boxes (M, 7) kept, at most `limit` of each.

    labels: (M,), ascending; of a class the best box is the first. nms_iou: (C,). Every round keeps the first box of
    each class that is left, and drops those that it overlaps.
    """
    number = torch.ones_like(labels).cumsum(0) - 1
    members = labels[None] == torch.ones_like(nms_iou, dtype=torch.int64).cumsum(0)[:, None] - 1  # (C, M)
    threshold = nms_iou.index_select(0, labels)
    left, kept = number >= 0, number < 0
    rounds = 0
    while rounds < limit and bool(left.any()):
        first = (members & left).long().argmax(dim=1).index_select(0, labels)
        is_first = left & (number == first)
        kept = kept | is_first
        left = left & ~is_first & (iou_of_pairs(boxes.index_select(0, first), boxes) <= threshold)
        rounds += 1
    return kept.nonzero().squeeze(1)


def iou_of_pairs(a: Tensor, b: Tensor) -> Tensor:
    """The IoU (M,) in bird's eye view of boxes a (M, 7) and b (M, 7), by the formula of `kernels/rotated.py`."""
    x, y = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    cos, sin = torch.cos(a[:, 6]), torch.sin(a[:, 6])
    x, y = x * cos + y * sin, y * cos - x * sin
    cos, sin = torch.cos(b[:, 6] - a[:, 6]), torch.sin(b[:, 6] - a[:, 6])
    l, w = a[:, 3] / 2, a[:, 4] / 2
    bl, bw = b[:, 3] / 2, b[:, 4] / 2
    # separating axes: boxes that lie apart share exactly nothing
    near = (x.abs() < l + bl * cos.abs() + bw * sin.abs()) & (y.abs() < w + bl * sin.abs() + bw * cos.abs())
    near = near & ((x * cos + y * sin).abs() < bl + l * cos.abs() + w * sin.abs())
    near = near & ((y * cos - x * sin).abs() < bw + l * sin.abs() + w * cos.abs())
    # the corners of b, counter-clockwise, in the axes of a
    lx, ly, wx, wy = bl * cos, bl * sin, -bw * sin, bw * cos
    corner_x = torch.stack((x + lx + wx, x - lx + wx, x - lx - wx, x + lx - wx))
    corner_y = torch.stack((y + ly + wy, y - ly + wy, y - ly - wy, y + ly - wy))
    next_x = torch.cat((corner_x[1:], corner_x[:1]))
    next_y = torch.cat((corner_y[1:], corner_y[:1]))
    shared = edge_area(corner_x, corner_y, next_x, next_y, l, w).sum(dim=0).clamp(min=0.0)
    union = a[:, 3] * a[:, 4] + b[:, 3] * b[:, 4] - shared
    return torch.where(near & (shared > 0), (shared / union).clamp(max=1.0), torch.zeros_like(shared))


def edge_area(x0: Tensor, y0: Tensor, x1: Tensor, y1: Tensor, l: Tensor, w: Tensor) -> Tensor:
    """The integral of clamp(x, -l, l) dy along edges (4, M) where |y| <= w (l, w: half sizes), as the kernel has it."""
    low, high = torch.minimum(torch.maximum(y0, -w), w), torch.minimum(torch.maximum(y1, -w), w)
    slope = (x1 - x0) / (y1 - y0)
    start, end = x0 + (low - y0) * slope, x1 - (y1 - high) * slope
    near, far = torch.minimum(torch.maximum(start, -l), l), torch.minimum(torch.maximum(end, -l), l)
    span = end - start
    # the weights of the part between the clamp's two values and of the parts that it flattens
    between, before = (far - near) / span, (near - start) / span
    mean = between * 0.5 * (near + far) + before * near + (1 - between - before) * far
    mean = torch.where(near != far, mean, near)
    return torch.where(low != high, mean * (high - low), torch.zeros_like(mean))
