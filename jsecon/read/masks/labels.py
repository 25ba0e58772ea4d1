"""LERF-style labels in LangSplat's annotation, on the host: frame_XXXXX.json with polygons and boxes by category.

Reading follows LangSplat's eval/utils.py: polygon corners cut to integers, filled with cv2.fillPoly (corners and edges
belong to the mask), the objects of a category OR-ed, their boxes side by side.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from jsecon.errors import InputError
from jsecon.files import read_json, reading
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


def _read(file: Path) -> LabelledFrame:
    """Reads one label file."""
    content = read_json(file, "a label file", _REMEDY)
    expected = "info (name, width, height) and objects (category, segmentation, bbox)"
    objects: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    with reading(file, expected, _REMEDY):
        info, entries = content["info"], list(content["objects"])
        name, width, height = Path(info["name"]).stem, int(info["width"]), int(info["height"])
        if min(width, height) < 1 or width * height > MAX_PIXELS:
            raise ValueError(f"the image is {width}x{height}")
    for index, entry in enumerate(entries):
        with reading(file, expected, _REMEDY, problem=f"object {index} cannot be read"):
            category, polygon = entry["category"], np.array(entry["segmentation"], np.float64).reshape(-1, 2)
            box = np.array(entry["bbox"], np.float64).reshape(1, 4)
            if not isinstance(category, str) or not len(polygon):
                raise ValueError(f"its category is {category!r}, with an outline of {len(polygon)} corners")
            if not (np.abs(polygon).max() < 1e6 and np.abs(box).max() < 1e6):
                raise ValueError("its segmentation or bbox is out of all range")
        mask = cv2.fillPoly(np.zeros((height, width), np.uint8), [polygon.astype(np.int32)], 1).astype(bool)
        box = box.astype(np.float32)
        if category in objects:
            before, boxes = objects[category]
            mask = mask | before
            box = boxes if (boxes == box).all(1).any() else np.concatenate([boxes, box])
        objects[category] = mask, box
    return LabelledFrame(name, width, height, objects)
