"""The configuration: shipped files, round trips, and every kind of mistake refused with file and dotted key."""

import copy
import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from hvnet.config import (
    AugmentConfig,
    BackboneConfig,
    Config,
    EncoderConfig,
    LossConfig,
    TrainConfig,
    config_from_dict,
    config_to_dict,
    load_config,
)
from hvnet.exceptions import InputError
from tests.models import CONFIGS

SHIPPED = sorted(CONFIGS.glob("*.yaml"))


@pytest.fixture
def tree() -> dict[str, Any]:
    return yaml.safe_load((CONFIGS / "demo.yaml").read_text())


def changed(tree: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """The tree with one value set; a key such as head.classes.0.level goes into lists, too."""
    tree = copy.deepcopy(tree)
    node: Any = tree
    *parents, last = key.split(".")
    for parent in parents:
        node = node[int(parent)] if isinstance(node, list) else node.setdefault(parent, {})
    node[last] = value
    return tree


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_configs_load_and_survive_the_round_trip(path: Path) -> None:
    config = load_config(path)
    plain = config_to_dict(config)
    assert config_from_dict(plain, "again") == config
    assert config_from_dict(yaml.safe_load(yaml.safe_dump(plain)), "again") == config
    given = yaml.safe_load(path.read_text())
    for group, values in given.items():
        if isinstance(values, dict):
            for key, value in values.items():
                if key != "classes":
                    assert plain[group][key] == value, f"{group}.{key}"
    if "base" not in given:
        for entry, made in zip(given["head"]["classes"], plain["head"]["classes"], strict=True):
            assert made == {"overlap": None} | entry


def test_the_demo_is_shipped() -> None:
    assert {"demo", "hvnet"} <= {path.stem for path in SHIPPED}


def test_every_field_can_be_given(tree: dict[str, Any]) -> None:
    """Each field of the resolved config can stand in the file."""
    config = config_from_dict(tree, "demo")
    for group, kind in (("encoder", EncoderConfig), ("backbone", BackboneConfig), ("loss", LossConfig),
                        ("augment", AugmentConfig), ("train", TrainConfig)):  # fmt: skip
        plain = config_to_dict(config)[group]
        assert set(plain) == {field.name for field in dataclasses.fields(kind)}
        for key, value in plain.items():
            again = config_from_dict(changed(tree, f"{group}.{key}", value), "demo")
            assert again == config, f"{group}.{key}"


def test_left_out_groups_have_the_papers_values(tree: dict[str, Any]) -> None:
    config = config_from_dict({"head": {"classes": tree["head"]["classes"]}}, "short")
    assert config.encoder == EncoderConfig()
    assert config.train == TrainConfig()
    assert config.synthetic is None


def test_whole_numbers_are_numbers(tree: dict[str, Any]) -> None:
    config = config_from_dict(changed(tree, "train.learning_rate", 1), "file")
    assert config.train.learning_rate == 1.0
    assert isinstance(config.train.learning_rate, float)


@pytest.mark.parametrize(
    ("key", "value", "where", "what"),
    [
        ("trian", {}, "trian", "unknown key; known here: head, encoder"),
        ("train.epoch", 3, "train.epoch", "unknown key; known here: epochs, batch_size"),
        ("head.classes.0.anchors", 3, "head.classes[0].anchors", "unknown key"),
        (
            "train.learning_rate",
            "1e-3",
            "train.learning_rate",
            r"want a number \(YAML reads 1e-3 as text: write 1.0e-3\)",
        ),
        ("train.learning_rate", True, "train.learning_rate", "want a number, got True"),
        ("train.learning_rate", 10**400, "train.learning_rate", "want a number, got 1000"),
        ("train.learning_rate", float("nan"), "train.learning_rate", "want a finite number, got nan"),
        ("train.gradient_clip", float("inf"), "train.gradient_clip", "want a finite number, got inf"),
        ("train.epochs", True, "train.epochs", "want a whole number, got True"),
        ("train.epochs", 3.0, "train.epochs", r"want a whole number, got 3.0 \(float\)"),
        ("train.epochs", None, "train.epochs", "want a whole number, got None"),
        ("train.bfloat16", 1, "train.bfloat16", "want true or false, got 1"),
        ("train.train_split", 3, "train.train_split", "want text, got 3"),
        ("train", None, "train", "want a mapping with the keys epochs"),
        ("train", [1], "train", "want a mapping"),
        ("encoder.voxel_size", 0.4, "encoder.voxel_size", "want a list, got 0.4"),
        ("encoder.voxel_size", [1.0e-6, 0.1], "encoder.voxel_size", "want at most 67108864 cells in the finest"),
        ("encoder.voxel_size", "0.4", "encoder.voxel_size", "want a list"),
        ("encoder.voxel_size", [0.4], "encoder.voxel_size", "want a list of 2"),
        ("encoder.voxel_size", [0.4, "x"], "encoder.voxel_size[1]", "want a number"),
        ("encoder.point_range", [0, 1, 2], "encoder.point_range", "want a list of 6"),
        ("head.classes.1.anchor_sizes", [[1, 2]], "head.classes[1].anchor_sizes[0]", "want a list of 3"),
        ("augment.objects", [3], "augment.objects", "want a mapping"),
        ("augment.objects", {"Car": 1.5}, "augment.objects.Car", "want a whole number"),
        ("augment.objects", {1: 1}, "augment.objects", "want text, got 1"),
        # impossible values
        ("augment.objects", {"Tram": 1}, "augment.objects.Tram", "want a class of head.classes"),
        ("augment.objects", {"Car": -1}, "augment.objects.Car", "want 0 or more"),
        ("augment.flip", 1.5, "augment.flip", "want between 0 and 1"),
        ("augment.fade_out", -1, "augment.fade_out", r"want 0 \(none\) or more"),
        ("augment.rotation", -1, "augment.rotation", "want 0 or more"),
        ("augment.pitch", 1, "augment.pitch", r"want 0 to 0.2 \(11 degrees\)"),
        ("augment.fewer_beams", 1.1, "augment.fewer_beams", "want between 0 and 1"),
        ("augment.no_reflectance", -0.1, "augment.no_reflectance", "want between 0 and 1"),
        ("augment.reflectance", [0, 1], "augment.reflectance", "want 0 < low <= high"),
        ("augment.scaling", [1.1, 0.9], "augment.scaling", "want 0 < low <= high"),
        ("augment.translation", [0, 0, -1], "augment.translation", "want 0 or more"),
        ("encoder.point_range", [0, 5, 0, 1, 5, 1], "encoder.point_range", "want x_min, y_min, z_min below"),
        ("encoder.voxel_size", [0.4, 0], "encoder.voxel_size", "want sizes above 0"),
        ("encoder.feature_scales", [], "encoder.feature_scales", "want scales above 0"),
        ("encoder.feature_scales", [1, -1], "encoder.feature_scales", "want scales above 0"),
        ("encoder.feature_scales", [1, 1], "encoder.feature_scales", "want no scale twice"),
        ("encoder.projection_scales", [0, 0, 0], "encoder.projection_scales", "want scales above 0"),
        ("encoder.projection_scales", [1, 2, 3], "encoder.projection_scales[2]", "want twice the scale before, 4.0"),
        ("encoder.projection_scales", [4, 2, 1], "encoder.projection_scales[1]", "want twice the scale before, 8.0"),
        ("encoder.feature_channels", 0, "encoder.feature_channels", "want 1 to 4096"),
        ("encoder.image_channels", -3, "encoder.image_channels", "want 1 to 4096"),
        ("backbone.widths", [16, 32], "backbone.widths", "want 3 values, one a block"),
        ("backbone.widths", [16, 32, 0], "backbone.widths", "want values from 1 to 4096"),
        ("backbone.widths", [16, 32, 10**6], "backbone.widths", "want values from 1 to 4096"),
        ("backbone.layers", [3, 3, 10**9], "backbone.layers", "want 200 or fewer"),
        ("loss.beta", 0.0, "loss.beta", "want above 0"),
        ("backbone.layers", [3, 4, 4, 4], "backbone.layers", "want 3 values, one a block"),
        ("backbone.layers", [3, 1, 4], "backbone.layers", "want 2 or more"),
        ("backbone.fusion_channels", 0, "backbone.fusion_channels", "want 1 to 4096"),
        ("head.classes", [], "head.classes", "want at least one class"),
        ("head.classes.1.name", "Car", "head.classes", "want no class twice"),
        ("head.classes.0.level", 3, "head.classes[0].level", "want 0, 1 or 2"),
        ("head.classes.0.level", -1, "head.classes[0].level", "want 0, 1 or 2"),
        ("head.classes.0.anchor_sizes", [], "head.classes[0].anchor_sizes", "want at least one size"),
        ("head.classes.0.anchor_sizes", [[1, 0, 1]], "head.classes[0].anchor_sizes", "want sizes above 0"),
        ("head.classes.0.positive_iou", 0, "head.classes[0].positive_iou", "want above 0 and at most 1"),
        ("head.classes.0.positive_iou", 1.1, "head.classes[0].positive_iou", "want above 0 and at most 1"),
        ("head.classes.2.negative_iou", 0.36, "head.classes[2].negative_iou", "want between 0 and positive_iou"),
        ("head.classes.0.focal_alpha", 2, "head.classes[0].focal_alpha", "want between 0 and 1"),
        ("head.classes.0.focal_gamma", -1, "head.classes[0].focal_gamma", "want 0 or more"),
        ("head.classes.0.nms_iou", 1.5, "head.classes[0].nms_iou", "want between 0 and 1"),
        ("head.classes.0.overlap", 0, "head.classes[0].overlap", "want above 0 and at most 1, got 0"),
        ("head.classes.0.overlap", 1.1, "head.classes[0].overlap", "want above 0 and at most 1, got 1.1"),
        ("head.classes.0.overlap", "half", "head.classes[0].overlap", r"want a number \(YAML"),
        ("head.classes.0.name", "traffic cone", "head.classes[0].name", "want a word, as in the label files, but not"),
        ("head.classes.0.name", "", "head.classes[0].name", "want a word"),
        ("head.classes.0.name", "DontCare", "head.classes[0].name", "want a word, as in the label files, but not Dont"),
        ("head.score_threshold", 1, "head.score_threshold", "want at least 0 and below 1"),
        ("head.candidates", 0, "head.candidates", "want 1 or more"),
        ("head.detections", 0, "head.detections", "want 1 or more"),
        ("loss.vertical", -0.1, "loss.vertical", "want 0 or more"),
        ("train.epochs", 0, "train.epochs", "want 1 or more"),
        ("train.batch_size", 0, "train.batch_size", "want 1 or more"),
        ("train.validate_every", 0, "train.validate_every", "want 1 or more"),
        ("train.report_every", 0, "train.report_every", "want 1 or more"),
        ("train.warmup_steps", -1, "train.warmup_steps", "want 0 or more"),
        ("train.workers", -1, "train.workers", "want 0 or more"),
        ("train.weight_decay", -1, "train.weight_decay", "want 0 or more"),
        ("train.average", 1, "train.average", "want at least 0 and below 1"),
        ("train.seed", -1, "train.seed", "want 0 or more"),
        ("train.seed", 2**63, "train.seed", "want below"),
        ("train.learning_rate", 0, "train.learning_rate", "want above 0"),
        ("train.decay_ratio", 0, "train.decay_ratio", "want above 0"),
        ("train.decay_epochs", [9, -1], "train.decay_epochs", "want epochs above 0"),
        ("train.gradient_clip", 0, "train.gradient_clip", "want above 0"),
        ("synthetic.train_frames", 0, "synthetic.train_frames", "want 1 or more"),
    ],
)
def test_mistakes_are_refused(tree: dict[str, Any], key: str, value: Any, where: str, what: str) -> None:
    with pytest.raises(InputError, match=rf"^some/file\.yaml: {re.escape(where)}: {what}"):
        config_from_dict(changed(tree, key, value), "some/file.yaml")


def test_any_word_is_a_class(tree: dict[str, Any]) -> None:
    named = changed(changed(tree, "head.classes.0.name", "truck2"), "head.classes.0.overlap", 0.4)
    config = config_from_dict(changed(named, "augment.objects", {"truck2": 3}), "file")
    assert (config.head.classes[0].name, config.head.classes[0].overlap) == ("truck2", 0.4)
    assert [entry.overlap for entry in config.head.classes[1:]] == [None, None]  # by size
    with pytest.raises(InputError, match=r"^file: augment\.objects\.Car: want a class of head\.classes \(truck2, Pede"):
        config_from_dict(named, "file")


def test_a_missing_key_is_named(tree: dict[str, Any]) -> None:
    del tree["head"]["classes"][1]["level"]
    with pytest.raises(InputError, match=r"^file: head\.classes\[1\]\.level: missing; it has no default"):
        config_from_dict(tree, "file")
    with pytest.raises(InputError, match=r"^file: head: missing"):
        config_from_dict({}, "file")


def test_overrides(tree: dict[str, Any]) -> None:
    config = load_config(
        CONFIGS / "demo.yaml",
        [
            "train.epochs=3",
            "train.learning_rate=1.0e-4",
            "train.bfloat16=true",
            "train.val_split=trainval",
            "encoder.feature_scales=[1, 2]",
            "augment.objects={Car: 2}",
            "augment.objects.Cyclist=1",
            "loss.vertical=2",  # the file has no key loss
            "synthetic=null",
        ],
    )
    assert (config.train.epochs, config.train.learning_rate, config.train.bfloat16) == (3, 1e-4, True)
    assert config.train.val_split == "trainval"
    assert config.encoder.feature_scales == (1.0, 2.0)
    assert config.augment.objects == {"Car": 2, "Cyclist": 1}
    assert config.loss.vertical == 2.0
    assert config.synthetic is None
    rest = dataclasses.replace(config, train=load_config(CONFIGS / "demo.yaml").train)
    assert isinstance(rest, Config)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("train.epochs", r"--set train\.epochs: want KEY=VALUE"),
        ("=3", "--set =3: want KEY=VALUE"),
        ("train.epochs.more=3", r"--set train\.epochs\.more=3: epochs is no group of keys"),
        ("head.classes.name=Car", r"--set head\.classes\.name=Car: classes is no group of keys"),
        ("train.epochs=[", r"--set train\.epochs=\[: '\[' is not a valid YAML value"),
        ("train.epochs=2024-13-01", r"--set train\.epochs=2024-13-01: '2024-13-01' is not a valid YAML value"),
        ("train.epoch=3", r"demo\.yaml: train\.epoch: unknown key"),
        ("train.learning_rate=1e-3", r"demo\.yaml: train\.learning_rate: want a number .*write 1\.0e-3"),
        ("train.epochs=", r"demo\.yaml: train\.epochs: want a whole number, got None"),
    ],
)
def test_bad_overrides(override: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_config(CONFIGS / "demo.yaml", [override])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"head: [", "is not valid YAML"),
        (b"head: &a [*b]", "is not valid YAML"),
        (b"head: 2024-13-01", "is not valid YAML"),
        (b"a\tb:\n\t- c", "is not valid YAML"),
        (b"\xff\xfe\x00", "cannot be read"),
        (b"", "want a mapping with the keys head, encoder"),
        (b"- 1\n- 2", "want a mapping"),
        (b"just text", "want a mapping"),
        (b"3: 4", "3: unknown key"),
    ],
)
def test_files_that_are_no_config(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"bad\.yaml: {message}") as caught:
        load_config(path)
    assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml: cannot be read"):
        load_config(tmp_path / "none.yaml")
    with pytest.raises(InputError, match=re.escape(f"{tmp_path}: cannot be read")):
        load_config(tmp_path)


def write(folder: Path, **files: str) -> None:
    for name, text in files.items():
        (folder / f"{name}.yaml").write_text(text)


def test_a_file_is_laid_over_its_base(tmp_path: Path, tree: dict[str, Any]) -> None:
    """Mappings key by key, classes by name, null takes away, lists and values are replaced; bases have bases."""
    write(
        tmp_path,
        bottom=yaml.safe_dump(tree),
        middle="base: bottom.yaml\ntrain: {epochs: 5, batch_size: 7}\nencoder: {feature_scales: [1, 2]}",
        top="base: middle.yaml\ntrain: {batch_size: null}\n"
        "head: {classes: {Car: {focal_alpha: 0.5}, Cyclist: null}}\naugment: {objects: {Cyclist: null}}",
    )
    below, config = load_config(tmp_path / "bottom.yaml"), load_config(tmp_path / "top.yaml")
    assert (config.train.epochs, config.train.batch_size) == (5, TrainConfig.batch_size)
    assert config.encoder == dataclasses.replace(below.encoder, feature_scales=(1.0, 2.0))
    car, pedestrian, _ = below.head.classes
    assert config.head.classes == (dataclasses.replace(car, focal_alpha=0.5), pedestrian)
    assert config.augment.objects == {"Car": 15, "Pedestrian": 8}
    other = dict(tree, train={"epochs": 1, "weight_decay": 0.25})
    write(tmp_path, other=yaml.safe_dump(other))
    replacement = (tmp_path / "bottom.yaml", tmp_path / "other.yaml")
    rebased = load_config(tmp_path / "top.yaml", ["head.classes.Car.level=2"], replacement)
    assert (rebased.train.epochs, rebased.train.weight_decay) == (5, 0.25)  # the middle stays, the bottom is another
    assert rebased.head.classes[0].level == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: none.yaml", r"none\.yaml: cannot be read"),
        ("base: 3", r"a\.yaml: base: want the path of a YAML file, got 3"),
        ("base: a.yaml", r"a\.yaml: base: is its own base"),
        ("base: b.yaml", r"a\.yaml: base: is its own base"),
        ("base: good.yaml\nhead: {classes: {Truck: null}}", r"a\.yaml: head\.classes\.Truck: no such entry below"),
        ("base: good.yaml\nencoder: {vfe: dense}", r"a\.yaml: encoder\.vfe: want one of attentive, plain, pillar"),
        ("base: good.yaml\nencoder: {vfe: pillar}", r"a\.yaml: encoder\.feature_scales: want \[1\.0\] for pillars"),
        ("base: good.yaml\nencoder: {voxel_limit: 9}", r"a\.yaml: encoder\.voxel_limit: want a point_limit with"),
        ("base: good.yaml\nencoder: {point_limit: -1}", r"a\.yaml: encoder\.point_limit: want 0 \(none\) or more"),
        ("base: good.yaml\nbackbone: {stride: 2}", r"a\.yaml: backbone\.stride: want 1 where a second image joins"),
        (
            "base: good.yaml\nbackbone: {pyramid: upsampled}",
            r"a\.yaml: head\.classes\[0\]\.level: want 0, the only one",
        ),
        ("base: good.yaml\nhead: {regression: angle}", r"a\.yaml: head\.regression: want one of corners, pose"),
        ("base: good.yaml\nloss: {box: l2}", r"a\.yaml: loss\.box: want one of smooth_l1, iou, giou"),
    ],
)
def test_mistakes_in_files_with_a_base(tmp_path: Path, tree: dict[str, Any], text: str, message: str) -> None:
    write(tmp_path, good=yaml.safe_dump(tree), a=text, b="base: a.yaml")
    with pytest.raises(InputError, match=message):
        load_config(tmp_path / "a.yaml")
