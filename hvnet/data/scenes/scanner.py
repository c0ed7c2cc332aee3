"""The sensor: a simulated Velodyne HDL-64E turns once in a scene."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from hvnet.data.scenes.street import MAX_RANGE, Floats, Ints, Options, Scene
from hvnet.kernels.raycast import raycast

# Elevations of the 64 beams in degrees (Velodyne HDL-64E manual): the upper block is spaced 1/3, the lower 1/2 degree
BEAMS = np.concatenate((2 - np.arange(32) / 3, 2 - 31 / 3 - 0.5 * np.arange(1, 33)))
BEAM_SHIFTS = np.random.default_rng(64).random(64)
"""Steps of azimuth (64,) by which the beams are out of line: the same in every turn, as in one real sensor."""
AZIMUTH_STEP = 0.1728  # degrees, at 10 turns a second
RANGE_NOISE = 0.02  # metres, standard deviation
THRESHOLD = 4.5e-5
"""Least returned power: the sensor's data sheet sees a reflectivity of 0.1 up to 50 m and of 0.8 up to 120 m."""

# For every Material: the share of the light that comes back at right angles; the reflectance that the sensor reports;
# and gloss, the power of the cosine of the angle of incidence with which the report falls
SURFACE = np.array(
    [
        (0.30, 0.28, 0.1),  # asphalt
        (0.40, 0.36, 0.1),  # paving
        (0.35, 0.38, 0.1),  # grass
        (0.50, 0.36, 0.4),  # facade
        (0.40, 0.32, 0.4),  # stone
        (0.45, 0.38, 0.4),  # wood
        (0.35, 0.30, 0.4),  # bark
        (0.40, 0.32, 0.5),  # leaf
        (0.35, 0.30, 1.5),  # metal
        (0.35, 0.30, 1.0),  # plastic
        (0.45, 0.50, 2.0),  # paint
        (0.012, 0.10, 4.0),  # glass
        (0.08, 0.05, 1.0),  # rubber
        (3.00, 0.90, 0.3),  # retro
        (0.40, 0.38, 0.5),  # cloth
        (0.45, 0.40, 0.5),  # skin
    ]
)


@dataclass(frozen=True)
class Scan:
    """One turn of the sensor."""

    points: NDArray[np.float32]  # (N, 4) x, y, z, reflectance
    owner: Ints  # (N,) the object that a point belongs to, -1 none
    hidden: Floats  # (M,) share of the rays towards an object that something else stops
    hits: Ints  # (M,) points of an object


def _directions(rng: np.random.Generator, azimuth: float) -> Floats:
    """Directions (R, 3) of all rays of one turn within the azimuth, beam by beam from the top."""
    steps = int(2 * azimuth / AZIMUTH_STEP)
    turn = np.radians(-azimuth + AZIMUTH_STEP * (np.arange(steps) + rng.random() + BEAM_SHIFTS[:, None]))
    up = np.broadcast_to(np.radians(BEAMS)[:, None], turn.shape)
    return np.stack((np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)), axis=-1).reshape(-1, 3)


def _cast(scene: Scene, faces: Ints, directions: Floats) -> tuple[Floats, Ints, Floats]:
    """Distance (R,), face (R,) and normal (R, 3) of what rays from the sensor meet among some faces of the scene."""
    # only the vertices that these faces use: one object is a small part of the scene
    first, last = faces.min(), faces.max() + 1
    rays = torch.from_numpy(directions.astype(np.float32))
    vertices = torch.from_numpy(scene.vertices[first:last].astype(np.float32))
    found = raycast(vertices, torch.from_numpy(faces - first), torch.zeros_like(rays), rays, MAX_RANGE)
    distance, face, normal = (part.numpy() for part in found)
    return distance.astype(np.float64), face, normal.astype(np.float64)


def scan(scene: Scene, rng: np.random.Generator, options: Options) -> Scan:
    """What the sensor measures in one turn."""
    directions = _directions(rng, options.azimuth)
    distance, face, normal = _cast(scene, scene.faces, directions)
    met = np.flatnonzero(face >= 0)
    hidden = _hidden(scene, directions, np.where(face >= 0, scene.owner[face], -1))

    distance, face, ray = distance[met], face[met], directions[met]
    cosine = np.abs((normal[met] * ray).sum(axis=1))
    strength, bright, gloss = SURFACE[scene.material[face]].T
    tint = scene.tint[face]
    # rough surfaces send some light back even where it only grazes them
    power = strength * tint * (0.25 + 0.75 * cosine) / distance**2 * np.exp(0.5 * rng.normal(size=len(met)))
    kept = (power > THRESHOLD) & (rng.random(len(met)) > 0.02)
    reflectance = bright * tint * cosine**gloss * (1 + 0.12 * rng.normal(size=len(met)))
    xyz = ray * (distance + RANGE_NOISE * rng.normal(size=len(met)))[:, None]

    reflectance = np.where(reflectance < 0.1, 0, reflectance)  # KITTI's files hold 0 for half the points of cars
    points = np.concatenate((xyz.round(3), reflectance.clip(0, 1).round(2)[:, None]), axis=1)[kept]
    owner = scene.owner[face][kept]
    hits = np.bincount(owner[owner >= 0], minlength=len(scene.boxes))
    return Scan(points.astype(np.float32), owner, hidden, hits)


def _hidden(scene: Scene, directions: Floats, owner: Ints) -> Floats:
    """Share (M,) of the rays that would meet an object if it stood alone, but meet something else; 1 if none would.

    owner: (R,) the object that each ray meets in the scene.
    """
    centres = scene.boxes[:, :3]
    distances = np.linalg.norm(centres, axis=1)
    radii = np.linalg.norm(scene.boxes[:, 3:6], axis=1) / 2
    # rays in the cone about the object's bounding sphere
    aimed = directions @ (centres / distances[:, None]).T >= np.sqrt(1 - np.minimum(radii / distances, 1) ** 2)
    hidden = np.ones(len(centres))
    for k in range(len(centres)):
        _, alone, _ = _cast(scene, scene.faces[scene.owner == k], directions[aimed[:, k]])
        count = (alone >= 0).sum()
        if count:
            hidden[k] = max(0.0, 1 - (owner == k).sum() / count)
    return hidden
