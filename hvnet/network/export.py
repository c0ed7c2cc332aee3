"""A trained model for other programs.

detector.onnx holds all of it, from points to boxes, in standard operators. backbone_heads.onnx holds the part between
the pseudo-images and the maps of the heads. detector.pt2 holds encoder, backbone and heads as one program of
torch.export, with the kernels as custom ops: it takes points. These two end at the maps, whose size is fixed; meta.json
says what decoding them and NMS need. docs/deploy.md has worked examples.
"""

import copy
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.onnx import symbolic_helper

from hvnet.config import ClassConfig, Config
from hvnet.network.anchors import ORIENTATIONS, level_step
from hvnet.network.detector import Detector, fold_batch_norms
from hvnet.network.grids import projection_grids
from hvnet.network.head import HeadMaps
from hvnet.network.model import HVNet
from hvnet.network.points_to_boxes import PointsToBoxes

OPSET = 17
"""ONNX opset of backbone_heads.onnx. All operators in it are older, so that older runtimes read them too."""
DETECTOR_OPSET = 18
"""ONNX opset of detector.onnx, the first whose ScatterElements has a maximum."""
SEARCHES = 31
"""Rounds of a binary search: it goes through two billion values."""


def dropped_points(config: Config) -> str:
    """The option by which an encoder drops points, for which it looks into the data; empty if it keeps all of them."""
    if config.encoder.vfe == "pillar":
        return "encoder.vfe: pillar"
    return f"encoder.point_limit: {config.encoder.point_limit}" if config.encoder.point_limit else ""


class BackboneHeads(nn.Module):
    """The part behind the encoder, its batch norms folded into the convolutions."""

    def __init__(self, model: HVNet) -> None:
        super().__init__()
        self.backbone = fold_batch_norms(model.backbone)
        self.heads = model.heads
        self.levels = [entry.level for entry in model.config.head.classes]

    def forward(self, *images: Tensor) -> tuple[Tensor, ...]:
        """Pseudo-images (B, N_H, N_L, N_W), finest first, to the maps of HVNet.maps_of, in the order of map_names."""
        levels = self.backbone(list(images))
        maps = [head(levels[level]) for head, level in zip(self.heads, self.levels, strict=True)]
        return tuple(each for of_class in maps for each in of_class if each is not None)


class PointsToMaps(nn.Module):
    """The whole network for batches of one size."""

    def __init__(self, model: HVNet, batch_size: int) -> None:
        super().__init__()
        self.encoder = model.encoder
        self.backbone_heads = BackboneHeads(model)
        self.names = map_names(model.config)
        self.batch_size = batch_size

    def forward(self, points: Tensor, sample: Tensor) -> dict[str, Tensor]:
        """Points (N, 4) of samples (N,) to the maps by name."""
        images = self.encoder(points, sample, self.batch_size)
        return dict(zip(self.names, self.backbone_heads(*images), strict=True))


def image_names(config: Config) -> list[str]:
    """Names of the pseudo-images, finest first."""
    return [f"image_{k}" for k in range(len(config.encoder.projection_scales))]


def maps_of_class(config: Config, entry: ClassConfig) -> dict[str, str]:
    """The fields of HeadMaps that a class has, and the names of their outputs.

    These begin with the class in lower case, or as it is written if only that tells it from another class.
    """
    absent = {"direction": not config.head.direction, "iou": not config.head.iou}
    lower = entry.name.lower()
    alike = sum(other.name.lower() == lower for other in config.head.classes)
    prefix = lower if alike == 1 else entry.name
    return {field: f"{prefix}_{field}" for field in HeadMaps._fields if not absent.get(field)}


def map_names(config: Config) -> list[str]:
    """Names of the maps of all classes."""
    return [name for entry in config.head.classes for name in maps_of_class(config, entry).values()]


def write_onnx(model: HVNet, path: Path) -> None:
    """Backbone and heads of a model, on the CPU and in evaluation mode, as ONNX; the batch is a dynamic axis.

    It needs onnx. An image that no class looks at is no input.
    """
    config = model.config
    inputs, outputs = image_names(config), map_names(config)
    channels = config.encoder.image_channels
    images = tuple(torch.zeros(1, channels, *grid.shape) for grid in projection_grids(config.encoder))
    axes = {name: {0: "batch"} for name in inputs + outputs}
    _export(BackboneHeads(model), images, path, OPSET, inputs, outputs, axes)


def write_detector(detector: Detector, path: Path, nms: bool = True) -> None:
    """A detector on the CPU, in float32 and with one view, as ONNX: see `PointsToBoxes`.

    Its config drops no points, see `dropped_points`. The file's metadata have the names of the classes, a line each, as
    "classes", and as "nms" whether it is in the file. It needs onnx.
    """
    import onnx

    x_min, y_min, z_min, x_max, y_max, z_max = detector.config.encoder.point_range
    corner, size = (
        torch.tensor([x_min, y_min, z_min, 0.0]),
        torch.tensor([x_max - x_min, y_max - y_min, z_max - z_min, 1.0]),
    )
    points = corner + size * torch.rand(1000, 4, generator=torch.Generator().manual_seed(0))
    operators = {"aten::scatter_reduce": _scatter_reduce, "aten::searchsorted": _searchsorted}
    for name, function in operators.items():
        torch.onnx.register_custom_op_symbolic(name, function, DETECTOR_OPSET)
    try:
        outputs = ["boxes", "scores", "labels"]
        axes = {"points": {0: "points"}} | {name: {0: "boxes"} for name in outputs}
        _export(PointsToBoxes(detector, nms), (points,), path, DETECTOR_OPSET, ["points"], outputs, axes)
        written = onnx.load(path)
        written.graph.output[0].type.tensor_type.shape.dim[1].dim_value = 7  # which torch does not know
        onnx.helper.set_model_props(written, {"classes": "\n".join(detector.classes), "nms": "yes" if nms else "no"})
        onnx.save(written, path)
    finally:
        for name in operators:
            torch.onnx.unregister_custom_op_symbolic(name, DETECTOR_OPSET)


def _export(
    module: nn.Module,
    inputs: tuple[Tensor, ...],
    path: Path,
    opset: int,
    input_names: list[str],
    output_names: list[str],
    dynamic_axes: dict[str, dict[int, str]],
) -> None:
    with warnings.catch_warnings(), torch.no_grad():
        # torch calls this exporter the old one; the new one takes ten times as long for the same convolutions, writes
        # two files, needs onnxscript, too, and has no loops whose end depends on the data
        warnings.simplefilter("ignore", DeprecationWarning)
        # that what depends on a shape is fixed: those of the weights are
        warnings.simplefilter("ignore", torch.jit.TracerWarning)
        warnings.filterwarnings("ignore", "Exporting aten::index operator", UserWarning)
        torch.onnx.export(
            module.eval(),
            inputs,
            str(path),
            dynamo=False,
            opset_version=opset,
            input_names=input_names,
            output_names=output_names,
            dynamic_axes=dynamic_axes,
        )


@symbolic_helper.parse_args("v", "i", "v", "v", "s", "b")
def _scatter_reduce(g: Any, table: Any, dim: int, index: Any, src: Any, reduction: str, include_self: bool) -> Any:
    """torch's own translation has a branch for tables without dimensions, behind which no shape is known."""
    assert reduction == "amax"
    assert include_self
    return g.op("ScatterElements", table, index, src, axis_i=dim, reduction_s="max")


@symbolic_helper.parse_args("v", "v", "b", "b", "s", "v")
def _searchsorted(
    g: Any, ordered: Any, values: Any, out_int32: bool, right: bool, side: str | None, sorter: Any
) -> Any:
    """The binary search of values (M,) in ordered ones (N >= 1,), which ONNX does not have."""
    one, two = (g.op("Constant", value_t=torch.tensor(number)) for number in (1, 2))
    size = g.op("Size", ordered)
    last = g.op("Sub", size, one)
    low = g.op("ConstantOfShape", g.op("Shape", values), value_t=torch.zeros(1, dtype=torch.int64))
    high = g.op("Add", low, size)
    known = symbolic_helper._get_tensor_sizes(ordered)
    for _ in range(known[0].bit_length() if known and known[0] else SEARCHES):
        middle = g.op("Div", g.op("Add", low, high), two)
        found = g.op("Gather", ordered, g.op("Min", middle, last), axis_i=0)
        later = g.op("LessOrEqual" if right else "Less", found, values)
        above = g.op("Min", g.op("Add", middle, one), high)  # where the search has ended, it stays
        low, high = g.op("Where", later, above, low), g.op("Where", later, high, middle)
    return low


def write_program(model: HVNet, path: Path, batch_size: int) -> None:
    """The whole of a model, on the CPU and in evaluation mode, as a program of torch.export for two points and more.

    Its config drops no points, see `dropped_points`. It is copied.
    """
    points, sample = torch.zeros(8, 4), torch.zeros(8, dtype=torch.int64)
    count = torch.export.Dim("points")
    module = PointsToMaps(copy.deepcopy(model), batch_size).eval().requires_grad_(False)
    # torch.export.save needs weights that are contiguous in memory
    module.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    program = torch.export.export(module, (points, sample), dynamic_shapes=({0: count}, {0: count}))
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)  # it names files of this machine
    torch.export.save(program, path)


def describe(config: Config, batch_size: int) -> dict[str, Any]:
    """The content of meta.json: inputs, outputs, the layout of the anchors, thresholds. Metres and radians."""
    encoder, head = config.encoder, config.head
    grids = projection_grids(encoder)
    finest = grids[0]
    origin = [finest.x_min, finest.y_min]
    classes = []
    for entry in head.classes:
        step = level_step(config, entry)
        classes.append(
            {
                "name": entry.name,
                "outputs": maps_of_class(config, entry),
                "level": entry.level,
                "cells": [length // step for length in finest.shape],
                "cell": [length * step for length in finest.cell],
                "origin": origin,
                "anchor_sizes": [list(size) for size in entry.anchor_sizes],
                "anchor_z": entry.anchor_z,
                "anchor_yaws": list(ORIENTATIONS),
                "nms_iou": entry.nms_iou,
            }
        )
    return {
        "point_range": list(encoder.point_range),
        "batch_size_of_program": batch_size,
        "images": [
            {
                "name": name,
                "channels": encoder.image_channels,
                "cells": list(grid.shape),
                "cell": list(grid.cell),
                "origin": origin,
            }
            for name, grid in zip(image_names(config), grids, strict=True)
        ],
        "regression": head.regression,
        "score_threshold": head.score_threshold,
        "candidates": head.candidates,
        "detections": head.detections,
        "classes": classes,
    }
