"""The room that tile lists have by default: enough for what is ordinary, told where it is not, one for all views."""

import jax
import numpy as np
import pytest
from conftest import gaussians_at
from reference import render_reference

from jsecon.field.evidence import region_votes
from jsecon.parallel import host_mesh
from jsecon.query.selection_masks import selection_mask
from jsecon.splat.capacity import default_capacity
from jsecon.splat.plan import prepare_views, render_plan
from jsecon.splat.render import render, render_depth
from jsecon.types import Gaussians

COVERING = 1100
"""Gaussians of `covering`: with four blocks in the image, 4,400 pairs"""


@pytest.fixture(scope="module")
def covering() -> Gaussians:
    """Faint Gaussians, each of which covers the whole image of any camera of the ring, all at other depths."""
    rng = np.random.default_rng(4)
    means, turns = rng.uniform(-0.3, 0.3, (COVERING, 3)), rng.normal(size=(COVERING, 4))
    return gaussians_at(means, np.exp(1.5), turns=turns, logit=rng.uniform(-4.8, -4.0, COVERING))


def features_of(count, channels=3):
    return np.random.default_rng(1).normal(size=(count, channels)).astype(np.float32)


@pytest.mark.parametrize("mesh", [None, pytest.param(host_mesh(), marks=pytest.mark.long)])
def test_what_exceeds_it_is_rendered_with_enough_outside_a_trace_and_counted_inside(covering, camera, mesh):
    features = features_of(COVERING)
    pairs, room = 4 * COVERING, default_capacity(COVERING, 48, 40, strips=1 if mesh is None else 2)
    assert room < pairs
    rendering = render(covering, camera, features, mesh=mesh)
    expected, alpha = render_reference(covering, camera, features)
    assert int(rendering.overflow) == 0
    np.testing.assert_allclose(rendering.features, expected, atol=2e-4)
    np.testing.assert_allclose(rendering.alpha, alpha, atol=2e-4)
    inside = jax.jit(lambda g: render(g, camera, features, mesh=mesh).overflow)(covering)
    assert int(inside) == pairs - room


def test_depth_that_lacks_something_is_no_number(covering, camera):
    depth, alpha = render_depth(covering, camera)
    assert np.isfinite(depth).all()
    assert np.isfinite(alpha).all()
    depth, alpha = jax.jit(lambda g: render_depth(g, camera))(covering)
    assert np.isnan(depth).all()
    assert np.isnan(alpha).all()


def test_plans_and_votes_hold_what_exceeds_it(covering, cameras):
    pair = jax.tree.map(lambda a: a[:2], cameras)
    plans = prepare_views(covering, pair)
    assert np.asarray(plans.overflow).tolist() == [0, 0]
    features, weight = features_of(COVERING), 0.0
    for t in range(2):
        one = render_plan(jax.tree.map(lambda a, t=t: a[t], plans), features)
        np.testing.assert_allclose(one.features, render_reference(covering, pair[t], features)[0], atol=2e-4)
        weight += np.asarray(one.alpha).sum()
    assert prepare_views(covering, pair, max_bytes=1000) is None

    labels = np.zeros((2, 40, 48), np.int32)
    votes = region_votes(covering, pair, labels, 1)
    assert int(votes.overflow) == 0
    np.testing.assert_allclose(np.asarray(votes.total).sum(), weight, rtol=1e-4)
    inside = jax.jit(lambda seen: region_votes(covering, pair, seen, 1))(labels)
    assert int(inside.overflow) == 2 * (4 * COVERING - default_capacity(COVERING, 48, 40))


def test_one_program_serves_all_views_and_selections_of_a_size(scene, cameras):
    some = jax.tree.map(lambda a: a[:61], scene)  # a count that no other test has

    def look(t):
        render(some, cameras[t], features_of(some.count))
        selection_mask(some, cameras[t], np.arange(some.count) % (t + 2) == 0)
        region_votes(some, cameras[t : t + 1], np.full((1, 40, 48), t % 2, np.int32), 2, near=0.01 * (t + 1))

    compiled: list[str] = []

    def count(event: str, *_: object, **__: object) -> None:
        compiled.extend([event] * event.endswith("backend_compile_duration"))

    jax.monitoring.register_event_duration_secs_listener(count)
    look(0)
    before = len(compiled)
    assert before > 0
    for t in range(1, 4):
        look(t)
    assert len(compiled) == before
