"""A flat seen by the vision without weights: point at a thing in one view, is it the thing in the others?

    python -m experiments.replica_pixels [--capture FOLDER] [--ways medium:0.4 fine:0.4 ...] [--steps 2000]
                                         [--out FOLDER]

replica_apartment_0, RGB-D, as `jsecon run` takes it: Gaussians fitted to every second view, regions by colour, texture
and depth, no mask of the data set. What is judged lies in the other views. A thing is what hangs together in space of
one of the data set's ids (`connected_parts`); it counts in views of which it fills at least 1 %. It is asked by its
innermost pixel in the view that shows most of it, and judged in up to eight others, evenly spaced. Beside stands the
best region there is, chosen by the truth: what the masks allow.

A way is a granularity of the masks and the share of the views that must agree (`jsecon run --granularity --agreement`).
"steadiest" asks the first three ways and takes the region that single frames' masks are most like (`steadiness`): which
of them it is that the pixel means is not known otherwise. Finished ways are kept in OUT/cells.jsonl.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from experiments import results
from experiments.bonsai_outlines import Asked, candidates
from experiments.cells import append_cell, read_cells
from experiments.default_vision import LEAST, connected_parts
from experiments.replica_apartment_0 import load_replica
from jsecon.pipeline import pipeline
from jsecon.pipeline.masklet_stages import frame_proposals
from jsecon.pipeline.options import Options as RunOptions
from jsecon.pipeline.stages import RunContext
from jsecon.types import Capture
from jsecon.vision.colours import ColourEmbedder
from jsecon.vision.protocols import Networks

WAYS = ("pixel", "pixel, silhouette", "best region")
CLASSES = ((0.01, 0.03), (0.03, 0.1), (0.1, 1.0))
"""of a thing's part of the view that shows most of it"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    capture: str = str(results.CAPTURES / "replica_apartment_0")
    ways: tuple[str, ...] = ("medium:0.4", "fine:0.4", "coarse:0.4", "medium:0.25", "medium:0.6")
    """granularity:agreement; the first is the default"""
    steps: int = RunOptions.steps
    judged_in: int = 8
    """views at most"""
    out: str = str(results.HOME / "results" / "replica_pixels")


def things(capture: Capture, instances: np.ndarray, most: int) -> dict[int, dict[int, np.ndarray]]:
    """instance -> view -> (H, W) bool, of views held out that it fills by LEAST: first the one that shows most of it,
    then up to `most` others. Instances of one view are left out."""
    shown = np.flatnonzero(np.asarray(capture.held_out))
    pixels = np.stack([np.bincount(instances[t][instances[t] >= 0], minlength=instances.max() + 1) for t in shown])
    found = {}
    for k in np.flatnonzero((pixels >= LEAST * instances[0].size).sum(0) > 1):
        large = np.flatnonzero(pixels[:, k] >= LEAST * instances[0].size)
        first = large[pixels[large, k].argmax()]
        others = large[large != first]
        others = others[np.unique(np.linspace(0, len(others) - 1, min(most, len(others))).round().astype(int))]
        found[int(k)] = {int(shown[t]): instances[shown[t]] == k for t in (first, *others)}
    return found


def judge(asked: Asked, truth: dict[int, np.ndarray]) -> dict[str, list[tuple[float, float]]]:
    """IoUs of a thing by each of WAYS, in all of its views but the first, in which it is asked."""
    (first, mask), *rest = truth.items()
    others, region = dict(rest), asked.under(first, mask)
    nothing = [(0.0, 0.0)] * len(others)
    found = {way: asked.judged(asked.region(region, way != "pixel"), others) for way in WAYS[:2] if region >= 0}
    every = [asked.judged(asked.region(r), others) for r in candidates(asked, truth)]
    best = max(every, key=lambda rows: np.mean([row[0] for row in rows]), default=nothing)
    return dict.fromkeys(WAYS[:2], nothing) | found | {WAYS[2]: best}


def steadiness(labels: np.ndarray, region: int, proposals: Callable[[int], np.ndarray]) -> float:
    """Mean over the frames that show a region of labels (T, H, W) of its best IoU with a single one's mask."""
    found = []
    for t in np.flatnonzero((labels == region).any((1, 2))):
        own, masks = labels[t] == region, proposals(t)
        both = (masks & own).sum((1, 2))
        found.append((both / (masks | own).sum((1, 2))).max(initial=0.0))
    return float(np.mean(found)) if found else 0.0


def measured(way: str, options: Options, capture: Capture, every: dict, tell: Callable[[str], None]) -> dict:
    """{"things": {thing: {"share", "steady", WAYS}}, "regions", "gaussians", "psnr"} of one way."""
    granularity, agreement = way.split(":")
    how: Any = {"granularity": granularity, "agreement": float(agreement), "steps": options.steps}
    given = RunOptions(Path(options.capture), **how)
    run = pipeline.run(given, Path(options.out) / "run", load=lambda: capture)
    masks, _ = frame_proposals(RunContext(given, Networks(ColourEmbedder()), Path()), capture, run.field.gaussians)
    asked, kept = Asked(run.field, capture), {}
    for k, truth in every.items():
        first, mask = next(iter(truth.items()))
        steady = steadiness(run.labels, asked.under(first, mask), masks)
        kept[k] = {"share": float(mask.mean()), "steady": steady, **judge(asked, truth)}
        tell(f"{way} {k}: " + str({name: np.mean(kept[k][name], axis=0).round(3) for name in WAYS}))
    psnr = float(np.mean(run.psnr))
    return {"things": kept, "regions": run.field.regions.count, "gaussians": run.field.gaussians.count, "psnr": psnr}


def steadiest(cells: dict[str, dict]) -> dict[str, dict]:
    """Of each thing what the steadiest region of the first three ways found."""
    first = list(cells.values())[:3]
    best = {k: max(first, key=lambda cell, k=k: cell["things"][k]["steady"]) for k in first[0]["things"]}
    return {k: cell["things"][k] for k, cell in best.items()}


def main(options: Options, tell: Callable[[str], None] = print) -> str:
    """The table, written."""
    out, cells = Path(options.out), {}
    capture, ids = load_replica(options.capture, voting_every=2)
    every = things(capture, connected_parts(capture, ids), options.judged_in)
    for way in options.ways:
        key = f"{way}, {options.steps} steps"
        known = read_cells(out / "cells.jsonl")
        if key not in known:
            append_cell(out / "cells.jsonl", key, measured(way, options, capture, every, tell))
        cells[way] = read_cells(out / "cells.jsonl")[key]
    asked = {way: cell["things"] for way, cell in cells.items()}
    asked |= {"steadiest": steadiest(cells)} if len(cells) > 2 else {}
    rows, metrics = [], {}
    for way, found in asked.items():
        for low, high in (*CLASSES, (LEAST, 1.0)):
            own = [kept for kept in found.values() if low <= kept["share"] < high]
            means = {name: np.mean([np.mean(kept[name], axis=0) for kept in own], axis=0) for name in WAYS if own}
            told = [f"{means[name][0]:.3f} / {means[name][1]:.3f}" if own else "-" for name in WAYS]
            size = f"{low:.0%} to {high:.0%}" if (low, high) != (LEAST, 1.0) else "all"
            rows.append((way, size, len(own), *told))
            metrics[f"{way}, {size}"] = {name: mean.tolist() for name, mean in means.items()}
    text = results.table(("way", "part of a view", "things", *WAYS), rows)
    text += "\n\nIoU at alpha > 0.7 / > 10/255, mean over the views that judge a thing, then over things. "
    text += f"{cells[options.ways[0]]['gaussians']} Gaussians, {cells[options.ways[0]]['psnr']:.2f} dB; regions: "
    text += ", ".join(f"{way} {cell['regions']}" for way, cell in cells.items()) + "."
    results.save(out, options, metrics, text)
    tell(text)
    return text


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for field in dataclasses.fields(Options):
        several = {"nargs": "+", "type": str} if field.name == "ways" else {"type": type(field.default)}
        parser.add_argument(f"--{field.name.replace('_', '-')}", default=field.default, **several)
    given = vars(parser.parse_args())
    main(Options(**{name: tuple(value) if name == "ways" else value for name, value in given.items()}))
