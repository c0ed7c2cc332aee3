"""detector.onnx in onnxruntime against `hvnet.load()` in float32: the same boxes, and what it costs to have no kernels.

Every cloud goes through both. Boxes are the same if each has one of its class in the other within 1 mm in x, y, z and
sizes, 1e-3 rad, and 1e-4 in its score. Then both are timed in turns on the first frames, and a last table says where
onnxruntime's time goes.
"""

import json
import math
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
import torch
from timing import parser, start, write_json, write_rows
from torch import Tensor

import hvnet
from hvnet.cli import run_command
from hvnet.data.kitti import read_frame, read_split
from hvnet.data.scenes.files import make_frame
from hvnet.data.scenes.street import Options
from hvnet.exceptions import InputError
from hvnet.network.export import dropped_points, write_detector
from hvnet.network.model import Detections

SHIFT, SCORE = 1e-3, 1e-4
"""Metres and radians, and score, by which boxes may differ."""
STAGES = {"place": "ground, heights", "encoder": "encoder", "backbone": "backbone", "heads": "heads, decoding"}
"""The parts of `PointsToBoxes` by the scope of their nodes; what is outside of them is NMS."""

COLUMNS = ("what", "boxes", "not_in_both", "largest_shift", "largest_score_difference", "ms", "share")
"""Of the rows that are written. A row of equality, of speed or of a share leaves the other columns empty."""


class Difference(NamedTuple):
    """What tells the boxes of one cloud from those that were expected."""

    boxes: int  # expected
    unmatched: int  # of either that the other does not have
    shift: float  # the largest of those that both have, metres or radians
    score: float


def row(**values: object) -> dict[str, object]:
    """A row that is written."""
    return {column: values.get(column, "") for column in COLUMNS}


def session_of(file: Path, threads: int, profile: str = "") -> onnxruntime.InferenceSession:
    """onnxruntime's session of a file on the CPU."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # its threads would wait for work on the cores that torch has its turn on
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if profile:
        options.enable_profiling = True
        options.profile_file_prefix = profile
    return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])


def run(session: onnxruntime.InferenceSession, points: Tensor) -> Detections:
    """The boxes of a cloud (N, 4)."""
    return Detections(*(torch.from_numpy(each) for each in session.run(None, {"points": points.numpy()})))


def compare(found: Detections, want: Detections) -> Difference:
    """Matches every box with those of its class within SHIFT and SCORE of it."""
    shift = (found.boxes[:, None] - want.boxes[None]).abs()
    turn = (found.boxes[:, None, 6] - want.boxes[None, :, 6]) / 2
    shift = torch.maximum(shift[..., :6].amax(dim=2), 2 * turn.sin().abs())
    score = (found.scores[:, None] - want.scores[None]).abs()
    same = (shift <= SHIFT) & (score <= SCORE) & (found.labels[:, None] == want.labels[None])
    count = len(want.boxes)
    if not same.numel():
        return Difference(count, count + len(found.boxes), 0.0, 0.0)
    unmatched = int((~same.any(dim=0)).sum() + (~same.any(dim=1)).sum())
    unmatched = max(unmatched, abs(len(found.boxes) - count))  # a box that comes twice matches
    largest = (float(each.where(same, 0.0).amax()) for each in (shift, score))
    return Difference(count, unmatched, *largest)


def edge_cases(street: Tensor) -> dict[str, Tensor]:
    """Clouds (N, 4) with few points or none in range, and what may become of a street's (N, 4)."""

    def changed(points: slice, column: slice | int, value: float) -> Tensor:
        cloud = street.clone()
        cloud[points, column] = value
        return cloud

    every = slice(None)
    third = slice(None, None, 3)
    left, right = street[street[:, 1] > 0], street[street[:, 1] > 0] * torch.tensor([1.0, -1.0, 1.0, 1.0])
    up = torch.tensor([0.0, 0.0, 1.0, 0.0])
    return {
        "no point": street[:0],
        "one point": street[:1],
        "nine points": street[:9],
        "all points outside": street * torch.tensor([-1.0, 1.0, 1.0, 1.0]) - torch.tensor([1.0, 0.0, 0.0, 0.0]),
        "all points NaN": torch.full_like(street, math.nan),
        "a third NaN": changed(third, every, math.nan),
        "a third infinite in x": changed(third, 0, math.inf),
        "a third far below": changed(third, 2, -1e30),
        "points twice": torch.cat((street, street)),
        "ties: left as right": torch.cat((left, right)),
        "points at one place": street[:1].expand(500, 4).contiguous(),
        "no reflectance": changed(every, 3, 0.0),
        "constant reflectance": changed(every, 3, 0.4),
        "reflectance NaN": changed(third, 3, math.nan),
        "reflectance negative": changed(third, 3, -1.0),
        "sensor 1.3 m higher": street - 1.3 * up,
        "heights of a map": street + 40 * up,
        "a slope of 8 %": street + 0.08 * street[:, :1] * up,
        "120,000 points": torch.cat([street + torch.tensor([0.0, 0.0, 0.002 * k, 0.0]) for k in range(7)])[:120_000],
    }


def shares(file: Path, threads: int, clouds: Sequence[Tensor], folder: Path) -> dict[str, float]:
    """The share of every stage in onnxruntime's time for clouds."""
    session = session_of(file, threads, str(folder / "profile"))
    for points in clouds:
        run(session, points)
    times: Counter[str] = Counter()
    for event in json.loads(Path(session.end_profiling()).read_text()):
        name = event["name"]
        if event.get("cat") != "Node" or not name.endswith("_kernel_time"):
            continue
        scope = name.strip("/").split("/")[0].split(".")[0]
        if "graph_inner" in event["args"] or scope == "":
            continue
        times[STAGES.get(scope, "NMS, heights of boxes")] += event["dur"]
    return {stage: time / times.total() for stage, time in times.most_common()}


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments = parser("export", __doc__, repeat=3)
    arguments.add_argument("--checkpoint", help="a checkpoint, or the name of weights (default: compact)")
    arguments.add_argument("--data", type=Path, metavar="KITTI", help="a root (default: generated scenes)")
    arguments.add_argument("--split", default="val", help="its frames (default: val)")
    args = arguments.parse_args(argv)
    if args.device != "cpu":
        raise InputError("--device cuda: onnxruntime is compared on the CPU")
    bench = start("export", args)
    detector = hvnet.load(args.checkpoint, "cpu", dtype=torch.float32)
    drops = dropped_points(detector.config)
    if drops:
        raise InputError(f"{args.checkpoint}: with {drops} it drops points, and there is no detector.onnx of it")
    if args.data is None:
        clouds = {f"scene {k}": torch.from_numpy(make_frame(0, k, Options())[1].points) for k in range(8)}
    else:
        clouds = {name: read_frame(args.data, name).points for name in read_split(args.data, args.split)}
    rows: list[dict[str, object]] = []

    def show(what: str, differences: Sequence[Difference]) -> None:
        boxes, unmatched = sum(each.boxes for each in differences), sum(each.unmatched for each in differences)
        shift, score = max(each.shift for each in differences), max(each.score for each in differences)
        print(f"{what:<26}{boxes:>7}{unmatched:>13}{shift:>14.1e}{score:>12.1e}", flush=True)
        rows.append(
            row(what=what, boxes=boxes, not_in_both=unmatched, largest_shift=shift, largest_score_difference=score)
        )

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "detector.onnx"
        write_detector(detector, file)
        session = session_of(file, args.threads)
        print(f"\n{'cloud':<26}{'boxes':>7}{'not in both':>13}{'largest shift':>14}{'score':>12}")
        show(f"{len(clouds)} frames", [compare(run(session, each), detector(each)) for each in clouds.values()])
        for what, points in edge_cases(next(iter(clouds.values()))).items():
            show(what, [compare(run(session, points), detector(points))])

        times: dict[str, list[float]] = {"hvnet.load()": [], "detector.onnx": []}
        for turn in range(args.repeat + 1):
            for points in list(clouds.values())[:8]:
                for name, call in (("hvnet.load()", detector), ("detector.onnx", lambda each: run(session, each))):
                    begin = time.perf_counter()
                    call(points)
                    if turn:
                        times[name].append(time.perf_counter() - begin)
        first = float(np.median(times["hvnet.load()"]))
        print(f"\n{'median of ' + str(len(times['hvnet.load()'])) + ' calls':<26}{'ms':>7}{'ratio':>9}")
        for name, each in times.items():
            median = float(np.median(each))
            print(f"{name:<26}{1e3 * median:7.1f}{median / first:8.2f}x")
            rows.append(row(what=name, ms=f"{1e3 * median:.6g}"))
        print(f"\n{'where the time of detector.onnx goes':<40}")
        for stage, share in shares(file, args.threads, list(clouds.values())[:8], Path(folder)).items():
            print(f"{stage:<26}{share:7.0%}")
            rows.append(row(what=stage, share=f"{share:.3f}"))
    write_rows(args.csv, rows, bench.machine)
    write_json(args.json, rows, bench.machine)


if __name__ == "__main__":
    run_command(main)
