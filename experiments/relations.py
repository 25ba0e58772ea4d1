"""Referring expressions against rooms whose solids are known: is the answer the right 0, 1 or several objects?

    python -m experiments.relations [--seeds 50 51 ...] [--vision true|default]

With true masks the rooms are of the demo's shapes, most kinds occur several times, and things stand on, in and under
others; Gaussians come from true depth. With the default vision they are the rooms of `jsecon demo`, and the fields what
`jsecon run` makes of their photographs; things without a name stand there unasked. The truth
of a relation comes from the solids by the rules of `Truth`: each says yes, no, or unclear, and an expression is asked
only if every candidate is clear. They use points of the solids and the image of the camera, not the predicates that
are measured. An answer is right if it holds exactly the true objects. Thresholds of `jsecon.query.relations` were
chosen on the seeds 40 to 49.
"""

import dataclasses
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from experiments import results
from experiments.cells import append_cell, read_cells
from experiments.rooms.capture import room_cameras, write_room
from experiments.rooms.raycast import render_views
from experiments.rooms.room import (
    ARCH_COLOUR,
    BEAM_COLOUR,
    ON_PLATE_COLOUR,
    PLATE_COLOUR,
    Room,
    build_room,
    crowded_room,
    footprint_radius,
    place_object,
    scatter_circles,
)
from experiments.rooms.shapes import SHAPES, Body, box, contains, ellipsoid, place
from jsecon import Scene
from jsecon.errors import InputError
from jsecon.field.evidence import region_votes
from jsecon.field.field import load_field, save_field
from jsecon.field.membership import normalise_votes
from jsecon.field.regions import region_embeddings
from jsecon.fit.start import points_from_depth
from jsecon.splat.points import gaussians_from_points
from jsecon.types import Camera, Capture, Gaussians, LanguageField
from jsecon.vision.colours import ColourEmbedder

SRGB = {
    "red": (208, 28, 38),
    "dark blue": (24, 44, 140),
    "yellow": (250, 216, 32),
    "white": (236, 236, 236),
    "orange": (247, 130, 18),
    "light green": (150, 222, 140),
    "purple": (124, 48, 158),
    "brown": (122, 72, 38),
    "turquoise": (54, 190, 182),
    "dark green": (18, 92, 42),
    "light blue": (132, 192, 240),
}
"""colours of the kinds"""
GRID_M = 0.006
"""spacing of the points inside the solids, m"""
FRAMES = 3
"""frames of a room from which directions are asked"""
PER_RELATION = {1: 2, 0: 1, 2: 1}
"""expressions of a room for each relation, by whether one, none or several objects are right"""


def _balls(draw: np.random.Generator, *radii: tuple[float, float]) -> list[Body]:
    drawn = (draw.uniform(*pair) for pair in radii)
    return [[(place(ellipsoid(r, r, r), (0, 0, r)), None, 1.0)] for r in drawn]


def _box(draw: np.random.Generator, side: tuple[float, float], height: tuple[float, float]) -> Body:
    return [(box(draw.uniform(*side), draw.uniform(*side), draw.uniform(*height)), None, 1.0)]


def relation_room(seed: int) -> tuple[Room, dict[int, tuple[str, int]]]:
    """Makes a room, and what holds some objects: index -> ("on", "in" or "under", index of the other)."""
    draw = np.random.default_rng([seed, 21])
    low = _box(draw, (0.12, 0.15), (0.05, 0.08))
    bodies = (
        ("dark blue", "box", [low, *(_box(draw, side, (0.06, 0.12)) for side in ((0.06, 0.08), (0.16, 0.19)))]),
        ("red", "mug", [SHAPES["mug"](draw) for _ in range(3)]),
        ("yellow", "ball", _balls(draw, (0.045, 0.055), (0.065, 0.085))),
        ("white", "plate", [SHAPES["plate"](draw)]),
        ("orange", "ball", _balls(draw, (0.055, 0.065), (0.04, 0.05))),
        ("light green", "bowl", [SHAPES["bowl"](draw)]),
        ("purple", "ball", _balls(draw, (0.045, 0.052), (0.06, 0.08))),
        ("brown", "arch", [[(box(0.1, 0.26, 0.2), place(box(0.2, 0.18, 0.16), (0, 0, -0.01)), 1.0)]]),
        ("turquoise", "box", [_box(draw, (0.07, 0.09), (0.06, 0.1)), _box(draw, (0.1, 0.13), (0.09, 0.15))]),
        ("dark green", "bottle", [SHAPES["bottle"](draw) for _ in range(2)]),
        ("light blue", "vase", [SHAPES["vase"](draw)]),
    )
    kinds = [(colour, shape, body) for colour, shape, own in bodies for body in own]
    held = {6: ("on", 0), 9: ("on", 8), 12: ("in", 11), 15: ("under", 14)}
    heights = {0: float(2 * low[0][0].bound[2]), 8: 0.008, 11: 0.018, 14: 0.0}
    free = [k for k in range(len(kinds)) if k not in held]
    radii = [0.15 if k == 14 else footprint_radius(kinds[k][2]) for k in free]
    spots = dict(zip(free, scatter_circles(draw, radii, gap=0.012)))
    spots |= {k: np.array([*spots[other][:2], heights[other]]) for k, (_, other) in held.items()}
    objects = [
        place_object(draw, k, colour, shape, SRGB[colour], body, spots[k])
        for k, (colour, shape, body) in enumerate(kinds)
    ]
    return build_room(draw, tuple(objects), seed), held


def solid_points(room: Room) -> list[np.ndarray]:
    """(P, 3) points inside each object of a room, on a grid, world, m."""
    clouds = []
    for item in room.objects:
        parts = []
        for part in item.parts:
            reach = part.solid.bound[3]
            steps = np.arange(-reach, reach + GRID_M, GRID_M)
            grid = part.solid.bound[:3, None] + np.stack(np.meshgrid(steps, steps, steps)).reshape(3, -1)
            inside = contains(part.solid, grid.astype(np.float32))
            if part.hollow is not None:
                inside &= ~contains(part.hollow, grid.astype(np.float32))
            parts.append(grid[:, inside].T)
        clouds.append(np.concatenate(parts))
    return clouds


class Truth:
    """Relations of a room's objects by its solids: True, False, or None where it is unclear."""

    def __init__(self, room: Room, held: dict[int, tuple[str, int]]):
        """Measures all objects."""
        self.room, self.held = room, held
        self.points = solid_points(room)
        self._images: dict[tuple[int, bytes], tuple[np.ndarray, np.ndarray]] = {}
        count = len(self.points)
        self.low = np.stack([cloud.min(0) for cloud in self.points])
        self.high = np.stack([cloud.max(0) for cloud in self.points])
        self.size = (self.high - self.low).mean(1)
        self.middle = 0.5 * (self.low + self.high)
        self.gap = np.zeros((count, count))
        trees = [KDTree(cloud) for cloud in self.points]
        for a in range(count):
            for b in range(a):
                apart = np.maximum(np.maximum(self.low[a] - self.high[b], self.low[b] - self.high[a]), 0)
                stride = 1 if np.linalg.norm(apart) < 0.05 else 5  # of near ones the gap decides what touches
                nearest = trees[a].query(self.points[b][::stride])[0].min()
                self.gap[a, b] = self.gap[b, a] = max(nearest - GRID_M, 0)
        self.stacked = np.zeros((count, count), bool)
        for k, (_, other) in held.items():
            self.stacked[k, other] = self.stacked[other, k] = True

    def _relative(self, a: int, b: int) -> float:
        return self.gap[a, b] / np.sqrt(self.size[a] * self.size[b])

    def pair(self, relation: str, a: int, b: int, camera: Camera) -> bool | None:
        """Whether `a RELATION b`."""
        if relation in ("left of", "right of"):
            return self._sideways(*((a, b) if relation == "left of" else (b, a)), camera)
        if relation in ("in front of", "behind"):
            return self._in_depth(*((a, b) if relation == "in front of" else (b, a)), camera)
        kind, other = self.held.get(a, ("", -1))
        upper, lower = (a, b) if relation in ("above", "on", "in") else (b, a)
        if relation in ("above", "below", "under"):
            if self.held.get(upper) == ("on", lower) or self.held.get(lower) == ("under", upper):
                return True
            inside = "in" in (self.held.get(a, ("",))[0], self.held.get(b, ("",))[0])
            return None if self.stacked[a, b] and inside else False
        if relation in ("on", "in"):
            if other == b:
                return True if kind == relation else (None if kind != "under" else False)
            return False
        if relation == "touching":
            if self.stacked[a, b]:
                return True if self.gap[a, b] < GRID_M else (None if self.gap[a, b] < 0.03 else False)
            return False if self.gap[a, b] > 0.035 else None
        gap = self._relative(a, b)
        if relation == "next to":
            if self.stacked[a, b]:
                return False
            return True if gap < 0.35 and a not in self.held and b not in self.held else (False if gap > 0.9 else None)
        if relation == "near":
            return True if gap < 0.8 else (False if gap > 1.5 else None)
        return True if gap > 2.6 else (False if gap < 1.5 else None)  # far from

    def _image(self, k: int, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Ends of an object's columns in the image, and of its horizontal distances."""
        pose = np.asarray(camera.world_to_camera, np.float64)
        key = k, pose.tobytes()
        if key not in self._images:
            local = self.points[k] @ pose[:3, :3].T + pose[:3, 3]
            distance = np.linalg.norm((self.points[k] - np.asarray(camera.centres, np.float64))[:, :2], axis=1)
            column = local[:, 0] / local[:, 2]
            self._images[key] = tuple(np.array([x.min(), x.max()]) for x in (column, distance))
        return self._images[key]

    def _offsets(self, a: int, b: int, camera: Camera) -> tuple[float, float]:
        """Distance of a's middle from b's, across the line of sight and along it, m."""
        eye = np.asarray(camera.centres, np.float64)[:2]
        sight = self.middle[b, :2] - eye
        sight = sight / np.linalg.norm(sight)
        step = self.middle[a, :2] - self.middle[b, :2]
        return abs(step @ np.array([sight[1], -sight[0]])), abs(step @ sight)

    def _sideways(self, a: int, b: int, camera: Camera) -> bool | None:
        u, v = self._image(a, camera)[0], self._image(b, camera)[0]
        mid_a, mid_b = 0.5 * (u.min() + u.max()), 0.5 * (v.min() + v.max())
        across, along = self._offsets(a, b, camera)
        if u.max() < mid_b and mid_a < v.min() and across > 0.7 * along:
            return True
        return False if mid_a > mid_b - 0.1 * (np.ptp(u) + np.ptp(v)) else None

    def _in_depth(self, a: int, b: int, camera: Camera) -> bool | None:
        near, far = self._image(a, camera)[1], self._image(b, camera)[1]
        mid_a, mid_b = 0.5 * (near.min() + near.max()), 0.5 * (far.min() + far.max())
        across, along = self._offsets(a, b, camera)
        if near.max() < mid_b and mid_a < far.min() and across < 0.8 * along:
            return True
        apart = across > 5 * along + 0.5 * (self.size[a] + self.size[b])
        return False if mid_a > mid_b - 0.05 * (np.ptp(near) + np.ptp(far)) or apart else None

    def between(self, a: int, b: int, c: int) -> bool | None:
        """Whether a lies between b and c."""
        line = self.middle[c] - self.middle[b]
        length = float(np.linalg.norm(line))
        along = float((self.middle[a] - self.middle[b]) @ line) / length**2
        off = float(np.linalg.norm(self.middle[a] - self.middle[b] - along * line))
        if 0.25 < along < 0.75 and off < 0.18 * length:
            return True
        return False if not -0.05 < along < 1.05 or off > 0.35 * length + 0.5 * self.size[a] else None

    def ranked(self, order: str, members: list[int], camera: Camera) -> list[int] | None:
        """The members in an order, or None if two neighbours in it are too close to tell."""
        volume = np.prod(self.high - self.low, axis=1)
        height = (self.high - self.low)[:, 2]
        eye = np.asarray(camera.centres, np.float64)
        column = np.array([self._image(k, camera)[0].mean() for k in range(len(self.points))])
        distance = np.linalg.norm(self.middle - eye, axis=1)
        values, step = {
            "largest": (-np.log(volume), np.log(1.6)),
            "smallest": (np.log(volume), np.log(1.6)),
            "tallest": (-np.log(height), np.log(1.2)),
            "leftmost": (column, 0.04),
            "rightmost": (-column, 0.04),
            "nearest": (distance, 0.05),
            "farthest": (-distance, 0.05),
        }[order]
        ranked = sorted(members, key=lambda k: values[k])
        steps = np.diff(values[ranked])
        return ranked if (steps > step).all() else None


@dataclasses.dataclass(frozen=True)
class Question:
    """An expression with the indices of the objects that it names."""

    relation: str
    text: str
    frame: int
    right: frozenset[int]


PAIR_RELATIONS = ("left of", "right of", "in front of", "behind", "above", "below", "under", "on", "in", "next to")
PAIR_RELATIONS += ("near", "far from", "touching")


def questions(truth: Truth, cameras: Camera, seed: int) -> list[Question]:
    """Draws expressions about a room: for each relation some with one, none and several right objects."""
    draw = np.random.default_rng([seed, 22])
    names = truth.room.names
    named = dict.fromkeys(filter(None, names))
    members = {name: [k for k, other in enumerate(names) if other == name] for name in named}
    pool: dict[str, list[Question]] = {}
    for frame in draw.choice(len(cameras), FRAMES, replace=False):
        for question in _all_questions(truth, members, cameras[int(frame)], int(frame), draw):
            pool.setdefault(question.relation, []).append(question)
    chosen = []
    for row in pool.values():
        unique = list({(question.text, question.frame): question for question in row}.values())
        for size, number in PER_RELATION.items():
            own = [question for question in unique if min(len(question.right), 2) == size]
            chosen += [own[k] for k in draw.permutation(len(own))[:number]]
    return chosen


def _all_questions(truth: Truth, members: dict, camera: Camera, frame: int, draw) -> Iterator[Question]:
    clear: dict[tuple[str, str, str], frozenset[int]] = {}
    for head, heads in members.items():
        for anchor, anchors in members.items():
            if head == anchor:
                continue
            for relation in PAIR_RELATIONS:
                verdicts = [[truth.pair(relation, a, b, camera) for b in anchors] for a in heads]
                if all(any(row) or None not in row for row in verdicts):
                    right = frozenset(a for a, row in zip(heads, verdicts) if any(row))
                    clear[relation, head, anchor] = right
                    yield Question(relation, f"the {head} {relation} the {anchor}", frame, right)
            gaps = [min(truth.gap[a, b] for b in anchors) for a in heads]
            if len(heads) > 1:
                for relation, sign in (("nearest to", 1), ("farthest from", -1)):
                    ranked = sorted(range(len(heads)), key=lambda k: sign * gaps[k])
                    if abs(gaps[ranked[0]] - gaps[ranked[1]]) > 0.05:
                        right = frozenset([heads[ranked[0]]])
                        yield Question(relation, f"the {head} {relation} the {anchor}", frame, right)
            for other, others in members.items():
                if other in (head, anchor) or len(anchors) + len(others) > 3:
                    continue
                rows = [[truth.between(a, b, c) for b in anchors for c in others] for a in heads]
                if all(any(row) or None not in row for row in rows):
                    right = frozenset(a for a, row in zip(heads, rows) if any(row))
                    yield Question("between", f"the {head} between the {anchor} and the {other}", frame, right)
        yield Question("number", f"how many {head}s", frame, frozenset(heads))
        yield Question("number", f"all {head}s", frame, frozenset(heads))
        for order in ("largest", "smallest", "tallest", "leftmost", "rightmost", "nearest", "farthest"):
            ranked = truth.ranked(order, heads, camera)
            if ranked is not None and len(heads) > 1:
                yield Question(order, f"the {order} {head}", frame, frozenset(ranked[:1]))
                if order == "leftmost" and len(heads) > 2:
                    yield Question("second from", f"the second {head} from the left", frame, frozenset(ranked[1:2]))
    pairs = [key for key in clear if members[key[1]][1:]]
    for key in (pairs[k] for k in draw.permutation(len(pairs))[:60]):
        for other in (other for other in pairs if other[1] == key[1] and other[0] != key[0] and other[2] != key[2]):
            text = f"the {key[1]} {key[0]} the {key[2]} and {other[0]} the {other[2]}"
            yield Question("two relations", text, frame, clear[key] & clear[other])


def true_field(room: Room) -> LanguageField:
    """The field of a room with its true masks, Gaussians from true depth, and regions named by their colours."""
    cameras = room_cameras(room, views=16, width=240, height=180)
    frames, instances, depths = render_views(room, cameras)
    count = len(cameras)
    names = tuple(f"frame_{view + 1:05d}" for view in range(count))
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    capture = Capture(frames, cameras, *nothing, np.zeros(count, bool), depths, np.eye(4), names)
    cloud = points_from_depth(capture, voxel=0.01)
    close = (np.abs(cloud.points[:, :2]) < 0.75).all(1) & (cloud.points[:, 2] > -0.1)
    scene = gaussians_from_points(cloud.points[close], cloud.colors[close], opacity=0.9, scale=0.5, max_scale=0.02)
    scene, cameras = jax.tree.map(jnp.asarray, (scene, cameras))
    return field_of_masks(scene, cameras, frames, instances, len(room.objects))


def field_of_masks(
    scene: Gaussians, cameras: Camera, frames: np.ndarray, instances: np.ndarray, count: int
) -> LanguageField:
    """The field of a scene whose views (T, H, W) show `count` instances, named by their colours."""
    embedder = ColourEmbedder()
    labels = np.asarray(instances, np.int16)
    regions = region_embeddings(frames, labels, embedder.embed_regions, num_regions=count)
    votes = region_votes(scene, cameras, labels, count, by_view=True)
    votes = normalise_votes(votes, regions)
    return LanguageField(
        gaussians=scene,
        votes=votes,
        regions=regions,
        cameras=cameras,
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.eye(4),
        names=tuple(f"frame_{view + 1:05d}" for view in range(len(frames))),
        embedder=embedder.name,
        unrelated_words=np.asarray(embedder.unrelated_words, np.float16),
    )


def demo_room(seed: int) -> tuple[Room, dict[int, tuple[str, int]]]:
    """Makes the room of `jsecon demo`, and what holds some objects, as `relation_room` does."""
    room = crowded_room(seed)
    places = {item.colour: k for k, item in enumerate(room.objects) if item.colour}
    on_plate, plate, beam, arch = (places[c] for c in (ON_PLATE_COLOUR, PLATE_COLOUR, BEAM_COLOUR, ARCH_COLOUR))
    return room, {on_plate: ("on", plate), beam: ("under", arch)}


def default_field(room: Room, folder: Path) -> LanguageField:
    """The field that `jsecon run` makes of a room's photographs, without masks."""
    from jsecon.pipeline import run as pipeline
    from jsecon.pipeline.options import Options
    from jsecon.pipeline.progress import Console

    write_room(folder / "capture", room)
    options = Options(folder / "capture", holdout=5, steps=550, seed=room.seed)
    return pipeline.run(options, folder, console=Console(sys.stdout, sys.stderr)).field


def ask_room(seed: int, vision: str, rooms: Path) -> list[tuple[str, int, int, bool, str]]:
    """Asks the expressions of a room, whose field is kept in a folder.

    Returns:
      Relation, right number, number of the answer, whether it is right, and texts of each expression.
    """
    room, held = relation_room(seed) if vision == "true" else demo_room(seed)
    truth = Truth(room, held)
    folder = rooms / f"{vision}-{seed}"
    if not (folder / "field.safetensors").exists():
        field = true_field(room) if vision == "true" else default_field(room, folder)
        folder.mkdir(parents=True, exist_ok=True)
        save_field(folder / "field.safetensors", field)
    field = load_field(folder / "field.safetensors")
    scene = Scene(field, ColourEmbedder())
    everything = KDTree(np.concatenate(truth.points))
    owner = np.repeat(np.arange(len(truth.points)), [len(cloud) for cloud in truth.points])
    means = np.asarray(field.gaussians.means, np.float64)
    rows = []
    for question in questions(truth, jax.tree.map(np.asarray, field.cameras), seed):
        try:
            answer = scene.relate(question.text, frame=question.frame)
        except InputError as error:
            rows.append((question.relation, len(question.right), -1, False, f"{question.text}: {error}"))
            continue
        names = [np.bincount(owner[everything.query(means[found.rows])[1]]).argmax() for found in answer.objects]
        exact = sorted(names) == sorted(question.right)
        text = f"{seed} #{question.frame} {question.text}: {sorted(map(int, names))} for {sorted(question.right)}; "
        rows.append((question.relation, len(question.right), answer.count, exact, text + answer.describe()))
    return rows


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = tuple(range(50, 70))
    vision: Literal["true", "default"] = "true"
    """Whose masks."""
    rooms: str = "experiments/data/relations"
    """Folder that keeps the fields."""
    out: str = ""


def main(options: Options) -> dict:
    """Asks all rooms, writes the table and returns the figures."""
    out = Path(f"{options.out}_{options.vision}")
    file = out / "run" / "cells.jsonl"
    rows: list = []
    for seed in options.seeds:
        key = f"{options.vision}-{seed}"
        if key not in read_cells(file):
            begin = time.perf_counter()
            append_cell(file, key, ask_room(seed, options.vision, Path(options.rooms)))
            print(f"room {seed}: {time.perf_counter() - begin:.1f} s", flush=True)
        rows += read_cells(file)[key]
    relations = list(dict.fromkeys(row[0] for row in rows))
    figures, lines = {}, []
    for relation in [*relations, "all"]:
        own = [row for row in rows if relation in (row[0], "all")]
        exact = float(np.mean([row[3] for row in own]))
        number = float(np.mean([row[1] == row[2] for row in own]))
        figures[relation] = {"expressions": len(own), "right objects": exact, "right number": number}
        sizes = [sum(min(row[1], 2) == size for row in own) for size in (0, 1, 2)]
        lines.append((relation, len(own), "/".join(map(str, sizes)), exact, number))
    header = ("relation", "expressions", "true number 0/1/more", "right objects", "right number")
    text = results.table(header, lines)
    results.save(out, options, figures, text)
    print(text)
    return figures


if __name__ == "__main__":
    main(results.read_options(Options, "relations", __doc__))
