"""A tracker without a network: it follows masks through the Gaussians of the scene. Host code.

The votes of the Gaussians on the superpixels of the frames lift a mask and render it into other frames.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8

from jsecon.association.frame_superpixels import (
    FrameSuperpixels,
    SceneSuperpixels,
    assign_superpixels,
    one_hot,
    superpixel_coverage,
)
from jsecon.errors import require_shape
from jsecon.types import Camera, Gaussians


class GeometricTracker:
    """Tracker (jsecon.vision.protocols) through the Gaussians of the scene.

    Prompts are tracked against competing labels: the other proposals of their frame, and the rest of it. From that
    frame the track proceeds to the frame with the largest overlap with a visited one. Every frame adds evidence e_ib,
    the weight of Gaussian i on the masks of class b; ownership is e_ib^2 / sum_b e_ib^2. In the next frame the classes
    are assigned superpixels (`assign_superpixels`). Occlusion is that of the compositing of the full scene. A Gaussian
    counts as known in proportion to its clarity in the visited frames, fully from half of its clarity in the present
    frame.

    `proposals` has the masks (M, H, W) of each frame.
    """

    def __init__(
        self, gaussians: Gaussians, cameras: Camera, proposals: Callable[[int], np.ndarray] | Sequence[np.ndarray]
    ):
        self.views = SceneSuperpixels(gaussians, cameras, proposals)

    def __call__(
        self, frames: UInt8[np.ndarray, "t h w 3"], index: int, prompts: Bool[np.ndarray, "b _ _"]
    ) -> Int16[np.ndarray, "t h w"]:
        """Tracks the masks (B, H, W) of frame `index` through all frames.

        Returns labels (T, H, W): the index of a prompt, or -1; at `index` the prompts (the earlier one if they
        overlap).
        """
        count, height, width = frames.shape[:3]
        require_shape("prompts", prompts, ("B", height, width), "Pass masks of the size of the frame.")
        labels = np.full((count, height, width), -1, np.int16)
        for b in reversed(range(len(prompts))):
            labels[index][prompts[b]] = b
        views = self.views.all(frames)
        if not len(prompts):
            return labels
        classes = self._with_competitors(labels[index], index, len(prompts))
        evidence = np.zeros((self.views.count, len(classes)), np.float32)
        best = np.zeros(len(evidence), np.float32)
        start = views[index]
        weight = start.votes @ superpixel_coverage(start.labels, classes, start.votes.shape[1]).T
        # A Gaussian seen from the side, across an outline, is weak evidence.
        evidence[start.seen] = start.clarity[:, None] * weight
        best[start.seen] = start.clarity
        owners = {}
        order = self._outward(index)
        for t in order * 2:  # once outward, and once with the evidence of all other frames
            view = views[t]
            view_evidence = evidence[view.seen]
            if t in owners:
                rows, columns, weight = _evidence(view, owners[t], len(classes))
                view_evidence[rows, columns] -= weight
            if not (view_evidence[:, : len(prompts)] > 1e-3).any():  # no prompt is visible
                continue
            owners[t] = self._match(view, view_evidence, best[view.seen])
            rows, columns, weight = _evidence(view, owners[t], len(classes))
            view_evidence[rows, columns] += weight
            evidence[view.seen] = view_evidence
            best[view.seen] = np.maximum(best[view.seen], view.clarity)
        for t, owner in owners.items():
            labels[t] = np.where(owner < len(prompts), owner, -1).astype(np.int16)[views[t].labels]
        return labels

    def _with_competitors(self, labels: Int16[np.ndarray, "h w"], index: int, count: int) -> Bool[np.ndarray, "c h w"]:
        """(B + C, H, W) bool masks of the prompts, of the other proposals of the frame, and of its rest."""
        classes = [labels == b for b in range(count)]
        free = labels < 0
        for mask in np.asarray(self.views.propose(index), bool):
            competitor = mask & free
            if competitor.any():
                classes.append(competitor)
                free &= ~competitor
        return np.stack([*classes, free])

    def _outward(self, index: int) -> list[int]:
        """The other frames in the order in which a maximum spanning tree of their overlap grows from `index` (Prim)."""
        shared = self.views.shared
        nearest, order = shared[index].copy(), []
        left = set(range(len(nearest))) - {index}
        while left:
            order.append(max(left, key=lambda t: (nearest[t], -abs(t - index), t)))
            left.remove(order[-1])
            nearest = np.maximum(nearest, shared[order[-1]])
        return order

    def _match(
        self, view: FrameSuperpixels, evidence: Float[np.ndarray, "n c"], best: Float[np.ndarray, " n"]
    ) -> Int[np.ndarray, " a"]:
        """Classes (A,) of the superpixels, or -1. `best` (n,) is the clarity in the best frame so far."""
        # A Gaussian on an outline overlaps its neighbours and is counted with them, in view after view. So it counts
        # only if another view has seen about as much of it as this one does, and has assigned it.
        assigned = evidence.sum(1) / np.maximum(view.totals * view.clarity, 1e-6)
        known = np.minimum(np.minimum(best / np.maximum(view.clarity, 1e-6), assigned) / 0.5, 1.0)
        known = np.square(known).astype(np.float32)[:, None]
        # Most classes are invisible in a frame, and most of its Gaussians have no evidence yet: both are skipped.
        rows, classes = np.flatnonzero(known), np.flatnonzero(evidence.any(0))
        # Gaussians on an outline overlap their neighbours: squares favour the majority.
        owned = np.square(evidence[rows])
        owned *= known[rows] / np.maximum(owned.sum(1, keepdims=True), 1e-12)
        votes = view.votes[rows]
        owner = assign_superpixels(view, votes.T @ owned[:, classes], votes.T @ known[rows])
        return np.where(owner >= 0, classes[owner], -1)


def _evidence(
    view: FrameSuperpixels, owner: Int[np.ndarray, " a"], count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, classes and weights (times clarity) of a view's evidence, by the classes (A,) of its superpixels."""
    cast = (view.votes @ one_hot(owner, count)).tocoo()
    return cast.row, cast.col, view.clarity[cast.row] * cast.data
