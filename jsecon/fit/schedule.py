"""Schedule of a fit: frame sizes, learning rates, degree of colour and number of Gaussians over time.

Time is the share of the fit that is done, in [0, 1], so that fits limited by steps and by minutes behave alike.
"""

import dataclasses
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np

from jsecon.errors import require
from jsecon.types import Array, Gaussians, record

MAX_GAUSSIANS = 100_000
"""Default limit on the number of Gaussians: more make each step slower. bonsai at 400x266 after two minutes has 28.6 dB
with 50,000, 28.8 with 100,000 and 28.2 with 200,000 (experiments/retired.md)."""
GROWTH_START, GROWTH_END = 0.05, 0.5
"""Shares of the fit between which the number of Gaussians rises linearly."""
DEGREE_INTERVAL = 0.1
"""Share of the fit after which the degree of the spherical harmonics rises by one."""


@record
class LearningRates:
    """Step sizes of Adam for each group of parameters. All decay log-linearly over the fit."""

    means: Any = 5e-4
    """First step size of the positions, in units of the cameras' extent."""
    means_last: Any = 5e-6
    """Last step size of the positions, in the same unit."""
    log_scales: Any = 2e-2
    quaternions: Any = 1e-2
    opacity_logits: Any = 5e-2
    colors: Any = 1.5e-2
    """Step size of the constant band of the spherical harmonics; higher bands take a twentieth."""
    rest_last: Any = 0.3
    """Last step size of all other groups, as a share of their first."""


def rates_at(done: Array, rates: LearningRates, gaussians: Gaussians, extent: Array, degree: Array) -> Gaussians:
    """Computes the step size of each array when the share `done` of the fit is done. Pure.

    Args:
      done: Share of the fit that is done.
      rates: Step sizes over the fit.
      gaussians: Scene, for the number of its spherical harmonics.
      extent: Cameras' extent, world units.
      degree: Highest degree of the spherical harmonics that learns: the rate of higher coefficients is zero.
    """
    band = np.floor(np.sqrt(np.arange(gaussians.sh.shape[1]))).astype(np.int32)
    sh = jnp.where(band <= degree, jnp.where(band == 0, rates.colors, rates.colors / 20), 0.0)
    # Log-linear; written so that a rate of 0 (frozen positions) stays 0.
    decay = jnp.where(rates.means > 0, rates.means_last / jnp.where(rates.means > 0, rates.means, 1.0), 0.0)
    means, rest = extent * rates.means * decay**done, rates.rest_last**done
    return Gaussians(
        means, rest * rates.log_scales, rest * rates.quaternions, rest * rates.opacity_logits, rest * sh[None, :, None]
    )


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Schedule of a fit. Raises ValueError if the ends of its frame sizes are out of order."""

    sizes: tuple[tuple[float, float], ...] = ((0.5, 0.5), (1.0, 1.0))
    """Pairs of a frame size and the share of the fit at which it ends. Smaller frames cost less and move large things
    first (arXiv 2503.18402)."""
    max_gaussians: int = MAX_GAUSSIANS
    """Number of Gaussians after growth. A start with as many or more keeps its number: 0 means no growth."""

    def __post_init__(self) -> None:
        """Checks the sizes."""
        ends = [end for _, end in self.sizes]
        ordered = ends == sorted(ends) and ends[-1:] == [1.0] and all(0 < size <= 1 for size, _ in self.sizes)
        require(ordered, "sizes", self.sizes, "sizes in (0, 1] with rising ends, the last 1", "((1, 1),) is one size.")

    def size(self, done: float) -> float:
        """Returns the size of the frames, as a share of their full size."""
        return next(size for size, end in self.sizes if done < end or end == 1.0)

    def next_size(self, done: float) -> float | None:
        """Returns the size of the frames that follows, or None if the present size is the last."""
        return next((later for (_, end), (later, _) in pairwise(self.sizes) if done < end), None)

    def degree(self, done: float) -> int:
        """Returns the highest degree of the spherical harmonics that learns; it may exceed the scene's."""
        return int(done / DEGREE_INTERVAL)

    def count(self, done: float, start: int) -> int | None:
        """Returns the number of Gaussians to grow to from `start`, or None outside of the growth phase."""
        if not GROWTH_START <= done <= GROWTH_END or self.max_gaussians <= start:
            return None
        share = (done - GROWTH_START) / (GROWTH_END - GROWTH_START)
        return round(start + share * (self.max_gaussians - start))
