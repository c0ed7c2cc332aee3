"""The tree is as DESIGN says: a kernel's stem goes through kernel, twin and test, and imports point down only."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# what each module may import of the project, besides hvnet.cli (the shared error)
KERNELS = {
    "launch": set(),
    "scatter": {"kernels.launch"},
    "voxel": {"kernels.launch", "kernels.scatter"},
    "rotated": {"kernels.launch"},
    "encode": {"kernels.launch", "kernels.scatter", "kernels.voxel"},
    "raycast": {"kernels.launch"},
    "reference": set(),
}
ANY_KERNEL = {f"kernels.{name}" for name in KERNELS}
NETWORK = {"config", "boxes", "anchors", "encoder", "pillars", "backbone", "head", "loss"}
DATA = {"data.kitti", "data.clouds", "data.database", "data.augment", "data.synthetic", "data.shapes"}
ALLOWED = {f"kernels.{name}": allowed for name, allowed in KERNELS.items()} | {
    "__init__": {"detector"},
    "__main__": set(),
    "cli": set(),
    "boxes": set(),
    "config": set(),
    "ranks": set(),
    "pillars": ANY_KERNEL,
    "encoder": ANY_KERNEL | {"config", "pillars", "ranks"},
    "backbone": {"config", "ranks"},
    "anchors": ANY_KERNEL | {"config", "boxes", "encoder"},
    "head": {"config", "anchors"},
    "loss": {"config", "anchors", "boxes", "head", "ranks"},
    "model": ANY_KERNEL | NETWORK,
    "detector": ANY_KERNEL | NETWORK | {"model"},
    "data.__init__": set(),
    "data.kitti": {"boxes"},
    "data.clouds": {"data.kitti"},
    "data.shapes": set(),
    "data.synthetic": ANY_KERNEL | {"boxes", "data.kitti", "data.shapes"},
    "data.database": {"boxes", "data.kitti"},
    "data.augment": {"boxes", "config", "data.database"},
    "draw": {"boxes", "data.kitti"},
    "matching": ANY_KERNEL | {"boxes", "data.kitti"},
    "evaluate": {"boxes", "matching", "data.kitti"},
    "figures": DATA | {"detect", "detector", "draw"},
    "errors": ANY_KERNEL | {"data.kitti", "detector", "draw", "evaluate", "mistakes", "model"},
    "mistakes": ANY_KERNEL | {"boxes", "data.kitti", "evaluate", "matching", "model"},
    "weights.__init__": set(),
    "weights.__main__": {"data.database", "model", "train"},
    "train": NETWORK | DATA | {"model", "detector", "draw", "evaluate", "ranks"},
    "detect": NETWORK | DATA | {"model", "detector", "draw", "evaluate"},
    "export": {"config", "anchors", "encoder", "head", "model", "detector"},
    "study": ANY_KERNEL | NETWORK | DATA | {"model", "detector", "evaluate", "matching", "train"},
    "view": NETWORK | DATA | {"kernels.voxel", "model", "detector", "draw", "mistakes", "detect", "errors"},
}


def modules() -> dict[str, Path]:
    """Every module of the package by its dotted name below hvnet."""
    found = {}
    package = ROOT / "hvnet"
    folders = (
        (package, ""),
        (package / "data", "data."),
        (package / "weights", "weights."),
        (ROOT / "kernels", "kernels."),
    )
    for folder, prefix in folders:
        for path in folder.glob("*.py"):
            found[prefix + path.stem] = path
    return found


def imported(path: Path) -> set[str]:
    """The project's modules that a file imports at run time, by dotted name below hvnet."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "hvnet":
            module = (node.module or "").removeprefix("hvnet").removeprefix(".")
            for alias in node.names:
                inner = f"{module}.{alias.name}" if module else alias.name
                names.add(inner if inner in modules() else module)
        elif isinstance(node, ast.Import):
            names |= {a.name.removeprefix("hvnet.") for a in node.names if a.name.startswith("hvnet.")}
    return names - {"cli"}


def test_every_module_is_known() -> None:
    assert set(modules()) == set(ALLOWED)


@pytest.mark.parametrize("name", sorted(ALLOWED))
def test_imports_point_down(name: str) -> None:
    only_for_types = {"kernels.reference": {"kernels.voxel", "kernels.scatter"}}.get(name, set())
    assert imported(modules()[name]) <= ALLOWED[name] | only_for_types


@pytest.mark.parametrize(
    "name", sorted({path.stem for path in (ROOT / "kernels").glob("*.py")} - {"launch", "reference"})
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
    assert link.is_symlink()
    assert link.readlink() == Path("..") / name
    assert not (ROOT / "kernels" / "__init__.py").exists()


def test_import_prints_nothing() -> None:
    code = "import hvnet, hvnet.detector, torch, hvnet.kernels.rotated as r; r.rotated_iou_bev(*[torch.ones(1, 7)] * 2)"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == ""
    assert done.stderr == ""
