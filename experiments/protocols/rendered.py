"""Variants of the rendered protocol of jsecon.evaluate.lerf: VALA's threshold, and localisation by masks."""

from collections.abc import Sequence

import cv2
import numpy as np

from jsecon import localization_accuracy
from jsecon.evaluate.lerf import Row
from jsecon.read.masks.labels import LabelledFrame

VALA_THRESHOLD = 10 / 255
"""Alpha of VALA's silhouette: lenient, it rewards faint selections; reported beside 0.7."""


def by_masks(rows: Sequence[Row], labels: Sequence[LabelledFrame]) -> dict[str, float]:
    """Localisation accuracies by the mask of each pair.

    loc_box: the paper's ("Evaluation metrics"): the centre of the mask's bounding box lies in a labelled box.
    loc_mask: any of the largest pixels of the smoothed mask (LangSplat's rule for ties) lies in one.
    """
    boxes = {(frame.name, query): box for frame in labels for query, (_, box) in frame.objects.items()}
    touched, centred = [], []
    for row in rows:
        own = boxes[row.frame, row.query]
        peaks = [(int(x), int(y)) for y, x in np.argwhere(_largest_pixels(row.mask))]
        touched.append(localization_accuracy(peaks, [own] * len(peaks)) > 0)
        centred.append(localization_accuracy([_box_centre(row.mask)], [own]) > 0)
    return {"loc_mask": float(np.mean(touched)), "loc_box": float(np.mean(centred))}


def _largest_pixels(mask: np.ndarray) -> np.ndarray:
    """(H, W) bool the largest pixels of the smoothed mask, if it has any."""
    window = 2 * round(0.04 * mask.shape[0] / 2) + 1  # px, as jsecon.evaluate.lerf smooths similarities
    smooth = cv2.blur(mask.astype(np.float64), (window, window), borderType=cv2.BORDER_REFLECT_101)
    return (smooth >= smooth.max() * (1 - 1e-6)) & mask.any()


def _box_centre(mask: np.ndarray) -> tuple[int, int] | None:
    """x, y of the centre of the bounding box of a mask; None for an empty mask."""
    y, x = np.nonzero(mask)
    return (int(x.min() + x.max()) // 2, int(y.min() + y.max()) // 2) if len(y) else None
