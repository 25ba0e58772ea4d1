"""Hard worlds: each switch does what it says, alike in all views, and nothing where it is off."""

import dataclasses

import numpy as np
import pytest
from experiments.test_simulated import NONE, frames, space  # noqa: F401

from experiments.datasets.plain_room import make_room
from experiments.simulated_vision.embeddings import CONFUSED, LEANING, SimulatedEmbedder, leanings
from experiments.simulated_vision.worlds import World, seen_in, world_of

TABLE = 7
"""the label after four objects, wall, floor and ceiling"""


@pytest.fixture(scope="module")
def made():
    """(room, truth (6, 30, 40), points): every view shows the same 3D points, each at a pixel drawn anew."""
    room, draw = make_room(3, num_objects=4), np.random.default_rng(0)
    labels = np.repeat(np.arange(5), 240)
    points = draw.uniform(-0.7, 0.7, (1200, 3)) * (1, 1, 0)
    for k, item in enumerate(room.objects):
        points[labels == k] = item.centre + draw.normal(0, item.radius / 3, (240, 3))
    labels[labels == 4] = TABLE
    orders = [draw.permutation(1200) for _ in range(6)]
    truth, seen = (np.stack([rows[order] for order in orders]) for rows in (labels, points))
    return room, truth.reshape(6, 30, 40), seen.reshape(6, 30, 40, 3), orders


def seen(made, **switches):
    room, truth, points, orders = made
    found = seen_in(World(**switches), truth, points, room, TABLE, seed=1)
    by_point = np.empty((6, 1200), int)
    for t, order in enumerate(orders):
        by_point[t, order] = found.masks[t].ravel()
    return found, by_point


def test_a_level_names_the_noise_and_the_switches():
    assert world_of("high") == ("high", World())
    assert world_of("medium+parts=1+gap=0.5") == ("medium", World(parts=1, gap=0.5))
    assert world_of("shared") == ("medium", World(shared=0.85))
    for wrong in ("medium+sharks=1", "medium+parts=2"):
        with pytest.raises(ValueError, match="a number from 0 to 1"):
            world_of(wrong)


def test_without_a_switch_what_is_seen_is_the_truth_and_levels_are_parts_objects_and_groups(made):
    found, _ = seen(made)
    np.testing.assert_array_equal(found.masks, made[1])
    np.testing.assert_array_equal(found.content, made[1])
    assert found.small is None
    found, _ = seen(made, levels=1)
    np.testing.assert_array_equal(found.masks, made[1])
    np.testing.assert_array_equal(found.small, seen(made, parts=1)[0].masks)
    np.testing.assert_array_equal(found.large, seen(made, groups=1)[0].masks)
    some, _ = seen(made, levels=0.5)
    assert 0 < (some.small != made[1]).mean() < (found.small != made[1]).mean()


def test_parts_are_the_same_points_in_all_views_that_tell_them_apart(made):
    found, by_point = seen(made, parts=1)
    assert (by_point == by_point[0]).all()  # the plane stands still
    for k in range(4):
        ids, counts = np.unique(by_point[0][240 * k : 240 * (k + 1)], return_counts=True)
        assert set(ids) == {k, 8 + k}
        assert counts.min() > 0.3 * 240
        assert set(found.objects[ids]) == {k}
    some, by_point = seen(made, parts=0.5)
    np.testing.assert_array_equal(some.content, found.content)
    cut = [(by_point[t][240 * k : 240 * (k + 1)] >= 8).any() for t in range(6) for k in range(4)]
    assert 0.2 < np.mean(cut) < 0.8


PLAIN = dataclasses.replace(NONE, gap=0.0, gap_along=0.0)
"""embeddings are their texts' directions"""


def shared_rows(space, strength, views):  # noqa: F811
    """(views, 12, E) embeddings of the true masks of twelve things, and the vectors of their names."""
    labels = np.repeat(np.arange(12, dtype=np.int16).reshape(1, 1, 12), views, 0).repeat(8, 1).repeat(8, 2)
    pictures = np.random.default_rng(0).integers(0, 256, (*labels.shape, 3)).astype(np.uint8)
    world = World(shared=strength)
    embedder = SimulatedEmbedder(pictures, labels, space.names[:12], space, PLAIN, world=world)
    masks = labels == np.arange(12)[:, None, None, None]
    return np.stack([embedder.embed_regions(p, masks[:, t]) for t, p in enumerate(pictures)]), space.vectors[:12]


def test_a_shared_error_is_the_same_in_every_view_and_leans_to_other_classes(space):  # noqa: F811
    right, texts = shared_rows(space, 0.0, views=3)
    wrong, _ = shared_rows(space, 1.0, views=3)
    np.testing.assert_array_equal(wrong, np.broadcast_to(wrong[0], wrong.shape))
    assert np.abs(wrong - right).max() > 0.01
    mixture = leanings(space.names[:12], 0, seed=0)
    leant = (1 - LEANING) * texts + LEANING * mixture @ texts
    assert not np.diagonal(mixture).any()
    np.testing.assert_array_equal((mixture > 0).sum(1), CONFUSED)
    np.testing.assert_allclose(wrong[0], leant / np.linalg.norm(leant, axis=1, keepdims=True), atol=1e-6)
    mixture = leanings(space.names[:12], 40, seed=0)  # to 40 names of nothing too
    np.testing.assert_allclose(mixture.sum(1), 1)
    np.testing.assert_array_equal((mixture[:, 12:] > 0).sum(1), CONFUSED)
    assert not leanings(("cup", "cup"), 0, seed=0).any()  # no other class: its own text stays
