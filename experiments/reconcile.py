"""Masks that a tracker lost, swapped, cut or merged, put right by what the other views say about the same Gaussians.

A mask and a Gaussian's votes are two opinions on one thing. Each Gaussian sides with the region that most of its votes
name, each mask takes the region that most of its Gaussians side with, and so on until nobody changes: a k-means whose
points are masks and whose centres are the votes. A mask that the tracker gave another id is outvoted by the views that
have it right; ids are kept, so that what only a tracker can know (two places are one thing) stays. In the spirit of the
partial-mask filter of Segment-then-Splat, but nothing is thrown away. Measured by `beyond.py`: consensus, which needs
no tracker, does better, so that jsecon has that instead.
"""

import numpy as np
from jaxtyping import Int
from scipy import sparse

from jsecon.vision.atoms import Sparse

ROUNDS = 10
"""most rounds; with a fifth of the masks wrong two or three suffice"""


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
