"""Votes of the Gaussians on the atoms of each frame, by which masks are associated. Host code.

With frozen geometry an image is linear in the features of the Gaussians: a pixel is sum_i w_ip f_i with w = alpha T,
occlusion included. One pass per frame sums w over the pixels of atoms (superpixels cut along the proposals of the
frame). Lifting a mask to the Gaussians and rendering it into another frame are then products with sparse matrices
(n Gaussians x A atoms) instead of renderings. Masks follow the outlines of atoms, and so the edges of the image.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy import sparse

from jsecon.association.superpixels import MIN_ATOM_PX, Sparse, superpixel_coverage, superpixel_votes, superpixels
from jsecon.errors import require
from jsecon.parallel import LANES, map_over_processes
from jsecon.process import cores
from jsecon.types import Camera, Gaussians, Progress

MIN_PROPOSAL_SHARE = 0.4
MIN_ATOM_SHARE = 0.6
MIN_MERGED_SHARE = 0.5
MIN_KNOWN_SHARE = 0.5
MIN_COVERAGE = 0.2
"""Thresholds of `assign_superpixels`."""


@dataclasses.dataclass(frozen=True)
class FrameSuperpixels:
    """Votes of the Gaussians in one frame."""

    labels: np.ndarray
    """(H, W) int32 atom of each pixel, 0 .. A-1."""
    seen: np.ndarray
    """(n,) indices of the Gaussians that the frame shows."""
    votes: Sparse
    """(n, A) sum of alpha T over the pixels of each atom."""
    proposals: np.ndarray
    """(M, A) float32 share of each atom that lies in each proposal."""
    clarity: np.ndarray
    """(n,) in (0, 1]: visible cross-section of each, relative to the frame that sees most of it."""

    @property
    def totals(self) -> np.ndarray:
        """(n,) total weight of each Gaussian in the frame."""
        return np.asarray(self.votes.sum(1)).ravel()

    @property
    def on_masks(self) -> Sparse:
        """(n, M) weight of each Gaussian on each proposal."""
        return self.votes @ sparse.csr_matrix(self.proposals.T)


class SceneSuperpixels:
    """Votes of one scene in all frames, computed once.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Batch of T cameras, one per frame.
      proposals: Masks (M, H, W) bool of each frame, which may overlap: a sequence, or a function of the index of a
        frame, which is called in several threads.
      superpixels_per_frame: Approximate number of superpixels per frame before the cut along proposals.
      centre: Weight of a Gaussian's centre against its footprint, see `region_votes`; above 0 if answers are judged at
        the centres of Gaussians.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Camera,
        proposals: Callable[[int], np.ndarray] | Sequence[np.ndarray],
        *,
        superpixels_per_frame: int = 256,
        centre: float = 0.0,
    ):
        require(
            superpixels_per_frame > 0,
            "superpixels_per_frame",
            superpixels_per_frame,
            "at least 1",
            "Use 200 for small frames.",
        )
        self.gaussians, self.cameras, self.count = gaussians, cameras, gaussians.count
        self.superpixels_per_frame, self.centre = superpixels_per_frame, centre
        self.propose = proposals if callable(proposals) else proposals.__getitem__
        self._views: list[FrameSuperpixels] = []
        self.shared = np.zeros((0, 0), np.float32)
        """(T, T) overlap of two frames: the cosine of their visible cross-sections of all Gaussians. Set by `all`."""

    def _view(self, frame: UInt8[np.ndarray, "h w 3"], t: int) -> tuple:
        """Atoms, visible Gaussians, arrays and shape of the votes, and proposals of a frame."""
        masks = np.asarray(self.propose(t), bool)
        atoms = superpixels(frame, masks, count=self.superpixels_per_frame)
        within = superpixel_coverage(atoms, masks, int(atoms.max()) + 1)
        votes = superpixel_votes(self.gaussians, self.cameras[t], atoms, centre=self.centre)
        seen = np.flatnonzero(np.diff(votes.indptr))
        votes = votes[seen]
        return atoms, seen, [votes.data, votes.indices, votes.indptr], votes.shape, within

    def _views_of(self, frames: UInt8[np.ndarray, "t h w 3"], indices: Sequence[int]) -> Iterator[tuple]:
        """Results of `_view` for the frames of `indices`, in order; threads work on several frames at a time."""
        pool = ThreadPoolExecutor(min(cores(), LANES))
        try:
            yield from pool.map(self._view, (frames[t] for t in indices), indices)
        finally:
            pool.shutdown(cancel_futures=True)

    def all(self, frames: UInt8[np.ndarray, "t h w 3"], progress: Progress | None = None) -> list[FrameSuperpixels]:
        """Computes the votes of all frames; several processes (`jax.distributed`) divide the frames.

        Args:
          frames: (T, H, W, 3) uint8 frames of the cameras, the same at every call.
          progress: Called with the number of frames done and of all.

        Returns:
          One `FrameSuperpixels` per frame.

        Raises:
          ValueError: The frames have another number or size than the cameras.
        """
        expected = (*self.cameras.fx.shape, self.cameras.height, self.cameras.width)
        remedy = "Pass the frames of the cameras of the scene."
        require(frames.shape[:3] == expected, "frames", frames.shape, f"{(*expected, 3)}", remedy)
        if not self._views:
            views = [
                FrameSuperpixels(
                    atoms, seen, sparse.csr_matrix((*votes,), shape=shape), within, np.ones(len(seen), np.float32)
                )
                for atoms, seen, votes, shape, within in map_over_processes(
                    len(frames), lambda indices: self._views_of(frames, indices), progress
                )
            ]
            cross_sections = np.zeros((len(views), self.count), np.float32)
            for t, view in enumerate(views):
                camera = self.cameras[t]
                pose = np.asarray(camera.world_to_camera)
                depths = np.asarray(self.gaussians.means)[view.seen] @ pose[2, :3] + pose[2, 3]
                cross_sections[t, view.seen] = view.totals * depths**2 / float(camera.fx * camera.fy)
            highest = np.maximum(cross_sections.max(0), 1e-30)
            self._views = [
                dataclasses.replace(view, clarity=area[view.seen] / highest[view.seen])
                for view, area in zip(views, cross_sections)
            ]
            cross_sections /= np.maximum(np.linalg.norm(cross_sections, axis=1, keepdims=True), 1e-30)
            self.shared = cross_sections @ cross_sections.T
        return self._views


def assign_superpixels(
    view: FrameSuperpixels, mass: Float[np.ndarray, "a c"], known_mass: Float[np.ndarray, "a 1"]
) -> Int[np.ndarray, " a"]:
    """Assigns the atoms of a view to classes of Gaussians.

    With t_a the weight of all Gaussians on an atom a, and sums over a proposal p that weigh an atom by its share in p:

        share of an atom       s_ac = m_ac / k_a,  reliable if k_a >= MIN_KNOWN_SHARE t_a and t_a >= MIN_COVERAGE px(a)
        share of a proposal    s_pc = m_pc / k_p,  reliable if k_p >= MIN_KNOWN_SHARE t_p

    1. A reliable atom goes to the class with the largest share, if that is at least MIN_ATOM_SHARE.
    2. Then each reliable proposal, from the weakest to the strongest in v = max_c s_pc, if v >= MIN_PROPOSAL_SHARE,
       assigns the atoms that lie in it by more than half to the class w of that share. If the proposal merges w with
       classes of m_pc >= MIN_MERGED_SHARE sum_a m_ac and m_pc >= MIN_ATOM_PX, a reliable atom goes to the one of them
       with the largest s_ac.

    Args:
      view: Votes of one frame.
      mass: (A, C) weight m_ac on each atom of the Gaussians of each class.
      known_mass: (A, 1) weight k_a on each atom of the Gaussians whose class is known.

    Returns:
      (A,) class of each atom, -1 if unassigned.
    """
    total = view.votes.T @ np.ones((len(view.seen), 1), np.float32)
    share_of_atom = mass / np.maximum(known_mass, 1e-6)
    area = np.bincount(view.labels.reshape(-1), minlength=len(total))
    reliable_atom = (known_mass >= MIN_KNOWN_SHARE * total)[:, 0] & (total[:, 0] >= MIN_COVERAGE * area)
    inside, known_inside = view.proposals @ mass, view.proposals @ known_mass  # (M, C), (M, 1)
    share = inside / np.maximum(known_inside, 1e-6)
    reliable = (known_inside >= MIN_KNOWN_SHARE * (view.proposals @ total))[:, 0]
    merged = (inside >= MIN_MERGED_SHARE * mass.sum(0)) & (inside >= MIN_ATOM_PX)

    owner = np.where(reliable_atom & (share_of_atom.max(1) >= MIN_ATOM_SHARE), share_of_atom.argmax(1), -1)
    strongest = np.where(reliable, share.max(1), 0.0) if len(share) else np.zeros(0)
    for m in np.argsort(strongest, kind="stable"):
        if strongest[m] >= MIN_PROPOSAL_SHARE:
            winner = share[m].argmax()
            merged[m, winner] = True
            members, rivals = np.flatnonzero(view.proposals[m] > 0.5), np.flatnonzero(merged[m])
            strongest_rival = rivals[share_of_atom[np.ix_(members, rivals)].argmax(1)]
            owner[members] = np.where(reliable_atom[members], strongest_rival, winner)
    return owner
