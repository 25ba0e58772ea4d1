"""All silhouettes in one walk against each group rendered alone, the others deleted."""

import jax
import jax.numpy as jnp
import numpy as np
from balls import ring_of_balls

from experiments.rivals.leaves import silhouette_overlaps
from jsecon.query.render import selection_mask
from jsecon.splat.plan import plan_view

GROUPS, SLOTS = 8, 4


def test_overlaps_are_those_of_each_group_rendered_alone():
    gaussians, cameras, _, truth, _ = ring_of_balls()
    gaussians, camera = jax.tree.map(jnp.asarray, (gaussians, cameras[3]))
    draw = np.random.default_rng(0)
    # Groups that occlude themselves, some Gaussians of none, one group of nobody.
    group_of = np.where(draw.random(gaussians.count) < 0.1, -1, np.arange(gaussians.count) * 7 // gaussians.count)
    plan, ids = plan_view(gaussians, camera), truth[3] - (truth[3] == 2)
    for threshold in (0.8, 0.3):
        both, area, pixels = silhouette_overlaps(
            plan, jnp.asarray(group_of), jnp.asarray(ids), threshold, groups=GROUPS, slots=SLOTS
        )
        for group in range(GROUPS):
            alone = np.asarray(selection_mask(gaussians, camera, jnp.asarray(group_of == group), threshold=threshold))
            # A pixel whose alpha is the threshold to the last bits may fall to either side.
            np.testing.assert_allclose(area[group], alone.sum(), atol=1)
            np.testing.assert_allclose(both[group], [(alone & (ids == k)).sum() for k in range(SLOTS)], atol=1)
        assert np.asarray(area[:7]).min() > 20
        assert area[7] == 0
    np.testing.assert_array_equal(pixels, [(ids == k).sum() for k in range(SLOTS)])
