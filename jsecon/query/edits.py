"""Selections grown, shrunk and combined. Pure functions of masks, but for the search for neighbours.

The shells are those of a symmetric graph of neighbours, so growing and then shrinking closes gaps and never loses a
selected Gaussian.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jsecon.errors import require
from jsecon.query.smoothing import nearest_neighbours
from jsecon.types import Array


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
      near: `mutual_neighbours` of all.
      shells: How often the neighbours of what is selected are added.

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
    """Removes shells of a selection: `grow` of what is not selected, with the same arguments and errors."""
    return ~grow(~jnp.asarray(mask), near, shells)


def invert(mask: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Selects what is not selected."""
    return ~jnp.asarray(mask)


def union(*masks: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Selects what any of the masks selects."""
    return jnp.any(jnp.stack(masks), axis=0)


def subtract(mask: Bool[Array, " n"], *others: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Selects what the mask selects and none of the others does."""
    return jnp.asarray(mask) & ~union(jnp.zeros_like(jnp.asarray(mask)), *others)
