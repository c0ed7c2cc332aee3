"""What every command shares: its parser, common options, and how it ends."""

import argparse
import math
import sys
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from hvnet.config import DataConfig
from hvnet.data.columns import parse_columns
from hvnet.data.drives import read_drives
from hvnet.data.labels import class_map
from hvnet.evaluation.bootstrap import CONFIDENCE, MIN_RESAMPLES, Resampling, resample
from hvnet.exceptions import InputError, Stopped

MAX_SENSOR_HEIGHT = 1000.0  # metres; below 0 where heights are those of a map


def make_parser(command: str, description: str, examples: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of `python -m hvnet.COMMAND`; its help ends with examples, each what follows the command."""
    return argparse.ArgumentParser(
        prog=f"python -m hvnet.{command}",
        description=textwrap.fill(description, 98),
        epilog="\n".join(["examples:", *(f"  python -m hvnet.{command} {example}".rstrip() for example in examples)]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_inputs(parser: argparse.ArgumentParser, suffixes: Sequence[str]) -> None:
    """The clouds that a command reads: INPUT and the option --split; `suffixes` are those of the files it knows."""
    parser.add_argument(
        "inputs", nargs="+", type=Path, metavar="INPUT", help=f"files ({', '.join(suffixes)}), folders, KITTI roots"
    )
    parser.add_argument(
        "--split", metavar="NAME", help="frames of ImageSets/NAME.txt of a KITTI root (default: all frames)"
    )


def add_columns(parser: argparse.ArgumentParser) -> None:
    """The option --columns."""
    parser.add_argument(
        "--columns",
        metavar="N|NAMES",
        help="the numbers of a point in .bin and .npy files: 5, or x,y,z,i,_ (i: the reflectance; default: found out)",
    )


def add_reading(parser: argparse.ArgumentParser) -> None:
    """The options --columns, --reflectance-scale and --classes; see `read_reading`."""
    add_columns(parser)
    parser.add_argument(
        "--reflectance-scale",
        metavar="X|none",
        help="what the reflectance is divided by, such as 255; none leaves it out (default: found out)",
    )
    parser.add_argument(
        "--classes",
        action="append",
        default=[],
        metavar="NAME=CLASS",
        help="labels of this name count as a class of the detector, such as bicycle=Cyclist; several with commas",
    )


def read_reading(
    options: argparse.Namespace, given: DataConfig | None = None, classes: Sequence[str] | None = None
) -> DataConfig:
    """How clouds and labels are read: the options of `add_reading`, and what is `given` where they say nothing.

    Raises InputError for a value that means nothing, and for a class that is not one of these, if they are known.
    """
    changes: dict[str, Any] = {}
    if options.columns is not None:
        changes["columns"] = parse_columns(options.columns)
    if options.reflectance_scale is not None:
        scale = 0.0 if options.reflectance_scale == "none" else _number(options.reflectance_scale)
        if not 0 <= scale < math.inf or (scale == 0 and options.reflectance_scale != "none"):
            raise InputError(f"--reflectance-scale {options.reflectance_scale}: want a number above 0, or none")
        changes["reflectance_scale"] = scale
    if options.classes:
        changes["classes"] = class_map(options.classes)
        for name, meant in changes["classes"].items():
            if classes is not None and meant not in classes:
                raise InputError(f"--classes {name}={meant}: no class {meant}; there are {', '.join(classes)}")
    return replace(given or DataConfig(), **changes)


def add_sensor_height(parser: argparse.ArgumentParser, what: str) -> None:
    """The option --sensor-height, what it does in a few words; see `read_sensor_height`."""
    parser.add_argument(
        "--sensor-height",
        metavar="METRES",
        help=f"of the LiDAR above the road{what} (default: found from the ground)",
    )


def read_sensor_height(options: argparse.Namespace) -> float | Literal["none"] | None:
    """The value of --sensor-height, None where it is not given. Raises InputError for one that means nothing."""
    text = options.sensor_height
    if text is None or text == "none":
        return text
    height = _number(text)
    if not abs(height) <= MAX_SENSOR_HEIGHT:
        raise InputError(f"--sensor-height {text}: want metres, {MAX_SENSOR_HEIGHT:g} at most, or none")
    return height


def add_mount(parser: argparse.ArgumentParser) -> None:
    """The options --sensor-height, --turn and --all-round; see `read_mount`."""
    add_sensor_height(parser, "; none: clouds stay where they are")
    parser.add_argument(
        "--turn",
        default="0",
        metavar="DEGREES",
        help="turn the cloud counter-clockwise, so that its forward points along x: -90 where it is y (default: 0)",
    )
    parser.add_argument(
        "--all-round", action="store_true", help="detect in all directions: several looks, joined by NMS"
    )


def read_mount(options: argparse.Namespace) -> dict[str, Any]:
    """The options of `add_mount` as `hvnet.load` takes them. Raises InputError for a value that means nothing."""
    height, turn = read_sensor_height(options), _number(options.turn)
    if not abs(turn) <= 360:
        raise InputError(f"--turn {options.turn}: want degrees from -360 to 360")
    return {"sensor_height": "found" if height is None else height, "turn": turn, "all_round": options.all_round}


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def add_device(parser: argparse.ArgumentParser) -> None:
    """The option --device."""
    parser.add_argument("--device", default="auto", metavar="NAME", help="auto, cpu, cuda or cuda:1 (default: auto)")


def add_checkpoint(parser: argparse.ArgumentParser) -> None:
    """The options --checkpoint and --weights, of which one may be given: `options.checkpoint` is what `hvnet.load`
    takes, a path, a name or None."""
    either = parser.add_mutually_exclusive_group()
    either.add_argument("--checkpoint", type=Path, metavar="FILE", help="from hvnet.train (default: --weights compact)")
    either.add_argument(
        "--weights", dest="checkpoint", metavar="NAME", help="weights of the package, see docs/model_card.md"
    )


def add_overlaps(parser: argparse.ArgumentParser) -> None:
    """The option --overlap, a list of CLASS=VALUE; see `read_overlaps`."""
    parser.add_argument(
        "--overlap",
        action="append",
        default=[],
        metavar="CLASS=X",
        help="overlap that a detection of a class needs (default: KITTI's; else by size, 0.7 from 3 m on, 0.5 below)",
    )


def read_overlaps(given: Sequence[str], classes: Sequence[str]) -> dict[str, float]:
    """The values of --overlap by class. Raises InputError for an unknown class or an invalid overlap."""
    overlaps = {}
    for text in given:
        name, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = math.nan
        if not name or not 0 < value <= 1:
            raise InputError(f"--overlap {text}: want CLASS=X with X above 0 and at most 1, such as Truck=0.5")
        if name not in classes:
            raise InputError(f"--overlap {text}: no class {name}; there are {', '.join(classes)}")
        overlaps[name] = value
    return overlaps


def add_bootstrap(parser: argparse.ArgumentParser) -> None:
    """The options --bootstrap, --groups and --seed; see `read_bootstrap`."""
    parser.add_argument(
        "--bootstrap",
        type=int,
        metavar="N",
        help=f"give every AP its {CONFIDENCE} %% interval, of N resamples of the frames such as 1000",
    )
    parser.add_argument(
        "--groups",
        type=Path,
        metavar="FILE",
        help="draw the frames of a drive together; a CSV file with the columns frame and drive",
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the resamples (default: 0)")


def read_bootstrap(options: argparse.Namespace, frames: Sequence[str]) -> Resampling | None:
    """The resamples of frames that the options of `add_bootstrap` ask for, None without them.

    Raises InputError for a value that means nothing, and for a frame that is in no group.
    """
    count, groups, seed = options.bootstrap, options.groups, options.seed
    if count is None:
        if groups is not None:
            raise InputError(f"--groups {groups}: is for --bootstrap N; add it")
        return None
    if count < MIN_RESAMPLES:
        raise InputError(f"--bootstrap {count}: want {MIN_RESAMPLES} resamples or more, such as 1000")
    if seed < 0:
        raise InputError(f"--seed {seed}: want 0 or more")
    if not frames:
        raise InputError(f"--bootstrap {count}: no frame has labels, so nothing is scored; leave it out")
    return resample(count, frames if groups is None else read_drives(groups, frames), seed=seed)


def add_changes(parser: argparse.ArgumentParser, what: str) -> None:
    """The option --set, a list of changes; `what` is its help."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=what)


def run_command(main: Callable[[Sequence[str] | None], None]) -> None:
    """Runs a command's main: a user's mistake or a failing file ends it with one line and exit code 2,
    a signal with exit code 128 plus its number."""
    try:
        main(None)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except Stopped as stop:
        if str(stop):  # empty on all ranks but the first
            print(stop, flush=True)
        sys.exit(128 + stop.signal)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
