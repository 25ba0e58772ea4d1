"""Seconds of vision on a CPU, and what guided prompts lose against SAM's grid.

    python -m experiments.vision_speed                      masks: made-up rooms, a decoder with true masks
    python -m experiments.vision_speed --graphs models      seconds: graphs of true size by experiments.export_models

`masks` counts the true masks of rooms that guided prompts and the grid find, at two levels of SAM. `seconds` times
every graph in a folder of models and adds up a frame; the machine should do nothing else.
"""

import dataclasses
import itertools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments import results
from experiments.datasets.plain_room import make_room
from experiments.rooms.capture import room_cameras
from experiments.rooms.raycast import render_views
from experiments.rooms.room import crowded_room
from experiments.simulated_vision.exact_sam import ExactGridSam, ExactSam, found_shares, level_labels, masks_of
from jsecon.networks.clip import ClipEmbedder
from jsecon.networks.hub import Role, find_files
from jsecon.networks.sam import Level, _GuidedPrompts, _SamGraphs
from jsecon.networks.sam2 import _open_sam2, follow
from jsecon.process import cores

THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9)
LEAST_PX = 100
"""px of a true mask that counts: SAM's generator drops smaller ones"""
GRID = 1024
"""prompts of SAM's grid"""
GUIDED = 70
"""guided prompts of a frame"""
LIMITS = (8, 16, 32, 64)
"""numbers of guided prompts of a frame that are tried beside the default's"""
REGIONS = 40
"""regions of a frame that are embedded"""
TEXT = "a red mug"


def _limited(most: int) -> type[ExactSam]:
    """`ExactSam` with fewer guided prompts."""

    class Prompts(_GuidedPrompts):
        def __init__(self, image: np.ndarray, levels: int):
            super().__init__(image, levels)
            self._left = most

    return type("Limited", (ExactSam,), {"prompts": Prompts})


PROMPTS: dict[str, type[ExactSam]] = {
    "grid": ExactGridSam,
    "guided": ExactSam,
    **{f"guided, at most {most}": _limited(most) for most in LIMITS},
}


@dataclasses.dataclass(frozen=True)
class Options:
    """What is measured."""

    graphs: str = ""
    """Folder with models of true size; empty: masks are counted instead."""
    roles: tuple[Role, ...] = ("segmenter", "embedder", "tracker")
    """Which of them are timed."""
    rooms: tuple[int, ...] = (0, 1, 2)
    """Seeds, of crowded and of plain rooms each."""
    views: int = 3
    width: int = 400
    height: int = 300
    out: str = ""


def main(options: Options) -> dict:
    """Measures, adds to metrics.json and writes table.md."""
    folder = Path(options.out)
    kept = folder / "metrics.json"
    metrics = json.loads(kept.read_text()) if kept.exists() else {}
    if not options.graphs:
        metrics["masks"] = count_masks(options)
    else:
        metrics["seconds"] = metrics.get("seconds", {}) | time_models(Path(options.graphs), options)
    results.save(folder, options, metrics, table(metrics))
    print(table(metrics))
    return metrics


def count_masks(options: Options) -> dict[str, dict[str, dict[str, Any]]]:
    """Counts the true masks that each kind of prompts finds, by kind of room and level."""
    kinds = {"crowded": crowded_room, "plain": make_room}
    zeros = {"found": [0] * len(THRESHOLDS), "prompts": 0, "most_prompts": 0, "host_seconds": 0.0}
    counted: dict[str, dict[str, dict[str, Any]]] = {}
    for kind, seed in itertools.product(kinds, options.rooms):
        room = kinds[kind](seed)
        cameras = room_cameras(room, views=options.views, width=options.width, height=options.height)
        frames = render_views(room, cameras)[0]
        for t, frame in enumerate(frames):
            labels = level_labels(room, cameras[t])
            for level in ("l", "default"):
                empty = {"frames": 0, "true": 0} | {name: dict(zeros) for name in PROMPTS}
                row = counted.setdefault(kind, {}).setdefault(level, empty)
                _count_frame(row, frame, labels, level)
    return counted


def _count_frame(row: dict[str, Any], frame: np.ndarray, labels: dict[str, np.ndarray], level: Level) -> None:
    """Adds one frame to the counts of a level."""
    truth = masks_of(labels["l"], LEAST_PX)
    if level == "default":
        every = np.concatenate([masks_of(labels[name], LEAST_PX) for name in labels])
        packed = np.unique(np.packbits(every.reshape(len(every), -1), axis=1), axis=0)
        truth = np.unpackbits(packed, axis=1, count=frame[..., 0].size).reshape(-1, *frame.shape[:2]).astype(bool)
    row["frames"] += 1
    row["true"] += len(truth)
    for prompts, kind in PROMPTS.items():
        segmenter = kind(labels, level)
        started = time.perf_counter()
        masks = segmenter(frame, 0)
        mine = row[prompts]
        mine["host_seconds"] += time.perf_counter() - started
        mine["prompts"] += segmenter.graphs.prompts
        mine["most_prompts"] = max(mine["most_prompts"], segmenter.graphs.prompts)
        mine["found"] = [a + b for a, b in zip(mine["found"], found_shares(truth, masks, THRESHOLDS))]


def time_models(folder: Path, options: Options) -> dict[str, Any]:
    """Times the graphs of each model in a folder."""
    room = make_room(options.rooms[0])
    cameras = room_cameras(room, views=1, width=options.width, height=options.height)
    frame, masks = render_views(room, cameras)[0][0], masks_of(level_labels(room, cameras[0])["l"], LEAST_PX)
    kinds = {
        "segmenter": _time_segmenter,
        "embedder": lambda model, frame: _time_embedder(model, frame, masks[:8]),
        "tracker": _time_tracker,
    }
    measured: dict[str, Any] = {}
    for model in sorted(path for path in folder.iterdir() if path.is_dir()):
        role = role_of(model)
        if role in options.roles:
            measured[model.name] = {"role": role} | kinds[role](model, frame)
            print(model.name, measured[model.name], flush=True)
    return measured


def role_of(model: Path) -> Role:
    """Returns what a folder of a model is for, by its files."""
    if (model / "onnx" / "memory_encoder.onnx").is_file():
        return "tracker"
    return "segmenter" if (model / "onnx" / "vision_encoder.onnx").is_file() else "embedder"


def _seconds(call: Callable[[], Any]) -> float:
    """Seconds of a call, after one that is not counted.

    They are CPU seconds divided by the cores, so that other work on the machine counts little. Threads of ONNX Runtime
    that wait take no CPU time here, and its graphs, or the frames side by side, keep all cores busy.
    """
    call()
    started = time.process_time()
    call()
    return (time.process_time() - started) / cores()


def _time_segmenter(model: Path, frame: np.ndarray) -> dict[str, Any]:
    graphs = _SamGraphs(*find_files(model, "segmenter"))
    encoder = _seconds(lambda: graphs.encode(frame))
    encoded = graphs.encode(frame)
    points = np.random.default_rng(0).uniform(0, 300, (8, 2)).astype(np.float32)
    prompt = _seconds(lambda: [graphs.decode(encoded, point) for point in points]) / len(points)
    frames = {"guided": encoder + GUIDED * prompt, "grid": encoder + GRID * prompt}
    return {"encoder": encoder, "prompt": {1: prompt}, "frame": frames}


def _time_embedder(model: Path, frame: np.ndarray, masks: np.ndarray) -> dict[str, Any]:
    embedder = ClipEmbedder(model)
    crop = {n: _seconds(lambda n=n: embedder.embed_regions(frame, masks[:n])) / n for n in (1, len(masks))}
    text = _seconds(lambda: embedder.embed_text([TEXT]))
    return {"crop": crop, "frame": REGIONS * min(crop.values()), "text": text}


def _time_tracker(model: Path, frame: np.ndarray) -> dict[str, Any]:
    graphs = _open_sam2(model)
    frames = np.stack([np.roll(frame, 3 * t, 1) for t in range(3)])
    prompt = np.array([[200.0, 150.0]], np.float32), np.array([1], np.int32)
    seconds = []
    calls = iter((frames[0], frames[1]))  # the first is not counted; a frame that was encoded is remembered
    encoder = _seconds(lambda: graphs.encode(next(calls)))
    graphs.encode(frames[2])
    started = time.process_time()
    for _ in follow(graphs, frames, 0, [prompt]):
        seconds.append((time.process_time() - started) / cores())
        started = time.process_time()
    return {"encoder": encoder, "object": min(seconds[1:]), "frame": encoder + min(seconds[1:])}


def table(metrics: dict) -> str:
    """Formats the figures as Markdown tables."""
    parts = []
    if "masks" in metrics:
        header = ("rooms", "level", "prompts", "a frame", "of true masks", *(f"IoU >= {t}" for t in THRESHOLDS))
        rows = []
        for kind, levels in metrics["masks"].items():
            for level, row in levels.items():
                for prompts in PROMPTS:
                    mine = row[prompts]
                    count = mine["prompts"] / row["frames"]
                    rows.append((kind, level, prompts, f"{count:.0f}", row["true"], *mine["found"]))
        parts.append(results.table(header, rows))
    header = ("model", "encoder, s", "prompt or crop, s", "text, s", "frame, s", "by the grid, s")
    rows = []
    for model, row in metrics.get("seconds", {}).items():
        each = row.get("prompt", row.get("crop", {"": row.get("object")}))
        batch = min(each, key=each.get)
        single = f"{each[batch]:.3f}{f' (batch {batch})' if batch else ''}"
        frame = row["frame"] if isinstance(row["frame"], dict) else {"guided": row["frame"]}
        grid = f"{frame['grid']:.0f}" if "grid" in frame else "-"
        encoder, text = (f"{row[name]:.2f}" if name in row else "-" for name in ("encoder", "text"))
        rows.append((model, encoder, single, text, f"{frame['guided']:.1f}", grid))
    if rows:
        parts.append(results.table(header, rows))
    return "\n\n".join(parts)


if __name__ == "__main__":
    main(results.read_options(Options, "vision_speed", __doc__))
