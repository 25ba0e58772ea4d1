"""What changed in made-up rooms: is each change found, with its kind, and is nothing found where nothing changed?

    python -m experiments.changes [--seeds FIRST LAST] [--counts 1 3] [--rooms FOLDER]

Ray-traced rooms (the ray tracer shares no code with the renderer) of nine things on a table. The field of a room has
its true masks, and Gaussians from true depth. Then the room is changed, lit anew or photographed with another exposure,
and photographed from other places, with poses: RGB with true poses, and RGB-D with noise of 1 cm and of 0.5 degrees.

AP is that of SceneDiff with the kind of change: changes of all rooms, the most probable first, also those too unsure to
be reported, are right if their masks in the new photographs have an IoU of at least 0.5 with those of a true change of
the same kind. Masks are the pixels where the thing would be seen had nothing changed (gone, moved) and where it is seen
now (new, moved). A turned thing counts as moved. The other columns count what is reported. Things that moved or are
gone are asked for by their colours in the updated field, and in the first rooms in fields by the other METHODS. The
seeds 0 to 5 and 200 to 213 chose the constants and the cues.
"""

import contextlib
import dataclasses
import itertools
import time
from collections.abc import Iterator
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
from jsecon import Scene, open_scene
from jsecon.app.comparison import Changes
from jsecon.errors import InputError
from jsecon.field.evidence import list_evidence, pack_evidence
from jsecon.field.ledger import Ledger, LedgerView, camera_row
from jsecon.field.ledger_file import save_with_ledger
from jsecon.field.regions import region_embeddings
from jsecon.fit.start import points_from_depth
from jsecon.read.captures.images import encode_jpeg
from jsecon.splat.points import gaussians_from_points
from jsecon.splat.visible import HIDDEN_LOGIT
from jsecon.types import Camera, Capture, LanguageField
from jsecon.vision.colours import ColourEmbedder

KINDS = ("remove", "move", "add", "swap", "turn", "nothing", "other light", "other exposure")
UNTURNED = ("box", "mug", "kettle", "pot", "teddy")
"""Shapes that look another way when they are turned."""
SENSORS = ("RGB", "RGB-D")
METHODS = ("updated", "just add", "new frames only")
"""How a field takes new photographs: `update`, `add`, or a field of their own (true masks, Gaussians of true depth)."""
ASKED = {"moved": "moved found", "gone": "gone refused", "same": "others found"}
"""What is asked for after a thing moved or is gone, by what became of it."""
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
    changes: tuple[tuple[str, int, int], ...] = ()
    light, exposure = 0.0, 1.0
    if kind == "remove":
        changes, after = (("gone", 0, -1),), after[1:]
    elif kind == "move":
        changes, yaw = (("moved", 0, 0),), things[0].yaw + float(draw.uniform(-1, 1))
        after[0] = dataclasses.replace(things[0], spot=tuple(map(float, spots[10])), yaw=yaw)
    elif kind == "add":
        changes, after = (("new", -1, 9),), things
    elif kind == "swap":
        far = int(np.argsort([abs(radii[k] - radii[0]) if k else 9 for k in range(count)])[0])
        changes = ("moved", 0, 0), ("moved", far, far)
        for a, b in ((0, far), (far, 0)):
            after[a] = dataclasses.replace(things[a], spot=things[b].spot)
    elif kind == "turn":
        turn = float(draw.choice([-1, 1]) * draw.uniform(0.7, 2.4))
        changes, after[0] = (("moved", 0, 0),), dataclasses.replace(things[0], yaw=things[0].yaw + turn)
    elif kind == "other light":
        light = float(draw.choice([-1, 1]) * draw.uniform(0.8, 2.2))
    elif kind == "other exposure":
        exposure = float(draw.choice([0.55, 0.75, 1.3, 1.5]))
    return Case(before, tuple(after), changes, light, exposure)


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


def field_of_views(
    cameras: Camera, frames: np.ndarray, instances: np.ndarray, depths: np.ndarray, count: int
) -> tuple[LanguageField, Ledger]:
    """The field of views with their true masks: Gaussians from true depth, `count` regions named by their colours."""
    names = tuple(f"frame_{view + 1:05d}" for view in range(len(frames)))
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    capture = Capture(frames, cameras, *nothing, np.zeros(len(frames), bool), depths, np.eye(4), names)
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
    field, labels = field_of_masks(scene, cameras, frames, instances, count), np.asarray(instances, np.int16)
    regions = region_embeddings(frames, labels, ColourEmbedder().embed_regions, num_regions=count)
    views = {}
    for t, (name, evidence) in enumerate(zip(names, list_evidence(scene, cameras, labels, count))):
        shown, rows = np.flatnonzero(regions.pixel_counts[:, t]), regions.embedded[:, 1] == t
        pixels = np.stack([shown, regions.pixel_counts[shown, t]]).astype(np.int32)
        packed, embedded = pack_evidence(evidence, count), (regions.embedded[rows, 0], regions.view_embeddings[rows])
        views[name] = LedgerView(packed, pixels, *embedded, camera_row(cameras[t]), encode_jpeg(frames[t]))
    return field, Ledger(count, views)


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
    rooms: str = "experiments/data/changes"
    """Folder that keeps fields and photographs."""
    beside: int = 10
    """Rooms, the first ones, whose fields that only add, or see only the new photographs, are asked too."""
    out: str = ""


def load_case(folder: Path, seed: int, kind: str, count: int) -> dict[str, np.ndarray]:
    """The photographs of a case, which are made once."""
    file = folder / f"{seed}-{kind.replace(' ', '-')}-{count}.npz"
    if not file.is_file():
        np.savez_compressed(file, **photographs(seed, kind, count))
    with np.load(file) as stored:
        return dict(stored)


def load_scene(folder: Path, seed: int) -> Scene:
    """The scene of a room, with the field of its true masks, which is made once."""
    file = folder / f"{seed}.safetensors"
    if not file.is_file():
        room = make_room(make_case(seed, "nothing").before, seed)
        cameras = room_cameras(room, views=16, width=240, height=180)
        save_with_ledger(file, *field_of_views(cameras, *render_views(room, cameras, coarser=2), len(room.objects)))
    return open_scene(file)


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


def updated_scene(scene: Scene, changes: Changes) -> tuple[str, Scene]:
    """The first of METHODS, and the scene after what moved or is gone."""
    known = tuple(change for change in changes.found if change.object >= 0)
    return METHODS[0], scene.update(dataclasses.replace(changes, found=known), date="2026-11-28")


def later_scenes(
    scene: Scene, capture: Capture, shots: dict[str, np.ndarray], chosen: np.ndarray
) -> Iterator[tuple[str, Scene]]:
    """The other METHODS, and the scene after a change by each."""
    added = scene
    with contextlib.suppress(InputError):  # all are refused as unlike the scene
        added = scene.add(capture, refused=[])
    yield METHODS[1], added
    views = shots["frames"][chosen], shots["after"][chosen], shots["depths"][chosen]
    yield METHODS[2], Scene(field_of_views(capture.cameras, *views, int(shots["after"].max()) + 1)[0], scene.embedder)


def ask_things(scene: Scene, case: Case) -> list[tuple[str, bool]]:
    """Asks a scene for each thing of the room before by its colour.

    Returns:
      What became of it, and whether the answer is right: at the place where it is now, or no Gaussian.
    """
    rows, changed = [], {i: (kind, j) for kind, i, j in case.changes}
    for i, thing in enumerate(case.before):
        kind, j = changed.get(i, ("same", -1))
        spot = case.after[j].spot if kind == "moved" else thing.spot
        answer = scene.ask(thing.colour)
        is_there = bool(answer.mask.any()) and float(np.linalg.norm(answer.place.center[:2] - spot)) < FOUND_M
        rows.append((kind, not answer.mask.any() if kind == "gone" else is_there))
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
    folder.mkdir(parents=True, exist_ok=True)
    loaded = load_scene(folder, seed)
    for kind in KINDS:
        shots, case = load_case(folder, seed, kind, max(options.counts)), make_case(seed, kind)
        cameras = new_cameras(seed + 1000 * KINDS.index(kind), len(shots["frames"]))
        for count, depth in itertools.product(options.counts, (False, True)):
            chosen = np.linspace(0, len(shots["frames"]), count, endpoint=False).astype(int)
            capture = new_capture(shots, cameras, chosen, seed, depth)
            _ = loaded.objects()
            began = time.perf_counter()
            changes = loaded.changes(capture)
            seconds = time.perf_counter() - began
            later = []
            if kind in ("remove", "move"):
                later.append(updated_scene(loaded, changes))
                if count == max(options.counts) and seed < options.seeds[0] + options.beside:
                    later += later_scenes(loaded, capture, shots, chosen)
            asked = [(method, *row) for method, scene in later for row in ask_things(scene, case)]
            row = judge(changes, case, shots, chosen) | {"seconds": seconds, "asked": asked}
            rows[f"{kind}, {count}, {SENSORS[depth]}"] = row
    return rows


def summarise(rows: dict, count: int, sensor: str) -> tuple[dict[str, float], list[str]]:
    """The figures of all rooms for a number of photographs and a sensor, and what was reported of each kind."""
    cells = {kind: [row[f"{kind}, {count}, {sensor}"] for row in rows.values()] for kind in KINDS}
    every = [cell for column in cells.values() for cell in column]
    found = [tuple(pair) for cell in every for pair in cell["found"]]
    moved = [pair for cell in every for pair in cell["moved"]]
    right, wrong = (
        {kind: sum(pair[3] and pair[1] == is_right for cell in cells[kind] for pair in cell["found"]) for kind in KINDS}
        for is_right in (True, False)
    )
    figures = {
        "AP": average_precision(found, sum(cell["truth"] for cell in every)),
        **{f"false in {kind}": wrong[kind] for kind in KINDS[5:]},
        "place of moved, cm": 100 * float(np.median([error for error, _ in moved])) if moved else float("nan"),
        "same id": float(np.mean([same for _, same in moved])) if moved else float("nan"),
        "seconds, median": float(np.median([cell["seconds"] for cell in every])),
    }
    truth = {kind: sum(cell["truth"] for cell in cells[kind]) for kind in KINDS[:5]}
    return figures, [f"{right[kind]} of {number}, {wrong[kind]} false" for kind, number in truth.items()]


def summarise_answers(rows: dict, count: int, sensor: str) -> dict[str, dict[str, float]]:
    """The share of right answers in the fields of each of METHODS, by what became of the thing."""
    asked = [answer for row in rows.values() for kind in KINDS for answer in row[f"{kind}, {count}, {sensor}"]["asked"]]
    return {
        method: {
            words: float(np.mean([is_right for of, became, is_right in asked if (of, became) == (method, kind)]))
            for kind, words in ASKED.items()
        }
        for method in METHODS
    }


def main(options: Options) -> dict:
    """Measures all rooms, writes the tables and returns the figures."""
    out, rows = Path(options.out), {}
    file = out / "run" / "cells.jsonl"
    for seed in range(*options.seeds):
        key = f"{seed} {options.counts}"
        if key not in read_cells(file):
            append_cell(file, key, measure_room(seed, options))
        print(seed, flush=True)
        rows[seed] = read_cells(file)[key]
    figures, lines, kinds, answers = {}, [], [], []
    for count, sensor in itertools.product(options.counts, SENSORS):
        figure, reported = summarise(rows, count, sensor)
        figures[f"{count} {sensor}"] = figure
        lines.append((count, sensor, *figure.values()))
        kinds.append((count, sensor, *reported))
    for sensor in SENSORS:
        figures[f"answers, {sensor}"] = summarise_answers(rows, max(options.counts), sensor)
        for method, shares in figures[f"answers, {sensor}"].items():
            answers.append((max(options.counts), sensor, method, *shares.values()))
    first = "photographs", "sensor"
    heads = (*first, *figure), (*first, *KINDS[:5]), (*first, "field", *ASKED.values())
    text = "\n\n".join(map(results.table, heads, (lines, kinds, answers)))
    results.save(out, options, figures, text)
    print(text)
    return figures


if __name__ == "__main__":
    main(results.read_options(Options, "changes", __doc__))
