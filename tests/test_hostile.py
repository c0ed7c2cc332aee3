"""A thousand hostile files: each gives a result or one clear error, and no memory grows.

Clouds, labels, calibrations, configs and checkpoints of random bytes, and good ones that were cut, flipped or filled
with impossible values; clouds as other sensors have them; from nothing to 64 MB. An error is an InputError that names
the file; anything else fails, a warning of numpy or torch too: it would be written to a user's terminal.
"""

import contextlib
import io
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.config import config_to_dict, load_config
from hvnet.data.clouds import read_cloud
from hvnet.data.kitti import read_calibration, read_labels
from hvnet.detect import main
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import load_checkpoint, model_from_checkpoint, save_checkpoint
from hvnet.network.detector import Detector, load
from hvnet.network.model import HVNet
from tests.helpers import CAMERA, ROOT

NARROW = [
    "encoder.point_range=[0, -3.2, -3, 12.8, 3.2, 2]",
    "backbone.widths=[8, 8, 8]",
    "backbone.layers=[2, 2, 2]",
    "backbone.fusion_channels=8",
    "head.score_threshold=0.0",
    "head.candidates=50",
]
SECONDS = 10.0  # that any one of them may take
LARGE = 64 * 2**20

IDENTITY = "1 0 0 0 1 0 0 0 1"
CALIBRATION = "\n".join(
    [*(f"P{k}: 700 0 600 45 0 700 180 0 0 0 1 0" for k in range(4)), f"R0_rect: {IDENTITY}",
     "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 -0.3", "Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0"]
)  # fmt: skip
LABELS = "Car 0.00 0 -1.58 587.01 173.33 614.12 200.12 1.65 1.67 3.64 -0.65 1.71 46.70 -1.59\n" * 3
PCD = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\n"
    "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {kind}\n"
)
PLY = "ply\nformat {kind} 1.0\nelement vertex {n}\n" + "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "intensity")
)


def size_of(generator: np.random.Generator) -> int:
    """Nothing to 200 kB; five of the thousand are 64 MB."""
    return int(generator.choice([0, 1, 15, 16, 17, generator.integers(1, 5000), generator.integers(1, 200_000)]))


def values(generator: np.random.Generator) -> np.ndarray:
    """Points (N, 4) float32 with whatever floats can hold."""
    points = generator.normal(0, 20, (int(generator.integers(0, 3000)), 4)).astype(np.float32)
    kind = generator.integers(0, 13)
    if kind == 0:
        points[:] = 3.0
    elif kind == 1:
        points[generator.random(points.shape) < 0.3] = generator.choice([np.nan, np.inf, -np.inf, 1e30, -1e30, 3e38])
    elif kind == 2:
        points *= np.float32(1e30)
    elif kind == 3:
        points *= np.float32(1e-42)
    elif kind == 4:
        points[:, 3] = generator.choice([np.nan, -1e30, 1e9, 65535, -1])
    elif kind == 5:
        points = points.view(np.uint32)[:, ::-1].copy().view(np.float32)
    elif kind == 6:  # as other sensors count, far from the origin, in millimetres, without echoes
        points[:, 3] = generator.integers(0, generator.choice([2, 256, 65536]), len(points))
    elif kind == 7:
        points[:, 3] = generator.choice([0, 0.5, 77])
    elif kind == 8:
        points[:, :3] += np.float32([4.5e5, 5.4e6, 110])
    elif kind == 9:
        points[:, :3] *= 1000
    elif kind == 10:
        points[generator.random(len(points)) < 0.5, :3] = 0
    elif kind == 11:
        points[:, 2] = generator.choice([-30, -0.33, 60]) + 0.01 * points[:, 2]
    return points


def damaged(content: bytes, generator: np.random.Generator) -> bytes:
    """As it is, cut, with bytes flipped or lines repeated, or with something in front."""
    kind = generator.integers(0, 5)
    if kind == 0 or not content:
        return content
    if kind == 1:
        return content[: generator.integers(0, len(content))]
    if kind == 2:
        flipped = bytearray(content)
        for place in generator.integers(0, len(content), 8):
            flipped[place] = int(generator.integers(0, 256))
        return bytes(flipped)
    if kind == 3:
        lines = content.splitlines(keepends=True)
        return b"".join(lines[k] for k in generator.integers(0, len(lines), len(lines) + 2))
    return generator.bytes(int(generator.integers(1, 20))) + content


def cloud_file(generator: np.random.Generator) -> tuple[str, bytes]:
    suffix = str(generator.choice([".bin", ".npy", ".pcd", ".ply"]))
    if generator.random() < 0.3:
        return suffix, generator.bytes(size_of(generator))
    points = values(generator)
    if suffix == ".bin":
        more = generator.normal(0, 20, (len(points), int(generator.integers(0, 5))))
        with np.errstate(all="ignore"):
            columns = np.concatenate((points, more), axis=1)[:, : generator.integers(3, 9)]
            content = columns.astype(
                str(generator.choice(["<f4", "<f8", "<f2", "<i4"], p=[0.7, 0.1, 0.1, 0.1]))
            ).tobytes()
    elif suffix == ".npy":
        file = io.BytesIO()
        kinds = ["f4", "f8", "i4", "u1", "c8", "S3", "?"]
        with np.errstate(all="ignore"):
            array = points.astype(str(generator.choice(kinds, p=[0.4, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])))
        np.save(file, (array[:, : generator.integers(0, 6)], array.T, array)[generator.integers(0, 3)])
        content = file.getvalue()
    elif suffix == ".pcd":
        header = PCD.format(n=len(points), kind=generator.choice(["binary", "ascii", "binary_compressed"]))
        content = header.encode() + points.tobytes()
    else:
        kind = generator.choice(["binary_little_endian", "binary_big_endian", "ascii"])
        header = PLY.format(n=len(points), kind=kind) + "end_header\n"
        content = header.encode() + points.tobytes()
    return suffix, damaged(content, generator)


def text_file(generator: np.random.Generator, content: str, suffix: str) -> tuple[str, bytes]:
    if generator.random() < 0.2:
        return suffix, generator.bytes(size_of(generator))
    words = content.split(" ")
    for place in generator.integers(0, len(words), int(generator.integers(0, 3))):
        strange = [
            "nan",
            "inf",
            "-inf",
            "1e30",
            "1e400",
            "",
            "-0",
            "0x10",
            "Ünïcödé",
            "1" * 5000,
            "\x00",
            "[",
            "{",
            "*",
            "~",
        ]
        words[place] = str(generator.choice(strange))
    return suffix, damaged(" ".join(words).encode(), generator)


def resident() -> float:
    """Megabytes that this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


@contextlib.contextmanager
def warnings_as_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        for category in (RuntimeWarning, UserWarning):
            warnings.simplefilter("error", category)
        yield


def test_a_thousand_hostile_files(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    torch.manual_seed(0)
    config = load_config(ROOT / "configs" / "demo.yaml", NARROW)
    model = HVNet(config).eval()
    detector = Detector(model, torch.device("cpu"))
    save_checkpoint(tmp_path / "good.pt", {"config": config_to_dict(config), "model": model.state_dict()})
    good = {
        "checkpoint": (tmp_path / "good.pt").read_bytes(),
        "config": (ROOT / "configs" / "compact.yaml").read_bytes(),
    }

    def detect(path: Path) -> None:
        found = detector(read_cloud(path)[0])
        assert found.boxes.shape == (len(found.scores), 7)

    kinds: list[tuple[Callable[[Path], object], Callable[[], tuple[str, bytes]]]] = [
        (detect, lambda: cloud_file(generator)),
        (read_labels, lambda: text_file(generator, LABELS, ".txt")),
        (read_calibration, lambda: text_file(generator, CALIBRATION, ".txt")),
        (load_config, lambda: text_file(generator, good["config"].decode(), ".yaml")),
        (lambda path: model_from_checkpoint(load_checkpoint(path), str(path)),
         lambda: (".pt", damaged(good["checkpoint"], generator) if generator.random() < 0.8
                  else generator.bytes(size_of(generator)))),
    ]  # fmt: skip
    outcomes = {"result": 0, "error": 0}
    before = 0.0
    for k in range(1000):
        take, make = kinds[generator.choice(5, p=[0.4, 0.15, 0.15, 0.15, 0.15])]
        suffix, content = make()
        if k in (100, 300, 500, 700, 900):  # a large one
            suffix, content = str(generator.choice([".bin", ".npy", ".pcd", ".ply"])), generator.bytes(LARGE)
            take = detect
        path = tmp_path / f"{k}{suffix}"
        path.write_bytes(content)
        begin = time.perf_counter()
        try:
            with warnings_as_errors():
                take(path)
            said = ""
        except InputError as error:
            said = str(error)
        outcomes["error" if said else "result"] += 1
        assert not said or str(path) in said, (k, said)
        assert len(said) < 1000, (k, said[:200])
        assert "\n" not in said, (k, said[:200])
        assert time.perf_counter() - begin < SECONDS, (k, take, suffix, len(content))
        path.unlink()
        if k == 499:
            before = resident()
    assert min(outcomes.values()) > 100, outcomes
    assert resident() - before < 200, (before, resident())


def test_hostile_frames_through_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """KITTI roots with damaged files, from the command line to the result files."""
    generator = np.random.default_rng(1)
    model = HVNet(load_config(ROOT / "configs" / "demo.yaml", NARROW)).eval()
    checkpoint = tmp_path / "good.pt"
    save_checkpoint(checkpoint, {"config": config_to_dict(model.config), "model": model.state_dict()})
    outcomes = {"result": 0, "error": 0}
    for k in range(60):
        root = tmp_path / str(k)
        hurt = generator.integers(0, 3)  # one of the three files
        points = values(generator).tobytes()
        files = {
            "velodyne/000000.bin": damaged(points, generator) if hurt == 0 else points,
            "calib/000000.txt": text_file(generator, CALIBRATION, "")[1] if hurt == 1 else CALIBRATION.encode(),
            "label_2/000000.txt": text_file(generator, LABELS, "")[1] if hurt == 2 else LABELS.encode(),
        }
        for name, content in files.items():
            path = root / "training" / name
            path.parent.mkdir(parents=True)
            path.write_bytes(content)
        options = ["--checkpoint", str(checkpoint), "--out", str(root / "out"), "--pictures", "1", "--device", "cpu"]
        try:
            with warnings_as_errors():
                main([str(root), *options])
            outcome = "result"
        except InputError as error:
            outcome, said = "error", str(error)
        assert outcome == "result" or (str(root) in said and "\n" not in said)
        outcomes[outcome] += 1
    assert min(outcomes.values()) > 5, outcomes


@pytest.mark.parametrize("points", [
    torch.full((5000, 4), 1.0),
    torch.full((3, 4), 1e30),
    torch.tensor([[torch.nan, 0, 0, 0], [5, torch.inf, 0, 0], [5, 0, -torch.inf, 0], [5, 0, 0, torch.nan]]),
    torch.zeros(0, 4),
])  # fmt: skip
def test_the_shipped_detector_takes_any_cloud(points: torch.Tensor) -> None:
    with warnings_as_errors():
        found = load(device="cpu")(points)
    assert found.boxes.isfinite().all()
    assert found.scores.isfinite().all()


HUGE = (0.0, 1.0, -1e30, 3e38, 1e160, 1e308, -1e308, np.inf, -np.inf, np.nan)


def test_a_camera_of_hostile_numbers() -> None:
    """Points, boxes, lines and polygons of any numbers, seen by cameras of any numbers: what is visible is finite."""
    generator = np.random.default_rng(0)
    inside = np.array([[10.0, 0, 0], [20.0, 1, 1], [15.0, -1, 0]])
    for k in range(500):
        points, boxes = generator.normal(10, 5, (200, 3)), np.tile([10.0, 0, 0, 4, 2, 2, 0], (20, 1))
        points[generator.random(points.shape) < 0.2] = generator.choice(HUGE)
        boxes[generator.random(boxes.shape) < 0.2] = generator.choice(HUGE)
        matrices = {"p2": CAMERA.p2.copy(), "velo_to_cam": CAMERA.velo_to_cam.copy()}
        for matrix in matrices.values():
            matrix[generator.random(matrix.shape) < 0.1] = generator.choice(HUGE)
        camera = replace(CAMERA, **matrices) if k % 2 else CAMERA
        with warnings_as_errors():
            camera.to_camera(points)
            seen, (pixels, depth) = camera.sees(points), camera.project(points)
            bbox, visible = camera.project_boxes(boxes)
            lines, drawn = camera.project_lines(points[:100], points[100:])
            polygons = [camera.project_polygon(corners) for corners in points.reshape(-1, 4, 3)]
        assert np.isfinite(pixels[seen]).all()
        assert np.isfinite(depth[seen]).all()
        assert np.isfinite(bbox).all()
        assert (bbox[~visible] == 0).all()
        assert np.isfinite(lines).all()
        assert len(lines) == drawn.sum()
        assert np.isfinite(np.concatenate(polygons)).all()
        if camera is CAMERA:
            assert camera.sees(inside).all()
            finite = np.isfinite(points).all(axis=1)
            with warnings_as_errors():
                there = camera.to_lidar(camera.to_camera(points))
            near = finite & (np.abs(points) < 1e3).all(axis=1)
            np.testing.assert_allclose(there[near], points[near], atol=1e-9)
