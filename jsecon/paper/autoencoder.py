"""The autoencoder of one scene: region embeddings to codes of d numbers, and back.

The paper takes LangSplat's (minghanqin/LangSplat, autoencoder/): codes l = E(phi_bar) on the unit sphere, trained to
bring the embeddings back, min |D(E(phi_bar)) - phi_bar|^2 + w (1 - cos(D(E(phi_bar)), phi_bar)). Pure.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jsecon.errors import require, require_shape
from jsecon.numerics import FULL_PRECISION, cosine, is_traced, normalize
from jsecon.types import Array, Autoencoder, Key, Progress

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
    size = autoencoder.encoder["params"]["Dense_0"]["kernel"].shape[0]
    require_shape("embeddings", embeddings, (..., size), "Embed with what the autoencoder was trained on.")
    units = normalize(jnp.asarray(embeddings))
    codes = _encode(autoencoder.encoder, units.reshape(-1, size))
    return codes.reshape(*units.shape[:-1], codes.shape[-1])


def decode(autoencoder: Autoencoder, codes: Float[Array, "*batch d"]) -> Float[Array, "*batch e"]:
    """Decodes codes (..., d) of any length to unit embeddings (..., E): phi = D(l)."""
    size = autoencoder.decoder["params"]["Dense_0"]["kernel"].shape[0]
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
    # LangSplat's hidden layers for E = 512; one narrower than the latent is widened to it.
    inward = (*(max(w, latent) for w in (256, 128, 64, 32)), latent)
    outward = (*(max(w, latent) for w in (16, 32, 64, 128, 256, 256)), dim)
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
    _, vector, stats = carry[1]
    vector = vector if is_traced(vector) else np.asarray(vector)  # NumPy's slices need no compilation
    params = jax.device_put(_unflatten(vector, _shapes(units, plan)[0]))
    return Autoencoder({"params": params["encoder"], "batch_stats": stats}, {"params": params["decoder"]})


class _Plan(NamedTuple):
    """What a training run is compiled for."""

    encoder_widths: tuple[int, ...]
    decoder_widths: tuple[int, ...]
    batches: int


@functools.partial(jax.jit, static_argnames="plan")
def _start(units: Array, key: Key, plan: _Plan) -> Any:
    """((parameters as one vector, batch statistics, Adam's moments), best so far: (loss, vector, batch statistics))."""
    shapes, stats = _shapes(units, plan)
    middle, spread = [], []
    for path, leaf in jax.tree_util.tree_leaves_with_path(shapes):
        part, name, kind = (step.key for step in path)
        norm = name.startswith("BatchNorm")
        middle.append(np.full(leaf.size, float(norm and kind == "scale")))
        # PyTorch's default, which LangSplat starts from: weights and biases uniform in +-1/sqrt(inputs).
        spread.append(np.full(leaf.size, 0.0 if norm else shapes[part][name]["kernel"].shape[0] ** -0.5))
    middle, spread = (jnp.asarray(np.concatenate(values), units.dtype) for values in (middle, spread))
    # One draw for all layers compiles several times faster than flax's initialisers, a draw a layer.
    vector = middle + spread * jax.random.uniform(key, middle.shape, units.dtype, -1.0, 1.0)
    stats = {
        name: {"mean": jnp.zeros_like(norm["mean"]), "var": jnp.ones_like(norm["var"])} for name, norm in stats.items()
    }
    moments = _optimizer().init(vector)
    return (vector, stats, moments), (jnp.asarray(jnp.inf, units.dtype), vector, stats)


def _shapes(units: Array, plan: _Plan) -> tuple[Any, Any]:
    """Shapes of the parameters {"encoder", "decoder"} and of the batch statistics."""
    key, codes = jax.random.key(0), jnp.zeros((1, plan.encoder_widths[-1]), units.dtype)
    encoder, decoder = _layers()
    first = jax.eval_shape(lambda: encoder(plan.encoder_widths).init(key, units[:1], train=False))
    second = jax.eval_shape(lambda: decoder(plan.decoder_widths).init(key, codes))
    return {"encoder": first["params"], "decoder": second["params"]}, first["batch_stats"]


def _unflatten(vector: Any, shapes: Any) -> Any:
    """The tree of parameters that `vector` holds end to end."""
    leaves, tree = jax.tree.flatten(shapes)
    ends = np.cumsum([leaf.size for leaf in leaves])
    parts = [vector[end - leaf.size : end].reshape(leaf.shape) for end, leaf in zip(ends, leaves, strict=True)]
    return jax.tree.unflatten(tree, parts)


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
    encoder, decoder = (layers(widths) for layers, widths in zip(_layers(), (plan.encoder_widths, plan.decoder_widths)))
    optimizer = _optimizer()
    shapes, _ = _shapes(units, plan)

    def difference(params, codes, x, weight):
        out: Any = decoder.apply({"params": params["decoder"]}, codes)
        return jnp.mean((out - x) ** 2) + weight * (1 - jnp.mean(cosine(out, x)))

    def loss(vector, stats, x):
        params = _unflatten(vector, shapes)
        variables = {"params": params["encoder"], "batch_stats": stats}
        codes, changed = encoder.apply(variables, x, train=True, mutable=["batch_stats"])
        return difference(params, codes, x, 0.001), changed["batch_stats"]

    def step(state, x) -> tuple[Any, None]:
        vector, stats, moments = state
        gradient, stats = jax.grad(loss, has_aux=True)(vector, stats, x)
        updates, moments = optimizer.update(gradient, moments)
        return (vector + updates, stats, moments), None

    def epoch(index, carry):
        state, best = carry
        order = jax.random.permutation(jax.random.fold_in(key, index), count)
        order = jnp.resize(order, (plan.batches, size))  # the last batch is filled up from the front of the order
        state, _ = jax.lax.scan(lambda s, rows: step(s, units[rows]), state, order)

        def judge(best):
            vector, stats, _ = state
            params = _unflatten(vector, shapes)
            codes = encoder.apply({"params": params["encoder"], "batch_stats": stats}, units, train=False)
            # LangSplat trains with the cosine term at 0.001 and chooses its checkpoint with it at full weight.
            value = difference(params, codes, units, 1.0)
            return jax.tree.map(lambda new, old: jnp.where(value < best[0], new, old), (value, vector, stats), best)

        return state, jax.lax.cond(index >= judged_from, judge, lambda best: best, best)

    return jax.lax.fori_loop(start, stop, epoch, carry)


def _widths(params: Any) -> tuple[int, ...]:
    layers = sum(name.startswith("Dense_") for name in params)
    return tuple(params[f"Dense_{i}"]["kernel"].shape[-1] for i in range(layers))


@jax.jit
def _encode(variables: Any, rows: Array) -> Array:
    codes: Any = _layers()[0](_widths(variables["params"])).apply(variables, rows, train=False)
    return jnp.where(jnp.any(rows != 0, axis=-1, keepdims=True), codes, 0.0)


@jax.jit
def _decode(variables: Any, rows: Array) -> Any:
    return _layers()[1](_widths(variables["params"])).apply(variables, rows)


@functools.cache
def _layers() -> tuple[Any, Any]:
    """Encoder and decoder, by their widths. flax is imported here, late: a field is read without it."""
    from flax import linen as nn

    class Encoder(nn.Module):
        widths: tuple[int, ...]

        @nn.compact
        def __call__(self, x, train: bool):
            x = nn.Dense(self.widths[0], param_dtype=x.dtype, precision=FULL_PRECISION)(x)
            for width in self.widths[1:]:
                norm = nn.BatchNorm(use_running_average=not train, momentum=0.9, epsilon=1e-5, param_dtype=x.dtype)
                x = nn.relu(norm(x))
                x = nn.Dense(width, param_dtype=x.dtype, precision=FULL_PRECISION)(x)
            return normalize(x)

    class Decoder(nn.Module):
        widths: tuple[int, ...]

        @nn.compact
        def __call__(self, x):
            for index, width in enumerate(self.widths):
                x = nn.Dense(width, param_dtype=x.dtype, precision=FULL_PRECISION)(nn.relu(x) if index else x)
            return normalize(x)

    return Encoder, Decoder
