"""What only a GPU can show: training, detection, graphs, streams and devices, against the CPU.

The kernels' own tests run on CUDA as well, by the fixture `device`. Of CPU and CUDA only integers are promised to be
the same, and arg-maxima of the same inputs; floats are close: a GPU contracts a * b + c into one operation, and it has
another sine and cosine. Two runs on one GPU give the same bits. TF32 is left out of comparisons.
"""

import copy
import dataclasses
import gc
import itertools
import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import hvnet
from hvnet.config import AugmentConfig, Config, EncoderConfig, load_config
from hvnet.data.augment import augment, mix_sectors
from hvnet.data.gt_database import load_database
from hvnet.data.insert import TrainingFrame, sampler_of
from hvnet.data.kitti import read_split
from hvnet.data.occlusion import nearest_points
from hvnet.data.scenes.files import make_frame
from hvnet.data.scenes.street import Options
from hvnet.kernels import reference
from hvnet.kernels.encode import attend
from hvnet.kernels.raycast import raycast
from hvnet.kernels.rotated import nms_order, rotated_iou_bev, rotated_match, rotated_nms
from hvnet.kernels.scatter import scatter_max, segments
from hvnet.kernels.voxel import cursors, hash_index, make_grid, voxel_index
from hvnet.network import fused
from hvnet.network.checkpoint import load_checkpoint
from hvnet.network.detector import MAX_GRAPHS, Detector
from hvnet.network.encoder import HybridVoxelEncoder
from hvnet.network.fused import FusedEncoder
from hvnet.network.model import Detections, HVNet
from hvnet.network.pillars import PillarEncoder, hard_voxels
from hvnet.training.batches import kitti_data
from hvnet.training.run import Run
from tests.encoders import SCALES, SMALL, cloud, restless, trained
from tests.helpers import ROOT, random_boxes, same
from tests.models import CONFIGS, NARROW, SHORT, lively, some_clouds, some_points

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    pytest.mark.usefixtures("plain_float32"),
]

GPU, CPU = torch.device("cuda"), torch.device("cpu")
LOSS = 1e-4  # relative; weights that are off by 3e-7 of themselves stay within it on a CPU
GRADIENT = 1e-2  # of the norm
ROUNDING = 1e-7  # of a weight
PRODUCTS_IN_TF32 = fused.products_in_tf32
RAYS = 1_000_000  # enough to keep a GPU busy for milliseconds
WAITS = 2  # that a step of training may make the host wait for the device


@pytest.fixture
def second() -> torch.device:
    if torch.cuda.device_count() < 2:
        pytest.skip("there is one CUDA device only")
    return torch.device("cuda:1")


@pytest.fixture(scope="module")
def street() -> Tensor:
    """What the camera sees of a generated street: 20,000 points (N, 4)."""
    return torch.from_numpy(make_frame(0, 0, Options(azimuth=41))[1].points)


def errors_in_norm(got: Sequence[Tensor], want: Sequence[Tensor]) -> list[float]:
    """|got - want| / |want| for every tensor; one that is next to nothing is measured by the largest."""
    norms = [float(b.double().norm()) for b in want]
    return [
        float((a.detach().cpu().double() - b.detach().double()).norm()) / max(norm, 1e-3 * max(norms))
        for a, b, norm in zip(got, want, norms, strict=True)
    ]


def near_in_norm(got: Sequence[Tensor], want: Sequence[Tensor], tolerance: float) -> None:
    errors = errors_in_norm(got, want)
    assert max(errors) <= tolerance, [(tuple(b.shape), error) for b, error in zip(want, errors, strict=True)]


def near(got: Sequence[Tensor], want: Sequence[Tensor], tolerance: float) -> None:
    for a, b in zip(got, want, strict=True):
        torch.testing.assert_close(a.cpu(), b, rtol=tolerance, atol=tolerance * float(b.detach().abs().amax()))


def equal(got: Sequence[Tensor], want: Sequence[Tensor]) -> None:
    assert len(got) == len(want)
    for k, (a, b) in enumerate(zip(got, want, strict=True)):
        assert torch.equal(a.cpu(), b.cpu()), k


def same_boxes(found: Detections, want: Detections, tolerance: float) -> None:
    """The same boxes in the same order; of the yaw the direction counts."""
    equal([found.labels], [want.labels])
    near([found.scores, found.boxes[:, :6]], [want.scores, want.boxes[:, :6]], tolerance)
    assert ((found.boxes[:, 6] - want.boxes[:, 6]).cos() > 1 - 10 * tolerance).all()


def share_found(found: Detections, want: Detections, score: float, iou: float) -> float:
    """The share of the boxes of at least this score that were found in their class, with at least this IoU."""
    hits = []
    for label in want.labels.unique().tolist():
        sure = want.boxes[(want.labels == label) & (want.scores >= score)]
        others = found.boxes[found.labels == label]
        hits += (rotated_iou_bev(sure, others) >= iou).any(dim=1).tolist() if len(sure) else []
    assert len(hits) >= 3
    return sum(hits) / len(hits)


def waits_of(work: Callable[[], object]) -> int:
    """How often torch made the host wait for the device."""
    torch.cuda.synchronize(GPU)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            work()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    # the mode has a warning about itself
    return sum("called a synchronizing" in str(each.message) for each in caught)


# --- kernels: integers and arg-maxima are the CPU's ------------------------------------------------------------------


@pytest.mark.parametrize("scales", [(0.5, 1.0, 2.0, 4.0), (1.0, 1.5)])  # one sort, and the hash table
def test_the_index_of_a_street(street: Tensor, scales: tuple[float, ...]) -> None:
    grids = [make_grid((0.0, -32.0, -3.0, 64.0, 32.0, 2.0), (0.2, 0.2), scale) for scale in scales]
    sample = torch.arange(len(street)) % 3
    want, found = voxel_index(street, sample, 3, grids), voxel_index(street.to(GPU), sample.to(GPU), 3, grids)
    equal([found.order], [want.order])
    for got, expected in zip(found.scales, want.scales, strict=True):
        equal([got.cursor], [expected.cursor])
        equal([part for part in got.segments if part is not None], [p for p in expected.segments if p is not None])
    for grid in grids:
        cursor = cursors(street, sample, grid)
        equal([cursors(street.to(GPU), sample.to(GPU), grid)], [cursor])
        equal(hash_index(cursor[cursor >= 0].to(GPU)), hash_index(cursor[cursor >= 0]))
        hard = hard_voxels(street, sample, 3, grid, 5, 400)
        equal(hard_voxels(street.to(GPU), sample.to(GPU), 3, grid, 5, 400), hard)


@pytest.mark.parametrize("channels", [64, 7])
def test_arg_maxima_with_ties(channels: int) -> None:
    """Values of five kinds, NaN and infinities among them: the bits of values and arg-maxima."""
    generator = torch.Generator().manual_seed(channels)
    kinds = torch.tensor([0.0, -0.0, 1.5, math.nan, math.inf, -math.inf])
    src = kinds[torch.randint(len(kinds), (5000, channels), generator=generator)]
    src[:2500] = src[:2500].nan_to_num(nan=0.25)
    index = torch.cat((torch.randint(300, (2500,), generator=generator), torch.randint(300, 700, (2500,))))
    values, argmax = scatter_max(src, index, 800)
    got, got_argmax = scatter_max(src.to(GPU), index.to(GPU), 800)
    equal([got_argmax], [argmax])
    assert torch.equal(got.cpu().view(torch.int32)[~values.isnan()], values.view(torch.int32)[~values.isnan()])
    assert torch.equal(got.cpu().isnan(), values.isnan())


def test_attention_of_whole_numbers() -> None:
    """All products and sums are exact, contracted or not: values, and gradients by way of the arg-max, are the same."""
    generator = torch.Generator().manual_seed(0)

    def whole(*shape: int) -> Tensor:
        return torch.randint(-3, 4, shape, generator=generator).float()

    features, points, mean, layer = whole(3000, 32), whole(3000, 4), whole(200, 4), whole(11, 32)
    index = torch.randint(200, (3000,), generator=generator)
    given = whole(3000, 32), whole(200, 32)
    for relu in (False, True):
        results = []
        for device in (CPU, GPU):
            inputs = [tensor.to(device).requires_grad_() for tensor in (features, layer)]
            voxels = segments(index.to(device), 200)
            outputs = attend(inputs[0], points.to(device), mean.to(device), inputs[1], voxels, relu)
            slopes = torch.autograd.grad(outputs, inputs, [tensor.to(device) for tensor in given])
            results.append([*outputs, *slopes])
        equal(results[1], results[0])


def test_nms_and_matching_of_many_boxes() -> None:
    """Candidates whose IoU is clear of the threshold; of anchors the box, of boxes the anchor."""
    boxes = random_boxes(1500, 3, spread=30).float()
    clear = ((rotated_iou_bev(boxes, boxes) - 0.3).abs() > 1e-4).all(dim=1)
    boxes = boxes[clear]
    scores = torch.rand(len(boxes), generator=torch.Generator().manual_seed(0))
    assert len(boxes) > 1000
    kept = rotated_nms(boxes, scores, 0.3)
    assert 100 < len(kept) < len(boxes) - 100
    equal([rotated_nms(boxes.to(GPU), scores.to(GPU), 0.3)], [kept])
    equal(nms_order(boxes.to(GPU), scores.to(GPU), 0.3), nms_order(boxes, scores, 0.3))
    anchors, starts = random_boxes(5000, 4, spread=30).float(), torch.tensor([0, 10, 10, 40])
    iou, box, anchor = rotated_match(anchors, boxes[:40], starts)
    got, nearest, best = rotated_match(anchors.to(GPU), boxes[:40].to(GPU), starts.to(GPU))
    equal([nearest, best], [box, anchor])
    assert (box >= 0).any()
    near([got], [iou], 1e-4)
    near([rotated_iou_bev(boxes[:300].to(GPU), boxes.to(GPU))], [rotated_iou_bev(boxes[:300], boxes)], 1e-4)


# --- encoders --------------------------------------------------------------------------------------------------------


def pass_through(encoder: nn.Module, device: torch.device, points: Tensor, sample: Tensor) -> list[list[Tensor]]:
    """Images, gradients and statistics of one pass of a copy of the encoder on a device."""
    encoder = copy.deepcopy(encoder).to(device)
    images = encoder(points.to(device), sample.to(device), 2)
    generator = torch.Generator().manual_seed(1)
    given = [torch.randn(image.shape, generator=generator).to(device) for image in images]
    gradients = torch.autograd.grad(images, list(encoder.parameters()), given)
    return [list(images), list(gradients), [buffer.float() for buffer in encoder.buffers()]]


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("vfe", ["attentive", "plain"])
@pytest.mark.parametrize(("feature_scales", "projection_scales"), SCALES)
def test_encoder_forward_and_backward(
    feature_scales: tuple[float, ...], projection_scales: tuple[float, ...], vfe: str, training: bool
) -> None:
    torch.manual_seed(1)
    config = dataclasses.replace(SMALL, vfe=vfe, feature_scales=feature_scales, projection_scales=projection_scales)
    encoder = restless(HybridVoxelEncoder(config)).train(training)
    inputs = cloud(1500)
    want, got, again = (pass_through(encoder, device, *inputs) for device in (CPU, GPU, GPU))
    near(got[0], want[0], 1e-4)
    for own, other in zip(got[0], want[0], strict=True):
        assert torch.equal((own == 0).all(dim=1).cpu(), (other == 0).all(dim=1))  # the cells without points
    near_in_norm(got[1], want[1], GRADIENT)
    near(got[2], want[2], 1e-4)
    for one, other in zip(again, got, strict=True):
        equal(one, other)


@pytest.mark.parametrize("training", [True, False])
def test_pillars_forward_and_backward(training: bool) -> None:
    torch.manual_seed(2)
    encoder = PillarEncoder(make_grid(SMALL.point_range, (0.4, 0.4), 1.0), 16, 4, 150).train(training)
    inputs = cloud(1500)
    want, got, again = (pass_through(encoder, device, *inputs) for device in (CPU, GPU, GPU))
    near(got[0], want[0], 1e-4)
    near_in_norm(got[1], want[1], GRADIENT)
    near(got[2], want[2], 1e-4)
    for one, other in zip(again, got, strict=True):
        equal(one, other)


def test_encoder_of_no_points_and_of_one() -> None:
    torch.manual_seed(3)
    encoder = restless(HybridVoxelEncoder(SMALL))
    for points, sample in (cloud(0), cloud(1), (torch.full((3, 4), math.nan), torch.zeros(3, dtype=torch.int64))):
        for training in (True, False):
            encoder.train(training)
            want, got = (pass_through(encoder, device, points, sample) for device in (CPU, GPU))
            near(got[0], want[0], 1e-4)
            near_in_norm(got[1], want[1], GRADIENT)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("scales", SCALES[:4])
def test_images_of_a_detector(scales: tuple[tuple[float, ...], tuple[float, ...]], dtype: torch.dtype) -> None:
    """In inference: clouds one after the other, so that what the one before has written must be gone."""
    encoder = trained(dataclasses.replace(SMALL, feature_scales=scales[0], projection_scales=scales[1]))
    on_cpu, on_gpu = FusedEncoder(encoder), FusedEncoder(copy.deepcopy(encoder).to(GPU))
    tolerance = {torch.float32: 1e-4, torch.float16: 2e-3, torch.bfloat16: 1e-2}[dtype]  # a unit in the last digit
    for count, seed in ((700, 0), (40, 1), (0, 2), (1500, 3)):
        points, sample = cloud(count, seed)
        want = [image.clone() for image in on_cpu(points, sample, 2)]
        got = on_gpu(points.to(GPU), sample.to(GPU), 2, dtype)
        for own, other in zip(got, want, strict=True):
            assert own.dtype == dtype
            assert own.is_contiguous(memory_format=torch.channels_last)
            largest = float(other.abs().amax())
            torch.testing.assert_close(own.float().cpu(), other, rtol=tolerance, atol=tolerance * 1e-2 * largest)


def test_what_tf32_costs(street: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the paper's setting products of numbers of 11 bits move no value by 0.1 % of the largest (0.04 % where a CPU
    rounds them so)."""
    torch.manual_seed(5)
    encoder = HybridVoxelEncoder(EncoderConfig()).to(GPU)
    points, sample = street.to(GPU), torch.zeros(len(street), dtype=torch.int64, device=GPU)
    encoder.train()(points, sample, 1)
    run = FusedEncoder(encoder.eval())
    want = [image.clone() for image in run(points, sample, 1)]
    monkeypatch.setattr(fused, "products_in_tf32", PRODUCTS_IN_TF32)
    near(run(points, sample, 1), [image.cpu() for image in want], 1e-3)


def test_the_benchmarks_twin_on_a_gpu(street: Tensor, monkeypatch: pytest.MonkeyPatch) -> None:
    """The encoder in plain torch, with which bench/voxel_encode.py compares: on CUDA the same images and gradients."""
    pytest.importorskip("numba")
    monkeypatch.syspath_prepend(ROOT / "bench")
    from torch_encoder import TorchEncoder, library

    torch.manual_seed(4)
    encoder = restless(HybridVoxelEncoder(SMALL)).train().to(GPU)
    scatter = library("torch")
    assert scatter is not None
    twin = TorchEncoder(SMALL, encoder, scatter)
    points, sample = cloud(1500)
    own, other = (pass_through(each, GPU, points, sample) for each in (encoder, twin))
    near(own[0], [image.cpu() for image in other[0]], 1e-3)
    near_in_norm(own[1], [gradient.cpu() for gradient in other[1]], GRADIENT)


# --- the model -------------------------------------------------------------------------------------------------------

BOXES = [
    torch.tensor([[5.0, 0.5, -1.0, 3.9, 1.6, 1.5, 0.3], [9.0, -1.5, -0.9, 0.8, 0.7, 1.7, 0.0]]),
    torch.zeros(0, 7),
    torch.tensor(
        [[8.0, 1.0, -1.0, 1.8, 0.7, 1.7, 1.4], [4.0, -1.0, -1.0, 3.8, 1.7, 1.6, -1.4], [2.0, 2, -1, 2, 1, 2, 0]]
    ),
]
LABELS = [torch.tensor([0, 1]), torch.zeros(0, dtype=torch.int64), torch.tensor([2, 0, -1])]


def losses_of(model: HVNet, device: torch.device) -> tuple[dict[str, Tensor], list[Tensor], list[Tensor]]:
    """The losses of three clouds, the gradients of all weights that have one, and the statistics afterwards."""
    model = copy.deepcopy(model).to(device).train()
    points, sample = some_clouds(3)
    boxes, labels = [own.to(device) for own in BOXES], [own.to(device) for own in LABELS]
    terms = model(points.to(device), sample.to(device), boxes, labels)
    torch.stack(list(terms.values())).sum().backward()
    gradients = [weight.grad for weight in model.parameters() if weight.grad is not None]
    return {name: term.detach() for name, term in terms.items()}, gradients, [b.float() for b in model.buffers()]


def off_by_rounding(model: HVNet, seed: int) -> HVNet:
    """The model with weights that differ in their last bit or two.

    Where two points tie but for rounding, the whole gradient goes to the one or the other: the gradient of the plain
    encoder on an H100 is 1.2 % off the CPU's, and so is the CPU's own for a third of these models.
    """
    model, generator = copy.deepcopy(model), torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in model.parameters():
            weight.mul_(1 + ROUNDING * torch.randn(weight.shape, generator=generator))
    return model


@pytest.mark.parametrize(
    "changes",
    [
        [],
        ["head.direction=false", "head.regression=pose"],
        ["head.iou=true", "loss.box=giou"],
        ["loss.box=iou"],
        ["loss.uncertainty=true"],
        ["encoder.vfe=plain", "backbone.pyramid=fpn"],
        ["encoder.point_limit=2"],
    ],
    ids=str,
)
def test_losses_and_gradients(changes: list[str]) -> None:
    """The positive and negative anchors are in them: one more or less would be seen."""
    config = load_config(CONFIGS / "demo.yaml", [*NARROW, "train.bfloat16=false", *changes])
    model = lively(config)
    want, got, again = (losses_of(model, device) for device in (CPU, GPU, GPU))
    assert got[0].keys() == want[0].keys()
    for name, term in want[0].items():
        assert float(term) != 0, name
        torch.testing.assert_close(got[0][name].cpu(), term, rtol=LOSS, atol=0)
    neighbours = (losses_of(off_by_rounding(model, k), CPU)[1] for k in range(8))
    assert any(max(errors_in_norm(got[1], each)) <= GRADIENT for each in itertools.chain([want[1]], neighbours))
    near(got[2], want[2], 1e-3)
    assert same({name: float(term) for name, term in again[0].items()}, {n: float(t) for n, t in got[0].items()})
    equal(again[1], got[1])
    equal(again[2], got[2])


def test_losses_without_boxes(demo: Config) -> None:
    model = lively(demo)
    points, sample = some_clouds(2)
    results = []
    for device in (CPU, GPU):
        own = copy.deepcopy(model).to(device).train()
        boxes, labels = torch.zeros(0, 7, device=device), torch.zeros(0, dtype=torch.int64, device=device)
        terms = own(points.to(device), sample.to(device), [boxes] * 2, [labels] * 2)
        torch.stack(list(terms.values())).sum().backward()
        results.append({name: float(term) for name, term in terms.items()})
        assert all(weight.grad is None or weight.grad.isfinite().all() for weight in own.parameters())
    assert results[1]["localization"] == results[0]["localization"] == 0
    assert results[1]["classification"] == pytest.approx(results[0]["classification"], rel=LOSS)


# --- training --------------------------------------------------------------------------------------------------------


def settings(*changes: str) -> Config:
    return load_config(CONFIGS / "demo.yaml", [*SHORT, "train.bfloat16=false", *changes])


def test_ten_steps_and_their_bits(scenes: Path, tmp_path: Path) -> None:
    """Two epochs of five steps: twice in a row, and stopped in between and resumed. The same bits, all three times."""
    ends = []
    for name in ("once", "again", "resumed"):
        config = settings("train.repeat=5", "train.batch_size=4", "train.epochs=2")
        torch.manual_seed(len(ends))  # a run does not depend on what was before it
        if name == "resumed":
            shorter = dataclasses.replace(config, train=dataclasses.replace(config.train, epochs=1))
            Run(shorter, kitti_data(scenes, config), tmp_path / name, GPU).train()
        run = Run(config, kitti_data(scenes, config), tmp_path / name, GPU, resume=name == "resumed")
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message=".*deterministic.*")  # torch's word for what does not repeat
            run.train()
        ends.append(load_checkpoint(tmp_path / name / "checkpoint.pt"))
        assert run.progress.step == 10
        assert all(weight.device.type == GPU.type and weight.isfinite().all() for weight in run.model.parameters())
    for end in ends[1:]:
        for key in ("model", "optimizer", "random"):
            assert same(end[key], ends[0][key]), key
    lines = [(tmp_path / name / "metrics.jsonl").read_text() for name in ("once", "again", "resumed")]
    assert lines[0] == lines[1] == lines[2]


def test_training_goes_down(scenes: Path, tmp_path: Path) -> None:
    config = settings("train.repeat=10", "train.batch_size=4", "train.warmup_steps=0", "train.learning_rate=5.0e-3")
    run = Run(config, kitti_data(scenes, config), tmp_path / "run", GPU)
    first = run.epoch()["loss"]
    assert run.epoch()["loss"] < 0.9 * first


@pytest.mark.parametrize(
    "changes", [[], ["train.bfloat16=true"], ["augment.whole_frames=0.5", "augment.mix=0.5"]], ids=str
)
def test_the_first_step_is_the_cpus(scenes: Path, tmp_path: Path, changes: list[str]) -> None:
    """From files to losses: the same frames, objects and random numbers."""
    config = settings("train.batch_size=4", *changes)
    losses = [
        Run(config, kitti_data(scenes, config), tmp_path / device.type / str(k), device).run_batches()
        for k, device in enumerate((CPU, GPU))
    ]
    assert losses[1].keys() == losses[0].keys()
    half = "train.bfloat16=true" in changes
    for name, value in losses[0].items():
        assert losses[1][name] == pytest.approx(value, rel=2e-2 if half else 1e-3), name


def test_a_step_waits_no_more_than_twice(
    scenes: Path, tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Ten steps from the loader to the progress bar; bench/gpu.py reports the number."""
    config = settings("train.repeat=5", "train.batch_size=2")
    run = Run(config, kitti_data(scenes, config), tmp_path / "run", GPU)
    with mock.patch.object(run, "save"):  # a checkpoint is a copy to the host
        run.run_batches()  # reads the frames, compiles, makes what is made once
        begin = run.progress.step
        run.progress = run.progress._replace(epoch=1, batch=0, sums=None)
        waits = waits_of(run.run_batches)
    steps = run.progress.step - begin
    assert steps == 10
    record_property("waits", waits / steps)
    assert waits <= WAITS * steps


def test_augmented_clouds(scenes: Path) -> None:
    """Boxes and labels stay on the host and are the same; rows that a GPU blanks instead of dropping are NaN."""
    names, classes = read_split(scenes, "train"), ("Car", "Pedestrian", "Cyclist")
    database = load_database(scenes, names, [])
    points, boxes = some_points(3000), random_boxes(4, 0, centre=6).float()
    frame = TrainingFrame(points, boxes, torch.tensor([0, 1, 2, 0]), nearest_points(points))
    points = some_points(2500, seed=1)
    boxes, labels = random_boxes(3, 1, centre=5).float(), torch.tensor([1, 0, 2])
    other = TrainingFrame(points, boxes, labels, nearest_points(points))
    for seed in range(12):
        options = AugmentConfig(objects={"Car": 8, "Pedestrian": 4}, whole_frames=0.3)
        results = []
        for device in (CPU, GPU):
            generator = torch.Generator().manual_seed(seed)
            there = [each._replace(points=each.points.to(device)) for each in (frame, other)]
            if seed % 3 == 0:
                there = [each._replace(obstacles=None) for each in there]
            mixed = mix_sectors(*there, generator)
            results.append(
                augment(mixed, sampler_of(database), options, generator, classes, -1.6 if seed % 2 else None)
            )
        (want, *rest), (got, *same_rest) = results
        assert got.device.type == GPU.type
        equal(same_rest, rest)
        got, want = (cloud[cloud.isfinite().all(dim=1)].cpu() for cloud in (got, want))
        assert len(got) == len(want)
        near([got], [want], 1e-5)


# --- detection -------------------------------------------------------------------------------------------------------


def test_clouds_of_different_lengths(demo: Config) -> None:
    """Together, in any order, and alone: the boxes of each are its own, and the CPU's."""
    model = lively(demo, score_threshold=0.05, candidates=100)
    on_cpu, on_gpu = Detector(model, CPU, torch.float32), Detector(model, GPU, torch.float32)
    clouds = [some_points(count, count) for count in (500, 3000, 40, 1024, 1025)]
    want = [on_cpu(points) for points in clouds]
    assert sum(len(each.boxes) for each in want) > 50
    for order in ((0, 1, 2, 3, 4), (1, 0), (4, 2, 3), (2,)):
        for k, found in zip(order, on_gpu.batch([clouds[k] for k in order]), strict=True):
            assert found.boxes.device == CPU
            same_boxes(found, want[k], 1e-3)


@pytest.mark.parametrize(
    "changes",
    [[], ["encoder.vfe=plain"], ["encoder.point_limit=1"], ["head.iou=true", "head.regression=pose"]],
    ids=str,
)
def test_detection_of_every_switch(changes: list[str]) -> None:
    """With a graph, and where the encoder cannot be fused without one."""
    model = lively(load_config(CONFIGS / "demo.yaml", [*NARROW, *changes]), score_threshold=0.02)
    want, found = (Detector(model, device, torch.float32)(some_points()) for device in (CPU, GPU))
    assert len(want.boxes) > 5
    same_boxes(found, want, 1e-3)


def test_pillars_detect(pillars: Path) -> None:
    for points in (some_points(2000), some_points(700, 1)):
        want, found = (hvnet.load(pillars, device.type)(points) for device in (CPU, GPU))
        assert found.boxes.isfinite().all()
        assert abs(len(found.boxes) - len(want.boxes)) <= 0.1 * len(want.boxes)


def test_bfloat16_finds_the_same_objects(demo: Config) -> None:
    model = lively(demo, score_threshold=0.05, candidates=100, detections=10)
    want = Detector(model, CPU, torch.float32)(some_points())
    found = Detector(model, GPU, torch.bfloat16)(some_points())
    for label in range(3):
        best = want.boxes[want.labels == label][:3]
        assert (rotated_iou_bev(best, found.boxes[found.labels == label]).amax(dim=1) > 0.8).all()


@pytest.mark.parametrize("mount", [{}, {"turn": 90.0}, {"all_round": True}, {"sensor_height": 1.8}], ids=str)
def test_the_shipped_weights(mount: dict[str, object]) -> None:
    """A whole scan of a generated street, raised by a metre: what is plainly there is found on both devices."""
    scan = torch.from_numpy(make_frame(0, 1, Options(azimuth=180))[1].points) + torch.tensor([0.0, 0, 1, 0])
    want, found = (hvnet.load(device=device.type, **mount)(scan) for device in (CPU, GPU))  # type: ignore[arg-type]
    assert share_found(found, want, 0.5, 0.7) > 0.9
    assert share_found(want, found, 0.5, 0.7) > 0.9


@pytest.mark.parametrize("name", ["compact", "standard"])
def test_a_detector_repeats(name: str, street: Tensor) -> None:
    detector = hvnet.load(name, device=GPU.type)
    first = detector(street)
    assert len(first.boxes) > 3
    for _ in range(5):
        detector(street[:5000])
        equal(detector(street), first)


def test_a_warm_frame_waits_for_its_boxes_alone(street: Tensor) -> None:
    detector = hvnet.load(device=GPU.type)
    on_gpu = street.to(GPU)
    for points in (on_gpu, street, street.numpy()):
        for _ in range(3):
            detector(points)  # compiled, captured, and the buffers are made
        assert waits_of(lambda points=points: detector(points)) <= 1


def test_a_reflectance_that_is_too_bright_is_named(street: Tensor) -> None:
    bright = street * torch.tensor([1.0, 1.0, 1.0, 255.0])
    with pytest.raises(ValueError, match="reflectance"):
        hvnet.load(device=GPU.type)(bright)


def test_old_graphs_go_and_come_back(demo: Config) -> None:
    """More capacities than graphs are kept: the first again gives its boxes, and memory stops growing."""
    model = lively(demo, score_threshold=0.05, candidates=100)
    detector = Detector(model, GPU, torch.float32)
    counts = [1000 * 2**k for k in range(MAX_GRAPHS + 2)]
    clouds = [some_points(count, count) for count in counts]

    def held() -> int:
        gc.collect()
        torch.cuda.empty_cache()
        return torch.cuda.memory_reserved(GPU)

    first = [detector(points) for points in clouds]
    for points, want in zip(clouds, first, strict=True):
        equal(detector(points), want)
    before = held()
    for _ in range(3):
        for points, want in zip(clouds, first, strict=True):
            equal(detector(points), want)
    assert held() - before <= before / (2 * MAX_GRAPHS)  # half of what one graph holds on average


# --- streams and devices ---------------------------------------------------------------------------------------------


def on_side_stream(work: Callable[[], list[Tensor]]) -> list[Tensor]:
    """Runs work on a stream that is late: whatever is launched elsewhere reads what is not yet written."""
    side = torch.cuda.Stream(GPU)
    side.wait_stream(torch.cuda.current_stream(GPU))
    with torch.cuda.stream(side):
        torch.cuda._sleep(50_000_000)  # some hundredths of a second
        results = work()
    torch.cuda.current_stream(GPU).wait_stream(side)
    return results


def test_side_streams(street: Tensor) -> None:
    grids = [make_grid((0.0, -32.0, -3.0, 64.0, 32.0, 2.0), (0.2, 0.2), scale) for scale in (1.0, 2.0)]
    encoder = restless(HybridVoxelEncoder(SMALL)).to(GPU)
    detector, boxes = hvnet.load(device=GPU.type), random_boxes(400, 0, spread=10).float().to(GPU)
    points, sample = (tensor.to(GPU) for tensor in cloud(1500))
    scene, scores = street.to(GPU), torch.linspace(0, 1, 400, device=GPU)

    def kernels() -> list[Tensor]:
        src = torch.cat((points, points), dim=1) * 2  # made on the stream, after the sleep
        index = (points[:, 0].clamp(0, 12) * 2).long()
        found = voxel_index(scene * 1, torch.zeros(len(scene), dtype=torch.int64, device=GPU), 1, grids)
        parts = [found.order, *(scale.cursor for scale in found.scales)]
        return [*scatter_max(src, index, 30), *parts, rotated_nms(boxes * 1, scores, 0.3), *hash_index(index * 7)]

    def training() -> list[Tensor]:
        own = copy.deepcopy(encoder).train()
        images = own(points * 1, sample, 2)
        return [*images, *torch.autograd.grad(images, list(own.parameters()), images)]

    for work in (kernels, training, lambda: list(detector(scene))):
        want = work()
        for _ in range(3):
            equal(on_side_stream(work), want)
    two = [on_side_stream(training), on_side_stream(kernels)]  # streams that take turns
    equal([*two[0], *two[1]], [*training(), *kernels()])


def test_a_mesh_outlives_its_rays() -> None:
    """A million rays on a side stream, and meshes that take its memory meanwhile on the first one."""
    generator = torch.Generator().manual_seed(0)
    vertices = (torch.randn(3000, 1, 3, generator=generator) * 4 + torch.randn(3000, 3, 3, generator=generator)).view(
        -1, 3
    )
    faces = torch.arange(9000).view(-1, 3)
    origins = torch.randn(RAYS, 3, generator=generator)
    directions = nn.functional.normalize(torch.randn(RAYS, 3, generator=generator), dim=1)
    given = [tensor.to(GPU) for tensor in (vertices, faces, origins, directions)]
    want = raycast(*given, 20.0)
    part = [*given[:2], given[2][:500], given[3][:500]]
    twin = reference.raycast(*part, 20.0)
    assert torch.equal(want[1][:500], twin[1])
    for _ in range(3):
        side = torch.cuda.Stream(GPU)
        side.wait_stream(torch.cuda.current_stream(GPU))
        with torch.cuda.stream(side):
            found = raycast(*given, 20.0)
        for k in range(5):
            raycast(given[0] + 100.0 * (k + 1), given[1], given[2][:10], given[3][:10], 20.0)
        torch.cuda.current_stream(GPU).wait_stream(side)
        equal(found, want)


def test_a_second_device(second: torch.device, street: Tensor, demo: Config) -> None:
    """Everything on cuda:1 while cuda:0 is current, which it stays."""
    assert torch.cuda.current_device() == 0
    model = lively(demo, score_threshold=0.05, candidates=100)
    detector = Detector(model, second, torch.float32)
    want = Detector(model, CPU, torch.float32)
    for count in (500, 3000, 500):
        same_boxes(detector(some_points(count)), want(some_points(count)), 1e-3)
        assert torch.cuda.current_device() == 0
    src, index = street.to(second), (torch.arange(len(street)) % 700).to(second)
    equal(scatter_max(src, index, 700), scatter_max(street, index.cpu(), 700))
    assert torch.cuda.current_device() == 0
    boxes, scores = random_boxes(200, 0).float(), torch.linspace(0, 1, 200)
    equal([rotated_nms(boxes.to(second), scores.to(second), 0.3)], [rotated_nms(boxes, scores, 0.3)])
    directions = nn.functional.normalize(torch.randn(50, 3), dim=1)
    mesh = torch.randn(90, 3), torch.arange(90).view(-1, 3), torch.zeros(50, 3), directions
    equal([raycast(*(tensor.to(second) for tensor in mesh), 9.0)[1]], [raycast(*mesh, 9.0)[1]])
    assert torch.cuda.current_device() == 0
    near_in_norm(losses_of(model, second)[1], losses_of(model, CPU)[1], GRADIENT)
    assert torch.cuda.current_device() == 0
    with pytest.raises(ValueError, match="want device"):
        scatter_max(src, index.to(GPU), 700)


def test_a_run_on_a_second_device(second: torch.device, scenes: Path, tmp_path: Path) -> None:
    config = settings("train.batch_size=4")
    losses = [Run(config, kitti_data(scenes, config), tmp_path / str(k), device).run_batches()
              for k, device in enumerate((GPU, second))]  # fmt: skip
    assert np.isfinite(list(losses[1].values())).all()
    assert losses[1] == pytest.approx(losses[0], rel=1e-3)
    assert torch.cuda.current_device() == 0
