"""The figures' command: which files it writes, in which format, and what it says of a mistake."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

from hvnet.data.kitti import read_frame
from hvnet.exceptions import InputError
from hvnet.figures import main
from hvnet.network.checkpoint import load_checkpoint, model_from_checkpoint
from hvnet.network.detector import Detector, load
from hvnet.pictures.features import features_of
from tests.helpers import ROOT
from tests.models import TINY, save_untrained


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two untrained models of one name in two folders."""
    paths = []
    for k, options in enumerate((TINY, [*TINY, "encoder.attention_relu=true"])):
        paths.append(tmp_path_factory.mktemp("run") / "checkpoint.pt")
        save_untrained(paths[-1], options, seed=k)
    return paths


def test_figures_of_clouds_and_frames(checkpoints: list[Path], scenes: Path, tmp_path: Path) -> None:
    """A frame's figure shows the camera's view and the range from above, a cloud's the range alone."""
    cloud = tmp_path / "cloud.bin"
    shutil.copy(scenes / "training" / "velodyne" / "000001.bin", cloud)
    options = ["--checkpoint", str(checkpoints[0]), "--out", str(tmp_path / "out"), "--device", "cpu"]
    main([str(cloud), str(scenes), "--split", "val", *options])
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["000004.png", "000005.png", "cloud.png"]
    with Image.open(tmp_path / "out" / "cloud.png") as image:
        assert image.width == 880
    with Image.open(tmp_path / "out" / "000004.png") as image:
        assert image.width == 1200


def test_names_are_no_formulas(checkpoints: list[Path], scenes: Path, tmp_path: Path) -> None:
    """A legal file name that would be a mistake in matplotlib's mathematical text."""
    cloud = tmp_path / "a$_$.bin"
    shutil.copy(scenes / "training" / "velodyne" / "000001.bin", cloud)
    odd = shutil.copy(checkpoints[0], tmp_path / "b$^$.pt")
    both = ["--checkpoint", str(odd), "--compare", str(checkpoints[1])]
    main([str(cloud), *both, "--features", "--out", str(tmp_path / "out"), "--device", "cpu"])
    assert len(list((tmp_path / "out").iterdir())) == 2


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_features_of_two_models(checkpoints: list[Path], scenes: Path, tmp_path: Path, suffix: str) -> None:
    cloud = str(scenes / "training" / "velodyne" / "000001.bin")
    both = ["--checkpoint", str(checkpoints[0]), "--compare", str(checkpoints[1])]
    main([cloud, *both, "--features", "--out", str(tmp_path), "--format", suffix, "--device", "cpu"])
    assert {path.name for path in tmp_path.iterdir()} == {f"000001.{suffix}", f"000001-features.{suffix}"}


def test_pillars_have_one_pseudo_image(pillars: Path, scenes: Path, tmp_path: Path) -> None:
    cloud = scenes / "training" / "velodyne" / "000001.bin"
    main([str(cloud), "--features", "--checkpoint", str(pillars), "--out", str(tmp_path), "--device", "cpu"])
    assert {path.name for path in tmp_path.iterdir()} == {"000001.png", "000001-features.png"}
    found = features_of(load(pillars, "cpu"), read_frame(scenes, "000001").points, "pillars")
    assert [tuple(image.shape[-2:]) for image in found.images] == [(160, 160)]
    assert found.cells == [(0.16, 0.16)]


def test_features_are_those_of_the_encoder(checkpoints: list[Path], scenes: Path) -> None:
    """One image a projection scale, with the values of the encoder in evaluation mode; the next call spoils none."""
    points = read_frame(scenes, "000000").points
    model = model_from_checkpoint(load_checkpoint(checkpoints[0]), "a checkpoint")
    detector = Detector(model, torch.device("cpu"), torch.float32)
    found = features_of(detector, points, "a model")
    features_of(detector, points[:10], "a model")
    with torch.no_grad():
        expected = model.encoder(points, torch.zeros(len(points), dtype=torch.int64), 1)
    assert (found.name, found.cells, found.corner) == ("a model", [(0.4, 0.4), (0.8, 0.8), (1.6, 1.6)], (0.0, -6.4))
    for image, wanted in zip(found.images, expected, strict=True):
        torch.testing.assert_close(image, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.bin"], "missing.bin: no such file or folder"),
        (["{cloud}", "--out", "{taken}"], "taken: is not empty; give another --out"),
        (["{cloud}", "--compare", "{checkpoint}"], "--compare: is for --features; give both"),
        (["{cloud}", "{twin}", "--features"], "000001-features: has the name of the features of 000001; rename one"),
        (["{cloud}", "--checkpoint", "missing.pt"], "missing.pt: no such checkpoint"),
        (["{cloud}", "--features", "--compare", "missing.pt"], "missing.pt: no such checkpoint"),
    ],
)
def test_mistakes(checkpoints: list[Path], scenes: Path, tmp_path: Path, arguments: list[str], message: str) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "a").touch()
    cloud = scenes / "training" / "velodyne" / "000001.bin"
    places = {"cloud": cloud, "taken": tmp_path / "taken", "checkpoint": checkpoints[0]}
    places["twin"] = shutil.copy(cloud, tmp_path / "000001-features.bin")
    given = [each.format(**places) for each in arguments]
    with pytest.raises(InputError, match=re.escape(message)):
        main(["--out", str(tmp_path / "out"), *given, "--device", "cpu"])


def test_a_mistake_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hvnet.figures", "missing.bin", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "error: missing.bin: no such file or folder\n"
