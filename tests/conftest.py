"""Fixtures for all tests: unwritten memory is seen, the real KITTI frames are found or skipped."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from hvnet.config import Config, config_to_dict, load_config
from hvnet.data.scenes.files import generate
from hvnet.data.scenes.street import Options
from hvnet.kernels import launch
from hvnet.network import fused
from hvnet.network.checkpoint import save_checkpoint
from hvnet.network.model import HVNet
from tests.helpers import SHARED
from tests.models import CONFIGS, NARROW, SHORT

os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # without it, products on CUDA are refused as not repeating
torch.utils.deterministic.fill_uninitialized_memory = True
torch.use_deterministic_algorithms(True)  # with it, torch.empty is filled with NaN or the largest integer
torch.set_num_threads(1)  # the networks here are small: threads cost more than they save where others use the cores


@pytest.fixture(scope="session")
def kitti_root() -> Path:
    root = SHARED / "kitti"
    if not (root / "training" / "velodyne").is_dir():
        pytest.skip(f"no KITTI frames at {root}")
    return root


@pytest.fixture(params=["cpu", "cpu-many-threads", pytest.param("cuda", marks=pytest.mark.cuda)])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The ways that kernels and what calls them can go: a CPU's, a GPU's on the CPU, and a GPU's where there is one."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    monkeypatch.setattr(launch, "force_many_threads", request.param == "cpu-many-threads")
    return request.param


@pytest.fixture
def device(way: str) -> torch.device:
    """The device of a test that runs every way."""
    return torch.device(way.partition("-")[0])


@pytest.fixture
def threads(way: str, request: pytest.FixtureRequest) -> None:
    """Runs a test both ways of the CPU, and if it takes a device, every way."""
    if way == "cuda" and "device" not in request.fixturenames:
        pytest.skip("runs on the CPU")


@pytest.fixture
def plain_float32(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No TF32, and deterministic convolutions, so that a GPU's numbers are close to a CPU's."""
    monkeypatch.setattr(fused, "products_in_tf32", lambda device: contextlib.nullcontext())
    with torch.backends.cudnn.flags(enabled=True, deterministic=True, allow_tf32=False):
        yield


@pytest.fixture(scope="session")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A KITTI root of four generated frames to train and two to validate; tests that change it copy it."""
    root = tmp_path_factory.mktemp("scenes") / "kitti"
    generate(root, 4, 2, seed=0, options=Options(azimuth=41, distance=(4.0, 22.0)))
    return root


@pytest.fixture
def copied(scenes: Path, tmp_path: Path) -> Path:
    """Scenes that a test may change, without the database that another test may have left there."""
    return Path(shutil.copytree(scenes, tmp_path / "kitti", ignore=shutil.ignore_patterns("gt_database.npz")))


@pytest.fixture
def tiny() -> Config:
    """The config of a run of seconds."""
    return load_config(CONFIGS / "demo.yaml", SHORT)


@pytest.fixture(scope="session")
def demo() -> Config:
    """The demo's config over a narrow range."""
    return load_config(CONFIGS / "demo.yaml", NARROW)


@pytest.fixture(scope="session")
def pillars(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of an untrained model with PointPillars' encoder, which has one grid and no scales."""
    torch.manual_seed(0)
    narrow = ["backbone.widths=[8, 8, 8]", "backbone.layers=[2, 2, 2]", "backbone.fusion_channels=8"]
    narrow += ["encoder.image_channels=8", "encoder.point_limit=8"]
    config = load_config(CONFIGS / "studies" / "voxel-size" / "pillars-0.16.yaml", narrow)
    path = tmp_path_factory.mktemp("pillars") / "checkpoint.pt"
    save_checkpoint(path, {"config": config_to_dict(config), "model": HVNet(config).state_dict()})
    return path
