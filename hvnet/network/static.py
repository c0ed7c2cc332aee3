"""A frame in arrays of fixed size, for many threads: from clouds to one table of boxes without a look at the device.

On CUDA one graph captures all of it. The clouds come to the device in one copy, the table leaves it in another.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from hvnet.config import HeadConfig
from hvnet.kernels.candidates import AnchorTable, decode_candidates, gather_patches, write_keys
from hvnet.kernels.rotated import nms_groups
from hvnet.network.anchors import MAX_HEIGHT, MAX_OUTPUT, MAX_SHIFT, MAX_SIZE, anchors_per_cell
from hvnet.network.head import LOCATION_VALUES

COLUMNS = 10
"""Of a row of the table: a box (7), its score, its label, and whether it was kept."""


class Rows(NamedTuple):
    """The candidates of C classes and B samples, best first."""

    table: Tensor  # (B, C, K, COLUMNS) float32; the last column is not written yet
    valid: Tensor  # (B, C, K) bool: above the threshold, and finite
    counts: Tensor  # (B C,) int32, those above the threshold


class BoxSteps:
    """The steps from the maps of the heads to boxes, for all classes and samples in one go."""

    def __init__(self, head: HeadConfig, weights: Sequence[Tensor], anchors: Sequence[Tensor]) -> None:
        """The weights are those of `regression_weight`, the anchors (A, 7) those of every class."""
        self.head, self.device = head, anchors[0].device
        self.per_cell = [anchors_per_cell(entry) for entry in head.classes]
        lengths = [len(each) for each in anchors]
        self.longest = max(lengths)
        self.kept = min(head.candidates, self.longest)
        boxes = torch.cat(list(anchors)).float()
        starts = torch.tensor([0, *lengths[:-1]], dtype=torch.int32).cumsum(0, dtype=torch.int32)
        self.anchors = AnchorTable(
            torch.cat((boxes, boxes[:, 6:].cos(), boxes[:, 6:].sin()), dim=1),
            starts.to(self.device),
            torch.tensor(self.per_cell, dtype=torch.int32, device=self.device),
            weights[0].shape[1] // self.per_cell[0],
            head.regression == "pose",
            head.direction,
            (MAX_SIZE, MAX_HEIGHT, MAX_SHIFT, MAX_OUTPUT),
        )
        # classes with fewer anchors at a cell are filled up with outputs that nobody reads
        width = max(weight.shape[1] for weight in weights)
        whole = torch.stack([torch.nn.functional.pad(weight, (0, width - weight.shape[1])) for weight in weights])
        self.weight, self.bias = whole[:, :-1].contiguous(), whole[:, -1:].contiguous()
        self.thresholds = torch.tensor([entry.nms_iou for entry in head.classes], device=self.device)
        assert self.anchors.values == LOCATION_VALUES[head.regression] + 2 + 2 * head.direction

    def keys(self, maps: Sequence[Sequence[Tensor]]) -> Tensor:
        """The maps (B, N_anc, N_L, N_W) of every class, its score's and perhaps its IoU's: keys (B, C, A) int64 of the
        anchors above the threshold, see `kernels.candidates`."""
        keys = torch.empty(len(maps[0][0]), len(maps), self.longest, dtype=torch.int64, device=self.device)
        for label, of_class in enumerate(maps):
            logits, *iou = [each.permute(0, 2, 3, 1).contiguous().flatten(1) for each in of_class]
            write_keys(logits, iou[0] if iou else None, self.head.score_threshold, label, keys)
        return keys

    def candidates(self, levels: Sequence[Tensor], keys: Tensor) -> Rows:
        """The anchors with the largest keys, regressed and decoded."""
        keys = torch.topk(keys, self.kept, dim=2).values
        samples, classes, count = keys.shape
        patches = torch.empty(classes, samples * count, self.weight.shape[1], device=self.device)
        for label, entry in enumerate(self.head.classes):
            level = levels[entry.level].permute(0, 2, 3, 1).contiguous()
            gather_patches(level, keys, label, self.per_cell[label], patches)
        values = torch.baddbmm(self.bias, patches, self.weight)
        table = torch.empty(samples, classes, count, COLUMNS, device=self.device)
        return Rows(table, *decode_candidates(values, keys, self.anchors, table))

    def suppress(self, rows: Rows) -> Tensor:
        """Rotated NMS of every class and sample: the table with its last column."""
        count = rows.valid.shape[2]
        table, valid = rows.table.view(-1, count, COLUMNS), rows.valid.view(-1, count)
        keep = nms_groups(table, valid, rows.counts, self.thresholds, self.head.detections)
        table[..., -1].copy_(keep)
        return rows.table


Run = Callable[[Tensor, Tensor, Tensor], Tensor]
"""From points (B, capacity, 4), counts (B,) int32 and samples (S capacity,) int64 to one row of numbers."""


class StaticFrame:
    """A frame of B clouds of at most `capacity` points: arrays of fixed size, and on CUDA the graph that fills them."""

    def __init__(self, batch_size: int, capacity: int, looks: int, device: torch.device) -> None:
        """looks: how many samples are made of each cloud."""
        # counts first, so that the copy of one cloud ends with its last point; they fill whole points
        self.head, self.shape = -(-batch_size // 4) * 4, (batch_size, capacity, 4)
        size = self.head + batch_size * capacity * 4
        self.staging = torch.zeros(size, pin_memory=device.type == "cuda")
        self.buffer = torch.zeros(size, device=device)
        self.sample = torch.arange(batch_size * looks, device=device).repeat_interleave(capacity)
        self.graph: torch.cuda.CUDAGraph | None = None

    def split(self, buffer: Tensor) -> tuple[Tensor, Tensor]:
        """The points (B, capacity, 4) and the counts (B,) int32 in a buffer."""
        return buffer[self.head :].view(self.shape), buffer[: self.head].view(torch.int32)[: self.shape[0]]

    def capture(self, run: Run) -> None:
        """Captures a run that reads nothing from the device as a graph."""
        device = self.buffer.device
        side = torch.cuda.Stream(device)
        side.wait_stream(torch.cuda.current_stream(device))
        with torch.cuda.stream(side):
            for _ in range(2):  # kernels are compiled and buffers made before the capture
                run(*self.split(self.buffer), self.sample)
        torch.cuda.current_stream(device).wait_stream(side)
        # cuBLAS keeps a workspace, 32 MiB on an H100, for every stream: that of the graph is to go with its memory
        torch._C._cuda_clearCublasWorkspaces()
        self.graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self.graph, stream=side, capture_error_mode="thread_local"):
            self.output = run(*self.split(self.buffer), self.sample)
        torch._C._cuda_clearCublasWorkspaces()

    def __call__(self, clouds: Sequence[Tensor], run: Run) -> Tensor:
        """What the run, or the graph that was captured of it, makes of clouds (N, 4) float32, on the host.

        The one transfer at the end waits for the device, so that nothing of this call is in use when the next one
        writes, or when the frame is freed.
        """
        self.upload(clouds)
        if self.graph is None:
            return run(*self.split(self.buffer), self.sample).cpu()
        self.graph.replay()
        return self.output.cpu()

    def upload(self, clouds: Sequence[Tensor]) -> None:
        """Writes clouds to the buffer: in one copy, or those that are on a device already one by one."""
        if all(cloud.device.type == "cpu" for cloud in clouds):
            points, counts = self.split(self.staging)
            for b, cloud in enumerate(clouds):
                points[b, : len(cloud)] = cloud
                counts[b] = len(cloud)
            end = self.head + ((len(clouds) - 1) * self.shape[1] + len(clouds[-1])) * 4
            self.buffer[:end].copy_(self.staging[:end], non_blocking=True)
            return
        points, counts = self.split(self.buffer)
        for b, cloud in enumerate(clouds):
            points[b, : len(cloud)].copy_(cloud, non_blocking=True)
            counts[b].fill_(len(cloud))


def capacity_of(clouds: Sequence[Tensor]) -> int:
    """Points of the largest cloud, up to the next power of two and no fewer than 1,024."""
    return 1 << max(*(len(cloud) - 1 for cloud in clouds), 1023).bit_length()
