"""OpenGaussian's "point level, rendered" protocol on labels like LERF's. Host code.

For every labelled frame and category, the Gaussians selected for the category (once per scene) are rendered alone at
the size of the labels. The mask is alpha > 0.7, and its IoU with the labelled mask counts for the pair. mIoU and
mAcc@0.25 (strict) are over all pairs; a pair without prediction counts as 0. For the localisation accuracy the peak of
the similarity, composited by sum alpha T s over the selected Gaussians alone and averaged over a window of 4 % of the
image height, lies in a labelled box, edges included.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jsecon.errors import InputError
from jsecon.evaluate.metrics import accuracy_at, iou, localization_accuracy, mean_iou
from jsecon.fit.resize import resize_camera
from jsecon.query.selection_masks import ALPHA_THRESHOLD, render_selection
from jsecon.read.masks.labels import LabelledFrame
from jsecon.types import Camera, Gaussians, Progress, Selection


@dataclasses.dataclass(frozen=True)
class Row:
    """Result of one (frame, category) pair; of a missing prediction IoU 0 and no point."""

    frame: str
    query: str
    iou: float
    located: bool
    point: tuple[int, int] | None  # x, y px of the peak of similarity
    selected: int  # number of Gaussians
    region: int  # that anchored the query, or -1
    score: float
    mask: np.ndarray = dataclasses.field(repr=False, compare=False)  # (H, W) bool, for pictures


def evaluate_labels(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    labels: Sequence[LabelledFrame],
    select: Callable[[str], Selection | None],
    *,
    alpha_threshold: float = ALPHA_THRESHOLD,
    progress: Progress | None = None,
) -> tuple[list[Row], dict]:
    """Evaluates selections of labelled categories.

    Args:
      gaussians: Scene of N Gaussians.
      cameras: Camera of each frame by name, of any size with the aspect of the labels.
      labels: Labelled frames.
      select: Maps a category to a selection of Gaussians; None, no answer, counts as missing.
      alpha_threshold: Threshold of the mask, by default OpenGaussian's.
      progress: Called with the number of pairs done and of all.

    Returns:
      The rows, one per labelled (frame, query) pair, and their summary.
    """
    for frame in labels:
        _check(frame, cameras)
    pairs = [(frame, query) for frame in labels for query in frame.objects]
    if not pairs:
        raise InputError("labels", "0 (frame, query) pairs", "at least one", "Give the folder of the label files.")
    answers: dict[str, Selection | None] = {}
    rows = []
    for done, (frame, category) in enumerate(pairs, start=1):
        if category not in answers:
            answers[category] = select(category)
        camera = resize_camera(cameras[frame.name], frame.width, frame.height)
        rows.append(_row(gaussians, camera, frame, category, answers[category], alpha_threshold))
        if progress is not None:
            progress(done, len(pairs))
    return rows, _summary(rows, alpha_threshold)


def _summary(rows: Sequence[Row], alpha_threshold: float) -> dict:
    """Summarises rows at one alpha threshold."""
    ious = [row.iou for row in rows]
    return {
        "protocol": f"point level, rendered: selected Gaussians alone, alpha > {alpha_threshold:.3g}; mean over pairs",
        "pairs": len(rows),
        "frames": len({row.frame for row in rows}),
        "queries": len({row.query for row in rows}),
        "missing": sum(row.point is None for row in rows),
        "miou": mean_iou(ious),
        "macc": accuracy_at(ious, 0.25),
        "acc_50": accuracy_at(ious, 0.5),
        "loc_acc": float(np.mean([row.located for row in rows])),
    }


def _row(
    gaussians: Gaussians,
    camera: Camera,
    frame: LabelledFrame,
    category: str,
    selection: Selection | None,
    alpha_threshold: float,
) -> Row:
    true, boxes = frame.objects[category]
    count = 0 if selection is None else int(np.asarray(selection.mask).sum())
    region, score = (-1, 0.0) if selection is None else (int(selection.region), float(selection.score))
    if selection is None or not count:
        return Row(frame.name, category, 0.0, False, None, 0, region, score, np.zeros(true.shape, bool))
    camera = jax.tree.map(jnp.asarray, camera)
    rendering = render_selection(gaussians, camera, selection.mask, selection.similarity)
    mask = np.asarray(rendering.alpha) > alpha_threshold
    point = _peak(np.asarray(rendering.features[..., 0]))
    share = float(iou(mask, true)) if true.any() else 0.0
    located = localization_accuracy([point], [boxes]) > 0
    return Row(frame.name, category, share, located, point, count, region, score, mask)


def _peak(image: np.ndarray) -> tuple[int, int] | None:
    """x, y of the pixel nearest to the centre of the largest pixels of the smoothed image; None if none is positive."""
    window = 2 * round(0.04 * image.shape[0] / 2) + 1  # side of a box filter, px: LangSplat's 30 of 730
    smooth = cv2.blur(image.astype(np.float64), (window, window), borderType=cv2.BORDER_REFLECT_101)
    if not image.max() > 0:
        return None
    y, x = np.nonzero(smooth >= smooth.max() * (1 - 1e-6))
    middle = np.argmin((x - x.mean()) ** 2 + (y - y.mean()) ** 2)
    return int(x[middle]), int(y[middle])


def _check(frame: LabelledFrame, cameras: Mapping[str, Camera]) -> None:
    if frame.name not in cameras:
        some = ", ".join(sorted(cameras)[:3])
        remedy = "Evaluate with the labelled capture and all of its labelled frames."
        problem = f"the capture has no frame of that name; it has {some}, ..."
        raise InputError(f"labels of {frame.name}", problem, remedy=remedy)
    camera = cameras[frame.name]
    if abs(frame.width / camera.width - frame.height / camera.height) > 0.02 * frame.width / camera.width:
        labelled, size = (f"{size.width}x{size.height}" for size in (frame, camera))
        remedy = "Label the undistorted frames, or scale the labels to them."
        raise InputError(
            f"labels of {frame.name}", f"{labelled} has another aspect than the frame, {size}", remedy=remedy
        )
