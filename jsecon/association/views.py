"""What each frame says about the Gaussians: the weight alpha T that each of them casts on each atom of the frame.

With the geometry frozen, a frame's image is linear in the Gaussians' features: a pixel is sum_i w_ip f_i with
w = alpha T, occlusion included. So one pass over each frame, which sums w over the pixels of small image regions
("atoms": superpixels cut by the frame's proposals), holds all that following masks through the frames needs: lifting a
mask to the Gaussians and rendering it into another frame are then products with that frame's sparse matrix
(n Gaussians x A atoms), and no mask costs a render. Masks come out cut along atoms, which follow the image's edges.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import sparse

from jsecon.association.atoms import MIN_ATOM_PX, Sparse, atom_coverage, atom_votes, image_atoms
from jsecon.errors import require
from jsecon.parallel import map_over_processes
from jsecon.process import cores
from jsecon.types import Camera, Gaussians

PROPOSAL_SHARE, ATOM_SHARE, MERGER, KNOWN_SHARE, COVERED = 0.4, 0.6, 0.5, 0.5, 0.2
"""see `claim_atoms`"""


@dataclasses.dataclass(frozen=True)
class FrameView:
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

    @property
    def on_masks(self) -> Sparse:
        """(n, M) weight that each Gaussian casts on each proposal."""
        return self.votes @ sparse.csr_matrix(self.proposals.T)


class SceneViews:
    """The views of one scene, each computed once.

    gaussians: the scene. cameras: batch of T, one per frame. proposals: a function of a frame's index, called in
    several threads, or a sequence with one entry per frame, giving masks (M, H, W) bool; they may overlap. `centre` as
    for `region_votes`: above 0 where the answer is judged at the Gaussians' centres.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Camera,
        proposals: Callable[[int], np.ndarray] | Sequence[np.ndarray],
        *,
        atoms_per_frame: int = 256,
        centre: float = 0.0,
    ):
        require(atoms_per_frame > 0, "atoms_per_frame", atoms_per_frame, "at least 1", "Use 200 for small frames.")
        self.gaussians, self.cameras, self.count = gaussians, cameras, gaussians.count
        self.atoms_per_frame, self.centre = atoms_per_frame, centre
        self.propose = proposals if callable(proposals) else proposals.__getitem__
        self._views: list[FrameView] = []
        self.shared = np.zeros((0, 0), np.float32)
        """(T, T) what any two frames see in common: the cosine of how much they see of each Gaussian. After `all`."""

    def _cut(self, frame: UInt8[np.ndarray, "h w 3"], t: int) -> tuple[np.ndarray, np.ndarray]:
        """(atoms (H, W), proposals (M, A) by the share of each atom that lies in them)."""
        masks = np.asarray(self.propose(t), bool)
        atoms = image_atoms(frame, masks, count=self.atoms_per_frame)
        return atoms, atom_coverage(atoms, masks, int(atoms.max()) + 1)

    def _said(self, frames: UInt8[np.ndarray, "t h w 3"], own: Sequence[int]) -> Iterator[tuple]:
        """Of each frame of `own` its atoms, the Gaussians that it shows, the arrays and the shape of their votes, and
        the proposals by the share of each atom. While one frame's votes are cast, others are segmented and cut, on all
        cores."""
        pool = ThreadPoolExecutor(cores())
        try:
            for t, (atoms, within) in zip(own, pool.map(self._cut, (frames[t] for t in own), own)):
                cast = atom_votes(self.gaussians, self.cameras[t], atoms, centre=self.centre)
                seen = np.flatnonzero(np.diff(cast.indptr))
                votes = cast[seen]
                yield atoms, seen, [votes.data, votes.indices, votes.indptr], votes.shape, within
        finally:
            pool.shutdown(cancel_futures=True)

    def all(
        self, frames: UInt8[np.ndarray, "t h w 3"], progress: Callable[[int, int], None] | None = None
    ) -> list[FrameView]:
        """All views, each with how clearly it sees its Gaussians; over several processes (`jax.distributed`) they are
        dealt out. Raises ValueError where the frames are not the cameras'."""
        expected = (*self.cameras.fx.shape, self.cameras.height, self.cameras.width)
        remedy = "Give the frames of the scene's own cameras, the same at every call."
        require(frames.shape[:3] == expected, "frames", frames.shape, f"{(*expected, 3)}", remedy)
        if not self._views:
            views = [
                FrameView(
                    atoms, seen, sparse.csr_matrix((*votes,), shape=shape), within, np.ones(len(seen), np.float32)
                )
                for atoms, seen, votes, shape, within in map_over_processes(
                    len(frames), lambda own: self._said(frames, own), progress
                )
            ]
            looks = np.zeros((len(views), self.count), np.float32)
            for t, view in enumerate(views):
                camera = self.cameras[t]
                pose = np.asarray(camera.world_to_camera)
                depths = np.asarray(self.gaussians.means)[view.seen] @ pose[2, :3] + pose[2, 3]
                looks[t, view.seen] = view.totals * depths**2 / float(camera.fx * camera.fy)
            highest = np.maximum(looks.max(0), 1e-30)
            self._views = [
                dataclasses.replace(view, clarity=look[view.seen] / highest[view.seen])
                for view, look in zip(views, looks)
            ]
            looks /= np.maximum(np.linalg.norm(looks, axis=1, keepdims=True), 1e-30)
            self.shared = looks @ looks.T
        return self._views


def claim_atoms(
    view: FrameView, mass: Float[np.ndarray, "a c"], known_mass: Float[np.ndarray, "a 1"]
) -> Int[np.ndarray, " a"]:
    """The class (A,) that owns each atom of a view, -1 = none.

    `mass` (A, C) is the weight m_ac on each atom of the Gaussians of each class, `known_mass` (A, 1) that, k_a, of all
    whose class is known; t_a is the weight of all. Sums over a proposal p weigh an atom by the share of it inside of p:

        share of an atom       s_ac = m_ac / k_a,  sure where k_a >= KNOWN_SHARE t_a and t_a >= COVERED px(a)
        share of a proposal    s_pc = m_pc / k_p,  sure where k_p >= KNOWN_SHARE t_p

    1. A sure atom goes to the class of its largest share if that is at least ATOM_SHARE.
    2. Then each sure proposal, from the weakest to the strongest in v = max_c s_pc, if v >= PROPOSAL_SHARE, gives the
       atoms that lie in it by more than half to the class w of that share. Where it is a merger of w and of the classes
       with m_pc >= MERGER sum_a m_ac and m_pc >= SMALLEST, a sure atom goes to the one of them with the largest s_ac.
    """
    total = view.votes.T @ np.ones((len(view.seen), 1), np.float32)
    share_of_atom = mass / np.maximum(known_mass, 1e-6)
    area = np.bincount(view.atoms.reshape(-1), minlength=len(total))
    sure_atom = (known_mass >= KNOWN_SHARE * total)[:, 0] & (total[:, 0] >= COVERED * area)
    inside, known_inside = view.proposals @ mass, view.proposals @ known_mass  # (M, C), (M, 1)
    share = inside / np.maximum(known_inside, 1e-6)
    sure = (known_inside >= KNOWN_SHARE * (view.proposals @ total))[:, 0]
    merged = (inside >= MERGER * mass.sum(0)) & (inside >= MIN_ATOM_PX)

    owner = np.where(sure_atom & (share_of_atom.max(1) >= ATOM_SHARE), share_of_atom.argmax(1), -1)
    strongest = np.where(sure, share.max(1), 0.0) if len(share) else np.zeros(0)
    for m in np.argsort(strongest, kind="stable"):
        if strongest[m] >= PROPOSAL_SHARE:
            winner = share[m].argmax()
            merged[m, winner] = True
            held, rivals = np.flatnonzero(view.proposals[m] > 0.5), np.flatnonzero(merged[m])
            strongest_rival = rivals[share_of_atom[np.ix_(held, rivals)].argmax(1)]
            owner[held] = np.where(sure_atom[held], strongest_rival, winner)
    return owner
