"""One value, computed once: a wall between fusions.

XLA's CPU backend fuses cheap arithmetic into every reader, so that a polynomial, or a test of sixteen tiles, is
computed anew for each; it drops optimization barriers before it fuses. The outcome of a conditional must lie in memory.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jsecon.types import Array


def materialize(always: Array, compute: Callable, *operands: Any) -> Any:
    """`compute(*operands)`, computed once and kept in memory whatever reads it; `always` is true, unknown to the
    compiler."""
    shapes = jax.eval_shape(compute, *operands)
    nothing = lambda *_: jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
    return lax.cond(always, compute, nothing, *operands)


def opaque_true(number: Array) -> Array:
    """() bool, true whatever `number` () holds, which the compiler does not find out."""
    bits = lax.bitcast_convert_type(number, jnp.int32 if number.dtype.itemsize == 4 else jnp.int64)
    return (bits | 1) != 0
