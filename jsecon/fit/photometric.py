"""How far a rendered image is from a photograph: L1, SSIM, their mixture (the 3DGS loss), and PSNR.

Images are (H, W, C), linear in [0, 1]. SSIM is Wang et al. 2004 as 3DGS training uses it: an 11 x 11 Gaussian window of
sigma 1.5 px, zero padding of 5 px, C1 = 0.01^2, C2 = 0.03^2, mean over pixels and channels.
"""

import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jsecon.errors import require
from jsecon.types import Array

RADIUS_PX = 5
"""half the SSIM window less its centre: 11 = 2 * 5 + 1"""
SIGMA_PX = 1.5
C1 = 0.01**2
"""keeps the luminance term finite where both images are black"""
C2 = 0.03**2
"""keeps the contrast term finite where both images are flat"""


def _window() -> np.ndarray:
    offsets = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    weights = np.exp(-(offsets**2) / (2 * SIGMA_PX**2))
    return weights / weights.sum()


def _blur_once(image, axis: int):
    """Shifted adds, which XLA fuses to one vectorised pass: 50 times faster on CPU than its convolution."""
    size = image.shape[axis]
    padding = [(RADIUS_PX, RADIUS_PX) if a == axis else (0, 0) for a in range(image.ndim)]
    padded = jnp.pad(image, padding)
    terms = (float(w) * jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i, w in enumerate(_window()))
    return functools.reduce(operator.add, terms)


@jax.custom_vjp
def gaussian_blur(image: Float[Array, "h w c"]) -> Float[Array, "h w c"]:
    """The SSIM window's weighted mean around each pixel, zeros outside the image; separable."""
    return _blur_once(_blur_once(image, 0), 1)


# The window is even and the padding zero, so the map is symmetric: its transpose is itself.
gaussian_blur.defvjp(lambda image: (gaussian_blur(image), None), lambda _, cotangent: (gaussian_blur(cotangent),))


def _same_shape(image, target) -> None:
    got = f"{image.shape} and {target.shape}"
    require(image.shape == target.shape, "image and target", got, "the same (H, W, C)", "Render at the photo's size.")


def l1(image: Float[Array, "h w c"], target: Float[Array, "_ _ _"]) -> Float[Array, ""]:
    """Mean absolute difference over pixels and channels."""
    _same_shape(image, target)
    return jnp.mean(jnp.abs(image - target))


def ssim_map(image: Float[Array, "h w c"], target: Float[Array, "_ _ _"]) -> Float[Array, "h w c"]:
    """Structural similarity at each pixel and channel, in [-1, 1]; 1 where windows are equal (Wang 2004, eq. 13)."""
    _same_shape(image, target)
    # Five blurs, not one of a stack: slicing the stack's gradient apart costs XLA four times the blurs themselves.
    mean_i, mean_t = gaussian_blur(image), gaussian_blur(target)
    square_i, square_t = gaussian_blur(image * image), gaussian_blur(target * target)
    product = gaussian_blur(image * target)
    variance_i, variance_t = square_i - mean_i * mean_i, square_t - mean_t * mean_t
    covariance = product - mean_i * mean_t
    numerator = (2 * mean_i * mean_t + C1) * (2 * covariance + C2)
    return numerator / ((mean_i * mean_i + mean_t * mean_t + C1) * (variance_i + variance_t + C2))


def ssim(image: Float[Array, "h w c"], target: Float[Array, "_ _ _"]) -> Float[Array, ""]:
    """Mean of `ssim_map` over pixels and channels."""
    return jnp.mean(ssim_map(image, target))


def photometric_loss(image: Float[Array, "h w c"], target: Float[Array, "_ _ _"]) -> Float[Array, ""]:
    """0.8 L1 + 0.2 (1 - SSIM), Kerbl et al. 2023, eq. 7."""
    return 0.8 * l1(image, target) + 0.2 * (1 - ssim(image, target))


def psnr(image: Float[Array, "h w c"], target: Float[Array, "_ _ _"]) -> Float[Array, ""]:
    """Peak signal-to-noise ratio, dB, of images in [0, 1] (clamp the rendering before); infinite where equal."""
    _same_shape(image, target)
    difference = image - target
    return -10.0 * jnp.log10(jnp.mean(difference * difference))
