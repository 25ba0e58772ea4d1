"""LangSplat's 2D protocol: rendered relevancy maps, smoothed, the best of the levels, a fixed threshold.

After minghanqin/LangSplat, eval/evaluate_iou_loc.py. It measures what is rendered, not which Gaussians are selected:
its numbers do not compare with point-level ones.
"""

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.data.lerf_labels import LabelledFrame
from jsecon.errors import require
from jsecon.evaluate.lerf import labelled_pairs
from jsecon.evaluate.metrics import accuracy_at, in_any_box, iou, mean_iou
from jsecon.query.baselines import relevancies
from jsecon.types import Array

WINDOW = 30
"""px, side of the mean filter; even, so that it reaches one pixel further to the left and up"""
VOTE = 3
"""px, reach of the majority vote around a pixel"""
THRESHOLD = 0.4
"""on the normalised map's 2 r - 1, clipped: a relevancy of 0.7 between the image's least and largest"""

TIE = 1e-6
"""maxima that differ by less are equal: LangSplat compares float32"""

_relevancies = jax.jit(relevancies)


@dataclasses.dataclass(frozen=True)
class Decision:
    """What the protocol makes of one query's maps."""

    mask: np.ndarray
    """(H, W) bool of the level chosen for segmentation."""
    level: int
    """that level."""
    peak: np.ndarray
    """(H, W) bool the pixels that the localisation may be at."""


@dataclasses.dataclass(frozen=True)
class PixelRow:
    """One (frame, query) pair."""

    frame: str
    query: str
    iou: float
    located: bool
    level: int
    """-1 for a missing map."""


def pixel_relevancy(
    features: Float[Array, "h w d"], text: Float[Array, " d"], canonical: Float[Array, "c d"]
) -> Float[np.ndarray, "h w"]:
    """LERF's relevancy of each pixel of a rendered (and decoded) feature map; 0.5 where nothing was rendered.

    A zero vector's cosine is 0 with every text. With less it would set the image's least relevancy, by which `decide`
    measures all others.
    """
    height, width, size = features.shape
    found, known = _relevancies(jnp.asarray(features).reshape(-1, size), jnp.asarray(text), jnp.asarray(canonical))
    return np.where(np.asarray(known), np.asarray(found), 0.5).reshape(height, width)


def decide(maps: Float[np.ndarray, "l h w"], *, threshold: float = THRESHOLD) -> Decision:
    """Mask and location of one query from its relevancy maps, one per level; H and W at least 2.

    Segmentation: each map averaged with its mean over 30x30 px; the level whose result has the largest maximum; that
    brought to 0 .. 1 over the image, 2 r - 1, clipped at 0, above the threshold; then each pixel what most of its 7x7
    neighbourhood is, of which the image's last row and column are never a part (ties are off). Localisation: of the
    mean alone, again the level with the largest maximum, and every pixel that attains it.
    """
    require(
        maps.shape[0] > 0 and min(maps.shape[1:]) > 1,
        "decide",
        maps.shape,
        "(L > 0, H > 1, W > 1)",
        "Render the maps at the labels' size.",
    )
    mean = np.stack([_mean(image) for image in maps.astype(np.float64)])
    mixed = 0.5 * (maps + mean)
    level = int(mixed.reshape(len(maps), -1).max(1).argmax())
    image = mixed[level] - mixed[level].min()
    image = image / (image.max() + 1e-9)
    mask = majority(np.clip(2 * image - 1, 0, 1) > threshold)
    best = mean[int(mean.reshape(len(maps), -1).max(1).argmax())]
    return Decision(mask, level, best >= best.max() - TIE)


def _mean(image: np.ndarray) -> np.ndarray:
    return cv2.blur(image, (WINDOW, WINDOW), anchor=(WINDOW // 2, WINDOW // 2), borderType=cv2.BORDER_REFLECT_101)


def majority(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Each pixel what most of rows i-3 .. min(i+3, H-2) and the like columns are; off where as many are on as off."""
    height, width = mask.shape
    sums = np.zeros((height + 1, width + 1), np.int64)
    sums[1:, 1:] = mask.cumsum(0).cumsum(1)
    top, left = (np.maximum(np.arange(size) - VOTE, 0) for size in (height, width))
    bottom, right = (np.minimum(np.arange(size) + VOTE + 1, size - 1) for size in (height, width))
    on = sums[np.ix_(bottom, right)] - sums[np.ix_(top, right)] - sums[np.ix_(bottom, left)] + sums[np.ix_(top, left)]
    return 2 * on > (bottom - top)[:, None] * (right - left)[None]


def evaluate_langsplat_2d(
    labels: Sequence[LabelledFrame],
    maps_of: Callable[[LabelledFrame, str], np.ndarray | None],
    *,
    threshold: float = THRESHOLD,
    expected_pairs: int | None = None,
) -> tuple[list[PixelRow], dict]:
    """A row a labelled (frame, query) pair, and their summary.

    maps_of: frame, query -> relevancy maps (L, H, W) at the labels' size, or None (no answer), which counts as 0. A
    pair whose labelled mask is empty counts as 0 too. Raises InputError for labels without pairs, or with another
    number of them than `expected_pairs`.
    """
    pairs = labelled_pairs(labels, expected_pairs)
    rows = []
    for frame, query in pairs:
        (true, boxes), maps = frame.objects[query], maps_of(frame, query)
        if maps is None:
            rows.append(PixelRow(frame.name, query, 0.0, False, -1))
        else:
            found = decide(np.asarray(maps), threshold=threshold)
            located = any(in_any_box((int(x), int(y)), boxes) for y, x in np.argwhere(found.peak))
            value = float(iou(found.mask, true)) if true.any() else 0.0
            rows.append(PixelRow(frame.name, query, value, located, found.level))
    ious = [row.iou for row in rows]
    return rows, {
        "protocol": f"LangSplat 2D: rendered relevancy, 30x30 smoothing, best level, threshold {threshold:g}",
        "pairs": len(rows),
        "missing": sum(row.level < 0 for row in rows),
        "miou": mean_iou(ious),
        "macc": accuracy_at(ious, 0.25),
        "loc_acc": float(np.mean([row.located for row in rows])),
    }
