"""Training end to end on a few generated frames: what is written, that it repeats bit for bit, resuming, mistakes."""

import contextlib
import copy
import io
import json
import math
import re
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor

from hvnet.config import Config, TrainConfig, load_config
from hvnet.data.gt_database import read_database
from hvnet.data.kitti import KittiFrames, read_split
from hvnet.evaluation.scoring import score
from hvnet.exceptions import InputError, Stopped
from hvnet.kernels import launch
from hvnet.network.checkpoint import load_checkpoint, save_checkpoint
from hvnet.network.detector import Detector, load
from hvnet.network.model import HVNet
from hvnet.train import choose_out, main
from hvnet.training import run as run_module
from hvnet.training.batches import TrainingFrames, collate, kitti_data
from hvnet.training.run import Progress, Run, learning_rate
from tests.helpers import ROOT, contents, same
from tests.models import SHORT

DEMO = ROOT / "configs" / "demo.yaml"


def run(root: Path | None, out: Path, *changes: str, resume: bool = False, config: Path = DEMO) -> str:
    """Trains; returns what was printed."""
    arguments = ["--config", str(config), "--out", str(out), "--device", "cpu"]
    arguments += ["--data", str(root)] if root is not None else []
    arguments += ["--resume"] if resume else []
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        main(arguments + [part for change in (*SHORT, *changes) for part in ("--set", change)])
    return printed.getvalue()


def metrics(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]


def numbers(printed: str) -> str:
    """What was printed, without the paths and what is said of the data."""
    others = ("run is", "/", "background", "clouds: ")
    return "\n".join(line for line in printed.splitlines() if not any(each in line for each in others))


@pytest.fixture(scope="module")
def trained(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Two epochs, and what they printed. Tests only read it."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    out = tmp_path_factory.mktemp("runs") / "tiny"
    printed = run(scenes, out)
    torch.set_num_threads(threads)
    return out, printed


# --- a run ------------------------------------------------------------------------------------------------------------


def test_what_a_run_writes(trained: tuple[Path, str]) -> None:
    out, printed = trained
    written = {"checkpoint.pt", "metrics.jsonl", "data.txt", "tensorboard", "pictures"}
    assert {path.name for path in out.iterdir()} == written
    assert printed.count("4 frames to train, 2 to validate, on cpu") == 1
    assert printed.count("labels of classes that the config does not have count as background: 3 Van\n") == 1
    for epoch, record in enumerate(metrics(out), 1):
        assert (record["epoch"], record["step"]) == (epoch, 2 * epoch)
        losses = [f"{name} {record[name]:.6f}" for name in
                  ("loss", "classification", "localization", "vertical", "direction")]  # fmt: skip
        assert f"epoch {epoch:3d}  " + "  ".join(losses) in printed
        assert record["loss"] == pytest.approx(sum(record[name.split()[0]] for name in losses[1:]), rel=1e-6)
        assert set(record["validation"]) == {"Car", "Pedestrian", "Cyclist"}
        assert len(record["validation"]["Car"]["R40"]["bev"]) == 3
        assert "exact" in record["validation"]["Car"]
    assert printed.count("Car: ") == 2
    assert str(out / "pictures") in printed
    assert [path.name for path in (out / "pictures").iterdir()] == ["000004.png"]
    with Image.open(out / "pictures" / "000004.png") as image:
        assert image.format == "PNG"
    assert load(out / "checkpoint.pt", "cpu").classes == ("Car", "Pedestrian", "Cyclist")


def test_tensorboard_has_the_metrics(trained: tuple[Path, str]) -> None:
    out, _ = trained
    board = EventAccumulator(str(out / "tensorboard")).Reload()
    written = board.Scalars("loss")
    assert [event.step for event in written] == [1, 2]
    assert [event.value for event in written] == pytest.approx([record["loss"] for record in metrics(out)])
    assert "validation/Car/R40/bev/moderate" in board.Tags()["scalars"]


def test_the_same_seed_gives_the_same_bits(scenes: Path, trained: tuple[Path, str], tmp_path: Path) -> None:
    out, printed = trained
    again = run(scenes, tmp_path / "again")
    assert numbers(again) == numbers(printed)
    assert (tmp_path / "again" / "metrics.jsonl").read_bytes() == (out / "metrics.jsonl").read_bytes()
    assert same(load_checkpoint(tmp_path / "again" / "checkpoint.pt"), load_checkpoint(out / "checkpoint.pt"))
    assert contents(tmp_path / "again" / "pictures") == contents(out / "pictures")


def test_workers_change_no_bit_and_pass_errors_on(
    copied: Path,
    trained: tuple[Path, str],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out, _ = trained
    run(copied, tmp_path / "workers", "train.workers=2")
    mine, theirs = load_checkpoint(out / "checkpoint.pt"), load_checkpoint(tmp_path / "workers" / "checkpoint.pt")
    assert same(mine["model"], theirs["model"])
    assert same(mine["optimizer"], theirs["optimizer"])
    assert metrics(tmp_path / "workers") == metrics(out)

    cloud = copied / "training" / "velodyne" / "000001.bin"
    cloud.write_bytes(b"x" * 17)
    with monkeypatch.context() as patched:  # as if the file were damaged after the run had looked at it
        patched.setattr(KittiFrames, "object_names", lambda *_: ["Car"])
        with pytest.raises(InputError, match=rf"^{re.escape(str(cloud))}: 17 bytes [^\n]*$"):
            run(copied, tmp_path / "damaged", "train.workers=1")
    assert "Traceback" not in capfd.readouterr().err


def test_another_seed_gives_another_run(scenes: Path, trained: tuple[Path, str], tmp_path: Path) -> None:
    run(scenes, tmp_path / "other", "train.seed=1", "train.epochs=1")
    assert metrics(tmp_path / "other")[0]["loss"] != metrics(trained[0])[0]["loss"]


def test_bfloat16(scenes: Path, trained: tuple[Path, str], tmp_path: Path) -> None:
    run(scenes, tmp_path / "half", "train.bfloat16=true", "train.epochs=1")
    ours, full = metrics(tmp_path / "half")[0]["loss"], metrics(trained[0])[0]["loss"]
    assert ours == pytest.approx(full, rel=0.1)  # bfloat16 has 8 bits: 0.4 % a number
    assert ours != full
    weights = load_checkpoint(tmp_path / "half" / "checkpoint.pt")["model"]
    assert {value.dtype for value in weights.values()} == {torch.float32, torch.int64}


def test_without_data_scenes_are_generated(tmp_path: Path) -> None:
    changes = ["synthetic.train_frames=2", "synthetic.val_frames=1", "train.epochs=1"]
    run(None, tmp_path / "a", *changes)
    folder = tmp_path / "scenes-2-1-25.6m-0"
    assert len(list((folder / "training" / "velodyne").iterdir())) == 3
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.bin")}
    run(None, tmp_path / "b", *changes)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*.bin")} == before
    assert metrics(tmp_path / "a") == metrics(tmp_path / "b")


# --- resuming ---------------------------------------------------------------------------------------------------------


def test_a_resumed_run_is_the_run_in_one_go(scenes: Path, trained: tuple[Path, str], tmp_path: Path) -> None:
    whole, printed = trained
    out = tmp_path / "resumed"
    run(scenes, out, "train.epochs=1")
    with (out / "metrics.jsonl").open("a") as file:
        file.write('{"epoch": 2, "lo')  # a run that was stopped while it wrote
    second = run(scenes, out, resume=True)
    assert (out / "metrics.jsonl").read_bytes() == (whole / "metrics.jsonl").read_bytes()
    assert same(load_checkpoint(out / "checkpoint.pt"), load_checkpoint(whole / "checkpoint.pt"))
    assert "epoch   1 " not in second
    assert numbers(printed).endswith(numbers(second))
    board = EventAccumulator(str(out / "tensorboard")).Reload()
    assert [event.step for event in board.Scalars("loss")] == [1, 2]  # none is purged


@pytest.fixture
def begun(trained: tuple[Path, str], tmp_path: Path) -> Path:
    """A copy of the run, to resume."""
    return Path(shutil.copytree(trained[0], tmp_path / "begun"))


def test_resuming_a_finished_run_changes_nothing(scenes: Path, begun: Path) -> None:
    before = contents(begun)
    run(scenes, begun, resume=True)
    after = contents(begun)
    assert {name: after[name] for name in before} == before


def test_drives(copied: Path, tmp_path: Path) -> None:
    """A run that draws by drives goes on to the same bits, but not with other drives."""
    file = copied / "drives.csv"
    file.write_text("frame,drive\n000000,a\n000001,b\n000002,b\n000003,b\n")
    changes = ["train.drives=drives.csv", "augment.mix=0.5", "train.repeat=2"]
    run(copied, tmp_path / "whole", *changes)
    run(copied, tmp_path / "out", *changes, "train.epochs=1")
    run(copied, tmp_path / "out", *changes, resume=True)
    mine, want = (load_checkpoint(tmp_path / name / "checkpoint.pt") for name in ("out", "whole"))
    assert same(mine, want)
    run(copied, tmp_path / "other", *changes[1:])
    assert metrics(tmp_path / "other")[0]["loss"] != metrics(tmp_path / "whole")[0]["loss"]
    with pytest.raises(InputError, match=r"another train\.drives"):
        run(copied, tmp_path / "out", *changes[1:], resume=True)
    file.write_text(file.read_text().replace("000001,b", "000001,a"))
    with pytest.raises(InputError, match="was trained on other frames or drives"):
        run(copied, tmp_path / "out", *changes, resume=True)
    file.unlink()
    with pytest.raises(InputError, match=r"drives\.csv: no such file; give a CSV file with the columns frame,drive"):
        run(copied, tmp_path / "none", *changes)
    file.mkdir()
    with pytest.raises(InputError, match=r"drives\.csv: cannot be read \(Is a directory\)"):
        run(copied, tmp_path / "none", *changes)
    assert not (tmp_path / "none").exists()


def test_averaged_weights(
    scenes: Path, trained: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are validated and used; the run itself is that without them, and goes on to the same bits."""
    changes = ["train.average=0.3", "train.report_every=2"]
    validated, detector = [], run_module.Detector

    def noted(model: HVNet, device: torch.device, **options: Any) -> Detector:
        validated.append(copy.deepcopy(model.state_dict()))
        return detector(model, device, **options)

    with monkeypatch.context() as patched:
        patched.setattr(run_module, "Detector", noted)
        run(scenes, tmp_path / "whole", *changes)
    whole, plain = (load_checkpoint(folder / "checkpoint.pt") for folder in (tmp_path / "whole", trained[0]))
    assert same(whole["raw"], plain["model"])
    assert same(whole["optimizer"], plain["optimizer"])
    mine, theirs = metrics(tmp_path / "whole"), metrics(trained[0])
    assert [record["loss"] for record in mine] == [record["loss"] for record in theirs]
    moving = {name for name, value in whole["raw"].items() if value.is_floating_point()}
    still = {name for name in moving if same(whole["model"][name], whole["raw"][name])}
    assert {name.rsplit(".", 2)[0] for name in still} == {"backbone.pyramid.upsilon.2"}  # a level that no class uses
    assert same(validated[-1], whole["model"])
    used = load(tmp_path / "whole" / "checkpoint.pt", "cpu").encoder.state_dict()
    assert same(used, {name: whole["model"][f"encoder.{name}"] for name in used})

    run(scenes, tmp_path / "out", *changes, "train.epochs=1")
    run(scenes, tmp_path / "out", *changes, resume=True)
    assert same(load_checkpoint(tmp_path / "out" / "checkpoint.pt"), whole)
    assert metrics(tmp_path / "out") == mine
    save_checkpoint(tmp_path / "out" / "checkpoint.pt", {key: value for key, value in whole.items() if key != "raw"})
    with pytest.raises(InputError, match=r"does not hold a whole run \('raw'\)"):
        run(scenes, tmp_path / "out", *changes, resume=True)


def test_a_flat_run_detects_as_it_was_validated(scenes: Path, tmp_path: Path) -> None:
    """Its clouds and boxes are flattened to the ground that the checkpoint keeps; inserted objects stand there."""
    changes = ["encoder.flat_ground=true", "augment.translation=[0, 0, 0]", "augment.scaling=[1, 1]"]
    config = load_config(DEMO, [*SHORT, *changes])
    made = Run(config, kitti_data(scenes, config), tmp_path / "run")
    record = [made.epoch() for _ in range(2)][-1]
    detector = load(tmp_path / "run" / "checkpoint.pt", "cpu")
    assert detector.is_flat
    assert detector.ground == made.sensor["ground"] == pytest.approx(-1.73, abs=0.1)
    found = score(detector, made.data.val)
    for name, measures in record["validation"].items():
        assert measures == {measure: found[name][measure] for measure in measures}
    frames = made.loader.dataset
    assert isinstance(frames, TrainingFrames)
    for k in range(4):
        sample = frames.augmented(0, k)
        above = sample.boxes[:, 2] - sample.boxes[:, 5] / 2 - detector.ground
        assert (above.abs() < 1e-5).sum() >= 3  # inserted; the estimate under the others is not perfect
        assert above.abs().max() < 0.3


def test_clouds_without_a_ground_stay_as_they_are(copied: Path, tmp_path: Path) -> None:
    for cloud in (copied / "training" / "velodyne").iterdir():
        np.fromfile(cloud, np.float32)[:40].tofile(cloud)
    printed = run(copied, tmp_path / "run", "encoder.flat_ground=true", "train.epochs=1")
    assert "no ground is found in the clouds, so that slopes stay" in printed
    assert not load(tmp_path / "run" / "checkpoint.pt", "cpu").is_flat


def test_an_average_begins_at_once(scenes: Path, tiny: Config, tmp_path: Path, threads: None) -> None:
    """At step t the decay is (1 + t) / (10 + t) until that is more than what is wanted, for the statistics as well."""
    config = replace(tiny, train=replace(tiny.train, repeat=3, average=0.3))
    training = Run(config, kitti_data(scenes, config), tmp_path / "run")
    assert training.averaged is not None
    training.model.train()
    names = ("heads.0.score.bias", "backbone.main_stream.blocks.0.first.1.running_var")
    averages = [training.model.state_dict()[name].double() for name in names]
    decays = (1 / 10, 2 / 11, 3 / 12, 0.3, 0.3, 0.3)
    for step, (batch, decay) in enumerate(zip(training.loader, decays, strict=True)):
        training.progress = Progress(step=step)
        training.step(batch)
        now = [training.model.state_dict()[name].double() for name in names]
        averages = [decay * average + (1 - decay) * value for average, value in zip(averages, now, strict=True)]
        assert not same(averages, now)
        for name, average in zip(names, averages, strict=True):
            torch.testing.assert_close(
                training.averaged.state_dict()[name], average, rtol=1e-5, atol=1e-7, check_dtype=False
            )


def test_frames_that_changed_since_are_said(copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Once, and the run goes on with them as they are; a file that was only touched is no change."""
    out, training = tmp_path / "out", copied / "training"
    changes = ["augment.objects={}", "train.learning_rate=1.0e-4"]
    run(copied, out, "train.epochs=1", *changes)
    stamps = load_checkpoint(out / "checkpoint.pt")["stamps"]
    assert {split: tuple(numbers.shape) for split, numbers in stamps.items()} == {"train": (4, 4), "val": (2, 4)}
    (training / "velodyne" / "000000.bin").touch()
    cloud, label = training / "velodyne" / "000002.bin", training / "label_2" / "000005.txt"
    cloud.write_bytes(cloud.read_bytes()[:-16])
    label.write_text("")
    printed = run(copied, out, "train.epochs=2", *changes, resume=True)
    said = "checkpoint.pt: since it was written, frames have changed: 000002 (cloud) and 1 more; they are used as they"
    assert printed.count(said) == 1
    assert len(metrics(out)) == 2
    now = load_checkpoint(out / "checkpoint.pt")["stamps"]
    assert (now["train"][:, 3] != stamps["train"][:, 3]).tolist() == [False, False, True, False]
    assert (now["val"][:, 0] != stamps["val"][:, 0]).tolist() == [False, True]
    with monkeypatch.context() as patched:  # no cloud is read to see that nothing has changed
        patched.setattr("hvnet.data.stamps._crc32", lambda path: pytest.fail(f"{path} is read"))
        assert "since it was written" not in run(copied, out, "train.epochs=3", *changes, resume=True)
    label.write_text("DontCare -1 -1 -10 0 0 10 10 -1 -1 -1 -1000 -1000 -1000 -10\n")
    printed = run(copied, out, "train.epochs=3", *changes, resume=True)
    assert "frames have changed: 000005 (labels, calibration or options of reading); they are used" in printed


def test_a_checkpoint_without_stamps_is_resumed(copied: Path, begun: Path) -> None:
    """Of an earlier version: nothing is known of its frames."""
    content = load_checkpoint(begun / "checkpoint.pt")
    del content["stamps"]
    save_checkpoint(begun / "checkpoint.pt", content)
    (copied / "training" / "label_2" / "000001.txt").write_text("")
    printed = run(copied, begun, "train.epochs=3", resume=True)
    assert "changed" not in printed
    assert set(load_checkpoint(begun / "checkpoint.pt")["stamps"]) == {"train", "val"}


@pytest.mark.parametrize("numbers", [torch.zeros(3, 4).long(), "none"])
def test_broken_stamps_are_refused(scenes: Path, begun: Path, numbers: Any) -> None:
    content = load_checkpoint(begun / "checkpoint.pt")
    save_checkpoint(begun / "checkpoint.pt", content | {"stamps": {"train": numbers}})
    with pytest.raises(InputError, match=r"checkpoint\.pt: does not hold a whole run \("):
        run(scenes, begun, resume=True)


def test_objects_of_changed_labels_are_cut_again(copied: Path, tmp_path: Path) -> None:
    run(copied, tmp_path / "before", "train.epochs=1")
    before = (copied / "gt_database.npz").read_bytes()
    (copied / "training" / "label_2" / "000001.txt").write_text("")
    printed = run(copied, tmp_path / "after", "train.epochs=1")
    said = (
        "gt_database.npz: is built again, as frames have changed: 000001 (labels, calibration or options of reading)\n"
    )
    assert printed.count(said) == 1
    assert (copied / "gt_database.npz").read_bytes() != before
    assert "000001" not in read_database(copied / "gt_database.npz").frame
    assert "built again" not in run(copied, tmp_path / "again", "train.epochs=1")
    assert metrics(tmp_path / "again") == metrics(tmp_path / "after")


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("backbone.layers=[2, 2, 3]", "backbone.layers"),
        ("train.seed=1", "train.seed"),
        ("head.direction=false", "head.direction"),
        ("augment.objects.Car=3", "augment.objects.Car"),
        ("synthetic=null", "synthetic"),
    ],
)
def test_another_config_is_refused(scenes: Path, begun: Path, change: str, key: str) -> None:
    before = contents(begun)
    with pytest.raises(InputError, match=rf"checkpoint\.pt: was trained with another {re.escape(key)}"):
        run(scenes, begun, change, resume=True)
    assert contents(begun) == before


@pytest.mark.parametrize("change", ["train.cosine=true", "augment.fade_out=1"])
def test_other_epochs_are_refused_where_they_matter(scenes: Path, tmp_path: Path, change: str) -> None:
    run(scenes, tmp_path / "out", change, "train.epochs=1")
    with pytest.raises(InputError, match=r"was trained with another train\.epochs"):
        run(scenes, tmp_path / "out", change, resume=True)


def test_a_broken_checkpoint_is_refused(scenes: Path, begun: Path) -> None:
    path = begun / "checkpoint.pt"
    content = load_checkpoint(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"checkpoint\.pt: truncated"):
        run(scenes, begun, resume=True)
    for key in ("optimizer", "epoch", "random"):
        save_checkpoint(path, {name: value for name, value in content.items() if name != key})
        with pytest.raises(InputError, match=rf"checkpoint\.pt: does not hold a whole run \('{key}'\)"):
            run(scenes, begun, resume=True)


# --- runs that are stopped --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_run_after_its_step(
    scenes: Path, trained: tuple[Path, str], tmp_path: Path, steps: int, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rate = learning_rate

    def signalled(config: TrainConfig, step: int, *rest: int) -> float:
        if step + 1 == steps:
            signal.raise_signal(number)
        return rate(config, step, *rest)

    out = tmp_path / "out"
    before = signal.getsignal(number)
    with monkeypatch.context() as patched:
        patched.setattr("hvnet.training.run.learning_rate", signalled)
        with pytest.raises(Stopped) as ended:
            run(scenes, out)
    assert ended.value.signal == number
    assert signal.getsignal(number) is before
    content = load_checkpoint(out / "checkpoint.pt")
    assert (content["epoch"], content["batch"], content["step"]) == (steps // 2, 1, steps)
    run(scenes, out, resume=True)
    assert same(load_checkpoint(out / "checkpoint.pt"), load_checkpoint(trained[0] / "checkpoint.pt"))
    assert metrics(out) == metrics(trained[0])


def test_a_signal_in_a_validation(
    scenes: Path, trained: tuple[Path, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = Run.validate

    def signalled(self: Run) -> Any:
        signal.raise_signal(signal.SIGTERM)
        return plain(self)

    out = tmp_path / "out"
    with monkeypatch.context() as patched:
        patched.setattr(Run, "validate", signalled)
        with pytest.raises(Stopped):
            run(scenes, out)
    assert load_checkpoint(out / "checkpoint.pt")["epoch"] == 1  # the validation was not in vain
    assert len(metrics(out)) == 1
    run(scenes, out, resume=True)
    assert same(load_checkpoint(out / "checkpoint.pt"), load_checkpoint(trained[0] / "checkpoint.pt"))


def test_a_signal_where_an_epoch_is_one_batch(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_module, "print_once", lambda *_: signal.raise_signal(signal.SIGTERM))
    with pytest.raises(Stopped):
        run(scenes, tmp_path / "out", "train.batch_size=4")
    content = load_checkpoint(tmp_path / "out" / "checkpoint.pt")
    assert (content["epoch"], content["batch"], content["step"]) == (0, 1, 1)


def test_a_long_epoch_is_saved_within(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved = []
    monkeypatch.setattr(run_module, "SAVE_SECONDS", 0.0)
    plain = Run.save
    monkeypatch.setattr(Run, "save", lambda self: (saved.append(self.progress[:2]), plain(self)))
    run(scenes, tmp_path / "out", "train.epochs=1")
    assert saved == [(0, 0), (0, 1), (0, 2), (0, 2), (1, 0)]


def test_two_ranks_train_and_one_goes_on(scenes: Path, trained: tuple[Path, str], tmp_path: Path) -> None:
    """torchrun: the losses are those of one process but for rounding, and all frames are validated."""
    out = tmp_path / "out"
    arguments = ["--config", str(DEMO), "--out", str(out), "--device", "cpu", "--data", str(scenes)]
    average = "train.average=0.9"  # changes no loss, and both ranks validate with it
    arguments += [part for change in (*SHORT, average, "train.epochs=1") for part in ("--set", change)]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    done = subprocess.run(
        [*command, "-m", "hvnet.train", *arguments], cwd=DEMO.parents[1], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("epoch   1 ") == 1
    run(scenes, out, average, resume=True)
    for mine, whole in zip(metrics(out), metrics(trained[0]), strict=True):
        assert mine["step"] == whole["step"]
        assert mine["loss"] == pytest.approx(whole["loss"], rel=0.02)
        assert mine["validation"].keys() == whole["validation"].keys()


KILLED = """
import os, signal, sys, torch
import hvnet.evaluation.scoring as scoring, hvnet.train as train, hvnet.training.run as run
torch.set_num_threads(1)
place, count = sys.argv[1], int(sys.argv[2])
calls = []
def killed(*_):
    calls.append(None)
    if len(calls) == count:
        os.kill(os.getpid(), signal.SIGKILL)
if place == "step":
    run.print_once = scoring.print_once = killed
else:
    save = torch.save
    def half(content, file):
        save(content, file)
        file.seek(file.tell() // 2)
        file.truncate()
        file.flush()
        killed()
        file.seek(0)
        save(content, file)
    torch.save = half
train.main(sys.argv[3:])
"""


# the place, the call of it that is killed (of notes: two in the steps of an epoch, three in its validation), and the
# epochs that are saved
RANDOM = np.random.default_rng(0).integers(1, 9, 3).tolist()
PLACES = [("step", count, (count - 1) // 5) for count in RANDOM] + [("save", 2, 0), ("save", 3, 0), ("save", 4, 1)]


@pytest.mark.parametrize(("place", "count", "epochs"), PLACES)
def test_a_killed_run_goes_on(
    scenes: Path, trained: tuple[Path, str], tmp_path: Path, place: str, count: int, epochs: int
) -> None:
    """kill -9 in a step, and in the middle of a checkpoint: the resumed run ends with the same bits."""
    out = tmp_path / "out"
    arguments = ["--config", str(DEMO), "--out", str(out), "--device", "cpu", "--data", str(scenes)]
    arguments += [part for change in SHORT for part in ("--set", change)]
    command = [sys.executable, "-c", KILLED, place, str(count), *arguments]
    done = subprocess.run(command, cwd=DEMO.parents[1], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert (out / "checkpoint.partial").exists() == (place == "save")
    assert load_checkpoint(out / "checkpoint.pt")["epoch"] == epochs
    run(scenes, out, resume=True)
    assert same(load_checkpoint(out / "checkpoint.pt"), load_checkpoint(trained[0] / "checkpoint.pt"))
    assert metrics(out) == metrics(trained[0])
    assert not (out / "checkpoint.partial").exists()


def test_a_full_disk_leaves_the_last_checkpoint(scenes: Path, begun: Path, trained: tuple[Path, str]) -> None:
    """The system refuses to write past 50 kB, as it refuses on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = (begun / "checkpoint.pt").read_bytes()
    assert len(before) > 50_000
    content = load_checkpoint(begun / "checkpoint.pt")
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(InputError, match=r"checkpoint\.pt: cannot be written .*held before is whole"):
            save_checkpoint(begun / "checkpoint.pt", content)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (begun / "checkpoint.pt").read_bytes() == before
    assert not (begun / "checkpoint.partial").exists()


def test_a_run_on_a_full_disk_goes_on(scenes: Path, begun: Path, tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    try:
        with pytest.raises(InputError, match=r"checkpoint\.pt: cannot be written"):
            run(scenes, begun, "train.epochs=3", resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    run(scenes, begun, "train.epochs=3", resume=True)
    run(scenes, tmp_path / "whole", "train.epochs=3")
    assert same(load_checkpoint(begun / "checkpoint.pt"), load_checkpoint(tmp_path / "whole" / "checkpoint.pt"))
    assert metrics(begun) == metrics(tmp_path / "whole")


def test_a_disk_without_room_is_found_before_the_run(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
    with pytest.raises(InputError, match=r"1 MB free, the run needs \d+ MB; free some, or give another --out"):
        run(scenes, tmp_path / "new" / "out")
    assert not (tmp_path / "new").exists()


def test_a_root_without_its_calibrations_is_refused_at_once(copied: Path, tmp_path: Path) -> None:
    shutil.rmtree(copied / "training" / "calib")
    with pytest.raises(InputError, match=r"training.calib: no such folder, but the labels of frame \d+ have 2D boxes"):
        run(copied, tmp_path / "out")
    assert not (tmp_path / "out" / "checkpoint.pt").exists()


@pytest.mark.parametrize("place", ["label", "points", "points that change during the run"])
def test_a_corrupt_frame_is_named_and_skipped(
    copied: Path, tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = read_split(copied, "train")
    bad = copied / "training" / ("label_2" if place == "label" else "velodyne") / names[1]
    if place == "label":
        bad.with_suffix(".txt").write_text("Car 1 2 three\n")
    else:
        bad.with_suffix(".bin").write_bytes(b"x" * 17)
    if place.endswith("run"):
        monkeypatch.setattr(KittiFrames, "object_names", lambda *_: ["Car"])
    with pytest.raises(InputError, match=names[1]):
        run(copied, tmp_path / "stopped")
    noted: list[str] = []
    monkeypatch.setattr("tqdm.tqdm.write", noted.append)
    (copied / "gt_database.npz").unlink(missing_ok=True)
    objects = ["augment.objects={}"] if place.endswith("run") else []  # the database is built before the change
    printed = run(copied, tmp_path / "out", "train.skip_corrupt=true", *objects)
    said = printed + "\n".join(noted)
    assert f"frame {names[1]} is skipped: " in said
    assert len(metrics(tmp_path / "out")) == 2


def test_no_frame_can_be_read(copied: Path, tmp_path: Path) -> None:
    for file in (copied / "training" / "label_2").iterdir():
        file.write_text("Car 1 2 three\n")
    with pytest.raises(InputError, match="no frame of the split can be read"):
        run(copied, tmp_path / "out", "train.skip_corrupt=true", "augment.objects={}")


# --- mistakes ---------------------------------------------------------------------------------------------------------


def test_a_folder_that_is_not_empty_is_refused(scenes: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine"
    out.mkdir()
    (out / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match=r"mine: is not empty; give another --out, or --resume"):
        run(scenes, out)
    with pytest.raises(InputError, match=r"mine: holds no checkpoint\.pt to resume"):
        run(scenes, out, resume=True)
    assert contents(out) == {"thesis.txt": b"years of work"}
    with pytest.raises(InputError, match=r"thesis\.txt: is not empty"):
        run(scenes, out / "thesis.txt")


def test_nothing_to_resume(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none: holds no checkpoint\.pt to resume"):
        run(scenes, tmp_path / "none", resume=True)
    assert not (tmp_path / "none").exists()


def _no_frame(root: Path) -> str:
    (root / "ImageSets" / "val.txt").write_text("000004\n000099\n")
    return r"val\.txt:2: frame 000099 has no .*000099\.bin; add the file or remove the line"


def _no_split(root: Path) -> str:
    (root / "ImageSets" / "train.txt").unlink()
    return r"train\.txt: no such file; it holds the frames of split 'train'"


def _cut_off_cloud(root: Path) -> str:
    path = root / "training" / "velodyne" / "000003.bin"
    path.write_bytes(path.read_bytes()[:-3])
    return r"000003\.bin: \d+ bytes are no multiple of 16"


def _no_calibration(root: Path) -> str:
    (root / "training" / "calib" / "000003.txt").write_text("P2: 1 2 3\n")
    return r"000003\.txt:1: P2 has 3 numbers, expected 12"


@pytest.mark.parametrize("spoil", [_no_frame, _no_split, _cut_off_cloud, _no_calibration])
def test_mistakes_in_the_data(copied: Path, tmp_path: Path, spoil: Callable[[Path], str]) -> None:
    (copied / "gt_database.npz").unlink(missing_ok=True)
    message = spoil(copied)
    with pytest.raises(InputError, match=message):
        run(copied, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_mistakes_in_the_arguments(scenes: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"demo\.yaml: has no key synthetic, so it needs --data with a KITTI root"):
        run(None, tmp_path / "out", "synthetic=null")
    with pytest.raises(InputError, match=r"head\.classes\[0\]\.name: want a word"):
        run(scenes, tmp_path / "out", "augment.objects={}", f"head.classes=[{_entry('a boat')}]")
    with pytest.raises(InputError, match=r"train\.epoch: unknown key"):
        run(scenes, tmp_path / "out", "train.epoch=3")
    with pytest.raises(InputError, match=r"none\.txt: no such file"):
        run(scenes, tmp_path / "out", "train.train_split=none")
    assert list(tmp_path.iterdir()) == []


def _entry(name: str) -> str:
    return (
        f"{{name: {name}, level: 0, anchor_sizes: [[4, 2, 2]], anchor_z: 0, positive_iou: 0.5, negative_iou: 0.3,"
        " focal_alpha: 0.2, focal_gamma: 2, nms_iou: 0.1}"
    )


def test_a_diverging_run_keeps_its_last_checkpoint(scenes: Path, begun: Path) -> None:
    before = contents(begun)
    message = r"the loss is .* at step \d+; its frames are in .*non_finite\.jsonl; lower train\.learning_rate.*--resume"
    with pytest.raises(InputError, match=message):
        run(scenes, begun, "train.learning_rate=1.0e+30", "train.epochs=9", resume=True)
    assert load_checkpoint(begun / "checkpoint.pt")["epoch"] >= 2
    for value in load_checkpoint(begun / "checkpoint.pt")["model"].values():
        assert value.isfinite().all()
    assert contents(begun).keys() >= before.keys()
    line = json.loads((begun / "non_finite.jsonl").read_text())
    assert len(line["frames"]) == 2
    assert set(line["frames"]) < {"000000", "000001", "000002", "000003"}


def test_a_step_that_is_not_finite_is_left_out(scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A point of absurd reflectance overflows the statistics of the batch norms, too."""
    made = spoil(monkeypatch, 1)
    out = tmp_path / "out"
    run(scenes, out, "train.skip_non_finite=true")
    assert len(made) == 4
    (line,) = (json.loads(line) for line in (out / "non_finite.jsonl").read_text().splitlines())
    assert (line["epoch"], line["step"], line["loss"]) == (1, 1, "nan")
    content = load_checkpoint(out / "checkpoint.pt")
    assert all(value.isfinite().all() for value in content["model"].values())
    assert all(math.isfinite(record["loss"]) for record in metrics(out))
    assert {int(state["step"]) for state in content["optimizer"]["state"].values()} == {3}


def test_ten_steps_of_many_threads_are_those_of_one(
    scenes: Path, tiny: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Augmentation, losses, gradients and the fused optimizer, but for rounding."""
    config = replace(tiny, train=replace(tiny.train, repeat=5), augment=replace(tiny.augment, mix=0.5))

    def ten_steps(out: Path) -> tuple[list[dict[str, float]], dict[str, Tensor]]:
        training = Run(config, kitti_data(scenes, config), out)
        training.model.train()
        for batch in training.loader:
            training.step(batch)
        return training.read_steps(), training.model.state_dict()

    losses, weights = ten_steps(tmp_path / "one")
    monkeypatch.setattr(launch, "force_many_threads", True)
    found, found_weights = ten_steps(tmp_path / "many")
    assert len(found) == 10
    assert found[0]["loss"] != pytest.approx(found[9]["loss"], rel=1e-3)
    for mine, want in zip(found, losses, strict=True):
        assert mine == pytest.approx(want, rel=1e-5)
    torch.testing.assert_close(found_weights, weights, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("many", [False, True])
def test_losses_are_reported_every_few_steps(
    scenes: Path, trained: tuple[Path, str], tmp_path: Path, many: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The record is the same, also where the steps of an epoch are no multiple, or the run is resumed with another."""
    if many:
        monkeypatch.setattr(launch, "force_many_threads", True)
        run(scenes, tmp_path / "whole")
    whole = tmp_path / "whole" if many else trained[0]
    out, reported = tmp_path / "out", []
    plain = Run.read_steps

    def read(training: Run) -> list[dict[str, float]]:
        reported.append(len(training.unread))
        return plain(training)

    monkeypatch.setattr(Run, "read_steps", read)
    run(scenes, out, "train.epochs=1", "train.report_every=3")
    run(scenes, out, "train.report_every=2", resume=True)
    assert reported == [2, 2]
    assert metrics(out) == metrics(whole)
    mine, want = load_checkpoint(out / "checkpoint.pt"), load_checkpoint(whole / "checkpoint.pt")
    assert same([mine[key] for key in ("model", "optimizer")], [want[key] for key in ("model", "optimizer")])
    reported.clear()
    run(scenes, tmp_path / "longer", "train.repeat=4", "train.epochs=1", "train.report_every=3")
    assert reported == [3, 3, 2]


@pytest.mark.parametrize("many", [False, True])
def test_a_run_goes_on_on_another_kind_of_device(
    scenes: Path, trained: tuple[Path, str], tmp_path: Path, many: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The optimizer is fused where many threads work, whatever the checkpoint says."""
    out = tmp_path / "out"
    with monkeypatch.context() as patched:
        patched.setattr(launch, "force_many_threads", not many)
        run(scenes, out, "train.epochs=1")
    monkeypatch.setattr(launch, "force_many_threads", many)
    run(scenes, out, resume=True)
    content = load_checkpoint(out / "checkpoint.pt")["optimizer"]
    assert [group["fused"] for group in content["param_groups"]] == [True if many else None]
    assert {int(state["step"]) for state in content["state"].values()} == {4}
    for mine, want in zip(metrics(out), metrics(trained[0]), strict=True):
        assert mine["loss"] == pytest.approx(want["loss"], rel=1e-5)


def spoil(monkeypatch: pytest.MonkeyPatch, number: int) -> list[list[str]]:
    """Gives the points of a batch absurd reflectances; returns the names of the frames of every batch."""
    made: list[list[str]] = []

    def broken(samples: Any) -> Any:
        batch = collate(samples)
        if len(made) == number:
            batch.points[:, 3] = 3e38
        made.append(batch.names)
        return batch

    monkeypatch.setattr("hvnet.training.run.collate", broken)
    return made


@pytest.mark.parametrize("report_every", [1, 3])
def test_a_step_that_is_not_finite_changes_nothing(
    scenes: Path, tiny: Config, tmp_path: Path, report_every: int, threads: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither weights nor statistics nor the optimizer, before it is read and noted by its own step and frames."""
    made = spoil(monkeypatch, 1)
    train = replace(tiny.train, repeat=4, epochs=1, report_every=report_every, skip_non_finite=True)
    config = replace(tiny, train=train)
    training = Run(config, kitti_data(scenes, config), tmp_path / "out")
    states = []
    plain = Run.step

    def step(self: Run, batch: Any) -> None:
        plain(self, batch)
        states.append(copy.deepcopy((self.model.state_dict(), self.optimizer.state_dict()["state"])))

    monkeypatch.setattr(Run, "step", step)
    training.train()
    assert same(states[0], states[1])
    assert not same(states[1], states[2])
    (line,) = (json.loads(line) for line in (tmp_path / "out" / "non_finite.jsonl").read_text().splitlines())
    assert (line["epoch"], line["step"], line["loss"], line["frames"]) == (1, 1, "nan", made[1])
    assert math.isfinite(metrics(tmp_path / "out")[0]["loss"])


def test_a_step_that_is_not_finite_ends_the_run_at_the_report(
    scenes: Path, tmp_path: Path, threads: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = spoil(monkeypatch, 4)
    out = tmp_path / "out"
    message = r"the loss is nan and its gradient's norm nan at step 4; its frames are in "
    with pytest.raises(InputError, match=message):
        run(scenes, out, "train.repeat=4", "train.report_every=3")
    assert len(made) == 6
    assert json.loads((out / "non_finite.jsonl").read_text())["frames"] == made[4]
    assert load_checkpoint(out / "checkpoint.pt")["step"] == 0


# --- odd frames -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch_size", [1, 2])
def test_frames_without_objects_or_points(copied: Path, tmp_path: Path, batch_size: int) -> None:
    """An empty label file, no point at all, and one point: alone, or with others in a batch."""
    training = copied / "training"
    (training / "label_2" / "000000.txt").write_text("")
    (training / "velodyne" / "000001.bin").write_bytes(b"")
    (training / "velodyne" / "000004.bin").write_bytes(b"")
    one = torch.tensor([[20.0, 0.0, -1.0, 0.5]])
    (training / "velodyne" / "000002.bin").write_bytes(one.numpy().tobytes())
    run(copied, tmp_path / "out", f"train.batch_size={batch_size}")
    for record in metrics(tmp_path / "out"):
        assert math.isfinite(record["loss"])


def test_no_object_in_any_frame(copied: Path, tmp_path: Path) -> None:
    for path in (copied / "training" / "label_2").iterdir():
        path.write_text("")
    (copied / "gt_database.npz").unlink(missing_ok=True)
    run(copied, tmp_path / "out", "augment.objects={}", "train.epochs=1")
    record = metrics(tmp_path / "out")[0]
    assert record["localization"] == 0
    assert math.isfinite(record["loss"])
    with pytest.raises(InputError, match="no object is labelled in the 4 frames"):
        run(copied, tmp_path / "other")


# --- the parts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("workers", [0, 1])
def test_points_that_are_not_finite_are_said_once(copied: Path, tmp_path: Path, workers: int) -> None:
    """Two epochs with two validations read each frame again and again."""
    for name in ("000001", "000005"):  # of the training and of the validation split
        path = copied / "training" / "velodyne" / f"{name}.bin"
        points = np.fromfile(path, dtype=np.float32).reshape(-1, 4)
        points[:7, 1] = np.nan
        points.tofile(path)
    printed = run(copied, tmp_path / "run", f"train.workers={workers}")
    for name in ("000001", "000005"):
        assert printed.count(f"frame {name}: 7 points that are not finite were dropped") == 1


def test_a_mistake_in_a_validation_file_is_found_before_the_first_epoch(copied: Path, tmp_path: Path) -> None:
    label = copied / "training" / "label_2" / "000005.txt"
    label.write_text(label.read_text() + "Car 1 2 3\n")
    with pytest.raises(InputError, match=r"000005\.txt:\d+: "):
        run(copied, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_other_frames_are_not_resumed(copied: Path, begun: Path) -> None:
    (copied / "ImageSets" / "train.txt").write_text("000000\n000001\n000002\n")
    with pytest.raises(InputError, match="was trained on other frames or drives"):
        run(copied, begun, resume=True)


def test_folders_are_numbered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config, first = Path("some/demo.yaml"), Path("runs/demo")
    assert choose_out(None, config, resume=False) == first
    with pytest.raises(InputError, match=r"demo: holds no checkpoint\.pt to resume"):
        choose_out(None, config, resume=True)
    first.mkdir(parents=True)
    assert choose_out(None, config, resume=False) == Path("runs/demo-2")
    Path("runs/demo-2").mkdir()
    Path("runs/demo-2/checkpoint.pt").touch()
    assert choose_out(None, config, resume=False) == Path("runs/demo-3")
    assert choose_out(None, config, resume=True) == Path("runs/demo-2")
    assert choose_out("runs/demo", config, resume=False) == first  # it is empty
    assert choose_out("runs/demo-2", config, resume=True) == Path("runs/demo-2")
    with pytest.raises(InputError, match=r"demo-2: is not empty"):
        choose_out("runs/demo-2", config, resume=False)


def test_a_run_that_is_not_resumed_leaves_the_database(copied: Path, tmp_path: Path) -> None:
    """Its config is looked at before the database is built again for other options."""
    database = copied / "gt_database.npz"
    run(copied, tmp_path / "run", "augment.objects={Car: 2}")
    before = database.read_bytes()
    with pytest.raises(InputError, match=r"was trained with another data\.reflectance_scale"):
        run(copied, tmp_path / "run", "augment.objects={Car: 2}", "data.reflectance_scale=255", resume=True)
    assert database.read_bytes() == before
