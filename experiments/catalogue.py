"""The catalogue of a made-up room against its true objects: how many are found, once each, where, and by which colour.

    python -m experiments.catalogue [--seeds 0 1 ...] [--quick]

The rooms are those of `jsecon demo`, with its options: default vision, colours, 24 of 30 frames. The true object of a
Gaussian is the one with most of its weight in the true masks of these frames, or none where the background has more.
Found: an object and a whole of the catalogue overlap by an IoU of at least 0.5 of their Gaussians. One row: of the
objects to which most Gaussians of any row belong, those with exactly one such row. Box: along the axes of the world,
against that of the solids. Named: the best name of a found object is the colour that it was made with; objects without
a name do not count. Located: of the objects with a name of their own, those for which the `center` of `Scene.locate`
lies in the true box; centre and grasp are its median distances to the middle and to the middle of the upper side, mm.
Seeds 20 to 22 chose the constants.
"""

import dataclasses
import json
import time
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

import jsecon
from experiments import results
from experiments.rooms import write_room
from experiments.rooms.room import Room, RoomObject, crowded_room
from experiments.rooms.shapes import ray_interval
from jsecon.app.catalogue import Catalogue
from jsecon.errors import InputError
from jsecon.files import FIELD_FILE
from jsecon.pipeline import run as pipeline
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.progress import Console
from jsecon.read.masks.masks import load_labels
from jsecon.types import LanguageField

FOUND = 0.5
"""IoU from which an object is found."""
GRID = 48
"""Rays along each side of a grid over a solid."""
HOLDOUT = 5
QUICK_ROOM = {"views": 8, "width": 96, "height": 72}


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    quick: bool = False
    """Run one tiny room."""
    rooms: str = str(results.HOME.parent / "demos")
    """Folder that keeps the rooms and their fields."""
    out: str = ""


def field_of_room(folder: Path, seed: int, options: Options) -> LanguageField:
    """The field of a room, which is made unless the folder has it."""
    capture = folder / "capture"
    if not (capture / "scene.json").is_file():
        write_room(capture, crowded_room(seed), holdout=HOLDOUT, **(QUICK_ROOM if options.quick else {}))
    if not (folder / FIELD_FILE).is_file():
        steps = 60 if options.quick else 550
        run = RunOptions(capture, holdout=HOLDOUT, steps=steps, seed=seed)
        pipeline.run(run, folder, console=Console())
    return jsecon.load_field(folder / FIELD_FILE)


def true_objects(field: LanguageField, capture: Path) -> Int[np.ndarray, " n"]:
    """Index of the object of each Gaussian by the true masks, or -1."""
    frames = jsecon.load_capture(capture, holdout=0)
    rows = [frames.names.index(name) for name in field.names]
    labels, ids, _ = load_labels(capture / "masks", frames.names, frames.frames.shape[1:3])
    labels = np.asarray(labels)[rows]
    count = len(json.loads((capture / "scene.json").read_text())["objects"])
    original = np.array([*map(int, ids), 0]) - 1  # pixels hold ids from 1 on; the last is the background
    votes = jsecon.region_votes(field.gaussians, field.cameras, original[labels].astype(np.int16), count)
    best, weight = np.asarray(votes.regions)[:, 0], np.asarray(votes.weights)[:, 0]
    return np.where(2 * weight > np.asarray(votes.total), best, -1)


def true_points(item: RoomObject) -> Float[np.ndarray, "p 3"]:
    """Points of the surfaces of an object's solids, where rays along their axes enter and leave them, world."""
    points = []
    for part in item.parts:
        solid, low, high = part.solid, -np.ones(3), np.ones(3)
        for _ in range(2):  # first within the bounding sphere, then within the sides of what is found
            found = []
            for axis in range(3):
                steps = [np.linspace(low[other], high[other], GRID) for other in np.delete(np.arange(3), axis)]
                starts = np.insert(np.stack(np.meshgrid(*steps)).reshape(2, -1), axis, 0.0, axis=0)
                origin = (solid.bound[:3, None] + solid.bound[3] * (solid.axes @ starts)).astype(np.float32)
                direction = np.repeat(solid.axes[:, axis, None], origin.shape[1], axis=1)
                enter, leave = ray_interval(solid, origin, direction)
                met = leave > enter
                found += [(origin + end * direction)[:, met].T for end in (enter, leave)]
            sides = (np.concatenate(found) - solid.bound[:3]) @ solid.axes / solid.bound[3]
            low, high = sides.min(0), sides.max(0)
        points += found
    return np.concatenate(points)


def box_iou(low: np.ndarray, high: np.ndarray, points: np.ndarray) -> float:
    """IoU of a box along the axes of the world and that of points."""
    sides = np.minimum(high, points.max(0)) - np.maximum(low, points.min(0))
    both = np.prod(np.maximum(sides, 0))
    return float(both / (np.prod(high - low) + np.prod(np.ptp(points, axis=0)) - both))


def located(field: LanguageField, room: Room) -> tuple[float, float, float]:
    """Share of the objects with a name of their own that are located, and the median errors of centre and grasp, mm."""
    names = [item.name for item in room.objects]
    inside, centres, grasps = [], [], []
    for item in (item for item in room.objects if item.name and names.count(item.name) == 1):
        points = true_points(item)
        low, high = points.min(0), points.max(0)
        middle, top = (low + high) / 2, np.array([*(low + high)[:2] / 2, high[2]])
        try:
            place = jsecon.Scene(field).locate(item.name).place
        except InputError as error:
            print(f"  not located: {item.name}: {error}")
            inside.append(False)
            continue
        inside.append(bool(((place.center >= low) & (place.center <= high)).all()))
        centres.append(1000 * np.linalg.norm(place.center - middle))
        grasps.append(1000 * np.linalg.norm([*place.center[:2], place.high[2]] - top))
    return float(np.mean(inside)), float(np.median(centres)), float(np.median(grasps))


def compare(
    catalogue: Catalogue, field: LanguageField, truth: Int[np.ndarray, " n"], room: Room, seconds: float
) -> dict[str, float]:
    """Compares a catalogue with the objects of a room.

    `found_named` counts the objects with a name; the others are boxes of 3 to 6 cm. `surroundings` is the share of the
    found objects that are taken for surroundings.
    """
    wholes = np.flatnonzero(catalogue.parent < 0)
    count = len(room.objects)
    table = np.zeros((len(catalogue) + 1, count + 1), int)
    np.add.at(table, (catalogue.labels, truth), 1)  # -1 is the last
    both = table[wholes, :count]
    iou = both / np.maximum(table[wholes].sum(1)[:, None] + table[:, :count].sum(0) - both, 1)
    best = iou.argmax(0)
    has_name = np.array([bool(item.name) for item in room.objects])
    seen = table[:, :count].sum(0) > 0
    found = np.flatnonzero(iou.max(0) >= FOUND)
    most = np.bincount(table[wholes].argmax(1), minlength=count + 1)[:count]
    boxes, named = [], []
    for k in found:
        row, item = int(wholes[best[k]]), room.objects[k]
        points = true_points(item)
        boxes.append(box_iou(catalogue.shapes.low[row], catalogue.shapes.high[row], points))
        if item.name:
            named.append(catalogue.names[row] == item.colour)
    share, centre, grasp = located(field, room)
    return dict(
        objects=int(seen.sum()),
        rows=int((~catalogue.surroundings[wholes]).sum()),
        found=len(found) / int(seen.sum()),
        found_named=float((iou.max(0) >= FOUND)[seen & has_name].mean()),
        one_row=float((most[most > 0] == 1).mean()),
        box=float(np.median(boxes)),
        named=float(np.mean(named)),
        located=share,
        centre=centre,
        grasp=grasp,
        surroundings=float(catalogue.surroundings[wholes[best[found]]].mean()),
        seconds=seconds,
    )


def main(options: Options) -> str:
    """Measures, writes the results and returns the table."""
    metrics: dict[str, dict] = {}
    for seed in options.seeds:
        folder = Path(options.rooms) / f"{'quick-' if options.quick else ''}{seed}"
        field = field_of_room(folder, seed, options)
        jsecon.objects(field)  # compiles
        started = time.perf_counter()
        catalogue = jsecon.objects(field)
        seconds = time.perf_counter() - started
        figures = compare(catalogue, field, true_objects(field, folder / "capture"), crowded_room(seed), seconds)
        metrics[f"seed {seed}"] = figures
        print(seed, figures, flush=True)
    names = list(next(iter(metrics.values())))
    rows = [(seed, *(row[name] for name in names)) for seed, row in metrics.items()]
    metrics["mean"] = {name: float(np.mean([row[name] for row in metrics.values()])) for name in names}
    text = results.table(("room", *names), [*rows, ("mean", *metrics["mean"].values())])
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "catalogue", __doc__, {"seeds": (0,)}))
