"""The result of an evaluation for people: its width and its columns, the curves as CSV, and the plot of them."""

import csv
from pathlib import Path

import numpy as np

from hvnet.evaluation.matching import distance_levels
from hvnet.evaluation.precision import evaluate
from hvnet.evaluation.tables import format_table, plot, write_csv
from tests.helpers import crowd, rows


def test_table_is_at_most_100_columns_wide_and_aligned() -> None:
    result = evaluate([crowd()], [crowd(scored=True)], points=[np.arange(3 * 60)])
    four = evaluate([crowd()], [crowd(scored=True)], levels=distance_levels([(0, 20), (20, 40), (40, 80), (80, 999)]))
    for lines in (format_table(result).splitlines(), format_table(four).splitlines()):
        assert max(map(len, lines)) <= 100
        assert len({len(line) for line in lines if line.startswith(("2d ", "aos", "bev 0", "3d  0", "overlap"))}) == 1


def test_a_class_without_detections_has_one_line() -> None:
    result = evaluate([rows("Tram 0 20 100 50")], [rows(scored=True)], classes=["Tram"])
    assert format_table(result) == "Tram: no detections; ground truths: 1 easy, 1 moderate, 1 hard"


def test_warnings_are_folded() -> None:
    name = "a_vehicle_of_more_than_four_wheels"
    kinds = [f"{name} 0 20 100 50 occ=3", f"{name} 0 20 100 50 trunc=0.9", f"{name} 0 20 100 10"]
    result = evaluate([rows(*kinds)], [rows(scored=True)], classes=[name])
    assert format_table(result).splitlines() == [
        f"{name}: no detections; ground truths: 0 easy, 0 moderate, 0 hard",
        f"! 3 labels of {name} count at no level: 1 with occlusion 3, 1 with",
        "  truncation 0.9, 1 with a 2D box of at most 25 pixels in height",
    ]


def test_loose_overlaps_stand_where_they_differ(tmp_path: Path) -> None:
    """In the table, the curves and the plot; that of 2D boxes is the strict one."""
    result = evaluate(
        [rows("Straßenbahn 0 20 100 50")],
        [rows("Straßenbahn 0 20 100 50 score=0.5", scored=True)],
        classes=["Straßenbahn"],
    )
    lines = [line.split()[:2] for line in format_table(result).splitlines() if line[:3] in ("2d ", "bev", "3d ", "aos")]
    strict = [["2d", "0.70"], ["aos", "0.70"], ["bev", "0.70"], ["3d", "0.70"]]
    assert lines[:6] == [*strict, ["bev", "0.50"], ["3d", "0.50"]]
    write_csv(tmp_path / "a.csv", result)
    with (tmp_path / "a.csv").open(newline="", encoding="utf-8") as file:
        curves = [(row["class"], row["metric"], row["overlap"]) for row in csv.DictReader(file)]
    expected = [("2d", "0.7"), ("bev", "0.7"), ("3d", "0.7"), ("bev", "0.5"), ("3d", "0.5")]
    assert curves == [("Straßenbahn", *each) for each in expected for _ in range(3)]
    plot(tmp_path / "a.png", result)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
