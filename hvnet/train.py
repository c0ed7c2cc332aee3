"""Training: `python -m hvnet.train`. Without arguments it trains the demo on generated scenes."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hvnet import ranks
from hvnet.cli import (
    add_changes,
    add_device,
    add_reading,
    add_sensor_height,
    make_parser,
    read_reading,
    read_sensor_height,
    run_command,
)
from hvnet.config import load_config
from hvnet.exceptions import InputError
from hvnet.network.devices import select_device
from hvnet.network.model import HVNet
from hvnet.training.batches import generated_scenes, kitti_data
from hvnet.training.folder import check_folder, check_room
from hvnet.training.run import Run

DEMO = Path(__file__).resolve().parent / "configs" / "demo.yaml"


def choose_out(given: str | None, config: Path, resume: bool) -> Path:
    """The run's folder: the one given, or runs/NAME, runs/NAME-2, ... after the config."""
    if given is not None:
        out = Path(given)
    else:
        names = [Path("runs") / (config.stem if k == 1 else f"{config.stem}-{k}") for k in range(1, 10_000)]
        free = next(k for k, path in enumerate(names) if not path.exists())
        out = names[max(free - 1, 0) if resume else free]
    check_folder(out, resume)
    return out


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "train",
        "Trains HVNet, validates it by KITTI's protocol, and writes checkpoint.pt, metrics.jsonl, tensorboard/, "
        "pictures/ and data.txt (the path of the data) to the run's folder. To train on 8 GPUs, replace python with "
        "torchrun --nproc-per-node 8.",
        [
            "",
            "--config configs/compact.yaml --data /data/kitti --set train.batch_size=2",
            "--out runs/demo --resume",
        ],
    )
    parser.add_argument("--config", type=Path, default=DEMO, metavar="FILE", help="YAML (default: configs/demo.yaml)")
    parser.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: generate scenes)")
    parser.add_argument("--out", metavar="DIR", help="folder of the run (default: runs/NAME of the config)")
    parser.add_argument("--resume", action="store_true", help="continue the run in --out (default: the latest)")
    add_reading(parser)
    add_sensor_height(parser, ", which the checkpoint keeps")
    add_device(parser)
    add_changes(parser, "override a config value, such as train.epochs=3")
    options = parser.parse_args(arguments)

    config = load_config(options.config, options.set)
    reading = read_reading(options, config.data, [entry.name for entry in config.head.classes])
    height = read_sensor_height(options)
    if height == "none":
        raise InputError("--sensor-height none: training moves no cloud; give metres, or leave it out")
    config = replace(config, data=reading if height is None else replace(reading, sensor_height=height))
    device = ranks.start(select_device(options.device))
    out = ranks.broadcast(choose_out(options.out, options.config, options.resume) if ranks.rank() == 0 else None)
    if ranks.rank() == 0:
        check_room(out, HVNet(config))
    root = options.data
    if root is None:
        if config.synthetic is None:
            raise InputError(f"{options.config}: has no key synthetic, so it needs --data with a KITTI root")
        root = ranks.broadcast(generated_scenes(config, out.parent) if ranks.rank() == 0 else None)
    Run(config, kitti_data(root, config), out, device, resume=options.resume).train()
    ranks.stop()  # not after an error: the other ranks are still working, and torchrun ends them


if __name__ == "__main__":
    run_command(main)
