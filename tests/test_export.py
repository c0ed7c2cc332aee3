"""Export: the ONNX file and the program of torch.export against torch, and docs/deploy.md as it stands."""

import errno
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import hvnet
from hvnet.config import load_config
from hvnet.data.kitti import read_frame
from hvnet.exceptions import InputError
from hvnet.export import main
from hvnet.network.anchors import make_anchors
from hvnet.network.checkpoint import find_checkpoint, load_checkpoint, model_from_checkpoint
from hvnet.network.export import describe, map_names, maps_of_class, write_onnx, write_program
from hvnet.network.head import HeadMaps
from hvnet.network.model import Detections, HVNet
from tests.helpers import ROOT
from tests.models import NARROW, lively, save_untrained, some_clouds

DEMO = ROOT / "configs" / "demo.yaml"
SMALL = [*NARROW, "head.score_threshold=0.02"]
CLASSES = ("Car", "Pedestrian", "Cyclist")


def scene(root: Path, count: int) -> tuple[Tensor, Tensor]:
    """The points of the first frames of a KITTI root, and the clouds they belong to."""
    parts = [read_frame(root, f"{k:06d}").points for k in range(count)]
    return torch.cat(parts), torch.repeat_interleave(torch.tensor([len(part) for part in parts]))


@pytest.fixture(scope="module")
def shipped() -> HVNet:
    return model_from_checkpoint(load_checkpoint(find_checkpoint(None)), "compact")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with what the command makes of the shipped weights."""
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    out = tmp_path_factory.mktemp("deploy") / "export"
    main(["--out", str(out)])
    return out


def maps_of_onnx(path: Path, images: list[Tensor]) -> dict[str, Tensor]:
    """What onnxruntime makes of pseudo-images."""
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: pip install '.[test]'")
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    inputs = {given.name: images[int(given.name[-1])].contiguous().numpy() for given in session.get_inputs()}
    values = session.run(names, inputs)
    return {name: torch.from_numpy(value) for name, value in zip(names, values, strict=True)}


def by_name(model: HVNet, maps: list[HeadMaps]) -> dict[str, Tensor]:
    """The maps of a model under the names that they are exported with."""
    values = [value for of_class in maps for value in of_class if value is not None]
    return dict(zip(map_names(model.config), values, strict=True))


def assert_same_maps(found: dict[str, Tensor], want: dict[str, Tensor]) -> None:
    """Within a ten-thousandth of each map's range."""
    assert found.keys() == want.keys()
    for name, value in want.items():
        assert found[name].shape == value.shape
        assert found[name].dtype == torch.float32
        span = float(value.max() - value.min())
        assert span > 0, name
        assert float((found[name] - value).abs().max()) < 1e-4 * span, name


def assert_same_boxes(found: Detections, want: Detections) -> None:
    assert torch.equal(found.labels, want.labels)
    torch.testing.assert_close(found.scores, want.scores, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.boxes[:, :6], want.boxes[:, :6], rtol=1e-3, atol=1e-3)
    assert (torch.cos(found.boxes[:, 6] - want.boxes[:, 6]) > 1 - 1e-5).all()


def boxes_of_maps(model: HVNet, maps: dict[str, Tensor], monkeypatch: pytest.MonkeyPatch, batch: int) -> Any:
    """What the model's own decoding and NMS make of maps from elsewhere."""
    config = model.config
    of_classes = [
        HeadMaps(**{"direction": None} | {field: maps[name] for field, name in maps_of_class(config, entry).items()})
        for entry in config.head.classes
    ]
    with monkeypatch.context() as patch:
        patch.setattr(model, "maps", lambda *_: of_classes)
        return model.detect(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), batch)


@pytest.mark.parametrize("batch", [1, 2])
@pytest.mark.parametrize("name", ["compact", "demo"])
def test_onnx_gives_the_maps_and_boxes_of_torch(
    name: str, batch: int, shipped: HVNet, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shipped weights on generated scenes, the demo's network on noise; one file serves any batch."""
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    model = shipped if name == "compact" else lively(load_config(DEMO, SMALL))
    points, sample = scene(scenes, batch) if name == "compact" else some_clouds(batch)
    write_onnx(model, tmp_path / "part.onnx")
    with torch.no_grad():
        images = model.encoder(points, sample, batch)
        want = by_name(model, model.maps_of(images))
    found = maps_of_onnx(tmp_path / "part.onnx", images)
    assert_same_maps(found, want)
    plain = model.detect(points, sample, batch)
    assert len(plain) == batch
    assert all(len(each.boxes) > 2 for each in plain)
    for one, other in zip(boxes_of_maps(model, found, monkeypatch, batch), plain, strict=True):
        assert_same_boxes(one, other)


@pytest.mark.parametrize(
    "changes",
    [
        ("head.regression=pose", "head.iou=true", "head.direction=false"),
        ("backbone.pyramid=fpn", "encoder.projection_scales=[1, 2, 4, 8]"),
        ("backbone.pyramid=none", "encoder.point_limit=1"),  # no class at the coarsest level: no input image_2
        ("backbone.pyramid=upsampled", "head.classes.Car.level=0"),
    ],
    ids=str,
)
def test_onnx_of_every_switch(changes: tuple[str, ...], tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    model = lively(load_config(DEMO, [*SMALL, *changes]))
    write_onnx(model, tmp_path / "part.onnx")
    with torch.no_grad():
        images = model.encoder(*some_clouds(2), 2)
        want = by_name(model, model.maps_of(images))
    assert_same_maps(maps_of_onnx(tmp_path / "part.onnx", images), want)


@pytest.mark.parametrize(
    ("names", "prefixes"),
    [
        (("Car", "Pedestrian", "Cyclist"), ["car", "pedestrian", "cyclist"]),
        (("Car", "car", "Cyclist"), ["Car", "car", "cyclist"]),
        (("Car", "car", "CAR"), ["Car", "car", "CAR"]),
        (("Straßenbahn", "Élan", "image"), ["straßenbahn", "élan", "image"]),
    ],
)
def test_no_two_outputs_have_one_name(names: tuple[str, ...], prefixes: list[str], tmp_path: Path) -> None:
    """Classes that differ only in case as well."""
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    changes = [f"head.classes.{old}.name={new}" for old, new in zip(CLASSES, names, strict=True)]
    model = lively(load_config(DEMO, [*SMALL, "augment.objects={}", *changes[::-1]]))
    outputs = map_names(model.config)
    assert [name for name in outputs if name.endswith("_logits")] == [f"{prefix}_logits" for prefix in prefixes]
    assert len(set(outputs)) == len(outputs) == len(names) * (len(outputs) // len(names))
    write_onnx(model, tmp_path / "part.onnx")
    with torch.no_grad():
        images = model.encoder(*some_clouds(1), 1)
        want = by_name(model, model.maps_of(images))
    assert_same_maps(maps_of_onnx(tmp_path / "part.onnx", images), want)


def test_the_onnx_file_is_standard_and_folded(exported: Path, shipped: HVNet) -> None:
    onnx = pytest.importorskip("onnx")
    model = onnx.load(exported / "backbone_heads.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert {node.domain for node in model.graph.node} == {""}
    kinds = [node.op_type for node in model.graph.node]
    assert "BatchNormalization" not in kinds
    meta = json.loads((exported / "meta.json").read_text())
    # blocks, the FFPN without the level that no class has, the branches of three heads
    branches = 3 * len(meta["classes"][0]["outputs"])
    assert kinds.count("Conv") == (3 + 5 + 5) + (3 + 2) + branches
    for image, given in zip(meta["images"], model.graph.input, strict=True):
        batch, *shape = given.type.tensor_type.shape.dim
        assert given.name == image["name"]
        assert batch.dim_param == "batch"
        assert [axis.dim_value for axis in shape] == [image["channels"], *image["cells"]]
    names = [name for entry in meta["classes"] for name in entry["outputs"].values()]
    assert names == [output.name for output in model.graph.output] == map_names(shipped.config)


def test_the_program_in_a_fresh_process(exported: Path, shipped: HVNet, scenes: Path, tmp_path: Path) -> None:
    """Clouds of other lengths than the one that it was traced with."""
    whole = scene(scenes, 1)[0]
    given = [whole, whole[::7].clone(), whole[whole[:, 0] > 3][:2].clone()]
    assert len(given[2]) == 2
    torch.save(given, tmp_path / "clouds.pt")
    code = (
        "import sys, torch, hvnet.network.encoder\n"
        "program, clouds, maps = sys.argv[1:]\n"
        "run = torch.export.load(program).module()\n"
        "given = torch.load(clouds)\n"
        "torch.save([run(each, torch.zeros(len(each), dtype=torch.int64)) for each in given], maps)\n"
    )
    files = [exported / "detector.pt2", tmp_path / "clouds.pt", tmp_path / "maps.pt"]
    subprocess.run([sys.executable, "-c", code, *map(str, files)], cwd=ROOT, check=True)
    for points, found in zip(given, torch.load(tmp_path / "maps.pt"), strict=True):
        with torch.no_grad():
            want = by_name(shipped, shipped.maps(points, torch.zeros(len(points), dtype=torch.int64), 1))
        assert not any(value.requires_grad for value in found.values())
        assert_same_maps(found, want)


def test_what_is_written(exported: Path) -> None:
    names = {"meta.json", "detector.onnx", "backbone_heads.onnx", "detector.pt2"}
    assert {path.name for path in exported.iterdir()} == names


def test_no_file_names_this_machine(exported: Path) -> None:
    assert zipfile.is_zipfile(exported / "detector.pt2")
    with zipfile.ZipFile(exported / "detector.pt2") as archive:
        contents = [archive.read(name) for name in archive.namelist()]
    assert any(b"hvnet.voxel_index" in content for content in contents)
    for content in (*contents, *(path.read_bytes() for path in exported.iterdir())):
        assert str(ROOT).encode() not in content
        assert str(exported).encode() not in content


def test_the_program_wants_two_points(exported: Path) -> None:
    program = torch.export.load(exported / "detector.pt2").module()
    for count in (0, 1):
        points = torch.tensor([[5.0, 0.0, -1.0, 0.5], [-5.0, 0.0, -1.0, 0.5]])[:count]
        with pytest.raises(RuntimeError, match=">= 2"):
            program(points, torch.zeros(count, dtype=torch.int64))


def test_a_program_for_two_clouds_and_scales_that_do_not_nest(tmp_path: Path) -> None:
    model = lively(load_config(DEMO, [*SMALL, "encoder.feature_scales=[0.5, 0.75, 2]", "encoder.vfe=plain"]))
    write_program(model, tmp_path / "detector.pt2", 2)
    assert all(weight.requires_grad for weight in model.parameters())
    program = torch.export.load(tmp_path / "detector.pt2").module()
    points, sample = some_clouds(2, 650)
    with torch.no_grad():
        want = by_name(model, model.maps(points, sample, 2))
    assert_same_maps(program(points, sample), want)


@pytest.mark.parametrize("name", ["compact", "demo", "hvnet", "standard"])
def test_the_layout_of_the_anchors(name: str) -> None:
    """meta.json is enough to make them."""
    config = load_config(ROOT / "configs" / f"{name}.yaml")
    for entry, described in zip(
        config.head.classes, json.loads(json.dumps(describe(config, 1)))["classes"], strict=True
    ):
        (cells_x, cells_y), (cell_x, cell_y), (x_min, y_min) = (described[key] for key in ("cells", "cell", "origin"))
        x = x_min + (torch.arange(cells_x, dtype=torch.float64) + 0.5) * cell_x
        y = y_min + (torch.arange(cells_y, dtype=torch.float64) + 0.5) * cell_y
        sizes = torch.tensor(described["anchor_sizes"], dtype=torch.float64)
        yaws = torch.tensor(described["anchor_yaws"], dtype=torch.float64)
        x, y, k, yaw = torch.cartesian_prod(x, y, torch.arange(len(sizes), dtype=torch.float64), yaws).unbind(1)
        z = torch.full_like(x, described["anchor_z"])
        anchors = torch.column_stack((x, y, z, sizes[k.long()], yaw)).float()
        assert torch.equal(anchors, make_anchors(config, entry))


@pytest.mark.parametrize("change", ["encoder.point_limit=1", "encoder.vfe=pillar"])
def test_a_config_that_drops_points(change: str, tmp_path: Path) -> None:
    """It says so before it writes anything, and writes what comes after the encoder."""
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")
    pillars = [
        "encoder.point_limit=9",
        "encoder.voxel_limit=99",
        "encoder.feature_scales=[1]",
        "encoder.projection_scales=[1]",
    ]
    changes = [change, *(pillars if change.endswith("pillar") else [])]
    save_untrained(tmp_path / "checkpoint.pt", [*SMALL, *changes])
    given = ["--checkpoint", str(tmp_path / "checkpoint.pt"), "--out", str(tmp_path / "out")]
    with pytest.raises(InputError, match=rf"checkpoint\.pt: .*{change.replace('=', ': ')}.*--without-encoder"):
        main(given)
    assert not (tmp_path / "out").exists()
    main([*given, "--without-encoder"])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"backbone_heads.onnx", "meta.json"}


def examples() -> list[str]:
    """The Python examples of the document."""
    text = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8")
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)


def test_the_documents_examples(
    exported: Path, shipped: HVNet, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """They run as they stand and find what the detector finds."""
    pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: pip install '.[test]'")
    points = scene(scenes, 1)[0]
    points.numpy().astype(np.float32).tofile(tmp_path / "cloud.bin")
    (tmp_path / "export").symlink_to(exported)
    monkeypatch.chdir(tmp_path)
    scope: dict[str, Any] = {}
    with_onnx, with_program = examples()
    exec(compile(with_onnx, "docs/deploy.md", "exec"), scope)
    want = hvnet.load(device="cpu", dtype=torch.float32)(points)
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == len(want.boxes) > 3
    for line, label, score in zip(printed, want.labels, want.scores, strict=True):
        assert line.startswith(f"{CLASSES[label]} {score:.2f} ")
    exec(compile(with_program, "docs/deploy.md", "exec"), scope)
    assert scope["maps"].keys() == set(map_names(shipped.config))


def test_the_program_in_cpp(exported: Path, scenes: Path, tmp_path: Path) -> None:
    """It is short, is built without a warning and prints what the detector finds."""
    text = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```cpp\n(.*?)```", text, re.DOTALL)
    assert program.count("\n") < 150
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is not installed: pip install '.[test]'")
    headers = Path("/usr/include/onnxruntime")
    libraries = sorted(Path(onnxruntime.__file__).parent.glob("capi/libonnxruntime.so.1.*"))
    if shutil.which("g++") is None or not (headers / "onnxruntime_cxx_api.h").is_file() or not libraries:
        pytest.skip(
            "no g++, or neither headers nor library of onnxruntime: Debian's libonnxruntime-dev has the headers"
        )
    (tmp_path / "detect.cpp").write_text(program)
    (tmp_path / "libonnxruntime.so.1").symlink_to(libraries[0])
    build = ["g++", "-std=c++17", "-Wall", "-Wextra", "-Werror", "detect.cpp", f"-I{headers}", "libonnxruntime.so.1"]
    subprocess.run([*build, "-Wl,-rpath,$ORIGIN", "-o", "detect"], cwd=tmp_path, check=True)
    points = scene(scenes, 1)[0]
    points.numpy().astype(np.float32).tofile(tmp_path / "cloud.bin")
    call = ["./detect", str(exported / "detector.onnx"), "cloud.bin"]
    lines = subprocess.run(call, cwd=tmp_path, check=True, capture_output=True, text=True).stdout.splitlines()
    want = hvnet.load(device="cpu", dtype=torch.float32)(points)
    assert len(lines) == len(want.boxes) > 3
    for line, label, box in zip(lines, want.labels, want.boxes, strict=True):
        name, _, *values = line.split()
        assert name == CLASSES[label]
        torch.testing.assert_close(torch.tensor([float(value) for value in values]), box, rtol=0, atol=0.006)


def test_a_full_disk_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnx", reason="onnx is not installed: pip install '.[test]'")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("hvnet.export.write_onnx", full)
    with pytest.raises(InputError, match=rf"{tmp_path}/out: cannot be written \(No space left on device\); make room"):
        main(["--out", str(tmp_path / "out"), "--without-encoder"])
    assert not list((tmp_path / "out").iterdir())


def test_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"--batch 0: want 1 or more"):
        main(["--batch", "0"])
    with pytest.raises(InputError, match=r"--batch 4: is of detector\.pt2"):
        main(["--batch", "4", "--without-encoder"])
    with pytest.raises(InputError, match=r"--without-nms: .*leave one of them out"):
        main(["--without-nms", "--without-encoder"])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install onnx"):
        main(["--out", str(tmp_path / "out")])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    (tmp_path / "file").write_text("")
    for out in (tmp_path, tmp_path / "file"):
        with pytest.raises(InputError, match=f"{out}: is not empty"):
            main(["--out", str(out)])
    with pytest.raises(InputError, match=r"none\.pt: no such checkpoint"):
        main(["--checkpoint", str(tmp_path / "none.pt"), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
