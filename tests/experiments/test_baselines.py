"""Each baseline does what its own idea promises: trained on perfect masks that agree, it finds each ball by text."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from balls import HEIGHT, WIDTH, ring_of_balls
from reference import weights_reference
from twin_files import evidence_of_tracks

from experiments.baselines import lifting
from experiments.baselines.evidence import local_masks
from experiments.baselines.gaussian_grouping import query_gaussian_grouping, train_gaussian_grouping
from experiments.baselines.langsplat import train_langsplat
from experiments.baselines.opengaussian import Schedule, train_opengaussian
from experiments.datasets.ovs3d import box_of
from experiments.protocols.opengaussian import most_similar_text, select_leaf, select_text
from experiments.simulated_vision.embeddings import made_text_space
from jsecon import InputError, plan_view
from jsecon.evaluate.lerf import evaluate_labels
from jsecon.read.masks.labels import LabelledFrame
from jsecon.vision.protocols import CANONICAL

QUERIES = ("floor", "red ball", "blue ball", "green ball")
TRAINED, SHOWN = np.arange(0, 24, 4), np.array([1, 10])


@pytest.fixture(scope="module")
def world():
    """(evidence, labelled views nothing learnt from, texts (4, E), canonical (4, E))"""
    gaussians, cameras, _, truth, _ = ring_of_balls()
    gaussians, cameras = jax.tree.map(jnp.asarray, (gaussians, cameras))
    space = made_text_space([*QUERIES, *CANONICAL], dim=128).vectors
    texts, canonical = space[:4], space[4:]
    embeddings = np.broadcast_to(texts, (len(TRAINED), *texts.shape))
    evidence = evidence_of_tracks(gaussians, cameras[TRAINED], truth[TRAINED], embeddings)
    frames = []
    for t in SHOWN:
        masks = {name: truth[t] == k for k, name in enumerate(QUERIES) if k and (truth[t] == k).sum() >= 40}
        boxed = {name: (mask, box_of(mask)) for name, mask in masks.items()}
        frames.append(LabelledFrame(f"view {t}", WIDTH, HEIGHT, boxed))
    views = {f"view {t}": cameras[int(t)] for t in SHOWN}
    return evidence, frames, views, jnp.asarray(texts), jnp.asarray(canonical)


def miou(world, select):
    evidence, frames, views, *_ = world
    _, told = evaluate_labels(evidence.gaussians, views, frames, lambda query: select(QUERIES.index(query)))
    assert told["pairs"] == sum(len(frame.objects) for frame in frames) >= 4
    return told["miou"]


def by_most_similar_text(world, features):
    labels, cosines = most_similar_text(jnp.asarray(features), world[3])
    return miou(world, lambda query: select_text(labels, cosines, query))


@pytest.mark.long
def test_langsplat(world):
    model = train_langsplat(world[0], key=jax.random.key(0), steps=100, epochs=300)
    assert np.isfinite(model.history).all()
    assert model.history[-20:].mean() < 0.7 * model.history[:3].mean()
    assert by_most_similar_text(world, model.features()) >= 0.6


@pytest.mark.long
def test_gaussian_grouping(world):
    evidence, _, _, texts, canonical = world
    model, history = train_gaussian_grouping(
        evidence, key=jax.random.key(0), steps=100, identity_rate=0.05, classifier_rate=0.02, classes=32
    )
    assert history[-20:].mean() < 0.7 * history[:5].mean()

    def ask(query):
        return query_gaussian_grouping(model, evidence, texts[query], canonical)

    assert miou(world, ask) >= 0.6
    # What the first view does not show can't be found.
    hidden = np.asarray(evidence.frame) == 0
    blind = dataclasses.replace(evidence, embeddings=np.where(hidden[:, None], canonical[0], evidence.embeddings))
    nothing = query_gaussian_grouping(model, blind, texts[1], canonical)
    assert not np.asarray(nothing.mask).any()
    assert int(nothing.region) == -1
    many = dataclasses.replace(evidence, tracks=np.asarray(evidence.tracks) + 260)
    with pytest.raises(InputError, match="at most 255"):
        train_gaussian_grouping(many, key=jax.random.key(0), steps=1)


SCHEDULE = Schedule(instance_steps=100, coarse_steps=20, fine_steps=20, roots=8, leaves=3, min_views=3, rate=0.05)


@pytest.mark.long
def test_opengaussian(world):
    model, history = train_opengaussian(world[0], key=jax.random.key(0), schedule=SCHEDULE)
    assert np.isfinite(history).all()
    assert history[-20:].mean() < history[:5].mean()

    def ask(query):
        return select_leaf(
            model.leaf_features, model.leaf_codes, model.leaf_of, world[3][query], siblings=model.siblings
        )

    assert miou(world, ask) >= 0.6
    leaf_of = np.asarray(model.leaf_of)
    assert leaf_of.max() < 24
    unmatched = np.asarray(model.matches) < 3
    assert not np.asarray(model.leaf_features)[unmatched].any()


@pytest.mark.parametrize("train", [lifting.train_occam, lifting.train_backprojection, lifting.train_vala])
def test_lifting(world, train):
    lifted = train(world[0])
    length = np.linalg.norm(lifted.features, axis=1)
    assert (np.isclose(length, 1, atol=1e-5) | (length == 0)).all()
    assert by_most_similar_text(world, lifted.features) >= 0.6
    evidence, _, _, texts, canonical = world

    def ask(query):
        return lifting.query_relevancy(lifted.features, evidence.gaussians.means, texts[query], canonical)

    assert miou(world, ask) >= 0.6


def test_backprojection_is_the_sum_over_all_pixels(world):
    """Against the votes' own total: every labelled pixel's weight is in it, once."""
    from jsecon.field.evidence import region_votes

    evidence = world[0]
    lifted = lifting.train_backprojection(evidence)
    votes = region_votes(evidence.gaussians, evidence.cameras, jnp.asarray(evidence.tracks), 4)
    np.testing.assert_allclose(np.asarray(lifted.weights.sum(1)).ravel(), votes.labelled, rtol=1e-4, atol=1e-4)


def test_centre_weights_are_the_renderers(scene, camera):
    """Those of the float64 twin at the pixel that holds the centre."""
    plan = plan_view(scene, camera)
    weight, pixel = (np.asarray(a) for a in lifting.centre_weights(plan))
    splats = np.asarray(plan.splats)
    x, y = np.floor(splats[:, :2]).astype(int).T
    inside = (splats[:, 5] > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    np.testing.assert_array_equal(pixel, np.where(inside, y * camera.width + x, -1))
    expected = weights_reference(scene, camera).reshape(-1, scene.count)[pixel, np.arange(scene.count)]
    np.testing.assert_allclose(weight, np.where(inside, expected, 0), atol=2e-4)
    assert (weight > 0.01).sum() > 10


def test_the_gate_keeps_the_heaviest():
    weight = np.concatenate([np.linspace(0.2, 0.9, 30), np.linspace(0, 0.12, 50)])
    kept = lifting.gate(weight)
    assert not kept[weight < 0.13].any()
    assert kept.any()
    assert weight[kept].min() >= weight[~kept].max()
    assert weight[kept].sum() <= 0.75 * weight.sum() + 0.9
    assert not lifting.gate(np.zeros(5)).any()


def test_masks_are_counted_afresh_in_each_frame(world):
    local, names = local_masks(world[0])
    masks = np.asarray(world[0].masks)
    for t in range(len(masks)):
        shown = masks[t] >= 0
        np.testing.assert_array_equal(names[t][local[t]][shown], masks[t][shown])
        assert (local[t] >= 0).sum() == shown.sum()
