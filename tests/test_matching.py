"""The matching at all scores at once against the devkit's way, one threshold after the other, in plain loops."""

import math

import numpy as np
import pytest
from shapely import affinity, box

from hvnet.data.labels import Labels
from hvnet.evaluation.matching import (
    LEVELS,
    Candidates,
    Level,
    Matching,
    clean_data,
    count,
    find_candidates,
    find_changes,
    found_scores,
    match_at,
)
from hvnet.evaluation.rules import METRICS

FRAMES, TRUTHS, DETECTIONS = 80, 8, 10


def random_frame(rng: np.random.Generator, size: int, scored: bool) -> Labels:
    """Crowded objects of all kinds; scores are coarse so that many are equal."""
    names = np.array(["Car", "Car", "Car", "Van", "Pedestrian", "Truck"] + ["DontCare"] * (not scored))
    corner = rng.uniform(0, 30, (size, 2))
    dimensions = rng.uniform((1.4, 1.5, 3), (1.6, 1.9, 4.5), (size, 3))
    return Labels(
        name=rng.choice(names, size),
        truncation=rng.choice([0, 0.2, 0.6], size),
        occlusion=rng.choice([0, 0, 1, 2, 3], size),
        alpha=rng.uniform(-np.pi, np.pi, size),
        bbox=np.concatenate((corner, corner + rng.choice([20, 25, 25.5, 39.9, 40, 41, 60], (size, 2))), axis=1),
        dimensions=dimensions,
        location=np.column_stack((rng.uniform(-1, 1, size), rng.uniform(1.5, 1.8, size), rng.uniform(10, 12, size))),
        rotation_y=rng.choice([0, 0.1, 3.0], size),
        score=rng.integers(0, 10, size) / 10 if scored else None,
    )


def slow_counts(
    matching: Matching, candidates: Candidates, frame: int, threshold: float
) -> tuple[int, int, int, float]:
    """True positives, false positives, misses and similarity of one frame, from the devkit's rules."""
    pairs = matching.pairs.select(matching.pairs.frame == frame)
    overlap = {(g, d): o for g, d, o in zip(pairs.truth, pairs.detection, pairs.overlap, strict=True)}
    detections = sorted({d for _, d in overlap if candidates.score[d] >= threshold})
    taken: set[int] = set()
    hits = misses = 0
    similarity = 0.0
    for g in truths_of(candidates, frame):
        free = [d for d in detections if (g, d) in overlap and d not in taken]
        valid = [d for d in free if not matching.ignored[d]]
        best = max(valid, key=lambda d: (overlap[g, d], -d)) if valid else free[0] if free else None
        if best is not None:
            taken.add(best)
        if matching.truths[g] and best is None:
            misses += 1
        elif matching.truths[g] and not matching.ignored[best]:
            hits += 1
            difference = candidates.truths.alpha[g] - candidates.detections.alpha[best]
            similarity += (1 + math.cos(difference)) / 2
    own = frame_of_detections(candidates) == frame
    alarms = own & matching.countable & (candidates.score >= threshold)
    return hits, int(alarms.sum()) - sum(alarms[d] for d in taken), misses, similarity


def truths_of(candidates: Candidates, frame: int) -> range:
    return range(frame * TRUTHS, (frame + 1) * TRUTHS)


def frame_of_detections(candidates: Candidates) -> np.ndarray:
    return np.arange(len(candidates.detections)) // DETECTIONS


@pytest.fixture(scope="module")
def candidates() -> Candidates:
    rng = np.random.default_rng(1)
    labels = [random_frame(rng, TRUTHS, scored=False) for _ in range(FRAMES)]
    return find_candidates(labels, [random_frame(rng, DETECTIONS, scored=True) for _ in range(FRAMES)])


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("level", LEVELS)
def test_counts_at_every_score(candidates: Candidates, metric: str, level: Level) -> None:
    matching = clean_data(candidates, "Car", metric, 0.3, level)
    counts = count(find_changes(matching, candidates))
    assert counts.true_positives.max() >= 3
    assert (np.diff(counts.score) < 0).all()
    for k, threshold in enumerate(counts.score):
        slow = np.sum([slow_counts(matching, candidates, frame, threshold) for frame in range(FRAMES)], axis=0)
        fast = [getattr(counts, name)[k] for name in ("true_positives", "false_positives", "misses", "similarity")]
        np.testing.assert_allclose(fast, slow, atol=1e-9)


def test_counts_agree_with_the_matching_at_one_score(candidates: Candidates) -> None:
    matching = clean_data(candidates, "Car", "bev", 0.3, LEVELS[2])
    counts = count(find_changes(matching, candidates))
    for k, threshold in enumerate(counts.score):
        matched, taken = match_at(matching, candidates, threshold)
        assert (matching.truths & (matched < 0)).sum() == counts.misses[k]
        assert (matching.countable & ~taken & (candidates.score >= threshold)).sum() == counts.false_positives[k]


def test_overlaps_are_those_of_polygons(candidates: Candidates) -> None:
    """Footprints by shapely in the camera's x and z, turned by rotation_y about y, which points down."""

    def footprint(labels: Labels, row: int):  # type: ignore[no-untyped-def]
        _, width, length = labels.dimensions[row]
        x, _, z = labels.location[row]
        turned = affinity.rotate(
            box(-length / 2, -width / 2, length / 2, width / 2), -labels.rotation_y[row], (0, 0), True
        )
        return affinity.translate(turned, x, z)

    bev, volume = candidates.pairs["bev"], candidates.pairs["3d"]
    for k in range(0, len(bev.frame), 7):
        rows = (candidates.truths, bev.truth[k]), (candidates.detections, bev.detection[k])
        a, b = (footprint(*row) for row in rows)
        assert bev.overlap[k] == pytest.approx(a.intersection(b).area / a.union(b).area, abs=1e-9)
        bottom = min(labels.location[row, 1] for labels, row in rows)
        top = max(labels.location[row, 1] - labels.dimensions[row, 0] for labels, row in rows)
        shared = a.intersection(b).area * max(bottom - top, 0)
        total = sum(labels.dimensions[row].prod() for labels, row in rows) - shared
        assert volume.overlap[k] == pytest.approx(shared / total, abs=1e-9)


def test_first_pass_goes_by_score_and_second_by_overlap() -> None:
    """A car and two detections of it: one fits better, the other is scored higher."""
    rng = np.random.default_rng(0)
    car = random_frame(rng, 1, scored=False)
    car = Labels(
        **{**vars(car), "name": np.array(["Car"]), "truncation": np.zeros(1), "occlusion": np.zeros(1, np.int64)}
    )
    car.bbox[:] = 0, 0, 100, 100
    two = Labels(**{**vars(car.select(np.array([0, 0]))), "score": np.array([0.9, 0.4])})
    two.bbox[0, 2] = 80  # overlap 0.8
    candidates = find_candidates([car], [two])
    matching = clean_data(candidates, "Car", "2d", 0.7, LEVELS[0])
    assert found_scores(find_changes(matching, candidates)).tolist() == [0.9]
    assert match_at(matching, candidates, 0.5)[0].tolist() == [0]
    assert match_at(matching, candidates, 0.3)[0].tolist() == [1]


def test_boxes_without_a_size_overlap_nothing() -> None:
    rng = np.random.default_rng(0)
    truths, detections = random_frame(rng, 3, scored=False), random_frame(rng, 3, scored=True)
    for without in (truths, detections):  # first the labels, then both
        without.dimensions[:] = -1
        without.bbox[:] = 5
        candidates = find_candidates([truths], [detections])
        assert [len(candidates.pairs[metric].overlap) for metric in METRICS] == [0, 0, 0]


def test_no_objects_at_all() -> None:
    empty = random_frame(np.random.default_rng(0), 0, scored=True)
    candidates = find_candidates([empty, empty], [empty, empty])
    matching = clean_data(candidates, "Car", "3d", 0.7, LEVELS[0])
    changes = find_changes(matching, candidates)
    assert len(count(changes).score) == len(found_scores(changes)) == 0


def test_predictions_without_scores_are_refused() -> None:
    frame = random_frame(np.random.default_rng(0), 2, scored=False)
    with pytest.raises(ValueError, match="want a score"):
        find_candidates([frame], [frame])
