"""The photometric loss of 3DGS, a mixture of L1 and SSIM; and PSNR. Pure functions.

Value and gradient are computed in one pass over the rows of each device, in stages that are computed once
(`compute_once`). It takes 2.4 ms instead of 8.3 ms at 400x266 on two cores.

Images are (H, W, C), linear in [0, 1]. SSIM is Wang et al. 2004 as 3DGS training uses it: an 11 x 11 Gaussian window of
sigma 1.5 px, zero padding of 5 px, C1 = 0.01^2, C2 = 0.03^2, mean over pixels and channels.
"""

import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float

from jsecon.errors import require_shape
from jsecon.numerics import array_module
from jsecon.parallel import map_over_devices
from jsecon.splat.fusion import compute_once, opaque_true
from jsecon.types import Array

RADIUS_PX = 5
"""Radius of the SSIM window: 11 = 2 * 5 + 1."""
C1, C2 = 0.01**2, 0.03**2
"""Keep the luminance and the contrast term finite if both images are black or flat."""
SSIM_WINDOW = np.exp(-(np.arange(-RADIUS_PX, RADIUS_PX + 1) ** 2) / (2 * 1.5**2))
SSIM_WINDOW /= SSIM_WINDOW.sum()
"""Weights of the SSIM window along one axis."""
SSIM_SHARE = 0.2
"""Share of SSIM in the loss (Kerbl et al. 2023)."""


def _shifts(image: Array, axis: int, step: int) -> Array:
    """The window along one axis with a step between its numbers; without padding."""
    size = image.shape[axis] - 2 * RADIUS_PX * step
    starts = range(0, image.shape[axis], step)
    terms = (float(w) * jax.lax.slice_in_dim(image, i, i + size, axis=axis) for i, w in zip(starts, SSIM_WINDOW))
    return functools.reduce(operator.add, terms)


def photometric_loss(
    image: Float[Array, "h w c"], target: Float[Array, "_ _ _"], mesh: Mesh | None = None
) -> Float[Array, ""]:
    """Computes 0.8 L1 + 0.2 (1 - SSIM) of a rendering and a photograph (Kerbl et al. 2023, eq. 7).

    Args:
      image: Rendering in [0, 1]; it alone is differentiable, in reverse mode.
      target: Photograph of the same shape.
      mesh: Devices to divide the rows among.
    """
    require_shape("target", target, image.shape, "Render at the photo's size.")
    return _loss(image, target, mesh)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _loss(image: Array, target: Array, mesh: Mesh | None) -> Array:
    return _loss_and_gradient(image, target, mesh)[0]


def _loss_and_gradient(image: Array, target: Array, mesh: Mesh | None) -> tuple[Array, Array]:
    """Loss and its gradient (H, W, C) in `image`.

    Each device computes some rows, with a halo of 2 RADIUS_PX rows on either side: the gradient of a pixel needs the
    SSIM in its window, and that needs the windows' pixels.
    """
    height, width, channels = image.shape
    devices, halo = 1 if mesh is None else mesh.size, 2 * RADIUS_PX
    rows = -(-height // devices)

    # Rows of W C numbers: a shift by one pixel is a shift by C, and the innermost loop is long.
    def flat(a):
        return jnp.pad(a.reshape(height, -1), ((halo, halo + devices * rows - height), (0, 0)))

    def local(index, _, images):
        x, y = (jax.lax.dynamic_slice_in_dim(a, index * rows, rows + 2 * halo) for a in images)
        row = index * rows - RADIUS_PX + jnp.arange(rows + 2 * RADIUS_PX)
        total, gradient = _loss_of_rows(x, y, ((row >= 0) & (row < height))[:, None], channels)
        return total[None], gradient

    images = flat(image), flat(target)
    totals, gradient = local(0, (), images) if mesh is None else map_over_devices(local, (), images, mesh)
    return totals.sum() / image.size, gradient[:height].reshape(height, width, channels) / image.size


_loss.defvjp(_loss_and_gradient, lambda mesh, gradient, bar: (bar * gradient, None))


def _loss_of_rows(x: Array, y: Array, inside: Array, channels: int) -> tuple[Array, Array]:
    """Sum of the loss over R rows, and its gradient (R, W C), from images (R + 4 RADIUS_PX, W C).

    `inside` (R + 2 RADIUS_PX, 1) marks rows inside of the image.

    With a = 2 m n + C1, b = 2 (p - m n) + C2, c = m^2 + n^2 + C1, d = q - m^2 + r - n^2 + C2 (m, n the blurred images,
    q, r, p their blurred squares and product) SSIM is S = a b / (c d), so dS/dm = 2 n (b - a) / (c d) - 2 m S
    (1 / c - 1 / d), dS/dq = -S / d, dS/dp = 2 a / (c d); the blur equals its transpose.
    """
    always = opaque_true(x[0, 0])

    def sides(a):
        return jnp.pad(a, ((0, 0), (RADIUS_PX * channels,) * 2))

    down, across = lambda a: sides(_shifts(a, 0, 1)), lambda a: _shifts(a, 1, channels)

    def similarity(m, n, q, r, p):
        m, n, q, r, p = map(across, (m, n, q, r, p))
        a, b = 2 * m * n + C1, 2 * (p - m * n) + C2
        c, d = m * m + n * n + C1, q - m * m + r - n * n + C2
        s = a * b / (c * d)
        by = s, 2 * n * (b - a) / (c * d) - 2 * m * s * (1 / c - 1 / d), -s / d, 2 * a / (c * d)
        return [jnp.where(inside, value, 0.0) for value in by]

    def gradient(by_mean, by_square, by_product, x, y):
        by_ssim = across(by_mean) + 2 * x * across(by_square) + y * across(by_product)
        return (1 - SSIM_SHARE) * jnp.sign(x - y) - SSIM_SHARE * by_ssim

    blurred = compute_once(always, lambda x, y: [down(a) for a in (x, y, x * x, y * y, x * y)], x, y)
    s, *partials = compute_once(always, similarity, *blurred)
    x, y = (a[2 * RADIUS_PX : -2 * RADIUS_PX] for a in (x, y))
    inner = slice(RADIUS_PX, -RADIUS_PX)
    loss = (1 - SSIM_SHARE) * jnp.abs(x - y) + SSIM_SHARE * (1 - s[inner])
    partials = compute_once(always, lambda *by: [down(a) for a in by], *partials)
    return jnp.sum(jnp.where(inside[inner], loss, 0.0)), compute_once(always, gradient, *partials, x, y)


@np.errstate(divide="ignore")
def psnr(image: Float[Array, "*pixels c"], target: Float[Array, "*pixels c"]) -> Float[Array, ""]:
    """Computes the peak signal-to-noise ratio in dB, infinite for equal images; clamp a rendering to [0, 1] first."""
    difference = image - target
    xp = array_module(difference)
    return xp.asarray(-10.0 * xp.log10((difference * difference).mean()))
