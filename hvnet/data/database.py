"""The ground-truth database of a KITTI split: `python -m hvnet.data.database --data KITTI_ROOT`."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hvnet.cli import add_reading, make_parser, read_reading, run_command
from hvnet.data.gt_database import FILE_NAME, build_database, write_database
from hvnet.data.kitti import KittiFrames, read_split
from hvnet.exceptions import InputError


def main(arguments: Sequence[str] | None = None) -> None:
    """Builds the database of a split and writes it."""
    parser = make_parser(
        "data.database",
        "Cuts every labelled object out of a KITTI split: the ground-truth database for augmentation. Training builds "
        "it by itself if the root has none, or if labels or clouds of its frames have changed.",
        ["--data /data/kitti", "--data /data/kitti --split trainval --out trainval.npz"],
    )
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="a KITTI root")
    parser.add_argument("--split", default="train", metavar="NAME", help="of the list in ImageSets (default: train)")
    parser.add_argument("--out", type=Path, metavar="FILE", help=f"(default: {FILE_NAME} in the KITTI root)")
    add_reading(parser)
    options = parser.parse_args(arguments)
    out: Path = options.out or options.data / FILE_NAME
    if out.exists():
        raise InputError(f"{out}: already exists; remove it or name another file with --out")
    if not os.access(out.parent, os.W_OK):  # checked before minutes of work, not after
        raise InputError(f"{out.parent}: not a writable folder; name a file elsewhere with --out")
    names = read_split(options.data, options.split)
    database = build_database(KittiFrames(options.data, names, crop=False, reading=read_reading(options)))
    try:
        write_database(out, database)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror})") from error
    print(f"{out}: {len(database)} objects, {len(database.reflectance)} points")
    for name, count in zip(*np.unique(database.name, return_counts=True), strict=True):
        print(f"{count:8d} {name}")


if __name__ == "__main__":
    run_command(main)
