"""A tracker without any weights: masks followed through the scene's own Gaussians, whose votes on the frames' atoms
(jsecon.association.views) lift a mask and render it into the other frames."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8

from jsecon.association.atoms import atom_coverage, label_shares, one_hot, sum_entries
from jsecon.association.views import FrameView, SceneViews, claim_atoms
from jsecon.errors import require_shape
from jsecon.types import Camera, Gaussians


class GeometricTracker:
    """Tracker (jsecon.vision.protocols) through the Gaussians of the scene itself.

    gaussians, cameras, proposals: see `SceneViews`.

    The prompts are tracked against their rivals: the other proposals of their frame, and the rest of it. From that
    frame the track goes outward, always on to the frame that shares the most with one already visited, and every frame
    adds what it shows: evidence e_ib, the weight that Gaussian i casts on the masks of b; ownership is e_ib^2 / sum_b
    e_ib^2. In the next frame the atoms are claimed (`claim_atoms`). Occlusion is that of the full scene's compositing.
    A Gaussian counts as known in proportion to the best look that a visited frame had of it, in full from half of
    what the frame at hand sees.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Camera,
        proposals: Callable[[int], np.ndarray] | Sequence[np.ndarray],
        *,
        atoms_per_frame: int = 256,
    ):
        self.views = SceneViews(gaussians, cameras, proposals, atoms_per_frame=atoms_per_frame)

    def __call__(
        self, frames: UInt8[np.ndarray, "t h w 3"], index: int, prompts: Bool[np.ndarray, "b _ _"]
    ) -> Int16[np.ndarray, "t h w"]:
        """frames (T, H, W, 3) uint8, masks `prompts` (B, H, W) bool of frame `index` -> labels (T, H, W) int16.

        The labels at `index` are the prompts themselves (the earlier one where they overlap).
        """
        count, height, width = frames.shape[:3]
        require_shape("prompts", prompts, ("B", height, width), "Give masks of the frame's own size.")
        labels = np.full((count, height, width), -1, np.int16)
        for b in reversed(range(len(prompts))):
            labels[index][prompts[b]] = b
        views = self.views.all(frames)
        if not len(prompts):
            return labels
        classes = self._with_rivals(labels[index], index, len(prompts))
        evidence = np.zeros((self.views.count, len(classes)), np.float32)
        best = np.zeros(len(evidence), np.float32)
        start = views[index]
        said = start.votes @ atom_coverage(start.atoms, classes, start.votes.shape[1]).T
        evidence[start.seen] = start.clarity[:, None] * said  # one seen from its side, over an outline, says little
        best[start.seen] = start.clarity
        owners = {}
        order = self._outward(index)
        for t in order * 2:  # once outward, and once more with what all other frames say
            view = views[t]
            here = evidence[view.seen]
            if t in owners:
                rows, columns, said = _said(view, owners[t], len(classes))
                here[rows, columns] -= said
            if not (here[:, : len(prompts)] > 1e-3).any():  # nothing of the prompts can be seen
                continue
            owners[t] = self._match(view, here, best[view.seen])
            rows, columns, said = _said(view, owners[t], len(classes))
            here[rows, columns] += said
            evidence[view.seen] = here
            best[view.seen] = np.maximum(best[view.seen], view.clarity)
        for t, owner in owners.items():
            labels[t] = np.where(owner < len(prompts), owner, -1).astype(np.int16)[views[t].atoms]
        return labels

    def _with_rivals(self, labels: Int16[np.ndarray, "h w"], index: int, count: int) -> Bool[np.ndarray, "c h w"]:
        """(B + C, H, W) bool: the prompts, and what they share the frame with: its other proposals, and the rest."""
        classes = [labels == b for b in range(count)]
        free = labels < 0
        for mask in np.asarray(self.views.propose(index), bool):
            rival = mask & free
            if rival.any():
                classes.append(rival)
                free &= ~rival
        return np.stack([*classes, free])

    def consistent(
        self, frames: UInt8[np.ndarray, "t h w 3"], labels: Int[np.ndarray, "t h w"]
    ) -> Int[np.ndarray, "t h w"]:
        """labels (T, H, W) with every region given away whose Gaussians belong to another one in the sum of all views.

        A region is kept if at least half of the weight that it casts falls on Gaussians on which no other region
        casts more; otherwise (a part that few frames tell from the rest, a shadow) its pixels become the region's that
        owns most of it. Numbers of regions are kept, so some may end without a pixel.
        """
        labels = np.array(labels)
        count = int(labels.max(initial=-1)) + 1
        for _ in range(4 if count else 0):  # what is given away may tip another region; seldom more than two rounds
            entries = []
            for t, view in enumerate(self.views.all(frames)):
                shares = label_shares(view.atoms, labels[t], view.votes.shape[1], count)
                cast = (view.votes @ shares).tocoo()
                entries.append((cast.data, view.seen[cast.row], cast.col))
            votes = sum_entries(entries, (self.views.count, count))
            winner = np.asarray(votes.argmax(axis=1)).reshape(-1)
            # (R, R): row r's weight by the region that owns the Gaussian
            cast = (votes.T @ one_hot(winner, count)).toarray()
            heir = cast.argmax(1)
            total = np.maximum(cast.sum(1), 1e-12)
            lost = (heir != np.arange(count)) & (np.diagonal(cast) < 0.5 * total)
            if not lost.any():
                break
            table = np.append(np.where(lost, heir, np.arange(count)), -1).astype(labels.dtype)
            labels = table[labels]
        return labels

    def _outward(self, index: int) -> list[int]:
        """The other frames in the order in which a maximum spanning tree of what they share grows from `index`
        (Prim)."""
        shared = self.views.shared
        nearest, order = shared[index].copy(), []
        left = set(range(len(nearest))) - {index}
        while left:
            order.append(max(left, key=lambda t: (nearest[t], -abs(t - index), t)))
            left.remove(order[-1])
            nearest = np.maximum(nearest, shared[order[-1]])
        return order

    def _match(
        self, view: FrameView, evidence: Float[np.ndarray, "n c"], best: Float[np.ndarray, " n"]
    ) -> Int[np.ndarray, " a"]:
        """The class (A,) that owns each atom of a view, -1 = none; evidence (n, B + C) of the Gaussians it shows, and
        the clarity (n,) of the best look at each in the frames that the evidence is from."""
        # On an outline a Gaussian leans over the neighbours and is counted with them, in view after view. So one tells
        # something only once some view has seen about as much of it as this one does, and assigned what it saw.
        assigned = evidence.sum(1) / np.maximum(view.totals * view.clarity, 1e-6)
        known = np.minimum(np.minimum(best / np.maximum(view.clarity, 1e-6), assigned) / 0.5, 1.0)
        known = np.square(known).astype(np.float32)[:, None]
        # Of most classes a frame shows nothing, of most of what it shows the visited frames say nothing: left out.
        rows, classes = np.flatnonzero(known), np.flatnonzero(evidence.any(0))
        # Gaussians on an outline lean into the neighbours: squares side with the majority.
        owned = np.square(evidence[rows])
        owned *= known[rows] / np.maximum(owned.sum(1, keepdims=True), 1e-12)
        votes = view.votes[rows]
        owner = claim_atoms(view, votes.T @ owned[:, classes], votes.T @ known[rows])
        return np.where(owner >= 0, classes[owner], -1)


def _said(view: FrameView, owner: Int[np.ndarray, " a"], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a view that gives its atoms to classes (A,), -1 = none, of `count`, says of its Gaussians: row, class and
    weight, by the clarity of the look, of each entry that is not 0."""
    cast = (view.votes @ one_hot(owner, count)).tocoo()
    return cast.row, cast.col, view.clarity[cast.row] * cast.data
