"""The check of the backend."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

import jsecon
import jsecon.backend as backend
from jsecon.numerics import FULL_PRECISION, cosine_matrix
from jsecon.paper.autoencoder import encode, train_autoencoder

pytestmark = pytest.mark.as_shipped


def test_our_forms_are_right_here():
    assert 0 < backend.check_backend() < 1e-5


def test_wrong_cosines_raise(monkeypatch):
    monkeypatch.setattr(backend, "cosine_matrix", lambda f, t: f @ t.T)
    with pytest.raises(RuntimeError, match="cosines are off"):
        backend.check_backend()


def products(jaxpr):
    """The precisions of all products of matrices in a program, those of the programs inside it too."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation.params["precision"]
        for inner in jaxprs_in_params(equation.params):
            yield from products(inner)


def test_no_product_of_matrices_is_left_to_the_device(scene, cameras):
    """A GPU keeps 10 bits of a factor that nobody asks it to keep whole."""
    rows = jnp.ones((9, 40))
    coder = train_autoencoder(rows, latent=5, key=jax.random.key(0), epochs=1)

    def image(g, c, f):
        return (jsecon.render(g, c[0], f, capacity=4096).features ** 2).sum()

    programs = {
        "cosines": lambda *_: cosine_matrix(rows, rows),
        "code": lambda *_: encode(coder, rows),
        "gradients": lambda g, c, _: jax.grad(image, argnums=(0, 2))(g, c, jnp.ones((64, 40))),
        "votes": lambda g, c, x: jsecon.region_votes(g, c, x, 3, capacity=4096).weights,
    }
    labels = np.zeros((4, cameras.height, cameras.width), np.int32)
    for name, program in programs.items():
        found = list(products(jax.make_jaxpr(program)(scene, cameras, labels).jaxpr))
        assert found, name
        assert set(found) == {(FULL_PRECISION, FULL_PRECISION)}, (name, found)
