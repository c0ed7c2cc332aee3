"""Figures of clouds, as the paper has them: `python -m hvnet.figures`.

A KITTI frame's camera picture above its bird's eye view, other clouds from above alone; and the pseudo-images of every
projection scale, of one model or of two side by side.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import torch
from tqdm import tqdm

from hvnet.cli import InputError, add_checkpoint, add_device, check_empty, make_parser, run_command
from hvnet.detect import Source, add_inputs, camera_of, find_sources, read_source
from hvnet.detector import Detector, load
from hvnet.draw import FORMATS, Colour, Features, Subject, draw_bev, draw_features, draw_frame


def features_of(detector: Detector, points: torch.Tensor, name: str) -> Features:
    """The pseudo-images that a detector makes of points (N, 4), under the name of its model."""
    config = detector.config.encoder
    points = points.to(detector.device)
    sample = torch.zeros(len(points), dtype=torch.int64, device=detector.device)
    images = [image.to("cpu", torch.float32, copy=True) for image in detector.encode(points, sample, 1)]
    length, width = config.voxel_size
    cells = [(length * scale, width * scale) for scale in config.projection_scales]
    return Features(name, images, cells, config.point_range[:2])


def draw_source(source: Source, detector: Detector, path: Path, colour: Colour) -> torch.Tensor:
    """Writes the figure of a cloud with its labels, if it has any, and detections; returns its points (N, 4)."""
    cloud = read_source(source, detector.classes)
    for note in cloud.notes:
        tqdm.write(note)
    subject = Subject(cloud.points, cloud.truth, *detector(cloud.points), detector.classes)
    point_range, camera = detector.config.encoder.point_range, camera_of(source, cloud)
    if camera is None:
        draw_bev(path, subject, point_range, source.name, colour)
    else:
        draw_frame(path, subject, point_range, camera, source.name, colour)
    return cloud.points


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "figures",
        "Draws clouds with their boxes of score 0.5 or more: of a KITTI frame the image (or, without one, the points "
        "as the camera sees them) above the bird's eye view, of other clouds the latter alone. With --features also "
        "the pseudo-images of every projection scale.",
        [
            "cloud.bin",
            "/data/kitti --split val --format pdf",
            "cloud.bin --features --checkpoint runs/demo/checkpoint.pt",
            "cloud.bin --features --checkpoint with.pt --compare without.pt",
        ],
    )
    add_inputs(parser)
    add_checkpoint(parser)
    parser.add_argument("--features", action="store_true", help="draw pseudo-images, too, as NAME-features")
    parser.add_argument(
        "--compare", type=Path, metavar="FILE", help="a second checkpoint, whose pseudo-images stand beside"
    )
    parser.add_argument("--colour", choices=get_args(Colour), default="height", help="of the points (default: height)")
    parser.add_argument("--out", type=Path, default=Path("figures"), metavar="DIR", help="(default: figures)")
    parser.add_argument("--format", choices=FORMATS, default="png", help="(default: png)")
    add_device(parser)
    options = parser.parse_args(arguments)

    check_empty(options.out)
    if options.compare and not options.features:
        raise InputError("--compare: is for --features; give both")
    sources = find_sources(options.inputs, options.split)
    detector = load(options.checkpoint, options.device)
    models = [(detector, options.checkpoint.stem if options.checkpoint else "shipped weights")]
    if options.compare:
        models.append((load(options.compare, options.device), options.compare.stem))
        if models[0][1] == models[1][1]:  # runs/a/checkpoint.pt and runs/b/checkpoint.pt
            models = [
                (each, str(path)) for (each, _), path in zip(models, (options.checkpoint, options.compare), strict=True)
            ]
    for source in tqdm(sources, desc="drawing", unit="cloud", dynamic_ncols=True):
        points = draw_source(source, detector, options.out / f"{source.name}.{options.format}", options.colour)
        if options.features:
            found = [features_of(each, points, name) for each, name in models]
            draw_features(options.out / f"{source.name}-features.{options.format}", found, source.name)
    print(f"figures: {options.out}")


if __name__ == "__main__":
    run_command(main)
