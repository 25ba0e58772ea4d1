"""Poses without images, of a COLMAP model or a transforms.json."""

from pathlib import Path

import numpy as np

from jsecon.data.colmap import find_model, read_cameras, read_images
from jsecon.data.coordinates import make_rigid
from jsecon.data.frames import downscaled_size, frame_names
from jsecon.data.nerfstudio import read_poses
from jsecon.errors import InputError
from jsecon.types import Camera


def load_poses(path: str | Path, *, long_side: int | None = None) -> tuple[Camera, tuple[str, ...]]:
    """Loads cameras to render from. Distortion is left out: the renders are those of pinhole lenses.

    Args:
      path: Folder of a COLMAP model (cameras and images, .bin or .txt) or of a capture that has one, or a
        transforms.json.
      long_side: Longest side of the renders, px; None keeps the size of the first lens. All cameras get that size,
        each with its field of view.

    Returns:
      Batch of T cameras in the world of the file, poses in float64, and their names.

    Raises:
      InputError: The path holds no poses, or damaged ones.
    """
    path = Path(path)
    model = find_model(path) if path.is_dir() else None
    file = path / "transforms.json" if path.is_dir() else path
    if model is not None:
        lenses = read_cameras(model)
        posed = [(name, lenses[number], pose) for name, number, pose in read_images(model)]
    elif file.is_file() and file.suffix.lower() == ".json":
        posed = read_poses(file)
    else:
        expected = "a folder with cameras.bin and images.bin (or .txt), or a transforms.json"
        raise InputError(path, "it has no poses", expected, "Check the path.")
    if not posed:
        raise InputError(path, "it has no frame", "at least one pose", "Estimate the poses again.")
    width, height = downscaled_size((posed[0][1].width, posed[0][1].height), None, long_side)
    sized = [lens.resized(width, height) for _, lens, _ in posed]

    def column(name):
        return np.array([getattr(lens, name) for lens in sized], np.float32)

    poses = np.stack([make_rigid(pose, path, name) for name, _, pose in posed])
    cameras = Camera(poses, column("fx"), column("fy"), column("cx"), column("cy"), width, height)
    return cameras, frame_names([name for name, _, _ in posed], path)
