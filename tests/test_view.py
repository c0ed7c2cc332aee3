"""The command of the viewer: its inputs, what it says of a mistake, and its page in a browser."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hvnet.exceptions import InputError
from hvnet.view import choose_data, main
from tests.browser import CHROMIUM, Browser, shown, wait
from tests.helpers import ROOT


def test_without_the_extra_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'hvnet\[view\]' \(from a clone: pip install -e '\.\[view\]'\)$"):
        main([])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing.bin"], "nothing.bin: no such file"),
        (["{run}", "--checkpoint", "a.pt"], "--checkpoint, --weights: the run .*run has its own"),
        (["{run}", "--data", "{empty}"], "checkpoint.pt: truncated"),
        (["{empty}", "--data", "{empty}"], "--data: only for the folder of a run"),
        (["--data", "{empty}"], "--data: only for the folder of a run"),
        (["{empty}"], "holds no cloud"),
        (["{cloud}", "--split", "val"], "--split val: none of the inputs is a KITTI root"),
        (["{cloud}", "--port", "70000"], "--port 70000: want 0 to 65535"),
        (["{cloud}", "--host", "203.0.113.7"], "--host 203.0.113.7: .*try 127.0.0.1"),
        (["{cloud}", "--overlap", "Tram=0.5"], "--overlap Tram=0.5: no class Tram; there are Car"),
        (["{cut}"], "cut.bin: 15 bytes are no multiple of 16"),
    ],
)
def test_a_users_mistake_is_said(arguments: list[str], message: str, tmp_path: Path) -> None:
    pytest.importorskip("viser")
    run, cut, cloud = tmp_path / "run", tmp_path / "cut.bin", tmp_path / "a" / "cloud.bin"
    for folder in (run, cloud.parent, tmp_path / "empty"):
        folder.mkdir()
    (run / "checkpoint.pt").write_bytes(b"")
    cut.write_bytes(bytes(15))
    cloud.write_bytes(bytes(32))
    names = {"run": run, "empty": tmp_path / "empty", "cut": cut, "cloud": cloud}
    with pytest.raises(InputError, match=message):
        main(["--port", "0", *(argument.format(**names) for argument in arguments)])


def test_a_run_brings_its_checkpoint(tmp_path: Path) -> None:
    run, root, cloud, weights = (tmp_path / name for name in ("run", "root", "cloud.bin", "a.pt"))
    run.mkdir()
    (run / "checkpoint.pt").touch()
    for given, wanted in {
        (None, None, None): (None, None),
        (None, None, weights): (None, weights),
        (root, None, None): (root, None),
        (cloud, None, weights): (cloud, weights),
        (run, None, None): (None, run / "checkpoint.pt"),
        (run, root, None): (root, run / "checkpoint.pt"),
    }.items():
        assert choose_data(*given) == wanted
    (run / "data.txt").write_text(f"{root}\n")
    assert choose_data(run, None, None) == (root, run / "checkpoint.pt")


def test_the_page_in_a_browser(tmp_path: Path) -> None:
    """The command on generated scenes: slider, keys and buttons work, no error is logged, nothing comes from afar."""
    pytest.importorskip("viser")
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    command = [sys.executable, "-m", "hvnet.view", "--port", "0", "--device", "cpu"]
    # a shell's background jobs ignore SIGINT, and so would the command that they start
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    try:
        assert process.stdout
        line = process.stdout.readline()
        address = line.split()[0]
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+", address)
        browser = Browser(tmp_path / "profile")
        try:
            browser.call("Page.navigate", url=address)
            wait(lambda: "frames searched" in browser.text() and browser.run("!!document.querySelector('canvas')"))
            assert browser.frame() == "000000"
            before, total = shown(browser.text())
            assert 0 < before < total

            browser.run("document.querySelector('[role=slider]').focus()")
            for _ in range(30):
                browser.press("ArrowRight")
            wait(lambda: shown(browser.text())[0] < before)
            assert shown(browser.text())[1] == total

            browser.press("n")
            wait(lambda: browser.frame() == "000001")
            browser.press("n")
            wait(lambda: browser.frame() == "000002")
            browser.press("p")
            wait(lambda: browser.frame() == "000001")
            browser.run("[...document.querySelectorAll('button')].find(e => e.innerText == 'previous (p)').click()")
            wait(lambda: browser.frame() == "000000")

            wait(lambda: "4 of 4 frames searched" in browser.text())
            buttons = "[...document.querySelectorAll('button')].filter(e => / points, .* m, 0/.test(e.innerText))"
            wanted = browser.run(f"{buttons}[0].innerText").split(", ")[-1]
            browser.run(f"{buttons}[0].click()")
            wait(lambda: browser.frame() == wanted)
            assert browser.errors == []
            assert {each.split(":")[0] for each in browser.addresses} <= {"http", "blob", "data"}
            assert all(each.startswith(address) for each in browser.addresses if each.startswith("http:"))
        finally:
            browser.close()
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=30)
        assert (process.returncode, rest, errors) == (130, "", "interrupted\n")
    finally:
        process.kill()
        process.communicate()
