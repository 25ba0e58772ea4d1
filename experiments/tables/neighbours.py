"""The nearest neighbours of Gaussians, over which shares are smoothed."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from jsecon.errors import require
from jsecon.types import Array

NEIGHBOURS = 10
"""nearest Gaussians that are averaged"""


def nearest_neighbours(means: Float[Array, "n 3"], *, count: int = NEIGHBOURS) -> Int[np.ndarray, "n k"]:
    """Ids (N, K) of the Gaussians whose centres are nearest to each, without itself; K = N - 1 if there are fewer.

    A centre that is not finite is not a neighbour, and has itself as its neighbours.
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
