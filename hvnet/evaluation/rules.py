"""How much a detection of a class has to overlap a label: KITTI's rules, and those of any other class."""

from collections.abc import Mapping
from typing import NamedTuple

from hvnet.config import Config

METRICS = ("2d", "bev", "3d")
LARGE = 3.0
"""Length in metres from which a class without a rule of its own needs a car's overlap."""


class Rule(NamedTuple):
    """The overlaps of a class by metric, and the similar class whose detections count as neither right nor wrong.

    The neighbour counts for nothing where it is itself a class that is scored.
    """

    strict: Mapping[str, float]
    loose: Mapping[str, float]
    neighbour: str | None = None


KITTI = {
    "Car": Rule({"2d": 0.7, "bev": 0.7, "3d": 0.7}, {"2d": 0.7, "bev": 0.5, "3d": 0.5}, "Van"),
    "Pedestrian": Rule({"2d": 0.5, "bev": 0.5, "3d": 0.5}, {"2d": 0.5, "bev": 0.25, "3d": 0.25}, "Person_sitting"),
    "Cyclist": Rule({"2d": 0.5, "bev": 0.5, "3d": 0.5}, {"2d": 0.5, "bev": 0.25, "3d": 0.25}),
}
"""The classes that KITTI scores."""


def rule_for(name: str, length: float, overlap: float | None = None) -> Rule:
    """The rule of a class: with the given overlap; else KITTI's own for its three, and for others 0.7 for objects of
    LARGE and more metres of length, 0.5 for smaller ones. The loose overlap is 0.5, or half of a strict one up to 0.5.

    length: metres.
    """
    known = KITTI.get(name)
    if known is not None and overlap is None:
        return known
    if overlap is None:
        overlap = 0.7 if length >= LARGE else 0.5
    loose = 0.5 if overlap > 0.5 else overlap / 2
    strict = dict.fromkeys(METRICS, overlap)
    return Rule(strict, {"2d": overlap, "bev": loose, "3d": loose}, known.neighbour if known else None)


def config_rules(config: Config, overlaps: Mapping[str, float] | None = None) -> dict[str, Rule]:
    """The rules of a config's classes: `overlaps` where they name a class, else its `overlap`, else its anchors' size.

    Raises ValueError for an overlap of a class that the config does not have.
    """
    overlaps = overlaps or {}
    rules = {}
    for entry in config.head.classes:
        length = sum(size[0] for size in entry.anchor_sizes) / len(entry.anchor_sizes)
        rules[entry.name] = rule_for(entry.name, length, overlaps.get(entry.name, entry.overlap))
    unknown = [name for name in overlaps if name not in rules]
    if unknown:
        raise ValueError(f"overlaps: {unknown[0]} is not one of the classes {', '.join(rules)}")
    return rules
