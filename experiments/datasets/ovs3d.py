"""3D-OVS: ROOT/<scene>/{images, sparse/0, segmentations/{classes.txt, <frame number>/<class>.png}}.

A folder of `segmentations` is called by its frame's place in the sorted list of images (Kunhao-Liu/3D-OVS,
dataLoader/llff.py). LangSplat and the paper ask every class of every labelled frame as a query of its own; so does this
loader.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from experiments.datasets.benchmark import Benchmark, hold_out, require_count, twin_of
from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.read.captures.capture import load_capture
from jsecon.read.captures.images import IMAGE_SUFFIXES, read_image, write_image
from jsecon.read.masks.labels import LabelledFrame

OVS3D_PAIRS = {"bed": 30, "bench": 35, "lawn": 30, "room": 30, "sofa": 30}
"""(frame, query) pairs: five labelled frames of six or seven classes"""
ON = 128
"""grey level from which a pixel of a mask belongs to the class: masks are 0 and 255"""


def load_ovs3d(root: str | Path, scene: str, *, downscale: float | int | None = None) -> Benchmark:
    """A scene of 3D-OVS with its labelled frames held out.

    Raises InputError where a labelled frame lacks a class's mask or has one of a class that classes.txt does not name,
    where a folder's number is no image's, and where the number of pairs is not the protocol's.
    """
    root, told = Path(root), twin_of(root, scene)
    folder = root / scene
    files = sorted(file for file in (folder / "images").glob("*") if file.suffix in IMAGE_SUFFIXES)
    if not files:
        raise InputError(folder / "images", "no image", remedy="Check the path.")
    frames, classes = load_segmentations(folder / "segmentations", [file.stem for file in files])
    pairs = sum(len(frame.objects) for frame in frames)
    expected = OVS3D_PAIRS.get(scene, pairs) if told is None else told["pairs"]
    require_count(folder / "segmentations", pairs, expected, "(frame, query) pairs")
    capture = load_capture(folder, downscale=downscale, holdout=0)
    return Benchmark(
        capture=hold_out(capture, frames, folder / "segmentations"),
        frames=tuple(frames),
        name=scene,
        dataset="ovs3d",
        queries=classes,
        pairs=pairs,
        twin=told is not None,
    )


def load_segmentations(folder: Path, names: Sequence[str]) -> tuple[list[LabelledFrame], tuple[str, ...]]:
    """Labelled frames in the order of their numbers, and the classes in alphabetical order (as 3D-OVS sorts them).

    names: of all images, sorted. Every frame has every class; one without a pixel keeps its place, with an empty mask
    and no box. Masks have the size of their files.
    """
    file = folder / "classes.txt"
    try:
        classes = tuple(sorted(line.strip() for line in file.read_text(encoding="utf-8").splitlines() if line.strip()))
    except OSError as error:
        raise InputError(file, error.strerror or "an error", "one class per line", "Check the path.") from error
    if not classes or len(set(classes)) < len(classes):
        problem = "must have one class per line, each once"
        raise InputError(file, problem, remedy="Use the dataset's own file.")
    frames = []
    for place in sorted((entry for entry in folder.iterdir() if entry.is_dir()), key=lambda entry: entry.name):
        if not place.name.isdigit() or int(place.name) >= len(names):
            problem = f"a folder called {place.name}, which is the number of none of the {len(names)} images"
            raise InputError(place, problem, remedy="Folders count the sorted list of images from 0.")
        found = {mask.stem for mask in place.glob("*.png")}
        missing, unknown = sorted(set(classes) - found), sorted(found - set(classes))
        if missing or unknown:
            without, beyond = (", ".join(names) or "none" for names in (missing, unknown))
            problem = f"classes without a mask: {without}; masks of no class: {beyond}"
            remedy = "Name each mask like its class; a class that a frame does not show has an all-black one."
            raise InputError(place, problem, remedy=remedy)
        objects = {name: read_image(place / f"{name}.png")[..., 0] >= ON for name in classes}
        shapes = {mask.shape for mask in objects.values()}
        if len(shapes) > 1:
            raise InputError(place, f"masks of {len(shapes)} sizes", "one size", "Export the masks again.")
        height, width = shapes.pop()
        boxed = {name: (mask, box_of(mask)) for name, mask in objects.items()}
        frames.append(LabelledFrame(names[int(place.name)], width, height, boxed))
    return frames, classes


def box_of(mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "b 4"]:
    """(1, 4) x1 y1 x2 y2 around the mask, ends included; (0, 4) around nothing. 3D-OVS has no boxes of its own."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return np.zeros((0, 4), np.float32)
    return np.array([[columns[0], rows[0], columns[-1], rows[-1]]], np.float32)


def write_segmentations(
    folder: Path, frames: Sequence[LabelledFrame], names: Sequence[str], classes: Sequence[str]
) -> None:
    """Writes what `load_segmentations` reads; a class that a frame does not hold gets an all-black mask."""
    write_text(folder / "classes.txt", "".join(f"{name}\n" for name in classes))
    for frame in frames:
        place = folder / f"{list(names).index(frame.name):02d}"
        empty = np.zeros((frame.height, frame.width), bool)
        for name in classes:
            mask = frame.objects.get(name, (empty, None))[0]
            write_image(place / f"{name}.png", np.repeat(np.uint8(255) * mask[..., None], 3, axis=2))
