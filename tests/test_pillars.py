"""Hard voxels: a small table, the limits on real frames; PointPillars' encoder as it is usually written."""

import copy

import pytest
import torch
from torch import Tensor

from hvnet.config import load_config
from hvnet.data.kitti import read_frame, read_split
from hvnet.kernels import reference
from hvnet.kernels.voxel import is_nested, make_grid
from hvnet.network.model import HVNet
from hvnet.network.pillars import PillarEncoder, hard_voxels
from tests.models import CONFIGS

RANGE = (0.0, -2.0, -3.0, 4.0, 2.0, 2.0)
# in 1 m voxels, by cursor: 5, 5, 0, 5, outside, 0, 10
TABLE = [(1.2, -0.5), (1.7, -0.9), (0.5, -1.5), (1.5, -0.1), (9.0, 0.0), (0.1, -1.1), (2.5, 0.5)]


def table() -> Tensor:
    points = torch.zeros(len(TABLE), 4)
    points[:, :2] = torch.tensor(TABLE)
    return points


@pytest.mark.parametrize(
    ("point_limit", "voxel_limit", "kept"),
    [(0, 0, [0, 1, 2, 3, 5, 6]), (2, 0, [0, 1, 2, 5, 6]), (1, 0, [0, 2, 6]), (9, 2, [0, 1, 2, 3, 5]), (1, 1, [0])],
)
def test_the_first_points_of_the_first_voxels(point_limit: int, voxel_limit: int, kept: list[int]) -> None:
    """Of two samples with the same points each has its own limits."""
    points, sample = table().repeat(2, 1), torch.arange(2).repeat_interleave(len(TABLE))
    grid = make_grid(RANGE, (1.0, 1.0), 1.0)
    hard = hard_voxels(points, sample, 2, grid, point_limit, voxel_limit)
    assert sorted(hard.point.tolist()) == kept + [k + len(TABLE) for k in kept]
    cursor = hard.cursor[hard.voxel]
    assert {5: [0, 1, 3], 0: [2, 5], 10: [6]}[int(cursor[0]) % 16][0] in kept
    for k, at, place in zip(hard.point.tolist(), cursor.tolist(), hard.place.tolist(), strict=True):
        own = {5: [0, 1, 3], 0: [2, 5], 10: [6]}[at % 16]
        assert own.index(k % len(TABLE)) == place
        assert at // 16 == k // len(TABLE)
    assert hard.voxel.max() + 1 == len(hard.cursor) == len(set(cursor.tolist()))


def test_limits_where_the_index_is_hashed() -> None:
    """A grid of more than 2^31 squares' worth of keys: of every voxel the first point, whatever the index."""
    grid = make_grid((0.0, 0.0, -3.0, 8000.0, 20.0, 2.0), (0.1, 0.1), 1.0)
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(300, 4, generator=generator) * torch.tensor([2.0, 2.0, 1.0, 1.0])
    assert not is_nested([grid], 1)
    hard = hard_voxels(points, torch.zeros(300, dtype=torch.int64), 1, grid, 1, 0)
    first = {}
    for k, at in enumerate(reference.cursors(points, torch.zeros(300, dtype=torch.int64), grid).tolist()):
        first.setdefault(at, k)
    assert hard.place.tolist() == [0] * len(first)
    assert sorted(hard.point.tolist()) == sorted(first.values())


def usual(encoder: PillarEncoder, points: Tensor) -> Tensor:
    """PointPillars in plain loops and float64, for one sample: pillars (12000, 100, 9) as a dictionary of lists."""
    grid = encoder.grid
    pillars: dict[tuple[int, int], list[Tensor]] = {}
    for point in points.double():
        x = int((point[0] - grid.x_min) // grid.cell[0])
        y = int((point[1] - grid.y_min) // grid.cell[1])
        inside = 0 <= x < grid.cells[0] and 0 <= y < grid.cells[1] and grid.z_min <= point[2] < grid.z_max
        full = (x, y) not in pillars and 0 < encoder.voxel_limit == len(pillars)
        if inside and not full and len(pillars.setdefault((x, y), [])) < encoder.point_limit:
            pillars[x, y].append(point)
    rows = torch.zeros(len(pillars), encoder.point_limit, 9, dtype=torch.float64)
    for k, ((x, y), own) in enumerate(pillars.items()):
        mean = torch.stack(own).mean(0)
        centre = torch.tensor([grid.x_min + (x + 0.5) * grid.cell[0], grid.y_min + (y + 0.5) * grid.cell[1]])
        for place, point in enumerate(own):
            rows[k, place] = torch.cat((point, point[:3] - mean[:3], point[:2] - centre))
    features = encoder.norm(encoder.linear(rows).flatten(0, 1)).relu().view(len(rows), encoder.point_limit, -1).amax(1)
    image = torch.zeros(1, features.shape[1], *grid.shape, dtype=torch.float64)
    for feature, (x, y) in zip(features, pillars, strict=True):
        image[0, :, x, y] = feature
    return image


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize(("point_limit", "voxel_limit"), [(3, 0), (100, 12), (2, 7)])
def test_the_encoder_is_the_usual_one(training: bool, point_limit: int, voxel_limit: int) -> None:
    torch.manual_seed(0)
    points = torch.rand(200, 4) * torch.tensor([5.0, 5.0, 4.0, 1.0]) - torch.tensor([0.5, 2.5, 3.0, 0.0])
    encoder = PillarEncoder(make_grid(RANGE, (0.8, 1.1), 1.0), 5, point_limit, voxel_limit).train(training)
    torch.nn.init.uniform_(encoder.norm.weight, 0.5, 1.5)
    torch.nn.init.uniform_(encoder.norm.bias, -0.5, 0.5)
    twin = copy.deepcopy(encoder).double()
    (image,) = encoder(points, torch.zeros(200, dtype=torch.int64), 1)
    expected = usual(twin, points)
    torch.testing.assert_close(image.double(), expected, rtol=1e-4, atol=1e-5)
    weight = torch.randn(image.shape)
    (image * weight).sum().backward()
    (expected * weight).sum().backward()
    for own, other in zip(encoder.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(own.grad.double(), other.grad, rtol=1e-3, atol=1e-4)
    for name, buffer in twin.named_buffers():
        torch.testing.assert_close(encoder.get_buffer(name).double(), buffer.double(), rtol=1e-4, atol=1e-6)


def test_clouds_without_a_point() -> None:
    encoder = PillarEncoder(make_grid(RANGE, (1.0, 1.0), 1.0), 4, 3, 5)
    for training in (True, False):
        (image,) = encoder.train(training)(torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64), 2)
        assert image.shape == (2, 4, 4, 4)
        assert not image.any()


def test_pointpillars_has_the_numbers_of_its_paper() -> None:
    """Lang et al., Sec. 2 and 3: D = 9, C = 64, P = 12000, N = 100, pillars of 0.16 m; blocks of 4, 6 and 6 layers with
    C, 2 C, 4 C channels at strides 2, 4 and 8, each brought to 2 C at stride 2: 6 C = 384 for the head."""
    studies = CONFIGS / "studies"
    base = (studies / "base.yaml", CONFIGS / "hvnet.yaml")
    config = load_config(studies / "voxel-size" / "pillars-0.16.yaml", replace_base=base)
    with torch.device("meta"):
        model = HVNet(config)
    assert isinstance(model.encoder, PillarEncoder)
    assert (model.encoder.voxel_limit, model.encoder.point_limit) == (12000, 100)
    assert model.encoder.linear.weight.shape == (64, 9)
    assert model.encoder.grid.cell == (0.16, 0.16)
    assert model.encoder.grid.shape == (400, 400)
    widths, layers, strides = [], [], []
    for block in model.backbone.main_stream.blocks:
        convolutions = [module for module in block.modules() if isinstance(module, torch.nn.Conv2d)]
        widths.append({each.out_channels for each in convolutions})
        layers.append(len(convolutions))
        strides.append(convolutions[0].stride)
    assert (widths, layers, strides) == ([{64}, {128}, {256}], [4, 6, 6], [(2, 2)] * 3)
    ups = [up[0] for up in model.backbone.pyramid.up]
    assert [(up.out_channels, up.stride[0]) for up in ups] == [(128, 1), (128, 2), (128, 4)]
    assert model.heads[0].score.in_channels == 384
    assert len(model.anchors(0)) == 200 * 200 * 8


@pytest.mark.parametrize(("size", "share"), [(0.16, 0.0307), (0.2, 0.0462)])
def test_points_that_the_limit_drops_on_real_frames(kitti_root, size: float, share: float) -> None:  # type: ignore[no-untyped-def]
    """32 points a pillar, which most implementations take, in the paper's range."""
    grid = make_grid((0.0, -32.0, -3.0, 64.0, 32.0, 2.0), (size, size), 1.0)
    whole = kept = 0
    for name in read_split(kitti_root, "train_first") + read_split(kitti_root, "val_first"):
        points = read_frame(kitti_root, name).points
        sample = torch.zeros(len(points), dtype=torch.int64)
        whole += len(hard_voxels(points, sample, 1, grid, 0, 0).point)
        kept += len(hard_voxels(points, sample, 1, grid, 32, 12000).point)
    assert 1 - kept / whole == pytest.approx(share, abs=1e-4)
