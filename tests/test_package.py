"""The package as others use it: its face, its types, what a wheel and an sdist hold."""

import os
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import hvnet
from hvnet.config import load_config
from tests.helpers import ROOT

USE = """
import hvnet
detector = hvnet.load()
reveal_type(detector)
reveal_type(detector.classes)
reveal_type(hvnet.Detector.__call__)
hvnet.laod()
"""
OTHERS = ("torch", "numpy", "warp", "matplotlib", "PIL", "onnx", "tensorboard", "viser")
"""Packages that hvnet imports."""


def test_the_face() -> None:
    assert set(hvnet.__all__) == {"Detector", "InputError", "__version__", "load"}
    assert all(hasattr(hvnet, name) for name in hvnet.__all__)
    assert hvnet.__version__ == version("hvnet")
    assert f"\nversion: {hvnet.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\n## {hvnet.__version__}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    with pytest.raises(AttributeError, match="module 'hvnet' has no attribute 'laod'"):
        hvnet.laod  # noqa: B018
    code = "import sys, hvnet.kernels.scatter; assert 'hvnet.network' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_types_are_known_to_others(tmp_path: Path) -> None:
    """mypy in a project of its own, with its own settings; what other packages export takes long and is not asked."""
    (tmp_path / "use.py").write_text(USE)
    others = ",".join(f"{name}.*" for name in OTHERS)
    (tmp_path / "mypy.ini").write_text(f"[mypy]\n[mypy-{others}]\nfollow_imports = skip\n")
    command = [sys.executable, "-m", "mypy", "use.py"]
    environment = os.environ | {"MYPYPATH": str(ROOT)}  # mypy does not follow an editable installation
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, env=environment)
    lines = [line for line in done.stdout.splitlines() if line.startswith("use.py")]
    assert 'Revealed type is "hvnet.network.detector.Detector"' in lines[0]
    assert "tuple[str, ...]" in lines[1] or "tuple[builtins.str, ...]" in lines[1]
    assert "hvnet.network.model.Detections" in lines[2]
    assert 'error: Module has no attribute "laod"' in lines[3]
    assert len(lines) == 4


def test_what_is_packed(tmp_path: Path) -> None:
    """The sdist holds all that git tracks but settings, the wheel all of the package; neither anything else's."""
    pytest.importorskip("setuptools", "77", reason="the licence in pyproject.toml needs it")
    made = str(tmp_path / "made")
    code = f"from setuptools import build_meta as b; b.build_sdist({made!r}); b.build_wheel({made!r})"
    command = [sys.executable, "-c", code]
    source = tmp_path / "source"
    (tmp_path / "made").mkdir()
    if not (ROOT / ".git").exists():
        pytest.skip("no git checkout to compare with")
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(source)], check=True)
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    tracked = subprocess.run(["git", "ls-files"], cwd=source, check=True, capture_output=True, text=True).stdout.split()
    (sdist,), (wheel,) = (tmp_path / "made").glob("*.tar.gz"), (tmp_path / "made").glob("*.whl")
    with tarfile.open(sdist) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    links = {"hvnet/kernels", "hvnet/configs"}  # as folders
    assert set(tracked) - packed - links == {".gitignore"}
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "installed")
    wanted = {name for name in tracked if name.startswith("hvnet/") and name not in links}
    wanted |= {f"hvnet/{name}" for name in tracked if name.startswith(("kernels/", "configs/"))}
    assert {name for name in names if ".dist-info/" not in name} == wanted
    assert {Path(name).name for name in names if "licenses/" in name} == {"LICENSE", "LICENSE.md"}
    for recipe in (source / "hvnet" / "weights").glob("*.yaml"):  # whose base is in another folder
        assert load_config(tmp_path / "installed" / "hvnet" / "weights" / recipe.name) == load_config(recipe)
