"""Lenses of captures, on the host, and the pinhole lens that replaces a distorted one.

OpenCV projects two models, Brown's and Kannala and Brandt's. A panorama (equirectangular, 360 x 180 degrees) becomes
several pinhole views. Its middle looks along z, and its columns and rows are equal steps of longitude and latitude, as
in COLMAP, nerfstudio and OpenSfM.

Pixels are counted as everywhere here (and in COLMAP): the centre of the first pixel is at (0.5, 0.5). OpenCV puts it at
(0, 0), hence the half pixels below.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.numerics import is_finite_and_bounded

PANORAMA = "EQUIRECTANGULAR"
"""COLMAP's and nerfstudio's model of a panorama"""
_TURNS = [*((-60 * view, 0) for view in range(6)), (0, 90), (0, -90)]
PANORAMA_VIEWS = Rotation.from_euler("YX", _TURNS, degrees=True).as_matrix()
"""(8, 3, 3) rotations from the axes of a panorama to those of its views: six along the horizon, one down and one up"""
OPERATOR_DEGREES = 30.0
"""half angle of the cone straight below a panorama in which its tripod, or whoever carries it, is seen"""


@dataclasses.dataclass(frozen=True)
class Lens:
    """The intrinsics of one image file."""

    width: int
    """px."""
    height: int
    """px."""
    fx: float
    """px."""
    fy: float
    """px."""
    cx: float
    """px, from the left edge of the first pixel."""
    cy: float
    """px, from the upper edge of the first pixel."""
    distortion: tuple[float, ...] = ()
    """OpenCV's order: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4 where `fisheye`; empty = pinhole."""
    fisheye: bool = False
    """equidistant model (Kannala and Brandt) instead of the polynomial one (Brown)."""
    view: int | None = None
    """row of PANORAMA_VIEWS, of a view of a panorama, whose size this has and whose focal lengths are px per radian; 0
    until the panorama is cut into views."""

    def __post_init__(self) -> None:
        """Raises ValueError if no image can have been taken with it."""
        numbers = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        has_size = 0 < self.width < 1 << 31 and 0 < self.height < 1 << 31
        is_lens = is_finite_and_bounded(numbers) and min(self.fx, self.fy) >= 1e-3 and len(self.distortion) <= 8
        is_in_pixels = max(self.cx, self.cy) > 1 or min(self.width, self.height) < 8
        if not (has_size and is_lens and is_in_pixels):
            problem = f"a camera of {self.width}x{self.height} px has focal lengths, centre and distortion {numbers}"
            raise ValueError(problem if is_in_pixels else f"{problem}: give them in pixels")

    @property
    def distorted(self) -> bool:
        """Whether its images must be resampled before they are those of a pinhole."""
        return self.fisheye or self.view is not None or any(k != 0 for k in self.distortion)

    @property
    def undistorted_size(self) -> tuple[int, int]:
        """(width, height) of its undistorted images; of a panorama, of a view with as many pixels a degree."""
        side = max(1, round(self.width / 3))
        return (self.width, self.height) if self.view is None else (side, side)

    def resized(self, width: int, height: int) -> Lens:
        """Scales the lens to another size of the same image, px; its distortion stays."""
        x, y = width / self.width, height / self.height
        return dataclasses.replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )


def panorama_lens(where: object, width: int, height: int) -> Lens:
    """Makes the lens of a panorama; `where` names its file in the error of another aspect than 2:1."""
    if width != 2 * height:
        raise InputError(where, f"the panorama is {width}x{height}", "twice as wide as high", "Export all directions.")
    return Lens(width, height, width / (2 * np.pi), height / np.pi, width / 2, height / 2, view=0)


def operator_mask(lens: Lens, pinhole: Lens) -> Bool[np.ndarray, "h w"]:
    """Marks the pixels of a panorama's view within the cone straight below it."""
    directions = _panorama_directions(lens, pinhole)
    return directions[..., 1] > np.cos(np.radians(OPERATOR_DEGREES)) * np.linalg.norm(directions, axis=-1)


def _panorama_directions(lens: Lens, pinhole: Lens) -> Float[np.ndarray, "h w 3"]:
    """Directions of a view's pixels in the frame of its panorama."""
    columns = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    rows = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.fy
    of_view = np.stack([*np.meshgrid(columns, rows), np.ones((pinhole.height, pinhole.width))], axis=-1)
    return of_view @ PANORAMA_VIEWS[lens.view or 0]


def _opencv(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Camera matrix and distortion coefficients as OpenCV has them."""
    matrix = np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
    size = 4 if lens.fisheye else next(n for n in (4, 5, 8) if n >= len(lens.distortion))
    return matrix, np.pad(np.array(lens.distortion, np.float64), (0, size - len(lens.distortion)))


def _distort(lens: Lens, spatial: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Projects directions in the camera's frame, z = 1, into the distorted image, px."""
    matrix, coefficients = _opencv(lens)
    if lens.fisheye:
        pixels = cv2.fisheye.distortPoints(np.ascontiguousarray(spatial[None, :, :2]), matrix, coefficients)
    else:
        pixels, _ = cv2.projectPoints(spatial, np.zeros(3), np.zeros(3), matrix, coefficients)
    return pixels.reshape(-1, 2) + 0.5


@np.errstate(all="ignore")  # an overflow means: not covered
def _covered(lens: Lens, zoom: float) -> bool:
    """Whether a pinhole lens of this zoom sees only pixels of the distorted image, where its model is one to one.

    Looks along rays from the principal point to the border: the distorted radius must grow all the way (a polynomial
    folds back beyond its range, which would show the same pixels twice) and end inside the image.
    """
    share = np.linspace(0, 1, 48)[:, None]
    border = np.concatenate([share * [1, 0], share * [1, 0] + [0, 1], share * [0, 1], share * [0, 1] + [1, 0]])
    border *= [lens.width, lens.height]
    ends = (border - [lens.cx, lens.cy]) / [lens.fx * zoom, lens.fy * zoom]
    rays = ends[:, None] * np.linspace(0, 1, 65)[:, None]
    spatial = np.pad(rays.reshape(-1, 2), ((0, 0), (0, 1)), constant_values=1.0)
    pixels = _distort(lens, spatial).reshape(rays.shape)
    if not np.isfinite(pixels).all():
        return False
    radius = np.linalg.norm((pixels - pixels[:, :1]) / [lens.fx, lens.fy], axis=-1)
    reached = pixels[:, -1]
    inside = (reached >= 0).all() and (reached[:, 0] <= lens.width).all() and (reached[:, 1] <= lens.height).all()
    return bool(inside and (np.diff(radius, axis=1) > 0).all())


def undistorted_pinhole(lens: Lens, where: object) -> Lens:
    """Finds the widest pinhole lens, of the same size and principal point, whose image has no empty border.

    An empty border could not be told from black things. `where` names the file of the lens for errors. For
    a view of a panorama, it is the pinhole lens of the view.
    """
    if lens.view is not None:
        side, _ = lens.undistorted_size
        focal = side / 2.2  # 95 degrees: the views of a panorama leave no gap from a tangent of 1.07 of their half on
        return Lens(side, side, focal, focal, side / 2, side / 2)
    if not lens.distorted:
        return dataclasses.replace(lens, distortion=())
    # Covered at a zoom means covered at every larger one: its rays are the same, but shorter. So bisection is exact.
    # Below a zoom of 0.5 the centre would lose over half its resolution, above 8 the coefficients are nonsense.
    low, high = 0.5, 8.0
    if not _covered(lens, high):
        remedy = "Calibrate again, or undistort the images first (colmap image_undistorter)."
        raise InputError(where, f"the distortion {lens.distortion} leaves no undistorted image", remedy=remedy)
    if _covered(lens, low):
        high = low
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _covered(lens, middle) else (middle, high)
    return dataclasses.replace(lens, fx=lens.fx * high, fy=lens.fy * high, distortion=(), fisheye=False)


def undistortion_maps(lens: Lens, pinhole: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Computes where each pixel of the undistorted image lies in the distorted one: two tables for cv2.remap."""
    if lens.view is not None:
        x, y, z = np.moveaxis(_panorama_directions(lens, pinhole), -1, 0)
        columns = lens.cx + lens.fx * np.arctan2(x, z) - 0.5
        rows = lens.cy + lens.fy * np.arctan2(y, np.hypot(x, z)) - 0.5
        return columns.astype(np.float32), rows.clip(0, lens.height - 1).astype(np.float32)
    matrix, coefficients = _opencv(lens)
    target, _ = _opencv(pinhole)
    make = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    return make(matrix, coefficients, np.eye(3), target, (pinhole.width, pinhole.height), cv2.CV_32FC1)
