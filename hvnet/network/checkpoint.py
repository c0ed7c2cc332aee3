"""Checkpoints: written whole or not at all, read without running what is in them."""

import os
from pathlib import Path

import torch

from hvnet.config import config_from_dict
from hvnet.exceptions import InputError
from hvnet.network.model import HVNet

WEIGHTS = Path(__file__).resolve().parents[1] / "weights"
"""The folder of the weights that come with the package: NAME.pt; docs/model_card.md says what they are for."""
DEFAULT = "compact"


def save_checkpoint(path: Path, content: dict) -> None:
    """Writes a checkpoint atomically: whatever happens, there is the old file or the new one, never half of one.

    Raises InputError naming the file if it cannot be written.
    """
    partial = path.with_suffix(".partial")
    try:
        with partial.open("wb") as file:
            torch.save(content, file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except (OSError, RuntimeError) as error:  # torch's writer turns some errors of the system into RuntimeError
        partial.unlink(missing_ok=True)
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        kept = "; what it held before is whole: make room and --resume" if path.is_file() else ""
        raise InputError(f"{path}: cannot be written ({reason}){kept}") from error


def find_checkpoint(given: str | Path | None) -> Path:
    """The file of a checkpoint: a path, or the name of weights of the package; None: the default ones.

    Where there is a file of that name, the path counts. Raises InputError naming the weights that there are.
    """
    path = Path(DEFAULT if given is None else given)
    if given is not None and (path.is_file() or path.suffix or path.name != str(given)):
        return path
    names = sorted(file.stem for file in WEIGHTS.glob("*.pt"))
    if path.name not in names:
        raise InputError(f"{path}: no weights of this name; there are {', '.join(names)}; or give a checkpoint file")
    return WEIGHTS / f"{path}.pt"


def load_checkpoint(path: str | Path) -> dict:
    """Reads a checkpoint to the CPU (weights_only, so that it can run no code). Raises InputError naming the file."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such checkpoint; train one with python -m hvnet.train") from error
    except Exception as error:  # the unpickler raises anything at all on a file that is damaged
        raise InputError(f"{path}: truncated, or no checkpoint of hvnet.train; train again or copy it again") from error
    if not isinstance(content, dict) or not {"config", "model"} <= content.keys():
        raise InputError(f"{path}: no checkpoint of hvnet.train (it holds no config and model)")
    return content


def model_from_checkpoint(content: dict, source: str) -> HVNet:
    """The model of what `load_checkpoint` read from source, in evaluation mode. Raises InputError naming source."""
    model = HVNet(config_from_dict(content["config"], source))
    try:
        model.load_state_dict(content["model"])
    except (RuntimeError, AttributeError, TypeError) as error:
        raise InputError(f"{source}: its weights do not fit its config; train again with this version") from error
    return model.eval()
