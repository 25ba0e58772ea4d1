"""The autoencoder of one scene: region embeddings to codes of d numbers, and back.

The paper takes LangSplat's (minghanqin/LangSplat, autoencoder/): codes l = E(phi_bar) on the unit sphere, trained to
bring the embeddings back, min |D(E(phi_bar)) - phi_bar|^2 + w (1 - cos(D(E(phi_bar)), phi_bar)). Pure.
"""

import functools
import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jsecon.errors import require, require_shape
from jsecon.numerics import FULL_PRECISION, cosine, normalize
from jsecon.types import Array, Autoencoder, Key, Progress

ENCODER_WIDTHS = (256, 128, 64, 32)
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)
"""LangSplat's hidden layers for E = 512; one narrower than the latent is widened to it."""
MIN_STEPS = 1_000
"""LangSplat's 100 epochs run over tens of thousands of crops; a few regions need more epochs to see as many steps."""


def encode(autoencoder: Autoencoder, embeddings: Float[Array, "*batch e"]) -> Float[Array, "*batch d"]:
    """Encodes embeddings, of regions or of a text: l = E(phi).

    Args:
      autoencoder: Of the field, `field.codes.autoencoder`.
      embeddings: (..., E) of any length.

    Returns:
      (..., d) unit codes; zero (unknown) for a zero embedding.

    Raises:
      ValueError: Embeddings of another size.
    """
    size = autoencoder.encoder[0]["weight"].shape[0]
    require_shape("embeddings", embeddings, (..., size), "Embed with what the autoencoder was trained on.")
    units = normalize(jnp.asarray(embeddings))
    codes = _encode(autoencoder.encoder, units.reshape(-1, size))
    return codes.reshape(*units.shape[:-1], codes.shape[-1])


def decode(autoencoder: Autoencoder, codes: Float[Array, "*batch d"]) -> Float[Array, "*batch e"]:
    """Decodes codes (..., d) of any length to unit embeddings (..., E): phi = D(l)."""
    size = autoencoder.decoder[0]["weight"].shape[0]
    require_shape("codes", codes, (..., size), "Decode codes of this autoencoder.")
    codes = jnp.asarray(codes)
    rows = _decode(autoencoder.decoder, codes.reshape(-1, size))
    return rows.reshape(*codes.shape[:-1], rows.shape[-1])


def train_autoencoder(
    embeddings: Float[Array, "r e"],
    *,
    latent: int,
    key: Key,
    epochs: int | None = None,
    progress: Progress | None = None,
) -> Autoencoder:
    """Trains LangSplat's autoencoder on the regions' embeddings.

    Args:
      embeddings: (R, E), R >= 1, of any length; zero rows (never embedded) are left out.
      latent: d, size of a code.
      key: The same key gives the same parameters.
      epochs: Passes over the regions; None takes LangSplat's 100, or as many as make 1,000 steps.
      progress: Called as progress(done, total), in epochs.

    Returns:
      The best parameters, by the loss in evaluation mode, of the last twentieth of the epochs.

    Raises:
      ValueError: All rows are zero, numbers are not finite, or options are out of range.
    """
    require(latent >= 1, "train_autoencoder", f"latent={latent}", "at least 1", "3 is LangSplat's.")
    positive, remedy = epochs is None or epochs >= 1, "Leave epochs out to have it chosen."
    require(positive, "train_autoencoder", f"epochs={epochs}", "at least 1", remedy)
    rows = np.asarray(embeddings)
    remedy, finite = "Find the regions whose crops gave NaN and leave them out.", bool(np.isfinite(rows).all())
    require(finite, "train_autoencoder", "embeddings that are not finite", "finite numbers", remedy)
    count = f"{len(rows)} rows, all zero"
    rows = rows[np.any(rows != 0, axis=1)]
    require(len(rows) >= 1, "train_autoencoder", count, "at least one embedding", "Embed the regions first.")
    units = normalize(jnp.asarray(rows))
    count, dim = units.shape
    batches = -(-count // 64)  # of similar sizes: batch normalisation cannot learn from one or two regions
    total = epochs if epochs is not None else max(100, -(-MIN_STEPS // batches))
    inward = (dim, *(max(w, latent) for w in ENCODER_WIDTHS), latent)
    outward = (latent, *(max(w, latent) for w in DECODER_WIDTHS), dim)
    plan = _Plan(inward, outward, batches)
    init_key, shuffle_key = jax.random.split(key)
    carry = _start(units, init_key, plan)
    stretch = total if progress is None else max(1, -(-total // 50))
    for start in range(0, total, stretch):
        stop = min(start + stretch, total)
        carry = _epochs(carry, units, shuffle_key, start, stop, total - -(-total // 20), plan)
        if progress is not None:
            jax.block_until_ready(carry)
            progress(stop, total)
    _, vector, moments = carry[1]
    encoder, decoder = _unflatten(vector, plan)
    return Autoencoder((*(a | b for a, b in zip(encoder, moments)), encoder[-1]), tuple(decoder))


class _Plan(NamedTuple):
    """What a training run is compiled for."""

    encoder_widths: tuple[int, ...]
    decoder_widths: tuple[int, ...]
    batches: int

    def shapes(self) -> tuple[list[dict], list[dict]]:
        """Shapes of the trained parameters of encoder and decoder, layer by layer."""
        encoder, decoder = (
            [{"weight": (inputs, outputs), "bias": (outputs,)} for inputs, outputs in itertools.pairwise(widths)]
            for widths in (self.encoder_widths, self.decoder_widths)
        )
        normalised = [layer | {"scale": layer["bias"], "shift": layer["bias"]} for layer in encoder[:-1]]
        return [*normalised, encoder[-1]], decoder


@functools.partial(jax.jit, static_argnames="plan")
def _start(units: Array, key: Key, plan: _Plan) -> Any:
    """((parameters as one vector, running moments, Adam's state), best so far: (loss, vector, running moments))."""
    middle, spread = [], []
    for layer in (*plan.shapes()[0], *plan.shapes()[1]):
        for name, shape in layer.items():
            size = int(np.prod(shape))
            middle.append(np.full(size, float(name == "scale")))
            # PyTorch's default, which LangSplat starts from: weights and biases uniform in +-1/sqrt(inputs).
            spread.append(np.full(size, layer["weight"][0] ** -0.5 if name in ("weight", "bias") else 0.0))
    middle, spread = (jnp.asarray(np.concatenate(values), units.dtype) for values in (middle, spread))
    # One draw for all layers compiles several times faster than a draw a layer.
    vector = middle + spread * jax.random.uniform(key, middle.shape, units.dtype, -1.0, 1.0)
    hidden = plan.encoder_widths[1:-1]
    moments = [{"mean": jnp.zeros(n, units.dtype), "variance": jnp.ones(n, units.dtype)} for n in hidden]
    return (vector, moments, _optimizer().init(vector)), (jnp.asarray(jnp.inf, units.dtype), vector, moments)


def _unflatten(vector: Array, plan: _Plan) -> tuple[list[dict], list[dict]]:
    """Parameters of encoder and decoder, which `vector` holds end to end."""
    start, parts = 0, ([], [])
    for layers, shapes in zip(parts, plan.shapes()):
        for shape_of in shapes:
            layer = {}
            for name, shape in shape_of.items():
                stop = start + int(np.prod(shape))
                layer[name] = vector[start:stop].reshape(shape)
                start = stop
            layers.append(layer)
    return parts


def _optimizer() -> Any:
    import optax  # late: a field is read without it

    return optax.adam(7e-4)


# The bounds are arguments: one compiled loop serves every stretch between two calls of `progress`.
@functools.partial(jax.jit, static_argnames="plan")
def _epochs(
    carry: Any, units: Array, key: Key, start: Array | int, stop: Array | int, judged_from: Array | int, plan: _Plan
) -> Any:
    count = units.shape[0]
    size = -(-count // plan.batches)
    optimizer = _optimizer()

    def difference(decoder, codes, x, weight):
        out = _decode(decoder, codes)
        return jnp.mean((out - x) ** 2) + weight * (1 - jnp.mean(cosine(out, x)))

    def loss(vector, moments, x):
        encoder, decoder = _unflatten(vector, plan)
        codes, of_batch = _forward(encoder, None, x)
        moments = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, moments, of_batch)
        return difference(decoder, codes, x, 0.001), moments

    def step(state, x) -> tuple[Any, None]:
        vector, moments, adam = state
        gradient, moments = jax.grad(loss, has_aux=True)(vector, moments, x)
        updates, adam = optimizer.update(gradient, adam)
        return (vector + updates, moments, adam), None

    def epoch(index, carry):
        state, best = carry
        order = jax.random.permutation(jax.random.fold_in(key, index), count)
        order = jnp.resize(order, (plan.batches, size))  # the last batch is filled up from the front of the order
        state, _ = jax.lax.scan(lambda s, rows: step(s, units[rows]), state, order)

        def judge(best):
            vector, moments, _ = state
            encoder, decoder = _unflatten(vector, plan)
            codes, _ = _forward(encoder, moments, units)
            # LangSplat trains with the cosine term at 0.001 and chooses its checkpoint with it at full weight.
            value = difference(decoder, codes, units, 1.0)
            return jax.tree.map(lambda new, old: jnp.where(value < best[0], new, old), (value, vector, moments), best)

        return state, jax.lax.cond(index >= judged_from, judge, lambda best: best, best)

    return jax.lax.fori_loop(start, stop, epoch, carry)


@jax.jit
def _encode(layers: Any, rows: Array) -> Array:
    codes, _ = _forward(layers, layers, rows)
    return jnp.where(jnp.any(rows != 0, axis=-1, keepdims=True), codes, 0.0)


def _forward(layers: Any, moments: Any, x: Array) -> tuple[Array, list[dict[str, Array]]]:
    """E(x): unit codes of rows, and the moments of each normalisation; these are the batch's own if none are given."""
    used = []
    for n, layer in enumerate(layers[:-1]):
        x = _affine(layer, x)
        mean, variance = (moments[n]["mean"], moments[n]["variance"]) if moments else (x.mean(0), x.var(0))
        used.append({"mean": mean, "variance": variance})
        x = jax.nn.relu((x - mean) * jax.lax.rsqrt(variance + 1e-5) * layer["scale"] + layer["shift"])
    return normalize(_affine(layers[-1], x)), used


@jax.jit
def _decode(layers: Any, x: Array) -> Array:
    """D(x): unit embeddings of codes."""
    for layer in layers[:-1]:
        x = jax.nn.relu(_affine(layer, x))
    return normalize(_affine(layers[-1], x))


def _affine(layer: dict[str, Array], x: Array) -> Array:
    return jnp.matmul(x, layer["weight"], precision=FULL_PRECISION) + layer["bias"]
