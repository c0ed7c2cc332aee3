"""Inference: a trained model made ready for a device, stage by stage from a cloud to its boxes.

Batch norms are folded into the convolutions, the encoder is the fused one, backbone and heads run in bfloat16 where the
device is faster with it, and only the anchors whose score is above the threshold are regressed and decoded. On a GPU
all of it is one CUDA graph (`network/static.py`), between one copy of the clouds and one of the boxes.
"""

import contextlib
import copy
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, cast

import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from hvnet.data.ground import cells_of, lower, reach_of, relief_map
from hvnet.data.sensor import (
    FEW_IN_RANGE,
    Look,
    as_points,
    check_points,
    find_ground,
    inside,
    range_reason,
    reflectance_error,
    shift_to,
    too_bright,
)
from hvnet.exceptions import InputError
from hvnet.kernels.launch import many_threads
from hvnet.kernels.place import ground_heights, place_points
from hvnet.kernels.rotated import nms_order, rotated_nms
from hvnet.network.anchors import anchors_per_cell, decode
from hvnet.network.backbone import ConvReLU
from hvnet.network.checkpoint import find_checkpoint, load_checkpoint, model_from_checkpoint
from hvnet.network.devices import keep_memory, select_device
from hvnet.network.fused import inference, is_fused
from hvnet.network.head import LOCATION_VALUES, Head, ScoreMaps, regress, scores_of, weight_of
from hvnet.network.model import Detections, HVNet
from hvnet.network.static import COLUMNS, BoxSteps, Rows, StaticFrame, capacity_of
from hvnet.network.views import AUGMENTED, PLAIN, View, fuse, turned

MAX_GRAPHS = 4
"""CUDA graphs that a detector keeps: each holds the memory of all that it calculates."""
SIDEWAYS = 2 / 3
"""Share of the reach straight ahead that a range must have in a direction for objects to be detected there."""
SEAM = 2.0
"""Metres by which looks in two directions overlap: each places a box between them a little differently."""


class Placed(NamedTuple):
    """A cloud as the network sees it, once for every view: in each direction in which it looks those of `Detector`."""

    clouds: list[Tensor]  # of every view the points (N, 4), turned so that its direction is along x
    ground: Tensor  # () height of the ground before that, NaN where none was found
    shift: Tensor  # () metres by which they were raised
    relief: Tensor | None  # (S, S) metres by which they were then lowered at the places of `ground_map`; None: by none
    bright: Tensor  # () a reflectance that is too large, 0 if none is

    @property
    def move(self) -> "Move":
        """What was done to the cloud, on the host."""
        return Move(float(self.bright), float(self.shift), None if self.relief is None else self.relief.cpu())


class Move(NamedTuple):
    """What was done to a cloud before detection, so that its boxes can be taken back, and what was seen of it."""

    bright: float  # a reflectance that is too large, 0 if none is
    shift: float  # metres by which it was raised
    relief: Tensor | None  # (S, S) metres by which it was then lowered


class Candidates(NamedTuple):
    """The anchors of a class and a sample that go into NMS, best first."""

    boxes: Tensor  # (K, 7)
    scores: Tensor  # (K,)
    valid: Tensor  # (K,) bool: finite; others are not reported


class Detector:
    """A trained model on a device: `detector(points)` gives the boxes of one cloud.

    The model is copied; training it further does not change the detector. On a CPU the process keeps memory
    that it frees, see `keep_memory`.

    ground: height of the road in the clouds that the model was trained with, in metres; None: not known.
    reflectance: whether these had any.
    sensor_height: of the sensor above the road in metres, "found" in each cloud by itself, or "none". A cloud whose
    road lies elsewhere than that of the training data is raised or lowered, and its boxes are moved back.
    turn: degrees, counter-clockwise, by which a cloud is turned before detection, so that its forward is along x.
    all_round: look in as many directions as the range's opening needs; each decides what is straight ahead of it.
    tta: test-time augmentation: see the cloud turned a little and mirrored as well, and average the boxes.
    """

    def __init__(
        self,
        model: HVNet,
        device: torch.device,
        dtype: torch.dtype | None = None,
        *,
        ground: float | None = None,
        reflectance: bool = True,
        sensor_height: float | Literal["found", "none"] = "found",
        turn: float = 0.0,
        all_round: bool = False,
        tta: bool = False,
    ) -> None:
        if sensor_height not in ("found", "none") and not _is_number(sensor_height):
            raise ValueError(f"sensor_height: want metres, 'found' or 'none', got {sensor_height!r}")
        if not _is_number(turn):
            raise ValueError(f"turn: want degrees, got {turn!r}")
        if dtype is not None and not (isinstance(dtype, torch.dtype) and dtype.is_floating_point):
            raise ValueError(f"dtype: want a floating type of torch, such as torch.float32, got {dtype!r}")
        self.ground, self.reflectance, self.sensor_height = ground, reflectance, sensor_height
        self.is_flat = model.config.encoder.flat_ground and ground is not None and sensor_height != "none"
        self.reach = reach_of(model.config.encoder.point_range)
        turns = 1 if not all_round else turns_all_round(model.config.encoder.point_range)
        self.turns = [math.radians((turn + 360 * k / turns) % 360) for k in range(turns)]
        self.views_of_turn = AUGMENTED if tta else PLAIN
        self.views = [view._replace(angle=turn + view.angle) for turn in self.turns for view in self.views_of_turn]
        self.device = device
        if device.type == "cpu":
            keep_memory()
        self.dtype = dtype or fastest_dtype(device)
        self.config = model.config
        self.entries = model.config.head.classes
        self.classes = tuple(entry.name for entry in model.config.head.classes)
        model = copy.deepcopy(model).to(device).eval()
        self.encoder = model.encoder
        self.images_of = inference(model.encoder)
        self.backbone = fold_batch_norms(model.backbone).to(dtype=self.dtype)
        heads = [cast(Head, head) for head in model.heads]
        self.score_maps = ScoreMaps(heads, [entry.level for entry in self.entries]).to(dtype=self.dtype)
        self.regression_weights = [regression_weight(head) for head in heads]
        self.anchors = [model.anchors(label) for label in range(len(heads))]
        # for many threads
        self.steps = BoxSteps(self.config.head, self.regression_weights, self.anchors)
        rows = [[math.cos(angle), math.sin(angle), -1.0 if mirrored else 1.0] for angle, mirrored in self.views]
        self.view_rows = torch.tensor(rows, device=device)
        self.fixed_shift = torch.zeros(1, device=device)
        if ground is not None and sensor_height not in ("found", "none"):
            self.fixed_shift = shift_to(torch.tensor([-float(sensor_height)]), ground).to(device)
        self.frames: dict[tuple[int, int], StaticFrame] = {}  # the last few, by batch size and number of points

    def __call__(self, points: Tensor | NDArray) -> Detections:
        """Points (N, 4), x, y, z in metres and reflectance in [0, 1], to boxes (M, 7), scores (M,), labels (M,).

        Points outside the range and points that are not finite are ignored. The results are on the host. Raises
        ValueError for points of another shape, or a reflectance beyond 1.
        """
        return self.batch([points])[0]

    @torch.no_grad()
    def batch(self, clouds: Sequence[Tensor | NDArray]) -> list[Detections]:
        """The boxes of several clouds (N, 4), detected together. Raises ValueError for points of another shape."""
        if not clouds:
            return []
        with torch.cuda.device(self.device) if self.device.type == "cuda" else contextlib.nullcontext():
            found, moves = self.batch_of_many(clouds) if many_threads(self.device) else self.batch_of_one(clouds)
        results = []
        for k, move in enumerate(moves):
            if move.bright:
                raise ValueError(reflectance_error(move.bright))
            results.append(self.take_back(found[k * len(self.views) : (k + 1) * len(self.views)], move))
        return results

    def batch_of_one(self, clouds: Sequence[Tensor | NDArray]) -> tuple[list[Detections], list[Move]]:
        """What one thread finds in every view of every cloud (N, 4), and how it has moved them."""
        placed = [self.place(cloud) for cloud in clouds]
        parts = [part for each in placed for part in each.clouds]
        points = torch.cat(parts)
        lengths = torch.tensor([len(part) for part in parts])
        sample = torch.repeat_interleave(torch.arange(len(parts)), lengths).to(self.device)
        levels, scores = self.maps(points, sample, len(parts))
        found = self.suppress(self.candidates(levels, scores))
        return found, [each.move for each in placed]

    def batch_of_many(self, clouds: Sequence[Tensor | NDArray]) -> tuple[list[Detections], list[Move]]:
        """The same by many threads."""
        checked = [check_points(cloud) for cloud in clouds]
        key = len(checked), capacity_of(checked)
        if key not in self.frames:
            while len(self.frames) >= MAX_GRAPHS:
                del self.frames[next(iter(self.frames))]
            frame = StaticFrame(*key, len(self.views), self.device)
            if self.device.type == "cuda" and self.is_fused(len(checked) * len(self.views)):
                frame.capture(self.numbers)
            self.frames[key] = frame
        output = self.frames[key](checked, self.numbers)
        size = (len(checked) * len(self.views), len(self.classes), self.steps.kept, COLUMNS)
        table, moves = output.split((math.prod(size), len(output) - math.prod(size)))
        (bright, shift), reliefs = moves[: 2 * len(checked)].view(2, -1).tolist(), [None] * len(checked)
        if self.is_flat:
            reliefs = list(moves[2 * len(checked) :].view(len(checked), cells_of(self.reach), -1))
        return detections(table.view(size)), [Move(*each) for each in zip(bright, shift, reliefs, strict=True)]

    def numbers(self, points: Tensor, counts: Tensor, sample: Tensor) -> Tensor:
        """By many threads all that is found in clouds (B, N, 4) of counts (B,) int32, in one row: the table of
        `BoxSteps.suppress`, for every cloud its brightest reflectance, its shift and, if it was flattened, its relief.

        sample: the view of a cloud (B V N,) int64 that each point is seen in.
        """
        shift, reliefs = self.shifts(points, counts), []
        if self.is_flat:
            missing = torch.arange(points.shape[1], device=self.device) >= counts[:, None]
            heights = points[..., 2] + shift[:, None]
            xyz = torch.cat((points[..., :2], heights.masked_fill(missing, math.nan)[..., None]), dim=2)
            relief = self.relief(xyz)
            points = lower(points, relief)
            reliefs = [relief.flatten()]
        point_range = self.config.encoder.point_range
        placed, bright = place_points(points, counts, shift, self.view_rows, point_range, self.reflectance)
        levels, keys = self.maps(placed.view(-1, 4), sample, len(points) * len(self.views))
        table = self.steps.suppress(self.steps.candidates(levels, cast(Tensor, keys)))
        return torch.cat((table.flatten(), bright, shift, *reliefs))

    def relief(self, points: Tensor) -> Tensor:
        """By how many metres (B, S, S) the ground under clouds (B, N, 3 or more) is above that of the training data."""
        return relief_map(points, self.reach, self.ground or 0.0)

    def shifts(self, points: Tensor, counts: Tensor) -> Tensor:
        """By many threads the metres (B,) by which clouds (B, N, 4) of counts (B,) int32 are raised."""
        if self.ground is not None and self.sensor_height == "found":
            return shift_to(ground_heights(points, counts), self.ground)
        return self.fixed_shift.expand(len(points)).contiguous()

    def place(self, cloud: Tensor | NDArray) -> Placed:
        """Moves a cloud (N, 4) to where the network expects its road, and turns it to every view."""
        points = as_points(cloud, self.device)
        if not self.reflectance:
            points = torch.cat((points[:, :3], torch.zeros_like(points[:, :1])), dim=1)
        shift, ground = points.new_zeros(()), points.new_full((), math.nan)
        if self.sensor_height == "found":
            ground = find_ground(points)
        elif self.sensor_height != "none":
            ground = points.new_tensor(-self.sensor_height)
        if self.ground is not None:
            shift = shift_to(ground, self.ground)  # 0 where the ground is NaN
            if many_threads(self.device) or shift:  # a GPU is not asked
                points = torch.cat((points[:, :2], points[:, 2:3] + shift, points[:, 3:]), dim=1)
        relief = None
        if self.is_flat:
            relief = self.relief(points[None])
            points, relief = lower(points[None], relief)[0], relief[0]
        clouds = [view.see(points) for view in self.views]
        bright = torch.stack([too_bright(each, self.config.encoder.point_range) for each in clouds]).amax()
        return Placed(clouds, ground, shift, relief, bright)

    def look(self, cloud: Tensor | NDArray) -> Look:
        """What the detector sees of a cloud (N, 4)."""
        placed = self.place(cloud)
        point_range = self.config.encoder.point_range
        seen = torch.stack([inside(each, point_range) for each in placed.clouds]).any(dim=0)
        count = int(seen.sum())
        reason = range_reason(placed.clouds[0].cpu(), point_range) if count <= FEW_IN_RANGE * len(seen) else ""
        return Look(len(seen), count, float(placed.ground), float(placed.shift), reason)

    def seen_range(self, shift: float = 0.0) -> tuple[float, ...]:
        """x_min, y_min, z_min, x_max, y_max, z_max around all that is seen of a cloud that is raised by `shift` metres,
        in its own axes."""
        point_range = self.config.encoder.point_range
        x_min, y_min, z_min, x_max, y_max, z_max = point_range
        if self.turns == [0.0]:
            return x_min, y_min, z_min - shift, x_max, y_max, z_max - shift
        corners = torch.tensor([[x_min, y_min], [x_min, y_max], [x_max, y_min], [x_max, y_max]], dtype=torch.float64)
        around = torch.cat([turned(corners, -angle) for angle in self.turns])
        low, high = around.amin(dim=0).tolist(), around.amax(dim=0).tolist()
        return *low, z_min - shift, *high, z_max - shift

    def take_back(self, found: Sequence[Detections], move: Move) -> Detections:
        """The boxes of a cloud, found in every view, in its own axes: those straight ahead, joined by NMS."""
        if len(self.views) > len(self.turns):
            count, head, point_range = len(self.views_of_turn), self.config.head, self.config.encoder.point_range
            starts = range(0, len(found), count)
            found = [fuse(found[k : k + count], self.views_of_turn, head, point_range) for k in starts]
        if len(self.turns) == 1 and not self.turns[0] and not move.shift and move.relief is None:
            return found[0]
        parts = []
        for each, angle in zip(found, self.turns, strict=True):
            if len(self.turns) > 1:
                x, y = each.boxes[:, 0], each.boxes[:, 1]
                sideways = torch.atan2(y, x).abs() - math.pi / len(self.turns)  # radians past the look's border
                beyond = torch.hypot(x, y) * sideways.clamp(0, math.pi / 2).sin()  # metres
                each = each.select(beyond <= SEAM)
            boxes = View(angle).take_back(each.boxes)
            if move.relief is not None:
                boxes = lower(boxes[None], -move.relief[None])[0]
            boxes[:, 2] -= move.shift
            parts.append(each._replace(boxes=boxes))
        joined = Detections(*(torch.cat(column) for column in zip(*parts, strict=True)))
        if len(self.turns) == 1:
            return joined
        rows = []
        for label, entry in enumerate(self.entries):
            own = (joined.labels == label).nonzero().squeeze(1)
            kept = rotated_nms(joined.boxes[own], joined.scores[own], entry.nms_iou)
            rows.append(own[kept[: self.config.head.detections]])
        return joined.select(torch.cat(rows))

    def maps(self, points: Tensor, sample: Tensor, batch_size: int) -> tuple[list[Tensor], list[Tensor] | Tensor]:
        """Pyramid levels (B, C, N_L, N_W) / 2^k and the scores of every class; they hold until the next call."""
        return self.score(self.backbone(self.encode(points, sample, batch_size)))

    def encode(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Tensor]:
        """Pseudo-images, finest first, that hold until the next call."""
        return self.images_of(points, sample, batch_size, self.dtype)

    def is_fused(self, batch_size: int) -> bool:
        """Whether the encoder runs as `FusedEncoder` for batches of this size."""
        return is_fused(self.encoder, batch_size)

    def score(self, levels: list[Tensor]) -> tuple[list[Tensor], list[Tensor] | Tensor]:
        """The pyramid levels, and the scores (B, A) float32 of every class; by many threads their keys."""
        if many_threads(self.device):
            return levels, self.steps.keys(self.score_maps(levels))
        scores = []
        for maps in self.score_maps(levels):
            rows = [each.permute(0, 2, 3, 1) for each in maps]
            logits, *iou = [each.reshape(len(each), -1).float() for each in rows]
            scores.append(scores_of(logits, iou[0] if iou else None))
        return levels, scores

    def candidates(self, levels: list[Tensor], scores: list[Tensor] | Tensor) -> list[list[Candidates]] | Rows:
        """For every sample and class the best anchors above the threshold, regressed and decoded."""
        if isinstance(scores, Tensor):
            return self.steps.candidates(levels, scores)
        return [
            [self._candidates(label, b, levels, of_class[b]) for label, of_class in enumerate(scores)]
            for b in range(len(scores[0]))
        ]

    def _candidates(self, label: int, b: int, levels: list[Tensor], scores: Tensor) -> Candidates:
        head, entry = self.config.head, self.entries[label]
        chosen = (scores > head.score_threshold).nonzero().squeeze(1)
        if len(chosen) == 0:
            return Candidates(scores.new_empty(0, 7), scores.new_empty(0), torch.empty(0, dtype=torch.bool))
        chosen = chosen[torch.sort(scores[chosen], descending=True, stable=True).indices[: head.candidates]]
        scores = scores[chosen]
        values = regress(
            levels[entry.level][b : b + 1], chosen, self.regression_weights[label], anchors_per_cell(entry)
        )
        count = LOCATION_VALUES[head.regression]
        direction = values[:, count + 2 :].argmax(dim=1) if head.direction else None
        boxes = decode(values[:, :count], values[:, count : count + 2], direction, self.anchors[label][chosen])
        return Candidates(boxes, scores, boxes.isfinite().all(dim=1))

    def suppress(self, candidates: list[list[Candidates]] | Rows) -> list[Detections]:
        """Rotated NMS class by class: the boxes of every sample, on the host."""
        if isinstance(candidates, Rows):
            return detections(self.steps.suppress(candidates).cpu())
        head, samples = self.config.head, []
        for of_sample in candidates:
            parts = []
            for label, (boxes, scores, valid) in enumerate(of_sample):
                scores = scores.where(valid, -1.0)  # after all others
                order, keep = nms_order(boxes, scores, self.entries[label].nms_iou)
                kept = order[keep & valid[order]][: head.detections]
                parts.append(Detections(boxes[kept], scores[kept], torch.full_like(kept, label)))
            samples.append(Detections(*(torch.cat(column) for column in zip(*parts, strict=True))))
        return samples


def detections(table: Tensor) -> list[Detections]:
    """The boxes that were kept in the table of `BoxSteps.suppress`, of every sample."""
    found = []
    for rows in table.flatten(1, 2):
        kept = rows[rows[:, 9] > 0]
        found.append(Detections(kept[:, :7].contiguous(), kept[:, 7].contiguous(), kept[:, 8].long()))
    return found


def fastest_dtype(device: torch.device) -> torch.dtype:
    """bfloat16 where the processor multiplies in it, else float32."""
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.get_device_capability(device) >= (8, 0) else torch.float32
    return torch.bfloat16 if torch.cpu._is_avx512_bf16_supported() else torch.float32


def fold_batch_norms(module: nn.Module) -> nn.Module:
    """A copy in which each convolution followed by a batch norm is one convolution, and one layer with a ReLU."""
    if isinstance(module, nn.Sequential):
        layers: list[nn.Module] = []
        for layer in module:
            if isinstance(layer, nn.BatchNorm2d):
                convolution = layers.pop()
                assert isinstance(convolution, nn.Conv2d | nn.ConvTranspose2d)
                transposed = isinstance(convolution, nn.ConvTranspose2d)
                layers.append(fuse_conv_bn_eval(convolution, layer, transposed))
            elif isinstance(layer, nn.ReLU) and layers and isinstance(layers[-1], nn.Conv2d):
                layers[-1] = ConvReLU(layers[-1])
            else:
                layers.append(fold_batch_norms(layer))
        return nn.Sequential(*layers)
    folded = copy.deepcopy(module)
    for name, child in folded.named_children():
        setattr(folded, name, fold_batch_norms(child))
    return folded


def regression_weight(head: Head) -> Tensor:
    """The branches of a head that make a box as the matrix of `weight_of`."""
    branches = [branch for branch in (head.location, head.vertical, head.direction) if branch is not None]
    return weight_of(branches, head.score.out_channels).detach()


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def turns_all_round(point_range: Sequence[float]) -> int:
    """In how many directions a range x_min, y_min, z_min, x_max, y_max, z_max has to look to see all round.

    Its opening is the angle in which it reaches SIDEWAYS as far as straight ahead.
    """
    x_min, y_min, _, x_max, y_max, _ = point_range
    reach = SIDEWAYS * x_max
    if x_min <= -reach and min(-y_min, y_max) >= reach:
        return 1
    side = min(-y_min, y_max)
    if side <= 0 or reach <= 0:
        raise InputError(f"point_range {list(point_range)}: is not around the x axis, so that it cannot look all round")
    return math.ceil(math.pi / math.asin(min(1.0, side / reach)))


def load(
    checkpoint: str | Path | None = None,
    device: str = "auto",
    *,
    dtype: torch.dtype | None = None,
    sensor_height: float | Literal["found", "none"] = "found",
    turn: float = 0.0,
    all_round: bool = False,
    tta: bool = False,
) -> Detector:
    """A detector from a checkpoint of `python -m hvnet.train`, or from weights that come with the package.

    checkpoint: a file, or the name of weights, such as "compact", which is the default.
    device: auto (CUDA where there is a GPU), cpu, cuda or cuda:N.
    dtype: of backbone and heads; None: what the device is fastest with, bfloat16 or float32.
    sensor_height, turn, all_round, tta: see `Detector`.
    Raises InputError naming the file, or the device.
    """
    path = find_checkpoint(checkpoint)
    content = load_checkpoint(path)
    facts = content.get("sensor", {"ground": None, "reflectance_scale": None})
    if not isinstance(facts, dict) or not all(
        facts.get(key) is None or _is_number(facts[key]) for key in ("ground", "reflectance_scale")
    ):
        raise InputError(f"{path}: its facts on the sensor are damaged; train again or copy it again")
    ground = facts.get("ground")
    if ground is None and sensor_height not in ("found", "none"):
        raise InputError(f"{path}: does not know the ground of its training data; leave the height of the sensor out")
    return Detector(
        model_from_checkpoint(content, str(path)),
        select_device(device),
        dtype,
        ground=ground,
        reflectance=facts.get("reflectance_scale") != 0,
        sensor_height=sensor_height,
        turn=turn,
        all_round=all_round,
        tta=tta,
    )
