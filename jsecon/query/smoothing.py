"""Similarities evened out over neighbours in space: what one Gaussian's votes say by chance its neighbours do not.

VALA's readout does so with the relevancy of each Gaussian (experiments/rivals/lifting.py); here it is done with the
share that a region has of each.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jsecon.errors import require
from jsecon.types import Array

NEIGHBOURS = 10


def nearest_neighbours(means: Float[Array, "n 3"], *, count: int = NEIGHBOURS) -> Int[np.ndarray, "n k"]:
    """(N, K) int32 the `count` Gaussians whose centres (N, 3) are nearest to each, itself left out; K = N - 1 where
    there are fewer. Centres that are not finite are nobody's neighbours, and have themselves as theirs. Host code."""
    require(count >= 1, "nearest", count, "at least 1", "10 is the default.")
    means = np.asarray(means, np.float64)
    sound = np.flatnonzero(np.isfinite(means).all(1))
    found = np.repeat(np.arange(len(means), dtype=np.int32)[:, None], min(count, max(len(means) - 1, 1)), axis=1)
    if len(sound) > 1:
        points = means[sound]
        ways = min(found.shape[1], len(sound) - 1)
        near = np.asarray(KDTree(points).query(points, k=ways + 1, workers=-1)[1])
        own = near == np.arange(len(points))[:, None]
        own[~own.any(1), -1] = True  # of many in one place the farthest goes in its stead
        found[sound, :ways] = sound[near[~own].reshape(len(points), ways)]
    return found


@jax.jit
def smooth_over_neighbours(similarity: Float[Array, " n"], near: Int[Array, "n k"]) -> Float[Array, " n"]:
    """(N,) the mean of each Gaussian's similarity and its neighbours' mean, `near` (N, K) as of `nearest`. Pure."""
    return 0.5 * (similarity + jnp.mean(similarity[near], axis=1))
