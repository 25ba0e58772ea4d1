"""The autoencoder: LangSplat's layers, against NumPy in float64."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import MANY
from jax.test_util import check_grads
from small_field import crowded, unit_rows

from jsecon.numerics import cosine
from jsecon.paper.autoencoder import decode, encode, train_autoencoder

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def trained():
    embeddings = crowded(np.random.default_rng(0), 65, 48, common=1.25)
    calls = []
    coder = train_autoencoder(embeddings, latent=3, key=KEY, epochs=300, progress=lambda *done: calls.append(done))
    return embeddings, coder, calls


def shapes_of(size, latent):
    """Shapes only: tracing is enough, so nothing is compiled."""
    embeddings = unit_rows(np.random.default_rng(0), 3, size)

    def train(key):
        return train_autoencoder(embeddings, latent=latent, key=key, epochs=1)

    return jax.eval_shape(train, KEY)


def test_layers_are_langsplats_and_wider_latents_are_no_bottleneck():
    coder, wide = shapes_of(512, 3), shapes_of(50, 40)
    inward, outward = (variables["params"] for variables in (coder.encoder, coder.decoder))
    assert [inward[f"Dense_{n}"]["kernel"].shape[1] for n in range(5)] == [256, 128, 64, 32, 3]
    assert [outward[f"Dense_{n}"]["kernel"].shape[0] for n in range(7)] == [3, 16, 32, 64, 128, 256, 256]
    assert set(coder.encoder["batch_stats"]) == {f"BatchNorm_{n}" for n in range(4)}  # all but the last
    kernels = [
        leaf for leaf in jax.tree.leaves((wide.encoder["params"], wide.decoder["params"])) if len(leaf.shape) == 2
    ]
    assert min(kernel.shape[1] for kernel in kernels) >= 40


def test_regions_come_back_from_three_numbers(trained):
    embeddings, coder, calls = trained
    codes = encode(coder, embeddings)
    back = decode(coder, codes)
    np.testing.assert_allclose(np.linalg.norm(codes, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1, atol=1e-5)
    nearest = np.argmax(np.asarray(back) @ embeddings.T, axis=1)
    assert (nearest == np.arange(65)).mean() >= 0.95
    common = float(cosine(jnp.asarray(embeddings), jnp.mean(embeddings, axis=0, keepdims=True)).mean())
    assert float(cosine(back, jnp.asarray(embeddings)).mean()) > common + 0.5 * (1 - common)
    assert calls[-1] == (300, 300)


def encoded(coder, x):
    """The codes of rows (..., E) in float64."""
    variables, x = jax.tree.map(lambda a: np.asarray(a, np.float64), coder.encoder), x.astype(np.float64)
    layers, stats = variables["params"], variables["batch_stats"]
    for n in range(len(stats)):
        layer, norm, moments = layers[f"Dense_{n}"], layers[f"BatchNorm_{n}"], stats[f"BatchNorm_{n}"]
        x = x @ layer["kernel"] + layer["bias"]
        x = (x - moments["mean"]) / np.sqrt(moments["var"] + 1e-5) * norm["scale"] + norm["bias"]
        x = np.maximum(x, 0)
    last = layers[f"Dense_{len(stats)}"]
    x = x @ last["kernel"] + last["bias"]
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def test_forward_pass_equals_numpy_float64(trained):
    embeddings, coder, _ = trained
    codes = encoded(coder, embeddings)
    np.testing.assert_allclose(encode(coder, embeddings), codes, atol=2e-4)
    x = codes
    layers = jax.tree.map(lambda a: np.asarray(a, np.float64), coder.decoder["params"])
    for n in range(len(layers)):
        layer = layers[f"Dense_{n}"]
        x = (np.maximum(x, 0) if n else x) @ layer["kernel"] + layer["bias"]
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    np.testing.assert_allclose(decode(coder, codes.astype(np.float32)), x, atol=1e-5)


@pytest.mark.parametrize("count", [400, MANY])
def test_one_vector_a_batch_a_vmap_and_a_jit_agree(trained, count):
    embeddings, coder, _ = trained
    many = np.resize(embeddings[:40], (count, 48))
    codes = encode(coder, many)
    np.testing.assert_allclose(codes, np.resize(codes[:40], codes.shape), atol=1e-6)
    np.testing.assert_allclose(codes[:40], encoded(coder, embeddings[:40]), atol=2e-4)
    np.testing.assert_allclose(jax.jit(jax.vmap(lambda row: encode(coder, row)))(many), codes, atol=1e-5)
    np.testing.assert_allclose(encode(coder, embeddings[7]), codes[7], atol=1e-5)
    np.testing.assert_allclose(decode(coder, codes[7]), decode(coder, codes)[7], atol=1e-5)
    np.testing.assert_allclose(jax.jit(encode)(coder, 1e30 * embeddings[:40]), codes[:40], atol=1e-5)


def test_zero_is_unknown_nan_stays_nan_and_codes_of_other_sizes_are_told(trained):
    _, coder, _ = trained
    codes = np.asarray(encode(coder, np.float32([[0.0] * 48, [np.nan] * 48])))
    assert (codes[0] == 0).all()
    assert np.isnan(codes[1]).all()
    with pytest.raises(ValueError, match=r"\.\.\., 48"):
        encode(coder, np.ones((2, 47), np.float32))
    with pytest.raises(ValueError, match=r"\.\.\., 3"):
        decode(coder, np.ones((2, 4), np.float32))


def test_gradients_are_those_of_finite_differences(trained):
    embeddings, coder, _ = trained
    with jax.enable_x64(True):
        coder, rows = jax.tree.map(lambda a: jnp.asarray(a, jnp.float64), (coder, embeddings[:3]))

        def back(rows, bias):
            params = coder.decoder["params"]
            changed = {"params": params | {"Dense_6": params["Dense_6"] | {"bias": bias}}}
            return decode(dataclasses.replace(coder, decoder=changed), encode(coder, rows))

        given = rows, coder.decoder["params"]["Dense_6"]["bias"]
        check_grads(jax.jit(back), given, order=1, modes=["rev"], eps=1e-6, rtol=1e-4)


def test_what_cannot_be_trained_on_is_told():
    none = {"all zero": np.zeros((4, 8)), "0 rows": np.zeros((0, 8)), "not finite": np.full((2, 8), np.nan)}
    for match, rows in none.items():
        with pytest.raises(ValueError, match=match):
            train_autoencoder(rows.astype(np.float32), latent=3, key=KEY)
    good = unit_rows(np.random.default_rng(0), 4, 8)
    for options in ({"latent": 0}, {"latent": 3, "epochs": 0}):
        with pytest.raises(ValueError, match="train_autoencoder"):
            train_autoencoder(good, key=KEY, **options)
