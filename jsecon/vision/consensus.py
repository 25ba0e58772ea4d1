"""Masklets without a tracker: what the views agree on, from any segmenter's masks and the scene's own Gaussians."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int16, UInt8
from scipy import sparse

from jsecon.language.grouping import group_by_consensus
from jsecon.vision.atoms import Sparse
from jsecon.vision.views import SceneViews, View, claim_atoms


def consensus_masklets(
    frames: UInt8[np.ndarray, "t h w 3"],
    scene: SceneViews,
    *,
    agreement: float = 0.5,
    pieces: int = 3000,
    least_clarity: float = 0.1,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Int16[np.ndarray, "t h w"]:
    """labels (T, H, W) int16, -1 = none, of frames (T, H, W, 3) uint8 whose proposals `scene` holds.

    The Gaussians are grouped by the views' consensus (`group_by_consensus`: `agreement`, `pieces`, `seed`; a frame is
    heard on the Gaussians of which it sees at least `least_clarity` of the best look at them), and the groups claim
    each frame's atoms (`claim_atoms`). Independent of the order of the frames. `progress(done, total)` counts frames.
    """
    views = scene.all(frames, progress)
    membership, visible, weights = mask_signatures(views, scene.count, least_clarity=least_clarity)
    owner = group_by_consensus(
        membership,
        visible,
        weights,
        np.asarray(scene.gaussians.means, np.float32),
        agreement=agreement,
        pieces=pieces,
        seed=seed,
    )
    count = int(owner.max(initial=-1)) + 1
    labels = np.full(frames.shape[:3], -1, np.int16)
    for image, view in zip(labels, views):
        known = np.flatnonzero(owner[view.seen] >= 0)
        ones = np.ones(len(known), np.float32)
        owned = sparse.csr_matrix((ones, (known, owner[view.seen[known]])), shape=(len(view.seen), count))
        if count:
            mass = view.on_atoms(owned)
            image[:] = claim_atoms(view, mass, mass.sum(1, keepdims=True))[view.atoms]
    return labels


def mask_signatures(
    views: list[View], count: int, *, least_clarity: float = 0.1, negligible: float = 0.05
) -> tuple[Sparse, Sparse, np.ndarray]:
    """(membership (N, M), visible (N, T), weights (N,)): what `group_by_consensus` asks for, of N = `count` Gaussians.

    Masks that lie over each other in a frame share the Gaussian: a frame's row adds up to at most 1, so a frame with
    many levels of masks has no more say than one with a single partition.
    """
    rows, columns, shares, seen, frame = [], [], [], [], []
    weights = np.zeros(count, np.float64)
    start = 0
    for t, view in enumerate(views):
        totals = view.totals
        weights[view.seen] += totals
        clear = view.clarity >= least_clarity
        # Two things are together with the mean, over the layers of masks, of the product of their shares.
        layers = np.maximum(view.proposals.sum(0).max(initial=1.0), 1.0)
        cast = (view.votes @ sparse.csr_matrix(view.proposals.T)).tocoo()
        share = cast.data / np.maximum(totals[cast.row], 1e-12)
        keep = clear[cast.row] & (share >= negligible)
        rows.append(view.seen[cast.row[keep]])
        columns.append(start + cast.col[keep])
        shares.append(share[keep] / np.sqrt(layers))
        seen.append(view.seen[clear])
        frame.append(np.full(int(clear.sum()), t))
        start += len(view.proposals)
    where = np.concatenate(rows), np.concatenate(columns)
    membership = sparse.csr_matrix((np.concatenate(shares).astype(np.float32), where), shape=(count, start))
    where = np.concatenate(seen), np.concatenate(frame)
    visible = sparse.csr_matrix((np.ones(len(where[0]), np.float32), where), shape=(count, len(views)))
    return membership, visible, (weights / max(len(views), 1)).astype(np.float32)
