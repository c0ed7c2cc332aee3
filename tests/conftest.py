"""Fixtures for all tests: unwritten memory is seen, the real KITTI frames are found or skipped."""

import shutil
from pathlib import Path

import pytest
import torch

from hvnet.config import Config, config_to_dict, load_config
from hvnet.data.scenes.files import generate
from hvnet.data.scenes.street import Options
from hvnet.kernels import launch
from hvnet.network.checkpoint import save_checkpoint
from hvnet.network.model import HVNet
from tests.helpers import SHARED
from tests.models import CONFIGS, NARROW, SHORT

torch.utils.deterministic.fill_uninitialized_memory = True
torch.use_deterministic_algorithms(True)  # with it, torch.empty is filled with NaN or the largest integer
torch.set_num_threads(1)  # the networks here are small: threads cost more than they save where others use the cores


@pytest.fixture(scope="session")
def kitti_root() -> Path:
    root = SHARED / "kitti"
    if not (root / "training" / "velodyne").is_dir():
        pytest.skip(f"no KITTI frames at {root}")
    return root


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> torch.device:
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return torch.device(request.param)


@pytest.fixture(params=["one thread", "many threads"])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs a test both ways: as a CPU works, and as a GPU does, on the CPU."""
    monkeypatch.setattr(launch, "force_many_threads", request.param == "many threads")


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
