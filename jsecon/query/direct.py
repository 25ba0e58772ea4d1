"""Queries that compare Gaussians with the text itself: one-step, by the cosine of codes (the paper's baseline), and
canonical, by LERF's relevancy, the text's softmax share against each of a few canonical phrases."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.errors import require, require_shape
from jsecon.numerics import FULL_PRECISION, normalize, safe_scale
from jsecon.types import Array, Leaf, Selection

NARROW = 32
"""codes of at most so many numbers are compared column by column"""
TEMPERATURE = 10.0
"""LERF's and LangSplat's factor on the cosines; not CLIP's own 100"""

Number = float | int | Array
"""a threshold: a Python number, or () under a trace"""


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


Codes = Float[Array, "n d"] | UnitCodes
"""(N, d) as they come, or brought to unit length once by `unit_codes`"""


@jax.jit
def unit_codes(codes: Float[Array, "n d"]) -> UnitCodes:
    """Codes (N, d) of any length as units, with what is zero or not finite marked as unknown.

    A field keeps its Gaussians and is asked many times: the lengths of 1 million codes of 512 numbers cost more than
    the query itself.
    """
    units = normalize(codes)
    known = jnp.all(jnp.isfinite(units), axis=-1) & jnp.any(units != 0, axis=-1)
    return UnitCodes(jnp.where(known[:, None], units, 0.0), known)


def query_one_step(codes: Codes, text_code: Float[Array, " d_text"], threshold: Number) -> Selection:
    """The Gaussians whose code has a cosine of at least `threshold` with the text's code.

    codes (N, d), text_code (d,), any length. A zero code (unknown) or one that is not finite has similarity 0 and is
    never selected; nothing is for a text code that is zero or not finite. `unit_codes(codes)` in place of the codes,
    made once, spares many queries the lengths. Selection.score is the best similarity, 0 where nothing is known. Raises
    ValueError on shapes that disagree.
    """
    require_shape("query_one_step", text_code, (codes.shape[1],), "Encode the text with the field's coder.")
    return _one_step(as_codes(codes), jnp.asarray(text_code), threshold)


@jax.jit
def _one_step(codes: Array | UnitCodes, text_code: Array, threshold: Number) -> Selection:
    return _selection(*similarities(codes, text_code), threshold)


def query_canonical(
    features: Codes, text: Float[Array, " d_text"], canonical: Float[Array, "c d_canonical"], threshold: Number
) -> Selection:
    """The Gaussians whose relevancy to the text is at least `threshold`.

    features (N, d), text (d,) and canonical phrases (C, d), C >= 1, in one space: embeddings, or codes of the same
    coder. Relevancy is the least, over the phrases c, of softmax(10 [cos(f, text), cos(f, c)])[0] (Kerr et al. 2023,
    LERF), in (0, 1); above 0.5 the text is closer than every phrase. Unknown features (zero, or not
    finite) have relevancy 0 and are never selected. Phrases that are zero or not finite make every relevancy unknown.
    Raises ValueError on shapes that disagree.
    """
    size = features.shape[1]
    fit = text.shape[0] == size and canonical.shape[1] == size and canonical.shape[0] >= 1
    found, expected = f"text {text.shape}, canonical {canonical.shape}", f"({size},) and (C >= 1, {size})"
    require(fit, "query_canonical", found, expected, "Embed or encode text and canonical phrases as the features are.")
    return _canonical(as_codes(features), jnp.asarray(text), jnp.asarray(canonical), threshold)


@jax.jit
def _canonical(features: Codes, text: Array, canonical: Array, threshold: Number) -> Selection:
    return _selection(*relevancies(features, text, canonical), threshold)


def relevancies(features: Codes, text: Float[Array, " d"], canonical: Float[Array, "c d"]) -> tuple[Array, Array]:
    """LERF's relevancy (N,), and where it means something (N,); 0 elsewhere."""
    positive, known = similarities(features, text)
    # One phrase at a time: the sums stay multiply-and-sum, and no (N, C) array of products is made.
    negative, known_too = jax.lax.map(lambda phrase: similarities(features, phrase), canonical)
    known = known & jnp.all(known_too, axis=0)
    # The softmax of two is a sigmoid of their difference, and its least is against the closest phrase.
    share = jax.nn.sigmoid(TEMPERATURE * (positive - jnp.max(negative, axis=0)))
    return jnp.where(known, share, 0.0), known


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
    # One column of a product of matrices: matrix times vector can be silently wrong (jax issue 39103).
    return jnp.matmul(rows, unit[:, None], precision=FULL_PRECISION)[:, 0]


def _by_column(codes: Array, unit: Array) -> tuple[Array, Array, Array]:
    """Of each row: the largest size, and dot product and square once it is brought into range. Column by column: a
    reduction over a short row does not vectorise (1 million rows of 3: 17 ms against 0.7)."""
    columns = [codes[:, k] for k in range(codes.shape[1])]
    zero = jnp.zeros(codes.shape[0], codes.dtype)
    largest = functools.reduce(jnp.maximum, (jnp.abs(column) for column in columns), zero)
    factor = jnp.where(jnp.isfinite(largest), safe_scale(largest), 0.0)
    scaled = [column * factor for column in columns]
    dots = sum((column * unit[k] for k, column in enumerate(scaled)), start=zero)
    return largest, dots, sum((column * column for column in scaled), start=zero)


def _by_row(codes: Array, unit: Array) -> tuple[Array, Array, Array]:
    # Multiply and sum: a matrix-vector product here can be silently wrong under jit and vmap (jax issue 39103).
    largest = jnp.max(jnp.abs(codes), axis=-1, initial=0.0)
    scaled = codes * jnp.where(jnp.isfinite(largest), safe_scale(largest), 0.0)[:, None]
    return largest, jnp.sum(scaled * unit[None], axis=-1), jnp.sum(scaled * scaled, axis=-1)


def _selection(similarity: Array, known: Array, threshold: Number) -> Selection:
    """Those known whose similarity is at least the threshold; the score is the best of all, 0 where none is known."""
    mask, nothing = known & (similarity >= threshold), jnp.asarray(-1, jnp.int32)
    best = jnp.where(jnp.any(known), jnp.max(jnp.where(known, similarity, -jnp.inf), initial=-jnp.inf), 0.0)
    return Selection(mask, similarity, nothing, best)
