"""Several processes that train one model together, each a rank: started by torchrun, or one process alone."""

import os
import warnings
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.autograd.function import once_differentiable


def start(device: torch.device) -> torch.device:
    """Joins the processes that torchrun started, if it did; returns the device of this one.

    The first rank may generate scenes or build a database while the others wait, hence the long time-out.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) > 1:
        if device.type == "cuda":
            device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
            torch.cuda.set_device(device)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=timedelta(hours=2))
    return device


def stop() -> None:
    """Leaves the other processes."""
    if dist.is_initialized():
        dist.destroy_process_group()


def size() -> int:
    """The number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """The number of this process; 0 prints and writes."""
    return dist.get_rank() if dist.is_initialized() else 0


def broadcast(value: Any) -> Any:
    """The value that rank 0 gives; the others wait for it."""
    if size() == 1:
        return value
    values = [value]
    dist.broadcast_object_list(values)
    return values[0]


def all_gather(value: Any) -> list[Any]:
    """The values of all ranks, on every rank."""
    if size() == 1:
        return [value]
    values: list[Any] = [None] * size()
    dist.all_gather_object(values, value)
    return values


class _AllReduce(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        total = value.clone()
        dist.all_reduce(total)
        return total

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        total = grads[0].clone()
        dist.all_reduce(total)
        return total


def all_reduce(value: Tensor) -> Tensor:
    """The sum of a tensor over all ranks; the gradient is that of the sum of what all ranks make of it."""
    return _AllReduce.apply(value) if size() > 1 else value


class BatchNorm2d(nn.BatchNorm2d):
    """A batch norm over the batch of all ranks together."""

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, C, H, W) normalised."""
        if not self.training or size() == 1:
            return super().forward(features)
        wide = features.float()
        mean, variance = wide.new_zeros(2, self.num_features)
        # for its statistics alone: torch.var_mean is much slower on a CPU
        nn.functional.batch_norm(wide.detach(), mean, variance, training=True, momentum=1.0)
        own = torch.stack((torch.full_like(mean, wide[:, 0].numel()), mean, variance))
        gathered = [torch.empty_like(own) for _ in range(size())]
        dist.all_gather(gathered, own)
        counts, means, variances = torch.stack(gathered, dim=1)  # (ranks, C) each
        count = counts.sum(dim=0)
        joint = (counts * means).sum(dim=0) / count
        squares = ((counts - 1) * variances + counts * (means - joint).square()).sum(dim=0)
        batches = self.get_buffer("num_batches_tracked").add_(1)
        momentum = 1 / batches if self.momentum is None else self.momentum  # None: the mean of all batches
        self.get_buffer("running_mean").lerp_(joint, momentum)
        self.get_buffer("running_var").lerp_(squares / (count - 1), momentum)
        out: Tensor = _Normalise.apply(wide, self.weight, self.bias, joint, squares / count, count, self.eps)
        return out.to(features.dtype)


class _Normalise(torch.autograd.Function):
    """Features (B, C, H, W) float32 normalised by the statistics (C,) of all ranks, by torch's own kernels.

    The backward pass exchanges the sums of all ranks once.
    """

    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        weight: Tensor,
        bias: Tensor,
        mean: Tensor,
        variance: Tensor,
        count: Tensor,
        eps: float,
    ) -> Tensor:
        ctx.save_for_backward(features, weight, mean, variance, count)
        ctx.eps = eps
        return nn.functional.batch_norm(features, mean, variance, weight, bias, eps=eps)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        features, weight, mean, variance, count = ctx.saved_tensors
        scale = torch.rsqrt(variance + ctx.eps)
        _, grad_weight, grad_bias = torch.ops.aten.native_batch_norm_backward(
            grads[0], features, weight, mean, variance, mean, scale, False, ctx.eps, [False, True, True]
        )
        total = torch.stack((grad_weight, grad_bias))
        dist.all_reduce(total)
        mean_of_products, mean_of_grads = total / count
        # weight * scale * (grad - mean_of_grads - x^ * mean_of_products), with x^ = (x - mean) * scale;
        # the products are grad * x^
        grad_factor = weight * scale
        feature_factor = -grad_factor * scale * mean_of_products
        constant = -grad_factor * mean_of_grads - feature_factor * mean
        grad_factor, feature_factor, constant = (
            each[:, None, None] for each in (grad_factor, feature_factor, constant)
        )
        grad_input = torch.addcmul(constant, features, feature_factor).addcmul_(grads[0], grad_factor)
        return grad_input, grad_weight, grad_bias, None, None, None, None


def wrap_ddp(model: nn.Module) -> nn.Module:
    """The model with gradients that are averaged over the ranks; alone, the model itself."""
    if size() == 1:
        return model
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # torch 2.13 has another name for broadcast_buffers
        # a pyramid level that no class uses has no gradient; buffers are the same on every rank
        return nn.parallel.DistributedDataParallel(model, find_unused_parameters=True, broadcast_buffers=False)
