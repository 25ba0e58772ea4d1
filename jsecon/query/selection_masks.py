"""A selection as a 2D mask: render the selected Gaussians alone, threshold their alpha (OpenGaussian's protocol)."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require_shape
from jsecon.numerics import array_module, is_traced
from jsecon.splat.render import render
from jsecon.splat.visible import HIDDEN_LOGIT
from jsecon.types import Array, Camera, Gaussians, Rendering

ALPHA_THRESHOLD = 0.7
"""Alpha of OpenGaussian's silhouette (render_lerf_by_text.py)."""


def selection_mask(
    gaussians: Gaussians,
    camera: Camera,
    mask: Bool[Array, " n"],
    *,
    threshold: float = ALPHA_THRESHOLD,
    capacity: int | None = None,
) -> Bool[Array, "h w"]:
    """Renders the selected Gaussians alone and thresholds their alpha. Pure.

    Occlusion by Gaussians that are not selected does not count: that is the protocol.

    Args:
      gaussians: Scene of N Gaussians.
      camera: The view.
      mask: (N,) the selected ones.
      threshold: Alpha above which a pixel is inside.
      capacity: Number of (block, Gaussian) pairs, see `render`; inside a trace `render_selection` returns the overflow.

    Returns:
      (H, W) bool.

    Raises:
      ValueError: Shapes disagree.
    """
    alpha = render_selection(gaussians, camera, mask, capacity=capacity).alpha
    return (alpha if is_traced(alpha) else np.asarray(alpha)) > threshold


def render_selection(
    gaussians: Gaussians,
    camera: Camera,
    mask: Bool[Array, " n"],
    similarity: Float[Array, " n"] | None = None,
    *,
    capacity: int | None = None,
) -> Rendering:
    """Renders the selected Gaussians alone. The others become transparent, so selections share one program. Pure.

    Features (H, W, 3) are sum alpha T similarity, three times; similarities are 1 by default.
    """
    require_shape("mask", mask, (gaussians.count,), "Pass one truth value per Gaussian.")
    arrays: Any = gaussians.opacity_logits, mask, similarity
    logits, mask, similarity = arrays if is_traced(arrays) else jax.tree.map(np.asarray, arrays)  # compiles no program
    xp = array_module(logits, mask, similarity)
    column = xp.where(mask, xp.ones_like(logits) if similarity is None else similarity, xp.zeros_like(logits))
    features = xp.broadcast_to(column[:, None], (*column.shape, 3))  # so that the program that renders colours serves
    alone = dataclasses.replace(gaussians, opacity_logits=xp.where(mask, logits, HIDDEN_LOGIT))
    return render(alone, camera, features, capacity=capacity)
