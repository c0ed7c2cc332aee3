"""What a run leaves in its folder, and what is refused there."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hvnet.config import Config
from hvnet.exceptions import InputError
from hvnet.network.model import HVNet
from hvnet.training.folder import check_folder, check_room, find_run


def test_a_run_is_found_by_its_folder_or_its_checkpoint(tmp_path: Path) -> None:
    checkpoint = tmp_path / "checkpoint.pt"
    checkpoint.touch()
    assert find_run(tmp_path) == find_run(checkpoint) == (checkpoint, [], None)
    records = [{"epoch": 1, "loss": 2.0}, {"epoch": 2, "loss": 1.0, "validation": {"Truck": {"exact": {}}}}]
    (tmp_path / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    (tmp_path / "data.txt").write_text("/some where/kitti\n")
    assert find_run(tmp_path) == (checkpoint, records, Path("/some where/kitti"))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        (
            "metrics.jsonl",
            b'{"epoch": 1}\n{"loss": 2}\n',
            "metrics.jsonl:2: not a record of hvnet.train; remove the line",
        ),
        ("metrics.jsonl", b"[1]\n", "metrics.jsonl:1: not a record of hvnet.train; remove the line"),
        ("data.txt", b"\xff\xfe\x00", "data.txt: does not hold the path of a KITTI root; remove it and give --data"),
    ],
)
def test_damaged_files_are_named(file: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "checkpoint.pt").touch()
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match=re.escape(message)):
        find_run(tmp_path)


def test_where_no_run_is(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no checkpoint\.pt; give the folder of a run"):
        find_run(tmp_path)
    with pytest.raises(InputError, match="no such run"):
        find_run(tmp_path / "none")


def test_folders_to_begin_and_to_go_on(tmp_path: Path) -> None:
    check_folder(tmp_path / "new", resume=False)
    check_folder(tmp_path, resume=False)
    with pytest.raises(InputError, match=r"holds no checkpoint\.pt to resume"):
        check_folder(tmp_path, resume=True)
    (tmp_path / "checkpoint.pt").touch()
    check_folder(tmp_path, resume=True)
    with pytest.raises(InputError, match="is not empty; give another --out, or --resume"):
        check_folder(tmp_path, resume=False)


def test_room(demo: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hvnet.training.folder.ROOM", 0)
    size = sum(weight.numel() * 4 for weight in HVNet(demo).parameters())
    averaging = HVNet(replace(demo, train=replace(demo.train, average=0.5)))
    for model, enough in ((HVNet(demo), 6 * size), (averaging, 8 * size)):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=enough: SimpleNamespace(free=free))
        check_room(tmp_path, model)
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=enough - 1: SimpleNamespace(free=free))
        with pytest.raises(InputError, match="the run needs"):
            check_room(tmp_path, model)
    monkeypatch.undo()
    check_room(tmp_path / "a" / "b", HVNet(demo))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
    with pytest.raises(InputError, match=r"1 MB free, the run needs \d+ MB; free some, or give another --out"):
        check_room(tmp_path / "a" / "b", HVNet(demo))
