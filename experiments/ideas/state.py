"""Regions and the votes that simulated vision's masks cast for them: what the experiments on ideas and queries share.

Each experiment groups the same masks in its own way (as tracked, reconciled, by consensus, each for itself) and
computes shares, leads and posteriors of the same votes, kept view by view.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int
from scipy import sparse

from experiments.ideas import scenes
from jsecon.association.atoms import Sparse
from jsecon.association.consensus import group_by_consensus
from jsecon.query.match import contrasts

ROUNDS = 10
"""most rounds of `agree`; with a fifth of the masks wrong two or three suffice"""


ALIKE_COSINE = 0.95
"""of two regions' embeddings: above it they are one thing seen twice"""


class State:
    """Regions and their votes: (N, R) votes, (T, R) which masks count, (R, E) embeddings; and what follows."""

    def __init__(self, sight: scenes.Sight, proof: scenes.Evidence, ids: np.ndarray, ok: np.ndarray, regions: int):
        """ids (M,) region of each mask, ok (M,) whether it counts; M = T R of the masks as they came."""
        views, masks = sight.pixels.shape[0], np.flatnonzero(ok)
        view = np.repeat(np.arange(views), sight.pixels.shape[1])
        self.proof, self.ids, self.ok, self.view, self.regions = proof, ids, ok, view, regions
        to_region = sparse.csr_matrix((np.ones(len(masks), np.float32), (masks, ids[masks])), shape=(len(ids), regions))
        self.votes = (proof.votes @ to_region).toarray()
        self.shows = np.zeros((views, regions), bool)
        self.shows[view[masks], ids[masks]] = True
        flat, pixels = sight.embeddings.reshape(len(ids), -1), sight.pixels.reshape(-1, 1)
        self.embeddings, self.pixels = unit(to_region.T @ (flat * pixels)), to_region.T @ pixels
        self.total = np.maximum(proof.seen.sum(1), 1e-12)

    def similarities(self, texts: np.ndarray, canonical: np.ndarray | None = None) -> np.ndarray:
        """(K, R) of texts and regions, -inf where a region has no embedding: the cosines, or with canonical phrases
        (C, E) the contrasts."""
        if canonical is None:
            return np.where(np.any(self.embeddings != 0, 1), texts @ self.embeddings.T, -np.inf)
        given = (jnp.asarray(a, jnp.float32) for a in (self.embeddings, texts, canonical, self.pixels))
        score, known = _contrasts(*given)
        return np.where(known, score, -np.inf)

    def anchors(self, texts: np.ndarray, canonical: np.ndarray | None = None) -> np.ndarray:
        """(K,) the region most similar to each text."""
        return self.similarities(texts, canonical).argmax(1)

    def joined(self, anchors: np.ndarray, alike: float = ALIKE_COSINE) -> list[np.ndarray]:
        """For each anchor the regions that are alike."""
        gram = self.embeddings @ self.embeddings.T
        return [np.flatnonzero(gram[a] >= alike) for a in anchors]

    def shares(self, groups: list[np.ndarray]) -> list[np.ndarray]:
        """(N,) per group: its share of all votes."""
        return [self.votes[:, g].sum(1) / self.total for g in groups]

    def leads(self, groups: list[np.ndarray]) -> list[np.ndarray]:
        """(N,) bool per group: the strongest region is not another's, and most of the weight is labelled."""
        labelled, others = self.votes.sum(1) >= 0.5 * self.total, np.ones(self.regions, bool)
        found = []
        for g in groups:
            others[g] = False
            rival = self.votes[:, others].max(1, initial=0.0)
            own = self.votes[:, g].sum(1)
            found.append(labelled & (own > 0) & (own >= rival))
            others[g] = True
        return found

    def posteriors(self, groups: list[np.ndarray]) -> list[np.ndarray]:
        """(N,) per group: its share of what the views that show it see of the Gaussian (D)."""
        found = []
        for g in groups:
            seen = self.proof.seen[:, self.shows[:, g].any(1)].sum(1)
            found.append(self.votes[:, g].sum(1) / np.maximum(seen, 1e-12))
        return found

    def overlap(self) -> np.ndarray:
        """(M,) IoU of each mask with the reprojection of its region: shares composited over the view."""
        share = (self.votes / self.total[:, None]).astype(np.float32)
        inside = np.asarray((self.proof.votes.T @ share)[np.arange(len(self.ids)), self.ids])
        everywhere = (self.proof.seen.T @ share)[self.view, self.ids]
        return inside, everywhere


@jax.jit
def _contrasts(embeddings, texts, canonical, pixels):
    return jax.vmap(lambda text: contrasts(embeddings, text, canonical, pixels))(texts)


def unit(rows: np.ndarray) -> np.ndarray:
    """Rows of length one; zero stays zero."""
    return rows / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-12)


def tracked(sight: scenes.Sight, proof: scenes.Evidence) -> State:
    """Regions as the tracker numbered them."""
    views, regions = sight.pixels.shape
    return State(sight, proof, np.tile(np.arange(regions), views), sight.pixels.reshape(-1) > 0, regions)


def consensus(sight: scenes.Sight, proof: scenes.Evidence, means: np.ndarray, *, agreement: float = 0.3) -> State:
    """E: objects are groups of Gaussians that the views put together, whatever the tracker said."""
    best = 1 / np.maximum(proof.seen.max(1), 1e-9)
    membership = (sparse.diags(best) @ proof.votes).tocsr().astype(np.float32)
    visible = sparse.csr_matrix((proof.seen * best[:, None]).astype(np.float32))
    weights = proof.seen.sum(1).astype(np.float32)
    owner = group_by_consensus(membership, visible, weights, means.astype(np.float32), agreement=agreement)
    live, groups = np.flatnonzero(owner >= 0), int(owner.max()) + 1
    gather = sparse.csr_matrix((np.ones(len(live), np.float32), (owner[live], live)), shape=(groups, len(owner)))
    ids = np.asarray((gather @ proof.votes).tocsc().argmax(0)).ravel()
    return State(sight, proof, ids, sight.pixels.reshape(-1) > 0, groups)


def agree(votes: Sparse, ids: Int[np.ndarray, " m"], *, rounds: int = ROUNDS) -> Int[np.ndarray, " m"]:
    """The region (M,) of each of M masks that a tracker lost, swapped, cut or merged, put right by the votes (N, M) of
    the masks on N Gaussians.

    Each Gaussian is assigned to the region with most of its votes, each mask to the region that most of its weight on
    Gaussians is assigned to, and so on until nothing changes: a k-means whose points are masks and whose centres are
    the votes. A mask to which the tracker gave another id has less weight than the views that have it right; ids are
    kept, so that what only a tracker can know (two places are one thing) stays. In the spirit of the partial-mask
    filter of Segment-then-Splat, but nothing is thrown away. Ties, and masks without weight, leave things as they were.
    Measured by `beyond.py`: consensus, which needs no tracker, does better, so that jsecon has that instead.
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


def point_miou(masks: list[np.ndarray], truth: np.ndarray) -> float:
    """Mean over the objects that some Gaussian belongs to of the selection's IoU with those Gaussians."""
    return float(
        np.mean(
            [(m & (truth == k)).sum() / (m | (truth == k)).sum() for k, m in enumerate(masks) if (truth == k).any()]
        )
    )
