"""Drives: frames that follow each other in time show one street, and count as less than as many streets."""

import csv
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from hvnet.exceptions import InputError


def read_drives(path: Path, names: Sequence[str]) -> list[str]:
    """The drive of each of the named frames, from a CSV file with the columns `frame` and `drive`.

    Raises InputError if the file is missing or has not these columns, a line is incomplete, a named frame is absent, or
    a frame is in two drives.
    """
    drives: dict[str, str] = {}
    remedy = "give a CSV file with the columns frame,drive"
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            for column in ("frame", "drive"):
                if column not in (rows.fieldnames or ()):
                    raise InputError(f"{path}:1: has no column {column}; the first line is to be frame,drive")
            for row in rows:
                frame, drive = ((row[column] or "").strip() for column in ("frame", "drive"))
                line = f"{path}:{rows.line_num}"
                if not frame or not drive:
                    raise InputError(f"{line}: want a frame and its drive; complete or remove the line")
                if drives.setdefault(frame, drive) != drive:
                    raise InputError(f"{line}: frame {frame} is already in drive {drives[frame]}; remove a line")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file; {remedy}") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read ({error}); {remedy}") from error
    unknown = [name for name in names if name not in drives]
    if unknown:
        raise InputError(
            f"{path}: has no drive for {len(unknown)} of {len(names)} frames, such as {unknown[0]}; add a line for each"
        )
    return [drives[name] for name in names]


def drive_weights(drives: Sequence[str]) -> Tensor:
    """How often each frame (N,) is drawn compared to others: 1 / sqrt(frames of its drive), float64.

    A drive of n frames is thus worth sqrt(n) drives of one frame: more than one, as its scans differ, and less than n.
    """
    frames_of = Counter(drives)
    return torch.tensor([frames_of[drive] for drive in drives], dtype=torch.float64).rsqrt()
