"""The paper's tables and figures as studies: `python -m hvnet.study NAME` trains the rows, prints both side by side."""

from collections.abc import Sequence
from pathlib import Path

from hvnet.cli import add_changes, add_device, make_parser, run_command
from hvnet.exceptions import InputError
from hvnet.network.devices import select_device
from hvnet.studies.catalogue import STUDIES
from hvnet.studies.study import Options, list_studies, locked, run_study


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "study",
        "Runs a study of the paper: trains its rows and writes a table next to the paper's figures (.md), all rows "
        "(.csv) and a picture (.png). What is done already is kept, so that a study can be stopped and begun again "
        "with the same command.",
        [
            "--list",
            "speed",
            "components --budget steps=600",
            "density --rows lossless limit-8 --validate /data/kitti",
            "components --data /data/kitti --base configs/hvnet.yaml --device cuda",
        ],
    )
    parser.add_argument("name", nargs="?", choices=[*STUDIES], metavar="NAME", help=", ".join(STUDIES))
    parser.add_argument("--list", action="store_true", help="say what each study shows and what it costs")
    parser.add_argument("--data", type=Path, metavar="DIR", help="a KITTI root (default: scenes are generated)")
    parser.add_argument(
        "--validate", type=Path, metavar="DIR", help="a KITTI root whose validation frames score every row, too"
    )
    parser.add_argument(
        "--groups",
        type=Path,
        metavar="FILE",
        help="for the intervals of --validate draw the frames of a drive together; a CSV file: columns frame and drive",
    )
    parser.add_argument("--out", type=Path, default=Path("runs/studies"), metavar="DIR", help="(default: runs/studies)")
    add_device(parser)
    parser.add_argument("--budget", metavar="epochs=N|steps=N", help="length of every training (default: the config's)")
    parser.add_argument("--seeds", type=int, default=2, metavar="N", help="trainings of every row (default: 2)")
    parser.add_argument(
        "--rows", nargs="+", metavar="ROW", help="train only these rows; of the others show what is done already"
    )
    parser.add_argument(
        "--base", type=Path, metavar="FILE", help="config under the rows (default: configs/studies/base.yaml)"
    )
    add_changes(parser, "override a config value in every row")
    options = parser.parse_args(arguments)

    if options.list:
        print(list_studies())
        return
    if options.name is None:
        parser.error("want the NAME of a study, or --list")
    if options.seeds < 1:
        raise InputError(f"--seeds {options.seeds}: want 1 or more")
    data, validate = (path.resolve() if path else None for path in (options.data, options.validate))
    how = Options(
        options.out,
        data,
        validate,
        select_device(options.device),
        options.budget,
        options.seeds,
        options.rows or (),
        options.base,
        options.set,
        options.groups,
    )
    with locked(options.out):
        run_study(options.name, how)


if __name__ == "__main__":
    run_command(main)
