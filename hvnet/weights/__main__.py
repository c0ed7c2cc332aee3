"""Makes weights of the package anew: `python -m hvnet.weights --data KITTI_ROOT [--name NAME]`.

It trains by the recipe NAME.yaml of this folder, calibrates the scores in the training frames as they are, and writes
the result in half precision. The root is the part of KITTI that docs/model_card.md names, with the objects of all 3712
training frames in gt_database.npz.
"""

from collections.abc import Sequence
from pathlib import Path

import torch
import warp as wp

from hvnet import __version__, ranks
from hvnet.cli import add_device, make_parser, run_command
from hvnet.config import load_config
from hvnet.data.gt_database import FILE_NAME
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import DEFAULT, load_checkpoint, save_checkpoint
from hvnet.network.detector import load
from hvnet.network.devices import device_name, select_device
from hvnet.network.model import HVNet
from hvnet.training.batches import kitti_data
from hvnet.training.calibration import calibrate
from hvnet.training.folder import check_folder, check_room
from hvnet.training.run import Run, deterministic

RECIPES = Path(__file__).resolve().parent


def describe(run: Run) -> dict[str, str | int]:
    """What the bits of a run depend on besides its config and its data, and a little of these."""
    return {
        "hvnet": __version__,
        "torch": str(torch.__version__),
        "warp-lang": wp.__version__,
        "processor": device_name(run.device),
        "processes": ranks.size(),
        "threads": torch.get_num_threads(),
        "seed": run.config.train.seed,
        "frames": len(run.data.train),
    }


def halve(checkpoint: Path, out: Path, made_by: dict[str, str | int], shifts: Sequence[float]) -> None:
    """Writes config and weights of a checkpoint, the parameters in half precision, and what made them.

    shifts: of the logits of every class, which `calibrate` found.

    Running statistics stay in float32: the variances of the encoder's output overflow float16.
    """
    content = load_checkpoint(checkpoint)
    for label, shift in enumerate(shifts):
        content["model"][f"heads.{label}.score.bias"] += shift
    running = ("running_mean", "running_var", "num_batches_tracked")
    model = {
        name: value if name.endswith(running) else value.to(torch.float16) for name, value in content["model"].items()
    }
    facts = {"sensor": content["sensor"]} if "sensor" in content else {}
    save_checkpoint(out, {"config": content["config"], "model": model, "made_by": made_by} | facts)


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "weights",
        "Makes weights of the package anew: trains by a recipe, calibrates the scores in the training frames as they "
        "are, and writes the result in half precision. The root is the part of KITTI that docs/model_card.md names, "
        "with the objects of all 3712 training frames in gt_database.npz. "
        "For two processes that train together, replace python with torchrun --nproc-per-node 2.",
        ["--data /data/kitti", "--data /data/kitti --resume"],
    )
    names = sorted(path.stem for path in RECIPES.glob("*.yaml"))
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="a KITTI root with gt_database.npz")
    parser.add_argument(
        "--name", choices=names, default=DEFAULT, help=f"the recipe: {', '.join(names)} (default: {DEFAULT})"
    )
    parser.add_argument("--run", type=Path, metavar="DIR", help="folder of the run (default: runs/weights/NAME)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="(default: NAME.pt)")
    parser.add_argument("--resume", action="store_true", help="continue a run that was stopped")
    add_device(parser)
    options = parser.parse_args(arguments)
    if not (options.data / FILE_NAME).is_file():
        raise InputError(f"{options.data / FILE_NAME}: no such file; other objects would make other weights")
    folder = options.run or Path("runs") / "weights" / options.name
    out = options.out or Path(f"{options.name}.pt")
    config = load_config(RECIPES / f"{options.name}.yaml")
    device = ranks.start(select_device(options.device))
    if ranks.rank() == 0:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_folder(folder, options.resume)
        check_room(folder, HVNet(config))
    ranks.broadcast(None)  # nothing is written before the folder was looked at
    run = Run(config, kitti_data(options.data, config), folder, device, resume=options.resume)
    run.train()
    if ranks.rank() == 0:
        print(f"calibrating in the {len(run.data.train)} training frames; if it is stopped, --resume begins it again")
        detector = load(run.checkpoint, str(device), dtype=torch.float32)
        with deterministic():
            shifts = calibrate(detector, run.data.train)
        moved = ", ".join(f"{name} {shift:+.4f}" for name, shift in zip(detector.classes, shifts, strict=True))
        halve(run.checkpoint, out, describe(run) | {"shifts": moved}, shifts)
        print(f"logits:     {moved}")
        print(f"weights:    {out} ({out.stat().st_size / 1e6:.2f} MB)")
    ranks.broadcast(None)  # the others wait until it is written
    ranks.stop()  # not after an error, as in hvnet.train


if __name__ == "__main__":
    run_command(main)
