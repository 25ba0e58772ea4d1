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
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from jsecon.errors import require, require_shape
from jsecon.numerics import FULL_PRECISION, cosine, normalize
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
    inward = (dim, *(max(w, latent) for w in (256, 128, 64, 32)), latent)
    outward = (latent, *(max(w, latent) for w in (16, 32, 64, 128, 256, 256)), dim)
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
    params = jax.jit(ravel_pytree(_bounds(plan, units.dtype))[1])(vector)
    return Autoencoder({"params": params["encoder"], "batch_stats": stats}, {"params": params["decoder"]})


class _Plan(NamedTuple):
    """What a training run is compiled for."""

    encoder_widths: tuple[int, ...]
    decoder_widths: tuple[int, ...]
    batches: int


def _bounds(plan: _Plan, dtype: Any) -> Any:
    """Parameters {"encoder", "decoder"}, each the bound of the interval around 0 that it is drawn from."""
    params: dict[str, dict[str, Any]] = {"encoder": {}, "decoder": {}}
    for layers, widths in zip(params.values(), (plan.encoder_widths, plan.decoder_widths)):
        for n, (inputs, outputs) in enumerate(itertools.pairwise(widths)):
            kernel = np.full((inputs, outputs), inputs**-0.5, dtype)  # PyTorch's default, which LangSplat starts from
            layers[f"Dense_{n}"] = {"kernel": kernel, "bias": kernel[0]}
    for n, width in enumerate(plan.encoder_widths[1:-1]):
        params["encoder"][f"BatchNorm_{n}"] = {"scale": np.zeros(width, dtype), "bias": np.zeros(width, dtype)}
    return params


@functools.partial(jax.jit, static_argnames="plan")
def _start(units: Array, key: Key, plan: _Plan) -> Any:
    """((parameters as one vector, batch statistics, Adam's moments), best so far: (loss, vector, batch statistics))."""
    bounds, unflatten = ravel_pytree(_bounds(plan, units.dtype))
    # One draw for all layers compiles several times faster than one a layer.
    params = unflatten(bounds * jax.random.uniform(key, bounds.shape, units.dtype, -1.0, 1.0))
    stats = {}
    for n, width in enumerate(plan.encoder_widths[1:-1]):
        ones = jnp.ones(width, units.dtype)
        params["encoder"][f"BatchNorm_{n}"]["scale"] = ones
        stats[f"BatchNorm_{n}"] = {"mean": jnp.zeros_like(ones), "var": ones}
    vector, _ = ravel_pytree(params)
    return (vector, stats, _optimizer().init(vector)), (jnp.asarray(jnp.inf, units.dtype), vector, stats)


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
    _, unflatten = ravel_pytree(_bounds(plan, units.dtype))

    def difference(params, codes, x, weight):
        out = _run_decoder(params["decoder"], codes)
        return jnp.mean((out - x) ** 2) + weight * (1 - jnp.mean(cosine(out, x)))

    def loss(vector, stats, x):
        params = unflatten(vector)
        codes, stats = _run_encoder(params["encoder"], stats, x, train=True)
        return difference(params, codes, x, 0.001), stats

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
            params = unflatten(vector)
            codes, _ = _run_encoder(params["encoder"], stats, units, train=False)
            # LangSplat trains with the cosine term at 0.001 and chooses its checkpoint with it at full weight.
            value = difference(params, codes, units, 1.0)
            return jax.tree.map(lambda new, old: jnp.where(value < best[0], new, old), (value, vector, stats), best)

        return state, jax.lax.cond(index >= judged_from, judge, lambda best: best, best)

    return jax.lax.fori_loop(start, stop, epoch, carry)


@jax.jit
def _encode(variables: Any, rows: Array) -> Array:
    codes, _ = _run_encoder(variables["params"], variables["batch_stats"], rows, train=False)
    return jnp.where(jnp.any(rows != 0, axis=-1, keepdims=True), codes, 0.0)


@jax.jit
def _decode(variables: Any, rows: Array) -> Array:
    return _run_decoder(variables["params"], rows)


def _run_encoder(params: Any, stats: Any, x: Array, *, train: bool) -> tuple[Array, Any]:
    """Returns the codes of rows, normalised by their own statistics to `train`, and the statistics after that."""
    x, updated = _dense(params["Dense_0"], x), {}
    for n in range(len(stats)):
        name = f"BatchNorm_{n}"
        norm, known = params[name], stats[name]
        used = {"mean": x.mean(axis=0), "var": x.var(axis=0)} if train else known
        updated[name] = jax.tree.map(lambda old, new: 0.9 * old + 0.1 * new, known, used)
        x = (x - used["mean"]) * jax.lax.rsqrt(used["var"] + 1e-5) * norm["scale"] + norm["bias"]
        x = _dense(params[f"Dense_{n + 1}"], jax.nn.relu(x))
    return normalize(x), updated


def _run_decoder(params: Any, x: Array) -> Array:
    """Returns the embeddings of codes."""
    for n in range(len(params)):
        x = _dense(params[f"Dense_{n}"], jax.nn.relu(x) if n else x)
    return normalize(x)


def _dense(layer: Any, x: Array) -> Array:
    return jnp.matmul(x, layer["kernel"], precision=FULL_PRECISION) + layer["bias"]
