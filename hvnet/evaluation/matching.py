"""Matching of detections with ground truths by the rules of KITTI's devkit, for `precision`.

The devkit (evaluate_object_3d_offline; Geiger et al., CVPR 2012) matches every frame once per score threshold. Here a
frame is matched once for every score that one of its overlapping detections has, since nothing else can change its
counts; the running sum over all frames then holds the devkit's counts at every threshold there is. A frame that is
drawn k times in a resample counts k times in that sum, so that nothing is matched again.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from hvnet.data.labels import DONTCARE, Labels, concatenate
from hvnet.kernels.rotated import rotated_overlap_pairs

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Level(NamedTuple):
    """Which ground truths of a class are to be found; the others are neither found nor missed."""

    name: str
    max_occlusion: float = math.inf
    max_truncation: float = math.inf
    min_height: float = -1  # pixels in the image; detections have to have them too
    distance: tuple[float, float] = (0, math.inf)  # metres on the ground, from and below; of detections too


LEVELS = (Level("easy", 0, 0.15, 40), Level("moderate", 1, 0.3, 25), Level("hard", 2, 0.5, 25))
LEVELS_WITHOUT_2D = tuple(level._replace(min_height=-1) for level in LEVELS)


def distance_levels(bands: Iterable[tuple[float, float]]) -> tuple[Level, ...]:
    """One level for each band of distances in metres, whatever the occlusion, the truncation and the 2D box."""
    return tuple(Level(f"{near:g}-{far:g}m", distance=(near, far)) for near, far in bands)


@dataclass(frozen=True)
class Pairs:
    """Ground truths and detections of the same frame, in the order of frame, ground truth, detection."""

    frame: Integers  # (P,)
    truth: Integers  # (P,) row among the ground truths of all frames
    detection: Integers  # (P,) row among the detections of all frames
    overlap: Floats  # (P,) intersection over union

    def select(self, mask: Mask) -> "Pairs":
        """The pairs that a mask picks."""
        return Pairs(self.frame[mask], self.truth[mask], self.detection[mask], self.overlap[mask])


@dataclass(frozen=True)
class Candidates:
    """The ground truths (G) and the detections (D) of all frames, and how much they overlap."""

    truths: Labels
    detections: Labels
    score: Floats  # (D,)
    truth_frame: Integers  # (G,)
    detection_frame: Integers  # (D,)
    frames: int
    pairs: dict[str, Pairs]  # for every metric, those that overlap at all
    dontcare: Floats  # (D,) share of the detection's 2D box in the DontCare region that holds most of it


@dataclass(frozen=True)
class Matching:
    """The question for one class, metric, minimum overlap and difficulty: who may be matched, and what it counts."""

    pairs: Pairs  # those that overlap enough
    truths: Mask  # (G,) ground truths that are found or missed; the others may be matched, but count for nothing
    ignored: Mask  # (D,) detections that may be matched, but are neither right nor wrong
    countable: Mask  # (D,) detections that are false positives where they are matched with nothing


@dataclass(frozen=True)
class Changes:
    """What each frame adds to the counts as the threshold falls, for one `Matching`."""

    score: Floats  # (S,) at which something changes, the highest first
    row: Integers  # (E,) of the score of each change
    frame: Integers  # (E,)
    added: Floats  # (4, E) true positives, false positives, ground truths that an ignored detection takes, similarity
    truths: Integers  # (F,) number of ground truths of each frame
    first_score: Floats  # (T,) the devkit's first pass: the scores of the true positives, the highest first
    first_frame: Integers  # (T,)


@dataclass(frozen=True)
class Counts:
    """Counts over all frames when the detections below a score are dropped, for every score, the highest first."""

    score: Floats  # (S,)
    true_positives: Floats  # (S,)
    false_positives: Floats  # (S,)
    misses: Floats  # (S,)
    similarity: Floats  # (S,) sum over the true positives of (1 + cos(difference of alpha)) / 2

    @property
    def recall(self) -> Floats:
        """Share (S,) of the ground truths that are found."""
        return self.true_positives / np.maximum(self.true_positives + self.misses, 1)

    @property
    def precision(self) -> Floats:
        """Share (S,) of the detections that are right."""
        return self.true_positives / np.maximum(self.true_positives + self.false_positives, 1)

    @property
    def orientation(self) -> Floats:
        """Mean similarity of orientation (S,) of the detections, 0 for a false positive."""
        return self.similarity / np.maximum(self.true_positives + self.false_positives, 1)

    def select(self, rows: Integers) -> "Counts":
        """The counts at some of the scores."""
        return Counts(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def find_candidates(labels: Sequence[Labels], predictions: Sequence[Labels]) -> Candidates:
    """The overlaps of all frames' ground truths and detections; one `Labels` a frame in both."""
    truths, truth_starts = _concatenate(labels)
    detections, detection_starts = _concatenate(predictions)
    if detections.score is None:
        raise ValueError("predictions: want a score for every detection, got frames without scores")
    frame, truth, detection = _meeting(truths.bbox, truth_starts, detections.bbox, detection_starts).T
    a, b = truths.bbox[truth], detections.bbox[detection]
    shared = (np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2])).prod(axis=1)
    area_a, area_b = (a[:, 2:] - a[:, :2]).prod(axis=1), (b[:, 2:] - b[:, :2]).prod(axis=1)
    pairs = {"2d": Pairs(frame, truth, detection, shared / (area_a + area_b - shared))}

    dontcare = np.zeros(len(detections))
    regions = truths.name[truth] == DONTCARE
    np.maximum.at(dontcare, detection[regions], (shared / area_b)[regions])

    bev_truths, bev_detections = truths.bev_boxes(), detections.bev_boxes()
    bounds = _bev_bounds(bev_truths), _bev_bounds(bev_detections)
    frame, truth, detection = _meeting(bounds[0], truth_starts, bounds[1], detection_starts).T
    a, b = bev_truths[truth], bev_detections[detection]
    shared = rotated_overlap_pairs(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    pairs["bev"] = Pairs(frame, truth, detection, shared / (area_a + area_b - shared))
    (top_a, bottom_a), (top_b, bottom_b) = truths.select(truth).vertical(), detections.select(detection).vertical()
    shared = shared * np.maximum(np.minimum(bottom_a, bottom_b) - np.maximum(top_a, top_b), 0)
    volume = area_a * a[:, 5] + area_b * b[:, 5] - shared
    pairs["3d"] = Pairs(frame, truth, detection, shared / np.where(volume > 0, volume, 1))
    truth_frame, detection_frame = (
        np.repeat(np.arange(len(labels)), np.diff(starts)) for starts in (truth_starts, detection_starts)
    )
    return Candidates(truths, detections, detections.score, truth_frame, detection_frame, len(labels), pairs, dontcare)


def outside(labels: Labels, level: Level) -> Mask:
    """Which of the labels (K,) are at another distance than the level's; without a 3D box, they have none."""
    near, far = level.distance
    distance = labels.ground_distance()
    return ~((distance >= near) & (distance < far)) & (level.distance != (0, math.inf))


def select_truths(labels: Labels, name: str, level: Level) -> Mask:
    """Which of the labels (K,) are to be found. One with just the minimum of height is not."""
    height = labels.bbox[:, 3] - labels.bbox[:, 1]
    hard = (labels.occlusion > level.max_occlusion) | (labels.truncation > level.max_truncation)
    return (labels.name == name) & ~(hard | (height <= level.min_height) | outside(labels, level))


def clean_data(
    candidates: Candidates, name: str, metric: str, min_overlap: float, level: Level, neighbour: str | None = None
) -> Matching:
    """The devkit's cleaning of the data for one class, metric, overlap and level.

    To find an object of the neighbouring class is neither right nor wrong.
    """
    labels, detections = candidates.truths, candidates.detections
    matchable = (labels.name == name) | (labels.name == (neighbour or name))
    own = detections.name == name
    # the devkit counts whole pixels here, and ignores a low detection of any class: it may hide a ground truth
    height = np.trunc(np.abs(detections.bbox[:, 3] - detections.bbox[:, 1]))
    ignored = (height < level.min_height) | (own & outside(detections, level))
    countable = own & ~ignored
    if metric == "2d":
        countable &= candidates.dontcare <= min_overlap
    pairs = candidates.pairs[metric]
    enough = pairs.overlap > min_overlap
    pairs = pairs.select(enough & matchable[pairs.truth] & (own | ignored)[pairs.detection])
    return Matching(pairs, select_truths(labels, name, level), ignored, countable)


def find_changes(matching: Matching, candidates: Candidates) -> Changes:
    """Matches every frame: once in the devkit's first pass, and in its second at every score a detection has.

    In the first pass nothing is dropped; each ground truth in turn takes the best-scored of the detections left, the
    first of them where scores are equal.
    """
    pairs, score = matching.pairs, candidates.score
    alphas = candidates.truths.alpha, candidates.detections.alpha
    masks = matching.truths, matching.ignored, matching.countable
    changes = _changes(pairs.frame, pairs.truth, pairs.detection, pairs.overlap, score, *masks, *alphas)
    frame, at, *matched = changes.T
    lone = np.flatnonzero(matching.countable)  # a false positive, until a change says that it is taken
    added = np.zeros((4, len(changes) + len(lone)))
    added[:, : len(changes)] = matched
    added[1, len(changes) :] = 1
    scores, row = np.unique(-np.concatenate((at, score[lone])), return_inverse=True)
    first = _found_detections(pairs.truth, pairs.detection, score, matching.truths, matching.ignored)
    first = first[np.argsort(-score[first], kind="stable")]
    return Changes(
        score=-scores,
        row=row,
        frame=np.concatenate((frame.astype(np.int64), candidates.detection_frame[lone])),
        added=added,
        truths=np.bincount(candidates.truth_frame[matching.truths], minlength=candidates.frames),
        first_score=score[first],
        first_frame=candidates.detection_frame[first],
    )


def count(changes: Changes, draws: Integers | None = None) -> Counts:
    """The counts at every score, in which each frame counts as often as it is drawn (F,): once by default."""
    added = changes.added if draws is None else changes.added * draws[changes.frame]
    size = len(changes.score)
    true_positives, false_positives, undecided, similarity = (
        np.bincount(changes.row, values, minlength=size).cumsum() for values in added
    )
    total = changes.truths.sum() if draws is None else changes.truths @ draws
    return Counts(changes.score, true_positives, false_positives, total - true_positives - undecided, similarity)


def found_scores(changes: Changes, draws: Integers | None = None) -> Floats:
    """The scores (T,) of the first pass, the highest first, each as often as its frame is drawn (F,)."""
    return changes.first_score if draws is None else np.repeat(changes.first_score, draws[changes.first_frame])


def match_at(matching: Matching, candidates: Candidates, threshold: float) -> tuple[Integers, Mask]:
    """The detection of each ground truth (G,), -1 for none, without those below a score; and which are taken (D,)."""
    pairs, score = matching.pairs, candidates.score
    matched = np.full(len(candidates.truths), -1)
    taken = np.zeros(len(candidates.detections), np.bool_)
    arrays = pairs.truth, pairs.detection, pairs.overlap, score, matching.ignored
    _assign(*arrays, 0, len(pairs.truth), threshold, matched, taken)
    return matched, taken


def _concatenate(frames: Sequence[Labels]) -> tuple[Labels, Integers]:
    """The rows of all frames, and where each frame's begin (F + 1,)."""
    return concatenate(frames), np.cumsum([0, *(len(frame) for frame in frames)])


def _bev_bounds(boxes: Floats) -> Floats:
    """Least x and y, greatest x and y (K, 4) of boxes (K, 7) in bird's eye view; a box without a size meets nothing."""
    cos, sin = np.abs(np.cos(boxes[:, 6])), np.abs(np.sin(boxes[:, 6]))
    half = np.column_stack((boxes[:, 3] * cos + boxes[:, 4] * sin, boxes[:, 3] * sin + boxes[:, 4] * cos)) / 2
    half[(boxes[:, 3:5] <= 0).any(axis=1)] = -np.inf
    return np.column_stack((boxes[:, :2] - half, boxes[:, :2] + half))


@njit(cache=True, nogil=True)
def _meeting(bounds_a: Floats, starts_a: Integers, bounds_b: Floats, starts_b: Integers) -> Integers:
    """Frame, row in a, row in b (P, 3) of the bounds (., 4) in one frame whose interiors meet."""
    found = np.empty((0, 3), np.int64)
    for fill in (False, True):  # first count, then write
        size = 0
        for frame in range(len(starts_a) - 1):
            for a in range(starts_a[frame], starts_a[frame + 1]):
                for b in range(starts_b[frame], starts_b[frame + 1]):
                    width = min(bounds_a[a, 2], bounds_b[b, 2]) - max(bounds_a[a, 0], bounds_b[b, 0])
                    height = min(bounds_a[a, 3], bounds_b[b, 3]) - max(bounds_a[a, 1], bounds_b[b, 1])
                    if width > 0 and height > 0:
                        if fill:
                            found[size] = frame, a, b
                        size += 1
        if not fill:
            found = np.empty((size, 3), np.int64)
    return found


@njit(cache=True, nogil=True)
def _found_detections(truth: Integers, detection: Integers, score: Floats, truths: Mask, ignored: Mask) -> Integers:
    """The true positives (T,) of the devkit's first pass, in the order of their ground truths."""
    taken = np.zeros(len(score), np.bool_)
    found = np.empty(len(truth), np.int64)
    size = k = 0
    while k < len(truth):
        row, best = truth[k], -1
        while k < len(truth) and truth[k] == row:
            d = detection[k]
            if not taken[d] and (best < 0 or score[d] > score[best]):
                best = d
            k += 1
        if best >= 0:
            taken[best] = True
            if truths[row] and not ignored[best]:
                found[size] = best
                size += 1
    return found[:size]


@njit(cache=True, nogil=True)
def _assign(
    truth: Integers,
    detection: Integers,
    overlap: Floats,
    score: Floats,
    ignored: Mask,
    begin: int,
    end: int,
    threshold: float,
    matched: Integers,
    taken: Mask,
) -> None:
    """Writes to matched and taken the matching of the pairs from begin to end, without detections below the threshold.

    Each ground truth in turn takes, of the detections left, the one with the greatest overlap; an ignored one only if
    there is no other, and then the first.
    """
    k = begin
    while k < end:
        row, best, best_overlap = truth[k], -1, 0.0
        while k < end and truth[k] == row:
            d = detection[k]
            if not taken[d] and score[d] >= threshold:
                if ignored[d]:
                    if best < 0:
                        best = d
                elif overlap[k] > best_overlap:
                    best, best_overlap = d, overlap[k]
            k += 1
        matched[row] = best
        if best >= 0:
            taken[best] = True


@njit(cache=True, nogil=True)
def _changes(
    frame: Integers,
    truth: Integers,
    detection: Integers,
    overlap: Floats,
    score: Floats,
    truths: Mask,
    ignored: Mask,
    countable: Mask,
    truth_alpha: Floats,
    detection_alpha: Floats,
) -> Floats:
    """The changes in the counts as the threshold passes each score of a frame: (E, 6) float64.

    The frame and the score, and the differences in true positives, in false positives (less by the countable detections
    that are taken), in ground truths matched with an ignored detection, and in similarity.
    """
    changes = np.empty((len(truth), 6))
    matched = np.full(len(truths), -1)
    taken = np.zeros(len(score), np.bool_)
    size = begin = 0
    while begin < len(truth):
        end = begin
        while end < len(truth) and frame[end] == frame[begin]:
            end += 1
        before = np.zeros(4)
        for threshold in np.unique(score[detection[begin:end]])[::-1]:
            taken[detection[begin:end]] = False
            _assign(truth, detection, overlap, score, ignored, begin, end, threshold, matched, taken)
            now = np.zeros(4)
            for k in range(begin, end):
                row = truth[k]
                d = matched[row]
                if d < 0 or (k > begin and truth[k - 1] == row):
                    continue
                if countable[d]:
                    now[1] -= 1
                if truths[row] and ignored[d]:
                    now[2] += 1
                elif truths[row]:
                    now[0] += 1
                    now[3] += (1 + np.cos(truth_alpha[row] - detection_alpha[d])) / 2
            changes[size, 0] = frame[begin]
            changes[size, 1] = threshold
            changes[size, 2:] = now - before
            before = now
            size += 1
        begin = end
    return changes[:size]
