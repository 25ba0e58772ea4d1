"""Numbers that are none: which Gaussians they make unusable, and how many there are. Nothing is dropped unsaid."""

import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from jsecon.types import Array, Gaussians


def usable(gaussians: Gaussians) -> Bool[Array, " n"]:
    """(N,) the Gaussians that can be drawn; the others are hidden, and harm neither image nor gradient of the rest.

    A NaN, an infinite mean or quaternion, or an infinite size is no Gaussian. Minus infinity as a log scale is the
    logarithm of a size of 0, and an infinite opacity logit that of an opacity of 0 or 1: both are drawn.
    """
    geometry = jnp.concatenate([gaussians.means, gaussians.quaternions], axis=1)
    sizes = jnp.isnan(gaussians.log_scales) | jnp.isposinf(gaussians.log_scales)
    return jnp.isfinite(geometry).all(1) & ~sizes.any(1) & ~jnp.isnan(gaussians.opacity_logits)


def count_non_finite(gaussians: Gaussians, features: Float[Array, "n d"] | None = None) -> Int[Array, ""]:
    """() int32 Gaussians that are not usable, or whose features (None: their spherical harmonics) are not finite.

    `render` hides the former, and shows the latter as NaN on the pixels that they touch.
    """
    channels = gaussians.sh.reshape(gaussians.sh.shape[0], -1) if features is None else features
    return jnp.sum(~(usable(gaussians) & jnp.isfinite(channels).all(1)), dtype=jnp.int32)
