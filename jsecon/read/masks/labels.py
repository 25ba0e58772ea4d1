"""LERF-style labels in LangSplat's annotation, on the host: frame_XXXXX.json with polygons and boxes by category.

Reading follows LangSplat's eval/utils.py: polygon corners cut to integers, filled with cv2.fillPoly (corners and edges
belong to the mask), the objects of a category OR-ed, their boxes side by side.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jsecon.errors import InputError
from jsecon.files import read_json
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
