"""A flat seen by the vision without weights: point at a thing in one view, is it the thing in the others?

    python -m experiments.replica_pixels [--capture FOLDER] [--granularity medium] [--steps 2000] [--out FOLDER]

replica_apartment_0, RGB-D, as `jsecon run` takes it: Gaussians fitted to every second view, regions by colour, texture
and depth, no mask of the data set. What is judged lies in the other views. A thing is what hangs together in space of
one of the data set's ids (`connected_parts`); it counts in views of which it fills at least 1 %. It is asked by its
innermost pixel in the view that shows most of it, and judged in up to eight others, evenly spaced. Beside stands the
best region there is, chosen by the truth: what the masks allow.
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments import results
from experiments.bonsai_outlines import Asked, candidates
from experiments.default_vision import LEAST, connected_parts
from experiments.replica_apartment_0 import load_replica
from jsecon.app import pipeline
from jsecon.app.options import Options as RunOptions
from jsecon.types import Capture

WAYS = ("pixel", "pixel, silhouette", "best region")
CLASSES = ((0.01, 0.03), (0.03, 0.1), (0.1, 1.0))
"""of a thing's part of the view that shows most of it"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    capture: str = str(results.CAPTURES / "replica_apartment_0")
    granularity: str = "medium"
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


def main(options: Options, tell: Callable[[str], None] = print) -> str:
    """The table, written."""
    out, place = Path(options.out), Path(options.capture)
    capture, ids = load_replica(place, voting_every=2)
    given = RunOptions(place, granularity=options.granularity, steps=options.steps)  # type: ignore[arg-type]
    run = pipeline.run(given, out / "run", load=lambda: capture)
    instances = connected_parts(capture, ids)
    asked, kept, sizes = Asked(run.field, capture), {}, {}
    for k, truth in things(capture, instances, options.judged_in).items():
        kept[k], sizes[k] = judge(asked, truth), float(next(iter(truth.values())).mean())
        tell(f"{k}: {sizes[k]:.3f} " + str({way: np.mean(found, axis=0).round(3) for way, found in kept[k].items()}))
    rows = []
    for low, high in (*CLASSES, (CLASSES[0][0], 1.0)):
        own = [k for k, size in sizes.items() if low <= size < high]
        means = {way: np.mean([np.mean(kept[k][way], axis=0) for k in own], axis=0) for way in WAYS if own}
        told = [f"{means[way][0]:.3f} / {means[way][1]:.3f}" if own else "-" for way in WAYS]
        rows.append((f"{low:.0%} to {high:.0%}" if (low, high) != (LEAST, 1.0) else "all", len(own), *told))
    text = results.table(("part of a view", "things", *WAYS), rows)
    text += "\n\nIoU at alpha > 0.7 / > 10/255, mean over the views that judge a thing, then over things. "
    text += f"{run.field.gaussians.count} Gaussians, {run.field.regions.count} regions, {np.mean(run.psnr):.2f} dB."
    results.save(out, options, {str(k): {"share": sizes[k], **kept[k]} for k in kept}, text)
    tell(text)
    return text


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    for field in dataclasses.fields(Options):
        parser.add_argument(f"--{field.name.replace('_', '-')}", default=field.default, type=type(field.default))
    main(Options(**vars(parser.parse_args())))
