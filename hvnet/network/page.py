"""The page that detects in a browser: hvnet/page/index.html, and the runtime that it needs beside it.

The runtime is onnxruntime-web, which npm gets: 14 MB, too much for this package.
"""

import json
import shutil
import subprocess
import tarfile
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path

from hvnet.exceptions import InputError

PAGE = Path(__file__).parents[1] / "page"
"""What is copied: the page, and the licence of the runtime, whose package on npm holds none."""
RUNTIME = "onnxruntime-web@1.30.0"
FILES = ("ort.wasm.min.js", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm")
"""What the page loads of the runtime: for the CPU alone, without the parts for GPUs."""


def fetch_runtime() -> dict[str, bytes]:
    """The files of the runtime by name, from npm's cache or its registry. Raises InputError if they cannot be had."""
    npm = shutil.which("npm")
    if npm is None:
        raise InputError(f"npm is missing, which gets {RUNTIME} for the page: install Node.js, or leave --page out")
    with tempfile.TemporaryDirectory() as folder:
        # npm's own tries, one less: with two it takes 70 s to find that there is no network
        command = [npm, "pack", RUNTIME, "--json", "--ignore-scripts", "--prefer-offline", "--fetch-retries=1"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        packed = list(Path(folder).glob("*.tgz"))
        if done.returncode or len(packed) != 1:
            raise InputError(
                f"npm cannot get {RUNTIME} for the page ({_reason(done)}); try again with a network, set npm's "
                "registry or proxy, or leave --page out"
            )
        try:
            with tarfile.open(packed[0], "r:gz") as archive:
                return {name: _content(archive, f"package/dist/{name}") for name in FILES}
        except (tarfile.TarError, zlib.error, KeyError, OSError, EOFError) as error:
            raise InputError(f"what npm got as {RUNTIME} is damaged ({error}); try npm cache clean --force") from error


def write_page(folder: Path, runtime: Mapping[str, bytes]) -> None:
    """Writes the page and its runtime, from `fetch_runtime`, into a folder with detector.onnx and meta.json."""
    for path in PAGE.iterdir():
        shutil.copy(path, folder / path.name)
    for name, content in runtime.items():
        (folder / name).write_bytes(content)


def _content(archive: tarfile.TarFile, name: str) -> bytes:
    file = archive.extractfile(name)
    if file is None:
        raise KeyError(f"{name} is no file")
    return file.read()


def _reason(done: subprocess.CompletedProcess[str]) -> str:
    """What npm says went wrong, in a line."""
    try:
        return str(json.loads(done.stdout)["error"]["summary"]).splitlines()[0]
    except (ValueError, LookupError, TypeError):
        lines = [line for line in done.stderr.splitlines() if line.strip() and "complete log" not in line]
        return lines[-1].strip() if lines else f"exit code {done.returncode}"
