"""3D-OVS: ROOT/<scene>/{images, sparse/0, poses_bounds.npy, segmentations/{classes.txt, <frame number>/<class>.png}}.

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
from jsecon.data.colmap import find_models
from jsecon.data.frames import PosedImage, PosedImages, build_capture
from jsecon.data.images import IMAGE_SUFFIXES, image_header, read_image, write_image
from jsecon.data.labels import LabelledFrame
from jsecon.data.lens import Lens
from jsecon.errors import InputError
from jsecon.files import atomic_write, write_text
from jsecon.types import Capture

OVS3D_PAIRS = {"bed": 30, "bench": 35, "lawn": 30, "room": 30, "sofa": 30}
"""(frame, query) pairs: five labelled frames of six or seven classes"""
ON = 128
"""grey level from which a pixel of a mask belongs to the class: masks are 0 and 255"""


def load_ovs3d(root: str | Path, scene: str, *, downscale: float | int | None = None) -> Benchmark:
    """A scene of 3D-OVS with its labelled frames held out; poses from sparse/0, or else from poses_bounds.npy.

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
    if find_models(folder):
        capture = load_capture(folder, downscale=downscale, holdout=0)
    else:
        capture = _from_poses(folder, files, downscale)
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


def read_poses_bounds(
    path: Path,
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """LLFF's poses_bounds.npy: world-to-camera (N, 4, 4) in OpenCV axes, (height, width, focal) and depth bounds.

    A row holds a 3x5 matrix (axes down, right, backwards, then centre, then height width focal) and near, far. Raises
    InputError where the file is no such array.
    """
    try:
        table = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(path, str(error), "an (N, 17) array", "Copy the file again.") from error
    if table.ndim != 2 or table.shape[1] != 17:
        raise InputError(path, f"shape {table.shape}", "(N, 17)", "Use LLFF's poses_bounds.npy.")
    matrices = table[:, :15].astype(np.float64).reshape(-1, 3, 5)
    down, right, back, centre, sizes = (matrices[..., k] for k in range(5))
    rotation = np.stack([right, down, -back], axis=1)  # rows: the camera's axes in the world
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, -np.einsum("nij,nj->ni", rotation, centre)
    return poses, sizes, table[:, 15:]


def write_poses_bounds(
    path: Path, poses: Float[np.ndarray, "n 4 4"], sizes: Float[np.ndarray, "n 3"], bounds: Float[np.ndarray, "n 2"]
) -> None:
    """Writes what `read_poses_bounds` reads."""
    rotation = poses[:, :3, :3]
    centre = -np.einsum("nji,nj->ni", rotation, poses[:, :3, 3])
    columns = [rotation[:, 1], rotation[:, 0], -rotation[:, 2], centre, sizes]
    table = np.concatenate([np.stack(columns, axis=2).reshape(-1, 15), bounds], axis=1)
    with atomic_write(path) as temporary:
        np.save(temporary.with_suffix(".npy"), table)


def _from_poses(folder: Path, files: list[Path], downscale: float | int | None) -> Capture:
    poses, sizes, _ = read_poses_bounds(folder / "poses_bounds.npy")
    require_count(folder / "poses_bounds.npy", len(poses), len(files), "poses")
    shots = []
    for file, pose, (height, width, focal) in zip(files, poses, sizes):
        lens = Lens(int(width), int(height), focal, focal, width / 2, height / 2)
        shots.append(PosedImage(file.name, file, lens.resized(*image_header(file).upright), pose))
    note = "Poses are those of poses_bounds.npy: one focal length, the principal point in the middle, no points."
    return build_capture(PosedImages(shots, folder, notes=(note,)), downscale=downscale, holdout=0)
