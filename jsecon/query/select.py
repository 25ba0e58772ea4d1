"""Which Gaussians belong to a matched region by their codes (the paper)."""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from jsecon.field.similarity import Number, UnitCodes, similarities
from jsecon.paper.codes import CODE_THRESHOLD
from jsecon.query.answer import RegionMatch
from jsecon.types import Array, LanguageField, Selection


def select_by_code(
    field: LanguageField, match: RegionMatch, threshold: Number = CODE_THRESHOLD, *, codes: UnitCodes | None = None
) -> Selection:
    """Selects the Gaussians whose code has at least a cosine with that of the best region. Pure.

    Args:
      field: The field of N Gaussians.
      match: Its regions, of which only the best counts.
      threshold: Smallest cosine.
      codes: `unit_codes(field.codes)`, made once for many queries.
    """
    if field.regions.count == 0:
        none = jnp.zeros(field.gaussians.count, bool)
        return Selection(none, none.astype(jnp.float32), *map(jnp.asarray, match[1:5]))
    table, views = jnp.asarray(field.region_codes), jnp.asarray(field.votes.views)
    return select_rows_by_code(field.codes if codes is None else codes, table, views, match, threshold)


@jax.jit
def select_rows_by_code(
    codes: Float[Array, "n d"] | UnitCodes,
    region_codes: Float[Array, "r d"],
    views: Int[Array, " n"],
    match: RegionMatch,
    threshold: Number,
) -> Selection:
    """Selects any Gaussians as `select_by_code` does; each row stands for itself. Pure."""
    similarity, known = similarities(codes, region_codes[jnp.maximum(match.region, 0)])
    known &= (views > 0) & (match.region >= 0)
    return Selection(known & (similarity >= threshold), jnp.where(known, similarity, 0.0), *match[1:])
