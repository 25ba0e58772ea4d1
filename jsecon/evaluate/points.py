"""ScanNet's and Replica's protocol at the points: the class of each, then means over the classes that occur.

OpenGaussian's ScanNet script (REFERENCE D.7): mIoU and mAcc (mean recall) over the classes present in the truth; mAcc
here is not "IoU > 0.25".
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError, require
from jsecon.evaluate.metrics import class_scores
from jsecon.types import Array

LEAST_OPACITY = 0.1
"""points whose Gaussian is fainter are left out of the truth"""


@dataclasses.dataclass(frozen=True)
class ClassRow:
    """One class that occurs."""

    query: str
    iou: float
    recall: float
    points: int
    """of the class, counted."""
    predicted: int
    """counted points that were given this class."""


def evaluate_points(
    predicted: Int[Array, " n"],
    truth: Int[Array, " n"],
    queries: Sequence[str],
    *,
    expected_classes: int | None = None,
    opacities: Float[Array, " n"] | None = None,
) -> tuple[list[ClassRow], dict]:
    """A row a class that occurs in the truth, and the summary.

    predicted: class of each point, -1 = none, which is a miss and never left out; truth: index into `queries`, -1 = not
    evaluated. Points whose Gaussian has an opacity below 0.1 (where `opacities` are given) are not evaluated. Raises
    ValueError for a class beyond the queries, InputError where another number of classes than `expected_classes`
    occurs: the mean would be over something else.
    """
    predicted, true = np.asarray(predicted), np.asarray(truth)
    highest = int(max(predicted.max(initial=-1), true.max(initial=-1)))
    require(
        highest < len(queries),
        "evaluate_points",
        got=f"classes up to {highest}",
        expected=f"below {len(queries)}",
        remedy="Count classes by the queries.",
    )
    counted = true >= 0
    faint = 0
    if opacities is not None:
        faint = int((counted & (np.asarray(opacities) < LEAST_OPACITY)).sum())
        counted &= np.asarray(opacities) >= LEAST_OPACITY
    predicted, true = predicted[counted], true[counted]
    rows = [
        ClassRow(queries[k], own, recall, int((true == k).sum()), int((predicted == k).sum()))
        for k, (own, recall) in class_scores(predicted, true).items()
    ]
    if not rows or (expected_classes is not None and len(rows) != expected_classes):
        raise InputError(
            "labelled points",
            found=f"{len(rows)} classes among {len(true)} counted points ({faint} left out as faint)",
            expected=f"{expected_classes or 'at least one'}",
            remedy="Evaluate on all labelled points of the scene, with the protocol's class set.",
        )
    return rows, {
        "protocol": "points: most similar class; means over the classes that occur of IoU and of recall",
        "pairs": len(rows),
        "points": len(true),
        "faint": faint,
        "missing": int((predicted < 0).sum()),
        "miou": float(np.mean([row.iou for row in rows])),
        "macc": float(np.mean([row.recall for row in rows])),
        "accuracy": float((predicted == true).mean()),
    }
