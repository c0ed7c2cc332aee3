"""Intervals of figures: hand-made frames, and resamples against frames that are given several times."""

import math

import numpy as np
import pytest

from hvnet.evaluation.bootstrap import Resampling, differences, interval, resample
from hvnet.evaluation.matching import distance_levels
from hvnet.evaluation.precision import MEASURES, evaluate
from hvnet.evaluation.rules import Rule
from hvnet.evaluation.tables import format_differences, format_table
from tests.helpers import crowd, rows
from tests.test_matching import random_frame

CAR = "Car 0 20 100 50"
KEYS = ("2d", "aos", "bev", "3d")


def drawn(*draws: list[int]) -> Resampling:
    """Resamples of single frames, given by how often each frame is drawn."""
    return Resampling(np.array(draws), np.arange(len(draws[0])))


def test_what_is_drawn() -> None:
    single = resample(50, ["a", "b", "c", "d"])
    assert single.draws.shape == (50, 4)
    assert (single.draws.sum(axis=1) == 4).all()
    assert len(np.unique(single.draws, axis=0)) > 10
    assert (single.groups, single.group.tolist()) == (4, [0, 1, 2, 3])
    assert (resample(50, range(4)).draws == single.draws).all()
    assert (resample(50, range(4), seed=1).draws != single.draws).any()
    drives = resample(50, ["x", "y", "x", "x"])
    assert (drives.groups, drives.group.tolist()) == (2, [0, 1, 0, 0])
    assert {tuple(row) for row in drives.draws.tolist()} == {(2, 0, 2, 2), (1, 1, 1, 1), (0, 2, 0, 0)}


def test_frames_count_as_often_as_they_are_drawn() -> None:
    # Frame 0: a car, found with a score of 0.9. Frame 1: a car that is missed, and a false positive of 0.95.
    # Once each: precision and recall 1/2, exact 25. Frame 0 alone 100, frame 1 alone 0. 2 to 1: 2/3 * 2/3.
    truths = [rows(CAR), rows(CAR)]
    found = [rows(CAR + " score=0.9", scored=True), rows("Car 30 20 300 50 score=0.95", scored=True)]
    resampling = drawn([1, 1], [2, 0], [0, 2], [2, 1])
    car = evaluate(truths, found, classes=["Car"], resampling=resampling)["Car"]
    for key in KEYS:
        assert car["exact"][key] == [25] * 3
        for level in car["resampled"]["strict"]["exact"][key]:
            assert level == pytest.approx([25, 100, 0, 400 / 9])
        assert car["bootstrap"]["intervals"]["exact"][key] == [interval(np.array([25, 100, 0, 400 / 9]))] * 3
    assert car["bootstrap"]["groups_with_ground_truths"] == [2, 2, 2]
    assert car["bootstrap"]["resamples_without"] == [0, 0, 0]


def test_interval() -> None:
    assert interval(np.arange(101.0)) == [2.5, 97.5]
    assert interval(np.array([math.nan, *range(101)])) == [2.5, 97.5]
    assert interval(np.array([math.nan])) is None


RULES = {"Car": Rule(dict.fromkeys(("2d", "bev", "3d"), 0.3), dict.fromkeys(("2d", "bev", "3d"), 0.15), "Van")}
FRAMES = 20


@pytest.mark.parametrize("seed", range(3))
def test_resamples_equal_frames_that_are_repeated(seed: int) -> None:
    """In all measures, those at the devkit's thresholds too; each frame once is the very same figure."""
    rng = np.random.default_rng(seed)
    labels = [random_frame(rng, 8, scored=False) for _ in range(FRAMES)]
    results = [random_frame(rng, 10, scored=True) for _ in range(FRAMES)]
    draws = rng.multinomial(FRAMES, [1 / FRAMES] * FRAMES, size=3).tolist()
    how = {"classes": ["Car"], "rules": RULES}
    car = evaluate(labels, results, **how, resampling=drawn([1] * FRAMES, *draws))["Car"]  # type: ignore[arg-type]
    for k, times in enumerate(draws, 1):
        repeated = [
            [frame for frame, n in zip(each, times, strict=True) for _ in range(n)] for each in (labels, results)
        ]
        again = evaluate(*repeated, **how)["Car"]  # type: ignore[arg-type]
        for strictness, once, table in (("strict", car, again), ("loose", car["loose"], again["loose"])):
            for measure in MEASURES:
                for key in KEYS:
                    samples = car["resampled"][strictness][measure][key]
                    assert [level[0] for level in samples] == once[measure][key]
                    assert [level[k] for level in samples] == pytest.approx(table[measure][key], abs=1e-9)
                    assert table[measure][key][2] > 0
    assert car["exact"] != again["exact"]


def test_resamples_without_ground_truths_are_left_out() -> None:
    truths, found = [rows(CAR), rows()], [rows(CAR, scored=True), rows(scored=True)]
    resampling = drawn([1, 1], [0, 2], [2, 0])
    car = evaluate(truths, found, classes=["Car"], resampling=resampling)["Car"]
    assert math.isnan(car["resampled"]["strict"]["exact"]["3d"][0][1])
    assert car["bootstrap"]["intervals"]["exact"]["3d"] == [[100, 100]] * 3
    assert car["warnings"][-2:] == [
        "easy, moderate, hard: all ground truths are in one group of frames: the intervals know nothing of others",
        "easy, moderate, hard: 1 of 3 resamples hold no ground truth: the intervals leave them out",
    ]
    cyclist = evaluate(truths, found, classes=["Cyclist"], resampling=resampling)["Cyclist"]
    assert cyclist["bootstrap"]["intervals"]["R40"]["3d"] == [None] * 3
    assert cyclist["warnings"] == ["there is no label of Cyclist"]


def test_results_are_compared_resample_by_resample() -> None:
    # One result has the cars of both frames, the other that of frame 0: 50 points less, 0 in frame 0, 100 in frame 1.
    truths = [rows(CAR), rows(CAR)]
    both = [rows(CAR, scored=True)] * 2
    resampling = drawn([1, 1], [2, 0], [0, 2])
    a, b = (
        evaluate(truths, found, classes=["Car", "Tram"], resampling=resampling)
        for found in (both, [both[0], rows(scored=True)])
    )
    found = differences(a, b)
    assert found["Car"]["strict"] == dict.fromkeys(KEYS, [pytest.approx([50, 2.5, 97.5])] * 3)
    assert found["Tram"]["loose"]["bev"] == [None] * 3
    lines = format_differences(a, found).splitlines()
    assert lines[3] == "bev 0.70  " + f"{'+50.00 [2.5, 97.5]':>22}" * 3
    assert [line[:8] for line in lines[:7]] == ["Car     ", *(f"{key:3} 0.70" for key in KEYS), "bev 0.50", "3d  0.50"]
    assert lines[-1].split() == ["3d", "0.25", "-", "-", "-"]


def test_table_with_intervals() -> None:
    bands = distance_levels([(0, 20), (20, 40), (40, 80), (80, 999)])
    for levels in (None, bands):
        result = evaluate([crowd()], [crowd(scored=True)], levels=levels, resampling=drawn([1], [1]))
        lines = format_table(result).splitlines()
        assert lines[1].startswith("[low, high]: 95 % of 2 resamples of 1 frames; 1, 1, 1")
        assert max(map(len, lines)) <= 100
        assert sum(line.startswith("bev 0.70  ") and "[" in line for line in lines) == len(MEASURES)
        assert len({len(line) for line in lines if line.startswith(("2d ", "aos", "bev 0", "3d  0", "overlap"))}) == 1


def test_frames_of_another_number() -> None:
    with pytest.raises(ValueError, match="resampling: want 2 frames, as there are labels, got 1"):
        evaluate([rows(CAR)] * 2, [rows(CAR, scored=True)] * 2, resampling=drawn([1]))
