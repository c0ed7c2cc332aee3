import csv
import dataclasses
import json
import math
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SHARED

from hvnet.boxes import box_corners
from hvnet.cli import InputError
from hvnet.data.kitti import Calibration, Labels, boxes_to_labels, read_labels, write_labels, write_points
from hvnet.evaluate import (
    CLASSES,
    LEVELS,
    LEVELS_WITHOUT_2D,
    MEASURES,
    count_points,
    distance_levels,
    evaluate,
    format_table,
    main,
    read_folders,
)


def rows(*lines: str, scored: bool = False) -> Labels:
    """Objects written as "class x z left height [key=value ...]": a 2D box 60 wide at the left edge given, a 3D box
    4 long, 2 wide and 1.5 high. Keys: score, alpha, ry, occ, trunc, right."""
    objects = []
    for line in lines:
        name, *fields = line.split()
        given = [float(field) for field in fields if "=" not in field]
        keys = {key: float(value) for key, value in (field.split("=") for field in fields if "=" in field)}
        objects.append((name, given, keys))

    def column(key: str, default: float = 0.0) -> np.ndarray:
        return np.array([keys.get(key, default) for _, _, keys in objects], np.float64)

    x, z, left, height = np.array([given for _, given, _ in objects], np.float64).reshape(-1, 4).T
    right = np.where(column("right") > 0, column("right"), left + 60)
    flat = np.array([name == "DontCare" for name, _, _ in objects], bool)[:, None]
    return Labels(
        name=np.array([name for name, _, _ in objects], np.str_),
        truncation=column("trunc"),
        occlusion=column("occ").astype(np.int64),
        alpha=column("alpha"),
        bbox=np.column_stack((left, np.full(len(left), 100.0), right, 100 + height)),
        dimensions=np.where(flat, -1, [1.5, 2, 4]),
        location=np.where(flat, -1000, np.column_stack((x, np.full(len(x), 1.6), z))),
        rotation_y=column("ry"),
        score=column("score", 0.5) if scored else None,
    )


def score_cars(truths: list[str], detections: list[str]) -> dict:
    result = evaluate([rows(*truths)], [rows(*detections, scored=True)], classes=["Car"], score_threshold=0)["Car"]
    return result


CAR = "Car 0 20 100 50"  # the one car of most frames below, 50 pixels high, at the columns 100 to 160


def test_one_car_found():
    # One ground truth gives one threshold, the first, at recall 0: R40, which leaves out recall 0, is 0, and R11 is a
    # sum of eleven precisions of which the first is 1: 100 / 11. All of it is found: exact 100.
    car = score_cars([CAR], [CAR])
    for metric in ("2d", "aos", "bev", "3d"):
        assert car["R40"][metric] == [0, 0, 0]
        assert car["R11"][metric] == pytest.approx([100 / 11] * 3)
        assert car["exact"][metric] == [100, 100, 100]
    assert car["counts"] == {"ground_truths": [1, 1, 1], "detections": 1, "frames": 1}
    assert car["report"]["misses"] == car["report"]["false_positives"] == [0, 0, 0]


def test_two_of_three_cars_found_with_a_false_positive_between():
    # Scores 0.9 right, 0.8 wrong, 0.7 right. Precision, recall: 1, 1/3; 1/2, 1/3; 2/3, 2/3.
    # exact = 1/3 * 1 + 1/3 * 2/3 = 5/9. Thresholds 0.9 and 0.7: R40 = (2/3) / 40, R11 = 1 / 11.
    truths = [CAR, "Car 10 20 300 50", "Car 20 20 500 50"]
    car = score_cars(truths, [CAR + " score=0.9", "Car -30 20 800 50 score=0.8", "Car 10 20 300 50 score=0.7"])
    for metric in ("2d", "bev", "3d"):
        assert car["exact"][metric] == pytest.approx([500 / 9] * 3)
        assert car["R40"][metric] == pytest.approx([200 / 3 / 40] * 3)
        assert car["R11"][metric] == pytest.approx([100 / 11] * 3)
    assert car["report"]["misses"] == [1, 1, 1]
    assert car["report"]["false_positives"] == [1, 1, 1]


def test_detection_on_a_van_is_neither_right_nor_wrong():
    # The better-scored detection lies on the other object. On a truck it is a false positive, so that the precision
    # is 1/2 where the car is found; on a van it counts for nothing.
    detections = [CAR + " score=0.5", "Car 10 20 300 50 score=0.9"]
    assert score_cars([CAR, "Van 10 20 300 50"], detections)["exact"]["3d"] == [100, 100, 100]
    assert score_cars([CAR, "Truck 10 20 300 50"], detections)["exact"]["3d"] == [50, 50, 50]


def test_pedestrian_on_a_person_sitting_is_neither_right_nor_wrong():
    # As with the van; a cyclist is no neighbour, so that there the precision is 1/2 where the pedestrian is found.
    truth = "Pedestrian 0 20 100 50"
    detections = [truth + " score=0.5", "Pedestrian 10 20 300 50 score=0.9"]
    for other, precision in (("Person_sitting", 100), ("Cyclist", 50)):
        truths = rows(truth, f"{other} 10 20 300 50")
        scored = evaluate([truths], [rows(*detections, scored=True)], classes=["Pedestrian"])["Pedestrian"]
        assert scored["exact"]["3d"] == [precision] * 3


def test_first_pass_matches_by_score_and_second_by_overlap():
    # Cars at 0 and 0.8 m. A at 0.4 m (score 0.9) overlaps both by 3.6 / 4.4 = 0.82; B at 0 m (score 0.8) is the first
    # car, and overlaps the second by 3.2 / 4.8 = 0.67 only. First pass: the first car takes A, nothing is left for the
    # second: one threshold, so that R40 is 0. By overlap there would be two: 1/40. Second pass with A and B: the first
    # car takes B, the second A: all is found, exact 100. By score there would be a miss and a false positive: 50.
    car = score_cars([CAR, "Car 0.8 20 112 50"], ["Car 0.4 20 106 50 score=0.9", CAR + " score=0.8"])
    for metric in ("2d", "bev", "3d"):
        assert car["R40"][metric] == [0, 0, 0]
        assert car["R11"][metric] == pytest.approx([100 / 11] * 3)
        assert car["exact"][metric] == [100, 100, 100]
    assert car["report"]["misses"] == car["report"]["false_positives"] == [0, 0, 0]


def test_detection_on_dontcare_counts_for_nothing_in_2d_only():
    # A region has no 3D box: in BEV and 3D the same detection is a false positive. It needs 0.7 of the detection's own
    # area in the region: of columns 300 to 360, 300 to 345 are enough (0.75), 300 to 340 are not (0.67).
    detections = [CAR + " score=0.5", "Car 10 20 300 50 score=0.9"]
    inside = score_cars([CAR, "DontCare 0 0 200 90 right=345"], detections)["exact"]
    assert (inside["2d"], inside["bev"], inside["3d"]) == ([100] * 3, [50] * 3, [50] * 3)
    assert score_cars([CAR, "DontCare 0 0 200 90 right=340"], detections)["exact"]["2d"] == [50] * 3


def test_second_detection_of_a_car_is_a_false_positive():
    # First alone, then with the second: precision 1, then 1/2, both at recall 1; the interpolated one is 1.
    car = score_cars([CAR], [CAR + " score=0.9", CAR + " score=0.8"])
    assert car["exact"]["3d"] == [100, 100, 100]
    assert car["report"]["false_positives"] == [1, 1, 1]


def test_tie_in_score():
    # Equal scores stand or fall together: one right and one wrong at the only threshold there is.
    car = score_cars([CAR], [CAR + " score=0.8", CAR + " score=0.8"])
    assert car["exact"]["3d"] == [50, 50, 50]
    assert car["R11"]["3d"] == pytest.approx([50 / 11] * 3)


@pytest.mark.parametrize(
    ("key", "counts"),
    [
        ("trunc=0.15", [1, 1, 1]),
        ("trunc=0.16", [0, 1, 1]),
        ("trunc=0.4", [0, 0, 1]),
        ("trunc=0.51", [0, 0, 0]),
        ("occ=1", [0, 1, 1]),
        ("occ=2", [0, 0, 1]),
        ("occ=3", [0, 0, 0]),
    ],
)
def test_truncated_and_occluded_cars(key: str, counts: list[int]):
    # Where the car does not count there is nothing to find, and finding it is no mistake.
    car = score_cars([f"{CAR} {key}"], [CAR])
    assert car["counts"]["ground_truths"] == counts
    assert car["exact"]["3d"] == [100.0 if count else None for count in counts]
    assert car["report"]["false_positives"] == [0, 0, 0]


@pytest.mark.parametrize(
    ("height", "counts"), [(41, [1, 1, 1]), (40, [0, 1, 1]), (39, [0, 1, 1]), (25, [0, 0, 0]), (25.5, [0, 1, 1])]
)
def test_height_of_a_ground_truth_is_above_the_minimum(height: float, counts: list[int]):
    assert score_cars([f"Car 0 20 100 {height}"], [])["counts"]["ground_truths"] == counts


@pytest.mark.parametrize(("height", "alarms"), [(40, [1, 1, 1]), (39.9, [0, 1, 1]), (25, [0, 1, 1]), (24.9, [0, 0, 0])])
def test_height_of_a_detection_is_at_least_the_minimum(height: float, alarms: list[int]):
    # A detection far from the one car is a false positive, unless it is too low; whole pixels count.
    report = score_cars([CAR], [CAR, f"Car 10 20 300 {height}"])["report"]
    assert report["false_positives"] == alarms


@pytest.mark.parametrize("name", ["Car", "Pedestrian"])
def test_low_detection_hides_a_ground_truth_whatever_its_class(name: str):
    # The devkit lets a detection under 40 pixels, of any class, take an easy car: the car is neither found nor missed.
    # From 25 pixels on, at moderate and hard, a Car finds it and a Pedestrian does not.
    car = score_cars([CAR], [f"{name} 0 20 100 39"])
    assert car["report"]["misses"] == ([0, 0, 0] if name == "Car" else [0, 1, 1])
    if name == "Car":
        assert car["exact"]["bev"] == [0, 100, 100]


def test_other_classes_are_left_out():
    # A pedestrian on the car, tall enough: the car is missed, and no Car is wrong.
    report = score_cars([CAR], ["Pedestrian 0 20 100 50", "Car 10 20 300 50"])["report"]
    assert report["misses"] == report["false_positives"] == [1, 1, 1]


def test_orientation_is_that_of_the_ground_truth_alpha():
    # One car found with alpha wrong by 60 degrees: (1 + cos 60) / 2 = 3/4. A false positive below it in score changes
    # nothing, one above halves precision and similarity.
    detection = f"{CAR} alpha={math.pi / 3} score=0.5"
    exact = score_cars([CAR], [detection, "Car 10 20 300 50 score=0.4"])["exact"]
    assert (exact["2d"][0], exact["aos"][0]) == (100, pytest.approx(75))
    exact = score_cars([CAR], [detection, "Car 10 20 300 50 score=0.6"])["exact"]
    assert (exact["2d"][0], exact["aos"][0]) == (50, pytest.approx(37.5))
    assert "aos" not in score_cars([CAR], [CAR + " alpha=-10"])["exact"]


def test_loose_overlaps():
    # A box moved by 0.8 of its 4 metres: 3.2 / 4.8 = 0.67 in BEV and 3D, found at 0.5 only.
    car = score_cars([CAR], ["Car 0.8 20 100 50"])
    assert (car["exact"]["bev"], car["loose"]["exact"]["bev"]) == ([0] * 3, [100] * 3)
    assert car["loose"]["exact"]["2d"] == car["exact"]["2d"] == [100] * 3


def crowd(count: int = 60, heading: float = 0.0, scored: bool = False) -> Labels:
    """As many objects of every class, apart from each other."""
    objects = [
        f"{name} {10 * k} {10 + 5 * row} {100 * k} 50 ry={0.1 * k + heading} alpha={0.1 * k + heading} score={k % 7}"
        for row, name in enumerate(CLASSES)
        for k in range(count)
    ]
    labels = rows(*objects, scored=scored)
    labels.bbox[:, [1, 3]] += 100 * np.repeat(np.arange(len(CLASSES)), count)[:, None]
    return labels


def test_ground_truth_as_prediction_is_perfect():
    for scored in evaluate([crowd(41)], [crowd(41, scored=True)]).values():
        for table in (scored, scored["loose"]):
            for measure in MEASURES:
                for metric in ("2d", "aos", "bev", "3d"):
                    assert table[measure][metric] == pytest.approx([100] * 3, abs=1e-9)
        assert scored["warnings"] == []


def test_headings_turned_by_pi_cost_orientation_alone():
    for scored in evaluate([crowd()], [crowd(heading=math.pi, scored=True)]).values():
        for measure in MEASURES:
            assert scored[measure]["aos"] == pytest.approx([0] * 3, abs=1e-9)
            for metric in ("2d", "bev", "3d"):
                assert scored[measure][metric] == pytest.approx([100] * 3, abs=1e-9)


def test_few_ground_truths_cap_r40_and_the_warning_says_where():
    scored = evaluate([crowd(9)], [crowd(9, scored=True)], classes=["Cyclist"])["Cyclist"]
    assert scored["R40"]["3d"] == pytest.approx([100 * 8 / 40] * 3)
    assert scored["R11"]["3d"] == pytest.approx([100 * 3 / 11] * 3)
    assert scored["warnings"][0] == "easy: 9 ground truths cap R40 at 20.00 and R11 at 27.27: read 'exact'"


def test_data_without_images():
    truths, detections = crowd(), crowd(scored=True)
    for labels in (truths, detections):
        labels.bbox[:] = 0
    car = evaluate([truths], [detections], levels=LEVELS)["Car"]
    assert car["exact"] == {"bev": [None] * 3, "3d": [None] * 3}
    assert "--no-2d-filter" in car["warnings"][0]
    car = evaluate([truths], [detections], levels=LEVELS_WITHOUT_2D)["Car"]
    assert car["R40"] == {"bev": [100] * 3, "3d": [100] * 3}
    assert car["warnings"] == []
    car = evaluate([truths], [detections])["Car"]  # these levels are the default where no label has a 2D box
    assert car["R40"] == {"bev": [100] * 3, "3d": [100] * 3}
    assert car["warnings"] == ["no label has a 2D box: the levels go by occlusion and truncation alone"]
    nothing = truths.select(np.zeros(0, np.int64))
    assert evaluate([nothing], [detections])["Car"]["report"]["false_positives"] == [len(truths) // 3] * 3


def test_some_labels_have_2d_boxes():
    """KITTI's levels, which count those alone, and a warning that says so."""
    truths, detections = crowd(), crowd(scored=True)
    for labels in (truths, detections):
        labels.bbox[:] = -1
    both = evaluate([truths, crowd()], [detections, crowd(scored=True)])["Car"]
    assert both["counts"]["ground_truths"] == evaluate([crowd()], [detections])["Car"]["counts"]["ground_truths"]
    count = both["counts"]["ground_truths"][0]
    (warning,) = both["warnings"]
    assert warning.startswith(f"{count} of {2 * count} labels have no 2D box, as these levels ask: see ")
    assert max(map(len, format_table({"Car": both}).splitlines())) <= 100


def test_distance_bands():
    # Cars at 10 and 30 m, the latter missed, and a false positive at 25 m, where nothing is.
    truths = rows("Car 0 10 100 5", "Car 0 30 300 5 occ=3 trunc=0.9")
    detections = rows("Car 0 10 100 5", "Car 10 22.9 500 5", scored=True)
    car = evaluate([truths], [detections], levels=distance_levels([(0, 20), (20, 40), (40, 60)]))["Car"]
    assert car["levels"] == ["0-20m", "20-40m", "40-60m"]
    assert car["exact"]["3d"] == [100, 0, None]
    assert car["report"]["misses"] == [0, 1, 0]
    assert car["report"]["false_positives"] == [0, 1, 0]


def test_report_by_distance_and_points():
    # Cars at 10, 30 and 50 m with 5, 20 and 300 points; the one at 30 m is missed.
    truths = rows("Car 0 10 100 50", "Car 0 30 300 50", "Car 0 50 500 50", "DontCare 0 0 900 50")
    detections = rows("Car 0 10 100 50 score=0.9", "Car 0 50 500 50 score=0.8", "Car 9 9 700 50 score=0.1", scored=True)
    points = [np.array([5, 20, 300, 0])]
    report = evaluate([truths], [detections], classes=["Car"], points=points)["Car"]["report"]
    assert (report["score_threshold"], report["chosen_by"]) == (0.8, "best F1")
    assert (report["misses"], report["false_positives"]) == ([1] * 3, [0] * 3)
    assert [row["recall"][0] for row in report["recall_by_distance"].values()] == [100, 0, 100]
    assert [row["recall"][0] for row in report["recall_by_points"].values()] == [100, 0, None, 100]
    assert [row["ground_truths"][0] for row in report["recall_by_points"].values()] == [1, 1, 0, 1]


def test_points_are_counted_in_camera_boxes():
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # LiDAR's x is the camera's z
    calib = Calibration(np.eye(3, 4), np.eye(3), np.column_stack((axes, np.zeros(3))))
    labels = rows("Car 3 20 0 50", "DontCare 0 0 0 50")
    centre = torch.tensor([[20.0, -3, -1.6 + 0.75, 2, 4, 1.5, 0]])  # 4 long across, as rotation_y is 0
    points = np.zeros((9, 4), np.float32)
    points[:8, :3] = 0.99 * (box_corners(centre)[0] - centre[0, :3]) + centre[0, :3]
    assert count_points(points, labels, calib).tolist() == [8, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], []), "at least one frame"),
        (([rows(CAR)], []), "one for each of the 1 labels, got 0"),
        (([rows(CAR)], [rows(CAR)]), "want a score"),
    ],
)
def test_wrong_arguments(arguments: tuple, message: str):
    with pytest.raises(ValueError, match=message):
        evaluate(*arguments)
    with pytest.raises(ValueError, match="got 'Tram'"):
        evaluate([rows(CAR)], [rows(CAR, scored=True)], classes=["Tram"])
    with pytest.raises(ValueError, match="points: want"):
        evaluate([rows(CAR)], [rows(CAR, scored=True)], points=[np.zeros(2, np.int64)])


LINE = "Car 0.00 0 0.10 100.00 100.00 160.00 150.00 1.50 2.00 4.00 1.00 1.60 20.00 0.10"


@pytest.fixture
def folders(tmp_path: Path) -> list[str]:
    """Two frames with one car each, found in both; the command's arguments."""
    for folder, ending in (("label_2", ""), ("results", " 0.75")):
        (tmp_path / folder).mkdir()
        for frame in ("000003", "000007"):
            (tmp_path / folder / f"{frame}.txt").write_text(LINE + ending + "\n")
    return ["--labels", str(tmp_path / "label_2"), "--predictions", str(tmp_path / "results")]


def test_command_writes_figures_curves_and_picture(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture):
    outputs = [tmp_path / name for name in ("a.json", "a.csv", "a.png")]
    arguments = zip(("--json", "--csv", "--plot"), map(str, outputs), strict=True)
    main([*folders, *(text for pair in arguments for text in pair)])
    printed = capsys.readouterr().out
    assert "2 frames scored" in printed
    assert "no detections; ground truths: 0 easy, 0 moderate, 0 hard" in printed
    assert max(map(len, printed.splitlines())) <= 100
    figures = json.loads(outputs[0].read_text())
    assert list(figures) == list(CLASSES)
    assert figures["Car"]["exact"]["aos"] == [100, 100, 100]
    assert figures["Car"]["counts"] == {"ground_truths": [2, 2, 2], "detections": 2, "frames": 2}
    assert figures["Cyclist"]["R40"]["3d"] == [None, None, None]
    with open(outputs[1]) as file:
        curve = [row for row in csv.DictReader(file) if (row["metric"], row["overlap"]) == ("3d", "0.7")]
    assert [(row["level"], row["score"], row["recall"], row["precision"]) for row in curve] == [
        (level, "0.75", "1", "1") for level in ("easy", "moderate", "hard")
    ]
    assert outputs[2].read_bytes().startswith(b"\x89PNG")


def test_table_is_at_most_100_columns_wide_and_aligned():
    result = evaluate([crowd()], [crowd(scored=True)], points=[np.arange(3 * 60)])
    four = evaluate([crowd()], [crowd(scored=True)], levels=distance_levels([(0, 20), (20, 40), (40, 80), (80, 999)]))
    for lines in (format_table(result).splitlines(), format_table(four).splitlines()):
        assert max(map(len, lines)) <= 100
        assert len({len(line) for line in lines if line.startswith(("2d ", "aos", "bev 0", "3d  0", "overlap"))}) == 1


@pytest.mark.parametrize("line", [LINE + " nan", LINE, LINE + " x", LINE.replace("20.00", "inf") + " 1"])
def test_malformed_line_is_named(folders: list[str], tmp_path: Path, line: str):
    path = tmp_path / "results" / "000007.txt"
    path.write_text(f"{LINE} 0.5\n{line}\n")
    with pytest.raises(InputError, match=r"000007\.txt:2: "):
        main(folders)


def test_frame_without_result_file(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture):
    (tmp_path / "results" / "000007.txt").unlink()
    with pytest.raises(InputError, match=r"no result file for 1 of 2 frames, the first is 000007\.txt.*--frames"):
        main(folders)
    main([*folders, "--missing-as-empty"])
    assert "2 frames scored, 1 of them without a result file, counted as empty\n" in capsys.readouterr().out
    frames = tmp_path / "frames.txt"
    frames.write_text("000003\n\n")
    main([*folders, "--frames", str(frames)])
    assert "1 frame scored\n" in capsys.readouterr().out


def test_missing_as_empty_counts_the_ground_truths(folders: list[str], tmp_path: Path):
    (tmp_path / "results" / "000007.txt").unlink()
    frames, labels, predictions = read_folders(tmp_path / "label_2", tmp_path / "results", missing_as_empty=True)
    assert frames == ["000003", "000007"]
    assert evaluate(labels, predictions)["Car"]["exact"]["3d"] == [50, 50, 50]


def test_prediction_for_a_frame_without_label(folders: list[str], tmp_path: Path):
    (tmp_path / "results" / "000009.txt").write_text("")
    with pytest.raises(InputError, match=r"results/000009\.txt: frame 000009 has no label file"):
        main(folders)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("000003\n000008\n", r"frames\.txt:2: frame 000008 is not in .*label_2"),
        ("000003\n000007\n000003\n", r"frames\.txt:3: frame 000003 stands on line 1 already"),
        ("\n", r"frames\.txt: names no frame"),
    ],
)
def test_wrong_frames_file(folders: list[str], tmp_path: Path, text: str, message: str):
    path = tmp_path / "frames.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        main([*folders, "--frames", str(path)])


def test_points_without_a_camera(folders: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
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


def test_duplicate_file(folders: list[str], tmp_path: Path):
    (tmp_path / "results" / "3.txt").write_text("")
    with pytest.raises(InputError, match=r"results/3\.txt: the same frame as .*000003\.txt"):
        main(folders)


def test_wrong_folders_and_outputs(folders: list[str], tmp_path: Path):
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


@pytest.fixture(scope="module")
def val_results() -> Path:
    root = SHARED / "kitti_val_results"
    if not root.is_dir():
        pytest.skip(f"no results of a published detector at {root}")
    return root


def test_published_detector_scores_as_in_the_devkit(val_results: Path):
    expected = json.loads((val_results / "expected.json").read_text())["Car"]
    _, labels, predictions = read_folders(val_results / "label_2", val_results / "point_gnn_car")
    scored = evaluate(labels, predictions, classes=["Car"])["Car"]
    for measure, table in expected.items():
        for metric, figures in table.items():
            assert scored[measure][metric] == pytest.approx(figures, abs=1e-4), (measure, metric)


def test_real_ground_truth_as_prediction_is_perfect(val_results: Path):
    """All 3769 frames; the DontCare regions and the classes that are not evaluated come along."""
    labels = [read_labels(path) for path in sorted((val_results / "label_2").iterdir())]
    predictions = [Labels(**{**vars(frame), "score": np.ones(len(frame))}) for frame in labels]
    for scored in evaluate(labels, predictions).values():
        for measure in MEASURES:
            for figures in scored[measure].values():
                assert figures == pytest.approx([100] * 3, abs=1e-9)
