"""A bare splat against the same scene with its photographs.

    python -m experiments.bare_splat [--seeds 1 2 3 4 5] [--demos FOLDER]
    python -m experiments.bare_splat --field FIELD [--poses]      (a field of `jsecon run` on a capture)

Each made-up room and its fields come from experiments/demo_rooms.py, kept in DEMOS/SEED. Its fitted Gaussians are
written to a .ply, turned, scaled by 0.01 to 100 and shifted at random, and `jsecon run scene.ply` makes a field
without photographs. With --poses, the cameras of the field lie beside it as INRIA's cameras.json.

- label mIoU: for each true object (the demo's field of exact masks), the best IoU of its Gaussians with those of one
  region; a Gaussian belongs to its strongest region if that has half of its weight. The ratio is bare / photographs.
- selection IoU: of the Gaussians of the regions that match a true object best in both fields, over all objects, over
  those that both fields find (IoU of at least 0.5), and its median.
- matched: share of the regions of the field with photographs (of at least 50 Gaussians) that a region of the bare
  field matches by an IoU of at least 0.5.
- matched_by_node: the same by any node of the bare field's tree: a region, a union of regions, or a part of one.
"""

import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import jsecon
from experiments import results
from experiments.demo_rooms import fields_of_room
from jsecon.field.tree import node_members
from jsecon.read.captures.frames import transform_poses

SMALLEST = 50
"""Gaussians of a region that is matched"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What is compared."""

    seeds: tuple[int, ...] = (1, 2, 3, 4, 5)
    demos: str = str(results.HOME.parent / "demos")
    field: str = ""
    views: int = 24
    poses: bool = False
    out: str = ""


def strongest_regions(field: jsecon.LanguageField) -> np.ndarray:
    """(N,) the region that has at least half of each Gaussian's weight, else -1."""
    votes = field.votes
    regions, weights = np.asarray(votes.regions)[:, 0], np.asarray(votes.weights)[:, 0]
    return np.where(weights >= 0.5 * np.asarray(votes.total), regions, -1)


def best_match(labels: np.ndarray, members: np.ndarray) -> tuple[float, int]:
    """The region of `labels` (N,) with the largest IoU with a set of Gaussians (N,), and that IoU."""
    ids, shared = np.unique(labels[members & (labels >= 0)], return_counts=True)
    if not len(ids):
        return 0.0, -1
    sizes = np.array([(labels == region).sum() for region in ids])
    overlaps = shared / (sizes + members.sum() - shared)
    return float(overlaps.max()), int(ids[overlaps.argmax()])


def compare(
    photographs: np.ndarray, bare: np.ndarray, truth: np.ndarray | None, field: jsecon.LanguageField
) -> dict[str, float]:
    """The figures of one scene, from the strongest regions of its Gaussians (N,) in each field, and the bare field."""
    ids = [k for k in np.unique(photographs[photographs >= 0]) if (photographs == k).sum() >= SMALLEST]
    regions = [best_match(bare, photographs == k)[0] >= 0.5 for k in ids]
    tree, leaf = np.asarray(field.tree), np.asarray(field.leaf)
    things = np.append(np.arange(len(ids)), -1)[[ids.index(k) if k in ids else -1 for k in photographs.tolist()]]
    best, size = np.zeros(len(ids)), np.bincount(things[things >= 0], minlength=len(ids))
    for node in range(len(tree)):
        inside = node_members(tree, leaf, node)
        shared = np.bincount(things[inside & (things >= 0)], minlength=len(ids))
        best = np.maximum(best, shared / (size + inside.sum() - shared))
    nodes = [one or other for one, other in zip(regions, (best >= 0.5).tolist())]
    figures = {"matched": float(np.mean(regions)), "matched_by_node": float(np.mean(nodes))}
    if truth is None:
        return figures
    rows = []
    for k in np.unique(truth[truth >= 0]):
        members = truth == k
        with_photographs, region = best_match(photographs, members)
        without, other = best_match(bare, members)
        a, b = photographs == region, bare == other
        rows.append((with_photographs, without, (a & b).sum() / max((a | b).sum(), 1)))
    mine, theirs, shared = np.array(rows).T
    figures |= {"photographs": mine.mean(), "bare": theirs.mean(), "ratio": theirs.mean() / mine.mean()}
    both = np.minimum(mine, theirs) >= 0.5
    figures |= {"selection_iou": shared.mean(), "of_both": shared[both].mean(), "median": np.median(shared)}
    return {name: float(value) for name, value in figures.items()}


def write_cameras(path: Path, field: jsecon.LanguageField, world: np.ndarray) -> None:
    """Writes the cameras of a field, in another world, as INRIA's cameras.json."""
    rows, cameras = [], field.cameras
    poses = np.linalg.inv(transform_poses(np.asarray(cameras.world_to_camera, np.float64), world))
    for name, camera, pose in zip(field.names, cameras, poses):
        row = {"img_name": name, "width": cameras.width, "height": cameras.height, "fx": float(camera.fx)}
        rows.append(row | {"fy": float(camera.fy), "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()})
    path.write_text(json.dumps(rows))


def bare_field(
    field: jsecon.LanguageField, seed: int, folder: Path, views: int, *, poses: bool = False
) -> tuple[jsecon.LanguageField, float]:
    """The field of the same Gaussians without photographs, in a world of their own, and the seconds of its run."""
    rng = np.random.default_rng(seed)
    world = np.eye(4)
    world[:3, :3] = Rotation.random(random_state=seed).as_matrix() * 10 ** rng.uniform(-2, 2)
    world[:3, 3] = rng.normal(size=3) * 20
    folder.mkdir(parents=True, exist_ok=True)
    jsecon.save_gaussians(folder / "scene.ply", field.gaussians, similarity=world)
    began = time.perf_counter()
    command = [sys.executable, "-m", "jsecon", "run", "scene.ply", "--out", "field"]
    if poses:
        write_cameras(folder / "cameras.json", field, world)
    else:
        command += ["--views", str(views)]
    with (folder / "run.log").open("w") as log:
        subprocess.run(command, cwd=folder, check=True, stdout=log, stderr=subprocess.STDOUT)
    return jsecon.load_field(folder / "field" / "field.safetensors"), time.perf_counter() - began


def main(options: Options) -> dict[str, dict]:
    """Runs and compares, and writes the table."""
    found: dict[str, dict] = {}
    scenes: list[tuple[str, int, Path, Path | None]] = []
    if options.field:
        name, path = Path(options.field).parent.name, Path(options.field)
        scenes += [(f"{name} in world {seed}", seed, path, None) for seed in options.seeds]
    else:
        for seed in options.seeds:
            demo = Path(options.demos) / str(seed)
            fields_of_room(demo, seed, quick=False)
            scenes.append((f"room {seed}", seed, demo / "field.safetensors", demo / "true_masks" / "field.safetensors"))
    for name, seed, path, true_path in scenes:
        field = jsecon.load_field(path)
        folder = Path(options.out) / "runs" / name.replace(" ", "_")
        bare, seconds = bare_field(field, seed, folder, options.views, poses=options.poses)
        truth = None if true_path is None else strongest_regions(jsecon.load_field(true_path))
        figures = compare(strongest_regions(field), strongest_regions(bare), truth, bare)
        seen = float((np.asarray(bare.votes.views) > 0).mean())
        found[name] = figures | {"seen": seen, "seconds": seconds, "gaussians": field.gaussians.count}
        print(name, json.dumps(found[name]), flush=True)
    keys = list(next(iter(found.values())))
    rows = [(name, *(figures[key] for key in keys)) for name, figures in found.items()]
    rows.append(("mean", *(float(np.mean([figures[key] for figures in found.values()])) for key in keys)))
    table = results.table(("scene", *keys), rows)
    print(table)
    results.save(Path(options.out), options, found, table)
    return found


if __name__ == "__main__":
    main(results.read_options(Options, "bare_splat", __doc__))
