"""Checkpoints: what is written is read again; a file that is none is refused by name."""

import re
from pathlib import Path

import pytest
import torch

from hvnet.config import Config, config_to_dict
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import load_checkpoint, model_from_checkpoint, save_checkpoint
from hvnet.network.model import HVNet
from tests.helpers import same


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
