"""Selected Gaussians that stand apart from the rest: DBSCAN on their centres (the paper's last step). Host code.

DBSCAN (Ester et al. 1996) with scikit-learn's labels, without scikit-learn's list of every point's neighbours (1.9
instead of 11.1 s at 500,000 points). Splats crowd: where thousands lie within eps of each other those lists are
quadratic in time and memory. Here points are put in cubic cells so small that any two of a cell are within eps: the
points of a cell with enough of them are core points without a search, the core points of one cell are one cluster, and
what is left is whether two cells touch.
"""

import hashlib
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.cluster.hierarchy import DisjointSet
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from jsecon.errors import require, require_one_of
from jsecon.types import Array

EPS_SPACINGS = 6.0
"""eps in units of the selection's own point spacing, the median distance to the third neighbour: wide enough to cross
the gaps that weakly textured parts leave between splats, far below the distance between objects"""
MIN_SAMPLES = 10
"""neighbours within eps, itself included, that make a core point; a surface has about 100 within 6 spacings"""


def remove_outliers(
    means: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    *,
    eps: float | None = None,
    min_samples: int = MIN_SAMPLES,
    keep: str = "largest",
) -> Bool[np.ndarray, " n"]:
    """The selection `mask` without what DBSCAN calls noise and, for keep="largest", without the smaller clusters.

    means (N, 3), world units. eps: radius, world units; None takes `default_eps` of the selection. keep="all" keeps
    every cluster (several objects of one kind). Returned as it came, less centres that are not finite: a selection of
    fewer than `min_samples` points, one that is a single component (no gap of eps anywhere, nothing stands apart), and
    one in which DBSCAN finds no cluster at all, as there is nothing for outliers to lie outside of. Raises ValueError
    for options out of range.
    """
    require_one_of("remove_outliers", keep, ("largest", "all"), "Use 'all' to keep several objects.")
    positive, found = min_samples >= 1 and (eps is None or eps > 0), f"eps={eps}, min_samples={min_samples}"
    remedy = "Leave eps out to have it follow the selection's spacing."
    require(positive, "remove_outliers", found, "eps > 0 and min_samples >= 1", remedy)
    return outliers_removed(means, mask, eps=eps, min_samples=min_samples, keep=keep)[0]


def outliers_removed(
    means: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    *,
    eps: float | None = None,
    min_samples: int = MIN_SAMPLES,
    keep: str = "largest",
) -> tuple[Bool[np.ndarray, " n"], str]:
    """What `remove_outliers` returns, and why DBSCAN was not needed, or ""."""
    kept = np.array(mask, bool)
    chosen = np.flatnonzero(kept)
    points = np.asarray(means)[chosen].astype(np.float64)
    finite = np.isfinite(points).all(axis=1)
    kept[chosen[~finite]] = False
    chosen, points = chosen[finite], points[finite]
    if len(chosen) < min_samples:
        return kept, f"fewer than {min_samples} Gaussians are selected"
    key = hashlib.blake2b(f"{eps} {min_samples} {keep}".encode() + points.tobytes()).digest()
    if (known := _known.get(key)) is None:
        known = _kept_of(points, default_eps(points) if eps is None else eps, min_samples, keep)
        if len(_known) >= _REMEMBERED:
            _known.clear()
        _known[key] = known
    inside, why = known
    kept[chosen[~inside]] = False
    return kept, why


_REMEMBERED = 256
"""selections, of a byte a selected Gaussian: texts in other words often select the same"""
_known: dict[bytes, tuple[Bool[np.ndarray, " m"], str]] = {}


def _kept_of(points: np.ndarray, eps: float, min_samples: int, keep: str) -> tuple[Bool[np.ndarray, " m"], str]:
    """Which of the points (M, 3) stay, and why DBSCAN was not needed, or ""."""
    if one_component(points, eps):
        return np.ones(len(points), bool), "the selection is one component"
    labels = dbscan(points, eps, min_samples)
    if labels.max() < 0:
        return np.ones(len(points), bool), ""
    return labels == np.bincount(labels[labels >= 0]).argmax() if keep == "largest" else labels >= 0, ""


def default_eps(points: Float[Array, "m 3"], *, spacings: float = EPS_SPACINGS) -> float:
    """`spacings` times the median distance of the points (M, 3) to their third neighbour; world units.

    The median is taken over at most 20,000 of them, evenly spaced in their order. Where more than half of the points
    coincide the spacing is that of the distinct ones; 1 where there is only one place.
    """
    points = np.asarray(points, np.float64)
    for candidates in (points, np.unique(points, axis=0)):
        if len(candidates) > 1:
            sample = candidates[:: -(-len(candidates) // 20_000)]
            neighbours = min(4, len(candidates))
            spacing = np.median(KDTree(candidates, balanced_tree=False).query(sample, k=neighbours)[0][:, -1])
            if spacing > 0:
                return float(spacings * spacing)
    return 1.0


def dbscan(points: Float[Array, "m 3"], eps: float, min_samples: int) -> Int[np.ndarray, " m"]:
    """Cluster of each of the points (M, 3), counted from 0 in the order of their first core point; -1 = noise.

    Equal to sklearn.cluster.DBSCAN(eps, min_samples).fit_predict up to rounding at distances of exactly eps: a core
    point has min_samples points, itself included, within eps; a point that is not core joins the first cluster with a
    core point within eps.
    """
    points = np.asarray(points, np.float64)
    labels = np.full(len(points), -1)
    if not len(points):
        return labels
    side = eps / np.sqrt(3) * (1 - 1e-9)
    # Counted from the median, so that a stray at the end of the world costs the others no digits.
    cells, cell_of = _distinct(np.floor((points - np.median(points, axis=0)) / side))
    core = np.bincount(cell_of)[cell_of] >= min_samples
    rest = np.flatnonzero(~core)
    if len(rest):
        nth: Any = [min_samples]  # that neighbour alone
        distances = KDTree(points).query(points[rest], k=nth, distance_upper_bound=eps * (1 + 1e-9))[0][:, 0]
        core[rest] = distances <= eps
    cores = np.flatnonzero(core)
    if not len(cores):
        return labels
    labels[cores] = _components(points[cores], cells, cell_of[cores], eps)
    border = np.flatnonzero(~core)
    if len(border):
        # Fewer than min_samples points lie within eps of each, so these lists are short.
        near = KDTree(points[cores]).query_ball_point(points[border], eps, return_sorted=False)
        core_labels = labels[cores]
        labels[border] = [core_labels[neighbours].min() if neighbours else -1 for neighbours in near]
    return labels


def one_component(points: Float[Array, "m 3"], eps: float) -> bool:
    """Whether steps of at most eps lead from each of the points (M, 3) to every other, as far as cells can tell.

    Cells of which any two that touch hold points within eps: True is certain; False may leave one component unproved.
    """
    points = np.asarray(points, np.float64)
    side = eps / np.sqrt(12) * (1 - 1e-9)
    cells, _ = _distinct(np.floor((points - np.median(points, axis=0)) / side))
    return len(cells) < 2 or bool(_join(len(cells), _close_pairs(cells, 1)).max() == 0)


def _distinct(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows of whole numbers (M, 3), and which of them each row is."""
    first_place = places.min(axis=0)
    sizes = places.max(axis=0) - first_place + 1
    if np.prod(sizes) < 2.0**62:
        # One integer a row sorts some ten times faster than rows do.
        keys = (places - first_place).astype(np.int64) @ np.array([sizes[1] * sizes[2], sizes[2], 1], np.int64)
        _, first, which = np.unique(keys, return_index=True, return_inverse=True)
        return places[first], which
    distinct, which = np.unique(places, axis=0, return_inverse=True)
    return distinct, which.reshape(-1)


def _components(points: np.ndarray, cells: np.ndarray, cell_of: np.ndarray, eps: float) -> np.ndarray:
    """Components of core points of which some pair is within eps, numbered by their first point."""
    used, own = np.unique(cell_of, return_inverse=True)
    places, count = cells[used], len(used)
    order = np.argsort(own, kind="stable")
    bounds = np.searchsorted(own[order], np.arange(count + 1))
    pairs = _close_pairs(places, 2)

    # Most cells that touch are told by one point of each, the one nearest the middle of its cell's points.
    sums = np.stack([np.bincount(own, points[:, axis], count) for axis in range(3)], axis=1)
    off = ((points - (sums / np.diff(bounds)[:, None])[own]) ** 2).sum(axis=1)
    middle = np.lexsort((off, own))[bounds[:-1]]
    gap = np.linalg.norm(points[middle[pairs[:, 0]]] - points[middle[pairs[:, 1]]], axis=1)
    part = _join(count, pairs[gap <= eps])

    # The others are looked at point by point, and only where their parts are not one already.
    parts = DisjointSet(range(part.max() + 1))
    for a, b in pairs[part[pairs[:, 0]] != part[pairs[:, 1]]]:
        if not parts.connected(part[a], part[b]):
            few, many = sorted((points[order[bounds[c] : bounds[c + 1]]] for c in (a, b)), key=len)
            if _within(few, many, eps):
                parts.merge(part[a], part[b])
    merged = np.array([parts[a] for a in parts])[part][own]
    _, first, named = np.unique(merged, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[named]


def _close_pairs(places: np.ndarray, apart: int) -> np.ndarray:
    """(P, 2) pairs of cells, each once, that are at most `apart` apart along each axis."""
    if len(places) == 1:
        return np.empty((0, 2), int)
    return KDTree(places, balanced_tree=False).query_pairs(apart + 0.5, p=np.inf, output_type="ndarray")


def _join(count: int, pairs: np.ndarray) -> np.ndarray:
    links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(links, directed=False)[1]


def _within(few: np.ndarray, many: np.ndarray, eps: float) -> bool:
    """Whether some point of one is within eps of some point of the other."""
    if len(few) * len(many) <= 4096:
        return bool((((few[:, None] - many[None]) ** 2).sum(-1) <= eps * eps).any())
    return bool((KDTree(many).query(few, k=1, distance_upper_bound=eps * (1 + 1e-9))[0] <= eps).any())
