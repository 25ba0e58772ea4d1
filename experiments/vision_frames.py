"""How many frames need masks, and which: objects of a real flat by frames that need or even spacing chooses.

    python -m experiments.vision_frames [--faults] [--counts 24 40]

The frames are the 82 voting views of replica_apartment_0. The masks of a frame are those of its true instances, or
these with the faults of single frames of simulated vision (level medium). Consensus makes regions of them, and each
Gaussian belongs to the region with most of its votes. The truth of a Gaussian is the instance of most of its depth
pixels in the views that do not vote. IoU: mean over the instances of at least 50 Gaussians of the best IoU with one
region. Accuracy: share of the Gaussians whose region has their instance for its most frequent one. Seconds are those
of SAM, SAM_SECONDS a frame, and of the rest on this machine.
"""

import dataclasses
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.datasets.depth_points import labels_of_points
from experiments.datasets.named_objects import connected_parts
from experiments.replica_apartment_0 import Options as Scan, load_replica, points_as_gaussians
from experiments.simulated_vision.masks import Faults, simulated_masks
from jsecon.association.consensus import track_masks
from jsecon.association.frame_superpixels import SceneSuperpixels
from jsecon.field.evidence import region_votes
from jsecon.read.captures.frames import evenly_spaced
from jsecon.views.placing import frames_by_need

LEAST_PX = 100
"""px of a mask; SAM's generator drops smaller ones"""
LEAST_POINTS = 50
"""Gaussians of an instance that counts"""
SAM_SECONDS = 3.0
"""s of EdgeTAM a frame, docs/models.md"""
FAULTS = Faults(lose=0, gone=0, swap=0)
"""medium, without those of a tracker"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    faults: bool = False
    counts: tuple[int, ...] = (24, 40)
    """Numbers of frames beside all, and those that need chooses."""
    out: str = ""


def scores(truth: np.ndarray, region: np.ndarray) -> tuple[float, float]:
    """Mean best IoU of the instances, and the accuracy of the regions; -1 is no instance and no region."""
    truth, region = truth[truth >= 0], region[truth >= 0]
    table = np.zeros((truth.max() + 1, region.max() + 2), int)
    np.add.at(table, (truth, region), 1)  # -1 is the last
    sizes, both = table.sum(1, keepdims=True), table[:, :-1]
    iou = (both / np.maximum(sizes + both.sum(0) - both, 1)).max(1)
    return float(iou[sizes[:, 0] >= LEAST_POINTS].mean()), float(both.max(0).sum() / len(truth))


def main(options: Options) -> dict:
    """Measures, prints and saves the table."""
    capture, ids = load_replica(Scan.capture, voting_every=2)
    objects, (points, gaussians) = connected_parts(capture, ids), points_as_gaussians(capture, Scan())
    silent = np.where(capture.held_out[:, None, None], objects, -1)
    truth = labels_of_points(points, silent, int(objects.max()) + 1)
    voting = np.flatnonzero(~capture.held_out)
    labels, frames = objects[voting].astype(np.int16), np.asarray(capture.frames)[voting]
    if options.faults:
        labels = simulated_masks(labels, FAULTS).labels
    gaussians, cameras = jax.tree.map(jnp.asarray, (gaussians, capture.cameras[voting]))

    def masks(t: int) -> np.ndarray:
        shown, pixels = np.unique(labels[t][labels[t] >= 0], return_counts=True)
        return labels[t] == shown[pixels >= LEAST_PX, None, None]

    began = time.perf_counter()
    need = frames_by_need(gaussians, cameras)
    print(f"chosen in {time.perf_counter() - began:.1f} s", flush=True)
    choices = {("all", len(voting)): np.arange(len(voting))}
    for count in (*options.counts, len(need)):
        choices["by need", count] = frames_by_need(gaussians, cameras, limit=count)
        choices["even", count] = evenly_spaced(len(voting), count)
    rows = []
    for (way, count), chosen in choices.items():
        began, chosen = time.perf_counter(), np.sort(chosen)
        scene = SceneSuperpixels(gaussians, cameras[chosen], lambda t, chosen=chosen: masks(chosen[t]))
        found = track_masks(frames[chosen], scene).labels
        votes = region_votes(gaussians, cameras[chosen], found, int(found.max()) + 1, top=1)
        own = time.perf_counter() - began
        rows.append((way, count, *scores(truth, np.asarray(votes.regions)[:, 0]), round(own + SAM_SECONDS * count)))
        print(rows[-1], flush=True)
    table = results.table(("frames", "number", "IoU", "accuracy", "s with SAM"), rows)
    metrics = {"rows": rows, "by_need": len(need), "faults": options.faults}
    results.save(Path(options.out), options, metrics, table)
    print(table)
    return metrics


if __name__ == "__main__":
    main(results.read_options(Options, "vision_frames", __doc__))
