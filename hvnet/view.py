"""Clouds, labels and detections in the browser: `python -m hvnet.view`."""

import importlib.util
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

from hvnet.cli import (
    add_checkpoint,
    add_device,
    add_mount,
    add_overlaps,
    add_reading,
    make_parser,
    read_mount,
    read_overlaps,
    read_reading,
    run_command,
)
from hvnet.data.clouds import SUFFIXES
from hvnet.data.scenes.files import generate
from hvnet.data.scenes.street import Options
from hvnet.data.sources import find_frames
from hvnet.evaluation.rules import config_rules
from hvnet.exceptions import InputError
from hvnet.network.detector import load
from hvnet.pictures.viewer import Viewer, start_server
from hvnet.training.folder import find_run

DEMO_FRAMES = 4


def choose_data(
    given: Path | None, root: Path | None, checkpoint: Path | str | None
) -> tuple[Path | None, Path | str | None]:
    """The clouds, None for generated scenes, and the checkpoint, None for the package's default, of the given input.

    Raises InputError for options that exclude each other.
    """
    if given is not None and (given / "checkpoint.pt").is_file():
        if checkpoint is not None:
            raise InputError(f"--checkpoint, --weights: the run {given} has its own weights; leave one of them out")
        return root or find_run(given).root, given / "checkpoint.pt"
    if root is not None:
        raise InputError("--data: only for the folder of a run, which holds checkpoint.pt; give the root as INPUT")
    return given, checkpoint


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "view",
        "Shows clouds in the browser, with labels, detections and what the detector gets wrong. Without INPUT it shows "
        "generated scenes. For clouds on another machine: ssh -L 8080:localhost:8080 MACHINE, and this command there.",
        [
            "",
            "cloud.pcd",
            "clouds/ --checkpoint runs/demo/checkpoint.pt",
            "/data/kitti --split val",
            "runs/compact --data /data/kitti --split val",
        ],
    )
    parser.add_argument(
        "input",
        nargs="?",
        type=Path,
        metavar="INPUT",
        help=f"a file ({', '.join(SUFFIXES)}), a folder of them, a KITTI root, or a run of python -m hvnet.train",
    )
    add_checkpoint(parser)
    parser.add_argument("--data", type=Path, metavar="DIR", help="for a run: a KITTI root (default: that of the run)")
    parser.add_argument("--split", metavar="NAME", help="frames of ImageSets/NAME.txt of a KITTI root (default: all)")
    parser.add_argument("--port", type=int, default=8080, metavar="N", help="or the next that is free (default: 8080)")
    parser.add_argument("--host", default="127.0.0.1", metavar="NAME", help="address to listen at (default: 127.0.0.1)")
    add_reading(parser)
    add_mount(parser)
    add_overlaps(parser)
    add_device(parser)
    options = parser.parse_args(arguments)

    if importlib.util.find_spec("viser") is None:
        raise InputError("the viewer needs viser: pip install 'hvnet[view]' (from a clone: pip install -e '.[view]')")
    data, checkpoint = choose_data(options.input, options.data, options.checkpoint)
    with tempfile.TemporaryDirectory() as folder:
        detector = load(checkpoint, options.device, **read_mount(options))
        if data is None:
            data = Path(folder)
            distance = (4.0, min(detector.config.encoder.point_range[3] - 2, 80.0))
            generate(data, 0, DEMO_FRAMES, seed=1, options=Options(distance=distance))
        reading = read_reading(options, detector.config.data, detector.classes)
        frames = find_frames([data], options.split, reading, crop=not options.all_round)
        rules = config_rules(detector.config, read_overlaps(options.overlap, detector.classes))
        server = start_server(options.host, options.port)
        try:
            viewer = Viewer(server, detector, frames, rules)
            print(f"http://{options.host}:{server.get_port()}  (Ctrl-C ends it)", flush=True)
            viewer.search()
            threading.Event().wait()
        finally:
            server.stop()


if __name__ == "__main__":
    run_command(main)
