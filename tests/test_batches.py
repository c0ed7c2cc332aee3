"""Batches of augmented frames: what an item depends on, their order, what is dropped."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from hvnet.config import Config, DataConfig
from hvnet.data.gt_database import load_database
from hvnet.data.insert import sampler_of
from hvnet.data.kitti import KittiFrames
from hvnet.data.sources import JoinedFrames
from hvnet.exceptions import InputError
from hvnet.training.batches import Data, EpochOrder, Sample, TrainingFrames, collate, seeded, training_objects
from tests.helpers import same

CPU = torch.device("cpu")
IDS = ["000000", "000001", "000002"]


def test_an_item_depends_on_seed_epoch_and_number_alone(scenes: Path, tiny: Config) -> None:
    objects = sampler_of(load_database(scenes, IDS, []))

    def frames(seed: int = 0) -> TrainingFrames:
        config = dataclasses.replace(tiny, train=dataclasses.replace(tiny.train, seed=seed))
        return TrainingFrames(KittiFrames(scenes, IDS), config, objects, CPU)

    one = frames()
    first = {item: one[item] for item in ((0, 0), (0, 1), (1, 0), (7, 2))}
    torch.rand(3)  # no state of torch's matters
    other = frames()
    for item in reversed(first):  # nor does the order
        assert same(other[item], first[item])
        assert same(one[item], first[item])
    assert not same(first[0, 0], first[1, 0])
    assert not same(first[0, 0], frames(seed=1)[0, 0])


def test_no_object_is_inserted_in_the_last_epochs(scenes: Path, tiny: Config) -> None:
    """Of three epochs two have more objects than the frames themselves, the same as without fading."""
    objects = sampler_of(load_database(scenes, IDS, []))

    def boxes(fade_out: int, **changes: object) -> list[int]:
        augmentation = dataclasses.replace(tiny.augment, fade_out=fade_out, rotation=0.0, **changes)
        config = dataclasses.replace(tiny, augment=augmentation, train=dataclasses.replace(tiny.train, epochs=3))
        frames = TrainingFrames(KittiFrames(scenes, IDS), config, objects, CPU)
        return [sum(len(frames.augmented(epoch, k).boxes) for k in range(3)) for epoch in range(3)]

    for changes in ({}, {"objects": {}, "whole_frames": 1.0}):
        some, none, plain = boxes(1, **changes), boxes(3, **changes), boxes(0, **changes)
        assert some == [*plain[:2], none[2]]
        assert all(fewer < more for fewer, more in zip(none, plain, strict=True))


def test_order_of_an_epoch() -> None:
    order = EpochOrder(50, 4, seed=3)
    first = list(order)
    assert len(order) == len(first) == 12  # two frames do not fill a batch
    items = [item for batch in first for item in batch]
    assert all(len(batch) == 4 for batch in first)
    assert len(set(items)) == 48
    assert set(items) < {(0, k) for k in range(50)}
    assert list(order) == first
    order.begin = 5
    assert list(order) == first[5:]
    order.begin, order.epoch = 0, 1
    assert {epoch for batch in order for epoch, _ in batch} == {1}
    assert [k for batch in order for _, k in batch] != [k for _, k in items]
    assert list(EpochOrder(50, 4, seed=4)) != first
    assert [len(batch) for batch in EpochOrder(3, 4, seed=0)] == [3]  # unless there are no others


def test_frames_of_long_drives_are_drawn_less_often() -> None:
    """A drive of n frames sqrt(n) times as often as one of one; each frame as often as expected, but for one."""
    drives = ["a"] * 16 + ["b"] * 4 + ["c"]  # of 4 + 2 + 1 parts
    expected = np.array([4 / 16] * 16 + [2 / 4] * 4 + [1]) * 63 / 7
    order = EpochOrder(63, 3, seed=0, drives=drives)
    epochs = []
    for order.epoch in range(100):
        items = [item for batch in order for item in batch]
        assert len(items) == len(set(items)) == 63
        assert {epoch for epoch, _ in items} == {order.epoch}
        counts = np.bincount([k % 21 for _, k in items], minlength=21)
        assert (np.abs(counts - expected) < 1).all()
        for k, count in enumerate(counts):  # augmented differently each time
            assert {item // 21 for _, item in items if item % 21 == k} == set(range(count))
        epochs.append(items)
    mean = np.mean([np.bincount([k % 21 for _, k in items], minlength=21) for items in epochs], axis=0)
    assert np.abs(mean - expected).max() < 0.1
    assert [k for _, k in epochs[0]] != sorted(k for _, k in epochs[0])
    assert [k for _, k in epochs[0]] != [k for _, k in epochs[1]]
    order.begin = 5
    assert [item for batch in order for item in batch] == epochs[-1][15:]


def test_sectors_come_from_frames_of_long_drives_less_often(scenes: Path, tiny: Config) -> None:
    mixed = dataclasses.replace(tiny, augment=dataclasses.replace(tiny.augment, mix=1.0, objects={}))
    frames = TrainingFrames(KittiFrames(scenes, IDS), mixed, None, CPU, drives=["a", "a", "b"])
    read, plain = [], frames.read

    def noted(k: int) -> Sample:
        read.append(k)
        return plain(k)

    frames.read = noted  # type: ignore[method-assign]
    for k in range(0, 600, 3):
        frames[0, k]
    shares = np.bincount(read[1::2], minlength=3) / 200
    np.testing.assert_allclose(shares, np.array([1, 1, 2**0.5]) / (2 + 2**0.5), atol=0.07)


def test_a_drive_for_every_frame(scenes: Path) -> None:
    frames = KittiFrames(scenes, IDS)
    with pytest.raises(ValueError, match="drives: want one for each of 3 training frames, got 2"):
        Data(frames, frames, drives=["a", "b"])


def test_ranks_share_a_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = list(EpochOrder(8, 4, seed=0))
    monkeypatch.setattr("hvnet.ranks.size", lambda: 2)
    shares = []
    for rank in range(2):
        monkeypatch.setattr("hvnet.ranks.rank", lambda rank=rank: rank)
        shares.append(list(EpochOrder(8, 4, seed=0)))
    for batch, *parts in zip(whole, *shares, strict=True):
        assert [len(part) for part in parts] == [2, 2]
        assert sorted(parts[0] + parts[1]) == sorted(batch)


def test_seeds_are_mixed() -> None:
    seeds = {seeded(a, b, c).initial_seed() for a in range(8) for b in range(8) for c in range(8)}
    assert len(seeds) == 512
    assert seeded(1, 2).initial_seed() == seeded(1, 2).initial_seed()


def test_boxes_outside_the_range_and_other_classes_are_dropped(copied: Path, tiny: Config) -> None:
    still = dataclasses.replace(tiny.augment, flip=0, rotation=0, scaling=(1, 1), translation=(0, 0, 0), objects={})
    config = dataclasses.replace(tiny, augment=still)
    lines = [
        "Car 0 0 0 600 150 700 200 1.5 1.6 4.0 0.00 1.7 10.0 0",  # ahead
        "Car 0 0 0 600 150 700 200 1.5 1.6 4.0 0.00 1.7 40.0 0",  # too far
        "Pedestrian 0 0 0 600 150 700 200 1.7 0.6 0.8 -7.5 1.7 9.0 0",  # too far to the left
        "Cyclist 0 0 0 600 150 700 200 1.7 0.6 1.8 5.0 1.7 9.0 0",
        "Van 0 0 0 600 150 700 200 2.0 1.9 5.0 -4.0 1.7 12.0 0",  # no class of the config
        "DontCare -1 -1 -10 600 150 700 200 -1 -1 -1 -1000 -1000 -1000 -10",
    ]
    (copied / "training" / "label_2" / "000000.txt").write_text("\n".join(lines) + "\n")
    _, boxes, labels, _, name = TrainingFrames(KittiFrames(copied, IDS[:1]), config, None, CPU)[0, 0]
    assert name == "000000"
    assert labels.tolist() == [0, 2]
    # the camera stands 0.27 m before the LiDAR, and its axes are turned by less than a degree
    torch.testing.assert_close(boxes[:, :2], torch.tensor([[10.3, 0.0], [9.3, -5.0]]), rtol=0, atol=0.2)


def test_a_frame_without_labels_is_no_frame_of_background(scenes: Path, tiny: Config) -> None:
    """It is a mistake or, where such frames are skipped, the next one takes its place."""
    unlabelled = KittiFrames(scenes, IDS[:1], labelled=False)
    frames = JoinedFrames([unlabelled, KittiFrames(scenes, IDS[1:])])
    still = dataclasses.replace(tiny, augment=dataclasses.replace(tiny.augment, objects={}))
    found = TrainingFrames(frames, still, None, CPU)[0, 0]
    assert isinstance(found, InputError)
    assert str(found) == "frame 000000: has no labels"
    skipping = dataclasses.replace(still, train=dataclasses.replace(still.train, skip_corrupt=True))
    sample = TrainingFrames(frames, skipping, None, CPU)[0, 0]
    assert isinstance(sample, Sample)
    assert (sample.name, sample.note) == ("000001", "frame 000000 is skipped: frame 000000: has no labels")
    assert not isinstance(collate([sample, sample]), InputError)
    assert collate([sample, found]) is found


def test_the_database_has_the_classes_of_the_frames(copied: Path) -> None:
    """It is built as the training frames are read, of those that can be, and without what is validated on."""
    reading = DataConfig(classes={"Van": "Car"})
    data = Data(KittiFrames(copied, IDS, reading=reading), KittiFrames(copied, ["000001"]), copied)
    said: list[str] = []
    plain = training_objects(Data(KittiFrames(copied, IDS), data.val, copied), [0, 2], said.append)
    assert "Van" in plain.name
    database = training_objects(data, [0, 2], said.append)
    assert set(database.frame.tolist()) == {"000000", "000002"}
    assert (database.name == "Car").sum() == np.isin(plain.name, ["Car", "Van"]).sum()
    assert "Van" not in database.name
    assert len(said) == 1  # that it was built again
    training_objects(data, [0, 1, 2], said.append)
    assert "was built without 1 of the 3 training frames, such as 000001" in said[1]


def test_batches_hold_whole_frames(scenes: Path, tiny: Config) -> None:
    items = [(0, 2), (0, 0), (0, 1)]
    config = dataclasses.replace(tiny, augment=dataclasses.replace(tiny.augment, objects={}))
    frames = TrainingFrames(KittiFrames(scenes, IDS), config, None, CPU)
    (batch,) = DataLoader(frames, batch_size=3, sampler=items, collate_fn=collate)  # type: ignore[arg-type]
    for b, item in enumerate(items):
        points, boxes, labels, _, name = frames[item]
        assert batch.names[b] == name
        assert torch.equal(batch.points[batch.sample == b], points)
        assert torch.equal(batch.boxes[b], boxes)
        assert torch.equal(batch.labels[b], labels)
    assert (batch.sample.diff() >= 0).all()
