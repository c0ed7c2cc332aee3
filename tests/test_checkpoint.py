"""Checkpoints: what is written is read again; a file that is none is refused by name."""

import re
from pathlib import Path

import pytest
import torch

import hvnet
from hvnet.config import Config, config_to_dict
from hvnet.exceptions import InputError
from hvnet.network import checkpoint
from hvnet.network.checkpoint import find_checkpoint, load_checkpoint, model_from_checkpoint, save_checkpoint
from hvnet.network.model import HVNet
from tests.helpers import same
from tests.models import SMALL, save_untrained


def test_round_trip(demo: Config, tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    content = {"config": config_to_dict(demo), "model": HVNet(demo).state_dict(), "step": 3}
    save_checkpoint(path, content)
    assert [file.name for file in tmp_path.iterdir()] == ["a.pt"]
    read = load_checkpoint(path)
    assert same(read, {**content, "model": dict(content["model"])})
    model = model_from_checkpoint(read, "a.pt")
    assert not model.training
    assert model.config == demo


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such checkpoint; train one with python -m hvnet.train"),
        (b"", "truncated, or no checkpoint of hvnet.train"),
        (b"Car 0 0 0", "truncated, or no checkpoint of hvnet.train"),
        ([1, 2], "no checkpoint of hvnet.train (it holds no config and model)"),
        ({"model": {}}, "no checkpoint of hvnet.train (it holds no config and model)"),
    ],
)
def test_files_that_are_none(content: object, message: str, tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(InputError, match=re.escape(f"{path}: {message}")):
        load_checkpoint(path)


def test_weights_of_another_config(demo: Config) -> None:
    content = {"config": config_to_dict(demo), "model": {"a": torch.zeros(1)}}
    with pytest.raises(InputError, match=r"^b\.pt: its weights do not fit its config; train again with this version$"):
        model_from_checkpoint(content, "b.pt")
    with pytest.raises(InputError, match=r"^b\.pt: trian: unknown key"):
        model_from_checkpoint({"config": {**config_to_dict(demo), "trian": {}}, "model": {}}, "b.pt")


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of weights, which holds compact and standard, and an empty working directory."""
    (folder := tmp_path / "weights").mkdir()
    for seed, name in enumerate(("compact", "standard")):
        save_untrained(folder / f"{name}.pt", SMALL, seed)
    monkeypatch.setattr(checkpoint, "WEIGHTS", folder)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return folder


def test_weights_by_name(weights: Path) -> None:
    found = {given: find_checkpoint(given) for given in (None, "compact", "standard", Path("standard"))}
    wanted = {None: "compact", "compact": "compact", "standard": "standard", Path("standard"): "standard"}
    assert found == {given: weights / f"{name}.pt" for given, name in wanted.items()}
    one, other = (hvnet.load(name, "cpu").backbone.state_dict() for name in ("compact", "standard"))
    assert one.keys() == other.keys()
    assert not any(torch.equal(one[name], other[name]) for name in one if name.endswith("weight"))


@pytest.mark.parametrize("given", ["standard.pt", "./standard", "runs/standard", "/standard", "a.b"])
def test_what_is_a_path(given: str, weights: Path) -> None:
    assert find_checkpoint(given) == Path(given)


def test_a_file_counts_before_a_name(weights: Path) -> None:
    for name in ("compact", "mine"):
        Path(name).touch()
        assert find_checkpoint(name) == Path(name)
    assert find_checkpoint(None) == weights / "compact.pt"
    Path("standard").mkdir()
    assert find_checkpoint("standard") == weights / "standard.pt"


@pytest.mark.parametrize("given", ["large", Path("large")])
def test_unknown_weights(given: str | Path, weights: Path) -> None:
    message = r"^large: no weights of this name; there are compact, standard; or give a checkpoint file$"
    with pytest.raises(InputError, match=message):
        hvnet.load(given, "cpu")
