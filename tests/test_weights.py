"""The weights of the package: small, loadable, and made by a command."""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml

import hvnet
import hvnet.weights.__main__ as weights
from hvnet.config import config_from_dict, config_to_dict, load_config
from hvnet.data import database
from hvnet.data.kitti import frame_labels, read_frame, read_split
from hvnet.exceptions import InputError
from hvnet.kernels.rotated import rotated_iou_bev
from hvnet.network.checkpoint import WEIGHTS, load_checkpoint, save_checkpoint
from hvnet.network.model import HVNet
from hvnet.weights.__main__ import RECIPES, halve, main
from tests.helpers import ROOT
from tests.models import CONFIGS, SHORT

MADE_BY = {"hvnet", "torch", "warp-lang", "processor", "processes", "threads", "seed", "frames", "shifts"}
NAMES = sorted(path.stem for path in WEIGHTS.glob("*.pt"))


def test_weights_and_recipes() -> None:
    assert NAMES == sorted(path.stem for path in RECIPES.glob("*.yaml")) == ["compact", "standard"]


@pytest.mark.parametrize("name", NAMES)
def test_the_shipped_weights(name: str) -> None:
    shipped = WEIGHTS / f"{name}.pt"
    assert shipped.stat().st_size <= 10e6
    content = load_checkpoint(shipped)
    assert content.keys() - {"made_by"} == {"config", "model", "sensor"}
    assert content["sensor"] == {"ground": pytest.approx(-1.66, abs=0.05), "reflectance_scale": 1.0}
    recipe = load_config(RECIPES / f"{name}.yaml")
    assert content["made_by"].keys() == MADE_BY
    assert content["made_by"]["seed"] == recipe.train.seed
    assert config_from_dict(content["config"], str(shipped)) == recipe
    for key, value in content["model"].items():
        wanted = torch.int64 if key.endswith("tracked") else torch.float32 if "running" in key else torch.float16
        assert value.dtype == wanted, key
        assert value.isfinite().all(), key


def test_half_precision_changes_little(tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = load_config(RECIPES / "compact.yaml")
    model = HVNet(config)
    save_checkpoint(tmp_path / "whole.pt", {"config": config_to_dict(config), "model": model.state_dict(), "step": 3})
    halve(tmp_path / "whole.pt", tmp_path / "half.pt", {"seed": 0}, [-0.5, 0.25, 1.0])
    content = load_checkpoint(tmp_path / "half.pt")
    assert content.keys() == {"config", "model", "made_by"}
    half = HVNet(config)
    half.load_state_dict(content["model"])
    with torch.no_grad():
        for head, shift in zip(model.heads, [-0.5, 0.25, 1.0], strict=True):
            head.score.bias += shift
    for (name, a), b in zip(model.state_dict().items(), half.state_dict().values(), strict=True):
        assert b.dtype == a.dtype
        torch.testing.assert_close(b, a, rtol=1e-3, atol=1e-6, msg=name)


@pytest.mark.parametrize("name", NAMES)
def test_cars_are_found_in_real_frames(name: str, kitti_root: Path) -> None:
    """In frames that it was not trained on: most cars that a camera sees well and a scanner hits often."""
    detector = hvnet.load(name, device="cpu")
    seen = found = 0
    for frame_id in read_split(kitti_root, "val_first"):
        frame = read_frame(kitti_root, frame_id)
        boxes, scores, labels = detector(frame.points)
        assert boxes.shape == (len(scores), 7)
        every = frame_labels(frame)
        labelled = every.select(every.name != "DontCare")
        assert frame.objects is not None
        cars = frame.objects.boxes[(labelled.name == "Car") & (labelled.occlusion <= 1)]
        mine = boxes[(labels == 0) & (scores > 0.5)]
        seen += len(cars)
        found += int((rotated_iou_bev(cars, mine).amax(1, keepdim=True) > 0.5).sum()) if len(mine) else 0
    assert seen > 10
    assert found > 0.6 * seen, (found, seen)


def test_the_command_refuses_what_is_no_root(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=str(tmp_path)):
        main(["--data", str(tmp_path), "--run", str(tmp_path / "run"), "--device", "cpu"])


def test_an_unknown_recipe(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["--data", "KITTI", "--name", "large"])
    assert caught.value.code == 2
    assert "argument --name: invalid choice: 'large' (choose from " in capsys.readouterr().err


def test_all_weights_have_a_recipe() -> None:
    recipes = {path.stem: load_config(path) for path in RECIPES.glob("*.yaml")}
    assert {path.stem for path in WEIGHTS.glob("*.pt")} == recipes.keys()


TWO_RANKS = """
import sys
from pathlib import Path
import torch, hvnet.weights.__main__ as weights
torch.set_num_threads(1)
weights.RECIPES = Path(sys.argv[1])
weights.run_command(lambda _: weights.main(sys.argv[2:]))
"""


def test_two_ranks_make_weights(copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """torchrun: one file, which says what made it, and which a detector takes; a run that is there is left alone."""
    changes = dict(change.split("=") for change in SHORT)
    tree: dict = {"base": str(CONFIGS / "demo.yaml")}
    for key, value in {**changes, "train.epochs": "1", "train.seed": "3"}.items():
        group, _, name = key.partition(".")
        tree.setdefault(group, {})[name] = yaml.safe_load(value)
    (recipes := tmp_path / "recipes").mkdir()
    (recipes / "small.yaml").write_text(yaml.safe_dump(tree))
    database.main(["--data", str(copied)])
    (tmp_path / "start.py").write_text(TWO_RANKS)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += [str(tmp_path / "start.py"), str(recipes), "--data", str(copied), "--name", "small", "--device", "cpu"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("weights:    small.pt") == 1
    content = load_checkpoint(tmp_path / "small.pt")
    made_by = content["made_by"]
    assert made_by.keys() == MADE_BY
    assert f"logits:     {made_by['shifts']}\n" in done.stdout
    assert re.fullmatch(
        r"Car [+-]\d+\.\d{4}, Pedestrian [+-]\d+\.\d{4}, Cyclist [+-]\d+\.\d{4}", str(made_by["shifts"])
    )
    assert {key: made_by[key] for key in ("hvnet", "processes", "threads", "seed", "frames")} == {
        "hvnet": hvnet.__version__, "processes": 2, "threads": 1, "seed": 3, "frames": 4
    }  # fmt: skip
    assert not any(hidden in str(made_by) for hidden in (socket.gethostname(), str(tmp_path), str(ROOT)))
    assert hvnet.load(tmp_path / "small.pt", "cpu").config == load_config(recipes / "small.yaml")
    monkeypatch.setattr(weights, "RECIPES", recipes)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^runs/weights/small: is not empty"):
        main(["--data", str(copied), "--name", "small", "--device", "cpu"])
