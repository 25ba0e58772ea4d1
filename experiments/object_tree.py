"""How well the best node of the tree of objects fits each thing of real rooms. Default masks.

    python -m experiments.object_tree

A node is a region, a union of regions or a part of one. Its fit to a thing is the IoU of their Gaussians, among those
that views tell the thing of which do not vote. The best node of each thing, mean over the things. Things of fewer than
100 points are left out of replica_apartment_0, and its things are divided: rules were chosen on those of even ids.
"""

import dataclasses
import time
from pathlib import Path

import numpy as np
import tyro

from experiments import results
from experiments.words.scenes import DEFAULT, SCENES, load_scene
from jsecon.field.tree import node_members

LEAST_POINTS = {"replica_apartment_0": 100}


@dataclasses.dataclass(frozen=True)
class Options:
    out: str = "experiments/results/object_tree"
    scenes: tuple[str, ...] = tuple(SCENES)


def best_fits(tree: np.ndarray, leaf: np.ndarray, things: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """(X,) the best IoU of each thing with one of the nodes; things (N,) of the Gaussians, -1 = not judged."""
    judged = np.flatnonzero(things >= 0)
    count = int(things.max(initial=-1)) + 1
    size, best = np.bincount(things[judged], minlength=count), np.zeros(count)
    for node in nodes:
        inside = np.bincount(things[judged[node_members(tree, leaf[judged], int(node))]], minlength=count)
        best = np.maximum(best, inside / np.maximum(size + inside.sum() - inside, 1))
    return best


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    rows = []
    for name in options.scenes:
        began = time.perf_counter()
        scene = load_scene(name, DEFAULT)
        found, count = scene.found, len(scene.pixels)
        known = scene.things[scene.things >= 0]
        judged = np.flatnonzero(np.bincount(known) >= LEAST_POINTS.get(name, 1))
        halves = {name: judged}
        if name in LEAST_POINTS:
            halves = {
                f"{name}, even ids": judged[judged % 2 == 0],
                f"{name}, odd ids": judged[judged % 2 == 1],
                name: judged,
            }
        flat, every = (
            best_fits(found.tree, found.leaf, scene.things, nodes)
            for nodes in (np.arange(count), np.arange(len(found.tree)))
        )
        for words, own in halves.items():
            fits = [
                round(float(number), 3)
                for best in (flat[own], every[own])
                for number in (best.mean(), (best > 0.5).mean())
            ]
            rows.append((words, len(own), count, len(found.tree), *fits))
        print(f"{name}: {time.perf_counter() - began:.0f} s", flush=True)
    header = ("scene", "things", "regions", "nodes", "best region", "above 0.5", "best node", "above 0.5, nodes")
    table = results.table(header, rows)
    metrics = {"rows": [dict(zip(header, row)) for row in rows]}
    bars = {"best region": [row[4] for row in rows], "best node": [row[6] for row in rows]}
    results.save(Path(options.out), options, metrics, table, results.bars([row[0] for row in rows], bars, "mean IoU"))
    print(table)
    return metrics


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
