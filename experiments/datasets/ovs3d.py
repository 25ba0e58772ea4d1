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

from experiments.datasets.benchmark import Benchmark, hold_out, no_points, require_count, twin_of
from jsecon.data.capture import load_capture
from jsecon.data.images import IMAGE_SUFFIXES, read_image, write_image
from jsecon.data.labels import LabelledFrame
from jsecon.errors import InputError
from jsecon.files import write_text

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
    files = image_files(folder / "images")
    frames, classes = load_segmentations(folder / "segmentations", [file.stem for file in files])
    pairs = sum(len(frame.objects) for frame in frames)
    expected = OVS3D_PAIRS.get(scene, pairs) if told is None else told["pairs"]
    require_count(folder / "segmentations", pairs, expected, "(frame, query) pairs")
    capture = load_capture(folder, downscale=downscale, holdout=0)
    return Benchmark(
        hold_out(capture, frames, folder / "segmentations"),
        tuple(frames),
        **no_points(),
        name=scene,
        dataset="ovs3d",
        queries=classes,
        pairs=pairs,
        twin=told is not None,
    )


def image_files(folder: Path) -> list[Path]:
    """The images of a scene in the order that the numbers of `segmentations` count. Raises InputError for none."""
    files = sorted(file for file in folder.glob("*") if file.suffix in IMAGE_SUFFIXES)
    if not files:
        raise InputError(folder, "no image", "the scene's frames", "Check the path.")
    return files


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
        raise InputError(
            file,
            f"{len(classes)} classes, {len(set(classes))} distinct",
            "one class per line, each once",
            "Use the dataset's own file.",
        )
    frames = []
    for place in sorted((entry for entry in folder.iterdir() if entry.is_dir()), key=lambda entry: entry.name):
        if not place.name.isdigit() or int(place.name) >= len(names):
            raise InputError(
                place,
                f"a folder called {place.name}",
                f"the number of one of the {len(names)} images, 00 to {len(names) - 1:02d}",
                "Folders count the sorted list of images from 0.",
            )
        found = {mask.stem for mask in place.glob("*.png")}
        missing, unknown = sorted(set(classes) - found), sorted(found - set(classes))
        if missing or unknown:
            raise InputError(
                place,
                "; ".join(
                    text
                    for text, which in (
                        (f"no mask of {', '.join(missing)}", missing),
                        (f"masks of {', '.join(unknown)}, which classes.txt does not name", unknown),
                    )
                    if which
                ),
                f"one .png for each of {', '.join(classes)}",
                "Name each mask like its class; a class that a frame does not show has an all-black one.",
            )
        objects = {name: _mask(place / f"{name}.png") for name in classes}
        shapes = {mask.shape for mask in objects.values()}
        if len(shapes) > 1:
            raise InputError(place, f"masks of {len(shapes)} sizes", "one size", "Export the masks again.")
        height, width = shapes.pop()
        boxed = {name: (mask, box_of(mask)) for name, mask in objects.items()}
        frames.append(LabelledFrame(names[int(place.name)], width, height, boxed))
    return frames, classes


def _mask(path: Path) -> Bool[np.ndarray, "h w"]:
    return read_image(path)[0][..., 0] >= ON


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
