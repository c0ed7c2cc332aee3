"""The whole of training and validation on real KITTI frames."""

import json
from pathlib import Path

from hvnet.config import load_config
from hvnet.training.batches import kitti_data
from hvnet.training.run import Run
from tests.helpers import ROOT
from tests.models import COARSE

FRAMES = ["000157", "000010", "000114", "000217"]  # 28 cars, 16 of them moderate, all within 43 m


def test_four_real_frames_are_learnt_by_heart(kitti_root: Path, tmp_path: Path) -> None:
    """A small network, trained without augmentation on four frames, finds their cars: exact BEV AP of 90 or more."""
    root = tmp_path / "kitti"
    (root / "ImageSets").mkdir(parents=True)
    (root / "training").symlink_to(kitti_root / "training")
    for split in ("train", "val"):
        (root / "ImageSets" / f"{split}.txt").write_text("\n".join(FRAMES))
    plain = ["flip=0", "rotation=0", "scaling=[1, 1]", "translation=[0, 0, 0]", "objects={}"]
    schedule = ["epochs=60", "learning_rate=5.0e-3", "warmup_steps=10", "decay_epochs=[45, 55]", "pictures=0"]
    config = load_config(
        ROOT / "configs" / "demo.yaml",
        [*COARSE, "encoder.point_range=[0, -19.2, -3, 44.8, 19.2, 2]"]
        + [f"augment.{change}" for change in plain]
        + [f"train.{change}" for change in [*schedule, "validate_every=60"]],
    )
    Run(config, kitti_data(root, config), tmp_path / "run").train()
    last = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])
    easy, moderate, hard = last["validation"]["Car"]["exact"]["bev"]
    assert min(easy, moderate, hard) >= 90
