"""The vision that needs no weights, against true instances: how good is a mask, and how well does its id last?

    python -m experiments.default_vision [FOLDER]

Scenes: the demo rooms of seeds 0 to 4 (made in FOLDER where they are missing) and, where ../shared/captures is at hand,
replica_apartment_0. Its ids are true ones modulo 40, so one stands for several things, here and there in the flat: an
object is what hangs together in space of one id (`connected_parts`); the ids as they are stand beside it. For every
true object that fills at least 1 % of a view: the best IoU of any masklet with it there, its mean over objects and
views; and the share of an object's views whose best masklet has the id that is the best in most of them, its mean over
objects seen twice or more. All from the pipeline's own stages: consensus (the default) and Algorithm 1 through the
Gaussians; beside them, the same proposals left alone in each frame, and carried from frame to frame by dense optical
flow (OpenCV's DIS).

Each cell (scene, way) is kept in OUT/cells.jsonl as it is finished, under a key that names the code that it comes
from: a run that was stopped goes on, and a changed vision is measured anew. Algorithm 1, which takes longest, comes
last.
"""

import dataclasses
import functools
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from experiments import replica_apartment_0, results
from experiments.cells import append_cell, read_cells
from jsecon.app.verbs import Demo
from jsecon.data.capture import load_capture
from jsecon.demo.demo import PLAIN_ROOM, run_demo
from jsecon.language.field import load_field
from jsecon.pipeline import cache
from jsecon.pipeline.masklet_stages import associate_masks, frame_proposals
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.progress import Listener
from jsecon.pipeline.stages import RunContext, training_frames
from jsecon.types import Capture, Gaussians
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Networks

LEAST = 0.01
"""share of a view that an object must fill to count there"""
KEPT = 0.5
"""optical flow: a proposal keeps the id that fills at least this much of it, as IoU"""
WAYS = CONSENSUS, ALONE, FLOW, TRACKING = (
    "consensus (default)",
    "each frame alone",
    "optical flow",
    "tracking (Algorithm 1)",
)
Scene = tuple[Capture, Gaussians, dict[str, np.ndarray]]
"""with the true labels (T, H, W), -1 = none, of each kind"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    rooms: str = ""
    """folder of the demo rooms"""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    capture: str = str(results.CAPTURES / "replica_apartment_0")
    out: str = str(results.HOME / "results" / "default_vision")


def score(found: np.ndarray, truth: np.ndarray, *, least: float = LEAST) -> tuple[float, float]:
    """(mean best IoU, mean share of views under one id) of masklets `found` (T, H, W) for the objects `truth`
    (T, H, W); -1 = none in both."""
    best, ids = [], {}
    for labels, true in zip(found, truth, strict=True):
        for k in np.unique(true[true >= 0]):
            inside = true == k
            if inside.mean() < least:
                continue
            names, shared = np.unique(labels[inside], return_counts=True)
            shared = shared[names >= 0]
            names = names[names >= 0]
            sizes = np.array([(labels == name).sum() for name in names])
            iou = shared / (sizes + inside.sum() - shared)
            best.append(iou.max(initial=0.0))
            ids.setdefault(k, []).append(names[iou.argmax()] if len(names) else -1)
    lasting = []
    for named in ids.values():
        if len(named) > 1:
            names, counts = np.unique([n for n in named if n >= 0], return_counts=True)
            lasting.append(counts.max(initial=0) / len(named) if len(names) else 0.0)
    return float(np.mean(best)), float(np.mean(lasting))


def alone(frames: np.ndarray, proposals) -> np.ndarray:
    """labels (T, H, W): every frame's proposals, the better above the worse, under ids of their own."""
    labels, last = np.full(frames.shape[:3], -1, np.int32), 0
    for t in range(len(frames)):
        masks = proposals(t)
        for m in range(len(masks) - 1, -1, -1):
            labels[t][masks[m]] = last + m
        last += len(masks)
    return labels


def by_flow(frames: np.ndarray, single: np.ndarray, *, kept: float = KEPT) -> np.ndarray:
    """The single frames' labels under ids that dense optical flow carries on from the frame before."""
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames]
    y, x = np.mgrid[: frames.shape[1], : frames.shape[2]].astype(np.float32)
    labels, fresh = single.copy(), int(single.max()) + 1
    for t in range(1, len(frames)):
        back = flow.calc(grey[t], grey[t - 1], None)
        carried = cv2.remap(
            labels[t - 1].astype(np.float32), x + back[..., 0], y + back[..., 1], cv2.INTER_NEAREST, borderValue=-1
        ).astype(np.int32)
        labels[t] = -1
        for name in np.unique(single[t][single[t] >= 0]):
            mask = single[t] == name
            names, shared = np.unique(carried[mask], return_counts=True)
            union = np.array([(carried == n).sum() for n in names]) + mask.sum() - shared
            iou = np.where(names >= 0, shared / union, 0.0)
            if iou.max() >= kept:
                labels[t][mask] = names[iou.argmax()]
            else:
                labels[t][mask] = fresh
                fresh += 1
    return labels


def measure(options: RunOptions, capture: Capture, gaussians: Gaussians, way: str) -> tuple[np.ndarray, float]:
    """(labels (T, H, W) by one of WAYS on the frames that take part, seconds with the segmentation)."""
    train = training_frames(capture)
    frames = np.asarray(capture.frames)[train]
    options = dataclasses.replace(options, association="consensus" if way == CONSENSUS else "tracking")
    work = RunContext(options, Networks(ColourEmbedder()), Path())
    start = time.perf_counter()
    if way in (ALONE, FLOW):
        labels = alone(frames, frame_proposals(work, capture, gaussians)[0])
        labels = by_flow(frames, labels) if way == FLOW else labels
    else:
        proposals, _ = frame_proposals(work, capture, gaussians)
        labels = associate_masks(work, capture, gaussians, proposals, lambda done, total: None)
    return labels, time.perf_counter() - start


def connected_parts(capture: Capture, ids: np.ndarray, *, voxel: float = 0.1, least: int = 10) -> np.ndarray:
    """Parts (T, H, W) int32 of ids (T, H, W), -1 = none: what hangs together in space, by the depths of all views.

    Voxels (edge in world units) that hold pixels of an id are joined with those of the same id among their 26
    neighbours. A part of fewer than `least` voxels, which is an outline's noise, goes to the nearest larger one of its
    id. Pixels without depth are -1.
    """
    poses = np.asarray(capture.cameras.world_to_camera, np.float64)
    cells = []
    for t, (depth, image) in enumerate(zip(capture.depths, ids, strict=True)):
        camera = capture.cameras[t]
        row, column = np.nonzero((depth > 0) & (image >= 0))
        z = depth[row, column].astype(np.float64)
        x = (column + 0.5 - float(camera.cx)) / float(camera.fx) * z
        y = (row + 0.5 - float(camera.cy)) / float(camera.fy) * z
        world = (np.stack([x, y, z], 1) - poses[t, :3, 3]) @ poses[t, :3, :3]
        cells.append(np.column_stack([np.floor(world / voxel), image[row, column]]).astype(np.int64))
    lowest = np.min([own.min(0) for own in cells], axis=0)
    size = np.max([own.max(0) for own in cells], axis=0) - lowest + 1
    keys = [np.ravel_multi_index((own - lowest).T, size) for own in cells]
    known = np.unique(np.concatenate([np.unique(own) for own in keys]))
    place = np.stack(np.unravel_index(known, size), 1)
    place, name = place[:, :3].astype(np.float64), place[:, 3]
    pairs = cKDTree(place).query_pairs(1.75, output_type="ndarray")  # the diagonal of a voxel is 1.73
    pairs = pairs[name[pairs[:, 0]] == name[pairs[:, 1]]]
    joined = sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(known), len(known)))
    part = connected_components(joined, directed=False)[1]
    small = np.bincount(part)[part] < least
    for number in np.unique(name[small]):
        few, many = np.flatnonzero(small & (name == number)), np.flatnonzero(~small & (name == number))
        if len(many):
            part[few] = part[many[cKDTree(place[many]).query(place[few])[1]]]
    result = np.full(ids.shape, -1, np.int32)
    for t, own in enumerate(keys):
        result[t][(capture.depths[t] > 0) & (ids[t] >= 0)] = part[np.searchsorted(known, own)]
    return result


def demo_room(folder: Path, seed: int) -> Scene:
    """The room of `seed` as `run_demo` with PLAIN_ROOM leaves it."""
    if not (folder / "field.safetensors").exists():
        run_demo(folder, seed=seed, steps=Demo.steps, listener=Listener(), room=PLAIN_ROOM)
    capture = load_capture(folder / "capture", holdout=8)
    files = [folder / "capture" / "masks" / f"{name}.png" for name in capture.names]
    truth = np.stack([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files]).astype(np.int32) - 1
    return capture, load_field(folder / "field.safetensors").gaussians, {"objects": truth}


def replica(folder: str) -> Scene:
    """replica_apartment_0, every second view, its depth points as Gaussians."""
    given = replica_apartment_0.Options(capture=folder)
    capture, ids = replica_apartment_0.load_replica(folder, voting_every=given.voting_every)
    gaussians = replica_apartment_0.points_as_gaussians(capture, given)[1]
    return capture, gaussians, {"objects": connected_parts(capture, ids), "ids": ids}


def main(options: Options = Options()) -> dict:
    """Measures every cell that is missing and writes the table."""
    rooms = Path(options.rooms or tempfile.mkdtemp())
    scenes: dict[str, Callable[[], Scene]] = {}
    for seed in options.seeds:
        scenes[f"demo {seed}"] = functools.partial(demo_room, rooms / f"demo{seed}", seed)
    if Path(options.capture).exists():
        scenes["replica_apartment_0"] = functools.partial(replica, options.capture)
    run = RunOptions(capture=Path())
    file, found = Path(options.out) / "cells.jsonl", {scene: {} for scene in scenes}
    source = cache.source_digest("association")
    for ways in (WAYS[:-1], WAYS[-1:]):
        for scene, make in scenes.items():
            keys = {way: f"{scene}, {way}, {source}" for way in ways}
            missing = [way for way in ways if keys[way] not in read_cells(file)]
            made = make() if missing else None
            for way in missing:
                capture, gaussians, truths = made
                labels, seconds = measure(run, capture, jax.tree.map(jnp.asarray, gaussians), way)
                cell = {"seconds": round(seconds, 1)}
                for kind, truth in truths.items():
                    cell[kind] = dict(zip(("best_iou", "lasting"), score(labels, truth[training_frames(capture)])))
                append_cell(file, keys[way], cell)
                print(scene, way, cell, flush=True)
            known = read_cells(file)
            found[scene] |= {way: known[keys[way]] for way in ways}
            if all(found.values()):
                write(options, found)
    print((Path(options.out) / "table.md").read_text())
    return found


def write(options: Options, found: dict[str, dict]) -> None:
    """Writes the results as far as they are measured; in the figure, the ways that all scenes have."""
    rows = []
    for scene, ways in found.items():
        for kind in ("objects", "ids"):
            for way, cell in ways.items():
                if kind in cell:
                    name = scene if kind == "objects" else f"{scene}, ids modulo 40 as objects"
                    rows.append((name, way, cell[kind]["best_iou"], cell[kind]["lasting"], cell["seconds"]))
    demos = [ways for scene, ways in found.items() if scene.startswith("demo")]
    means = {}
    for way in [way for way in WAYS if demos and all(way in room for room in demos)]:
        means[way] = [float(np.mean([room[way]["objects"][key] for room in demos])) for key in ("best_iou", "lasting")]
        seconds = float(np.mean([room[way]["seconds"] for room in demos]))
        rows.append((f"mean of {len(demos)} demos", way, *means[way], seconds))
    table = results.table(
        ("scene", "association", "mean best IoU", "share of views under one id", "seconds, beside other work"), rows
    )
    measured = [way for way in WAYS if all(way in ways for ways in found.values())]
    groups = {f"{len(demos)} demos": means} if demos else {}
    groups |= {
        scene: {way: [ways[way]["objects"][key] for key in ("best_iou", "lasting")] for way in measured}
        for scene, ways in found.items()
        if not scene.startswith("demo")
    }
    labels = [f"{name}\n{figure}" for name in groups for figure in ("best IoU", "one id")]
    series = {way: [value for group in groups.values() for value in group[way]] for way in measured}
    results.save(Path(options.out), options, found, table, results.bars(labels, series, "share"))


if __name__ == "__main__":
    main(Options(rooms=sys.argv[1]) if len(sys.argv) > 1 else Options())
