"""Runs a detector on frames of any format and scores what it finds."""

import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from hvnet import ranks
from hvnet.config import Config
from hvnet.data.frame import Frame, Frames, check_names, frame_at, notes
from hvnet.data.kitti import centres_to_lidar, detections_to_labels, frame_labels
from hvnet.data.labels import DONTCARE, Labels, count_others
from hvnet.data.sensor import Look
from hvnet.evaluation.bootstrap import Resampling
from hvnet.evaluation.precision import evaluate
from hvnet.evaluation.rules import Rule, config_rules
from hvnet.exceptions import InputError
from hvnet.network.detector import Detector
from hvnet.network.model import Detections


class Detected(NamedTuple):
    """A frame, and what a detector finds in it."""

    k: int  # its number among the frames
    frame: Frame
    found: Detections
    rows: Labels  # the same as the rows of a result file: what is in the image, where there is a camera


def detect_frames(
    detector: Detector, frames: Frames, wanted: Iterable[int] | None = None, seen: set[str] | None = None
) -> Iterator[Detected]:
    """Reads frames and detects in them; the notes on their files are printed, each once (those in `seen` not again)."""
    seen = set() if seen is None else seen
    print_once(notes(frames), seen)
    for k in range(len(frames)) if wanted is None else wanted:
        frame = frame_at(frames, k)
        print_once(frame.notes, seen)
        found = detect_frame(detector, frame)
        names = found.names(detector.classes)
        yield Detected(k, frame, found, detections_to_labels(found.boxes, found.scores, names, frame.camera))


def detect_frame(detector: Detector, frame: Frame) -> Detections:
    """What a detector finds in a frame. Raises InputError naming it if its points are not what a detector takes."""
    try:
        return detector(frame.points)
    except ValueError as error:
        raise InputError(f"frame {frame.name}: {error}") from error


def look_at(detector: Detector, frame: Frame) -> Look:
    """What a detector sees of a frame's cloud; if that is next to nothing, the reason is printed."""
    look = detector.look(frame.points)
    if look.reason and (look.points or frame.camera is None):  # a camera that sees nothing is in the frame's notes
        tqdm.write(f"{frame.name}: {look.in_range:,} of {look.points:,} points are in range: {look.reason}")
    return look


def score(
    detector: Detector,
    frames: Frames,
    *,
    rules: Mapping[str, Rule] | None = None,
    resampling: Resampling | None = None,
    in_range: bool = False,
    visit: Callable[[Detected], None] | None = None,
    seen: set[str] | None = None,
    title: str = "scoring",
    background: bool = True,
) -> dict[str, dict[str, Any]]:
    """Detects in labelled frames and scores the boxes as `evaluate` does, by the rules of the detector's config.

    resampling: adds intervals to the figures, see `evaluate`.
    in_range: labels whose centre is outside the detector's range do not count.
    visit: called for every frame of this rank, in their order.
    background: say how many labels have a class that the detector does not know.

    Each rank takes its share of the frames; the scores are those of all.
    """
    check_names(frames)
    share = range(ranks.rank(), len(frames), ranks.size())
    bar = tqdm(share, desc=title, unit="frame", leave=False, dynamic_ncols=True, disable=ranks.rank() > 0)
    pairs: list[tuple[Labels, Labels]] = []
    for detected in detect_frames(detector, frames, bar, seen):
        truth = labels_in_range(detected.frame, detector.config) if in_range else frame_labels(detected.frame)
        pairs.append((truth, detected.rows))
        if visit is not None:
            visit(detected)
    shares = ranks.all_gather(pairs)
    pairs = [shares[k % len(shares)][k // len(shares)] for k in range(len(frames))]  # in the order of the frames
    truths, found = [truth for truth, _ in pairs], [rows for _, rows in pairs]
    if background and ranks.rank() == 0:
        names = (str(name) for truth in truths for name in truth.name)
        print_once([background_note(names, detector.classes)], set() if seen is None else seen)
    rules = rules or config_rules(detector.config)
    return evaluate(truths, found, classes=detector.classes, rules=rules, resampling=resampling)


def labels_in_range(frame: Frame, config: Config) -> Labels:
    """The labels whose centre is in the config's range, and DontCare."""
    labels = frame_labels(frame)
    low, high = np.reshape(config.encoder.point_range, (2, 3))[:, :2]
    centres = centres_to_lidar(labels, frame.camera)[:, :2]
    near = ((centres >= low) & (centres < high)).all(axis=1)
    return labels.select(near | (labels.name == DONTCARE))


def background_note(names: Iterable[str], classes: Iterable[str]) -> str:
    """How many of the labels have a class that is not among these, in lines of 100 characters; empty if none."""
    names, classes = Counter(names), list(classes)
    others = count_others(names, classes)
    if not others:
        return ""
    known = {name.lower(): name for name in classes}
    alike = [f"{name}={known[name.lower()]}" for name in sorted(names) if known.get(name.lower(), name) != name]
    hint = f"; --classes {','.join(alike)} counts them" if alike else ""
    return textwrap.fill(f"labels of classes that the config does not have count as background: {others}{hint}", 100)


def print_once(notes: Iterable[str], seen: set[str]) -> None:
    """Prints the notes that were not seen before."""
    for text in notes:
        if text and text not in seen:
            seen.add(text)
            tqdm.write(text)
