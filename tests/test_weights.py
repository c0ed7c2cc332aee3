"""The weights of the package: small, loadable, and made by a command."""

from pathlib import Path

import pytest
import torch

import hvnet
from hvnet.config import config_from_dict, config_to_dict, load_config
from hvnet.data.kitti import frame_labels, read_frame, read_split
from hvnet.exceptions import InputError
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.checkpoint import WEIGHTS, load_checkpoint, save_checkpoint
from hvnet.network.model import HVNet
from hvnet.weights.__main__ import CONFIG, RECIPE, halve, main


def test_the_shipped_weights() -> None:
    shipped = WEIGHTS / "compact.pt"
    assert shipped.stat().st_size <= 10e6
    content = load_checkpoint(shipped)
    assert content.keys() == {"config", "model", "sensor"}
    assert content["sensor"] == {"ground": pytest.approx(-1.66, abs=0.05), "reflectance_scale": 1.0}
    recipe = load_config(CONFIG, RECIPE)
    assert config_from_dict(content["config"], str(shipped)) == recipe
    for name, value in content["model"].items():
        wanted = torch.int64 if name.endswith("tracked") else torch.float32 if "running" in name else torch.float16
        assert value.dtype == wanted, name
        assert value.isfinite().all(), name


def test_half_precision_changes_little(tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = load_config(CONFIG)
    model = HVNet(config)
    save_checkpoint(tmp_path / "whole.pt", {"config": config_to_dict(config), "model": model.state_dict(), "step": 3})
    halve(tmp_path / "whole.pt", tmp_path / "half.pt")
    half = HVNet(config)
    half.load_state_dict(load_checkpoint(tmp_path / "half.pt")["model"])
    for (name, a), b in zip(model.state_dict().items(), half.state_dict().values(), strict=True):
        assert b.dtype == a.dtype
        torch.testing.assert_close(b, a, rtol=1e-3, atol=1e-6, msg=name)


def test_cars_are_found_in_real_frames(kitti_root: Path) -> None:
    """In frames that it was not trained on: most cars that a camera sees well and a scanner hits often."""
    detector = hvnet.load(device="cpu")
    seen = found = 0
    for name in read_split(kitti_root, "val_first"):
        frame = read_frame(kitti_root, name)
        boxes, scores, labels = detector(frame.points)
        assert boxes.shape == (len(scores), 7)
        every = frame_labels(frame)
        labelled = every.select(every.name != "DontCare")
        assert frame.objects is not None
        cars = frame.objects.boxes[(labelled.name == "Car") & (labelled.occlusion <= 1)]
        mine = boxes[(labels == 0) & (scores > 0.3)]
        seen += len(cars)
        found += int((rotated_iou_bev(cars, mine).amax(1, keepdim=True) > 0.5).sum()) if len(mine) else 0
    assert seen > 10
    assert found > 0.6 * seen, (found, seen)


def test_the_command_refuses_what_is_no_root(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=str(tmp_path)):
        main(["--data", str(tmp_path), "--run", str(tmp_path / "run"), "--device", "cpu"])
