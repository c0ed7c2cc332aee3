"""The rows of the studies: every one has a config, builds, trains a step and detects; they are what the paper says."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from hvnet.config import load_config
from hvnet.data.frame import Objects
from hvnet.data.kitti import read_split_frames
from hvnet.network.detector import Detector
from hvnet.network.model import HVNet
from hvnet.studies.catalogue import STUDIES
from tests.models import CONFIGS, SMALL

CPU = torch.device("cpu")
ROWS = [(name, row.name) for name, each in STUDIES.items() for row in each.rows]


@pytest.mark.parametrize(("name", "row"), ROWS, ids=lambda value: value)
def test_every_row_builds_trains_a_step_and_detects(name: str, row: str, scenes: Path) -> None:
    config = load_config(CONFIGS / "studies" / name / f"{row}.yaml", SMALL)
    torch.manual_seed(0)
    model = HVNet(config).train()
    frames = list(read_split_frames(scenes, "val"))
    points = torch.cat([frame.points for frame in frames])
    sample = torch.repeat_interleave(torch.arange(2), torch.tensor([len(frame.points) for frame in frames]))
    classes = [entry.name for entry in config.head.classes]
    boxes, labels = [], []
    for frame in frames:
        objects = frame.objects or Objects(torch.zeros(0, 7), [])
        near = (objects.boxes[:, 0] < 25.6) & (objects.boxes[:, 1].abs() < 6.4)
        known = [k for k, each in enumerate(objects.names) if each in classes and near[k]]
        boxes.append(objects.boxes[known])
        labels.append(torch.tensor([classes.index(objects.names[k]) for k in known]).long())
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    losses = []
    for _ in range(2):
        terms = model(points, sample, boxes, labels)
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(map(len, labels)) > 3
    assert np.isfinite(losses).all()
    assert losses[1] < losses[0]
    here = [model.heads[label] for label in torch.cat(labels).unique().tolist()]  # of classes that the frames hold
    for weight in (weight for part in (*here, model.encoder) for weight in part.parameters()):
        assert weight.grad is not None
        assert weight.grad.any()
    found = Detector(model.eval(), CPU)(frames[0].points)
    assert set(found.labels.tolist()) == set(range(len(classes)))
    assert found.boxes.isfinite().all()


def test_rows_are_differences_to_their_bases() -> None:
    """Every row has a file, every file a row, and each but one of a study's chain names a base."""
    files = {(path.parent.name, path.stem) for path in (CONFIGS / "studies").glob("*/*.yaml")}
    assert files == set(ROWS)
    for path in (CONFIGS / "studies").rglob("*.yaml"):
        assert re.search(r"^base: \S+\.yaml$", path.read_text(), flags=re.MULTILINE), path
        assert len(path.read_text().splitlines()) < (40 if path.stem == "base" else 15), path


@pytest.mark.parametrize(
    ("row", "changes"),
    [
        ("baseline", {"vfe": "plain", "scales": (1, 1), "pyramid": "none", "alpha": 0.25}),
        ("attention", {"vfe": "attentive", "scales": (1, 1), "pyramid": "none", "alpha": 0.25}),
        ("fpn", {"vfe": "attentive", "scales": (1, 1), "pyramid": "fpn", "alpha": 0.25}),
        ("ffpn", {"vfe": "attentive", "scales": (1, 1), "pyramid": "ffpn", "alpha": 0.25}),
        ("focal", {"vfe": "attentive", "scales": (1, 1), "pyramid": "ffpn", "alpha": 0.75}),
        ("scale-2-feature", {"vfe": "attentive", "scales": (2, 1), "pyramid": "ffpn", "alpha": 0.75}),
        ("scale-2", {"vfe": "attentive", "scales": (2, 2), "pyramid": "ffpn", "alpha": 0.75}),
        ("scale-3", {"vfe": "attentive", "scales": (3, 3), "pyramid": "ffpn", "alpha": 0.75}),
    ],
)
def test_the_ablation_table(row: str, changes: dict[str, object]) -> None:
    """The eight rows as the paper's table ticks them."""
    config = load_config(CONFIGS / "studies" / "components" / f"{row}.yaml")
    assert config.encoder.vfe == changes["vfe"]
    assert (len(config.encoder.feature_scales), len(config.encoder.projection_scales)) == changes["scales"]
    assert config.encoder.feature_scales == (0.5, 1.0, 2.0)[: len(config.encoder.feature_scales)]
    assert config.encoder.projection_scales == (1.0, 2.0, 4.0)[: len(config.encoder.projection_scales)]
    assert config.backbone.pyramid == changes["pyramid"]
    assert [entry.focal_alpha for entry in config.head.classes] == [0.25, changes["alpha"], changes["alpha"]]


def test_the_scale_rows() -> None:
    for n in range(1, 6):
        by_t = load_config(CONFIGS / "studies" / "scales" / f"nt{n}.yaml")
        by_r = load_config(CONFIGS / "studies" / "scales" / f"nr{n}.yaml")
        assert (len(by_t.encoder.feature_scales), len(by_t.encoder.projection_scales)) == (n, 1)
        assert (len(by_r.encoder.feature_scales), len(by_r.encoder.projection_scales)) == (3, n)
        assert len(HVNet(by_r).backbone.main_stream.blocks) == max(3, n)
