import jax
import numpy as np
import pytest
from small_field import crowded, unit_rows

from experiments.tables.codes import (
    CODE_THRESHOLD,
    Rotation,
    Spread,
    confused_pairs,
    encode,
    principal_rotation,
    region_codes,
    spread_codes,
)

KEY = jax.random.key(0)


def test_no_coder_where_embeddings_are_short():
    embeddings = 2 * unit_rows(np.random.default_rng(0), 9, 6)
    codes, coder, reason = region_codes(embeddings, latent=6, key=KEY)
    assert coder is None
    np.testing.assert_allclose(codes, embeddings / 2, atol=1e-6)
    np.testing.assert_allclose(encode(coder, embeddings), codes, atol=1e-6)
    assert "left out" in reason


@pytest.mark.parametrize(("regions", "latent"), [(0, 3), (2, 3), (5, 16)])
def test_a_rotation_keeps_every_cosine(regions, latent):
    embeddings = unit_rows(np.random.default_rng(regions), regions, 512)
    codes, coder, reason = region_codes(embeddings, latent=latent, key=KEY)
    assert isinstance(coder, Rotation)
    assert "without loss" in reason
    assert codes.shape == (regions, latent)
    np.testing.assert_allclose(np.asarray(codes) @ np.asarray(codes).T, embeddings @ embeddings.T, atol=2e-6)
    np.testing.assert_allclose(encode(coder, embeddings), codes, atol=1e-6)


@pytest.mark.parametrize(("count", "latent"), [(40, 3), pytest.param(300, 6, marks=pytest.mark.long)])
def test_spread_codes_keep_crowded_regions_apart_where_a_rotation_does_not(count, latent):
    units = crowded(np.random.default_rng(0), count, 64, common=2.0)
    units[7], units[9] = units[3], 0
    assert confused_pairs(units, principal_rotation(units, latent).encode(units)) > count
    codes = np.asarray(spread_codes(units, latent))
    known = np.arange(count) != 9
    np.testing.assert_allclose(np.linalg.norm(codes[known], axis=1), 1, atol=1e-5)
    assert not codes[9].any()
    assert codes[3] @ codes[7] > CODE_THRESHOLD  # one thing seen twice
    assert confused_pairs(units, codes) == 0
    assert not np.asarray(Spread(units, codes).encode(np.zeros(64, np.float32))).any()
