"""Votes against the float64 twin's weights; the same bits in any order, in memory and on disk."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import cameras_of, gaussians_at
from reference import weights_reference

from jsecon import plan_view
from jsecon.errors import InputError
from jsecon.field import columns, evidence
from jsecon.field.evidence import IGNORED, region_votes, sum_evidence, view_evidence
from jsecon.field.membership import normalise_votes
from jsecon.splat import visible
from jsecon.splat.render import render_rgb
from jsecon.splat.visible import padded_size, render_in_blocks, visible_part
from jsecon.types import Regions, Votes

REGIONS = 11
COLUMNS = "regions", "weights", "labelled", "total", "max_pixel_weight", "views"


@pytest.fixture(scope="module")
def labels(cameras):
    """Four label images: blocks, one of them noise (many regions in a tile), one half ignored, one with no region."""
    rng = np.random.default_rng(5)
    blocks = rng.integers(-1, REGIONS, (4, 5, 6)).repeat(8, 1).repeat(8, 2).astype(np.int32)
    blocks[1] = rng.integers(-1, REGIONS, (40, 48))
    blocks[2, :, 10:35] = IGNORED
    blocks[3] = -1
    return blocks


@pytest.fixture(scope="module")
def cast(scene, cameras, labels):
    return region_votes(scene, cameras, labels, REGIONS, top=REGIONS, by_view=True)


def assert_same_bits(found: Votes, votes: Votes, names=(*COLUMNS, "by_view")):
    for name in names:
        np.testing.assert_array_equal(getattr(found, name), getattr(votes, name), err_msg=name)


def ball(count, views, width, height, *, opaque=0.0, seed=0):
    rng = np.random.default_rng(seed)
    size = 0.7 * count ** (-1 / 3)
    means, sizes = rng.normal(size=(count, 3)), rng.uniform(0.1 * size, size, (count, 3))
    turns, logit = rng.normal(size=(count, 4)), rng.normal(opaque, 1, count)
    poses = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
    poses[:, 2, 3] = 4 - 0.3 * np.arange(views)
    cameras = cameras_of(poses, (0.9 * width, 0.9 * width, width / 2, height / 2), width, height)
    return gaussians_at(means, sizes, turns=turns, logit=logit), cameras


def test_equals_the_oracles_weights(cast, scene, cameras, labels):
    """By brute force in float64."""
    votes, total = np.zeros((scene.count, REGIONS)), np.zeros((4, scene.count))
    peak, views = np.zeros(scene.count), np.zeros(scene.count, int)
    for t in range(4):
        weights = weights_reference(scene, cameras[t]).reshape(-1, scene.count)[labels[t].reshape(-1) != IGNORED]
        counted = labels[t][labels[t] != IGNORED]
        for r in range(REGIONS):
            votes[:, r] += weights[counted == r].sum(0)
        total[t] = weights.sum(0)
        peak = np.maximum(peak, weights.max(0))
        views += weights.sum(0) > 0
    assert int(cast.overflow) == 0
    # float32, and alphas that fall on the other side of the 1/255 cut on single pixels
    np.testing.assert_allclose(cast.dense(), votes, rtol=2e-4, atol=0.02)
    assert np.linalg.norm(cast.dense() - votes) <= 1e-4 * np.linalg.norm(votes)
    np.testing.assert_allclose(cast.labelled, votes.sum(1), rtol=2e-4, atol=0.02)
    np.testing.assert_allclose(cast.by_view, total, rtol=2e-4, atol=0.02)
    np.testing.assert_allclose(cast.total, total.sum(0), rtol=2e-4, atol=0.02)
    np.testing.assert_allclose(cast.max_pixel_weight, peak, atol=1e-4)
    np.testing.assert_array_equal(cast.views, views)


def test_inside_a_trace_they_are_the_same_also_under_vmap(cast, scene, cameras, labels):
    """Where no error can be raised, a label that is no region counts as none."""

    def votes_of(labels):
        return region_votes(scene, cameras, labels, REGIONS, top=REGIONS, by_view=True)

    beyond = jnp.where(labels == -1, REGIONS, labels)
    batched = jax.tree.map(lambda a: a[0], jax.vmap(votes_of)(beyond[None]))
    for inside in (jax.jit(votes_of)(beyond), batched):
        np.testing.assert_allclose(inside.dense(), cast.dense(), rtol=1e-5, atol=1e-5)
        for name in ("labelled", "total", "by_view"):
            np.testing.assert_allclose(getattr(inside, name), getattr(cast, name), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(inside.max_pixel_weight, cast.max_pixel_weight, atol=1e-5)
        np.testing.assert_array_equal(inside.views, cast.views)


def test_no_order_of_views_changes_a_bit(cast, scene, cameras, labels):
    """Nor do parts that are added up apart: each is exact."""
    views = [view_evidence(scene, cameras[t], labels[t], REGIONS) for t in range(4)]
    order = [2, 0, 3, 1]
    turned = sum_evidence([views[t] for t in order], scene.count, REGIONS, top=REGIONS, by_view=True)
    assert_same_bits(turned, cast, COLUMNS)
    np.testing.assert_array_equal(turned.by_view, cast.by_view[order])
    some = sum_evidence([views[t] for t in (3, 1)], scene.count, REGIONS, top=REGIONS)
    alone = region_votes(scene, cameras[np.array([1, 3])], labels[[1, 3]], REGIONS, top=REGIONS)
    assert_same_bits(some, alone, COLUMNS)


def test_on_disk_and_in_blocks_they_are_the_same_to_the_bit(cast, scene, cameras, labels, tmp_path, monkeypatch):
    monkeypatch.setattr(evidence, "_MAX_ENTRIES", 4 * 16)  # blocks of 16 rows
    options = {"top": REGIONS, "by_view": True}
    assert_same_bits(region_votes(scene, cameras, labels, REGIONS, **options), cast)
    told = []
    options |= {"folder": tmp_path / "v", "progress": lambda *count: told.append(count)}
    mapped = region_votes(scene, cameras, list(labels), REGIONS, **options)  # a view at a time
    assert_same_bits(mapped, cast)
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert isinstance(mapped.weights, np.memmap)
    assert mapped.weights.flags.writeable is False


@pytest.mark.parametrize("opaque", [0.0, pytest.param(4.0, marks=pytest.mark.long)])
def test_a_scene_cut_to_what_a_view_sees_has_the_same_votes(monkeypatch, opaque):
    """40,000 Gaussians; opaque, most lie behind what stopped every pixel. A pixel's last weight, of at most 0.01, may
    come to lie on the other side of the stop: another program rounds a splat's place its own way."""
    count = 40_000
    scene, cameras = ball(count, 2, 160, 120, opaque=opaque)
    scene.means[: count // 2, 0] += 50  # beside every view
    blocks = np.random.default_rng(1).integers(-1, 7, (2, 6, 8)).repeat(20, 1).repeat(20, 2)
    whole = region_votes(scene, cameras, blocks, 7, top=3)
    monkeypatch.setattr(evidence, "MAX_WHOLE", 1000)
    cut = region_votes(scene, cameras, blocks, 7, top=3)
    assert not np.asarray(cut.views[: count // 2]).any()
    for name in ("weights", "labelled", "total"):
        own, other = (np.asarray(getattr(votes, name), np.float64) for votes in (cut, whole))
        np.testing.assert_allclose(own, other, rtol=1e-4, atol=0.011)
        assert np.linalg.norm(own - other) <= 1e-4 * np.linalg.norm(other) + 0.02
    for name in ("regions", "views"):
        assert (np.asarray(getattr(cut, name)) != np.asarray(getattr(whole, name))).sum() <= 4


@pytest.mark.parametrize("share", [0.4, pytest.param(1.0, marks=pytest.mark.long)])
def test_at_the_centre_they_are_the_weights_of_that_pixel(scene, cameras, labels, cast, share):
    found = region_votes(scene, cameras, labels, REGIONS, top=REGIONS, by_view=True, centre_pixel_weight=share)
    votes, total = np.zeros((scene.count, REGIONS)), np.zeros((4, scene.count))
    for t in range(4):
        weights, splats = weights_reference(scene, cameras[t]), np.asarray(plan_view(scene, cameras[t]).splats)
        height, width, _ = weights.shape
        for n, (x, y) in enumerate(np.floor(splats[:, :2]).astype(int)):
            if splats[n, 5] > 0 and 0 <= x < width and 0 <= y < height:
                total[t, n] = weights[y, x, n] * (labels[t, y, x] != IGNORED)
                if labels[t, y, x] >= 0:
                    votes[n, labels[t, y, x]] += weights[y, x, n]
    mixed = (1 - share) * np.asarray(cast.dense()) + share * votes
    np.testing.assert_allclose(found.dense(), mixed, rtol=2e-4, atol=0.01)
    np.testing.assert_allclose(found.by_view, (1 - share) * cast.by_view + share * total, rtol=2e-4, atol=0.01)
    assert votes.max() > 0.1


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize(("count", "views", "regions"), [(0, 4, 3), (64, 0, 3), (64, 4, 0), (1, 1, 1), (0, 0, 0)])
def test_no_gaussians_no_views_no_regions(scene, cameras, tmp_path, count, views, regions, traced):
    some, seen = jax.tree.map(lambda a: a[:count], scene), jax.tree.map(lambda a: a[:views], cameras)
    images = np.full((views, 40, 48), 0 if regions else -1, np.int32)

    def cast(images):
        return region_votes(some, seen, images, regions, by_view=True)

    votes = jax.jit(cast)(images) if traced else cast(images)
    width = min(8, max(regions, 1))
    assert votes.regions.shape == votes.weights.shape == (count, width)
    assert votes.by_view.shape == (views, count)
    assert votes.dense().shape == (count, regions)
    assert (float(votes.total.sum()) > 0) == (count > 0 and views > 0)
    assert float(votes.labelled.sum()) == pytest.approx(float(votes.total.sum()) if regions else 0.0, rel=1e-5)
    if not traced:
        assert_same_bits(region_votes(some, seen, images, regions, by_view=True, folder=tmp_path / "v"), votes)


@pytest.mark.parametrize("top", [2, 4])
def test_the_strongest_come_first_and_the_sum_of_all_is_kept(cast, scene, cameras, labels, top):
    few = region_votes(scene, cameras, labels, REGIONS, top=top)
    assert few.by_view is None
    np.testing.assert_array_equal(few.weights, cast.weights[:, :top])
    np.testing.assert_array_equal(few.regions, cast.regions[:, :top])
    np.testing.assert_array_equal(few.labelled, cast.labelled)
    assert bool((cast.weights[:, :-1] >= cast.weights[:, 1:]).all())
    np.testing.assert_array_equal(cast.regions >= 0, cast.weights > 0)


def test_what_does_not_fit_raises(scene, cameras, camera, labels, tmp_path, monkeypatch):
    for views, images, named in (
        (camera, labels, "leading axis"),
        (cameras, labels[:2], "one per view"),
        (cameras, labels[:, 1:], "size"),
        (cameras, list(labels[:, 1:]), "size"),
    ):
        with pytest.raises(ValueError, match=named):
            region_votes(scene, views, images, REGIONS)
    (tmp_path / "v").mkdir()
    (tmp_path / "v" / "mine").touch()
    for folder, named in ((tmp_path / "v", "not empty"), (tmp_path / "v" / "mine" / "w", "can be written")):
        with pytest.raises(InputError, match=named):
            region_votes(scene, cameras, labels, REGIONS, folder=folder)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(InputError, match="No space left"):
        region_votes(scene, cameras, labels, REGIONS, folder=tmp_path / "w")
    assert not list((tmp_path / "w").iterdir())  # nor does the scratch folder stay


def test_normalised_on_disk_they_are_those_in_memory(scene, cameras, labels, tmp_path, monkeypatch):
    embeddings = np.random.default_rng(0).normal(size=(REGIONS, 4)).astype(np.float32)
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    pixels = np.stack([(labels == r).sum((1, 2)) for r in range(REGIONS)]).astype(np.int32)
    pixels[:5, 1] = 0  # as if the noise of that view showed but half of them
    regions = Regions(embeddings, pixels)
    options = {"top": 4, "by_view": True}
    memory = normalise_votes(region_votes(scene, cameras, labels, REGIONS, **options), regions)
    monkeypatch.setattr(columns, "ROWS", 24)
    mapped = normalise_votes(region_votes(scene, cameras, labels, REGIONS, **options, folder=tmp_path / "w"), regions)
    for name in ("weight_where_region_visible", "overlap"):
        np.testing.assert_allclose(getattr(mapped, name), getattr(memory, name), rtol=1e-5, atol=1e-6)
    assert mapped.by_view is None


def test_a_view_is_rendered_from_what_it_can_see(monkeypatch):
    scene, cameras = ball(3_000, 1, 60, 40)
    scene.means[:1500, 0] += 50  # beside every view
    monkeypatch.setattr(visible, "ROWS", 700)
    ids, _ = visible_part(scene, cameras[0])
    assert 0 < len(ids) <= 1500
    assert (ids >= 1500).all()
    expected = render_rgb(scene, cameras[0]).features
    np.testing.assert_allclose(render_in_blocks(scene, cameras[0]), expected, atol=1e-5)
    away = scene.means.copy()
    away[:, 0] += 500
    empty = dataclasses.replace(scene, means=away)
    np.testing.assert_array_equal(render_in_blocks(empty, cameras[0]), 0)
    counts = range(0, 300_000, 4_999)
    sizes = [padded_size(count) for count in counts]
    assert sizes == sorted(sizes)
    assert len(set(sizes)) < 40
    assert all(count <= size <= max(1.13 * count, count + 4096) for count, size in zip(counts, sizes))
