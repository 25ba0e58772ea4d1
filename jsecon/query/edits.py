"""Selections grown and shrunk. Pure functions of masks, but for the search for neighbours.

Other edits are operators of arrays: `a | b` joins two masks, `a & ~b` subtracts one, `~a` inverts one.

The shells are those of a symmetric graph of neighbours, so growing and then shrinking closes gaps and never loses a
selected Gaussian.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
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


def mutual_neighbours(means: Float[Array, "n 3"]) -> Int[np.ndarray, "n k"]:
    """Finds pairs of Gaussians that are among each other's nearest ones. Host code.

    A floater has no such tie to the object that it floats before.

    Args:
      means: (N, 3) centres.

    Returns:
      (N, K) int32 ids; the Gaussian itself in place of a neighbour that does not have it in turn.
    """
    near = nearest_neighbours(means)
    itself = np.arange(len(near), dtype=np.int32)[:, None]
    mutual = np.stack([(near[column] == itself).any(1) for column in near.T], axis=1)  # in turn, for memory
    return np.where(mutual, near, itself)


@jax.jit
def _grow_once(mask: Bool[Array, " n"], near: Int[Array, "n k"]) -> Bool[Array, " n"]:
    return mask | jnp.any(mask[near], axis=1)


def grow(mask: Bool[Array, " n"], near: Int[Array, "n k"], shells: int = 1) -> Bool[Array, " n"]:
    """Adds shells of neighbours to a selection.

    Args:
      mask: (N,) the selected Gaussians.
      near: (N, K) `mutual_neighbours` of all.
      shells: Number of shells that are added.

    Returns:
      (N,) mask, which contains the first one.

    Raises:
      ValueError: `shells` is negative.
    """
    require(shells >= 0, "grow", shells, "0 or more shells", "Use shrink to remove shells.")
    mask = jnp.asarray(mask)
    for _ in range(shells):
        mask = _grow_once(mask, jnp.asarray(near))
    return mask


def shrink(mask: Bool[Array, " n"], near: Int[Array, "n k"], shells: int = 1) -> Bool[Array, " n"]:
    """Removes shells of a selection: `grow` of what is not selected.

    Args:
      mask: (N,) the selected Gaussians.
      near: (N, K) `mutual_neighbours` of all.
      shells: Number of shells that are removed.

    Returns:
      (N,) mask, which the first one contains.

    Raises:
      ValueError: `shells` is negative.
    """
    return ~grow(~jnp.asarray(mask), near, shells)
