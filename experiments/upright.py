"""Is the up axis of a bare scene right, and is a wrong one said to be unsure?

    python -m experiments.upright [--seeds 6]

Made-up scenes of points on surfaces, as `jsecon.views.frame.surface_points` draws them: rooms, corridors, tables with
and without a floor, shelves, a facade. Each is turned at random, and has noise of 0.2 % of its size. Up is right within
11 degrees. Of the last three kinds nobody can tell up; they only count where up is said to be sure.
"""

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from experiments import results
from jsecon.views.upright import find_up

POINTS, NOISE = 20_000, 0.002
Parts = list[np.ndarray]


class Maker:
    """Draws points on surfaces, z up, m.

    Args:
      draw: Source of random numbers.
      density: Points per square metre.
    """

    def __init__(self, draw: np.random.Generator, density: float):
        self.draw, self.density = draw, density

    def sheet(self, corner, first, second, times=1.0) -> np.ndarray:
        """Points of a parallelogram."""
        first, second = np.asarray(first, float), np.asarray(second, float)
        count = max(int(times * self.density * np.linalg.norm(np.cross(first, second))), 8)
        along = self.draw.random((count, 2))
        return np.asarray(corner) + along[:, :1] * first + along[:, 1:] * second

    def box(self, center, size, *, times=2.0, bottom=False, turn=0.0) -> np.ndarray:
        """Points of the faces of a box."""
        x, y, z = np.diag(size)
        low = -0.5 * np.asarray(size)
        faces = [(low + z, x, y), (low, x, z), (low, y, z), (low + y, x, z), (low + x, y, z)]
        points = np.concatenate([self.sheet(*face, times) for face in faces + [(low, x, y)] * bottom])
        return points @ Rotation.from_euler("z", turn).as_matrix().T + center

    def ball(self, center, radius, times=2.0) -> np.ndarray:
        """Points of a sphere."""
        points = self.draw.normal(size=(max(int(times * self.density * 12.6 * radius**2), 8), 3))
        return center + radius * points / np.linalg.norm(points, axis=1, keepdims=True)

    def cylinder(self, center, radius, height, times=2.0) -> np.ndarray:
        """Points of a cylinder without its bottom."""
        count = max(int(times * self.density * 6.3 * radius * height), 8)
        top = max(int(times * self.density * 3.1 * radius**2), 4)
        turn = 2 * np.pi * self.draw.random(count + top)
        r = radius * np.where(np.arange(count + top) < count, 1.0, np.sqrt(self.draw.random(count + top)))
        z = np.concatenate([height * (self.draw.random(count) - 0.5), np.full(top, 0.5 * height)])
        return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1) + center

    def things(self, count, x, y, z, size) -> Parts:
        """Balls, boxes and cylinders that stand at a height z."""
        parts = []
        for _ in range(count):
            s = size * np.exp(self.draw.uniform(-0.6, 0.6))
            px, py = self.draw.uniform(*x), self.draw.uniform(*y)
            kind = self.draw.integers(3)
            if kind == 0:
                parts.append(self.ball([px, py, z + s / 2], s / 2))
            elif kind == 1:
                sides = s * self.draw.uniform(0.5, 1.5, 3)
                parts.append(self.box([px, py, z + sides[2] / 2], sides, turn=self.draw.uniform(0, 3)))
            else:
                height = s * self.draw.uniform(0.7, 2.5)
                parts.append(self.cylinder([px, py, z + height / 2], 0.3 * s, height))
        return parts

    def beam(self, center, size) -> np.ndarray:
        """Points of all faces of a leg or a board, as many as on the surfaces around it."""
        return self.box(center, size, times=1, bottom=True)

    def table(self, things, *, underside=True) -> Parts:
        """A table with four legs, and things on it."""
        x, y, z = self.draw.uniform(0.8, 2), self.draw.uniform(0.6, 1), self.draw.uniform(0.5, 0.8)
        parts = [self.box([x / 2, y / 2, z - 0.02], [x, y, 0.04], times=1, bottom=underside)]
        corners = itertools.product((0.06, x - 0.06), (0.06, y - 0.06))
        parts += [self.beam([*corner, z / 2 - 0.02], [0.05, 0.05, z - 0.04]) for corner in corners]
        return parts + self.things(things, (0.15, x - 0.15), (0.15, y - 0.15), z, self.draw.uniform(0.1, 0.25))


Kind = Callable[[Maker], Parts]


def _indoors(low, high, *, size, ceiling, walls=(4, 5), things=(3, 8), lamps=False) -> Kind:
    """A floor with some of four walls, things on it, and a ceiling with a probability, with lamps on cords."""

    def make(m: Maker) -> Parts:
        x, y, z = m.draw.uniform(low, high)
        count, length = m.draw.integers(*things), m.draw.uniform(*size)
        number = m.draw.integers(*walls)
        covered = ceiling == 1 or m.draw.random() < ceiling
        a, b, c = np.diag([x, y, z])
        sides = [(0 * a, a, c), (0 * a, b, c), (b, a, c), (a, b, c)]
        parts = [m.sheet(0 * a, a, b), *(m.sheet(*sides[k]) for k in m.draw.permutation(4)[:number])]
        parts += [m.sheet(c, a, b)] * covered
        parts += m.things(count, (0.2 * x, 0.8 * x), (0.2 * y, 0.8 * y), 0, length)
        for _ in range(m.draw.integers(1, 4) if lamps else 0):
            px, py, cord = m.draw.uniform([0.5, 0.5, 0.2], [x - 0.5, y - 0.5, 0.5])
            parts += [m.cylinder([px, py, z - cord / 2], 0.02, cord, 10), m.ball([px, py, z - cord - 0.1], 0.12)]
        return parts

    return make


def _wall_with_floor(low, high, size, *, pictures=False) -> Kind:
    def make(m: Maker) -> Parts:
        x, y, z = m.draw.uniform(low, high)
        parts = [m.sheet([0, 0, 0], [x, 0, 0], [0, y, 0]), m.sheet([0, 0, 0], [x, 0, 0], [0, 0, z])]
        count, length = m.draw.integers(3, 8), m.draw.uniform(*size)
        parts += m.things(count, (0.1 * x, 0.9 * x), (0.2 * y, 0.8 * y), 0, length)
        if pictures:
            x, z = parts[1].max(0)[[0, 2]]
            sizes = m.draw.uniform([0.4, 0.06, 0.3], [0.9, 0.06, 0.8], (m.draw.integers(1, 4), 3))
            places = m.draw.uniform([0.5, 0.04, 1.2], [x - 0.5, 0.04, z - 0.5], (len(sizes), 3))
            parts += map(m.box, places, sizes)
        return parts

    return make


def _pedestal(m: Maker) -> Parts:
    r, z = m.draw.uniform(0.4, 0.7), m.draw.uniform(0.6, 0.9)
    discs = ((z - 0.02, r, 0.04), (z / 2, 0.05, z), (0.02, 0.3, 0.04))
    parts = [m.cylinder([0, 0, middle], radius, height, 1) for middle, radius, height in discs]
    return parts + m.things(m.draw.integers(2, 6), (-0.3, 0.3), (-0.3, 0.3), z, m.draw.uniform(0.1, 0.25))


def _table_on_floor(m: Maker) -> Parts:
    r = m.draw.uniform(0.5, 1.5)
    floor = m.sheet([-r, -r, 0], [2 * r + 1.4, 0, 0], [0, 2 * r + 0.8, 0], m.draw.uniform(0.2, 1))
    return [*m.table(m.draw.integers(2, 8)), floor]


def _desk_at_wall(m: Maker) -> Parts:
    x, y, z = m.draw.uniform([1.2, 0.5, 1], [2, 0.8, 2])
    parts = [m.sheet([0, 0, 0.75], [x, 0, 0], [0, y, 0]), m.sheet([-0.3, 0, 0.45], [x + 0.6, 0, 0], [0, 0, z])]
    return parts + m.things(m.draw.integers(3, 8), (0.1, x - 0.1), (0.12, y - 0.1), 0.75, m.draw.uniform(0.1, 0.25))


def _shelf(m: Maker) -> Parts:
    x, y, z = m.draw.uniform(0.8, 1.5), 0.3, m.draw.uniform(1.4, 2)
    parts = [m.sheet([0, 0, 0], [x, 0, 0], [0, 0, z])]
    parts += [m.sheet([side, 0, 0], [0, y, 0], [0, 0, z]) for side in (0, x)]
    for level in np.linspace(0.05, z, 5):
        parts.append(m.sheet([0, 0, level], [x, 0, 0], [0, y, 0]))
        count = m.draw.integers(2, 6) if level < z - 0.1 else 0
        parts += m.things(count, (0.1, x - 0.1), (0.1, y - 0.05), level, m.draw.uniform(0.1, 0.2))
    return parts


def _chair(m: Maker) -> Parts:
    back = m.draw.uniform(0.4, 0.6)
    parts = [m.beam([0.22, 0.22, 0.45], [0.45, 0.45, 0.04]), m.beam([0.22, 0.02, 0.45 + back / 2], [0.45, 0.03, back])]
    corners = itertools.product((0.03, 0.42), repeat=2)
    return parts + [m.beam([*corner, 0.225], [0.04, 0.04, 0.45]) for corner in corners]


def _outdoors(m: Maker) -> Parts:
    r = m.draw.uniform(3, 8)
    ground = m.cylinder([0, 0, 0], r, 0.0, 1)
    sky = m.draw.normal(size=(3200, 3))
    sky[:, 2] = np.abs(sky[:, 2])
    sky *= r * m.draw.uniform(1, 1.6, (3200, 1)) / np.linalg.norm(sky, axis=1, keepdims=True)
    reach = -r / 3, r / 3
    return [ground, sky, *m.things(m.draw.integers(2, 8), reach, reach, 0, m.draw.uniform(0.4, 1.5))]


def _table_top(m: Maker) -> Parts:
    x, y = m.draw.uniform(0.8, 2), m.draw.uniform(0.6, 1)
    things = m.things(m.draw.integers(2, 8), (0.15, x - 0.15), (0.15, y - 0.15), 0, m.draw.uniform(0.1, 0.3))
    return [m.sheet([0, 0, 0], [x, 0, 0], [0, y, 0]), *things]


def _floating(m: Maker) -> Parts:
    return [m.ball(m.draw.uniform(-1, 1, 3), m.draw.uniform(0.2, 0.4)) for _ in range(m.draw.integers(1, 5))]


def _board(m: Maker) -> Parts:
    parts = [m.sheet([-2, 0, -1], [6, 0, 0], [0, 0, 3])]
    for _ in range(m.draw.integers(2, 6)):
        place = m.draw.uniform([-1.5, -0.03, -0.5], [3.5, -0.03, 1.5])
        parts.append(m.box(place, m.draw.uniform([0.3, 0.05, 0.3], [0.8, 0.05, 0.8])))
    return parts


KINDS: dict[str, tuple[float, Kind]] = {
    "room": (400, _indoors((3, 3, 2.2), (6, 6, 3), size=(0.2, 0.9), ceiling=0.4, walls=(2, 5), things=(3, 10))),
    "room with lamps": (400, _indoors((3, 3, 2.4), (6, 6, 3), size=(0.3, 0.9), ceiling=1, lamps=True)),
    "corridor": (400, _indoors((5, 0.9, 2.4), (9, 1.5, 4), size=(0.2, 0.5), ceiling=0.5)),
    "closet": (
        1200,
        _indoors((0.8, 0.8, 2.4), (1.3, 1.3, 3.2), size=(0.15, 0.4), ceiling=0.5, walls=(3, 4), things=(3, 7)),
    ),
    "wall and a narrow floor": (400, _wall_with_floor((3, 0.8, 3), (6, 1.8, 5), (0.2, 0.5))),
    "the same with pictures": (400, _wall_with_floor((3, 0.8, 3), (6, 1.8, 5), (0.2, 0.5), pictures=True)),
    "facade": (120, _wall_with_floor((8, 1.5, 6), (14, 3, 10), (0.5, 1.2))),
    "table with legs, no floor": (3600, lambda m: m.table(m.draw.integers(2, 8))),
    "the same from above": (3600, lambda m: m.table(m.draw.integers(2, 8), underside=False)),
    "table with one thing": (3600, lambda m: m.table(1)),
    "bare table": (3600, lambda m: m.table(0)),
    "table on a pedestal": (3600, _pedestal),
    "table on a floor": (3600, _table_on_floor),
    "table top alone": (3600, _table_top),
    "desk at a wall": (2800, _desk_at_wall),
    "shelf": (2400, _shelf),
    "chair": (6000, _chair),
    "outdoors with sky": (240, _outdoors),
    "floating balls": (3200, _floating),
    "pictures on a wall": (1200, _board),
    "crate": (8000, lambda m: [m.beam([0, 0, 0], m.draw.uniform(0.3, 1, 3))]),
}
"""kind -> points per square metre, and its maker"""
UNKNOWABLE = ("floating balls", "pictures on a wall", "crate")


def scene(kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(P, 3) points of a scene, and its up axis (3,)."""
    draw = np.random.default_rng([seed, list(KINDS).index(kind)])
    density, make = KINDS[kind]
    points = np.concatenate(make(Maker(draw, density)))
    size = np.linalg.norm(np.quantile(points, 0.98, axis=0) - np.quantile(points, 0.02, axis=0))
    points = draw.permutation(points)[:POINTS]
    points = points + draw.normal(0, NOISE * size, points.shape)
    turn = Rotation.random(random_state=seed).as_matrix()
    return points @ turn.T, turn[:, 2]


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: int = 6
    """Scenes of each kind."""
    out: str = ""


def main(options: Options) -> dict:
    """Finds up in all scenes, writes the table and returns the figures."""
    figures = {}
    for kind in KINDS:
        counts = np.zeros(3, int)
        for seed in range(options.seeds):
            points, up = scene(kind, seed)
            found, sure, _ = find_up(points)
            right = bool(found @ up > np.cos(np.radians(11)))
            counts += right, right and sure, sure and not right
        figures[kind] = dict(zip(("right", "right and sure", "wrong and sure"), counts.tolist()))
    rows = [(kind, options.seeds, *figures[kind].values()) for kind in KINDS]
    known = np.array([row[1:] for row in rows if row[0] not in UNKNOWABLE]).sum(0)
    rows.append(("all of which up can be told", *known.tolist()))
    table = results.table(("kind", "scenes", "right", "right and sure", "wrong and sure"), rows)
    print(table)
    results.save(Path(options.out), options, figures, table)
    return figures


if __name__ == "__main__":
    main(results.read_options(Options, "upright", __doc__))
