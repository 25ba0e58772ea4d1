"""Photometric losses: L1, SSIM, their mixture (the loss of 3DGS), and PSNR. Pure functions.

The mixture has a second form for a mesh of devices: value and gradient in one pass over the rows of each device, in
stages that are computed once (`compute_once`). It takes 2.4 ms instead of 8.3 ms at 400x266 on two cores.

Images are (H, W, C), linear in [0, 1]. SSIM is Wang et al. 2004 as 3DGS training uses it: an 11 x 11 Gaussian window of
sigma 1.5 px, zero padding of 5 px, C1 = 0.01^2, C2 = 0.03^2, mean over pixels and channels.
"""

import functools
import operator
from collections.abc import Callable

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
_C1, _C2 = 0.01**2, 0.03**2
"""Keep the luminance and the contrast term finite if both images are black or flat."""
SSIM_WINDOW = np.exp(-(np.arange(-RADIUS_PX, RADIUS_PX + 1) ** 2) / (2 * 1.5**2))
SSIM_WINDOW /= SSIM_WINDOW.sum()
"""Weights of the SSIM window along one axis."""
SSIM_SHARE = 0.2
"""Share of SSIM in the loss (Kerbl et al. 2023)."""


def _blur_once(image, axis: int):
    """Blurs along one axis by shifted sums.

    XLA fuses them to one vectorised pass: 50 times faster on CPU than a convolution.
    """
    padding = [(RADIUS_PX, RADIUS_PX) if a == axis else (0, 0) for a in range(image.ndim)]
    return _shifts(jnp.pad(image, padding), axis, 1)


def _shifts(image: Array, axis: int, step: int) -> Array:
    """The window along one axis with a step between its numbers; without padding."""
    size = image.shape[axis] - 2 * RADIUS_PX * step
    starts = range(0, image.shape[axis], step)
    terms = (float(w) * jax.lax.slice_in_dim(image, i, i + size, axis=axis) for i, w in zip(starts, SSIM_WINDOW))
    return functools.reduce(operator.add, terms)


@jax.custom_vjp
def _gaussian_blur(image: Float[Array, "h w c"]) -> Float[Array, "h w c"]:
    """Blurs an image with the SSIM window, with zeros outside of the image. Reverse mode only."""
    return _blur_once(_blur_once(image, 0), 1)


# The window is even and the padding zero, so the map is symmetric and equals its transpose.
_gaussian_blur.defvjp(lambda image: (_gaussian_blur(image), None), lambda _, cotangent: (_gaussian_blur(cotangent),))


def ssim_map(
    image: Float[Array, "h w c"], target: Float[Array, "_ _ _"], blur: Callable = _gaussian_blur
) -> Float[Array, "h w c"]:
    """Computes the structural similarity of each pixel and channel, in [-1, 1] (Wang 2004, eq. 13)."""
    # Five blurs instead of one of a stack: slicing the gradient of the stack costs XLA four times the blurs.
    mean_i, mean_t = blur(image), blur(target)
    square_i, square_t = blur(image * image), blur(target * target)
    product = blur(image * target)
    variance_i, variance_t = square_i - mean_i * mean_i, square_t - mean_t * mean_t
    covariance = product - mean_i * mean_t
    numerator = (2 * mean_i * mean_t + _C1) * (2 * covariance + _C2)
    return numerator / ((mean_i * mean_i + mean_t * mean_t + _C1) * (variance_i + variance_t + _C2))


def photometric_loss(
    image: Float[Array, "h w c"], target: Float[Array, "_ _ _"], mesh: Mesh | None = None
) -> Float[Array, ""]:
    """Computes 0.8 L1 + 0.2 (1 - SSIM) of a rendering and a photograph (Kerbl et al. 2023, eq. 7).

    Args:
      image: Rendering in [0, 1].
      target: Photograph of the same shape.
      mesh: Devices to divide the rows among. With a mesh only `image` is differentiable, in reverse mode.
    """
    require_shape("target", target, image.shape, "Render at the photo's size.")
    if mesh is None:
        absolute = jnp.mean(jnp.abs(image - target))
        return (1 - SSIM_SHARE) * absolute + SSIM_SHARE * (1 - jnp.mean(ssim_map(image, target)))
    return _over_mesh(image, target, mesh)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def _over_mesh(image: Array, target: Array, mesh: Mesh) -> Array:
    return _loss_and_gradient(image, target, mesh)[0]


def _loss_and_gradient(image: Array, target: Array, mesh: Mesh) -> tuple[Array, Array]:
    """Loss and its gradient (H, W, C) in `image`.

    Each device computes some rows, with a halo of 2 RADIUS_PX rows on either side: the gradient of a pixel needs the
    SSIM in its window, and that needs the windows' pixels.
    """
    height, width, channels = image.shape
    rows, halo = -(-height // mesh.size), 2 * RADIUS_PX

    # Rows of W C numbers: a shift by one pixel is a shift by C, and the innermost loop is long.
    def flat(a):
        return jnp.pad(a.reshape(height, -1), ((halo, halo + mesh.size * rows - height), (0, 0)))

    def local(index, _, images):
        x, y = (jax.lax.dynamic_slice_in_dim(a, index * rows, rows + 2 * halo) for a in images)
        row = index * rows - RADIUS_PX + jnp.arange(rows + 2 * RADIUS_PX)
        total, gradient = _loss_of_rows(x, y, ((row >= 0) & (row < height))[:, None], channels)
        return total[None], gradient

    totals, gradient = map_over_devices(local, (), (flat(image), flat(target)), mesh)
    return totals.sum() / image.size, gradient[:height].reshape(height, width, channels) / image.size


_over_mesh.defvjp(_loss_and_gradient, lambda mesh, gradient, bar: (bar * gradient, None))


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
        a, b = 2 * m * n + _C1, 2 * (p - m * n) + _C2
        c, d = m * m + n * n + _C1, q - m * m + r - n * n + _C2
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
