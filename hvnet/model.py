"""HVNet: encoder, backbone and one head a class; `forward` returns maps, `detect` returns boxes."""

import os
import platform
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from hvnet.anchors import assign_targets, decode, make_anchors
from hvnet.backbone import Backbone
from hvnet.cli import InputError
from hvnet.config import Config, EncoderConfig, config_from_dict
from hvnet.encoder import HybridVoxelEncoder, projection_grids
from hvnet.head import Head, HeadMaps, scores_of
from hvnet.kernels.rotated import rotated_nms
from hvnet.loss import class_loss
from hvnet.pillars import PillarEncoder


class Detections(NamedTuple):
    """Boxes of one cloud: class by class, within a class the best first."""

    boxes: Tensor  # (M, 7)
    scores: Tensor  # (M,)
    labels: Tensor  # (M,) int64, index into config.head.classes


LOSS_TERMS = ("classification", "localization", "vertical", "direction", "iou")


def make_encoder(config: EncoderConfig) -> HybridVoxelEncoder | PillarEncoder:
    """The hybrid voxel encoder, or that of PointPillars."""
    if config.vfe == "pillar":
        grid = projection_grids(config)[0]
        return PillarEncoder(grid, config.image_channels, config.point_limit, config.voxel_limit)
    return HybridVoxelEncoder(config)


class HVNet(nn.Module):
    """The detector. A batch is all points (N, 4) of all samples in one tensor, and the sample (N,) of each point."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        self.encoder = make_encoder(config.encoder)
        self.backbone = Backbone(config.backbone, config.encoder.image_channels, len(config.encoder.projection_scales))
        self.heads = nn.ModuleList(Head(entry, self.backbone.channels, config.head) for entry in config.head.classes)
        self.log_variances = nn.ParameterDict()
        if config.loss.uncertainty:
            for name in LOSS_TERMS:
                if name not in ("direction", "iou") or getattr(config.head, name):
                    self.log_variances[name] = nn.Parameter(torch.zeros(()))
        for k, entry in enumerate(config.head.classes):
            self.register_buffer(f"anchors_{k}", make_anchors(config, entry), persistent=False)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def anchors(self, label: int) -> Tensor:
        """Anchors (A, 7) of a class."""
        return self.get_buffer(f"anchors_{label}")

    def forward(self, points: Tensor, sample: Tensor, batch_size: int) -> list[HeadMaps]:
        """Points (N, 4) of samples (N,) to the maps of every class."""
        return self.maps_of(self.encoder(points, sample, batch_size))

    def maps_of(self, images: list[Tensor]) -> list[HeadMaps]:
        """Pseudo-images, finest first, to the maps of every class."""
        bfloat16 = self.config.train.bfloat16 and self.training
        with torch.autocast(images[0].device.type, torch.bfloat16, enabled=bfloat16):
            levels = self.backbone(images)
            return [head(levels[entry.level]) for head, entry in zip(self.heads, self.config.head.classes, strict=True)]

    def loss(self, maps: list[HeadMaps], boxes: list[Tensor], labels: list[Tensor]) -> dict[str, Tensor]:
        """Eq. 5: the terms summed over classes, for the boxes (M_b, 7) and labels (M_b,) of every sample.

        With learnt weights a term L is exp(-s) L + s, s the logarithm of its variance (Kendall et al., CVPR 2018).
        """
        total: dict[str, Tensor] = {}
        for k, entry in enumerate(self.config.head.classes):
            own = [b[at == k] for b, at in zip(boxes, labels, strict=True)]
            thresholds = entry.positive_iou, entry.negative_iou
            targets = assign_targets(self.anchors(k), own, *thresholds, self.config.head.regression)
            for name, term in class_loss(maps[k], targets, entry, self.config.loss).items():
                total[name] = total[name] + term if name in total else term
        for name, s in self.log_variances.items():
            total[name] = (-s).exp() * total[name] + s
        return total

    @torch.no_grad()
    def detect(self, points: Tensor, sample: Tensor, batch_size: int) -> list[Detections]:
        """Boxes of every sample, in evaluation mode: scores above the threshold, then rotated NMS class by class.

        This is the plain way, in float32; `hvnet.detector` has the fast one.
        """
        if self.training:
            raise RuntimeError("detect: the model is in training mode; call eval() first")
        maps = self(points, sample, batch_size)
        samples = []
        for b in range(batch_size):
            parts = [self._detect_class(label, of_class.of_sample(b)) for label, of_class in enumerate(maps)]
            samples.append(Detections(*(torch.cat(column) for column in zip(*parts, strict=True))))
        return samples

    def _detect_class(self, label: int, maps: HeadMaps) -> Detections:
        head = self.config.head
        scores = scores_of(maps.logits, maps.iou)
        at = (scores > head.score_threshold).nonzero().squeeze(1)
        best = torch.sort(scores[at], descending=True, stable=True).indices[: head.candidates]
        at = at[best]
        direction = None if maps.direction is None else maps.direction[at].argmax(dim=1)
        boxes = decode(maps.location[at], maps.vertical[at], direction, self.anchors(label)[at])
        kept = rotated_nms(boxes, scores[at], head.classes[label].nms_iou)[: head.detections]
        return Detections(boxes[kept], scores[at][kept], torch.full_like(kept, label))


def save_checkpoint(path: Path, content: dict) -> None:
    """Writes a checkpoint atomically: whatever happens, there is the old file or the new one, never half of one.

    Raises InputError naming the file if it cannot be written.
    """
    partial = path.with_suffix(".partial")
    try:
        with partial.open("wb") as file:
            torch.save(content, file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except (OSError, RuntimeError) as error:  # torch's writer turns some errors of the system into RuntimeError
        partial.unlink(missing_ok=True)
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        kept = "; what it held before is whole: make room and --resume" if path.is_file() else ""
        raise InputError(f"{path}: cannot be written ({reason}){kept}") from error


def load_checkpoint(path: str | Path) -> dict:
    """Reads a checkpoint to the CPU (weights_only, so that it can run no code). Raises InputError naming the file."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such checkpoint; train one with python -m hvnet.train") from error
    except Exception as error:  # the unpickler raises anything at all on a file that is damaged
        raise InputError(f"{path}: truncated, or no checkpoint of hvnet.train; train again or copy it again") from error
    if not isinstance(content, dict) or not {"config", "model"} <= content.keys():
        raise InputError(f"{path}: no checkpoint of hvnet.train (it holds no config and model)")
    return content


def model_from_checkpoint(content: dict, source: str) -> HVNet:
    """The model of what `load_checkpoint` read from source, in evaluation mode. Raises InputError naming source."""
    model = HVNet(config_from_dict(content["config"], source))
    try:
        model.load_state_dict(content["model"])
    except (RuntimeError, AttributeError, TypeError) as error:
        raise InputError(f"{source}: its weights do not fit its config; train again with this version") from error
    return model.eval()


def select_device(name: str) -> torch.device:
    """The device named auto, cpu or cuda (or cuda:1, ...); auto is CUDA where there is a GPU."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(f"--device {name}: torch sees no CUDA device; use --device cpu")
    if name.partition(":")[0] not in ("cpu", "cuda"):
        raise InputError(f"--device {name}: want auto, cpu or cuda")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError(f"--device {name}: want auto, cpu, cuda or cuda:N") from error


def device_name(device: torch.device) -> str:
    """What a device is called: the GPU's or the processor's name."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
