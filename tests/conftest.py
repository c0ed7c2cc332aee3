"""Fixtures for all tests: unwritten memory is seen, the real KITTI frames are found or skipped."""

import os
from pathlib import Path

import pytest
import torch

torch.utils.deterministic.fill_uninitialized_memory = True
torch.use_deterministic_algorithms(True)  # with it, torch.empty is filled with NaN or the largest integer

SHARED = Path(os.environ.get("HVNET_SHARED", Path(__file__).resolve().parents[2] / "shared"))


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
