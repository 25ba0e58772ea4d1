"""Masks of single frames from disk, which still have to be brought together over the frames.

Of each frame, under its name: `<name>.json`, the masks of SAM's own generator (they may overlap); `<name>_s.npy`, a
level of LangSplat's; `<name>.png` or `<name>.npy`, one id per pixel; `<name>.npy` also a stack of masks (M, H, W). Or
one COCO file for all frames. What an id is called does not matter.

A mask in JSON is run-length encoded or polygons. Encoded it is {"size": [H, W], "counts": ...}. Runs alternate between
0 and 1, 0 first, down the columns. `counts` is a list of them, or a text of 6-bit digits: five bits a sign, the lowest
first, the sixth says that more follow, the last one's highest bit is the sign of the number. From the third run after
the first on, a number is the difference from the run two before. Decoded here: about fifty lines, which also check that
the runs fill the mask, spare a compiled dependency. Polygons are [[x, y, x, y, ...], ...] in px of the image; one that
lies within another is a hole in it.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool

from jsecon.data.images import MAX_PIXELS, read_label_image
from jsecon.data.mask_names import Masks, Names, find_masks
from jsecon.data.masks import Fit, black_and_white, read_level
from jsecon.errors import InputError, describe_error
from jsecon.files import READ_ERRORS, map_npy, read_json
from jsecon.types import ImageFile

ENDINGS = (".json", "_s.npy", ".png", ".npy")
"""of files of masks, those first that are taken first"""
_REMEDY = "Write them with SAM's scripts/amg.py --convert-to-rle, or as COCO polygons."
_RLE = ('{"size": [H, W], "counts": a text or a list}', _REMEDY)
_LIST = 'a list of {"segmentation": ...}, or COCO\'s {"images", "annotations"}'


def decode_rle(rle: Any, where: str | Path) -> Bool[np.ndarray, "h w"]:
    """The mask (H, W) of an encoded one. Raises InputError, at `where`, for anything else."""
    try:
        height, width = rle["size"]
        if not isinstance(height, int) or not isinstance(width, int):
            raise ValueError("its size is no pair of whole numbers")
        counts = rle["counts"]
        runs = np.asarray(_numbers(counts) if isinstance(counts, str) else counts, np.int64)
    except (TypeError, KeyError, ValueError, IndexError, OverflowError) as error:
        raise InputError(where, f"the mask cannot be read: {describe_error(error)}", *_RLE) from error
    fits = runs.ndim == 1 and ((runs >= 0) & (runs <= MAX_PIXELS)).all() and min(height, width) > 0
    if not fits or height * width > MAX_PIXELS or runs.sum() != height * width:
        raise InputError(where, f"the mask's runs fill {int(runs.sum())} of {height}x{width} pixels", *_RLE)
    values = np.arange(len(runs)) % 2 == 1
    return np.ascontiguousarray(np.repeat(values, runs).reshape(width, height).T)


def _numbers(text: str) -> list[int]:
    """The runs in a text of 6-bit digits."""
    runs: list[int] = []
    value = shift = 0
    for sign in text:
        digit = ord(sign) - 48
        if not 0 <= digit < 64:
            raise ValueError(f"{sign!r} is no digit of its runs")
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


def fill_polygons(polygons: Any, width: int, height: int, where: str | Path) -> Bool[np.ndarray, "h w"]:
    """The mask (H, W) of COCO's polygons [[x, y, x, y, ...], ...], px; one within another is a hole in it.

    Raises InputError, at `where`, where they are no polygons, or lie outside of the image.
    """
    wanted = "[[x, y, x, y, ...], ...] with three corners or more each"
    nested = isinstance(polygons, list) and all(isinstance(polygon, list) for polygon in polygons)
    try:
        corners = [np.asarray(each, np.float64).reshape(-1, 2) for each in (polygons if nested else [polygons])]
    except (ValueError, TypeError) as error:
        raise InputError(where, "the mask's polygons are no lists of x and y in turn", wanted, _REMEDY) from error
    # Corners may lie on the far edges, or a little beyond them.
    reach = np.array([width, height]) + 1
    if not corners or not all(len(each) > 2 and np.isfinite(each).all() for each in corners):
        raise InputError(where, "the mask has a polygon without three corners", wanted, _REMEDY)
    if not all(((each >= -1) & (each <= reach)).all() for each in corners):
        far = np.concatenate(corners)
        problem = f"the mask's polygons reach from {far.min(0).tolist()} to {far.max(0).tolist()} px"
        remedy = 'Give the size of the image that they were drawn on ("images" with "width" and "height").'
        raise InputError(where, problem, f"corners within {width}x{height}", remedy)
    whole = list({each.tobytes(): each for each in (np.round(each).astype(np.int32) for each in corners)}.values())
    filled = [(_filled([each], width, height), each) for each in whole]
    groups: list[tuple[np.ndarray, list[np.ndarray]]] = []
    for mask, each in sorted(filled, key=lambda pair: -int(pair[0].sum())):
        outer = next((group for group in groups if not (mask & ~group[0]).any()), None)
        if outer is None:
            groups.append((mask, [each]))
        else:
            outer[1].append(each)
    return np.any([_filled(group, width, height) for _, group in groups], axis=0)


def _filled(polygons: list[np.ndarray], width: int, height: int) -> np.ndarray:
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
    order: Sequence[str] | None = None,
    files: Mapping[str, ImageFile] | None = None,
) -> tuple[Callable[[int], Bool[np.ndarray, "m h w"]], tuple[str, ...]]:
    """Finds the masks of single frames in `folder`.

    Files are named, and their subfolders read, as by `jsecon.data.masks.load_labels`. Masks are best first where
    the file holds scores (SAM's stability times predicted IoU), else as they are in it; of another size they are
    resized (nearest) where the aspect agrees. A frame without a file has none.

    Args:
      folder: The files of masks.
      names: The frames.
      size: (H, W) of the masks.
      level: LangSplat's level.
      order: All frames of the capture.
      files: The image of each frame, by its name.

    Returns:
      A function of a frame's index that reads its masks (M, H, W) bool, and notes. It raises InputError where a file is
      damaged.

    Raises:
      InputError: No frame has a file.
    """
    folder, every = Path(folder), order if order is not None else names
    files = files or {}
    known = Names(every, files)
    if (dataset := _dataset(folder, known)) is not None:
        return _of_dataset(*dataset, known, names, size, files)
    kinds = find_masks(folder, every, ENDINGS, black_and_white, files=files, numbered=order is not None)
    kinds = sorted(kinds, key=lambda kind: ENDINGS.index(kind.ending))
    own = {name: next((kind for kind in kinds if kind.path(name) is not None), None) for name in names}
    missing = [name for name, kind in own.items() if kind is None]
    if len(missing) == len(names):
        problem = "it holds no masks called like a frame that is worked with"
        raise InputError(folder, problem, f"one for {names[0]} and others", "Name each file like its frame.")
    notes = [f"{len(missing)} of {len(names)} frames have no masks (the first: {missing[0]})."] if missing else []
    notes += [note for kind in kinds for note in kind.notes]

    def shape(name: str) -> tuple[int, ...] | None:
        kind = own.get(name)
        masks = [] if kind is None else _read_frame(kind, name, level, files.get(name), size)
        return masks[0][1].shape if masks else None

    fit = Fit(files, size, shape)

    def of_frame(index: int) -> Bool[np.ndarray, "m h w"]:
        name = names[index]
        kind = own[name]
        masks = [] if kind is None else _read_frame(kind, name, level, files.get(name), size)
        return _stacked([fit(path, mask, name) for path, mask in masks], size)

    return of_frame, tuple(notes)


def _stacked(masks: list[np.ndarray], size: tuple[int, int]) -> Bool[np.ndarray, "m h w"]:
    """The masks that have a pixel."""
    return np.stack([np.zeros(size, bool), *(mask for mask in masks if mask.any())])[1:]


def _read_frame(
    kind: Masks, name: str, level: str, file: ImageFile | None, size: tuple[int, int]
) -> list[tuple[Path, np.ndarray]]:
    """The masks of a frame, as they are stored, each with its file."""
    frame = size[::-1] if file is None else (file.width, file.height)
    paths = kind.objects[name].values() if name in kind.objects else [kind.files[name]]
    return [(path, mask) for path in paths for mask in _read(path, level, (frame[0], frame[1]))]


def _read(path: Path, level: str, frame: tuple[int, int]) -> list[np.ndarray]:
    """The masks (H, W) bool of a file; `frame` is the size (width, height) that polygons are of."""
    ending = path.name.lower()
    if ending.endswith(".json"):
        return _read_json(path, frame)
    if ending.endswith("_s.npy"):
        image, none = read_level(path, level), -1
    elif ending.endswith(".npy") and (stack := _stack(path)) is not None:
        return stack
    else:
        image, none = read_label_image(path)[0], 0
    return [image == id for id in np.unique(image) if id != none and id >= 0]


def _stack(path: Path) -> list[np.ndarray] | None:
    """The masks of a .npy of shape (M, H, W); None where it has another."""
    try:
        masks = map_npy(path)
    except READ_ERRORS:
        return None  # `read_label_image` tells
    if masks.ndim != 3 or 1 in (masks.shape[0], masks.shape[2]):
        return None
    if not np.isin(masks, (0, 1)).all():
        problem = f"the stack of shape {masks.shape} holds more than 0 and 1"
        raise InputError(path, problem, "masks (M, H, W)", "Write each mask as booleans.")
    return list(np.asarray(masks, bool))


def _records(content: Any) -> list[Any]:
    """The records of a file's masks: a list, or under "annotations". Raises a ValueError in words."""
    if isinstance(content, dict) and "annotations" not in content:
        raise ValueError("'annotations' is missing")
    records = content["annotations"] if isinstance(content, dict) else content
    if not isinstance(records, list):
        raise ValueError("it is no list")
    for number, record in enumerate(records):
        if not isinstance(record, dict) or "segmentation" not in record:
            raise ValueError(f"'segmentation' is missing in record {number}")
    return records


def _read_json(file: Path, frame: tuple[int, int]) -> list[np.ndarray]:
    """The masks of a file of SAM's generator: a list of records, or one under "annotations" as in SA-1B."""
    content = read_json(file, _LIST, _REMEDY)
    try:
        records = _records(content)
        told = [content.get("image"), *content.get("images", [])[:1]] if isinstance(content, dict) else []
        size = next((size for size in map(_size, told) if size is not None), frame)
    except (ValueError, TypeError) as error:
        raise InputError(file, f"it holds no masks: {describe_error(error)}", _LIST, _REMEDY) from error
    return _decoded(file, records, size)


def _decoded(file: Path, records: list[Any], frame: tuple[int, int]) -> list[np.ndarray]:
    """The masks of a file's records, the best first."""
    try:
        scores = [float(r.get("predicted_iou", 1.0)) * float(r.get("stability_score", 1.0)) for r in records]
    except (ValueError, TypeError) as error:
        raise InputError(file, "a mask's score is no number", "numbers", _REMEDY) from error
    masks = []
    for number in np.argsort(-np.asarray(scores), kind="stable"):
        coded, where = records[number]["segmentation"], f"{file}, mask {number}"
        if isinstance(coded, dict):
            masks.append(decode_rle(coded, where))
        elif isinstance(coded, list):
            masks += [fill_polygons(coded, *frame, where)] if coded else []
        else:
            raise InputError(where, f"the mask is {str(coded)[:40]!r}", "run lengths or polygons", _REMEDY)
    return masks


def _size(image: Any) -> tuple[int, int] | None:
    """(width, height) of an image's record, or None."""
    try:
        width, height = int(image["width"]), int(image["height"])
    except (TypeError, KeyError, ValueError, OverflowError):
        return None
    return (width, height) if 0 < width * height <= MAX_PIXELS and width > 0 else None


def _dataset(folder: Path, known: Names) -> tuple[Path, Any] | None:
    """The COCO file of all frames and its content: `folder` itself, or the one JSON in it, if it lists images."""
    files = [folder] if folder.is_file() else sorted(folder.glob("*.json")) if folder.is_dir() else []
    if len(files) != 1 or (files[0] != folder and known.match(files[0], (), ".json") is not None):
        return None
    content = read_json(files[0], _LIST, _REMEDY)
    return (files[0], content) if files[0] == folder or (isinstance(content, dict) and "images" in content) else None


def _of_dataset(
    file: Path, content: Any, known: Names, names: Sequence[str], size: tuple[int, int], files: Mapping[str, ImageFile]
) -> tuple[Callable[[int], Bool[np.ndarray, "m h w"]], tuple[str, ...]]:
    """`load_proposals` of one COCO file."""
    try:
        images = {image["id"]: image for image in content["images"]}
        by_image: dict[Any, list[Any]] = {number: [] for number in images}
        for record in _records(content):
            by_image[record["image_id"]].append(record)
        called = {number: PurePosixPath(str(image["file_name"])) for number, image in images.items()}
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(file, f"it is no COCO file: {describe_error(error)}", _LIST, _REMEDY) from error
    matches = {n: known.match(Path(path.name), path.parts[:-1], "") for n, path in called.items()}
    own = {match.frame: number for number, match in matches.items() if match is not None}
    if not own:
        first = next(iter(called.values()), "no image")
        problem = f"none of its {len(called)} images is called like a frame (the first: {first})"
        raise InputError(file, problem, f"{names[0]}.jpg and others", "Name the images like those of the capture.")
    missing = [name for name in names if name not in own]
    notes = [f"{len(missing)} of {len(names)} frames have no masks (the first: {missing[0]})."] if missing else []

    def read(name: str) -> list[np.ndarray]:
        image = files.get(name)
        frame = size[::-1] if image is None else (image.width, image.height)
        return _decoded(file, by_image[own[name]], _size(images[own[name]]) or (frame[0], frame[1]))

    def shape(name: str) -> tuple[int, ...] | None:
        return masks[0].shape if name in own and (masks := read(name)) else None

    fit = Fit(files, size, shape)

    def of_frame(index: int) -> Bool[np.ndarray, "m h w"]:
        name = names[index]
        return _stacked([fit(file, mask, name) for mask in read(name)] if name in own else [], size)

    return of_frame, tuple(notes)
