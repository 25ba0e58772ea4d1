"""Superpixels of the frames, and the weights of the Gaussians on them, by which masks are associated. Host code.

With fixed geometry an image is linear in the features of the Gaussians: a pixel is sum_i w_ip f_i with w = alpha T,
occlusion included. One pass per frame sums w over the pixels of superpixels, which are cut along the proposals of the
frame. Lifting a mask to the Gaussians and rendering it into another frame are then products with sparse matrices
(n Gaussians x A superpixels) instead of renderings. Masks follow the outlines of superpixels, and so the edges of the
image.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt8
from scipy import sparse

from jsecon.errors import require
from jsecon.field.evidence import CastLabels, plan_evidence
from jsecon.parallel import map_views
from jsecon.types import Camera, Gaussians, Progress
from jsecon.vision.region_graph import relabel_sequential
from jsecon.vision.surfaces import fill_nearest

Sparse: TypeAlias = Any
"""scipy.sparse.csr_matrix, which type checkers cannot resolve."""
SUPERPIXELS_PER_FRAME = 256
"""Approximate number before the cut along proposals."""
MIN_SUPERPIXEL_PX = 12
"""Least size in px; smaller pieces are slivers along an edge."""


@dataclasses.dataclass(frozen=True)
class FrameSuperpixels:
    """The superpixels of one frame, and the weights of the Gaussians on them."""

    labels: np.ndarray
    """(H, W) int32 superpixel of each pixel, 0 .. A-1."""
    seen: np.ndarray
    """(n,) indices of the Gaussians that the frame shows."""
    votes: Sparse
    """(n, A) sum of alpha T over the pixels of each superpixel."""
    proposals: np.ndarray
    """(M, A) float32 share of each superpixel that lies in each proposal."""
    clarity: np.ndarray
    """(n,) in (0, 1]: visible cross-section of each, relative to the frame that sees most of it."""

    @property
    def totals(self) -> np.ndarray:
        """(n,) total weight of each Gaussian in the frame."""
        return np.asarray(self.votes.sum(1)).ravel()


class SceneSuperpixels:
    """The superpixels of all frames of one scene, computed once.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Batch of T cameras, one per frame.
      proposals: Masks (M, H, W) bool of each frame, which may overlap: a sequence, or a function of the index of a
        frame, which is called in several threads.
      centre_pixel_weight: As for `region_votes`; above 0 if answers are judged at the centres of Gaussians.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        cameras: Camera,
        proposals: Callable[[int], np.ndarray] | Sequence[np.ndarray],
        *,
        centre_pixel_weight: float = 0.0,
    ):
        self.gaussians, self.cameras, self.count = gaussians, cameras, gaussians.count
        self.centre_pixel_weight = centre_pixel_weight
        self.propose = proposals if callable(proposals) else proposals.__getitem__
        self._views: list[FrameSuperpixels] = []
        self.shared = np.zeros((0, 0), np.float32)
        """(T, T) overlap of two frames: the cosine of their visible cross-sections of all Gaussians. Set by `all`."""
        self.median_depth = 0.0
        """Median depth of what the frames show, by rendering weight, world units. Set by `all`."""

    def _view(self, frame: UInt8[np.ndarray, "h w 3"], t: int) -> tuple:
        """Superpixels, visible Gaussians, arrays and shape of their weights, and proposals of a frame."""
        masks = np.asarray(self.propose(t), bool)
        cast = plan_evidence(self.gaussians, self.cameras[t], centre_pixel_weight=self.centre_pixel_weight)
        view = frame_superpixels(frame, masks, cast)
        votes = view.votes
        return view.labels, view.seen, [votes.data, votes.indices, votes.indptr], votes.shape, view.proposals

    def all(self, frames: UInt8[np.ndarray, "t h w 3"], progress: Progress | None = None) -> list[FrameSuperpixels]:
        """Computes the superpixels of all frames, which are the same at every call; several processes divide them."""
        expected = (*self.cameras.fx.shape, self.cameras.height, self.cameras.width)
        remedy = "Pass the frames of the cameras of the scene."
        require(frames.shape[:3] == expected, "frames", frames.shape, f"{(*expected, 3)}", remedy)
        if not self._views:
            views = [
                FrameSuperpixels(
                    labels, seen, sparse.csr_matrix((*votes,), shape=shape), within, np.ones(len(seen), np.float32)
                )
                for labels, seen, votes, shape, within in map_views(
                    len(frames), lambda t: self._view(frames[t], t), progress
                )
            ]
            cross_sections, all_depths = np.zeros((len(views), self.count), np.float32), []
            for t, view in enumerate(views):
                camera = self.cameras[t]
                pose = np.asarray(camera.world_to_camera)
                depths = np.asarray(self.gaussians.means)[view.seen] @ pose[2, :3] + pose[2, 3]
                cross_sections[t, view.seen] = view.totals * depths**2 / float(camera.fx * camera.fy)
                all_depths.append(depths)
            depths, weights = np.concatenate(all_depths), np.concatenate([view.totals for view in views])
            if len(depths):
                self.median_depth = float(np.quantile(depths, 0.5, weights=weights, method="inverted_cdf"))
            highest = np.maximum(cross_sections.max(0), 1e-30)
            self._views = [
                dataclasses.replace(view, clarity=area[view.seen] / highest[view.seen])
                for view, area in zip(views, cross_sections)
            ]
            cross_sections /= np.maximum(np.linalg.norm(cross_sections, axis=1, keepdims=True), 1e-30)
            self.shared = cross_sections @ cross_sections.T
        return self._views


def frame_superpixels(
    frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"], cast: CastLabels
) -> FrameSuperpixels:
    """Cuts a frame into superpixels, with the weights of the Gaussians on them, but for the faintest."""
    labels = superpixels(frame, masks, count=SUPERPIXELS_PER_FRAME)
    number = int(labels.max()) + 1
    evidence = cast(labels, number)
    columns = evidence.weights.copy(), evidence.regions, evidence.starts
    votes = sparse.csr_matrix(columns, shape=(len(evidence.gaussians), number + 1))[:, :number]
    total = np.repeat(np.asarray(votes.sum(1)).ravel(), np.diff(votes.indptr))
    votes.data[votes.data <= 0.005 * total] = 0.0
    votes.eliminate_zeros()
    seen = np.flatnonzero(np.diff(votes.indptr))
    within = superpixel_coverage(labels, masks, number)
    return FrameSuperpixels(labels, evidence.gaussians[seen], votes[seen], within, np.ones(len(seen), np.float32))


def assign_superpixels(
    view: FrameSuperpixels, mass: Float[np.ndarray, "a c"], known_mass: Float[np.ndarray, "a 1"]
) -> Int[np.ndarray, " a"]:
    """Assigns the superpixels of a view to classes of Gaussians: (A,) class of each, -1 if unassigned.

    With t_a the weight of all Gaussians on a superpixel a, and sums over a proposal p that weigh it by its share in p:

        share of a superpixel  s_ac = m_ac / k_a,  reliable if k_a >= 0.5 t_a and t_a >= 0.2 px(a)
        share of a proposal    s_pc = m_pc / k_p,  reliable if k_p >= 0.5 t_p and t_p >= 0.2 px(p)

    1. A reliable superpixel goes to the class with the largest share, if that is at least 0.6.
    2. Then each reliable proposal, from the weakest to the strongest in v = max_c s_pc, if v >= 0.4, assigns
       the superpixels that lie in it by more than half to the class w of that share. If the proposal merges w with
       classes of m_pc >= 0.5 sum_a m_ac and m_pc >= MIN_SUPERPIXEL_PX, a reliable superpixel goes to the one of them
       with the largest s_ac.

    So what shows no Gaussians, such as the space around a splat without photographs, goes to no class. `mass` is m_ac,
    the weight of the Gaussians of each class on each superpixel, and `known_mass` k_a, that of the Gaussians whose
    class is known.
    """
    total = view.votes.T @ np.ones((len(view.seen), 1), np.float32)
    share_of_superpixel = mass / np.maximum(known_mass, 1e-6)
    area = np.bincount(view.labels.reshape(-1), minlength=len(total))[:, None]
    is_reliable = ((known_mass >= 0.5 * total) & (total >= 0.2 * area))[:, 0]
    inside, known_inside = view.proposals @ mass, view.proposals @ known_mass  # (M, C), (M, 1)
    share = inside / np.maximum(known_inside, 1e-6)
    total_inside = view.proposals @ total
    reliable = ((known_inside >= 0.5 * total_inside) & (total_inside >= 0.2 * (view.proposals @ area)))[:, 0]
    merged = (inside >= 0.5 * mass.sum(0)) & (inside >= MIN_SUPERPIXEL_PX)

    certain = is_reliable & (share_of_superpixel.max(1) >= 0.6)
    owner = np.where(certain, share_of_superpixel.argmax(1), -1)
    strongest = np.where(reliable, share.max(1), 0.0) if len(share) else np.zeros(0)
    for m in np.argsort(strongest, kind="stable"):
        if strongest[m] >= 0.4:
            winner = share[m].argmax()
            merged[m, winner] = True
            members, competing = np.flatnonzero(view.proposals[m] > 0.5), np.flatnonzero(merged[m])
            nearest = competing[share_of_superpixel[np.ix_(members, competing)].argmax(1)]
            owner[members] = np.where(is_reliable[members], nearest, winner)
    return owner


def label_by_regions(
    view: FrameSuperpixels,
    owner: Int[np.ndarray, " n"],
    consensus: Sparse,
    unknown: Bool[np.ndarray, " n"],
    *,
    split: bool = False,
) -> tuple[Int32[np.ndarray, "h w"], int]:
    """Labels a new view with the regions of a scene; what belongs to none gets labels from their number on.

    Superpixels take the regions of their Gaussians (`assign_superpixels`). A mask takes a region as a whole if both are
    the same in the new view: at least half of the mask's weight lies in the region, and half of the region's in the
    mask. What matches no region in both directions opens one if most of its weight lies on `unknown` Gaussians; with
    `split` also if it lies in a larger region, as a mug on a table that no mask had cut out.

    Args:
      view: The view with its masks.
      owner: Region of each of the n Gaussians that the view shows, -1 for none.
      consensus: (n, R) share of each in each region, over the views that see both.
      unknown: Those on which a region may be opened.
      split: Whether a part of a region may be one of its own.

    Returns:
      (H, W) labels, -1 for none, and the number of new regions.
    """
    count = consensus.shape[1]
    mass = (view.votes.T @ one_hot(owner, max(count, 1))).toarray()
    classes = assign_superpixels(view, mass, mass.sum(1, keepdims=True))
    total, shares = np.asarray(view.votes.sum(0)).ravel(), (view.votes.T @ consensus).toarray()
    fresh, area = view.votes.T @ (unknown * 1.0), np.bincount(view.labels.reshape(-1))
    new = 0
    for share in view.proposals:
        weight, inside, members = share @ total, shares.T @ share, share > 0.5
        both = np.minimum(inside / max(weight, 1e-6), inside / np.maximum(shares.sum(0), 1e-6))
        if weight < 0.2 * (share @ area):
            continue
        if both.max(initial=0) >= 0.5:
            classes[members & (classes < count)] = both.argmax()
        elif share @ fresh >= 0.5 * weight or (split and inside.max(initial=0) >= 0.5 * weight):
            classes[members & (classes < count)] = count + new
            fresh[members] = 0.0  # a mask that overlaps this one opens a region for the rest of it alone
            new += 1
    return classes[view.labels].astype(np.int32), new


def superpixels(
    frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"], *, count: int
) -> Int32[np.ndarray, "h w"]:
    """Segments a frame into about `count` superpixels (SLICO, Achanta et al. 2012), cut along the outlines of masks.

    Pieces below MIN_SUPERPIXEL_PX pixels join the nearest other piece.
    """
    lab = cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2LAB)
    size = max(round(float(np.sqrt(frame.shape[0] * frame.shape[1] / count))), 4)
    slic = cv2.ximgproc.createSuperpixelSLIC(lab, cv2.ximgproc.SLICO, size)
    slic.iterate(6)
    pieces = np.asarray(slic.getLabels(), np.int64)
    for eight in np.packbits(masks, axis=0):
        pieces = relabel_sequential(pieces * 256 + eight)
    large = np.bincount(pieces.reshape(-1))[pieces] >= MIN_SUPERPIXEL_PX
    if large.any() and not large.all():
        pieces = fill_nearest(pieces, large)
    return relabel_sequential(pieces).astype(np.int32)


def superpixel_coverage(
    labels: Int32[np.ndarray, "h w"], masks: Bool[np.ndarray, "m h w"], count: int
) -> Float32[np.ndarray, "m a"]:
    """Computes the share of the pixels of each of `count` superpixels that lies in each mask."""
    area = np.bincount(labels.reshape(-1), minlength=count)
    inside = [np.bincount(labels[mask], minlength=count) for mask in masks]
    return (np.asarray(inside, np.float32).reshape(len(masks), count) / np.maximum(area, 1)).astype(np.float32)


def one_hot(labels: Int[np.ndarray, " a"], count: int) -> Sparse:
    """Encodes labels, -1 for none, as a sparse matrix (A, `count`) of float32 ones."""
    rows = np.flatnonzero(labels >= 0)
    return sparse.csr_matrix((np.ones(len(rows), np.float32), (rows, labels[rows])), shape=(len(labels), count))
