"""Claims of the paper beside its tables: averages over views vary less and compress better, retraining moves little.

    python -m experiments.claims [--quick]

Twins of LERF's figurines at medium noise, regions by the ids of the tracker. Spread: 1 - cosine between the mean of
half of a region's views and a view of the other half, or the mean of the other half. Compression: LangSplat's
autoencoder to 3 numbers, trained on the masks of all views or on the averages of the regions; cosine of the decoded
averages, and share of texts whose region (by the cosine) stays the same.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments import lerf, results
from experiments.baselines.evidence import unit
from experiments.tables.answers import Steps
from experiments.tables.association import overlaps
from experiments.tables.fill import measure
from experiments.tables.ours import paper
from experiments.tables.setting import Setting, prepare
from jsecon.numerics import cosine, cosine_matrix
from jsecon.paper.autoencoder import decode, encode, train_autoencoder
from jsecon.types import Autoencoder

LATENT = 3
"""Size of the autoencoder's code."""
LEAST_VIEWS = 6
"""Views that a region needs to count."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What the experiment can vary."""

    seeds: tuple[int, ...] = (10, 11, 12)
    retrained: int = 5
    """Number of trainings of the paper's path on the last twin."""
    scene: str = "figurines"
    level: str = "medium"
    quick: bool = False
    """Run one tiny scene with few training steps."""
    out: str = ""


def views_of_regions(setting: Setting) -> list[tuple[np.ndarray, np.ndarray]]:
    """(V, E) embeddings and (V,) pixels of the masks of each region with at least LEAST_VIEWS masks.

    A mask belongs to the region that most of its pixels belong to.
    """
    evidence = setting.evidence
    inside = overlaps(np.asarray(evidence.tracks), np.asarray(evidence.masks), len(evidence.embeddings))
    region, pixels = inside.argmax(0), inside.max(0)
    rows = [np.flatnonzero((region == r) & (pixels > 0)) for r in range(len(inside))]
    return [(np.asarray(evidence.embeddings)[own], pixels[own]) for own in rows if len(own) >= LEAST_VIEWS]


def spread(regions: list[tuple[np.ndarray, np.ndarray]], seed: int) -> tuple[float, float]:
    """Mean 1 - cosine to the mean of half of the views: of a view of the other half, and of the mean of that half."""
    draw, single, half = np.random.default_rng(seed), [], []

    def mean(rows, weights):
        return unit((weights[:, None] * rows).sum(0, keepdims=True))[0]

    for rows, weights in regions:
        order = draw.permutation(len(rows))
        a, b = order[: len(rows) // 2], order[len(rows) // 2 :]
        other = mean(rows[b], weights[b])
        single.append(1 - float((rows[a] @ other).mean()))
        half.append(1 - float(mean(rows[a], weights[a]) @ other))
    return float(np.mean(single)), float(np.mean(half))


def compressed(coder: Autoencoder, averages: np.ndarray, texts: np.ndarray) -> tuple[float, float]:
    """Cosine of the decoded averages, and share of texts that match the same region as before."""
    back = decode(coder, encode(coder, jnp.asarray(averages)))
    before, after = (np.asarray(cosine_matrix(jnp.asarray(texts), rows)).argmax(1) for rows in (averages, back))
    return float(cosine(back, jnp.asarray(averages)).mean()), float((before == after).mean())


def main(options: Options) -> str:
    """Measures, writes the results and returns the table."""
    table = lerf.QUICK if options.quick else lerf.PLAN
    steps = table.steps if options.quick else Steps()
    rows, metrics = [], {}
    setting = None
    for seed in options.seeds:
        setting = prepare(table.data, options.scene, seed, options.level, fit_steps=table.fit_steps)
        regions, key = views_of_regions(setting), jax.random.key(seed)
        averages = unit(np.stack([(pixels[:, None] * rows).sum(0) for rows, pixels in regions]))
        every = np.concatenate([rows for rows, _ in regions])
        told = dict(zip(("one view", "mean of half"), spread(regions, seed), strict=True))
        for name, given in (("masks", every), ("averages", averages)):
            coder = train_autoencoder(jnp.asarray(given), latent=LATENT, key=key, epochs=steps.epochs)
            told |= dict(zip((f"{name}: cosine", f"{name}: texts"), compressed(coder, averages, setting.texts)))
        metrics[f"seed {seed}"] = told
        rows.append((seed, len(regions), len(every), *told.values()))
        print(rows[-1], flush=True)
    header = ("seed", "regions", "masks", *next(iter(metrics.values())))
    text = results.table(header, rows)
    assert setting is not None
    again = []
    for k in range(options.retrained):  # the last twin; only the training's seed changes
        again.append(measure(setting, paper(dataclasses.replace(setting, seed=100 + k), steps))["miou"])
        print(f"retrained {k}: {again[-1]:.3f}", flush=True)
    metrics["retrained"] = again
    apart = np.std(again, ddof=1) if len(again) > 1 else 0.0
    text += f"\n\nThe paper's path, {len(again)} trainings on the last twin: mIoU {np.mean(again):.3f} ± {apart:.3f}, "
    text += ", ".join(f"{value:.3f}" for value in again) + "."
    results.save(Path(options.out), options, metrics, text)
    print(text)
    return text


if __name__ == "__main__":
    main(results.read_options(Options, "claims", __doc__, {"seeds": (0,), "retrained": 2}))
