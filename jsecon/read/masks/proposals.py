"""Masks of single frames from disk (proposals), on the host: they are not matched over the frames yet.

Per frame, under its name: `<name>.json`, the masks of SAM's own generator (they may overlap); `<name>_s.npy`, a level
of LangSplat's; `<name>.png` or `<name>.npy`, one id per pixel; `<name>.npy` also a stack of masks (M, H, W). Or one
COCO file for all frames.

A mask in JSON is run-length encoded or polygons. Run lengths are {"size": [H, W], "counts": ...}: runs of 0 and 1 in
turn, 0 first, down the columns. `counts` is a list of them, or COCO's text of 6-bit digits, decoded here: that also
checks that the runs fill the mask, and needs no compiled dependency. Polygons are [[x, y, x, y, ...], ...] in px of the
image; a polygon within another is a hole in it.
"""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool

from jsecon.errors import InputError
from jsecon.files import READ_ERRORS, map_npy, read_json, reading
from jsecon.read.captures.images import MAX_PIXELS, read_label_image
from jsecon.read.masks.masks import AllFrames, FrameNames, MaskFiles, MaskFitter, find_masks, read_level
from jsecon.types import ImageFile

SUFFIXES = (".json", "_s.npy", ".png", ".npy")
"""suffixes of files of masks, the preferred first"""
_REMEDY = "Write them with SAM's scripts/amg.py --convert-to-rle, or as COCO polygons."
_RLE = '{"size": [H, W], "counts": a text or a list}'
_JSON = 'a list of {"segmentation": ...}, or COCO\'s {"images", "annotations"}'


class Proposals(NamedTuple):
    """Masks of single frames, read on demand."""

    read: Callable[[int], Bool[np.ndarray, "m h w"]]
    """Index of a frame -> its masks (M, H, W). Raises InputError if a file is damaged."""
    notes: tuple[str, ...]
    """What was skipped or changed, a sentence each."""


def decode_rle(rle: Any, where: str | Path) -> Bool[np.ndarray, "h w"]:
    """Decodes a run-length encoded mask.

    Args:
      rle: {"size": [H, W], "counts": text or list}.
      where: Name of the mask for errors.

    Returns:
      (H, W) mask.

    Raises:
      InputError: It is something else, or its runs do not fill the mask.
    """
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
    """Draws COCO's polygons [[x, y, x, y, ...], ...], px, as a mask; a polygon within another is a hole in it."""
    expected = "[[x, y, x, y, ...], ...] with three corners or more each"
    nested = isinstance(polygons, list) and all(isinstance(polygon, list) for polygon in polygons)
    try:
        corners = [np.asarray(each, np.float64).reshape(-1, 2) for each in (polygons if nested else [polygons])]
    except (ValueError, TypeError) as error:
        problem = "the mask's polygons are no lists of x and y in turn"
        raise InputError(where, problem, expected, _REMEDY) from error
    if not corners or not all(len(each) > 2 and np.isfinite(each).all() for each in corners):
        raise InputError(where, "the mask has a polygon without three corners", expected, _REMEDY)
    far = np.concatenate(corners)
    if (far < -1).any() or (far > np.array([width, height]) + 1).any():  # corners may lie on the far edges
        problem = f"the mask's polygons reach from {far.min(0).tolist()} to {far.max(0).tolist()} px"
        remedy = 'Give the size of the image that they were drawn on ("images" with "width" and "height").'
        raise InputError(where, problem, f"corners within {width}x{height}", remedy)
    distinct = {each.tobytes(): each for each in (np.round(each).astype(np.int32) for each in corners)}.values()
    filled = [(_fill([each], width, height), each) for each in distinct]
    groups: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for mask, each in sorted(filled, key=lambda pair: -int(pair[0].sum())):
        outer = next((group for group in groups if not (mask & ~group[0]).any()), None)
        if outer is None:
            groups.append((mask, [each]))
        else:
            outer[1].append(each)
    return np.any([_fill(group, width, height) for _, group in groups], axis=0)


def _fill(polygons: list[np.ndarray], width: int, height: int) -> np.ndarray:
    """(H, W) bool: inside an odd number of polygons, edges included."""
    canvas = np.zeros((height, width), np.uint8)
    cv2.fillPoly(canvas, polygons, 1)
    return canvas.astype(bool)


def load_proposals(
    folder: str | Path,
    names: Sequence[str],
    size: tuple[int, int],
    *,
    level: str = "l",
    frames: AllFrames | None = None,
) -> Proposals:
    """Finds the masks of single frames.

    Files are named, and their subfolders read, as in `jsecon.read.masks.masks`. Masks are in the order of their scores
    (SAM's stability times predicted IoU), else as in the file; other sizes of the same aspect are resized (nearest). A
    frame without a file has no masks.

    Args:
      folder: The files of masks, or a COCO file.
      names: The frames.
      size: (H, W) of the masks.
      level: LangSplat's level.
      frames: All frames of the capture in order, each with its image; without it, numbered files are not accepted.

    Returns:
      A reader of a frame's masks, and notes.

    Raises:
      InputError: No frame has a file.
    """
    folder, every = Path(folder), frames or dict.fromkeys(names)
    frame_names = FrameNames(every)
    dataset = _find_dataset(folder, frame_names)
    if dataset is not None:
        available, notes = _read_dataset(*dataset, frame_names, names, size, every), []
    else:
        kinds = find_masks(folder, every, SUFFIXES, numbered=frames is not None)
        kinds = sorted(kinds, key=lambda kind: SUFFIXES.index(kind.suffix))
        by_name = {name: kind for kind in reversed(kinds) for name in names if kind.path(name) is not None}
        sizes = {name: _frame_size(every.get(name), size) for name in by_name}
        available = {
            name: lambda name=name, kind=kind: _read_files(kind, name, level, sizes[name])
            for name, kind in by_name.items()
        }
        notes = [note for kind in kinds for note in kind.notes]
        if not available:
            problem = "it holds no masks called like a frame in use"
            raise InputError(folder, problem, f"one for {names[0]} and others", "Name each file like its frame.")
    if missing := [name for name in names if name not in available]:
        notes = [f"{len(missing)} of {len(names)} frames have no masks (the first: {missing[0]}).", *notes]

    def shape(name: str) -> tuple[int, ...] | None:
        masks = available[name]() if name in available else []
        return masks[0][1].shape if masks else None

    fit = MaskFitter(every, size, shape)

    def read(index: int) -> Bool[np.ndarray, "m h w"]:
        name = names[index]
        pairs = available[name]() if name in available else []
        masks = [fit(path, mask, name) for path, mask in pairs]
        return np.stack([np.zeros(size, bool), *(mask for mask in masks if mask.any())])[1:]

    return Proposals(read, tuple(notes))


def _frame_size(file: ImageFile | None, size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) that polygons of a frame are drawn on."""
    return (size[1], size[0]) if file is None else (file.width, file.height)


def _read_files(kind: MaskFiles, name: str, level: str, frame: tuple[int, int]) -> list[tuple[Path, np.ndarray]]:
    """The masks of a frame, as they are stored, each with its file."""
    return [(path, mask) for path in kind.files[name].values() for mask in _read_file(path, level, frame)]


def _read_file(path: Path, level: str, frame: tuple[int, int]) -> list[np.ndarray]:
    """The masks (H, W) of a file; `frame` is the (width, height) of polygons."""
    name = path.name.lower()
    if name.endswith(".json"):
        return _read_json(path, frame)
    if name.endswith("_s.npy"):
        image = read_level(path, level)
        return [image == number for number in np.unique(image) if number >= 0]
    if name.endswith(".npy") and (stack := _read_stack(path)) is not None:
        return stack
    image = read_label_image(path)[0]
    return [image == number for number in np.unique(image) if number > 0]


def _read_stack(path: Path) -> list[np.ndarray] | None:
    """The masks of a .npy of shape (M, H, W); None for other shapes."""
    try:
        masks = map_npy(path)
    except READ_ERRORS:
        return None  # `read_label_image` raises the error
    if masks.ndim != 3 or 1 in (masks.shape[0], masks.shape[2]):
        return None
    if not np.isin(masks, (0, 1)).all():
        problem = f"the stack of shape {masks.shape} holds more than 0 and 1"
        raise InputError(path, problem, "masks (M, H, W)", "Write each mask as booleans.")
    return list(np.asarray(masks, bool))


def _records(content: Any) -> list[Any]:
    """The records of a file's masks: a list, or "annotations". Raises ValueError with the problem."""
    if isinstance(content, dict) and "annotations" not in content:
        raise ValueError("'annotations' is missing")
    records = content["annotations"] if isinstance(content, dict) else content
    if not isinstance(records, list):
        raise ValueError("it is not a list")
    for number, record in enumerate(records):
        if not isinstance(record, dict) or "segmentation" not in record:
            raise ValueError(f"'segmentation' is missing in record {number}")
    return records


def _read_json(file: Path, frame: tuple[int, int]) -> list[np.ndarray]:
    """The masks of a file of SAM's generator, or of one image as in SA-1B."""
    content = read_json(file, _JSON, _REMEDY)
    with reading(file, _JSON, _REMEDY, problem="it holds no masks"):
        records = _records(content)
        images = [content.get("image"), *content.get("images", [])[:1]] if isinstance(content, dict) else []
        size = next((size for size in map(_image_size, images) if size is not None), frame)
    return _decode_records(file, records, size)


def _decode_records(file: Path, records: list[Any], frame: tuple[int, int]) -> list[np.ndarray]:
    """The masks of records, the best first."""
    with reading(file, remedy=_REMEDY, problem="a mask's score is not a number"):
        scores = [float(r.get("predicted_iou", 1.0)) * float(r.get("stability_score", 1.0)) for r in records]
    masks = []
    for number in np.argsort(-np.asarray(scores), kind="stable"):
        segmentation, where = records[number]["segmentation"], f"{file}, mask {number}"
        if isinstance(segmentation, dict):
            masks.append(decode_rle(segmentation, where))
        elif isinstance(segmentation, list):
            masks += [_fill_polygons(segmentation, *frame, where)] if segmentation else []
        else:
            raise InputError(where, f"the mask is {str(segmentation)[:40]!r}", "run lengths or polygons", _REMEDY)
    return masks


def _image_size(image: Any) -> tuple[int, int] | None:
    """(width, height) of an image's record, or None."""
    try:
        width, height = int(image["width"]), int(image["height"])
    except (TypeError, KeyError, ValueError, OverflowError):
        return None
    return (width, height) if 0 < width * height <= MAX_PIXELS and width > 0 else None


def _find_dataset(folder: Path, frame_names: FrameNames) -> tuple[Path, Any] | None:
    """The COCO file of all frames, and its content: `folder` itself, or the only JSON in it if that lists images."""
    files = [folder] if folder.is_file() else sorted(folder.glob("*.json")) if folder.is_dir() else []
    if len(files) != 1 or (files[0] != folder and frame_names.match(files[0], (), ".json") is not None):
        return None
    content = read_json(files[0], _JSON, _REMEDY)
    return (files[0], content) if files[0] == folder or (isinstance(content, dict) and "images" in content) else None


def _read_dataset(
    file: Path,
    content: Any,
    frame_names: FrameNames,
    names: Sequence[str],
    size: tuple[int, int],
    frames: AllFrames,
) -> dict[str, Callable[[], list[tuple[Path, np.ndarray]]]]:
    """Readers of the masks of a COCO file, by frame."""
    with reading(file, _JSON, _REMEDY, problem="it is not a COCO file"):
        images = {image["id"]: image for image in content["images"]}
        by_image: dict[Any, list[Any]] = {number: [] for number in images}
        for record in _records(content):
            by_image[record["image_id"]].append(record)
        paths = {number: PurePosixPath(str(image["file_name"])) for number, image in images.items()}
    matches = {n: frame_names.match(Path(path.name), path.parts[:-1], "") for n, path in paths.items()}
    images_of = {match.frame: number for number, match in matches.items() if match is not None}
    if not images_of:
        first = next(iter(paths.values()), "no image")
        problem = f"none of its {len(paths)} images is called like a frame (the first: {first})"
        raise InputError(file, problem, f"{names[0]}.jpg and others", "Name the images like those of the capture.")

    def reader(name: str) -> Callable[[], list[tuple[Path, np.ndarray]]]:
        number = images_of[name]
        frame = _image_size(images[number]) or _frame_size(frames.get(name), size)
        return lambda: list(zip(itertools.repeat(file), _decode_records(file, by_image[number], frame)))

    return {name: reader(name) for name in names if name in images_of}
