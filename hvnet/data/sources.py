"""The clouds that a user names: files, folders of files and KITTI roots, as one sequence of frames."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import torch

from hvnet.config import DataConfig
from hvnet.data.clouds import SUFFIXES, find_scales, is_cloud, read_scaled
from hvnet.data.frame import Frame, Frames, notes, object_names
from hvnet.data.kitti import KittiFrames, cloud_files, find_file, has_camera, read_split
from hvnet.exceptions import InputError


class CloudFiles:
    """Files of clouds, without labels and cameras: a `Frames`.

    reading: how they are read; what it does not say is found out.
    siblings: files of the same call, which tell the scale of the reflectance as well.
    """

    def __init__(
        self, paths: Sequence[Path], reading: DataConfig | None = None, siblings: Sequence[Path] | None = None
    ) -> None:
        self.paths, self.names = list(paths), [path.stem for path in paths]
        self.reading, self.siblings = reading or DataConfig(), self.paths if siblings is None else siblings

    def __len__(self) -> int:
        return len(self.paths)

    def __getitem__(self, k: int) -> Frame:
        path = self.paths[k]
        raw, cloud = read_scaled(path, self.reading, self.scales)
        alone = sum(each.parent == path.parent for each in self.siblings) == 1
        said = [f"{path}: {note}" for note in cloud.notes]
        # the same for all files of a folder, so that it is said once
        said += [f"{path if alone else path.parent}: {note}" for note in (raw.note, cloud.reflectance.note) if note]
        return Frame(self.names[k], torch.from_numpy(cloud.points), notes=said, reflectance=cloud.reflectance.fact)

    def object_names(self, k: int) -> None:
        """See `frame.object_names`: nothing is labelled."""

    @cached_property
    def scales(self) -> dict[str, float]:
        """The scale of the reflectance of every sensor among the files: see `clouds.sensor_of`."""
        return find_scales(self.siblings, self.reading)


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

    @property
    def notes(self) -> list[str]:
        """See `frame.notes`."""
        return [note for part in self.parts for note in notes(part)]

    def object_names(self, k: int) -> Sequence[str] | None:
        """See `frame.object_names`."""
        part, index = self.places[k]
        return object_names(part, index)


def _place(part: Frames, k: int) -> str:
    if isinstance(part, CloudFiles):
        return str(part.paths[k])
    return str(part.root) if isinstance(part, KittiFrames) else part.names[k]


def find_frames(
    inputs: Sequence[Path], split: str | None = None, reading: DataConfig | None = None, *, crop: bool = True
) -> JoinedFrames:
    """The frames of the inputs, in order; of KITTI roots those of ImageSets/SPLIT.txt, by default all.

    reading: how clouds and labels are read. crop: of frames with a camera only what it sees.

    Raises InputError for an input that is missing or empty, or a name used twice.
    """
    files: dict[Path, list[Path]] = {}  # of every input that is no KITTI root
    for path in inputs:
        if path.is_file():
            if not is_cloud(path):
                raise InputError(f"{path}: unknown kind of file; known: {', '.join(SUFFIXES)}")
            files[path] = [path]
        elif not path.is_dir():
            raise InputError(f"{path}: no such file or folder")
        elif not _is_kitti(path):
            files[path] = sorted(file for file in path.iterdir() if is_cloud(file) and file.is_file())
            if not files[path]:
                raise InputError(f"{path}: holds no cloud ({', '.join(SUFFIXES)}) and is no KITTI root")
    siblings = [file for own in files.values() for file in own]
    parts: list[Frames] = [
        CloudFiles(files[path], reading, siblings) if path in files else _find_kitti(path, split, reading, crop)
        for path in inputs
    ]
    if split is not None and not any(isinstance(part, KittiFrames) for part in parts):
        raise InputError(f"--split {split}: none of the inputs is a KITTI root")
    return JoinedFrames(parts)


def _is_kitti(path: Path) -> bool:
    return (path / "training").is_dir() or (path / "testing").is_dir()


def _find_kitti(root: Path, split: str | None, reading: DataConfig | None, crop: bool) -> KittiFrames:
    folder = "testing" if split == "test" or not (root / "training").is_dir() else "training"
    # the test set is all of its folder, and KITTI's own download names its frames nowhere
    if split is not None and (split != "test" or (root / "ImageSets" / "test.txt").is_file()):
        names = read_split(root, split, split_dir=folder, labelled=False)
    else:
        names = [file.stem for file in cloud_files(root / folder)]
        if not names:
            raise InputError(f"{root / folder / 'velodyne'}: holds no .bin file")
        if has_camera(root / folder):
            for name in names:
                calib = find_file(root / folder / "calib", name, ".txt")
                if not calib.is_file():
                    raise InputError(f"{calib}: no such file; each frame needs one")
    return KittiFrames(root, names, folder, labelled=None, crop=crop, reading=reading)
