"""KITTI's object evaluation over result files of any detector: `python -m hvnet.evaluate`."""

import argparse
import json
import math
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from hvnet.cli import (
    add_bootstrap,
    add_columns,
    add_overlaps,
    make_parser,
    read_bootstrap,
    read_overlaps,
    run_command,
)
from hvnet.data.columns import parse_columns
from hvnet.data.kitti import TYPES
from hvnet.data.labels import DONTCARE, Labels, class_map, count_others, rename
from hvnet.evaluation.bootstrap import CONFIDENCE, differences
from hvnet.evaluation.folders import Folders, check_axes, read_folders, read_point_counts
from hvnet.evaluation.matching import LEVELS_WITHOUT_2D, Level, distance_levels
from hvnet.evaluation.precision import evaluate
from hvnet.evaluation.rules import KITTI, rule_for
from hvnet.evaluation.tables import format_differences, format_table, plot, write_csv
from hvnet.exceptions import InputError

ARRAYS = ("curves", "resampled")
"""What a result holds besides the figures of its JSON."""


def _band(text: str) -> tuple[float, float]:
    near, dash, far = text.partition("-")
    try:
        band = float(near), float(far)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no band such as 20-40") from None
    if not (dash and 0 <= band[0] < band[1]):
        raise argparse.ArgumentTypeError(f"'{text}' is no band such as 20-40")
    return band


def choose_classes(given: Sequence[str] | None, labels: Sequence[Labels], predictions: Sequence[Labels]) -> list[str]:
    """The classes to score: those given, else KITTI's three and every class that KITTI does not know.

    Where there is none of the three it is every class there is. Raises InputError for a class that is nowhere.
    """
    found = Counter(name for frame in (*labels, *predictions) for name in frame.name.tolist())
    if given is None:
        if found.keys() & KITTI.keys() or not found.keys() - {DONTCARE}:
            return [*KITTI, *sorted(found.keys() - set(TYPES))]
        return sorted(found.keys() - {DONTCARE})
    known = found.keys() - {DONTCARE}
    missing = [name for name in given if name not in known and name not in KITTI]
    if missing:
        there = f"there are {', '.join(sorted(known))}" if known else "there are none"
        raise InputError(f"--classes {missing[0]}: no label or result is of this class; {there}")
    return list(given)


def read_classes(given: Sequence[str] | None) -> tuple[list[str] | None, dict[str, str]]:
    """The classes of --classes, None if it names none, and the names that count as one of them.

    Raises InputError for a mapping that means nothing.
    """
    if given is None:
        return None, {}
    renamed = class_map([text for text in given if "=" in text])
    bare = [text for text in given if "=" not in text]
    return list(dict.fromkeys([*bare, *renamed.values()])) if bare else None, renamed


def rename_all(folders: Folders, renamed: Mapping[str, str]) -> Folders:
    """The labels and results with their names replaced. Raises InputError for a name that is nowhere."""
    rows = (*folders.labels, *folders.predictions)
    found = {name for frame in rows for name in frame.name.tolist()} - {DONTCARE}
    for name, meant in renamed.items():
        if name not in found and name not in TYPES:
            there = f"there are {', '.join(sorted(found))}" if found else "there are none"
            raise InputError(f"--classes {name}={meant}: no label or result is named {name}; {there}")
    return folders._replace(
        labels=[rename(frame, renamed) for frame in folders.labels],
        predictions=[rename(frame, renamed) for frame in folders.predictions],
    )


def _read_folders(args: argparse.Namespace, predictions: Path) -> Folders:
    folders = read_folders(args.labels, predictions, args.frames, args.missing_as_empty)
    if not args.same_axes:
        check_axes(args.labels, predictions, folders)
    return folders


def main(argv: Sequence[str] | None) -> None:
    """The command `python -m hvnet.evaluate`."""
    parser = make_parser(
        "evaluate",
        "Scores result files of any detector and of any classes as KITTI's devkit does, and reports what is missed.",
        [
            "--labels KITTI/training/label_2 --predictions results --frames val.txt",
            "--labels labels --predictions results --json val.json --plot val.png",
            "--labels labels --predictions results --no-2d-filter",
            "--labels labels --predictions results --distance-bands 0-20 20-40",
            "--labels labels --predictions results --score 0.5 --classes Car",
            "--labels labels --predictions results --classes Truck --overlap Truck=0.5",
            "--labels labels --predictions results --classes Car bicycle=Cyclist",
            "--labels labels --predictions val --bootstrap 1000 --groups drives.csv",
            "--labels labels --predictions val --bootstrap 1000 --against other",
        ],
    )
    parser.add_argument("--labels", type=Path, required=True, metavar="DIR", help="label files (KITTI's label_2)")
    parser.add_argument("--predictions", type=Path, required=True, metavar="DIR", help="result files with scores")
    parser.add_argument("--frames", type=Path, metavar="FILE", help="names of the frames to score, one a line")
    parser.add_argument(
        "--missing-as-empty", action="store_true", help="a frame without result file has no detections (else an error)"
    )
    parser.add_argument(
        "--classes",
        nargs="+",
        metavar="CLASS",
        help="to score (default: Car, Pedestrian and Cyclist, and every class that KITTI does not know); "
        "bicycle=Cyclist: labels and results of this name count as this class, which is scored",
    )
    add_overlaps(parser)
    parser.add_argument(
        "--no-2d-filter",
        action="store_true",
        help="levels from occlusion and truncation alone, without the height of 2D boxes: for data without images",
    )
    parser.add_argument(
        "--distance-bands",
        type=_band,
        nargs="+",
        metavar="FROM-TO",
        help="levels from the distance in metres alone, such as 0-20 20-40 40-60",
    )
    parser.add_argument(
        "--same-axes",
        action="store_true",
        help="3D boxes of labels and of results are in the same axes, although only one side has 2D boxes (else an "
        "error)",
    )
    parser.add_argument(
        "--score", type=float, metavar="X", help="the report counts detections from this score (default: best F1)"
    )
    parser.add_argument(
        "--clouds",
        type=Path,
        metavar="DIR",
        help="folder with velodyne/ and calib/ (none without a camera): adds the recall by number of points in the box",
    )
    add_columns(parser)
    add_bootstrap(parser)
    parser.add_argument(
        "--against",
        type=Path,
        metavar="DIR",
        help="other results of the same frames: how much higher the AP is than theirs (with --bootstrap)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the precision-recall curves")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw these curves (.png, .pdf, .svg)")
    args = parser.parse_args(argv)
    if args.plot and args.plot.suffix not in (".png", ".pdf", ".svg"):
        raise InputError(f"{args.plot}: not the name of a picture; let it end in .png, .pdf or .svg")
    if args.score is not None and not math.isfinite(args.score):
        raise InputError(f"--score {args.score}: want a finite number")
    levels: Sequence[Level] | None = LEVELS_WITHOUT_2D if args.no_2d_filter else None
    if args.distance_bands:
        levels = distance_levels(args.distance_bands)
    given, renamed = read_classes(args.classes)
    if args.against and args.bootstrap is None:
        raise InputError(f"--against {args.against}: is for --bootstrap N; add it")
    folders = _read_folders(args, args.predictions)
    against = _read_folders(args, args.against).predictions if args.against else None
    frames, labels, predictions, missing = rename_all(folders, renamed)
    resampling = read_bootstrap(args, frames)
    classes = choose_classes(given, labels, predictions)
    overlaps = read_overlaps(args.overlap, classes)
    columns = parse_columns(args.columns) if args.columns is not None else ()
    points = read_point_counts(args.clouds, frames, labels, columns) if args.clouds else None
    score = partial(
        evaluate,
        labels,
        classes=classes,
        rules={name: rule_for(name, 0.0, overlap) for name, overlap in overlaps.items()},
        levels=levels,
        score_threshold=args.score,
        points=points,
        resampling=resampling,
    )
    result = score(predictions)
    print(format_table(result))
    empty = f", {len(missing)} of them without a result file, counted as empty" if missing else ""
    print(f"\n{len(frames)} frame{'s' * (len(frames) != 1)} scored{empty}")
    for what, rows in (("labels", labels), ("results", predictions)):
        if others := count_others((name for frame in rows for name in frame.name.tolist()), classes):
            print(textwrap.fill(f"{what} of classes that are not scored: {others}", 100))
    if against is not None:
        found = differences(result, score([rename(frame, renamed) for frame in against]))
        print(f"\nexact AP less that of {args.against}, in points [{CONFIDENCE} % interval]\n")
        print(format_differences(result, found))
        for name in found:
            result[name]["bootstrap"]["differences"] = found[name]
    figures = {name: {key: scored[key] for key in scored if key not in ARRAYS} for name, scored in result.items()}
    try:
        if args.json:
            args.json.write_text(json.dumps(figures, indent=1) + "\n")
        if args.csv:
            write_csv(args.csv, result)
        if args.plot:
            plot(args.plot, result)
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be written ({error.strerror})") from error


if __name__ == "__main__":
    run_command(main)
