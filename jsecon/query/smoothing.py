"""Similarities smoothed over neighbours in space, so that chance differences of the votes even out.

VALA's readout smooths the relevancy of each Gaussian (experiments/rivals/lifting.py); here it is the share of a region.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jsecon.errors import require
from jsecon.types import Array

NEIGHBOURS = 10
"""Nearest Gaussians that are averaged."""


def nearest_neighbours(means: Float[Array, "n 3"], *, count: int = NEIGHBOURS) -> Int[np.ndarray, "n k"]:
    """Finds the Gaussians whose centres are nearest to each. Host code.

    Args:
      means: (N, 3) centres.
      count: Neighbours of each.

    Returns:
      (N, K) int32 ids without the Gaussian itself; K = N - 1 if there are fewer. A centre that is not finite is not a
      neighbour, and has itself as its neighbours.

    Raises:
      ValueError: `count` is below 1.
    """
    require(count >= 1, "nearest_neighbours", count, "at least 1", "10 is the default.")
    means = np.asarray(means, np.float64)
    finite = np.flatnonzero(np.isfinite(means).all(1))
    ids = np.repeat(np.arange(len(means), dtype=np.int32)[:, None], min(count, max(len(means) - 1, 1)), axis=1)
    if len(finite) > 1:
        points = means[finite]
        kept = min(ids.shape[1], len(finite) - 1)
        near = np.asarray(KDTree(points).query(points, k=kept + 1, workers=-1)[1])
        itself = near == np.arange(len(points))[:, None]
        itself[~itself.any(1), -1] = True  # of many in one place the farthest goes in its stead
        ids[finite, :kept] = finite[near[~itself].reshape(len(points), kept)]
    return ids


@jax.jit
def smooth_over_neighbours(similarity: Float[Array, " n"], near: Int[Array, "n k"]) -> Float[Array, " n"]:
    """Averages each Gaussian's similarity (N,) with the mean of its `nearest_neighbours` (N, K). Pure.

    Returns:
      (N,) half the similarity and half the neighbours' mean.
    """
    return 0.5 * (similarity + jnp.mean(similarity[near], axis=1))
