"""A training run as an object: frames of any format, any classes, flags that are restored; and its parts."""

import dataclasses
import math
from pathlib import Path

import pytest

from hvnet.config import TrainConfig
from hvnet.training.run import keep_metrics, learning_rate


def test_learning_rate() -> None:
    config = TrainConfig(learning_rate=3.0, warmup_steps=10, warmup_ratio=1 / 3, decay_epochs=(4, 6), decay_ratio=0.1)
    table = [(0, 0, 1.0), (5, 0, 2.0), (9, 0, 2.8), (10, 0, 3.0), (99, 3, 3.0), (100, 4, 0.3), (150, 5, 0.3),
             (200, 6, 0.03), (999, 60, 0.03)]  # fmt: skip
    for step, epoch, rate in table:
        assert learning_rate(config, step, epoch, 1000) == pytest.approx(rate), (step, epoch)
    assert learning_rate(dataclasses.replace(config, warmup_steps=0), 0, 0, 1000) == 3.0
    cosine = dataclasses.replace(config, cosine=True)
    for step, rate in [(0, 1.0), (5, 2.0 * (1 + math.cos(0)) / 2), (10, 3.0), (60, 1.5), (110, 0.0), (111, 0.0)]:
        assert learning_rate(cosine, step, 9, 110) == pytest.approx(rate, abs=1e-12), step


def test_metrics_keep_the_epochs_that_are_done(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    keep_metrics(path, 0)
    assert not path.exists()
    for rest in ("", '{"epoch": 3}\n', '{"epoch": 3, "a": {"b": 1}', "{"):
        path.write_text('{"epoch": 1}\n{"epoch": 2}\n' + rest)
        keep_metrics(path, 2)
        assert path.read_text() == '{"epoch": 1}\n{"epoch": 2}\n'
