"""Core and cover: a selection grown from what is surely the thing's by what covers most of it and spills least."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.query.render import ALPHA_THRESHOLD, VALA_THRESHOLD
from jsecon.query.silhouette import MIN_CANDIDATE_SHARE, footprints, views_of
from jsecon.types import Array, Camera, Gaussians

CORE = 0.9
"""share of a Gaussian from which it is taken at once"""
LEAST_GAIN = 0.5
"""of cover for a pixel of spill, for a Gaussian to be added"""
MOST = 4096


def core_and_cover(gaussians: Gaussians, cameras: Camera, share: Float[np.ndarray, " n"]) -> Bool[Array, " n"]:
    """(N,) bool: {s >= CORE}, then, largest share s (N,) first, every Gaussian of s > MIN_CANDIDATE_SHARE with

        sum pi min(a, (l* - l)_+) / l* >= LEAST_GAIN sum (1 - pi) 1[l <= l_0 < l + a]

    over the pixels of the views, pi the part of a pixel that is the thing's, l what is absorbed there by those taken, a
    what the Gaussian absorbs, l* = -log(1 - 0.7) and l_0 = -log(1 - 10/255).
    """
    share = np.asarray(share, np.float32)
    chosen = share >= CORE
    order = np.flatnonzero((share > MIN_CANDIDATE_SHARE) & ~chosen)
    order = order[np.argsort(-share[order], kind="stable")[:MOST]]
    if not chosen.any() or not len(order):
        return jnp.asarray(chosen)
    found = footprints(gaussians, views_of(gaussians, cameras, chosen), share, order, chosen)
    absorbed, tiles, starts = (np.asarray(a) for a in (found.absorbed, found.tiles, found.starts))
    inside, outside, level = (np.array(a) for a in (found.inside, found.outside, found.base))
    solid, faint = (-np.log1p(-t) for t in (ALPHA_THRESHOLD, VALA_THRESHOLD))
    for k, n in enumerate(order):
        pairs = slice(starts[k], starts[k + 1])
        a, t = absorbed[pairs], tiles[pairs]
        before = level[t]
        cover = (inside[t] * np.minimum(a, np.maximum(solid - before, 0))).sum() / solid
        spill = (outside[t] * ((before <= faint) & (before + a > faint))).sum()
        if cover >= LEAST_GAIN * spill and cover > 0:
            level[t] += a
            chosen[n] = True
    return jnp.asarray(chosen)
