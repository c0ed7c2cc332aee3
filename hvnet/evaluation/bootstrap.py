"""How uncertain figures are because frames are few: a bootstrap over frames, or over groups of frames such as drives.

A resample draws as many groups as there are, with replacement; AP of many resamples gives a percentile interval
(Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13).
"""

from collections.abc import Hashable, Sequence
from typing import Any, NamedTuple

import numpy as np

from hvnet.evaluation.matching import Floats, Integers

CONFIDENCE = 95
"""Of an interval, in per cent."""
MIN_RESAMPLES = 100
"""With fewer, the ends of an interval are hardly more than the extremes."""


class Resampling(NamedTuple):
    """What is drawn of F frames."""

    draws: Integers  # (N, F) how often each resample holds each frame
    group: Integers  # (F,) the group of each frame, counted from 0

    @property
    def groups(self) -> int:
        """Number of groups."""
        return int(self.group.max()) + 1


def resample(resamples: int, groups: Sequence[Hashable], *, seed: int = 0) -> Resampling:
    """Draws groups of frames, with replacement, as many as there are.

    groups: for every frame its group, such as its drive, or its own name to draw single frames.
    """
    places: dict[Hashable, int] = {}
    group = np.array([places.setdefault(name, len(places)) for name in groups], np.int64)
    drawn = np.random.default_rng(seed).integers(len(places), size=(resamples, len(places)))
    return Resampling(np.array([np.bincount(row, minlength=len(places))[group] for row in drawn]), group)


def interval(values: Floats) -> list[float] | None:
    """The ends of the percentile interval of resampled figures (N,), without those that are NaN; None if all are."""
    known = values[~np.isnan(values)]
    if not len(known):
        return None
    tail = (100 - CONFIDENCE) / 2
    return np.percentile(known, (tail, 100 - tail)).tolist()


def differences(
    result: dict[str, dict[str, Any]], other: dict[str, dict[str, Any]]
) -> dict[str, dict[str, dict[str, list[list[float] | None]]]]:
    """How much higher AP is in one result of `evaluate` than in another, of the same labels and resampling.

    By class, strictness and metric, for every level the difference of the exact AP in points and the ends of its
    interval; None without ground truths.
    """
    found: dict[str, dict[str, dict[str, list[list[float] | None]]]] = {}
    for name, a in result.items():
        b, found[name] = other[name], {}
        for strictness, tables in (("strict", (a, b)), ("loose", (a["loose"], b["loose"]))):
            figures_a, figures_b = (table["exact"] for table in tables)
            drawn_a, drawn_b = (each["resampled"][strictness]["exact"] for each in (a, b))
            found[name][strictness] = {
                key: [
                    [x - y, *ends] if (ends := interval(p - q)) else None
                    for x, y, p, q in zip(figures_a[key], figures_b[key], drawn_a[key], drawn_b[key], strict=True)
                ]
                for key in figures_a
                if key in figures_b
            }
    return found
