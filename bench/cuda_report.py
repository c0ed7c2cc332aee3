"""What a GPU would do, seen without one: every kernel's compiled code, a model of a frame's and a training step's time.

Kernels are compiled for an architecture; registers, stack and spills are those of the compiled file, and loads and
stores are counted in the innermost loop of its SASS (of several the one with the most loads, with all the copies that
the compiler made of its body; of a kernel without a loop in the whole of it).

The model runs the code that a GPU would run, at the paper's setting, on tensors without data (see fake_cuda.py), and
adds up stage by stage what is launched, the bytes that must be moved and the floating-point operations. A launch of
Warp moves every tensor that it is given once, but of one as long as the arrays for points only the rows of the points
that are there. The floor is bytes or operations at the device's full rate. The estimate is the floor at the share of
the rate that such work reaches, plus the launches and what one thread does alone; it is good to a factor of two. It
takes no GPU and says nothing that a measurement would not say better.
"""

import argparse
import functools
import json
import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import cuda_kernels
import torch
from cuda_kernels import Code, Usage, code_of, compile_kernels, find_kernels, resources
from fake_cuda import CUDA, Work, fake_cuda, index_of_known_length
from timing import read_scene
from torch import Tensor

from hvnet.cli import run_command
from hvnet.config import Config, load_config
from hvnet.data.kitti import drop_non_finite, read_points
from hvnet.data.scenes.files import make_frame
from hvnet.data.scenes.street import Options
from hvnet.data.sensor import inside
from hvnet.exceptions import InputError
from hvnet.kernels.shares import CHUNK
from hvnet.kernels.voxel import voxel_index
from hvnet.network.backbone import ConvReLU
from hvnet.network.detector import Detector
from hvnet.network.encoder import HybridVoxelEncoder
from hvnet.network.model import HVNet

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "hvnet.yaml"
GROUND = -1.66
"""Height of the road under KITTI's clouds: with it a detector looks for the road of every cloud."""

# Assumed, not measured: what such work reaches on other GPUs, to a factor of two.
GRAPH_US = 1.5  # a kernel in a CUDA graph, from the end of the one before it
HOST_US = 7.0  # an operation of torch that the host starts, with what Python does for it
COPY_US = 10.0  # a transfer between host and device: the call and the wait
HOST_BANDWIDTH = 50e9  # bytes a second over PCIe, from pinned memory
MEMORY = 0.8  # share of the bandwidth that passes over large tensors reach
GATHER = 0.5  # ... kernels that gather rows and write ends
CONVOLUTION = 0.62  # share of the roofline that cuDNN reaches over the backbone's layers: 222 of 350 us
CHAIN_US = 0.15  # a point that a thread goes through: loads that wait for each other
FEW = 1024  # threads of a launch that does not hide how long memory takes, as the sweep of an NMS
LOADS = 100  # that wait for each other in such a launch
KERNELS = {"sort": 8, "topk": 12, "cumsum": 3, "cat": 1}
"""Kernels that torch starts for one operation, where it is not one."""

ARCHS = (75, 80, 86, 87, 89, 90, 100, 120)
BOUND_FRAME_US, BOUND_LAUNCHES, BOUND_BACKWARD_US = 1000.0, 150, 500.0


class Device(NamedTuple):
    """Full rates."""

    bandwidth: float  # bytes a second
    single: float  # float32 operations a second
    tf32: float  # ... of matrix products and convolutions whose factors are rounded to TF32
    half: float  # ... in bfloat16


class Rule(NamedTuple):
    """What belongs to a stage: work inside one of the functions, or by one of the names."""

    stage: str
    functions: frozenset[str] = frozenset()
    names: frozenset[str] = frozenset()


def rule(stage: str, functions: str = "", names: str = "") -> Rule:
    """A rule, its words separated by spaces."""
    return Rule(stage, frozenset(functions.split()), frozenset(names.split()))


PRODUCTS = "mm addmm addmm_ bmm baddbmm mv"
CONVOLUTIONS = "convolution cudnn_convolution_relu cudnn_convolution_add_relu"
FRAME = (
    rule("place", "shifts place_points find_ground"),
    rule("means", "voxel_means"),
    rule("index", "nested_index scales_of"),
    rule("encode", "encode_voxels"),
    rule("project", "project_voxels"),
    rule("context", "add_of_voxels"),
    rule("clear images", "images"),
    rule("fold batch norms", "folded"),
    rule("scores", "score"),
    rule("candidates", "candidates"),
    rule("NMS", "suppress"),
    rule("convolutions", names=CONVOLUTIONS),
    rule("products", names=PRODUCTS),
    rule("concatenations", names="cat"),
    rule("bias and ReLU", names="relu relu_ add_"),
)
TRAINING = (
    rule("encode.backward", "_attend_backward"),
    rule("loss", "loss"),
    rule("index", "voxel_index"),
    rule("encode", "_attend"),
    rule("convolutions", names=CONVOLUTIONS),
    rule("convolutions, backward", names="convolution_backward"),
    rule("products", names=PRODUCTS),
    rule("batch norm and ReLU", names="native_batch_norm native_batch_norm_backward relu relu_ threshold_backward"),
    rule(
        "optimiser", names="_fused_adam_ _foreach_add_ _foreach_mul_ _foreach_addcdiv_ _foreach_addcmul_ _foreach_sqrt"
    ),
    rule("encoder, other", "point_features voxel_features scale_of_points column_sums write_image"),
    rule("concatenations", names="cat"),
)
OTHER = "other"
POINTS = {"points", "features", "src", "base", "rows"}
"""Arguments of kernels that have a row a point."""


@dataclass
class Stage:
    """What a stage does, and how long it takes."""

    stage: str
    in_graph: bool
    launches: int = 0
    bytes: float = 0.0
    flops: float = 0.0
    floor_us: float = 0.0
    estimated_us: float = 0.0


class Cloud(NamedTuple):
    """What the model has to know of a cloud."""

    points: int  # in range
    capacity: int  # that arrays have room for
    longest: int  # points of the fullest voxel
    voxels: tuple[int, ...]  # of every scale of the encoder


def stage_of(work: Work, rules: Sequence[Rule]) -> str:
    """The stage that work belongs to, by the first rule that fits."""
    for each in rules:
        if work.name in each.names or not each.functions.isdisjoint(work.functions):
            return each.stage
    return OTHER


def moved_by(work: Work, cloud: Cloud) -> float:
    """Bytes that must be moved: every tensor once. Of arrays with room for more points the rows of those there are; of
    a kernel that joins what others have left, which is given no row of a point, one row a thread; and of columns that
    several launches share the part of one. Of a map whose patches are gathered, the patches are read."""
    if not work.threads:
        return work.bytes
    if "level" in work.arguments:
        return math.prod(work.threads) * (work.tensors[0][1] + work.tensors[-1][1])
    of_points = not work.arguments or not POINTS.isdisjoint(work.arguments) or "starts" not in work.arguments
    rows = cloud.points if of_points else max(work.threads)
    columns = work.threads[-1]
    total = 0.0
    for shape, size in work.tensors:
        lengths = [min(length, rows) if length >= cloud.points else length for length in shape]
        if len(shape) == 3 and len(work.threads) == 2 and shape[0] >= cloud.points:
            lengths[1] = min(shape[1], columns)
        total += size * math.prod(lengths)
    return total


def chain_us(work: Work, cloud: Cloud) -> float:
    """Microseconds that the slowest thread of a launch of Warp takes by itself."""
    if not work.threads:
        return 0.0
    if math.prod(work.threads) < FEW:
        return CHAIN_US * LOADS
    if "starts" not in work.arguments:
        return 0.0
    # a thread for each voxel goes through its points; else a thread has its chunk of them
    by_voxel = "points" in work.arguments and max(work.threads) >= cloud.capacity
    return CHAIN_US * (cloud.longest if by_voxel else CHUNK)


def account(
    works: Sequence[Work], rules: Sequence[Rule], device: Device, cloud: Cloud, *, in_graph: bool
) -> list[Stage]:
    """The stages of the rules, with what the works add to each."""
    stages = {name: Stage(name, in_graph) for name in (*(each.stage for each in rules), OTHER)}
    for work in works:
        stage = stages[stage_of(work, rules)]
        moved, rate = moved_by(work, cloud), getattr(device, work.kind)
        floor = 1e6 * max(moved / device.bandwidth, work.flops / rate)
        share = CONVOLUTION if "convolution" in work.name else GATHER if work.threads else MEMORY
        start = GRAPH_US * KERNELS.get(work.name, 1)
        busy = start + max(floor / share, chain_us(work, cloud))
        stage.launches += 1
        stage.bytes += moved
        stage.flops += work.flops
        stage.floor_us += floor
        stage.estimated_us += busy if in_graph else max(busy, HOST_US)
    return [stage for stage in stages.values() if stage.launches]


def model_frame(config: Config, device: Device, cloud: Cloud) -> list[Stage]:
    """The stages of one frame, from a cloud on the host to boxes there."""
    with fake_cuda() as record, fused_convolutions(), torch.no_grad():
        detector = Detector(HVNet(config).eval(), CUDA, ground=GROUND)
        points, counts = torch.empty(1, cloud.capacity, 4, device=CUDA), torch.empty(1, device=CUDA).int()
        sample = torch.zeros(cloud.capacity, device=CUDA).long()
        for _ in range(2):  # the first fills the caches
            record.work.clear()
            table = detector.numbers(points, counts, sample)
        works = list(record.work)
    stages = account(works, FRAME, device, cloud, in_graph=True)
    size = float(table.numel() * table.element_size())
    return [copy_of("upload", 16.0 * cloud.points), *stages, copy_of("transfer", size)]


@contextmanager
def fused_convolutions() -> Iterator[None]:
    """As if cuDNN had a kernel with bias and ReLU for every layer, which only a GPU can tell."""
    always = mock.patch.object(ConvReLU, "has_one_kernel", return_value=True)
    with mock.patch.object(torch.backends.cudnn, "is_available", return_value=True), always:
        yield


def copy_of(stage: str, size: float) -> Stage:
    """A copy between host and device."""
    floor = 1e6 * size / HOST_BANDWIDTH
    return Stage(stage, False, 1, size, 0.0, floor, floor + COPY_US)


def model_training(config: Config, device: Device, cloud: Cloud) -> list[Stage]:
    """The stages of a step of training with a batch of the config's size, each cloud like the one given."""
    batch = config.train.batch_size
    count = batch * cloud.points
    index = functools.partial(index_of_known_length, voxels=[batch * each for each in cloud.voxels])
    with fake_cuda(torch.device("cpu"), voxel_index=index) as record:
        model = HVNet(config).train()
        optimizer = torch.optim.Adam(model.parameters(), fused=True)
        points, sample = torch.empty(count, 4), torch.zeros(count, dtype=torch.int64)
        boxes, labels = [torch.empty(8, 7)] * batch, [torch.zeros(8, dtype=torch.int64)] * batch
        record.work.clear()
        terms = model(points, sample, boxes, labels)
        torch.stack(list(terms.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.train.gradient_clip)
        optimizer.step()
        works = list(record.work)
    return account(works, TRAINING, device, cloud._replace(points=count, capacity=count), in_graph=False)


def read_kernels(arch: int) -> list[dict[str, Any]]:
    """A row for every kernel, compiled for an architecture."""
    found = find_kernels()
    usage: dict[str, Usage] = {}
    code: dict[str, Code] = {}
    with tempfile.TemporaryDirectory() as folder:
        for file in compile_kernels([each.kernel for each in found], [arch], Path(folder))[arch]:
            usage |= resources(file)
            code |= code_of(file)
    rows = []
    for each in found:
        use, does = usage[each.symbol], code[each.symbol]
        rows.append(
            {
                "name": each.name,
                "dtype": each.dtype,
                "lanes": each.lanes,
                "registers": use.registers,
                "stack": use.stack,
                "shared": use.shared,
                "spill_stores": does.spill_stores,
                "spill_loads": does.spill_loads,
                "load_bytes": {str(width): does.loads[width] for width in sorted(does.loads)},
                "store_bytes": {str(width): does.stores[width] for width in sorted(does.stores)},
                "loops": does.loops,
            }
        )
    return rows


def read_clouds(file: Path | None, config: Config) -> tuple[Cloud, Cloud]:
    """A velodyne .bin, or a generated scan: all round, and cropped to the camera's view as KITTI's are in training."""
    if file is None:
        whole = torch.from_numpy(make_frame(0, 0, Options(azimuth=180))[1].points)
    else:
        whole = torch.from_numpy(drop_non_finite(read_points(file))[0])
    return cloud_of(whole, config), cloud_of(read_scene(file), config)


def cloud_of(points: Tensor, config: Config) -> Cloud:
    """The numbers of points (N, 4)."""
    kept = points[inside(points, config.encoder.point_range)]
    if not len(kept):
        raise InputError("--points: no point is in range")
    encoder = HybridVoxelEncoder(config.encoder)
    grids = list(dict.fromkeys(encoder.feature_grids + encoder.projection_grids))
    sizes = [torch.bincount(scale.segments.voxel) for scale in
             voxel_index(kept, torch.zeros(len(kept), dtype=torch.int64), 1, grids).scales]  # fmt: skip
    capacity = 1 << max(len(points) - 1, 1023).bit_length()
    return Cloud(len(kept), capacity, max(int(each.max()) for each in sizes), tuple(len(each) for each in sizes))


def print_kernels(rows: Sequence[dict[str, Any]], arch: int) -> None:
    """The table of the kernels."""
    widths = (1, 2, 4, 8, 16)
    heads = f"{'registers':>10}{'stack':>7}{'shared':>8}{'spills':>11}"
    print(f"{f'sm_{arch}':<34}{'type':<10}{heads}   loads of 1/2/4/8/16 B, stores")
    for row in rows:
        spills = f"{row['spill_stores']}+{row['spill_loads']}"
        loads, stores = (
            "/".join(str(row[key].get(str(width), 0)) for width in widths) for key in ("load_bytes", "store_bytes")
        )
        numbers = f"{row['registers']:>10}{row['stack']:>7}{row['shared']:>8}{spills:>11}"
        print(f"{row['name'][:33]:<34}{row['dtype'] or '':<10}{numbers}   {loads:<18}{stores}")


def print_stages(title: str, stages: Sequence[Stage]) -> Stage:
    """A table of stages with its sum, which is returned."""
    print(f"\n{title:<42}{'launches':>9}{'graph':>7}{'MB':>9}{'GFLOP':>9}{'floor us':>10}{'estimate us':>13}")
    whole = Stage("sum", False)
    for each in stages:
        for key in ("launches", "bytes", "flops", "floor_us", "estimated_us"):
            setattr(whole, key, getattr(whole, key) + getattr(each, key))
    for each in (*stages, whole):
        graph = "" if each is whole else "yes" if each.in_graph else "no"
        numbers = f"{each.bytes / 1e6:>9.1f}{each.flops / 1e9:>9.2f}{each.floor_us:>10.1f}{each.estimated_us:>13.1f}"
        print(f"  {each.stage:<40}{each.launches:>9}{graph:>7}{numbers}")
    return whole


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="bench/cuda_report.py", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("--arch", type=int, choices=ARCHS, default=90, help="80 is sm_80 (default: 90)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all of it there as JSON")
    parser.add_argument("--points", type=Path, metavar="FILE", help="a velodyne .bin (default: a generated scan)")
    parser.add_argument(
        "--bandwidth", type=float, default=4.8, metavar="TB/S", help="of memory (default: 4.8, an H200)"
    )
    parser.add_argument("--float32", type=float, default=67.0, metavar="TFLOP/S", help="(default: 67, an H200)")
    parser.add_argument("--tf32", type=float, default=495.0, metavar="TFLOP/S", help="dense (default: 495, an H200)")
    parser.add_argument(
        "--bfloat16", type=float, default=990.0, metavar="TFLOP/S", help="dense (default: 990, an H200)"
    )
    args = parser.parse_args(argv)
    for name in ("cuobjdump", "nvdisasm"):
        if cuda_kernels.tool(name) is None:
            raise InputError(f"{name} is missing: {cuda_kernels.PIP}")
    if args.json and not args.json.parent.is_dir():
        raise InputError(f"--json {args.json}: its folder does not exist")
    rates = args.bandwidth, args.float32, args.tf32, args.bfloat16
    if min(rates) <= 0:
        raise InputError("--bandwidth, --float32, --tf32 and --bfloat16: want numbers above 0")
    device = Device(*(1e12 * rate for rate in rates))
    config = load_config(CONFIG)
    scan, view = read_clouds(args.points, config)
    kernels = read_kernels(args.arch)
    print_kernels(kernels, args.arch)
    frame, training = model_frame(config, device, scan), model_training(config, device, view)
    whole = print_stages(f"one frame, {scan.points:,} points", frame)
    print_stages(f"one step, {config.train.batch_size} x {view.points:,} points", training)
    backward = sum(each.estimated_us for each in training if each.stage == "encode.backward")
    bounds: list[dict[str, Any]] = [
        {
            "bound": "a frame's sum at most 1.0 ms",
            "value": whole.estimated_us,
            "holds": whole.estimated_us <= BOUND_FRAME_US,
        },
        {"bound": "launches a frame below 150", "value": whole.launches, "holds": whole.launches < BOUND_LAUNCHES},
        {"bound": "encode.backward below 0.5 ms", "value": backward, "holds": backward < BOUND_BACKWARD_US},
    ]
    print()
    for each in bounds:
        print(f"{each['bound']:<36}{each['value']:>10.1f}  {'holds' if each['holds'] else 'does not hold'}")
    if args.json:
        tree = {"arch": args.arch, "device": device._asdict(), "cloud": scan._asdict(), "kernels": kernels}
        tree |= {"frame": [asdict(each) for each in frame], "training": [asdict(each) for each in training]}
        args.json.write_text(json.dumps(tree | {"bounds": bounds}, indent=1) + "\n", encoding="utf-8")
        print(f"written: {args.json}")


if __name__ == "__main__":
    run_command(main)
