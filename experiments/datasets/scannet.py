"""ScanNet under OpenGaussian's protocol: ten scenes, truth at the vertices in NYU40 ids, sets of 19, 15 and 10 classes.

ROOT/<scene>/{color/<n>.jpg, pose/<n>.txt, intrinsic/intrinsic_color.txt, <scene>_vh_clean_2.ply,
<scene>_vh_clean_2.labels.ply}, as ScanNet's own exporter leaves it. Scenes and sets of classes are those of
yanmin-wu/OpenGaussian, scripts/eval_scannet.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.datasets.benchmark import Benchmark, require_count, twin_of
from jsecon.data.frames import Posed, Shot, assemble
from jsecon.data.images import image_size
from jsecon.data.lens import Lens
from jsecon.data.ply import load_points_ply
from jsecon.data.ply_file import read_vertices
from jsecon.errors import InputError

SCANNET_SCENES = tuple(f"scene{n:04d}_00" for n in (0, 62, 70, 97, 140, 200, 347, 400, 590, 645))
NYU40 = {
    1: "wall",
    2: "floor",
    3: "cabinet",
    4: "bed",
    5: "chair",
    6: "sofa",
    7: "table",
    8: "door",
    9: "window",
    10: "bookshelf",
    11: "picture",
    12: "counter",
    14: "desk",
    16: "curtain",
    24: "refrigerator",
    28: "shower curtain",
    33: "toilet",
    34: "sink",
    36: "bathtub",
}
"""the ids that the protocol asks, and the texts it asks them by"""
CLASS_SETS = {
    19: tuple(NYU40),
    15: (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34),
    10: (1, 2, 4, 5, 6, 7, 8, 9, 10, 33),
}
"""ids of each set"""


def load_scannet(
    root: str | Path,
    scene: str,
    *,
    classes: int = 19,
    every: int = 20,
    downscale: float | int | None = None,
) -> Benchmark:
    """A scene of ScanNet: every `every`-th frame that has a pose, all vertices in order, the class of each in the set.

    Frames whose pose is not finite (tracking lost) are left out and counted in Capture.notes. No frame is held out:
    truth is at the points. Raises InputError for a set that is not 19, 15 or 10, where the label file has another
    number of vertices than the mesh, and where files are missing or damaged.
    """
    if classes not in CLASS_SETS:
        raise InputError("classes", str(classes), "19, 15 or 10", "These are OpenGaussian's three sets.")
    root, told = Path(root), twin_of(root, scene)
    folder = root / scene
    points, colors = load_points_ply(folder / f"{scene}_vh_clean_2.ply")
    file = folder / f"{scene}_vh_clean_2.labels.ply"
    labelled = read_vertices(file)
    if "label" not in (labelled.dtype.names or ()):
        raise InputError(file, "vertices without label", "ScanNet's .labels.ply", "Use that.")
    require_count(file, len(labelled), len(points), "labels for the vertices of the mesh")
    ids = np.asarray(labelled["label"], np.int64)
    table = np.full(max(int(ids.max(initial=0)), max(NYU40)) + 1, -1, np.int32)
    table[list(CLASS_SETS[classes])] = np.arange(classes)
    point_classes = table[ids]
    occurring = len(np.unique(point_classes[point_classes >= 0]))
    if told is not None:
        require_count(file, occurring, told["pairs"][str(classes)], "classes that occur")
    images = sorted((folder / "color").glob("*.jpg"), key=lambda image: (len(image.stem), image.stem))[::every]
    matrix = _matrix(folder / "intrinsic" / "intrinsic_color.txt")
    shots, lost = [], 0
    for image in images:
        pose = _matrix(folder / "pose" / f"{image.stem}.txt")
        if not np.isfinite(pose).all():
            lost += 1
            continue
        # The principal point counts pixel centres from 0.
        lens = Lens(*image_size(image), matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5)
        shots.append(Shot(image.name, image, lens, np.linalg.inv(pose)))
    notes = (f"{lost} of {len(images)} frames have no pose (tracking was lost) and were left out.",) if lost else ()
    posed = Posed(shots, folder, points, colors, notes=notes)
    capture = assemble(posed, downscale=downscale, holdout=0)
    return Benchmark(
        capture,
        (),
        points,
        colors,
        point_classes,
        name=scene,
        dataset="scannet",
        queries=tuple(NYU40[number] for number in CLASS_SETS[classes]),
        pairs=occurring,
        twin=told is not None,
    )


def _matrix(file: Path) -> np.ndarray:
    """(4, 4) of a text file; infinite where ScanNet has no pose."""
    try:
        matrix = np.loadtxt(file)
    except (OSError, ValueError) as error:
        raise InputError(file, str(error), "a 4x4 matrix", "Export the scan again.") from error
    if matrix.shape != (4, 4):
        raise InputError(file, f"{matrix.shape}", "a 4x4 matrix", "Export the scan again.")
    return matrix
