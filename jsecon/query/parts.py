"""Which parts of what a text found answer it: where masks took a thing and its neighbour for one, a text tells them
apart.

Regions hold what most views put into one mask. Where most views are wrong alike, a region is two things, or a thing and
its shadow; but in the other views the masks tell them apart, and so do their embeddings. So each small part of the
scene has an embedding of its own, the mean over all masks that hold it. This is what training-free methods give each
Gaussian (Occam's LGS, arXiv 2412.01807); here it only divides what the regions found.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.query.outliers import MIN_SAMPLES, dbscan, default_eps
from jsecon.query.retrieval import NEARNESS, PIECE_NEARNESS, contrasts
from jsecon.types import Array, LanguageField, Parts, Selection

SPACINGS = 3.0
"""of a selection's own points, between which it falls apart: less than for outliers, as things that stand side by side
are to be told apart"""
NOT_OF_IT = 0.25
"""of a Gaussian whose region answers and whose part does not: the similarity that says so, at most"""
UPPER = 0.75
"""quantile of a cluster's parts that says how near it is: parts at its rim are mixed with what is behind"""


@jax.jit
def part_nearness(parts: Parts, text: Float[Array, " e"], canonical: Float[Array, "c e"]) -> Float[Array, " n"]:
    """How near each Gaussian's part comes to a text (E,), (N,): 0 as near as the middle one, 1 as the nearest.

        z_p = (s_p - m) / (max s - m),  s the contrast with the text (`contrasts`), m its median

    over parts that lie in masks; 0 for Gaussians of no such part, and for all where all parts are equally near.
    """
    similarity, known = contrasts(parts.embeddings, text, canonical, parts.weight[:, None])
    middle = jnp.nanmedian(jnp.where(known, similarity, jnp.nan))
    reach = jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf) - middle
    near = jnp.where(known & (reach > 0), (similarity - middle) / jnp.where(reach > 0, reach, 1.0), 0.0)
    near = jnp.concatenate([near, jnp.zeros(1, near.dtype)])
    return near[parts.part]  # of -1: the last


def query_parts(field: LanguageField, selection: Selection, wanted: Float[Array, "q e"]) -> Selection:
    """`selection`, what `query_several` found for the wanted texts (Q, E), without parts that answer none of them
    (`answering_parts`); their similarity becomes NOT_OF_IT at most. Raises ValueError where the field has no parts."""
    remedy = "Run with --parts, or ask without."
    require(field.parts is not None, "query_parts", "a field without parts", "its parts", remedy)
    near = jnp.max(jnp.stack([part_nearness(field.parts, text, field.canonical) for text in wanted]), axis=0)
    mask = jnp.asarray(answering_parts(selection.mask, near, field.gaussians.means))
    dropped = jnp.asarray(selection.mask) & ~mask
    similarity = jnp.where(dropped, jnp.minimum(selection.similarity, NOT_OF_IT), selection.similarity)
    return dataclasses.replace(selection, mask=mask, similarity=similarity)


def answering_parts(
    mask: Bool[Array, " n"],
    nearness: Float[Array, " n"],
    means: Float[Array, "n 3"],
    *,
    least: float = PIECE_NEARNESS,
    of_kind: float = NEARNESS,
) -> Bool[np.ndarray, " n"]:
    """What of a selection `mask` answers the text by `part_nearness`, with two thresholds: the parts that are at least
    `least` near, in clusters (DBSCAN on the centres, `SPACINGS`) of which the upper quarter is at least `of_kind` near.
    The nearest of the clusters that have a tenth of the largest's Gaussians stays in any case. Host code.
    """
    near, kept = np.asarray(nearness), np.asarray(mask) & np.isfinite(np.asarray(means)).all(axis=1)
    kept &= near >= least
    chosen = np.flatnonzero(kept)
    if len(chosen) < MIN_SAMPLES:
        return kept
    points = np.asarray(means)[chosen].astype(np.float64)
    cluster = dbscan(points, default_eps(points, spacings=SPACINGS), MIN_SAMPLES)
    if cluster.max() < 0:
        return kept
    sizes = np.bincount(cluster[cluster >= 0])
    upper = np.array([np.quantile(near[chosen][cluster == c], UPPER) for c in range(len(sizes))])
    stays = (upper >= of_kind) | (upper >= upper[sizes >= 0.1 * sizes.max()].max())
    result = np.zeros_like(kept)
    result[chosen[(cluster >= 0) & stays[cluster]]] = True
    return result
