"""Queries of a field larger than memory: its columns are read once, and an answer is a list of Gaussians. Host code."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import require_one_of
from jsecon.field.columns import row_slices, votes_of_rows
from jsecon.field.similarity import Number
from jsecon.query.answer import RegionMatch, match_regions, select_from_votes
from jsecon.query.rules import RULES, QueryRules
from jsecon.query.select import CODE_THRESHOLD, codes_of, select_rows_by_code
from jsecon.types import Array, LanguageField


class SparseSelection(NamedTuple):
    """The answer to one query: `Selection` without a number for every Gaussian."""

    gaussians: Int[np.ndarray, " m"]
    """(M,) int64 the selected ones, ascending: `np.flatnonzero(selection.mask)`."""
    similarity: Float[np.ndarray, " m"]
    """(M,) of the selected ones."""
    region: int
    """As in `Selection`."""
    score: float
    """As in `Selection`."""


def query_in_blocks(
    field: LanguageField,
    text_embeddings: Float[Array, "q e"],
    *,
    rules: QueryRules = RULES,
    by: str = "votes",
    similarity_threshold: Number | None = None,
) -> list[SparseSelection]:
    """Answers Q texts as `query_anchored` does, to the bit, in one pass over the columns of a field.

    Memory: one block of columns, and 12 bytes for each selected Gaussian.

    Args:
      field: Field of R regions, such as `load_field(path, mapped=True)`.
      text_embeddings: (Q, E), one row per text.
      rules: How texts match regions.
      by: "votes" or "code", or "code".
      similarity_threshold: Smallest similarity; None takes 0.5 for votes and 0.9 for codes.

    Returns:
      One answer per text.

    Raises:
      ValueError: The embeddings have another size, or `by` is unknown.
    """
    matches = [match_regions(field, jnp.asarray(text)[None], rules) for text in text_embeddings]
    return select_in_blocks(field, matches, by, similarity_threshold=similarity_threshold)


def select_in_blocks(
    field: LanguageField,
    matches: Sequence[RegionMatch],
    by: str = "votes",
    *,
    similarity_threshold: Number | None = None,
) -> list[SparseSelection]:
    """Selects the Gaussians of several matches in one pass over the columns of a field.

    Args:
      field: Field of R regions, such as `load_field(path, mapped=True)`.
      matches: Results of `match_regions`.
      by: "votes" or "code", or "code".
      similarity_threshold: Smallest similarity; None takes 0.5 for votes and 0.9 for codes.

    Returns:
      One answer per match.

    Raises:
      ValueError: `by` is unknown.
    """
    require_one_of("select_in_blocks", by, ("votes", "code"), "'votes' is the default.")
    default = RULES.min_share if by == "votes" else CODE_THRESHOLD
    threshold = default if similarity_threshold is None else similarity_threshold
    stored = codes_of(field) if by == "code" else None
    columns = [[(np.zeros(0, np.int64), np.zeros(0, np.float32))] for _ in matches]
    for rows in row_slices(field.votes, len(field.votes.views)) if field.regions.count and matches else ():
        votes = jax.tree.map(jnp.asarray, votes_of_rows(field.votes, rows))
        for column, match in zip(columns, matches):
            if stored is None:
                selection = select_from_votes(votes, match, threshold)
            else:
                codes = jnp.asarray(stored.gaussians[rows]), jnp.asarray(stored.regions)
                selection = select_rows_by_code(*codes, match, threshold)
            places = np.flatnonzero(np.asarray(selection.mask))
            column.append((places + rows.start, np.asarray(selection.similarity)[places]))
    answers = []
    for column, match in zip(columns, matches):
        gaussians, similarity = (np.concatenate(part) for part in zip(*column))
        answers.append(SparseSelection(gaussians, similarity, int(match.region), float(match.score)))
    return answers
