"""Seconds of vision on a CPU, and what guided prompts lose against SAM's grid.

    python -m experiments.vision_speed                      masks: made-up rooms, a decoder with true masks
    python -m experiments.vision_speed --graphs models      seconds: graphs of true size by experiments.export_models

`masks` counts the true masks of rooms that guided prompts and the grid find, at two levels of SAM. `seconds` times
every graph in a folder of models and adds up a frame; the machine should do nothing else.
"""

import argparse
import dataclasses
import itertools
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

from experiments import results
from experiments.datasets.plain_room import make_room
from experiments.simulated_vision.exact_sam import ExactSam, found_shares, level_labels, masks_of
from jsecon.demo.capture import room_cameras
from jsecon.demo.raycast import render_views
from jsecon.demo.room import crowded_room
from jsecon.networks.sam import Level, Prompts, SamSettings

THRESHOLDS = (0.5, 0.6, 0.7, 0.8, 0.9)
LEAST_PX = 100
"""px of a true mask that counts: SAM's generator drops smaller ones"""
GRID = 1024
"""prompts of SAM's grid"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What is measured."""

    graphs: str | None = None
    """folder with models of true size; None counts masks instead"""
    results: str = str(results.HOME / "results" / "vision_speed")
    rooms: tuple[int, ...] = (0, 1, 2)
    """seeds, of crowded and of plain rooms each"""
    views: int = 3
    width: int = 400
    height: int = 300


def main(options: Options) -> dict:
    """Measures, adds to metrics.json and writes table.md."""
    folder = Path(options.results)
    kept = folder / "metrics.json"
    metrics = json.loads(kept.read_text()) if kept.exists() else {}
    if options.graphs is None:
        metrics["masks"] = count_masks(options)
    else:
        metrics["seconds"] = time_models(Path(options.graphs), options)
    results.save(folder, options, metrics, table(metrics))
    print(table(metrics))
    return metrics


def count_masks(options: Options) -> dict[str, dict[str, dict[str, Any]]]:
    """Counts the true masks that each kind of prompts finds, by kind of room and level."""
    kinds = {"crowded": crowded_room, "plain": make_room}
    counted: dict[str, dict[str, dict[str, Any]]] = {}
    for kind, seed in itertools.product(kinds, options.rooms):
        room = kinds[kind](seed)
        cameras = room_cameras(room, views=options.views, width=options.width, height=options.height)
        frames = render_views(room, cameras)[0]
        for t, frame in enumerate(frames):
            labels = level_labels(room, cameras[t])
            for level in ("l", "default"):
                row = counted.setdefault(kind, {}).setdefault(level, _empty())
                _count_frame(row, frame, labels, level)
    return counted


def _empty() -> dict[str, Any]:
    zeros = {"found": [0] * len(THRESHOLDS), "prompts": 0, "most_prompts": 0, "host_seconds": 0.0}
    return {"frames": 0, "true": 0, "guided": zeros | {"found": [0] * 5}, "grid": zeros | {"found": [0] * 5}}


def _count_frame(row: dict[str, Any], frame: np.ndarray, labels: dict[str, np.ndarray], level: Level) -> None:
    """Adds one frame to the counts of a level."""
    truth = masks_of(labels["l"], LEAST_PX)
    if level == "default":
        every = np.concatenate([masks_of(labels[name], LEAST_PX) for name in labels])
        packed = np.unique(np.packbits(every.reshape(len(every), -1), axis=1), axis=0)
        truth = np.unpackbits(packed, axis=1, count=frame[..., 0].size).reshape(-1, *frame.shape[:2]).astype(bool)
    row["frames"] += 1
    row["true"] += len(truth)
    kinds: tuple[Prompts, ...] = ("guided", "grid")
    for prompts in kinds:
        segmenter = ExactSam(labels, SamSettings(level=level, prompts=prompts, crop_layers=0))
        started = time.perf_counter()
        masks = segmenter(frame, 0)
        mine = row[prompts]
        mine["host_seconds"] += time.perf_counter() - started
        mine["prompts"] += segmenter.graphs.prompts
        mine["most_prompts"] = max(mine["most_prompts"], segmenter.graphs.prompts)
        mine["found"] = [a + b for a, b in zip(mine["found"], found_shares(truth, masks, THRESHOLDS))]


def time_models(folder: Path, options: Options) -> dict[str, Any]:
    raise NotImplementedError


def table(metrics: dict) -> str:
    """Formats the figures as Markdown tables."""
    parts = []
    if "masks" in metrics:
        header = ("rooms", "level", "prompts", "a frame", "of true masks", *(f"IoU >= {t}" for t in THRESHOLDS))
        rows = []
        for kind, levels in metrics["masks"].items():
            for level, row in levels.items():
                for prompts in ("grid", "guided"):
                    mine = row[prompts]
                    count = mine["prompts"] / row["frames"]
                    rows.append((kind, level, prompts, f"{count:.0f}", row["true"], *mine["found"]))
        parts.append(results.table(header, rows))
    return "\n\n".join(parts)


def parsed(arguments: list[str] | None = None) -> Options:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--graphs", default=None)
    parser.add_argument("--results", default=Options.results)
    parser.add_argument("--rooms", nargs="+", type=int, default=list(Options.rooms))
    parser.add_argument("--views", type=int, default=Options.views)
    values = vars(parser.parse_args(arguments))
    return Options(**values | {"rooms": tuple(values["rooms"])})


if __name__ == "__main__":
    main(parsed())
