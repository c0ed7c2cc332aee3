"""The page that detects in a browser: what it reads and finds is what Python does, and nothing leaves the machine."""

import base64
import csv
import functools
import http.server
import json
import os
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hvnet import export
from hvnet.data.clouds import read_cloud
from hvnet.exceptions import InputError
from hvnet.network.detector import Detector, load
from hvnet.network.model import Detections
from hvnet.network.page import FILES, RUNTIME
from tests.browser import CHROMIUM, Browser, shown, wait

ERROR = "document.getElementById('error').textContent"


class Server(http.server.SimpleHTTPRequestHandler):
    """What `python -m http.server` runs; it keeps what it is asked for."""

    asked: list[tuple[str, str]]

    def __init__(self, *arguments: Any, asked: list[tuple[str, str]], **options: Any) -> None:
        self.asked = asked
        super().__init__(*arguments, **options)

    def log_request(self, code: int | str = "-", size: int | str = "-") -> None:
        self.asked.append((self.path, str(int(code))))


class Page:
    """The page in a browser."""

    def __init__(self, browser: Browser, address: str, asked: list[tuple[str, str]]) -> None:
        self.browser, self.address, self.asked = browser, address, asked
        browser.call("Page.navigate", url=address)
        wait(lambda: "Ready." in browser.text())

    def result(self, script: str) -> Any:
        """The value of a promise."""
        answer = self.browser.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def drop(self, *paths: Path) -> None:
        self.browser.run(dropping(*paths))

    def picture(self) -> str:
        """What the canvas shows."""
        return self.browser.run("document.getElementById('canvas').toDataURL()")

    def wait_for(self, path: Path) -> Detections:
        """What it finds in a file."""
        wait(lambda: self.browser.run(f"window.detections?.file === {json.dumps(path.name)} || {ERROR}"))
        assert self.browser.run(ERROR) == ""
        wait(lambda: "Ready." in self.browser.text())
        found = self.browser.run("window.detections")
        boxes = torch.tensor(found["boxes"]).view(-1, 7)
        return Detections(boxes, torch.tensor(found["scores"]), torch.tensor(found["labels"], dtype=torch.int64))


def dropping(*paths: Path) -> str:
    """A script that drops files together."""
    files = ", ".join(map(js_file, paths))
    return (
        f"{{const dataTransfer = new DataTransfer(); for (const file of [{files}]) dataTransfer.items.add(file);"
        "document.body.dispatchEvent(new DragEvent('drop', {dataTransfer, bubbles: true, cancelable: true}))}"
    )


def js_file(path: Path) -> str:
    """A File with the content of a file, as a script."""
    content = base64.b64encode(path.read_bytes()).decode()
    return f"new File([Uint8Array.from(atob('{content}'), c => c.charCodeAt(0))], {json.dumps(path.name)})"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the command writes."""
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    pytest.importorskip("websockets", reason="websockets is not installed: pip install '.[test]'")
    if CHROMIUM is None:
        pytest.skip("no Chromium")
    out = tmp_path_factory.mktemp("page") / "export"
    try:
        export.main(["--page", "--out", str(out)])
    except InputError as error:
        if RUNTIME not in str(error):
            raise
        pytest.skip(str(error))
    return out


@pytest.fixture(scope="module")
def page(exported: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    asked: list[tuple[str, str]] = []
    handler = functools.partial(Server, directory=str(exported), asked=asked)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = Browser(tmp_path_factory.mktemp("profile"))
        try:
            yield Page(browser, f"http://127.0.0.1:{server.server_port}/", asked)
        finally:
            browser.close()
            server.shutdown()


@pytest.fixture(scope="module")
def detector() -> Detector:
    """The shipped weights in float32, as they are exported."""
    return load(device="cpu", dtype=torch.float32)


@pytest.fixture(scope="module")
def scene(scenes: Path) -> Path:
    """A generated cloud."""
    return scenes / "training" / "velodyne" / "000000.bin"


def assert_same_boxes(found: Detections, want: Detections, least: float) -> None:
    """Both have the same boxes; one that only just reaches the threshold may be missing."""
    assert len(want.boxes) > 2
    for some, others in ((found, want), (want, found)):
        for box, score, label in zip(*some, strict=True):
            if score < least + 1e-3:
                continue
            own = others.select(others.labels == label)
            k = int((own.boxes[:, :3] - box[:3]).norm(dim=1).argmin())
            torch.testing.assert_close(own.boxes[k, :6], box[:6], rtol=0, atol=1e-3)
            assert torch.cos(own.boxes[k, 6] - box[6]) > 1 - 1e-5
            torch.testing.assert_close(own.scores[k], score, rtol=0, atol=1e-4)


# --- detection -------------------------------------------------------------------------------------------------------


def test_it_finds_in_a_real_frame_what_the_detector_finds(page: Page, detector: Detector, kitti_root: Path) -> None:
    path = sorted((kitti_root / "training" / "velodyne").glob("*.bin"))[0]
    page.drop(path)
    found = page.wait_for(path)
    want = detector(read_cloud(path)[0])
    least = detector.config.head.score_threshold
    assert_same_boxes(found, want, least)
    assert shown(page.browser.text()) == (len(found.boxes), len(found.boxes))
    counts = [page.browser.run(f"document.querySelectorAll('#classes b')[{k}].innerText") for k in range(3)]
    assert counts == [str(int((found.labels == k).sum())) for k in range(3)]
    assert page.browser.run("window.detections.seconds") > 0


def test_a_pcd_from_another_sensor(page: Page, detector: Detector, scene: Path, tmp_path: Path) -> None:
    """Chosen by the button: text, another order, a reflectance up to 255, points without a number, a higher mount."""
    points = read_cloud(scene)[0]
    rows = np.column_stack((points[:, 3] * 255, points[:, 2] + 0.9, points[:, 0], points[:, 1]))
    rows[5:25] = np.nan
    path = tmp_path / "scan.PCD"
    write_pcd(path, "Intensity z x y", rows.astype(np.float32))
    node = page.browser.call("Runtime.evaluate", expression="document.getElementById('file')")["result"]["objectId"]
    page.browser.call("DOM.setFileInputFiles", files=[str(path)], objectId=node)
    found = page.wait_for(path)
    points, notes = read_cloud(path)
    assert_same_boxes(found, detector(points), detector.config.head.score_threshold)
    for note in notes:
        assert any(words in page.browser.text() for words in ("20 points that are not finite", "divided by 255")), note


def test_what_the_slider_leaves_is_saved(page: Page, detector: Detector, scene: Path, tmp_path: Path) -> None:
    page.drop(scene)
    found = page.wait_for(scene)
    total = len(found.boxes)
    least = float(found.scores.sort().values[total // 2]) + 0.005
    page.browser.run(
        f"{{const score = document.getElementById('score'); score.value = {least};"
        "score.dispatchEvent(new Event('input'))}"
    )
    least = float(page.browser.run("document.getElementById('score').value"))
    left = found.select(found.scores >= least)
    assert 0 < len(left.boxes) < total
    assert shown(page.browser.text()) == (len(left.boxes), total)
    page.browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    page.browser.run("document.getElementById('save').click()")
    saved = tmp_path / "000000-boxes.csv"
    wait(saved.is_file)
    time.sleep(0.2)
    with saved.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    assert header == ["cloud", "class", "score", "x", "y", "z", "length", "width", "height", "yaw"]
    assert [row[:2] for row in rows] == [["000000", detector.classes[label]] for label in left.labels.tolist()]
    numbers = torch.tensor([[float(value) for value in row[2:]] for row in rows])
    torch.testing.assert_close(numbers[:, 0], left.scores, rtol=0, atol=1e-4)
    torch.testing.assert_close(numbers[:, 1:], left.boxes, rtol=0, atol=1e-3)


def test_a_cloud_that_is_dropped_meanwhile_waits(page: Page, scene: Path, tmp_path: Path) -> None:
    """Of several the last one; a cloud of no points has no boxes, and of one far away the reason is said."""
    names = ("one", "two", "three")
    paths = [tmp_path / f"{name}.bin" for name in names]
    for path, points in zip(paths, (np.fromfile(scene, np.float32), np.zeros(0), np.full(4, 500)), strict=True):
        points.astype(np.float32).tofile(path)
    status = page.browser.run("\n".join(map(dropping, paths)) + "\ndocument.getElementById('status').textContent")
    assert status == "Detecting in one.bin ...; three.bin is next."
    assert len(page.wait_for(paths[2]).boxes) == 0
    assert "0 of 0 detections" in page.browser.text()
    assert "0 of 1 points are where it detects" in page.browser.text()
    page.drop(paths[1])
    assert len(page.wait_for(paths[1]).boxes) == 0


def test_what_it_cannot_read_is_said(page: Page, scene: Path, tmp_path: Path) -> None:
    """In one line; what was shown stays."""
    before = page.browser.run("window.detections?.file")
    random = np.random.default_rng(0).integers(0, 256, 16 * 50, dtype=np.uint8).tobytes()
    header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 2\nDATA "
    for name, content, message in (
        ("cut.bin", scene.read_bytes()[:-5], "no multiple of 16, the size of a point .* is the file cut off"),
        ("noise.bin", random, "its numbers are no coordinates in metres; is it a cloud"),
        ("cloud.ply", b"ply", r"is no \.bin or \.pcd; python -m hvnet\.detect reads"),
        ("cloud", b"", r"is no \.bin or \.pcd"),
        ("text.pcd", b"hello\n", "the header has no DATA"),
        ("packed.pcd", f"{header}binary_compressed\n".encode(), "is compressed; write it as DATA binary or ascii"),
        ("short.pcd", f"{header}ascii\n1 2 3\n".encode(), "the header says 2 points, the file has 1"),
        (
            "huge.pcd",
            b"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 999999999999\nDATA ascii\n1 2 3\n",
            "has 1",
        ),
        ("hexadecimal.pcd", f"{header}ascii\n1 2 3\n0x10 2 3\n".encode(), "has words that are no numbers"),
        ("long.pcd", f"{header}ascii\n1 2 3\n1 2 3\n\n1 2 3\n".encode(), "line 10 is one more than the 2 points"),
        ("words.pcd", f"{header}ascii\n1 2 3\n1 two 3\n".encode(), "line 8 has words that are no numbers"),
        ("wide.pcd", f"{header}ascii\n1 2 3 4\n".encode(), "line 7 has 4 numbers, want 3"),
        ("half.pcd", f"{header}binary\n".encode() + bytes(12), "wants 24 bytes for 2 points, the file has 12"),
        (
            "field.pcd",
            f"{header}ascii\n".replace("WIDTH 2", "WIDTH 0").replace("x", "a").encode(),
            "has no field x; its fields are a, y, z",
        ),
        ("type.pcd", f"{header}ascii\n".replace("F F F", "F F Q").encode(), "the TYPE and SIZE Q4 are unknown"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        page.drop(path)
        wait(lambda name=name: page.browser.run(ERROR).startswith(f"{name}: "))
        assert page.browser.run(f"/{message}/.test({ERROR})"), page.browser.run(ERROR)
        wait(lambda: "Ready." in page.browser.text())
    page.drop(scene, scene)
    assert page.browser.run(ERROR) == "2 files were dropped; drop one"
    assert page.browser.run("window.detections?.file") == before


def test_the_wheel_zooms_and_a_drag_moves(page: Page, scene: Path) -> None:
    page.drop(scene)
    page.wait_for(scene)
    seen = [page.picture()]
    for kind, x, options in (
        ("mouseWheel", 200, {"deltaX": 0, "deltaY": -240}),
        ("mousePressed", 200, {"button": "left", "clickCount": 1}),
        ("mouseMoved", 260, {"button": "left"}),
        ("mouseReleased", 260, {"button": "left", "clickCount": 1}),
    ):
        page.browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=200, **options)
        if kind in ("mouseWheel", "mouseMoved"):
            wait(lambda: page.picture() != seen[-1])
            seen.append(page.picture())
    page.browser.run("[...document.querySelectorAll('button')].find(e => e.innerText == 'fit').click()")
    wait(lambda: page.picture() == seen[0])


# --- reading ---------------------------------------------------------------------------------------------------------


def write_pcd(path: Path, fields: str, rows: NDArray, encoding: str = "ascii") -> None:
    """Columns of one type."""
    kind, count = {"f": "F", "u": "U", "i": "I"}[rows.dtype.kind], rows.shape[1]
    lines = ["# .PCD", "VERSION 0.7", f"FIELDS {fields}", f"SIZE {f'{rows.itemsize} ' * count}"]
    lines += [f"TYPE {f'{kind} ' * count}", f"WIDTH {len(rows)}", "HEIGHT 1", f"DATA {encoding}"]
    body = rows.tobytes()
    if encoding == "ascii":
        body = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows).encode()
    path.write_bytes("\n".join(lines).encode() + b"\n" + body)


def columns_of(points: NDArray, count: int, dtype: str = "<f4") -> Callable[[Path], Any]:
    """Writes the points with so many numbers each, rings and times after the reflectance."""
    rings = np.arange(len(points)) // 100
    rows = np.column_stack((points, *(rings + k for k in range(4))))[:, :count]
    return lambda path: rows.astype(dtype).tofile(path)


def clouds(points: NDArray) -> dict[str, Callable[[Path], Any]]:
    """Ways to write points (N, 4), each of which Python's reader takes in its own way."""
    changed = points.copy()
    changed[:7, 1] = np.nan
    changed[7:9, 3] = np.inf
    changed[9:12, 3] = np.nan
    changed[20:40, :3] = 0
    bright = points * [1, 1, 1, 255]
    bright[3, 3] = 1e6
    packed = struct.Struct("<fBfdHf")  # x, two of padding below, y as float64, z
    body = b"".join(packed.pack(x, 9, z, y, round(60000 * i), 7.0) for x, y, z, i in points.tolist())
    head = (
        "COLUMNS x _ z y scalar_Intensity a\nSIZE 4 1 4 8 2 4\nTYPE f u F F U F\nCOUNT 1 1 1 1 1 1\n"
        f"POINTS {len(points)}\nDATA binary\n"
    ).encode()
    return {
        **{f"{count}.bin": columns_of(points, count) for count in range(3, 9)},
        "double.bin": columns_of(points, 4, "<f8"),
        "double3.bin": columns_of(points.round(2), 3, "<f8"),
        "half.bin": columns_of(points.clip(-50, 50), 4, "<f2"),
        "few.bin": columns_of(points[:9] * [1, 1, 1, 0], 4),
        "constant.bin": columns_of(points * [1, 1, 1, 0], 4),
        "shuffled.bin": columns_of(np.random.default_rng(0).permutation(points), 4),
        "16-bit.bin": columns_of(points * [1, 1, 1, 65535], 4),
        "decibel.bin": columns_of(points * [1, 1, 1, 1e6], 4),
        "bright.bin": columns_of(bright, 4),
        "changed.bin": columns_of(changed, 4),
        "plain.pcd": lambda path: write_pcd(path, "x y z intensity", points),
        "changed.pcd": lambda path: write_pcd(path, "x y z i", changed),
        "binary.pcd": lambda path: write_pcd(path, "z _ X y", points, "binary"),
        "short.pcd": lambda path: write_pcd(path, "x y z remission", (points * 100).astype("<i2"), "binary"),
        "packed.pcd": lambda path: path.write_bytes(head + body),
    }


def test_it_reads_what_python_reads(page: Page, scene: Path, tmp_path: Path) -> None:
    """The same points, to the bit."""
    points = np.fromfile(scene, np.float32).reshape(-1, 4)
    for name, write in clouds(points[:: max(1, len(points) // 5000)]).items():
        path = tmp_path / name
        write(path)
        want, notes = read_cloud(path)
        script = f"readCloud({js_file(path)}).then(({{points, notes}}) => ({{points: [...points], notes}}))"
        found = page.result(script)
        np.testing.assert_array_equal(np.array(found["points"], np.float32).reshape(-1, 4), want, err_msg=name)
        own = [note for note in notes if "has a name of the reflectance" not in note]  # which the page does not say
        assert len(found["notes"]) == len(own), (found["notes"], own)


# --- the files -------------------------------------------------------------------------------------------------------


def test_nothing_is_asked_of_others(page: Page, exported: Path) -> None:
    """Whatever the tests before did: no error, and no request but to the folder itself."""
    assert page.browser.errors == []
    assert all(each.startswith((page.address, "blob:", "data:")) for each in page.browser.addresses)
    assert {path for path, _ in page.asked} == {"/", "/meta.json", "/detector.onnx", *(f"/{name}" for name in FILES)}
    assert {code for _, code in page.asked} <= {"200", "304"}
    names = {path.name for path in exported.iterdir()}
    assert {"index.html", "detector.onnx", "meta.json", "onnxruntime-license.txt", *FILES} <= names
    text = (exported / "index.html").read_text(encoding="utf-8")
    assert "http" not in text.replace("http-equiv", "").replace("http.server", "").replace("http://127.0.0.1:8000", "")


def fake_npm(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An npm that does what a script says."""
    folder.mkdir()
    (folder / "npm").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "npm").chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)


@pytest.mark.skipif(os.name == "nt", reason="the npm here is a script of sh")
@pytest.mark.parametrize(
    ("script", "message"),
    [
        (
            """echo '{"error": {"code": "E", "summary": "request failed, reason: no network"}}'; exit 1""",
            r"npm cannot get onnxruntime-web@[\d.]+ for the page \(request failed, reason: no network\); try again",
        ),
        ("echo 'npm error no luck' >&2; echo 'npm error A complete log ...' >&2; exit 1", r"\(npm error no luck\)"),
        ("exit 3", r"\(exit code 3\)"),
        ("exit 0", "npm cannot get"),
        ("echo nothing > a.tgz", "what npm got as .* is damaged .*; try npm cache clean"),
        ("mkdir package && tar czf a.tgz package", "what npm got as .* is damaged .*ort.wasm.min.js"),
    ],
)
def test_npm_fails(script: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line, and nothing is written."""
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    fake_npm(tmp_path / "bin", script, monkeypatch)
    with pytest.raises(InputError, match=message) as caught:
        export.main(["--page", "--out", str(tmp_path / "out")])
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--without-nms", "--without-encoder"])
def test_the_page_wants_boxes(option: str) -> None:
    with pytest.raises(InputError, match=r"--page: wants detector\.onnx to give boxes; leave"):
        export.main(["--page", option])


def test_without_npm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match=f"npm is missing, which gets {RUNTIME} for the page: install Node.js"):
        export.main(["--page", "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
