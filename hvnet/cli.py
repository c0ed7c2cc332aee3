"""What every command shares: the error a user can mend, and how it ends a command."""

import sys
from collections.abc import Callable, Sequence


class InputError(ValueError):
    """A mistake in what the user gave; the message names the file, the place and the remedy."""


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
