"""From 3D Gaussians to 2D splats: EWA projection with a determinant that does not cancel and tight, exact extents."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jsecon.errors import require
from jsecon.numerics import BLUR_PX2, FRUSTUM_MARGIN, MIN_ALPHA, NEAR, finite, normalize, sigmoid
from jsecon.splat.sound import usable
from jsecon.types import Array, Camera, Gaussians, Leaf

# An axis longer than this (px) is flat over any image; it is shrunk to it, so that squares stay in float32.
_WIDEST_PX = 1e15
# No splat reaches back from here (px): its axes end at _WIDEST_PX.
_FARTHEST_PX = 1e17
# exp(60) is beyond any scene and its products with a focal length over a depth still fit float32.
_LARGEST_LOG_SCALE = 60.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Projection:
    """N splats of one view."""

    means_px: Leaf
    """(N, 2) centres, px. This and the following mean nothing where `visible` is False."""
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
    """(N,) bool: usable (see `sound.usable`), in front of the near plane, able to reach alpha 1/255, box touching the
    image."""

    @property
    def conics(self) -> Array:
        """(N, 3) a, b, c of the inverse 2D covariance [[a, b], [b, c]], 1/px^2."""
        l11, l21, l22 = self.whitening[:, 0], self.whitening[:, 1], self.whitening[:, 2]
        return jnp.stack([l11 * l11, l11 * l21, l21 * l21 + l22 * l22], axis=-1)


def rotation_matrices(quaternions: Float[Array, "n 4"]) -> Float[Array, "n 3 3"]:
    """Rotation matrices of wxyz quaternions of any length (the zero quaternion gives the identity)."""
    unit = normalize(quaternions)
    w, x, y, z = unit[:, 0], unit[:, 1], unit[:, 2], unit[:, 3]
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return jnp.stack(rows, axis=-2)


def check_shapes(gaussians: Gaussians, camera: Camera) -> None:
    """Raises ValueError where the arrays of `gaussians` disagree or `camera` is a batch."""
    n = gaussians.means.shape[0] if gaussians.means.ndim == 2 else -1
    for name, expected in (
        ("means", (n, 3)),
        ("log_scales", (n, 3)),
        ("quaternions", (n, 4)),
        ("opacity_logits", (n,)),
    ):
        got = getattr(gaussians, name).shape
        require(
            got == expected,
            f"gaussians.{name}",
            got=got,
            expected=f"{expected} with N = {n}",
            remedy="Every array of Gaussians has one row a Gaussian.",
        )
    require(
        camera.world_to_camera.shape == (4, 4),
        "camera.world_to_camera",
        got=camera.world_to_camera.shape,
        expected="(4, 4), a single camera",
        remedy="Index the batch (cameras[t]) or use jax.vmap over it.",
    )


def project(gaussians: Gaussians, camera: Camera, *, near: float = NEAR) -> Projection:
    """Projects N Gaussians into one view (Zwicker et al. 2001 as in Kerbl et al. 2023; conventions in DESIGN section
    5).

    Differentiable in every array of both. Raises ValueError on shapes that disagree. Gaussians that are not usable
    (NaN, infinite) come back invisible, with gradient zero; before a camera that is not finite, all do.
    """
    check_shapes(gaussians, camera)
    gaussians, camera, drawn = _guarded(*jax.tree.map(jnp.asarray, (gaussians, camera)))
    w2c = camera.world_to_camera
    means, width, height = gaussians.means, camera.width, camera.height

    # Written out rather than as a matrix product: exact float32 on every backend, and one fused loop.
    x, y, z = (
        means[:, 0] * w2c[i, 0] + means[:, 1] * w2c[i, 1] + means[:, 2] * w2c[i, 2] + w2c[i, 3] for i in range(3)
    )
    # What lies aside beyond all measure is hidden here, before its ratio overflows.
    farthest = _FARTHEST_PX * z
    in_front = drawn & (z > near) & (jnp.abs(camera.fx * x) < farthest) & (jnp.abs(camera.fy * y) < farthest)
    z_safe = jnp.where(in_front, z, 1.0)
    x_ratio, y_ratio = jnp.where(in_front, x, 0.0) / z_safe, jnp.where(in_front, y, 0.0) / z_safe
    means_px = jnp.stack([camera.fx * x_ratio + camera.cx, camera.fy * y_ratio + camera.cy], axis=-1)

    # Inside the Jacobian only, the ray is kept to a multiple of the field of view, on each side of the principal point.
    margin_x = (FRUSTUM_MARGIN - 1) * 0.5 * width / camera.fx
    margin_y = (FRUSTUM_MARGIN - 1) * 0.5 * height / camera.fy
    x_ratio = jnp.clip(x_ratio, -camera.cx / camera.fx - margin_x, (width - camera.cx) / camera.fx + margin_x)
    y_ratio = jnp.clip(y_ratio, -camera.cy / camera.fy - margin_y, (height - camera.cy) / camera.fy + margin_y)

    scales = jnp.exp(jnp.minimum(gaussians.log_scales, _LARGEST_LOG_SCALE))
    axes = (w2c[None, :3, :3, None] * rotation_matrices(gaussians.quaternions)[:, None, :, :]).sum(2) * scales[
        :, None, :
    ]
    row_1 = (camera.fx / z_safe)[:, None] * (axes[:, 0] - x_ratio[:, None] * axes[:, 2])
    row_2 = (camera.fy / z_safe)[:, None] * (axes[:, 1] - y_ratio[:, None] * axes[:, 2])
    longest = jnp.maximum(jnp.abs(row_1), jnp.abs(row_2))
    shrink = jax.lax.stop_gradient(jnp.where(longest > _WIDEST_PX, _WIDEST_PX / longest, 1.0))
    row_1, row_2 = row_1 * shrink, row_2 * shrink

    norm_1, norm_2 = (row_1 * row_1).sum(1), (row_2 * row_2).sum(1)
    cov_xx, cov_yy = norm_1 + BLUR_PX2, norm_2 + BLUR_PX2
    # In y, the unit is from here on the splat's own height (constant to the gradient: it cancels): 1 / cov_yy^2, which
    # the derivative of a quotient contains, would vanish in float32 from heights of 1e9 px on.
    height_px = jax.lax.stop_gradient(jnp.sqrt(cov_yy))
    row_2 = row_2 / height_px[:, None]
    blur_y = BLUR_PX2 / height_px / height_px
    norm_2 = (row_2 * row_2).sum(1)
    own_yy = norm_2 + blur_y
    cross = jnp.stack(
        [
            row_1[:, 1] * row_2[:, 2] - row_1[:, 2] * row_2[:, 1],
            row_1[:, 2] * row_2[:, 0] - row_1[:, 0] * row_2[:, 2],
            row_1[:, 0] * row_2[:, 1] - row_1[:, 1] * row_2[:, 0],
        ],
        -1,
    )
    # det(M M^T + e I) as a sum of positive terms, over cov_yy: the variance of x given y. Nothing cancels.
    x_given_y = ((cross * cross).sum(1) + blur_y * norm_1 + BLUR_PX2 * own_yy) / own_yy
    l11 = jax.lax.rsqrt(x_given_y)
    slope = (row_1 * row_2).sum(1) / own_yy / height_px
    whitening = jnp.stack([l11, -slope * l11, jax.lax.rsqrt(own_yy) / height_px], axis=-1)

    opacities = sigmoid(gaussians.opacity_logits)
    reach = jnp.sqrt(2 * jnp.log(jnp.maximum(opacities / MIN_ALPHA, 1.0)))[:, None]
    extents = jax.lax.stop_gradient(reach * jnp.sqrt(jnp.stack([cov_xx, cov_yy], axis=-1)))
    extents = extents * (1 + 1e-5) + 1e-3  # covers the rounding of the box against that of the exponent
    centres = jax.lax.stop_gradient(means_px)
    touching = ((centres + extents > 0) & (centres - extents < jnp.asarray([[width, height]], centres.dtype))).all(1)
    numbers = jnp.concatenate(
        [centres, extents, jax.lax.stop_gradient(whitening), z[:, None], opacities[:, None]], axis=1
    )
    visible = in_front & (opacities >= MIN_ALPHA) & touching & jnp.isfinite(numbers).all(1)
    return Projection(means_px, whitening, opacities, z, extents, visible)


def _guarded(gaussians: Gaussians, camera: Camera) -> tuple[Gaussians, Camera, Array]:
    """Both with harmless numbers in place of bad ones, and (N,) bool the Gaussians that are themselves: a bad number
    must be gone before the first product, or its gradient, zero times NaN, is NaN and reaches the pose."""
    sound = finite(*jax.tree.leaves(camera))
    drawn = usable(gaussians) & sound
    keep = lambda array, other: jnp.where(drawn.reshape(-1, *[1] * (array.ndim - 1)), array, other)
    harmless = jax.tree.map(lambda a: jnp.ones((), a.dtype), camera)
    harmless = dataclasses.replace(harmless, world_to_camera=jnp.eye(4, dtype=camera.world_to_camera.dtype))
    return (
        dataclasses.replace(
            gaussians,
            means=keep(gaussians.means, 0.0),
            log_scales=keep(gaussians.log_scales, 0.0),
            quaternions=keep(gaussians.quaternions, 0.0),
            opacity_logits=keep(gaussians.opacity_logits, 0.0),
        ),
        jax.tree.map(lambda a, b: jnp.where(sound, a, b), camera, harmless),
        drawn,
    )
