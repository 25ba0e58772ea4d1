"""ScanNet's and Replica's protocol at the points: the class of each, then means over the classes that occur.

yanmin-wu/OpenGaussian, scripts/eval_scannet.py: mIoU and mAcc (mean recall) over the classes present in the truth; mAcc
here is not "IoU > 0.25".
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError, require
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
    """A row per class that occurs in the truth, and the summary.

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
        f"classes up to {highest}",
        f"below {len(queries)}",
        "Count classes by the queries.",
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
        problem = f"{len(rows)} classes among {len(true)} counted points ({faint} left out as faint)"
        remedy = "Evaluate on all labelled points of the scene, with the protocol's class set."
        raise InputError("labelled points", problem, f"{expected_classes or 'at least one'}", remedy)
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


def point_accuracy(predicted: Int[Array, " n"], true: Int[Array, " n"], *, ignore: int = -1) -> float:
    """Share of the points with a true label (not `ignore`) whose predicted label equals it. NaN for none."""
    predicted, true = np.asarray(predicted), np.asarray(true)
    counted = true != ignore
    return float((predicted == true)[counted].mean()) if counted.any() else float("nan")


def point_class_means(predicted: Int[Array, " n"], true: Int[Array, " n"], *, ignore: int = -1) -> tuple[float, float]:
    """(mIoU, mAcc) at the level of points: means over the classes that occur in the truth of IoU and of recall.

    OpenGaussian's ScanNet script, and the likely meaning of mAcc on Replica (yanmin-wu/OpenGaussian,
    scripts/eval_scannet.py), not "IoU > 0.25". Points of true label `ignore` are left out of both sides. NaN where no
    point has a label.
    """
    scores = list(class_scores(predicted, true, ignore=ignore).values())
    miou, macc = np.mean(scores, axis=0) if scores else (np.nan, np.nan)
    return float(miou), float(macc)


def class_scores(
    predicted: Int[Array, " n"], true: Int[Array, " n"], *, ignore: int = -1
) -> dict[int, tuple[float, float]]:
    """(IoU, recall) of each class that occurs in the truth; points of true label `ignore` are left out."""
    predicted, true = np.asarray(predicted), np.asarray(true)
    predicted, true = predicted[true != ignore], true[true != ignore]
    scores = {}
    for label in np.unique(true):
        both = np.sum((predicted == label) & (true == label))
        either = np.sum((predicted == label) | (true == label))
        scores[int(label)] = float(both / either), float(both / np.sum(true == label))
    return scores
