"""KITTI's object evaluation: AP in 2D, bird's eye view and 3D, and AOS, of results of any detector and any class.

The protocol is that of the official C++ devkit (evaluate_object_3d_offline; Geiger et al., CVPR 2012), with 40 and
with 11 recall positions. `exact` is the area under the interpolated precision-recall curve of all detections: the
devkit takes at most one score a ground truth, so with n <= 40 of them no detector gets past (n - 1) / 40 in its R40.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from tqdm import tqdm

from hvnet.boxes import indices_in_boxes
from hvnet.data.frame import Camera
from hvnet.data.kitti import boxes_to_lidar
from hvnet.data.labels import DONTCARE, Labels
from hvnet.evaluation.bootstrap import Resampling, interval
from hvnet.evaluation.matching import (
    LEVELS,
    LEVELS_WITHOUT_2D,
    Candidates,
    Changes,
    Counts,
    Floats,
    Integers,
    Level,
    Mask,
    Matching,
    clean_data,
    count,
    find_candidates,
    find_changes,
    found_scores,
    match_at,
    outside,
    select_truths,
)
from hvnet.evaluation.rules import KITTI, METRICS, Rule, rule_for

MEASURES = ("R40", "R11", "exact")
RECALL_STEPS = 40
CURVE_STEPS = 200
DISTANCES = {"0-20 m": (0, 20), "20-40 m": (20, 40), "40-60 m": (40, 60)}
POINT_COUNTS = {"0-9 points": (0, 10), "10-49": (10, 50), "50-199": (50, 200), "200 or more": (200, math.inf)}


def evaluate(
    labels: Sequence[Labels],
    predictions: Sequence[Labels],
    *,
    classes: Sequence[str] = tuple(KITTI),
    rules: Mapping[str, Rule] | None = None,
    levels: Sequence[Level] | None = None,
    score_threshold: float | None = None,
    points: Sequence[Integers] | None = None,
    resampling: Resampling | None = None,
) -> dict[str, dict[str, Any]]:
    """Scores the predictions for frames against their labels; one `Labels` a frame in both.

    For every class: `R40`, `R11` and `exact`, in each `2d`, `aos`, `bev` and `3d` (those that the boxes allow), in each
    a list of one figure in per cent for every level, None where there is no ground truth; `loose`, the same at the
    loose overlaps; `overlaps`, these by strictness and metric; `levels`, their names; `counts`; `report`, what is
    missed and what is found wrongly at one score, `score_threshold` or that of the best F1; `warnings`; and `curves`,
    for strict and loose overlaps and every metric one `Counts` a level, thinned to CURVE_STEPS.

    `rules` are by default KITTI's for its classes; for others they follow from the length of the labelled objects
    (`rule_for`). `levels` are by default KITTI's, without their least height in the image where no label has a 2D box.
    `points` are for every frame the numbers of points in the boxes of its labels (K,), see `count_points`; without them
    the report's recall by points is None.

    `resampling` (see `bootstrap.resample`) adds `bootstrap`: the number of `resamples` and of `groups`; by level, how
    many `groups_with_ground_truths` there are and how many `resamples_without`; and `intervals`, laid out as the
    figures, each the two ends. It adds `resampled`, the figures (N,) themselves, by strictness.
    """
    if len(labels) != len(predictions):
        raise ValueError(f"predictions: want one for each of the {len(labels)} labels, got {len(predictions)}")
    if not labels:
        raise ValueError("labels: want at least one frame, got none")
    if points is not None and [len(frame) for frame in points] != [len(frame) for frame in labels]:
        raise ValueError("points: want one number for every row of every frame's labels, DontCare too")
    if resampling is not None and len(resampling.group) != len(labels):
        raise ValueError(f"resampling: want {len(labels)} frames, as there are labels, got {len(resampling.group)}")
    candidates = find_candidates(labels, predictions)
    notes = []
    if levels is None:
        levels = LEVELS
        if not _has(candidates.truths if len(candidates.truths) else candidates.detections, "2d"):
            levels = LEVELS_WITHOUT_2D
            notes = ["no label has a 2D box: the levels go by occlusion and truncation alone"]
    all_points = None if points is None else np.concatenate(points)
    result = {}
    for name in classes:
        rule = (rules or {}).get(name) or rule_for(name, _median_length(candidates, name))
        notes_of_class = []
        if rule.neighbour in classes:
            notes_of_class = [f"{rule.neighbour} is scored itself, so that a {name} found there is wrong"]
            rule = rule._replace(neighbour=None)
        result[name] = _evaluate_class(candidates, name, rule, levels, score_threshold, all_points, resampling)
        result[name]["counts"]["frames"] = len(labels)
        if result[name]["counts"]["detections"]:
            result[name]["warnings"] = notes + notes_of_class + result[name]["warnings"]
    return result


def _median_length(candidates: Candidates, name: str) -> float:
    """Median length in metres of the labelled objects of a class, or of its detections if none is labelled."""
    for rows in (candidates.truths, candidates.detections):
        lengths = rows.dimensions[rows.name == name, 2]
        if (lengths > 0).any():
            return float(np.median(lengths[lengths > 0]))
    return 0.0


def count_points(points: NDArray[np.float32], labels: Labels, camera: Camera | None) -> Integers:
    """How many of the points (N, 4) in LiDAR axes lie in the 3D box of each label: (K,), 0 without one."""
    objects = (labels.name != DONTCARE) & labels.has_3d()
    boxes = torch.from_numpy(boxes_to_lidar(labels.select(objects), camera))
    counts = np.zeros(len(labels), np.int64)
    counts[objects] = [len(inside) for inside in indices_in_boxes(torch.from_numpy(points), boxes)]
    return counts


def _evaluate_class(
    candidates: Candidates,
    name: str,
    rule: Rule,
    levels: Sequence[Level],
    score_threshold: float | None,
    points: Integers | None,
    resampling: Resampling | None,
) -> dict[str, Any]:
    truths = candidates.truths.select(candidates.truths.name == name)
    detections = candidates.detections.select(candidates.detections.name == name)
    metrics = [metric for metric in METRICS if _has(truths, metric) and _has(detections, metric)]
    oriented = not (_unknown_angles(truths) or _unknown_angles(detections))
    draws = [None, *(resampling.draws if resampling else ())]  # first every frame once
    tables: dict[str, Any] = {}
    resampled: dict[str, Any] = {}
    curves: dict[str, dict[str, list[Counts]]] = {}
    for strictness, overlaps in (("strict", rule.strict), ("loose", rule.loose)):
        table: dict[str, dict[str, list[float | None]]] = {measure: {} for measure in MEASURES}
        drawn: dict[str, dict[str, list[Floats]]] = {measure: {} for measure in MEASURES}
        curves[strictness] = {metric: [] for metric in metrics}
        for metric in metrics:
            keys = ("2d", "aos") if metric == "2d" and oriented else (metric,)
            for level in levels:
                matching = clean_data(candidates, name, metric, overlaps[metric], level, rule.neighbour)
                changes = find_changes(matching, candidates)
                curves[strictness][metric].append(_thin(count(changes)))
                bar = tqdm(draws, f"{name} {metric}, resampling", disable=None if resampling else True, leave=False)
                figures = np.array([_averages(changes, each) for each in bar])
                for (k, key), (m, measure) in itertools.product(enumerate(keys), enumerate(MEASURES)):
                    found = float(figures[0, k, m]) if matching.truths.any() else None
                    table[measure].setdefault(key, []).append(found)
                    drawn[measure].setdefault(key, []).append(figures[1:, k, m])
        tables[strictness], resampled[strictness] = table, drawn
    truth_counts = [int(select_truths(candidates.truths, name, level).sum()) for level in levels]
    report = None
    if metrics:
        metric = metrics[-1]
        overlap = rule.strict[metric]
        matchings = [clean_data(candidates, name, metric, overlap, level, rule.neighbour) for level in levels]
        chosen_by = "best F1" if score_threshold is None else "given"
        threshold = _best_score(curves["strict"][metric]) if score_threshold is None else score_threshold
        report = {"metric": metric, "overlap": overlap, "score_threshold": threshold, "chosen_by": chosen_by}
        report |= _report(candidates, matchings, threshold, points)
    warnings = _warnings(name, truths, detections, levels, truth_counts)
    uncertain = {}
    if resampling is not None:
        bootstrap = _bootstrap(candidates, name, levels, resampling)
        bootstrap["intervals"] = {**_intervals(resampled["strict"]), "loose": _intervals(resampled["loose"])}
        uncertain = {"bootstrap": bootstrap, "resampled": resampled}
        if len(detections):
            warnings += _interval_warnings(bootstrap, levels)
    return {
        **tables["strict"],
        "loose": tables["loose"],
        "overlaps": {"strict": dict(rule.strict), "loose": dict(rule.loose)},
        "levels": [level.name for level in levels],
        "counts": {"ground_truths": truth_counts, "detections": len(detections)},
        "report": report,
        "warnings": warnings,
        "curves": curves,
        **uncertain,
    }


def _bootstrap(candidates: Candidates, name: str, levels: Sequence[Level], resampling: Resampling) -> dict[str, Any]:
    """What was drawn, and how much of it has objects of a class."""
    with_truths, without = [], []
    for level in levels:
        frames = candidates.truth_frame[select_truths(candidates.truths, name, level)]
        with_truths.append(len(np.unique(resampling.group[frames])))
        without.append(int((resampling.draws[:, np.unique(frames)].sum(axis=1) == 0).sum()))
    whole = {"resamples": len(resampling.draws), "groups": resampling.groups}
    return whole | {"groups_with_ground_truths": with_truths, "resamples_without": without}


def _interval_warnings(bootstrap: dict[str, Any], levels: Sequence[Level]) -> list[str]:
    """Why intervals are not what they seem, with the levels that each reason holds for."""
    found: dict[str, list[str]] = {}
    columns = (bootstrap["groups_with_ground_truths"], bootstrap["resamples_without"])
    for level, groups, without in zip(levels, *columns, strict=True):
        if groups == 1:
            text = "all ground truths are in one group of frames: the intervals know nothing of others"
            found.setdefault(text, []).append(level.name)
        if groups and without:
            text = f"{without} of {bootstrap['resamples']} resamples hold no ground truth: the intervals leave them out"
            found.setdefault(text, []).append(level.name)
    return [f"{', '.join(names)}: {text}" for text, names in found.items()]


def _intervals(resampled: dict[str, dict[str, list[Floats]]]) -> dict[str, dict[str, list[list[float] | None]]]:
    return {
        measure: {key: [interval(values) for values in levels] for key, levels in table.items()}
        for measure, table in resampled.items()
    }


def _has(labels: Labels, metric: str) -> bool:
    """Whether boxes of this kind are given: at least once, as in the devkit, or nothing is given at all."""
    if metric == "2d":
        given = (labels.bbox[:, 0] >= 0) & (labels.bbox[:, 2:] > labels.bbox[:, :2]).all(axis=1)
    elif metric == "bev":
        given = (labels.location[:, [0, 2]] != -1000).all(axis=1) & (labels.dimensions[:, 1:] > 0).all(axis=1)
    else:
        given = (labels.location != -1000).all(axis=1) & (labels.dimensions > 0).all(axis=1)
    return bool(given.any()) or not len(labels)


def _unknown_angles(labels: Labels) -> int:
    """How many have the angle of observation -10, the devkit's mark of an unknown one."""
    return int((labels.alpha == -10).sum())


@njit(cache=True, nogil=True)
def _thresholds(scores: Floats, total: int) -> Floats:
    """The devkit's thresholds (at most 41,) of the true positives' scores (T,), highest first.

    They are those whose recall is nearest to 0, 1/40, 2/40, ...; total: the number of ground truths.
    """
    chosen = np.empty(len(scores))
    size, target = 0, 0.0
    for k, score in enumerate(scores):
        last = k == len(scores) - 1
        recall, following = (k + 1) / total, (k + 2) / total
        if last or following - target >= target - recall:
            chosen[size] = score
            size += 1
            target += 1 / RECALL_STEPS
    return chosen[:size]


def best_to_the_right(values: Floats) -> Floats:
    """The greatest of each value and those after it: interpolated precision, (S,) by rising recall."""
    return np.maximum.accumulate(values[::-1])[::-1]


def _averages(changes: Changes, draws: Integers | None = None) -> Floats:
    """Averages over recall of precision and orientation (2, 3), in per cent: R40, R11 and exact, as in MEASURES.

    draws: how often each frame is drawn (F,), once by default. NaN where no ground truth is drawn.
    """
    total = int(changes.truths.sum() if draws is None else changes.truths @ draws)
    if not total:
        return np.full((2, len(MEASURES)), math.nan)
    counts = count(changes, draws)
    rows = np.searchsorted(-counts.score, -_thresholds(found_scores(changes, draws), total))
    recall = counts.recall
    order = np.argsort(recall, kind="stable")
    steps = np.diff(recall[order], prepend=0)
    averages = []
    for values in (counts.precision, counts.orientation):
        sampled = np.zeros(RECALL_STEPS + 1)
        sampled[: len(rows)] = best_to_the_right(values[rows])
        averages.append((sampled[1:].mean(), sampled[::4].mean(), steps @ best_to_the_right(values[order])))
    return 100 * np.array(averages)


def _thin(counts: Counts) -> Counts:
    """The counts where recall first reaches each of CURVE_STEPS steps; with fewer ground truths, each of theirs."""
    steps = np.floor(counts.recall * CURVE_STEPS + 1e-9)
    return counts.select(np.flatnonzero(np.diff(np.maximum.accumulate(steps), prepend=0) > 0))


def _best_score(curves: Sequence[Counts]) -> float:
    """The score of the best F1 at the middle level, else at the first level where something is found."""
    for curve in (curves[len(curves) // 2], *curves):
        if len(curve.score):
            wrong = curve.false_positives + curve.misses
            f1 = 2 * curve.true_positives / (2 * curve.true_positives + wrong)
            return float(curve.score[f1.argmax()])
    return 0.0


def _report(
    candidates: Candidates, matchings: Sequence[Matching], threshold: float, points: Integers | None
) -> dict[str, Any]:
    """Misses and false positives when the detections below a score are dropped."""
    counts: dict[str, list[int]] = {"ground_truths": [], "misses": [], "false_positives": []}
    distance = candidates.truths.ground_distance()
    groups = {"recall_by_distance": {band: _between(distance, limits) for band, limits in DISTANCES.items()}}
    if points is not None:
        groups["recall_by_points"] = {band: _between(points, limits) for band, limits in POINT_COUNTS.items()}
    recalls: dict[str, Any] = {"recall_by_distance": {}, "recall_by_points": None if points is None else {}}
    for matching in matchings:
        matched, taken = match_at(matching, candidates, threshold)
        missed = matching.truths & (matched < 0)
        found = matching.truths & (matched >= 0)
        found[found] = ~matching.ignored[matched[found]]
        wrong = matching.countable & (candidates.score >= threshold) & ~taken
        counts["ground_truths"].append(int(matching.truths.sum()))
        counts["misses"].append(int(missed.sum()))
        counts["false_positives"].append(int(wrong.sum()))
        for group, bands in groups.items():
            for band, inside in bands.items():
                row = recalls[group].setdefault(band, {"ground_truths": [], "recall": []})
                hits, total = int((found & inside).sum()), int(((found | missed) & inside).sum())
                row["ground_truths"].append(total)
                row["recall"].append(100 * hits / total if total else None)
    return {**counts, **recalls}


def _between(values: NDArray, limits: tuple[float, float]) -> Mask:
    return (values >= limits[0]) & (values < limits[1])


def _warnings(
    name: str, truths: Labels, detections: Labels, levels: Sequence[Level], counts: Sequence[int]
) -> list[str]:
    """Caveats for the reader of the figures; truths and detections are those of the class.

    Without detections there are no figures: then it is only why labels do not count.
    """
    warnings = []
    if any(level.min_height > 0 for level in levels):
        for objects, kind in ((truths, "label"), (detections, "detection")):
            if len(objects) and not _has(objects, "2d"):
                warnings.append(f"no {kind} has a 2D box, as these levels ask: see hvnet.evaluate --no-2d-filter")
        flat = int((truths.bbox[:, 3] <= truths.bbox[:, 1]).sum())
        if 0 < flat < len(truths):
            of = f"{flat} of {len(truths)} labels have"
            warnings.append(f"{of} no 2D box, as these levels ask: see hvnet.evaluate --no-2d-filter")
    warnings += _uncounted(name, truths, levels, counts)
    if not len(detections):
        return warnings
    warnings += _left_out(name, truths, detections)
    for level, total in zip(levels, counts, strict=True):
        if 0 < total <= RECALL_STEPS:
            # at most one threshold per ground truth, and the first is at recall 0
            best = (100 * (total - 1) / RECALL_STEPS, 100 * math.ceil(total / 4) / 11)
            warnings.append(
                f"{level.name}: {total} ground truths cap R40 at {best[0]:.2f} and R11 at {best[1]:.2f}: read 'exact'"
            )
    return warnings


def _uncounted(name: str, truths: Labels, levels: Sequence[Level], counts: Sequence[int]) -> list[str]:
    """Why there is nothing to find at some or all of the levels; truths are those of the class."""
    total = len(truths)
    if not total:
        return [f"there is no label of {name}"]
    if not any(counts):
        count = f"{total} label{'s' * (total != 1)} of {name} count{'s' * (total == 1)}"
        return [f"{count} at no level: {_reasons(truths, levels)}"]
    empty = [level for level, count in zip(levels, counts, strict=True) if not count]
    return [f"{level.name}: 0 of {total} labels of {name} count: {_reasons(truths, [level])}" for level in empty]


def _reasons(truths: Labels, levels: Sequence[Level]) -> str:
    """What keeps truths from counting at any of these levels, each by the first reason that holds for it."""
    height = truths.bbox[:, 3] - truths.bbox[:, 1]
    lowest = min(level.min_height for level in levels)
    left, found = np.ones(len(truths), np.bool_), []

    def note(reason: str, mask: Mask) -> None:
        count = int((mask & left).sum())
        left[mask] = False
        if count:
            found.append((reason, count))

    for what, values, limit in (
        ("occlusion", truths.occlusion, max(level.max_occlusion for level in levels)),
        ("truncation", truths.truncation, max(level.max_truncation for level in levels)),
    ):
        over = (values > limit) & left
        alike = np.unique(values[over])
        note(f"{what} {alike[0]:g}" if len(alike) == 1 else f"{what} above {limit:g}", over)
    note("no 2D box", (height <= lowest) & ~truths.has_2d())
    note(f"a 2D box of at most {lowest:g} pixels in height", height <= lowest)
    away = np.all([outside(truths, level) for level in levels], axis=0)
    note("no 3D box, hence no distance", away & ~truths.has_3d())
    note("a distance outside the band" + "s" * (len(levels) > 1), away)
    note("limits that differ from level to level", left.copy())
    if len(found) == 1:
        return found[0][0]
    return ", ".join(f"{count} with {reason}" for reason, count in found)


def _left_out(name: str, truths: Labels, detections: Labels) -> list[str]:
    """Which metrics are missing, or hard to reach, since boxes or angles are."""
    lines = []
    sides = {"label": truths, "detection": detections}
    without = {metric: [f"no {kind}" for kind, rows in sides.items() if not _has(rows, metric)] for metric in METRICS}
    if without["2d"]:
        lines.append(f"2d and aos are left out: {' and '.join(without['2d'])} of {name} has a 2D box")
    else:
        for kind, rows in sides.items():
            if unknown := _unknown_angles(rows):
                lines.append(f"aos is left out: {unknown} of {len(rows)} {kind}s of {name} have the unknown angle -10")
    if without["3d"]:
        metrics = "bev and 3d are" if without["bev"] else "3d is"
        lines.append(f"{metrics} left out: {' and '.join(without['3d'])} of {name} has a 3D box")
    missed = int((~truths.has_3d()).sum())
    if 0 < missed < len(truths) and not without["bev"]:
        lines.append(f"{missed} of {len(truths)} labels of {name} have no 3D box: bev and 3d count them as missed")
    return lines
