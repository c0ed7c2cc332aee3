"""The configuration: a tree of frozen dataclasses, read from YAML. Unknown keys, wrong types and impossible values
are rejected with the dotted key. Defaults are the paper's (Sec. 4.1), see configs/hvnet.yaml."""

import dataclasses
import itertools
import math
import sys
import types
import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import yaml

from hvnet.exceptions import InputError

MAX_CELLS = 2**26
"""Cells of the finest pseudo-image: 8192 x 8192; with 32 channels that is 8 GiB a sample."""
MAX_CHANNELS = 4096
MAX_LAYERS = 200
"""Layers of a block. Larger configs are rejected as mistakes before they use up all memory."""
COLUMNS = "x, y and z once each, i (the reflectance) at most once, and _ for any other number"


@dataclass(frozen=True)
class EncoderConfig:
    """Hybrid voxel feature extraction: the scales S_T and S_R are multiples of the voxel size."""

    point_range: tuple[float, float, float, float, float, float] = (0.0, -32.0, -3.0, 64.0, 32.0, 2.0)
    voxel_size: tuple[float, float] = (0.2, 0.2)  # v_L, v_W in metres
    flat_ground: bool = False  # heights are those above the ground under a point, so that slopes are taken out
    feature_scales: tuple[float, ...] = (0.5, 1.0, 2.0)  # S_T
    projection_scales: tuple[float, ...] = (1.0, 2.0, 4.0)  # S_R, each twice the one before
    feature_channels: int = 64  # q
    image_channels: int = 128  # N_H
    # AVFE and AVFEO; VoxelNet's VFE layers in their place; or one layer of PointPillars' features
    vfe: Literal["attentive", "plain", "pillar"] = "attentive"
    attention_relu: bool = False  # a ReLU before the product of the AVFE layers
    point_limit: int = 0  # hard voxels: maximum points per voxel of voxel_size, the others are dropped; 0: no limit
    voxel_limit: int = 0  # maximum number of such voxels per sample


@dataclass(frozen=True)
class BackboneConfig:
    """Main stream and pyramid: one width and one number of layers per block; further blocks repeat the last entry."""

    widths: tuple[int, ...] = (64, 128, 256)
    layers: tuple[int, ...] = (3, 5, 5)
    stride: int = 1  # of the first block: PointPillars has 2
    pyramid: Literal["ffpn", "fpn", "none", "upsampled"] = "ffpn"  # "upsampled": PointPillars' one map for all classes
    fusion_channels: int = 128  # of each Psi and of each pyramid level


@dataclass(frozen=True)
class ClassConfig:
    """One class: its anchors, its matching thresholds, its focal loss and its NMS."""

    name: str
    level: int  # pyramid level: 0 at the finest projection grid, each next one half of it
    anchor_sizes: tuple[tuple[float, float, float], ...]  # length, width, height in metres
    anchor_z: float  # height of the anchors' centres in metres
    positive_iou: float
    negative_iou: float
    focal_alpha: float
    focal_gamma: float
    nms_iou: float
    overlap: float | None = None  # IoU with a label that a detection needs in the evaluation; default: by size


@dataclass(frozen=True)
class HeadConfig:
    """Detection heads, and what `detect` reports."""

    classes: tuple[ClassConfig, ...]
    regression: Literal["corners", "pose"] = "corners"  # of the BEV box: its corners, or x, y, l, w and theta
    direction: bool = False  # the two-bin heading branch
    iou: bool = False  # predicts the box's IoU: the score is the geometric mean of this and the class's
    score_threshold: float = 0.2
    candidates: int = 1000  # highest-scoring anchors of a class that go into NMS
    detections: int = 100  # maximum number of boxes reported per class


@dataclass(frozen=True)
class LossConfig:
    """Weights of the total loss (the paper's lambdas; the direction branch has SECOND's 0.2), and what is summed."""

    localization: float = 1.0
    classification: float = 1.0
    vertical: float = 1.5
    direction: float = 0.2
    iou: float = 1.0
    box: Literal["smooth_l1", "iou", "giou"] = "smooth_l1"  # box loss: of the offsets, or 1 - IoU or GIoU
    uncertainty: bool = False  # learn the weights as well (Kendall et al., CVPR 2018)
    beta: float = 1.0  # error at which smooth L1 turns linear: metres for corners; SECOND's sigma of 3 is 1/9


@dataclass(frozen=True)
class AugmentConfig:
    """Augmentation of the training frames."""

    flip: float = 0.5  # probability
    rotation: float = math.pi / 2  # uniform in [-rotation, rotation], radians
    scaling: tuple[float, float] = (0.95, 1.05)
    translation: tuple[float, float, float] = (0.2, 0.2, 0.2)  # standard deviations in metres
    objects: dict[str, int] = field(default_factory=dict)  # objects of a class after ground-truth sampling
    whole_frames: float = 0.0  # probability that all objects of one frame of the database are inserted instead
    occlusion: bool = False  # inserted objects hide what is behind them, and are hidden by what is before them
    fade_out: int = 0  # last epochs of a run in which no object is inserted
    mix: float = 0.0  # probability that a sector of the frame is taken from another frame
    # frames as other sensors see them
    fewer_beams: float = 0.0  # probability that beams of an HDL-64E are left out
    no_reflectance: float = 0.0  # probability that the reflectance is 0, as where a sensor has none
    reflectance: tuple[float, float] = (1.0, 1.0)  # limits of a factor for the reflectance, which stays below 1
    pitch: float = 0.0  # about the y axis, uniform in [-pitch, pitch], radians


@dataclass(frozen=True)
class SyntheticConfig:
    """Scenes generated when no data folder is given."""

    train_frames: int
    val_frames: int


@dataclass(frozen=True)
class DataConfig:
    """How clouds and labels are read (docs/sensors.md). What is not given is found out from the clouds."""

    columns: tuple[str, ...] = ()  # the numbers of a point in .bin and .npy files: x, y, z, i, and _ for any other
    reflectance_scale: float | None = None  # what the reflectance is divided by; 0: it is left out
    sensor_height: float | None = None  # metres of the LiDAR above the road
    classes: dict[str, str] = field(default_factory=dict)  # names in the labels, and the classes that they count as


@dataclass(frozen=True)
class TrainConfig:
    """Optimisation, validation and what is written."""

    epochs: int = 70
    batch_size: int = 4
    learning_rate: float = 2e-4
    weight_decay: float = 1e-4
    warmup_steps: int = 300
    warmup_ratio: float = 1 / 3
    decay_epochs: tuple[int, ...] = (40, 60)
    decay_ratio: float = 0.1
    cosine: bool = False  # after the warm-up half a cosine down to zero, instead of the steps at decay_epochs
    repeat: int = 1  # passes over the frames in an epoch, augmented differently each time
    drives: str = ""  # CSV file in the data's folder with the columns frame and drive: long drives are weighed down
    gradient_clip: float = 10.0  # largest norm of the gradient
    average: float = 0.0  # decay a step of the moving average of the weights, which is then validated; 0: no average
    validate_every: int = 10  # epochs; the last epoch is always validated
    report_every: int = 1  # steps; between reports a GPU is not waited for
    pictures: int = 4  # validation frames drawn
    workers: int = 0  # processes that read and augment
    bfloat16: bool = False  # backbone and heads in bfloat16; the encoder stays in float32
    skip_corrupt: bool = False  # report an unreadable frame and use the next one, instead of stopping
    skip_non_finite: bool = False  # log and skip a step whose loss is not finite, instead of stopping
    train_split: str = "train"
    val_split: str = "val"
    seed: int = 0


@dataclass(frozen=True)
class Config:
    """Everything that a run depends on, except its data."""

    head: HeadConfig
    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    backbone: BackboneConfig = field(default_factory=BackboneConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    data: DataConfig = field(default_factory=DataConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    synthetic: SyntheticConfig | None = None


def load_config(
    path: str | Path, overrides: Sequence[str] = (), replace_base: tuple[Path, Path] | None = None
) -> Config:
    """Reads a YAML file and applies overrides such as "train.epochs=3".

    A file with a key `base`, the path of another file relative to its own folder, holds only the differences to that
    file. They are merged into it: mappings key by key, the list of classes by a mapping of their names; null removes a
    key or a class. With `replace_base`, (file, other), the other takes the file's place among the bases.

    Raises InputError naming file and key.
    """
    tree = _read_chain(Path(path), replace_base, ())
    for override in overrides:
        _override(tree, override)
    return config_from_dict(tree, str(path))


def _read_chain(path: Path, replace_base: tuple[Path, Path] | None, seen: tuple[Path, ...]) -> dict[str, Any]:
    """The tree of a file, merged into that of its base."""
    if replace_base is not None and path.resolve() == replace_base[0].resolve():
        return _read_chain(replace_base[1], None, ())
    if path.resolve() in seen:
        raise InputError(f"{path}: base: is its own base; name another file")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); give an existing YAML file") from error
    try:
        tree = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: 2024-13-01 looks like a date
        raise InputError(f"{path}: is not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(tree, dict):
        raise InputError(f"{path}: want a mapping with the keys {', '.join(_keys(Config))}")
    if "base" not in tree:
        return tree
    below = tree.pop("base")
    if not isinstance(below, str):
        raise InputError(f"{path}: base: want the path of a YAML file, got {below!r}")
    return _merge(_read_chain(path.parent / below, replace_base, (*seen, path.resolve())), tree, str(path), "")


def _merge(below: Any, above: Any, source: str, key: str) -> Any:
    """The value `above` merged into the value `below` of a dotted key."""
    if not isinstance(above, dict):
        return above
    if isinstance(below, list) and all(isinstance(entry, dict) and "name" in entry for entry in below):
        named = {str(entry["name"]): entry for entry in below}
        unknown = [str(name) for name in above if name not in named]
        if unknown:
            raise InputError(f"{source}: {key}.{unknown[0]}: no such entry below; known: {', '.join(named)}")
        return list(_merge(named, above, source, key).values())
    made = dict(below) if isinstance(below, dict) else {}
    for name, value in above.items():
        if value is None:
            made.pop(name, None)
        else:
            made[name] = _merge(made.get(name), value, source, f"{key}.{name}" if key else str(name))
    return made


def config_from_dict(tree: dict[str, Any], source: str) -> Config:
    """Builds a Config from plain data (a YAML file, a checkpoint); source names it in errors."""
    config = _build(Config, tree, "", source)
    _check(config, source)
    return config


def config_to_dict(config: Config) -> dict[str, Any]:
    """The resolved config as plain dicts, lists, numbers and strings."""
    return _plain(dataclasses.asdict(config))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def _override(tree: dict[str, Any], override: str) -> None:
    """Sets KEY=VALUE in the tree; a class is a key of the list of classes."""
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise InputError(f"--set {override}: want KEY=VALUE, such as train.epochs=3")
    *parents, last = key.split(".")
    node: Any = tree
    for parent in parents:
        if isinstance(node, list):
            node = next((entry for entry in node if isinstance(entry, dict) and entry.get("name") == parent), None)
        else:
            node = node.setdefault(parent, {})
        if not isinstance(node, dict) and not (isinstance(node, list) and parent == "classes"):
            raise InputError(f"--set {override}: {parent} is no group of keys")
    if isinstance(node, list):
        raise InputError(f"--set {override}: {parents[-1]} is no group of keys")
    try:
        node[last] = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"--set {override}: {text!r} is not a valid YAML value") from error


def _keys(kind: Any) -> list[str]:
    return [entry.name for entry in dataclasses.fields(kind)]


def _build(kind: Any, value: Any, key: str, source: str) -> Any:
    """The value as the annotated type, or an InputError with the dotted key."""

    def wrong(wanted: str) -> InputError:
        shown = repr(value)
        shown = shown if len(shown) < 200 else shown[:200] + "..."
        return InputError(f"{source}: {key}: want {wanted}, got {shown} ({type(value).__name__})")

    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise wrong(f"a mapping with the keys {', '.join(_keys(kind))}")
        unknown = [str(name) for name in value if name not in _keys(kind)]
        if unknown:
            where = f"{key}.{unknown[0]}" if key else unknown[0]
            raise InputError(f"{source}: {where}: unknown key; known here: {', '.join(_keys(kind))}")
        hints = typing.get_type_hints(kind)
        made = {}
        for entry in dataclasses.fields(kind):
            where = f"{key}.{entry.name}" if key else entry.name
            if entry.name in value:
                made[entry.name] = _build(hints[entry.name], value[entry.name], where, source)
            elif entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING:
                raise InputError(f"{source}: {where}: missing; it has no default")
        return kind(**made)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value not in inner or not isinstance(value, str):
            raise wrong(f"one of {', '.join(inner)}")
        return value
    if origin is types.UnionType:
        return None if value is None else _build(inner[0], value, key, source)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise wrong("a list")
        if inner[-1] is Ellipsis:
            return tuple(_build(inner[0], item, f"{key}[{k}]", source) for k, item in enumerate(value))
        if len(value) != len(inner):
            raise wrong(f"a list of {len(inner)}")
        items = enumerate(zip(inner, value, strict=True))
        return tuple(_build(item_kind, item, f"{key}[{k}]", source) for k, (item_kind, item) in items)
    if origin is dict:
        if not isinstance(value, dict):
            raise wrong("a mapping")
        return {
            _build(inner[0], name, key, source): _build(inner[1], item, f"{key}.{name}", source)
            for name, item in value.items()
        }
    if kind is float and isinstance(value, int) and not isinstance(value, bool) and abs(value) <= sys.float_info.max:
        return float(value)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        hint = ""
        if kind is float and isinstance(value, str):
            hint = " (YAML reads 1e-3 as text: write 1.0e-3)"
        raise wrong({float: "a number", int: "a whole number", str: "text", bool: "true or false"}[kind] + hint)
    if kind is float and not math.isfinite(value):
        raise wrong("a finite number")
    return value


def are_columns(names: Sequence[str]) -> bool:
    """Whether the names say what the numbers of a point are, as `COLUMNS` has it."""
    counts = {name: list(names).count(name) for name in ("x", "y", "z", "i")}
    return set(names) <= {*counts, "_"} and all(counts[axis] == 1 for axis in "xyz") and counts["i"] <= 1


class Check(NamedTuple):
    """A condition that single values have to meet."""

    group: str  # of the keys; "head.classes" for those of every class
    keys: str
    wanted: str
    holds: Callable[[Any], bool]


CHECKS = (
    Check("encoder", "voxel_size", "sizes above 0", lambda v: min(v) > 0),
    Check("encoder", "feature_scales projection_scales", "scales above 0", lambda v: min(v, default=0) > 0),
    Check("encoder", "feature_scales projection_scales", "no scale twice", lambda v: len(set(v)) == len(v)),
    Check("encoder", "feature_channels image_channels", f"1 to {MAX_CHANNELS}", lambda v: 0 < v <= MAX_CHANNELS),
    Check("encoder", "point_limit voxel_limit", "0 (none) or more", lambda v: v >= 0),
    Check("backbone", "stride", "1 or 2", lambda v: v in (1, 2)),
    Check("backbone", "fusion_channels", f"1 to {MAX_CHANNELS}", lambda v: 0 < v <= MAX_CHANNELS),
    Check("head", "classes", "at least one class", lambda v: len(v) > 0),
    Check("head", "score_threshold", "at least 0 and below 1", lambda v: 0 <= v < 1),
    Check("head", "candidates detections", "1 or more", lambda v: v > 0),
    Check(
        "head.classes",
        "name",
        "a word, as in the label files, but not DontCare",
        lambda v: v.split() == [v] and v != "DontCare",
    ),
    Check("head.classes", "anchor_sizes", "at least one size", lambda v: len(v) > 0),
    Check("head.classes", "anchor_sizes", "sizes above 0", lambda v: min(map(min, v)) > 0),
    Check("head.classes", "positive_iou", "above 0 and at most 1", lambda v: 0 < v <= 1),
    Check("head.classes", "overlap", "above 0 and at most 1", lambda v: v is None or 0 < v <= 1),
    Check("head.classes", "focal_alpha nms_iou", "between 0 and 1", lambda v: 0 <= v <= 1),
    Check("head.classes", "focal_gamma", "0 or more", lambda v: v >= 0),
    Check("loss", "localization classification vertical direction iou", "0 or more", lambda v: v >= 0),
    Check("loss", "beta", "above 0", lambda v: v > 0),
    Check("augment", "flip whole_frames mix fewer_beams no_reflectance", "between 0 and 1", lambda v: 0 <= v <= 1),
    Check("augment", "fade_out", "0 (none) or more", lambda v: v >= 0),
    Check("augment", "rotation", "0 or more", lambda v: v >= 0),
    Check("augment", "pitch", "0 to 0.2 (11 degrees)", lambda v: 0 <= v <= 0.2),
    Check("augment", "scaling reflectance", "0 < low <= high", lambda v: 0 < v[0] <= v[1]),
    Check("augment", "translation", "0 or more", lambda v: min(v) >= 0),
    Check("data", "columns", COLUMNS, lambda v: not v or are_columns(v)),
    Check("data", "reflectance_scale", "above 0, or 0 for none", lambda v: v is None or v >= 0),
    Check("train", "epochs repeat batch_size validate_every report_every", "1 or more", lambda v: v > 0),
    Check("train", "warmup_steps pictures workers weight_decay seed", "0 or more", lambda v: v >= 0),
    Check("train", "learning_rate warmup_ratio decay_ratio gradient_clip", "above 0", lambda v: v > 0),
    Check("train", "average", "at least 0 and below 1", lambda v: 0 <= v < 1),
    Check("train", "seed", "below 2**63", lambda v: v < 2**63),
    Check("train", "decay_epochs", "epochs above 0", lambda v: min(v, default=1) > 0),
    Check("synthetic", "train_frames val_frames", "1 or more", lambda v: v > 0),
)


def _check(config: Config, source: str) -> None:
    """Rejects invalid values: the table first, then what values have to be to each other."""

    def want(holds: bool, key: str, wanted: str, got: object) -> None:
        if not holds:
            got = list(got) if isinstance(got, tuple) else got
            raise InputError(f"{source}: {key}: want {wanted}, got {got}")

    for check in CHECKS:
        groups = {check.group: getattr(config, check.group, None)}
        if check.group == "head.classes":
            groups = {f"head.classes[{k}]": entry for k, entry in enumerate(config.head.classes)}
        for where, group in groups.items():
            for key in check.keys.split() if group is not None else ():
                value = getattr(group, key)
                want(check.holds(value), f"{where}.{key}", check.wanted, value)
    _check_encoder(config.encoder, want)
    _check_backbone(config, want)
    names = [entry.name for entry in config.head.classes]
    want(len(set(names)) == len(names), "head.classes", "no class twice", names)
    levels = 1 if config.backbone.pyramid == "upsampled" else 3
    for k, entry in enumerate(config.head.classes):
        key = f"head.classes[{k}]"
        want(0 <= entry.level < levels, f"{key}.level", "0, 1 or 2" if levels == 3 else "0, the only one", entry.level)
        want(0 <= entry.negative_iou <= entry.positive_iou, f"{key}.negative_iou",
             "between 0 and positive_iou", entry.negative_iou)  # fmt: skip
    for name, meant in config.data.classes.items():
        want(meant in names, f"data.classes.{name}", f"a class of head.classes ({', '.join(names)})", meant)
        want(name != "DontCare", f"data.classes.{name}", "the name of objects, which are regions here", name)
    for name, count in config.augment.objects.items():
        wanted = f"a class of head.classes ({', '.join(names)}; rename or remove it)"
        want(name in names, f"augment.objects.{name}", wanted, name)
        want(count >= 0, f"augment.objects.{name}", "0 or more", count)


def _check_encoder(encoder: EncoderConfig, want: Callable[[bool, str, str, object], None]) -> None:
    low, high = encoder.point_range[:3], encoder.point_range[3:]
    want(all(a < b for a, b in zip(low, high, strict=True)), "encoder.point_range",
         "x_min, y_min, z_min below x_max, y_max, z_max", encoder.point_range)  # fmt: skip
    for r, (fine, coarse) in enumerate(itertools.pairwise(encoder.projection_scales)):
        want(coarse == 2 * fine, f"encoder.projection_scales[{r + 1}]", f"twice the scale before, {2 * fine}", coarse)
    finest = [v * encoder.projection_scales[0] for v in encoder.voxel_size]
    cells = math.prod((b - a) / v for a, b, v in zip(low, high, finest, strict=False))
    wanted = f"at most {MAX_CELLS} cells in the finest projection"
    want(cells <= MAX_CELLS, "encoder.voxel_size", wanted, f"{cells:.3g}")
    wanted = "a point_limit with it"
    want(encoder.voxel_limit == 0 or encoder.point_limit > 0, "encoder.voxel_limit", wanted, "none")
    if encoder.vfe == "pillar":
        for key in ("feature_scales", "projection_scales"):
            scales = getattr(encoder, key)
            want(scales == (1.0,), f"encoder.{key}", "[1.0] for pillars", scales)
        for key in ("point_limit", "voxel_limit"):
            want(getattr(encoder, key) > 0, f"encoder.{key}", "1 or more for pillars", getattr(encoder, key))
        padded = encoder.point_limit * encoder.voxel_limit
        want(padded <= MAX_CELLS, "encoder.voxel_limit", f"at most {MAX_CELLS} places of points in pillars", padded)


def _check_backbone(config: Config, want: Callable[[bool, str, str, object], None]) -> None:
    backbone, images = config.backbone, len(config.encoder.projection_scales)
    want(backbone.stride == 1 or images == 1, "backbone.stride", "1 where a second image joins", backbone.stride)
    blocks = max(3, images)
    wanted = "3 values" if blocks == 3 else f"3 to {blocks} values"
    for key in ("widths", "layers"):
        values = getattr(backbone, key)
        want(3 <= len(values) <= blocks, f"backbone.{key}", f"{wanted}, one a block", values)
    widths, layers = backbone.widths, backbone.layers
    in_reach = min(widths) > 0 and max(widths) <= MAX_CHANNELS
    want(in_reach, "backbone.widths", f"values from 1 to {MAX_CHANNELS}", widths)
    want(max(layers) <= MAX_LAYERS, "backbone.layers", f"{MAX_LAYERS} or fewer", layers)
    want(min(layers) > 1, "backbone.layers", "2 or more (an image joins after the first)", layers)
