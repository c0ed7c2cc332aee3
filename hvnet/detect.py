"""Boxes for clouds: `python -m hvnet.detect`, on files, on folders of files and on KITTI roots."""

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from hvnet.cli import InputError, run_command
from hvnet.data.clouds import SUFFIXES, read_cloud
from hvnet.data.kitti import (
    Calibration,
    Labels,
    boxes_to_camera,
    detections_to_labels,
    read_frame,
    read_split,
    write_labels,
)
from hvnet.draw import draw_bev
from hvnet.model import Detections, Detector, load


class Source(NamedTuple):
    """One cloud: a file, or a frame of a KITTI root."""

    name: str
    path: Path  # the file, or the root
    split_dir: str | None  # training or testing for a frame of a KITTI root


class Cloud(NamedTuple):
    """What a source holds."""

    points: Tensor  # (N, 4)
    truth: Tensor  # (T, 7), none where there are no labels
    calib: Calibration | None
    image_size: tuple[int, int]
    notes: list[str]


NO_IMAGE = Calibration(
    p2=np.eye(3, 4), r0_rect=np.eye(3), velo_to_cam=np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
)
"""Camera axes at the LiDAR itself, for clouds that come without calibration."""


def find_sources(inputs: Sequence[Path], split: str | None) -> list[Source]:
    """The clouds of the inputs, in order. Raises InputError for one that is missing or empty, or a name used twice."""
    sources: list[Source] = []
    for path in inputs:
        if path.is_file():
            if path.suffix not in SUFFIXES:
                raise InputError(f"{path}: unknown kind of file; known: {', '.join(SUFFIXES)}")
            sources.append(Source(path.stem, path, None))
        elif (path / "training").is_dir() or (path / "testing").is_dir():
            sources += _kitti_sources(path, split)
        elif path.is_dir():
            files = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES)
            if not files:
                raise InputError(f"{path}: holds no cloud ({', '.join(SUFFIXES)}) and is no KITTI root")
            sources += [Source(file.stem, file, None) for file in files]
        else:
            raise InputError(f"{path}: no such file or folder")
    if split is not None and all(source.split_dir is None for source in sources):
        raise InputError(f"--split {split}: none of the inputs is a KITTI root")
    first: dict[str, Source] = {}
    for source in sources:
        if source.name in first:
            raise InputError(f"{source.path}: the name {source.name} is taken by {first[source.name].path}; rename one")
        first[source.name] = source
    return sources


def _kitti_sources(root: Path, split: str | None) -> list[Source]:
    folder = "testing" if split == "test" or not (root / "training").is_dir() else "training"
    if split is not None:
        names = read_split(root, split, split_dir=folder, labelled=False)
    else:
        names = sorted(file.stem for file in (root / folder / "velodyne").glob("*.bin"))
        if not names:
            raise InputError(f"{root / folder / 'velodyne'}: holds no .bin file")
    return [Source(name, root, folder) for name in names]


def read_source(source: Source, classes: Sequence[str]) -> Cloud:
    """Reads a source; a KITTI frame comes with its calibration and, where there are labels, the true boxes."""
    if source.split_dir is None:
        points, notes = read_cloud(source.path)
        return Cloud(torch.from_numpy(points), torch.zeros(0, 7), None, (0, 0), notes)
    labelled = (source.path / source.split_dir / "label_2" / f"{source.name}.txt").is_file()
    frame = read_frame(source.path, source.name, source.split_dir, labelled=labelled)
    notes = [f"frame {frame.id}: {frame.dropped} points that are not finite were dropped"] if frame.dropped else []
    truth = frame.boxes[[name in classes for name in frame.names]]
    return Cloud(frame.points, truth, frame.calib, frame.image_size, notes)


def result_rows(found: Detections, cloud: Cloud, classes: Sequence[str]) -> Labels:
    """The rows of a KITTI result file. Without calibration the 2D boxes are -1 and the camera stands at the LiDAR."""
    names = [classes[label] for label in found.labels.tolist()]
    if cloud.calib is not None:
        return detections_to_labels(found.boxes, found.scores, names, cloud.calib, cloud.image_size)
    dimensions, location, rotation_y = boxes_to_camera(found.boxes.double().cpu().numpy(), NO_IMAGE)
    alpha = rotation_y - np.arctan2(location[:, 0], location[:, 2])
    return Labels(
        name=np.array(names, dtype=np.str_),
        truncation=np.full(len(names), -1.0),
        occlusion=np.full(len(names), -1),
        alpha=(alpha + np.pi) % (2 * np.pi) - np.pi,
        bbox=np.full((len(names), 4), -1.0),
        dimensions=dimensions,
        location=location,
        rotation_y=rotation_y,
        score=found.scores.double().cpu().numpy(),
    )


def csv_rows(name: str, found: Detections, classes: Sequence[str]) -> Iterator[list[object]]:
    """Rows of boxes.csv: every box in LiDAR axes."""
    for box, score, label in zip(found.boxes.tolist(), found.scores.tolist(), found.labels.tolist(), strict=True):
        yield [name, classes[label], f"{score:.4f}", *(f"{value:.3f}" for value in box)]


def detect(detector: Detector, sources: Sequence[Source], out: Path, pictures: int) -> int:
    """Writes results/NAME.txt, boxes.csv and the first few pictures/NAME.png; returns the number of boxes."""
    total = 0
    for k, source in enumerate(tqdm(sources, desc="detecting", unit="cloud", dynamic_ncols=True)):
        cloud = read_source(source, detector.classes)
        for note in cloud.notes:
            tqdm.write(note)
        found = Detections(*(part.cpu() for part in detector(cloud.points)))
        (out / "results").mkdir(parents=True, exist_ok=True)  # not before the first cloud is read
        write_labels(out / "results" / f"{source.name}.txt", result_rows(found, cloud, detector.classes))
        with (out / "boxes.csv").open("a", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            if k == 0:
                table.writerow(["cloud", "class", "score", "x", "y", "z", "length", "width", "height", "yaw"])
            table.writerows(csv_rows(source.name, found, detector.classes))
        if k < pictures:
            point_range = detector.model.config.encoder.point_range
            path = out / "pictures" / f"{source.name}.png"
            draw_bev(path, cloud.points, point_range, cloud.truth, *found, detector.classes, source.name)
        total += len(found.boxes)
    return total


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m hvnet.detect",
        description="Detects objects in point clouds; writes KITTI result files (results/), all boxes in LiDAR axes"
        " (boxes.csv) and bird's eye views (pictures/).",
        epilog="examples:\n  python -m hvnet.detect cloud.pcd --checkpoint runs/demo/checkpoint.pt\n"
        "  python -m hvnet.detect /data/kitti --split val --checkpoint runs/compact/checkpoint.pt --out val",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "inputs", nargs="+", type=Path, metavar="INPUT", help=f"files ({', '.join(SUFFIXES)}), folders, KITTI roots"
    )
    parser.add_argument("--checkpoint", required=True, type=Path, metavar="FILE", help="of python -m hvnet.train")
    parser.add_argument("--split", help="frames of ImageSets/SPLIT.txt of a KITTI root (default: all frames)")
    parser.add_argument("--out", type=Path, default=Path("detections"), metavar="DIR", help="(default: detections)")
    parser.add_argument("--pictures", type=int, default=20, metavar="N", help="draw the first N clouds (default: 20)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda (default: auto)")
    options = parser.parse_args(arguments)

    if options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        raise InputError(f"{options.out}: is not empty; give another --out")
    detector = load(options.checkpoint, options.device)
    sources = find_sources(options.inputs, options.split)
    total = detect(detector, sources, options.out, options.pictures)
    print(f"{total} boxes in {len(sources)} clouds")
    print(f"results:  {options.out / 'results'}\nboxes:    {options.out / 'boxes.csv'}")
    if options.pictures > 0:
        print(f"pictures: {options.out / 'pictures'}")


if __name__ == "__main__":
    run_command(main)
