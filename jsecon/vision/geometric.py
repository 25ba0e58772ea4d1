"""A tracker without any weights: masks followed through the scene's own Gaussians.

With the geometry frozen, a frame's image is linear in the Gaussians' features: a pixel is sum_i w_ip f_i with
w = alpha T, occlusion included. So one pass over each frame, which sums w over the pixels of small image regions
("atoms": superpixels cut by the frame's proposals), holds all that tracking needs: lifting a mask to the Gaussians and
rendering it into another frame are then products with that frame's sparse matrix V (N Gaussians x A atoms), and no
prompt costs a render. Masks come out cut along atoms, which follow the image's edges.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, Int16, UInt8
from scipy import sparse

from jsecon.errors import require
from jsecon.language.votes import region_votes
from jsecon.splat.tiles import plan_capacity
from jsecon.types import Camera, Gaussians
from jsecon.vision.atoms import SMALLEST, Sparse, coverage, image_atoms, label_shares

_CHUNK = 64
"""atoms are counted in multiples of this, so that few shapes are compiled"""


@dataclasses.dataclass(frozen=True)
class _View:
    """What one frame says about the Gaussians."""

    atoms: np.ndarray
    """(H, W) int32 atom of each pixel, 0 .. A-1."""
    seen: np.ndarray
    """(n,) the Gaussians that the frame shows."""
    votes: Sparse
    """(n, A) sum of alpha T over the atom's pixels."""
    to_atoms: Sparse
    """(A, n) the same, transposed."""
    proposals: np.ndarray
    """(M, A) float32 share of each atom that lies in each proposal."""
    clarity: np.ndarray
    """(n,) in (0, 1]: the cross-section that is seen of each, against the frame that sees most of it."""
    clear: Sparse
    """(n, A) the votes times the clarity: a Gaussian seen from its side, over an outline, says little."""

    @property
    def totals(self) -> np.ndarray:
        """(n,) weight that each Gaussian casts in the frame."""
        return np.asarray(self.votes.sum(1)).ravel()


class GeometricTracker:
    """Tracker (jsecon.vision.protocols) through the Gaussians of the scene itself.

    gaussians: the scene. cameras: batch of T, one a frame. proposals: a function of a frame's index, or a sequence with
    one entry a frame, giving masks (M, H, W) bool; they may overlap.

    The prompts are tracked against their rivals: the other proposals of their frame, and the rest of it. From that
    frame the track goes outward, always on to the frame that shares the most with one already visited, and every frame
    adds what it shows: evidence e_ib, the weight that Gaussian i casts on the masks of b; ownership is e_ib^2 / sum_b
    e_ib^2. In the next frame a proposal goes to the one that owns the largest part of its known weight, if that is at
    least `proposal_share`. If the proposal also holds at least `merger` of what is seen of others, each of its atoms
    goes to whom of them owns most of it. An atom that no proposal brings goes to whom owns at least `atom_share` of it.
    Nothing is decided where less than `known_share` of the weight is known, nor on atoms that the Gaussians cover by
    less than `covered`. Occlusion is that of the full scene's compositing. A Gaussian counts as known in proportion to
    the best look that a visited frame had of it, in full from `glimpse` times what the frame at hand sees.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Camera,
        proposals: Callable[[int], np.ndarray] | Sequence[np.ndarray],
        *,
        atoms_per_frame: int = 256,
        proposal_share: float = 0.4,
        atom_share: float = 0.6,
        merger: float = 0.5,
        known_share: float = 0.5,
        covered: float = 0.2,
        glimpse: float = 0.5,
        capacity: int | None = None,
    ):
        require(
            atoms_per_frame > 0,
            "atoms_per_frame",
            got=atoms_per_frame,
            expected="at least 1",
            remedy="Use about 200 for small frames.",
        )
        self.gaussians, self.cameras = gaussians, cameras
        # Planned once for all views: one compiled shape.
        self.capacity = plan_capacity(gaussians, cameras) if capacity is None else capacity
        self.proposal_share, self.atom_share = proposal_share, atom_share
        self.merger, self.known_share, self.covered, self.glimpse = merger, known_share, covered, glimpse
        self.atoms_per_frame = atoms_per_frame
        self._propose = proposals if callable(proposals) else proposals.__getitem__
        self._views: dict[int, _View] = {}
        self._shared = np.zeros((0, 0), np.float32)

    def __call__(
        self, frames: UInt8[np.ndarray, "t h w 3"], index: int, prompts: Bool[np.ndarray, "b _ _"]
    ) -> Int16[np.ndarray, "t h w"]:
        """frames (T, H, W, 3) uint8, masks `prompts` (B, H, W) bool of frame `index` -> labels (T, H, W) int16.

        The labels at `index` are the prompts themselves (the earlier one where they overlap).
        """
        count, height, width = frames.shape[:3]
        require(
            (*self.cameras.fx.shape, self.cameras.height, self.cameras.width) == (count, height, width),
            "frames",
            got=frames.shape,
            expected=f"{(*self.cameras.fx.shape, self.cameras.height, self.cameras.width, 3)}",
            remedy="Give the frames of the tracker's own cameras, the same at every call.",
        )
        require(
            prompts.shape[1:] == (height, width),
            "prompts",
            got=prompts.shape,
            expected=f"(B, {height}, {width})",
            remedy="Give masks of the frame's own size.",
        )
        labels = np.full((count, height, width), -1, np.int16)
        for b in reversed(range(len(prompts))):
            labels[index][prompts[b]] = b
        if not len(prompts):
            return labels
        views = self._prepare(frames)
        classes = self._with_rivals(labels[index], index, len(prompts))
        evidence = np.zeros((self.gaussians.means.shape[0], len(classes)), np.float32)
        best = np.zeros(len(evidence), np.float32)
        start = views[index]
        evidence[start.seen] = start.clear @ coverage(start.atoms, classes, start.votes.shape[1]).T
        best[start.seen] = start.clarity
        owners = {}
        order = self._outward(index)
        for t in order * 2:  # once outward, and once more with what all other frames say
            view = views[t]
            here = evidence[view.seen]
            if t in owners:
                here -= view.clear @ _one_hot(owners[t], len(classes))
            if not (here[:, : len(prompts)] > 1e-3).any():  # nothing of the prompts can be seen
                continue
            owners[t] = self._match(view, here, best[view.seen])
            evidence[view.seen] = here + view.clear @ _one_hot(owners[t], len(classes))
            best[view.seen] = np.maximum(best[view.seen], view.clarity)
        for t, owner in owners.items():
            labels[t] = np.where(owner < len(prompts), owner, -1).astype(np.int16)[views[t].atoms]
        return labels

    def _with_rivals(self, labels: Int16[np.ndarray, "h w"], index: int, count: int) -> Bool[np.ndarray, "c h w"]:
        """(B + C, H, W) bool: the prompts, and what they share the frame with: its other proposals, and the rest."""
        classes = [labels == b for b in range(count)]
        free = labels < 0
        for mask in np.asarray(self._propose(index), bool):
            rival = mask & free
            if rival.any():
                classes.append(rival)
                free &= ~rival
        return np.stack([*classes, free])

    def consistent(
        self, frames: UInt8[np.ndarray, "t h w 3"], labels: Int[np.ndarray, "t h w"], *, least_own: float = 0.5
    ) -> Int[np.ndarray, "t h w"]:
        """labels (T, H, W) with every region given away whose Gaussians belong to another one in the sum of all views.

        A region is kept if at least `least_own` of the weight that it casts falls on Gaussians on which no other region
        casts more; otherwise (a part that few frames tell from the rest, a shadow) its pixels become the region's that
        owns most of it. Numbers of regions are kept, so some may end without a pixel.
        """
        labels = np.array(labels)
        count = int(labels.max(initial=-1)) + 1
        for _ in range(4 if count else 0):  # what is given away may tip another region; seldom more than two rounds
            entries = []
            for t in range(len(frames)):
                view = self.view(frames, t)
                shares = label_shares(view.atoms, labels[t], view.votes.shape[1], count)
                cast = (view.votes @ shares).tocoo()
                entries.append((cast.data, view.seen[cast.row], cast.col))
            weights, rows, columns = (np.concatenate(parts) for parts in zip(*entries))
            shape = (self.gaussians.means.shape[0], count)
            votes = sparse.csr_matrix((weights, (rows, columns)), shape=shape)  # sums what repeats
            winner = np.asarray(votes.argmax(axis=1)).reshape(-1)
            owner = sparse.csr_matrix((np.ones(shape[0], np.float32), (np.arange(shape[0]), winner)), shape=shape)
            cast = (votes.T @ owner).toarray()  # (R, R): row r's weight by the region that owns the Gaussian
            heir = cast.argmax(1)
            total = np.maximum(cast.sum(1), 1e-12)
            lost = (heir != np.arange(count)) & (np.diagonal(cast) < least_own * total)
            if not lost.any():
                break
            table = np.append(np.where(lost, heir, np.arange(count)), -1).astype(labels.dtype)
            labels = table[labels]
        return labels

    def view(self, frames: UInt8[np.ndarray, "t h w 3"], t: int) -> _View:
        """The frame's atoms and votes; computed once."""
        if t not in self._views:
            masks = np.asarray(self._propose(t), bool)
            atoms = image_atoms(frames[t], masks, count=self.atoms_per_frame)
            number = int(atoms.max()) + 1
            padded = -(-number // _CHUNK) * _CHUNK
            votes = region_votes(
                self.gaussians,
                self.cameras[t : t + 1],
                atoms[None].astype(np.int32),
                padded,
                top=12,
                capacity=self.capacity,
            )
            require(
                int(votes.overflow) == 0,
                "capacity",
                got=f"{self.capacity}, {int(votes.overflow)} pairs too few in frame {t}",
                expected="room for every (tile, Gaussian) pair",
                remedy="Leave capacity out: it is planned then.",
            )
            matrix = _sparse(np.asarray(votes.regions), np.asarray(votes.weights), number)
            seen = np.flatnonzero(np.diff(matrix.indptr))
            matrix = matrix[seen]
            # How clearly it sees them is known once all views are: see _prepare.
            clear = np.ones(len(seen), np.float32)
            within = coverage(atoms, masks, number)
            self._views[t] = _View(atoms, seen, matrix, matrix.T.tocsr(), within, clear, matrix)
        return self._views[t]

    def _prepare(self, frames: UInt8[np.ndarray, "t h w 3"]) -> list[_View]:
        """All views, each with how clearly it sees its Gaussians, and what any two of them share."""
        views = [self.view(frames, t) for t in range(len(frames))]
        if not self._shared.size:
            looks = np.zeros((len(views), self.gaussians.means.shape[0]), np.float32)
            for t, view in enumerate(views):
                camera = self.cameras[t]
                pose = np.asarray(camera.world_to_camera)
                depths = np.asarray(self.gaussians.means)[view.seen] @ pose[2, :3] + pose[2, 3]
                looks[t, view.seen] = view.totals * depths**2 / float(camera.fx * camera.fy)
            highest = np.maximum(looks.max(0), 1e-30)
            for t, view in enumerate(views):
                clarity = looks[t, view.seen] / highest[view.seen]
                clear = sparse.csr_matrix(view.votes.multiply(clarity[:, None]))
                self._views[t] = dataclasses.replace(view, clarity=clarity, clear=clear)
            looks /= np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-30)
            self._shared = looks @ looks.T
        return [self._views[t] for t in range(len(frames))]

    def _outward(self, index: int) -> list[int]:
        """The other frames in the order in which a maximum spanning tree of what they share grows from `index`
        (Prim)."""
        nearest, order = self._shared[index].copy(), []
        left = set(range(len(nearest))) - {index}
        while left:
            order.append(max(left, key=lambda t: (nearest[t], -abs(t - index), t)))
            left.remove(order[-1])
            nearest = np.maximum(nearest, self._shared[order[-1]])
        return order

    def _match(
        self, view: _View, evidence: Float[np.ndarray, "n c"], best: Float[np.ndarray, " n"]
    ) -> Int[np.ndarray, " a"]:
        """The class (A,) that owns each atom of a view, -1 = none; evidence (n, B + C) of the Gaussians it shows, and
        the clarity (n,) of the best look at each in the frames that the evidence is from."""
        # On an outline a Gaussian leans over the neighbours and is counted with them, in view after view. So one tells
        # something only once some view has seen about as much of it as this one does, and assigned what it saw.
        assigned = evidence.sum(1) / np.maximum(view.totals * view.clarity, 1e-6)
        known = np.minimum(np.minimum(best / np.maximum(view.clarity, 1e-6), assigned) / self.glimpse, 1.0)
        known = np.square(known).astype(np.float32)[:, None]
        # Gaussians on an outline lean into the neighbours: squares side with the majority.
        owned = np.square(evidence)
        owned *= known / np.maximum(owned.sum(1, keepdims=True), 1e-12)
        mass, known_mass = view.to_atoms @ owned, view.to_atoms @ known  # (A, B + C), (A, 1)
        total = np.asarray(view.to_atoms.sum(1), np.float32)  # (A, 1)
        atom_share = mass / np.maximum(known_mass, 1e-6)
        area = np.bincount(view.atoms.reshape(-1), minlength=len(total))
        atom_sure = (known_mass >= self.known_share * total)[:, 0] & (total[:, 0] >= self.covered * area)
        inside, known_inside = view.proposals @ mass, view.proposals @ known_mass  # (M, B + C), (M, 1)
        share = inside / np.maximum(known_inside, 1e-6)
        sure = (known_inside >= self.known_share * (view.proposals @ total))[:, 0]
        # A proposal that holds most of what is seen of several classes is a merger of them.
        merged = (inside >= self.merger * mass.sum(0)) & (inside >= SMALLEST)

        owner = np.where(atom_sure & (atom_share.max(1) >= self.atom_share), atom_share.argmax(1), -1)
        strongest = np.where(sure, share.max(1), 0.0) if len(share) else np.zeros(0)
        for m in np.argsort(strongest, kind="stable"):
            if strongest[m] >= self.proposal_share:
                winner = share[m].argmax()
                merged[m, winner] = True
                contest = np.where(atom_sure, np.where(merged[m], atom_share, -1.0).argmax(1), winner)
                owner = np.where(view.proposals[m] > 0.5, contest, owner)
        return owner


def _one_hot(owner: np.ndarray, count: int) -> np.ndarray:
    """(A,) class of each atom, -1 = none -> (A, count) float32."""
    return (owner[:, None] == np.arange(count)).astype(np.float32)


def _sparse(regions: np.ndarray, weights: np.ndarray, columns: int, *, negligible: float = 0.005) -> Sparse:
    """(N, K) strongest regions and weights -> (N, columns), without what is a negligible share of its row."""
    keep = (regions >= 0) & (weights > negligible * weights.sum(1, keepdims=True))
    rows, slots = np.nonzero(keep)
    entries = weights[rows, slots].astype(np.float32)
    return sparse.csr_matrix((entries, (rows, regions[rows, slots])), shape=(len(regions), columns))
