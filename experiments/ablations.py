"""The paper's two ablations on demo rooms: what each part of the system adds, and what each kind of query does.

    python -m experiments.ablations [--quick] [FOLDER_OF_DEMOS]

Table 1, components: everything, and everything but one of tracking, weighting of the views by their pixels, anchoring
(without it: one-step) and DBSCAN. Table 2, queries: one-step, canonical, anchored by code and by votes, of all views
and of those that show the region (jsecon's own), each without and with DBSCAN. Rooms of five seeds, seen by simulated
vision (experiments.simulated_vision). One text per object; point level: a selection against the Gaussians whose true
object it is, mIoU and mAcc@0.25 (the share of IoUs above 0.25), mean and deviation over the rooms. Codes as in the
paper: a Gaussian's is the mean of its votes, with d numbers.

Without tracking each mask of each view is a region of its own, embedded from that view alone.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.ideas import scenes
from experiments.ideas.scenes import rooms_of
from experiments.ideas.state import State, tracked
from jsecon.demo.demo import PLAIN_ROOM, run_demo
from jsecon.evaluate.metrics import accuracy_at, mean_iou
from jsecon.language.codes import encode, region_codes
from jsecon.pipeline.progress import Listener
from jsecon.query.baselines import query_canonical, query_one_step
from jsecon.query.outliers import remove_outliers


@dataclasses.dataclass(frozen=True)
class Options(scenes.Rooms):
    """What the experiment can vary."""

    level: str = "medium"
    latent: int = 16
    code_threshold: float = 0.9
    """on the cosine with the anchor's code, and of one-step with the text's."""
    canonical_threshold: float = 0.5
    share: float = 0.5
    """on the share of votes."""
    out: str = str(results.HOME / "results" / "ablations")


QUICK = Options(
    demos=str(results.HOME / "results" / "ablations_quick" / "pictures"),
    seeds=(0,),
    latent=8,
    out=str(results.HOME / "results" / "ablations_quick"),
)
QUICK_ROOM = PLAIN_ROOM | {"views": 12, "width": 160, "height": 120, "points": 1200}


@dataclasses.dataclass(frozen=True)
class View:
    """What a query needs of one way to build the field."""

    state: State
    table: np.ndarray
    """(R, d) unit codes of the regions."""
    points: np.ndarray
    """(N, d) codes of the Gaussians, zero where unknown."""
    asked: np.ndarray
    """(K, d) codes of the texts."""
    phrases: np.ndarray
    """(C, d) of the canonical phrases."""
    canonical: np.ndarray
    """(C, E) the phrases themselves."""


def built(sight: scenes.Sight, proof: scenes.Evidence, options: Options, *, tracking=True, weighting=True) -> View:
    """The field with or without tracking and weighting."""
    seen = sight if weighting else dataclasses.replace(sight, pixels=(sight.pixels > 0).astype(sight.pixels.dtype))
    masks = sight.pixels.size
    state = tracked(seen, proof) if tracking else State(seen, proof, np.arange(masks), seen.pixels.ravel() > 0, masks)
    units = jnp.asarray(state.embeddings, jnp.float32)
    table, coder, _ = region_codes(units, latent=options.latent, key=jax.random.key(0))
    labelled = state.votes.sum(1) >= 0.5 * state.total
    points = (state.votes @ np.asarray(table)) * labelled[:, None]
    asked, phrases = (np.asarray(encode(coder, jnp.asarray(a))) for a in (sight.texts, sight.canonical))
    return View(state, np.asarray(table), points, asked, phrases, sight.canonical)


def selections(view: View, texts: np.ndarray, way: str, options: Options) -> list[np.ndarray]:
    """(N,) bool per text, by a kind of query."""
    points = jnp.asarray(view.points, jnp.float32)
    if way == "one-step":
        return [np.asarray(query_one_step(points, code, options.code_threshold).mask) for code in view.asked]
    if way == "canonical":
        ask = lambda code: query_canonical(points, code, view.phrases, options.canonical_threshold)
        return [np.asarray(ask(code).mask) for code in view.asked]
    anchors = view.state.anchors(texts, view.canonical if way.endswith("contrast") else None)
    if way in VOTES:
        shares = view.state.shares if way == VOTES[0] else view.state.posteriors
        return [share >= options.share for share in shares(view.state.joined(anchors))]
    return [np.asarray(query_one_step(points, view.table[a], options.code_threshold).mask) for a in anchors]


def scored(masks: list[np.ndarray], truth: np.ndarray, means: np.ndarray, dbscan: bool) -> tuple[float, float]:
    """mIoU and mAcc@0.25 over the objects that some Gaussian belongs to."""
    masks = [remove_outliers(means, mask) for mask in masks] if dbscan else masks
    ious = [
        float((m & (truth == k)).sum() / (m | (truth == k)).sum()) for k, m in enumerate(masks) if (truth == k).any()
    ]
    return mean_iou(ious), accuracy_at(ious)


COMPONENTS = {
    "all": (True, True, True, True),
    "without tracking": (False, True, True, True),
    "without weighting": (True, False, True, True),
    "without anchoring": (True, True, False, True),
    "without DBSCAN": (True, True, True, False),
}
"""row -> tracking, weighting, anchoring, DBSCAN"""
VOTES = "anchored by votes of all views", "anchored by votes", "anchored by votes, region by contrast"
"""the second by the views that show the region alone; the third, jsecon's own, finds it by the contrast"""
QUERIES = ("one-step", "canonical", "anchored by code", *VOTES)


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    space = options.space()
    components: dict[str, list[tuple[float, float]]] = {}
    queries: dict[tuple[str, bool], list[tuple[float, float]]] = {}
    for make in options.scenes().values():
        scene = make()
        sight = scenes.look(scene, options.level, space)
        proof = scenes.evidence(scene, sight.masks.labels, len(sight.masks.origin))
        means = np.asarray(scene.gaussians.means)
        ways = {
            (tracking, weighting): built(sight, proof, options, tracking=tracking, weighting=weighting)
            for tracking, weighting in ((True, True), (False, True), (True, False))
        }
        for name, (tracking, weighting, anchoring, dbscan) in COMPONENTS.items():
            way = "anchored by code" if anchoring else "one-step"
            masks = selections(ways[tracking, weighting], sight.texts, way, options)
            components.setdefault(name, []).append(scored(masks, scene.truth, means, dbscan))
        for way in QUERIES:
            masks = selections(ways[True, True], sight.texts, way, options)
            for dbscan in (False, True):
                queries.setdefault((way, dbscan), []).append(scored(masks, scene.truth, means, dbscan))

    tick = lambda yes: "x" if yes else ""
    first = [
        (*(tick(part) for part in COMPONENTS[name]), *(_spread(values, i) for i in (0, 1)))
        for name, values in components.items()
    ]
    second = [(way, tick(dbscan), *(_spread(values, i) for i in (0, 1))) for (way, dbscan), values in queries.items()]
    table = "\n\n".join(
        (
            results.table(("tracking", "weighting", "anchoring", "DBSCAN", "mIoU", "mAcc@0.25"), first),
            results.table(("query", "DBSCAN", "mIoU", "mAcc@0.25"), second),
        )
    )
    metrics = {
        "components": {name: _told(values) for name, values in components.items()},
        "queries": {f"{way}{', DBSCAN' if dbscan else ''}": _told(values) for (way, dbscan), values in queries.items()},
    }
    figure = results.bars(
        [name.replace(" ", "\n") for name in components],
        {kind: [told[kind] for told in metrics["components"].values()] for kind in ("miou", "macc")},
        "point level",
    )
    results.save(Path(options.out), options, metrics, table, figure)
    print(table)
    return metrics


def _spread(values: list[tuple[float, float]], index: int) -> str:
    return f"{np.mean([v[index] for v in values]):.3f} +- {np.std([v[index] for v in values]):.3f}"


def _told(values: list[tuple[float, float]]) -> dict:
    miou, macc = np.array(values).T
    return {
        "miou": float(miou.mean()),
        "miou_deviation": float(miou.std()),
        "macc": float(macc.mean()),
        "macc_deviation": float(macc.std()),
        "rooms": len(values),
    }


def quick() -> dict:
    """The experiment on one small room, which is made first."""
    folder = Path(QUICK.demos) / "demo0"
    if not (folder / "field.safetensors").exists():
        run_demo(folder, seed=0, steps=150, listener=Listener(), room=QUICK_ROOM)
    return main(QUICK)


if __name__ == "__main__":
    chosen = rooms_of(Options(), QUICK)
    if chosen is QUICK:
        quick()
    else:
        main(chosen)
