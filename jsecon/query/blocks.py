"""Many questions to a field larger than memory: its columns are read once, and a selection is a list of Gaussians."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import require_one_of, require_shape
from jsecon.language.regions import ALIKE_THRESHOLD
from jsecon.query.anchored import THRESHOLDS, Found, found_of, members_by_block
from jsecon.query.direct import Number
from jsecon.query.retrieval import PIECE_NEARNESS, QUANTILE, RETRIEVALS
from jsecon.types import Array, LanguageField
from jsecon.vision.protocols import Logits


class Chosen(NamedTuple):
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
    piece_nearness: Number | None = PIECE_NEARNESS,
    logits: Logits | None = None,
) -> list[Chosen]:
    """`query_anchored` of Q texts, (Q, E), in one pass over the columns of a field (`load_field(path, mapped=True)`).

    The same Gaussians with the same similarities, to the bit. Memory: a block of columns, and what is selected (12
    bytes each). Host code. Options and errors as for `query_anchored`.
    """
    require_shape(
        "query_in_blocks", text_embeddings, ("Q", field.regions.embeddings.shape[1]), "Give a row for a text."
    )
    require_one_of("query_in_blocks", by, THRESHOLDS, "'votes' is the default.")
    how = {"quantile": quantile, "retrieval_threshold": retrieval_threshold, "retrieval": retrieval}
    how |= {"alike_threshold": alike_threshold, "piece_nearness": piece_nearness, "logits": logits}
    found = [found_of(field, jnp.asarray(text), **how) for text in text_embeddings]
    return chosen_in_blocks(field, found, similarity_threshold, by=by)


def chosen_in_blocks(
    field: LanguageField, found: Sequence[Found], threshold: Number | None = None, *, by: str = "votes"
) -> list[Chosen]:
    """`members` of what each of several questions found, in one pass over the columns."""
    empty = np.zeros(0, np.int64), np.zeros(0, np.float32)
    parts: list[list[tuple[np.ndarray, np.ndarray]]] = [[empty] for _ in found]
    first = 0
    for selections in members_by_block(field, found, threshold, by=by) if field.regions.count and found else ():
        for own, selection in zip(parts, selections):
            places = np.flatnonzero(np.asarray(selection.mask))
            own.append((places + first, np.asarray(selection.similarity)[places]))
        first += len(selections[0].mask)
    joined = [[np.concatenate(column) for column in zip(*own)] for own in parts]
    return [Chosen(own[0], own[1], int(each.region), float(each.score)) for own, each in zip(joined, found)]
