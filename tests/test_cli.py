"""All commands have one kind of help and one kind of error."""

import importlib
import re
import subprocess
import sys

import pytest

from hvnet.__main__ import COMMANDS
from tests.test_layout import ROOT, modules


def run(name: str, argument: str, monkeypatch: pytest.MonkeyPatch) -> object:
    """The exit code of a command."""
    monkeypatch.setenv("COLUMNS", "100")
    main = importlib.import_module("hvnet.weights.__main__" if name == "weights" else f"hvnet.{name}").main
    with pytest.raises(SystemExit) as caught:
        main([argument])
    return caught.value.code


def test_every_command_is_listed() -> None:
    found = {
        name.removesuffix(".__main__")
        for name, path in modules().items()
        if "run_command(main)" in path.read_text(encoding="utf-8")
    }
    assert set(COMMANDS) == found
    out = subprocess.run([sys.executable, "-m", "hvnet"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert all(f"python -m hvnet.{name} " in out for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_teaches_by_example(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(name, "--help", monkeypatch) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert f"examples:\n  python -m hvnet.{name}" in out
    assert max(map(len, out.splitlines())) <= 100
    options = re.findall(r"^  (--\w[\w-]*)", out, flags=re.MULTILINE)
    used = re.findall(r"(?<= )--\w[\w-]*", out.partition("examples:")[2])
    assert set(used) <= set(options)


@pytest.mark.parametrize("name", COMMANDS)
def test_an_unknown_option_is_refused_in_one_line(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(name, "--no-such-option", monkeypatch) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(r"python -m hvnet\.\S+: error: .*", err.strip().splitlines()[-1])
