"""Rays against meshes: Warp's query against the brute force twin, and hand-made rays with known answers."""

import math
import subprocess
import sys

import pytest
import torch
from torch import Tensor

from hvnet.kernels import reference
from hvnet.kernels.raycast import raycast

# a triangle across the x axis at x = 1; its normal points along +x
TRIANGLE = torch.tensor([[1.0, -1, -1], [1, 1, -1], [1, 0, 1]])
FACE = torch.tensor([[0, 1, 2]])


def rays(count: int, seed: int, device: torch.device) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return origins.to(device), directions.to(device)


def soup(count: int, seed: int, device: torch.device) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    vertices = torch.randn(count, 1, 3, generator=generator) * 4 + torch.randn(count, 3, 3, generator=generator)
    return vertices.view(-1, 3).to(device), torch.arange(3 * count, device=device).view(-1, 3)


def one_ray(origin: list[float], direction: list[float], max_range: float = 10.0) -> tuple[float, int, list[float]]:
    ray = torch.tensor([origin, direction], dtype=torch.float32)
    distance, face, normal = raycast(TRIANGLE, FACE, ray[:1], ray[1:], max_range)
    return distance.item(), int(face), normal[0].tolist()


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_agrees_with_the_twin(device: torch.device, dtype: torch.dtype) -> None:
    vertices, faces = soup(300, 0, device)
    origins, directions = rays(2000, 1, device)
    distance, face, normal = raycast(vertices, faces.to(dtype), origins, directions, 8.0)
    expected = reference.raycast(vertices, faces, origins, directions, 8.0)
    assert 0.2 < (face >= 0).float().mean() < 0.95
    assert face.equal(expected[1])
    torch.testing.assert_close(distance, expected[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(normal, expected[2], rtol=1e-4, atol=1e-4)


def test_shared_edges_are_watertight(device: torch.device) -> None:
    """Rays through the edges and vertices of a grid of triangles: never a gap, the distance as in the twin."""
    y, z = torch.meshgrid(torch.arange(9.0), torch.arange(9.0), indexing="ij")
    vertices = torch.stack((torch.full_like(y, 3.0), y - 4, z - 4), -1).view(-1, 3)
    corner = (torch.arange(8)[:, None] * 9 + torch.arange(8)).flatten()
    faces = torch.cat(
        (torch.stack((corner, corner + 9, corner + 1), 1), torch.stack((corner + 9, corner + 10, corner + 1), 1))
    )
    steps = torch.linspace(-3, 3, 13)  # vertices, and the middles of edges and diagonals
    targets = torch.cartesian_prod(torch.tensor([3.0]), steps, steps)
    directions = torch.nn.functional.normalize(targets, dim=1)
    arguments = [t.to(device) for t in (vertices, faces, torch.zeros_like(directions), directions)]
    distance, face, normal = raycast(*arguments, 20.0)
    assert (face >= 0).all()
    torch.testing.assert_close(distance.cpu(), targets.norm(dim=1))
    torch.testing.assert_close(reference.raycast(*arguments, 20.0)[0], distance)
    torch.testing.assert_close(normal.cpu(), torch.tensor([[1.0, 0, 0]]).expand(len(targets), 3))


def test_hits_from_either_side() -> None:
    assert one_ray([0, 0, 0], [1, 0, 0]) == (1, 0, [1, 0, 0])
    assert one_ray([3, 0, 0], [-1, 0, 0]) == (2, 0, [1, 0, 0])


@pytest.mark.parametrize(
    ("origin", "direction", "max_range"),
    [
        ([0, 3, 0], [1, 0, 0], 10.0),  # beside
        ([2, 0, 0], [1, 0, 0], 10.0),  # behind
        ([1, -5, 0], [0, 1, 0], 10.0),  # edge-on
        ([0, 0, 0], [1, 0, 0], 1.0),  # just out of range
    ],
)
def test_misses(origin: list[float], direction: list[float], max_range: float) -> None:
    assert one_ray(origin, direction, max_range) == (math.inf, -1, [0, 0, 0])
    ray = torch.tensor([origin, direction], dtype=torch.float32)
    twin = reference.raycast(TRIANGLE, FACE, ray[:1], ray[1:], max_range)
    assert (twin[0].item(), twin[1].item()) == (math.inf, -1)


def test_the_nearest_of_several_faces() -> None:
    vertices = torch.cat((TRIANGLE + torch.tensor([4.0, 0, 0]), TRIANGLE, TRIANGLE - torch.tensor([3.0, 0, 0])))
    distance, face, _ = raycast(
        vertices, torch.arange(9).view(3, 3), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), 9.0
    )
    assert (distance.item(), face.item()) == (1, 1)


def test_no_faces_or_no_rays(device: torch.device) -> None:
    vertices, faces = soup(3, 0, device)
    origins, directions = rays(5, 0, device)
    for function in (raycast, reference.raycast):
        distance, face, normal = function(vertices[:0], faces[:0], origins, directions, 8.0)
        assert distance.tolist() == [math.inf] * 5
        assert face.tolist() == [-1] * 5
        assert normal.tolist() == [[0, 0, 0]] * 5
        shapes = [tuple(t.shape) for t in function(vertices, faces, origins[:0], directions[:0], 8.0)]
        assert shapes == [(0,), (0,), (0, 3)]


def test_a_face_without_area_is_never_met() -> None:
    flat = torch.tensor([[1.0, -1, 0], [1, 1, 0], [1, -1, 0]])
    assert raycast(flat, FACE, torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), 9.0)[1].item() == -1


def test_non_contiguous_input() -> None:
    vertices, faces = soup(50, 2, torch.device("cpu"))
    origins, directions = rays(200, 3, torch.device("cpu"))
    strided = [t.T.contiguous().T for t in (vertices, faces, origins, directions)]
    for got, expected in zip(raycast(*strided, 9.0), raycast(vertices, faces, origins, directions, 9.0), strict=True):
        assert got.equal(expected)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"vertices": TRIANGLE.double()}, TypeError, "vertices.*float32.*float64"),
        ({"vertices": TRIANGLE.tolist()}, TypeError, "vertices.*list"),
        ({"vertices": TRIANGLE[:, :2]}, ValueError, "vertices"),
        ({"vertices": TRIANGLE * math.inf}, ValueError, "vertices.*finite"),
        ({"faces": FACE.float()}, TypeError, "faces.*float32"),
        ({"faces": FACE + 1}, ValueError, r"faces.*\[0, 3\)"),
        ({"faces": FACE - 1}, ValueError, r"faces.*\[0, 3\)"),
        ({"origins": torch.zeros(2, 3)}, ValueError, "directions"),
        ({"directions": torch.tensor([[2.0, 0, 0]])}, ValueError, "directions.*length 1.*2"),
        ({"directions": torch.full((1, 3), math.nan)}, ValueError, "directions.*length 1"),
        ({"max_range": 0.0}, ValueError, "max_range.*0"),
        ({"max_range": "9"}, TypeError, "max_range.*str"),
        ({"max_range": math.nan}, ValueError, "max_range"),
    ],
)
def test_wrong_arguments_are_named(change: dict[str, object], error: type[Exception], message: str) -> None:
    arguments: dict[str, object] = {
        "vertices": TRIANGLE,
        "faces": FACE,
        "origins": torch.zeros(1, 3),
        "directions": torch.tensor([[1.0, 0, 0]]),
        "max_range": 9.0,
    }
    with pytest.raises(error, match=message):
        raycast(**(arguments | change))  # type: ignore[arg-type]


def test_no_gradients(device: torch.device) -> None:
    vertices, faces = soup(20, 4, device)
    origins, directions = rays(30, 5, device)
    distance, face, normal = raycast(vertices.requires_grad_(), faces, origins.requires_grad_(), directions, 9.0)
    assert not any(result.requires_grad for result in (distance, face, normal))


def test_opcheck(device: torch.device) -> None:
    for count in (20, 0):
        torch.library.opcheck(torch.ops.hvnet.raycast, (*soup(count, 4, device), *rays(30, 5, device), 9.0))


def test_compiles_into_one_graph() -> None:
    """Its checks of the data too. aot_eager needs no C++ compiler."""
    compiled = torch.compile(raycast, fullgraph=True, backend="aot_eager", dynamic=True)
    cpu = torch.device("cpu")
    for count in (20, 30):
        arguments = (*soup(count, 6, cpu), *rays(2 * count, 7, cpu), 9.0)
        for got, expected in zip(compiled(*arguments), raycast(*arguments), strict=True):
            assert got.equal(expected)
    with pytest.raises(ValueError, match=r"directions.*length 1"):
        compiled(*arguments[:3], 2 * arguments[3], 9.0)


def test_importing_and_casting_print_nothing() -> None:
    code = (
        "import torch; from hvnet.kernels.raycast import raycast;"
        "raycast(torch.eye(3), torch.tensor([[0, 1, 2]]), torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]), 9.0)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout + result.stderr == ""
