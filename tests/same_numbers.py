"""Whether a change left every number as it was: run it in a checkout before and in one after, on one machine.

    python tests/same_numbers.py DATA before.json
    python tests/same_numbers.py DATA after.json --compare before.json

DATA holds `kitti/`, a KITTI root with the splits train_first and val_first, and `kitti_val_results/`. It uses commands
alone, so that it runs with versions whose insides differ. Runs take one thread: the bits depend on their number.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any


def run(*arguments: object) -> str:
    """Runs a command of the package; returns what it prints."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    command = [sys.executable, "-m", *map(str, arguments)]
    return subprocess.run(command, check=True, capture_output=True, text=True, env=environment).stdout


def metrics(folder: Path) -> list[Any]:
    """The lines of a run's metrics.jsonl."""
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text(encoding="utf-8").splitlines()]


def digest(files: list[Path]) -> str:
    """One hash of the content of files, in their order."""
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def collect(data: Path, work: Path) -> dict[str, Any]:
    """Every number, by name."""
    kitti, numbers = data / "kitti", {}
    run("hvnet.train", "--out", work / "demo", "--set", "train.epochs=2", "--set", "train.validate_every=2")
    numbers["demo, two epochs"] = metrics(work / "demo")
    for split in ("train_first", "val_first"):
        out = work / split
        run("hvnet.detect", kitti, "--split", split, "--out", out, "--pictures", 0)
        numbers[f"boxes of {split}"] = digest([out / "boxes.csv"])
        numbers[f"results of {split}"] = digest(sorted((out / "results").iterdir()))
    real = ["--data", kitti, "--config", "configs/compact.yaml"]
    for change in ("train_split=train_first", "val_split=val_first", "batch_size=2", "validate_every=1", "epochs=2"):
        real += ["--set", f"train.{change}"]
    run("hvnet.train", *real, "--out", work / "real")
    numbers["two epochs on real frames"] = metrics(work / "real")
    run("hvnet.train", *real, "--set", "train.epochs=1", "--out", work / "resumed")
    run("hvnet.train", *real, "--out", work / "resumed", "--resume")
    numbers["the same, stopped and resumed"] = metrics(work / "resumed")
    published, scores = data / "kitti_val_results", work / "scores.json"
    folders = ["--labels", published / "label_2", "--predictions", published / "point_gnn_car"]
    run("hvnet.evaluate", *folders, "--missing-as-empty", "--json", scores, "--classes", "Car")
    tables = json.loads(scores.read_text(encoding="utf-8"))
    measures = ("R40", "R11", "exact", "loose", "counts", "report")
    numbers["AP of published results"] = {name: {key: table[key] for key in measures} for name, table in tables.items()}
    return numbers


def main() -> None:
    """Writes the numbers, and says which of them differ from those of another checkout."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("out", type=Path, metavar="FILE")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="the numbers of another checkout")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        numbers = collect(options.data.resolve(), Path(work))
    options.out.write_text(json.dumps(numbers, indent=1), encoding="utf-8")
    if options.compare:
        before = json.loads(options.compare.read_text(encoding="utf-8"))
        differ = [name for name in {**before, **numbers} if before.get(name) != numbers.get(name)]
        for name in {**before, **numbers}:
            print(f"{'DIFFERS' if name in differ else 'same':8} {name}")
        sys.exit(bool(differ))


if __name__ == "__main__":
    main()
