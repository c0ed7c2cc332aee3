"""The scene of one frame: a street with its objects, as meshes.

Frame k depends on the seed and on k only. A scene is laid out in the road's axes (u along the road, v to its left, the
sensor at 0) and turned to LiDAR axes: x forward, y left, z up, metres, the sensor 1.73 m above the ground.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from hvnet.boxes import bev_corners, boxes_collide, limit_angle
from hvnet.data.scenes import shapes
from hvnet.data.scenes.shapes import Material, Mesh

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SENSOR_HEIGHT = 1.73  # metres above the ground
MAX_RANGE = 120.0  # of the sensor, metres
# Length, width, height: mean and standard deviation in metres, and the part of the variance that the three share, of
# the boxes of KITTI's 3712 training frames, for n in Car, Van, Pedestrian, Cyclist:
#   d = np.load("gt_database.npz"); s = d["box"][d["name"] == n, 3:6]; s.mean(0), s.std(0), np.corrcoef(s.T)
SIZES = {
    "Car": ((3.89, 1.62, 1.53), (0.44, 0.11, 0.14), 0.27),
    "Van": ((5.15, 1.91, 2.19), (0.85, 0.18, 0.32), 0.75),
    "Pedestrian": ((0.82, 0.63, 1.77), (0.24, 0.12, 0.13), 0.15),
    "Cyclist": ((1.77, 0.57, 1.72), (0.15, 0.14, 0.10), 0.25),
}
SIZE_LIMIT = 2.3
"""Standard deviations at which sizes are truncated."""


@dataclass(frozen=True)
class Options:
    """What the scenes hold. Counts are the least and the most a frame; some objects find no place in a small range."""

    azimuth: float = 50.0  # degrees to either side that are scanned; the camera sees 41, all round is 180
    distance: tuple[float, float] = (4.0, 60.0)  # metres from the sensor to the labelled objects
    cars: tuple[int, int] = (7, 14)
    vans: tuple[int, int] = (0, 1)
    pedestrians: tuple[int, int] = (3, 6)
    cyclists: tuple[int, int] = (1, 4)


@dataclass(frozen=True)
class Scene:
    """A street as one mesh, and the objects in it that get a label."""

    vertices: Floats  # (V, 3) metres, LiDAR axes
    faces: Ints  # (F, 3)
    material: Ints  # (F,) Material
    tint: Floats  # (F,) how much brighter than its material a face is
    owner: Ints  # (F,) the object that a face belongs to, -1 none
    boxes: Floats  # (M, 7)
    names: list[str]  # M classes


# --- the street ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Road:
    """Where the parts of a street are, in the road's axes."""

    heading: float  # radians from LiDAR's x to the road's u
    lane: float  # width of a lane; the sensor is on the right one of two
    offset: float  # v of the middle of the right lane
    edges: tuple[float, float]  # v of the right and the left kerb
    sidewalk: float  # width
    crossing: float  # u of the middle of the cross street; inf: none
    crossing_width: float
    reach: tuple[float, float]  # u from where to where there is a street

    def walks(self) -> tuple[float, float]:
        """Outer v of the right and the left sidewalk."""
        return self.edges[0] - self.sidewalk, self.edges[1] + self.sidewalk

    def to_lidar(self, pose: Floats) -> Floats:
        """Poses (..., 3) = u, v, yaw in the road's axes to x, y, yaw in LiDAR axes."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        u, v, yaw = np.moveaxis(pose, -1, 0)
        return np.stack((u * cos - v * sin, u * sin + v * cos, yaw + self.heading), axis=-1)


@dataclass(frozen=True)
class Ground:
    """Heights z (U, V) over the lines u (U,) and v (V,) of a grid in the road's axes."""

    road: Road
    u: Floats
    v: Floats
    z: Floats

    def height(self, x: float, y: float) -> float:
        """Height at a place in LiDAR axes, interpolated between the grid's points."""
        cos, sin = math.cos(self.road.heading), math.sin(self.road.heading)
        u, v = x * cos + y * sin, y * cos - x * sin
        i = int(np.clip(np.searchsorted(self.u, u) - 1, 0, len(self.u) - 2))
        j = int(np.clip(np.searchsorted(self.v, v) - 1, 0, len(self.v) - 2))
        a = (u - self.u[i]) / (self.u[i + 1] - self.u[i])
        b = (v - self.v[j]) / (self.v[j + 1] - self.v[j])
        near = (1 - b) * self.z[i, j] + b * self.z[i, j + 1]
        far = (1 - b) * self.z[i + 1, j] + b * self.z[i + 1, j + 1]
        return float((1 - a) * near + a * far)


def _road(rng: np.random.Generator, options: Options) -> Road:
    # mostly along the road; sometimes the car turns
    heading = rng.normal(scale=math.radians(4)) if rng.random() < 0.85 else rng.uniform(-0.6, 0.6)
    lane = rng.uniform(2.9, 3.6)
    offset = rng.normal(scale=0.25)
    right, left = (rng.choice([0.4, 2.3], p=[0.35, 0.65]) for _ in range(2))  # with a lane of parked cars or without
    far = options.distance[1]
    behind = -10.0 if options.azimuth <= 90 else -far - 30
    return Road(
        heading=heading,
        lane=lane,
        offset=offset,
        edges=(offset - lane / 2 - right, offset + 1.5 * lane + left),
        sidewalk=rng.uniform(1.5, 3.5),
        crossing=rng.uniform(0.25, 0.9) * far if rng.random() < 0.4 else math.inf,
        crossing_width=rng.uniform(6, 9),
        reach=(behind, far + 30),
    )


def _ground(rng: np.random.Generator, road: Road) -> tuple[Ground, Mesh]:
    """The ground's heights and its mesh: a slope, some roughness, kerbs beside the road and the cross street."""
    kerb = rng.uniform(0.06, 0.15)
    step = 0.03  # metres over which a kerb rises
    right, left = road.edges
    outer_right, outer_left = road.walks()
    v = np.concatenate(  # finer where there is more to see
        (
            [-120, -80, -50, -35, -25, -18, outer_right - 4, outer_right, right - step],
            np.linspace(right, left, 7),
            [left + step, outer_left, outer_left + 4, 20, 27, 37, 52, 80, 120],
        )
    )
    v = np.unique(v)  # sorted: a wide street's sidewalk may lie beyond the first outer lines
    u = np.arange(road.reach[0], road.reach[1] + 3, 3.0)
    if math.isfinite(road.crossing):
        low, high = road.crossing - road.crossing_width / 2, road.crossing + road.crossing_width / 2
        u = np.concatenate((u, [low - step, low, high, high + step]))
    u = np.unique(np.concatenate((u, [road.reach[1] + 20, MAX_RANGE])))

    on_road = ((v >= right) & (v <= left)) | (np.abs(u - road.crossing) <= road.crossing_width / 2 + 1e-6)[:, None]
    # KITTI's boxes stand 0.23 m higher than the ground below the sensor on average, at 28 m: it looks a little down
    slope = rng.normal((0.008, 0.0), (0.008, 0.01))
    z = slope[0] * u[:, None] + slope[1] * v + np.where(on_road, 0, kerb)
    z += rng.normal(size=z.shape) * np.where(on_road, 0.008, 0.025)
    ground = Ground(road, u, v, z)
    ground = replace(ground, z=z - ground.height(0, 0) - SENSOR_HEIGHT)

    mid_u, mid_v = (u[1:] + u[:-1])[:, None] / 2, (v[1:] + v[:-1]) / 2
    paved = (mid_v > outer_right) & (mid_v < outer_left)
    driven = ((mid_v > right) & (mid_v < left)) | (np.abs(mid_u - road.crossing) < road.crossing_width / 2)
    material = np.where(driven, Material.ASPHALT, np.where(paved, Material.PAVING, Material.GRASS))
    pose = np.stack(np.broadcast_arrays(u[:, None], v, 0.0), axis=-1)
    vertices = np.concatenate((road.to_lidar(pose)[..., :2], ground.z[..., None]), axis=-1).reshape(-1, 3)
    a = np.arange(len(u) * len(v)).reshape(len(u), len(v))[:-1, :-1].reshape(-1, 1)
    faces = np.concatenate((a, a + len(v), a + len(v) + 1, a, a + len(v) + 1, a + 1), axis=1).reshape(-1, 3)
    return ground, Mesh(vertices, faces, np.repeat(material.ravel(), 2))


@dataclass(frozen=True)
class Thing:
    """An unlabelled thing in the scene, still in the road's axes."""

    mesh: Mesh
    pose: tuple[float, float, float]  # u, v, yaw
    size: tuple[float, float]  # length and width of the ground that it takes


def _plots(rng: np.random.Generator, road: Road) -> tuple[list[Thing], Floats]:
    """The things beyond the sidewalks, and the poses (P, 3) in the road's axes of cars on parking lots."""
    near, far = road.reach
    low, high = road.crossing - road.crossing_width / 2 - 2, road.crossing + road.crossing_width / 2 + 2
    stretches = [(near, far)] if math.isinf(road.crossing) else [(near, low), (high, far)]
    things: list[Thing] = []
    slots: list[tuple[float, float, float]] = []
    for side, edge in zip((-1, 1), road.walks(), strict=True):
        for begin, end in stretches:
            u = begin
            while end - u > 5:
                length = min(rng.uniform(8, 20), end - u)
                plot, cars = _plot(rng, length)
                # a plot's x runs along the road and its y away from it: the right side is turned by half a turn
                for thing in plot:
                    x, y, yaw = thing.pose
                    pose = (u + length / 2 + side * x, edge + side * y, yaw + (0 if side > 0 else math.pi))
                    things.append(replace(thing, pose=pose))
                slots += [(u + length / 2 + x, edge + side * 3.2, yaw) for x, yaw in cars]
                u += length
    return things, np.array(slots).reshape(-1, 3)


def _plot(rng: np.random.Generator, length: float) -> tuple[list[Thing], list[tuple[float, float]]]:
    """The things on one plot, and the x and yaw of the cars if it is a parking lot; y = 0 is the sidewalk's edge."""
    kind = rng.choice(["house", "garden", "open", "lot"], p=[0.29, 0.33, 0.27, 0.11])
    things = []
    if kind != "open":
        setback = rng.uniform(*{"house": (0, 0.6), "garden": (4, 8), "lot": (8, 14)}[kind])
        depth = rng.uniform(7, 12)
        house = shapes.building(length - 0.6, depth, rng.uniform(4, 11), rng)
        things.append(Thing(house, (0, setback, 0), (length, 2 * depth)))
    if kind == "lot":
        yaw = rng.choice([-0.5, 0.5]) * math.pi
        return things, [(x, yaw) for x in np.arange(1.6 - length / 2, length / 2 - 1.5, 2.6)]
    if kind == "garden":
        span = length - rng.uniform(0.3, 3)
        front = rng.integers(0, 4)  # 3: nothing
        if front == 0:
            things.append(Thing(shapes.wall(span, rng.uniform(0.5, 1.9)), (0, 0.2, 0), (span, 0.3)))
        elif front == 1:
            things.append(Thing(shapes.hedge(span, 0.7, rng.uniform(0.8, 1.8), rng), (0, 0.5, 0), (span, 0.9)))
        elif front == 2:
            things.append(Thing(shapes.fence(span, rng.uniform(0.9, 1.6)), (0, 0.2, 0), (span, 0.2)))
    if kind != "house":
        for _ in range(rng.integers(2, 7)):
            pose = (rng.uniform(1 - length / 2, length / 2 - 1), rng.uniform(1.5, 3.5 if kind == "garden" else 12), 0)
            if rng.random() < 0.5:
                things.append(Thing(shapes.tree(rng), pose, (0.6, 0.6)))
            else:
                width = rng.uniform(0.8, 2.2)
                things.append(Thing(shapes.bush(width, rng.uniform(0.7, 2.0), rng), pose, (width, width)))
    return things, []


# --- the objects -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Object:
    """Something that gets a label."""

    name: str
    box: Floats  # (7,) LiDAR axes
    mesh: Mesh  # in LiDAR axes
    tint: float


PROPOSALS = 24
"""Poses that are tried for an object; if none is free, the scene has one object less."""


def _size(rng: np.random.Generator, name: str) -> Floats:
    """Length, width and height (3,) from truncated normal distributions."""
    mean, deviation, common = SIZES[name]
    while True:
        score = math.sqrt(common) * rng.normal() + math.sqrt(1 - common) * rng.normal(size=3)
        if (np.abs(score) < SIZE_LIMIT).all():
            return np.array(mean) + score * deviation


def _distances(rng: np.random.Generator, options: Options, near: float, far: float) -> Floats:
    """Distances (PROPOSALS,) along the road, beta distributed; behind the sensor too where it scans there."""
    low, high = options.distance
    distance = low + (high - low) * rng.beta(near, far, PROPOSALS)
    return distance * (rng.choice([-1, 1], PROPOSALS) if options.azimuth > 90 else 1)


def _car_poses(rng: np.random.Generator, road: Road, slots: Floats, options: Options) -> Floats:
    """Poses (C, 3) in the road's axes: parked on either side, driving either way, crossing, on lots, turned anyhow."""
    u = _distances(rng, options, 1.3, 1.3)
    lanes = [  # v, yaw, weight
        (road.edges[0] + 1.1, 0.0, 0.28),
        (road.edges[1] - 1.1, math.pi, 0.24),
        (road.edges[1] - 1.1, 0.0, 0.06),  # parked against the traffic
        (road.offset, 0.0, 0.16),
        (road.offset + road.lane, math.pi, 0.16),
    ]
    weights = np.array([*(lane[2] for lane in lanes), 0.10])  # the last one: elsewhere
    choice = rng.choice(len(weights), PROPOSALS, p=weights / weights.sum())
    table = np.array([*(lane[:2] for lane in lanes), (0.0, 0.0)])[choice]
    poses = np.stack((u, table[:, 0], table[:, 1]), axis=1)
    elsewhere = choice == len(lanes)
    spot = rng.random(PROPOSALS)
    poses[elsewhere, 1] = rng.uniform(road.edges[0] + 1, road.edges[1] - 1, elsewhere.sum())
    poses[elsewhere, 2] = rng.uniform(-math.pi, math.pi, elsewhere.sum())
    if math.isfinite(road.crossing):
        rows = np.flatnonzero((spot < 0.08) | (elsewhere & (spot < 0.8)))
        way = rng.choice([-1, 1], len(rows))  # to the right, to the left
        poses[rows, 0] = road.crossing + way * road.crossing_width / 4
        poses[rows, 1] = rng.uniform(-20, 20, len(rows))
        poses[rows, 2] = way * math.pi / 2
    if len(slots):
        rows = np.flatnonzero((spot > 0.75) | (elsewhere & (spot > 0.3)))
        poses[rows] = slots[rng.integers(0, len(slots), len(rows))]
    return poses + rng.normal(size=poses.shape) * (0.3, 0.12, 0.03)


def _pedestrian_poses(rng: np.random.Generator, road: Road, options: Options) -> Floats:
    """Poses (C, 3) in the road's axes: on the sidewalks, across the road, beyond the sidewalks."""
    u = _distances(rng, options, 1.3, 2.4)
    right, left = road.edges
    outer_right, outer_left = road.walks()
    v = np.where(
        rng.random(PROPOSALS) < 0.5,
        rng.uniform(outer_right, right, PROPOSALS),
        rng.uniform(left, outer_left, PROPOSALS),
    )
    yaw = rng.choice([0, math.pi], PROPOSALS) + rng.normal(scale=0.3, size=PROPOSALS)
    spot = rng.random(PROPOSALS)
    crosses = spot < 0.2
    v[crosses] = rng.uniform(right, left, crosses.sum())
    yaw[crosses] += math.pi / 2
    beyond = spot > 0.8
    v[beyond] = np.where(
        rng.random(beyond.sum()) < 0.5,
        rng.uniform(outer_right - 6, outer_right, beyond.sum()),
        rng.uniform(outer_left, outer_left + 6, beyond.sum()),
    )
    yaw[beyond] = rng.uniform(-math.pi, math.pi, beyond.sum())
    return np.stack((u, v, yaw), axis=1)


def _cyclist_poses(rng: np.random.Generator, road: Road, options: Options) -> Floats:
    """Poses (C, 3) in the road's axes: at the edges of the lanes with the traffic, some on the sidewalk or crossing."""
    u = _distances(rng, options, 1.5, 2.2)
    middle = road.offset + road.lane / 2
    left_side = rng.random(PROPOSALS) < 0.5
    away = rng.uniform(0.45, 0.95, PROPOSALS) * road.lane
    v = np.where(left_side, middle + away, middle - away)
    yaw = np.where(left_side, math.pi, 0.0)
    spot = rng.random(PROPOSALS)
    walk = spot < 0.25
    v[walk] = np.where(left_side, road.edges[1] + road.sidewalk / 2, road.edges[0] - road.sidewalk / 2)[walk]
    yaw[spot > 0.85] += rng.choice([-0.5, 0.5]) * math.pi
    return np.stack((u, v, yaw + rng.normal(scale=0.12, size=PROPOSALS)), axis=1)


def _free(poses: Floats, size: Floats, taken: list[Floats], gap: float) -> NDArray[np.bool_]:
    """Which of the poses (C, 3) in LiDAR axes have room for something of size (2,) or (C, 2), and a gap around it."""
    boxes = np.zeros((len(poses), 7))
    boxes[:, :2], boxes[:, 6] = poses[:, :2], poses[:, 2]
    boxes[:, 3:5] = size + gap
    return ~boxes_collide(torch.from_numpy(boxes), torch.from_numpy(np.array(taken))).any(1).numpy()


def _footprint(pose: Floats, size: tuple[float, float]) -> Floats:
    return np.array([pose[0], pose[1], 0, size[0], size[1], 1, pose[2]])


def build_scene(rng: np.random.Generator, options: Options) -> Scene:
    """A street with everything in it."""
    road = _road(rng, options)
    ground, ground_mesh = _ground(rng, road)
    background = [(ground_mesh, 1.0)]
    taken = [np.array([-0.5, 0, 0, 6, 2.5, 1, 0])]  # the car that carries the sensor

    def stand(thing: Thing) -> None:
        x, y, yaw = road.to_lidar(np.array(thing.pose))
        background.append((thing.mesh.moved(x, y, ground.height(x, y), yaw), rng.uniform(0.7, 1.3)))
        taken.append(_footprint(np.array((x, y, yaw)), thing.size))

    things, slots = _plots(rng, road)
    for thing in things:
        stand(thing)

    objects: list[Object] = []
    share = max(1.0, options.azimuth / 50)  # the counts are meant for the camera's view
    kinds: list[tuple[str, tuple[int, int], float, Callable[[], Floats]]] = [
        ("Van", options.vans, 0.6, lambda: _car_poses(rng, road, slots, options)),
        ("Car", options.cars, 0.6, lambda: _car_poses(rng, road, slots, options)),
        ("Cyclist", options.cyclists, 0.4, lambda: _cyclist_poses(rng, road, options)),
        ("Pedestrian", options.pedestrians, 0.15, lambda: _pedestrian_poses(rng, road, options)),
    ]
    for name, (least, most), gap, proposals in kinds:
        for _ in range(round(share * rng.integers(least, most + 1))):
            size = _size(rng, name)
            poses = road.to_lidar(proposals())
            if name == "Pedestrian" and objects and objects[-1].name == name and rng.random() < 0.3:
                # people walk in groups
                beside = objects[-1].box[[0, 1, 6]]
                poses[:4] = beside + rng.normal(size=(4, 3)) * (0.9, 0.9, 0.2)
            distance = np.hypot(poses[:, 0], poses[:, 1])
            # a little beyond the camera's view of 41 degrees, so that some objects cross the image's edge
            seen = np.abs(np.arctan2(poses[:, 1], poses[:, 0])) < math.radians(min(options.azimuth, 46))
            seen |= options.azimuth > 90
            seen &= (distance >= options.distance[0]) & (distance <= options.distance[1])
            poses = poses[seen]
            poses = poses[_free(poses, size[:2], taken, gap)]
            if len(poses):
                objects.append(_object(rng, name, size, poses[0], ground))
                taken.append(objects[-1].box)

    count = round(share * rng.integers(24, 40))
    extras = [_extra(rng, road) for _ in range(count)]
    places = road.to_lidar(np.array([thing.pose for thing in extras]))
    free = _free(places, np.array([thing.size for thing in extras]), taken, 0.3)
    for thing, is_free in zip(extras, free, strict=True):
        # the cross street stays clear; that two of these stand in each other does not matter
        if is_free and abs(thing.pose[0] - road.crossing) > road.crossing_width / 2 + 0.5:
            stand(thing)
    return assemble(background, objects)


def _extra(rng: np.random.Generator, road: Road) -> Thing:
    """Something on a sidewalk or a little beyond: clutter, a pole at the kerb, a tree."""
    kind = rng.choice(["clutter", "pole", "tree"], p=[0.5, 0.25, 0.25])
    side = rng.integers(0, 2)
    out = {"clutter": rng.uniform(0.4, 7), "pole": 0.4, "tree": 0.8}[kind]
    v = road.edges[side] + (-1, 1)[side] * out
    u = rng.uniform(road.reach[0] + 7, road.reach[1])
    if kind == "clutter":
        yaw = rng.choice([0, 0.5, 1, 1.5]) * math.pi + rng.normal(scale=0.1)
        return Thing(shapes.clutter(rng), (u, v, yaw), (0.7, 0.7))
    if kind == "pole":
        return Thing(shapes.pole(rng), (u, v, 0), (0.3, 0.3))
    return Thing(shapes.tree(rng), (u, v, 0), (0.6, 0.6))


def _object(rng: np.random.Generator, name: str, size: Floats, pose: Floats, ground: Ground) -> Object:
    """An object of a class at a pose (3,) in LiDAR axes, on the ground."""
    length, width, height = size
    if name == "Car":
        mesh = shapes.car(rng.choice(shapes.CAR_STYLES)).fitted(length, width, height)
    elif name == "Van":
        mesh = shapes.van(rng.choice(shapes.VAN_STYLES)).fitted(length, width, height)
    elif name == "Pedestrian":
        mesh = shapes.pedestrian(length, width, height, rng)
    else:
        mesh = shapes.cyclist(length, width, height, rng)
    x, y, yaw = pose
    box = np.array([x, y, 0, length, width, height, yaw])
    # wheels, or feet, stand on ground that is not flat
    corners = bev_corners(torch.from_numpy(box)).numpy()
    floor = float(np.mean([ground.height(*corner) for corner in corners]))
    box[2] = floor + height / 2
    box[6] = limit_angle(torch.tensor(yaw)).item()
    # lacquer is anything from black to white
    tint = rng.uniform(0.05, 1.5) if name in ("Car", "Van") else rng.uniform(0.5, 1.4)
    return Object(name, box, mesh.moved(x, y, floor, yaw), tint)


def assemble(background: Sequence[tuple[Mesh, float]], objects: Sequence[Object]) -> Scene:
    """One scene of meshes with their tints and of objects, all in LiDAR axes."""
    parts = [*background, *((thing.mesh, thing.tint) for thing in objects)]
    counts = [len(mesh.faces) for mesh, _ in parts]
    whole = shapes.join(*(mesh for mesh, _ in parts))
    return Scene(
        vertices=whole.vertices,
        faces=whole.faces,
        material=whole.material,
        tint=np.repeat([tint for _, tint in parts], counts),
        owner=np.repeat([-1] * len(background) + list(range(len(objects))), counts),
        boxes=np.array([thing.box for thing in objects]).reshape(-1, 7),
        names=[thing.name for thing in objects],
    )
