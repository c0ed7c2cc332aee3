"""A trained model for deployment: `python -m hvnet.export` writes what other programs run."""

import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path

from hvnet.cli import add_checkpoint, make_parser, run_command
from hvnet.exceptions import InputError
from hvnet.folders import check_empty
from hvnet.network.checkpoint import find_checkpoint, load_checkpoint, model_from_checkpoint
from hvnet.network.export import describe, is_program, write_onnx, write_program


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "export",
        "Writes a trained model for deployment: backbone_heads.onnx (pseudo-images to the heads' maps), detector.pt2 "
        "(points to the heads' maps, a program of torch.export) and meta.json (anchors, thresholds). docs/deploy.md "
        "says how to run them.",
        ["", "--checkpoint runs/demo/checkpoint.pt --out deploy/demo", "--batch 4 --out deploy/four"],
    )
    add_checkpoint(parser)
    parser.add_argument("--out", type=Path, default=Path("export"), metavar="DIR", help="(default: export)")
    parser.add_argument(
        "--batch",
        type=int,
        default=1,
        metavar="N",
        help="clouds that detector.pt2 takes at a time; the ONNX file takes any number (default: 1)",
    )
    options = parser.parse_args(arguments)
    if options.batch < 1:
        raise InputError(f"--batch {options.batch}: want 1 or more")
    if importlib.util.find_spec("onnx") is None:
        raise InputError("the package onnx is missing, without which torch writes no ONNX file: pip install onnx")
    check_empty(options.out)

    path = find_checkpoint(options.checkpoint)
    model = model_from_checkpoint(load_checkpoint(path), str(path))
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{options.out}: cannot be made a folder ({error.strerror}); give another --out") from error
    meta = options.out / "meta.json"
    meta.write_text(json.dumps(describe(model.config, options.batch), indent=2) + "\n", encoding="utf-8")
    print(f"meta:    {meta}")
    write_onnx(model, options.out / "backbone_heads.onnx")
    print(f"ONNX:    {options.out / 'backbone_heads.onnx'}")
    if is_program(model):
        write_program(model, options.out / "detector.pt2", options.batch)
        print(f"program: {options.out / 'detector.pt2'}")
    else:
        print("program: none; torch.export cannot take an encoder that drops points")


if __name__ == "__main__":
    run_command(main)
