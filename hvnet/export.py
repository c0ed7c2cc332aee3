"""A trained model for deployment: `python -m hvnet.export` writes what other programs run."""

import importlib.util
import json
import shlex
from argparse import Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from hvnet.cli import add_checkpoint, make_parser, run_command
from hvnet.exceptions import InputError
from hvnet.folders import check_empty
from hvnet.network.checkpoint import find_checkpoint, load_checkpoint, model_from_checkpoint
from hvnet.network.detector import load
from hvnet.network.export import describe, dropped_points, write_detector, write_onnx, write_program
from hvnet.network.model import HVNet
from hvnet.network.page import fetch_runtime, write_page

SERVE = "python -m http.server --bind 127.0.0.1 --directory"


def main(arguments: Sequence[str] | None) -> None:
    """The command."""
    parser = make_parser(
        "export",
        "Writes a trained model for deployment: detector.onnx (points to boxes), backbone_heads.onnx (pseudo-images to "
        "the heads' maps), detector.pt2 (points to the heads' maps, a program of torch.export) and meta.json (classes, "
        "anchors, thresholds). docs/deploy.md says how to run them.",
        [
            "",
            "--checkpoint runs/demo/checkpoint.pt --out deploy/demo",
            "--page --out page",
            "--without-nms",
            "--batch 4 --out deploy/four",
        ],
    )
    add_checkpoint(parser)
    parser.add_argument("--out", type=Path, default=Path("export"), metavar="DIR", help="(default: export)")
    parser.add_argument(
        "--without-nms", action="store_true", help="detector.onnx gives the candidates that go into NMS"
    )
    parser.add_argument(
        "--without-encoder",
        action="store_true",
        help="writes backbone_heads.onnx and meta.json alone, as is possible with every encoder",
    )
    parser.add_argument(
        "--batch",
        type=int,
        default=1,
        metavar="N",
        help="clouds that detector.pt2 takes at a time; backbone_heads.onnx takes any number, detector.onnx one "
        "(default: 1)",
    )
    parser.add_argument(
        "--page",
        action="store_true",
        help="writes a folder to serve instead: a page that detects in a browser, detector.onnx, meta.json and the "
        "runtime, which npm gets",
    )
    options = parser.parse_args(arguments)
    if options.batch < 1:
        raise InputError(f"--batch {options.batch}: want 1 or more")
    if options.without_encoder and options.without_nms:
        raise InputError("--without-nms: there is no detector.onnx with --without-encoder; leave one of them out")
    if options.page and (options.without_encoder or options.without_nms):
        raise InputError("--page: wants detector.onnx to give boxes; leave --without-encoder and --without-nms out")
    if options.batch != 1 and (options.page or options.without_encoder):
        raise InputError(
            f"--batch {options.batch}: is of detector.pt2, which --page and --without-encoder do not write"
        )
    if importlib.util.find_spec("onnx") is None:
        raise InputError("the package onnx is missing, without which torch writes no ONNX file: pip install onnx")
    check_empty(options.out)

    path = find_checkpoint(options.checkpoint)
    model = model_from_checkpoint(load_checkpoint(path), str(path))
    drops = dropped_points(model.config)
    if drops and not options.without_encoder:
        raise InputError(
            f"{path}: cannot be exported from points on, since with {drops} it drops some of them; --without-encoder "
            "writes what comes after its encoder"
        )
    runtime = fetch_runtime() if options.page else {}
    try:
        options.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{options.out}: cannot be made a folder ({error.strerror}); give another --out") from error
    try:
        write(options, path, model, runtime)
    except OSError as error:
        for written in options.out.iterdir():
            written.unlink()
        raise InputError(
            f"{options.out}: cannot be written ({error.strerror}); make room, or give another --out"
        ) from error


def write(options: Namespace, path: Path, model: HVNet, runtime: Mapping[str, bytes]) -> None:
    """Writes what the options ask for of a model, the checkpoint at a path, and says so file by file."""
    out = options.out
    content = describe(model.config, options.batch)
    (out / "meta.json").write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    print(f"meta:     {out / 'meta.json'}")
    if not options.without_encoder:
        write_detector(load(path, "cpu", dtype=torch.float32), out / "detector.onnx", not options.without_nms)
        print(f"detector: {out / 'detector.onnx'}")
    if options.page:
        write_page(out, runtime)
        print(f"page:     {out / 'index.html'}; to serve it: {SERVE} {shlex.quote(str(out))}")
        return
    write_onnx(model, out / "backbone_heads.onnx")
    print(f"backbone: {out / 'backbone_heads.onnx'}")
    if not options.without_encoder:
        write_program(model, out / "detector.pt2", options.batch)
        print(f"program:  {out / 'detector.pt2'}")


if __name__ == "__main__":
    run_command(main)
