"""The viewer's page: a browser without a screen, and what the page's text says."""

import itertools
import json
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = (
    "--headless=new",
    "--no-sandbox",  # which root has none of
    "--use-angle=swiftshader",  # WebGL without a GPU
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--no-first-run",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",  # the page has to do without the internet
)
KEYS = {"n": ("KeyN", 78, "n"), "p": ("KeyP", 80, "p"), "ArrowRight": ("ArrowRight", 39, "")}


class Browser:
    """Chromium without a screen, by its DevTools protocol."""

    def __init__(self, folder: Path) -> None:
        from websockets.sync.client import connect

        assert CHROMIUM
        command = [CHROMIUM, *FLAGS, f"--user-data-dir={folder}", "--window-size=800,600", "about:blank"]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        address = folder / "DevToolsActivePort"
        wait(lambda: address.is_file() and len(address.read_text().splitlines()) == 2)
        port = address.read_text().splitlines()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(each for each in json.load(answer) if each["type"] == "page")
        self.socket = connect(page["webSocketDebuggerUrl"], max_size=None)
        self.calls = itertools.count()
        self.errors: list[Any] = []  # what is logged as an error; warnings, such as of slow rendering, are none
        self.addresses: list[str] = []
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        number = next(self.calls)
        self.socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self.socket.recv(timeout=60))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            event, about = message.get("method"), message.get("params", {})
            if event == "Network.requestWillBeSent":
                self.addresses.append(about["request"]["url"])
            elif (
                event == "Runtime.exceptionThrown"
                or (event == "Log.entryAdded" and about["entry"]["level"] == "error")
                or (event == "Runtime.consoleAPICalled" and about["type"] in ("error", "assert"))
            ):
                self.errors.append(about)

    def run(self, script: str) -> Any:
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    def text(self) -> str:
        return self.run("document.body?.innerText ?? ''")  # there is no body before the page comes

    def frame(self) -> str:
        """The value of the first field that holds one: the frame chooser."""
        return self.run("[...document.querySelectorAll('input')].map(e => e.value).find(v => /^0\\d{5}$/.test(v))")

    def press(self, key: str) -> None:
        code, number, text = KEYS[key]
        parts = {"key": key, "code": code, "windowsVirtualKeyCode": number}
        self.call("Input.dispatchKeyEvent", type="keyDown", text=text, **parts)
        self.call("Input.dispatchKeyEvent", type="keyUp", **parts)

    def close(self) -> None:
        self.call("Browser.close")
        self.process.wait(30)


def wait(condition: Callable[[], object], seconds: float = 60) -> None:
    """Until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)


def shown(text: str) -> tuple[int, int]:
    """How many detections the page says are shown, and of how many."""
    match = re.search(r"(\d+) of (\d+) detections", text)
    assert match, text
    return int(match[1]), int(match[2])
