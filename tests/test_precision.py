"""Average precision by KITTI's protocol: hand-made frames, what is worked out beside them, and the devkit's figures."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from hvnet.boxes import box_corners
from hvnet.data.frame import Camera
from hvnet.data.kitti import read_labels
from hvnet.data.labels import Labels
from hvnet.evaluation.folders import read_folders
from hvnet.evaluation.matching import LEVELS, LEVELS_WITHOUT_2D, distance_levels
from hvnet.evaluation.precision import MEASURES, count_points, evaluate
from hvnet.evaluation.rules import Rule, rule_for
from hvnet.evaluation.tables import format_table
from tests.helpers import SHARED, crowd, rows


def score_cars(truths: list[str], detections: list[str]) -> dict[str, Any]:
    return evaluate([rows(*truths)], [rows(*detections, scored=True)], classes=["Car"], score_threshold=0)["Car"]


CAR = "Car 0 20 100 50"  # the one car of most frames below, 50 pixels high, at the columns 100 to 160


def test_one_car_found() -> None:
    # One ground truth gives one threshold, the first, at recall 0: R40, which leaves out recall 0, is 0, and R11 is a
    # sum of eleven precisions of which the first is 1: 100 / 11. All of it is found: exact 100.
    car = score_cars([CAR], [CAR])
    for metric in ("2d", "aos", "bev", "3d"):
        assert car["R40"][metric] == [0, 0, 0]
        assert car["R11"][metric] == pytest.approx([100 / 11] * 3)
        assert car["exact"][metric] == [100, 100, 100]
    assert car["counts"] == {"ground_truths": [1, 1, 1], "detections": 1, "frames": 1}
    assert car["report"]["misses"] == car["report"]["false_positives"] == [0, 0, 0]


def test_two_of_three_cars_found_with_a_false_positive_between() -> None:
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


def test_detection_on_a_van_is_neither_right_nor_wrong() -> None:
    # The better-scored detection lies on the other object. On a truck it is a false positive, so that the precision
    # is 1/2 where the car is found; on a van it counts for nothing.
    detections = [CAR + " score=0.5", "Car 10 20 300 50 score=0.9"]
    assert score_cars([CAR, "Van 10 20 300 50"], detections)["exact"]["3d"] == [100, 100, 100]
    assert score_cars([CAR, "Truck 10 20 300 50"], detections)["exact"]["3d"] == [50, 50, 50]


def test_pedestrian_on_a_person_sitting_is_neither_right_nor_wrong() -> None:
    # As with the van; a cyclist is no neighbour, so that there the precision is 1/2 where the pedestrian is found.
    truth = "Pedestrian 0 20 100 50"
    detections = [truth + " score=0.5", "Pedestrian 10 20 300 50 score=0.9"]
    for other, precision in (("Person_sitting", 100), ("Cyclist", 50)):
        truths = rows(truth, f"{other} 10 20 300 50")
        scored = evaluate([truths], [rows(*detections, scored=True)], classes=["Pedestrian"])["Pedestrian"]
        assert scored["exact"]["3d"] == [precision] * 3


def test_first_pass_matches_by_score_and_second_by_overlap() -> None:
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


def test_detection_on_dontcare_counts_for_nothing_in_2d_only() -> None:
    # A region has no 3D box: in BEV and 3D the same detection is a false positive. It needs 0.7 of the detection's own
    # area in the region: of columns 300 to 360, 300 to 345 are enough (0.75), 300 to 340 are not (0.67).
    detections = [CAR + " score=0.5", "Car 10 20 300 50 score=0.9"]
    inside = score_cars([CAR, "DontCare 0 0 200 90 right=345"], detections)["exact"]
    assert (inside["2d"], inside["bev"], inside["3d"]) == ([100] * 3, [50] * 3, [50] * 3)
    assert score_cars([CAR, "DontCare 0 0 200 90 right=340"], detections)["exact"]["2d"] == [50] * 3


def test_second_detection_of_a_car_is_a_false_positive() -> None:
    # First alone, then with the second: precision 1, then 1/2, both at recall 1; the interpolated one is 1.
    car = score_cars([CAR], [CAR + " score=0.9", CAR + " score=0.8"])
    assert car["exact"]["3d"] == [100, 100, 100]
    assert car["report"]["false_positives"] == [1, 1, 1]


def test_tie_in_score() -> None:
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
def test_truncated_and_occluded_cars(key: str, counts: list[int]) -> None:
    # Where the car does not count there is nothing to find, and finding it is no mistake.
    car = score_cars([f"{CAR} {key}"], [CAR])
    assert car["counts"]["ground_truths"] == counts
    assert car["exact"]["3d"] == [100.0 if count else None for count in counts]
    assert car["report"]["false_positives"] == [0, 0, 0]


@pytest.mark.parametrize(
    ("height", "counts"), [(41, [1, 1, 1]), (40, [0, 1, 1]), (39, [0, 1, 1]), (25, [0, 0, 0]), (25.5, [0, 1, 1])]
)
def test_height_of_a_ground_truth_is_above_the_minimum(height: float, counts: list[int]) -> None:
    assert score_cars([f"Car 0 20 100 {height}"], [])["counts"]["ground_truths"] == counts


@pytest.mark.parametrize(("height", "alarms"), [(40, [1, 1, 1]), (39.9, [0, 1, 1]), (25, [0, 1, 1]), (24.9, [0, 0, 0])])
def test_height_of_a_detection_is_at_least_the_minimum(height: float, alarms: list[int]) -> None:
    # A detection far from the one car is a false positive, unless it is too low; whole pixels count.
    report = score_cars([CAR], [CAR, f"Car 10 20 300 {height}"])["report"]
    assert report["false_positives"] == alarms


@pytest.mark.parametrize("name", ["Car", "Pedestrian"])
def test_low_detection_hides_a_ground_truth_whatever_its_class(name: str) -> None:
    # The devkit lets a detection under 40 pixels, of any class, take an easy car: the car is neither found nor missed.
    # From 25 pixels on, at moderate and hard, a Car finds it and a Pedestrian does not.
    car = score_cars([CAR], [f"{name} 0 20 100 39"])
    assert car["report"]["misses"] == ([0, 0, 0] if name == "Car" else [0, 1, 1])
    if name == "Car":
        assert car["exact"]["bev"] == [0, 100, 100]


def test_other_classes_are_left_out() -> None:
    # A pedestrian on the car, tall enough: the car is missed, and no Car is wrong.
    report = score_cars([CAR], ["Pedestrian 0 20 100 50", "Car 10 20 300 50"])["report"]
    assert report["misses"] == report["false_positives"] == [1, 1, 1]


def test_orientation_is_that_of_the_ground_truth_alpha() -> None:
    # One car found with alpha wrong by 60 degrees: (1 + cos 60) / 2 = 3/4. A false positive below it in score changes
    # nothing, one above halves precision and similarity.
    detection = f"{CAR} alpha={math.pi / 3} score=0.5"
    exact = score_cars([CAR], [detection, "Car 10 20 300 50 score=0.4"])["exact"]
    assert (exact["2d"][0], exact["aos"][0]) == (100, pytest.approx(75))
    exact = score_cars([CAR], [detection, "Car 10 20 300 50 score=0.6"])["exact"]
    assert (exact["2d"][0], exact["aos"][0]) == (50, pytest.approx(37.5))
    assert "aos" not in score_cars([CAR], [CAR + " alpha=-10"])["exact"]


def test_loose_overlaps() -> None:
    # A box moved by 0.8 of its 4 metres: 3.2 / 4.8 = 0.67 in BEV and 3D, found at 0.5 only.
    car = score_cars([CAR], ["Car 0.8 20 100 50"])
    assert (car["exact"]["bev"], car["loose"]["exact"]["bev"]) == ([0] * 3, [100] * 3)
    assert car["loose"]["exact"]["2d"] == car["exact"]["2d"] == [100] * 3


def test_ground_truth_as_prediction_is_perfect() -> None:
    for scored in evaluate([crowd(41)], [crowd(41, scored=True)]).values():
        for table in (scored, scored["loose"]):
            for measure in MEASURES:
                for metric in ("2d", "aos", "bev", "3d"):
                    assert table[measure][metric] == pytest.approx([100] * 3, abs=1e-9)
        assert scored["warnings"] == []


def test_headings_turned_by_pi_cost_orientation_alone() -> None:
    for scored in evaluate([crowd()], [crowd(heading=math.pi, scored=True)]).values():
        for measure in MEASURES:
            assert scored[measure]["aos"] == pytest.approx([0] * 3, abs=1e-9)
            for metric in ("2d", "bev", "3d"):
                assert scored[measure][metric] == pytest.approx([100] * 3, abs=1e-9)


def test_few_ground_truths_cap_r40_and_the_warning_says_where() -> None:
    scored = evaluate([crowd(9)], [crowd(9, scored=True)], classes=["Cyclist"])["Cyclist"]
    assert scored["R40"]["3d"] == pytest.approx([100 * 8 / 40] * 3)
    assert scored["R11"]["3d"] == pytest.approx([100 * 3 / 11] * 3)
    assert scored["warnings"][0] == "easy: 9 ground truths cap R40 at 20.00 and R11 at 27.27: read 'exact'"


def test_data_without_images() -> None:
    truths, detections = crowd(), crowd(scored=True)
    for labels in (truths, detections):
        labels.bbox[:] = 0
    car = evaluate([truths], [detections], levels=LEVELS)["Car"]
    assert car["exact"] == {"bev": [None] * 3, "3d": [None] * 3}
    assert "--no-2d-filter" in car["warnings"][0]
    car = evaluate([truths], [detections], levels=LEVELS_WITHOUT_2D)["Car"]
    assert car["R40"] == {"bev": [100] * 3, "3d": [100] * 3}
    left_out = "2d and aos are left out: no label and no detection of Car has a 2D box"
    assert car["warnings"] == [left_out]
    car = evaluate([truths], [detections])["Car"]  # these levels are the default where no label has a 2D box
    assert car["R40"] == {"bev": [100] * 3, "3d": [100] * 3}
    assert car["warnings"] == ["no label has a 2D box: the levels go by occlusion and truncation alone", left_out]
    nothing = truths.select(np.zeros(0, np.int64))
    assert evaluate([nothing], [detections])["Car"]["report"]["false_positives"] == [len(truths) // 3] * 3


def test_some_labels_have_2d_boxes() -> None:
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


def test_distance_bands() -> None:
    # Cars at 10 and 30 m, the latter missed, and a false positive at 25 m, where nothing is.
    truths = rows("Car 0 10 100 5", "Car 0 30 300 5 occ=3 trunc=0.9")
    detections = rows("Car 0 10 100 5", "Car 10 22.9 500 5", scored=True)
    car = evaluate([truths], [detections], levels=distance_levels([(0, 20), (20, 40), (40, 60)]))["Car"]
    assert car["levels"] == ["0-20m", "20-40m", "40-60m"]
    assert car["exact"]["3d"] == [100, 0, None]
    assert car["report"]["misses"] == [0, 1, 0]
    assert car["report"]["false_positives"] == [0, 1, 0]


def test_report_by_distance_and_points() -> None:
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


def test_points_are_counted_in_camera_boxes() -> None:
    axes = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # LiDAR's x is the camera's z
    camera = Camera(np.eye(3, 4), np.eye(3), np.column_stack((axes, np.zeros(3))))
    labels = rows("Car 3 20 0 50", "DontCare 0 0 0 50")
    centre = torch.tensor([[20.0, -3, -1.6 + 0.75, 2, 4, 1.5, 0]])  # 4 long across, as rotation_y is 0
    points = np.zeros((9, 4), np.float32)
    points[:8, :3] = 0.99 * (box_corners(centre)[0] - centre[0, :3]) + centre[0, :3]
    assert count_points(points, labels, camera).tolist() == [8, 0]
    labels.dimensions[0] = 0  # without a 3D box, whatever is at its place
    points[8, :3] = 20, -3, -1.6
    assert count_points(points, labels, camera).tolist() == [0, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], []), "at least one frame"),
        (([rows(CAR)], []), "one for each of the 1 labels, got 0"),
        (([rows(CAR)], [rows(CAR)]), "want a score"),
    ],
)
def test_wrong_arguments(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(*arguments)
    with pytest.raises(ValueError, match="points: want"):
        evaluate([rows(CAR)], [rows(CAR, scored=True)], points=[np.zeros(2, np.int64)])


def test_any_class_is_scored_by_the_size_of_its_labels() -> None:
    """A box moved by 0.8 of its 4 metres overlaps by 0.67: too little for a tram, enough at a third of the size."""
    for length, found in ((4.0, 0), (2.9, 100)):
        truths, detections = rows("Tram 0 20 100 50"), rows("Tram 0.8 20 100 50", scored=True)
        for labels in (truths, detections):
            labels.dimensions[:, 2] = length
            labels.location[:, 0] *= length / 4
        (tram,) = evaluate([truths], [detections], classes=["Tram"]).values()
        assert tram["exact"]["bev"] == [found] * 3
        assert tram["overlaps"]["strict"]["bev"] == (0.7 if length >= 3 else 0.5)
        assert tram["loose"]["exact"]["bev"] == [100] * 3


def test_a_class_without_labels_goes_by_the_size_of_its_detections() -> None:
    nothing, detection = rows(CAR), rows("bus_2 0 20 100 50", scored=True)
    (bus,) = evaluate([nothing], [detection], classes=["bus_2"]).values()
    assert bus["overlaps"]["strict"] == {"2d": 0.7, "bev": 0.7, "3d": 0.7}
    assert bus["counts"] == {"ground_truths": [0, 0, 0], "detections": 1, "frames": 1}
    assert bus["exact"]["3d"] == [None] * 3
    small = rows("bus_2 0 20 100 50")
    small.dimensions[:] = 2.0  # labels come first
    (bus,) = evaluate([small], [detection], classes=["bus_2"]).values()
    assert bus["overlaps"]["strict"]["3d"] == 0.5
    detection.dimensions[:] = -1  # without 3D boxes there is no size
    (bus,) = evaluate([nothing], [detection], classes=["bus_2"]).values()
    assert bus["overlaps"]["strict"]["2d"] == 0.5
    (bus,) = evaluate([nothing], [rows(scored=True)], classes=["bus_2"]).values()
    assert (bus["counts"]["detections"], bus["report"]["false_positives"]) == (0, [0, 0, 0])


def test_rules_that_are_given() -> None:
    """For the classes that they name; the others follow KITTI, or their size."""
    truths, detections = rows(CAR, "Tram 9 20 300 50"), rows("Car 0.8 20 100 50", "Tram 9.8 20 300 50", scored=True)
    found = evaluate([truths], [detections], classes=["Car", "Tram"], rules={"Tram": rule_for("Tram", 0, 0.6)})
    assert [found[name]["exact"]["bev"][0] for name in found] == [0, 100]
    mixed = Rule({"2d": 0.7, "bev": 0.6, "3d": 0.7}, {"2d": 0.7, "bev": 0.2, "3d": 0.2})
    (car,) = evaluate([truths], [detections], classes=["Car"], rules={"Car": mixed}).values()
    assert [car["exact"][metric][0] for metric in ("2d", "bev", "3d")] == [100, 100, 0]


def test_a_neighbour_that_is_scored_itself() -> None:
    """Where vans are scored, a car found on one is wrong, and the result says so."""
    truths = rows(CAR, "Van 10 20 300 50")
    detections = rows(CAR + " score=0.5", "Car 10 20 300 50 score=0.9", scored=True)
    alone = evaluate([truths], [detections], classes=["Car"])["Car"]
    both = evaluate([truths], [detections], classes=["Car", "Van"])
    assert alone["exact"]["3d"] == [100] * 3
    assert both["Car"]["exact"]["3d"] == [50] * 3
    said = "Van is scored itself, so that a Car found there is wrong"
    assert said not in alone["warnings"]
    assert both["Car"]["warnings"][0] == said
    assert said not in both["Van"]["warnings"]
    assert both["Van"]["counts"]["ground_truths"] == [1] * 3


NO_LEVEL = [
    (["occ=3", "occ=3"], "2 labels of Car count at no level: occlusion 3"),
    (["occ=3"], "1 label of Car counts at no level: occlusion 3"),
    (["occ=3", "occ=4"], "2 labels of Car count at no level: occlusion above 2"),
    (["trunc=0.6"], "1 label of Car counts at no level: truncation 0.6"),
    (
        ["occ=3", "trunc=1", "trunc=1 occ=3"],
        "3 labels of Car count at no level: 2 with occlusion 3, 1 with truncation 1",
    ),
]


@pytest.mark.parametrize(("keys", "reason"), NO_LEVEL)
def test_labels_that_count_at_no_level(keys: list[str], reason: str) -> None:
    """The table says why, with detections and without."""
    truths = [f"Car {10 * k} 20 {100 * k} 50 {each}" for k, each in enumerate(keys)]
    for detections in ([CAR], []):
        car = score_cars(truths, detections)
        assert car["exact"]["3d"] == [None] * 3
        assert car["warnings"] == [reason]
        assert f"\n! {reason}" in format_table({"Car": car})


def test_labels_that_are_too_low() -> None:
    truths = [f"Car 0 20 100 {height}" for height in (25, 20)]
    reason = "a 2D box of at most 25 pixels in height"
    assert score_cars(truths, [CAR])["warnings"] == [f"2 labels of Car count at no level: {reason}"]
    reason = "easy: 0 of 2 labels of Car count: 1 with occlusion 1, 1 with a 2D box of at most 40 pixels in height"
    assert score_cars([CAR + " occ=1", "Car 10 20 300 40"], [CAR])["warnings"][0] == reason


def test_labels_outside_the_bands() -> None:
    truths, detections = [rows("Car 0 30 100 50")], [rows("Car 0 30 100 50", scored=True)]
    bands = distance_levels([(0, 20), (20, 40), (40, 60)])
    car = evaluate(truths, detections, classes=["Car"], levels=bands)["Car"]
    assert car["warnings"][:2] == [
        f"{band}: 0 of 1 labels of Car count: a distance outside the band" for band in ("0-20m", "40-60m")
    ]
    car = evaluate(truths, detections, classes=["Car"], levels=[bands[0], bands[2]])["Car"]
    assert car["warnings"] == ["1 label of Car counts at no level: a distance outside the bands"]
    truths[0].dimensions[:] = -1
    truths[0].location[:] = 0  # no place, rather than one at 0 m
    car = evaluate(truths, detections, classes=["Car"], levels=bands)["Car"]
    assert car["warnings"][0] == "1 label of Car counts at no level: no 3D box, hence no distance"
    levels = [LEVELS[0]._replace(max_truncation=math.inf), LEVELS[0]._replace(max_occlusion=math.inf)]
    car = evaluate([rows(CAR + " occ=1 trunc=0.2")], detections, classes=["Car"], levels=levels)["Car"]
    assert car["warnings"] == ["1 label of Car counts at no level: limits that differ from level to level"]


def test_a_class_without_labels_says_so() -> None:
    for detections in (rows("Cyclist 0 20 100 50", scored=True), rows(scored=True)):
        (cyclist,) = evaluate([rows(CAR)], [detections], classes=["Cyclist"]).values()
        assert cyclist["warnings"] == ["there is no label of Cyclist"]
        assert "! there is no label of Cyclist" in format_table({"Cyclist": cyclist})


def test_labels_without_3d_boxes_are_scored_in_2d() -> None:
    # Two cars, one of them found: exact 50 in 2D and, with the right alpha, in AOS.
    truths = rows(CAR, "Car 10 20 300 50")
    truths.dimensions[:], truths.location[:] = -1, -1000
    detections = rows(CAR, scored=True)
    car = evaluate([truths], [detections], classes=["Car"])["Car"]
    assert car["exact"] == {"2d": [50] * 3, "aos": [50] * 3}
    assert (car["report"]["metric"], car["report"]["misses"]) == ("2d", [1] * 3)
    assert [row["ground_truths"] for row in car["report"]["recall_by_distance"].values()] == [[0] * 3] * 3
    assert car["warnings"][0] == "bev and 3d are left out: no label of Car has a 3D box"
    truths.alpha[0] = -10
    car = evaluate([truths], [detections], classes=["Car"])["Car"]
    assert car["exact"] == {"2d": [50] * 3}
    assert car["warnings"][0] == "aos is left out: 1 of 2 labels of Car have the unknown angle -10"
    detections.dimensions[:, 0] = 0  # a footprint without a height
    car = evaluate([rows(CAR)], [detections], classes=["Car"])["Car"]
    assert list(car["exact"]) == ["2d", "aos", "bev"]
    assert car["warnings"][0] == "3d is left out: no detection of Car has a 3D box"


@pytest.mark.filterwarnings("error")
def test_a_label_without_a_3d_box_among_others() -> None:
    """As in the devkit: in 2D it is found, in BEV and 3D it is missed, and what is found there is wrong."""
    truths, detections = rows(CAR, "Car 10 20 300 50"), rows(CAR, "Car 10 20 300 50", scored=True)
    for size in (0, -1):
        truths.dimensions[1], truths.location[1] = size, -1000
        car = evaluate([truths], [detections], classes=["Car"])["Car"]
        assert car["exact"] == {"2d": [100] * 3, "aos": [100] * 3, "bev": [25] * 3, "3d": [25] * 3}
        assert (car["report"]["misses"], car["report"]["false_positives"]) == ([1] * 3, [1] * 3)
        said = "1 of 2 labels of Car have no 3D box: bev and 3d count them as missed"
        assert car["warnings"][0] == said


@pytest.fixture(scope="module")
def val_results() -> Path:
    root = SHARED / "kitti_val_results"
    if not root.is_dir():
        pytest.skip(f"no results of a published detector at {root}")
    return root


def test_published_detector_scores_as_in_the_devkit(val_results: Path) -> None:
    expected = json.loads((val_results / "expected.json").read_text())["Car"]
    _, labels, predictions, _ = read_folders(val_results / "label_2", val_results / "point_gnn_car")
    scored = evaluate(labels, predictions, classes=["Car"])["Car"]
    for measure, table in expected.items():
        for metric, figures in table.items():
            assert scored[measure][metric] == pytest.approx(figures, abs=1e-4), (measure, metric)


def test_real_ground_truth_as_prediction_is_perfect(val_results: Path) -> None:
    """All 3769 frames; the DontCare regions and the classes that are not evaluated come along."""
    labels = [read_labels(path) for path in sorted((val_results / "label_2").iterdir())]
    predictions = [Labels(**{**vars(frame), "score": np.ones(len(frame))}) for frame in labels]
    for scored in evaluate(labels, predictions).values():
        for measure in MEASURES:
            for figures in scored[measure].values():
                assert figures == pytest.approx([100] * 3, abs=1e-9)
