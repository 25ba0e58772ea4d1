"""One view as a fit takes it: camera, frame, depth, what not to fit of it; and how far the scene is from all that."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jsecon.errors import InputError
from jsecon.fit.corrections import Corrections, apply_exposure, corrected_camera, correction_penalty
from jsecon.fit.photometric import photometric_loss
from jsecon.fit.schedule import resize_cameras, resize_frame, resize_mask
from jsecon.parallel import map_rows
from jsecon.splat.render import render
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Array, Camera, Capture, Gaussians, record

DEPTH_WEIGHT = 0.2
"""of the mean relative error of the depth, where a capture has any"""
ALIKE = 0.05
"""spread of the depths that a smaller frame's pixel takes together, as a share of their mean, up to which it has one"""
COVERED = 0.5
"""alpha from which a pixel's rendered depth is that of something"""


@record
class TrainingView:
    """One view."""

    camera: Camera
    frame: Array
    """(H, W, 3) uint8"""
    depth: Array | None
    """(H, W) float32, 0 = unknown"""
    ignored: Array | None
    """(H, W) bool: what not to fit"""


class TrainingViews:
    """The frames of a capture that are not held out, read one at a time, at the size that is wanted now.

    Raises InputError where every frame is held out.
    """

    def __init__(self, capture: Capture):
        self.used = np.flatnonzero(~np.asarray(capture.held_out))
        if not len(self.used):
            raise InputError("capture", "every frame held out", "frames to fit to", "Hold out fewer frames.")
        self._capture, self.size = capture, 1.0
        # NumPy: to index them compiles nothing.
        self._whole = jax.tree.map(lambda a: np.asarray(a, np.float32), capture.cameras[self.used])
        self.cameras = self._whole
        self.extent = np.asarray(cameras_extent(self._whole), np.float32)

    def at(self, size: float) -> None:
        """Takes the frames at `size` times theirs."""
        if size != self.size:
            self.size, self.cameras = size, resize_cameras(self._whole, size)

    def __getitem__(self, index: int) -> TrainingView:
        """The view of the `index`-th frame used. A depth is 0 where it is not finite and positive, and in a smaller
        frame where it is of several surfaces; what not to fit spreads to every pixel that it is part of."""
        capture, t, to = self._capture, self.used[index], (self.cameras.width, self.cameras.height)
        depth = ignored = None
        if capture.depths is not None:
            depth = np.asarray(capture.depths[t], np.float32)
            depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
            depth = depth if depth.shape == to[::-1] else _smaller_depth(depth, to)
        if capture.ignored is not None:
            ignored = resize_mask(np.asarray(capture.ignored[t]), self.cameras)
        frame = resize_frame(np.asarray(capture.frames[t]), self.cameras)
        return TrainingView(self.cameras[index], frame, depth, ignored)


def _smaller_depth(depth: np.ndarray, to: tuple[int, int]) -> np.ndarray:
    """The mean over each pixel of a smaller frame, 0 where a part is unknown or where surfaces meet. (One
    picked out of several stands beside the pixel's centre.)"""
    shrink = lambda a: cv2.resize(a, to, interpolation=cv2.INTER_AREA).astype(np.float64)
    mean, square, known = shrink(depth), shrink(depth.astype(np.float64) ** 2), shrink(np.float32(depth > 0))
    alike = square - mean**2 <= (ALIKE * mean) ** 2
    return np.where((known > 0.999) & alike, mean, 0).astype(np.float32)


def cameras_extent(cameras: Camera) -> float:
    """1.1 times the largest distance of a camera's centre from their mean, world units (INRIA's `spatial_lr_scale`)."""
    centres = jax.tree.map(lambda a: np.asarray(a, np.float64), cameras).centres
    return 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


def view_loss(
    gaussians: Gaussians,
    nothing: Array,
    own: Corrections | None,
    view: TrainingView,
    extent: Array,
    capacity: int | None = None,
    mesh: Mesh | None = None,
) -> tuple[Array, tuple[Array, Array]]:
    """What a step descends, and with it the view's loss and the pairs that overflowed.

    The loss is the photometric one of the rendering, seen through the view's `own` corrections where it has any, and
    DEPTH_WEIGHT times the mean of |rendered - known| / known depth over the view's pixels, zero where the depth is
    unknown or little is rendered. What not to fit has no gradient and no votes there. The gradient in `nothing` (N, 1),
    zeros, is the votes: the weights alpha T of each Gaussian times the pixels' mean absolute error; (N, 0) where they
    are not wanted.
    """
    camera = view.camera if own is None else corrected_camera(view.camera, own.twists)
    colours = map_rows(colours_from_sh, gaussians, camera, mesh)
    # The votes are the gradient of a fourth channel that shows nothing: they cost no pass of their own.
    features = jnp.concatenate([colours, nothing], axis=1)
    rendering = render(gaussians, camera, features, capacity=capacity, mesh=mesh, depth=view.depth is not None)
    image, fourth = rendering.features[..., :3], rendering.features[..., 3:].sum(-1)
    image = image if own is None else apply_exposure(image, own.colours)
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
        value = value + correction_penalty(own, extent)
    error = jax.lax.stop_gradient(jnp.abs(image - target).mean(-1))
    return value + jnp.sum(error * fourth), (value, rendering.overflow)
