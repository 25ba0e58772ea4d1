"""Masklets without a tracker: what the views agree on, from any segmenter's masks and the scene's own Gaussians.

Two Gaussians belong together if most views that see both put both into one mask. This is evidence accumulation (Fred &
Jain, PAMI 2005) with the views as the ensemble and the rendering weights as the evidence. A mask that merges two
things, or cuts one, is outvoted by the views that do not. No frame comes first and nothing is tracked, so no error
travels; the idea is that of mask clustering by view consensus (Yan et al., CVPR 2024), between pieces of the scene
instead of masks.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int, Int16, UInt8
from scipy import sparse

from jsecon.association.atoms import Sparse, one_hot, sum_entries
from jsecon.association.views import FrameView, SceneViews, claim_atoms
from jsecon.errors import require
from jsecon.vision.region_graph import relabel_sequential

PIECES = 3000
"""of a scene, at most"""
SKETCH = 24
"""numbers that stand for a Gaussian's masks while pieces are formed"""
ROUNDS = 2
"""of k-means"""
LEAST_SHARED = 0.02
"""of what two groups are seen: groups that fewer views see together are left apart"""
NEGLIGIBLE = 0.05
"""a mask's share of a Gaussian that is left out, where masks lie in one layer"""


def group_by_consensus(
    membership: Sparse,
    visible: Sparse,
    weights: Float[np.ndarray, " n"],
    means: Float[np.ndarray, "n 3"],
    *,
    agreement: float = 0.4,
    pieces: int = PIECES,
    seed: int = 0,
) -> Int[np.ndarray, " n"]:
    """Object (N,) of each Gaussian, 0 .. R-1, -1 = never seen.

    visible (N, T): how well a frame sees the Gaussian, 0 to 1. membership (N, M): share of the Gaussian that lies in a
    mask, times how well the mask's frame sees it; M masks of all frames. weights (N,): how much is seen of each.
    means (N, 3): centres, world units.

    The Gaussians are first gathered into at most `pieces` small pieces (`scene_pieces`), then the pieces are joined by
    `average_linkage` while the views that see two groups put both into one mask with a probability of at least
    `agreement`; groups that hardly any view sees together (LEAST_SHARED) are left apart.
    """
    shapes = [rows.shape for rows in (membership, visible, weights, means)]
    equal = len({shape[0] for shape in shapes}) == 1
    require(equal, "membership, visible, weights, means", shapes, "N rows each", "Give one row per Gaussian.")
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
    owner[live] = average_linkage(together, both, least_ratio=agreement, least_shared=LEAST_SHARED)[piece[live]]
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
    random projection of the masks, from the means of `split_cells`. Two rounds end within 6 % of the sum of squares
    of k-means++ and mini-batches (bonsai, replica_apartment_0), in a tenth to a third of the time.
    """
    piece = np.full(len(means), -1, np.int64)
    live = np.flatnonzero(weights > 0)
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
    centres = _cell_means(points, split_cells(points, min(pieces, max(len(live) // 4, 1))))
    for _ in range(ROUNDS):
        # |p - c|^2 / 2 but for |p|^2 / 2, which is the same for all centres
        lines = np.concatenate([-centres, 0.5 * np.square(centres).sum(1, keepdims=True)], axis=1).astype(np.float32)
        parts = np.array_split(np.pad(points, [(0, 0), (0, 1)], constant_values=1.0), len(points) // 4096 + 1)
        own = relabel_sequential(np.concatenate([(part @ lines.T).argmin(1) for part in parts]))
        centres = _cell_means(points, own)
    piece[live] = own
    return piece


def split_cells(points: Float[np.ndarray, "n d"], count: int) -> Int[np.ndarray, " n"]:
    """Cells (N,), 0 .. K-1, K <= `count`, of points (N, D): round by round, those that spread most along some direction
    are cut there at their mean, up to half of all cells a round. Equal points stay together."""
    cell = np.zeros(len(points), np.int64)
    while (have := int(cell.max()) + 1) < count:
        away = points - _cell_means(points, cell)[cell]
        spread = np.stack([np.bincount(cell, column) for column in np.square(away).T], axis=1)
        axis, most = spread.argmax(1), spread.max(1)
        widest = np.argsort(-most, kind="stable")[: min(count - have, (have + 1) // 2)]
        widest = widest[most[widest] > 1e-9]
        if not len(widest):
            break
        fresh = np.arange(have)
        fresh[widest] = have + np.arange(len(widest))
        cell = np.where(away[np.arange(len(points)), axis[cell]] > 0, fresh[cell], cell)
    return cell


def _cell_means(points: Float[np.ndarray, "n d"], cell: Int[np.ndarray, " n"]) -> Float[np.ndarray, "k d"]:
    return np.stack([np.bincount(cell, column) for column in points.T], axis=1) / np.bincount(cell)[:, None]


def average_linkage(
    together: Float[np.ndarray, "k k"], both: Float[np.ndarray, "k k"], *, least_ratio: float, least_shared: float = 0.0
) -> Int[np.ndarray, " k"]:
    """Groups (K,), 0 .. R-1, of K things, of which the two most alike are joined until none are alike by `least_ratio`.

    With w = `together` and v = `both` (K, K), symmetric, two groups a and b are alike by

        s_ab = W_ab / V_ab,  W_ab = sum of w_ij over i in a, j in b,  V_ab likewise,  where V_ab > 0

    and V_ab >= least_shared sqrt(V_aa V_bb), else not at all: the mean of w / v over all pairs of members, weighted by
    v (average linkage). By chains of nearest neighbours, O(K^2): s of a union lies between those of its parts, so
    chains end in the same groups as joining the best pair of all again and again.
    """
    together, both = ((matrix + matrix.T) / 2.0 for matrix in (together.astype(np.float64), both.astype(np.float64)))
    count = len(together)
    parent = np.arange(count)
    waiting, live = np.ones((2, count), bool)  # a chain may start here; not joined to another yet

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
    return relabel_sequential(parent)


def consensus_masklets(
    frames: UInt8[np.ndarray, "t h w 3"],
    scene: SceneViews,
    *,
    agreement: float = 0.4,
    silent: bool = True,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Int16[np.ndarray, "t h w"]:
    """labels (T, H, W) int16, -1 = none, of frames (T, H, W, 3) uint8 whose proposals `scene` holds.

    The Gaussians are grouped by the views' consensus (`group_by_consensus`), and the groups claim each frame's atoms
    (`claim_atoms`). Independent of the order of the frames. `silent` as for `mask_signatures`. `progress(done, total)`
    counts frames.
    """
    views, means = scene.all(frames, progress), np.asarray(scene.gaussians.means, np.float32)
    owner = group_by_consensus(
        *mask_signatures(views, scene.count, silent=silent), means, agreement=agreement, seed=seed
    )
    count = int(owner.max(initial=-1)) + 1
    labels = np.full(frames.shape[:3], -1, np.int16)
    for image, view in zip(labels, views):
        if count:
            mass = (view.votes.T @ one_hot(owner[view.seen], count)).toarray()
            image[:] = claim_atoms(view, mass, mass.sum(1, keepdims=True))[view.atoms]
    return labels


def pieces_on_masks(
    frames: UInt8[np.ndarray, "t h w 3"],
    scene: SceneViews,
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Int[np.ndarray, " n"], Sparse]:
    """(piece (N,), cast (N, M)): the `scene_pieces` of frames (T, H, W, 3) uint8, and the weight that each Gaussian
    casts on each of the M masks of all frames, in their order: what `language.regions.scene_parts` asks for."""
    views, means = scene.all(frames, progress), np.asarray(scene.gaussians.means, np.float32)
    piece = scene_pieces(*mask_signatures(views, scene.count), means, pieces=PIECES, seed=seed)
    entries, start = [], 0
    for view in views:
        cast = view.on_masks.tocoo()
        entries.append((cast.data, view.seen[cast.row], start + cast.col))
        start += len(view.proposals)
    return piece, sum_entries(entries, (scene.count, start))


def mask_signatures(
    views: list[FrameView], count: int, *, silent: bool = True
) -> tuple[Sparse, Sparse, Float[np.ndarray, " n"]]:
    """(membership (N, M), visible (N, T), weights (N,)): what `group_by_consensus` asks for, of N = `count` Gaussians.

    A frame is heard on a Gaussian by how clearly it sees it, against the frame that sees it best: on an outline it
    leans over the neighbours. Its shares of the masks are squared and made to add up to 1, which sides with the
    majority. Masks that lie over each other share it: a frame with many levels of masks has no more say than one with
    a single partition. Where a Gaussian lies in no mask of a frame, the frame is `silent` on it, by the share that lies
    in none; otherwise it says that the Gaussian belongs with nothing.
    """
    shares, looks, weights, start = [], [], np.zeros(count, np.float64), 0
    for t, view in enumerate(views):
        totals = view.totals
        weights[view.seen] += totals
        # Two things are together with the mean, over the layers of masks, of the product of their shares.
        layers = np.maximum(view.proposals.sum(0).max(initial=1.0), 1.0)
        cast = view.on_masks.tocoo()
        outside = np.maximum(1.0 - np.asarray(cast.sum(1)).ravel() / np.maximum(totals * layers, 1e-12), 0.0)
        share = cast.data / np.maximum(totals[cast.row] * layers, 1e-12)
        norm = np.bincount(cast.row, share**2, len(totals)) + outside**2 / layers
        share = share**2 / np.maximum(norm[cast.row], 1e-12)
        heard = view.clarity * (np.bincount(cast.row, share, len(totals)) if silent else 1.0)
        keep = share >= NEGLIGIBLE / layers
        share = (share * np.sqrt(layers) * view.clarity[cast.row])[keep].astype(np.float32)
        shares.append((share, view.seen[cast.row[keep]], start + cast.col[keep]))
        looks.append((heard.astype(np.float32), view.seen, np.full(len(view.seen), t)))
        start += len(view.proposals)
    membership, visible = sum_entries(shares, (count, start)), sum_entries(looks, (count, len(views)))
    return membership, visible, (weights / max(len(views), 1)).astype(np.float32)
