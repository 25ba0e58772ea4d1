"""Errors that all views of an object share: what they do to simulated embeddings, against a real embedder.

    python -m experiments.shared_errors [--quick]

Twins of LERF at a level of noise, `World.shared` at each strength. Regions are those of the simulated tracker, each
with the mean of its masks' embeddings by their pixels. Measured are cosines between texts, masks and regions; how many
regions have their own object's text as the best of the scene's texts; how many texts find their object; and how often a
text of what is there is more similar to its best region than one of 100 names that nothing has. 100 other such names
are the words that a text is set apart from: their mean is subtracted. The last column is a real embedder's, noted and
not measured here: ConSE of a 631-class image labeller under MiniLM's text vectors, on given masks of
replica_apartment_0, 15 classes among 44 texts.
"""

import dataclasses
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import tyro

from experiments import lerf, results
from experiments.datasets.benchmark import Benchmark
from experiments.simulated_vision.worlds import SHARED_STRENGTH
from experiments.tables import twins
from experiments.words import rules

REAL = {
    "text to text": "0.29 to 0.33",
    "mask to its own text": "0.58",
    "mask to any text": "0.41",
    "same region, another view": "0.82",
    "another region of the same object": "0.73",
    "region of another object": "0.64",
    "own text is the best, by cosine": "0.23",
    "own text is the best, by centred cosine": "",
    "own text is the best, by what sets it apart from words": "",
    "text finds its object, by cosine": "",
    "text finds its object, by centred cosine": "",
    "text finds its object, by what sets it apart from words": "",
    "present above absent, by cosine": "0.92",
    "present above absent, by centred cosine": "0.84",
    "present above absent, by what sets it apart from words": "",
}
"""what is measured, and the real embedder's figures where they are known"""
RULES = {"cosine": "cosine", "centred cosine": "centred", "what sets it apart from words": "contrast"}
"""names of some of `rules.SCORES` there"""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    data: tyro.conf.Suppress[twins.Data] = lerf.PLAN.data
    scenes: tuple[str, ...] = lerf.PLAN.data.scenes
    """Twins of LERF."""
    seeds: tuple[int, ...] = (0, 1, 2)
    strengths: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, SHARED_STRENGTH, 1.0)
    noise: Literal["low", "medium", "high"] = "medium"
    quick: bool = False
    """Run one tiny scene with two strengths."""
    out: str = ""


QUICK = {"data": lerf.QUICK.data, "scenes": lerf.QUICK.data.scenes, "seeds": (0,), "strengths": (0.0, 1.0)}


class Pooled(NamedTuple):
    """The tracker's regions of a twin, and the texts that can be asked."""

    embeddings: np.ndarray
    """(R, E) unit, of each region the mean of its masks' by their pixels; zero where it has none."""
    pixels: np.ndarray
    """(R, T)."""
    objects: np.ndarray
    """(R,) the object that most of its pixels show, -1 = none."""
    masks: np.ndarray
    """(T, R, E) unit, zero where a region has no mask."""
    texts: np.ndarray
    """(K, E) of the objects, surroundings included."""
    asked: np.ndarray
    """(Q,) the objects that the benchmark's queries name."""
    absent: np.ndarray
    """(A, E) texts of nothing in the scene."""
    canonical_phrases: np.ndarray
    """(4, E)."""


def pooled(bench: Benchmark, root: Path, level: str, seed: int) -> Pooled:
    """The regions and texts of a twin under simulated vision of a level, without Gaussians."""
    _, frames, _, (labels, *_), embedder = twins.sight(bench, root, level, seed)
    names = twins.objects_of(bench, root)
    regions = len(labels.origin)
    masks = np.zeros((len(frames), regions, embedder.dim), np.float32)
    pixels = np.zeros((regions, len(frames)), np.int64)
    for t, image in enumerate(labels.labels):
        here, pixels_here = np.unique(image[image >= 0], return_counts=True)
        pixels[here, t] = pixels_here
        masks[t, here] = embedder.embed_regions(frames[t], image[None] == here[:, None, None])
    embeddings = rules.unit(np.einsum("tre,rt->re", masks, pixels)).astype(np.float32)
    asked = np.array([names.index(query) for query in bench.queries])
    absent = twins.words_of(bench, root, level, seed).absent
    texts = embedder.embed_text(names)
    return Pooled(embeddings, pixels, labels.origin, masks, texts, asked, absent, embedder.canonical_phrases)


def figures_of(found: Pooled) -> dict[str, float]:
    """The figures of REAL, of one twin."""
    here = (found.pixels.sum(1) > 0) & (found.objects >= 0)
    own = found.objects[here]
    rows = found.embeddings[here]
    different = ~np.eye(len(found.texts), dtype=bool)
    to_text = found.masks[:, here] @ found.texts.T
    shown = found.pixels[here].T > 0
    to_own = np.take_along_axis(to_text, np.broadcast_to(own[None, :, None], (*shown.shape, 1)), axis=2)[..., 0]
    views = np.einsum("tre,sre->rts", found.masks[:, here], found.masks[:, here])
    pairs = shown.T[:, :, None] & shown.T[:, None, :] & ~np.eye(len(shown), dtype=bool)
    between = rows @ rows.T
    same = (own[:, None] == own) & ~np.eye(len(own), dtype=bool)
    told = {
        "text to text": (found.texts @ found.texts.T)[different].mean(),
        "mask to its own text": to_own[shown].mean(),
        "mask to any text": to_text[shown].mean(),
        "same region, another view": views[pairs].mean(),
        "another region of the same object": between[same].mean() if same.any() else np.nan,
        "region of another object": between[own[:, None] != own].mean(),
    }
    every = np.concatenate([found.texts, found.absent])
    words = found.absent[: len(found.absent) // 2]
    for rule, kind in RULES.items():
        scores = rules.scores(found.embeddings, every, found.canonical_phrases, words, found.pixels, kind)
        texts, absent = scores[: len(found.texts)], scores[len(found.texts) + len(words) :]
        told[f"own text is the best, by {rule}"] = (texts[:, here].argmax(0) == own).mean()
        answer = texts[found.asked].argmax(1)
        told[f"text finds its object, by {rule}"] = (found.objects[answer] == found.asked).mean()
        above = texts[found.asked].max(1)[:, None] > absent.max(1)
        told[f"present above absent, by {rule}"] = above.mean()
    return {name: float(told[name]) for name in REAL}


def main(options: Options) -> dict:
    """Runs the experiment, writes its results and returns the mean figures of each strength."""
    told: dict[float, list[dict[str, float]]] = {strength: [] for strength in options.strengths}
    for scene in options.scenes:
        for seed in options.seeds:
            root = options.data.place(scene, seed, "medium")
            bench = options.data.load(root, scene)
            for strength in options.strengths:
                told[strength].append(figures_of(pooled(bench, root, f"{options.noise}+shared={strength:g}", seed)))

    def mean(each):
        return {name: float(np.nanmean([figures[name] for figures in each])) for name in REAL}

    means = {strength: mean(each) for strength, each in told.items()}
    header = ("measured", *(f"strength {strength:g}" for strength in means), "a real embedder")
    table = results.table(header, [(name, *(m[name] for m in means.values()), REAL[name]) for name in REAL])
    kept = {f"{strength:g}": {"mean": means[strength], "each": each} for strength, each in told.items()}
    results.save(Path(options.out), options, kept, table)
    print(table)
    return means


if __name__ == "__main__":
    main(results.read_options(Options, "shared_errors", __doc__, QUICK))
