"""The command that builds the ground-truth database of a KITTI root."""

import re
from pathlib import Path

import numpy as np
import pytest

from hvnet.data.database import main
from hvnet.data.gt_database import LAYOUT, build_database, read_database
from hvnet.data.kitti import KittiFrames, read_split
from hvnet.exceptions import InputError


def test_command(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = copied
    main(["--data", str(root)])
    path = root / "gt_database.npz"
    read, built = read_database(path), build_database(KittiFrames(root, read_split(root, "train"), crop=False))
    for name in LAYOUT:
        np.testing.assert_array_equal(getattr(read, name), getattr(built, name), err_msg=name)
    printed = capsys.readouterr().out
    assert f"{path}: {len(built)} objects, {len(built.reflectance)} points\n" in printed
    assert f"{(built.name == 'Car').sum():8d} Car\n" in printed
    with pytest.raises(InputError, match=re.escape(f"{path}: already exists")):
        main(["--data", str(root)])
    main(["--data", str(root), "--split", "val", "--out", str(root / "val.npz")])
    assert set(read_database(root / "val.npz").frame.tolist()) == {"000004", "000005"}
    with pytest.raises(InputError, match=re.escape(f"{root / 'none'}: not a writable folder")):
        main(["--data", str(root), "--out", str(root / "none" / "a.npz")])
    with pytest.raises(InputError, match=r"test\.txt: no such file"):
        main(["--data", str(root), "--split", "test", "--out", str(root / "b.npz")])
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "--split" in capsys.readouterr().out
