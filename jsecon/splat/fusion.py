"""Keeps XLA from recomputing a value for each of its readers.

XLA's CPU backend fuses cheap arithmetic into every reader, so that a polynomial or a test of sixteen tiles is computed
again for each, and it drops optimization barriers before it fuses. But the result of a conditional must be in memory.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jsecon.types import Array


def compute_once(always: Array, compute: Callable, *operands: Any) -> Any:
    """Computes `compute(*operands)` once and stores it.

    Args:
      always: () bool that is true, which the compiler cannot know (`opaque_true`).
      compute: Pure function of arrays.
      *operands: Its arguments.
    """
    shapes = jax.eval_shape(compute, *operands)

    def zeros(*_):
        return jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)

    return lax.cond(always, compute, zeros, *operands)


def opaque_true(number: Array) -> Array:
    """Makes the condition of `compute_once`, true for any float, NaN included; the compiler cannot infer it."""
    bits = lax.bitcast_convert_type(number, jnp.int32 if number.dtype.itemsize == 4 else jnp.int64)
    return (bits | 1) != 0
