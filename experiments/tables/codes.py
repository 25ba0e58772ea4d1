"""Small codes for the regions: which kind, of how many numbers, and why.

A coder has `.encode`: `Rotation` (principal directions; exact where the regions' span fits), `Spread`
(a code per region, placed on the sphere so that distinct regions stay apart), LangSplat's `Autoencoder`
(jsecon.paper.autoencoder), or None (the embeddings themselves). `region_codes` chooses.
"""

import dataclasses
import functools
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.numerics import FULL_PRECISION, cosine_matrix, normalize
from jsecon.paper.autoencoder import encode as encode_by_network, train_autoencoder
from jsecon.types import Array, Autoencoder, Key

MAX_COSINE_LOSS = 1e-4
"""Largest change of a cosine between two regions for which a rotation counts as lossless."""
CODE_THRESHOLD = 0.9
"""Cosine of two codes from which a query takes one for the other. Codes distilled from one region lie within a few
degrees (0.9 is 26)."""
DISTINCT_COSINE = 0.95
"""Cosine of two regions' embeddings below which their codes must stay apart."""
LATENTS = (3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)
"""Sizes of code that "auto" tries."""
SHARPNESS = 40.0
"""Factor of the softmax over regions with which `Spread` places a text among their codes."""
SPREAD_STEPS = 400
"""Steps of Adam in `spread_codes`."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Rotation:
    """Codes as coordinates in an orthonormal basis: cosines inside its span are kept as they are."""

    basis: Array
    """(E, d) orthonormal columns, or zero columns where the span has fewer than d dimensions."""

    def encode(self, embeddings: Float[Array, "*batch e"]) -> Float[Array, "*batch d"]:
        """Encodes embeddings by the part of each that lies inside the span.

        Args:
          embeddings: (..., E) of any length.

        Returns:
          (..., d) unit codes.
        """
        return normalize(jnp.matmul(normalize(jnp.asarray(embeddings)), self.basis, precision=FULL_PRECISION))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Spread:
    """A table: each region's embedding and its code.

    Anything else lies among the regions that it is most similar to, by a softmax over their cosines.
    """

    embeddings: Array
    """(R, E) unit embeddings of the regions; zero rows have no code."""
    codes: Array
    """(R, d) their unit codes."""

    def encode(self, embeddings: Float[Array, "*batch e"]) -> Float[Array, "*batch d"]:
        """Encodes embeddings by the codes of the regions that they are most similar to.

        Args:
          embeddings: (..., E) of any length.

        Returns:
          (..., d) unit codes; zero for a zero embedding.
        """
        return _among(jnp.asarray(embeddings), jnp.asarray(self.embeddings), jnp.asarray(self.codes))


Coder: TypeAlias = Autoencoder | Rotation | Spread | None
"""What encodes embeddings; None: the codes are the unit embeddings themselves."""


@functools.partial(jax.jit, inline=True)
def _among(x: Array, keys: Array, values: Array) -> Array:
    """Rows x (..., A) -> unit rows (..., B): the values (R, B) of the keys (R, A) most similar to each."""
    rows = x.reshape(-1, x.shape[-1])
    known = jnp.any(keys != 0, axis=-1)
    similarity = jnp.where(known[None], SHARPNESS * cosine_matrix(rows, keys), -jnp.inf)
    share = jax.nn.softmax(similarity, axis=-1)
    share = jnp.where(jnp.any(known), share, 0.0)
    units = normalize(jnp.matmul(share, values, precision=FULL_PRECISION))
    units = jnp.where(jnp.any(rows != 0, axis=-1, keepdims=True), units, 0.0)
    return units.reshape(*x.shape[:-1], values.shape[-1])


def encode(coder: Coder, embeddings: Float[Array, "*batch e"]) -> Float[Array, "*batch d"]:
    """Encodes embeddings, such as those of a text, with the coder of a field.

    Args:
      coder: Coder of the field; None keeps the embeddings.
      embeddings: (..., E) of any length.

    Returns:
      (..., d) unit codes.
    """
    if coder is None:
        return normalize(jnp.asarray(embeddings))
    return encode_by_network(coder, embeddings) if isinstance(coder, Autoencoder) else coder.encode(embeddings)


class RegionCodes(NamedTuple):
    """Codes of the regions."""

    codes: Float[Array, "r d"]
    """(R, d) of unit length; zero for a region that was never embedded."""
    coder: Coder
    """What encodes texts in the same way."""
    reason: str
    """A sentence that says why this code."""


def region_codes(embeddings: Float[Array, "r e"], *, latent: int | str, key: Key, **training: Any) -> RegionCodes:
    """Chooses the cheapest code of at most `latent` numbers per region that keeps the regions' cosines. Host code.

    With E <= latent it is the unit embeddings (coder None); for regions whose span has at most `latent` dimensions a
    `Rotation` into it; otherwise the codes of an `Autoencoder` trained on them. With "auto" it is the smallest of
    LATENTS, first as a `Rotation` and then as `Spread` codes, that keeps every pair of distinct regions (cosine of
    embeddings below DISTINCT_COSINE) apart for queries (cosine of codes below CODE_THRESHOLD), or else None.

    Args:
      embeddings: (R, E); a zero row (never embedded) gets a zero code.
      latent: Maximum size of a code, at least 1, or "auto".
      key: Random key of the autoencoder.
      training: Options of `train_autoencoder`.

    Returns:
      The codes, their coder, and the reason for the choice.

    Raises:
      ValueError: Numbers are not finite, or `latent` is out of range.
    """
    known = latent == "auto" or (isinstance(latent, int) and latent >= 1)
    require(known, "region_codes", f"latent={latent!r}", "at least 1, or 'auto'", "3 is LangSplat's.")
    finite = bool(np.isfinite(np.asarray(embeddings)).all())
    require(finite, "region_codes", "embeddings that are not finite", "finite numbers", "Leave these regions out.")
    units = normalize(jnp.asarray(embeddings))
    if latent == "auto":
        return _smallest_codes(units)
    assert isinstance(latent, int)
    count, dim = units.shape
    if dim <= latent:
        return RegionCodes(
            units, None, f"left out: the embeddings have {dim} numbers, no more than the {latent} of a code"
        )
    codes, rotation = _rotated(units, latent)
    exact, coded = np.asarray(units, np.float64), np.asarray(codes, np.float64)
    loss = float(np.abs(coded @ coded.T - exact @ exact.T).max(initial=0.0))
    if loss <= MAX_COSINE_LOSS:
        return RegionCodes(codes, rotation, f"left out: {count} regions fit in {latent} dimensions without loss")
    coder = train_autoencoder(units, latent=latent, key=key, **training)
    why = f"run: a rotation into {latent} dimensions would move cosines by up to {loss:.2f}"
    return RegionCodes(encode(coder, units), coder, why)


def _smallest_codes(units: Array) -> RegionCodes:
    count, dim = units.shape
    distinct = int(_distinct_pairs(units).sum()) // 2
    for latent in (size for size in LATENTS if size < dim):
        for kind, make in (("a rotation", _rotated), ("spread codes", _spread_out)):
            codes, coder = make(units, latent)
            if not confused_pairs(units, codes):
                reason = f"{kind} of {latent} numbers: all {distinct} pairs of {count} regions stay apart"
                return RegionCodes(codes, coder, f"left out: {reason} (cosine below {CODE_THRESHOLD:g})")
    reason = f"left out: no code shorter than {dim} numbers keeps all {distinct} pairs of regions apart"
    return RegionCodes(units, None, reason)


def _rotated(units: Array, latent: int) -> tuple[Array, Rotation]:
    rotation = principal_rotation(units, latent)
    return rotation.encode(units), rotation


def _spread_out(units: Array, latent: int) -> tuple[Array, Spread]:
    codes = spread_codes(units, latent)
    return codes, Spread(units, codes)


def _distinct_pairs(units: Float[Array, "r e"]) -> Bool[np.ndarray, "r r"]:
    """Finds pairs (R, R) of regions with an embedding that are two things: their cosine is below DISTINCT_COSINE."""
    exact = np.asarray(units, np.float64)
    known = np.any(exact != 0, axis=1)
    return (exact @ exact.T < DISTINCT_COSINE) & known[:, None] & known[None]


def confused_pairs(units: Float[Array, "r e"], codes: Float[Array, "r d"]) -> int:
    """Counts distinct regions that a query takes for each other: the cosine of their codes is at least CODE_THRESHOLD.

    Args:
      units: (R, E) unit embeddings.
      codes: (R, d) their unit codes.

    Returns:
      Number of pairs.
    """
    exact = np.asarray(codes, np.float64)
    return int((_distinct_pairs(units) & (exact @ exact.T >= CODE_THRESHOLD)).sum()) // 2


def principal_rotation(units: Float[Array, "r e"], latent: int) -> Rotation:
    """Finds the principal directions of embeddings, not centred: cosines are to be kept, not distances.

    Args:
      units: (R, E) unit embeddings.
      latent: d, number of directions.

    Returns:
      The rotation into them.
    """
    exact = np.asarray(units, np.float64)
    _, sizes, directions = np.linalg.svd(exact, full_matrices=False)
    rank = int(np.sum(sizes > 1e-6 * max(sizes.max(initial=0.0), 1e-300)))
    basis = np.zeros((exact.shape[1], latent))
    kept = directions[: min(rank, latent)].T
    signs = np.sign(kept[np.abs(kept).argmax(0), np.arange(kept.shape[1])])  # an SVD's signs are arbitrary: fix them
    basis[:, : kept.shape[1]] = kept * signs
    return Rotation(jnp.asarray(basis, units.dtype))


def spread_codes(units: Float[Array, "r e"], latent: int) -> Float[Array, "r d"]:
    """Places a unit code (R, d) for each region so that cosines are kept and distinct regions stay apart. Host code.

    Adam starts at the principal directions and minimises the mean squared error of the centred cosines, and the squares
    by which distinct pairs exceed CODE_THRESHOLD and alike ones fall short of it.

    Args:
      units: (R, E) unit embeddings; a zero row gets a zero code.
      latent: d.

    Returns:
      The codes, the same in every run.
    """
    exact = np.asarray(units, np.float64)
    known = np.any(exact != 0, axis=1)
    centred = np.where(known[:, None], exact - exact[known].mean(0), 0.0) if known.any() else exact
    target = np.asarray(cosine_matrix(jnp.asarray(centred, units.dtype), jnp.asarray(centred, units.dtype)))
    start = np.zeros((len(exact), latent))
    left, sizes, _ = np.linalg.svd(centred, full_matrices=False)
    kept = min(latent, len(sizes))
    start[:, :kept] = (left * sizes)[:, :kept]
    # Equal rows, and rows of fewer directions than numbers, part by a little noise that only depends on their place.
    start += 1e-3 * np.random.default_rng(0).standard_normal(start.shape)
    distinct = _distinct_pairs(units)
    alike = ~distinct & known[:, None] & known[None]
    start, target = jnp.asarray(start, units.dtype), jnp.asarray(target, units.dtype)
    codes = _spread(start, target, jnp.asarray(distinct), jnp.asarray(alike), CODE_THRESHOLD)
    return jnp.where(jnp.asarray(known)[:, None], codes, 0.0)


@jax.jit
def _spread(start: Array, target: Array, distinct: Array, alike: Array, separation: Array | float) -> Array:
    pairs = jnp.maximum(jnp.sum(distinct | alike), 1)

    def loss(points):
        codes = normalize(points)
        cosines = jnp.matmul(codes, codes.T, precision=FULL_PRECISION)
        error = jnp.where(distinct | alike, cosines - target, 0.0)
        too_near = jnp.where(distinct, jnp.maximum(cosines - (separation - 0.03), 0.0), 0.0)
        too_far = jnp.where(alike, jnp.maximum(separation + 0.03 - cosines, 0.0), 0.0)
        # A pair that is confused weighs as much as all cosines together, however many regions there are.
        return jnp.sum(error**2) / pairs + 10.0 * jnp.sum(too_near**2 + 0.1 * too_far**2)

    import optax  # late: a field is read without it

    optimizer = optax.adam(optax.cosine_decay_schedule(0.05, SPREAD_STEPS))

    def step(state, _) -> tuple[Any, None]:
        points, moments = state
        updates, moments = optimizer.update(jax.grad(loss)(points), moments)
        return (optax.apply_updates(points, updates), moments), None

    start = normalize(start)
    (points, _), _ = jax.lax.scan(step, (start, optimizer.init(start)), None, length=SPREAD_STEPS)
    return normalize(points)
