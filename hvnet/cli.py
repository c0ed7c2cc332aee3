"""What every command shares: its parser, the error a user can mend, and how it ends."""

import argparse
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path


class InputError(ValueError):
    """A mistake in what the user gave; the message names the file, the place and the remedy."""


def make_parser(command: str, description: str, examples: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of `python -m hvnet.COMMAND`; its help ends with examples, each what follows the command."""
    return argparse.ArgumentParser(
        prog=f"python -m hvnet.{command}",
        description=textwrap.fill(description, 98),
        epilog="\n".join(["examples:", *(f"  python -m hvnet.{command} {example}".rstrip() for example in examples)]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_device(parser: argparse.ArgumentParser) -> None:
    """The option --device."""
    parser.add_argument("--device", default="auto", metavar="NAME", help="auto, cpu, cuda or cuda:1 (default: auto)")


def add_checkpoint(parser: argparse.ArgumentParser) -> None:
    """The option --checkpoint."""
    parser.add_argument(
        "--checkpoint", type=Path, metavar="FILE", help="of python -m hvnet.train (default: the weights of the package)"
    )


def add_changes(parser: argparse.ArgumentParser, what: str) -> None:
    """The option --set, a list of changes; `what` is its help."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=what)


def check_empty(out: Path, remedy: str = "give another --out") -> None:
    """Raises InputError unless `out` is an empty folder or does not exist."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is not empty; {remedy}")


def run_command(main: Callable[[Sequence[str] | None], None]) -> None:
    """Runs a command's main: a user's mistake, or a file that fails, ends it with one line and exit code 2."""
    try:
        main(None)
    except (InputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
