"""A trained model for other programs.

backbone_heads.onnx holds everything between the pseudo-images and the maps of the heads, in standard operators.
detector.pt2 holds encoder, backbone and heads as one program of torch.export, with the kernels as custom ops: it takes
points. Both end at the maps, whose size is fixed; meta.json says what decoding them and NMS need. docs/deploy.md has
worked examples.
"""

import copy
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hvnet.config import ClassConfig, Config
from hvnet.network.anchors import ORIENTATIONS, level_step
from hvnet.network.detector import fold_batch_norms
from hvnet.network.grids import projection_grids
from hvnet.network.head import HeadMaps
from hvnet.network.model import HVNet

OPSET = 17
"""Of ONNX: all operators here are older, and so are the programs that read them."""


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
    """The fields of HeadMaps that a class has, and the names of their outputs."""
    absent = {"direction": not config.head.direction, "iou": not config.head.iou}
    return {field: f"{entry.name.lower()}_{field}" for field in HeadMaps._fields if not absent.get(field)}


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
    with warnings.catch_warnings(), torch.no_grad():
        # torch calls this exporter the old one; the new one takes ten times as long for the same convolutions, writes
        # two files and needs onnxscript, too
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            BackboneHeads(model).eval(),
            images,
            str(path),
            dynamo=False,
            opset_version=OPSET,
            input_names=inputs,
            output_names=outputs,
            dynamic_axes={name: {0: "batch"} for name in inputs + outputs},
        )


def is_program(model: HVNet) -> bool:
    """Whether torch.export can take the whole network: hard voxels look into the data to drop points."""
    return model.config.encoder.vfe != "pillar" and model.config.encoder.point_limit == 0


def write_program(model: HVNet, path: Path, batch_size: int) -> None:
    """The whole of a model, on the CPU and in evaluation mode, as a program of torch.export for two points and more.

    The model must be one for which `is_program` holds; it is copied.
    """
    points, sample = torch.zeros(8, 4), torch.zeros(8, dtype=torch.int64)
    count = torch.export.Dim("points")
    module = PointsToMaps(copy.deepcopy(model), batch_size).eval().requires_grad_(False)
    # torch.export.save wants weights in the order in which they lie in memory
    module.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    program = torch.export.export(module, (points, sample), dynamic_shapes=({0: count}, {0: count}))
    for node in program.graph.nodes:
        node.meta.pop("stack_trace", None)  # it names files of this machine
    torch.export.save(program, path)


def describe(config: Config, batch_size: int) -> dict[str, Any]:
    """What meta.json holds: inputs, outputs, the layout of the anchors, thresholds. Metres and radians."""
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
