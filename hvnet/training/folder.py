"""What a training run leaves in its folder."""

import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

from hvnet.exceptions import InputError
from hvnet.folders import check_empty
from hvnet.network.model import HVNet

ROOM = 100 * 2**20
"""Bytes that a run may need on the disk in addition to its checkpoints."""


class RunFolder(NamedTuple):
    """The files of a training run."""

    checkpoint: Path
    metrics: list[dict[str, Any]]  # one record per epoch; empty if there is no metrics.jsonl
    root: Path | None  # the KITTI root that it was trained on, if the run says so


def find_run(path: Path) -> RunFolder:
    """The run of a folder of hvnet.train, or of a checkpoint file. Raises InputError if it is neither."""
    if path.is_dir() and not (path / "checkpoint.pt").is_file():
        raise InputError(f"{path}: holds no checkpoint.pt; give the folder of a run of hvnet.train, or a checkpoint")
    if not path.exists():
        raise InputError(f"{path}: no such run; give the folder of a run of hvnet.train, or a checkpoint")
    checkpoint = path / "checkpoint.pt" if path.is_dir() else path
    data = checkpoint.parent / "data.txt"
    try:
        named = data.read_text(encoding="utf-8").strip() if data.is_file() else ""
    except UnicodeDecodeError as error:
        raise InputError(f"{data}: does not hold the path of a KITTI root; remove it and give --data") from error
    root = Path(named) if named else None
    return RunFolder(checkpoint, _read_metrics(checkpoint.parent / "metrics.jsonl"), root)


def _read_metrics(path: Path) -> list[dict[str, Any]]:
    records = []
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            record["epoch"]
            for table in record.get("validation", {}).values():
                table["exact"]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}:{number}: not a record of hvnet.train; remove the line") from error
        records.append(record)
    return records


def check_folder(out: Path, resume: bool) -> None:
    """Raises InputError unless a run can start in the folder `out` or, with `resume`, continue there."""
    if resume and not (out / "checkpoint.pt").is_file():
        raise InputError(f"{out}: holds no checkpoint.pt to resume; give the run's folder with --out, or no --resume")
    if not resume:
        check_empty(out, "give another --out, or --resume to continue the run in it")


def check_room(out: Path, model: HVNet) -> None:
    """Raises InputError if the disk has no room for a run: two checkpoints.

    Each holds the weights, both moments of Adam and, if there is one, the average of the weights.
    """
    folder = next(path for path in (out, *out.absolute().parents) if path.exists())
    free = shutil.disk_usage(folder).free
    copies = 4 if model.config.train.average else 3
    wanted = 2 * copies * sum(weight.numel() * weight.element_size() for weight in model.parameters()) + ROOM
    if free < wanted:
        raise InputError(
            f"{folder}: {free / 1e6:.0f} MB free, the run needs {wanted / 1e6:.0f} MB; free some, or give another --out"
        )
