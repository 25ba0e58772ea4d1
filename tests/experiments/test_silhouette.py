"""The ascent of the expected IoU: against a slow twin, against real renderings, and on a thing with a blurred rim."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.protocols.rendered import VALA_THRESHOLD
from experiments.tables.silhouette import SWEEPS, WEIGHTS, Footprints, ascend
from jsecon.query.selection_masks import ALPHA_THRESHOLD


def made_up(seed, count=14, tiles=40, views=2):
    rng = np.random.default_rng(seed)
    pairs = rng.integers(0, 20, count)  # some Gaussians are seen nowhere, some fill more than one block
    starts = np.concatenate([[0], np.cumsum(pairs)]).astype(np.int32)
    room = starts[-1] + 16
    absorbed = (rng.exponential(0.4, (room, 64)) * (rng.random((room, 64)) < 0.4)).astype(np.float32)
    place = np.full(room, tiles, np.int32)
    place[: starts[-1]] = np.concatenate([rng.permutation(tiles)[:n] for n in pairs])
    inside = rng.random((tiles + 1, 64)).astype(np.float32) ** 2
    there = np.ones_like(inside)
    inside[-1] = there[-1] = 0
    base = np.zeros_like(inside)
    return Footprints(absorbed, place, starts, inside, there - inside, base), views, rng.random(count) < 0.5


def slow_twin(found, views, taken, weights):
    """Every value from the beginning, in float64."""
    taken, tiles = taken.copy(), (len(found.inside) - 1) // views

    def value(taken):
        level = np.array(found.base, np.float64)
        for c in np.flatnonzero(taken):
            own = slice(found.starts[c], found.starts[c + 1])
            np.add.at(level, found.tiles[own], found.absorbed[own])
        whole = 0.0
        for v in range(views):
            part = slice(v * tiles, (v + 1) * tiles)
            for weight, threshold in zip(weights, (ALPHA_THRESHOLD, VALA_THRESHOLD), strict=True):
                hit = level[part] > -np.log1p(-threshold)
                covered, spilt = (image[part].astype(np.float64)[hit].sum() for image in (found.inside, found.outside))
                whole += weight * covered / (found.inside[part].astype(np.float64).sum() + spilt)
        return whole

    for _ in range(SWEEPS):
        for c in range(len(taken)):
            other = taken.copy()
            other[c] ^= True
            if value(other) > value(taken) + 1e-6:
                taken = other
    return taken


@pytest.mark.parametrize("seed", range(4))
def test_equals_the_slow_twin(seed):
    found, views, taken = made_up(seed)
    weights = WEIGHTS if seed else (0.0, 1.0)
    got = np.asarray(ascend(found, jnp.asarray(taken), views, len(taken), jnp.asarray(weights)))
    np.testing.assert_array_equal(got, slow_twin(found, views, taken, weights))
