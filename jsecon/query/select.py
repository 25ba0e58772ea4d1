"""Which Gaussians belong to a matched region by their codes (the paper)."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require
from jsecon.field.similarity import Number
from jsecon.paper.queries import CODE_THRESHOLD, select_near_region
from jsecon.query.answer import RegionMatch
from jsecon.types import Array, Codes, LanguageField, Selection


def codes_of(field: LanguageField) -> Codes:
    """Returns the codes of a field. Raises ValueError if it has none."""
    remedy = "Make the field with jsecon run --paper, or select by votes."
    require(field.codes is not None, "field.codes", None, "codes", remedy)
    return field.codes


def select_by_code(field: LanguageField, match: RegionMatch, threshold: Number = CODE_THRESHOLD) -> Selection:
    """Selects the Gaussians whose code has at least a cosine with that of the best matched region. Pure."""
    codes = codes_of(field)
    if field.regions.count == 0:
        none = jnp.zeros(field.gaussians.count, bool)
        return Selection(none, none.astype(jnp.float32), *map(jnp.asarray, match[1:5]))
    return select_rows_by_code(jnp.asarray(codes.gaussians), jnp.asarray(codes.regions), match, threshold)


@jax.jit
def select_rows_by_code(
    codes: Float[Array, "n d"], region_codes: Float[Array, "r d"], match: RegionMatch, threshold: Number
) -> Selection:
    """Selects any Gaussians as `select_by_code` does; each row stands for itself. Pure."""
    near = select_near_region(codes, region_codes, match.region, threshold)
    return Selection(near.mask, near.similarity, *match[1:])
