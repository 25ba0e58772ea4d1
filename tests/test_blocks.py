"""Votes, codes and queries in blocks are those in memory; what is approximate about them is bounded here."""

# ruff: noqa: F811  (the fixtures of test_votes)

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_field import make_field
from test_votes import REGIONS, expected, labels  # noqa: F401

from jsecon.errors import InputError
from jsecon.field import columns, view_votes, votes as votes_module
from jsecon.field.field import load_field, save_field
from jsecon.field.membership import normalise_votes, normalise_votes_in_blocks, with_overlap
from jsecon.field.streaming import region_votes_in_blocks, strongest
from jsecon.field.votes import region_votes
from jsecon.query.answer import query_anchored
from jsecon.query.blocks import query_in_blocks
from jsecon.splat.render import render_rgb
from jsecon.splat.visible import geometry_of_rows, render_in_blocks, visible_rows
from jsecon.types import Camera, Gaussians, Regions


def ball(count, views, width, height, *, opaque=0.0, seed=0):
    rng = np.random.default_rng(seed)
    size = 0.7 * count ** (-1 / 3)
    columns = rng.normal(size=(count, 3)), np.log(rng.uniform(0.1 * size, size, (count, 3)))
    columns = *columns, rng.normal(size=(count, 4)), rng.normal(opaque, 1, count), np.zeros((count, 1, 3))
    poses = np.tile(np.eye(4, dtype=np.float32), (views, 1, 1))
    poses[:, 2, 3] = 4 - 0.3 * np.arange(views)
    lens = (np.full(views, v, np.float32) for v in (0.9 * width, 0.9 * width, width / 2, height / 2))
    return Gaussians(*(a.astype(np.float32) for a in columns)), Camera(poses, *lens, width, height)


def blocky(rng, views, height, width, regions):
    return rng.integers(-1, regions, (views, -(-height // 20), -(-width // 20))).repeat(20, 1).repeat(20, 2)[
        :, :height, :width
    ].astype(np.int32)  # fmt: skip


class Streamed:
    """Labels, a view at a time; keeps which were asked for."""

    def __init__(self, labels):
        self.labels, self.asked = labels, []

    def __len__(self):
        return len(self.labels)

    def __getitem__(self, t):
        self.asked.append(t)
        return self.labels[t]


def assert_alike(blocks, memory, *, pixels=0):
    """Float32 sums, and `pixels` whose last weight, of at most 0.01, came to lie on the other side of the stop."""
    assert int(blocks.overflow) == 0
    for name in ("weights", "labelled", "total"):
        own, other = (np.asarray(getattr(votes, name), np.float64) for votes in (blocks, memory))
        assert np.linalg.norm(own - other) <= 1e-6 * np.linalg.norm(other) + 0.01 * np.sqrt(pixels)
        np.testing.assert_allclose(own, other, rtol=3e-6, atol=1e-6 + 0.01 * (pixels > 0))
    # A single pixel's weight hangs on the last bit of a splat's place, which each program rounds its own way.
    apart = ~np.isclose(blocks.max_pixel_weight, memory.max_pixel_weight, rtol=2e-4, atol=1e-5)
    assert apart.sum() <= pixels
    np.testing.assert_allclose(blocks.max_pixel_weight, memory.max_pixel_weight, atol=0.011)


@pytest.mark.parametrize("rows", [16, *(pytest.param(rows, marks=pytest.mark.long) for rows in (5, 64, 1 << 18))])
def test_equal_to_votes_in_memory(scene, cameras, labels, tmp_path, rows):
    memory = region_votes(scene, cameras, labels, REGIONS, top=REGIONS)
    cast = region_votes_in_blocks(scene, cameras, labels, REGIONS, top=REGIONS, folder=tmp_path / "v", rows=rows)
    assert_alike(cast, memory)
    np.testing.assert_array_equal(cast.views, memory.views)
    assert cast.weights.flags.writeable is False
    assert with_overlap(cast).overlap.shape == (REGIONS, REGIONS)
    assert sorted(file.name for file in (tmp_path / "v").iterdir()) == sorted(
        f"{name}.npy" for name in ("regions", "weights", "labelled", "total", "max_pixel_weight", "views")
    )


def test_weights_at_the_centre_of_labels_that_are_read_one_at_a_time(scene, cameras, labels, tmp_path):
    how = {"top": REGIONS, "centre": 0.7}
    memory = region_votes(scene, cameras, labels, REGIONS, **how)
    told, streamed = [], Streamed(labels)
    how |= {"rows": 16, "progress": lambda *count: told.append(count)}
    cast = region_votes_in_blocks(scene, cameras, streamed, REGIONS, folder=tmp_path / "v", **how)
    assert_alike(cast, memory)
    np.testing.assert_array_equal(cast.regions, memory.regions)
    assert streamed.asked == [0, 1, 2, 3]  # one at a time
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


@pytest.mark.parametrize("opaque", [0.0, pytest.param(4.0, marks=pytest.mark.long)])
def test_equal_at_many_gaussians(tmp_path, monkeypatch, opaque):
    """4,000, all visible; opaque, most lie behind what stopped every pixel. Votes in memory take blocks of two regions,
    and those of a view cut lists and parts of these."""
    monkeypatch.setattr(votes_module, "DENSE_BYTES", 4 * 2 * 4096)
    monkeypatch.setattr(view_votes, "MAX_SLOT_BYTES", 0)
    monkeypatch.setattr(view_votes, "PAIRS", 1000)
    scene, cameras = ball(4000, 3, 160, 120, opaque=opaque)
    labels = blocky(np.random.default_rng(1), 3, 120, 160, 7)
    memory = region_votes(scene, cameras, labels, 7, top=3)
    cast = region_votes_in_blocks(scene, cameras, labels, 7, top=3, folder=tmp_path / "v", rows=500)
    assert_alike(cast, memory, pixels=3)
    assert (np.asarray(cast.regions) != np.asarray(memory.regions)).sum() <= 4
    assert (np.asarray(cast.views) != np.asarray(memory.views)).sum() <= 4
    np.testing.assert_allclose(cast.weight_beyond_top_k, memory.weight_beyond_top_k, rtol=1e-4, atol=1e-3)


def test_equal_depths_keep_the_order_of_indices(scene, cameras, labels, tmp_path):
    """All Gaussians in one place: each sees what those before it leave."""
    alike = {"means": np.zeros_like(scene.means), "log_scales": np.full_like(scene.log_scales, -1)}
    scene = dataclasses.replace(scene, **alike, opacity_logits=np.full_like(scene.opacity_logits, -3))
    memory = region_votes(scene, cameras, labels, REGIONS, top=REGIONS)
    cast = region_votes_in_blocks(scene, cameras, labels, REGIONS, top=REGIONS, folder=tmp_path / "v", rows=16)
    assert (np.diff(cast.total) < 0).all()
    assert_alike(cast, memory)


def test_finished_votes_are_those_in_memory(scene, cameras, labels, tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    embeddings = rng.normal(size=(REGIONS, 4)).astype(np.float32)
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    pixels = np.stack([(labels == r).sum((1, 2)) for r in range(REGIONS)]).astype(np.int32)
    pixels[:5, 1] = 0  # as if the noise of that view showed but half of them
    regions = Regions(embeddings, pixels)
    whole = region_votes(scene, cameras, labels, REGIONS, top=4, by_view=True)
    memory = normalise_votes(whole, regions)
    monkeypatch.setattr(columns, "ROWS", 24)
    how = {"top": 4, "rows": 16, "by_view": True}
    cast = region_votes_in_blocks(scene, cameras, labels, REGIONS, **how, folder=tmp_path / "w")
    assert isinstance(cast.by_view, np.memmap)
    np.testing.assert_array_equal(cast.regions, memory.regions)
    np.testing.assert_allclose(cast.by_view, whole.by_view, rtol=1e-5, atol=1e-5)
    blocks, one = normalise_votes_in_blocks(cast, regions), normalise_votes_in_blocks(whole, regions)
    for finished in (blocks, one):
        np.testing.assert_allclose(
            finished.weight_where_region_visible, memory.weight_where_region_visible, rtol=1e-5, atol=1e-6
        )
        np.testing.assert_allclose(finished.overlap, memory.overlap, rtol=1e-5, atol=1e-6)


def test_a_view_is_rendered_from_what_it_can_see():
    scene, cameras = ball(3_000, 3, 60, 40)
    scene.means[:1500, 0] += 50  # beside every view
    for t in range(3):
        ids = visible_rows(scene, cameras[t], rows=700)
        assert 0 < len(ids) <= 1500
        assert (ids >= 1500).all()
        expected = render_rgb(scene, cameras[t]).features
        np.testing.assert_allclose(render_in_blocks(scene, cameras[t]), expected, atol=1e-5)
    away = scene.means.copy()
    away[:, 0] += 500
    empty = dataclasses.replace(scene, means=away)
    np.testing.assert_array_equal(render_in_blocks(empty, cameras[0]), 0)
    counts = range(0, 300_000, 4_999)
    sizes = [geometry_of_rows(scene, np.zeros(count, int)).count for count in counts]
    assert sizes == sorted(sizes)
    assert len(set(sizes)) < 40
    assert all(count <= size <= max(1.13 * count, count + 4096) for count, size in zip(counts, sizes))


def test_no_regions_no_gaussians_and_labels_of_nothing(scene, cameras, labels, tmp_path):
    none = region_votes_in_blocks(scene, cameras, np.full((4, 40, 48), -1, np.int32), 0, folder=tmp_path / "a")
    assert none.dense().shape == (scene.count, 0)
    assert float(none.total.sum()) > 0
    empty, few = jax.tree.map(lambda a: a[:0], scene), np.minimum(labels, 2)
    assert region_votes_in_blocks(empty, cameras, few, 3, folder=tmp_path / "c").regions.shape == (0, 3)


def test_what_does_not_fit_raises(scene, cameras, camera, labels, tmp_path):
    def cast(*given, **how):
        return region_votes_in_blocks(*given, REGIONS, folder=tmp_path / "v", **how)

    with pytest.raises(ValueError, match="leading axis"):
        cast(scene, camera, labels)
    with pytest.raises(ValueError, match="one per view"):
        cast(scene, cameras, labels[:2])
    with pytest.raises(ValueError, match="size"):
        cast(scene, cameras, labels[:, 1:])
    (tmp_path / "v").mkdir(exist_ok=True)
    (tmp_path / "v" / "mine").touch()
    with pytest.raises(InputError, match="not empty"):
        cast(scene, cameras, labels)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="can be written"):
        region_votes_in_blocks(scene, cameras, labels, REGIONS, folder=tmp_path / "file" / "v")


def test_a_full_disk_is_told_and_the_scratch_folder_removed(scene, cameras, labels, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "save", full)
    with pytest.raises(InputError, match="No space left"):
        region_votes_in_blocks(scene, cameras, labels, REGIONS, folder=tmp_path / "v")
    assert not list((tmp_path / "v").iterdir())


def test_strongest_is_top_k_with_equal_ones_by_region():
    from scipy import sparse

    rng = np.random.default_rng(0)
    dense = rng.integers(0, 4, (500, 9)).astype(np.float64) * (rng.random((500, 9)) < 0.6)
    ids, weights = strongest(sparse.csr_array(dense), 4)
    wanted, places = jax.lax.top_k(jnp.asarray(dense), 4)
    np.testing.assert_array_equal(weights, wanted)
    np.testing.assert_array_equal(ids, np.where(np.asarray(wanted) > 0, places, -1))


@pytest.fixture
def fields(scene, cameras, tmp_path, monkeypatch):
    """A field in memory, and the same with all its columns mapped."""
    from jsecon.field import field as home

    field = make_field(scene, cameras)[0]
    field = dataclasses.replace(field, votes=with_overlap(field.votes))
    save_field(tmp_path / "a.safetensors", field)
    monkeypatch.setattr(home, "MAPPED", 0)
    monkeypatch.setattr(columns, "ROWS", 10)
    return field, load_field(tmp_path / "a.safetensors", mapped=True)


@pytest.mark.parametrize("by", ["votes", "code"])
def test_queries_of_a_mapped_field_are_those_in_memory(fields, by):
    field, mapped = fields
    texts = np.asarray(field.regions.embeddings) + np.float32(0.05)
    chosen = query_in_blocks(mapped, texts, by=by)
    assert len(chosen) == len(texts)
    assert sum(len(own.gaussians) for own in chosen) > 0
    for text, own in zip(texts, chosen):
        memory, blocks = query_anchored(field, text, by=by), query_anchored(mapped, text, by=by)
        np.testing.assert_array_equal(blocks.mask, memory.mask)
        np.testing.assert_array_equal(blocks.similarity, memory.similarity)
        np.testing.assert_array_equal(own.gaussians, np.flatnonzero(memory.mask))
        np.testing.assert_array_equal(own.similarity, np.asarray(memory.similarity)[own.gaussians])
        assert own.region == int(memory.region)
        assert own.score == pytest.approx(float(memory.score), rel=1e-6)
    with pytest.raises(ValueError, match="match_regions"):
        query_in_blocks(mapped, texts[:, 1:])
    none = dataclasses.replace(mapped, regions=Regions(np.zeros((0, 12), np.float32), np.zeros((0, 4), np.int32)))
    assert [own.region for own in query_in_blocks(none, texts)] == [-1] * len(texts)
