"""Clouds of one's own: every kind of file gives the same points; broken files are refused by name."""

import contextlib
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from hvnet.data.clouds import read_cloud
from hvnet.exceptions import InputError

KINDS = ("bin", "npy", "npy64", "pcd-ascii", "pcd-binary", "pcd-binary_compressed", "ply-ascii", "ply-binary")


def some_points(count: int = 60) -> NDArray[np.float32]:
    points = np.random.default_rng(0).uniform(-20, 20, (count, 4)).astype(np.float32)
    points[:, 3] = np.linspace(0, 1, count)
    return points


def write_cloud(
    folder: Path, kind: str, points: NDArray, names: tuple[str, ...] = ("x", "y", "z", "intensity")
) -> Path:
    """Writes the columns of points (N, C) under names, as far as the kind of file has names."""
    suffix, _, encoding = kind.partition("-")
    path = folder / f"cloud.{suffix[:3]}"
    if kind == "bin":
        path.write_bytes(points.astype("<f4").tobytes())
    elif suffix.startswith("npy"):
        np.save(path, points.astype(np.float64) if kind == "npy64" else points)
    elif suffix == "pcd":
        names = names[: points.shape[1]]
        PointCloud.from_points(points, names, [np.float32] * len(names)).save(path, encoding=Encoding(encoding))
    else:
        names = names[: points.shape[1]]
        rows = np.array([tuple(row) for row in points], dtype=[(name, "f4") for name in names])
        PlyData([PlyElement.describe(rows, "vertex")], text=encoding == "ascii").write(str(path))
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_the_same_points(tmp_path: Path, kind: str) -> None:
    points = some_points()
    read, notes = read_cloud(write_cloud(tmp_path, kind, points))
    assert read.dtype == np.float32
    assert read.shape == (60, 4)
    # text files hold fewer digits: 1e-5 m of 20 m are float32's own seven
    np.testing.assert_allclose(read, points, rtol=0, atol=1e-5 if kind.endswith("ascii") else 0)
    assert notes == []


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "bin"])
def test_without_reflectance_it_is_0_and_a_note_says_so(tmp_path: Path, kind: str) -> None:
    path = write_cloud(tmp_path, kind, some_points()[:, :3])
    read, notes = read_cloud(path)
    assert read.shape == (60, 4)
    assert (read[:, 3] == 0).all()
    assert notes == [f"{path}: has no reflectance; 0 is used, which makes detection worse"]


@pytest.mark.parametrize(("highest", "divisor"), [(1, 1), (1.5, 255), (120, 255), (255, 255), (256, 65535), (1e6, 1e6)])
def test_reflectance_is_scaled_to_1(tmp_path: Path, highest: float, divisor: float) -> None:
    points = some_points()
    points[:, 3] *= highest
    path = write_cloud(tmp_path, "npy", points)
    read, notes = read_cloud(path)
    np.testing.assert_allclose(read[:, 3], points[:, 3] / divisor, rtol=1e-6)
    assert notes == ([] if divisor == 1 else [f"{path}: reflectance up to {highest:g} was divided by {divisor:g}"])


@pytest.mark.parametrize("name", ["intensity", "Intensity", "reflectance", "reflectivity", "scalar_Intensity", "i"])
@pytest.mark.parametrize("kind", ["pcd-binary", "ply-binary"])
def test_names_of_the_reflectance(tmp_path: Path, kind: str, name: str) -> None:
    points = np.column_stack((some_points(), np.arange(60.0))).astype(np.float32)
    path = write_cloud(tmp_path, kind, points[:, [4, 3, 2, 1, 0]], ("ring", name, "z", "y", "x"))
    read, _ = read_cloud(path)
    np.testing.assert_array_equal(read, points[:, :4])


def test_more_columns_and_whole_numbers_in_npy(tmp_path: Path) -> None:
    path = tmp_path / "cloud.npy"
    np.save(path, np.arange(12, dtype=np.int16).reshape(2, 6) // 6)
    read, notes = read_cloud(path)
    assert read.tolist() == [[0] * 4, [1] * 4]
    assert notes == []


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_are_not_finite_are_dropped_and_counted(tmp_path: Path, kind: str) -> None:
    points = some_points()
    points[3, 0] = np.nan
    points[4, 3] = np.inf
    path = write_cloud(tmp_path, kind, points)
    read, notes = read_cloud(path)
    assert len(read) == 58
    assert np.isfinite(read).all()
    assert notes == [f"{path}: 2 points that are not finite were dropped"]


@pytest.mark.parametrize("kind", ["bin", "npy", "pcd-binary", "ply-binary"])
def test_a_cloud_without_points(tmp_path: Path, kind: str) -> None:
    read, notes = read_cloud(write_cloud(tmp_path, kind, some_points()[:0]))
    assert read.shape == (0, 4)
    assert notes == []


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.3, 0.99])
def test_truncated_files(tmp_path: Path, kind: str, share: float) -> None:
    path = write_cloud(tmp_path, kind, some_points())
    whole = path.read_bytes()
    size = int(len(whole) * share) if kind != "bin" else 16 * 20 + 3
    if kind.endswith("ascii"):  # a line of text that is cut off within a number is a whole line to any reader
        size = whole.rindex(b"\n", 0, size) - 12
    path.write_bytes(whole[:size])
    with pytest.raises(InputError, match="^" + re.escape(str(path))):
        read_cloud(path)


@pytest.mark.parametrize("suffix", [".npy", ".pcd", ".ply"])
@pytest.mark.parametrize("content", [b"", b"\n", b"garbage\n" * 20, bytes(range(256)) * 3, b"PK\x03\x04" + b"\0" * 60])
def test_garbage(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"cloud{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError, match="^" + re.escape(f"{path}: cannot be read as {suffix}")) as caught:
        read_cloud(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_spoilt_bytes_give_points_or_the_error(tmp_path: Path, kind: str) -> None:
    path = write_cloud(tmp_path, kind, some_points())
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(60):
        spoilt = bytearray(whole)
        for place in rng.integers(0, min(260, len(whole)), 2):  # the header
            spoilt[place] = rng.integers(256)
        if rng.random() < 0.5:
            del spoilt[rng.integers(len(spoilt)) :]
        path.write_bytes(spoilt)
        with contextlib.suppress(InputError):  # any other error fails the test
            assert read_cloud(path)[0].shape[1] == 4


def test_other_mistakes(tmp_path: Path) -> None:
    path = tmp_path / "cloud.xyz"
    path.touch()
    with pytest.raises(InputError, match=r"cloud\.xyz: unknown kind of file; known: \.bin, \.npy, \.pcd, \.ply"):
        read_cloud(path)
    for suffix in (".bin", ".npy", ".pcd", ".ply"):
        path = tmp_path / f"none{suffix}"
        with pytest.raises(InputError, match=re.escape(f"{path}: cannot be read")):
            read_cloud(path)
    path = tmp_path / "cloud.npy"
    for array in (np.zeros(4), np.zeros((5, 2)), np.zeros((2, 3, 4)), np.array([["a"] * 4]), np.zeros((2, 4), complex)):
        np.save(path, array)
        with pytest.raises(InputError, match=r"cloud\.npy: want numbers \(N, 3\) or \(N, 4\), got"):
            read_cloud(path)
    np.save(path, np.array([None, 1], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match=r"cloud\.npy: cannot be read as \.npy"):
        read_cloud(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("points.npy", b"")
    with pytest.raises(InputError, match=r"cloud\.npy: cannot be read as \.npy"):
        read_cloud(path)


@pytest.mark.parametrize("kind", ["pcd-ascii", "ply-ascii"])
def test_missing_coordinates(tmp_path: Path, kind: str) -> None:
    path = write_cloud(tmp_path, kind, some_points(), ("x", "y", "depth", "intensity"))
    with pytest.raises(InputError, match=r"has no field z; its fields are x, y, depth, intensity"):
        read_cloud(path)


def test_ply_without_vertices(tmp_path: Path) -> None:
    path = tmp_path / "cloud.ply"
    PlyData([PlyElement.describe(np.zeros(2, dtype=[("x", "f4")]), "corner")]).write(str(path))
    with pytest.raises(InputError, match=r"cloud\.ply: cannot be read as \.ply"):
        read_cloud(path)
