"""Rules of compositing for jax: gradient, vmap, and containment of non-finite features. Reverse mode only.

Gradient: symbolic zeros show whether the gradient of the geometry is needed, so that a field that is distilled into
frozen Gaussians does not compute it.

vmap: a batched loop with early exit runs as long as its slowest member. So several feature sets of one view become more
channels of one walk over its tiles, and several views are walked one after another.

Zero times NaN is NaN, so a non-finite feature would spread to its whole tile, and through the padding of lists to other
tiles. Such features are composited as zeros instead, and a second walk, only if there are any, marks their pixels.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap, sequential_vmap
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.splat.composite import composite, composite_features_vjp
from jsecon.splat.gradient import composite_vjp
from jsecon.splat.tiles import TileLists
from jsecon.types import Array


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4, 5))
def _rasterize(
    splats: Array, features: Array, lists: TileLists, width: int, height: int, mesh: Mesh | None = None
) -> tuple[Array, Array]:
    """Composites finite features; arguments and results as for `rasterize_nan_contained`."""
    return _forward(splats, features, lists, width, height, mesh)[:2]


def _rasterize_forward(splats, features, lists, width, height, mesh):
    needs_geometry = splats.perturbed
    splats, features = splats.value, features.value
    lists = jax.tree.map(lambda leaf: leaf.value, lists, is_leaf=lambda leaf: hasattr(leaf, "perturbed"))
    image, transmittance, seen = _forward(splats, features, lists, width, height, mesh)
    lists = dataclasses.replace(lists, lengths=seen)
    saved = (image, transmittance) if needs_geometry else None
    return (image, transmittance), (splats, features, lists, saved)


def _rasterize_backward(width, height, mesh, residual, cotangents):
    splats, features, lists, saved = residual
    symbolic = jax.custom_derivatives.SymbolicZero
    bars = [jnp.zeros(bar.shape, splats.dtype) if isinstance(bar, symbolic) else bar for bar in cotangents]
    if saved is None:
        gradient = _features_backward(splats, bars[0], lists, mesh)
        return jnp.zeros_like(splats), gradient.astype(features.dtype), None
    vjp = sequential_vmap(functools.partial(composite_vjp, mesh=mesh))
    by_splat, gradient = vjp(splats, features.astype(splats.dtype), lists, *saved, *bars)
    return by_splat, gradient.astype(features.dtype), None


_rasterize.defvjp(_rasterize_forward, _rasterize_backward, symbolic_zeros=True)


def _forward(splats, features, lists, width: int, height: int, mesh: Mesh | None) -> tuple[Array, Array, Array]:
    def one(splats, features, lists):
        return composite(splats, features, lists, width, height, mesh)

    def split(out, sets):
        return (_unmerge(out[0], sets), *out[1:]), (True, False, False)

    return _fold_vmap_into_channels(one, split)(splats, features, lists)


def _features_backward(splats: Array, cotangent: Array, lists: TileLists, mesh: Mesh | None) -> Array:
    def one(splats, cotangent, lists):
        return composite_features_vjp(splats, lists, cotangent, mesh)

    return _fold_vmap_into_channels(one, lambda out, sets: (_unmerge(out, sets), True))(splats, cotangent, lists)


def _fold_vmap_into_channels(one: Callable, split: Callable) -> Callable:
    """Wraps `one(splats, channels, lists)` with a rule for vmap.

    If only channels (S, ..., D) are batched, they become S D channels of one call, whose result `split(result, S)`
    unmerges. Any other batch runs one after another.
    """
    function = custom_vmap(one)

    @function.def_vmap
    def rule(size, batched, splats, channels, lists):
        if any(jax.tree.leaves((batched[0], batched[2]))):

            def one_of(index):
                def take(a, is_batched):
                    return lax.dynamic_index_in_dim(a, index, 0, False) if is_batched else a

                return function(*jax.tree.map(take, (splats, channels, lists), tuple(batched)))

            out = lax.map(one_of, jnp.arange(size))
            return out, jax.tree.map(lambda _: True, out)
        merged = jnp.moveaxis(channels, 0, -2)
        return split(function(splats, merged.reshape(*merged.shape[:-2], -1), lists), size)

    return function


def _unmerge(array: Array, sets: int) -> Array:
    """(..., S D) -> (S, ..., D)."""
    return jnp.moveaxis(array.reshape(*array.shape[:-1], sets, -1), -2, 0)


def rasterize_nan_contained(
    splats: Float[Array, "n 6"],
    features: Float[Array, "n d"],
    lists: TileLists,
    width: int,
    height: int,
    mesh: Mesh | None = None,
) -> tuple[Float[Array, "h w d"], Float[Array, "h w"]]:
    """Composites features of which some may be NaN or infinite.

    Returns:
      Image (H, W, D), NaN in exactly the pixels that a Gaussian with a non-finite feature touches, and final
      transmittance (H, W). Those pixels and features have gradient zero.
    """
    finite = jnp.isfinite(features)
    image, transmittance = _rasterize(splats, jnp.where(finite, features, 0.0), lists, width, height, mesh)
    bad = lax.stop_gradient(1.0 - finite.all(1, keepdims=True).astype(splats.dtype))

    def mark(bad) -> Array:
        image, _ = cast(tuple[Array, Array], _rasterize(lax.stop_gradient(splats), bad, lists, width, height, mesh))
        return image[..., 0] > 0

    touched = lax.cond(_any(bad), mark, lambda bad: jnp.zeros((height, width), bool), bad)
    return jnp.where(touched[..., None], jnp.nan, image), transmittance


@custom_vmap
def _any(bad: Array) -> Array:
    """() bool whether any is set; under vmap any of the whole batch, so that a conditional stays one."""
    return jnp.any(bad > 0)


@_any.def_vmap
def _(size: int, batched: list, bad: Array):
    del size, batched
    return _any(bad), False
