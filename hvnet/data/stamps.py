"""Stamps of frames: which bytes they were made of, so that what was built from them is not used after they change.

A cloud is read for its stamp only where its size or its modification time differs from what is known of it.
"""

import os
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from hvnet import ranks
from hvnet.data.frame import Frames

LABELS, CLOUD = "labels, calibration or options of reading", "cloud"
"""What can change of a frame."""
CHUNK = 2**20  # bytes that are read at once


class Stamp(NamedTuple):
    """Which bytes one frame is made of."""

    labels: int  # CRC-32 of its small files, and of how they are read
    size: int  # of its cloud's file, bytes; -1 if there is none
    modified: int  # time of its cloud's file, nanoseconds
    content: Callable[[], int]  # reads the cloud's file: its CRC-32


@dataclass(frozen=True)
class Stamps:
    """The stamps of F frames as numbers, to be kept in a file. Raises ValueError for other shapes."""

    names: Sequence[str]  # F frames
    numbers: NDArray[np.int64]  # (F, 4) labels, size, modified and content of each, as in Stamp

    def __post_init__(self) -> None:
        if self.numbers.shape != (len(self.names), 4):
            raise ValueError(f"numbers: want shape ({len(self.names)}, 4), got {self.numbers.shape}")


class Change(NamedTuple):
    """A frame that changed."""

    name: str
    what: str  # what of it


def stamp_of(frames: Frames, k: int) -> Stamp | None:
    """The stamp of frame k, None where the format has none: it may have a method `stamp(k)` that gives it."""
    own = getattr(frames, "stamp", None)
    return None if own is None else own(k)


def stamp_files(small: Sequence[Path], options: str, cloud: Path) -> Stamp:
    """The stamp of a frame of some small files, read with some options, and the file of a cloud.

    A file that cannot be read, or is not there, has a stamp too: it is a change if it can be read later.
    """
    labels = zlib.crc32(options.encode())
    for path in small:
        try:
            content = path.read_bytes()
            labels = zlib.crc32(b"%d:" % len(content) + content, labels)  # no byte may pass from one file to the next
        except OSError:
            labels = zlib.crc32(b"-", labels)
    try:
        status = os.stat(cloud)
    except OSError:
        return Stamp(labels, -1, 0, lambda: 0)
    return Stamp(labels, status.st_size, status.st_mtime_ns, partial(_crc32, cloud))


def _crc32(path: Path) -> int:
    value = 0
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                value = zlib.crc32(chunk, value)
    except OSError:
        return 0
    return value


def take_stamps(frames: Frames, wanted: Sequence[int] | None = None, known: Stamps | None = None) -> Stamps | None:
    """The stamps of these frames, or those of them that are wanted, as they are now; None where the format has none.

    A cloud of the size and time that are known of it is not read.
    """
    rows = {} if known is None else dict(zip(known.names, known.numbers.tolist(), strict=True))
    wanted = range(len(frames)) if wanted is None else wanted
    numbers: list[tuple[int, int, int, int]] = []
    hidden = ranks.rank() > 0
    for k in tqdm(wanted, desc="stamps", unit="frame", leave=False, dynamic_ncols=True, disable=hidden):
        stamp = stamp_of(frames, k)
        if stamp is None:
            return None
        labels, size, modified, read = stamp
        row = rows.get(frames.names[k])
        content = row[3] if row is not None and row[1:3] == [size, modified] else read()
        numbers.append((labels, size, modified, content))
    return Stamps([frames.names[k] for k in wanted], np.array(numbers, np.int64).reshape(-1, 4))


def find_changes(before: Stamps, now: Stamps) -> list[Change]:
    """The frames of `now` that were others before. What is not in both is left out, and the time alone is no change."""
    rows = dict(zip(before.names, before.numbers.tolist(), strict=True))
    changes = []
    for name, (labels, size, _, content) in zip(now.names, now.numbers.tolist(), strict=True):
        row = rows.get(name, [labels, size, None, content])
        parts = [LABELS] * (row[0] != labels) + [CLOUD] * (row[1] != size or row[3] != content)
        if parts:
            changes.append(Change(name, "; ".join(parts)))
    return changes


def describe_changes(changes: Sequence[Change]) -> str:
    """Frames that changed, in a few words: the first, what of it, and how many others."""
    name, what = changes[0]
    others = f" and {len(changes) - 1} more" if len(changes) > 1 else ""
    return f"frames have changed: {name} ({what}){others}"
