"""What changed in made-up rooms: is each change found, with its kind, and is nothing found where nothing changed?

    python -m experiments.changes [--seeds FIRST LAST] [--quick]

Ray-traced rooms (the ray tracer shares no code with the renderer) of nine things on a table. The field of a room has
its true masks, and Gaussians from true depth. Then the room is changed, lit anew or photographed with another exposure,
and photographed from other places, with poses: RGB with true poses, and RGB-D with noise of 1 cm and of 0.5 degrees.

AP is that of SceneDiff with the kind of change: changes of all rooms, the most probable first, also those too unsure to
be reported, are right if their masks in the new photographs have an IoU of at least 0.5 with those of a true change of
the same kind. Masks are the pixels where the thing would be seen had nothing changed (gone, moved) and where it is seen
now (new, moved). A turned thing counts as moved. The other columns count what is reported. Things that moved or are
gone are asked for by their colours in the updated field, and in the field as it was. The seeds 0 to 4 chose the
constants.
"""

import dataclasses
import time
from pathlib import Path

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from experiments import results
from experiments.cells import append_cell, read_cells
from experiments.relations import SRGB, field_of_masks
from experiments.rooms.capture import look_at, room_cameras
from experiments.rooms.raycast import render_views, trace_rays
from experiments.rooms.room import Room, build_room, footprint_radius, place_object, scatter_circles
from experiments.rooms.shapes import SHAPES
from jsecon import Scene
from jsecon.app.comparison import Changes
from jsecon.field.field import load_field, save_field
from jsecon.fit.start import points_from_depth
from jsecon.query.render import HIDDEN_LOGIT
from jsecon.splat.points import gaussians_from_points
from jsecon.types import Camera, Capture, LanguageField
from jsecon.vision.colours import ColourEmbedder

KINDS = ("remove", "move", "add", "swap", "turn", "nothing", "other light", "other exposure")
UNTURNED = ("box", "mug", "kettle", "pot", "teddy")
"""Shapes that look another way when they are turned."""
SIZE = {"width": 160, "height": 120}
GAUSSIANS = 26_000
"""Gaussians of each field, with transparent ones, so that all rooms share their programs."""
FOUND_M = 0.05
"""Distance of an answer's middle from that of the thing, along the table, up to which it is found at its place, m."""


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
    chosen = np.random.default_rng(0).permutation(len(points))[:GAUSSIANS]
    scene = gaussians_from_points(points[chosen], colours[chosen], opacity=0.9, scale=0.5, max_scale=0.08)
    more = GAUSSIANS - len(chosen)
    scene = jax.tree.map(lambda a: np.concatenate([a, np.repeat(np.asarray(a)[:1], more, 0)]), scene)
    logits = np.where(np.arange(GAUSSIANS) < len(chosen), scene.opacity_logits, np.float32(HIDDEN_LOGIT))
    scene = dataclasses.replace(scene, opacity_logits=logits)
    return field_of_masks(scene, cameras, frames, instances, len(room.objects))


def photographs(seed: int, kind: str, count: int) -> dict[str, np.ndarray]:
    """New photographs of a changed room, with depth and the instances before and after."""
    case = make_case(seed, kind)
    cameras = new_cameras(seed + 1000 * KINDS.index(kind), count)
    before, after = make_room(case.before, seed), make_room(case.after, seed, case.light)
    frames, instances, depths = render_views(after, cameras, coarser=2)
    if case.exposure != 1:
        linear = (frames / 255.0) ** 2.2 * case.exposure
        frames = (255 * np.clip(linear, 0, 1) ** (1 / 2.2)).round().astype(np.uint8)
    owners = np.array([part.owner for part in before.parts] + [-1], np.int16)
    old = np.stack([owners[trace_rays(before, camera)[1]] for camera in cameras])
    return {"frames": frames, "after": instances, "depths": depths, "before": old}


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, int] = (100, 106)
    """First seed, and the one after the last."""
    counts: tuple[int, ...] = (1, 3)
    """Numbers of photographs."""
    quick: bool = False
    """Measure one room with three photographs."""
    rooms: str = "experiments/data/changes"
    """Folder that keeps fields and photographs."""
    only_make: bool = False
    """Make the rooms, and measure nothing."""
    out: str = ""


def load_case(folder: Path, seed: int, kind: str, count: int) -> dict[str, np.ndarray]:
    """The photographs of a case, which are made once."""
    file = folder / f"{seed}-{kind.replace(' ', '-')}.npz"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(file, **photographs(seed, kind, count))
    with np.load(file) as stored:
        return dict(stored)


def load_room_field(folder: Path, seed: int) -> LanguageField:
    """The field of a room, which is made once."""
    file = folder / f"{seed}.safetensors"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        save_field(file, room_field(make_room(make_case(seed, "nothing").before, seed)))
    return load_field(file)


def new_capture(shots: dict[str, np.ndarray], cameras: Camera, chosen: np.ndarray, seed: int, depth: bool) -> Capture:
    """Some of the photographs as a capture; with depth there is noise of 1 cm, and of 0.5 degrees of the poses."""
    draw, poses, depths = np.random.default_rng([seed, 35]), np.array(cameras.world_to_camera)[chosen], None
    if depth:
        depths = (shots["depths"][chosen] + draw.normal(0, 0.01, shots["depths"][chosen].shape)).astype(np.float32)
        axes = draw.normal(size=(len(chosen), 3))
        turns = Rotation.from_rotvec(np.radians(0.5) * axes / np.linalg.norm(axes, axis=1, keepdims=True)).as_matrix()
        poses[:, :3] = turns @ poses[:, :3]
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    views = dataclasses.replace(cameras[chosen], world_to_camera=poses.astype(np.float32))
    names = tuple(f"new_{n:03d}" for n in chosen)
    return Capture(shots["frames"][chosen], views, *nothing, np.zeros(len(chosen), bool), depths, np.eye(4), names)


def judge(changes: Changes, case: Case, shots: dict[str, np.ndarray], chosen: np.ndarray) -> dict:
    """Compares the changes of a case with the truth.

    Returns:
      "found": (probability, whether it is right, its kind, whether it is reported) of each change; "truth": number of
      true changes; "moved": of each true moved thing that a right change found, the error of its place, m, and whether
      it has its id.
    """
    before, after = shots["before"][chosen], shots["after"][chosen]
    truth = []
    for kind, i, j in case.changes:
        masks = np.stack([(before == i) & (i >= 0), (after == j) & (j >= 0)])
        truth.append((kind, i, j, masks))
    found, moved, taken = [], [], set()
    records = changes.records()
    order = sorted(range(len(records)), key=lambda n: -records[n]["probability"])
    for n in order:
        change, record = changes.found[n], records[n]
        likeliest = change.suspected or change.kind
        if likeliest in ("same", "not seen"):
            continue
        masks = np.stack([change.before & (likeliest != "new"), change.after & (likeliest != "gone")])
        ious = [
            (masks & true).sum() / max((masks | true).sum(), 1) if kind == likeliest and k not in taken else 0.0
            for k, (kind, _, _, true) in enumerate(truth)
        ]
        best = int(np.argmax(ious)) if ious else -1
        right = best >= 0 and ious[best] >= 0.5
        found.append((record["probability"], bool(right), likeliest, not change.suspected))
        if right:
            taken.add(best)
            _, i, j, _ = truth[best]
            if likeliest == "moved":
                spot = change.motion[:3, :3] @ [*case.before[i].spot, 0] + change.motion[:3, 3]
                error = float(np.linalg.norm(spot[:2] - case.after[j].spot))
                moved.append((error, record["region"] == i))
    return {"found": found, "truth": len(truth), "moved": moved}


def ask_updated(scene: Scene, changes: Changes, case: Case) -> list[tuple[str, bool, bool]]:
    """Asks for each thing that moved or is gone by its colour, in the updated field and in the field as it was.

    Returns:
      The kind, and whether the answers of the two are right: at the new place, or no Gaussian.
    """
    known = dataclasses.replace(changes, found=tuple(change for change in changes.found if change.object >= 0))
    rows, new = [], scene.update(known, date="2026-11-28")  # what is new would need a ledger

    def is_right(asked: Scene, kind: str, i: int, j: int) -> bool:
        answer = asked.ask(case.before[i].colour)
        if kind == "gone":
            return not answer.mask.any()
        return bool(answer.mask.any()) and np.linalg.norm(answer.place.center[:2] - case.after[j].spot) < FOUND_M

    for kind, i, j in case.changes:
        if kind != "new":
            rows.append((kind, bool(is_right(new, kind, i, j)), bool(is_right(scene, kind, i, j))))
    return rows


def average_precision(found: list[tuple[float, bool]], truth: int) -> float:
    """Area under precision over recall, of changes with probabilities."""
    order = sorted(found, key=lambda pair: -pair[0])
    right = np.array([pair[1] for pair in order], float)
    precision = np.cumsum(right) / np.arange(1, len(right) + 1) if len(right) else np.zeros(0)
    best = np.maximum.accumulate(precision[::-1])[::-1] if len(right) else precision
    return float((best * right).sum() / max(truth, 1))


def measure_room(seed: int, options: Options) -> dict:
    """Measures all cases of a room: by the kind of case, the number of photographs and whether they have depth."""
    folder, rows = Path(options.rooms), {}
    most = max(options.counts)
    field = load_room_field(folder, seed)
    for kind in KINDS:
        shots = load_case(folder, seed, kind, most)
        if options.only_make:
            continue
        cameras, case = new_cameras(seed + 1000 * KINDS.index(kind), len(shots["frames"])), make_case(seed, kind)
        for count in options.counts:
            chosen = np.linspace(0, len(shots["frames"]), count, endpoint=False).astype(int)
            for depth in (False, True):
                scene = Scene(field, ColourEmbedder())
                _ = scene.objects()
                began = time.perf_counter()
                changes = scene.changes(new_capture(shots, cameras, chosen, seed, depth))
                seconds = time.perf_counter() - began
                rows[f"{kind}, {count}, {'RGB-D' if depth else 'RGB'}"] = {
                    **judge(changes, case, shots, chosen),
                    "seconds": seconds,
                    "asked": ask_updated(scene, changes, case) if kind in ("remove", "move") else [],
                }
    return rows


def main(options: Options) -> dict:
    """Measures all rooms, writes the tables and returns the figures."""
    out, rows = Path(options.out), {}
    file = out / "run" / "cells.jsonl"
    for seed in range(*options.seeds):
        key = f"{seed} {options.counts}"
        if options.only_make:
            measure_room(seed, options)
        elif key not in read_cells(file):
            append_cell(file, key, measure_room(seed, options))
        print(seed, flush=True)
        rows[seed] = {} if options.only_make else read_cells(file)[key]
    if options.only_make:
        return {}
    figures, lines, kinds = {}, [], []
    for count in options.counts:
        for sensor in ("RGB", "RGB-D"):
            cells = {kind: [rows[seed][f"{kind}, {count}, {sensor}"] for seed in rows] for kind in KINDS}
            every = [cell for column in cells.values() for cell in column]
            found = [tuple(pair) for cell in every for pair in cell["found"]]
            moved = [pair for cell in every for pair in cell["moved"]]
            reported = {k: [pair for cell in cells[k] for pair in cell["found"] if pair[3]] for k in KINDS}
            quiet = {k: len(reported[k]) for k in KINDS[5:]}
            figures[f"{count} {sensor}"] = figure = {
                "AP": average_precision(found, sum(cell["truth"] for cell in every)),
                "false in nothing": quiet["nothing"],
                "false in other light": quiet["other light"],
                "false in other exposure": quiet["other exposure"],
                "place of moved, cm": 100 * float(np.median([error for error, _ in moved])) if moved else float("nan"),
                "same id": float(np.mean([same for _, same in moved])) if moved else float("nan"),
                **{
                    f"{words}, {when}": float(
                        np.mean([row[n] for cell in every for row in cell["asked"] if row[0] == kind])
                    )
                    for kind, words in (("moved", "moved found"), ("gone", "gone refused"))
                    for n, when in ((1, "updated"), (2, "as it was"))
                },
                "seconds, median": float(np.median([cell["seconds"] for cell in every])),
            }
            lines.append((count, sensor, *figure.values()))
            parts = []
            for kind in KINDS[:5]:
                right = sum(pair[1] for pair in reported[kind])
                wrong = len(reported[kind]) - right
                parts.append(f"{right} of {sum(cell['truth'] for cell in cells[kind])}, {wrong} false")
            kinds.append((count, sensor, *parts))
    header = ("photographs", "sensor", *next(iter(figures.values())))
    text = results.table(header, lines) + "\n\n" + results.table(("photographs", "sensor", *KINDS[:5]), kinds)
    results.save(out, options, figures, text)
    print(text)
    return figures


if __name__ == "__main__":
    main(results.read_options(Options, "changes", __doc__, {"seeds": (100, 101), "counts": (3,)}))
