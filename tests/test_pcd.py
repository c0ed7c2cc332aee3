"""The reader of .pcd files: the format's rules by hand, real files, what pypcd4 writes, and damaged files."""

import re
import struct
import tracemalloc
import warnings
from pathlib import Path

import lzf
import numpy as np
import pytest
from numpy.typing import NDArray
from pypcd4 import Encoding, PointCloud

from hvnet.data.pcd import read_pcd
from hvnet.exceptions import InputError
from tests.helpers import SHARED

HEADER = """# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z
SIZE 4 4 4
TYPE F F F
COUNT 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA binary
"""
XYZ = np.array([[1, 2, 3], [4, 5.5, -6]], "<f4")
WANT = {"x": [1, 4], "y": [2, 5.5], "z": [3, -6]}


def read(path: Path, header: str, body: bytes = b"") -> dict[str, list]:
    path.write_bytes(header.encode() + body)
    return {name: column.tolist() for name, column in read_pcd(path).items()}


def packed(content: bytes) -> bytes:
    """A container of compressed bytes; what does not become smaller is stored."""
    smaller = lzf.compress(content) or content
    return struct.pack("<II", len(smaller), len(content)) + smaller


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cloud.pcd"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ("VERSION 0.7\n", ""),
        ("VERSION 0.7", "VERSION .7"),
        ("VERSION 0.7\nFIELDS", "VERSION .5\nCOLUMNS"),
        ("VERSION 0.7", "VERSION 0.6"),
        ("COUNT 1 1 1\n", ""),
        ("HEIGHT 1\n", ""),
        ("HEIGHT 1\n", "HEIGHT 0\n"),
        ("WIDTH 2\nHEIGHT 1\n", "WIDTH 1\nHEIGHT 2\n"),
        ("WIDTH 2\nHEIGHT 1\n", ""),
        ("POINTS 2\n", ""),
        ("VIEWPOINT 0 0 0 1 0 0 0\n", ""),
        ("VIEWPOINT 0 0 0 1 0 0 0\n", "VIEWPOINT 0.5 1e-3\n"),
        ("FIELDS x y z", "fields  x\ty  z "),
        ("TYPE F F F", "Type f F f"),
        ("DATA binary", "data Binary"),
        ("WIDTH", "\n  # a comment\n\nSOMETHING new\nWIDTH"),
        ("\n", "\r\n"),
    ],
)
def test_headers(path: Path, old: str, new: str) -> None:
    header = HEADER.replace(old, new)
    assert read(path, header, XYZ.tobytes()) == WANT
    assert read(path, header, XYZ.tobytes() + b"\0" * 9) == WANT  # what follows is of no matter
    text = re.sub("binary", "ascii", header, flags=re.IGNORECASE)
    assert read(path, text, b"1 2 3\n4 5.5 -6\n") == WANT
    assert (
        read(path, re.sub("binary", "binary_compressed", header, flags=re.IGNORECASE), packed(XYZ.T.tobytes())) == WANT
    )


@pytest.mark.parametrize("kind", ["F2", "F4", "F8", "I1", "I2", "I4", "I8", "U1", "U2", "U4", "U8"])
def test_types(path: Path, kind: str) -> None:
    """One field of every type between two others: the values next to it stay."""
    dtype = np.dtype(f"<{kind.lower()}")
    values = [0, 1, 100] if dtype.kind == "f" else [np.iinfo(dtype).min, 7, np.iinfo(dtype).max]
    rows = np.array([(k, value, -k) for k, value in enumerate(values)], [("a", "<f4"), ("b", dtype), ("c", "<i2")])
    header = f"FIELDS a b c\nSIZE 4 {dtype.itemsize} 2\nTYPE F {kind[0]} I\nWIDTH 3\nDATA "
    want = {name: rows[name].tolist() for name in ("a", "b", "c")}
    assert read(path, header + "binary\n", rows.tobytes()) == want
    assert read_pcd(path)["b"].dtype == dtype
    by_field = b"".join(rows[name].tobytes() for name in ("a", "b", "c"))
    assert read(path, header + "binary_compressed\n", packed(by_field)) == want
    assert read_pcd(path)["b"].dtype == dtype
    found = read(path, header + "ascii\n", "\n".join(f"{a} {b} {c}" for a, b, c in rows.tolist()).encode())
    assert found == {name: [float(value) for value in column] for name, column in want.items()}


PADDED = "FIELDS x _ i _ n _\nSIZE 4 1 1 3 2 8\nTYPE F U U P I F\nCOUNT 1 4 1 0 2 1\nPOINTS 2\nDATA "
ROWS = [struct.pack("<f4xB2h8x", x, i, n, 9) for x, i, n in ((1.5, 7, -2), (2.5, 8, -3))]
PADDED_WANT = {"x": [1.5, 2.5], "i": [7, 8], "n": [-2, -3]}


def test_padding_and_counts(path: Path) -> None:
    """Padding takes the bytes of its SIZE and COUNT, none for a COUNT of 0; of several values the first is taken."""
    assert read(path, PADDED + "binary\n", b"".join(ROWS)) == PADDED_WANT
    assert read(path, PADDED + "ascii\n", b"1.5 0 0 0 0 7 -2 9 0\n2.5 0 0 0 0 8 -3 9 0") == PADDED_WANT
    columns = [(0, 4), (4, 8), (8, 9), (9, 13), (13, 21)]
    with_padding = b"".join(row[begin:end] for begin, end in columns for row in ROWS)
    without = b"".join(row[begin:end] for begin, end in (columns[0], columns[2], columns[3]) for row in ROWS)
    for content in (with_padding, without):  # pypcd4 and PCL
        assert read(path, PADDED + "binary_compressed\n", packed(content)) == PADDED_WANT
    nothing = "FIELDS x y\nSIZE 4 4\nTYPE F F\nCOUNT 1 0\nWIDTH 2\nDATA binary\n"
    assert read(path, nothing, XYZ.tobytes()) == {"x": [1, 2]}


def test_of_two_fields_of_one_name_the_first_is_taken(path: Path) -> None:
    assert read(path, HEADER.replace("x y z", "x y x"), XYZ.tobytes()) == {"x": [1, 4], "y": [2, 5.5]}


@pytest.mark.parametrize(
    "body",
    [
        b"1 2 3\n4 5.5 -6",
        b"1 2 3\r\n4 5.5 -6\r\n",
        b"  1   2\t3  \n\n4  5.50 -6.0e0\n\n \n\r\n",
        b"+1 2. 3\n4 55e-1 -6",
    ],
)
def test_text(path: Path, body: bytes) -> None:
    assert read(path, HEADER.replace("binary", "ascii"), body) == WANT


def test_text_that_is_not_finite(path: Path) -> None:
    found = read(path, HEADER.replace("binary", "ascii"), b"nan -nan NaN\ninf -Inf 1e400\n")
    np.testing.assert_array_equal(list(found.values()), [[np.nan, np.inf], [np.nan, -np.inf], [np.nan, np.inf]])


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("body", [b"", b"\n", struct.pack("<II", 0, 0)])
def test_no_points(path: Path, encoding: str, body: bytes) -> None:
    header = HEADER.replace("WIDTH 2", "WIDTH 0").replace("POINTS 2", "POINTS 0").replace("binary", encoding)
    if encoding == "ascii" and body.strip():
        with pytest.raises(InputError, match=r"line 12 is one more than the 0 points of the header"):
            read(path, header, body)
    else:
        assert read(path, header.removesuffix("\n") if not body else header, body) == {"x": [], "y": [], "z": []}


def compressible(points: int = 100) -> tuple[str, NDArray[np.float32]]:
    header = (
        HEADER.replace("WIDTH 2", f"WIDTH {points}").replace("POINTS 2\n", "").replace("binary", "binary_compressed")
    )
    return header, np.repeat(np.arange(3, dtype="<f4"), points).reshape(3, points)


def test_compressed(path: Path) -> None:
    header, columns = compressible()
    body = packed(columns.tobytes())
    assert len(body) < 100
    assert read(path, header, body) == dict(zip("xyz", columns.tolist(), strict=True))
    assert read(path, header, body + b"more") == dict(zip("xyz", columns.tolist(), strict=True))
    stored = struct.pack("<II", 1200, 1200) + columns.tobytes()
    assert read(path, header, stored) == dict(zip("xyz", columns.tolist(), strict=True))


MISTAKES: dict[str, tuple[str, str, bytes]] = {
    "": ("the header has no DATA", "", b""),
    "DATA binary": ("DATA is 'pickle'; known: ascii, binary, binary_compressed", "DATA pickle", b""),
    "FIELDS x y z\n": ("the header has no FIELDS", "", b""),
    "x y z": ("the header has no FIELDS", "", b""),
    "SIZE 4 4 4": ("SIZE has 2 values for 3 fields", "SIZE 4 4", b""),
    "SIZE 4": ("SIZE has '-4', which is no whole number of 0 or more", "SIZE -4", b""),
    "4 4 4": ("TYPE 'F' of SIZE 3 is unknown", "4 3 4", b""),
    "F F F": ("TYPE 'Q' of SIZE 4 is unknown", "F F Q", b""),
    "TYPE F F F\n": ("TYPE has 0 values for 3 fields", "", b""),
    "COUNT 1 1 1": ("COUNT has 4 values for 3 fields", "COUNT 1 1 1 1", b""),
    "COUNT 1": ("COUNT has '1.5', which is no whole number of 0 or more", "COUNT 1.5", b""),
    "WIDTH 2": ("POINTS is 2, and WIDTH times HEIGHT is 3", "WIDTH 3", b""),
    "HEIGHT 1": ("POINTS is 2, and WIDTH times HEIGHT is 6", "HEIGHT 3", b""),
    "POINTS 2": ("POINTS has '', which is no whole number of 0 or more", "POINTS", b""),
    "WIDTH 2\n": ("WIDTH has '-2', which is no whole number of 0 or more", "WIDTH -2\n", b""),
    "HEIGHT 1\n": (
        "HEIGHT has '" + "1" * 40 + "', which is no whole number of 0 or more",
        "HEIGHT " + "1" * 5000 + "\n",
        b"",
    ),
    "WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\n": ("the header has neither WIDTH nor POINTS", "", b""),
    "WIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2": (
        "DATA binary wants 12,000,000,000,000 bytes for 1,000,000,000,000 points, the file has 24",
        "WIDTH 1000000000000",
        XYZ.tobytes(),
    ),
    "VERSION": ("DATA binary wants 24 bytes for 2 points, the file has 23", "VERSION", XYZ.tobytes()[:-1]),
    "\n": ("the header has no DATA", "\n" + "#" * 2**14 + "\n", XYZ.tobytes()),
}


@pytest.mark.parametrize("old", MISTAKES)
def test_mistakes_in_headers(path: Path, old: str) -> None:
    reason, new, body = MISTAKES[old]
    with pytest.raises(InputError) as caught:
        read(path, HEADER.replace(old, new, 1) if old else "", body)
    assert str(caught.value) == f"{path}: cannot be read as .pcd ({reason}); write it again or convert it"


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        (b"1 2 3\n", "the header says 2 points, the file has 1"),
        (b"1 2 3\n\n4 5 6\n7 8 9", "line 15 is one more than the 2 points of the header"),
        (b"1 2 3\n4 5", "line 13 has less than 3 numbers"),
        (b"1 2 3 4\n5 6", "line 12 has more than 3 numbers"),
        (b"1 2 3\n4 five 6\n", "line 13 has words that are no numbers"),
        (b"1 2 3\n4 5 \xff\xff\n", "line 13 has words that are no numbers"),
        (b"1,2,3\n4,5,6\n", "line 12 has less than 3 numbers"),
    ],
)
def test_mistakes_in_text(path: Path, body: bytes, reason: str) -> None:
    with pytest.raises(InputError, match=re.escape(f"{path}: cannot be read as .pcd ({reason}); write it again")):
        read(path, HEADER.replace("binary", "ascii"), body)


def test_mistakes_in_compressed_data(path: Path) -> None:
    header, columns = compressible()
    good = packed(columns.tobytes())
    small, size = struct.unpack_from("<II", good)
    huge = header.replace("WIDTH 100", "WIDTH 300000000")
    for text, body, reason in (
        (header, good[:7], "DATA binary_compressed wants two sizes, the file is cut off"),
        (header, good[:-1], f"DATA binary_compressed wants {small} bytes, the file has {small - 1}"),
        (header, struct.pack("<I", 2**32 - 1) + good[4:], f"wants 4,294,967,295 bytes, the file has {small}"),
        (
            header,
            good[:4] + struct.pack("<I", 2**32 - 1) + good[8:],
            "100 points are 1,200 bytes, and the file says 4,29",
        ),
        (
            huge,
            good[:4] + struct.pack("<I", 3_600_000_000) + good[8:],
            f"{small} compressed bytes cannot hold 3,600,000",
        ),
        (header, struct.pack("<II", small - 1, size) + good[8:-1], "error in compressed data"),
        (header, struct.pack("<II", 16, size) + b"\x0f" + bytes(15), "error in compressed data"),
        (header, packed(bytes(1196))[:4] + struct.pack("<I", size) + packed(bytes(1196))[8:], "data are damaged"),
        (header, packed(bytes(1204))[:4] + struct.pack("<I", size) + packed(bytes(1204))[8:], "data are damaged"),
    ):
        tracemalloc.start()
        with pytest.raises(InputError, match=re.escape(f"{path}: cannot be read as .pcd (") + ".*" + re.escape(reason)):
            read(path, text, body)
        assert tracemalloc.get_traced_memory()[1] < 2**20
        tracemalloc.stop()


def test_files_that_cannot_be_opened(path: Path) -> None:
    with pytest.raises(InputError, match=re.escape(f"{path}: cannot be read (No such file or directory)")):
        read_pcd(path)
    path.mkdir()
    with pytest.raises(InputError, match=re.escape(f"{path}: cannot be read (")):
        read_pcd(path)


@pytest.mark.parametrize("encoding", [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED])
def test_what_pypcd4_writes(path: Path, encoding: Encoding) -> None:
    generator = np.random.default_rng(0)
    types = {"x": np.float32, "y": np.float64, "z": np.float32, "intensity": np.uint8, "ring": np.uint16, "t": np.int32}
    columns = [np.round(generator.uniform(0, 100, 500)).astype(dtype) for dtype in types.values()]
    PointCloud.from_points(columns, list(types), list(types.values())).save(path, encoding=encoding)
    found = read_pcd(path)
    assert list(found) == list(types)
    for name, column in zip(types, columns, strict=True):
        np.testing.assert_array_equal(found[name], column)


def real(name: str) -> dict[str, NDArray]:
    file = SHARED / "clouds" / name
    if not file.exists():
        pytest.skip(f"no clouds at {file.parent}")
    return read_pcd(file)


def test_real_text() -> None:
    """PCL's tutorial: several blanks between numbers, CRLF."""
    found = real("ascii_blanks.pcd")
    assert {name: column.shape for name, column in found.items()} == {name: (9311,) for name in "xyz"}
    assert [column[0] for column in found.values()] == [72.25, -18.179, 0.85]
    assert [(column.min(), column.max()) for column in found.values()] == [
        (64.799, 72.799),
        (-22.189, -14.929),
        (-0.1, 1.68),
    ]


def test_real_padding() -> None:
    """SUSTechPOINTS' example: four fields of padding, one of which has COUNT 0, and bytes after the last point."""
    found = real("padded_fields.pcd")
    assert list(found) == ["x", "y", "z", "intensity", "timestamp", "ring"]
    assert {len(column) for column in found.values()} == {67153}
    xyz = np.stack([found[name] for name in "xyz"])
    assert np.isfinite(xyz).all()
    np.testing.assert_allclose(xyz.min(axis=1), [-182.5, -99.14, -12.54], atol=0.01)
    np.testing.assert_allclose(xyz.max(axis=1), [188.91, 194.58, 12.43], atol=0.01)
    assert (np.linalg.norm(xyz, axis=0) < 80).mean() > 0.95
    assert (found["intensity"].min(), found["intensity"].max()) == (0, 255)
    assert (found["intensity"] % 1 == 0).all()


def damaged(content: bytes, generator: np.random.Generator) -> bytes:
    """Cut, with bytes changed, with lines in another order, or with a number of the header replaced."""
    kind = generator.integers(0, 4)
    if kind == 0:
        return content[: generator.integers(0, len(content))]
    if kind == 1:
        changed = bytearray(content)
        for place in generator.integers(0, min(200, len(content)), 3):
            changed[place] = generator.integers(0, 256)
        return bytes(changed)
    if kind == 2:
        lines = content.splitlines(keepends=True)
        return b"".join(lines[k] for k in generator.integers(0, len(lines), len(lines) + 2))
    number = generator.choice(["0", "-1", "1e3", "1000000000000", "4294967296", "999999999999999", "2 2", "", "nan"])
    places = [match.span() for match in re.finditer(rb"\b\d+\b", content[:200])]
    begin, end = places[generator.integers(0, len(places))]
    return content[:begin] + str(number).encode() + content[end:]


def test_damaged_files(path: Path) -> None:
    """Columns of one length, or one line that names the file: no other error, no warning, no memory."""
    generator = np.random.default_rng(0)
    header, columns = compressible(60)
    plain = header.replace("binary_compressed", "{}")
    whole = [
        plain.format("binary").encode() + columns.T.tobytes(),
        plain.format("ascii").encode() + "\n".join(" ".join(map(str, row)) for row in columns.T).encode(),
        header.encode() + packed(columns.tobytes()),
        PADDED.encode() + b"binary\n" + b"".join(ROWS),
        PADDED.encode() + b"ascii\n" + b"1.5 0 0 0 0 7 -2 9 0\n" * 2,
    ]
    outcomes = {"columns": 0, "error": 0}
    tracemalloc.start()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in range(3000):
            path.write_bytes(damaged(whole[k % len(whole)], generator))
            try:
                found, said = read_pcd(path), ""
            except InputError as error:
                found, said = {}, str(error)
            assert all(column.ndim == 1 for column in found.values())
            assert len({len(column) for column in found.values()}) < 2
            assert not said or said.startswith(f"{path}: cannot be read as .pcd (")
            assert "\n" not in said
            assert len(said) < 300 + len(str(path))
            outcomes["error" if said else "columns"] += 1
    assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    tracemalloc.stop()
    assert min(outcomes.values()) > 300, outcomes
