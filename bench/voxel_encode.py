"""The encoder, stage by stage: cursors, index, knowledge, AVFE, AVFEO and the whole, against torch and torch_scatter.

"forward" is inference: batch norm with its running statistics, no gradients; "hvnet" is the FusedEncoder of a detector,
"hvnet, unfused" the encoder of training. "forward + backward" is training: batch norm of the batch, gradients of all
weights. Every case first checks that its providers give the same result.
"""

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import torch
from timing import (
    Bench,
    Run,
    Work,
    agree,
    agree_in_norm,
    free_memory,
    parser,
    peak_memory,
    read_scene,
    skipped,
    start,
    timed,
)
from torch import Tensor, nn
from torch_encoder import Ids, PillarEncoder, Scatter, TorchEncoder, library
from torch_encoder import cursors as torch_cursors
from torch_encoder import knowledge as torch_knowledge

from hvnet.cli import run_command
from hvnet.config import EncoderConfig
from hvnet.exceptions import InputError
from hvnet.kernels.encode import knowledge
from hvnet.kernels.scatter import segment_mean, segments
from hvnet.kernels.voxel import Grid, VoxelIndex, Voxels, cursors, hash_index, nested_index, voxel_index
from hvnet.network.encoder import HybridVoxelEncoder, scale_of_points
from hvnet.network.fused import FusedEncoder, inference

matplotlib.use("Agg")
import matplotlib.pyplot as plt

VALUES = {"rtol": 1e-4, "atol": 2e-6}  # float32 sums in another order; atol is a share of the largest value
TRAINED = {"rtol": 1e-4, "atol": 5e-5}  # float32 statistics over all rows: either provider is off float64 by 2e-5
IN_TF32 = {"rtol": 1e-4, "atol": 2e-3}  # a GPU's inference multiplies H in TF32: off by 4e-4, by 8e-4 in small encoders
GRADIENTS = 5e-3  # of the norm
PATIENCE = 60.0  # seconds a call; a provider that would take longer is left out of the plot from there on

Encode = Callable[[Tensor, Tensor, int], list[Tensor]]
Inputs = tuple[Tensor, Tensor, int]  # points (N, 4), sample (N,), batch size


@dataclass
class Setting:
    """An encoder, its grids, and how each library's twin of it numbers its voxels."""

    config: EncoderConfig
    device: torch.device
    dense: dict[str, bool] = field(default_factory=dict)  # over the whole grid instead of torch.unique

    def __post_init__(self) -> None:
        torch.manual_seed(0)
        self.encoder = HybridVoxelEncoder(self.config).to(self.device)
        self.grids = list(dict.fromkeys(self.encoder.feature_grids + self.encoder.projection_grids))

    def twin(self, name: str, training: bool) -> TorchEncoder:
        """The same encoder by a library's scatter."""
        made = TorchEncoder(self.config, self.encoder, libraries()[name], self.dense.get(name, False))
        return made.train(training)

    def fused(self) -> FusedEncoder:
        """The same encoder as a detector runs it."""
        return FusedEncoder(copy.deepcopy(self.encoder).eval())


class Counts:
    """The bytes and operations of every stage: each input read once, each output written once, no recalculation."""

    def __init__(self, encoder: HybridVoxelEncoder, points: int, index: VoxelIndex, grids: list[Grid]) -> None:
        kept = len(index.order)
        voxels = {grid: len(scale.cursor) for grid, scale in zip(grids, index.scales, strict=True)}
        at_features = sum(voxels[grid] for grid in encoder.feature_grids)
        at_projection = sum(voxels[grid] for grid in encoder.projection_grids)
        s_t, s_r, scales = len(encoder.feature_grids), len(encoder.projection_grids), len(grids)
        q, wide = encoder.avfe.features.weight.shape[0], encoder.avfeo.features.weight.shape[0]
        self.cursors = Work(points * (24 + 8 * scales))
        self.index = Work(points * 24 + kept * 8 * (1 + scales) + 16 * sum(voxels.values()))
        self.knowledge = Work(kept * (16 + scales * (8 + 32)), kept * scales * 11)
        # Linear(g) is a part of the point, made once, and a part of the voxel's mean; a product and a maximum a scale
        avfe = 2 * q * (kept * (4 + 4) + 8 * at_features + kept * s_t)
        self.avfe = Work(kept * (16 + s_t * (40 + 4 * q)) + 4 * q * at_features, avfe)
        # Linear(H): M's half is a part of the point, the maxima's half one of the voxel
        linear = 2 * wide * q * (kept * s_t + at_features)
        avfeo = linear + 2 * wide * (4 * kept + 8 * at_projection + kept * s_r)
        self.avfeo = Work(4 * kept * 2 * q * s_t + kept * s_r * 40 + 4 * wide * at_projection, avfeo)
        self.encoder = Work(points * 24 + 4 * wide * at_projection, avfe + avfeo)


def in_order(index: VoxelIndex) -> list[Tensor]:
    """What an index says, whatever its order: the kept points, and each one's cursor and number of neighbours."""
    parts = [index.order.sort().values]
    for scale in index.scales:
        of_point = torch.stack((scale.cursor, scale.segments.starts.diff()), dim=1)[scale.segments.voxel]
        owned = scale.segments.order
        gathered = of_point if owned is None else of_point[owned]
        runs = scale.cursor.repeat_interleave(scale.segments.starts.diff())  # the segments themselves
        parts += [of_point[index.order.argsort()], (gathered[:, 0] != runs).sum().reshape(1)]
    return parts


def hashed(points: Tensor, sample: Tensor, grids: list[Grid]) -> VoxelIndex:
    """The index of all scales by the hash table, which scales that do not nest need."""
    found = [cursors(points, sample, grid) for grid in grids]
    kept = torch.stack([cursor >= 0 for cursor in found]).all(0).nonzero()[:, 0]
    scales = []
    for cursor in found:
        unique, voxel = hash_index(cursor[kept])
        scales.append(Voxels(unique, segments(voxel, len(unique))))
    return VoxelIndex(kept, scales)


def unique_index(found: list[Tensor]) -> list[tuple[Tensor, Tensor, Tensor]]:
    """torch.unique with inverse and counts at every scale."""
    return [torch.unique(cursor, return_inverse=True, return_counts=True) for cursor in found]


def from_points(points: Tensor, sample: Tensor, grids: list[Grid]) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Cursors and torch.unique at every scale."""
    inside, found = torch_cursors(points, sample, grids)
    return unique_index([cursor[inside] for cursor in found])


def bench_index(bench: Bench, points: Tensor, sample: Tensor, grids: list[Grid], counts: Counts) -> None:
    """Cursors, then the voxels of all scales."""
    inside, found = torch_cursors(points, sample, grids)
    own = [cursors(points, sample, grid) for grid in grids]
    agree("cursors", [cursor.where(inside, -1) for cursor in own], found, 0, 0)
    providers: dict[str, Run] = {
        "hvnet": lambda: [cursors(points, sample, grid) for grid in grids],
        "torch": lambda: torch_cursors(points, sample, grids),
    }
    bench.time(f"cursors, {len(grids)} scales", providers, counts.cursors)

    kept = [cursor[inside] for cursor in found]
    nested, of_hash = in_order(voxel_index(points, sample, 1, grids)), in_order(hashed(points, sample, grids))
    want = [inside.nonzero()[:, 0]]
    for cursor, voxel, count in unique_index(kept):
        want += [torch.stack((cursor, count), dim=1)[voxel], torch.zeros(1, device=points.device)]
    agree("index, one sort", nested, want, 0, 0)
    agree("index, hash table", of_hash, want, 0, 0)
    providers = {
        "hvnet, one sort": lambda: nested_index(points, sample, grids),
        "torch.unique alone, cursors given": lambda: unique_index(kept),
    }
    bench.time(f"index, {len(grids)} scales", providers, counts.index)
    # the hash table leaves nothing of the others in the caches: what a call costs that comes after other work
    providers |= {
        "hvnet, one sort, lengths read": lambda: voxel_index(points, sample, 1, grids),
        "hvnet, hash table": lambda: hashed(points, sample, grids),
        "torch: cursors + unique": lambda: from_points(points, sample, grids),
    }
    bench.time(f"index, {len(grids)} scales, among others", providers, counts.index)


def bench_first_step(bench: Bench, setting: Setting, inputs: Inputs, counts: Counts) -> None:
    """All that an encoder does before AVFE; FusedEncoder has the means, of which the kernels make g."""
    points, sample, batch_size = inputs
    grids, fused = setting.grids, setting.fused()
    order = nested_index(points, sample, grids).order

    def fused_index() -> list[Tensor]:
        points_in_order, scales = fused.index(points, sample, batch_size)
        return [points_in_order, scales.voxels.counts[-1:], *scales.voxels.voxel, *scales.means]

    def pick_fused(found: list[Tensor]) -> list[Tensor]:
        kept = int(found[1])
        back = order[:kept].argsort()
        of_scales = zip(found[2 : 2 + len(grids)], found[2 + len(grids) :], strict=True)
        return [knowledge(found[0][:kept], mean, voxel[:kept])[back, :8] for voxel, mean in of_scales]

    def own_index() -> list[Tensor]:
        index = voxel_index(points, sample, batch_size, grids)
        kept = points[index.order]
        of_scales = [scale_of_points(kept, voxels) for voxels in index.scales]
        return [kept, index.order, *(part for scale in of_scales for part in (scale.segments.voxel, scale.mean))]

    def pick_own(found: list[Tensor]) -> list[Tensor]:
        kept, order, *of_scales = found
        return [knowledge(kept, mean, voxel)[order.argsort(), :8] for voxel, mean in paired(of_scales)]

    def twin_index(name: str) -> list[Tensor]:
        twin = twins[name]
        kept, ids = twin.index(points, sample, batch_size)
        return [torch_knowledge(kept, ids[grid], twin.scatter) for grid in grids]

    twins = {name: setting.twin(name, False) for name in libraries()}
    runs = {"hvnet": Provider(fused_index, [], pick_fused), "hvnet, unfused": Provider(own_index, [], pick_own)}
    runs |= {name: Provider(partial(twin_index, name), []) for name in twins}
    work = Work(counts.index.bytes + counts.knowledge.bytes, counts.knowledge.operations)
    compare(bench, f"index and knowledge, {len(grids)} scales", runs, work, training=False)


def libraries() -> dict[str, Scatter]:
    """The scatter libraries that are installed."""
    found = {name: library(name) for name in ("torch_scatter", "torch")}
    return {name: scatter for name, scatter in found.items() if scatter}


class Provider(NamedTuple):
    """One way to calculate the outputs of a stage."""

    run: Callable[[], list[Tensor]]
    inputs: Sequence[Tensor]  # what gradients are taken of
    pick: Callable[[list[Tensor]], list[Tensor]] = list  # from what it returns, what the others return


def compare(bench: Bench, stage: str, providers: dict[str, Provider], work: Work, training: bool) -> None:
    """Checks every provider against the last one, plain torch, then times them; in training with the backward pass."""
    *others, (_, last) = providers.items()
    with torch.set_grad_enabled(training):
        want = last.run()
        tolerance = TRAINED if training else VALUES
        if not training and bench.device.type == "cuda" and stage in ("AVFEO", "encoder"):
            tolerance = IN_TF32
        given = [torch.randn_like(out) for out in want]  # gradient of every output, in the output's memory layout
        slopes = torch.autograd.grad(want, last.inputs, given) if training else ()
        for name, provider in others:
            got = provider.run()
            shown = provider.pick(got)
            agree(f"{stage}, {name}, values", shown, want, **tolerance)
            if training:
                slope = torch.autograd.grad(got, provider.inputs, given)
                agree_in_norm(f"{stage}, {name}, gradients", slope, slopes, GRADIENTS)
    runs: dict[str, Run] = {}
    for name, (run, inputs, _) in providers.items():
        runs[name] = partial(trained, run, inputs, given) if training else torch.no_grad()(run)
    if training:
        bench.time(f"{stage}, forward + backward", runs, Work(2 * work.bytes, 3 * work.operations))
    else:
        bench.time(f"{stage}, forward", runs, work)


def trained(run: Callable[[], list[Tensor]], inputs: Sequence[Tensor], given: list[Tensor]) -> object:
    """Forward and backward."""
    return torch.autograd.grad(run(), inputs, given)


class Stages(NamedTuple):
    """AVFE and AVFEO by one provider: the first gives M and maxima, the second makes the images of them."""

    avfe: Callable[[], list[Tensor]]
    avfeo: Callable[[list[Tensor]], list[Tensor]]
    weights: tuple[list[nn.Parameter], list[nn.Parameter]] = ([], [])  # of either, where they are trained
    pick_encoded: Callable[[list[Tensor]], list[Tensor]] = list  # M and maxima, scale after scale
    pick_images: Callable[[list[Tensor]], list[Tensor]] = list  # the voxels in the images


def weights_of(encoder: HybridVoxelEncoder | TorchEncoder) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """The weights of AVFE and those of AVFEO."""
    return list(encoder.avfe.parameters()), list(encoder.avfeo.parameters())


def flat(encoded: list[tuple[Tensor, Tensor]]) -> list[Tensor]:
    """M and maxima of all scales in one list."""
    return [part for pair in encoded for part in pair]


def paired(encoded: list[Tensor]) -> list[tuple[Tensor, Tensor]]:
    """The inverse of `flat`."""
    return list(zip(encoded[0::2], encoded[1::2], strict=True))


def own_stages(setting: Setting, points: Tensor, voxels: dict[Grid, Voxels], training: bool) -> Stages:
    """The two steps of HybridVoxelEncoder."""
    encoder = copy.deepcopy(setting.encoder).train(training)
    scales = {grid: scale_of_points(points, at) for grid, at in voxels.items()}
    return Stages(
        lambda: flat(encoder.point_features(points, scales)),
        lambda encoded: encoder.voxel_features(paired(encoded), points, scales),
        weights_of(encoder),
    )


def twin_stages(setting: Setting, name: str, points: Tensor, voxels: dict[Grid, Voxels], training: bool) -> Stages:
    """The same by torch or torch_scatter."""
    encoder, scatter = setting.twin(name, training), libraries()[name]
    ids = {grid: Ids(at.segments.voxel, at.cursor, len(at.cursor)) for grid, at in voxels.items()}
    given = {grid: torch_knowledge(points, ids[grid], scatter) for grid in voxels}
    of_features = [ids[grid] for grid in encoder.feature_grids]

    def avfe() -> list[Tensor]:
        return flat(encoder.avfe(points, [given[grid] for grid in encoder.feature_grids], of_features, scatter))

    def avfeo(encoded: list[Tensor]) -> list[Tensor]:
        context, grids = encoder.context(paired(encoded), of_features), encoder.projection_grids
        made = encoder.avfeo(context, [given[grid] for grid in grids], [ids[grid] for grid in grids], scatter)
        return [maxima for _, maxima in made]

    return Stages(avfe, avfeo, weights_of(encoder))


def fused_stages(setting: Setting, points: Tensor, sample: Tensor) -> Stages:
    """The two steps of FusedEncoder; the points are in the index's order."""
    encoder = setting.fused()
    indexed = encoder.index(points, sample, 1)
    index = indexed.scales.voxels
    voxels = index.counts[:-1].tolist()  # on a GPU arrays are longer

    def avfe() -> list[Tensor]:
        return list(encoder.point_features(indexed))

    def avfeo(encoded: list[Tensor]) -> list[Tensor]:
        return encoder.voxel_features(encoded[0], encoded[1], indexed, 1, torch.float32)

    def pick_encoded(encoded: list[Tensor]) -> list[Tensor]:
        product, values = encoded
        maxima = [values[t, : voxels[t]] for t in range(len(values))]
        return flat(list(zip(product.chunk(len(maxima), dim=1), maxima, strict=True)))

    def pick_images(images: list[Tensor]) -> list[Tensor]:
        rows = [image.permute(0, 2, 3, 1).flatten(0, 2) for image in images]
        cursor = [index.cursor[s, : voxels[s]] for s in encoder.projected.tolist()]
        return [of_cells[at] for of_cells, at in zip(rows, cursor, strict=True)]

    return Stages(avfe, avfeo, pick_encoded=pick_encoded, pick_images=pick_images)


def bench_layers(bench: Bench, setting: Setting, points: Tensor, sample: Tensor, counts: Counts) -> None:
    """Knowledge, AVFE and AVFEO, each from the same inputs; the index is given and the points are in its order."""
    index = voxel_index(points, sample, 1, setting.grids)
    points, sample = points[index.order], sample[index.order]
    voxels = dict(zip(setting.grids, index.scales, strict=True))

    def means() -> list[Tensor]:
        return [segment_mean(points, at.segments) for at in voxels.values()]

    def own_knowledge() -> list[Tensor]:
        at = zip(means(), voxels.values(), strict=True)
        return [knowledge(points, mean, of.segments.voxel)[:, :8] for mean, of in at]

    def twin_knowledge(scatter: Scatter) -> list[Tensor]:
        ids = [Ids(at.segments.voxel, at.cursor, len(at.cursor)) for at in voxels.values()]
        return [torch_knowledge(points, of, scatter) for of in ids]

    runs = {"hvnet, means only (g is made in AVFE)": Provider(means, [], pick=lambda _: own_knowledge())}
    runs["hvnet, unfused"] = Provider(own_knowledge, [])
    runs |= {name: Provider(partial(twin_knowledge, scatter), []) for name, scatter in libraries().items()}
    compare(bench, "knowledge", runs, counts.knowledge, training=False)

    for training in (False, True):
        stages: dict[str, Stages] = {}
        if not training:
            stages["hvnet"] = fused_stages(setting, points, sample)
        stages["hvnet" if training else "hvnet, unfused"] = own_stages(setting, points, voxels, training)
        stages |= {name: twin_stages(setting, name, points, voxels, training) for name in libraries()}
        runs = {name: Provider(of.avfe, of.weights[0], of.pick_encoded) for name, of in stages.items()}
        compare(bench, "AVFE", runs, counts.avfe, training)
        runs = {}
        for name, of in stages.items():
            with torch.no_grad():
                encoded = of.avfe()
            if training:
                encoded = [part.requires_grad_() for part in encoded]
            runs[name] = Provider(partial(of.avfeo, encoded), [*of.weights[1], *encoded], of.pick_images)
        compare(bench, "AVFEO", runs, counts.avfeo, training)


def compiled(name: str, module: nn.Module, inputs: Inputs, training: bool) -> Encode | None:
    """A module after torch.compile; None, with a word, where that fails."""
    torch.compiler.reset()
    made = torch.compile(module)
    try:
        with torch.set_grad_enabled(training), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of graph breaks
            images = made(*inputs)
            if training:
                torch.autograd.grad(sum(image.sum() for image in images), list(module.parameters()))
    except RuntimeError as error:  # torch's own, and a compiler that is missing or fails
        skipped(name, f"{type(error).__name__}: {error}")
        return None
    return made


def captured(encode: Encode, inputs: Inputs) -> Callable[[], list[Tensor]]:
    """A CUDA graph of a call."""
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            encode(*inputs)
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        images = encode(*inputs)

    def replay() -> list[Tensor]:
        graph.replay()
        return images

    return replay


def encoders(setting: Setting, inputs: Inputs, training: bool, compile: bool) -> dict[str, Provider]:
    """Every provider of the whole encoder; the first is what this project uses, the last is plain torch."""
    own = copy.deepcopy(setting.encoder).train(training)
    modules: dict[str, Encode] = {}
    found: dict[str, Provider] = {}
    if training:
        modules["hvnet"] = own
    else:
        fused = setting.fused()
        if inputs[0].is_cuda:
            found["hvnet, CUDA graph"] = Provider(captured(fused, inputs), [])
        modules |= {"hvnet": fused, "hvnet, unfused": own}
    twins = {name: setting.twin(name, training) for name in libraries()}
    if compile:
        for name, module in (("hvnet, torch.compile", own), ("torch, torch.compile", twins["torch"])):
            made = compiled(name, module, inputs, training)
            if made is not None:
                modules[name] = made
    for name, encode in (modules | twins).items():
        weights = list((twins["torch"] if name.startswith("torch,") else twins.get(name, own)).parameters())
        found[name] = Provider(partial(encode, *inputs), weights)
    return found


def bench_encoder(bench: Bench, setting: Setting, inputs: Inputs, counts: Counts, compile: bool) -> None:
    """The whole encoder, and for comparison the smaller one of PointPillars, which calculates something else."""
    for training in (False, True):
        compare(bench, "encoder", encoders(setting, inputs, training, compile), counts.encoder, training)
        pillars = PillarEncoder(setting.encoder.projection_grids[0]).to(setting.device).train(training)
        runs = {
            "PointPillars: 1 scale, 32 points, 64 ch.": Provider(partial(pillars, *inputs), list(pillars.parameters()))
        }
        compare(bench, "another, smaller encoder", runs, Work(0), training)


def choose(setting: Setting, inputs: Inputs) -> None:
    """Gives every library's twin the faster way to number voxels on this machine, and says which."""
    for name in libraries():
        seconds = {}
        for dense in (False, True):
            setting.dense[name] = dense
            run = torch.no_grad()(partial(setting.twin(name, False), *inputs))
            seconds[dense] = min(timed(run, setting.device) for _ in range(3))
        setting.dense[name] = seconds[True] < seconds[False]
        print(
            f"{name}: torch.unique at every scale {1e3 * seconds[False]:.0f} ms, dense over the grid "
            f"{1e3 * seconds[True]:.0f} ms: the {'dense' if setting.dense[name] else 'compact'} one is compared"
        )


def grow(points: Tensor, count: int) -> Tensor:
    """As many points as asked for: every k-th of the scene's, or copies of them that are scattered by a metre."""
    if count <= len(points):
        return points[torch.linspace(0, len(points) - 1, count, device=points.device).long()]
    generator = torch.Generator().manual_seed(0)
    copies = points[torch.arange(count, device=points.device) % len(points)]
    shift = torch.randn(count, 4, generator=generator) * torch.tensor([1.0, 1.0, 0.1, 0.0])
    shift[: len(points)] = 0
    return copies + shift.to(points.device)


class Dot(NamedTuple):
    """One dot of the plot."""

    line: str  # provider and pass
    x: int
    seconds: float
    memory: float  # bytes


def sweep(bench: Bench, cases: Sequence[tuple[int, str, Setting, Inputs]]) -> list[Dot]:
    """Time and peak memory of every provider, case by case; one that would outgrow the machine is left out."""
    samples: list[Dot] = []
    last: dict[str, Dot] = {}
    for x, label, setting, inputs in cases:
        for training in (False, True):
            title = "forward + backward" if training else "forward"
            makers: dict[str, Callable[[], Encode]] = {"hvnet": partial(own_encoder, setting, training)}
            makers |= {name: partial(setting.twin, name, training) for name in libraries()}
            runs: dict[str, Run] = {}
            memory: dict[str, float] = {}
            for name, make in makers.items():
                line = f"{name}, {title}"
                if line in last:
                    growth = x / last[line].x
                    if last[line].memory * growth > 0.6 * free_memory(setting.device):
                        skipped(line, f"{label} would take {last[line].memory * growth / 1e9:.0f} GB")
                        continue
                    if last[line].seconds * growth > PATIENCE:
                        skipped(line, f"{label} would take {last[line].seconds * growth:.0f} s")
                        continue
                runs[name] = partial(one_call, make(), inputs, training)
                memory[name] = peak_memory(partial(first_call, make, inputs, training), setting.device)
            if "hvnet" not in runs:
                continue
            for row in bench.time(f"{label}, {title}", runs, memory=memory):
                line = f"{row.provider}, {title}"
                last[line] = Dot(line, x, row.median_ms / 1e3, memory[row.provider])
                samples.append(last[line])
    return samples


def own_encoder(setting: Setting, training: bool) -> Encode:
    """What this project runs in inference or in training."""
    own = copy.deepcopy(setting.encoder).train(training)
    return own if training else inference(own)


def one_call(encode: Encode, inputs: Inputs, training: bool) -> None:
    """A forward pass, in training a backward pass as well."""
    with torch.set_grad_enabled(training):
        images = encode(*inputs)
        if training and isinstance(encode, nn.Module):
            torch.autograd.grad(images, list(encode.parameters()), images)


def first_call(make: Callable[[], Encode], inputs: Inputs, training: bool) -> None:
    """A call with all that an encoder keeps between calls."""
    one_call(make(), inputs, training)


def plot(bench: Bench, scene: Tensor, config: EncoderConfig, most: int, file: Path) -> None:
    """Draws time and peak memory over the number of points and over the number of scales."""
    setting = Setting(config, bench.device)
    sizes = [size for k in range(7) if (size := 1000 * 4**k) <= most] + ([most] if most > 1000 * 4**5 else [])
    by_points = sweep(bench, [(size, f"{size:,} points", setting, batch(grow(scene, size))) for size in sizes])
    scene = grow(scene, min(len(scene), most))
    cases = []
    for count in range(1, 6):
        features, projections = tuple(2.0**k / 2 for k in range(count)), tuple(2.0**k for k in range(count))
        scaled = Setting(replace(config, feature_scales=features, projection_scales=projections), bench.device)
        cases.append((count, f"{count} scale{'s'[: count > 1]}", scaled, batch(scene)))
    by_scales = sweep(bench, cases)

    figure, axes = plt.subplots(2, 2, figsize=(11, 8), sharex="col", layout="constrained")
    looks: dict[str, dict[str, Any]] = {}
    for column, samples in enumerate((by_points, by_scales)):
        for line in dict.fromkeys(sample.line for sample in samples):
            name, _, title = line.partition(", ")
            # lines that lie on each other stay visible: the later the thinner
            look = {"color": f"C{len(looks)}", "linewidth": 3.5 - len(looks), "marker": "o", "markersize": 4}
            style = looks.setdefault(name, look) | {"label": line, "linestyle": "--" if "backward" in title else "-"}
            dots = [sample for sample in samples if sample.line == line]
            x = [dot.x for dot in dots]
            axes[0, column].plot(x, [1e3 * dot.seconds for dot in dots], **style)
            axes[1, column].plot(x, [dot.memory / 1e6 for dot in dots], **style)
    for ax in axes.flat:
        ax.set_yscale("log")
        ax.grid(True, which="major", alpha=0.3)
        ax.spines[["top", "right"]].set_visible(False)
    for ax in axes[:, 0]:
        ax.set_xscale("log")
    axes[0, 0].set_ylabel("time, ms")
    axes[1, 0].set_ylabel("peak memory, MB")
    axes[1, 0].set_xlabel("points")
    axes[1, 1].set_xlabel(f"feature and projection scales ({len(scene):,} points)")
    axes[1, 1].set_xticks(range(1, 6))
    for ax in axes[:, 1]:
        ax.set_yscale("linear")
        ax.set_ylim(bottom=0)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    used = bench.machine["threads"]
    threads = "" if bench.device.type == "cuda" else ", 1 thread" if used == 1 else f", {used} threads"
    figure.suptitle(f"Hybrid voxel encoder on {bench.machine['device']}{threads}")
    figure.savefig(file, dpi=120)
    plt.close(figure)
    print(f"\nwritten: {file}")


def batch(points: Tensor) -> Inputs:
    """A batch of one sample."""
    return points, torch.zeros(len(points), dtype=torch.int64, device=points.device), 1


def main(argv: Sequence[str] | None = None) -> None:
    """The command."""
    arguments = parser("voxel_encode", __doc__, repeat=20)
    arguments.add_argument("--points", type=Path, help="a velodyne .bin (default: a generated scene)")
    arguments.add_argument(
        "--max-points", type=int, help="run on fewer points; with --plot the largest number (4 million)"
    )
    arguments.add_argument("--no-compile", action="store_true", help="leave torch.compile out: it takes a minute")
    arguments.add_argument(
        "--plot",
        type=Path,
        help="draw time and memory over points and scales, instead of the stages; --save is for voxel_encode_sweep",
    )
    args = arguments.parse_args(argv)
    if args.max_points is not None and args.max_points < 1000:
        raise InputError(f"--max-points: want 1000 or more, got {args.max_points}")
    bench = start("voxel_encode_sweep" if args.plot else "voxel_encode", args)
    config = EncoderConfig()
    scene = read_scene(args.points).to(bench.device)
    for name in {"torch_scatter"} - libraries().keys():
        skipped(name, "not installed (pip install torch-scatter --no-build-isolation)")
    if args.plot:
        plot(bench, scene, config, args.max_points or 4_000_000, args.plot)
    else:
        inputs = batch(grow(scene, min(args.max_points or len(scene), len(scene))))
        points, sample, _ = inputs
        setting = Setting(config, bench.device)
        setting.encoder.train()(*inputs)  # running statistics that are not those of the start
        index = voxel_index(points, sample, 1, setting.grids)
        bench.machine["points"] = len(index.order)
        print(f"{len(index.order):,} points inside the range, voxels {[len(scale.cursor) for scale in index.scales]}")
        counts = Counts(setting.encoder, len(points), index, setting.grids)
        choose(setting, inputs)
        bench_index(bench, points, sample, setting.grids, counts)
        bench_first_step(bench, setting, inputs, counts)
        bench_layers(bench, setting, points, sample, counts)
        bench_encoder(bench, setting, inputs, counts, not args.no_compile)
    bench.write(args.csv, args.json)


if __name__ == "__main__":
    run_command(main)
