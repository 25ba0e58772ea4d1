"""OpenSfM's reconstruction.json, on the host, as OpenDroneMap and WebODM write it too; panoramas among its cameras.

Format: OpenSfM doc/source/dataset.rst and opensfm/io.py. A shot's rotation is an angle-axis vector, world-to-camera in
OpenCV axes. Focal lengths and centres are shares of the image's longer side, and centres are relative to its middle.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jsecon.files import read_json, reading
from jsecon.read.captures.frames import PosedImage, PosedImages, pose_matrix
from jsecon.read.captures.images import find_image
from jsecon.read.captures.lens import Lens, panorama_lens
from jsecon.read.registry import Reader

_REMEDY = "Run OpenSfM's reconstruct again."
_PANORAMAS = ("spherical", "equirectangular")
_LENSES = ("perspective", "simple_radial", "radial", "brown", "fisheye", "fisheye_opencv")
"""projection types that OpenCV has"""


def _read_opensfm(path: Path) -> PosedImages:
    """Reads the posed images and points of the largest reconstruction; the images lie in images/."""
    file = path / "reconstruction.json"
    with reading(file, remedy=_REMEDY):
        models = sorted(read_json(file, "a reconstruction.json", _REMEDY), key=lambda model: -len(model["shots"]))
        notes = [f"There are {len(models)} reconstructions; the largest is used."] if models[1:] else []
        lenses = {name: _lens(file, name, camera) for name, camera in models[0]["cameras"].items()}
        images = []
        for name, shot in models[0]["shots"].items():
            pose = pose_matrix(Rotation.from_rotvec(np.array(shot["rotation"], np.float64)), shot["translation"])
            images.append(PosedImage(name, find_image(path / "images", name), lenses[shot["camera"]], pose))
        points = models[0].get("points", {}).values()
        places = np.array([point["coordinates"] for point in points], np.float64).reshape(-1, 3)
        colours = np.array([point["color"] for point in points], np.float64).reshape(-1, 3).clip(0, 255)
    return PosedImages(images, file, places, colours.astype(np.uint8), notes=tuple(notes), ignores_exif=True)


def _lens(file: Path, name: str, camera: dict[str, Any]) -> Lens:
    """The lens of a camera."""
    model, width, height = camera["projection_type"], int(camera["width"]), int(camera["height"])
    if model in _PANORAMAS:
        return panorama_lens(file, width, height)
    if model not in _LENSES:
        raise ValueError(f"the projection_type {model} of camera {name} is not read: undistort the images first")
    side, is_fisheye = max(width, height), "fisheye" in model
    order = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortion = tuple(float(camera.get(key, 0.0)) for key in order)
    fx, fy = (side * float(camera.get(key, camera.get("focal", 0.0))) for key in ("focal_x", "focal_y"))
    cx, cy = width / 2 + side * float(camera.get("c_x", 0.0)), height / 2 + side * float(camera.get("c_y", 0.0))
    return Lens(width, height, fx, fy, cx, cy, distortion, is_fisheye)


READERS = (Reader("OpenSfM", ("reconstruction.json",), _read_opensfm),)
