"""The command that scores result files: its outputs, its classes, and its mistakes."""

import csv
import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvnet.data.kitti import boxes_to_labels, write_labels, write_points
from hvnet.evaluate import main
from hvnet.evaluation.rules import KITTI
from hvnet.exceptions import InputError
from tests.helpers import LINE, ROOT, write_folders


@pytest.fixture
def folders(tmp_path: Path) -> list[str]:
    """Two frames with one car each, found in both; the command's arguments."""
    labels, results = write_folders(tmp_path)
    return ["--labels", str(labels), "--predictions", str(results)]


def test_command_writes_figures_curves_and_picture(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    outputs = [tmp_path / name for name in ("a.json", "a.csv", "a.png")]
    arguments = zip(("--json", "--csv", "--plot"), map(str, outputs), strict=True)
    main([*folders, *(text for pair in arguments for text in pair)])
    printed = capsys.readouterr().out
    assert "2 frames scored" in printed
    assert "not scored" not in printed
    assert "no detections; ground truths: 0 easy, 0 moderate, 0 hard" in printed
    assert max(map(len, printed.splitlines())) <= 100
    figures = json.loads(outputs[0].read_text())
    assert list(figures) == list(KITTI)
    assert figures["Car"]["exact"]["aos"] == [100, 100, 100]
    assert figures["Car"]["counts"] == {"ground_truths": [2, 2, 2], "detections": 2, "frames": 2}
    assert figures["Cyclist"]["R40"]["3d"] == [None, None, None]
    with open(outputs[1]) as file:
        curve = [row for row in csv.DictReader(file) if (row["metric"], row["overlap"]) == ("3d", "0.7")]
    assert [(row["level"], row["score"], row["recall"], row["precision"]) for row in curve] == [
        (level, "0.75", "1", "1") for level in ("easy", "moderate", "hard")
    ]
    assert outputs[2].read_bytes().startswith(b"\x89PNG")


def test_frame_without_result_file(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "results" / "000007.txt").unlink()
    with pytest.raises(InputError, match=r"no result file for 1 of 2 frames, the first is 000007\.txt.*--frames"):
        main(folders)
    main([*folders, "--missing-as-empty"])
    assert "2 frames scored, 1 of them without a result file, counted as empty\n" in capsys.readouterr().out
    frames = tmp_path / "frames.txt"
    frames.write_text("000003\n\n")
    main([*folders, "--frames", str(frames)])
    assert "1 frame scored\n" in capsys.readouterr().out


def test_files_with_a_suffix_in_capitals_are_there(folders: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    path = Path(folders[3]) / "000007.txt"
    path.rename(path.with_suffix(".TXT"))
    main(folders)
    assert "2 frames scored\n" in capsys.readouterr().out


def test_no_result_file_at_all(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    given = [*folders[:2], "--predictions", str(tmp_path / "empty"), "--missing-as-empty"]
    outputs = ["--csv", str(tmp_path / "a.csv"), "--plot", str(tmp_path / "a.png")]
    assert scored([*given, *outputs], tmp_path)["Car"]["counts"]["ground_truths"] == [2] * 3
    printed = capsys.readouterr().out
    assert "Car: no detections; ground truths: 2 easy, 2 moderate, 2 hard\n" in printed
    assert "2 frames scored, 2 of them without a result file, counted as empty\n" in printed
    given[3] = str(tmp_path / "none")
    with pytest.raises(InputError, match="none: no such folder"):
        main(given)


@pytest.mark.parametrize("levels", [[], ["--no-2d-filter"], ["--distance-bands", "0-50"]])
@pytest.mark.parametrize("side", ["label_2", "results"])
def test_results_in_other_axes(folders: list[str], tmp_path: Path, side: str, levels: list[str]) -> None:
    """Of bare clouds, without 2D boxes, against KITTI's labels: refused, unless the axes are said to be the same."""
    for path in (tmp_path / side).iterdir():
        path.write_text(path.read_text().replace("100.00 100.00 160.00 150.00", "-1 -1 -1 -1"))
    names = re.escape(str(tmp_path / "label_2")), re.escape(str(tmp_path / "results"))
    camera, bare = names if side == "results" else names[::-1]
    with pytest.raises(InputError, match=f"^{camera} has 2D boxes.*; {bare} has none.*--same-axes$"):
        main([*folders, *levels])
    car = scored([*folders, "--same-axes", *levels], tmp_path)["Car"]
    assert list(car["exact"]) == ["bev", "3d"]
    kind = "detection" if side == "results" else "label"
    assert f"2d and aos are left out: no {kind} of Car has a 2D box" in car["warnings"]


def test_labels_with_2d_boxes_alone(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (tmp_path / "label_2").iterdir():
        path.write_text(path.read_text().replace("1.50 2.00 4.00 1.00 1.60 20.00", "-1 -1 -1 -1000 -1000 -1000"))
    outputs = ["--csv", str(tmp_path / "a.csv"), "--plot", str(tmp_path / "a.png")]
    car = scored([*folders, "--classes", "Car", *outputs], tmp_path)["Car"]
    assert car["exact"] == {"2d": [100] * 3, "aos": [100] * 3}
    assert "! bev and 3d are left out: no label of Car has a 3D box\n" in capsys.readouterr().out


def test_a_dash_has_its_reason(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (tmp_path / "label_2").iterdir():
        path.write_text(path.read_text().replace("Car 0.00 0", "Car 0.00 3"))
    main(folders)
    printed = capsys.readouterr().out
    assert "! 2 labels of Car count at no level: occlusion 3\n" in printed
    assert "ground truths: 0 easy, 0 moderate, 0 hard\n! there is no label of Cyclist\n" in printed


@pytest.mark.parametrize(
    ("name", "line", "message"),
    [
        ("000007.txt", f"{LINE} 0.5\n{LINE} nan\n", r"000007\.txt:2: field 16 is 'nan'"),
        ("000009.txt", "", r"results/000009\.txt: frame 000009 has no label file"),
        ("3.txt", "", r"results/3\.txt: the same frame as .*000003\.txt"),
    ],
)
def test_mistakes_in_files(folders: list[str], tmp_path: Path, name: str, line: str, message: str) -> None:
    (tmp_path / "results" / name).write_text(line)
    with pytest.raises(InputError, match=message):
        main(folders)


def test_points_without_a_camera(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """No calib beside the clouds: there is no camera, unless labels have 2D boxes."""
    boxes = np.array([[10.0, 1.0, -1.0, 4.0, 1.6, 1.5, 0.3], [-9.0, -3.0, -1.0, 4.0, 1.6, 1.5, 0.0]])
    root = tmp_path / "lidar"
    for name in ("velodyne", "label_2", "results"):
        (root / name).mkdir(parents=True)
    labels = boxes_to_labels(boxes, ["Car", "Car"])
    write_labels(root / "label_2" / "000000.txt", labels)
    write_labels(root / "results" / "000000.txt", dataclasses.replace(labels, score=np.array([0.9, 0.8])))
    write_points(root / "velodyne" / "000000.bin", np.array([[-9, -3, -1, 0]] * 20, dtype=np.float32))
    given = ["--labels", str(root / "label_2"), "--predictions", str(root / "results"), "--classes", "Car"]
    main([*given, "--clouds", str(root)])
    printed = capsys.readouterr().out
    for points in ("0-9 points", "10-49"):
        assert re.search(rf"{points}( +100\.0 of 1){{3}}$", printed, flags=re.MULTILINE)
    for name in ("000003", "000007"):
        shutil.copy(root / "velodyne" / "000000.bin", root / "velodyne" / f"{name}.bin")
    with pytest.raises(InputError, match=r"lidar.calib: no such folder, but the labels of frame \d+ have 2D boxes"):
        main([*folders, "--clouds", str(root)])


def test_wrong_folders_and_outputs(folders: list[str], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        main(["--labels", str(tmp_path / "none"), *folders[2:]])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no \.txt file"):
        main([*folders[:2], "--predictions", str(tmp_path / "empty")])
    with pytest.raises(InputError, match=r"curve\.gif: not the name of a picture"):
        main([*folders, "--plot", "curve.gif"])
    with pytest.raises(InputError, match="--score nan: want a finite number"):
        main([*folders, "--score", "nan"])
    with pytest.raises(InputError, match="cannot be written"):
        main([*folders, "--json", str(tmp_path / "none" / "a.json")])
    with pytest.raises(SystemExit):
        main([*folders, "--distance-bands", "40-20"])


def write_objects(root: Path, labels: list[str], results: list[str]) -> None:
    """Objects of these classes in frame 000003, apart from each other, in place of its car."""
    for folder, names, ending in (("label_2", labels, ""), ("results", results, " 0.75")):
        lines = [LINE.replace("Car", name).replace("20.00", f"{10 + 9 * k}") for k, name in enumerate(names)]
        (root / folder / "000003.txt").write_text("".join(f"{line}{ending}\n" for line in lines))


def scored(arguments: list[str], tmp_path: Path) -> dict[str, Any]:
    main([*arguments, "--json", str(tmp_path / "out.json")])
    return json.loads((tmp_path / "out.json").read_text())


def test_classes_that_are_scored_by_default(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """KITTI's three and every class that KITTI does not know, of labels and of results; the rest is counted."""
    write_objects(tmp_path, ["Van", "Van", "bicycle", "Tram", "DontCare"], ["Truck", "lorry_2", "bicycle"])
    assert list(scored(folders, tmp_path)) == [*KITTI, "bicycle", "lorry_2"]
    printed = capsys.readouterr().out
    assert printed.count("labels of classes that are not scored: 2 Van, 1 Tram\n") == 1
    assert printed.count("results of classes that are not scored: 1 Truck\n") == 1


def test_labels_of_unknown_classes_alone(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without one of KITTI's three, all that there is is scored, by size."""
    frames = tmp_path / "frames.txt"
    frames.write_text("000003\n")
    given = [*folders, "--frames", str(frames)]
    write_objects(tmp_path, ["excavator", "Van", "DontCare"], ["excavator"])
    found = scored(given, tmp_path)
    assert list(found) == ["Van", "excavator"]
    assert found["excavator"]["overlaps"]["strict"]["bev"] == 0.7  # it is 4 m long
    assert found["excavator"]["exact"]["3d"] == [100] * 3
    assert "not scored" not in capsys.readouterr().out
    write_objects(tmp_path, ["excavator", "van"], [])
    found = scored(given, tmp_path)
    assert [each["counts"]["ground_truths"] for each in found.values()] == [[1] * 3] * 2
    assert "excavator: no detections; ground truths: 1 easy, 1 moderate, 1 hard" in capsys.readouterr().out
    write_objects(tmp_path, ["DontCare"], [])  # nothing at all: KITTI's three, which are then told to be empty
    assert list(scored(given, tmp_path)) == list(KITTI)


def test_classes_and_overlaps_that_are_given(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_objects(tmp_path, ["Truck", "bicycle", "Car"], ["Truck", "bicycle", "bus"])
    given = [*folders, "--classes", "Truck", "bicycle", "--overlap", "Truck=0.5"]
    found = scored(given, tmp_path)
    assert list(found) == ["Truck", "bicycle"]
    assert found["Truck"]["overlaps"] == {
        "strict": {"2d": 0.5, "bev": 0.5, "3d": 0.5},
        "loose": {"2d": 0.5, "bev": 0.25, "3d": 0.25},
    }
    assert found["bicycle"]["overlaps"]["strict"]["3d"] == 0.7
    assert [each["exact"]["3d"] for each in found.values()] == [[100] * 3] * 2
    printed = capsys.readouterr().out
    assert "labels of classes that are not scored: 2 Car\n" in printed
    assert "results of classes that are not scored: 1 bus, 1 Car\n" in printed
    both = scored([*given, "--overlap", "bicycle=0.25"], tmp_path)
    assert [each["overlaps"]["strict"]["3d"] for each in both.values()] == [0.5, 0.25]


def test_names_that_count_as_a_class(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In labels and in results; the class is scored whether it is named or not."""
    write_objects(tmp_path, ["bicycle", "Cyclist", "Van"], ["Cyclist", "bicycle", "truck"])
    for given in (["bicycle=Cyclist"], ["Cyclist", "bicycle=Cyclist"], ["bicycle=Cyclist,truck=Cyclist", "Cyclist"]):
        found = scored([*folders, "--classes", *given], tmp_path)
        assert list(found) == (["Cyclist"] if len(given) > 1 else [*KITTI, "truck"])  # a name alone chooses no class
        assert found["Cyclist"]["counts"]["ground_truths"] == [2] * 3
        assert found["Cyclist"]["counts"]["detections"] == 2 + ("," in given[0])
        assert found["Cyclist"]["exact"]["3d"] == ([100] * 3 if "," not in given[0] else pytest.approx([200 / 3] * 3))
    found = scored([*folders, "--classes", "Car", "Van=lorry", "truck=lorry", "--overlap", "lorry=0.5"], tmp_path)
    assert list(found) == ["Car", "lorry"]
    assert found["lorry"]["exact"]["3d"] == [100] * 3
    assert "labels of classes that are not scored: 1 bicycle, 1 Cyclist\n" in capsys.readouterr().out
    assert list(scored([*folders, "--classes", "Car", "Tram=Car"], tmp_path)) == ["Car"]  # KITTI's may be nowhere


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("=Car", "--classes =Car: want NAME=CLASS, such as bicycle=Cyclist"),
        ("bicycle=", "--classes bicycle=: want NAME=CLASS, such as bicycle=Cyclist"),
        ("a=b=c", "--classes a=b=c: want NAME=CLASS, such as bicycle=Cyclist"),
        ("a=b c", "--classes a=b c: want NAME=CLASS, such as bicycle=Cyclist"),
        ("a=b,a=c", "--classes a=c: a is given twice; leave one out"),
        ("DontCare=Car", "--classes DontCare=Car: DontCare is a region of the image, no class"),
        ("bycicle=Cyclist", "--classes bycicle=Cyclist: no label or result is named bycicle; there are Car, bicycle"),
    ],
)
def test_bad_names(folders: list[str], tmp_path: Path, given: str, message: str) -> None:
    write_objects(tmp_path, ["Car", "bicycle", "DontCare"], [])
    with pytest.raises(InputError, match=f"^{re.escape(message)}$"):
        main([*folders, "--classes", "Car", given])


def test_what_is_not_scored_is_said_within_100_columns(
    folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_objects(tmp_path, [f"kind_of_object_{k}" for k in range(20)], [])
    main([*folders, "--classes", "Car"])
    printed = capsys.readouterr().out
    assert "1 kind_of_object_19" in printed
    assert max(map(len, printed.splitlines())) <= 100


@pytest.mark.parametrize(
    "given", ["Car", "=0.5", "Car=", "Car=0", "Car=1.1", "Car=-1", "Car=nan", "Car=x", "Car=0.5=1"]
)
def test_bad_overlaps(folders: list[str], given: str) -> None:
    with pytest.raises(InputError) as caught:
        main([*folders, "--overlap", given])
    message = str(caught.value)
    assert message.startswith(f"--overlap {given}: ")
    assert "\n" not in message


def test_an_overlap_of_a_class_that_is_not_scored(folders: list[str]) -> None:
    with pytest.raises(InputError, match=r"^--overlap Truck=0\.5: no class Truck; there are Car, Pedestrian, Cyclist$"):
        main([*folders, "--overlap", "Truck=0.5"])


def test_classes_that_are_nowhere(folders: list[str], tmp_path: Path) -> None:
    write_objects(tmp_path, ["Car", "bicycle", "DontCare"], [])
    for name in ("Bicycle", "DontCare"):  # a region is no object
        message = f"^--classes {name}: no label or result is of this class; there are Car, bicycle$"
        with pytest.raises(InputError, match=message):
            main([*folders, "--classes", "Car", name])
    assert list(scored([*folders, "--classes", "Cyclist"], tmp_path)) == ["Cyclist"]  # KITTI's may be nowhere
    for folder in ("label_2", "results"):
        for path in (tmp_path / folder).iterdir():
            path.write_text("")
    with pytest.raises(InputError, match=r"^--classes Bus: no label or result is of this class; there are none$"):
        main([*folders, "--classes", "Bus"])


def test_a_mistake_is_one_line_of_the_command(folders: list[str]) -> None:
    arguments = [sys.executable, "-m", "hvnet.evaluate", *folders, "--overlap", "Car=2"]
    failed = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (failed.returncode, failed.stdout) == (2, "")
    assert failed.stderr == "error: --overlap Car=2: want CLASS=X with X above 0 and at most 1, such as Truck=0.5\n"


def test_intervals(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One car in each of two frames: found in both, and by other results in the first alone."""
    other = shutil.copytree(tmp_path / "results", tmp_path / "other")
    (other / "000007.txt").write_text("")
    arguments = [*folders, "--bootstrap", "200", "--against", str(other)]
    figures = scored(arguments, tmp_path)["Car"]
    printed = capsys.readouterr().out
    assert "[low, high]: 95 % of 200 resamples of 2 frames; 2, 2, 2 of them hold ground truths" in printed
    assert re.search(r"^bev 0\.70( +100\.00 \[100\.0, 100\.0\]){3}$", printed, flags=re.MULTILINE)
    assert re.search(r"^exact AP less that of .*other, in points \[95 % interval\]$", printed, flags=re.MULTILINE)
    assert re.search(r"^bev 0\.70( +\+50\.00 \[0\.0, 100\.0\]){3}$", printed, flags=re.MULTILINE)
    assert max(len(line) for line in printed.splitlines() if str(tmp_path) not in line) <= 100
    assert figures["bootstrap"]["intervals"]["exact"]["3d"] == [[100, 100]] * 3
    assert figures["bootstrap"]["intervals"]["loose"]["exact"]["bev"] == [[100, 100]] * 3
    assert figures["bootstrap"]["differences"]["strict"]["3d"] == [[50, 0, 100]] * 3
    assert (figures["bootstrap"]["resamples"], figures["bootstrap"]["groups"]) == (200, 2)
    main(arguments)
    assert capsys.readouterr().out == printed
    (tmp_path / "drives.csv").write_text("frame,drive\n000003,a\n000007,a\n")
    main([*arguments, "--groups", str(tmp_path / "drives.csv")])
    assert re.search(r"^bev 0\.70( +\+50\.00 \[50\.0, 50\.0\]){3}$", capsys.readouterr().out, flags=re.MULTILINE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--bootstrap", "99"], "--bootstrap 99: want 100 resamples or more"),
        (["--bootstrap", "100", "--seed", "-1"], "--seed -1: want 0 or more"),
        (["--groups", "drives.csv"], r"--groups drives\.csv: is for --bootstrap N; add it"),
        (["--against", "other"], "--against other: is for --bootstrap N; add it"),
        (["--bootstrap", "100", "--against", "other"], "other: no such folder"),
        (["--bootstrap", "100", "--groups", "none.csv"], r"^none\.csv: no such file; give a CSV file with the columns"),
        (["--bootstrap", "100", "--groups", "."], r"^\.: cannot be read \(Is a directory\)$"),
    ],
)
def test_bad_options_of_intervals(folders: list[str], options: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        main([*folders, *options])
