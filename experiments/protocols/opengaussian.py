"""OpenGaussian's ways from texts to Gaussians: the most similar text of the scene, or the most similar leaf cluster.

What they select is measured like any other selection, rendered alone with alpha > 0.7 (yanmin-wu/OpenGaussian,
render_lerf_by_text.py).
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from jsecon.errors import require
from jsecon.numerics import cosine_matrix, safe_norm
from jsecon.types import Array, Selection

LARGEST_SCALE = 0.1
"""world units: a Gaussian larger than this along any axis is not selected"""
FEWEST = 100
"""Gaussians below which a selection is left as it is"""
LEAF_REACH = 0.9
"""L2 distance between codes within which a sibling leaf is taken along"""
NEXT_BEST = 9
"""leaves after the best that may be taken along"""


def most_similar_text(
    features: Float[Array, "n e"], texts: Float[Array, "q e_text"]
) -> tuple[Int[Array, " n"], Float[Array, "n q"]]:
    """Each Gaussian's most similar text of the scene (-1 for a feature that is zero or not finite), and all cosines.

    How OpenGaussian measures LangSplat at the points (its issue 9), and how Replica and ScanNet are answered.
    """
    require(
        features.shape[1] == texts.shape[1] and texts.shape[0] > 0,
        "most_similar_text",
        f"features {features.shape}, texts {texts.shape}",
        "one space, at least one text",
        "Decode the features to the texts' space.",
    )
    return _most_similar_text(features, texts)


@jax.jit
def _most_similar_text(features: Array, texts: Array) -> tuple[Array, Array]:
    known = jnp.any(features != 0, axis=1) & jnp.all(jnp.isfinite(features), axis=1)
    cosines = cosine_matrix(jnp.where(known[:, None], features, 0.0), texts)
    return jnp.where(known, jnp.argmax(cosines, axis=1), -1), cosines


@jax.jit
def select_text(labels: Int[Array, " n"], cosines: Float[Array, "n q"], query: int | Array) -> Selection:
    """The Gaussians whose most similar text is `query`."""
    mask = labels == query
    similarity = jnp.where(mask, jnp.maximum(cosines[:, query], 0.0), 0.0)
    return Selection(mask, similarity, jnp.asarray(-1, jnp.int32), jnp.max(similarity, initial=0.0))


@functools.partial(jax.jit, static_argnames="siblings")
def select_leaf(
    leaf_features: Float[Array, "l e"],
    leaf_codes: Float[Array, "l d"],
    leaf_of: Int[Array, " n"],
    text: Float[Array, " e"],
    *,
    siblings: int,
) -> Selection:
    """The Gaussians of the leaf most similar to the text, without threshold, and of those of the next nine that are
    its siblings with a near code.

    leaf_features: (L, E) language features, a zero row for a leaf that matched too few views; leaf_codes (L, d) the
    codebook; leaf_of (N,) the leaf of each Gaussian, -1 = none; `siblings`: ids that differ by less are of one root.
    Selection.region is the best leaf; nothing is selected where no leaf has a feature.
    """
    known = jnp.any(leaf_features != 0, axis=1)
    cosines = jnp.where(known, cosine_matrix(leaf_features, text[None])[:, 0], -jnp.inf)
    order = jnp.argsort(-cosines)
    best, rest = order[0], order[1 : 1 + NEXT_BEST]
    near = safe_norm(leaf_codes[rest] - leaf_codes[best]) < LEAF_REACH
    along = (jnp.abs(rest - best) < siblings) & near & known[rest]
    chosen = jnp.zeros(len(leaf_features), bool).at[best].set(known[best]).at[rest].max(along)
    mask = (leaf_of >= 0) & chosen[jnp.maximum(leaf_of, 0)]
    found = jnp.where(known[best], cosines[best], 0.0)
    similarity = jnp.where(mask, jnp.maximum(cosines[jnp.maximum(leaf_of, 0)], 0.0), 0.0)
    return Selection(mask, similarity, jnp.where(known[best], best, -1).astype(jnp.int32), found)


def without_stragglers(
    means: Float[Array, "n 3"], log_scales: Float[Array, "n 3"], mask: Bool[Array, " n"]
) -> Bool[np.ndarray, " n"]:
    """A selection without Gaussians of any scale from 0.1 on, and without those whose mean distance to their
    sqrt(m) neighbours in the selection exceeds its mean by one standard deviation. Fewer than 100 stay as they are.

    OpenGaussian's own clean-up; host code. World units: the rule is not scale-aware, as theirs is not.
    """
    kept = np.asarray(mask) & (np.exp(np.asarray(log_scales)).max(1) < LARGEST_SCALE)
    chosen = np.flatnonzero(kept)
    if len(chosen) < FEWEST:
        return np.asarray(mask).copy()
    points = np.asarray(means, np.float64)[chosen]
    distance = KDTree(points).query(points, k=int(np.sqrt(len(points))))[0].mean(1)
    kept[chosen[distance > distance.mean() + distance.std()]] = False
    return kept
