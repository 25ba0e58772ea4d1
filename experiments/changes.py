"""What changed in made-up rooms: is each change found, with its kind, and is nothing found where nothing changed?

    python -m experiments.changes [--seeds FIRST LAST] [--quick]

Ray-traced rooms (the ray tracer shares no code with the renderer) of nine things on a table. The field of a room has
its true masks, and Gaussians from true depth. Then the room is changed, lit anew or photographed with another exposure,
and photographed from other places, with poses: RGB with true poses, and RGB-D with noise of 1 cm and of 0.5 degrees.
"""

import dataclasses

import numpy as np

from experiments.relations import SRGB
from experiments.rooms.capture import look_at, room_cameras
from experiments.rooms.raycast import render_views
from experiments.rooms.room import Room, build_room, footprint_radius, place_object, scatter_circles
from experiments.rooms.shapes import SHAPES
from jsecon.field.evidence import region_votes
from jsecon.field.membership import normalise_votes
from jsecon.field.regions import region_embeddings
from jsecon.fit.depth import points_from_depth
from jsecon.fit.start import gaussians_from_points
from jsecon.types import Camera, Capture, LanguageField
from jsecon.vision.colours import ColourEmbedder

KINDS = ("remove", "move", "add", "swap", "turn", "nothing", "other light", "other exposure")
UNTURNED = ("box", "mug", "kettle", "pot", "teddy")
"""Shapes that look another way when they are turned."""
SIZE = {"width": 160, "height": 120}


@dataclasses.dataclass(frozen=True)
class Thing:
    """A thing of a room: what it is, and where."""

    colour: str
    shape: str
    seed: int
    spot: tuple[float, float]
    yaw: float

    def placed(self, index: int):
        """The object of the ray tracer."""
        draw = np.random.default_rng([self.seed, 31])
        body = SHAPES[self.shape](draw)
        return place_object(draw, index, self.colour, self.shape, SRGB[self.colour], body, self.spot, self.yaw)


def radius(shape: str, seed: int) -> float:
    """Radius of a thing's footprint, m."""
    return footprint_radius(SHAPES[shape](np.random.default_rng([seed, 31])))


@dataclasses.dataclass(frozen=True)
class Case:
    """A room before and after, and what changed: (kind, index before, index after), -1 for none."""

    before: tuple[Thing, ...]
    after: tuple[Thing, ...]
    changes: tuple[tuple[str, int, int], ...]
    light: float = 0.0
    """Angle by which the lamp goes around the table."""
    exposure: float = 1.0


def make_case(seed: int, kind: str) -> Case:
    """Draws a room, and changes it."""
    draw = np.random.default_rng([seed, 32])
    colours = [str(colour) for colour in draw.permutation(list(SRGB))]
    shapes = [str(draw.choice(list(SHAPES))) for _ in colours]
    shapes[0] = str(draw.choice(UNTURNED))
    seeds = [int(draw.integers(1 << 30)) for _ in colours]
    count = 9
    radii = [radius(shape, own) for shape, own in zip(shapes, seeds)]
    # Places of nine things, of a thing that comes, and one to go to.
    spots = scatter_circles(draw, [*radii[:10], radii[0]], gap=0.012)
    things = [
        Thing(colours[k], shapes[k], seeds[k], tuple(map(float, spots[k])), float(draw.uniform(0, 2 * np.pi)))
        for k in range(10)
    ]
    before, after = tuple(things[:count]), list(things[:count])
    if kind == "remove":
        return Case(before, tuple(after[1:]), (("gone", 0, -1),))
    if kind == "move":
        yaw = things[0].yaw + float(draw.uniform(-1, 1))
        after[0] = dataclasses.replace(things[0], spot=tuple(map(float, spots[10])), yaw=yaw)
        return Case(before, tuple(after), (("moved", 0, 0),))
    if kind == "add":
        return Case(before, (*after, things[9]), (("new", -1, 9),))
    if kind == "swap":
        far = np.argsort([abs(radii[k] - radii[0]) if k else 9 for k in range(count)])[0]
        after[0], after[far] = (
            dataclasses.replace(things[a], spot=things[b].spot) for a, b in ((0, int(far)), (int(far), 0))
        )
        return Case(before, tuple(after), (("moved", 0, 0), ("moved", int(far), int(far))))
    if kind == "turn":
        after[0] = dataclasses.replace(
            things[0], yaw=things[0].yaw + float(draw.choice([-1, 1]) * draw.uniform(0.7, 2.4))
        )
        return Case(before, tuple(after), (("moved", 0, 0),))
    return Case(
        before,
        before,
        (),
        light=float(draw.choice([-1, 1]) * draw.uniform(0.8, 2.2)) if kind == "other light" else 0.0,
        exposure=float(draw.choice([0.55, 0.75, 1.3, 1.5])) if kind == "other exposure" else 1.0,
    )


def make_room(things: tuple[Thing, ...], seed: int, light: float = 0.0) -> Room:
    """The ray tracer's room; `light` turns the lamp around the table."""
    draw = np.random.default_rng([seed, 33])
    room = build_room(draw, tuple(thing.placed(k) for k, thing in enumerate(things)), seed)
    cos, sin = np.cos(light), np.sin(light)
    x, y, z = room.light
    return dataclasses.replace(room, light=np.array([cos * x - sin * y, sin * x + cos * y, z], np.float32))


def new_cameras(seed: int, count: int) -> Camera:
    """Cameras at places between those of the field, all around the table."""
    draw = np.random.default_rng([seed, 34])
    turn = draw.uniform(0, 2 * np.pi) + 2 * np.pi * (np.arange(count) + draw.uniform(-0.25, 0.25, count)) / count
    centres = np.stack([1.5 * np.cos(turn), 1.5 * np.sin(turn), draw.uniform(0.55, 1.0, count)], -1)
    poses = np.stack([look_at(c, np.array([0, 0, 0.03]) + draw.normal(0, 0.03, 3)) for c in centres])
    focal = 0.5 * SIZE["width"] / np.tan(np.radians(30))
    lens = (np.full(count, value, np.float32) for value in (focal, focal, SIZE["width"] / 2, SIZE["height"] / 2))
    return Camera(poses, *lens, **SIZE)


def room_field(room: Room, *, views: int = 16) -> LanguageField:
    """The field of a room with its true masks: Gaussians from true depth, regions named by their colours."""
    cameras = room_cameras(room, views=views, width=240, height=180)
    frames, instances, depths = render_views(room, cameras, coarser=2)
    names = tuple(f"frame_{view + 1:05d}" for view in range(views))
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    capture = Capture(frames, cameras, *nothing, np.zeros(views, bool), depths, np.eye(4), names)
    cloud = points_from_depth(capture, voxel=0.013)
    near = (np.abs(cloud.points[:, :2]) < 0.75).all(1) & (cloud.points[:, 2] > -0.1)
    coarse = points_from_depth(capture, voxel=0.08)
    far = ~((np.abs(coarse.points[:, :2]) < 0.75).all(1) & (coarse.points[:, 2] > -0.1))
    points, colours = (
        np.concatenate([a[near], b[far]]) for a, b in ((cloud.points, coarse.points), (cloud.colors, coarse.colors))
    )
    scene = gaussians_from_points(points, colours, opacity=0.9, scale=0.5, max_scale=0.08)
    embedder = ColourEmbedder()
    labels = np.asarray(instances, np.int16)
    regions = region_embeddings(frames, labels, embedder.embed_regions, num_regions=len(room.objects))
    votes = normalise_votes(region_votes(scene, cameras, labels, len(room.objects), by_view=True), regions)
    return LanguageField(
        gaussians=scene,
        votes=votes,
        regions=regions,
        cameras=cameras,
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.eye(4),
        names=names,
        embedder=embedder.name,
        unrelated_words=np.asarray(embedder.unrelated_words, np.float16),
    )
