"""Checks of the folders that commands and runs write to."""

from pathlib import Path

from hvnet.exceptions import InputError


def check_empty(out: Path, remedy: str = "give another --out") -> None:
    """Raises InputError unless `out` is an empty folder or does not exist."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out}: is not empty; {remedy}")
