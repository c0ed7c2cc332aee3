"""Retrains the weights of the package: `python -m hvnet.weights --data KITTI_ROOT`.

It trains configs/compact.yaml by the recipe below and writes the result in half precision. The root is the part of
KITTI that docs/model_card.md names: 23 whole frames, and the objects of all 3712 training frames in gt_database.npz.
"""

from collections.abc import Sequence
from pathlib import Path

import torch

from hvnet.cli import add_device, make_parser, run_command
from hvnet.config import load_config
from hvnet.data.gt_database import FILE_NAME
from hvnet.exceptions import InputError
from hvnet.network.checkpoint import load_checkpoint, save_checkpoint
from hvnet.network.devices import select_device
from hvnet.network.model import HVNet
from hvnet.training.batches import kitti_data
from hvnet.training.folder import check_folder, check_room
from hvnet.training.run import Run

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "compact.yaml"
RECIPE = (
    "train.epochs=32",
    "train.repeat=20",
    "train.batch_size=2",
    "train.learning_rate=3.0e-3",
    "train.warmup_steps=200",
    "train.cosine=true",
    "train.bfloat16=true",
    "train.validate_every=4",
    "augment.mix=0.5",
    "augment.whole_frames=0.2",
)
"""Changes to the config; docs/training.md gives the reasons."""


def halve(checkpoint: Path, out: Path) -> None:
    """Writes config and weights of a checkpoint, the parameters in half precision.

    Running statistics stay in float32: the variances of the encoder's output overflow float16.
    """
    content = load_checkpoint(checkpoint)
    running = ("running_mean", "running_var", "num_batches_tracked")
    model = {
        name: value if name.endswith(running) else value.to(torch.float16) for name, value in content["model"].items()
    }
    facts = {"sensor": content["sensor"]} if "sensor" in content else {}
    save_checkpoint(out, {"config": content["config"], "model": model} | facts)


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "weights",
        "Retrains the weights of the package: trains configs/compact.yaml by a fixed recipe and writes the "
        "result in half precision. The root is the part of KITTI that docs/model_card.md names: 23 whole frames, and "
        "the objects of all 3712 training frames in gt_database.npz.",
        ["--data /data/kitti", "--data /data/kitti --resume"],
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="a KITTI root with gt_database.npz")
    parser.add_argument("--run", type=Path, default=Path("runs/weights"), metavar="DIR", help="(default: runs/weights)")
    parser.add_argument("--out", type=Path, default=Path("compact.pt"), metavar="FILE", help="(default: compact.pt)")
    parser.add_argument("--resume", action="store_true", help="continue a run that was stopped")
    add_device(parser)
    options = parser.parse_args(arguments)
    if not (options.data / FILE_NAME).is_file():
        raise InputError(f"{options.data / FILE_NAME}: no such file; other objects would make other weights")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    config = load_config(CONFIG, RECIPE)
    check_folder(options.run, options.resume)
    check_room(options.run, HVNet(config))
    data = kitti_data(options.data, config)
    Run(config, data, options.run, select_device(options.device), resume=options.resume).train()
    halve(options.run / "checkpoint.pt", options.out)
    print(f"weights:    {options.out} ({options.out.stat().st_size / 1e6:.2f} MB)")


if __name__ == "__main__":
    run_command(main)
