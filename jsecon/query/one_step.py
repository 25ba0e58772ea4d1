"""The one-step query: the text's code against every Gaussian's code (the paper's baseline)."""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.numerics import into_range, normalize
from jsecon.query.units import UnitCodes
from jsecon.types import Array, Selection

NARROW = 32
"""codes of at most so many numbers are compared column by column"""

Number = float | int | Array
"""a threshold: a Python number, or () under a trace"""
Codes = Float[Array, "n d"] | UnitCodes
"""(N, d) as they come, or brought to unit length once by `unit_codes`"""


def query_one_step(codes: Codes, text_code: Float[Array, " d_text"], threshold: Number) -> Selection:
    """The Gaussians whose code has a cosine of at least `threshold` with the text's code.

    codes (N, d), text_code (d,), any length. A zero code (unknown) or one that is not finite has similarity 0 and is
    never selected; nothing is for a text code that is zero or not finite. `unit_codes(codes)` in place of the codes,
    made once, spares many queries the lengths. Selection.score is the best similarity, 0 where nothing is known. Raises
    ValueError on shapes that disagree.
    """
    require(
        codes.shape[1] == text_code.shape[0],
        "query_one_step",
        got=f"text code of size {text_code.shape[0]}",
        expected=f"{codes.shape[1]}, as the codes",
        remedy="Encode the text with the field's coder.",
    )
    return _one_step(as_codes(codes), jnp.asarray(text_code), threshold)


@jax.jit
def _one_step(codes: Array | UnitCodes, text_code: Array, threshold: Number) -> Selection:
    similarity, known = similarities(codes, text_code)
    return Selection(known & (similarity >= threshold), similarity, jnp.asarray(-1, jnp.int32), best(similarity, known))


def as_codes(codes: Array | UnitCodes) -> Array | UnitCodes:
    """jax's arrays of what a caller gave."""
    return codes if isinstance(codes, UnitCodes) else jnp.asarray(codes)


def similarities(codes: Codes, code: Float[Array, " d"]) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Cosines (N,) of rows with one code, and where they mean something: both finite and not zero; 0 elsewhere."""
    unit = normalize(code)
    sound = jnp.all(jnp.isfinite(unit)) & jnp.any(unit != 0)
    if isinstance(codes, UnitCodes):
        known = codes.known & sound
        return jnp.where(known, _product(codes.rows, unit), 0.0), known
    narrow = codes.shape[1] <= NARROW
    largest, dots, squares = (_by_column if narrow else _by_row)(codes, unit)
    known = (largest > 0) & jnp.isfinite(largest) & sound
    return jnp.where(known, dots / jnp.sqrt(jnp.where(known, squares, 1.0)), 0.0), known


def _product(rows: Array, unit: Array) -> Array:
    """rows @ unit. Under vmap over codes it is one (N, d) x (d, Q) product: no query walks the rows on its own."""
    if rows.shape[1] <= NARROW:
        columns = (rows[:, k] * unit[k] for k in range(rows.shape[1]))
        return sum(columns, start=jnp.zeros(rows.shape[0], rows.dtype))
    # One column of a product of matrices, which STYLE trap 1 leaves right where matrix times vector is not.
    return (rows @ unit[:, None])[:, 0]


def _by_column(codes: Array, unit: Array) -> tuple[Array, Array, Array]:
    """Of each row: the largest size, and dot product and square once it is brought into range. Column by column: a
    reduction over a short row does not vectorise (1 million rows of 3: 17 ms against 0.7)."""
    columns = [codes[:, k] for k in range(codes.shape[1])]
    zero = jnp.zeros(codes.shape[0], codes.dtype)
    largest = functools.reduce(jnp.maximum, (jnp.abs(column) for column in columns), zero)
    factor = jnp.where(jnp.isfinite(largest), into_range(largest), 0.0)
    scaled = [column * factor for column in columns]
    dots = sum((column * unit[k] for k, column in enumerate(scaled)), start=zero)
    return largest, dots, sum((column * column for column in scaled), start=zero)


def _by_row(codes: Array, unit: Array) -> tuple[Array, Array, Array]:
    # Multiply and sum: a matrix-vector product here can be silently wrong under jit and vmap (STYLE trap 1).
    largest = jnp.max(jnp.abs(codes), axis=-1, initial=0.0)
    scaled = codes * jnp.where(jnp.isfinite(largest), into_range(largest), 0.0)[:, None]
    return largest, jnp.sum(scaled * unit[None], axis=-1), jnp.sum(scaled * scaled, axis=-1)


def best(similarity: Float[Array, " n"], known: Bool[Array, " n"]) -> Float[Array, ""]:
    """The largest similarity among the known, 0 where none is."""
    return jnp.where(jnp.any(known), jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf), 0.0)
