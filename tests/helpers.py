"""What several tests use."""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hvnet.data.frame import Camera

ROOT = Path(__file__).resolve().parents[1]
SHARED = Path(os.environ.get("HVNET_SHARED", ROOT.parent / "shared"))
"""Real data, where there is any."""

CAMERA = Camera(
    p2=np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
    r0_rect=np.eye(3),
    velo_to_cam=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]),
)
"""At the LiDAR's origin, looking along +x: u = 600 - 700 y / x, v = 180 - 700 z / x."""


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
