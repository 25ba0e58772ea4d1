"""Selected Gaussians that lie apart from the rest: scikit-learn's DBSCAN on their centres (the paper's last step).

Host code. DBSCAN lists all neighbours of every point. Where thousands of splats lie within eps of each other, those
lists are quadratic in time and memory. A large selection is therefore clustered by voxels: one point for each, with the
number of its splats as sample weight.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse  # loads csgraph on its first use
from scipy.spatial import KDTree

from jsecon.errors import require_one_of, require_shape
from jsecon.types import Array

EPS_SPACINGS = 6.0
"""DBSCAN's eps in point spacings of the selection (median distance to the third neighbour). It crosses the gaps that
weakly textured parts leave between splats, and is far below the distance between objects."""
MIN_SAMPLES = 10
"""Neighbours within eps, itself included, that make a core point; a surface has about 100 within 6 spacings."""


def remove_outliers(
    means: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    *,
    weight: Float[Array, " n"] | None = None,
    keep: str = "supported",
) -> Bool[np.ndarray, " n"]:
    """Removes the selected Gaussians that lie apart, by DBSCAN on their centres. Host code: it cannot be traced.

    Noise is dropped, and so are the clusters that `keep` does not name. Three kinds of selections come back as they
    are, except for centres that are not finite: fewer than MIN_SAMPLES points, a single component (no gap of eps
    anywhere), and points in which DBSCAN finds no cluster.

    Args:
      means: (N, 3) centres, world units.
      mask: (N,) the selected Gaussians.
      weight: (N,) how much the views' masks show of each Gaussian, in pixels. `jsecon query` takes similarity *
        votes.total of the selection; None counts each as 1.
      keep: "supported" keeps each cluster that has at least a tenth of the weight of the heaviest: a mask may show one
        object in several pieces. "largest" keeps the cluster with most Gaussians (the paper). "all" keeps
        every cluster.

    Returns:
      (N,) bool, the mask without outliers.

    Raises:
      ValueError: An option is out of range, or `weight` has another length.
    """
    return split_outliers(means, mask, weight=weight, keep=keep)[0]


def split_outliers(
    means: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    *,
    weight: Float[Array, " n"] | None = None,
    keep: str = "supported",
) -> tuple[Bool[np.ndarray, " n"], int]:
    """Removes outliers as `remove_outliers` does: (N,) the mask that stays, and the number of clusters in it."""
    require_one_of("remove_outliers", keep, ("largest", "supported", "all"), "Use 'all' to keep several objects.")
    if weight is not None:
        require_shape("weight", weight, (len(means),), "Give one weight per Gaussian.")
    mask = np.array(mask, bool)
    chosen = np.flatnonzero(mask)
    points = np.asarray(means)[chosen].astype(np.float64)
    finite = np.isfinite(points).all(axis=1)
    mask[chosen[~finite]] = False
    chosen, points = chosen[finite], points[finite]
    if len(chosen) < MIN_SAMPLES:
        return mask, 0
    eps = _default_eps(points)
    if _one_component(points, eps):  # then nothing lies apart, and DBSCAN is not needed
        return mask, 1
    labels = _dbscan(points, eps)
    if labels.max() < 0:
        return mask, 0
    clustered = labels >= 0
    sizes = np.bincount(labels[clustered])
    stays = np.ones(len(sizes), bool)
    if keep == "largest":
        stays = np.arange(len(sizes)) == sizes.argmax()
    elif keep == "supported":
        support = np.ones(len(chosen)) if weight is None else np.asarray(weight, np.float64)[chosen]
        support = np.bincount(labels[clustered], np.nan_to_num(support[clustered], posinf=0.0))
        stays = support >= 0.1 * support.max()
    mask[chosen[~(clustered & stays[labels])]] = False
    return mask, int(stays.sum())


def _default_eps(points: Float[Array, "m 3"]) -> float:
    """Chooses DBSCAN's radius: EPS_SPACINGS times the median distance of points to their third neighbour.

    The median is taken over at most 20,000 points. If more than half of the points coincide the spacing is that of the
    distinct ones; the radius is 1 if there is only one place.
    """
    for candidates in (points, np.unique(points, axis=0)):
        if len(candidates) > 1:
            sample = candidates[:: -(-len(candidates) // 20_000)]
            neighbours = min(4, len(candidates))
            spacing = np.median(KDTree(candidates, balanced_tree=False).query(sample, k=neighbours)[0][:, -1])
            if spacing > 0:
                return float(EPS_SPACINGS * spacing)
    return 1.0


def _dbscan(points: Float[np.ndarray, "m 3"], eps: float, min_samples: int = MIN_SAMPLES) -> Int[np.ndarray, " m"]:
    """Clusters points by scikit-learn's DBSCAN: counted from 0 in the order of their first core point, -1 for noise.

    Above 5,000 points those of one voxel have one label.
    """
    from sklearn.cluster import DBSCAN

    places, voxel, count = _places(points, eps)
    weight = count if len(places) < len(points) else None  # of ones it would add up each list of neighbours
    return DBSCAN(eps=eps, min_samples=min_samples).fit(places, sample_weight=weight).labels_[voxel]


def _one_component(points: np.ndarray, eps: float) -> bool:
    """Finds out whether steps of at most eps lead from each of the points (M, 3), M >= 1, to every other."""
    places, _, _ = _places(points, eps)
    links = 16  # nearest neighbours that are tried first
    distance, near = map(np.asarray, KDTree(places, balanced_tree=False).query(places, k=links))
    linked = distance <= eps
    ends = near[linked], np.concatenate([[0], np.cumsum(linked.sum(1))])
    graph = sparse.csr_array((np.ones(len(ends[0])), *ends), shape=(len(places), len(places)))
    count, component = sparse.csgraph.connected_components(graph, directed=False)
    # The nearest links are enough where the points are evenly spaced, and spare the import of scikit-learn; also where
    # a component is so small that the links of its points show all that is near.
    if count == 1 or np.bincount(component).min() < links:
        return count == 1
    return bool((_dbscan(points, eps, 1) == 0).all())


def _places(points: np.ndarray, eps: float) -> tuple[np.ndarray, Int[np.ndarray, " m"], Int[np.ndarray, " v"]]:
    """The points, or the means of the voxels of many; the place of each point, and how many points each has."""
    if len(points) <= 5_000:  # their lists of neighbours have at most 25 million entries
        return points, np.arange(len(points)), np.ones(len(points), int)
    # A splat lies about half a voxel from the mean of its voxel, so gaps are measured to about a third of eps. 4 voxels
    # along eps take three times as long for a million splats.
    voxel, count = _voxels(points, eps / 3.0)
    sums = [np.bincount(voxel, axis) for axis in points.T]
    return np.stack(sums, axis=1) / count[:, None], voxel, count


def _voxels(points: np.ndarray, edge: float) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " v"]]:
    """The voxel of each point (M,), numbered in the order of their first points, and how many points each has (V,)."""
    # Counted from the median, so that a stray at the end of the world costs the others no digits.
    places = np.floor((points - np.median(points, axis=0)) / edge)
    # One integer a row sorts some ten times faster than rows do. Strays beyond a million voxels count as at their edge.
    keys = (np.clip(places, -(1 << 20), (1 << 20) - 1).astype(np.int64) + (1 << 20)) @ (1 << np.array([42, 21, 0]))
    _, first, which, count = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(first)
    return np.argsort(order)[which.reshape(-1)], count[order]
