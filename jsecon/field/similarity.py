"""Cosines of rows with one vector, as every query needs them: of Gaussians' codes or of regions' embeddings. Pure."""

import functools
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jsecon.numerics import array_module, inline_jit, normalize, safe_scale
from jsecon.types import Array

Number = float | int | np.number | Array
"""One number: of Python or NumPy, or () under a trace."""


@inline_jit
def similarities(codes: Float[Array, "n d"], code: Float[Array, " d"]) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Computes the cosines of rows (N, d) with one code, both of any length. Pure.

    A cosine is known where both are finite and not zero; else it is 0.
    """
    unit, xp = normalize(code), array_module(codes, code)
    usable = xp.isfinite(unit).all() & (unit != 0).any()
    narrow = codes.shape[1] <= 32  # where columns are faster (`_by_column`)
    largest, dots, squares = (_by_column if narrow else _by_row)(codes, unit)
    known = (largest > 0) & xp.isfinite(largest) & usable
    return xp.where(known, dots / xp.sqrt(xp.where(known, squares, 1.0)), 0.0), known


def _by_column(codes: Array, unit: Array) -> tuple[Array, Array, Array]:
    """Of each row: the largest size, and dot product and square once it is brought into range.

    Column by column: a reduction over a short row does not vectorise (1 million rows of 3: 17 ms against 0.7).
    """
    columns, xp = [codes[:, k] for k in range(codes.shape[1])], array_module(codes)
    zero = xp.zeros(codes.shape[0], codes.dtype)
    largest = functools.reduce(xp.maximum, (xp.abs(column) for column in columns), zero)
    factor = xp.where(xp.isfinite(largest), safe_scale(largest), 0.0)
    scaled = [column * factor for column in columns]
    dots: Any = sum((column * unit[k] for k, column in enumerate(scaled)), start=zero)
    squares: Any = sum((column * column for column in scaled), start=zero)
    return largest, dots, squares


def _by_row(codes: Array, unit: Array) -> tuple[Array, Array, Array]:
    # Multiply and sum: a matrix-vector product here can be silently wrong under jit and vmap (jax issue 39103).
    xp = array_module(codes)
    largest = xp.max(xp.abs(codes), axis=-1, initial=0.0)
    scaled = codes * xp.where(xp.isfinite(largest), safe_scale(largest), 0.0)[:, None]
    return largest, (scaled * unit[None]).sum(axis=-1), (scaled * scaled).sum(axis=-1)
