"""What do DBSCAN's options change, and what do they cost?

    python -m experiments.outliers [FOLDER_OF_DEMOS]

The selections are those of the anchored query on demo rooms under simulated vision at the medium level; IoU is point
level, with the Gaussians whose true object it is. Beside them, in the same run, 500,000 made points (200 blobs of
surfaces and a tenth of noise) against scikit-learn's DBSCAN on the same eps, and scikit-learn alone on the largest part
of them that its lists of neighbours leave memory for.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from sklearn.cluster import DBSCAN

from experiments import results
from experiments.ideas import scenes
from experiments.ideas.scenes import rooms_of
from experiments.ideas.state import point_miou, tracked
from jsecon.process import peak_memory_mib
from jsecon.query.outliers import EPS_SPACINGS, MIN_SAMPLES, dbscan, default_eps, remove_outliers

LARGE = 0.25


@dataclasses.dataclass(frozen=True)
class Options(scenes.Rooms):
    """What the experiment can vary."""

    level: str = "medium"
    spacings: tuple[float, ...] = (2.0, 4.0, EPS_SPACINGS, 10.0)
    """eps in the selection's own spacings."""
    points: int = 500_000
    sizes: tuple[int, ...] = (20_000, 100_000, 500_000)
    """at which scikit-learn runs too."""
    out: str = str(results.HOME / "results" / "outliers")


def made_points(count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) points on the surfaces of 200 spheres in a room of 10 m, and a tenth of noise."""
    draw = np.random.default_rng(seed)
    owner = draw.integers(0, 200, count - count // 10)
    middle, radius = draw.uniform(0, 10, (200, 3)), draw.uniform(0.05, 0.5, 200)
    turn = draw.normal(size=(len(owner), 3))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    blobs = middle[owner] + radius[owner, None] * turn
    return np.concatenate([blobs, draw.uniform(0, 10, (count // 10, 3))])[draw.permutation(count)]


def large_clusters(means: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The selection's clusters that have at least LARGE times the Gaussians of its largest: a thing that falls apart,
    or two things of one name. Measured and not kept."""
    chosen, result = np.flatnonzero(mask), np.zeros_like(mask)
    if len(chosen):
        cluster = dbscan(means[chosen], default_eps(means[chosen]), MIN_SAMPLES)
        sizes = np.bincount(cluster[cluster >= 0], minlength=1)
        result[chosen[(cluster >= 0) & (sizes[cluster] >= LARGE * sizes.max())]] = True
    return result


def cleaners(means: np.ndarray, options: Options) -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """Functions of a selection's mask (N,), by the options that they stand for."""
    ways = {"none": lambda mask: mask}
    for keep in ("largest", "all"):
        for spacings in options.spacings:
            ways[f"{keep}, {spacings:g} spacings"] = lambda mask, keep=keep, spacings=spacings: remove_outliers(
                means, mask, keep=keep, eps=default_eps(means[mask], spacings=spacings) if mask.any() else None
            )
        for eps in (0.02, 0.1):
            ways[f"{keep}, eps {eps} m"] = lambda mask, keep=keep, eps=eps: remove_outliers(
                means, mask, keep=keep, eps=eps
            )
    ways[f"at least {LARGE:g} of the largest, {EPS_SPACINGS:g} spacings"] = lambda mask: large_clusters(means, mask)
    for samples in (5, 20):
        ways[f"largest, {EPS_SPACINGS:g} spacings, min_samples {samples}"] = lambda mask, samples=samples: (
            remove_outliers(means, mask, min_samples=samples)
        )
    return ways


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    space = options.space()
    found: dict[str, list[float]] = {}
    seconds: dict[str, list[float]] = {}
    for make in options.scenes().values():
        scene = make()
        sight = scenes.look(scene, options.level, space)
        proof = scenes.evidence(scene, sight.masks.labels, len(sight.masks.origin))
        state = tracked(sight, proof)
        masks = state.leads(state.joined(state.anchors(sight.texts)))
        ways = cleaners(np.asarray(scene.gaussians.means), options)
        for name, way in ways.items():
            began = time.process_time()
            kept = [way(mask) for mask in masks]
            seconds.setdefault(name, []).append((time.process_time() - began) / len(masks))
            found.setdefault(name, []).append(point_miou(kept, scene.truth))
    rows = [
        (name, float(np.mean(v)), float(np.std(v)), f"{1000 * np.mean(seconds[name]):.2f}") for name, v in found.items()
    ]

    sizes = []
    for count in options.sizes:
        points = made_points(options.points)[:count]
        eps = default_eps(points)
        began = time.process_time()
        ours = dbscan(points, eps, MIN_SAMPLES)
        spent, began = time.process_time() - began, time.process_time()
        peak = peak_memory_mib()
        theirs = DBSCAN(eps=eps, min_samples=MIN_SAMPLES).fit_predict(points)
        other = time.process_time() - began
        unlike, clusters = int((ours != theirs).sum()), int(ours.max()) + 1
        sizes.append((count, f"{eps:.4f}", spent, other, unlike, clusters, round(peak)))
    header = ("DBSCAN", "mIoU, point level", "deviation", "ms a selection")
    second = ("points", "eps, m", "seconds", "scikit-learn's", "labels that differ", "clusters", "peak MiB so far")
    table = results.table(header, rows) + "\n\n" + results.table(second, sizes)
    metrics = {
        "options": [dict(zip(header, row)) for row in rows],
        "sizes": [dict(zip(second, row)) for row in sizes],
        "by_room": found,
    }
    results.save(Path(options.out), options, metrics, table, draw(rows))
    print(table)
    return metrics


def draw(rows: list[tuple]):
    """IoU against time, a point a set of options."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.8))
    axes = figure.add_subplot()
    for name, mean, deviation, spent in rows:
        axes.errorbar([float(spent)], [mean], yerr=[deviation], marker="o", linestyle="none", label=name)
    axes.set_xlabel("ms a selection")
    axes.set_ylabel("mIoU, point level")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure


if __name__ == "__main__":
    main(rooms_of(Options()))
