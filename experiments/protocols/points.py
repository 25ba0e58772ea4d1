"""ScanNet's and Replica's protocol at the points: the class of each, then means over the classes that occur.

yanmin-wu/OpenGaussian, scripts/eval_scannet.py: mIoU and mAcc (mean recall) over the classes present in the truth; mAcc
here is not "IoU > 0.25".
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jsecon.errors import InputError, require
from jsecon.types import Array

LEAST_OPACITY = 0.1
"""points whose Gaussian is fainter are left out of the truth"""


def evaluate_points(
    predicted: Int[Array, " n"],
    truth: Int[Array, " n"],
    queries: Sequence[str],
    *,
    expected_classes: int | None = None,
    opacities: Float[Array, " n"] | None = None,
) -> tuple[dict[str, float], dict[str, float]]:
    """The IoU of each class that occurs in the truth, and the summary.

    predicted: class of each point, -1 = none, which is a miss and never left out; truth: index into `queries`, -1 = not
    evaluated. Points whose Gaussian has an opacity below 0.1 (where `opacities` are given) are not evaluated. Raises
    ValueError for a class beyond the queries, InputError where another number of classes than `expected_classes`
    occurs: the mean would be over something else.
    """
    predicted, true = np.asarray(predicted), np.asarray(truth)
    highest = int(max(predicted.max(initial=-1), true.max(initial=-1)))
    below, remedy = f"below {len(queries)}", "Count classes by the queries."
    require(highest < len(queries), "evaluate_points", f"classes up to {highest}", below, remedy)
    counted = true >= 0
    if opacities is not None:
        counted &= np.asarray(opacities) >= LEAST_OPACITY
    predicted, true = predicted[counted], true[counted]
    scores = class_scores(predicted, true)
    if not scores or len(scores) != (expected_classes or len(scores)):
        problem = f"{len(scores)} classes among {len(true)} counted points"
        remedy = "Evaluate on all labelled points of the scene, with the protocol's class set."
        raise InputError("labelled points", problem, f"{expected_classes or 'at least one'}", remedy)
    miou, macc = point_class_means(predicted, true)
    figures = {"miou": miou, "macc": macc, "accuracy": point_accuracy(predicted, true)}
    figures |= {"pairs": len(scores), "missing": int((predicted < 0).sum())}
    return {queries[k]: iou for k, (iou, _) in scores.items()}, figures


def point_accuracy(predicted: Int[Array, " n"], true: Int[Array, " n"]) -> float:
    """Share of the points with a true label (not -1) whose predicted label equals it. NaN for none."""
    predicted, true = np.asarray(predicted), np.asarray(true)
    counted = true != -1
    return float((predicted == true)[counted].mean()) if counted.any() else float("nan")


def point_class_means(predicted: Int[Array, " n"], true: Int[Array, " n"]) -> tuple[float, float]:
    """(mIoU, mAcc): means over the classes that occur in the truth of IoU and of recall. Points of true label -1 are
    left out of both sides. NaN where no point has a label."""
    scores = list(class_scores(predicted, true).values())
    miou, macc = np.mean(scores, axis=0) if scores else (np.nan, np.nan)
    return float(miou), float(macc)


def class_scores(predicted: Int[Array, " n"], true: Int[Array, " n"]) -> dict[int, tuple[float, float]]:
    """(IoU, recall) of each class that occurs in the truth; points of true label -1 are left out."""
    predicted, true = np.asarray(predicted), np.asarray(true)
    predicted, true = predicted[true != -1], true[true != -1]
    scores = {}
    for label in np.unique(true):
        both = np.sum((predicted == label) & (true == label))
        either = np.sum((predicted == label) | (true == label))
        scores[int(label)] = float(both / either), float(both / np.sum(true == label))
    return scores
