"""Hard worlds: each switch does what it says, alike in all views, and nothing where it is off."""

import dataclasses
import json

import numpy as np
import pytest
from experiments.test_simulated import NONE, frames, space  # noqa: F401
from hypothesis import given, settings, strategies as st

from experiments import worlds
from experiments.datasets.plain_room import make_room
from experiments.datasets.twins import by_kind, camouflaged
from experiments.rooms.room import TABLE_WOOD, srgb_to_linear
from experiments.simulated_vision.embeddings import (
    CONFUSED,
    LEANING,
    SimulatedEmbedder,
    leanings,
    made_text_space,
    named_after,
)
from experiments.simulated_vision.masks import LEVELS
from experiments.simulated_vision.worlds import World, seen_in, world_of
from experiments.tables import twins
from experiments.tables.rows import TRAINED
from jsecon.errors import InputError
from jsecon.read.masks.labels import LabelledFrame

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


def test_without_a_switch_what_is_seen_is_the_truth(made):
    found, _ = seen(made)
    np.testing.assert_array_equal(found.masks, made[1])
    np.testing.assert_array_equal(found.content, made[1])


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


def test_groups_join_nearest_neighbours(made):
    room = made[0]
    _, by_point = seen(made, groups=1)
    centres = np.stack([item.centre for item in room.objects])
    away = np.linalg.norm(centres[:, None] - centres, axis=-1) + 9 * np.eye(4)
    for t in range(6):
        assert len(np.unique(by_point[t][:960])) < 4
    a, b = np.unravel_index(away.argmin(), away.shape)
    assert (by_point[:, 240 * a] == by_point[:, 240 * b]).all()


def test_three_levels_overlap_and_are_alike_where_the_switch_spares_them(made):
    truth = made[1]
    found, _ = seen(made, levels=1)
    np.testing.assert_array_equal(found.masks, truth)
    parts, _ = seen(made, parts=1)
    np.testing.assert_array_equal(found.small, parts.masks)
    joined, _ = seen(made, groups=1)
    assert len(np.unique(found.large)) < len(np.unique(truth))
    np.testing.assert_array_equal(found.large, joined.masks)
    some, _ = seen(made, levels=0.5)
    assert 0 < (some.small != truth).mean() < (found.small != truth).mean()
    assert seen(made)[0].small is None


def test_masks_reach_over_the_table_away_from_the_lamp(made):
    room, truth, points, _ = made
    found, _ = seen(made, shadow=1)
    taken = (found.masks != truth) & (truth == TABLE)
    assert taken.any()
    np.testing.assert_array_equal(found.masks[~taken], truth[~taken])
    np.testing.assert_array_equal(found.content, truth)  # an embedder sees what is there
    for k, item in enumerate(room.objects):
        own = points[taken & (found.masks == k)][:, :2] - item.centre[:2]
        if len(own):
            assert (own @ (item.centre[:2] - room.light[:2])).mean() > 0


def embedded(frames, space, world, noise):  # noqa: F811
    labels = np.full(frames.shape[:3], -1, np.int16)
    for k in range(6):
        labels[:, 4:20, 4 + 13 * k : 14 + 13 * k] = k
    faults = dataclasses.replace(NONE, view_noise=noise, gap=1.0, gap_along=0.0)
    turns = np.linspace(0, 2 * np.pi, len(frames), endpoint=False)
    names = space.names[:6]
    hard = SimulatedEmbedder(frames, labels, names, space, faults, world=world, azimuths=turns)
    return np.stack(
        [hard.embed_regions(frame, labels[t] == np.arange(6)[:, None, None]) for t, frame in enumerate(frames)]
    )


def test_noise_that_follows_the_azimuth_is_alike_in_neighbouring_views(frames, space):  # noqa: F811
    apart = {}
    for turning in (0.0, 1.0):
        rows = embedded(frames, space, World(azimuth=turning), 2.0)
        off = rows - rows.mean(0)
        off /= np.linalg.norm(off, axis=-1, keepdims=True)
        apart[turning] = [float((off * np.roll(off, by, axis=0)).sum(-1).mean()) for by in (1, 4)]
    assert abs(apart[0.0][0] - apart[0.0][1]) < 0.1
    assert apart[1.0][0] > apart[1.0][1] + 0.4


def test_the_gap_differs_by_class_and_not_by_view(frames, space):  # noqa: F811
    alike, apart = (embedded(frames, space, World(gap=hard), 0.0) for hard in (0.0, 1.0))
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-6)
    along = alike[0].mean(0) - space.vectors[:6].mean(0)
    assert np.ptp(apart[0] @ along) > 3 * np.ptp(alike[0] @ along)


PLAIN = dataclasses.replace(NONE, gap=0.0, gap_along=0.0)
"""embeddings are their texts' directions"""


def shared_rows(space, strength, seed=0, views=1, faults=NONE, others=None):  # noqa: F811
    """(views, 12, E) embeddings of the true masks of twelve things, and the vectors of their names."""
    labels = np.repeat(np.arange(12, dtype=np.int16).reshape(1, 1, 12), views, 0).repeat(8, 1).repeat(8, 2)
    pictures = np.random.default_rng(0).integers(0, 256, (*labels.shape, 3)).astype(np.uint8)
    world = World(shared=strength)
    embedder = SimulatedEmbedder(
        pictures, labels, space.names[:12], space, faults, seed=seed, world=world, others=others
    )
    masks = labels == np.arange(12)[:, None, None, None]
    return np.stack([embedder.embed_regions(p, masks[:, t]) for t, p in enumerate(pictures)]), space.vectors[:12]


def test_a_shared_error_is_the_same_in_every_view_and_leans_to_other_classes(space):  # noqa: F811
    right, texts = shared_rows(space, 0.0, views=3, faults=PLAIN)
    wrong, _ = shared_rows(space, 1.0, views=3, faults=PLAIN)
    np.testing.assert_array_equal(wrong, np.broadcast_to(wrong[0], wrong.shape))
    assert np.abs(wrong - right).max() > 0.01
    mixture = leanings(space.names[:12], 0, seed=0)
    leant = (1 - LEANING) * texts + LEANING * mixture @ texts
    assert not np.diagonal(mixture).any()
    np.testing.assert_array_equal((mixture > 0).sum(1), CONFUSED)
    np.testing.assert_allclose(wrong[0], leant / np.linalg.norm(leant, axis=1, keepdims=True), atol=1e-6)


def test_shared_errors_lean_to_names_of_nothing_too(space):  # noqa: F811
    others = space.vectors[100:140]
    wrong, texts = shared_rows(space, 1.0, faults=PLAIN, others=others)
    mixture = leanings(space.names[:12], 40, seed=0)
    np.testing.assert_allclose(mixture.sum(1), 1)
    np.testing.assert_array_equal((mixture[:, 12:] > 0).sum(1), CONFUSED)
    leant = (1 - LEANING) * texts + LEANING * mixture @ np.concatenate([texts, others])
    np.testing.assert_allclose(wrong[0], leant / np.linalg.norm(leant, axis=1, keepdims=True), atol=1e-6)
    assert not leanings(("cup", "cup"), 0, seed=0).any()  # no other class: its own text stays


def test_without_strength_the_simulation_is_as_it_was_to_the_bit(space):  # noqa: F811
    faults = LEVELS["high"]
    labels = np.repeat(np.arange(12, dtype=np.int16).reshape(1, 1, 12), 1, 0).repeat(8, 1).repeat(8, 2)
    pictures = np.random.default_rng(0).integers(0, 256, (*labels.shape, 3)).astype(np.uint8)
    plain = SimulatedEmbedder(pictures, labels, space.names[:12], space, faults, seed=4)
    masks = labels[0] == np.arange(12)[:, None, None]
    off, _ = shared_rows(space, 0.0, seed=4, faults=faults, others=space.vectors[100:])
    np.testing.assert_array_equal(off[0], plain.embed_regions(pictures[0], masks))
    words = ["dog", "cup", "red mug"]
    found, others, _ = twins.space_of(words, World(), 3)
    np.testing.assert_array_equal(found.vectors, made_text_space(words, seed=3).vectors)
    assert others.shape == (twins.ABSENT, found.vectors.shape[1])


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_the_more_errors_are_shared_the_fewer_regions_have_their_own_text(space, seed):  # noqa: F811
    """Who is right at some strength is right at every smaller one, as each other text gains in proportion to it."""
    before = np.ones(12, bool)
    for strength in (0.0, 0.25, 0.5, 0.75, 1.0):
        rows, texts = shared_rows(space, strength, seed=seed, faults=PLAIN)
        right = (rows[0] @ texts.T).argmax(1) == np.arange(12)
        assert (before | ~right).all()
        before = right


def test_names_with_words_in_common_lie_near_each_other():
    names = ("dark green mug", "light green mug", "red ball", *(f"word{i}" for i in range(200)))
    plain, near = (made_text_space(names, common=common).vectors for common in (0.0, 1.0))
    assert near[0] @ near[1] > near[0] @ near[2] + 0.05
    assert abs(plain[0] @ plain[1] - plain[0] @ plain[2]) < 0.05
    assert abs((near @ near.T).mean() - (plain @ plain.T).mean()) < 0.01


def test_real_names_are_drawn_by_lot_or_near_each_other(space):  # noqa: F811
    lot, near = (named_after(space, list("abcdefgh"), near=n) for n in (False, True))
    assert lot.names == tuple("abcdefgh")
    assert (near.vectors @ near.vectors.T).mean() > (lot.vectors @ lot.vectors.T).mean() + 0.01
    with pytest.raises(InputError, match="9999 or more"):
        named_after(space, ["a"] * 9999, near=True)


def test_things_of_a_kind_are_one_answer_and_camouflage_takes_their_colours():
    room = make_room(0)
    a, b = next(
        (a, b) for n, a in enumerate(room.objects) for b in room.objects[n + 1 :] if a.shape == b.shape
    )  # every room has some
    left, right = (np.arange(80).reshape(8, 10) % 10 == c for c in (1, 7))
    box = np.zeros((1, 4), np.float32)
    frame = by_kind(LabelledFrame("f", 10, 8, {a.name: (left, box), b.name: (right, box + 1)}), room)
    assert list(frame.objects) == [a.shape]
    np.testing.assert_array_equal(frame.objects[a.shape][0], left | right)
    assert frame.objects[a.shape][1].shape == (2, 4)
    assert camouflaged(room, 0) is room
    for item in camouflaged(room, 1.0).objects:
        for part in item.parts:
            np.testing.assert_allclose(part.albedo, srgb_to_linear(TABLE_WOOD), rtol=1e-6)


def test_every_fault_has_its_worlds_and_methods_are_read_as_suits_them_there():
    found = worlds.worlds(worlds.FAULTS, (1.0, 0.5))
    assert {fault for fault, _ in found} == {"none", "together", *worlds.FAULTS}
    assert all(world_of(level)[0] == "medium" for level, _ in found.values())
    there = {"scenes": ("ramen",), "seeds": (10,), "scenes_trained": ("ramen",), "seeds_trained": (10,)}
    options = worlds.Options(only=("kinds",), values=(1.0,), out="nowhere", **there)
    plan = worlds.plan_of(*worlds.worlds(options.only, options.values)["kinds", 1.0], options, trained=False)
    assert dict(plan.data.size)["kinds"]
    assert plan.data.seeds == (0, 10)
    training = worlds.plan_of("medium", {}, options, trained=True)
    rows, seeds = training.methods, training.data.seeds
    assert seeds == (10,)
    assert {row.split(": ")[0] for row in rows} == set(TRAINED)
    assert not set(rows) & set(plan.methods)
    assert {"OpenGaussian: 16 roots, as published", "the paper's path: contrast, threshold 0.98"} <= set(rows)
    own, cells = {"VALA: as published": 0.5, "VALA: centred, threshold": 0.4, "ours, consensus: x": 0.6}, []
    for seed, value in ((0, 0.1), (10, 0.3)):
        cell = {"seed": seed, "scene": "ramen"}
        cells += [cell | {"method": m, "miou": at + value, "miou_vala": at - value} for m, at in own.items()]
    told = worlds.of_world(cells, options.choosing, options.seeds)
    assert told["VALA"] == {"miou": pytest.approx(0.8), "miou_vala": pytest.approx(0.2)}
    text = worlds.layout({("none", 0.0): told, ("kinds", 1.0): told | {"VALA": {"miou": 0.99, "miou_vala": 0.0}}})
    assert "| kinds 1 | 0.990 | 0.900 | -0.090 |" in text
    assert "behind in: kinds 1 (VALA, by 0.090)" in text


@pytest.mark.long
def test_a_quick_run_measures_every_method_in_the_plain_world_and_under_two_faults(tmp_path):
    worlds.main(worlds.Options(**worlds.QUICK, quick=True, out=str(tmp_path), processes=1))
    worlds_of = json.loads((tmp_path / "metrics.json").read_text())
    assert set(worlds_of) == {"none 0", "parts 1", "kinds 1"}
    for methods in worlds_of.values():
        assert {"ours, consensus", "ours, tracks", "Occam's LGS"} <= set(methods)
        assert all(0 <= figure <= 1 for figures in methods.values() for figure in figures.values())
        assert methods["ours, consensus"]["miou"] > 0
    assert "| miou" in (tmp_path / "table.md").read_text()
    assert (tmp_path / "figure.webp").exists()
