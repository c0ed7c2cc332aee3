"""Boxes for clouds: `python -m hvnet.detect`, on files, on folders of files and on KITTI roots.

`--split test` makes a submission for the KITTI server: a zip file that holds one result file for every frame of the
test set in its root (the readme of KITTI's object devkit), checked line by line before it is written.
"""

import csv
import math
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from hvnet.cli import (
    add_bootstrap,
    add_checkpoint,
    add_device,
    add_inputs,
    add_mount,
    add_overlaps,
    add_reading,
    make_parser,
    read_bootstrap,
    read_mount,
    read_overlaps,
    read_reading,
    run_command,
)
from hvnet.data.clouds import SUFFIXES
from hvnet.data.frame import IMAGE_SIZE, Frame, Frames
from hvnet.data.kitti import IMAGES, KittiFrames, find_file, frame_labels, has_camera, read_labels, write_labels
from hvnet.data.labels import Labels
from hvnet.data.sensor import summary
from hvnet.data.sources import find_frames
from hvnet.evaluation.bootstrap import Resampling
from hvnet.evaluation.precision import evaluate
from hvnet.evaluation.rules import KITTI, Rule, config_rules
from hvnet.evaluation.scoring import background_note, detect_frames, look_at, print_once
from hvnet.evaluation.tables import format_table
from hvnet.exceptions import InputError
from hvnet.folders import check_empty
from hvnet.network.detector import Detector, load
from hvnet.network.model import Detections
from hvnet.pictures.clouds import Subject, draw_bev, draw_frame

TEST_FRAMES = 7518
"""Frames 000000 to 007517 are KITTI's test set; its server rejects results with fewer."""


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


def result_rows(rows: Labels, frame: Frame) -> Labels:
    """The rows of a result file: of a box with less than 0.01 pixels in the image nothing is reported.

    Rounded it would have no area. Without a camera there are no 2D boxes.
    """
    if frame.camera is None:
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
    return rows.select(np.isin(rows.name, [*KITTI]))


def check_results(path: Path, image_size: tuple[int, int]) -> None:
    """Raises InputError, naming file and line, if the KITTI server would reject or misread a result file."""
    rows = read_labels(path, scored=True)  # 16 fields, all numbers finite, a known class
    angles = np.abs(np.column_stack((rows.alpha, rows.rotation_y)))
    wrong = {
        "a class that is not scored": ~np.isin(rows.name, [*KITTI]),
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


def detect(
    detector: Detector,
    frames: Frames,
    out: Path,
    pictures: int,
    submit: bool = False,
    *,
    verbose: bool = False,
    seen: set[str] | None = None,
) -> tuple[int, dict[str, Labels]]:
    """Writes results/NAME.txt, boxes.csv and the first few pictures/NAME.png.

    Prints what was seen of all clouds, of every cloud if `verbose`, and notes that are not in `seen`. Returns the
    number of boxes, and the labels of the frames that have any, by name. With `submit` the results are made and checked
    for the KITTI server, and submission.zip is written last.
    """
    total, truths, looks, reflectances = 0, {}, [], []
    bar = tqdm(range(len(frames)), desc="detecting", unit="cloud", dynamic_ncols=True)
    for k, frame, found, every in detect_frames(detector, frames, bar, seen):
        (out / "results").mkdir(parents=True, exist_ok=True)  # not before the first cloud is read
        looks.append(look := look_at(detector, frame))
        reflectances.append(frame.reflectance)
        if verbose:
            parts = (frame.in_view, look.text(), frame.reflectance)
            tqdm.write(f"{frame.name}: {'; '.join(filter(None, parts))}")
        rows, result_file = result_rows(every, frame), out / "results" / f"{frame.name}.txt"
        write_labels(result_file, submission_rows(rows) if submit else rows)
        if submit:
            check_results(result_file, frame.camera.size if frame.camera else IMAGE_SIZE)
        with (out / "boxes.csv").open("a", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            if k == 0:
                table.writerow(["cloud", "class", "score", "x", "y", "z", "length", "width", "height", "yaw"])
            table.writerows(csv_rows(frame.name, found, detector.classes))
        if k < pictures:
            with_image = frame.camera is not None and frame.camera.image is not None
            picture = draw_frame if with_image else draw_bev
            subject = Subject(frame, found, detector.classes)
            picture(out / "pictures" / f"{frame.name}.png", subject, detector.seen_range(look.shift), frame.name)
        if frame.objects is not None:
            truths[frame.name] = frame_labels(frame)
        total += len(found.boxes)
    if submit:
        write_submission(out / "submission.zip", out / "results")
    tqdm.write(f"clouds:     {summary(looks, reflectances)}")
    return total, truths


def print_scores(
    detector: Detector,
    frames: Frames,
    truths: dict[str, Labels],
    results: Path,
    rules: dict[str, Rule],
    resampling: Resampling | None,
) -> None:
    """Scores the results of the frames that have labels, and says which have none."""
    names = [name for name in frames.names if name in truths]
    if names:
        written = [read_labels(results / f"{name}.txt", scored=True) for name in names]
        labels = [truths[name] for name in names]
        table = evaluate(labels, written, classes=detector.classes, rules=rules, resampling=resampling)
        print(format_table(table) + "\n")
        if without := [name for name in frames.names if name not in truths]:
            shown = ", ".join(without[:5]) + (", ..." if len(without) > 5 else "")
            print(f"{len(names)} of {len(frames)} frames are scored; no labels: {shown}")
    if note := background_note((str(name) for truth in truths.values() for name in truth.name), detector.classes):
        print(note)


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "detect",
        "Detects objects in point clouds; writes KITTI result files (results/), all boxes in LiDAR axes (boxes.csv) "
        "and bird's eye views (pictures/), which KITTI frames have below their image. The results of KITTI frames with "
        "labels are scored. --split test writes submission.zip for the KITTI server. docs/sensors.md has the options "
        "for clouds of other sensors.",
        [
            "cloud.bin",
            "nuscenes/ --all-round --turn -90",
            "cloud.pcd --checkpoint runs/demo/checkpoint.pt",
            "clouds/ --weights compact",
            "clouds/ --pictures 0 --tta",
            "/data/kitti --split val --out val",
            "/data/kitti --split val --out val --bootstrap 1000 --groups drives.csv",
            "/data/kitti --split test --checkpoint runs/hvnet/checkpoint.pt --out test",
        ],
    )
    add_inputs(parser, SUFFIXES)
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
    parser.add_argument("--verbose", action="store_true", help="say of every cloud what was found out about it")
    add_reading(parser)
    add_mount(parser)
    parser.add_argument(
        "--tta",
        action="store_true",
        help="see clouds turned a little and mirrored as well and average the boxes: better, in 4 times the time",
    )
    add_overlaps(parser)
    add_bootstrap(parser)
    add_device(parser)
    options = parser.parse_args(arguments)

    check_empty(options.out)
    if options.partial and options.split != "test":
        raise InputError("--partial: is for --split test")
    submit = options.split == "test" and not options.partial
    detector = load(options.checkpoint, options.device, **read_mount(options), tta=options.tta)
    reading = read_reading(options, detector.config.data, detector.classes)
    # looking all round wants the whole cloud, not what a camera sees
    frames = find_frames(options.inputs, options.split, reading, crop=not options.all_round)
    roots = [part for part in frames.parts if isinstance(part, KittiFrames)]
    for folder in sorted({part.folder for part in roots}):
        if not has_camera(folder):
            if submit:
                raise InputError(f"{folder / 'calib'}: no such folder, and the KITTI server wants 2D boxes; add it")
            print(f"{folder}: has no calib, so no camera: every point counts, and there are no 2D boxes")
    if submit:
        check_test_set(frames.names)
        blind = sum(not find_file(part.folder / "image_2", n, *IMAGES).is_file() for part in roots for n in part.names)
        if blind:
            width, height = IMAGE_SIZE
            print(f"{blind} frames have no file in image_2; their 2D boxes are clipped to {width} x {height}")
    rules = config_rules(detector.config, read_overlaps(options.overlap, detector.classes))
    seen: set[str] = set()  # what was printed
    # labels are looked at before minutes of work, and stop none of it
    labels = {part.names[k]: part.labels(k) for part in roots for k in range(len(part))}
    print_once((note for _, note in labels.values()), seen)
    resampling = read_bootstrap(options, [name for name, (rows, _) in labels.items() if rows is not None])
    total, truths = detect(detector, frames, options.out, options.pictures, submit, verbose=options.verbose, seen=seen)
    print_scores(detector, frames, truths, options.out / "results", rules, resampling)
    print(f"{total} boxes in {len(frames)} cloud{'s' * (len(frames) != 1)}")
    print(f"results:    {options.out / 'results'}\nboxes:      {options.out / 'boxes.csv'}")
    if options.pictures > 0:
        print(f"pictures:   {options.out / 'pictures'}")
    if submit:
        print(f"submission: {options.out / 'submission.zip'}")
    elif options.split == "test":
        print(f"no submission: --partial was given, and the KITTI server wants {TEST_FRAMES} frames")


if __name__ == "__main__":
    run_command(main)
