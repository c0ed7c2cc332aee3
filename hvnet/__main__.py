"""`hvnet COMMAND` and `python -m hvnet COMMAND` do what `python -m hvnet.COMMAND` does; alone they list commands."""

import difflib
import importlib
import sys

from hvnet import __version__
from hvnet.cli import run_command

COMMANDS = {
    "detect": "boxes for clouds",
    "train": "train and validate; without arguments the demo, on generated scenes",
    "evaluate": "score KITTI result files of any detector",
    "figures": "draw clouds, labels, detections and pseudo-images",
    "mistakes": "a page of the worst misses and false positives",
    "view": "look at clouds, labels and mistakes in the browser",
    "export": "write ONNX and torch.export files for other programs",
    "study": "rerun the paper's tables and figures",
    "data.synthetic": "generate street scenes in KITTI's layout",
    "data.database": "cut the labelled objects out of a KITTI split",
    "weights": "make the weights of the package anew",
}


def overview() -> str:
    """The list of commands."""
    lines = ["HVNet detects objects in LiDAR clouds. Commands, each with --help:", ""]
    lines += [f"  hvnet {command:<15} {does}" for command, does in COMMANDS.items()]
    return "\n".join([*lines, "", "`python -m hvnet.COMMAND` does the same."])


def main() -> None:
    """Runs the command that the arguments begin with. A wrong one ends with exit code 2."""
    name, *arguments = sys.argv[1:] or ["--help"]
    if name in ("-h", "--help"):
        print(overview())
    elif name == "--version":
        print(f"hvnet {__version__}")
    elif name in COMMANDS:
        module = importlib.import_module("hvnet.weights.__main__" if name == "weights" else f"hvnet.{name}")
        run_command(lambda _: module.main(arguments))
    else:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(COMMANDS)}"
        print(f"hvnet: error: no command {name}; {hint}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
