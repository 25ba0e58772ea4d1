import jax
import numpy as np
import pytest
from small_field import unit_rows

from experiments.tables.codes import (
    CODE_THRESHOLD,
    LATENTS,
    Rotation,
    Spread,
    confused_pairs,
    encode,
    principal_rotation,
    region_codes,
    spread_codes,
)
from jsecon.paper.autoencoder import Autoencoder

KEY = jax.random.key(0)


def unit_rows_of(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def crowded(count, size=64, common=2.0, seed=0):
    """Unit rows with much in common, as CLIP's are: cosines around common^2 / (1 + common^2)."""
    rng = np.random.default_rng(seed)
    return unit_rows_of(common * unit_rows(rng, 1, size) + unit_rows(rng, count, size))


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


def test_an_autoencoder_where_regions_do_not_fit_and_what_is_refused():
    embeddings = unit_rows(np.random.default_rng(0), 12, 40)
    codes, coder, reason = region_codes(embeddings, latent=3, key=KEY, epochs=50)
    assert isinstance(coder, Autoencoder)
    assert reason.startswith("run")
    np.testing.assert_allclose(encode(coder, embeddings), codes, atol=1e-6)
    with pytest.raises(ValueError, match="not finite"):
        region_codes(np.full((3, 40), np.inf, np.float32), latent=3, key=KEY)
    for latent in (0, "some"):
        with pytest.raises(ValueError, match="region_codes"):
            region_codes(np.eye(4, dtype=np.float32), latent=latent, key=KEY)


@pytest.mark.parametrize(("count", "latent"), [(40, 3), pytest.param(300, 6, marks=pytest.mark.long)])
def test_spread_codes_keep_crowded_regions_apart_where_a_rotation_does_not(count, latent):
    units = crowded(count)
    assert confused_pairs(units, principal_rotation(units, latent).encode(units)) > count
    codes = spread_codes(units, latent)
    assert codes.shape == (count, latent)
    np.testing.assert_allclose(np.linalg.norm(codes, axis=1), 1, atol=1e-5)
    assert confused_pairs(units, codes) == 0
    np.testing.assert_array_equal(codes, spread_codes(units, latent))  # nothing is drawn


def test_spread_codes_of_twins_and_of_the_unknown():
    units = crowded(20)
    units[7], units[9] = units[3], 0
    codes = np.asarray(spread_codes(units, 4))
    assert codes[3] @ codes[7] > CODE_THRESHOLD  # one thing seen twice
    assert (codes[9] == 0).all()
    coder = Spread(units, codes)
    assert (np.asarray(coder.encode(np.zeros(64, np.float32))) == 0).all()
    for few in (0, 2):
        some = np.asarray(spread_codes(units[:few], 3))
        assert some.shape == (few, 3)
        assert np.isfinite(some).all()
    assert (np.asarray(spread_codes(np.zeros((3, 8), np.float32), 3)) == 0).all()


def test_auto_takes_the_smallest_code_that_keeps_regions_apart():
    few = unit_rows(np.random.default_rng(0), 5, 64)
    codes, coder, why = region_codes(few, latent="auto", key=KEY)
    assert codes.shape == (5, LATENTS[0])
    assert not confused_pairs(few, codes)
    many = crowded(100)
    codes, coder, why = region_codes(many, latent="auto", key=KEY)
    size = codes.shape[1]
    assert not confused_pairs(many, codes)
    assert f"{size} numbers" in why
    assert isinstance(coder, Rotation | Spread)
    np.testing.assert_array_equal(codes, region_codes(many, latent="auto", key=KEY)[0])
    for smaller in (latent for latent in LATENTS if latent < size):
        assert confused_pairs(many, principal_rotation(many, smaller).encode(many))
        assert confused_pairs(many, spread_codes(many, smaller))
    short = unit_rows(np.random.default_rng(0), 40, 2)  # no size tried is smaller than two numbers
    codes, coder, why = region_codes(short, latent="auto", key=KEY)
    assert coder is None
