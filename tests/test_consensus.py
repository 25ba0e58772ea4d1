import dataclasses

import numpy as np
import pytest
from balls import HEIGHT, VIEWS, WIDTH, ious, ring_of_balls
from hypothesis import given, settings, strategies as st
from scipy import sparse

from jsecon.association import frame_superpixels as association
from jsecon.association.consensus import (
    _average_linkage,
    _coplanarity,
    _group_by_consensus,
    _Groups,
    _object_tree,
    _piece_planes,
    track_masks,
)
from jsecon.association.frame_superpixels import SceneSuperpixels
from jsecon.field.tree import node_members


@pytest.fixture(scope="module")
def world():
    return ring_of_balls()


def linkage(*args, **options):
    return _average_linkage(*args, **options)[0]


def group(*args, **options):
    return _group_by_consensus(*args, **options).owner


@pytest.fixture(autouse=True)
def few_superpixels(monkeypatch):
    monkeypatch.setattr(association, "SUPERPIXELS_PER_FRAME", 60)


def scene_of(world, proposals):
    return SceneSuperpixels(world[0], world[1], proposals)


def regions_of(tree, count, node):
    """Regions under a node of a tree of `count` regions."""
    return np.flatnonzero(node_members(tree, np.arange(count), int(node))).tolist()


@pytest.fixture(scope="module")
def scene(world):
    return scene_of(world, world[4])


def as_truth(labels, truth):
    """labels renumbered so that each of the floor and the three balls is its most frequent label; others 9."""
    names = [np.bincount(labels[(truth == k) & (labels >= 0)]).argmax() for k in range(4)]
    assert len(set(names)) == 4
    table = np.full(labels.max() + 2, 9)
    table[names] = np.arange(4)
    table[-1] = -1
    return table[labels]


def test_finds_the_three_balls_and_the_floor(world, scene):
    _, _, frames, truth, _ = world
    calls = []
    labels = track_masks(frames, scene, progress=lambda *row: calls.append(row)).labels
    assert labels.max() == 3
    assert np.nanmin(ious(as_truth(labels, truth) - 1, truth, 3)) > 0.9
    assert calls[-1] == (VIEWS, VIEWS)


def test_frames_that_merge_cut_or_propose_nothing_are_outvoted(world, monkeypatch):
    _, _, frames, truth, proposals = world
    worse = list(proposals)
    for t in (2, 9, 16):
        worse[t] = (truth[t] >= 0)[None]  # everything is one region
    left = np.arange(WIDTH) < WIDTH // 2
    for t in (5, 12):
        worse[t] = np.concatenate([proposals[t] & left, proposals[t] & ~left])
    worse[20] = np.zeros((0, HEIGHT, WIDTH), bool)
    monkeypatch.setattr(association, "SUPERPIXELS_PER_FRAME", 300)
    labels = as_truth(track_masks(frames, scene_of(world, worse)).labels, truth)
    scores = ious(labels - 1, truth, 3)
    assert np.nanmean(scores) > 0.85
    assert np.nanmean(scores[[2, 9, 16, 20]]) > 0.6  # and there, too, the Gaussians tell the balls apart


def test_what_shows_no_gaussians_is_no_object(world):
    """The disc is gone but for a faint haze, as around a splat without photographs; a mask of each frame shows it."""
    gaussians, cameras, frames, truth, proposals = world
    on_disc = np.arange(gaussians.count) < 2500
    faint = dataclasses.replace(gaussians, opacity_logits=np.where(on_disc, -6.0, np.asarray(gaussians.opacity_logits)))
    labels = track_masks(frames, scene_of((faint, cameras), proposals)).labels
    assert (labels[truth == 0] >= 0).mean() < 0.02
    assert all((labels[truth == ball] >= 0).mean() > 0.9 for ball in (1, 2, 3))


def test_what_some_views_cut_has_a_common_node(world, monkeypatch):
    """Half of the views cut a ball into its upper and its lower half; no view joins two balls."""
    _, cameras, frames, truth, proposals = world
    cut, of_ball = list(proposals), np.arange(2500, 4000)
    above = np.zeros(len(of_ball))  # in how many more of these views a Gaussian of the ball lies in the upper half
    for t in range(0, VIEWS, 2):
        rows = np.flatnonzero((truth[t] == 1).any(1))
        upper = np.arange(HEIGHT)[:, None] < rows.mean()
        cut[t] = np.concatenate([proposals[t] & upper, proposals[t] & ~upper])
        pose = np.asarray(cameras.world_to_camera[t])
        _, y, z = pose[:3, :3] @ np.asarray(world[0].means)[of_ball].T + pose[:3, 3:]
        above += np.where(90 * y / z + HEIGHT / 2 < rows.mean() + 0.5, 1, -1)
    monkeypatch.setattr(association, "SUPERPIXELS_PER_FRAME", 300)
    scene = scene_of(world, cut)
    found = track_masks(frames, scene, agreement=0.8)
    count = int(found.labels.max()) + 1
    inside = [np.bincount(truth[found.labels == r] + 1, minlength=5)[1:].argmax() for r in range(count)]
    halves = [r for r in range(count) if inside[r] == 1]
    assert len(halves) >= 2
    unions = [regions_of(found.tree, count, node) for node in range(count, len(found.tree))]
    assert halves in unions
    assert all(found.tree[r] < 0 or found.tree[r] >= count for r in range(count))

    merged = track_masks(frames, scene)  # fewer views need agree: the ball is one object, of parts
    count = int(merged.labels.max()) + 1
    ball = int(np.bincount(merged.labels[truth == 1] + 1).argmax()) - 1
    members = [node_members(merged.tree, merged.leaf, node)[of_ball] for node in range(len(merged.tree))]
    assert members[ball].mean() > 0.8
    for half in (above > 0, above <= 0):
        assert max((half & found).sum() / (half | found).sum() for found in members[count:]) > 0.55


def test_parts_that_masks_show_alone_are_labelled(world, monkeypatch):
    """Every view has a mask of a whole ball and masks of its halves: the object has two parts, those of the masks."""
    _, _, frames, truth, proposals = world
    layered = list(proposals)
    for t in range(VIEWS):
        rows = np.flatnonzero((truth[t] == 1).any(1))
        if len(rows):
            upper = np.arange(HEIGHT)[:, None] < rows.mean()
            halves = np.stack([(truth[t] == 1) & upper, (truth[t] == 1) & ~upper])
            layered[t] = np.concatenate([proposals[t], halves])
    monkeypatch.setattr(association, "SUPERPIXELS_PER_FRAME", 300)
    found = track_masks(frames, scene_of(world, layered))
    count, ball = int(found.labels.max()) + 1, int(np.bincount(found.labels[truth == 1] + 1).argmax()) - 1
    assert found.parts.shape[1:] == found.labels.shape
    own = []
    for part, node in enumerate(found.part_nodes):
        shown = (found.parts == part).any(0)
        assert shown.any()
        objects = np.unique(found.labels[shown])
        assert len(objects) == 1  # a part lies in its object
        members = node_members(found.tree, found.leaf, int(node))
        assert count <= node < len(found.tree)
        if objects[0] == ball:
            own.append((members[2500:4000].sum(), shown))
    assert 2 <= len(own) <= 8
    for t in np.flatnonzero((truth == 1).any((1, 2))):
        rows = np.flatnonzero((truth[t] == 1).any(1))
        upper = (truth[t] == 1) & (np.arange(HEIGHT)[:, None] < rows.mean())
        assert max((shown[t] & upper).sum() / (shown[t] | upper).sum() for _, shown in own) > 0.5


def test_a_small_part_of_a_large_scene_has_a_node_of_its_own():
    """Twenty things and few pieces: in these the knob of 40 Gaussians is one with what it stands on."""
    rng, views = np.random.default_rng(0), 6
    things = np.repeat(np.arange(20), 500)
    means = rng.normal(0, 0.1, (len(things), 3)) + 2.0 * np.stack(np.unravel_index(things, (5, 4, 1)), axis=1)
    knob = np.zeros(len(things), bool)
    middle = means[:500].mean(0) + np.array([0, 0, 0.3])
    knob[:40], means[:40] = True, middle + rng.normal(0, 0.01, (40, 3))
    of_things, of_knob = np.eye(20)[things] * np.where(knob, 0.7, 0.8)[:, None], 0.7 * knob[:, None]
    membership = sparse.csr_matrix(np.tile(np.concatenate([of_things, of_knob], axis=1), views))
    visible = sparse.csr_matrix(np.repeat(np.where(knob, 0.99, 0.8)[:, None], views, axis=1))
    found = _group_by_consensus(membership, visible, np.ones(len(things)), means, pieces=40)
    assert found.owner.max() + 1 == 20  # the knob is no object
    assert len(np.unique(found.owner[:500])) == 1
    parts = found.parts.owner
    assert max(((parts == k) & knob).sum() / ((parts == k) | knob).sum() for k in np.unique(parts)) > 0.8
    assert {tuple(np.unique(found.owner[np.isin(parts, pair)])) for pair in found.parts.joins} <= {
        (k,) for k in range(20)
    }


def test_without_objects_there_are_no_parts(world):
    gaussians, cameras, frames, _, proposals = world
    none = [np.zeros((0, *masks.shape[1:]), bool) for masks in proposals]
    found = track_masks(frames, scene_of((gaussians, cameras), none))
    assert (found.labels == -1).all()
    assert found.parts.shape == (1, *found.labels.shape)
    assert len(found.part_nodes) == len(found.tree) == 0


def test_parents_come_after_their_children_in_any_tree():
    """Random groups and joins, some of groups that were removed: what joined is under one node, and a tree it is."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        count = int(rng.integers(1, 12))
        kept = rng.uniform(size=count) < 0.8
        number = np.where(kept, np.cumsum(kept) - 1, -1)
        roots, joins, sets = list(range(count)), [], [{g} for g in range(count)]
        while len(roots) > 1 and rng.uniform() < 0.9:
            a, b = sorted(rng.choice(roots, 2, replace=False).tolist())
            joins.append((a, b))
            roots.remove(b)
            sets[a] |= sets[b]
        tree = _object_tree(_Groups(np.zeros(0, int), joins, 10 ** rng.uniform(-3, 0, count)), number)
        own = np.arange(len(tree))
        assert ((tree == -1) | ((tree > own) & (tree >= kept.sum()))).all()
        tops = [regions_of(tree, int(kept.sum()), node) for node in np.flatnonzero(tree < 0)]
        expected = [sorted(number[list(sets[root])][number[list(sets[root])] >= 0].tolist()) for root in roots]
        assert sorted(tops) == sorted(filter(None, expected))


def joined_pair_by_pair(together, both, least):
    """The slow twin: the best pair of all, again and again."""
    groups = [[k] for k in range(len(together))]
    while len(groups) > 1:
        best, pair = -1.0, None
        for i in range(len(groups)):
            for j in range(i):
                shared = both[np.ix_(groups[i], groups[j])].sum()
                ratio = together[np.ix_(groups[i], groups[j])].sum() / shared if shared > 0 else -1.0
                if ratio > best:
                    best, pair = ratio, (i, j)
        if best < least:
            break
        i, j = pair
        groups[j] += groups.pop(i)
    labels = np.empty(len(together), int)
    for number, group in enumerate(groups):
        labels[group] = number
    return labels


def same_partition(a, b):
    return np.array_equal(a[:, None] == a[None], b[:, None] == b[None])


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 14), st.floats(0.05, 0.95))
def test_average_linkage_joins_what_the_slow_twin_joins(seed, count, least):
    rng = np.random.default_rng(seed)
    both = rng.uniform(0.1, 2.0, (count, count))
    ratio = rng.uniform(0.0, 1.0, (count, count))
    both, ratio = both + both.T, (ratio + ratio.T) / 2
    got = linkage(both * ratio, both, least_ratio=least)
    assert same_partition(got, joined_pair_by_pair(both * ratio, both, least))
    np.testing.assert_array_equal(np.unique(got), np.arange(got.max() + 1))


def test_average_linkage_of_ties_large_sums_and_pairs_that_are_hardly_seen_together():
    for scale in (1e-20, 1.0, 1e20):
        both = np.full((40, 40), scale)
        assert linkage(both, both, least_ratio=1.0).max() == 0  # all pairs alike
        assert linkage(0.5 * both, both, least_ratio=0.6).max() == 39
    rng = np.random.default_rng(0)
    rows = rng.random((300, 30)).astype(np.float32) * 1e-3
    both = rows @ rows.T  # as float32 products come: not exactly symmetric sums
    assert linkage(0.9 * both, both, least_ratio=0.5).max() == 0
    both = np.asarray([[1.0, 0.01], [0.01, 1.0]])  # hardly seen together
    assert linkage(both, both, least_ratio=0.5, least_shared=0.0).max() == 0
    assert linkage(both, both, least_ratio=0.5, least_shared=0.02).max() == 1


def turned(rng):
    return np.linalg.qr(rng.standard_normal((3, 3)))[0]


@pytest.mark.parametrize("seed", range(3))
def test_planes_and_coplanarity_of_pieces_equal_the_slow_twins(seed):
    rng = np.random.default_rng(seed)
    points = (rng.standard_normal((60, 3)) * [3.0, 2.0, 0.3]) @ turned(rng) + 1e3
    piece, weights = np.repeat(np.arange(6), 10), rng.uniform(0.1, 1.0, 60)
    gather = sparse.csr_matrix((weights, (piece, np.arange(60))), shape=(6, 60))
    centres, normals = _piece_planes(gather, points)
    for k in range(6):
        own, share = points[piece == k], weights[piece == k] / weights[piece == k].sum()
        middle = (share[:, None] * own).sum(0)
        spread = sum(w * np.outer(x - middle, x - middle) for w, x in zip(share, own))
        np.testing.assert_allclose(centres[k] + points.mean(0), middle, rtol=1e-9)  # relative to the mean of all
        assert abs(np.linalg.eigh(spread)[1][:, 0] @ normals[k]) > 1.0 - 1e-6
    got = _coplanarity(centres, normals, 0.7)
    for i in range(6):
        for j in range(6):
            off = min(abs((centres[j] - centres[i]) @ normals[i]), abs((centres[j] - centres[i]) @ normals[j]))
            assert abs(got[i, j] - np.exp(-((off / 0.7) ** 2))) < 1e-5
    rotation, signs = turned(rng), rng.choice([-1.0, 1.0], (6, 1))
    np.testing.assert_allclose(_coplanarity(centres @ rotation, signs * normals @ rotation, 0.7), got, atol=1e-5)
    np.testing.assert_array_equal(_coplanarity(centres, normals, np.inf), 1.0)


def test_what_rises_out_of_a_plane_leaves_it_and_the_plane_stays_whole():
    """A box on a floor, in one mask with it in half of the views: the surfaces decide, up to the size of the box."""
    rng = np.random.default_rng(0)
    floor = rng.uniform(-5.0, 5.0, (600, 3)) * [1.0, 1.0, 0.001]
    box = np.asarray([2.0, 2.0, 1.2]) + rng.uniform(-0.5, 0.5, (200, 3))
    means, truth = np.concatenate([floor, box]).astype(np.float32), np.repeat([0, 1], [600, 200])
    names = [np.zeros(800, int) if t % 2 else truth for t in range(12)]
    masks = [sparse.csr_matrix((np.ones(800, np.float32), (np.arange(800), name)), shape=(800, 2)) for name in names]
    given = sparse.hstack(masks, format="csr"), sparse.csr_matrix(np.ones((800, 12), np.float32)), np.ones(800), means
    assert group(*given, pieces=80).max() == 0
    assert group(*given, pieces=80, surface_width=5.0).max() == 0
    assert same_partition(group(*given, pieces=80, surface_width=0.8), truth)
    assert group(*given, pieces=200, surface_width=0.8).max() == 0  # pieces of four Gaussians have no plane


def made_scene(views=12, wrong=0, seed=0):
    """Three clumps of points; each view has one mask a clump, but `wrong` views have one mask over all of them."""
    rng = np.random.default_rng(seed)
    centres = np.asarray([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0]])
    truth = np.repeat(np.arange(3), 60)
    means = (centres[truth] + 0.1 * rng.standard_normal((180, 3))).astype(np.float32)
    blocks = []
    for t in range(views):
        label = np.zeros(180, int) if t < wrong else truth
        blocks.append(sparse.csr_matrix((np.ones(180, np.float32), (np.arange(180), label)), shape=(180, 3)))
    visible = sparse.csr_matrix(np.ones((180, views), np.float32))
    return sparse.hstack(blocks, format="csr"), visible, np.ones(180, np.float32), means, truth


@pytest.mark.parametrize("wrong", [0, 4])
def test_views_that_merge_everything_are_outvoted_in_any_order_of_frames_and_masks(wrong):
    membership, visible, weights, means, truth = made_scene(wrong=wrong)
    assert same_partition(group(membership, visible, weights, means, pieces=24), truth)
    cells = group(membership, visible, weights, means, pieces=24, agreement=2.0)  # joins no two pieces
    assert all(len(np.unique(truth[cells == cell])) == 1 for cell in np.unique(cells))
    order = np.random.default_rng(1).permutation(membership.shape[1])
    got = group(membership[:, order], visible[:, ::-1], weights, means, pieces=24)
    assert same_partition(got, truth)


def test_most_views_decide_and_rows_and_frames_that_disagree_are_refused(world, scene):
    membership, visible, weights, means, _ = made_scene(wrong=8)  # of 12
    assert group(membership, visible, weights, means, pieces=24).max() == 0
    assert group(membership, visible, weights, means, pieces=24, agreement=0.7).max() == 2
    with pytest.raises(ValueError, match="N rows"):
        group(membership[1:], visible, weights, means)
    with pytest.raises(ValueError, match="frames"):
        track_masks(world[2][1:], scene)
    with pytest.raises(ValueError, match="seed: got -1"):
        track_masks(world[2], scene, seed=-1)


def test_few_points_and_points_that_are_never_seen():
    membership, visible, weights, means, truth = made_scene()
    for count in (1, 2, 5):
        few = (part[:count] for part in (membership, visible, weights, means))
        assert group(*few).max() == 0  # all of one clump
    weights[::7], means[::7] = 0.0, np.nan
    got = group(membership, visible, weights, means, pieces=24)
    assert (got[::7] == -1).all()
    assert same_partition(got[weights > 0], truth[weights > 0])
    assert (group(membership, visible, 0 * weights, means) == -1).all()
