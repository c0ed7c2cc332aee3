"""The tree is as docs/architecture.md says: imports point down; a kernel's stem goes through kernel, twin and test."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from hvnet.__main__ import COMMANDS
from tests.helpers import ROOT

# from below: a module imports from its own layer and from those below it
LAYERS = ("base", "kernels", "data", "network", "evaluation", "pictures", "training", "studies", "commands")
BASE = {"__init__", "exceptions", "boxes", "config", "folders", "ranks"}
LIBRARIES = {"kernels": {"kernels"}, "network": {"base", "kernels", "network"}}
"""Layers that know less than what is below them."""
SHARED = {
    (f"network.{module}", f"data.{other}")
    for module in ("detector", "points_to_boxes")
    for other in ("sensor", "ground")
}
"""... but for the one judge of clouds, which arrays pass as files do, and the ground, which training takes out too."""


def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name below hvnet."""
    package = ROOT / "hvnet"
    found = {str(path.relative_to(package).with_suffix("")).replace("/", "."): path for path in package.rglob("*.py")}
    # older Pythons do not follow the symlink
    return found | {f"kernels.{path.stem}": path for path in (ROOT / "kernels").glob("*.py")}


def commands() -> set[str]:
    """The modules that are commands."""
    return {name if name != "weights" else "weights.__main__" for name in COMMANDS} | {"__main__"}


def layer(name: str) -> str:
    """The layer of a module."""
    if name in commands() or name == "cli" or name.startswith("weights."):
        return "commands"
    return "base" if name in BASE else name.split(".")[0]


def imported(path: Path) -> set[str]:
    """The project's modules that a file imports, by dotted name below hvnet; those for types alone left out."""
    names = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for below in ast.walk(node):
                if isinstance(below, ast.ImportFrom):
                    below.module = None
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "hvnet":
            module = (node.module or "").removeprefix("hvnet").removeprefix(".")
            for alias in node.names:
                inner = f"{module}.{alias.name}" if module else alias.name
                names.add(inner if inner in modules() else module)
        elif isinstance(node, ast.Import):
            names |= {a.name.removeprefix("hvnet.") for a in node.names if a.name.startswith("hvnet.")}
    return names - {""}


def test_every_module_has_a_layer() -> None:
    assert {layer(name) for name in modules()} <= set(LAYERS)
    assert commands() <= set(modules())


@pytest.mark.parametrize("name", sorted(modules()))
def test_imports_point_down(name: str) -> None:
    own = layer(name)
    allowed = LIBRARIES.get(own, set(LAYERS[: LAYERS.index(own) + 1]))
    # the face of the package is lazy: it gives what is above when it is asked for it
    if name == "__init__":
        allowed = {"base", "network"}
    below = {other for other in imported(modules()[name]) if (name, other) not in SHARED}
    assert {other: layer(other) for other in below if layer(other) not in allowed} == {}


@pytest.mark.parametrize("name", sorted(commands() - {"__main__"}))
def test_no_command_imports_another(name: str) -> None:
    assert imported(modules()[name]) & commands() == set()


def test_there_is_no_circle() -> None:
    graph = {name: imported(path) for name, path in modules().items() if name != "__init__"}
    done: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        assert name not in above, " -> ".join((*above, name))
        if name not in done:
            for other in sorted(graph.get(name, ())):
                visit(other, (*above, name))
            done.add(name)

    for name in graph:
        visit(name, ())


@pytest.mark.parametrize(
    "name", sorted({path.stem for path in (ROOT / "kernels").glob("*.py")} - {"launch", "reference", "shares"})
)
def test_kernel_has_twin_and_test(name: str) -> None:
    twins = {node.name for node in ast.parse((ROOT / "kernels" / "reference.py").read_text()).body
             if isinstance(node, ast.FunctionDef)}  # fmt: skip
    public = {
        node.name
        for node in ast.parse((ROOT / "kernels" / f"{name}.py").read_text()).body
        if isinstance(node, ast.FunctionDef) and not node.name.startswith("_") and not node.decorator_list
    }
    # scatter's calls over segments that are at hand; the geometry of grids; the parts of inference, whose twin is the
    # encoder in evaluation mode
    others = {
        "segments",
        "segment_max",
        "segment_mean",
        "segment_gather",
        "segment_add",
        "make_grid",
        "is_nested",
        "nested_index",
        "nms_order",
        "ground_heights",
        "place_points",
        "write_keys",
        "gather_patches",
        "decode_candidates",
    }
    others |= {"scales_of", "voxel_means", "encode_voxels", "add_of_voxels", "project_voxels", "clear_voxels"}
    assert public - others - twins == set()
    assert (ROOT / "tests" / f"test_{name}.py").is_file()


def test_twins_need_no_warp() -> None:
    code = "import sys; import hvnet.kernels.reference; assert 'warp' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize("name", ["kernels", "configs"])
def test_symlink(name: str) -> None:
    link = ROOT / "hvnet" / name
    if not (ROOT / ".git").exists():
        pytest.skip("an sdist holds folders in the place of links")
    assert link.is_symlink()
    assert link.readlink() == Path("..") / name
    assert not (ROOT / "kernels" / "__init__.py").exists()


def test_import_prints_nothing() -> None:
    code = "import hvnet, hvnet.network.detector, torch, hvnet.kernels.rotated as r\n"
    code += "r.rotated_iou_bev(*[torch.ones(1, 7)] * 2)"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == ""
    assert done.stderr == ""
