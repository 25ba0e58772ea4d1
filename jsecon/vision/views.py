"""What each frame says about the Gaussians: the weight alpha T that each of them casts on each atom of the frame.

With the geometry frozen, a frame's image is linear in the Gaussians' features: a pixel is sum_i w_ip f_i with
w = alpha T, occlusion included. So one pass over each frame, which sums w over the pixels of small image regions
("atoms": superpixels cut by the frame's proposals), holds all that following masks through the frames needs: lifting a
mask to the Gaussians and rendering it into another frame are then products with that frame's sparse matrix
(n Gaussians x A atoms), and no mask costs a render. Masks come out cut along atoms, which follow the image's edges.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import sparse

from jsecon.errors import require
from jsecon.language.votes import region_votes
from jsecon.splat.tiles import plan_capacity
from jsecon.types import Camera, Gaussians
from jsecon.vision.atoms import SMALLEST, Sparse, coverage, image_atoms

_CHUNK = 64
"""atoms are counted in multiples of this, so that few shapes are compiled"""


@dataclasses.dataclass(frozen=True)
class View:
    """What one frame says about the Gaussians."""

    atoms: np.ndarray
    """(H, W) int32 atom of each pixel, 0 .. A-1."""
    seen: np.ndarray
    """(n,) the Gaussians that the frame shows."""
    votes: Sparse
    """(n, A) sum of alpha T over the atom's pixels."""
    proposals: np.ndarray
    """(M, A) float32 share of each atom that lies in each proposal."""
    clarity: np.ndarray
    """(n,) in (0, 1]: the cross-section that is seen of each, against the frame that sees most of it."""

    @property
    def totals(self) -> np.ndarray:
        """(n,) weight that each Gaussian casts in the frame."""
        return np.asarray(self.votes.sum(1)).ravel()

    def on_atoms(self, values: Float[np.ndarray, "n c"] | Sparse) -> np.ndarray:
        """(A, C) what the atoms receive of values (n, C) of the Gaussians."""
        mass = self.votes.T @ values
        return mass.toarray() if sparse.issparse(mass) else mass

    def clearly(self, values: Float[np.ndarray, "a c"]) -> np.ndarray:
        """(n, C) what the Gaussians receive of values (A, C) of the atoms, by how clearly they are seen: one seen from
        its side, over an outline, says little."""
        return self.clarity[:, None] * (self.votes @ values)


class SceneViews:
    """The views of one scene, each computed once.

    gaussians: the scene. cameras: batch of T, one a frame. proposals: a function of a frame's index, or a sequence with
    one entry a frame, giving masks (M, H, W) bool; they may overlap.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Camera,
        proposals: Callable[[int], np.ndarray] | Sequence[np.ndarray],
        *,
        atoms_per_frame: int = 256,
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
        self.atoms_per_frame = atoms_per_frame
        self.propose = proposals if callable(proposals) else proposals.__getitem__
        self._views: dict[int, View] = {}
        self._shared = np.zeros((0, 0), np.float32)

    @property
    def count(self) -> int:
        """Gaussians in the scene."""
        return self.gaussians.means.shape[0]

    def view(self, frames: UInt8[np.ndarray, "t h w 3"], t: int) -> View:
        """The frame's atoms and votes. How clearly it sees the Gaussians is known once all views are: see `all`."""
        if t not in self._views:
            masks = np.asarray(self.propose(t), bool)
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
                expected="room for every (block, Gaussian) pair",
                remedy="Leave capacity out: it is planned then.",
            )
            matrix = _sparse(np.asarray(votes.regions), np.asarray(votes.weights), number)
            seen = np.flatnonzero(np.diff(matrix.indptr))
            within = coverage(atoms, masks, number)
            self._views[t] = View(atoms, seen, matrix[seen], within, np.ones(len(seen), np.float32))
        return self._views[t]

    def all(
        self, frames: UInt8[np.ndarray, "t h w 3"], progress: Callable[[int, int], None] | None = None
    ) -> list[View]:
        """All views, each with how clearly it sees its Gaussians. Raises ValueError where the frames are not the
        cameras'."""
        expected = (*self.cameras.fx.shape, self.cameras.height, self.cameras.width)
        require(
            frames.shape[:3] == expected,
            "frames",
            got=frames.shape,
            expected=f"{(*expected, 3)}",
            remedy="Give the frames of the scene's own cameras, the same at every call.",
        )
        if not self._shared.size:
            views = []
            for t in range(len(frames)):
                views.append(self.view(frames, t))
                if progress is not None:
                    progress(t + 1, len(frames))
            looks = np.zeros((len(views), self.count), np.float32)
            for t, view in enumerate(views):
                camera = self.cameras[t]
                pose = np.asarray(camera.world_to_camera)
                depths = np.asarray(self.gaussians.means)[view.seen] @ pose[2, :3] + pose[2, 3]
                looks[t, view.seen] = view.totals * depths**2 / float(camera.fx * camera.fy)
            highest = np.maximum(looks.max(0), 1e-30)
            for t, view in enumerate(views):
                self._views[t] = dataclasses.replace(view, clarity=looks[t, view.seen] / highest[view.seen])
            looks /= np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-30)
            self._shared = looks @ looks.T
        return [self._views[t] for t in range(len(frames))]

    @property
    def shared(self) -> Float[np.ndarray, "t t"]:
        """(T, T) what any two frames see in common: the cosine of how much they see of each Gaussian. After `all`."""
        return self._shared


def claim_atoms(
    view: View,
    mass: Float[np.ndarray, "a c"],
    known_mass: Float[np.ndarray, "a 1"],
    *,
    proposal_share: float = 0.4,
    atom_share: float = 0.6,
    merger: float = 0.5,
    known_share: float = 0.5,
    covered: float = 0.2,
) -> Int[np.ndarray, " a"]:
    """The class (A,) that owns each atom of a view, -1 = none.

    `mass` (A, C) is the weight on each atom of the Gaussians of each class, `known_mass` (A, 1) that of those whose
    class is known. A proposal goes to the class that owns the largest part of its known weight, if that is at least
    `proposal_share`. If the proposal also holds at least `merger` of what is seen of others, each of its atoms goes to
    whom of them owns most of it. An atom that no proposal brings goes to whom owns at least `atom_share` of it. Nothing
    is decided where less than `known_share` of the weight is known, nor on atoms that the Gaussians cover by less than
    `covered`.
    """
    total = view.on_atoms(np.ones((len(view.seen), 1), np.float32))
    share_of_atom = mass / np.maximum(known_mass, 1e-6)
    area = np.bincount(view.atoms.reshape(-1), minlength=len(total))
    sure_atom = (known_mass >= known_share * total)[:, 0] & (total[:, 0] >= covered * area)
    inside, known_inside = view.proposals @ mass, view.proposals @ known_mass  # (M, C), (M, 1)
    share = inside / np.maximum(known_inside, 1e-6)
    sure = (known_inside >= known_share * (view.proposals @ total))[:, 0]
    # A proposal that holds most of what is seen of several classes is a merger of them.
    merged = (inside >= merger * mass.sum(0)) & (inside >= SMALLEST)

    owner = np.where(sure_atom & (share_of_atom.max(1) >= atom_share), share_of_atom.argmax(1), -1)
    strongest = np.where(sure, share.max(1), 0.0) if len(share) else np.zeros(0)
    for m in np.argsort(strongest, kind="stable"):
        if strongest[m] >= proposal_share:
            winner = share[m].argmax()
            merged[m, winner] = True
            contest = np.where(sure_atom, np.where(merged[m], share_of_atom, -1.0).argmax(1), winner)
            owner = np.where(view.proposals[m] > 0.5, contest, owner)
    return owner


def _sparse(regions: np.ndarray, weights: np.ndarray, columns: int, *, negligible: float = 0.005) -> Sparse:
    """(N, K) strongest regions and weights -> (N, columns), without what is a negligible share of its row."""
    keep = (regions >= 0) & (weights > negligible * weights.sum(1, keepdims=True))
    rows, slots = np.nonzero(keep)
    entries = weights[rows, slots].astype(np.float32)
    return sparse.csr_matrix((entries, (rows, regions[rows, slots])), shape=(len(regions), columns))
