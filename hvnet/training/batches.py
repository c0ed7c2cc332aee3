"""Training frames, augmented, in batches whose order depends on seed and epoch alone."""

import contextlib
import math
import statistics
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler
from tqdm import tqdm

from hvnet import ranks
from hvnet.config import Config
from hvnet.data.augment import augment, mix_sectors
from hvnet.data.drives import drive_weights, read_drives
from hvnet.data.frame import Frame, Frames, check_names, frame_at, object_names
from hvnet.data.ground import flatten
from hvnet.data.gt_database import Database, build_database, load_database
from hvnet.data.insert import ObjectSampler, TrainingFrame, send
from hvnet.data.kitti import KittiFrames, read_split_frames
from hvnet.data.occlusion import nearest_points
from hvnet.data.scenes.files import generate
from hvnet.data.scenes.street import Options
from hvnet.data.sensor import (
    FEW_IN_RANGE,
    Look,
    find_ground,
    inside,
    range_reason,
    reflectance_error,
    summary,
    too_bright,
)
from hvnet.exceptions import InputError

LOOKED_AT = 32
"""Frames that tell what the training data's clouds are like."""
ANCHOR_TOLERANCE = 0.6  # metres between the ground and the bottom of the anchors


@dataclass(frozen=True)
class Data:
    """What a run trains and validates on."""

    train: Frames
    val: Frames
    root: Path | None = None  # their KITTI root, where the ground-truth database is kept
    drives: Sequence[str] = ()  # of each training frame, if frames of long drives are to be drawn less often

    def __post_init__(self) -> None:
        if self.drives and len(self.drives) != len(self.train):
            raise ValueError(f"drives: want one for each of {len(self.train)} training frames, got {len(self.drives)}")


def kitti_data(root: Path, config: Config) -> Data:
    """The frames of the config's splits in a KITTI root, and the drives of the training frames if it names a file."""
    train = read_split_frames(root, config.train.train_split, config.data)
    val = read_split_frames(root, config.train.val_split, config.data)
    return Data(train, val, root, read_drives(root / config.train.drives, train.names) if config.train.drives else ())


def generated_scenes(config: Config, folder: Path) -> Path:
    """A KITTI root in the folder with the scenes that the config asks for; an existing one is reused."""
    assert config.synthetic is not None
    scenes, reach, seed = config.synthetic, config.encoder.point_range[3], config.train.seed
    root = folder / f"scenes-{scenes.train_frames}-{scenes.val_frames}-{reach:g}m-{seed}"
    generate(root, scenes.train_frames, scenes.val_frames, seed, Options(distance=(4.0, min(reach - 2, 80.0))))
    return root


def training_objects(data: Data, good: Sequence[int], say: Callable[..., None]) -> Database:
    """The ground-truth database of the training frames that can be read: that of the KITTI root, or a new one."""
    if data.root is not None:
        reading = data.train.reading if isinstance(data.train, KittiFrames) else None
        return load_database(data.root, [data.train.names[k] for k in good], data.val.names, say, reading)
    return build_database(data.train, good)


class Batch(NamedTuple):
    """Several frames in one: all points, the sample of each, and the boxes of every sample."""

    points: Tensor  # (N, 4)
    sample: Tensor  # (N,) int64
    boxes: list[Tensor]  # (M_b, 7) each
    labels: list[Tensor]  # (M_b,) int64 each, index into the config's classes
    notes: list[str]  # about the frames' files, each to be printed once
    names: list[str]  # of the frames

    def to(self, device: torch.device) -> "Batch":
        """The batch on a device. A GPU's points are there already, and for the rest the host does not wait."""
        sizes = [len(each) for each in self.boxes]  # one copy for all samples
        boxes, labels = (list(send(torch.cat(part), device).split(sizes)) for part in (self.boxes, self.labels))
        return self._replace(points=self.points.to(device), sample=self.sample.to(device), boxes=boxes, labels=labels)


class Sample(NamedTuple):
    """A training sample."""

    points: Tensor  # (N, 4), on the GPU when training on one
    boxes: Tensor  # (M, 7)
    labels: Tensor  # (M,) int64, index into the config's classes, or -1
    note: str
    name: str


class TrainingFrames(Dataset[Sample | InputError]):
    """Frames augmented on a device; item (epoch, k) depends on the seed, the epoch and k alone.

    A mistake in a file is returned, not raised: a worker process would wrap it in the text of its traceback.
    """

    def __init__(
        self,
        frames: Frames,
        config: Config,
        objects: ObjectSampler | None,
        device: torch.device,
        drives: Sequence[str] = (),
        ground: float | None = None,
    ) -> None:
        """ground: the height that the ground of every frame is brought to; None: they stay as they are."""
        self.ground = ground
        self.frames, self.config, self.objects, self.device = frames, config, objects, device
        self.weights = drive_weights(drives)
        self.classes = [entry.name for entry in config.head.classes]
        self.kept: dict[int, TrainingFrame] = {}

    def __getitem__(self, item: tuple[int, int]) -> Sample | InputError:
        try:
            return self.augmented(*item)
        except InputError as error:
            return error

    def augmented(self, epoch: int, k: int) -> Sample:
        """Frame k as training sees it in an epoch."""
        options = self.config.augment
        generator = seeded(self.config.train.seed, epoch, k)
        frame = self.read(k % len(self.frames))
        if options.mix and torch.rand((), generator=generator).item() < options.mix:
            if len(self.weights):
                drawn = torch.multinomial(self.weights, 1, generator=generator)
            else:
                drawn = torch.randint(len(self.frames), (), generator=generator)
            frame = mix_sectors(frame, self.read(int(drawn)), generator)
        # inserted objects are too many, and stand where none would be: the last epochs see streets as they are
        faded = epoch >= self.config.train.epochs - options.fade_out
        objects = None if faded else self.objects
        points, boxes, labels = augment(frame, objects, options, generator, self.classes, self.ground)
        low, high = boxes.new_tensor(self.config.encoder.point_range).view(2, 3)
        inside = ((boxes[:, :2] >= low[:2]) & (boxes[:, :2] < high[:2])).all(dim=1) & (labels >= 0)
        return Sample(points, boxes[inside], labels[inside], frame.note, frame.name)

    def read(self, k: int) -> TrainingFrame:
        """Frame k as it is; boxes of classes that are not trained have label -1.

        Where frames that cannot be read are to be skipped, the next one that can be takes the place.
        """
        if k in self.kept:
            return self.kept[k]
        notes: list[str] = []
        for at in [*range(k, len(self.frames)), *range(k)]:
            try:
                frame = frame_at(self.frames, at)
                if frame.objects is None:
                    raise InputError(f"frame {frame.name}: has no labels")
                if highest := float(too_bright(frame.points, self.config.encoder.point_range)):
                    raise InputError(f"frame {frame.name}: {reflectance_error(highest)}")
                break
            except (InputError, OSError) as error:
                if not self.config.train.skip_corrupt:
                    raise error if isinstance(error, InputError) else InputError(str(error)) from error
                notes.append(f"frame {self.frames.names[at]} is skipped: {error}")
        else:
            raise InputError(f"no frame can be read; the last: {notes[-1]}")
        sample = self.sample_of(frame, "\n".join([*notes, *frame.notes]))
        if self.config.train.workers == 0:  # read once; several workers would each keep all frames
            self.kept[k] = sample
        return sample

    def sample_of(self, frame: Frame, note: str) -> TrainingFrame:
        """The frame on the device, its classes by number."""
        assert frame.objects is not None
        labels = [self.classes.index(name) if name in self.classes else -1 for name in frame.objects.names]
        points, boxes = frame.points, frame.objects.boxes
        if self.ground is not None:
            points, boxes = flatten(points, boxes, self.ground, self.config.encoder.point_range)
        obstacles = nearest_points(points) if self.config.augment.occlusion else None
        return TrainingFrame(points.to(self.device), boxes, torch.tensor(labels).long(), obstacles, note, frame.name)


class EpochOrder(Sampler[list[tuple[int, int]]]):
    """Batches of items (epoch, k), shuffled by seed and epoch: of each, from the batch `begin` on, a rank's share.

    The last frames of an epoch that do not fill a batch are left out, unless there are no others. Where the frames (N,)
    have drives, `count` of them are drawn by `drive_weights` instead of each equally often.
    """

    def __init__(self, count: int, batch_size: int, seed: int, drives: Sequence[str] = ()) -> None:
        self.count, self.batch_size, self.seed, self.epoch, self.begin = count, batch_size, seed, 0, 0
        self.weights = drive_weights(drives)

    def __len__(self) -> int:
        return max(1, self.count // self.batch_size)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        generator = seeded(self.seed, self.epoch)
        order = torch.randperm(self.count, generator=generator)
        if len(self.weights):
            order = draw_items(self.weights, self.count, generator)[order]
        for batch in range(self.begin, len(self)):
            items = order[batch * self.batch_size : (batch + 1) * self.batch_size].tolist()
            yield [(self.epoch, k) for k in items[ranks.rank() :: ranks.size()]]


def draw_items(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draws frames (N,) in proportion to their weights, each as often as expected, rounded up or down by chance.

    Returns items (count,): N * d + k for frame k and d = 0, 1, ... each time that it is drawn, so that no item is there
    twice. This is systematic sampling: a comb of equal teeth, moved at random, over the weights laid end to end.
    """
    ends = weights.cumsum(0)
    teeth = (torch.arange(count) + torch.rand((), generator=generator, dtype=torch.float64)) * (ends[-1] / count)
    frames = torch.searchsorted(ends, teeth, right=True).clamp(max=len(weights) - 1)
    draw = torch.arange(count) - torch.searchsorted(frames, frames)
    return frames + len(weights) * draw


def seeded(*numbers: int) -> torch.Generator:
    """A generator that depends on all of the numbers and on nothing else."""
    seed = 0
    for number in numbers:
        seed = (seed * 6364136223846793005 + number + 1442695040888963407) % 2**63
    return torch.Generator().manual_seed(seed)


def collate(samples: Sequence[Sample | InputError]) -> Batch | InputError:
    """Joins samples into a batch; returns the first error among them instead, if there is one."""
    good = []
    for each in samples:
        if isinstance(each, InputError):
            return each
        good.append(each)
    points, boxes, labels, notes, names = zip(*good, strict=True)
    sample = torch.cat([torch.full((len(cloud),), k, device=cloud.device) for k, cloud in enumerate(points)])
    return Batch(torch.cat(points), sample, list(boxes), list(labels), list(notes), list(names))


def check_frames(frames: Frames, skip: bool, say: Callable[..., None]) -> tuple[list[int], Counter[str]]:
    """The frames that can be read, and the names of the objects in them, so that a mistake is found before the run.

    The first mistake raises InputError or, with `skip`, is named and its frame left out.
    """
    check_names(frames)
    good, names, last = [], Counter[str](), ""
    hidden = ranks.rank() > 0
    for k in tqdm(range(len(frames)), desc="checking", unit="frame", leave=False, dynamic_ncols=True, disable=hidden):
        try:
            found = object_names(frames, k)
            if found is None:
                raise InputError(f"frame {frames.names[k]}: has no labels")
            names.update(found)
            good.append(k)
        except (InputError, OSError) as error:
            if not skip:
                raise
            last = str(error)
            say(f"frame {frames.names[k]} is skipped: {error}")
    if not good:
        raise InputError(f"no frame of the split can be read; the last: {last}")
    return good, names


def look_at_clouds(frames: Frames, wanted: Sequence[int], config: Config) -> tuple[dict[str, float | None], list[str]]:
    """What a detector has to know of the clouds that it is trained with, and what a user should.

    The former is the height of their `ground` in metres, None if there is none, and the `reflectance_scale`, 0 if there
    is no reflectance. Of many frames some are looked at.
    """
    point_range = config.encoder.point_range
    looks, reflectances, reasons, bright = [], [], [], False
    for k in wanted[:: max(1, len(wanted) // LOOKED_AT)]:
        with contextlib.suppress(InputError, OSError):  # named when its turn comes
            frame = frame_at(frames, k)
            points = frame.points
            look = Look(len(points), int(inside(points, point_range).sum()), float(find_ground(points)), 0.0)
            looks.append(look)
            reflectances.append(frame.reflectance)
            bright |= bool(points[:, 3].any())
            if look.in_range <= FEW_IN_RANGE * look.points:
                reasons.append(f"{frame.name}: {range_reason(points, point_range)}")
    known = [look.ground for look in looks if not math.isnan(look.ground)]
    ground = statistics.median(known) if known else None
    if config.data.sensor_height is not None:
        ground = -config.data.sensor_height
    scale = max(getattr(frames, "scales", {"": 1.0}).values(), default=1.0) if bright else 0.0
    said = [f"clouds: {summary(looks, reflectances)}"] if looks else []
    if reasons:
        said.append(f"in {len(reasons)} of {len(looks)} clouds few points are in range; the first is {reasons[0]}")
    if ground is not None:
        better = []
        for entry in config.head.classes:
            half = max(size[2] for size in entry.anchor_sizes) / 2
            if abs(entry.anchor_z - half - ground) > ANCHOR_TOLERANCE:
                better.append(f"--set head.classes.{entry.name}.anchor_z={ground + half:.2f}")
        if better:
            where = f"the ground lies at {ground:.2f} m, where the anchors do not stand"
            said.append(f"{where}; better: {' '.join(better)}")
    return {"ground": ground, "reflectance_scale": scale}, said
