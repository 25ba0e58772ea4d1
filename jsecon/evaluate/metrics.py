"""Metrics, each with its protocol in its name or docstring. A missing prediction counts as 0, never as left out."""

from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import require
from jsecon.types import Array

Point = tuple[float | int, float | int]
"""x, y px"""


def iou(predicted: Bool[Array, "..."], true: Bool[Array, "..."]) -> Float[Array, ""]:
    """Intersection over union of two masks of one shape (pixels or points); 1 where both are empty. Jit-safe."""
    got, remedy = f"{predicted.shape} and {true.shape}", "Render the prediction at the size of the truth."
    require(predicted.shape == true.shape, "iou", got, "one shape", remedy)
    both, either = jnp.sum(predicted & true), jnp.sum(predicted | true)
    return jnp.where(either > 0, both / jnp.maximum(either, 1), 1.0)


def mean_iou(ious: Iterable[float | None]) -> float:
    """Plain mean over (frame, query) pairs of their IoU; None or NaN, a missing prediction, counts as 0.

    The denominator is the number of pairs (208 on LERF, over its 22 frames): pass every pair. NaN for none at all.
    """
    values = _values(ious)
    return float(values.mean()) if values.size else float("nan")


def accuracy_at(ious: Iterable[float | None], threshold: float = 0.25) -> float:
    """Share of (frame, query) pairs with an IoU strictly above `threshold`; mAcc in the papers is that at 0.25.

    None or NaN, a missing prediction, counts as a failure. NaN for no pairs at all.
    """
    values = _values(ious)
    return float((values > threshold).mean()) if values.size else float("nan")


def localization_accuracy(points: Iterable[Point | None], boxes: Iterable[Float[Array, "b 4"]]) -> float:
    """Share of (frame, query) pairs whose point (x, y) lies inside, edges included, any of the pair's boxes.

    Boxes are x1 y1 x2 y2. None, a missing prediction, counts as a failure. What the point is, is the caller's
    definition: say it beside the number, as published ones mean different things. NaN for no pairs.
    """
    hits = [point is not None and in_any_box(point, box) for point, box in zip(points, boxes, strict=True)]
    return float(np.mean(hits)) if hits else float("nan")


def in_any_box(point: Point, boxes: Float[Array, "b 4"]) -> bool:
    """Whether (x, y) lies inside any of the boxes x1 y1 x2 y2, edges included."""
    x, y = point
    boxes = np.asarray(boxes)
    return bool(((boxes[:, 0] <= x) & (x <= boxes[:, 2]) & (boxes[:, 1] <= y) & (y <= boxes[:, 3])).any())


def _values(ious: Iterable[float | None]) -> np.ndarray:
    return np.nan_to_num(np.array([np.nan if value is None else float(value) for value in ious]), nan=0.0)
