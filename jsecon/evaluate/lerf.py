"""OpenGaussian's "point level, rendered" protocol on LERF-style labels: select by the text, render what was selected.

For every labelled frame and every category labelled in it: the Gaussians selected for the category (once a scene, not a
frame) are rendered without all others at the size of the labels, alpha > 0.7 is the mask, its IoU with the labelled
mask is the pair's. mIoU and mAcc@0.25 (strict) are over all pairs; a pair without prediction counts as 0.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jsecon.data.labels import LabelledFrame
from jsecon.errors import InputError
from jsecon.evaluate.metrics import accuracy_at, in_any_box, iou, mean_iou
from jsecon.fit.resize import resize_camera
from jsecon.query.render import ALPHA_THRESHOLD, VALA_THRESHOLD, render_selection
from jsecon.types import Camera, Gaussians, Selection

LOCALISATION_WINDOW = 0.04
"""side of the box filter before the maximum is taken, as a part of the image's height: LangSplat's 30 px of 730"""


@dataclasses.dataclass(frozen=True)
class Row:
    """One (frame, query) pair."""

    frame: str
    """name of the labelled frame."""
    query: str
    """category."""
    iou: float
    """of the rendered selection's mask with the labelled one; 0 for a missing prediction."""
    located: bool
    """whether `point` lies in a labelled box: localisation by the peak of similarity."""
    touched: bool
    """whether any of the mask's innermost pixels lies in a labelled box: localisation by the mask."""
    centred: bool
    """whether the centre of the mask's bounding box lies in a labelled box: the paper's Loc. Acc."""
    point: tuple[int, int] | None
    """x, y px of the localisation maximum; None for a missing prediction."""
    selected: int
    """Gaussians selected."""
    region: int
    """that anchored the query, -1 = none."""
    score: float
    """of the query."""
    mask: np.ndarray = dataclasses.field(repr=False, compare=False)
    """(H, W) bool the rendered selection's mask, for pictures."""


def evaluate_point_level_rendered(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    labels: Sequence[LabelledFrame],
    select: Callable[[str], Selection | None],
    *,
    alpha_threshold: float = ALPHA_THRESHOLD,
    **options: Any,
) -> tuple[list[Row], dict]:
    """`evaluate_at_thresholds` at one threshold, the protocol's own."""
    found = evaluate_at_thresholds(gaussians, cameras, labels, select, alpha_thresholds=(alpha_threshold,), **options)
    return found[alpha_threshold]


def evaluate_at_thresholds(
    gaussians: Gaussians,
    cameras: Mapping[str, Camera],
    labels: Sequence[LabelledFrame],
    select: Callable[[str], Selection | None],
    *,
    alpha_thresholds: tuple[float, ...] = (ALPHA_THRESHOLD, VALA_THRESHOLD),
    expected_pairs: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[float, tuple[list[Row], dict]]:
    """By silhouette threshold (OpenGaussian's, and VALA's to stand beside it): rows, one for each labelled (frame,
    query) pair, and their summary, under the module's protocol, from one rendering per pair.

    cameras: by frame name, of any size with the labels' aspect; they are brought to the labels' size.
    select: category -> Selection over the Gaussians; None (no answer to this text) counts as missing.
    expected_pairs: the protocol's denominator where it is known (`experiments.datasets.lerf_ovs.LERF_PAIRS`), checked.

    Localisation has three readings. As the paper defines it ("Evaluation metrics"),
    summary["loc_box"]: the centre of the bounding box of the binary mask lies in a labelled box. By the peak,
    summary["loc_acc"]: the point of maximum of the selected Gaussians' similarity, composited by sum alpha T s over
    them alone and smoothed by a mean over a window of 4 % of the image's height, lies in a labelled box of the
    category, edges included. By the mask, summary["loc_mask"]: the same smoothing of the binary mask, and any of the
    pixels where it is largest (LangSplat's rule for ties), lies in one. Raises InputError for a labelled frame without
    a camera or of another aspect, for labels without pairs, and where the number of pairs is not the expected one.
    """
    for frame in labels:
        _check(frame, cameras)
    pairs = labelled_pairs(labels, expected_pairs)
    answers: dict[str, Selection | None] = {}
    rows: dict[float, list[Row]] = {threshold: [] for threshold in alpha_thresholds}
    for done, (frame, category) in enumerate(pairs, start=1):
        if category not in answers:
            answers[category] = select(category)
        camera = resize_camera(cameras[frame.name], frame.width, frame.height)
        found = _rows(gaussians, camera, frame, category, answers[category], alpha_thresholds)
        for threshold, row in zip(alpha_thresholds, found):
            rows[threshold].append(row)
        if progress is not None:
            progress(done, len(pairs))
    return {threshold: (found, summary(found, threshold)) for threshold, found in rows.items()}


def summary(rows: Sequence[Row], alpha_threshold: float = ALPHA_THRESHOLD) -> dict:
    """{"protocol", "pairs", "frames", "queries", "missing", "miou", "macc", "acc_50", and "loc_acc", "loc_mask",
    "loc_box"}."""
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
        "loc_acc": float(np.mean([row.located for row in rows])) if rows else float("nan"),
        "loc_mask": float(np.mean([row.touched for row in rows])) if rows else float("nan"),
        "loc_box": float(np.mean([row.centred for row in rows])) if rows else float("nan"),
    }


def labelled_pairs(labels: Sequence[LabelledFrame], expected: int | None) -> list[tuple[LabelledFrame, str]]:
    """All (frame, query) pairs. Raises InputError for none, or another number than `expected`."""
    pairs = [(frame, query) for frame in labels for query in frame.objects]
    if not pairs or (expected is not None and len(pairs) != expected):
        remedy = "Evaluate on the very label files of the protocol, all of them."
        raise InputError("labels", f"{len(pairs)} (frame, query) pairs", f"{expected or 'at least one'}", remedy)
    return pairs


def _rows(
    gaussians: Gaussians,
    camera: Camera,
    frame: LabelledFrame,
    category: str,
    selection: Selection | None,
    thresholds: tuple[float, ...],
) -> list[Row]:
    true, boxes = frame.objects[category]
    count = 0 if selection is None else int(np.asarray(selection.mask).sum())
    region, score = (-1, 0.0) if selection is None else (int(selection.region), float(selection.score))
    if selection is None or not count:
        nothing = np.zeros(true.shape, bool)
        return [
            Row(frame.name, category, 0.0, False, False, False, None, 0, region, score, nothing) for _ in thresholds
        ]
    camera = jax.tree.map(jnp.asarray, camera)
    rendering = render_selection(gaussians, camera, selection.mask, selection.similarity)
    alpha, point = np.asarray(rendering.alpha), _middle(_peak(np.asarray(rendering.features[..., 0])))
    rows = []
    for threshold in thresholds:
        mask = alpha > threshold
        share = float(iou(mask, true)) if true.any() else 0.0
        located = point is not None and in_any_box(point, boxes)
        touched = any(in_any_box((int(x), int(y)), boxes) for y, x in np.argwhere(_peak(mask)))
        centre = _box_centre(mask)
        centred = centre is not None and in_any_box(centre, boxes)
        rows.append(Row(frame.name, category, share, located, touched, centred, point, count, region, score, mask))
    return rows


def _peak(image: np.ndarray) -> np.ndarray:
    """(H, W) bool where the smoothed image is largest; nowhere where it is not positive."""
    window = 2 * round(LOCALISATION_WINDOW * image.shape[0] / 2) + 1
    smooth = cv2.blur(image.astype(np.float64), (window, window), borderType=cv2.BORDER_REFLECT_101)
    return (smooth >= smooth.max() * (1 - 1e-6)) & (image.max() > 0)


def _middle(where: np.ndarray) -> tuple[int, int] | None:
    """x, y of the pixel of a mask that is nearest to its centre; None for an empty one."""
    y, x = np.nonzero(where)
    if not len(y):
        return None
    middle = np.argmin((x - x.mean()) ** 2 + (y - y.mean()) ** 2)
    return int(x[middle]), int(y[middle])


def _box_centre(mask: np.ndarray) -> tuple[int, int] | None:
    """x, y of the pixel in the middle of a mask's bounding box; None for an empty one."""
    y, x = np.nonzero(mask)
    return (int(x.min() + x.max()) // 2, int(y.min() + y.max()) // 2) if len(y) else None


def _check(frame: LabelledFrame, cameras: Mapping[str, Camera]) -> None:
    if frame.name not in cameras:
        some = ", ".join(sorted(cameras)[:3])
        remedy = "Evaluate with the capture that was labelled, and leave none of its labelled frames out."
        found = "no frame of that name in the capture"
        raise InputError(f"labels of {frame.name}", found, f"one of {some}, ...", remedy)
    camera = cameras[frame.name]
    if abs(frame.width / camera.width - frame.height / camera.height) > 0.02 * frame.width / camera.width:
        found, expected = (f"{size.width}x{size.height}" for size in (frame, camera))
        remedy = "Label the undistorted frames, or scale the labels to them."
        raise InputError(f"labels of {frame.name}", found, f"the aspect of the frame, {expected}", remedy)
