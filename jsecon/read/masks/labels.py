"""LERF-style labels in LangSplat's annotation, on the host: frame_XXXXX.json with polygons and boxes by category.

Reading follows LangSplat's eval/utils.py: polygon corners cut to integers, filled with cv2.fillPoly (corners and edges
belong to the mask), the objects of a category OR-ed, their boxes side by side.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool

from jsecon.errors import InputError, require
from jsecon.files import path_within, read_json, write_text
from jsecon.read.captures.images import MAX_PIXELS
from jsecon.types import record, static

_REMEDY = "Label the frame again (LangSplat's format, as its LERF-OVS labels have it)."


@record
class LabelledFrame:
    """The annotation of one frame."""

    name: str = static()
    """the frame's name without ending, as in Capture.names."""
    width: int = static()
    """px."""
    height: int = static()
    """px."""
    objects: dict[str, tuple[np.ndarray, np.ndarray]]
    """category -> mask bool (H, W), boxes float32 (B, 4) x1 y1 x2 y2 in px, ends included."""


def load_lerf_labels(folder: str | Path) -> list[LabelledFrame]:
    """Reads the labels of a folder.

    `iscrowd` is ignored. Polygons may lie partly outside the image. Objects of one category with the same box count as
    one box.

    Args:
      folder: Folder of `*.json` files.

    Returns:
      The labelled frames, in name order.

    Raises:
      InputError: There is no label file, or one is damaged.
    """
    folder = Path(folder)
    files = sorted(folder.glob("*.json"))
    if not files:
        raise InputError(folder, "it holds no .json file", "frame_XXXXX.json labels", "Check the path.")
    return [_read(file) for file in files]


def _error(file: Path, problem: str, expected: str) -> InputError:
    """An error of a label file."""
    return InputError(file, problem, expected, _REMEDY)


def _get(file: Path, record: Any, key: str, kind: type | tuple[type, ...], where: str) -> Any:
    """A required value of some type; `where` names the record."""
    if not isinstance(record, dict) or not isinstance(record.get(key), kind):
        expected = "info (name, width, height) and objects (category, segmentation, bbox)"
        raise _error(file, f"there is no usable {key!r} in {where}", expected)
    return record[key]


def _read(file: Path) -> LabelledFrame:
    """Reads one label file."""
    content = read_json(file, "a label file", _REMEDY)
    info = _get(file, content, "info", dict, "the file")
    name = Path(_get(file, info, "name", str, "info")).stem
    width, height = (int(_get(file, info, key, int, "info")) for key in ("width", "height"))
    if min(width, height) < 1 or width * height > MAX_PIXELS:
        raise _error(file, f"the image is {width}x{height}", f"a positive size, at most {MAX_PIXELS} pixels")
    objects: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for index, entry in enumerate(_get(file, content, "objects", list, "the file")):
        where = f"object {index}"
        category = _get(file, entry, "category", str, where)
        polygon = _numbers(file, _get(file, entry, "segmentation", list, where), (-1, 2), f"segmentation of {where}")
        box = _numbers(file, _get(file, entry, "bbox", list, where), (1, 4), f"bbox of {where}").astype(np.float32)
        mask = cv2.fillPoly(np.zeros((height, width), np.uint8), [polygon.astype(np.int32)], 1).astype(bool)
        if category in objects:
            before, boxes = objects[category]
            mask = mask | before
            box = boxes if (boxes == box).all(1).any() else np.concatenate([boxes, box])
        objects[category] = mask, box
    return LabelledFrame(name, width, height, objects)


def _numbers(file: Path, values: list, shape: tuple[int, int], what: str) -> np.ndarray:
    """An array of a list of numbers; a dimension of `shape` may be -1."""
    try:
        array = np.array(values, np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        problem = f"the {what} is not a list of {shape[1]} numbers each"
        raise _error(file, problem, "[x, y] corners, and x1 y1 x2 y2") from error
    if not np.isfinite(array).all() or np.abs(array).max(initial=0) > 1e6 or not len(array):
        raise _error(file, f"the {what} is empty or out of all range", "pixels")
    return array


def write_lerf_labels(folder: str | Path, frames: Iterable[LabelledFrame], *, image_ending: str = ".png") -> None:
    """Writes `<name>.json` of each frame; `load_lerf_labels` gives the same masks and boxes back.

    A polygon has one piece and no holes, so a mask is written as several objects of its category: one for each
    connected piece, and pieces with holes are cut along pixel rows. Each has the category's box that fits it best.

    Args:
      folder: The folder.
      frames: The labelled frames.
      image_ending: Suffix of the frames' images.

    Raises:
      ValueError: A category has no pixels or boxes.
      InputError: The folder cannot be written.
    """
    for frame in frames:
        objects = []
        for group, (category, (mask, boxes)) in enumerate(frame.objects.items(), start=1):
            fits = mask.shape == (frame.height, frame.width) and bool(mask.any()) and len(boxes) > 0
            got = f"mask {mask.shape} with {int(mask.sum())} pixels, {len(boxes)} boxes"
            expected = f"({frame.height}, {frame.width}), with pixels and a box"
            require(fits, f"{frame.name}: {category}", got, expected, "Leave out what the frame does not show.")
            for polygon, box in _with_boxes(_mask_polygons(mask), np.asarray(boxes, np.float64)):
                shape = {"segmentation": polygon.astype(float).tolist(), "area": float(mask.sum()), "layer": 1.0}
                rest = {"bbox": box.tolist(), "iscrowd": 0, "note": ""}
                objects.append({"category": category, "group": group} | shape | rest)
        info = {"name": frame.name + image_ending, "width": frame.width, "height": frame.height, "depth": 3, "note": ""}
        write_text(path_within(Path(folder), f"{frame.name}.json"), json.dumps({"info": info, "objects": objects}))


def _mask_polygons(mask: Bool[np.ndarray, "h w"]) -> list[np.ndarray]:
    """Outlines a mask by polygons without holes, whose polygon masks OR-ed are the mask exactly."""
    polygons = []
    image = np.ascontiguousarray(mask, np.uint8)
    _, labels = cv2.connectedComponents(image, connectivity=8)
    contours, tree = cv2.findContours(image, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    for contour, (_, _, hole, parent) in zip(contours, tree[0] if tree is not None else ()):
        if parent >= 0:
            continue
        outline = contour[:, 0]
        if hole < 0:
            polygons.append(outline)
            continue
        # Cut along the middle row of a hole: it opens into a notch of either part. The hole nearest to the piece's
        # middle, so that many holes are halved at each cut.
        cuts = []
        while hole >= 0:
            rows = contours[hole][:, 0, 1]
            cuts.append(int(rows.min() + rows.max() + 1) // 2)
            hole = tree[0][hole][0]
        cut = min(cuts, key=lambda row: abs(2 * row - outline[:, 1].min() - outline[:, 1].max()))
        x, y, width, height = cv2.boundingRect(outline)
        piece = labels[y : y + height, x : x + width] == labels[outline[0, 1], outline[0, 0]]
        upper, lower = piece[: cut - y], piece[cut - y :]
        polygons += [polygon + np.array([x, y]) for polygon in _mask_polygons(upper)]
        polygons += [polygon + np.array([x, cut]) for polygon in _mask_polygons(lower)]
    return polygons


def _with_boxes(polygons: list[np.ndarray], boxes: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Each polygon with the box that shares most with it; boxes left over go with the first polygon again."""
    pairs, unused = [], set(range(len(boxes)))
    for polygon in polygons:
        low, high = polygon.min(0), polygon.max(0) + 1
        shared = (np.minimum(boxes[:, 2:], high) - np.maximum(boxes[:, :2], low)).clip(0).prod(1)
        area = (boxes[:, 2:] - boxes[:, :2]).clip(0).prod(1)
        best = int(np.lexsort((area, -shared))[0])
        pairs.append((polygon, boxes[best]))
        unused.discard(best)
    return pairs + [(polygons[0], boxes[index]) for index in sorted(unused)]
