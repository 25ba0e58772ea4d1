"""Where a thing is: centres and boxes of the answers in the demo's rooms, against the rooms themselves.

    python -m experiments.places [ROOMS] [--seeds 0 1 2 3 4] [--crowded]

ROOMS holds a folder <seed> for each room, made where it is missing: with --crowded as `jsecon demo` leaves it, else as
`run_demo` with PLAIN_ROOM does. Every thing is asked for by its name, which no other has. The true box is that of all
its surface that any of the 30 views shows, by ray casting.
"""

import argparse
import collections
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments import results
from jsecon.app.locate import locate
from jsecon.app.verbs import Demo
from jsecon.demo.demo import PLAIN_ROOM, run_demo
from jsecon.demo.raycast import trace_rays
from jsecon.demo.room import Room, crowded_room, make_room
from jsecon.errors import InputError
from jsecon.language.field import load_field
from jsecon.pipeline.networks import field_embedder
from jsecon.pipeline.progress import Listener
from jsecon.types import Camera, LanguageField


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    rooms: str = "rooms"
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    crowded: bool = False
    out: str = str(results.HOME / "results" / "places")


def true_boxes(room: Room, cameras: Camera) -> dict[str, np.ndarray]:
    """name -> (2, 3) lowest and highest corner of what the views show of each thing that alone has its name, m."""
    count = collections.Counter(item.name for item in room.objects)
    owners = np.array([part.owner for part in room.parts])
    found: dict[str, list[np.ndarray]] = {}
    for t in range(len(np.asarray(cameras.fx))):
        camera = cameras[t]
        depth, part = trace_rays(room, camera)
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        x, y = (columns - float(camera.cx)) / float(camera.fx), (rows - float(camera.cy)) / float(camera.fy)
        pose = np.asarray(camera.world_to_camera, np.float64)
        world = (np.stack([x, y, np.ones_like(x)], -1) * depth[..., None] - pose[:3, 3]) @ pose[:3, :3]
        owner = np.where(part >= 0, owners[np.maximum(part, 0)], -1)
        for k, item in enumerate(room.objects):
            if count[item.name] == 1 and (owner == k).any():
                found.setdefault(item.name, []).append(world[owner == k])
    return {name: np.stack([np.concatenate(p).min(0), np.concatenate(p).max(0)]) for name, p in found.items()}


def box_iou(a: np.ndarray, b: np.ndarray) -> float:
    """IoU of two boxes (2, 3) along the axes."""
    volume = lambda box: float(np.prod(np.maximum(box[1] - box[0], 0)))
    both = volume(np.stack([np.maximum(a[0], b[0]), np.minimum(a[1], b[1])]))
    return both / (volume(a) + volume(b) - both)


def fields_of(options: Options) -> Iterator[tuple[int, Path, LanguageField]]:
    """Seed, folder and field of each room, made where it is missing."""
    for seed in options.seeds:
        folder = Path(options.rooms) / str(seed)
        if not (folder / "field.safetensors").exists():
            run_demo(
                folder, seed=seed, steps=Demo.steps, listener=Listener(), room=None if options.crowded else PLAIN_ROOM
            )
        yield seed, folder, load_field(folder / "field.safetensors")


def room_of(seed: int, options: Options) -> Room:
    """The room that a field was made of."""
    return crowded_room(seed) if options.crowded else make_room(seed)


def asked_for(kind: type[Options]) -> Options:
    """The options of the command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("rooms", nargs="?", default=kind.rooms)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(kind.seeds))
    parser.add_argument("--crowded", action="store_true", help="the demo's rooms instead of plain ones")
    given = parser.parse_args()
    return kind(given.rooms, tuple(given.seeds), given.crowded, kind.out + "_crowded" * given.crowded)


def main(options: Options) -> str:
    """The table, written."""
    rows = []
    for seed, _, field in fields_of(options):
        embedder = field_embedder(field)
        for name, box in true_boxes(room_of(seed, options), field.cameras).items():
            try:
                place = locate(field, name, embedder)
            except InputError:
                rows.append((seed, name, np.inf, 0.0))
                continue
            away = float(np.linalg.norm(place.center - box.mean(0)))
            rows.append((seed, name, away, box_iou(np.stack([place.low, place.high]), box)))
    away, overlap = (np.array([row[k] for row in rows]) for k in (2, 3))
    told = [(seed, name, f"{1000 * a:.1f}", f"{o:.3f}") for seed, name, a, o in rows]
    text = results.table(("room", "thing", "centre off, mm", "IoU of boxes"), told)
    text += f"\n\n{len(rows)} things: centre off by {1000 * np.median(away):.1f} mm in the median, "
    text += f"IoU {np.median(overlap):.3f} in the median, at least 0.6 for {np.mean(overlap >= 0.6):.0%}."
    metrics = {"median_mm": 1000 * float(np.median(away)), "median_iou": float(np.median(overlap))}
    results.save(Path(options.out), options, metrics | {"share_of_0.6": float(np.mean(overlap >= 0.6))}, text)
    print(text)
    return text


if __name__ == "__main__":
    main(asked_for(Options))
