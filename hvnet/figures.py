"""Figures of clouds, as the paper has them: `python -m hvnet.figures`.

A KITTI frame's camera picture above its bird's eye view, other clouds from above alone; and the pseudo-images of every
projection scale, of one model or of two side by side.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from tqdm import tqdm

from hvnet.cli import (
    add_checkpoint,
    add_device,
    add_inputs,
    add_mount,
    add_reading,
    make_parser,
    read_mount,
    read_reading,
    run_command,
)
from hvnet.data.clouds import SUFFIXES
from hvnet.data.frame import Frame
from hvnet.data.sensor import summary
from hvnet.data.sources import find_frames
from hvnet.evaluation.scoring import detect_frames, look_at
from hvnet.exceptions import InputError
from hvnet.folders import check_empty
from hvnet.network.checkpoint import find_checkpoint
from hvnet.network.detector import Detector, load
from hvnet.network.model import Detections
from hvnet.pictures.clouds import FORMATS, Colour, Subject, draw_bev, draw_frame
from hvnet.pictures.features import draw_features, features_of


def draw(frame: Frame, found: Detections, detector: Detector, shift: float, path: Path, colour: Colour) -> None:
    """Writes the figure of a frame, seen raised by `shift` metres, with its labels, if it has any, and detections."""
    picture = draw_bev if frame.camera is None else draw_frame
    picture(path, Subject(frame, found, detector.classes), detector.seen_range(shift), frame.name, colour)


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
    add_inputs(parser, SUFFIXES)
    add_checkpoint(parser)
    parser.add_argument("--features", action="store_true", help="draw pseudo-images, too, as NAME-features")
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="FILE",
        help="a second checkpoint; its pseudo-images are drawn next to those of the first",
    )
    parser.add_argument("--colour", choices=get_args(Colour), default="height", help="of the points (default: height)")
    parser.add_argument("--out", type=Path, default=Path("figures"), metavar="DIR", help="(default: figures)")
    parser.add_argument("--format", choices=FORMATS, default="png", help="(default: png)")
    add_reading(parser)
    add_mount(parser)
    add_device(parser)
    options = parser.parse_args(arguments)

    check_empty(options.out)
    if options.compare and not options.features:
        raise InputError("--compare: is for --features; give both")
    detector = load(options.checkpoint, options.device, **read_mount(options))
    reading = read_reading(options, detector.config.data, detector.classes)
    frames = find_frames(options.inputs, options.split, reading, crop=not options.all_round)
    if options.features and (clash := set(frames.names) & {f"{name}-features" for name in frames.names}):
        name = min(clash)
        raise InputError(f"{name}: has the name of the features of {name.removesuffix('-features')}; rename one")
    models = [(detector, find_checkpoint(options.checkpoint).stem)]
    if options.compare:
        models.append((load(options.compare, options.device, **read_mount(options)), options.compare.stem))
        if models[0][1] == models[1][1]:  # runs/a/checkpoint.pt and runs/b/checkpoint.pt
            models = [
                (each, str(find_checkpoint(path)))
                for (each, _), path in zip(models, (options.checkpoint, options.compare), strict=True)
            ]
    bar = tqdm(range(len(frames)), desc="drawing", unit="cloud", dynamic_ncols=True)
    looks, reflectances = [], []
    for _, frame, found, _ in detect_frames(detector, frames, bar):
        looks.append(look := look_at(detector, frame))
        reflectances.append(frame.reflectance)
        draw(frame, found, detector, look.shift, options.out / f"{frame.name}.{options.format}", options.colour)
        if options.features:
            features = [features_of(each, each.place(frame.points).clouds[0], name) for each, name in models]
            draw_features(options.out / f"{frame.name}-features.{options.format}", features, frame.name)
    print(f"clouds:  {summary(looks, reflectances)}\nfigures: {options.out}")


if __name__ == "__main__":
    run_command(main)
