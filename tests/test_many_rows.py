"""What computes on many rows, as it ships, under jit and vmap, against NumPy in float64, where jax was silently wrong
in float32 (its issue 39103: about 32,769 to 43,000 rows; in float64 from 16,385 on).

The definitions that results are compared with are those of the files that test each function itself. In every run
test_numerics.py has the products that all of them are made of at such a size.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_autoencoder as of_autoencoder
import test_classes as of_classes
import test_distill as of_distill
import test_retrieval as of_retrieval
import test_shares as of_shares
from conftest import gaussians_at, look_at
from small_field import shares, unit_rows
from test_direct import exact_cosines, exact_relevancy

from jsecon.field.membership import _add_visible_weight, _with_overlap, inside_fraction
from jsecon.paper.autoencoder import encode
from jsecon.paper.distill import distill_votes
from jsecon.paper.queries import query_canonical, query_one_step, select_by_code
from jsecon.query.answer import match_regions, query_anchored
from jsecon.query.classes import query_classes
from jsecon.query.match import region_similarities
from jsecon.query.rules import QueryRules
from jsecon.splat.project import project
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Camera, Codes

pytestmark = [pytest.mark.as_shipped, pytest.mark.long]

COUNT = 40_000


def normal(*shape):
    return np.random.default_rng(shape).normal(size=shape).astype(np.float32)


def compiled(function, batch, *given):
    """function(one of the batch, *given) for all of a batch, in one program."""
    return jax.jit(jax.vmap(function, in_axes=(0, *(None for _ in given))))(batch, *given)


def test_one_step():
    codes, texts = normal(COUNT, 3), normal(2, 3)
    expected = np.stack([exact_cosines(codes, text) for text in texts])
    found = compiled(lambda text, codes: query_one_step(codes, text, 0.5), texts, codes)
    np.testing.assert_allclose(found.similarity, expected, atol=1e-6)
    np.testing.assert_allclose(found.score, expected.max(axis=1), atol=1e-6)
    clear = np.abs(expected - 0.5) > 1e-5
    assert (np.asarray(found.mask) == (expected >= 0.5))[clear].all()


def test_canonical():
    features, texts, phrases = normal(COUNT, 8), normal(2, 8), normal(4, 8)
    expected = np.stack([exact_relevancy(features, text, phrases) for text in texts])

    def ask(text, features, phrases):
        return query_canonical(features, text, phrases, 0.5)

    found = compiled(ask, texts, features, phrases)
    np.testing.assert_allclose(found.similarity, expected, atol=3e-6)
    clear = np.abs(expected - 0.5) > 1e-5
    assert (np.asarray(found.mask) == (expected >= 0.5))[clear].all()


@pytest.fixture
def field():
    """Random votes and codes for six regions."""
    made = of_classes.made_field(COUNT)
    rng = np.random.default_rng(1)
    return dataclasses.replace(made, codes=Codes(unit_rows(rng, COUNT, 4), unit_rows(rng, made.regions.count, 4), None))


def test_anchored(field):
    asked = np.array([0, 3])
    texts = field.regions.embeddings[asked]
    ask = {"rules": QueryRules(retrieval="cosine", duplicate_cosine=None, fragment_score=None)}
    by_votes = compiled(lambda text, field: query_anchored(field, text, **ask).similarity, texts, field)
    by_code = compiled(
        lambda text, field: select_by_code(field, match_regions(field, text[None], ask["rules"])).similarity,
        texts,
        field,
    )
    for n, region in enumerate(asked):
        np.testing.assert_allclose(by_votes[n], shares(field, [region]).clip(max=1), atol=1e-6)
        np.testing.assert_allclose(
            by_code[n], exact_cosines(field.codes.gaussians, field.codes.regions[region]), atol=1e-6
        )


def test_classes_of_all(field):
    sets = unit_rows(np.random.default_rng(2), 10, of_classes.SIZE).reshape(2, 5, -1)
    rules = QueryRules(retrieval="cosine", min_score=-1.0)
    ask = {"rules": rules, "standardise": False, "every": True}
    labels, found = compiled(lambda texts, field: query_classes(field, texts, **ask), sets, field)
    rows = np.unique(np.linspace(0, COUNT - 1, 2_000).astype(int))
    few = dataclasses.replace(
        field, votes=jax.tree.map(lambda a: np.asarray(a)[rows] if np.ndim(a) else a, field.votes)
    )
    for n, texts in enumerate(sets):
        similarity = np.asarray(field.regions.embeddings, np.float64) @ texts.T
        expected, _ = of_classes.exact(few, similarity, -1.0)
        np.testing.assert_allclose(found[n][rows], expected, atol=2e-6)
        ordered = np.sort(expected, axis=1)
        clear = ordered[:, -1] - ordered[:, -2] > 1e-5
        np.testing.assert_array_equal(np.asarray(labels)[n][rows][clear], expected.argmax(1)[clear])


def test_similarities_of_many_regions():
    rng = np.random.default_rng(3)
    embeddings, texts, words = (unit_rows(rng, n, of_retrieval.SIZE) for n in (COUNT, 3, 4))

    def ask(text, embeddings, words):
        return region_similarities(embeddings, text, words, "contrast")

    found, known = compiled(ask, texts, embeddings, words)
    assert np.asarray(known).all()
    for n, text in enumerate(texts):
        np.testing.assert_allclose(found[n], of_retrieval.exact(embeddings, text, words), atol=5e-6)


@pytest.mark.parametrize("shown", [True, False])
def test_shares(shown):
    votes = jax.tree.map(jnp.asarray, of_shares.known_votes(COUNT, shown=shown))
    chosen = np.random.default_rng(1).random((3, of_shares.REGIONS)) < 0.5
    found = compiled(lambda one, votes: inside_fraction(votes, one), chosen, votes)
    rows = np.unique(np.linspace(0, COUNT - 1, 2_000).astype(int))
    few = jax.tree.map(lambda a: a if a.ndim == 0 else np.asarray(a)[rows], votes)
    for n, one in enumerate(chosen):
        np.testing.assert_allclose(found.fraction[n][rows], of_shares.exact_share(few, one), atol=1e-6)


def test_shown_and_overlap():
    votes, regions = of_shares.cast(COUNT)
    found = _add_visible_weight(votes, regions)
    np.testing.assert_allclose(
        found.weight_where_region_visible, of_shares.exact_shown(votes, regions), rtol=1e-5, atol=1e-6
    )
    np.testing.assert_allclose(_with_overlap(found).overlap, of_shares.exact_overlap(found), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("reduce", ["median", "mean", "mode"])
def test_reductions_of_votes(reduce):
    rng = np.random.default_rng(0)
    small, tables = of_distill.random_votes(rng, 100, 4, 8), np.stack([unit_rows(rng, 8, 3) for _ in range(2)])
    rows = np.arange(COUNT) % 100
    votes = jax.tree.map(lambda a: a[rows] if np.ndim(a) else a, small)
    found = compiled(lambda table, votes: distill_votes(votes, table, reduce), tables, votes)
    for n, table in enumerate(tables):
        np.testing.assert_allclose(found[n], of_distill.exact(small, table, reduce)[rows], atol=3e-5)


def test_encode():
    many = unit_rows(np.random.default_rng(1), COUNT, 12)
    rng = np.random.default_rng(3)

    def drawn(leaf):
        return rng.uniform(0.1, 0.2, leaf.shape).astype(np.float32) * rng.choice([-1, 1], leaf.shape)

    coder = jax.tree.map(drawn, of_autoencoder.shapes_of(12, 3))
    for moments in coder.encoder["batch_stats"].values():
        moments["var"] = abs(moments["var"])
    expected = of_autoencoder.encoded(coder, many)
    np.testing.assert_allclose(compiled(lambda row, coder: encode(coder, row), many, coder), expected, atol=1e-3)


@pytest.fixture
def cloud():
    """Gaussians in a cube, and a camera before it."""
    rng = np.random.default_rng(COUNT)
    means, sizes = rng.uniform(-1, 1, (COUNT, 3)), rng.uniform(0.01, 0.1, (COUNT, 3))
    turns, logit, sh = (rng.normal(size=(COUNT, *rest)) for rest in ((4,), (), (4, 3)))
    gaussians = gaussians_at(means, sizes, turns=turns, logit=logit, sh=sh)
    lens = (np.float32(number) for number in (300, 310, 160, 120))
    return gaussians, Camera(look_at((0.3, -0.5, -3.0)), *lens, 320, 240)


def test_projection(cloud):
    gaussians, camera = cloud
    pose = np.asarray(camera.world_to_camera, np.float64)
    inside = gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    expected = inside[:, :2] / inside[:, 2:] * [300, 310] + [160, 120]
    views = jax.tree.map(lambda a: np.asarray(a)[None], camera)
    found = compiled(lambda view, gaussians: project(gaussians, view), views, gaussians)
    np.testing.assert_allclose(found.means_px[0], expected, rtol=1e-4, atol=2e-3)
    np.testing.assert_allclose(found.depths[0], inside[:, 2], rtol=1e-5)


def test_colours(cloud):
    gaussians, camera = cloud
    x, y, z = (away := gaussians.means - np.asarray(camera.centres, np.float64)).T / np.linalg.norm(away, axis=1)
    basis = 0.28209479177387814 * np.ones_like(x), *(0.4886025119029199 * np.stack([-y, z, -x]))
    expected = np.maximum(np.einsum("kn,nkc->nc", np.stack(basis), gaussians.sh) + 0.5, 0)
    np.testing.assert_allclose(jax.jit(colours_from_sh)(gaussians, camera), expected, atol=2e-6)
