"""Gaussians into objects by what the views agree on: two belong together if most views that see both put both into one
mask.

This is evidence accumulation (Fred & Jain, PAMI 2005) with the views as the ensemble and the rendering weights as the
evidence. A mask that merges two things, or cuts one, is outvoted by the views that do not. No frame comes first and
nothing is tracked, so no error travels; the idea is that of mask clustering by view consensus (Yan et al., CVPR 2024),
between pieces of the scene instead of masks.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from sklearn.cluster import MiniBatchKMeans

from jsecon.errors import require
from jsecon.vision.atoms import Sparse

SKETCH = 24
"""numbers that stand for a Gaussian's masks while pieces are formed"""


def group_by_consensus(
    membership: Sparse,
    visible: Sparse,
    weights: Float[np.ndarray, " n"],
    means: Float[np.ndarray, "n 3"],
    *,
    agreement: float = 0.4,
    pieces: int = 3000,
    least_shared: float = 0.02,
    seed: int = 0,
) -> Int[np.ndarray, " n"]:
    """Object (N,) of each Gaussian, 0 .. R-1, -1 = never seen.

    visible (N, T): how well a frame sees the Gaussian, 0 to 1. membership (N, M): share of the Gaussian that lies in a
    mask, times how well the mask's frame sees it; M masks of all frames. weights (N,): how much is seen of each.
    means (N, 3): centres, world units.

    The Gaussians are first gathered into at most `pieces` small pieces (`scene_pieces`), then the pieces are joined by
    `average_linkage` while the views that see two groups put both into one mask with a probability of at least
    `agreement`; groups that hardly any view sees together (below `least_shared` of what each is seen) are left apart.
    """
    require(
        membership.shape[0] == visible.shape[0] == len(weights) == len(means),
        "membership, visible, weights, means",
        got=(membership.shape, visible.shape, weights.shape, means.shape),
        expected="N rows each",
        remedy="Give one row a Gaussian.",
    )
    piece = scene_pieces(membership, visible, weights, means, pieces=pieces, seed=seed)
    live = np.flatnonzero(piece >= 0)
    owner = np.full(len(piece), -1, np.int64)
    if not len(live):
        return owner
    shape = (int(piece.max()) + 1, len(piece))
    gather = sparse.csr_matrix((weights[live], (piece[live], live)), shape=shape)
    in_masks, in_view = gather @ membership, gather @ visible
    together = (in_masks @ in_masks.T).toarray()
    both = (in_view @ in_view.T).toarray()
    owner[live] = average_linkage(together, both, least_ratio=agreement, least_shared=least_shared)[piece[live]]
    return owner


def scene_pieces(
    membership: Sparse,
    visible: Sparse,
    weights: Float[np.ndarray, " n"],
    means: Float[np.ndarray, "n 3"],
    *,
    pieces: int,
    seed: int = 0,
) -> Int[np.ndarray, " n"]:
    """Piece (N,) of each Gaussian, -1 where `weights` is 0: near each other in space, and in the same masks.

    k-means over the centres (distances beyond the scene's middle half shrink, so that far things get few pieces) and a
    random projection of the masks.
    """
    piece = np.full(len(means), -1, np.int64)
    live = np.flatnonzero(weights > 0)
    count = min(pieces, max(len(live) // 4, 1))
    if not len(live):
        return piece
    centred = means[live] - np.median(means[live], axis=0)
    centred = centred / max(1.5 * float(np.median(np.abs(centred))), 1e-12)
    reach = np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1.0)
    centred = centred * (2.0 - 1.0 / reach) / reach
    rng = np.random.default_rng(seed)
    basis = rng.standard_normal((membership.shape[1], SKETCH)).astype(np.float32)
    sketch = membership[live] @ basis
    sketch /= np.maximum(np.linalg.norm(sketch, axis=1, keepdims=True), 1e-12)
    points = np.concatenate([4.0 * centred, sketch], axis=1).astype(np.float32)
    means_of = MiniBatchKMeans(count, n_init=1, batch_size=8192, max_iter=20, random_state=seed).fit(points)
    piece[live] = np.unique(means_of.labels_, return_inverse=True)[1]
    return piece


def average_linkage(
    together: Float[np.ndarray, "k k"],
    both: Float[np.ndarray, "k k"],
    *,
    least_ratio: float,
    least_shared: float = 0.0,
) -> Int[np.ndarray, " k"]:
    """Groups (K,), 0 .. R-1, of K things joined while the best pair's together / both is at least `least_ratio`.

    `together` and `both` (K, K), symmetric, are sums over the members, so they add up as groups grow and the ratio is
    the mean over all pairs of members, weighted by `both`: average linkage. A pair counts only where `both` is at least
    `least_shared` of the geometric mean of the two's own. By chains of nearest neighbours, O(K^2): the ratio of a union
    lies between those of its parts, so chains end in the same groups as joining the best pair of all again and again.
    """
    together, both = ((matrix + matrix.T) / 2.0 for matrix in (together.astype(np.float64), both.astype(np.float64)))
    count = len(together)
    parent = np.arange(count)
    waiting = np.ones(count, bool)
    """a chain may start here"""
    live = np.ones(count, bool)

    def ratios(a: int) -> Float[np.ndarray, " k"]:
        own = np.sqrt(np.maximum(both[a, a] * np.diagonal(both), 0.0))
        eligible = live & (both[a] > 0) & (both[a] >= least_shared * own)
        row = np.where(eligible, together[a] / np.maximum(both[a], 1e-300), -1.0)
        row[a] = -1.0
        return row

    chain: list[int] = []
    while True:
        if not chain:
            starts = np.flatnonzero(waiting & live)
            if not len(starts):
                break
            chain = [int(starts[0])]
        a = chain[-1]
        row = ratios(a)
        b = int(row.argmax())
        if row[b] < least_ratio:
            waiting[a] = False
            chain = []
        elif len(chain) > 1 and row[chain[-2]] >= row[b]:
            b = chain[-2]
            chain = chain[:-2]
            a, b = min(a, b), max(a, b)
            for matrix in (together, both):  # exactly symmetric, or rounding sends a chain in circles
                own = matrix[a, a] + 2.0 * matrix[a, b] + matrix[b, b]
                matrix[a] += matrix[b]
                matrix[:, a] = matrix[a]
                matrix[a, a] = own
            parent[b], live[b], waiting[a] = a, False, True
        else:
            chain.append(b)
    while not np.array_equal(parent, parent[parent]):
        parent = parent[parent]
    return np.unique(parent, return_inverse=True)[1]
