"""Boxes for clouds: `python -m hvnet.detect`, on files, on folders of files and on KITTI roots.

`--split test` makes a submission for the KITTI server: a zip file that holds one result file for every frame of the
test set in its root (the readme of KITTI's object devkit), checked line by line before it is written.
"""

import argparse
import csv
import math
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from hvnet.cli import InputError, add_checkpoint, add_device, check_empty, make_parser, run_command
from hvnet.data.clouds import SUFFIXES, read_cloud
from hvnet.data.kitti import (
    AT_LIDAR,
    IMAGE_SIZE,
    NO_IMAGE,
    Calibration,
    Labels,
    detections_to_labels,
    has_camera,
    read_frame,
    read_labels,
    read_split,
    write_labels,
)
from hvnet.detector import Detector, load
from hvnet.draw import Camera, Subject, camera_at, draw_bev, draw_frame
from hvnet.evaluate import CLASSES, evaluate, format_table
from hvnet.model import Detections

TEST_FRAMES = 7518
"""Frames 000000 to 007517 are KITTI's test set; its server rejects results with fewer."""


class Source(NamedTuple):
    """One cloud: a file, or a frame of a KITTI root."""

    name: str
    path: Path  # the file, or the root
    split_dir: str | None  # training or testing for a frame of a KITTI root

    def kitti_file(self, folder: str, suffix: str) -> Path | None:
        """The frame's file in a folder of its KITTI root, None if there is none."""
        path = self.path / (self.split_dir or "") / folder / (self.name + suffix)
        return path if self.split_dir is not None and path.is_file() else None


class Cloud(NamedTuple):
    """What a source holds."""

    points: Tensor  # (N, 4)
    truth: Tensor  # (T, 7), none where there are no labels
    calib: Calibration
    image_size: tuple[int, int]  # NO_IMAGE without a camera
    notes: list[str]


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """The clouds that `find_sources` looks for: INPUT and the option --split."""
    parser.add_argument(
        "inputs", nargs="+", type=Path, metavar="INPUT", help=f"files ({', '.join(SUFFIXES)}), folders, KITTI roots"
    )
    parser.add_argument(
        "--split", metavar="NAME", help="frames of ImageSets/NAME.txt of a KITTI root (default: all frames)"
    )


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
    # the test set is all of its folder, and KITTI's own download names its frames nowhere
    if split is not None and (split != "test" or (root / "ImageSets" / "test.txt").is_file()):
        names = read_split(root, split, split_dir=folder, labelled=False)
        return [Source(name, root, folder) for name in names]
    names = sorted(file.stem for file in (root / folder / "velodyne").glob("*.bin"))
    if not names:
        raise InputError(f"{root / folder / 'velodyne'}: holds no .bin file")
    sources = [Source(name, root, folder) for name in names]
    camera = has_camera(root / folder)
    for source in sources:
        if camera and source.kitti_file("calib", ".txt") is None:
            raise InputError(f"{root / folder / 'calib' / source.name}.txt: no such file; each frame wants one")
    return sources


def check_test_set(names: Sequence[str]) -> None:
    """Raises InputError unless these are the frames of KITTI's test set, all of them and no other."""
    wanted = [f"{k:06d}" for k in range(TEST_FRAMES)]
    missing, strange = sorted(set(wanted) - set(names)), sorted(set(names) - set(wanted))
    if missing or strange:
        what = f"{len(missing)} of them are missing, the first is {missing[0]}" if missing else f"not {strange[0]}"
        raise InputError(
            f"--split test: the KITTI server wants the frames {wanted[0]} to {wanted[-1]}; {what}. Give the whole test "
            "set, or --partial for results that cannot be submitted"
        )


def read_source(source: Source, classes: Sequence[str]) -> Cloud:
    """Reads a source; a KITTI frame comes with its calibration, if any, and, where there are labels, the true boxes."""
    if source.split_dir is None:
        points, notes = read_cloud(source.path)
        return Cloud(torch.from_numpy(points), torch.zeros(0, 7), AT_LIDAR, NO_IMAGE, notes)
    labelled = source.kitti_file("label_2", ".txt") is not None
    frame = read_frame(source.path, source.name, source.split_dir, labelled=labelled)
    truth = frame.boxes[[name in classes for name in frame.names]]
    return Cloud(frame.points, truth, frame.calib, frame.image_size, [frame.note] if frame.note else [])


def camera_of(source: Source, cloud: Cloud) -> Camera | None:
    """The camera of a cloud with its image, where there is one; None without a camera."""
    return camera_at(cloud.calib, cloud.image_size, source.kitti_file("image_2", ".png"))


def result_rows(found: Detections, cloud: Cloud, classes: Sequence[str]) -> Labels:
    """The rows of a KITTI result file. Without a camera the 2D boxes are -1, and the axes those of AT_LIDAR.

    Of a box with less than 0.01 pixels in the image nothing is reported: rounded it would have no area.
    """
    names = [classes[label] for label in found.labels.tolist()]
    rows = detections_to_labels(found.boxes, found.scores, names, cloud.calib, cloud.image_size)
    if cloud.image_size == NO_IMAGE:
        return rows
    size = rows.bbox[:, 2:] - rows.bbox[:, :2]
    return rows.select(size.min(axis=1) >= 0.01)


def csv_rows(name: str, found: Detections, classes: Sequence[str]) -> Iterator[list[object]]:
    """Rows of boxes.csv: every box in LiDAR axes."""
    for box, score, label in zip(found.boxes.tolist(), found.scores.tolist(), found.labels.tolist(), strict=True):
        yield [name, classes[label], f"{score:.4f}", *(f"{value:.3f}" for value in box)]


def submission_rows(rows: Labels) -> Labels:
    """The rows that the KITTI server scores: of its classes, with angles that stay in [-pi, pi] when rounded."""
    limit = 3.1415
    rows = replace(rows, alpha=rows.alpha.clip(-limit, limit), rotation_y=rows.rotation_y.clip(-limit, limit))
    return rows.select(np.isin(rows.name, CLASSES))


def check_results(path: Path, image_size: tuple[int, int]) -> None:
    """Raises InputError, naming file and line, if the KITTI server would reject or misread a result file."""
    rows = read_labels(path, scored=True)  # 16 fields, all numbers finite, a known class
    angles = np.abs(np.column_stack((rows.alpha, rows.rotation_y)))
    wrong = {
        "a class that is not scored": ~np.isin(rows.name, CLASSES),
        "a 2D box without area": (rows.bbox[:, 2:] <= rows.bbox[:, :2]).any(axis=1),
        "a 2D box outside the image": ((rows.bbox < 0) | (rows.bbox > np.tile(image_size, 2) - 1)).any(axis=1),
        "a 3D box without volume": (rows.dimensions <= 0).any(axis=1),
        "an angle outside [-pi, pi]": (angles > math.pi).any(axis=1),
    }
    for what, found in wrong.items():
        if found.any():
            raise InputError(f"{path}:{found.argmax() + 1}: {what}; the KITTI server wants none")


def write_submission(path: Path, results: Path) -> None:
    """Packs all result files into the root of a zip file, the same bits for the same results."""
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(results.iterdir()):
            archive.writestr(zipfile.ZipInfo(file.name), file.read_bytes(), zipfile.ZIP_DEFLATED)


def score_results(sources: Sequence[Source], results: Path, classes: Sequence[str]) -> str | None:
    """The table of `hvnet.evaluate` for the result files, None unless every source is a frame with labels."""
    label_files = [file for source in sources if (file := source.kitti_file("label_2", ".txt")) is not None]
    scored = [name for name in CLASSES if name in classes]
    if len(label_files) < len(sources) or not scored:
        return None
    labels = [read_labels(file) for file in label_files]
    predictions = [read_labels(results / f"{source.name}.txt", scored=True) for source in sources]
    return format_table(evaluate(labels, predictions, classes=scored))


def detect(detector: Detector, sources: Sequence[Source], out: Path, pictures: int, submit: bool = False) -> int:
    """Writes results/NAME.txt, boxes.csv and the first few pictures/NAME.png; returns the number of boxes.

    With `submit` the results are made and checked for the KITTI server, and submission.zip is written last.
    """
    total = 0
    for k, source in enumerate(tqdm(sources, desc="detecting", unit="cloud", dynamic_ncols=True)):
        cloud = read_source(source, detector.classes)
        for note in cloud.notes:
            tqdm.write(note)
        found = detector(cloud.points)
        (out / "results").mkdir(parents=True, exist_ok=True)  # not before the first cloud is read
        rows, result_file = result_rows(found, cloud, detector.classes), out / "results" / f"{source.name}.txt"
        write_labels(result_file, submission_rows(rows) if submit else rows)
        if submit:
            check_results(result_file, cloud.image_size)
        with (out / "boxes.csv").open("a", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            if k == 0:
                table.writerow(["cloud", "class", "score", "x", "y", "z", "length", "width", "height", "yaw"])
            table.writerows(csv_rows(source.name, found, detector.classes))
        if k < pictures:
            path, point_range = out / "pictures" / f"{source.name}.png", detector.config.encoder.point_range
            subject = Subject(cloud.points, cloud.truth, *found, detector.classes)
            camera = camera_of(source, cloud)
            if camera is not None and camera.image is not None:
                draw_frame(path, subject, point_range, camera, source.name)
            else:
                draw_bev(path, subject, point_range, source.name)
        total += len(found.boxes)
    if submit:
        write_submission(out / "submission.zip", out / "results")
    return total


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "detect",
        "Detects objects in point clouds; writes KITTI result files (results/), all boxes in LiDAR axes (boxes.csv) "
        "and bird's eye views (pictures/), which KITTI frames have below their image. Where every cloud is a KITTI "
        "frame with labels, the results are scored. --split test writes submission.zip for the KITTI server.",
        [
            "cloud.bin",
            "cloud.pcd --checkpoint runs/demo/checkpoint.pt",
            "clouds/ --pictures 0",
            "/data/kitti --split val --out val",
            "/data/kitti --split test --checkpoint runs/hvnet/checkpoint.pt --out test",
        ],
    )
    add_inputs(parser)
    add_checkpoint(parser)
    parser.add_argument(
        "--partial", action="store_true", help="with --split test: take the frames there are; no submission is written"
    )
    parser.add_argument("--out", type=Path, default=Path("detections"), metavar="DIR", help="(default: detections)")
    parser.add_argument(
        "--pictures",
        type=int,
        default=20,
        metavar="N",
        help="draw the first N clouds, with boxes of score 0.5 or more (default: 20)",
    )
    add_device(parser)
    options = parser.parse_args(arguments)

    check_empty(options.out)
    if options.partial and options.split != "test":
        raise InputError("--partial: is for --split test")
    submit = options.split == "test" and not options.partial
    sources = find_sources(options.inputs, options.split)
    for folder in sorted({source.path / source.split_dir for source in sources if source.split_dir is not None}):
        if not has_camera(folder):
            if submit:
                raise InputError(f"{folder / 'calib'}: no such folder, and the KITTI server wants 2D boxes; add it")
            print(f"{folder}: has no calib, so no camera: every point counts, and there are no 2D boxes")
    if submit:
        check_test_set([source.name for source in sources])
        blind = sum(source.kitti_file("image_2", ".png") is None for source in sources)
        if blind:
            width, height = IMAGE_SIZE
            print(f"{blind} frames have no file in image_2; their 2D boxes are clipped to {width} x {height}")
    detector = load(options.checkpoint, options.device)
    total = detect(detector, sources, options.out, options.pictures, submit)
    if scores := score_results(sources, options.out / "results", detector.classes):
        print(scores + "\n")
    print(f"{total} boxes in {len(sources)} cloud{'s' * (len(sources) != 1)}")
    print(f"results:    {options.out / 'results'}\nboxes:      {options.out / 'boxes.csv'}")
    if options.pictures > 0:
        print(f"pictures:   {options.out / 'pictures'}")
    if submit:
        print(f"submission: {options.out / 'submission.zip'}")
    elif options.split == "test":
        print(f"no submission: --partial was given, and the KITTI server wants {TEST_FRAMES} frames")


if __name__ == "__main__":
    run_command(main)
