"""All commands have one kind of help and one kind of error."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hvnet
from hvnet.__main__ import COMMANDS
from hvnet.cli import add_checkpoint, make_parser, read_overlaps, run_command
from hvnet.exceptions import InputError, Stopped
from tests.helpers import ROOT
from tests.test_layout import modules


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


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "hvnet", *arguments], cwd=ROOT, capture_output=True, text=True)


def test_the_list_of_commands() -> None:
    for arguments in ((), ("--help",), ("-h",)):
        done = call(*arguments)
        assert (done.returncode, done.stderr) == (0, "")
        assert all(f"  hvnet {name} " in done.stdout for name in COMMANDS)
        assert max(map(len, done.stdout.splitlines())) <= 100
    assert call("--version").stdout == f"hvnet {hvnet.__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("nonsense",), "hvnet: error: no command nonsense; there are detect, train"),
        (("trian", "--help"), "hvnet: error: no command trian; did you mean train?"),
        (("detect", "nothing.bin"), "error: nothing.bin: no such file or folder"),
        (("detect", "--no-such-option"), "python -m hvnet.detect: error: "),
        (("evaluate",), "python -m hvnet.evaluate: error: "),
    ],
)
def test_a_wrong_call_ends_with_2_and_a_line(arguments: tuple[str, ...], line: str) -> None:
    done = call(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.strip().splitlines()[-1].startswith(line)


def test_a_command_behind_the_name_of_the_package(tmp_path: Path) -> None:
    """`hvnet COMMAND` hands its arguments on; weights is the one whose module has another name."""
    done = call("weights", "--data", str(tmp_path))
    assert done.returncode == 2
    assert "gt_database.npz: no such file" in done.stderr


def test_how_a_command_ends(capsys: pytest.CaptureFixture[str]) -> None:
    def ends(error: BaseException) -> tuple[object, str, str]:
        def main(_: object) -> None:
            raise error

        with pytest.raises(SystemExit) as caught:
            run_command(main)
        return caught.value.code, *capsys.readouterr()

    assert ends(InputError("a.bin: is empty")) == (2, "", "error: a.bin: is empty\n")
    assert ends(Stopped("stopped in epoch 1", 15)) == (143, "stopped in epoch 1\n", "")
    assert ends(Stopped("", 2)) == (130, "", "")  # not the first of several ranks
    assert ends(KeyboardInterrupt()) == (130, "", "interrupted\n")


def test_weights_or_a_checkpoint(capsys: pytest.CaptureFixture[str]) -> None:
    parser = make_parser("detect", "", [])
    add_checkpoint(parser)
    for given, wanted in {"": None, "--weights compact": "compact", "--checkpoint a/b.pt": Path("a/b.pt")}.items():
        assert parser.parse_args(given.split()).checkpoint == wanted
    with pytest.raises(SystemExit) as caught:
        parser.parse_args(["--checkpoint", "a.pt", "--weights", "compact"])
    assert caught.value.code == 2
    assert capsys.readouterr().err.endswith("error: argument --weights: not allowed with argument --checkpoint\n")


@pytest.mark.parametrize("given", ["Truck", "Truck=", "Truck=nan", "Truck=0", "Truck=1.1", "=0.5", "Lorry=0.5"])
def test_overlaps_that_are_none(given: str) -> None:
    with pytest.raises(InputError, match=f"--overlap {re.escape(given)}: "):
        read_overlaps([given], ["Truck"])
    assert read_overlaps(["Truck=0.5", "a=b=1"], ["Truck", "a=b"]) == {"Truck": 0.5, "a=b": 1.0}


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
