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
    """Computes the step sizes at one time. Pure.

    Args:
      done: () share of the fit that is done.
      rates: Step sizes over the fit.
      gaussians: Scene, for the number of its spherical harmonics.
      extent: () cameras' extent in world units.
      degree: () highest degree of the spherical harmonics that learns.

    Returns:
      One rate for each array in the layout of Gaussians; sh has one per coefficient, zero above `degree`.
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
    """Schedule of a fit. Raises ValueError if its shares of the fit are out of order."""

    sizes: tuple[tuple[float, float], ...] = ((0.5, 0.5), (1.0, 1.0))
    """Pairs of a frame size and the share of the fit at which it ends. Smaller frames cost less and move large things
    first (arXiv 2503.18402)."""
    max_gaussians: int = MAX_GAUSSIANS
    """Number of Gaussians after growth. A start with as many or more keeps its number: 0 means no growth."""
    growth_start: float = 0.05
    """Share of the fit at which growth begins."""
    growth_end: float = 0.5
    """Share of the fit at which the number of Gaussians, which rises linearly, reaches `max_gaussians`."""
    degree_interval: float = 0.1
    """Share of the fit after which the degree of the spherical harmonics rises by one."""

    def __post_init__(self) -> None:
        """Checks the ranges of the numbers."""
        ends = [end for _, end in self.sizes]
        ordered = ends == sorted(ends) and ends[-1:] == [1.0] and all(0 < size <= 1 for size, _ in self.sizes)
        require(ordered, "sizes", self.sizes, "sizes in (0, 1] with rising ends, the last 1", "((1, 1),) is one size.")
        ordered = 0 <= self.growth_start < self.growth_end <= 1
        got = self.growth_start, self.growth_end
        require(ordered, "growth_start, growth_end", got, "0 <= start < end <= 1", "")

    def size(self, done: float) -> float:
        """Returns the size of the frames.

        Args:
          done: Share of the fit that is done, in [0, 1].

        Returns:
          Share of their full size.
        """
        return next(size for size, end in self.sizes if done < end or end == 1.0)

    def next_size(self, done: float) -> float | None:
        """Returns the size of the frames that follows.

        Args:
          done: Share of the fit that is done, in [0, 1].

        Returns:
          Share of their full size, or None if the present size is the last.
        """
        return next((later for (_, end), (later, _) in pairwise(self.sizes) if done < end), None)

    def degree(self, done: float) -> int:
        """Returns the degree of colour.

        Args:
          done: Share of the fit that is done, in [0, 1].

        Returns:
          Highest degree of the spherical harmonics that learns; it may exceed the scene's.
        """
        return int(done / self.degree_interval) if self.degree_interval > 0 else 3

    def count(self, done: float, start: int) -> int | None:
        """Returns the number of Gaussians.

        Args:
          done: Share of the fit that is done, in [0, 1].
          start: Number of Gaussians at the start.

        Returns:
          The number to grow to, or None outside of the growth phase.
        """
        if not self.growth_start <= done <= self.growth_end or self.max_gaussians <= start:
            return None
        share = (done - self.growth_start) / (self.growth_end - self.growth_start)
        return round(start + share * (self.max_gaussians - start))
