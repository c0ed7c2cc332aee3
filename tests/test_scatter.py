"""Scatter max, scatter mean and gather against hand-made tables and their twins, with gradients."""

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from hvnet.kernels import reference, scatter
from hvnet.kernels.shares import CHUNK

INF, NAN = math.inf, math.nan
DTYPES = (torch.float32, torch.float64)


class Table(NamedTuple):
    """A scatter of src (N, C) by index (N,) with all its expected results, (dim_size, C) each."""

    src: list[list[float]]
    index: list[int]
    largest: list[list[float]]
    argmax: list[list[int]]
    mean: list[list[float]]


TABLES = {
    "unsorted, with empty rows": Table(
        src=[[2, 0], [6, 8], [-4, 5], [10, 4], [1, 9]],
        index=[3, 1, 3, 1, 0],
        largest=[[1, 9], [10, 8], [0, 0], [2, 5], [0, 0]],
        argmax=[[4, 4], [3, 1], [5, 5], [0, 2], [5, 5]],
        mean=[[1, 9], [8, 6], [0, 0], [-1, 2.5], [0, 0]],
    ),
    "a tie goes to the largest point": Table(
        src=[[3], [7], [7], [7], [-1], [3]],
        index=[0, 0, 0, 0, 1, 1],
        largest=[[7], [3]],
        argmax=[[3], [5]],
        mean=[[6], [1]],
    ),
    "negative values beat an empty row's 0": Table(
        src=[[-5], [-2], [-3]],
        index=[1, 1, 1],
        largest=[[0], [-2], [0]],
        argmax=[[3], [1], [3]],
        mean=[[0], [-10 / 3], [0]],
    ),
    "zeros of both signs tie": Table(
        src=[[0.0, -0.0], [-0.0, 0.0], [-0.0, -0.0]],
        index=[0, 0, 1],
        largest=[[-0.0, 0.0], [-0.0, -0.0]],
        argmax=[[1, 1], [2, 2]],
        mean=[[0, 0], [0, 0]],
    ),
    "NaN is the maximum": Table(
        src=[[NAN, 1], [INF, 2], [5, 3], [NAN, NAN], [9, NAN], [8, 1]],
        index=[0, 0, 0, 1, 1, 1],
        largest=[[NAN, 3], [NAN, NAN]],
        argmax=[[0, 2], [3, 4]],
        mean=[[NAN, 2], [NAN, NAN]],
    ),
    "infinities": Table(
        src=[[-INF, INF], [-INF, 1], [-INF, -INF], [4, INF]],
        index=[0, 0, 1, 1],
        largest=[[-INF, INF], [4, INF]],
        argmax=[[1, 0], [3, 3]],
        mean=[[-INF, INF], [-INF, NAN]],
    ),
    "the largest float": Table(
        src=[[-3e38], [-INF], [3e38]],
        index=[0, 0, 1],
        largest=[[-3e38], [3e38]],
        argmax=[[0], [2]],
        mean=[[-INF], [3e38]],
    ),
}


def random_case(count: int, channels: int, dim_size: int, seed: int = 0) -> tuple[Tensor, Tensor, int]:
    generator = torch.Generator().manual_seed(seed)
    src = torch.randn(count, channels, generator=generator, dtype=torch.float64)
    return src, torch.randint(dim_size, (count,), generator=generator), dim_size


def tied_case() -> tuple[Tensor, Tensor, int]:
    src, index, dim_size = random_case(500, 20, 7)
    return src.round(), index, dim_size


CASES: dict[str, Callable[[], tuple[Tensor, Tensor, int]]] = {
    "random": lambda: random_case(300, 64, 50),
    "1 channel": lambda: random_case(200, 1, 40),
    "3 channels": lambda: random_case(200, 3, 40),
    "16 channels": lambda: random_case(200, 16, 40),
    "19 channels": lambda: random_case(200, 19, 40),
    "128 channels": lambda: random_case(100, 128, 10),
    "no channel": lambda: random_case(20, 0, 4),
    "no point": lambda: random_case(0, 5, 4),
    "no row": lambda: (torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.int64), 0),
    "one point": lambda: random_case(1, 16, 3),
    "one row": lambda: random_case(1000, 17, 1),
    "mostly empty rows": lambda: random_case(50, 8, 5000),
    "tied": tied_case,
}


def strided(tensor: Tensor) -> Tensor:
    """The same values with gaps between rows and between columns."""
    wide = torch.full([2 * size for size in tensor.shape], 99, dtype=tensor.dtype, device=tensor.device)
    view = wide[(slice(None, None, 2),) * tensor.dim()]
    view.copy_(tensor)
    return view


def transposed(tensor: Tensor) -> Tensor:
    return tensor.t().contiguous().t()


def same_floats(actual: Tensor, expected: Tensor) -> None:
    """Every bit, except that all NaNs are one."""
    torch.testing.assert_close(actual, expected, rtol=0, atol=0, equal_nan=True)
    number = ~expected.isnan()
    assert torch.equal(actual.signbit() & number, expected.signbit() & number)


def sum_tolerance(index: Tensor, src: Tensor, dtype: torch.dtype) -> float:
    """The bound of any order of summation: terms x unit roundoff x the largest term, for one row."""
    terms = int(torch.bincount(index).max()) if len(index) else 0
    largest = float(src.abs().max()) if src.numel() else 0.0
    return (terms + 2) * terms * torch.finfo(dtype).eps * largest


def gradient(call: Callable[[Tensor], Tensor], src: Tensor, upstream: Tensor) -> Tensor:
    leaf = src.detach().clone().requires_grad_()
    call(leaf).backward(upstream)
    assert leaf.grad is not None
    return leaf.grad


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", TABLES)
def test_table(name: str, dtype: torch.dtype, device: torch.device) -> None:
    table = TABLES[name]
    src, index = torch.tensor(table.src, dtype=dtype, device=device), torch.tensor(table.index, device=device)
    values, argmax = scatter.scatter_max(src, index, len(table.largest))
    assert argmax.dtype == torch.int64
    assert argmax.tolist() == table.argmax
    same_floats(values.cpu(), torch.tensor(table.largest, dtype=dtype))
    mean = scatter.scatter_mean(src, index, len(table.mean))
    torch.testing.assert_close(mean.cpu(), torch.tensor(table.mean, dtype=dtype), equal_nan=True)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", CASES)
def test_max_equals_twin(name: str, dtype: torch.dtype, device: torch.device) -> None:
    src, index, dim_size = CASES[name]()
    src = src.to(dtype)
    values, argmax = scatter.scatter_max(src.to(device), index.to(device), dim_size)
    twin_values, twin_argmax = reference.scatter_max(src, index, dim_size)
    same_floats(values.cpu(), twin_values)
    assert torch.equal(argmax.cpu(), twin_argmax)

    upstream = torch.randn(dim_size, src.shape[1], dtype=dtype)
    twin_gradient = gradient(lambda x: reference.scatter_max(x, index, dim_size)[0], src, upstream)
    actual = gradient(
        lambda x: scatter.scatter_max(x, index.to(device), dim_size)[0], src.to(device), upstream.to(device)
    )
    torch.testing.assert_close(actual.cpu(), twin_gradient, rtol=0, atol=0)  # one term each, so no rounding


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", CASES)
def test_mean_equals_twin(name: str, dtype: torch.dtype, device: torch.device) -> None:
    src, index, dim_size = CASES[name]()
    mean = scatter.scatter_mean(src.to(device, dtype), index.to(device), dim_size)
    assert mean.dtype == dtype
    atol = sum_tolerance(index, src, dtype)
    expected = reference.scatter_mean(src, index, dim_size)
    torch.testing.assert_close(mean.cpu().double(), expected, rtol=0, atol=atol)

    upstream = torch.randn(dim_size, src.shape[1], dtype=dtype)
    twin_gradient = gradient(lambda x: reference.scatter_mean(x, index, dim_size), src.to(dtype), upstream)
    actual = gradient(
        lambda x: scatter.scatter_mean(x, index.to(device), dim_size), src.to(device, dtype), upstream.to(device)
    )
    # a quotient, or a product with a rounded reciprocal: 2 roundings
    torch.testing.assert_close(actual.cpu(), twin_gradient, rtol=2 * torch.finfo(dtype).eps, atol=0)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("name", CASES)
def test_gather_equals_twin(name: str, dtype: torch.dtype, device: torch.device) -> None:
    terms, index, rows = CASES[name]()
    src = torch.randn(rows, terms.shape[1], dtype=dtype)
    gathered = scatter.gather(src.to(device), index.to(device))
    assert torch.equal(gathered.cpu(), reference.gather(src, index))

    twin_gradient = gradient(lambda x: reference.gather(x, index), src.double(), terms)
    actual = gradient(lambda x: scatter.gather(x, index.to(device)), src.to(device), terms.to(device, dtype))
    atol = sum_tolerance(index, terms, dtype)
    torch.testing.assert_close(actual.cpu().double(), twin_gradient, rtol=0, atol=atol)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("layout", [strided, transposed])
@pytest.mark.parametrize("channels", [1, 16, 19])
def test_layout_does_not_matter(
    channels: int, layout: Callable[[Tensor], Tensor], dtype: torch.dtype, device: torch.device
) -> None:
    src, index, dim_size = random_case(100, channels, 13)
    src, index = src.to(device, dtype), index.to(device)
    for name in ("scatter_max", "scatter_mean"):
        function = getattr(scatter, name)

        def call(x: Tensor, index: Tensor, function: Callable[..., Tensor] = function, name: str = name) -> Tensor:
            out = function(x, index, dim_size)
            return out[0] if name == "scatter_max" else out

        upstream = torch.randn(dim_size, channels, dtype=dtype, device=device)
        assert torch.equal(call(layout(src), strided(index)), call(src, index))
        expected = gradient(lambda x, call=call: call(x, index), src, upstream)
        of_view = gradient(lambda x, call=call: call(layout(x), strided(index)), src, layout(upstream))
        assert torch.equal(of_view, expected)

    rows, upstream = src[:dim_size], src
    assert torch.equal(scatter.gather(layout(rows), strided(index)), scatter.gather(rows, index))
    expected = gradient(lambda x: scatter.gather(x, index), rows, upstream)
    assert torch.equal(gradient(lambda x: scatter.gather(layout(x), strided(index)), rows, layout(upstream)), expected)


def test_expanded_tensors(device: torch.device) -> None:
    """Stride 0, as the gradient of a sum has it."""
    src = torch.tensor([[1.0, 2.0, 3.0]], device=device).expand(4, 3)
    index = torch.tensor([1], device=device).expand(4)
    values, argmax = scatter.scatter_max(src, index, 2)
    assert values.tolist() == [[0, 0, 0], [1, 2, 3]]
    assert argmax.tolist() == [[4, 4, 4], [3, 3, 3]]
    assert scatter.scatter_mean(src, index, 2).tolist() == [[0, 0, 0], [1, 2, 3]]

    leaf = torch.ones(4, 3, device=device, requires_grad=True)
    scatter.scatter_max(leaf, index, 2)[0].sum().backward()
    scatter.scatter_mean(leaf, index, 2).sum().backward()
    scatter.gather(leaf, index).sum().backward()
    assert leaf.grad is not None
    assert leaf.grad.tolist() == [[0.25] * 3, [4.25] * 3, [0.25] * 3, [1.25] * 3]


def test_gradient_goes_to_the_argmax_alone(device: torch.device) -> None:
    """Also where the gradient is not finite: no 0 * NaN in the other points; an empty row's gradient goes nowhere."""
    src = torch.tensor([[3.0], [3.0], [1.0]], device=device)
    index = torch.tensor([0, 0, 2], device=device)
    upstream = torch.tensor([[NAN], [7.0], [INF]], device=device)
    actual = gradient(lambda x: scatter.scatter_max(x, index, 3)[0], src, upstream)
    same_floats(actual.cpu(), torch.tensor([[0.0], [NAN], [INF]]))


def test_argmax_has_no_gradient(device: torch.device) -> None:
    src = torch.ones(2, 3, device=device, requires_grad=True)
    values, argmax = scatter.scatter_max(src, torch.tensor([0, 1], device=device), 2)
    assert values.requires_grad
    assert not argmax.requires_grad


@pytest.mark.parametrize("channels", [1, 5])
def test_gradcheck(channels: int, device: torch.device) -> None:
    """Distinct values a step of 1 apart, so that the step of the finite difference changes no arg-max."""
    generator = torch.Generator().manual_seed(0)
    src = torch.randperm(20 * channels, generator=generator).reshape(20, channels)
    leaf = src.double().to(device).requires_grad_()
    index = torch.randint(6, (20,), generator=generator).to(device)
    assert torch.autograd.gradcheck(lambda x: scatter.scatter_max(x, index, 8)[0], leaf)
    assert torch.autograd.gradcheck(lambda x: scatter.scatter_mean(x, index, 8), leaf)
    assert torch.autograd.gradcheck(lambda x: scatter.gather(x, index), leaf)


@pytest.mark.parametrize("channels", [1, 5])
def test_second_derivatives(channels: int, device: torch.device) -> None:
    """Also of tied values, where the first derivative has no finite difference, and with empty rows."""
    generator = torch.Generator().manual_seed(0)
    leaf = torch.randperm(20 * channels, generator=generator).reshape(20, channels).double().to(device)
    leaf.requires_grad_()
    index = torch.randint(6, (20,), generator=generator).to(device)

    def largest(x: Tensor) -> Tensor:
        return scatter.scatter_max(x, index, 8)[0]

    assert torch.autograd.gradgradcheck(largest, leaf)
    assert torch.autograd.gradgradcheck(lambda x: largest(x).sin(), leaf)
    assert torch.autograd.gradgradcheck(lambda x: scatter.scatter_mean(x, index, 8).sin(), leaf)
    assert torch.autograd.gradgradcheck(lambda x: scatter.gather(x, index).sin(), leaf)
    none = torch.zeros(0, channels, dtype=torch.float64, device=device, requires_grad=True)
    assert torch.autograd.gradgradcheck(lambda x: scatter.scatter_max(x, index[:0], 3)[0].sin(), none)

    tied = (leaf % 3).detach().requires_grad_()
    upstream = torch.randn(8, channels, dtype=torch.float64, generator=generator).to(device).requires_grad_()
    weight = torch.randn(20, channels, dtype=torch.float64, generator=generator).to(device)
    results = []
    for function in (scatter.scatter_max, reference.scatter_max):
        (first,) = torch.autograd.grad(function(tied, index, 8)[0], tied, upstream, create_graph=True)
        results.append(torch.autograd.grad((first * weight).sum(), upstream)[0])
    assert torch.equal(*results)


def test_second_derivative_by_hand(device: torch.device) -> None:
    """The gradient's gradient is a gather at the arg-max; an empty row's is 0."""
    src = torch.tensor([[3.0, 1], [3, 5], [2, 2]], device=device, requires_grad=True)
    values, argmax = scatter.scatter_max(src, torch.tensor([0, 0, 2], device=device), 3)
    assert argmax.tolist() == [[1, 1], [3, 3], [2, 2]]
    upstream = torch.ones(3, 2, device=device, requires_grad=True)
    (grad,) = torch.autograd.grad(values, src, upstream, create_graph=True)
    (second,) = torch.autograd.grad(grad, upstream, torch.tensor([[1.0, 2], [3, 4], [5, 6]], device=device))
    assert second.tolist() == [[3, 4], [0, 0], [5, 6]]


def test_opcheck(device: torch.device) -> None:
    src, index, dim_size = random_case(20, 5, 6)
    src, index = src.to(device).requires_grad_(), index.to(device)
    rows = torch.randn(6, 5, dtype=torch.float64, device=device, requires_grad=True)
    ops, voxels = torch.ops.hvnet, scatter.segments(index, dim_size)
    torch.library.opcheck(ops.segments, (index, dim_size))
    for order in (voxels.order, None):  # None: of a sorted index
        at_hand = (index if order is not None else index.sort().values, order, voxels.starts)
        torch.library.opcheck(ops.segment_max, (src, *at_hand))
        torch.library.opcheck(ops.segment_sum, (src, *at_hand))
        torch.library.opcheck(ops.gather, (rows, *at_hand))
        torch.library.opcheck(ops.gather_add, (src, rows, *at_hand))
    argmax = torch.ops.hvnet.segment_max(src.detach(), index, voxels.order, voxels.starts)[1]
    torch.library.opcheck(ops.segment_max_backward, (rows, argmax, index))


@pytest.mark.parametrize("name", ["scatter_max", "scatter_mean", "gather"])
def test_compiles_into_one_graph(name: str) -> None:
    """The check of the index too; forward and backward. aot_eager needs no C++ compiler."""

    def function(src: Tensor, index: Tensor, dim_size: int) -> Tensor:
        if name == "gather":
            return scatter.gather(src, index)
        result = getattr(scatter, name)(src, index, dim_size)
        return result[0] * result[1] if name == "scatter_max" else result

    compiled = torch.compile(function, fullgraph=True, backend="aot_eager", dynamic=True)
    for case in (random_case(50, 16, 50), random_case(40, 16, 40)):
        src, index, dim_size = case
        expected, actual = function(*case), compiled(*case)
        assert torch.equal(actual, expected)
        upstream = torch.randn_like(expected)
        assert torch.equal(
            gradient(lambda x, case=case: compiled(x, *case[1:]), src, upstream),
            gradient(lambda x, case=case: function(x, *case[1:]), src, upstream),
        )
    with pytest.raises(ValueError, match=r"index.*\[0, 40\)"):
        compiled(src, index - 1, dim_size)


def test_no_gradient_wanted(device: torch.device) -> None:
    src, index = torch.ones(3, 2, device=device, requires_grad=True), torch.tensor([0, 0, 1], device=device)
    with torch.no_grad():
        assert not scatter.scatter_max(src, index, 2)[0].requires_grad
        assert not scatter.scatter_mean(src, index, 2).requires_grad
        assert not scatter.gather(src, index).requires_grad
    assert not scatter.scatter_mean(src.detach(), index, 2).requires_grad


@pytest.mark.parametrize("dtype", DTYPES)
def test_segments_longer_than_a_share(dtype: torch.dtype, device: torch.device) -> None:
    """Rows that many threads cut: of several shares, of one to the point, with empty rows and what is not finite."""
    size = CHUNK
    generator = torch.Generator().manual_seed(0)
    for count, dim_size in ((40 * size, 3), (3 * size, 3), (size, 1), (size + 1, 1), (3 * size + 1, 200)):
        even = torch.arange(count) * dim_size // count
        for index in (even, torch.randint(dim_size, (count,), generator=generator)):
            src = torch.randint(-4, 4, (count, 5), generator=generator).to(dtype)
            for value in (0.0, NAN, INF):
                src[torch.randint(count, (3,), generator=generator), torch.arange(3)] = value
                inputs = src.to(device), index.to(device), dim_size
                for got, want in zip(scatter.scatter_max(*inputs), reference.scatter_max(*inputs), strict=True):
                    torch.testing.assert_close(got, want, rtol=0, atol=0, equal_nan=True)
                mean = scatter.scatter_mean(*inputs)
                torch.testing.assert_close(mean, reference.scatter_mean(*inputs), equal_nan=True)


def test_segments_at_hand(device: torch.device) -> None:
    """Points that already stand voxel by voxel need no order."""
    src, index, dim_size = random_case(200, 19, 40)
    src, index = src.to(device), index.sort().values.to(device)
    starts = torch.searchsorted(index, torch.arange(dim_size + 1, device=device))
    voxels = scatter.Segments(index, starts, None)
    upstream, rows = torch.randn_like(src[:dim_size]), torch.randn_like(src[:dim_size])
    for actual, expected in zip(
        scatter.segment_max(src, voxels), scatter.scatter_max(src, index, dim_size), strict=True
    ):
        assert torch.equal(actual, expected)
    assert torch.equal(scatter.segment_mean(src, voxels), scatter.scatter_mean(src, index, dim_size))
    assert torch.equal(scatter.segment_gather(rows, voxels), scatter.gather(rows, index))
    for at_hand, by_index, leaf, given in (
        (
            lambda x: scatter.segment_max(x, voxels)[0],
            lambda x: scatter.scatter_max(x, index, dim_size)[0],
            src,
            upstream,
        ),
        (lambda x: scatter.segment_mean(x, voxels), lambda x: scatter.scatter_mean(x, index, dim_size), src, upstream),
        (lambda x: scatter.segment_gather(x, voxels), lambda x: scatter.gather(x, index), rows, src),
    ):
        assert torch.equal(gradient(at_hand, leaf, given), gradient(by_index, leaf, given))


def test_segment_add_is_gather_and_sum(device: torch.device) -> None:
    base, index, dim_size = random_case(60, 7, 9)
    base, index = base.to(device).requires_grad_(), index.to(device)
    rows = torch.randn_like(base[:dim_size]).detach().requires_grad_()
    voxels = scatter.segments(index, dim_size)
    for fused, plain in zip(
        torch.autograd.grad(scatter.segment_add(base, rows, voxels).sin().sum(), (base, rows)),
        torch.autograd.grad((base + scatter.gather(rows, index)).sin().sum(), (base, rows)),
        strict=True,
    ):
        assert torch.equal(fused, plain)
    assert torch.equal(scatter.segment_add(base, rows, voxels), base + scatter.gather(rows, index))


def test_inputs_stay_as_they_are(device: torch.device) -> None:
    src, index, dim_size = random_case(50, 6, 9)
    src, index = src.float().to(device), index.to(device)
    before = src.clone(), index.clone()
    scatter.scatter_max(src, index, dim_size)
    scatter.scatter_mean(src, index, dim_size)
    scatter.gather(src, index)
    assert torch.equal(src, before[0])
    assert torch.equal(index, before[1])


@pytest.mark.parametrize("dim_size", [3, 2000])
def test_same_bits_on_every_run(dim_size: int, device: torch.device) -> None:
    src, index, _ = random_case(20_000, 24, dim_size)
    src, index, rows = src.float().to(device), index.to(device), torch.randn(dim_size, 24, device=device)

    def results() -> list[Tensor]:
        values, argmax = scatter.scatter_max(src, index, dim_size)
        of_max = gradient(lambda x: scatter.scatter_max(x, index, dim_size)[0], src, rows)
        of_mean = gradient(lambda x: scatter.scatter_mean(x, index, dim_size), src, rows)
        of_gather = gradient(lambda x: scatter.gather(x, index), rows, src)
        return [values, argmax, scatter.scatter_mean(src, index, dim_size), of_max, of_mean, of_gather]

    for first, second in zip(results(), results(), strict=True):
        assert torch.equal(first, second)


def test_a_million_points_in_one_row(device: torch.device) -> None:
    count = 1_000_000
    src = torch.rand(count, 4, generator=torch.Generator().manual_seed(0))
    src[123_456], src[654_321] = 2.0, 2.0
    index = torch.ones(count, dtype=torch.int64, device=device)
    values, argmax = scatter.scatter_max(src.to(device), index, 2)
    assert values.tolist() == [[0.0] * 4, [2.0] * 4]
    assert argmax.tolist() == [[count] * 4, [654_321] * 4]
    mean = scatter.scatter_mean(src.to(device), index, 2).cpu()
    # a plain float32 sum of a million terms drifts by 1e-5 to 1e-4 of its value
    torch.testing.assert_close(mean[1].double(), src.double().mean(0), rtol=1e-3, atol=0)


BAD_ARGUMENTS = [
    (TypeError, "src", {"src": [[1.0]]}),
    (TypeError, "src.*float16", {"src": torch.ones(3, 2, dtype=torch.float16)}),
    (TypeError, "src.*int64", {"src": torch.ones(3, 2, dtype=torch.int64)}),
    (ValueError, "src", {"src": torch.ones(3)}),
    (ValueError, "src", {"src": torch.ones(3, 2, 1)}),
    (TypeError, "index", {"index": [0, 1, 1]}),
    (TypeError, "index.*int32", {"index": torch.zeros(3, dtype=torch.int32)}),
    (TypeError, "index.*float32", {"index": torch.zeros(3)}),
    (ValueError, "index", {"index": torch.zeros(3, 1, dtype=torch.int64)}),
    (ValueError, "index.*meta", {"index": torch.zeros(3, dtype=torch.int64, device="meta")}),
    (ValueError, "index.*3", {"index": torch.tensor([0, 1, 3])}),
    (ValueError, "index.*-1", {"index": torch.tensor([0, -1, 1])}),
]


@pytest.mark.parametrize(("error", "match", "changed"), BAD_ARGUMENTS)
def test_bad_arguments(error: type[Exception], match: str, changed: dict[str, object]) -> None:
    given = {"src": torch.ones(3, 2), "index": torch.tensor([0, 1, 1])} | changed
    for function in (scatter.scatter_max, scatter.scatter_mean):
        with pytest.raises(error, match=match):
            function(**given, dim_size=2)
    with pytest.raises(error, match=match):
        scatter.gather(**given)


@pytest.mark.parametrize("function", [scatter.scatter_max, scatter.scatter_mean])
def test_bad_size(function: Callable[[Tensor, Tensor, int], object]) -> None:
    with pytest.raises(ValueError, match=r"index.*3"):
        function(torch.ones(3, 2), torch.zeros(2, dtype=torch.int64), 2)
    with pytest.raises(ValueError, match=r"dim_size.*-1"):
        function(torch.ones(3, 2), torch.zeros(3, dtype=torch.int64), -1)
    with pytest.raises(ValueError, match="index"):
        function(torch.ones(3, 2), torch.zeros(3, dtype=torch.int64), 0)


def test_bad_rows_of_segments_at_hand() -> None:
    """An index of these segments beyond src would be a read of foreign memory."""
    voxels = scatter.segments(torch.tensor([0, 1, 1]), 2)
    for function, rows in ((scatter.segment_max, 3), (scatter.segment_mean, 3), (scatter.segment_gather, 2)):
        with pytest.raises(ValueError, match=rf"src.*\({rows}, any\).*\(1, 4\)"):
            function(torch.ones(1, 4), voxels)
        with pytest.raises(TypeError, match=r"src.*int64"):
            function(torch.ones(rows, 4, dtype=torch.int64), voxels)
    with pytest.raises(ValueError, match=r"base.*\(3, any\)"):
        scatter.segment_add(torch.ones(2, 4), torch.ones(2, 4), voxels)
    with pytest.raises(ValueError, match=r"src.*\(2, 4\)"):
        scatter.segment_add(torch.ones(3, 4), torch.ones(3, 4), voxels)
    with pytest.raises(TypeError, match=r"src.*float64"):
        scatter.segment_add(torch.ones(3, 4), torch.ones(2, 4).double(), voxels)


def test_bad_segments() -> None:
    with pytest.raises(TypeError, match=r"index.*int32"):
        scatter.segments(torch.zeros(3, dtype=torch.int32), 2)
    with pytest.raises(ValueError, match=r"index.*\(any\)"):
        scatter.segments(torch.zeros(3, 1, dtype=torch.int64), 2)
    for wrong in (-1, 2):
        with pytest.raises(ValueError, match=rf"index.*\[0, 2\).*{wrong}"):
            scatter.segments(torch.tensor([0, wrong, 1]), 2)
    with pytest.raises(ValueError, match=r"dim_size.*-1"):
        scatter.segments(torch.zeros(0, dtype=torch.int64), -1)


def test_index_out_of_range_on_the_device(device: torch.device) -> None:
    src = torch.ones(2, 3, device=device)
    with pytest.raises(ValueError, match="index"):
        scatter.scatter_max(src, torch.tensor([0, 2], device=device), 2)
    with pytest.raises(ValueError, match="index"):
        scatter.gather(src, torch.tensor([0, 2], device=device))
