"""The clouds that a user names: files, folders of files and KITTI roots, as one sequence of frames."""

from collections.abc import Sequence
from pathlib import Path

import torch

from hvnet.data.clouds import SUFFIXES, read_cloud
from hvnet.data.frame import Frame, Frames, object_names
from hvnet.data.kitti import KittiFrames, has_camera, read_split
from hvnet.exceptions import InputError


class CloudFiles:
    """Files of clouds, without labels and cameras: a `Frames`."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self.paths, self.names = list(paths), [path.stem for path in paths]

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, k: int) -> Frame:
        points, notes = read_cloud(self.paths[k])
        return Frame(self.names[k], torch.from_numpy(points), notes=notes)

    def object_names(self, k: int) -> None:
        """See `frame.object_names`: nothing is labelled."""


class JoinedFrames:
    """Several sequences of frames, one after the other: a `Frames`. Raises InputError for a name used twice."""

    def __init__(self, parts: Sequence[Frames]) -> None:
        self.parts = list(parts)
        self.places = [(part, k) for part in self.parts for k in range(len(part))]
        self.names = [part.names[k] for part, k in self.places]
        first: dict[str, str] = {}
        for name, (part, k) in zip(self.names, self.places, strict=True):
            if name in first:
                raise InputError(f"{_place(part, k)}: the name {name} is taken by {first[name]}; rename one")
            first[name] = _place(part, k)

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, k: int) -> Frame:
        part, index = self.places[k]
        return part[index]

    def object_names(self, k: int) -> Sequence[str] | None:
        """See `frame.object_names`."""
        part, index = self.places[k]
        return object_names(part, index)


def _place(part: Frames, k: int) -> str:
    if isinstance(part, CloudFiles):
        return str(part.paths[k])
    return str(part.root) if isinstance(part, KittiFrames) else part.names[k]


def find_frames(inputs: Sequence[Path], split: str | None = None) -> JoinedFrames:
    """The frames of the inputs, in order; of KITTI roots those of ImageSets/SPLIT.txt, by default all.

    Raises InputError for an input that is missing or empty, or a name used twice.
    """
    parts: list[Frames] = []
    for path in inputs:
        if path.is_file():
            if path.suffix not in SUFFIXES:
                raise InputError(f"{path}: unknown kind of file; known: {', '.join(SUFFIXES)}")
            parts.append(CloudFiles([path]))
        elif (path / "training").is_dir() or (path / "testing").is_dir():
            parts.append(_find_kitti(path, split))
        elif path.is_dir():
            files = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES)
            if not files:
                raise InputError(f"{path}: holds no cloud ({', '.join(SUFFIXES)}) and is no KITTI root")
            parts.append(CloudFiles(files))
        else:
            raise InputError(f"{path}: no such file or folder")
    if split is not None and not any(isinstance(part, KittiFrames) for part in parts):
        raise InputError(f"--split {split}: none of the inputs is a KITTI root")
    return JoinedFrames(parts)


def _find_kitti(root: Path, split: str | None) -> KittiFrames:
    folder = "testing" if split == "test" or not (root / "training").is_dir() else "training"
    # the test set is all of its folder, and KITTI's own download names its frames nowhere
    if split is not None and (split != "test" or (root / "ImageSets" / "test.txt").is_file()):
        return KittiFrames(root, read_split(root, split, split_dir=folder, labelled=False), folder, labelled=None)
    names = sorted(file.stem for file in (root / folder / "velodyne").glob("*.bin"))
    if not names:
        raise InputError(f"{root / folder / 'velodyne'}: holds no .bin file")
    if has_camera(root / folder):
        for name in names:
            calib = root / folder / "calib" / f"{name}.txt"
            if not calib.is_file():
                raise InputError(f"{calib}: no such file; each frame needs one")
    return KittiFrames(root, names, folder, labelled=None)
