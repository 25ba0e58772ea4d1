"""Many questions to a field larger than memory: its columns are read once, and a selection is a list of Gaussians."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import require_one_of, require_shape
from jsecon.language.regions import ALIKE_THRESHOLD
from jsecon.query.anchored import THRESHOLDS, RegionMatch, found_of, select_by_block
from jsecon.query.match import PIECE_THRESHOLD, QUANTILE, RETRIEVALS
from jsecon.query.similarity import Number
from jsecon.types import Array, LanguageField
from jsecon.vision.protocols import Logits


class SparseSelection(NamedTuple):
    """The answer to one query: `Selection` without a number for each Gaussian."""

    gaussians: Int[np.ndarray, " m"]
    """(M,) int64 the selected ones, ascending: `np.flatnonzero(selection.mask)`."""
    similarity: Float[np.ndarray, " m"]
    """(M,) theirs."""
    region: int
    """as in `Selection`."""
    score: float
    """as in `Selection`."""


def query_in_blocks(
    field: LanguageField,
    text_embeddings: Float[Array, "q e"],
    *,
    quantile: Number = QUANTILE,
    retrieval_threshold: Number | None = None,
    similarity_threshold: Number | None = None,
    by: str = "votes",
    retrieval: str = RETRIEVALS[0],
    alike_threshold: Number | None = ALIKE_THRESHOLD,
    piece_threshold: Number | None = PIECE_THRESHOLD,
    logits: Logits | None = None,
) -> list[SparseSelection]:
    """`query_anchored` of Q texts, (Q, E), in one pass over the columns of a field (`load_field(path, mapped=True)`).

    The same Gaussians with the same similarities, to the bit. Memory: a block of columns, and what is selected (12
    bytes each). Host code. Options and errors as for `query_anchored`.
    """
    require_shape(
        "query_in_blocks", text_embeddings, ("Q", field.regions.embeddings.shape[1]), "Give a row for a text."
    )
    require_one_of("query_in_blocks", by, THRESHOLDS, "'votes' is the default.")
    how = {"quantile": quantile, "retrieval_threshold": retrieval_threshold, "retrieval": retrieval}
    how |= {"alike_threshold": alike_threshold, "piece_threshold": piece_threshold, "logits": logits}
    found = [found_of(field, jnp.asarray(text), **how) for text in text_embeddings]
    return select_in_blocks(field, found, similarity_threshold, by=by)


def select_in_blocks(
    field: LanguageField, found: Sequence[RegionMatch], threshold: Number | None = None, *, by: str = "votes"
) -> list[SparseSelection]:
    """`members` of what each of several questions found, in one pass over the columns."""
    empty = np.zeros(0, np.int64), np.zeros(0, np.float32)
    parts: list[list[tuple[np.ndarray, np.ndarray]]] = [[empty] for _ in found]
    first = 0
    for selections in select_by_block(field, found, threshold, by=by) if field.regions.count and found else ():
        for own, selection in zip(parts, selections):
            places = np.flatnonzero(np.asarray(selection.mask))
            own.append((places + first, np.asarray(selection.similarity)[places]))
        first += len(selections[0].mask)
    joined = [[np.concatenate(column) for column in zip(*own)] for own in parts]
    return [SparseSelection(own[0], own[1], int(each.region), float(each.score)) for own, each in zip(joined, found)]
