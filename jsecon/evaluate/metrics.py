"""Metrics, each with its protocol in its name or docstring. A missing prediction counts as 0 and is never skipped."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.numerics import array_module
from jsecon.types import Array

Point = tuple[float | int, float | int]
"""x and y, px."""


def iou(predicted: Bool[Array, "..."], true: Bool[Array, "..."]) -> Float[Array, ""]:
    """Computes the intersection over union of two masks (pixels or points). Pure.

    Args:
      predicted: Mask.
      true: Mask of the same shape.

    Returns:
      () IoU, 1 if both masks are empty.

    Raises:
      ValueError: The shapes differ.
    """
    got, remedy = f"{predicted.shape} and {true.shape}", "Render the prediction at the size of the truth."
    require(predicted.shape == true.shape, "iou", got, "one shape", remedy)
    xp, both, either = array_module(predicted, true), (predicted & true).sum(), (predicted | true).sum()
    return xp.asarray(xp.where(either > 0, both / xp.maximum(either, 1), 1.0))


def mean_iou(ious: Iterable[float | None]) -> float:
    """Computes the plain mean of the IoU over (frame, query) pairs.

    Args:
      ious: IoU of every pair (208 pairs in 22 frames of LERF); None or NaN, a missing prediction, counts as 0.

    Returns:
      The mean, NaN without pairs.
    """
    values = _values(ious)
    return float(values.mean()) if values.size else float("nan")


def accuracy_at(ious: Iterable[float | None], threshold: float = 0.25) -> float:
    """Computes the share of (frame, query) pairs with an IoU strictly above a threshold; mAcc of the papers is at 0.25.

    Args:
      ious: IoU of every pair; None or NaN, a missing prediction, counts as a failure.
      threshold: The threshold.

    Returns:
      The share, NaN without pairs.
    """
    values = _values(ious)
    return float((values > threshold).mean()) if values.size else float("nan")


def localization_accuracy(points: Iterable[Point | None], boxes: Iterable[Float[Array, "b 4"]]) -> float:
    """Computes the share of (frame, query) pairs whose point lies inside of a box of the pair.

    State the definition of the point beside the number: published ones differ.

    Args:
      points: (x, y) of every pair; None, a missing prediction, counts as a failure.
      boxes: (B, 4) x1 y1 x2 y2 of every pair, edges included.

    Returns:
      The share, NaN without pairs.
    """
    hits = [point is not None and _in_any_box(point, box) for point, box in zip(points, boxes, strict=True)]
    return float(np.mean(hits)) if hits else float("nan")


def _in_any_box(point: Point, boxes: Float[Array, "b 4"]) -> bool:
    """Whether a point (x, y) lies inside of any box, edges included; B may be 0."""
    x, y = point
    boxes = np.asarray(boxes)
    return bool(((boxes[:, 0] <= x) & (x <= boxes[:, 2]) & (boxes[:, 1] <= y) & (y <= boxes[:, 3])).any())


def _values(ious: Iterable[float | None]) -> np.ndarray:
    return np.nan_to_num(np.array([np.nan if value is None else float(value) for value in ious]), nan=0.0)
