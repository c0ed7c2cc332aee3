"""Generated scenes as files: deterministic, in KITTI's layout, and nothing else is written over; and the command."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.data.kitti import boxes_to_lidar, read_frame, read_labels, read_split
from hvnet.data.labels import DONTCARE
from hvnet.data.scenes.files import CAMERA, generate, make_frame
from hvnet.data.scenes.street import Options
from hvnet.data.synthetic import main
from hvnet.exceptions import InputError
from tests.helpers import contents


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "kitti"
    generate(folder, 2, 1, seed=0)
    return folder


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not(root: Path, tmp_path: Path) -> None:
    generate(tmp_path / "again", 2, 1, seed=0)
    assert contents(tmp_path / "again") == contents(root)
    generate(tmp_path / "other", 1, 0, seed=1)
    cloud = "training/velodyne/000000.bin"
    assert contents(tmp_path / "other")[cloud] != contents(root)[cloud]


def test_a_frame_does_not_depend_on_the_number_of_frames(root: Path) -> None:
    _, measured, _ = make_frame(0, 2, Options())
    assert measured.points.tobytes() == (root / "training" / "velodyne" / "000002.bin").read_bytes()


def test_the_kitti_reader_reads_what_was_made(root: Path) -> None:
    assert read_split(root, "train") == ["000000", "000001"]
    assert read_split(root, "val") == ["000002"]
    scene, measured, labels = make_frame(0, 0, Options())
    frame = read_frame(root, "000000")
    assert frame.points.equal(torch.from_numpy(measured.points[CAMERA.sees(measured.points)]))
    assert frame.objects is not None
    assert frame.objects.names == tuple(labels.name[labels.name != DONTCARE].tolist())
    # label files hold two decimals
    nearest = np.linalg.norm(frame.objects.boxes[:, None, :6].numpy() - scene.boxes[None, :, :6], axis=2).min(axis=1)
    assert len(nearest)
    assert nearest.max() < 0.02


def test_a_complete_folder_is_left_as_it_is_and_a_partial_one_completed(root: Path, tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    generate(root, 2, 1, seed=0)
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before

    generate(tmp_path, 2, 1, seed=0)
    meta = json.loads((tmp_path / "meta.json").read_text())
    (tmp_path / "meta.json").write_text(json.dumps(meta | {"complete": False}))
    (tmp_path / "training" / "label_2" / "000001.txt").unlink()
    generate(tmp_path, 2, 1, seed=0)
    assert contents(tmp_path) == contents(root)


def test_a_folder_of_something_else_is_refused_and_untouched(root: Path, tmp_path: Path) -> None:
    before = contents(root)
    with pytest.raises(InputError, match=r"other options.*meta\.json"):
        generate(root, 2, 1, seed=5)
    with pytest.raises(InputError, match="other options"):
        generate(root, 2, 1, seed=0, options=Options(cars=(1, 1)))
    assert contents(root) == before
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not empty"):
        generate(tmp_path, 1, 1, seed=0)
    with pytest.raises(InputError, match="not empty"):
        generate(tmp_path / "notes.txt", 1, 1, seed=0)
    assert contents(tmp_path) == {"notes.txt": b"mine"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (Options(azimuth=20), "azimuth 20"),
        (Options(distance=(10, 5)), "distance 10 to 5"),
        (Options(cars=(3, 1)), "cars 3 to 1"),
    ],
)
def test_impossible_options_are_refused(options: Options, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        generate(tmp_path / "out", 1, 1, seed=0, options=options)
    with pytest.raises(InputError, match="negative"):
        generate(tmp_path / "out", -1, 1, seed=0)
    assert not (tmp_path / "out").exists()


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--out", str(tmp_path), "--train", "1", "--val", "1", "--seed", "3", "--distance", "30"])
    assert "2 frames" in capsys.readouterr().out
    for frame_id in ("000000", "000001"):
        labels = read_labels(tmp_path / "training" / "label_2" / f"{frame_id}.txt")
        boxes = boxes_to_lidar(labels.select(labels.name != DONTCARE), CAMERA)
        assert (np.hypot(boxes[:, 0], boxes[:, 1]) < 30.1).all()
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
