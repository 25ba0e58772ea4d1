"""Rules that answer texts by embeddings of regions or of Gaussians: pure functions of arrays.

Letters: N Gaussians, R regions, Q texts, E embedding. Scores are (Q, R) or (Q, N), choices bool of the same shape. A
choice of regions becomes one of Gaussians by their votes (`selected`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.field.membership import SHARE_THRESHOLD, inside_fraction
from jsecon.paper.queries import TEMPERATURE
from jsecon.types import Votes

SCORES = ("cosine", "relevancy", "centred", "contrast")
"""of a text and a region"""


def scores(
    embeddings: Float[np.ndarray, "r e"],
    texts: Float[np.ndarray, "q e"],
    canonical: Float[np.ndarray, "c e"],
    words: Float[np.ndarray, "w e"],
    pixels: Int[np.ndarray, "r t"],
    kind: str,
) -> Float[np.ndarray, "q r"]:
    """Scores of all texts with all regions, by one of SCORES; -inf for a region without an embedding.

    "relevancy" is LERF's. "contrast" is jsecon's: it subtracts the mean of the unrelated words (W, E) from the text.
    "centred" compares what is left of a text across the canonical phrases (C, E) with what is left of a region without
    the mean of the R regions, weighted by their pixels in T views.
    """
    known = np.asarray(embeddings).any(axis=1)
    if kind == "centred":
        weight = pixels.sum(axis=1) * known
        mean = weight @ embeddings / max(weight.sum(), 1)
        residual = embeddings - known.sum() / (known.sum() + 1) * mean
        cone = unit(unit(canonical).sum(axis=0)[None])
        table = unit(texts - texts @ cone.T * cone) @ unit(residual).T
    elif kind == "contrast":
        table = unit(unit(texts) - unit(words).mean(axis=0)) @ embeddings.T
    else:
        table = texts @ embeddings.T
        if kind == "relevancy":
            table = 1 / (1 + np.exp(-TEMPERATURE * (table - (canonical @ embeddings.T).max(axis=0))))
    return np.where(known[None], table, -np.inf)


def unit(rows: Float[np.ndarray, "n e"]) -> Float[np.ndarray, "n e"]:
    """Rows of unit length in their own precision; zero rows stay zero."""
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)


def best_of(table: Float[np.ndarray, "q r"]) -> Bool[np.ndarray, "q r"]:
    """The best region of each text."""
    return (np.arange(table.shape[1]) == table.argmax(axis=1)[:, None]) & np.isfinite(table)


def near_best(table: Float[np.ndarray, "q r"], nearness: float) -> Bool[np.ndarray, "q r"]:
    """All regions that have come at least so far from the median region's score to the best one's."""
    known = np.where(np.isfinite(table), table, np.nan)
    middle = np.nanmedian(known, axis=1, keepdims=True)
    best = np.nanmax(known, axis=1, keepdims=True)
    return (table >= middle + nearness * (best - middle)) & (best > middle)


def standardised(
    table: Float[np.ndarray, "q r"], weight: Float[np.ndarray, " r"] | None = None
) -> Float[np.ndarray, "q r"]:
    """Each text's scores less their mean over the regions, over their standard deviation; regions weighted alike, or
    by `weight`. A text that all regions answer alike has 0."""
    known = np.isfinite(table)
    own = known * (np.ones(table.shape[1]) if weight is None else weight)
    own = own / np.maximum(own.sum(axis=1, keepdims=True), 1e-12)
    finite = np.where(known, table, 0.0)
    mean = (own * finite).sum(axis=1, keepdims=True)
    spread = np.sqrt((own * (finite - mean) ** 2).sum(axis=1, keepdims=True))
    return np.where(known, (finite - mean) / np.where(spread > 0, spread, np.inf), -np.inf)


def best_text(table: Float[np.ndarray, "q r"]) -> Bool[np.ndarray, "q r"]:
    """Each region under its best text: a list of classes divides the regions."""
    return (np.arange(len(table))[:, None] == table.argmax(axis=0)) & np.isfinite(table)


def selected(votes: Votes, chosen: Bool[np.ndarray, "q r"]) -> Bool[np.ndarray, "q n"]:
    """The Gaussians that lie in the chosen regions with a share of at least `SHARE_THRESHOLD`."""
    votes = jax.tree.map(jnp.asarray, votes)
    rows = []
    for own in chosen:
        share, known = _share(votes, jnp.asarray(own))
        rows.append(np.asarray(known & (share >= SHARE_THRESHOLD)))
    return np.stack(rows)


_share = jax.jit(lambda votes, chosen: tuple(inside_fraction(votes, chosen)))


def point_scores(
    features: Float[np.ndarray, "n e"], texts: Float[np.ndarray, "q e"], canonical: Float[np.ndarray, "c e"], kind: str
) -> Float[np.ndarray, "q n"]:
    """Scores of all texts with all Gaussians, "cosine" or "relevancy"; -inf where a feature is zero."""
    known, table = np.asarray(features).any(axis=1), texts @ features.T
    if kind == "relevancy":
        table = 1 / (1 + np.exp(-TEMPERATURE * (table - (canonical @ features.T).max(axis=0))))
    return np.where(known[None], table, -np.inf)


def ious(
    chosen: Bool[np.ndarray, "q n"], truth: Int[np.ndarray, " n"], asked: Int[np.ndarray, " q"]
) -> Float[np.ndarray, " q"]:
    """IoU of each text's Gaussians with those of its name, over the Gaussians with a truth (-1 = none)."""
    counted = truth >= 0
    true = truth[None, counted] == asked[:, None]
    own = chosen[:, counted]
    return (own & true).sum(axis=1) / np.maximum((own | true).sum(axis=1), 1)


def best_threshold(
    table: Float[np.ndarray, "q n"],
    truth: Int[np.ndarray, " n"],
    asked: Int[np.ndarray, " q"],
    grid: Float[np.ndarray, " g"],
) -> tuple[float, Float[np.ndarray, " q"]]:
    """The threshold of `grid` with the largest mean IoU over the texts, the same for all of them, and the IoUs there.
    Chosen by the truth: what a threshold could give at most."""
    found = [ious(table >= level, truth, asked) for level in grid]
    best = int(np.argmax([row.mean() for row in found]))
    return float(grid[best]), found[best]


def auc(present: Float[np.ndarray, " p"], absent: Float[np.ndarray, " a"]) -> float:
    """How probably a present text's score is above an absent one's; ties count half."""
    above = (present[:, None] > absent[None]).mean()
    return float(above + 0.5 * (present[:, None] == absent[None]).mean())


def interval(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """The middle 95 % of the mean under resampling of its values: classes, or (class, scene) pairs."""
    drawn = np.random.default_rng(0).integers(0, len(values), (10_000, len(values)))
    means = np.asarray(values, float)[drawn].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(low), float(high)
