"""Which Gaussians are a region's? Fifteen classes of a real scan, from given masks and regions chosen by the truth.

    python -m experiments.replica_classes [CAPTURE [WORDS]]

The Gaussians are those of `experiments.replica_apartment_0`, the masks of every second view vote, and an object is what
hangs together in space of one id (`connected_parts`). WORDS holds points with the names of their classes. An object has
the name of most of the named points within 0.10 m of its Gaussians. A class is asked for by the objects of that name,
so that no text and no embedding plays a part: what is measured is the step from regions to Gaussians alone. The truth
of a Gaussian is the object that the views whose masks did not vote show there, with its name. IoU over the Gaussians
with a truth, mean over the classes.

Three rules, see `jsecon.language.membership`: weight over that of all views, over that of the views that show the
region, and the latter with evidence (the library's). Masks as they are; lost, where each mask of each view is missing
with some probability; and swallowed, where its pixels then go to the nearest mask.
"""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import KDTree

from experiments import results
from experiments.datasets.depth_points import labels_of_points
from experiments.default_vision import connected_parts
from experiments.replica_apartment_0 import Options as Scan, load_replica, points_as_gaussians
from jsecon.errors import InputError
from jsecon.language.membership import SHARE_THRESHOLD, share_of, with_shown
from jsecon.language.votes import region_votes
from jsecon.types import Regions, Votes

CLASSES = (
    "wall", "floor", "ceiling", "door", "blinds", "sofa", "rug", "table", "base-cabinet", "wall-cabinet", "window",
    "chair", "indoor-plant", "refrigerator", "picture",
)  # fmt: skip
"""large enough in the named points to be relied on"""
NEAR_M = 0.10
"""how far a Gaussian is from the named point that names it, at most"""
RULES = ("all views", "views that show the region", "with evidence")


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    capture: str = Scan.capture
    words: str = str(results.CAPTURES.parent / "words" / "replica_apartment_0_named_points.npz")
    damage: tuple[tuple[str, float], ...] = (
        ("as they are", 0.0),
        ("lost", 0.5),
        ("swallowed", 0.3),
    )
    """what happens to a mask of a view, and how probably"""
    seed: int = 0
    out: str = str(results.HOME / "results" / "replica_apartment_0" / "classes")


def names_of_objects(label: np.ndarray, name: np.ndarray, count: int, classes: int) -> np.ndarray:
    """(R,) the name that most of the points of each object have; -1 where none has any. `label` and `name` (P,) are the
    object and the name of each point, -1 = none."""
    known = (label >= 0) & (name >= 0)
    table = np.zeros((count, classes), int)
    np.add.at(table, (label[known], name[known]), 1)
    return np.where(table.any(1), table.argmax(1), -1)


def damaged(labels: np.ndarray, kind: str, probability: float, seed: int) -> np.ndarray:
    """`labels` (T, H, W) with some masks of some views lost, or swallowed by the nearest other mask."""
    rng, labels = np.random.default_rng(seed), labels.copy()
    for image in labels:
        gone = rng.random(labels.max() + 1) < probability
        lost = gone[image] & (image >= 0)
        image[lost] = -1
        if kind == "swallowed" and (image >= 0).any():
            nearest = distance_transform_edt(image < 0, return_distances=False, return_indices=True)
            image[lost] = image[tuple(nearest)][lost]
    return labels


def by_rule(votes: Votes, rule: str) -> Votes:
    """Votes whose shares follow one of RULES."""
    if rule == RULES[0]:
        return dataclasses.replace(votes, shown=None)
    if rule == RULES[1]:
        nothing = jnp.zeros_like(votes.total)
        return dataclasses.replace(votes, labelled=nothing, total=nothing)
    return votes


def ious(votes: Votes, of_object: np.ndarray, truth: np.ndarray, wanted: np.ndarray) -> list[float]:
    """IoU of the Gaussians of each wanted class with its truth (N,), -1 = not judged."""
    found = []
    for name in wanted:
        mask = np.asarray(share_of(votes, jnp.asarray(of_object == name)).share) >= SHARE_THRESHOLD
        both, either = mask & (truth == name), (mask | (truth == name)) & (truth >= 0)
        found.append(float(both.sum() / max(either.sum(), 1)))
    return found


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    capture, ids = load_replica(options.capture, voting_every=Scan.voting_every)
    labels = connected_parts(capture, ids)
    points, gaussians = points_as_gaussians(capture, Scan(capture=options.capture))
    if not Path(options.words).exists():
        raise InputError(options.words, "no such file", "named points (.npz)", "Give the file of named points.")
    named, count = np.load(options.words), int(labels.max()) + 1
    away, place = KDTree(named["points"]).query(points.points, distance_upper_bound=NEAR_M)
    name = np.where(np.isfinite(away), named["label"][np.minimum(place, len(named["label"]) - 1)], -1)
    silent = np.where(capture.held_out[:, None, None], labels, -1)
    truth = labels_of_points(points, silent, count)
    names = len(named["names"])
    true_name = np.where(truth >= 0, names_of_objects(truth, name, count, names)[np.maximum(truth, 0)], -1)
    of_object = names_of_objects(labels_of_points(points, labels, count), name, count, names)
    wanted = np.array([list(named["names"]).index(word) for word in CLASSES])

    voting = np.flatnonzero(~capture.held_out)
    cameras, gaussians = jax.tree.map(jnp.asarray, (capture.cameras[voting], gaussians))
    rows, classes = [], {}
    for kind, probability in options.damage:
        seen = damaged(labels[voting], kind, probability, options.seed)
        votes = region_votes(gaussians, cameras, jnp.asarray(seen), count, by_view=True)
        pixels = np.stack([np.bincount(image[image >= 0], minlength=count) for image in seen], axis=1)
        votes = with_shown(votes, Regions(np.eye(count, dtype=np.float32), pixels))
        found = {rule: ious(by_rule(votes, rule), of_object, true_name, wanted) for rule in RULES}
        rows.append({"masks": kind, "probability": probability} | {r: float(np.mean(v)) for r, v in found.items()})
        print(rows[-1], flush=True)
        classes = classes or found
    table = results.table(
        ("masks", "probability", *RULES),
        [(row["masks"], f"{row['probability']:.1f}", *(row[rule] for rule in RULES)) for row in rows],
    )
    table += "\n\nMasks as they are, class by class:\n\n"
    table += results.table(
        ("class", "Gaussians", *RULES),
        [(w, int((true_name == wanted[k]).sum()), *(classes[r][k] for r in RULES)) for k, w in enumerate(CLASSES)],
    )
    metrics = {"objects": count, "judged": int((true_name >= 0).sum()), "rows": rows, "classes": classes}
    results.save(Path(options.out), options, metrics, table)
    print(table)
    return metrics


if __name__ == "__main__":
    main(Options(**dict(zip(("capture", "words"), sys.argv[1:]))))
