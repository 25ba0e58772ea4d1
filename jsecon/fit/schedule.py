"""What a fit does when: the sizes of its frames, its learning rates, its degree of colour, its number of Gaussians.

All of it follows the share of the fit that is done, in [0, 1], so that a fit of so many steps and one of so many
minutes go the same way.
"""

import dataclasses
from typing import Any

import cv2
import jax.numpy as jnp
import numpy as np

from jsecon.errors import require
from jsecon.types import Array, Camera, Gaussians, record


@record
class LearningRates:
    """Step sizes of Adam per group. Positions are in units of the cameras' extent. All decay log-linearly over the
    fit."""

    means: Any = 5e-4
    """at the first step, times the extent"""
    means_last: Any = 5e-6
    """at the last step, times the extent"""
    log_scales: Any = 2e-2
    quaternions: Any = 1e-2
    opacity_logits: Any = 5e-2
    colors: Any = 1.5e-2
    """of the constant band of the spherical harmonics; the higher bands take a twentieth"""
    rest_last: Any = 0.3
    """what the other rates have decayed to at the last step, log-linearly too, as a share of their first"""


def rates_at(done: Array, rates: LearningRates, gaussians: Gaussians, extent: Array, degree: Array) -> Gaussians:
    """One rate per array (one per band for sh), in the shape of Gaussians; bands above `degree` have none."""
    of_band = np.floor(np.sqrt(np.arange(gaussians.sh.shape[1]))).astype(np.int32)
    sh = jnp.where(of_band <= degree, jnp.where(of_band == 0, rates.colors, rates.colors / 20), 0.0)
    # Log-linear; written so that a rate of 0 (frozen positions) stays 0.
    decay = jnp.where(rates.means > 0, rates.means_last / jnp.where(rates.means > 0, rates.means, 1.0), 0.0)
    means, rest = extent * rates.means * decay**done, rates.rest_last**done
    return Gaussians(
        means, rest * rates.log_scales, rest * rates.quaternions, rest * rates.opacity_logits, rest * sh[None, :, None]
    )


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How a fit goes."""

    sizes: tuple[tuple[float, float], ...] = ((0.5, 0.5), (1.0, 1.0))
    """(size of the frames, share of the fit at which it ends): smaller frames cost less and move what is large first
    (arXiv 2503.18402)"""
    max_gaussians: int = 100_000
    """Number of Gaussians after growth. A start with as many or more keeps its number: 0 means no growth."""
    growth_start: float = 0.05
    growth_end: float = 0.5
    """shares of the fit between which the number of Gaussians rises evenly to `max_gaussians`"""
    degree_interval: float = 0.1
    """share of the fit after which the degree of the spherical harmonics rises by one, up to what the start holds"""

    def __post_init__(self) -> None:
        ends = [end for _, end in self.sizes]
        sound = ends == sorted(ends) and ends[-1:] == [1.0] and all(0 < size <= 1 for size, _ in self.sizes)
        require(sound, "sizes", self.sizes, "pairs of a size in (0, 1] and its end, the last end 1", "((1, 1),) is one")
        order = 0 <= self.growth_start < self.growth_end <= 1
        require(order, "growth_start, growth_end", (self.growth_start, self.growth_end), "0 <= from < until <= 1", "")

    def size(self, done: float) -> float:
        """Of the frames, as a share of their own."""
        return next(size for size, end in self.sizes if done < end or end == 1.0)

    def degree(self, done: float) -> int:
        """The highest of the spherical harmonics that learns."""
        return int(done / self.degree_interval) if self.degree_interval > 0 else 3

    def grows(self, start: int) -> bool:
        """Whether a fit that starts with `start` Gaussians adds any."""
        return self.max_gaussians > start

    def count(self, done: float, start: int) -> int | None:
        """Number of Gaussians at this share of the fit, or None outside of the growth phase."""
        if not self.growth_start <= done <= self.growth_end or not self.grows(start):
            return None
        share = (done - self.growth_start) / (self.growth_end - self.growth_start)
        return round(start + share * (self.max_gaussians - start))


LONG_STEPS, LONG_MINUTES = 3000, 3.0
"""from which on a fit is long"""
MOST = 100_000
"""Gaussians, where nothing else is asked for"""


def default_max_gaussians(pixels: int, *, steps: int | None, minutes: float | None) -> int:
    """How many Gaussians a fit to frames of so many pixels may have: one for every other pixel, in a long fit one for
    each, at most MOST. More of them make a step slower: bonsai at 400x266 after two minutes has 28.3 dB with 50,000,
    28.5 with 100,000, 27.8 with 200,000 (experiments/work_precision_fit.py)."""
    long = steps >= LONG_STEPS if minutes is None and steps is not None else (minutes or 0) >= LONG_MINUTES
    return min(pixels if long else pixels // 2, MOST)


def resize_cameras(cameras: Camera, size: float) -> Camera:
    """A batch of cameras whose images are `size` times theirs, in whole px."""
    width, height = max(round(cameras.width * size), 1), max(round(cameras.height * size), 1)
    x, y = np.float32(width / cameras.width), np.float32(height / cameras.height)
    lens = cameras.fx * x, cameras.fy * y, cameras.cx * x, cameras.cy * y
    return Camera(cameras.world_to_camera, *lens, width=width, height=height)


def resize_frame(frame: np.ndarray, cameras: Camera) -> np.ndarray:
    """A frame (h, w, 3) uint8 at the size of `cameras`: each pixel the mean of those that it covers."""
    if frame.shape[:2] == (cameras.height, cameras.width):
        return np.asarray(frame)
    return cv2.resize(np.asarray(frame), (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)


def resize_mask(mask: np.ndarray, cameras: Camera) -> np.ndarray:
    """A mask (h, w) bool at the size of `cameras`: a pixel is set where any of those that it covers is."""
    size = cameras.width, cameras.height
    return cv2.resize(np.asarray(mask, np.float32), size, interpolation=cv2.INTER_AREA) > 0
