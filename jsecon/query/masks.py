"""A selection as a 2D mask: render the selected Gaussians alone, threshold their alpha (OpenGaussian's protocol)."""

import dataclasses
import math

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.splat.render import is_traced, render
from jsecon.splat.tiles import plan_capacity
from jsecon.types import Array, Camera, Gaussians, Rendering

ALPHA_THRESHOLD = 0.7
"""OpenGaussian's silhouette (render_lerf_by_text.py); VALA's is 10/255, which rewards faint selections"""
_HIDDEN_LOGIT = -30.0
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

    Occlusion by what is not selected is not taken into account: that is the protocol. capacity as for `render`.
    """
    return render_selection(gaussians, camera, mask, capacity=capacity).alpha > threshold


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
    require(
        mask.shape == (gaussians.count,),
        "mask",
        got=mask.shape,
        expected=f"({gaussians.count},)",
        remedy="Pass one truth value a Gaussian.",
    )
    logits = jnp.where(mask, gaussians.opacity_logits, _HIDDEN_LOGIT)
    features = jnp.where(mask, jnp.ones_like(logits) if similarity is None else similarity, 0.0)
    hidden = jax.tree.map(jnp.asarray, dataclasses.replace(gaussians, opacity_logits=logits))
    if capacity is None and not is_traced((hidden, camera)):
        # Selections differ in size: in steps of four, a handful of compilations serves them all.
        capacity = 4 ** math.ceil(math.log(plan_capacity(hidden, camera, margin=1.0), 4))
    return render(hidden, camera, features[:, None], capacity=capacity)
