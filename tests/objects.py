"""Scenes and databases of objects for the tests of augmentation and insertion."""

import math

import numpy as np
import torch
from torch import Generator, Tensor

from hvnet.data.gt_database import Database
from hvnet.data.insert import ObjectSampler, TrainingFrame, sampler_of

CLASSES = ("Car", "Pedestrian", "Cyclist")
COUNTS = {"Car": 15, "Pedestrian": 8, "Cyclist": 8}


def seeded(seed: int = 0) -> Generator:
    return Generator().manual_seed(seed)


def scene(seed: int = 0) -> tuple[Tensor, Tensor]:
    """2000 points (N, 4) and 12 boxes (M, 7), with points inside every box."""
    generator = seeded(seed)
    boxes = torch.rand(12, 7, generator=generator)
    boxes = (boxes - 0.5) * torch.tensor([60.0, 60, 2, 0, 0, 0, 2 * math.pi]) + torch.tensor([30.0, 0, 0, 4, 2, 2, 0])
    points = torch.rand(2000, 4, generator=generator)
    points[:, :3] = (points[:, :3] - 0.5) * 3
    points[:, :3] += boxes[torch.arange(2000) % 12, :3]
    return points, boxes


def make_objects(objects: list[tuple[str, list[float]]], points_each: int = 10, **columns: list) -> ObjectSampler:
    """A database of objects (class, box) with `points_each` points along their middles."""
    count = len(objects)
    box = np.array([box for _, box in objects], dtype=np.float32).reshape(-1, 7)
    xyz_mm = np.zeros((3, count * points_each), dtype=np.int16)
    xyz_mm[0] = np.tile(np.arange(points_each), count)
    arrays = {"truncation": [0.0] * count, "occlusion": [0] * count, "bbox_height": [40.0] * count}
    arrays |= {"frame": [0] * count} | columns
    database = Database(
        xyz_mm=xyz_mm,
        reflectance=np.full(count * points_each, 50, dtype=np.uint8),
        offsets=np.arange(count + 1) * points_each,
        centre_mm=(box[:, :3] * 1000).round().astype(np.int32),
        box=box,
        name=np.array([name for name, _ in objects], dtype=np.str_),
        frame=np.array(arrays["frame"], dtype=np.int32),
        label_row=np.arange(count, dtype=np.int16),
        truncation=np.array(arrays["truncation"], dtype=np.float32),
        occlusion=np.array(arrays["occlusion"], dtype=np.int8),
        bbox_height=np.array(arrays["bbox_height"], dtype=np.float32),
    )
    return sampler_of(database)


def points_of(objects: ObjectSampler, k: int) -> Tensor:
    return objects.points[objects.database.offsets[k] : objects.database.offsets[k + 1]]


def car(x: float, y: float, yaw: float = 0.0) -> list[float]:
    return [x, y, -1.0, 4.0, 2.0, 1.5, yaw]


def unlabelled(points: Tensor | None = None) -> TrainingFrame:
    """A frame of points (N, 4), of none by default, without boxes."""
    return TrainingFrame(
        torch.zeros(0, 4) if points is None else points, torch.zeros(0, 7), torch.zeros(0, dtype=torch.int64)
    )
