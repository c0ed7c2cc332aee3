"""The fused attention kernel against its twin: values, gradients, ties, and what it refuses."""

import math

import pytest
import torch
from torch import Tensor

from hvnet.kernels import launch, reference
from hvnet.kernels.encode import attend, column_sums, knowledge, write_image
from hvnet.kernels.scatter import Segments, scatter_mean, segments
from hvnet.kernels.shares import CHUNK
from hvnet.kernels.voxel import hash_index


def case(count: int, voxels: int, channels: int, dtype: torch.dtype, device: torch.device, ordered: bool) -> tuple:
    """Features, points, means, layer and segments of random points; with ordered, the points stand by voxel."""
    generator = torch.Generator().manual_seed(count + channels)
    index = torch.randint(voxels, (count,), generator=generator)
    if ordered:
        index = index.sort().values
    points = torch.rand(count, 4, generator=generator, dtype=dtype) * 4 - 2
    features = torch.randn(count, channels, generator=generator, dtype=dtype)
    layer = torch.randn(11, channels, generator=generator, dtype=dtype)
    at = segments(index.to(device), voxels)
    mean = scatter_mean(points.to(device), index.to(device), voxels)
    return features.to(device), points.to(device), mean, layer.to(device), at._replace(order=None) if ordered else at


@pytest.mark.parametrize("relu", [True, False])
@pytest.mark.parametrize("ordered", [True, False])
@pytest.mark.parametrize(
    ("count", "voxels", "channels"),
    [(60, 20, 32), (60, 1, 16), (1, 1, 8), (0, 3, 4), (50, 70, 7), (9, 4, 1), (200, 3, 5), (64, 2, 1)],
)
def test_values_and_gradients(
    count: int, voxels: int, channels: int, relu: bool, ordered: bool, device: torch.device
) -> None:
    features, points, mean, layer, at = case(count, voxels, channels, torch.float64, device, ordered)
    results = []
    for function in (attend, reference.attend):
        inputs = features.clone().requires_grad_(), layer.clone().requires_grad_()
        product, values = function(inputs[0], points, mean, inputs[1], at, relu)
        loss = (product * product.detach().cos()).sum() + (values * values.detach().sin()).sum()
        results.append((product, values, *torch.autograd.grad(loss, inputs, allow_unused=True)))
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12)
    without, same = attend(features, points, mean, layer, at, relu, keep=False)
    assert without.shape == (0, channels)
    assert torch.equal(same, results[0][1])


@pytest.mark.parametrize("relu", [True, False])
@pytest.mark.parametrize("keep", [True, False])
def test_gradcheck(relu: bool, keep: bool, device: torch.device) -> None:
    features, points, mean, layer, at = case(12, 5, 3, torch.float64, device, ordered=False)

    def outputs(features: Tensor, layer: Tensor) -> tuple[Tensor, ...]:
        product, values = attend(features, points, mean, layer, at, relu, keep)
        return (product, values) if keep else (values,)

    assert torch.autograd.gradcheck(outputs, (features.requires_grad_(), layer.requires_grad_()))


def test_second_derivatives(device: torch.device) -> None:
    """Of sums and images; the product of `attend` has none, and says so."""
    rows = torch.randn(4, 3, dtype=torch.float64, device=device, requires_grad=True)
    cursor = torch.tensor([5, 0, 3, 8], device=device)
    assert torch.autograd.gradgradcheck(lambda x: [sums.sin() for sums in column_sums(x)], rows)
    assert torch.autograd.gradgradcheck(lambda x: write_image(x, cursor, 9).sin(), rows)
    features, points, mean, layer, at = case(12, 5, 3, torch.float64, device, ordered=False)
    values = attend(features.requires_grad_(), points, mean, layer, at)[1]
    (grad,) = torch.autograd.grad(values.square().sum(), features, create_graph=True)
    with pytest.raises(RuntimeError, match="attend_backward"):
        grad.sum().backward()


def test_float32_is_near_float64(device: torch.device) -> None:
    features, points, mean, layer, at = case(500, 90, 64, torch.float64, device, ordered=True)
    want = attend(features, points, mean, layer, at)
    got = attend(features.float(), points.float(), mean.float(), layer.float(), at)
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a.double(), b, rtol=1e-5, atol=1e-5)  # nine products of numbers up to 4


def test_a_tie_goes_to_the_last_point(device: torch.device) -> None:
    """Three equal points in one voxel: the gradient of the maximum goes to the third alone."""
    points = torch.tensor([[1.0, 2.0, 3.0, 0.5]], device=device).repeat(3, 1)
    at = segments(torch.zeros(3, dtype=torch.int64, device=device), 1)
    features = torch.full((3, 2), 2.0, device=device, requires_grad=True)
    layer = torch.zeros(11, 2, device=device)
    layer[8] = torch.tensor([1.5, -1.5])
    layer[9] = 1
    product, values = attend(features, points, points[:1], layer, at)
    assert product.tolist() == [[3.0, -3.0]] * 3
    assert values.tolist() == [[3.0, -3.0]]
    (grad,) = torch.autograd.grad(values.sum(), features)
    assert grad.tolist() == [[0, 0], [0, 0], [1.5, -1.5]]


@pytest.mark.parametrize("relu", [True, False])
@pytest.mark.parametrize("ordered", [True, False])
def test_one_thread_and_many_give_the_same_maxima(
    relu: bool, ordered: bool, device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Voxels longer than what a thread takes, some without points, ties between parts, and a NaN in one of them."""
    cpu = torch.device("cpu")
    for count, voxels in ((500, 3), (96, 3), (97, 200), (CHUNK, 1), (CHUNK + 1, 1), (0, 2)):
        features, points, mean, layer, own = case(count, voxels, 3, torch.float32, cpu, ordered)
        features = (4 * features).round() / 4  # equal values
        if count:
            points, mean, layer = points.round(), mean.round(), layer.round()
            features[count // 2, 1] = math.nan
        inputs = features, points, mean, layer, own.voxel, own.order, own.starts, relu, True
        monkeypatch.setattr(launch, "force_many_threads", False)
        want = torch.ops.hvnet.attend(*inputs)
        monkeypatch.setattr(launch, "force_many_threads", True)
        got = torch.ops.hvnet.attend(*(x.to(device) if isinstance(x, Tensor) else x for x in inputs))
        for a, b in zip(got, want, strict=True):
            torch.testing.assert_close(a.cpu(), b, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize(("count", "channels"), [(5000, 32), (1024, 7), (1, 16), (0, 4), (3, 0)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_column_sums(count: int, channels: int, dtype: torch.dtype, device: torch.device) -> None:
    rows = torch.randn(count, channels, dtype=dtype, device=device, requires_grad=True)
    results = []
    for function in (column_sums, reference.column_sums):
        total, squares = function(rows)
        results.append((total, squares, *torch.autograd.grad((total.cos() + squares.sin()).sum(), rows)))
    for got, want in zip(*results, strict=True):
        tolerance = 1e-5 if got.dtype == torch.float32 else 1e-10  # the gradient is rounded to the dtype of the rows
        torch.testing.assert_close(got, want, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [0, 1, 30])
def test_write_image(count: int, dtype: torch.dtype, device: torch.device) -> None:
    features = torch.randn(count, 5, dtype=dtype, device=device, requires_grad=True)
    cursor = torch.randperm(40, generator=torch.Generator().manual_seed(count))[:count].to(device)
    results = []
    for function in (write_image, reference.write_image):
        image = function(features, cursor, 40)
        results.append((image, *torch.autograd.grad(image.cos().sum(), features)))
    assert all(torch.equal(got, want) for got, want in zip(*results, strict=True))
    assert ((results[0][0] != 0).any(dim=1)).sum() == count


def test_knowledge_by_hand(device: torch.device) -> None:
    points = torch.tensor([[1.0, 2.0, 3.0, 0.5], [3.0, 2.0, 1.0, 0.1], [7.0, 7.0, 7.0, 0.7]], device=device)
    mean = torch.tensor([[2.0, 2.0, 2.0, 0.25], [7.0, 7.0, 7.0, 0.75]], device=device)
    rows = knowledge(points, mean, torch.tensor([0, 0, 1], device=device))
    assert rows.tolist() == [
        pytest.approx([-1, 0, 1, 0.5, 2, 2, 2, 0.25, 1]),
        pytest.approx([1, 0, -1, 0.1, 2, 2, 2, 0.25, 1]),
        pytest.approx([0, 0, 0, 0.7, 7, 7, 7, 0.75, 1]),
    ]


def test_same_bits_twice(device: torch.device) -> None:
    features, points, mean, layer, at = case(3000, 200, 64, torch.float32, device, ordered=False)
    runs = []
    for _ in range(2):
        inputs = features.clone().requires_grad_(), layer.clone().requires_grad_()
        product, values = attend(inputs[0], points, mean, inputs[1], at)
        runs.append((product, values, *torch.autograd.grad(product.sum() + values.square().sum(), inputs)))
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


def test_bad_arguments() -> None:
    features, points, mean, layer, at = case(6, 3, 4, torch.float32, torch.device("cpu"), ordered=False)
    with pytest.raises(TypeError, match=r"features: want a torch\.Tensor, got list"):
        attend([1.0], points, mean, layer, at)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"points: want dtype torch\.float32, got torch\.float64"):
        attend(features, points.double(), mean, layer, at)
    with pytest.raises(ValueError, match=r"points: want shape \(6, 4\), got \(5, 4\)"):
        attend(features, points[:5], mean, layer, at)
    with pytest.raises(ValueError, match=r"mean: want shape \(3, 4\), got \(2, 4\)"):
        attend(features, points, mean[:2], layer, at)
    with pytest.raises(ValueError, match=r"layer: want shape \(11, 4\), got \(8, 4\)"):
        attend(features, points, mean, layer[:8], at)


def test_opcheck(device: torch.device) -> None:
    """torch.library's own checks of the ops: schema, fake tensors, autograd registration, compilation."""
    features, points, mean, layer, at = case(20, 6, 16, torch.float32, device, ordered=False)
    inputs = features.requires_grad_(), points, mean, layer.requires_grad_()
    ops = torch.ops.hvnet
    for order in (at.order, None):
        for keep in (True, False):
            torch.library.opcheck(ops.attend, (*inputs, at.voxel, order, at.starts, False, keep))
    given = [tensor.detach() for tensor in (*ops.attend(*inputs, at.voxel, at.order, at.starts, True, True),)]
    for grad_product in (given[0], None):
        tensors = (
            grad_product,
            given[1],
            *(tensor.detach() for tensor in inputs),
            at.voxel,
            at.order,
            at.starts,
            given[2],
        )
        torch.library.opcheck(ops.attend_backward, (*tensors, True))
    rows = torch.randn(6, 5, device=device, requires_grad=True)
    torch.library.opcheck(ops.write_image, (rows, torch.tensor([5, 0, 3, 8, 1, 2], device=device), 9))
    torch.library.opcheck(ops.column_sums, (rows,))


def test_compiles_into_one_graph() -> None:
    """Forward and backward. aot_eager needs no C++ compiler."""

    def function(features: Tensor, points: Tensor, mean: Tensor, layer: Tensor, at: Segments) -> tuple[Tensor, ...]:
        product, values = attend(features, points, mean, layer, at)
        image = write_image(values, torch.arange(len(values)) * 2, 2 * len(values))
        return (image, knowledge(points, mean, at.voxel), *column_sums(product))

    compiled = torch.compile(function, fullgraph=True, backend="aot_eager", dynamic=True)
    for count in (40, 30):
        arguments = case(count, 9, 16, torch.float64, torch.device("cpu"), ordered=False)
        leaves = arguments[0].requires_grad_(), arguments[3].requires_grad_()
        results = []
        for each in (function, compiled):
            outputs = each(*arguments)
            results.append((*outputs, *torch.autograd.grad(sum(out.sum() for out in outputs), leaves)))
        for expected, actual in zip(*results, strict=True):
            torch.testing.assert_close(actual, expected, rtol=1e-12, atol=1e-12)


def test_segments_are_those_of_the_hash_table() -> None:
    cursor = torch.tensor([7, 3, 7, 900, 3])
    unique, index = hash_index(cursor)
    assert isinstance(segments(index, len(unique)), Segments)
    assert unique[segments(index, len(unique)).voxel].tolist() == cursor.tolist()
