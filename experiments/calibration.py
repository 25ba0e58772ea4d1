"""The confidence of an answer against how often it is right: fitted on some simulated rooms, measured on others.

    python -m experiments.calibration [--quick]

Twins of LERF, regions of the simulated tracker. Every name of a thing in the room is asked, and 200 names that nothing
in it has; the first weigh as much as the second in all. An answer is right if its region shows the thing. Answers that
the default rules judge absent do not count. `OFFSET` and `SLOPE` of jsecon.query.match are fitted on the seeds
`--fitted` by the likelihood. The expected calibration error has ten bins of equal width.
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float
from scipy.optimize import minimize

from experiments import lerf, results
from experiments.cells import append_cell, read_cells
from experiments.shared_errors import pooled
from experiments.tables import twins
from jsecon.query.match import OFFSET, SLOPE, score_text, word_similarities
from jsecon.query.rules import ABSENT, RULES

BINS = 10
FITTED_VISION = 100
PADDED = 64
"""regions of a room are padded to multiples of this number"""


class Bin(NamedTuple):
    """Answers whose confidence is in one tenth of 0 to 1."""

    confidence: float
    """mean."""
    right: float
    """share."""
    weight: float


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    data: tyro.conf.Suppress[twins.Data] = lerf.PLAN.data
    scenes: tuple[str, ...] = lerf.PLAN.data.scenes
    """Twins of LERF."""
    fitted: tuple[int, ...] = (0, 1)
    """Seeds of the rooms to fit on; their vision has seeds from FITTED_VISION on."""
    seeds: tuple[int, ...] = (10, 11, 12, 13, 14)
    """Seeds to report."""
    levels: tuple[str, ...] = ("medium", "high", "shared")
    quick: bool = False
    """Run one tiny scene at one level."""
    out: str = ""


QUICK = {"data": lerf.QUICK.data, "scenes": lerf.QUICK.data.scenes, "fitted": (0,), "seeds": (1,)}
QUICK |= {"levels": ("shared",)}


def calibration_error(
    confidence: Float[np.ndarray, " a"], right: Float[np.ndarray, " a"], weight: Float[np.ndarray, " a"]
) -> tuple[float, list[Bin]]:
    """The expected calibration error of weighted answers, and the reliability curve: its bins that hold any."""
    place = np.clip((confidence * BINS).astype(int), 0, BINS - 1)
    curve = []
    for own in (place == k for k in range(BINS) if (place == k).any()):

        def mean(values, own=own):
            return float(np.average(values[own], weights=weight[own]))

        curve.append(Bin(mean(confidence), mean(right), float(weight[own].sum())))
    error = sum(bin.weight * abs(bin.confidence - bin.right) for bin in curve) / max(weight.sum(), 1e-12)
    return float(error), curve


@jax.jit
def _ask(embeddings, texts, pixels, words):
    similar = word_similarities(embeddings, words, RULES.retrieval)

    def ask(text):
        scores = score_text(embeddings, text, pixels, words, similar, RULES)
        return scores.best, scores.state, scores.confidence

    return jax.vmap(ask)(texts)


def answered(options: Options, scene: str, seed: int, level: str, vision: int) -> list[tuple[float, float, float]]:
    """(confidence, right, weight) of each answer in one room, by simulated vision of a level and a seed."""
    root = options.data.place(scene, seed, "medium")
    bench = options.data.load(root, scene)
    found = pooled(bench, root, level, vision)
    words = twins.words_of(bench, root, level, vision).unrelated_words
    # Rooms share one program: regions without an embedding change nothing.
    room = -len(found.embeddings) % PADDED
    embeddings, pixels = (np.pad(own, ((0, room), (0, 0))) for own in (found.embeddings, found.pixel_counts))
    rows = []
    for texts, objects in ((found.texts, np.arange(len(found.texts))), (found.absent, np.full(len(found.absent), -1))):
        given = (jnp.asarray(own, jnp.float32) for own in (embeddings, texts, pixels, words))
        for region, state, confidence, thing in zip(*map(np.asarray, _ask(*given)), objects):
            if state > ABSENT:
                right = thing >= 0 and found.objects[region] == thing
                rows.append((float(confidence), float(right), 1 / len(texts)))
    return rows


def fit(told: Float[np.ndarray, "3 a"]) -> tuple[float, float]:
    """OFFSET and SLOPE of the largest likelihood, from confidences that the present ones gave."""
    confidence, right, weight = told
    ratio = (np.log(confidence) - np.log1p(-confidence) - OFFSET) / SLOPE

    def loss(line: np.ndarray) -> float:
        logit = line[0] + line[1] * ratio
        return float(np.average(np.logaddexp(0, logit) - right * logit, weights=weight))

    offset, slope = minimize(loss, np.array([OFFSET, SLOPE])).x
    return float(offset), float(slope)


def main(options: Options) -> dict:
    """Runs the experiment, writes its results and returns the figures."""
    file, both = Path(options.out) / "run" / "cells.jsonl", {}
    for seeds in (options.fitted, options.seeds):
        for level in options.levels:
            rows = []
            for scene, seed in ((scene, seed) for scene in options.scenes for seed in seeds):
                vision = seed + FITTED_VISION * (seeds == options.fitted)
                key = f"{scene}-{seed}-{vision}-{level}-{dict(options.data.size)}"
                if key not in read_cells(file):
                    append_cell(file, key, answered(options, scene, seed, level, vision))
                rows += read_cells(file)[key]
            both[seeds, level] = np.array(rows).reshape(-1, 3).T
    offset, slope = fit(np.concatenate([both[options.fitted, level] for level in options.levels], axis=1))
    kept, rows = {"fit": [offset, slope], "in jsecon": [OFFSET, SLOPE], "levels": {}}, []
    own = {level: both[options.seeds, level] for level in options.levels}
    for level, told in {**own, "all": np.concatenate(list(own.values()), axis=1)}.items():
        error, curve = calibration_error(*told)
        kept["levels"][level] = {"error": error, "curve": curve, "answers": told.shape[1]}
        said, right = (float(np.average(part, weights=told[2])) for part in told[:2])
        rows.append((level, told.shape[1], f"{error:.3f}", f"{said:.3f}", f"{right:.3f}"))
    table = results.table(("level", "answers", "calibration error", "mean confidence", "right"), rows)
    curve = results.table(("confidence", "right", "weight"), kept["levels"]["all"]["curve"])
    text = f"{table}\n\nReliability, all levels:\n\n{curve}\n\nFitted: offset {offset:.2f}, slope {slope:.2f}."
    results.save(Path(options.out), options, kept, text)
    print(text)
    return kept


if __name__ == "__main__":
    main(results.read_options(Options, "calibration", __doc__, QUICK))
