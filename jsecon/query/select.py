"""Which Gaussians belong to a matched region by their codes (the paper)."""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from jsecon.errors import require
from jsecon.field.similarity import Number, similarities
from jsecon.query.answer import RegionMatch
from jsecon.types import Array, Codes, LanguageField, Selection

CODE_THRESHOLD = 0.9
"""Smallest cosine with the region's code: codes of one region lie within a few degrees (0.9 is 26)."""


def codes_of(field: LanguageField) -> Codes:
    """Returns the codes of a field. Raises ValueError if it has none."""
    remedy = "Make the field with jsecon run --paper, or select by votes."
    require(field.codes is not None, "field.codes", None, "codes", remedy)
    return field.codes


def select_by_code(field: LanguageField, match: RegionMatch, threshold: Number = CODE_THRESHOLD) -> Selection:
    """Selects the Gaussians whose code has at least a cosine with that of the best region. Pure.

    Args:
      field: The field of N Gaussians.
      match: Its regions, of which only the best counts.
      threshold: Smallest cosine.
    """
    codes = codes_of(field)
    if field.regions.count == 0:
        none = jnp.zeros(field.gaussians.count, bool)
        return Selection(none, none.astype(jnp.float32), *map(jnp.asarray, match[1:5]))
    columns = codes.gaussians, codes.regions, field.votes.views
    return select_rows_by_code(*map(jnp.asarray, columns), match, threshold)


@jax.jit
def select_rows_by_code(
    codes: Float[Array, "n d"],
    region_codes: Float[Array, "r d"],
    views: Int[Array, " n"],
    match: RegionMatch,
    threshold: Number,
) -> Selection:
    """Selects any Gaussians as `select_by_code` does; each row stands for itself. Pure."""
    similarity, known = similarities(codes, region_codes[jnp.maximum(match.region, 0)])
    known &= (views > 0) & (match.region >= 0)
    return Selection(known & (similarity >= threshold), jnp.where(known, similarity, 0.0), *match[1:])
