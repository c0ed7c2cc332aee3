"""Runs what a GPU runs on tensors that have a shape, a type and the device cuda:0, but no data: no GPU is needed.

Tensors of different devices in one operation raise an error, and so does a read of the device: nothing is there. What
is launched, what is calculated and what goes between host and device is written down. Torch's fake tensors do the work;
what they cannot do in a build of torch without CUDA (indexing, conversions) is done here by other operations.
"""

import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import torch
import warp as wp
from cuda_kernels import name_of
from torch import Tensor, nn
from torch._library.custom_ops import OPDEFS
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

from hvnet.kernels import launch

FOLDER = Path(__file__).resolve().parent
ROOT = FOLDER.parent
CUDA = torch.device("cuda:0")
CHANNELS_LAST = torch.channels_last
CONVOLUTION = torch.ops.aten.convolution
HALF = (torch.bfloat16, torch.float16)
NO_WORK = {"detach", "lift_fresh", "_unsafe_view", "_reshape_alias"}
"""Operations that calculate nothing; so do those whose outputs are views, and those that only allocate."""


READS = {"_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "_unique2", "unique_consecutive"}
"""Operations that wait for the device."""


class ToHost(Exception):
    """The code copies to the host: what comes next needs data."""


class ReadsDevice(Exception):
    """The code waits for a value of the device."""


class Work(NamedTuple):
    """One launch of Warp, or one operation of torch."""

    name: str
    bytes: float  # of all tensors that it is given and gives
    flops: float
    kind: str  # of arithmetic: single, tf32 or half
    functions: tuple[str, ...]  # of the project that were running, the innermost first
    tensors: tuple[tuple[tuple[int, ...], int], ...] = ()  # of a launch: shapes and bytes a number
    threads: tuple[int, ...] = ()  # of a launch
    arguments: tuple[str, ...] = ()  # of a kernel


@dataclass
class Record:
    """What ran on the fake device."""

    launches: Counter[str] = field(default_factory=Counter)  # of Warp, by kernel
    operations: Counter[str] = field(default_factory=Counter)  # of torch, those that calculate
    from_host: Counter[str] = field(default_factory=Counter)  # copies, by the line of the project that makes them
    to_host: Counter[str] = field(default_factory=Counter)
    work: list[Work] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Launches and operations: what a GPU has to start."""
        return self.launches.total() + self.operations.total()


class Watch(TorchDispatchMode):
    """Records operations, and runs the bodies of the project's own instead of their fakes.

    `sizes` replaces operations of the project whose results have lengths that depend on data.
    """

    def __init__(self, record: Record, device: torch.device, sizes: dict[str, Callable[..., Any]]) -> None:
        super().__init__()
        self.record, self.device, self.sizes = record, device, sizes

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        space, _, name = func._schema.name.partition("::")
        if space == "hvnet":
            with self, OtherWays() if self.device == CUDA else nullcontext():
                return self.sizes.get(name, OPDEFS[func._schema.name]._init_fn)(*args, **kwargs)
        inputs = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        devices = {each.device.type for each in inputs}
        copies_to = args[0].device if name in ("copy", "copy_") else kwargs.get("device")
        if (
            name in ("_to_copy", "copy", "copy_")
            and copies_to is not None
            and {*devices, copies_to.type} == {"cpu", "cuda"}
        ):
            self.copied(name, to_host=copies_to.type == "cpu")
        of_mask = name == "index" and any(each is not None and each.dtype == torch.bool for each in args[1])
        if "cuda" in devices and (name in READS or of_mask):
            raise ReadsDevice(f"{line_of_project()}: {name}")
        output: Any
        if "batch_norm" in name:  # torch's fake writes running statistics in a way that asks for a device guard
            channels = args[0].shape[1]
            output = torch.empty_like(args[0]), args[0].new_empty(channels), args[0].new_empty(channels)
        elif name.endswith("grid_sampler_2d"):  # its fake indexes
            output = args[0].new_empty(*args[0].shape[:2], *args[1].shape[1:3])
        elif name == "cudnn_convolution_relu":  # a build without CUDA has no fake of it
            image, weight, bias, stride, padding, dilation, groups = args
            output = CONVOLUTION.default(image, weight, bias, stride, padding, dilation, False, [0, 0], groups)
        else:
            output = func(*args, **kwargs)
        if name.endswith(("convolution", "convolution_relu")) and args[0].is_contiguous(memory_format=CHANNELS_LAST):
            output = torch.empty_like(output, memory_format=CHANNELS_LAST)  # as cuDNN does
        outputs = [each for each in tree_leaves(output) if isinstance(each, Tensor)]
        on_device = any(each.device.type == self.device.type for each in outputs)
        if on_device and not func.is_view and name not in NO_WORK and not name.startswith(("empty", "new_empty")):
            self.record.operations[name] += 1
            moved = sum(each.numel() * each.element_size() for each in (*inputs, *outputs))
            if name.startswith("cudnn_convolution"):
                flops = flop_registry[CONVOLUTION](*args[:6], False, out_val=output)
            elif product := flop_registry.get(func._overloadpacket):
                flops = product(*args, **kwargs, out_val=output)
            else:
                flops = sum(each.numel() for each in outputs)
            kind = "half" if any(each.dtype in HALF for each in outputs) else kind_of_single(name)
            self.record.work.append(Work(name, float(moved), float(flops), kind, running()))
        return output

    def copied(self, name: str, *, to_host: bool) -> None:
        """A copy between host and device."""
        where = f"{line_of_project()}: {name}"
        (self.record.to_host if to_host else self.record.from_host)[where] += 1
        if to_host:
            raise ToHost(where)


def kind_of_single(name: str) -> str:
    """How torch is set to work in float32: in TF32 or not."""
    if "convolution" in name:
        return "tf32" if torch.backends.cudnn.allow_tf32 else "single"
    return "tf32" if torch.backends.cuda.matmul.fp32_precision == "tf32" else "single"


def running() -> tuple[str, ...]:
    """The functions of the project that are running, the innermost first."""
    names, frame = [], sys._getframe(1)
    while frame is not None:
        if "/hvnet/" in frame.f_code.co_filename:
            names.append(frame.f_code.co_name)
        frame = frame.f_back  # type: ignore[assignment]
    return tuple(names)


def line_of_project() -> str:
    """The line of the project that runs."""
    here = [
        each
        for each in traceback.extract_stack()
        if Path(each.filename).parent != FOLDER and str(ROOT) in each.filename
    ]
    return f"{Path(here[-1].filename).name}:{here[-1].lineno}" if here else "?"


class OtherWays(TorchFunctionMode):
    """Calls that ask for a device guard, which a build without CUDA does not have, by others that do not."""

    def __torch_function__(self, func: Any, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None) -> Any:
        kwargs = kwargs or {}
        if func is Tensor.__getitem__ and args[0].device.type == "cuda":
            return indexed(*args)
        if func is Tensor.__setitem__ and args[0].device.type == "cuda":
            target, key, value = args
            part = indexed(target, key)
            return copy(part, value) if isinstance(value, Tensor) else part.fill_(value)
        if func is torch.cudnn_convolution_relu:
            return torch.ops.aten.cudnn_convolution_relu.default(*args)
        if func is Tensor.__invert__:
            return torch.ops.aten.bitwise_not.default(args[0])
        if func is Tensor.copy_:
            return copy(args[0], args[1])
        if func is Tensor.new_tensor and args[0].device.type == "cuda":
            made = torch.tensor(args[1], dtype=kwargs.get("dtype", args[0].dtype))
            return convert(made, kwargs.get("device", args[0].device))
        if func is torch.tensor and torch.device(kwargs.get("device") or "cpu").type == "cuda":
            return convert(torch.tensor(*args, **{k: v for k, v in kwargs.items() if k != "device"}), CUDA)
        if func is Tensor.to:
            device, dtype, _, memory_format = torch._C._nn._parse_to(
                *args[1:], **{k: v for k, v in kwargs.items() if k != "copy"}
            )
            return convert(args[0], device or args[0].device, dtype, memory_format)
        if func is Tensor.contiguous and args[0].device.type == "cuda":
            layout = {"memory_format": kwargs.get("memory_format", torch.contiguous_format)}
            return args[0] if args[0].is_contiguous(**layout) else torch.ops.aten.clone.default(args[0], **layout)
        if getattr(func, "__name__", "") in READS and args[0].device.type == "cuda":
            raise ReadsDevice(f"{line_of_project()}: {func.__name__}")
        if func is Tensor.cpu:
            return convert(args[0], torch.device("cpu"))
        return func(*args, **kwargs)


def convert(
    tensor: Tensor, device: torch.device, dtype: torch.dtype | None = None, memory_format: Any = None
) -> Tensor:
    """`tensor.to`."""
    same = tensor.device.type == device.type and dtype in (None, tensor.dtype)
    if same and (memory_format is None or tensor.is_contiguous(memory_format=memory_format)):
        return tensor
    device = CUDA if device.type == "cuda" else device
    options = {} if memory_format is None else {"memory_format": memory_format}
    return torch.ops.aten._to_copy.default(tensor, device=device, dtype=dtype or tensor.dtype, **options)


def copy(target: Tensor, source: Tensor) -> Tensor:
    """`target.copy_(source)`: what it gives has no data to be written."""
    torch.ops.aten.copy.default(target, source)
    return target


def indexed(tensor: Tensor, key: Any) -> Tensor:
    """`tensor[key]`, by views and aten::index."""
    key = list(key) if isinstance(key, tuple) else [key]
    dots = [k for k, each in enumerate(key) if each is Ellipsis]
    if dots:
        taken = sum(each.dim() if isinstance(each, Tensor) and each.dtype == torch.bool else 1
                    for each in key if each is not None and each is not Ellipsis)  # fmt: skip
        key[dots[0] : dots[0] + 1] = [slice(None)] * (tensor.dim() - taken)
    dim = 0
    tensors: list[Tensor | None] = []
    for each in key:
        if isinstance(each, int):
            tensor = tensor.select(dim, each)
        elif each is None:
            tensor = tensor.unsqueeze(dim)
            tensors.append(None)
            dim += 1
        elif isinstance(each, slice):
            begin, end, step = each.indices(tensor.shape[dim])
            tensor = torch.ops.aten.slice.Tensor(tensor, dim, begin, max(begin, end), step)
            tensors.append(None)
            dim += 1
        else:
            each = each if isinstance(each, Tensor) else torch.tensor(each)
            tensors.append(each)
            dim += each.dim() if each.dtype == torch.bool else 1
    if any(each is not None for each in tensors):
        tensor = torch.ops.aten.index.Tensor(tensor, tensors)
    return tensor


def apply(module: nn.Module, function: Callable[[Tensor], Tensor], recurse: bool = True) -> nn.Module:
    """`nn.Module._apply`, which swaps what fake tensors cannot swap."""
    for each in module.modules():
        for name, buffer in each._buffers.items():
            each._buffers[name] = buffer if buffer is None else function(buffer)
        for name, weight in each._parameters.items():
            if weight is not None:
                each._parameters[name] = nn.Parameter(function(weight.detach()), weight.requires_grad)
    return module


def deepcopy(tensor: Tensor, memo: dict[int, Tensor]) -> Tensor:
    """`copy.deepcopy` of a tensor, whose storage a fake one does not have."""
    copied = tensor.detach().clone()
    memo[id(tensor)] = nn.Parameter(copied, tensor.requires_grad) if isinstance(tensor, nn.Parameter) else copied
    return memo[id(tensor)]


@contextmanager
def fake_cuda(device: torch.device = CUDA, **sizes: Callable[..., Any]) -> Iterator[Record]:
    """What runs inside may use cuda:0; or the CPU, on the ways of a GPU, where gradients are wanted: torch's autograd
    cannot do without a CUDA build. `sizes`: operations of the project to replace, see `Watch`."""
    record = Record()

    def launched(kernel: wp.Kernel, dim: Any, inputs: Any, **options: Any) -> None:
        tensors = [each for each in inputs if isinstance(each, Tensor)]
        assert all(each.device == device for each in tensors), f"{kernel.key}: {[each.device for each in tensors]}"
        record.launches[name_of(kernel)] += 1
        moved = sum(each.numel() * each.element_size() for each in tensors)
        shapes = tuple((tuple(each.shape), each.element_size()) for each in tensors)
        threads = (dim,) if isinstance(dim, int) else tuple(dim)
        arguments = tuple(each.label for each in kernel.adj.args)
        record.work.append(Work(name_of(kernel), float(moved), 0.0, "single", running(), shapes, threads, arguments))

    with ExitStack() as stack:
        for owner, name, value in (
            (wp, "launch", launched),
            (wp, "from_torch", lambda tensor, **options: tensor),
            (wp, "is_cuda_available", lambda: True),
            (launch, "current_stream", lambda device: None),
            (launch, "force_many_threads", True),
            (nn.Module, "_apply", apply),
            (Tensor, "__deepcopy__", deepcopy),
            (nn.Parameter, "__deepcopy__", deepcopy),
            (torch.cuda, "device", lambda device: nullcontext()),
            (torch.cuda, "get_device_capability", lambda device=None: (9, 0)),
        ):
            stack.enter_context(mock.patch.object(owner, name, value))
        stack.enter_context(FakeTensorMode(allow_non_fake_inputs=True))
        if device == CUDA:
            stack.enter_context(OtherWays())
        stack.enter_context(Watch(record, device, sizes))
        yield record


def index_of_known_length(
    points: Tensor, sample: Tensor, batch_size: int, flat: Sequence[float], voxels: Sequence[int] = ()
) -> list[Tensor]:
    """In the place of `hvnet::voxel_index`, whose lengths training reads once: all points, in as many voxels of every
    scale, by default in half as many as there are points."""
    count, scales = points.shape[0], len(flat) // 10
    parts = [sample.new_empty(count)]
    for of_scale in voxels or [count // 2] * scales:
        parts += [sample.new_empty(of_scale), sample.new_empty(count), sample.new_empty(of_scale + 1)]
    return parts
