"""A selection as a 2D mask: render the selected Gaussians alone, threshold their alpha (OpenGaussian's protocol)."""

import dataclasses
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require_shape
from jsecon.numerics import array_module, is_traced
from jsecon.splat.render import render
from jsecon.types import Array, Camera, Gaussians, Rendering

ALPHA_THRESHOLD = 0.7
"""Alpha of OpenGaussian's silhouette (render_lerf_by_text.py)."""
VALA_THRESHOLD = 10 / 255
"""Alpha of VALA's silhouette: lenient, it rewards faint selections; reported beside 0.7."""
HIDDEN_LOGIT = -30.0
"""Opacity logit of hidden Gaussians: an opacity of 1e-13 is culled in projection, and every number stays finite."""


def hide(gaussians: Gaussians, mask: Bool[np.ndarray, " n"]) -> Gaussians:
    """Makes some Gaussians transparent."""
    logits = np.where(mask, np.float32(HIDDEN_LOGIT), np.asarray(gaussians.opacity_logits))
    return dataclasses.replace(gaussians, opacity_logits=logits)


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
    arrays = arrays if is_traced(arrays) else jax.tree.map(np.asarray, arrays)  # NumPy compiles no program
    logits, features = _alone(*arrays)
    return render(dataclasses.replace(gaussians, opacity_logits=logits), camera, features, capacity=capacity)


def _alone(logits: Array, mask: Array, similarity: Array | None) -> tuple[Array, Array]:
    """Returns opacity logits that hide what is not selected, and the features of each Gaussian.

    The features have three columns, so that the program that renders colours serves.
    """
    xp = array_module(logits, mask, similarity)
    features = xp.where(mask, xp.ones_like(logits) if similarity is None else similarity, xp.zeros_like(logits))
    return xp.where(mask, logits, HIDDEN_LOGIT), xp.broadcast_to(features[:, None], (*features.shape, 3))
