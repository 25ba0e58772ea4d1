"""Lenses of captures, on the host, and the pinhole lens that replaces a distorted one.

OpenCV projects two models, Brown's and Kannala and Brandt's. COLMAP's others are projected here, by the formulas of its
src/colmap/sensor/models.h: pycolmap, which has them too, is an optional package.

Pixels are counted as everywhere here (and in COLMAP): the centre of the first pixel is at (0.5, 0.5). OpenCV puts it at
(0, 0), hence the half pixels below.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError

MIN_ZOOM, MAX_ZOOM = 0.5, 8.0
"""zooms searched for a pinhole lens without empty pixels: below the one the centre would lose over half its resolution,
above the other the coefficients are nonsense"""
RAY_STEPS, BORDER_STEPS = 64, 48
"""samples along a ray from the principal point, and along each edge of the image, in that search"""


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
    """OpenCV's order: k1 k2 p1 p2 [k3 [k4 k5 k6]], or k1 k2 k3 k4 where `fisheye`; empty = pinhole. COLMAP's order
    where `model` names one of its models."""
    fisheye: bool = False
    """equidistant model (Kannala and Brandt) instead of the polynomial one (Brown)."""
    model: str | None = None
    """one of PROJECTIONS; None: OpenCV's, see `fisheye`."""

    @property
    def distorted(self) -> bool:
        """Whether its images must be resampled before they are those of a pinhole."""
        return self.fisheye or self.model is not None or any(k != 0 for k in self.distortion)

    def resized(self, width: int, height: int) -> Lens:
        """Scales the lens to another size of the same image.

        Args:
          width: New width, px.
          height: New height, px.

        Returns:
          The lens; its distortion stays.
        """
        x, y = width / self.width, height / self.height
        return dataclasses.replace(
            self, width=width, height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y
        )


def _radius(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Distance from the axis, above 0 so that it can be divided by."""
    return np.maximum(np.hypot(x, y), 1e-12)


def _equidistant(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(x/z, y/z) -> the direction's angle to the axis, along x and y."""
    radius = _radius(x, y)
    scale = np.arctan(radius) / radius
    return x * scale, y * scale


def _polynomial(squared: np.ndarray, coefficients: Sequence[float]) -> np.ndarray:
    """1 + k1 r^2 + k2 r^4 + ..."""
    result = np.zeros_like(squared)
    for coefficient in reversed(coefficients):
        result = squared * (coefficient + result)
    return 1 + result


def _field_of_view(x: np.ndarray, y: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
    """COLMAP's FOV (Devernay and Faugeras, "Straight lines have to be straight", 2001); omega 0 is a pinhole."""
    if abs(omega) < 1e-6:
        return x, y
    radius = _radius(x, y)
    scale = np.arctan(2 * radius * np.tan(omega / 2)) / (radius * omega)
    return x * scale, y * scale


def _thin_prism(x: np.ndarray, y: np.ndarray, *parameters: float) -> tuple[np.ndarray, np.ndarray]:
    """COLMAP's THIN_PRISM_FISHEYE: k1 k2 p1 p2 k3 k4 sx1 sy1 act on the angles."""
    k1, k2, p1, p2, k3, k4, sx1, sy1 = parameters
    u, v = _equidistant(x, y)
    squared = u * u + v * v
    radial = _polynomial(squared, (k1, k2, k3, k4))
    across = u * radial + 2 * p1 * u * v + p2 * (squared + 2 * u * u) + sx1 * squared
    down = v * radial + 2 * p2 * u * v + p1 * (squared + 2 * v * v) + sy1 * squared
    return across, down


def _radial_tangential(x: np.ndarray, y: np.ndarray, *parameters: float) -> tuple[np.ndarray, np.ndarray]:
    """COLMAP's RAD_TAN_THIN_PRISM_FISHEYE (Project Aria's Fisheye624): k0..k5, then p0 p1 s0..s3 on the result."""
    p0, p1, s0, s1, s2, s3 = parameters[6:]
    u, v = _equidistant(x, y)
    radial = _polynomial(u * u + v * v, parameters[:6])
    u, v = u * radial, v * radial
    squared = u * u + v * v
    along = 2 * (u * p0 + v * p1)
    across = u + along * u + squared * p0 + s0 * squared + s1 * squared**2
    down = v + along * v + squared * p1 + s2 * squared + s3 * squared**2
    return across, down


def _division(x: np.ndarray, y: np.ndarray, k: float) -> tuple[np.ndarray, np.ndarray]:
    """COLMAP's DIVISION (Fitzgibbon, CVPR 2001): undistorted = distorted / (1 + k r^2). NaN beyond its range."""
    scale = 2 / (1 + np.sqrt(1 - 4 * k * (x * x + y * y)))
    return x * scale, y * scale


def _unified(x: np.ndarray, y: np.ndarray, alpha: float, beta: float) -> tuple[np.ndarray, np.ndarray]:
    """COLMAP's EUCM (Khomutenko et al., "An enhanced unified camera model", RA-L 2016)."""
    scale = 1 / (alpha * np.sqrt(beta * (x * x + y * y) + 1) + 1 - alpha)
    return x * scale, y * scale


PROJECTIONS: dict[str, Callable[..., tuple[np.ndarray, np.ndarray]]] = {
    "FOV": _field_of_view,
    "THIN_PRISM_FISHEYE": _thin_prism,
    "RAD_TAN_THIN_PRISM_FISHEYE": _radial_tangential,
    "SIMPLE_DIVISION": _division,
    "DIVISION": _division,
    "EUCM": _unified,
}
"""COLMAP's other models: (x/z, y/z) and coefficients -> (u - cx) / fx, (v - cy) / fy"""


def _opencv(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Camera matrix and distortion coefficients as OpenCV has them."""
    matrix = np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
    size = 4 if lens.fisheye else next(n for n in (4, 5, 8) if n >= len(lens.distortion))
    return matrix, np.pad(np.array(lens.distortion, np.float64), (0, size - len(lens.distortion)))


def distort(lens: Lens, directions: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Projects directions into the distorted image.

    Args:
      lens: The lens.
      directions: (N, 2) x/z and y/z in the camera's frame.

    Returns:
      (N, 2) u v, px.
    """
    if lens.model is not None:
        across, down = PROJECTIONS[lens.model](*np.asarray(directions, np.float64).T, *lens.distortion)
        return np.stack([lens.fx * across + lens.cx, lens.fy * down + lens.cy], axis=-1)
    matrix, coefficients = _opencv(lens)
    points = np.ascontiguousarray(directions, np.float64)
    if lens.fisheye:
        pixels = cv2.fisheye.distortPoints(points[None], matrix, coefficients)
    else:
        spatial = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        pixels, _ = cv2.projectPoints(spatial, np.zeros(3), np.zeros(3), matrix, coefficients)
    return pixels.reshape(-1, 2) + 0.5


@np.errstate(all="ignore")  # an overflow means: not covered
def _covered(lens: Lens, zoom: float) -> bool:
    """Whether a pinhole lens of this zoom sees only pixels of the distorted image, where its model is one to one.

    Looks along rays from the principal point to the border: the distorted radius must grow all the way (a polynomial
    folds back beyond its range, which would show the same pixels twice) and end inside the image.
    """
    across, down = np.linspace(0, lens.width, BORDER_STEPS), np.linspace(0, lens.height, BORDER_STEPS)
    edges = [(across, 0 * across), (across, 0 * across + lens.height), (0 * down, down), (0 * down + lens.width, down)]
    border = np.concatenate([np.stack(edge, -1) for edge in edges])
    ends = (border - [lens.cx, lens.cy]) / [lens.fx * zoom, lens.fy * zoom]
    rays = ends[:, None] * np.linspace(0, 1, RAY_STEPS + 1)[:, None]
    pixels = distort(lens, rays.reshape(-1, 2)).reshape(rays.shape)
    if not np.isfinite(pixels).all():
        return False
    radius = np.linalg.norm((pixels - pixels[:, :1]) / [lens.fx, lens.fy], axis=-1)
    reached = pixels[:, -1]
    inside = (reached >= 0).all() and (reached[:, 0] <= lens.width).all() and (reached[:, 1] <= lens.height).all()
    return bool(inside and (np.diff(radius, axis=1) > 0).all())


def undistorted_pinhole(lens: Lens, where: object) -> Lens:
    """Finds the widest pinhole lens, of the same size and principal point, whose image has no empty border.

    An empty border could not be told from black things.

    Args:
      lens: The distorted lens.
      where: Name of its file for errors.

    Returns:
      The pinhole lens; `lens` itself if it is not distorted.

    Raises:
      InputError: There is no such lens: the principal point lies outside the image, or coefficients are absurd.
    """
    if not lens.distorted:
        return dataclasses.replace(lens, distortion=())
    # Covered at a zoom means covered at every larger one: its rays are the same, but shorter. So bisection is exact.
    low, high = MIN_ZOOM, MAX_ZOOM
    if not _covered(lens, high):
        remedy = "Calibrate again, or undistort the images first (colmap image_undistorter)."
        raise InputError(where, f"the distortion {lens.distortion} leaves no undistorted image", remedy=remedy)
    if _covered(lens, low):
        high = low
    while high - low > 1e-4:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if _covered(lens, middle) else (middle, high)
    return dataclasses.replace(lens, fx=lens.fx * high, fy=lens.fy * high, distortion=(), fisheye=False, model=None)


def undistortion_maps(lens: Lens, pinhole: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Computes where each pixel of the undistorted image lies in the distorted one.

    Args:
      lens: The distorted lens.
      pinhole: Its pinhole lens.

    Returns:
      Two tables (H, W) float32 for cv2.remap.
    """
    if lens.model is not None:
        columns = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
        rows = (np.arange(pinhole.height) + 0.5 - pinhole.cy) / pinhole.fy
        directions = np.stack(np.meshgrid(columns, rows), axis=-1)
        pixels = distort(lens, directions.reshape(-1, 2)).reshape(directions.shape) - 0.5
        return pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32)
    matrix, coefficients = _opencv(lens)
    target, _ = _opencv(pinhole)
    make = cv2.fisheye.initUndistortRectifyMap if lens.fisheye else cv2.initUndistortRectifyMap
    return make(matrix, coefficients, np.eye(3), target, (pinhole.width, pinhole.height), cv2.CV_32FC1)


def resample_depth(depth: Float[np.ndarray, "h w"], lens: Lens, other: Lens) -> Float[np.ndarray, "p q"]:
    """Resamples a depth map for another lens at the same place.

    Args:
      depth: (H, W) z-depth.
      lens: Its pinhole lens.
      other: The other pinhole lens.

    Returns:
      (P, Q) depth of the nearest pixel, 0 outside.
    """
    columns = np.floor((np.arange(other.width) + 0.5 - other.cx) / other.fx * lens.fx + lens.cx).astype(int)
    rows = np.floor((np.arange(other.height) + 0.5 - other.cy) / other.fy * lens.fy + lens.cy).astype(int)
    height, width = depth.shape
    inside = ((rows >= 0) & (rows < height))[:, None] & ((columns >= 0) & (columns < width))
    return np.where(inside, depth[np.clip(rows, 0, height - 1)[:, None], np.clip(columns, 0, width - 1)], 0)
