"""A selection as a 2D mask: render the selected Gaussians alone, threshold their alpha (OpenGaussian's protocol)."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.errors import require_shape
from jsecon.splat.render import render
from jsecon.types import Array, Camera, Gaussians, Rendering

ALPHA_THRESHOLD = 0.7
"""OpenGaussian's silhouette (render_lerf_by_text.py); VALA's is 10/255, which rewards faint selections"""
VALA_THRESHOLD = 10 / 255
"""VALA's silhouette threshold: lenient, to be reported beside 0.7 and never mixed with it"""
HIDDEN_LOGIT = -30.0
"""an opacity of 1e-13, far below 1/255: culled in projection, with every number finite"""


def selection_mask(
    gaussians: Gaussians,
    camera: Camera,
    mask: Bool[Array, " n"],
    *,
    threshold: float = ALPHA_THRESHOLD,
    capacity: int | None = None,
) -> Bool[Array, "h w"]:
    """(H, W) bool: where the rendering of the selected Gaussians alone, all others deleted, has alpha > threshold.

    Occlusion by what is not selected is not taken into account: that is the protocol. capacity as for `render`; inside
    a trace `render_selection` tells what overflowed it.
    """
    return _rendered(gaussians, camera, mask, None, capacity).alpha > threshold


def render_selection(
    gaussians: Gaussians,
    camera: Camera,
    mask: Bool[Array, " n"],
    similarity: Float[Array, " n"] | None = None,
    *,
    capacity: int | None = None,
) -> Rendering:
    """Renders the selected Gaussians alone: alpha, and features (H, W, 1) = sum alpha T similarity (ones by default).

    Those not selected become transparent instead of being cut out, so that every selection shares one compilation.
    """
    rendering = _rendered(gaussians, camera, mask, similarity, capacity)
    return dataclasses.replace(rendering, features=rendering.features[..., :1])


def _rendered(
    gaussians: Gaussians, camera: Camera, mask: Array, similarity: Array | None, capacity: int | None
) -> Rendering:
    require_shape("mask", mask, (gaussians.count,), "Pass one truth value per Gaussian.")
    logits, features = _alone(gaussians.opacity_logits, mask, similarity)
    return render(dataclasses.replace(gaussians, opacity_logits=logits), camera, features, capacity=capacity)


@jax.jit
def _alone(logits: Array, mask: Array, similarity: Array | None) -> tuple[Array, Array]:
    """Opacity logits that hide what is not selected, and what of each Gaussian is rendered: in three columns, so that
    the program that renders colours serves."""
    features = jnp.where(mask, jnp.ones_like(logits) if similarity is None else similarity, 0.0)
    return jnp.where(mask, logits, HIDDEN_LOGIT), jnp.broadcast_to(features[:, None], (*features.shape, 3))
