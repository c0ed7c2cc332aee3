"""A page of what a detector gets wrong in the validation split: `python -m hvnet.mistakes RUN`."""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

from hvnet.cli import (
    add_device,
    add_overlaps,
    add_reading,
    make_parser,
    read_overlaps,
    read_reading,
    run_command,
)
from hvnet.data.kitti import read_split_frames
from hvnet.evaluation.rules import config_rules
from hvnet.exceptions import InputError
from hvnet.network.detector import load
from hvnet.pictures.page import make_page
from hvnet.training.folder import find_run


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text} is no score: want a number from 0 to 1")
    return value


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is no count: want 1 or more")
    return int(text)


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "mistakes",
        "Writes a page (HTML, all pictures inside) of a run: its evaluation in the validation split, its curves, and "
        "the worst misses and false positives, from above and, with a camera, in the image.",
        [
            "runs/demo",
            "runs/compact --data /data/kitti --count 50 --min-score 0.3",
            "model.pt --data /data/kitti --out model.html",
        ],
    )
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run of hvnet.train, or a checkpoint")
    parser.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: the one that the run names)")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="(default: mistakes.html in the folder of the run, or here)",
    )
    parser.add_argument("--count", type=_positive, default=20, metavar="N", help="of each kind (default: 20)")
    parser.add_argument(
        "--min-score", type=_share, default=0.5, metavar="X", help="detections below do not count (default: 0.5)"
    )
    add_reading(parser)
    add_overlaps(parser)
    add_device(parser)
    options = parser.parse_args(arguments)

    run = find_run(options.run)
    root = options.data or run.root
    if root is None:
        raise InputError(f"{options.run}: does not name the data that it was trained on; give a KITTI root with --data")
    out = options.out or (options.run if options.run.is_dir() else Path()) / "mistakes.html"
    if out.is_dir():
        raise InputError(f"{out}: is a folder; --out names the page, such as {out / 'mistakes.html'}")
    if not out.parent.is_dir() and (out.parent.exists() or not out.parent.parent.is_dir()):
        raise InputError(f"{out.parent}: no folder; --out names the page, such as mistakes.html")
    detector = load(run.checkpoint, options.device)
    reading = read_reading(options, detector.config.data, detector.classes)
    page = make_page(
        run.checkpoint,
        run.metrics,
        detector,
        read_split_frames(root, detector.config.train.val_split, reading),
        of=str(root),
        count=options.count,
        min_score=options.min_score,
        rules=config_rules(detector.config, read_overlaps(options.overlap, detector.classes)),
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(page, encoding="utf-8")
    print(f"page: {out}")


if __name__ == "__main__":
    run_command(main)
