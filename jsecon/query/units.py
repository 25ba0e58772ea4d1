"""Codes whose lengths are known: brought to unit length once, so that a query is one product."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.numerics import normalize
from jsecon.types import Array, Leaf


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class UnitCodes:
    """What `unit_codes` makes, and every query takes in place of codes."""

    rows: Leaf
    """(N, d) of unit length; zero where unknown."""
    known: Leaf
    """(N,) bool: the code was finite and not zero."""

    @property
    def shape(self) -> tuple[int, ...]:
        return self.rows.shape


@jax.jit
def unit_codes(codes: Float[Array, "n d"]) -> UnitCodes:
    """Codes (N, d) of any length as units, with what is zero or not finite marked as unknown.

    A field keeps its Gaussians and is asked many times: the lengths of 1 million codes of 512 numbers cost more than
    the query itself.
    """
    units = normalize(codes)
    known = jnp.all(jnp.isfinite(units), axis=-1) & jnp.any(units != 0, axis=-1)
    return UnitCodes(jnp.where(known[:, None], units, 0.0), known)
