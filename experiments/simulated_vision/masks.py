"""Masks simulated from true instance labels, with the faults of real vision at stated rates.

Objects are cut into parts, merged with a neighbour, missing or with a shifted border in single views; a tracker loses
objects and swaps two.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from jsecon.errors import require

REACH_PX = 3
"""regions at most so far apart are neighbours"""


@dataclasses.dataclass(frozen=True)
class Faults:
    """How bad the vision is. Shares are in [0, 1]; the defaults are the level "medium"."""

    split: float | int = 0.2
    """share of the masks (a region in a view) that are cut by straight lines; the largest part keeps the id."""
    parts: int = 2
    """parts of a mask that is cut; each further one has an id of its own, the same in all views."""
    merge: float | int = 0.1
    """share of the masks that take the id of the neighbour with the longest common border, where there is one."""
    miss: float | int = 0.05
    """share of the masks that are missing."""
    jitter_px: int = 2
    """masks grow or shrink by a whole number of px, uniform in -jitter_px .. jitter_px."""
    lose: float | int = 0.2
    """share of the objects that the tracker loses at a frame of the middle half, and never finds by the same id."""
    gone: float | int = 0.5
    """share of the lost objects that stay without label; the others go on under a new id."""
    swap: float | int = 0.2
    """share of the objects whose ids are exchanged, in pairs, from a frame of the middle half on."""
    gap: float | int = 2.2
    """length of what all images have in common, in lengths of a text vector; across the texts' mean direction."""
    gap_along: float | int = -0.16
    """what an image has along the texts' mean direction beyond its own text's."""
    object_noise: float | int = 1.4
    """length of what sets an object's images apart from its class's text, the same in all views."""
    view_noise: float | int = 1.1
    """length of what differs from view to view, at `reference_pixels`; it falls with the root of the pixels."""
    reference_pixels: int = 1000


LEVELS = {
    "low": Faults(0.05, 2, 0.02, 0.02, 1, 0.1, 0.5, 0.0, object_noise=1.0, view_noise=0.6),
    "medium": Faults(),
    "high": Faults(0.4, 3, 0.2, 0.15, 4, 0.4, 0.5, 0.35, object_noise=1.8, view_noise=1.8),
}
"""named levels of noise; `Faults` of all zeros is perfect vision"""


class SimulatedMasks(NamedTuple):
    """What the segmenter and the tracker make of the true labels."""

    labels: np.ndarray
    """(T, H, W) int16 regions 0 .. R-1, -1 = none."""
    origin: np.ndarray
    """(R,) int64 the object that most of the region's pixels show; -1 where most show none."""


def simulated_masks(labels: Int[np.ndarray, "t h w"], faults: Faults, *, seed: int = 0) -> SimulatedMasks:
    """Disturbed region labels of the true objects' labels (T, H, W), -1 = none; a function of its arguments.

    First the tracker's faults, then within each frame cuts, merges, missing masks and jitter. Each kind has its own
    random stream: changing one rate leaves what the others do. Raises ValueError for shares outside [0, 1].
    """
    _check(faults)
    count = int(labels.max(initial=-1)) + 1
    tracked = _track(labels.astype(np.int64), count, faults, seed)
    found = np.stack([_propose(image, 2 * count, faults, seed, t) for t, image in enumerate(tracked)])
    kept, compact = np.unique(found, return_inverse=True)
    compact = (compact.reshape(found.shape) - int((kept < 0).any())).astype(np.int16)
    regions = int((kept >= 0).sum())
    shown = compact >= 0
    joint = np.bincount(
        compact[shown].astype(np.int64) * (count + 1) + labels[shown] + 1, minlength=regions * (count + 1)
    )
    return SimulatedMasks(compact, joint.reshape(regions, count + 1).argmax(1) - 1)


def _check(faults: Faults) -> None:
    for name in ("split", "merge", "miss", "lose", "gone", "swap"):
        share = getattr(faults, name)
        require(0 <= share <= 1, f"Faults.{name}", share, "a share in [0, 1]", "See LEVELS.")
    require(
        faults.parts >= 2 and faults.jitter_px >= 0,
        "Faults",
        f"parts={faults.parts}, jitter_px={faults.jitter_px}",
        "parts >= 2, jitter_px >= 0",
        "split=0 cuts nothing.",
    )


def _track(labels: np.ndarray, count: int, faults: Faults, seed: int) -> np.ndarray:
    """The true labels under the tracker's ids; a lost object k goes on as count + k, or not at all."""
    tracked, frames = labels.copy(), len(labels)
    draw = np.random.default_rng([seed, 0])
    whole = draw.permutation(count)[: 2 * round(faults.swap * count / 2)]
    for a, b in whole.reshape(-1, 2):
        later = tracked[_middle(draw, frames) :]
        is_a, is_b = later == a, later == b
        later[is_a], later[is_b] = b, a
    draw = np.random.default_rng([seed, 1])
    lost = draw.permutation(count)[: round(faults.lose * count)]
    for place, k in enumerate(lost):
        later = tracked[_middle(draw, frames) :]
        later[later == k] = -1 if place < round(faults.gone * len(lost)) else count + k
    return tracked


def _middle(draw: np.random.Generator, frames: int) -> int:
    return int(draw.integers(frames // 4, max(3 * frames // 4, frames // 4 + 1)))


def _propose(image: np.ndarray, ids: int, faults: Faults, seed: int, t: int) -> np.ndarray:
    """One frame's masks; part p of id r is ids * p + r."""
    found = image.copy()
    here = np.unique(image[image >= 0])

    draw = np.random.default_rng([seed, 2, t])
    for r in here:
        cut, angle = draw.random() < faults.split, draw.uniform(0, np.pi)
        if cut:
            rows, columns = np.nonzero(image == r)
            along = np.cos(angle) * columns + np.sin(angle) * rows
            share = np.sort(draw.dirichlet(np.full(faults.parts, 3.0)))[::-1]
            part = np.searchsorted(np.quantile(along, np.cumsum(share)[:-1]), along)
            found[rows, columns] = ids * part + r

    draw = np.random.default_rng([seed, 3, t])
    before = found.copy()
    for r in here:
        if draw.random() < faults.merge:
            mask = image == r
            near = image[_grown(mask, REACH_PX) & ~mask]
            near = near[near >= 0]
            if len(near):
                other = np.bincount(near).argmax()
                # Each takes the id that its neighbour had before any merge: two that choose each other trade theirs.
                found[mask] = np.where(before[mask] == r, other, before[mask])

    draw = np.random.default_rng([seed, 4, t])
    for r in here:
        if draw.random() < faults.miss:
            found[image == r] = -1

    if faults.jitter_px:
        draw = np.random.default_rng([seed, 5, t])
        before = found.copy()
        for r in np.unique(before[before >= 0]):
            by, mask = int(draw.integers(-faults.jitter_px, faults.jitter_px + 1)), before == r
            if by > 0:
                found[_grown(mask, by)] = r
            elif by < 0:
                found[mask & (found == r) & _grown(~mask, -by)] = -1
    return found


def _grown(mask: np.ndarray, by: int) -> np.ndarray:
    """The mask and all pixels at most `by` steps to a side from it."""
    grown = mask.copy()
    for _ in range(by):
        last = grown.copy()
        grown[1:] |= last[:-1]
        grown[:-1] |= last[1:]
        grown[:, 1:] |= last[:, :-1]
        grown[:, :-1] |= last[:, 1:]
    return grown
