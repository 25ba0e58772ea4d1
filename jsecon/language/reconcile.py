"""Masks that a tracker lost, swapped, cut or merged, put right by what the other views say about the same Gaussians.

A mask and a Gaussian's votes are two opinions on one thing. Each Gaussian sides with the region that most of its votes
name, each mask takes the region that most of its Gaussians side with, and so on until nobody changes: a k-means whose
points are masks and whose centres are the votes. A mask that the tracker gave another id is outvoted by the views that
have it right; ids are kept, so that what only a tracker can know (two places are one thing) stays. In the spirit of the
partial-mask filter of Segment-then-Splat, but nothing is thrown away.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int, Int16
from scipy import sparse

from jsecon.errors import require
from jsecon.language.votes import region_votes
from jsecon.splat.tiles import plan_capacity
from jsecon.types import Array, Camera, Gaussians
from jsecon.vision.atoms import Sparse

ROUNDS = 10
"""most rounds; with a fifth of the masks wrong two or three suffice"""
_CHUNK = 16
"""masks of a view are counted in multiples of this, so that few shapes are compiled"""


def reconcile_labels(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Int[Array, "t h w"],
    *,
    rounds: int = ROUNDS,
    top: int = 8,
    capacity: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Int16[np.ndarray, "t h w"]:
    """Labels (T, H, W), -1 = none, in which each mask (a region in a view) has the id that the views agree on.

    cameras: batch of T. Ids stay what they were; some may lose all their masks. Pixels without label stay so. `top`
    strongest masks of each Gaussian are kept a view. A pass over the views, as `region_votes` makes, and sparse
    products. `progress(done, total)` counts views. Raises ValueError on shapes that disagree and where a capacity given
    is too small.
    """
    labels = np.asarray(labels)
    require(
        labels.shape == (*cameras.fx.shape, cameras.height, cameras.width),
        "labels",
        got=labels.shape,
        expected=f"{(*cameras.fx.shape, cameras.height, cameras.width)}",
        remedy="Give one label image of the camera's size a view.",
    )
    require(rounds >= 0, "rounds", got=rounds, expected="at least 0", remedy=f"{ROUNDS} is the default.")
    capacity = plan_capacity(gaussians, cameras, margin=1.0) if capacity is None else capacity
    masks, ids, blocks = [], [], []
    for t, image in enumerate(labels):
        here = np.unique(image[image >= 0])
        local = np.where(image >= 0, np.searchsorted(here, image), -1).astype(np.int32)
        padded = max(-(-len(here) // _CHUNK), 1) * _CHUNK
        votes = region_votes(
            gaussians, cameras[t : t + 1], jnp.asarray(local[None]), padded, top=top, capacity=capacity
        )
        require(
            int(votes.overflow) == 0,
            "capacity",
            got=f"{capacity}, {int(votes.overflow)} pairs too few in view {t}",
            expected="room for every (block, Gaussian) pair",
            remedy="Leave capacity out: it is planned then.",
        )
        rows, slots = np.nonzero(np.asarray(votes.weights) > 0)
        entries = np.asarray(votes.weights)[rows, slots], (rows, np.asarray(votes.regions)[rows, slots])
        blocks.append(sparse.csr_matrix(entries, shape=(gaussians.means.shape[0], len(here))))
        masks.append(local)
        ids.append(here)
        if progress is not None:
            progress(t + 1, len(labels))
    found = labels.astype(np.int16)
    if not sum(map(len, ids)):
        return found
    settled = agree(sparse.hstack(blocks, format="csr"), np.concatenate(ids).astype(np.int64), rounds=rounds)
    for image, local, own in zip(found, masks, np.split(settled, np.cumsum([len(here) for here in ids])[:-1])):
        image[local >= 0] = own[local[local >= 0]]
    return found


def agree(votes: Sparse, ids: Int[np.ndarray, " m"], *, rounds: int = ROUNDS) -> Int[np.ndarray, " m"]:
    """The region (M,) of each of M masks, from the one that it has now and the masks' votes (N, M) on N Gaussians.

    A round: Gaussians side with the region of most of their votes, masks with the region that the largest part of their
    weight sides with. Ties, and masks without weight, leave things as they were; so does a round that changes nothing.
    """
    ids = ids.copy()
    count, regions = len(ids), int(ids.max(initial=-1)) + 1
    rows, transposed = votes.tocsr(), votes.T.tocsr()
    for _ in range(rounds):
        of_region = sparse.csr_matrix((np.ones(count), (np.arange(count), ids)), shape=(count, regions))
        cast = (rows @ of_region).tocsr()
        side = np.asarray(cast.argmax(axis=1)).ravel()
        known = np.flatnonzero(np.diff(cast.indptr))
        shape = (votes.shape[0], regions)
        sides = sparse.csr_matrix((np.ones(len(known)), (known, side[known])), shape=shape)
        weight = (transposed @ sides).tocsr()
        best = np.asarray(weight.argmax(axis=1)).ravel()
        own = np.asarray(weight[np.arange(count), ids]).ravel()
        settled = np.where(np.asarray(weight.max(axis=1).todense()).ravel() > own, best, ids)
        if np.array_equal(settled, ids):
            break
        ids = settled
    return ids
