"""Generated street scenes in KITTI's layout: `python -m hvnet.data.synthetic --out DIR`."""

from collections.abc import Sequence
from pathlib import Path

from hvnet.cli import make_parser, run_command
from hvnet.data.scenes.files import generate
from hvnet.data.scenes.street import Options


def main(argv: Sequence[str] | None = None) -> None:
    """Generates scenes from the command line."""
    default = Options()
    parser = make_parser(
        "data.synthetic",
        "Generates street scenes, scanned by a simulated 64-beam LiDAR, in KITTI's layout. Frame k depends on the seed "
        "and on k alone.",
        ["--out scenes", "--out scenes --train 1000 --val 100 --distance 40 --seed 1"],
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="new or empty, or holds these scenes")
    parser.add_argument("--train", type=int, default=200, metavar="N", help="frames to train on (default: 200)")
    parser.add_argument("--val", type=int, default=40, metavar="N", help="frames to validate on (default: 40)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="(default: 0)")
    parser.add_argument(
        "--azimuth",
        type=float,
        default=default.azimuth,
        metavar="DEGREES",
        help=f"scanned to either side of x (default: {default.azimuth:g})",
    )
    parser.add_argument(
        "--distance",
        type=float,
        default=default.distance[1],
        metavar="METRES",
        help=f"to the farthest object (default: {default.distance[1]:g})",
    )
    args = parser.parse_args(argv)
    options = Options(azimuth=args.azimuth, distance=(default.distance[0], args.distance))
    generate(args.out, args.train, args.val, args.seed, options)
    print(f"{args.train + args.val} frames in {args.out}")


if __name__ == "__main__":
    run_command(main)
