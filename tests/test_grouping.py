import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import sparse

from jsecon.language.grouping import average_linkage, group_by_consensus, scene_pieces


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


@given(st.integers(0, 10**6), st.integers(1, 14), st.floats(0.05, 0.95))
def test_average_linkage_joins_what_the_slow_twin_joins(seed, count, least):
    rng = np.random.default_rng(seed)
    both = rng.uniform(0.1, 2.0, (count, count))
    ratio = rng.uniform(0.0, 1.0, (count, count))
    both, ratio = both + both.T, (ratio + ratio.T) / 2
    got = average_linkage(both * ratio, both, least_ratio=least)
    assert same_partition(got, joined_pair_by_pair(both * ratio, both, least))
    np.testing.assert_array_equal(np.unique(got), np.arange(got.max() + 1))


def test_average_linkage_ends_on_ties_and_at_large_sums():
    for scale in (1e-20, 1.0, 1e20):
        both = np.full((40, 40), scale)
        assert average_linkage(both, both, least_ratio=1.0).max() == 0  # all pairs alike
        assert average_linkage(0.5 * both, both, least_ratio=0.6).max() == 39
    rng = np.random.default_rng(0)
    rows = rng.random((300, 30)).astype(np.float32) * 1e-3
    both = rows @ rows.T  # as float32 products come: not exactly symmetric sums
    assert average_linkage(0.9 * both, both, least_ratio=0.5).max() == 0


def test_pairs_that_are_hardly_seen_together_stay_apart():
    both = np.asarray([[1.0, 0.01], [0.01, 1.0]])
    assert average_linkage(both, both, least_ratio=0.5, least_shared=0.0).max() == 0
    assert average_linkage(both, both, least_ratio=0.5, least_shared=0.02).max() == 1


def scene(views=12, wrong=0, seed=0):
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
def test_views_that_merge_everything_are_outvoted(wrong):
    membership, visible, weights, means, truth = scene(wrong=wrong)
    assert same_partition(group_by_consensus(membership, visible, weights, means, pieces=24), truth)


def test_most_views_decide():
    membership, visible, weights, means, _ = scene(wrong=8)  # of 12
    assert group_by_consensus(membership, visible, weights, means, pieces=24).max() == 0
    assert group_by_consensus(membership, visible, weights, means, pieces=24, agreement=0.7).max() == 2


def test_order_of_the_frames_and_of_their_masks_does_not_matter():
    membership, visible, weights, means, truth = scene(wrong=3)
    order = np.random.default_rng(1).permutation(membership.shape[1])
    got = group_by_consensus(membership[:, order], visible[:, ::-1], weights, means, pieces=24)
    assert same_partition(got, truth)


def test_what_is_never_seen_belongs_to_nothing():
    membership, visible, weights, means, truth = scene()
    weights[::7] = 0.0
    got = group_by_consensus(membership, visible, weights, means, pieces=24)
    assert (got[::7] == -1).all()
    seen = weights > 0
    assert same_partition(got[seen], truth[seen])
    assert (group_by_consensus(membership, visible, np.zeros(180, np.float32), means) == -1).all()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_points(count):
    membership, visible, weights, means, _ = (part[:count] for part in scene())
    assert group_by_consensus(membership, visible, weights, means).max() == 0  # all of one clump


def test_pieces_are_near_and_deterministic_and_far_things_do_not_swallow_them():
    membership, visible, weights, means, truth = scene()
    means = np.concatenate([means, [[1e6, 0, 0]]]).astype(np.float32)
    far = sparse.csr_matrix((1, membership.shape[1]), dtype=np.float32)
    membership = sparse.vstack([membership, far], format="csr")
    visible = sparse.vstack([visible, visible[:1]], format="csr")
    weights = np.append(weights, 1.0).astype(np.float32)
    piece = scene_pieces(membership, visible, weights, means, pieces=24)
    np.testing.assert_array_equal(piece, scene_pieces(membership, visible, weights, means, pieces=24))
    for number in range(piece.max() + 1):
        assert len(np.unique(truth[piece[:-1] == number])) <= 1
    assert len(np.unique(piece[:-1])) >= 12


def test_rows_that_disagree_are_refused():
    membership, visible, weights, means, _ = scene()
    with pytest.raises(ValueError, match="N rows"):
        group_by_consensus(membership[1:], visible, weights, means)
