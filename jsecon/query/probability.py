"""How sure a selection is of each of its Gaussians: the probability that it belongs, from its votes."""

import jax
import jax.numpy as jnp
from jax.scipy.special import betainc
from jaxtyping import Float

from jsecon.types import Array, Votes

CORRELATION = 0.05
"""between two views' errors: a tracker's loss or a proposal's cut lasts, so that views beyond about 20 add nothing"""


def membership_probability(
    share: Float[Array, " n"], votes: Votes, *, correlation: float = CORRELATION
) -> Float[Array, " n"]:
    """(N,) probability that most of a Gaussian belongs to what was selected, in [0, 1]; 0 where it was never seen.

    `share` (N,) is what a query by votes returns as similarity: the part of the weight with which the Gaussian was
    seen that fell inside, in the views that show the region where the votes know them. Taken as draws of views, of
    which n count as independent (of all that see the Gaussian), the true part has the posterior
    Beta(1 + n share, 1 + n (1 - share)) under a flat prior, and the probability is what of it lies above one half.
    n is the number of views, at most the Gaussian's weight in pixels (a glimpse of a tenth of a pixel is no whole
    look), damped by `correlation` r to n / (1 + (n - 1) r). So 0.9 of one view's weight and 0.9 of twenty views' are
    not the same answer. Pure; under jit and vmap.
    """
    return _probability(jnp.asarray(share), jnp.asarray(votes.views), jnp.asarray(votes.total), correlation)


@jax.jit
def _probability(share: Array, views: Array, total: Array, correlation: Array | float) -> Array:
    sound = (views > 0) & jnp.isfinite(share) & jnp.isfinite(total) & (total > 0)
    looks = jnp.where(sound, jnp.minimum(views.astype(share.dtype), total), 1.0)
    looks = looks / (1 + jnp.maximum(looks - 1, 0.0) * correlation)
    inside = jnp.clip(jnp.where(sound, share, 0.5), 0.0, 1.0) * looks
    # 1 - I_{1/2}(a, b) = I_{1/2}(b, a), without the cancellation.
    return jnp.where(sound, betainc(1 + looks - inside, 1 + inside, 0.5), 0.0)
