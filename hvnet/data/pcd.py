"""Point Cloud Library's .pcd files: ascii, binary and binary_compressed, versions 0.5 to 0.7.

A reader of our own, since none on PyPI reads all real files: pypcd4 fails on several blanks between numbers, padding of
COUNT 0, headers without COUNT or POINTS and version 0.5, and it needs pydantic.
"""

import io
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import lzf
import numpy as np
from numpy.typing import NDArray

from hvnet.exceptions import InputError

PADDING = "_"
"""Name of the fields that hold nothing."""
TYPES = ("F2", "F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8")
ENCODINGS = ("ascii", "binary", "binary_compressed")
MAX_HEADER = 2**14
"""Bytes in which the header must end."""
MAX_RATIO = 88
"""LZF makes at most 264 bytes of 3."""


class Field(NamedTuple):
    """A field of the header."""

    name: str
    dtype: str  # of a value, little-endian
    values: int  # a point
    size: int  # bytes a point


class Header(NamedTuple):
    """What the header says."""

    fields: list[Field]
    points: int
    encoding: str  # one of ENCODINGS
    lines: int  # of the header
    start: int  # byte at which the data begin


def read_pcd(path: Path) -> dict[str, NDArray]:
    """The columns (N,) of a .pcd file by the names of its fields, in the order of its header.

    Padding is left out, of a field with several values the first one is taken, and of two fields of one name the first.
    Numbers written as text are float64. Raises InputError naming the file.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    try:
        header = _read_header(data)
        if header.encoding == "ascii":
            return _read_text(data, header)
        if header.encoding == "binary" or not header.points:
            return _read_binary(data, header)
        return _read_compressed(data, header)
    except (ValueError, MemoryError) as error:
        reason = str(error) or "too large for the memory"
        raise InputError(f"{path}: cannot be read as .pcd ({reason}); write it again or convert it") from error


def _read_header(data: bytes) -> Header:
    entries: dict[str, list[str]] = {}
    start, lines = 0, 0
    for line in io.BytesIO(data[:MAX_HEADER]):
        start, lines = start + len(line), lines + 1
        words = line.decode(errors="replace").split()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
            if words[0].upper() == "DATA":
                break
    else:
        raise ValueError("the header has no DATA")
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in ENCODINGS:
        raise ValueError(f"DATA is {encoding[:40]!r}; known: {', '.join(ENCODINGS)}")
    return Header(_read_fields(entries), _count_points(entries), encoding, lines, start)


def _read_fields(entries: dict[str, list[str]]) -> list[Field]:
    names = entries.get("FIELDS") or entries.get("COLUMNS")  # as version 0.5 calls them
    if not names:
        raise ValueError("the header has no FIELDS")
    columns = [names]
    for key, default in (("SIZE", []), ("TYPE", []), ("COUNT", ["1"] * len(names))):
        columns.append(entries.get(key, default))
        if len(columns[-1]) != len(names):
            raise ValueError(f"{key} has {len(columns[-1])} values for {len(names)} fields")
    fields = []
    for name, size, kind, count in zip(*columns, strict=True):
        width, values = _whole_number("SIZE", size), _whole_number("COUNT", count)
        if name != PADDING and f"{kind.upper()}{width}" not in TYPES:
            raise ValueError(f"TYPE {kind[:40]!r} of SIZE {width} is unknown")
        fields.append(Field(name, f"<{kind.lower()}{width}", values, width * values))
    return fields


def _count_points(entries: dict[str, list[str]]) -> int:
    width, height, points = (
        _whole_number(key, " ".join(entries[key])) if key in entries else None for key in ("WIDTH", "HEIGHT", "POINTS")
    )
    if width is None:
        if points is None:
            raise ValueError("the header has neither WIDTH nor POINTS")
        return points
    product = width * (height or 1)  # PCL takes a HEIGHT of 0 for 1
    if points is not None and points != product:
        raise ValueError(f"POINTS is {points}, and WIDTH times HEIGHT is {product}")
    return product


def _whole_number(key: str, word: str) -> int:
    if not re.fullmatch("[0-9]{1,15}", word):
        raise ValueError(f"{key} has {word[:40]!r}, which is no whole number of 0 or more")
    return int(word)


def _read_text(data: bytes, header: Header) -> dict[str, NDArray]:
    width = sum(field.values for field in header.fields)
    values = np.fromiter(_numbers(data, header, width), dtype=np.float64).reshape(header.points, width)
    columns = list(accumulate((field.values for field in header.fields), initial=0))
    return _by_name(header.fields, lambda k: values[:, columns[k]])


def _numbers(data: bytes, header: Header, width: int) -> Iterator[float]:
    """The numbers of all points, each on a line of its own."""
    body = io.BytesIO(data)
    body.seek(header.start)
    points = 0
    for number, line in enumerate(body, header.lines + 1):
        words = line.split(maxsplit=width)
        if not words:
            continue
        points += 1
        if points > header.points:
            raise ValueError(f"line {number} is one more than the {header.points:,} points of the header")
        if len(words) != width:
            raise ValueError(f"line {number} has {'more' if len(words) > width else 'less'} than {width} numbers")
        try:
            yield from map(float, words)
        except ValueError as error:
            raise ValueError(f"line {number} has words that are no numbers") from error
    if points < header.points:
        raise ValueError(f"the header says {header.points:,} points, the file has {points:,}")


def _read_binary(data: bytes, header: Header) -> dict[str, NDArray]:
    """Point after point."""
    fields, points = header.fields, header.points
    step = sum(field.size for field in fields)
    left = len(data) - header.start
    if left < step * points:
        raise ValueError(f"DATA binary wants {step * points:,} bytes for {points:,} points, the file has {left:,}")
    if not points:
        return _by_name(fields, lambda k: np.empty(0, fields[k].dtype))
    offsets = list(accumulate((field.size for field in fields), initial=header.start))
    return _by_name(fields, lambda k: np.ndarray((points,), fields[k].dtype, data, offsets[k], (step,)))


def _read_compressed(data: bytes, header: Header) -> dict[str, NDArray]:
    """Field after field."""
    start, points, fields = header.start + 8, header.points, header.fields
    if len(data) < start:
        raise ValueError("DATA binary_compressed wants two sizes, the file is cut off")
    packed, size = struct.unpack_from("<II", data, header.start)
    if len(data) < start + packed:
        raise ValueError(f"DATA binary_compressed wants {packed:,} bytes, the file has {len(data) - start:,}")
    if size != points * sum(field.size for field in fields):
        fields = [field for field in fields if field.name != PADDING]  # PCL compresses no padding
    want = points * sum(field.size for field in fields)
    if size != want:
        raise ValueError(f"{points:,} points are {want:,} bytes, and the file says {size:,}")
    content = data[start : start + packed]
    if packed != size:  # else it is stored as it is
        if size > MAX_RATIO * packed:
            raise ValueError(f"{packed:,} compressed bytes cannot hold {size:,}")
        content = lzf.decompress(content, size)
        if content is None or len(content) != size:
            raise ValueError("its compressed data are damaged")
    offsets = list(accumulate((field.size * points for field in fields), initial=0))
    return _by_name(fields, lambda k: np.ndarray((points,), fields[k].dtype, content, offsets[k], (fields[k].size,)))


def _by_name(fields: Sequence[Field], column: Callable[[int], NDArray]) -> dict[str, NDArray]:
    """The columns of the fields by name: the first of a name, without padding and without fields that hold nothing."""
    columns: dict[str, NDArray] = {}
    for k, field in enumerate(fields):
        if field.name not in (PADDING, *columns) and field.values:
            columns[field.name] = column(k)
    return columns
