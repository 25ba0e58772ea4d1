"""Which views show most of a scene: a greedy cover, for bare scenes and for the masks of networks. Host code."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, Shaped

from jsecon.field.evidence import view_evidence
from jsecon.parallel import map_over_processes, map_views
from jsecon.types import Camera, Gaussians, Progress

SEEN_PX = 0.3
"""px of rendering weight from which a view shows a Gaussian"""
LOOKS = 8
"""frames with masks that should show a Gaussian: its object is what most of them agree on"""
LEAST_GAIN = 0.01
"""share of the Gaussians that a further frame must show to one that lacks looks"""


def greedy_cover(
    shown: Float[np.ndarray, "v n"],
    importance: Shaped[np.ndarray, " n"],
    views: int,
    *,
    enough: float | int = np.inf,
    least_gain: float = 0.0,
) -> Int[np.ndarray, " k"]:
    """Chooses views that show the scene, one after the other, each time the one that adds most.

    What a Gaussian adds grows with the logarithm of its weight in all chosen views, so that a near view of a small
    thing still counts when others have shown it. This value is submodular: the choice is within 1 - 1/e of the best
    one.

    Args:
      shown: How much each candidate shows each Gaussian, in units of `SEEN_PX`.
      importance: Weight of each Gaussian in the gain.
      views: Largest number of views to choose.
      enough: Sum over the chosen views from which a Gaussian adds nothing more.
      least_gain: Share of the importance below which what a view adds to `enough` is too little to choose it.
    """
    importance = importance.astype(np.float32)
    covered = np.zeros(shown.shape[1], np.float32)
    chosen: list[int] = []
    bound = np.full(len(shown), np.inf)
    for _ in range(min(views, len(shown))):
        bound[chosen] = -np.inf
        best, gain = -1, -np.inf
        for index in np.argsort(-bound, kind="stable"):  # lazy: a gain never grows
            if bound[index] <= gain:
                break
            added = np.minimum(shown[index], enough - covered)
            bound[index] = float(importance @ np.log1p(added / (1 + covered)))
            if bound[index] > gain:
                best, gain = int(index), bound[index]
        added = np.minimum(shown[best], enough - covered)
        if importance @ added < least_gain * importance.sum():
            break
        chosen.append(best)
        covered += added
    return np.array(chosen, int)


def frames_by_need(
    gaussians: Gaussians, cameras: Camera, *, limit: int | None = None, progress: Progress | None = None
) -> Int[np.ndarray, " k"]:
    """Chooses at most `limit` of T frames for masks, those that show most of the scene first.

    A frame is needed where it shows Gaussians that fewer than `LOOKS` chosen frames show. Several processes that make
    the same call share the work.
    """
    counted = np.unique(np.linspace(0, gaussians.count - 1, min(gaussians.count, 100_000)).astype(int))
    whole = np.zeros((cameras.height, cameras.width), np.int32)

    def shown(t: int) -> Float[np.ndarray, " n"]:
        weights = view_evidence(gaussians, cameras[t], whole, 1).matrix(gaussians.count, 1).sum(1)
        return np.minimum(np.asarray(weights, np.float32)[counted, 0] / SEEN_PX, 1)

    looks = np.stack(map_views(len(cameras), shown, progress))
    views = len(cameras) if limit is None else limit

    def choose(rows: Sequence[int]) -> list[np.ndarray]:
        return [greedy_cover(looks, looks.max(0) > 0, views, enough=LOOKS, least_gain=LEAST_GAIN) for _ in rows]

    return map_over_processes(1, choose)[0]  # one process chooses: others may round otherwise
