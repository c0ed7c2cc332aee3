"""How much a detection has to overlap a label: KITTI's table, other classes by size, and what a config says."""

import dataclasses

import pytest

from hvnet.config import ClassConfig, Config
from hvnet.evaluation.rules import KITTI, LARGE, METRICS, Rule, config_rules, rule_for


def test_kittis_table() -> None:
    """Of the devkit, and its loose overlaps, which many papers give beside the strict ones."""
    strict = {name: list(rule.strict.values()) for name, rule in KITTI.items()}
    assert strict == {"Car": [0.7] * 3, "Pedestrian": [0.5] * 3, "Cyclist": [0.5] * 3}
    loose = {name: [rule.loose[metric] for metric in METRICS] for name, rule in KITTI.items()}
    assert loose == {"Car": [0.7, 0.5, 0.5], "Pedestrian": [0.5, 0.25, 0.25], "Cyclist": [0.5, 0.25, 0.25]}
    neighbours = {name: rule.neighbour for name, rule in KITTI.items()}
    assert neighbours == {"Car": "Van", "Pedestrian": "Person_sitting", "Cyclist": None}


@pytest.mark.parametrize("name", KITTI)
@pytest.mark.parametrize("length", [0.0, 0.8, 12.0])
def test_kittis_classes_keep_their_rules_whatever_their_size(name: str, length: float) -> None:
    assert rule_for(name, length) is KITTI[name]


@pytest.mark.parametrize(
    ("length", "strict", "loose"), [(0.0, 0.5, 0.25), (LARGE - 0.01, 0.5, 0.25), (LARGE, 0.7, 0.5), (12.0, 0.7, 0.5)]
)
def test_other_classes_go_by_size(length: float, strict: float, loose: float) -> None:
    rule = rule_for("truck", length)
    assert rule == Rule(dict.fromkeys(METRICS, strict), {"2d": strict, "bev": loose, "3d": loose})
    assert rule.neighbour is None


@pytest.mark.parametrize(("overlap", "loose"), [(1.0, 0.5), (0.6, 0.5), (0.5, 0.25), (0.4, 0.2)])
def test_a_given_overlap(overlap: float, loose: float) -> None:
    """For any class; KITTI's keep their neighbours."""
    for name, neighbour in (("truck", None), ("Car", "Van")):
        rule = rule_for(name, 12.0, overlap)
        assert rule == Rule(dict.fromkeys(METRICS, overlap), {"2d": overlap, "bev": loose, "3d": loose}, neighbour)


def with_classes(config: Config, *entries: ClassConfig) -> Config:
    return dataclasses.replace(config, head=dataclasses.replace(config.head, classes=entries))


def test_rules_of_a_config(demo: Config) -> None:
    """Given overlaps come first, then the config's, then the mean length of the anchors."""
    assert config_rules(demo) == KITTI
    base = demo.head.classes[0]
    config = with_classes(
        demo,
        dataclasses.replace(base, name="bus", anchor_sizes=((10.0, 2.5, 3.0),)),
        dataclasses.replace(base, name="trailer", anchor_sizes=((2.0, 1.0, 1.0), (3.5, 1.0, 1.0))),
        dataclasses.replace(base, name="train", anchor_sizes=((2.0, 1.0, 1.0), (4.0, 1.0, 1.0))),
        dataclasses.replace(base, name="bicycle", overlap=0.3),
        dataclasses.replace(base, name="Car", overlap=0.6),
    )
    rules = config_rules(config)
    assert {name: rule.strict["bev"] for name, rule in rules.items()} == {
        "bus": 0.7, "trailer": 0.5, "train": 0.7, "bicycle": 0.3, "Car": 0.6
    }  # fmt: skip
    assert list(rules) == ["bus", "trailer", "train", "bicycle", "Car"]  # in the order that labels number
    assert rules["Car"].neighbour == "Van"
    given = config_rules(config, {"bicycle": 0.4, "bus": 0.2})
    assert (given["bicycle"].strict["3d"], given["bus"].strict["3d"], given["Car"]) == (0.4, 0.2, rules["Car"])


def test_an_overlap_of_no_class_is_refused(demo: Config) -> None:
    with pytest.raises(ValueError, match="overlaps: Truck is not one of the classes Car, Pedestrian, Cyclist"):
        config_rules(demo, {"Car": 0.5, "Truck": 0.5})
