"""Masks in JSON, on the host: a file a frame of SAM's generator or of SA-1B, or COCO's one file for all frames.

A mask is run-length encoded or polygons. Run lengths are {"size": [H, W], "counts": ...}: runs of 0 and 1 in turn, 0
first, down the columns. `counts` is a list of them, or COCO's text of 6-bit digits, decoded here: that also checks that
the runs fill the mask, and needs no compiled dependency. Polygons are [[x, y, x, y, ...], ...] in px of the image, and
add up.
"""

from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool

from jsecon.errors import InputError
from jsecon.files import read_json, reading
from jsecon.read.captures.images import MAX_PIXELS
from jsecon.read.masks.names import FrameNames

_REMEDY = "Write them with SAM's scripts/amg.py --convert-to-rle, or as COCO polygons."
_RLE = '{"size": [H, W], "counts": a text or a list}'
_JSON = 'a list of {"segmentation": ...}, or COCO\'s {"images", "annotations"}'


def _decode_rle(rle: Any, where: str | Path) -> Bool[np.ndarray, "h w"]:
    """Decodes a run-length encoded mask; `where` names it for errors."""
    with reading(where, _RLE, _REMEDY, problem="the mask cannot be read"):
        height, width = rle["size"]
        if not isinstance(height, int) or not isinstance(width, int):
            raise ValueError("its size is not a pair of whole numbers")
        counts = rle["counts"]
        runs = np.asarray(_parse_runs(counts) if isinstance(counts, str) else counts, np.int64)
    valid = runs.ndim == 1 and ((runs >= 0) & (runs <= MAX_PIXELS)).all() and min(height, width) > 0
    if not valid or height * width > MAX_PIXELS or runs.sum() != height * width:
        raise InputError(where, f"the mask's runs fill {int(runs.sum())} of {height}x{width} pixels", _RLE, _REMEDY)
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


def _fill_polygons(polygons: Any, width: int, height: int, where: str | Path) -> Bool[np.ndarray, "h w"]:
    """Draws COCO's polygons [[x, y, x, y, ...], ...], px, as one mask, edges included."""
    expected = "[[x, y, x, y, ...], ...] with three corners or more each"
    nested = isinstance(polygons, list) and all(isinstance(polygon, list) for polygon in polygons)
    with reading(where, expected, _REMEDY, problem="the mask's polygons cannot be read"):
        corners = [np.asarray(each, np.float64).reshape(-1, 2) for each in (polygons if nested else [polygons])]
        if not corners or not all(len(each) > 2 and np.isfinite(each).all() for each in corners):
            raise ValueError("one has no three corners")
    far = np.concatenate(corners)
    if (far < -1).any() or (far > np.array([width, height]) + 1).any():  # corners may lie on the far edges
        problem = f"the mask's polygons reach from {far.min(0).tolist()} to {far.max(0).tolist()} px"
        remedy = 'Give the size of the image that they were drawn on ("images" with "width" and "height").'
        raise InputError(where, problem, f"corners within {width}x{height}", remedy)
    canvas = np.zeros((height, width), np.uint8)
    for each in corners:
        cv2.fillPoly(canvas, [np.round(each).astype(np.int32)], 1)
    return canvas.astype(bool)


def read_json_masks(file: Path, size: tuple[int, int]) -> list[Bool[np.ndarray, "h w"]]:
    """Reads the masks of one frame, the best first. Polygons are drawn on `size` (width, height), or on the file's."""
    content = read_json(file, _JSON, _REMEDY)
    with reading(file, _JSON, _REMEDY, problem="it holds no masks"):
        records = _records(content)
        images = [content.get("image"), *content.get("images", [])[:1]] if isinstance(content, dict) else []
        size = next((own for own in map(_image_size, images) if own is not None), size)
    return _decode_records(file, records, size)


def _records(content: Any) -> list[Any]:
    """The records of a file's masks: a list, or "annotations"."""
    return list(content["annotations"] if isinstance(content, dict) else content)


def _decode_records(file: Path, records: list[Any], size: tuple[int, int]) -> list[np.ndarray]:
    """The masks of records, those with the best scores (SAM's stability times predicted IoU) first."""
    with reading(file, _JSON, _REMEDY, problem="a mask's score cannot be read"):
        scores = [float(r.get("predicted_iou", 1.0)) * float(r.get("stability_score", 1.0)) for r in records]
    masks = []
    for number in np.argsort(-np.asarray(scores), kind="stable"):
        where = f"{file}, mask {number}"
        with reading(where, "run lengths or polygons", _REMEDY, problem="the mask cannot be read"):
            segmentation = records[number]["segmentation"]
            if isinstance(segmentation, dict):
                masks.append(_decode_rle(segmentation, where))
            elif segmentation != []:
                masks.append(_fill_polygons(segmentation, *size, where))
    return masks


def _image_size(image: Any) -> tuple[int, int] | None:
    """(width, height) of an image's record, or None."""
    try:
        width, height = int(image["width"]), int(image["height"])
    except (TypeError, KeyError, ValueError, OverflowError):
        return None
    return (width, height) if 0 < width * height <= MAX_PIXELS and width > 0 else None


class _CocoFile:
    """A COCO file of all frames."""

    def __init__(self, file: Path, content: Any, frame_names: FrameNames):
        self.file = file
        with reading(file, _JSON, _REMEDY, problem="it is not a COCO file"):
            images = {image["id"]: image for image in content["images"]}
            records: dict[Any, list[Any]] = {number: [] for number in images}
            for record in _records(content):
                records[record["image_id"]].append(record)
            paths = {number: PurePosixPath(str(image["file_name"])) for number, image in images.items()}
        matches = {n: frame_names.match(Path(path.name), path.parts[:-1], "") for n, path in paths.items()}
        self._images = {match.frame: (images[n], records[n]) for n, match in matches.items() if match is not None}
        if not self._images:
            first = next(iter(paths.values()), "no image")
            problem = f"none of its {len(paths)} images is called like a frame (the first: {first})"
            raise InputError(file, problem, remedy="Name the images like those of the capture.")

    def __contains__(self, name: str) -> bool:
        """Whether a frame is among its images."""
        return name in self._images

    def read(self, name: str, size: tuple[int, int]) -> list[Bool[np.ndarray, "h w"]]:
        """Reads the masks of a frame as `read_json_masks` does."""
        image, records = self._images[name]
        return _decode_records(self.file, records, _image_size(image) or size)


def open_coco(folder: Path, frame_names: FrameNames) -> _CocoFile | None:
    """Opens the COCO file of all frames: `folder` itself, or the only JSON in it if that lists images."""
    files = [folder] if folder.is_file() else sorted(folder.glob("*.json")) if folder.is_dir() else []
    if len(files) != 1 or (files[0] != folder and frame_names.match(files[0], (), ".json") is not None):
        return None
    if files[0].suffix.lower() != ".json":
        return None
    content = read_json(files[0], _JSON, _REMEDY)
    is_coco = files[0] == folder or (isinstance(content, dict) and "images" in content)
    return _CocoFile(files[0], content, frame_names) if is_coco else None
