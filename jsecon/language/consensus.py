"""Masklets without a tracker: what the views agree on, from any segmenter's masks and the scene's own Gaussians."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int16, UInt8
from scipy import sparse

from jsecon.language.grouping import group_by_consensus
from jsecon.vision.atoms import Sparse
from jsecon.vision.views import SceneViews, View, claim_atoms


def consensus_masklets(
    frames: UInt8[np.ndarray, "t h w 3"],
    scene: SceneViews,
    *,
    agreement: float = 0.4,
    pieces: int = 3000,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Int16[np.ndarray, "t h w"]:
    """labels (T, H, W) int16, -1 = none, of frames (T, H, W, 3) uint8 whose proposals `scene` holds.

    The Gaussians are grouped by the views' consensus (`group_by_consensus`: `agreement`, `pieces`, `seed`), and the
    groups claim each frame's atoms (`claim_atoms`). Independent of the order of the frames. `progress(done, total)`
    counts frames.
    """
    views = scene.all(frames, progress)
    membership, visible, weights = mask_signatures(views, scene.count)
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
    views: list[View], count: int, *, negligible: float = 0.05
) -> tuple[Sparse, Sparse, Float[np.ndarray, " n"]]:
    """(membership (N, M), visible (N, T), weights (N,)): what `group_by_consensus` asks for, of N = `count` Gaussians.

    A frame is heard on a Gaussian by how clearly it sees it, against the frame that sees it best: on an outline it
    leans over the neighbours. Its shares of the masks are squared and made to add up to 1, which sides with the
    majority. Masks that lie over each other share it: a frame with many levels of masks has no more say than one with
    a single partition.
    """
    rows, columns, shares, seen, frame, clarity = [], [], [], [], [], []
    weights = np.zeros(count, np.float64)
    start = 0
    for t, view in enumerate(views):
        totals = view.totals
        weights[view.seen] += totals
        # Two things are together with the mean, over the layers of masks, of the product of their shares.
        layers = np.maximum(view.proposals.sum(0).max(initial=1.0), 1.0)
        cast = (view.votes @ sparse.csr_matrix(view.proposals.T)).tocoo()
        outside = np.maximum(1.0 - np.asarray(cast.sum(1)).ravel() / np.maximum(totals * layers, 1e-12), 0.0)
        share = cast.data / np.maximum(totals[cast.row] * layers, 1e-12)
        norm = np.bincount(cast.row, share**2, len(totals)) + outside**2 / layers
        share = share**2 / np.maximum(norm[cast.row], 1e-12)
        keep = share >= negligible / layers
        rows.append(view.seen[cast.row[keep]])
        columns.append(start + cast.col[keep])
        shares.append((share * np.sqrt(layers) * view.clarity[cast.row])[keep])
        seen.append(view.seen)
        frame.append(np.full(len(view.seen), t))
        clarity.append(view.clarity)
        start += len(view.proposals)
    where = np.concatenate(rows), np.concatenate(columns)
    membership = sparse.csr_matrix((np.concatenate(shares).astype(np.float32), where), shape=(count, start))
    where = np.concatenate(seen), np.concatenate(frame)
    visible = sparse.csr_matrix((np.concatenate(clarity).astype(np.float32), where), shape=(count, len(views)))
    return membership, visible, (weights / max(len(views), 1)).astype(np.float32)
