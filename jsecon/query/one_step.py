"""The one-step query: the text's code against every Gaussian's code (the paper's baseline)."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.numerics import into_range, normalize
from jsecon.types import Array, Selection

Number = float | int | Array
"""a threshold: a Python number, or () under a trace"""


def query_one_step(codes: Float[Array, "n d"], text_code: Float[Array, " d_text"], threshold: Number) -> Selection:
    """The Gaussians whose code has a cosine of at least `threshold` with the text's code.

    codes (N, d), text_code (d,), any length. A zero code (unknown) or one that is not finite has similarity 0 and is
    never selected; nothing is for a text code that is zero or not finite. Selection.score is the best similarity, 0
    where nothing is known. Raises ValueError on shapes that disagree.
    """
    require(
        codes.shape[1] == text_code.shape[0],
        "query_one_step",
        got=f"text code of size {text_code.shape[0]}",
        expected=f"{codes.shape[1]}, as the codes",
        remedy="Encode the text with the field's coder.",
    )
    return _one_step(jnp.asarray(codes), jnp.asarray(text_code), threshold)


@jax.jit
def _one_step(codes: Array, text_code: Array, threshold: Number) -> Selection:
    similarity, known = similarities(codes, text_code)
    return Selection(known & (similarity >= threshold), similarity, jnp.asarray(-1, jnp.int32), best(similarity, known))


def similarities(codes: Float[Array, "n d"], code: Float[Array, " d"]) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Cosines (N,) of rows with one code, and where they mean something: both finite and not zero; 0 elsewhere."""
    # Multiply and sum: a matrix-vector product here can be silently wrong under jit and vmap (STYLE trap 1).
    unit = normalize(code)
    largest = jnp.max(jnp.abs(codes), axis=-1, initial=0.0)
    known = (largest > 0) & jnp.isfinite(largest) & jnp.all(jnp.isfinite(unit)) & jnp.any(unit != 0)
    scaled = codes * jnp.where(known, into_range(largest), 0.0)[:, None]
    dots, squares = jnp.sum(scaled * unit[None], axis=-1), jnp.sum(scaled * scaled, axis=-1)
    return jnp.where(known, dots / jnp.sqrt(jnp.where(known, squares, 1.0)), 0.0), known


def best(similarity: Float[Array, " n"], known: Bool[Array, " n"]) -> Float[Array, ""]:
    """The largest similarity among the known, 0 where none is."""
    return jnp.where(jnp.any(known), jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf), 0.0)
