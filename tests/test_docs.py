"""Every `python -m hvnet` of the README and of docs/ is run: on generated scenes in the place of KITTI, and shortened.

The benchmarks are run by test_bench.py, torchrun by test_ranks.py, the Python of docs/deploy.md by test_export.py, the
installation by .ci/run. Not run: trtexec (docs/deploy.md) and how pictures are made smaller (docs/pictures.md).
"""

import importlib
import importlib.util
import json
import re
import shlex
import shutil
from base64 import b64decode
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hvnet import detect, figures, mistakes, train
from hvnet.config import config_to_dict, load_config
from hvnet.data.kitti import read_frame, read_labels, read_split
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import save_checkpoint
from hvnet.network.model import HVNet
from hvnet.studies.catalogue import STUDIES
from tests.helpers import ROOT
from tests.models import QUICK, SMALL

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMAND = re.compile(r"^(?:pip install [^&]*&& |/usr/bin/time .*? )?python -m hvnet\.(\S+)(.*?)(?:\s+#.*)?$")
SETTINGS = [part for each in (*SMALL, *QUICK) for part in ("--set", each)]
ONCE = ["train.epochs=1", "train.repeat=1", "train.workers=0", "train.pictures=0", "train.warmup_steps=0"]


def commands() -> list[tuple[str, str, str]]:
    """Page, module and arguments of every command in a block of code or in the text."""

    def found() -> Iterator[tuple[str, str, str]]:
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            blocks = re.findall(r"^```\w*\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
            lines = [line for block in blocks for line in re.sub(r" *\\\n *", " ", block).splitlines()]
            lines += [code.replace("\n", " ") for code in re.findall(r"`(python -m hvnet\.[^`]+ [^`]+)`", text)]
            for line in lines:
                match = COMMAND.match(line)
                if match and "NAME" not in line:
                    yield page.name, match[1], match[2].strip()

    return list(dict.fromkeys(found()))


@pytest.fixture(scope="module")
def place(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that holds what the commands name."""
    folder = tmp_path_factory.mktemp("docs")
    for name in ("KITTI", "DIR", "scenes", "mine"):
        shutil.copytree(scenes, folder / name)
    for name in ("configs", "hvnet"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "clouds").mkdir()
    cloud = scenes / "training" / "velodyne" / f"{read_split(scenes, 'val')[0]}.bin"
    shutil.copy(cloud, folder / "cloud.bin")
    shutil.copy(cloud, folder / "clouds")
    points = "\n".join("1 2 -1 0.5" for _ in range(20))
    fields = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 20\nHEIGHT 1\n"
    (folder / "cloud.pcd").write_text(f"{fields}POINTS 20\nDATA ascii\n{points}\n")
    config = load_config(ROOT / "configs" / "demo.yaml", SMALL)
    content = {"config": config_to_dict(config), "model": HVNet(config).state_dict()}
    for name in ("model.pt", "with.pt", "without.pt"):
        save_checkpoint(folder / name, content)
    for run, name in (
        ("demo", "demo"),
        ("compact", "compact"),
        ("hvnet", "hvnet"),
        ("mine", "compact"),
        ("with", "demo"),
        ("without", "demo"),
    ):
        given = ["--config", str(ROOT / "configs" / f"{name}.yaml"), "--data", str(folder / "KITTI")]
        once = [part for each in ONCE for part in ("--set", each)]
        train.main([*given, "--out", str(folder / "runs" / run), "--device", "cpu", *SETTINGS, *once])
    labels = folder / "KITTI" / "training" / "label_2"
    ids = read_split(scenes, "train") + read_split(scenes, "val")
    for name in ("results", "label_2", "labels", "point_gnn_car", "detections/results", "val/results", "other/results"):
        (folder / name).mkdir(parents=True)
        for at in ids:
            lines = (labels / f"{at}.txt").read_text().splitlines()
            scored = name.endswith(("results", "car"))
            kept = [f"{line} 0.9" if scored else line for line in lines if not scored or "DontCare" not in line]
            (folder / name / f"{at}.txt").write_text("".join(f"{line}\n" for line in kept))
    (folder / "KITTI" / "drives.csv").write_text("frame,drive\n" + "".join(f"{at},{int(at) % 2}\n" for at in ids))
    (folder / "val.txt").write_text("".join(f"{at}\n" for at in ids[-2:]))
    return folder


def shortened(module: str, arguments: list[str], out: str) -> list[str]:
    """The arguments, followed by those that make the command small: the last of an option counts."""
    if module == "train":
        once = [part for each in ONCE for part in ("--set", each)]
        return [*arguments, *([] if "--resume" in arguments else ["--out", out]), *SETTINGS, *once]
    if module == "study":
        once = [] if "speed" in arguments else ["--budget", "steps=1", "--seeds", "1"]
        once += ["--rows", STUDIES[arguments[0]].rows[0].name] if arguments[0] in STUDIES else []
        return [*arguments, *SETTINGS, "--set", "train.workers=0", *once, "--out", out]
    if module == "data.synthetic":
        return [*arguments, "--train", "1", "--val", "1", "--out", out]
    if module in ("detect", "figures", "export"):
        return [*arguments, "--out", out]
    if module == "data.database":
        return [*arguments, "--out", f"{out}.npz"]
    if module == "mistakes" and "--help" not in arguments:
        return [*arguments, "--count", "3"]
    return arguments


@pytest.mark.parametrize(("page", "module", "given"), commands())
def test_command(
    page: str, module: str, given: str, place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs = {"view": "viser", "export": "onnx"}.get(module)
    if needs and importlib.util.find_spec(needs) is None:
        pytest.skip(f"{needs} is not installed")
    monkeypatch.chdir(place)
    arguments = shortened(
        module, shlex.split(given.replace("/data/kitti", "KITTI").replace("RUN", "runs/demo")), str(tmp_path / "out")
    )
    main = importlib.import_module("hvnet.weights.__main__" if module == "weights" else f"hvnet.{module}").main
    if "--help" in arguments:
        with pytest.raises(SystemExit):
            main(arguments)
    elif module == "weights":  # 44 minutes: it asks for the objects of all frames first
        (place / "DIR" / "gt_database.npz").unlink(missing_ok=True)
        with pytest.raises(InputError, match="gt_database"):
            main(arguments)
    elif "--split test" in given:  # nor has this folder all 7518 frames of the test set
        arguments[arguments.index("--checkpoint") + 1] = "model.pt"
        with pytest.raises(InputError, match=r"7518|the KITTI server wants|testing"):
            main(arguments)
    elif module == "view":

        def interrupt(_: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("hvnet.pictures.viewer.Viewer.search", interrupt)  # the last but to wait for Ctrl-C
        with pytest.raises(KeyboardInterrupt):
            main([*arguments, "--port", "8790"])
    else:
        main(arguments)


def test_own_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The worked example of docs/own_data.md: the folder that it writes holds what it was given, trains and is scored,
    all round and without a camera."""
    monkeypatch.chdir(tmp_path)
    points = np.random.default_rng(0).uniform((-12, -12, -2, 0), (12, 12, 1, 1), (500, 4))
    boxes = np.array([[10.0, 1.0, -1.0, 4.0, 1.6, 1.5, 0.3], [-9.0, -3.0, -0.9, 0.8, 0.7, 1.7, -2.0]])
    text = (ROOT / "docs" / "own_data.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)
    exec(code, {"my_frames": [(points, boxes, ["Car", "Pedestrian"])] * 5})
    frame = read_frame(Path("mine"), "000004")
    assert frame.objects is not None
    np.testing.assert_allclose(frame.objects.boxes.numpy(), boxes, atol=0.01)
    assert frame.objects.names == ("Car", "Pedestrian")
    assert len(frame.points) == 500
    assert (len(read_split(Path("mine"), "train")), len(read_split(Path("mine"), "val"))) == (4, 1)
    given = ["--config", str(ROOT / "configs" / "compact.yaml"), "--data", "mine", "--out", "run", "--device", "cpu"]
    changes = [*ONCE, "train.pictures=1", "encoder.point_range=[-12.8, -12.8, -3, 12.8, 12.8, 2]"]
    train.main([*given, *SETTINGS, *(part for each in changes for part in ("--set", each))])
    scored = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])["validation"]
    assert scored["Car"]["exact"]["bev"][1] is not None
    mistakes.main(["run", "--device", "cpu", "--min-score", "0"])
    page = (tmp_path / "run" / "mistakes.html").read_text()
    assert "9.5 m away" in page  # the pedestrian behind
    with Image.open(BytesIO(b64decode(re.findall(r'class="crop".*?base64,([^"]+)"', page)[0]))) as crop:
        assert crop.width == pytest.approx(crop.height, rel=0.1)  # from above alone
    (far,) = re.findall(r'--set "(encoder\.point_range=.*?)"', text)
    assert load_config(ROOT / "configs" / "compact.yaml", [far]).encoder.point_range[0] < 0
    given = ["--checkpoint", "run/checkpoint.pt", "--device", "cpu"]
    capsys.readouterr()
    detect.main(["mine", "--split", "val", *given])
    printed = capsys.readouterr().out
    assert re.search(r"^\d+ boxes in 1 cloud$", printed, flags=re.MULTILINE)
    assert "mine/training: has no calib, so no camera: every point counts, and there are no 2D boxes" in printed
    found = read_labels(tmp_path / "detections" / "results" / "000004.txt", scored=True)
    assert (found.location[:, 2] < 0).any()  # behind
    assert (found.bbox == -1).all()
    figures.main(["mine", "--split", "val", *given])
    assert (tmp_path / "figures" / "000004.png").is_file()


def test_pages_are_read() -> None:
    found = commands()
    assert {page for page, _, _ in found} >= {"README.md", "training.md", "evaluation.md"}
    assert len(found) > 30


def test_links_lead_somewhere() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
