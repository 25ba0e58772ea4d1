"""A case rendered with its gradients: by the engine in float32, and by a dense float64 compositor that shares no code
with it."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.numerics import BLUR_PX2, FRUSTUM_MARGIN, MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE, NEAR
from jsecon.splat.render import render
from stability.case import ARGUMENTS, Case

TILE_PAIRS_PX = 8
"""capacity: every Gaussian in every tile of this edge; `overflow` is checked"""


def dense_image(gaussians, camera, features):
    """(H, W, D + 1) image and alpha by automatic differentiation's leave: every Gaussian at every pixel, in a scan."""
    w2c, means = camera.world_to_camera, gaussians.means
    x, y, z = jnp.moveaxis(means @ w2c[:3, :3].T + w2c[:3, 3], 1, 0)
    in_front = z > NEAR
    x, y, z = (jnp.where(in_front, a, 1.0) for a in (x, y, z))
    margin_x, margin_y = (FRUSTUM_MARGIN - 1) / 2 * camera.width, (FRUSTUM_MARGIN - 1) / 2 * camera.height
    u, v = camera.fx * x / z, camera.fy * y / z
    u_kept = jnp.clip(u, -camera.cx - margin_x, camera.width - camera.cx + margin_x)
    v_kept = jnp.clip(v, -camera.cy - margin_y, camera.height - camera.cy + margin_y)
    squared = (gaussians.quaternions**2).sum(1)
    unit = jnp.where(squared > 0, 1.0, 0.0)[:, None] * gaussians.quaternions
    a, b, c, d = jnp.moveaxis(unit / jnp.sqrt(jnp.where(squared > 0, squared, 1.0))[:, None], 1, 0)
    rotation = jnp.array(
        [
            [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
        ]
    )
    axes = jnp.einsum("ij,jkn,nk->nik", w2c[:3, :3], rotation, jnp.exp(gaussians.log_scales))
    row_x = (camera.fx * axes[:, 0] - u_kept[:, None] * axes[:, 2]) / z[:, None]
    row_y = (camera.fy * axes[:, 1] - v_kept[:, None] * axes[:, 2]) / z[:, None]
    xx, xy, yy = (row_x**2).sum(1), (row_x * row_y).sum(1), (row_y**2).sum(1)
    determinant = (jnp.cross(row_x, row_y) ** 2).sum(1) + BLUR_PX2 * (xx + yy) + BLUR_PX2**2
    inverse = jnp.stack([yy + BLUR_PX2, -xy, xx + BLUR_PX2], 1) / determinant[:, None]
    rows, columns = jnp.mgrid[: camera.height, : camera.width] + 0.5
    opacities = jnp.exp(-jnp.logaddexp(0.0, -gaussians.opacity_logits))

    def one(carry, item):
        transmittance, running, total = carry
        centre_x, centre_y, (p, q, r), opacity, seen, feature = item
        dx, dy = columns - centre_x, rows - centre_y
        alpha = opacity * jnp.exp(-0.5 * (p * dx * dx + 2 * q * dx * dy + r * dy * dy))
        alpha = jnp.where(seen & (alpha >= MIN_ALPHA), jnp.minimum(alpha, MAX_ALPHA), 0.0)
        running &= transmittance * (1 - alpha) > MIN_TRANSMITTANCE
        weight = jnp.where(running, alpha * transmittance, 0.0)
        return (transmittance - weight, running, total + weight[..., None] * feature), None

    order = jnp.argsort(jax.lax.stop_gradient(z), stable=True)
    items = (u + camera.cx, v + camera.cy, inverse, opacities, in_front, features)
    clear = jnp.ones((camera.height, camera.width))
    initial = (clear, clear > 0, jnp.zeros((*clear.shape, features.shape[1])))
    left, _, total = jax.lax.scan(one, initial, jax.tree.map(lambda a: a[order], items))[0]
    return jnp.concatenate([total, 1 - left[..., None]], axis=-1)


def engine_image(gaussians, camera, features, *, capacity: int):
    rendering = render(gaussians, camera, features, capacity=capacity)
    return jnp.concatenate([rendering.features, rendering.alpha[..., None]], axis=-1), rendering.overflow


def image_and_gradients(image_of, gaussians, camera, features, cotangent):
    """The image, what came with it, and a gradient for each of ARGUMENTS of <image, cotangent>."""

    def loss(gaussians, camera, features):
        image = image_of(gaussians, camera, features)
        image, extra = image if isinstance(image, tuple) else (image, 0)
        # A pixel that is not finite has no gradient to give; the others must not suffer from it.
        return jnp.where(jnp.isfinite(image), image * cotangent, 0.0).sum(), (image, extra)

    (_, (image, extra)), (g, c, f) = jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True)(
        gaussians, camera, features
    )
    intrinsics = jnp.stack([c.fx, c.fy, c.cx, c.cy])
    parts = (g.means, g.log_scales, g.quaternions, g.opacity_logits, c.world_to_camera[:3], intrinsics, f)
    return image, extra, dict(zip(ARGUMENTS, parts))


@functools.cache
def _compiled(image_of, **options):
    return jax.jit(functools.partial(image_and_gradients, image_of), compiler_options=options)


@functools.cache
def _engine(capacity: int):
    return functools.partial(engine_image, capacity=capacity)


def engine(case: Case, cotangent: np.ndarray):
    down, across = -(-case.camera.height // TILE_PAIRS_PX), -(-case.camera.width // TILE_PAIRS_PX)
    capacity = max(case.gaussians.count * down * across, 64)
    arguments = jax.tree.map(jnp.asarray, (case.gaussians, case.camera, case.features, cotangent.astype(np.float32)))
    return jax.tree.map(np.asarray, _compiled(_engine(capacity))(*arguments))


def dense(gaussians, camera, features, cotangent):
    with jax.enable_x64(True):
        arguments = jax.tree.map(jnp.asarray, (gaussians, camera, features, cotangent))
        # Compiled without optimisation: several times as soon ready, and it runs but a few times.
        run = _compiled(dense_image, xla_backend_optimization_level=0)
        return jax.tree.map(np.asarray, run(*arguments))
