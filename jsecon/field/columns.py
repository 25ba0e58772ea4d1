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


def is_mapped(tree: Any) -> bool:
    """Finds out whether any array of a tree lies in a memory-mapped file."""
    return any(isinstance(leaf, np.memmap) for leaf in jax.tree.leaves(tree))


def row_slices(tree: Any, count: int) -> Iterator[slice]:
    """Divides `count` rows into slices: of ROWS rows if the tree has mapped arrays, else into one."""
    step = ROWS if is_mapped(tree) else max(count, 1)
    return (slice(first, min(first + step, count)) for first in range(0, count, step))


def votes_of_rows(votes: Votes, rows: slice | Int[np.ndarray, " m"]) -> Votes:
    """Takes the votes of some of the Gaussians, without `by_view` and `overlap`, which have no row for each."""

    def take(column):
        return None if column is None else np.asarray(column[rows])

    others = {"overflow", "num_regions", "by_view", "overlap"}
    columns = {
        field.name: take(getattr(votes, field.name)) for field in dataclasses.fields(votes) if field.name not in others
    }
    return dataclasses.replace(votes, **columns, by_view=None, overlap=None)


def vote_blocks(votes: Votes) -> Iterator[Votes]:
    """Divides votes into blocks of Gaussians on jax's device; a single block if they are not mapped."""
    return (jax.tree.map(jnp.asarray, votes_of_rows(votes, rows)) for rows in row_slices(votes, len(votes.views)))
