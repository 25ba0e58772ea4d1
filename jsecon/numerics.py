"""Safe maths and the named constants, each with its reason. Every guard is finite in value and gradient everywhere."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jsecon.errors import require
from jsecon.types import Array

# Splatting semantics (Kerbl et al. 2023, diff-gaussian-rasterization; gsplat agrees). They define the image.
BLUR_PX2 = 0.3
"""added to the 2D covariance's diagonal, px^2: a splat is never thinner than about a pixel"""
MAX_ALPHA = 0.99
"""cap on a single alpha: keeps 1 - alpha, and so the gradient, away from 0"""
MIN_ALPHA = 1.0 / 255.0
"""alphas below what 8 bits can show are ignored; also bounds a splat's extent"""
MIN_TRANSMITTANCE = 1e-4
"""compositing stops before the Gaussian that would take T to this or below"""
FRUSTUM_MARGIN = 1.3
"""x/z and y/z are clamped to this multiple of the field of view inside the Jacobian only"""
NEAR = 0.01
"""near plane, world units (0.2 reproduces INRIA)"""
FULL_PRECISION = jax.lax.Precision.HIGHEST
"""precision of matrix products, all of float32. By default a GPU keeps 10 bits of each factor (TF32; cosines off by
5e-4 on an H100). A CPU computes the same digits either way"""


MAX_COORDINATE = 1e18
"""largest coordinate: float32 holds its square"""


@np.errstate(invalid="ignore")  # a signalling NaN
def is_finite_and_bounded(*numbers: Any) -> bool:
    """Whether all numbers are finite and at most `MAX_COORDINATE` in size."""
    return all(bool((np.abs(np.asarray(values, np.float64)) <= MAX_COORDINATE).all()) for values in numbers)


def array_module(*arrays: Any) -> Any:
    """Returns NumPy for NumPy's arrays, which it computes without a program, and jax.numpy if any is jax's."""
    return jnp if any(isinstance(array, jax.Array) for array in arrays) else np


def inline_jit(function: Callable) -> Callable:
    """Compiles a function of arrays if any is jax's, inline in a trace; see `array_module`."""
    compiled = jax.jit(function, inline=True)

    @functools.wraps(function)
    def call(*arrays):
        return (function if array_module(*jax.tree.leaves(arrays)) is np else compiled)(*arrays)

    return call


def axes_across(direction: np.ndarray) -> np.ndarray:
    """Returns two unit axes (2, 3) across a unit direction (3,) and each other; with it they are right-handed."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def safe_scale(size: Array) -> Array:
    """Chooses a power of two that brings numbers to where squares neither overflow nor vanish.

    Multiplied, not divided: XLA turns a division by a row's largest number into a product with its reciprocal, and that
    of 1e38 is flushed to zero. A constant to the gradient, which stays exact: lengths are homogeneous, directions
    invariant.
    """
    limit = jnp.finfo(size.dtype).maxexp
    far, shift = limit * 5 // 16, limit * 21 // 32
    xp = array_module(size)
    factor = xp.where(size > 2.0**far, 2.0**-shift, xp.where(size < 2.0**-far, 2.0**shift, 1.0)).astype(size.dtype)
    return factor if xp is np else jax.lax.stop_gradient(factor)


@functools.partial(jax.jit, inline=True)
def safe_norm(x: Array) -> Array:
    """Computes Euclidean lengths, right over the whole float range (1e-30 and 1e30 alike)."""
    x = jnp.asarray(x)
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=-1, keepdims=True, initial=0.0))
    usable = (largest > 0) & jnp.isfinite(largest)
    factor = safe_scale(largest)
    scaled = jnp.where(usable, x * factor, 0.0)
    squares = jnp.sum(scaled * scaled, axis=-1, keepdims=True)
    length = jnp.where(usable, jnp.sqrt(jnp.where(usable, squares, 1.0)) * (1 / factor), largest)
    return jnp.squeeze(length, -1)


@inline_jit
def normalize(x: Array) -> Array:
    """Scales vectors to unit length."""
    xp = array_module(x)
    largest = xp.max(xp.abs(x), axis=-1, keepdims=True, initial=0.0)
    largest = largest if xp is np else jax.lax.stop_gradient(largest)
    usable = (largest > 0) & xp.isfinite(largest)
    scaled = xp.where(usable, x * safe_scale(largest), 0.0)
    squares = xp.sum(scaled * scaled, axis=-1, keepdims=True)
    unit = scaled / xp.sqrt(xp.where(usable, squares, 1.0))
    return xp.where(usable, unit, xp.where(largest == 0, 0.0, xp.nan).astype(unit.dtype))


@jax.custom_jvp
def sigmoid(x: Array) -> Array:
    """Computes 1 / (1 + exp(-x)) with a derivative that is right to the last digits where it is nearly 1.

    The derivative is s(x) s(-x), because 1 - s(x) cancels: jax.nn.sigmoid's is off by 5e-4 at x = 10, and 0 from 17 on,
    in float32.
    """
    return jax.nn.sigmoid(x)


sigmoid.defjvps(lambda tangent, value, x: tangent * value * jax.nn.sigmoid(-x))


@inline_jit
def cosine(x: Array, y: Array) -> Array:
    """Computes cosines by multiply-and-sum, which jax issue 39103 leaves right."""
    return (normalize(x) * normalize(y)).sum(axis=-1)


@inline_jit
def cosine_matrix(x: Array, y: Array) -> Array:
    """Computes the (N, M) cosines of (N, d) and (M, d) vectors as one matrix product.

    It is the form that jax issue 39103 leaves right.
    """
    if array_module(x, y) is np:
        return normalize(x) @ normalize(y).T
    return jnp.matmul(normalize(x), normalize(y).T, precision=FULL_PRECISION)


@functools.partial(jax.jit, inline=True)
def all_finite(*arrays: Array) -> Array:
    """Whether every number in every array is finite."""
    result = jnp.asarray(True)
    for array in arrays:
        result &= jnp.all(jnp.isfinite(array))
    return result


def is_traced(tree: Any = ()) -> bool:
    """Whether a tree is being traced by jax (jit, grad, vmap)."""
    return any(isinstance(leaf, Tracer) for leaf in [*jax.tree.leaves(tree), jnp.zeros(())])


def require_labels(labels: Any, num_regions: int) -> None:
    """Checks that an array of labels holds integers, all below `num_regions`.

    Inside a trace the numbers are not known: there a label of `num_regions` or more belongs to no region, like -1.
    """
    remedy = "Convert them, for example by labels.astype(np.int32)."
    integers = "integers, -1 for a pixel of no region"
    require(np.dtype(labels.dtype).kind in "iu", "labels", f"{labels.dtype}", integers, remedy)
    if not is_traced(labels):
        highest = int(np.asarray(labels).max()) if math.prod(labels.shape) else -1
        remedy = "Raise num_regions, or set what belongs to no region to -1."
        require(highest < max(num_regions, 0), "labels", f"a label of {highest}", f"labels below {num_regions}", remedy)
