"""What several tests use."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hvnet.data.frame import Camera, Frame
from hvnet.data.labels import Labels
from hvnet.evaluation.rules import KITTI

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("HVNET_SHARED", ROOT.parent / "shared"))
"""Real data, where there is any."""

CAMERA = Camera(
    p2=np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    r0_rect=np.eye(3),
    velo_to_cam=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]),
)
"""At the LiDAR's origin, looking along +x: u = 600 - 700 y / x, v = 180 - 700 z / x."""


class GivenFrames:
    """Frames that a test made, as a data format of its own; an error in the place of one is raised."""

    def __init__(self, *frames: Frame | Exception) -> None:
        self.frames = frames
        self.names = [each.name if isinstance(each, Frame) else f"frame {k}" for k, each in enumerate(frames)]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, k: int) -> Frame:
        each = self.frames[k]
        if isinstance(each, Exception):
            raise each
        return each


def contents(folder: Path) -> dict[str, bytes]:
    """The files below a folder, by their path in it."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def random_boxes(count: int, seed: int, spread: float = 4.0, scale: float = 1.0, centre: float = 0.0) -> Tensor:
    """Boxes (count, 7) float64 of 1 to 5 scales' length and width, within +-spread scales of the centre."""
    generator = np.random.default_rng(seed)
    boxes = np.empty((count, 7))
    boxes[:, :3] = generator.uniform(-spread, spread, (count, 3)) * scale
    boxes[:, :2] += centre
    boxes[:, 3:6] = generator.uniform(1, 5, (count, 3)) * scale
    boxes[:, 6] = generator.uniform(-math.pi, math.pi, count)
    return torch.from_numpy(boxes)


def same(a: Any, b: Any) -> bool:
    """Whether two values, such as checkpoints, are equal, tensors bit for bit."""
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b


def rows(*lines: str, scored: bool = False) -> Labels:
    """Objects written as "class x z left height [key=value ...]": a 2D box 60 wide at the left edge given, a 3D box
    4 long, 2 wide and 1.5 high. Keys: score, alpha, ry, occ, trunc, right."""
    objects = []
    for line in lines:
        name, *fields = line.split()
        given = [float(field) for field in fields if "=" not in field]
        keys = {key: float(value) for key, value in (field.split("=") for field in fields if "=" in field)}
        objects.append((name, given, keys))

    def column(key: str, default: float = 0.0) -> np.ndarray:
        return np.array([keys.get(key, default) for _, _, keys in objects], np.float64)

    x, z, left, height = np.array([given for _, given, _ in objects], np.float64).reshape(-1, 4).T
    right = np.where(column("right") > 0, column("right"), left + 60)
    flat = np.array([name == "DontCare" for name, _, _ in objects], bool)[:, None]
    return Labels(
        name=np.array([name for name, _, _ in objects], np.str_),
        truncation=column("trunc"),
        occlusion=column("occ").astype(np.int64),
        alpha=column("alpha"),
        bbox=np.column_stack((left, np.full(len(left), 100.0), right, 100 + height)),
        dimensions=np.where(flat, -1, [1.5, 2, 4]),
        location=np.where(flat, -1000, np.column_stack((x, np.full(len(x), 1.6), z))),
        rotation_y=column("ry"),
        score=column("score", 0.5) if scored else None,
    )


def crowd(count: int = 60, heading: float = 0.0, scored: bool = False) -> Labels:
    """As many objects of every class, apart from each other."""
    objects = [
        f"{name} {10 * k} {10 + 5 * row} {100 * k} 50 ry={0.1 * k + heading} alpha={0.1 * k + heading} score={k % 7}"
        for row, name in enumerate(KITTI)
        for k in range(count)
    ]
    labels = rows(*objects, scored=scored)
    labels.bbox[:, [1, 3]] += 100 * np.repeat(np.arange(len(KITTI)), count)[:, None]
    return labels


LINE = "Car 0.00 0 0.10 100.00 100.00 160.00 150.00 1.50 2.00 4.00 1.00 1.60 20.00 0.10"


def write_folders(root: Path) -> tuple[Path, Path]:
    """A folder of label files and one of result files: two frames with one car each, LINE, found in both."""
    for folder, ending in (("label_2", ""), ("results", " 0.75")):
        (root / folder).mkdir()
        for frame in ("000003", "000007"):
            (root / folder / f"{frame}.txt").write_text(LINE + ending + "\n")
    return root / "label_2", root / "results"
