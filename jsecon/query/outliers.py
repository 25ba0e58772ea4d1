"""Selected Gaussians that stand apart from the rest: DBSCAN on their centres (the paper's last step). Host code."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jsecon.errors import require
from jsecon.query.clusters import dbscan, one_component
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
    require(
        keep in ("largest", "all"),
        "remove_outliers",
        got=f"keep={keep!r}",
        expected="'largest' or 'all'",
        remedy="Use 'all' to keep several objects.",
    )
    require(
        min_samples >= 1 and (eps is None or eps > 0),
        "remove_outliers",
        got=f"eps={eps}, min_samples={min_samples}",
        expected="eps > 0 and min_samples >= 1",
        remedy="Leave eps out to have it follow the selection's spacing.",
    )
    means = np.asarray(means)
    kept = np.asarray(mask) & np.isfinite(means).all(axis=1)
    chosen = np.flatnonzero(kept)
    if len(chosen) < min_samples:
        return kept
    points = means[chosen].astype(np.float64)
    eps = default_eps(points) if eps is None else eps
    if one_component(points, eps):
        return kept
    labels = dbscan(points, eps, min_samples)
    if labels.max() < 0:
        return kept
    inside = labels == np.bincount(labels[labels >= 0]).argmax() if keep == "largest" else labels >= 0
    result = np.zeros_like(kept)
    result[chosen[inside]] = True
    return result


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
            spacing = np.median(KDTree(candidates).query(sample, k=neighbours)[0][:, -1])
            if spacing > 0:
                return float(spacings * spacing)
    return 1.0
