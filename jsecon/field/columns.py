"""Rows of columns that may lie in memory-mapped files. Host code."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from jsecon.types import Votes

ROWS = 1 << 18
"""Gaussians of a block of mapped columns."""
_NOT_BY_ROW = ("overflow", "num_regions", "by_view", "overlap")
"""Fields of `Votes` that have no row for each Gaussian."""


def is_mapped(tree: Any) -> bool:
    """Finds out whether any array of a tree lies in a memory-mapped file.

    Args:
      tree: Tree of arrays.

    Returns:
      True if one does.
    """
    return any(isinstance(leaf, np.memmap) for leaf in jax.tree.leaves(tree))


def row_slices(tree: Any, count: int) -> Iterator[slice]:
    """Divides rows into consecutive slices, so that at most one block of mapped columns is in memory.

    Args:
      tree: Tree of arrays with rows.
      count: N, number of rows.

    Returns:
      The slices, of ROWS rows if the tree has mapped arrays; else a single one.
    """
    step = ROWS if is_mapped(tree) else max(count, 1)
    return (slice(first, min(first + step, count)) for first in range(0, count, step))


def votes_of_rows(votes: Votes, rows: slice | Int[np.ndarray, " m"]) -> Votes:
    """Takes the votes of some of the Gaussians.

    Args:
      votes: Votes of N Gaussians.
      rows: (M,) rows, or a slice.

    Returns:
      Votes of M Gaussians, NumPy, without `by_view` and `overlap`, which have no row for each Gaussian.
    """

    def take(column):
        return None if column is None else np.asarray(column[rows])

    columns = {field.name: getattr(votes, field.name) for field in dataclasses.fields(votes)}
    taken = {name: take(column) for name, column in columns.items() if name not in _NOT_BY_ROW}
    return dataclasses.replace(votes, **taken, by_view=None, overlap=None)


def vote_blocks(votes: Votes) -> Iterator[Votes]:
    """Divides votes into blocks of Gaussians.

    Args:
      votes: Votes of N Gaussians.

    Returns:
      The votes of each block on jax's device; a single block if they are not mapped.
    """
    return (jax.tree.map(jnp.asarray, votes_of_rows(votes, rows)) for rows in row_slices(votes, len(votes.views)))
