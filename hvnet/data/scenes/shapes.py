"""Triangle meshes of the things in a street: cars, vans, people, bicycles, trees, buildings and clutter.

Metres; x forward, y left, z up. Unless said otherwise a thing faces +x and stands on z = 0, its middle over the origin.
Nearly everything is a loft: rings of points joined to a skin.
"""

import functools
import math
from dataclasses import dataclass
from enum import IntEnum, auto

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Point = tuple[float, float, float]


class Material(IntEnum):
    """What a face is made of; `scanner.SURFACE` says how each reflects."""

    ASPHALT = 0
    PAVING = auto()
    GRASS = auto()
    FACADE = auto()
    STONE = auto()
    WOOD = auto()
    BARK = auto()
    LEAF = auto()
    METAL = auto()
    PLASTIC = auto()
    PAINT = auto()
    GLASS = auto()
    RUBBER = auto()
    RETRO = auto()
    """Number plates, rear lamps, traffic signs: they send the light back to where it came from."""
    CLOTH = auto()
    SKIN = auto()


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with a material for every face."""

    vertices: Floats  # (V, 3) metres
    faces: Ints  # (F, 3) rows of vertices
    material: Ints  # (F,) Material

    def moved(self, x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> "Mesh":
        """The mesh turned by yaw about z, then shifted."""
        cos, sin = math.cos(yaw), math.sin(yaw)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        return Mesh(self.vertices @ turn + (x, y, z), self.faces, self.material)

    def fitted(self, length: float, width: float, height: float) -> "Mesh":
        """The mesh scaled to fill a box of this size that stands on the origin."""
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        unit = (self.vertices - low) / (high - low) - (0.5, 0.5, 0.0)
        return Mesh(unit * (length, width, height), self.faces, self.material)


def join(*meshes: Mesh) -> Mesh:
    """One mesh of several."""
    shifts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + shift for mesh, shift in zip(meshes, shifts, strict=True)]),
        np.concatenate([mesh.material for mesh in meshes]),
    )


@functools.cache
def _loft_faces(rings: int, points: int) -> Ints:
    """Faces of a loft: two for every point of every ring but the last, then the two caps as fans."""
    ring, point = np.divmod(np.arange((rings - 1) * points), points)
    a = ring * points + point
    b = ring * points + (point + 1) % points
    skin = np.stack((a, b, b + points, a, b + points, a + points), axis=1).reshape(-1, 3)
    fan = np.arange(1, points - 1)
    first = np.stack((np.zeros_like(fan), fan + 1, fan), axis=1)
    last = np.stack((np.zeros_like(fan), fan, fan + 1), axis=1) + (rings - 1) * points
    return np.concatenate((skin, first, last))


def loft(rings: Floats, material: Material | Ints, caps: Material | None = None) -> Mesh:
    """A skin over rings (S, K, 3) with flat caps; the material is one, or one for each of the (S-1, K) patches."""
    sections, points, _ = rings.shape
    skin = np.broadcast_to(material, (sections - 1, points)).ravel()
    ends = np.full(2 * (points - 2), skin[0] if caps is None else caps)
    return Mesh(rings.reshape(-1, 3), _loft_faces(sections, points), np.concatenate((np.repeat(skin, 2), ends)))


def block(size: Point, centre: Point, material: Material) -> Mesh:
    """A box with axis-parallel faces."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    rings = np.empty((2, 4, 3))
    rings[..., :2] = corners
    rings[:, :, 2] = [[-0.5], [0.5]]
    return loft(rings * size + centre, material)


def tube(start: Point, end: Point, radius: float, end_radius: float, material: Material, sides: int = 6) -> Mesh:
    """A cone frustum about the line from start to end."""
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    # two directions across the axis; by hand, because np.cross takes longer than all the rest
    across = (-z, 0.0, x) if x * x + z * z > y * y else (0.0, z, -y)
    other = (y * across[2] - z * across[1], z * across[0] - x * across[2], x * across[1] - y * across[0])
    turn = 2 * math.pi * np.arange(sides)[:, None] / sides
    circle = np.cos(turn) * np.divide(across, math.hypot(*across)) + np.sin(turn) * np.divide(other, math.hypot(*other))
    return loft(np.stack((start + radius * circle, end + end_radius * circle)), material)


def stack(levels: Floats, material: Material, sides: int = 8) -> Mesh:
    """An upright skin over ellipses, one a row (S, 4) of levels: x of the middle, z, radius in x, radius in y."""
    turn = 2 * math.pi * np.arange(sides) / sides
    x = levels[:, None, 0] + levels[:, None, 2] * np.cos(turn)
    y = levels[:, None, 3] * np.sin(turn)
    return loft(np.stack((x, y, np.broadcast_to(levels[:, None, 1], x.shape)), axis=-1), material)


def ball(x: float, z: float, radius: float, material: Material) -> Mesh:
    """A sphere over the y axis' zero."""
    angle = np.linspace(-0.45, 0.45, 5) * math.pi
    radii = radius * np.cos(angle)
    return stack(np.stack((np.full(5, x), z + radius * np.sin(angle), radii, radii), axis=1), material)


def leaves(size: Point, centre: Point, count: int, leaf: float, rng: np.random.Generator, round_: bool = True) -> Mesh:
    """Loose triangles about as large as `leaf`, spread in an ellipsoid or a box: light passes between them."""
    if round_:
        middle = rng.normal(size=(count, 1, 3))
        middle *= rng.uniform(0.3, 1, (count, 1, 1)) ** (1 / 3) / 2 / np.linalg.norm(middle, axis=2, keepdims=True)
    else:
        middle = rng.uniform(-0.5, 0.5, (count, 1, 3))
    vertices = middle * size + rng.normal(scale=leaf / 2, size=(count, 3, 3)) + centre
    return Mesh(
        vertices.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), np.full(count, Material.LEAF, dtype=np.int64)
    )


# Cars. A body is a loft along x over sections (x, bottom, top, half width at the bottom, half width at the top), in
# shares of the length, height and width; so is the cabin on it, whose front slants more than its rear.
_BODY = [
    (-0.5, 0.27, 0.52, 0.42, 0.42),
    (-0.47, 0.17, 0.60, 0.48, 0.46),
    (-0.30, 0.13, 0.62, 0.50, 0.48),
    (0.20, 0.13, 0.60, 0.50, 0.48),
    (0.38, 0.13, 0.54, 0.49, 0.45),
    (0.47, 0.17, 0.49, 0.45, 0.40),
    (0.5, 0.24, 0.40, 0.38, 0.36),
]
_TALL_BODY = [(x, bottom + 0.02, top + 0.06, low, high) for x, bottom, top, low, high in _BODY]
_CABINS = {  # x at the belt and at the roof: rear window's foot and head, windscreen's head and foot
    "saloon": (-0.38, -0.22, 0.05, 0.26),
    "hatchback": (-0.48, -0.36, 0.07, 0.29),
    "estate": (-0.49, -0.43, 0.05, 0.26),
    "suv": (-0.48, -0.41, 0.08, 0.25),
}
CAR_STYLES = tuple(_CABINS)
VAN_STYLES = ("panel", "minibus")


def _sections(rows: list[tuple[float, float, float, float, float]]) -> Floats:
    """Rings (S, 4, 3) of a loft along x: bottom right, bottom left, top left, top right."""
    x, bottom, top, low, high = np.array(rows).T
    corners = ((-low, bottom), (low, bottom), (high, top), (-high, top))
    return np.stack([np.stack((x, y, z), axis=1) for y, z in corners], axis=1)


def _wheels(x_rear: float, x_front: float, radius: float, aspect: float) -> list[Mesh]:
    """Four wheels; aspect is height / length of the car, so that they come out round."""
    wheels = []
    for x in (x_rear, x_front):
        for y in (-0.49, 0.49):
            tyre = tube((0, y - math.copysign(0.12, y), 0), (0, y, 0), radius, radius, Material.RUBBER, sides=10)
            wheels.append(Mesh(tyre.vertices * (aspect, 1, 1) + (x, 0, radius), tyre.faces, tyre.material))
    return wheels


def _plates(rear_z: float, front_z: float) -> list[Mesh]:
    """Number plates at both ends and lamps at the rear."""
    parts = [block((0.01, 0.3, 0.07), (x, 0, z), Material.RETRO) for x, z in ((-0.497, rear_z), (0.497, front_z))]
    parts += [block((0.01, 0.08, 0.09), (-0.495, y, rear_z + 0.14), Material.RETRO) for y in (-0.36, 0.36)]
    return parts


@functools.cache
def car(style: str) -> Mesh:
    """A car of one of CAR_STYLES that fills the unit box; scale it with `fitted`."""
    body = _TALL_BODY if style == "suv" else _BODY
    foot, head, screen_head, screen_foot = _CABINS[style]
    belt = body[2][2] - 0.04
    cabin = [
        (foot, belt, belt + 0.01, 0.46, 0.45),
        (head, belt, 0.96, 0.46, 0.38),
        ((head + screen_head) / 2, belt, 1.0, 0.46, 0.38),
        (screen_head, belt, 0.97, 0.46, 0.38),
        (screen_foot, belt - 0.03, belt, 0.46, 0.45),
    ]
    glass, paint = Material.GLASS, Material.PAINT
    # bottom, left side, top, right side of every stretch: the roof is painted, the rest are windows
    skin = np.array([[paint, glass, glass if k in (0, 3) else paint, glass] for k in range(4)])
    tall = 0.92 - belt
    pillars = [
        block((0.03, 0.02, tall), (x, y, belt + tall / 2), paint) for x in (head + 0.02, -0.04) for y in (-0.42, 0.42)
    ]
    parts = [loft(_sections(body), paint), loft(_sections(cabin), skin, paint), *pillars]
    parts += _wheels(-0.31, 0.31, 0.205, 0.38) + _plates(0.42, 0.32)
    return join(*parts).fitted(1, 1, 1)


@functools.cache
def van(style: str) -> Mesh:
    """A van of one of VAN_STYLES that fills the unit box; scale it with `fitted`."""
    body = [
        (-0.5, 0.13, 0.97, 0.48, 0.44),
        (-0.48, 0.10, 0.99, 0.50, 0.45),
        (0.20, 0.10, 1.00, 0.50, 0.45),
        (0.36, 0.10, 0.56, 0.50, 0.46),
        (0.47, 0.12, 0.46, 0.47, 0.43),
        (0.5, 0.17, 0.38, 0.42, 0.40),
    ]
    skin = np.full((5, 4), Material.PAINT)
    skin[2, 2] = Material.GLASS
    # front doors' windows, and, of a minibus, those behind them: panes a little outside the slanting sides
    panes = [0.17] if style == "panel" else [0.17, -0.05, -0.28]
    windows = []
    for x in panes:
        for side in (-1, 1):
            outline = [
                (x - 0.09, 0.486, 0.62),
                (x + 0.09, 0.486, 0.62),
                (x + 0.05, 0.464, 0.88),
                (x - 0.09, 0.464, 0.88),
            ]
            pane = np.array(outline) * (1, side, 1)
            windows.append(loft(np.stack((pane, pane + np.array((0, 0.004 * side, 0)))), Material.GLASS))
    parts = [loft(_sections(body), skin), *windows, *_wheels(-0.32, 0.31, 0.15, 0.43), *_plates(0.30, 0.26)]
    return join(*parts).fitted(1, 1, 1)


def pedestrian(length: float, width: float, height: float, rng: np.random.Generator) -> Mesh:
    """A standing or walking person: the longer the box, the wider the step."""
    cloth, skin = Material.CLOTH, Material.SKIN
    step = min(max(length / height - 0.15, 0.0), 0.42) / 2
    swing = step * rng.uniform(0.3, 0.9)
    levels = [(0, 0.46, 0.07, 0.095), (0, 0.60, 0.065, 0.09), (0.01, 0.76, 0.07, 0.12), (0, 0.82, 0.05, 0.11)]
    parts = [stack(np.array([*levels, (0.0, 0.86, 0.03, 0.035)]), cloth), ball(0.01, 0.93, 0.07, skin)]
    for side in (-1, 1):
        foot = side * step
        parts.append(tube((0, side * 0.055, 0.5), (foot, side * 0.06, 0.03), 0.055, 0.033, cloth))
        parts.append(block((0.14, 0.05, 0.04), (foot + 0.03, side * 0.06, 0.02), cloth))
        # the arm swings against the leg of its side
        parts.append(tube((0, side * 0.125, 0.81), (-side * swing, side * 0.17, 0.45), 0.035, 0.025, cloth))
    if rng.random() < 0.25:
        parts.append(block((0.1, 0.16, 0.22), (-0.11, 0, 0.71), cloth))  # a rucksack
    if rng.random() < 0.2:
        parts.append(block((0.2, 0.05, 0.18), (0.02, 0.19, 0.36), Material.PLASTIC))  # a bag
    return join(*parts).fitted(length, width, height)


def bicycle() -> Mesh:
    """A bicycle 1.75 m long without a rider."""
    turn = 2 * math.pi * np.arange(15) / 14
    radii = np.array([(0.35, -0.015), (0.35, 0.015), (0.29, 0.015), (0.29, -0.015)])  # tyre's section: radius, y
    parts = []
    for x in (-0.52, 0.52):
        ring = np.stack(
            (
                x + np.cos(turn)[:, None] * radii[:, 0],
                np.broadcast_to(radii[:, 1], (15, 4)),
                0.35 + np.sin(turn)[:, None] * radii[:, 0],
            ),
            axis=-1,
        )
        parts.append(loft(ring, Material.RUBBER))
    crank, seat, head = (-0.08, 0.0, 0.3), (-0.22, 0.0, 0.9), (0.36, 0.0, 0.85)
    frame = [(crank, seat), (crank, head), (seat, head), (crank, (-0.52, 0.0, 0.35)), (head, (0.52, 0.0, 0.35))]
    parts += [tube(start, end, 0.022, 0.022, Material.METAL, sides=4) for start, end in frame]
    parts.append(tube((0.36, -0.28, 1.0), (0.36, 0.28, 1.0), 0.02, 0.02, Material.METAL, sides=4))
    parts.append(tube(head, (0.36, 0.0, 1.0), 0.02, 0.02, Material.METAL, sides=4))
    parts.append(block((0.24, 0.14, 0.06), (-0.22, 0.0, 0.93), Material.PLASTIC))
    return join(*parts)


def cyclist(length: float, width: float, height: float, rng: np.random.Generator) -> Mesh:
    """A rider on a bicycle, leaning more or less far forward."""
    cloth, skin = Material.CLOTH, Material.SKIN
    shoulder_x = rng.uniform(-0.05, 0.2)
    shoulder_z = 1.5 - 0.3 * shoulder_x
    turn = rng.uniform(0, 2 * math.pi)
    parts = [bicycle(), tube((-0.2, 0, 0.93), (shoulder_x, 0, shoulder_z), 0.13, 0.17, cloth, sides=8)]
    parts.append(ball(shoulder_x + 0.07, shoulder_z + 0.2, 0.12, skin))
    for side in (-1, 1):
        pedal_x = -0.08 + side * 0.17 * math.cos(turn)
        pedal_z = 0.3 + side * 0.17 * math.sin(turn)
        knee = (pedal_x + 0.18, side * 0.11, (pedal_z + 0.95) / 2 + 0.1)
        parts.append(tube((-0.2, side * 0.09, 0.92), knee, 0.085, 0.06, cloth))
        parts.append(tube(knee, (pedal_x, side * 0.1, pedal_z), 0.06, 0.04, cloth))
        parts.append(tube((shoulder_x, side * 0.18, shoulder_z), (0.36, side * 0.25, 1.02), 0.05, 0.035, cloth))
    return join(*parts).fitted(length, width, height)


def tree(rng: np.random.Generator) -> Mesh:
    """A trunk and a crown of leaves; crowns start low enough for the upper beams to meet them."""
    trunk = rng.uniform(1.2, 2.8)
    radius = rng.uniform(0.08, 0.25)
    width, tall = rng.uniform(2.5, 5.0), rng.uniform(2.5, 5.0)
    stem = tube((0, 0, -0.3), (0, 0, trunk + 0.4 * tall), radius, 0.5 * radius, Material.BARK)
    crown = leaves((width, width, tall), (0, 0, trunk + tall / 2), 260, 0.35, rng)
    return join(stem, crown)


def bush(width: float, height: float, rng: np.random.Generator) -> Mesh:
    """A bush: leaves about a core that light does not pass."""
    size = (width, width, height)
    middle = height / 2
    core = stack(
        np.array([(0, z * height, r * width, r * width) for z, r in ((-0.1, 0.2), (0.4, 0.35), (0.8, 0.2))]),
        Material.LEAF,
        sides=6,
    )
    return join(core, leaves(size, (0, 0, middle), 110, 0.16, rng))


def hedge(length: float, depth: float, height: float, rng: np.random.Generator) -> Mesh:
    """A clipped hedge along x."""
    core = block((length, 0.7 * depth, 0.9 * height + 0.3), (0, 0, 0.45 * height - 0.15), Material.LEAF)
    return join(core, leaves((length, depth, height), (0, 0, height / 2), int(30 * length), 0.3, rng, round_=False))


def fence(length: float, height: float) -> Mesh:
    """Posts and rails along x: light passes between them."""
    posts = [
        block((0.09, 0.09, height + 0.4), (x, 0, height / 2 - 0.2), Material.WOOD)
        for x in np.linspace(-length / 2, length / 2, max(2, round(length / 2)))
    ]
    rails = [block((length, 0.04, 0.1), (0, 0, z * height), Material.WOOD) for z in (0.3, 0.6, 0.95)]
    return join(*posts, *rails)


def wall(length: float, height: float) -> Mesh:
    """A wall along x, sunk into the ground so that a slope leaves no gap."""
    return block((length, 0.25, height + 0.8), (0, 0, height / 2 - 0.4), Material.STONE)


def building(length: float, depth: float, height: float, rng: np.random.Generator) -> Mesh:
    """A house along x whose front, with windows, a door and some bays, looks to -y; y = 0 is the front."""
    parts = [block((length, depth, height + 1.5), (0, depth / 2, height / 2 - 0.75), Material.FACADE)]
    door = rng.integers(0, 3)
    for k, x in enumerate(np.arange(-length / 2 + 1.6, length / 2 - 1.0, rng.uniform(2.2, 3.4))):
        if k == door:
            parts.append(block((1.0, 0.1, 2.2), (x, -0.03, 1.0), Material.WOOD))
            parts.append(block((1.4, 0.6, 0.4), (x, -0.3, 0.0), Material.STONE))  # a step
        elif rng.random() < 0.15:
            parts.append(block((1.8, 1.0, height), (x, -0.2, height / 2 - 0.3), Material.FACADE))  # a bay
        else:
            for z in np.arange(1.7, height - 1, 2.9):
                parts.append(block((1.2, 0.04, 1.4), (x, -0.01, z), Material.GLASS))
    return join(*parts)


def pole(rng: np.random.Generator) -> Mesh:
    """A lamp post, or the post of a traffic sign that looks to -x."""
    if rng.random() < 0.5:
        return tube((0, 0, -0.3), (0, 0, rng.uniform(5, 8)), rng.uniform(0.07, 0.14), 0.05, Material.METAL, sides=8)
    height = rng.uniform(2.4, 3.2)
    post = tube((0, 0, -0.3), (0, 0, height), 0.04, 0.04, Material.METAL)
    return join(post, block((0.03, 0.6, 0.6), (-0.05, 0, height - 0.3), Material.RETRO))


def clutter(rng: np.random.Generator) -> Mesh:
    """Something small that could be taken for a person or a bicycle: bin, post box, cabinet, bollard, bush, ..."""
    kind = rng.integers(0, 8)
    if kind == 0:  # a bin on wheels, its lid wider than its body
        width, height = rng.uniform(0.5, 0.8), rng.uniform(0.95, 1.3)
        body = [(0, 0.05, 0.40 * width, 0.40 * width), (0, 0.9 * height, 0.5 * width, 0.5 * width)]
        return stack(np.array([*body, (0, height, 0.45 * width, 0.5 * width)]), Material.PLASTIC, sides=4)
    if kind == 1:  # a cabinet
        width, height = rng.uniform(0.5, 1.2), rng.uniform(0.8, 1.6)
        return block((0.35, width, height + 0.2), (0, 0, height / 2 - 0.1), Material.METAL)
    if kind == 2:  # a post box or a parking meter on its post
        head = block((0.3, 0.45, 0.6), (0, 0, rng.uniform(1.1, 1.4)), Material.METAL)
        return join(tube((0, 0, -0.2), (0, 0, 1.0), 0.05, 0.05, Material.METAL), head)
    if kind == 3:  # a bollard
        return tube((0, 0, -0.2), (0, 0, rng.uniform(0.7, 1.1)), 0.09, 0.08, Material.STONE)
    if kind == 4:  # a sapling tied to a stake
        stem = tube((0, 0, -0.2), (0, 0, 1.8), 0.04, 0.03, Material.BARK)
        return join(stem, leaves((0.7, 0.7, 1.0), (0, 0, 1.6), 60, 0.14, rng))
    if kind == 5:  # boxes on top of each other
        low = block((0.6, 0.7, 0.6), (0, 0, 0.3), Material.WOOD)
        return join(low, block((0.5, 0.5, 0.5), (0.05, 0.05, 0.85), Material.WOOD))
    if kind == 6:
        return bicycle()
    return bush(rng.uniform(0.6, 1.2), rng.uniform(0.7, 1.8), rng)
