"""What every command shares: its parser, common options, and how it ends."""

import argparse
import math
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

from hvnet.exceptions import InputError, Stopped


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


def add_device(parser: argparse.ArgumentParser) -> None:
    """The option --device."""
    parser.add_argument("--device", default="auto", metavar="NAME", help="auto, cpu, cuda or cuda:1 (default: auto)")


def add_checkpoint(parser: argparse.ArgumentParser) -> None:
    """The option --checkpoint."""
    parser.add_argument(
        "--checkpoint", type=Path, metavar="FILE", help="from hvnet.train (default: the weights of the package)"
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
