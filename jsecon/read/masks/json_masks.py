"""Masks in JSON, on the host: a file a frame of SAM's generator or of SA-1B, or COCO's one file for all frames.

A mask is run-length encoded or polygons. Run lengths are {"size": [H, W], "counts": ...}: runs of 0 and 1 in turn, 0
first, down the columns. `counts` is a list of them, or COCO's text of 6-bit digits, decoded here: that also checks that
the runs fill the mask, and needs no compiled dependency. Polygons are [[x, y, x, y, ...], ...] in px of the image, and
add up.
"""

import functools
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool

from jsecon.errors import InputError
from jsecon.files import read_json, reading
from jsecon.read.captures.images import MAX_PIXELS
from jsecon.read.registry import Reader

ReadMasks: TypeAlias = Callable[[tuple[int, int]], tuple[Path, np.ndarray | list[np.ndarray]]]
"""(width, height) of the image of a frame -> a file, and its ids (H, W), or masks (H, W), the best first"""
_REMEDY = "Write them with SAM's scripts/amg.py --convert-to-rle, or as COCO polygons."
_MASK = '{"size": [H, W], "counts": a text or a list}, or polygons of three corners or more'
_JSON = 'a list of {"segmentation": ...}, or COCO\'s {"images", "annotations"}'


def _decode_rle(rle: Any, where: str) -> Bool[np.ndarray, "h w"]:
    """Decodes a run-length encoded mask; `where` names it for errors."""
    height, width = rle["size"]
    if not isinstance(height, int) or not isinstance(width, int):
        raise ValueError("its size is not a pair of whole numbers")
    counts = rle["counts"]
    runs = np.asarray(_parse_runs(counts) if isinstance(counts, str) else counts, np.int64)
    valid = runs.ndim == 1 and ((runs >= 0) & (runs <= MAX_PIXELS)).all() and min(height, width) > 0
    if not valid or height * width > MAX_PIXELS or runs.sum() != height * width:
        raise InputError(where, f"the mask's runs fill {int(runs.sum())} of {height}x{width} pixels", _MASK, _REMEDY)
    values = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(values, runs).reshape(width, height).T)


def _parse_runs(text: str) -> list[int]:
    """The runs in COCO's text of 6-bit digits.

    A digit has five bits of a number, the lowest first, and a sixth bit that says whether more follow; the highest bit
    of the last digit is the sign. From the fourth run on, a number is the difference from the run two before.
    """
    runs: list[int] = []
    value = shift = 0
    for character in text:
        digit = ord(character) - 48
        if not 0 <= digit < 64:
            raise ValueError(f"{character!r} is not a digit of its runs")
        value |= (digit & 31) << shift
        shift += 5
        if not digit & 32:
            if digit & 16:
                value -= 1 << shift
            runs.append(value + (runs[-2] if len(runs) > 2 else 0))
            value = shift = 0
    if shift:
        raise ValueError("the last run breaks off")
    return runs


def _fill_polygons(polygons: list[Any], size: tuple[int, int], where: str) -> Bool[np.ndarray, "h w"]:
    """Draws COCO's polygons [[x, y, x, y, ...], ...], px, as one mask of `size` (width, height), edges included."""
    nested = all(isinstance(polygon, list) for polygon in polygons)
    corners = [np.asarray(each, np.float64).reshape(-1, 2) for each in (polygons if nested else [polygons])]
    if not all(len(each) > 2 and np.isfinite(each).all() for each in corners):
        raise ValueError("one of its polygons has no three corners")
    far = np.concatenate(corners)
    if (far < -1).any() or (far > np.array(size) + 1).any():  # corners may lie on the far edges
        problem = f"the mask's polygons reach from {far.min(0).tolist()} to {far.max(0).tolist()} px"
        remedy = 'Give the size of the image that they were drawn on ("images" with "width" and "height").'
        raise InputError(where, problem, f"corners within {size[0]}x{size[1]}", remedy)
    canvas = np.zeros(size[::-1], np.uint8)
    for each in corners:
        cv2.fillPoly(canvas, [np.round(each).astype(np.int32)], 1)
    return canvas.astype(bool)


def _read_json_masks(file: Path, size: tuple[int, int], level: str) -> list[Bool[np.ndarray, "h w"]]:
    """The masks of one frame, the best first. Polygons are drawn on `size` (width, height), or on the file's."""
    content = read_json(file, _JSON, _REMEDY)
    with reading(file, _JSON, _REMEDY, problem="it holds no masks"):
        records = list(content["annotations"] if isinstance(content, dict) else content)
        images = [content.get("image"), *content.get("images", [])[:1]] if isinstance(content, dict) else []
        own = next(filter(None, map(_image_size, images)), None)
    return _decode_records(file, records, own, size)[1]


def _decode_records(
    file: Path, records: list[Any], own: tuple[int, int] | None, size: tuple[int, int]
) -> tuple[Path, list[np.ndarray]]:
    """The file, and the masks of its records, those with the best scores (SAM's stability times predicted IoU) first.

    `own` is the (width, height) that the file gives for the image, which goes before `size`.
    """
    with reading(file, _JSON, _REMEDY, problem="a mask's score cannot be read"):
        scores = [float(r.get("predicted_iou", 1.0)) * float(r.get("stability_score", 1.0)) for r in records]
    masks = []
    for number in np.argsort(-np.asarray(scores), kind="stable"):
        where = f"{file}, mask {number}"
        with reading(where, _MASK, _REMEDY, problem="the mask cannot be read"):
            segmentation = records[number]["segmentation"]
            if isinstance(segmentation, dict):
                masks.append(_decode_rle(segmentation, where))
            elif segmentation != []:
                masks.append(_fill_polygons(list(segmentation), own or size, where))
    return file, masks


def _image_size(image: Any) -> tuple[int, int] | None:
    """(width, height) of an image's record, or None."""
    sides = [image.get(key) if isinstance(image, dict) else None for key in ("width", "height")]
    width, height = (int(side) if isinstance(side, int | float) and 0 < side <= MAX_PIXELS else 0 for side in sides)
    return (width, height) if 0 < width * height <= MAX_PIXELS else None


def open_coco(folder: Path, match: Callable[[PurePosixPath, str], Any]) -> dict[str, ReadMasks] | None:
    """Opens the COCO file of all frames: `folder` itself, or the only JSON in it if that lists images.

    `match` finds the `frame` of the path and the suffix of an image, or None.
    """
    files = [folder] if folder.is_file() else list(folder.glob("*.json"))
    if len(files) != 1 or files[0].suffix.lower() != ".json":
        return None
    file = files[0]
    if file != folder and match(PurePosixPath(file.name), ".json") is not None:
        return None
    content = read_json(file, _JSON, _REMEDY)
    if file != folder and not (isinstance(content, dict) and "images" in content):
        return None
    readers: dict[str, ReadMasks] = {}
    with reading(file, _JSON, _REMEDY, problem="it is not a COCO file"):
        records: dict[Any, list[Any]] = {image["id"]: [] for image in content["images"]}
        for record in content["annotations"]:
            records[record["image_id"]].append(record)
        for image in content["images"]:
            found, own = match(PurePosixPath(str(image["file_name"])), ""), _image_size(image)
            if found is not None:
                readers[found.frame] = functools.partial(_decode_records, file, records[image["id"]], own)
    if not readers:
        first = content["images"][0]["file_name"] if content["images"] else "no image"
        problem = f"none of its {len(records)} images is called like a frame (the first: {first})"
        raise InputError(file, problem, remedy="Name the images like those of the capture.")
    return readers


READER = Reader("SAM", (".json",), _read_json_masks)
