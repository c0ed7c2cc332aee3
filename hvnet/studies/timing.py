"""The stages of detection, timed."""

import itertools
import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from hvnet.network.detector import Detector

TIMED_CLOUDS = 10
TIMED_ROUNDS = 3
STAGES = ("encoder", "backbone", "head and NMS")

Times = tuple[float, float, float]  # milliseconds of the STAGES


def time_stages(detectors: dict[str, Detector], clouds: Sequence[Tensor]) -> dict[str, Times]:
    """Median milliseconds of the STAGES of every detector, cloud by cloud in turns."""
    times: dict[str, list[tuple[float, ...]]] = {name: [] for name in detectors}
    for turn in range(-1, TIMED_ROUNDS):  # the first to warm up
        for points in clouds[: 2 if turn < 0 else None]:
            for name, detector in detectors.items():
                marks = [mark(detector.device)]
                with torch.no_grad():
                    inside = points.to(detector.device)
                    images = detector.encode(inside, torch.zeros(len(inside), dtype=torch.int64).to(inside.device), 1)
                    marks.append(mark(detector.device))
                    levels = detector.backbone(images)
                    marks.append(mark(detector.device))
                    detector.suppress(detector.candidates(*detector.score(levels)))
                    marks.append(mark(detector.device))
                if turn >= 0:
                    times[name].append(tuple(1e3 * (b - a) for a, b in itertools.pairwise(marks)))
    medians = {name: np.median(np.array(rows), axis=0).tolist() for name, rows in times.items()}
    return {name: (encoder, backbone, head) for name, (encoder, backbone, head) in medians.items()}


def mark(device: torch.device) -> float:
    """The time in seconds at which the device has done what it was given."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
