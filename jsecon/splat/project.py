"""Projects 3D Gaussians to 2D splats: EWA splatting with a determinant without cancellation and exact, tight extents.

Non-finite inputs disable the affected Gaussians.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jsecon.errors import require, require_shape
from jsecon.numerics import BLUR_PX2, FRUSTUM_MARGIN, MIN_ALPHA, NEAR, all_finite, normalize, sigmoid
from jsecon.splat.fusion import compute_once, opaque_true
from jsecon.splat.sh import COEFFICIENT_COUNTS
from jsecon.types import Array, Camera, Gaussians, Leaf, record


def _is_usable(gaussians: Gaussians) -> Bool[Array, " n"]:
    """Finds the Gaussians that can be rendered; the others are hidden, without effect on image and gradients.

    A NaN, an infinite mean or quaternion, or an infinite size disables a Gaussian. A log scale of minus infinity is a
    size of 0 and an infinite opacity logit an opacity of 0 or 1: both are rendered.
    """
    geometry = jnp.concatenate([gaussians.means, gaussians.quaternions], axis=1)
    sizes = jnp.isnan(gaussians.log_scales) | jnp.isposinf(gaussians.log_scales)
    return jnp.isfinite(geometry).all(1) & ~sizes.any(1) & ~jnp.isnan(gaussians.opacity_logits)


def unusable_rows(name: str, numbers: np.ndarray) -> Bool[np.ndarray, " m"]:
    """Finds rows of the field `name` of `Gaussians` that no file may hold. Host code (NumPy).

    These are the rows that `_is_usable` excludes, colours that are not finite, and quaternions of length 0.
    """
    if name == "opacity_logits":
        wrong = np.isnan(numbers)
    elif name == "log_scales":
        wrong = np.isnan(numbers) | np.isposinf(numbers)
    else:
        wrong = ~np.isfinite(numbers)
    if name == "quaternions":
        wrong = wrong | (numbers == 0).all(axis=1, keepdims=True)
    return np.asarray(wrong.any(axis=tuple(range(1, wrong.ndim))))


_MAX_AXIS_PX = 1e15
"""Longest axis of a splat in px, flat over any image; longer axes are shrunk to it, so that squares fit float32."""


@record
class Projection:
    """N splats of one view."""

    means_px: Leaf
    """(N, 2) centres, px. This and the following fields are arbitrary where `visible` is False."""
    whitening: Leaf
    """(N, 3) l11, l21, l22 of the lower-triangular L with inverse covariance = L L^T, 1/px: with d = pixel - centre,
    the squared Mahalanobis distance is (l11 dx + l21 dy)^2 + (l22 dy)^2, never negative and without the cancellation
    that the expanded quadratic suffers far along a needle."""
    opacities: Leaf
    """(N,) in (0, 1)."""
    depths: Leaf
    """(N,) z in the camera, world units."""
    extents: Leaf
    """(N, 2) half-width and half-height, px, of the box outside which alpha < 1/255."""
    visible: Leaf
    """(N,) bool: usable, in front of the near plane, opacity of at least 1/255, box touching the image."""


def _rotation(w: Array, x: Array, y: Array, z: Array) -> list[list[Array]]:
    """Entries (N,) of the rotation matrices of unit quaternions, row by row; identity for the zero quaternion."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _covariance_root(w2c: Array, unit: list[Array], log_scales: Array, rays: tuple) -> tuple[list[Array], list[Array]]:
    """Computes the rows, three (N,) each, of M = J R S, with M M^T the 2D covariance, J the Jacobian of the ray."""
    rotation = _rotation(*unit)
    x_ratio, y_ratio, focal_x, focal_y = rays
    row_1, row_2 = [], []
    for axis in range(3):
        # exp(60) is beyond any scene, and its products with a focal length over a depth still fit float32.
        scale = jnp.exp(jnp.minimum(log_scales[:, axis], 60.0))
        along = [sum(w2c[i, k] * rotation[k][axis] for k in range(3)) * scale for i in range(3)]
        row_1.append(focal_x * (along[0] - x_ratio * along[2]))
        row_2.append(focal_y * (along[1] - y_ratio * along[2]))
    longest = [jnp.maximum(jnp.abs(first), jnp.abs(second)) for first, second in zip(row_1, row_2)]
    shrink = [jax.lax.stop_gradient(jnp.where(size > _MAX_AXIS_PX, _MAX_AXIS_PX / size, 1.0)) for size in longest]
    return [entry * by for entry, by in zip(row_1, shrink)], [entry * by for entry, by in zip(row_2, shrink)]


def _whitening(row_1: list[Array], row_2: list[Array]) -> tuple[Array, ...]:
    """(N,) variances of x and y with blur, and l11, l21, l22 of the root of the inverse covariance."""

    def dot(a, b):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    norm_1, norm_2 = dot(row_1, row_1), dot(row_2, row_2)
    cov_xx, cov_yy = norm_1 + BLUR_PX2, norm_2 + BLUR_PX2
    # From here on the unit in y is the height of the splat (constant to the gradient, where it cancels): 1 / cov_yy^2,
    # part of the derivative of a quotient, would underflow in float32 for heights of 1e9 px.
    per_height = jax.lax.stop_gradient(jax.lax.rsqrt(cov_yy))
    row_2 = [entry * per_height for entry in row_2]
    blur_y = BLUR_PX2 * per_height * per_height
    scaled_yy = dot(row_2, row_2) + blur_y
    # det(M M^T + e I) as a sum of positive terms, over cov_yy: the variance of x for fixed y. No cancellation.
    cross = [row_1[(i + 1) % 3] * row_2[(i + 2) % 3] - row_1[(i + 2) % 3] * row_2[(i + 1) % 3] for i in range(3)]
    l11 = jax.lax.rsqrt((dot(cross, cross) + blur_y * norm_1 + BLUR_PX2 * scaled_yy) / scaled_yy)
    return (
        cov_xx,
        cov_yy,
        l11,
        -(dot(row_1, row_2) / scaled_yy * per_height) * l11,
        jax.lax.rsqrt(scaled_yy) * per_height,
    )


def check_gaussians(gaussians: Gaussians, camera: Camera | None = None, *, colour: bool = True) -> None:
    """Checks the shapes of what is to be rendered or written: Gaussians, their harmonics (`colour`), and one camera."""
    require_shape("gaussians.means", gaussians.means, ("N", 3), "Pass one centre per Gaussian.")
    for name, rest in (("log_scales", (3,)), ("quaternions", (4,)), ("opacity_logits", ())):
        expected = gaussians.count, *rest
        require_shape(f"gaussians.{name}", getattr(gaussians, name), expected, "Pass one row per Gaussian.")
    if colour:
        require(gaussians.sh is not None, "gaussians.sh", None, "an array (N, K, 3)", "Pass spherical harmonics.")
        require_shape("gaussians.sh", gaussians.sh, (gaussians.count, "K", 3), "Pass one row per Gaussian.")
        shape, expected = tuple(gaussians.sh.shape), "(N, K, 3) with K of 1, 4, 9 or 16"
        require(shape[1] in COEFFICIENT_COUNTS, "gaussians.sh", shape, expected, "Pad it with zeros.")
    if camera is not None:
        remedy = "Pass a single camera: index the batch (cameras[t]) or use jax.vmap over it."
        require_shape("camera.world_to_camera", camera.world_to_camera, (4, 4), remedy)


def project(gaussians: Gaussians, camera: Camera, *, near: float | Array = NEAR) -> Projection:
    """Projects N Gaussians into one view (Zwicker et al. 2001 as in Kerbl et al. 2023).

    Pure, and differentiable in every array of both arguments, in forward mode too.

    Args:
      gaussians: Scene of N Gaussians; its `sh` has no influence.
      camera: One camera.
      near: Near plane, world units.

    Returns:
      N splats. Gaussians that are not usable (NaN, infinite) are invisible, with gradient zero; if the camera is not
      finite, all are.

    Raises:
      ValueError: Shapes disagree.
    """
    check_gaussians(gaussians, camera, colour=False)
    gaussians, camera, drawn = _replace_non_finite(*jax.tree.map(jnp.asarray, (gaussians, camera)))
    w2c = camera.world_to_camera
    width, height = camera.width, camera.height

    # Written out in columns: exact float32 on every backend, and XLA vectorises over the rows. Arrays of 3x3 matrices
    # take five times as long.
    mean_x, mean_y, mean_z = (gaussians.means[:, i] for i in range(3))
    x, y, z = (mean_x * w2c[i, 0] + mean_y * w2c[i, 1] + mean_z * w2c[i, 2] + w2c[i, 3] for i in range(3))
    # Gaussians extremely far aside are hidden before their ratio overflows: as axes end at _MAX_AXIS_PX, none from
    # farther reaches the image.
    max_offset = 1e17 * z
    in_front = drawn & (z > near) & (jnp.abs(camera.fx * x) < max_offset) & (jnp.abs(camera.fy * y) < max_offset)
    z_safe = jnp.where(in_front, z, 1.0)
    x_ratio, y_ratio = jnp.where(in_front, x, 0.0) / z_safe, jnp.where(in_front, y, 0.0) / z_safe
    mean_px, mean_py = camera.fx * x_ratio + camera.cx, camera.fy * y_ratio + camera.cy

    # Inside the Jacobian only, the ray is clamped to a multiple of the field of view on each side.
    margin_x = (FRUSTUM_MARGIN - 1) * 0.5 * width / camera.fx
    margin_y = (FRUSTUM_MARGIN - 1) * 0.5 * height / camera.fy
    x_ratio = jnp.clip(x_ratio, -camera.cx / camera.fx - margin_x, (width - camera.cx) / camera.fx + margin_x)
    y_ratio = jnp.clip(y_ratio, -camera.cy / camera.fy - margin_y, (height - camera.cy) / camera.fy + margin_y)

    # Each stage is stored, not recomputed by every reader: the gradient becomes four times faster.
    always = opaque_true(gaussians.means[0, 0]) if gaussians.means.shape[0] else jnp.asarray(True)
    unit = compute_once(always, lambda q: [normalize(q)[:, i] for i in range(4)], gaussians.quaternions)
    rays = (x_ratio, y_ratio, camera.fx / z_safe, camera.fy / z_safe)
    row_1, row_2 = compute_once(always, _covariance_root, w2c, unit, gaussians.log_scales, rays)
    cov_xx, cov_yy, l11, l21, l22 = compute_once(always, _whitening, row_1, row_2)

    opacities = sigmoid(gaussians.opacity_logits)
    reach = jnp.sqrt(2 * jnp.log(jnp.maximum(opacities / MIN_ALPHA, 1.0)))
    # widened to cover rounding of the box and of the exponent
    extent_x, extent_y = (
        jax.lax.stop_gradient(reach * jnp.sqrt(variance)) * (1 + 1e-5) + 1e-3 for variance in (cov_xx, cov_yy)
    )
    centre_x, centre_y = jax.lax.stop_gradient((mean_px, mean_py))
    touching = (centre_x + extent_x > 0) & (centre_x - extent_x < width)
    touching &= (centre_y + extent_y > 0) & (centre_y - extent_y < height)
    visible = in_front & (opacities >= MIN_ALPHA) & touching
    for number in jax.lax.stop_gradient((centre_x, centre_y, extent_x, extent_y, l11, l21, l22, z, opacities)):
        visible &= jnp.isfinite(number)

    def stack(*columns):
        return jnp.stack(columns, axis=-1)

    means_px, whitening, extents = stack(mean_px, mean_py), stack(l11, l21, l22), stack(extent_x, extent_y)
    return Projection(means_px, whitening, opacities, z, extents, visible)


def _replace_non_finite(gaussians: Gaussians, camera: Camera) -> tuple[Gaussians, Camera, Array]:
    """Both with finite numbers in place of others, and (N,) bool the unchanged Gaussians.

    Non-finite numbers must be replaced before the first product: otherwise a gradient of zero times NaN is NaN and
    reaches the pose.
    """
    finite = all_finite(*jax.tree.leaves(camera))
    drawn = _is_usable(gaussians) & finite

    def keep(array):
        return jnp.where(drawn.reshape(-1, *[1] * (array.ndim - 1)), array, 0.0)

    harmless = jax.tree.map(lambda a: jnp.ones((), a.dtype), camera)
    harmless = dataclasses.replace(harmless, world_to_camera=jnp.eye(4, dtype=camera.world_to_camera.dtype))
    kept = {name: keep(getattr(gaussians, name)) for name in ("means", "log_scales", "quaternions", "opacity_logits")}
    camera = jax.tree.map(lambda a, b: jnp.where(finite, a, b), camera, harmless)
    return dataclasses.replace(gaussians, **kept), camera, drawn
