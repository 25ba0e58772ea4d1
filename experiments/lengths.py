"""Lengths between things of made-up rooms after one known length, and volumes of their solids.

    python -m experiments.lengths [--seeds 0 1 2 3 4] [--rooms FOLDER]

Rooms and fields (own masks) come from experiments/demo_rooms.py, things from their scene.json: those with a name of
their own that `Scene.locate` finds. The known length is that between the two things farthest apart, and `Scene.measure`
then gives all others in metres. True ends are the middles of the boxes of the solids. "Any" takes each length in turn
for the known one. Volumes are those of the convex hulls, and of the best primitives, over that of the hull of the
truth.
"""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

import jsecon
from experiments import results
from experiments.catalogue import true_points
from experiments.demo_rooms import fields_of_room
from experiments.rooms.room import Room, crowded_room
from jsecon.app.records import source_points
from jsecon.errors import InputError
from jsecon.query.solids import object_solid, object_surfaces
from jsecon.types import LanguageField


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    quick: bool = False
    """Measure one tiny room."""
    rooms: str = str(results.HOME.parent / "demos")
    """Folder that keeps the rooms and their fields."""
    out: str = ""


def measure(field: LanguageField, room: Room) -> dict[str, float]:
    """The figures of a room."""
    scene, names = jsecon.Scene(field), [item.name for item in room.objects]
    middles, found, labels = {}, [], np.full(field.gaussians.count, -1)
    for item in room.objects:
        try:
            if not item.name or names.count(item.name) > 1:
                continue
            answer = scene.locate(item.name)
        except InputError as error:
            print(f"  not located: {item.name}: {error}")
            continue
        points = true_points(item)
        middles[item.name] = (points.min(0) + points.max(0)) / 2
        labels[answer.rows] = len(found)
        found.append((answer.place, ConvexHull(points).volume))
    volumes = []
    for points, (place, volume) in zip(object_surfaces(field.gaussians, field.cameras, labels), found):
        hull, primitive = object_solid(source_points(field, points), place).values()
        a, *rest = size = primitive["size"]
        kinds = {"box": np.prod(size), "cylinder": np.pi * a**2 * sum(rest), "sphere": 4 / 3 * np.pi * a**3}
        volumes.append(np.array([hull["volume"], kinds[primitive["type"]]]) / volume)
    pairs = [*itertools.combinations(middles, 2)]
    true = np.array([np.linalg.norm(middles[a] - middles[b]) for a, b in pairs])
    known = int(true.argmax())
    scaled = scene.scaled(*pairs[known], float(true[known]))
    found = np.array([scaled.measure(*pair)["centers"] for pair in pairs])
    error = np.delete(np.abs(found / true - 1), known)
    ratio = found / true
    off = np.abs(ratio[None] / ratio[:, None] - 1)[~np.eye(len(pairs), dtype=bool)]
    hull, primitive = np.median(volumes, axis=0)
    figures = {"lengths": len(error), "error": np.median(error), "90 %": np.quantile(error, 0.9), "any": np.median(off)}
    near = np.abs(np.array(volumes)[:, 0] - 1)
    figures |= {"hull": hull, "primitive": primitive, "hull off": np.median(near), "within 10 %": np.mean(near < 0.1)}
    return {name: float(value) for name, value in figures.items()}


def main(options: Options) -> str:
    """Measures, writes the results and returns the table."""
    metrics: dict[str, dict] = {}
    for seed in options.seeds:
        folder = Path(options.rooms) / f"{'quick-' if options.quick else ''}{seed}"
        run, _ = fields_of_room(folder, seed, options.quick)
        metrics[f"room {seed}"] = measure(run.field, crowded_room(seed))
        print(seed, metrics[f"room {seed}"], flush=True)
    names = list(next(iter(metrics.values())))
    rows = [(room, *(f"{row[name]:.4f}" for name in names)) for room, row in metrics.items()]
    mean = {name: float(np.mean([row[name] for row in metrics.values()])) for name in names}
    text = results.table(("room", *names), [*rows, ("mean", *(f"{value:.4f}" for value in mean.values()))])
    results.save(Path(options.out), options, metrics | {"mean": mean}, text)
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "lengths", __doc__, {"seeds": (0,)}))
