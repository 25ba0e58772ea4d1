"""Masks in JSON, on the host: a file a frame of SAM's generator or of SA-1B, or COCO's one file for all frames.

A mask is run-length encoded or polygons. Run lengths are {"size": [H, W], "counts": ...}: runs of 0 and 1 in turn, 0
first, down the columns. `counts` is a list of them, or COCO's text of 6-bit digits, decoded here: that also checks that
the runs fill the mask, and needs no compiled dependency. Polygons are [[x, y, x, y, ...], ...] in px of the image, and
add up.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from jaxtyping import Bool

from jsecon.files import read_json, reading
from jsecon.read.captures.images import MAX_PIXELS, without_image_suffix
from jsecon.read.registry import Reader

ReadMasks: TypeAlias = Callable[[tuple[int, int]], tuple[Path, np.ndarray | list[np.ndarray]]]
"""(width, height) of the image of a frame -> a file, and its ids (H, W), or masks (H, W), the best first"""
_REMEDY = "Write them with SAM's scripts/amg.py --convert-to-rle, or as COCO polygons."
_MASK = '{"size": [H, W], "counts": a text or a list}, or polygons of three corners or more'
_JSON = 'a list of {"segmentation": ...}, or COCO\'s {"images", "annotations"}'


def _decode_rle(rle: Any) -> Bool[np.ndarray, "h w"]:
    """Decodes a run-length encoded mask."""
    (height, width), counts = rle["size"], rle["counts"]
    runs = np.asarray(_parse_runs(counts) if isinstance(counts, str) else counts, np.int64)
    valid = runs.ndim == 1 and ((runs >= 0) & (runs <= MAX_PIXELS)).all()
    if not valid or height * width > MAX_PIXELS or runs.sum() != height * width:
        raise ValueError(f"its runs fill {int(runs.sum())} of {height}x{width} pixels")
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


def _fill_polygons(polygons: list[Any], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Draws COCO's polygons [[x, y, x, y, ...], ...], px, as one mask of `size` (width, height), edges included."""
    nested = all(isinstance(polygon, list) for polygon in polygons)
    corners = [np.asarray(each, np.float64).reshape(-1, 2) for each in (polygons if nested else [polygons])]
    if not all(len(each) > 2 and np.isfinite(each).all() for each in corners):
        raise ValueError("one of its polygons has no three corners")
    if min(size) < 1 or size[0] * size[1] > MAX_PIXELS:
        raise ValueError(f"its image is {size[0]}x{size[1]}")
    far = np.concatenate(corners)
    if (far < -1).any() or (far > np.array(size) + 1).any():  # corners may lie on the far edges
        raise ValueError(f"its polygons reach from {far.min(0).tolist()} to {far.max(0).tolist()}, beyond {size} px")
    canvas = np.zeros(size[::-1], np.uint8)
    for each in corners:
        cv2.fillPoly(canvas, [np.round(each).astype(np.int32)], 1)
    return canvas.astype(bool)


def _read_json_masks(file: Path, size: tuple[int, int], level: str) -> list[Bool[np.ndarray, "h w"]]:
    """The masks of one frame, the best first. Polygons are drawn on `size` (width, height), or on the file's."""
    content = read_json(file, _JSON, _REMEDY)
    with reading(file, _JSON, _REMEDY, problem="it holds no masks"):
        content = content if isinstance(content, dict) else {"annotations": content}
        image = [content.get("image"), *content.get("images", ())][-1]
        return _decode_records(file, list(content["annotations"]), image, size)[1]


def _decode_records(file: Path, records: list[Any], image: Any, size: tuple[int, int]) -> tuple[Path, list[np.ndarray]]:
    """The file, and the masks of its records, those with the best scores (SAM's stability times predicted IoU) first.

    `image` is the record of the image in the file, whose size goes before `size`.
    """
    size = (image["width"], image["height"]) if isinstance(image, dict) and "width" in image else size
    with reading(file, _JSON, _REMEDY, problem="a mask's score cannot be read"):
        scores = [float(r.get("predicted_iou", 1.0)) * float(r.get("stability_score", 1.0)) for r in records]
    masks = []
    for number in np.argsort(-np.asarray(scores), kind="stable"):
        with reading(f"{file}, mask {number}", _MASK, _REMEDY, problem="the mask cannot be read"):
            segmentation = records[number]["segmentation"]
            if isinstance(segmentation, dict):
                masks.append(_decode_rle(segmentation))
            elif segmentation != []:
                masks.append(_fill_polygons(list(segmentation), size))
    return file, masks


def open_coco(folder: Path, names: Mapping[str, Sequence[str]]) -> dict[str, ReadMasks] | None:
    """Opens the COCO file of all frames: `folder` itself, or the only JSON in it, if that is no frame's and has images.

    `names` has what the image of each frame may be called, without its suffix and in small letters.
    """
    files = [folder] if folder.is_file() else list(folder.glob("*.json"))
    known = {name for own in names.values() for name in own}
    if len(files) != 1 or files[0].suffix.lower() != ".json" or files[0].stem.lower() in known:
        return None
    file, content = files[0], read_json(files[0], _JSON, _REMEDY)
    if file != folder and "images" not in content:
        return None
    found: dict[str, ReadMasks] = {}
    with reading(file, _JSON, _REMEDY, problem="it is not a COCO file"):
        records: dict[Any, list[Any]] = {image["id"]: [] for image in content["images"]}
        for record in content["annotations"]:
            records[record["image_id"]].append(record)
        images = {str(image["file_name"]).lower(): image for image in content["images"]}
        images |= {without_image_suffix(name): image for name, image in images.items()}
        for frame, own in names.items():
            for image in [images[name] for name in own if name in images][:1]:
                found[frame] = functools.partial(_decode_records, file, records[image["id"]], image)
        if not found:
            raise ValueError(f"none of its {len(records)} images is called like a frame, as {next(iter(names))} is")
    return found


READER = Reader("SAM", (".json",), _read_json_masks)
