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
    """Whether any array of a tree lies in a memory-mapped file."""
    return any(isinstance(leaf, np.memmap) for leaf in jax.tree.leaves(tree))


def row_slices(tree: Any, count: int, rows: int | None = None) -> Iterator[slice]:
    """Consecutive slices of `count` rows: of ROWS rows (or `rows`) if the tree has mapped arrays, else one of all.

    A pure function of rows, applied slice by slice, therefore never holds more than a block of mapped columns.
    """
    step = (ROWS if rows is None else rows) if is_mapped(tree) else max(count, 1)
    return (slice(first, min(first + step, count)) for first in range(0, count, step))


def votes_of_rows(votes: Votes, rows: slice | Int[np.ndarray, " m"]) -> Votes:
    """The votes of some of the Gaussians, NumPy, without what has no row for each (`by_view`, `overlap`)."""

    def take(column):
        return None if column is None else np.asarray(column[rows])

    columns = {field.name: getattr(votes, field.name) for field in dataclasses.fields(votes)}
    taken = {name: take(column) for name, column in columns.items() if name not in _NOT_BY_ROW}
    return dataclasses.replace(votes, **taken, by_view=None, overlap=None)


def vote_blocks(votes: Votes) -> Iterator[Votes]:
    """The votes on jax's device, block after block of Gaussians if they are mapped."""
    return (jax.tree.map(jnp.asarray, votes_of_rows(votes, rows)) for rows in row_slices(votes, len(votes.views)))
