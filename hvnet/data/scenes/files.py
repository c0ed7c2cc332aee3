"""Generated scenes as files in KITTI's layout, with the labels of what the camera sees."""

import json
import math
import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from hvnet.boxes import limit_angle
from hvnet.data.frame import Camera
from hvnet.data.kitti import boxes_to_camera, write_calibration, write_labels, write_points
from hvnet.data.labels import DONTCARE, Labels
from hvnet.data.scenes.scanner import Scan, scan
from hvnet.data.scenes.street import Floats, Options, Scene, build_scene
from hvnet.exceptions import InputError

VERSION = 1
"""Increase this when a seed gives other scenes than before, so that older folders are rejected, not reused."""

MIN_POINTS = 5
"""An object with fewer points is a DontCare region: KITTI's annotators could not fit a box to so few either."""

OCCLUSION = (0.15, 0.5, 0.85)
"""Shares of an object that is hidden from which on it has occlusion 1, 2 and 3."""

# Close to the calibrations of KITTI's drives of 26 September 2011
CAMERA = Camera(
    p2=np.array(
        [
            [721.5377, 0.0, 609.5593, 44.85728],
            [0.0, 721.5377, 172.854, 0.2163791],
            [0.0, 0.0, 1.0, 0.002745884],
        ]
    ),
    r0_rect=np.array(
        [
            [0.9999239, 0.00983776, -0.007445048],
            [-0.009869795, 0.9999421, -0.004278459],
            [0.007402527, 0.004351614, 0.9999631],
        ]
    ),
    velo_to_cam=np.array(
        [
            [0.007533745, -0.9999714, -0.000616602, -0.004069766],
            [0.01480249, 0.0007280733, -0.9998902, -0.07631618],
            [0.9998621, 0.00752379, 0.01480755, -0.2717806],
        ]
    ),
)


def truncation(boxes: Floats) -> Floats:
    """Share (M,) of what the sensor could see of boxes (M, 7) that lies outside the image.

    The area of the 2D box is no measure for it: it is infinite for a box that reaches past the camera.
    """
    steps = (np.arange(12) + 0.5) / 12 - 0.5
    a, b = (grid.ravel() for grid in np.meshgrid(steps, steps))
    unit, facing = [], []
    for axis in range(3):
        for side in (-0.5, 0.5):
            unit.append(np.insert(np.stack((a, b), axis=1), axis, side, axis=1))
            facing.append(np.broadcast_to(np.eye(3)[axis] * 2 * side, (len(a), 3)))
    spots, normals = np.concatenate(unit), np.concatenate(facing)  # (S, 3) of the unit box's surface
    outside = np.zeros(len(boxes))
    for k, box in enumerate(boxes):
        cos, sin = math.cos(box[6]), math.sin(box[6])
        turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        xyz = spots * box[3:6] @ turn + box[:3]
        # solid angle of every spot: the area of its side, seen at an angle, over the squared distance
        area = box[3:6].prod() / (np.abs(normals) @ box[3:6])
        distance = np.linalg.norm(xyz, axis=1)
        angle = area * np.maximum(0, -(normals @ turn * xyz).sum(axis=1)) / distance**3
        outside[k] = angle[~CAMERA.sees(xyz)].sum() / angle.sum()
    return outside


def make_labels(scene: Scene, measured: Scan) -> Labels:
    """The labels of what the camera sees: rows of objects, then DontCare regions.

    As in KITTI, occlusion 0 is fully visible, 1 partly, 2 largely occluded, 3 unknown; nothing is said of an object
    outside the image or entirely hidden; one that can be seen, but has too few points for a box, is a DontCare region.
    """
    bbox, visible = CAMERA.project_boxes(scene.boxes)
    seen = np.flatnonzero(visible & (measured.hidden < 1))
    known = measured.hits[seen] >= MIN_POINTS
    rows, unknown = seen[known], seen[~known]
    dimensions, location, rotation_y = boxes_to_camera(scene.boxes[rows], CAMERA)
    alpha = limit_angle(torch.from_numpy(rotation_y - np.arctan2(location[:, 0], location[:, 2]))).numpy()
    count = len(unknown)
    return Labels(
        name=np.array([scene.names[k] for k in rows] + [DONTCARE] * count, dtype=np.str_),
        truncation=np.concatenate((truncation(scene.boxes[rows]), np.full(count, -1.0))),
        occlusion=np.concatenate((np.digitize(measured.hidden[rows], OCCLUSION), np.full(count, -1))),
        alpha=np.concatenate((alpha, np.full(count, -10.0))),
        bbox=bbox[np.concatenate((rows, unknown))],
        dimensions=np.concatenate((dimensions, np.full((count, 3), -1.0))),
        location=np.concatenate((location, np.full((count, 3), -1000.0))),
        rotation_y=np.concatenate((rotation_y, np.full(count, -10.0))),
    )


def make_frame(seed: int, index: int, options: Options) -> tuple[Scene, Scan, Labels]:
    """Frame `index` of a seed, whatever the number of frames."""
    rng = np.random.default_rng((seed, index))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # for hundreds of small tensors a second thread takes longer to wake than it helps
    try:
        scene = build_scene(rng, options)
        measured = scan(scene, rng, options)
    finally:
        torch.set_num_threads(threads)
    return scene, measured, make_labels(scene, measured)


def generate(root: Path, frames_train: int, frames_val: int, seed: int, options: Options | None = None) -> None:
    """Writes scenes as a KITTI root: frames 0 to frames_train - 1 for training, the next frames_val for validation.

    A folder that holds these very scenes is left as it is, one with a part of them is rewritten, and any other that
    is not empty is refused.
    """
    root, options = Path(root), options or Options()
    _check(frames_train, frames_val, seed, options)
    plan = {"version": VERSION, "seed": seed, "train": frames_train, "val": frames_val, "options": asdict(options)}
    if _is_complete(root, plan):
        return
    folders = [root / "training" / name for name in ("velodyne", "calib", "label_2")]
    for folder in (*folders, root / "ImageSets"):
        folder.mkdir(parents=True, exist_ok=True)
    _write_meta(root, plan | {"complete": False})
    for index in tqdm(range(frames_train + frames_val), desc="generate", unit="frame", disable=None):
        _, measured, labels = make_frame(seed, index, options)
        write_points(folders[0] / f"{index:06d}.bin", measured.points)
        write_calibration(folders[1] / f"{index:06d}.txt", CAMERA)
        write_labels(folders[2] / f"{index:06d}.txt", labels)
    splits = {"train": range(frames_train), "val": range(frames_train, frames_train + frames_val)}
    for name, indices in splits.items():
        (root / "ImageSets" / f"{name}.txt").write_text("".join(f"{index:06d}\n" for index in indices))
    _write_meta(root, plan | {"complete": True})


def _check(frames_train: int, frames_val: int, seed: int, options: Options) -> None:
    if min(frames_train, frames_val, seed) < 0:
        raise InputError(f"train {frames_train}, val {frames_val}, seed {seed}: none may be negative")
    if not 41 <= options.azimuth <= 180:
        raise InputError(f"azimuth {options.azimuth:g}: give 41 (the camera's view) to 180 degrees")
    near, far = options.distance
    if not 4 <= near < far <= 80:
        raise InputError(f"distance {near:g} to {far:g}: give an interval within 4 to 80 metres")
    for name in ("cars", "vans", "pedestrians", "cyclists"):
        least, most = getattr(options, name)
        if not 0 <= least <= most:
            raise InputError(f"{name} {least} to {most}: give the least and the most of a frame, from 0 on")


def _is_complete(root: Path, plan: dict[str, object]) -> bool:
    """Whether the folder holds these scenes already; an InputError if it holds anything but (a part of) these."""
    if not root.exists() or (root.is_dir() and not any(root.iterdir())):
        return False
    try:
        meta = json.loads((root / "meta.json").read_text())
        complete = meta.pop("complete")
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise InputError(
            f"{root}: not empty, and no folder of generated scenes; choose another or delete it"
        ) from error
    if meta != json.loads(json.dumps(plan)):  # JSON knows no tuples
        raise InputError(f"{root}: holds scenes of other options ({root / 'meta.json'}); choose another or delete it")
    return bool(complete)


def _write_meta(root: Path, meta: dict[str, object]) -> None:
    """Writes meta.json in one step, so that it is never half written."""
    part = root / "meta.json.part"
    part.write_text(json.dumps(meta, indent=1) + "\n")
    os.replace(part, root / "meta.json")
