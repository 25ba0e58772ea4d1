"""One view as a fit takes it: camera, frame, depth, what not to fit of it; and how far the scene is from all that."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Int

from jsecon.fit.corrections import Corrections, away_from_rest, corrected_camera, exposed
from jsecon.fit.photometric import photometric_loss
from jsecon.fit.schedule import resized
from jsecon.parallel import over_rows
from jsecon.splat.render import render
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Array, Camera, Capture, Gaussians, record

DEPTH_WEIGHT = 0.2
"""of the mean relative error of the depth, where a capture has any"""
COVERED = 0.5
"""alpha from which a pixel's rendered depth is that of something"""


@record
class View:
    """A view, or a batch of them with a leading axis (T,)."""

    camera: Camera
    frame: Array
    """(H, W, 3) uint8"""
    depth: Array | None
    """(H, W) float32, 0 = unknown"""
    ignored: Array | None
    """(H, W) bool: what not to fit"""


def views_of(capture: Capture, used: Int[np.ndarray, " t"]) -> View:
    """The frames `used` of a capture, a batch; a depth that is not finite and positive is an unknown one."""
    # NumPy: to index it is free.
    cameras = jax.tree.map(lambda a: np.asarray(a, np.float32), capture.cameras[used])
    depths = None if capture.depths is None else np.asarray(capture.depths, np.float32)[used]
    if depths is not None:
        depths = np.where(np.isfinite(depths) & (depths > 0), depths, np.float32(0))
    ignored = None if capture.ignored is None else np.asarray(capture.ignored, bool)[used]
    return View(cameras, np.asarray(capture.frames)[used], depths, ignored)


def views_at(views: View, size: float) -> View:
    """A batch at `size` times its size, whole px; a depth is that of one of the pixels, as the mean of two lies on
    neither surface, and what not to fit spreads to every pixel that it is part of."""
    cameras, frames = resized(views.camera, np.asarray(views.frame), size)
    to = frames.shape[2], frames.shape[1]
    if to == (views.frame.shape[2], views.frame.shape[1]):
        return views
    depths, ignored = views.depth, views.ignored
    if depths is not None:
        depths = np.stack([cv2.resize(depth, to, interpolation=cv2.INTER_NEAREST_EXACT) for depth in depths])
    if ignored is not None:
        share = [cv2.resize(own.astype(np.float32), to, interpolation=cv2.INTER_AREA) for own in ignored]
        ignored = np.stack(share) > 0
    return View(cameras, frames, depths, ignored)


def view_loss(
    gaussians: Gaussians,
    nothing: Array,
    own: Corrections | None,
    view: View,
    extent: Array,
    capacity: int | None = None,
    mesh: Mesh | None = None,
) -> tuple[Array, tuple[Array, Array]]:
    """What a step descends, and with it the view's loss and the pairs that overflowed.

    The loss is the photometric one of the rendering, seen through the view's `own` corrections where it has any, and
    DEPTH_WEIGHT times the mean of |rendered - known| / known depth over the view's pixels, zero where the depth is
    unknown or little is rendered. What not to fit has no gradient and no votes there. The gradient in `nothing` (N, 1),
    zeros, is the votes: the weights alpha T of each Gaussian times the pixels' mean absolute error.
    """
    camera = view.camera if own is None else corrected_camera(view.camera, own.twists)
    colours = over_rows(colours_from_sh, gaussians, camera, mesh)
    # The votes are the gradient of a fourth channel that shows nothing: they cost no pass of their own.
    features = jnp.concatenate([colours, nothing], axis=1)
    rendering = render(gaussians, camera, features, capacity=capacity, mesh=mesh, depth=view.depth is not None)
    image, fourth = rendering.features[..., :3], rendering.features[..., 3]
    image = image if own is None else exposed(image, own.colours)
    target = view.frame.astype(image.dtype) / 255.0
    if view.ignored is not None:  # as it is rendered there, which is exact: SSIM's windows reach across the border
        ignored, as_is = view.ignored[..., None], jax.lax.stop_gradient(image)
        image, target = jnp.where(ignored, as_is, image), jnp.where(ignored, as_is, target)
    value = photometric_loss(image, target, mesh)
    if view.depth is not None and rendering.depth is not None:
        known = (view.depth > 0) & (rendering.alpha > COVERED)
        relative = jnp.abs(rendering.depth - view.depth) / jnp.where(known, view.depth, 1.0)
        value = value + DEPTH_WEIGHT * jnp.mean(jnp.where(known, relative, 0.0))
    if own is not None:
        value = value + away_from_rest(own, extent)
    error = jax.lax.stop_gradient(jnp.abs(image - target).mean(-1))
    return value + jnp.sum(error * fourth), (value, rendering.overflow)
