"""What the numbers of a file are: found out from their values, or said by the user."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hvnet.data.columns import COUNTS, FOUR, Layout, find_layout, is_reflectance, parse_columns, read_numbers
from hvnet.exceptions import InputError
from tests.helpers import SHARED

PATH = Path("cloud.bin")


def scan(rows: int = 600, seed: int = 0) -> NDArray[np.float32]:
    """Points (rows, 4) in the order of a turning sensor: neighbours are near each other; intensities of 8 bits."""
    generator = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, rows)
    distance = 12 + 3 * np.sin(5 * angle) + generator.normal(0, 0.02, rows)
    z = -1.7 + generator.uniform(0, 0.1, rows)
    points = np.column_stack((distance * np.cos(angle), distance * np.sin(angle), z, generator.integers(0, 256, rows)))
    return points.astype(np.float32)


def with_more(points: NDArray, count: int) -> NDArray[np.float32]:
    """The points with further numbers: rings, times."""
    rings = np.arange(len(points))[:, None] % 32 + np.zeros((1, count - 4))
    return np.concatenate((points, rings), axis=1).astype(np.float32)


@pytest.mark.parametrize(("text", "names"), [
    ("3", ("x", "y", "z")),
    ("4", ("x", "y", "z", "i")),
    ("6", ("x", "y", "z", "i", "_", "_")),
    ("x,y,z,i,_", ("x", "y", "z", "i", "_")),
    ("_, Y,x,Z ,Intensity", ("_", "y", "x", "z", "i")),
    ("z,y,x", ("z", "y", "x")),
])  # fmt: skip
def test_columns_as_a_user_writes_them(text: str, names: tuple[str, ...]) -> None:
    assert parse_columns(text) == names


@pytest.mark.parametrize("text", ["", "2", "99", "-5", "5.0", "x,y", "x,y,z,w", "x,x,y,z", "x,y,z,i,i", "x y z"])
def test_columns_that_mean_nothing(text: str) -> None:
    with pytest.raises(InputError, match=r"--columns .*: want "):
        parse_columns(text)


@pytest.mark.parametrize("name", ["i", "Intensity", "REFLECTANCE", "reflectivity", "remission", "scalar_Reflectance"])
def test_names_of_the_reflectance(name: str) -> None:
    assert is_reflectance(name)
    assert not is_reflectance(f"{name}_2")


@pytest.mark.parametrize("dtype", ["<f4", "<f8", "<f2"])
@pytest.mark.parametrize("count", [3, 4, 5, 6])
@pytest.mark.parametrize("rows", [600, 597])
def test_scans_tell_their_columns(count: int, dtype: str, rows: int) -> None:
    """Whether the number of bytes is a multiple of 16 or not."""
    points = scan(rows)
    points = points[:, :3] if count == 3 else with_more(points, count)
    data = points.astype(dtype).tobytes()
    assert find_layout(data) == Layout(COUNTS[count], dtype)
    numbers, layout = read_numbers(data, PATH)
    assert layout.names == COUNTS[count]
    np.testing.assert_array_equal(numbers, points.astype(dtype))


def test_float64_with_few_digits() -> None:
    """Whose lower halves are all zero, which are fine numbers as float32."""
    assert find_layout(scan().astype(np.float16).astype("<f8").tobytes()) == Layout(COUNTS[4], "<f8")


def test_without_any_order_the_sign_tells() -> None:
    """The reflectance is never negative; a coordinate in its place is."""
    shuffled = np.random.default_rng(1).permutation(with_more(scan(), 5))
    assert find_layout(shuffled.tobytes()).names == COUNTS[5]
    assert find_layout(np.random.default_rng(1).permutation(scan()).tobytes()) == FOUR


@pytest.mark.parametrize("low", [-20, 0])
def test_in_doubt_it_is_four(low: float) -> None:
    """Points in no order, with numbers that are all alike."""
    data = np.random.default_rng(2).uniform(low, 20, (4000, 5)).astype("<f4").tobytes()
    assert len(data) % 16 == 0
    assert find_layout(data) == FOUR
    negative = scan() - np.float32([0, 0, 0, 100])  # some tools shift the reflectance
    assert find_layout(negative.tobytes()) == FOUR
    assert find_layout(with_more(scan(), 5)[:4].tobytes()) == FOUR  # too few points to tell
    assert find_layout(b"") == FOUR


@pytest.mark.parametrize("low", [-20, 0])
def test_what_cannot_be_four_is_refused_with_what_fits(low: float) -> None:
    data = np.random.default_rng(2).uniform(low, 20, (1001, 5)).astype("<f4").tobytes()
    with pytest.raises(InputError) as caught:
        read_numbers(data, PATH)
    assert str(caught.value) == (
        "cloud.bin: 20020 bytes are no multiple of 16, the size of a point (x, y, z, reflectance as float32); it may "
        "hold 5 numbers a point as nuScenes writes them: --columns 5, or 7 numbers a point: --columns 7"
    )
    with pytest.raises(InputError, match=r"19 bytes are no multiple of 16.*; is the file cut off\?"):
        read_numbers(bytes(19), PATH)


def test_given_columns_are_taken() -> None:
    """Of the type that the numbers are of."""
    data = np.random.default_rng(2).uniform(-20, 20, (1000, 5)).astype("<f4")
    assert read_numbers(data.tobytes(), PATH, COUNTS[5])[1] == Layout(COUNTS[5])
    assert read_numbers(data.astype("<f8").tobytes(), PATH, COUNTS[5])[1] == Layout(COUNTS[5], "<f8")
    names = ("_", "z", "y", "x", "i")
    numbers, layout = read_numbers(data.tobytes(), PATH, names)
    assert layout.names == names
    np.testing.assert_array_equal(numbers, data)
    with pytest.raises(InputError, match=r"20000 bytes are no multiple of 24, the size of a point \(x, y, z, i, _, _ "):
        read_numbers(data.tobytes(), PATH, COUNTS[6])


def test_real_files() -> None:
    clouds = SHARED / "clouds"
    if not clouds.is_dir():
        pytest.skip(f"no clouds at {clouds}")
    assert find_layout((clouds / "nuscenes.pcd.bin").read_bytes()) == Layout(COUNTS[5])
    assert find_layout((clouds / "six_columns.bin").read_bytes()) == Layout(COUNTS[6])
    argoverse = np.load(clouds / "argoverse2.npy")
    for dtype in ("<f4", "<f8", "<f2"):
        assert find_layout(argoverse.astype(dtype).tobytes()) == Layout(COUNTS[4], dtype)


def test_every_kitti_cloud_has_four(kitti_root: Path) -> None:
    for file in sorted((kitti_root / "training" / "velodyne").glob("*.bin")):
        assert find_layout(file.read_bytes()) == FOUR, file


def test_float64_with_one_full_column() -> None:
    """Such as times: five of six lower halves are zero."""
    times = np.linspace(1.5e9, 1.5e9 + 0.1, 600)[:, None]
    points = np.concatenate((scan().astype(np.float16), scan()[:, :1].round(), times), axis=1).astype("<f8")
    for columns in ((), COUNTS[6]):
        numbers, layout = read_numbers(points.tobytes(), PATH, columns)
        assert layout == Layout(COUNTS[6], "<f8")
        np.testing.assert_array_equal(numbers, points)


@pytest.mark.parametrize("content", [
    np.random.default_rng(0).bytes(16000),
    (b"1.0 2.0 3.0 0.5\n" * 1000),
    np.random.default_rng(0).integers(-60_000, 60_000, (1000, 4)).astype("<i4").tobytes(),
])  # fmt: skip
def test_files_that_are_no_clouds(content: bytes) -> None:
    assert len(content) % 16 == 0
    with pytest.raises(
        InputError, match=r"cloud\.bin: its numbers, as 4 numbers a point, are no coordinates in metres; "
    ):
        read_numbers(content, PATH)


def test_few_points_of_another_type_by_their_columns() -> None:
    data = scan(20).astype("<f2").tobytes() + scan(3).astype("<f2").tobytes()
    assert read_numbers(data, PATH, COUNTS[4])[1] == Layout(COUNTS[4], "<f2")
