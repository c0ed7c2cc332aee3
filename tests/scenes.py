"""Generated scenes that several tests share."""

import functools

import numpy as np

from hvnet.data.labels import Labels
from hvnet.data.scenes import shapes
from hvnet.data.scenes.files import make_frame, make_labels
from hvnet.data.scenes.scanner import Scan, scan
from hvnet.data.scenes.shapes import Material
from hvnet.data.scenes.street import Object, Options, Scene, assemble

FRAMES = 10


@functools.cache
def some_frames() -> list[tuple[Scene, Scan, Labels]]:
    """The first FRAMES of seed 0."""
    return [make_frame(0, index, Options()) for index in range(FRAMES)]


def car_at(x: float, y: float, yaw: float = 0.0) -> Object:
    mesh = shapes.car("saloon").fitted(4, 1.7, 1.5).moved(x, y, -1.73, yaw)
    return Object("Car", np.array([x, y, -0.98, 4, 1.7, 1.5, yaw]), mesh, tint=1.0)


def scan_of(*objects: Object, background: tuple[shapes.Mesh, ...] = ()) -> tuple[Scan, Labels]:
    ground = shapes.block((200, 200, 1), (0, 0, -2.23), Material.ASPHALT)
    scene = assemble([(mesh, 1.0) for mesh in (ground, *background)], objects)
    measured = scan(scene, np.random.default_rng(0), Options())
    return measured, make_labels(scene, measured)
