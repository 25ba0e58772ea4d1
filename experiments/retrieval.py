"""From a text to a region: plain cosine, LERF's relevancy and the contrast, for what is there and for what is not.

    python -m experiments.retrieval [--quick] [FOLDER_OF_DEMOS]

Scenes: demo rooms of five seeds and replica_apartment_0 (where it lies beside the checkout), each seen by simulated
vision (experiments.simulated_vision) at three levels of noise; masks as tracked, and by consensus. Each object is asked
for by its class, and 200 names of the text space that no object has are asked for too. Shown: how many texts find a
region of their object; point-level mIoU, membership by the votes of the views that show the region; how often a text of
what is there is more similar to its best region than one of what is not (area under the curve); and, for each
threshold, how many of either kind it refuses, with the mIoU that is left."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import results
from experiments.ideas import scenes
from experiments.ideas.scenes import rooms_of
from experiments.ideas.state import State, consensus, point_miou, tracked
from jsecon.query.baselines import relevancies
from jsecon.query.match import CONTRAST_THRESHOLD, RETRIEVAL_THRESHOLD


@dataclasses.dataclass(frozen=True)
class Options(scenes.Places):
    """What the experiment can vary."""

    levels: tuple[str, ...] = ("low", "medium", "high")
    absent: int = 200
    """texts of what is not there."""
    share: float = 0.5
    """threshold on a Gaussian's votes."""
    thresholds: tuple[tuple[str, tuple[float, ...]], ...] = (
        ("cosine", (0.0, RETRIEVAL_THRESHOLD, 0.26, 0.28, 0.3)),
        ("relevancy", (0.0, 0.5, 0.52, 0.54, 0.56)),
        ("contrast", (0.0, 0.1, CONTRAST_THRESHOLD, 0.15, 0.18, 0.2)),
    )
    out: str = str(results.HOME / "results" / "retrieval")


QUICK = Options(seeds=(0,), replica="", levels=("medium",), out=str(results.HOME / "results" / "quick" / "retrieval"))


@jax.jit
def _relevancies(embeddings, texts, canonical):
    return jax.vmap(lambda text: relevancies(embeddings, text, canonical))(texts)


def _by_relevancy(state: State, texts: np.ndarray, canonical: np.ndarray) -> np.ndarray:
    given = (jnp.asarray(a, jnp.float32) for a in (state.embeddings, texts, canonical))
    score, known = _relevancies(*given)
    return np.where(known, score, -np.inf)


RULES: dict[str, Callable[[State, np.ndarray, np.ndarray], np.ndarray]] = {
    "cosine": lambda state, texts, canonical: state.similarities(texts),
    "relevancy": _by_relevancy,
    "contrast": lambda state, texts, canonical: state.similarities(texts, canonical),
}
"""(Q, E) texts, (C, E) phrases -> (Q, R) similarities, -inf where a region has no embedding"""


@dataclasses.dataclass(frozen=True)
class Asked:
    """What one rule made of one scene, seen at one level, its masks put together one way."""

    scene: str
    level: str
    regions: str
    rule: str
    right: list[bool]
    """per text: whether its best region shows its object."""
    best: list[float]
    """per text: the similarity of its best region."""
    iou: list[float]
    """per text: of what is selected; NaN for an object without Gaussians."""
    absent: list[float]
    """per text of what is not there: the similarity of its best region."""


def ask(scene: scenes.Scene, level: str, space: scenes.TextSpace, options: Options) -> list[Asked]:
    """All rules on a scene, its masks as tracked and by consensus."""
    sight = scenes.look(scene, level, space)
    proof = scenes.evidence(scene, sight.masks.labels, len(sight.masks.origin))
    here, count = sight.pixels.reshape(-1) > 0, len(sight.texts)
    states = {"tracks": tracked(sight, proof), "consensus": consensus(sight, proof, np.asarray(scene.gaussians.means))}
    shown = np.tile(sight.masks.origin, len(sight.pixels))
    draw = np.random.default_rng(scene.seed)
    others = space.vectors[draw.permutation(len(space.names))[: options.absent]]
    others = others[(others @ sight.texts.T).max(1) < 0.999]
    found = []
    for name, state in states.items():
        joint = np.zeros((state.regions, count + 1))
        np.add.at(joint, (state.ids[here], shown[here]), sight.pixels.reshape(-1)[here])
        texts = np.concatenate([sight.texts, others])
        for rule, similar in RULES.items():
            score = similar(state, texts, sight.canonical)
            anchors, best = score.argmax(1), score.max(1)
            picked = [p >= options.share for p in state.posteriors(state.joined(anchors[:count]))]
            found.append(
                Asked(
                    scene.name,
                    level,
                    name,
                    rule,
                    [bool(joint[r, k] == joint[r].max() > 0) for k, r in enumerate(anchors[:count])],
                    best[:count].tolist(),
                    [
                        point_miou([m], np.where(scene.truth == k, 0, -1)) if (scene.truth == k).any() else np.nan
                        for k, m in enumerate(picked)
                    ],
                    best[count:].tolist(),
                )
            )
    return found


def rows_of(asked: list[Asked], options: Options) -> tuple[list[dict], list[dict]]:
    """The rows of the rules, and those of their thresholds."""
    rules, thresholds = [], []
    for regions in ("tracks", "consensus"):
        for rule in RULES:
            own = [a for a in asked if (a.regions, a.rule) == (regions, rule)]
            row = {"regions": regions, "rule": rule}
            for level in options.levels:
                here = [a for a in own if a.level == level]
                row[f"{level} texts"] = float(np.mean(np.concatenate([a.right for a in here])))
                row[f"{level} mIoU"] = float(np.mean([np.nanmean(a.iou) for a in here]))
                row[f"{level} there or not"] = float(
                    np.mean([np.mean(np.array(a.best)[:, None] > np.array(a.absent)) for a in here])
                )
            row["mIoU"] = float(np.mean([np.nanmean(a.iou) for a in own]))
            rules.append(row)
            for least in dict(options.thresholds)[rule]:
                row = {"regions": regions, "rule": rule, "threshold": least}
                for level in options.levels:
                    here = [a for a in own if a.level == level]
                    row[f"{level} there, refused"] = float(np.mean([np.mean(np.array(a.best) < least) for a in here]))
                    row[f"{level} not there, refused"] = float(
                        np.mean([np.mean(np.array(a.absent) < least) for a in here])
                    )
                left = [np.nanmean(np.where(np.array(a.best) < least, 0.0 * np.array(a.iou), a.iou)) for a in own]
                row["mIoU"] = float(np.mean(left))
                thresholds.append(row)
    return rules, thresholds


def main(options: Options = Options()) -> dict:
    """Runs the experiment, writes its results and returns the metrics."""
    space, asked = options.space(), []
    for make in options.scenes().values():
        scene = make()
        for level in options.levels:
            asked += ask(scene, level, space, options)
    rules, thresholds = rows_of(asked, options)
    table = "\n\n".join(
        results.table(tuple(rows[0]), [tuple(r.values()) for r in rows]) for rows in (rules, thresholds)
    )
    results.save(Path(options.out), options, {"rules": rules, "thresholds": thresholds}, table, draw(asked))
    print(table)
    return {"rules": rules, "thresholds": thresholds}


def draw(asked: list[Asked]):
    """For each rule the similarities of texts that are there and of those that are not, by consensus."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3))
    for column, rule in enumerate(RULES):
        own = [a for a in asked if (a.regions, a.rule) == ("consensus", rule)]
        axes = figure.add_subplot(1, len(RULES), column + 1)
        for name, values in (("there", [a.best for a in own]), ("not there", [a.absent for a in own])):
            axes.hist(np.concatenate(values), bins=40, density=True, alpha=0.6, label=name)
        axes.set_xlabel(f"{rule} of a text's best region")
        axes.set_yticks([])
    axes.legend(fontsize=8)
    return figure


if __name__ == "__main__":
    main(rooms_of(Options(), QUICK))
