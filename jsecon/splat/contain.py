"""Compositing that keeps a feature which is not finite to the pixels that its Gaussian touches.

Zero times NaN is NaN, so a bad row left in the tables would spread: to its whole tile, and by the padding of lists to
others. Bad numbers are therefore composited as zeros, and the pixels they touch are found by a second walk, which is
taken only where there is a bad number at all.
"""

import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.splat.differentiate import splat
from jsecon.splat.tiles import TileLists
from jsecon.types import Array


def splat_contained(
    splats: Float[Array, "n 6"],
    features: Float[Array, "n d"],
    lists: TileLists,
    width: int,
    height: int,
    mesh: Mesh | None = None,
) -> tuple[Float[Array, "h w d"], Float[Array, "h w"]]:
    """`differentiate.splat`, with NaN in every channel of the pixels that a Gaussian with a NaN or infinite feature
    touches, and in no other. Those pixels and those numbers have gradient zero."""
    sound = jnp.isfinite(features)
    image, transmittance = splat(splats, jnp.where(sound, features, 0.0), lists, width, height, mesh)
    bad = lax.stop_gradient(1.0 - sound.all(1, keepdims=True).astype(splats.dtype))

    def walk(bad):
        return splat(lax.stop_gradient(splats), bad, lists, width, height, mesh)[0][..., 0] > 0

    touched = lax.cond(_any(bad), walk, lambda bad: jnp.zeros((height, width), bool), bad)
    return jnp.where(touched[..., None], jnp.nan, image), transmittance


@custom_vmap
def _any(bad: Array) -> Array:
    """() bool: one is bad. Under vmap: one in the whole batch, so that the choice stays one branch."""
    return (bad > 0).any()


@_any.def_vmap
def _(size: int, batched: list, bad: Array):
    del size, batched
    return _any(bad), False
