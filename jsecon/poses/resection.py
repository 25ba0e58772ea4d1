"""The pose of one photograph in a scene that is already there. Host code.

Features of the photograph are matched with those of the field's own pictures, which get their places in the world from
the depth that the Gaussians render. A pose follows by PnP with RANSAC. Then the photograph is compared with what the
scene renders from there: optical flow gives thousands of matches, whose pose is that of the photograph. Old poses have
no part in this, so they stay.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jsecon.read.captures.frames import same_aspect
from jsecon.splat.render import render_depth, render_rgb
from jsecon.types import Camera, Gaussians

MIN_INLIERS = 40
"""Matches that agree on a pose. In fox and bonsai, photographs of the other have up to 23, held-out ones 154."""
_FIRST_VIEWS = 16
"""Views whose pictures look most alike, which are matched first; the others only if these do not suffice."""
_RATIO = 0.8
"""Largest distance of a match over that of the second best (Lowe, IJCV 2004)."""
_FOCALS = (0.6, 0.75, 0.9, 1.2, 1.5, 2.0)
"""Focal lengths over the longer side that are tried where those of the field's views do not fit."""
_SAME_LENS = 0.04
"""Change of the focal length up to which a photograph counts as one of the same lens as the field's views."""
_TOLERANCE = 0.008
"""Distance over the longer side up to which a match agrees with a pose."""
_ROUNDS = 3
"""Comparisons with the rendered scene."""


class Resection(NamedTuple):
    """Where a photograph was taken."""

    camera: Camera | None
    """Of the photograph's size; None if too few matches agree."""
    inliers: int
    """Matches that agree on the pose."""


class _Lens(NamedTuple):
    """A pinhole lens, px."""

    focal: float
    x: float
    y: float
    width: int
    height: int

    def camera(self, pose: Float[np.ndarray, "4 4"]) -> Camera:
        """Returns the camera of this lens at a pose."""
        numbers = np.float32([self.focal, self.focal, self.x, self.y])
        return Camera(pose.astype(np.float32), *numbers, width=self.width, height=self.height)


class _Pose(NamedTuple):
    """A pose that matches agree on."""

    pose: Float[np.ndarray, "4 4"]
    lens: _Lens
    inliers: Int[np.ndarray, " m"]
    """Rows of the matches."""

    def agreeing(self) -> int:
        """Number of these matches."""
        return len(self.inliers)


class _Matches(NamedTuple):
    """Pixels of a photograph, and the places in the world that they show."""

    pixels: Float[np.ndarray, "m 2"]
    points: Float[np.ndarray, "m 3"]


class Landmarks:
    """The features of a field's views and their places in the world; each view is looked at when it is first needed.

    Args:
      gaussians: The scene.
      cameras: Batch of T cameras.
      pictures: T photographs of the cameras' size.
    """

    def __init__(self, gaussians: Gaussians, cameras: Camera, pictures: Sequence[UInt8[np.ndarray, "h w 3"]]):
        self.gaussians, self.cameras, self.pictures = gaussians, cameras, pictures
        self._views: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._small = np.stack([_thumbnail(picture) for picture in pictures])

    def alike(self, photo: UInt8[np.ndarray, "h w 3"]) -> np.ndarray:
        """Lists the views, those whose picture looks most like a photograph first."""
        return np.argsort(-(self._small @ _thumbnail(photo)), kind="stable")

    def view(self, t: int) -> tuple[Float32[np.ndarray, "m 128"], Float[np.ndarray, "m 3"]]:
        """Returns the descriptors and the places of the features of a view, of those on a surface."""
        if t not in self._views:
            pixels, descriptors = _features(self.pictures[t])
            places, known = _places(self.gaussians, self.cameras[t], pixels)
            self._views[t] = descriptors[known], places[known]
        return self._views[t]


def find_pose(photo: UInt8[np.ndarray, "h w 3"], landmarks: Landmarks) -> Resection:
    """Finds where a photograph was taken, and its focal length; its lens counts as free of distortion.

    The lens of the field's views is tried first, then others. The same aspect has the same principal point.

    Args:
      photo: The photograph, about as large as the field's frames.
      landmarks: Of the field.
    """
    usual = _usual_lens(landmarks.cameras, *photo.shape[1::-1])
    pixels, descriptors = _features(photo)
    order = landmarks.alike(photo)
    parts: list[_Matches] = []
    matches, best = _Matches(pixels[:0], np.zeros((0, 3))), None
    for rows in (order[:_FIRST_VIEWS], order[_FIRST_VIEWS:]):
        parts += [_match(pixels, descriptors, *landmarks.view(int(t))) for t in rows]
        matches = _Matches(*(np.concatenate(part) for part in zip(*parts)))
        best = max(_poses(matches, [usual]), key=_Pose.agreeing, default=None)
        if best is not None and best.agreeing() >= 3 * MIN_INLIERS:
            break
    if best is None or best.agreeing() < 3 * MIN_INLIERS:
        lenses = [usual, *(usual._replace(focal=share * max(photo.shape)) for share in _FOCALS)]
        best = max(_poses(matches, lenses), key=_Pose.agreeing, default=None)
    if best is None or best.agreeing() < MIN_INLIERS:
        return Resection(None, 0 if best is None else best.agreeing())
    inliers = _Matches(matches.pixels[best.inliers], matches.points[best.inliers])
    pose, lens = _refine(inliers, best.pose, best.lens, free_focal=True)
    if is_same := abs(np.log(lens.focal / usual.focal)) <= _SAME_LENS:
        pose, lens = _refine(inliers, best.pose, usual, free_focal=False)
    for _ in range(_ROUNDS):
        seen = _flow_matches(photo, landmarks.gaussians, lens.camera(pose))
        if len(seen.pixels) >= 4 * MIN_INLIERS:
            pose, lens = _refine(seen, pose, lens, free_focal=not is_same)
    return Resection(lens.camera(pose), best.agreeing())


def _usual_lens(cameras: Camera, width: int, height: int) -> _Lens:
    """Returns the median lens of the field's views, at the size of a photograph."""
    fx, cx, cy = (float(np.median(np.asarray(numbers))) for numbers in (cameras.fx, cameras.cx, cameras.cy))
    scale = max(width, height) / max(cameras.width, cameras.height)
    if same_aspect((width, height), (cameras.width, cameras.height)):
        return _Lens(fx * scale, cx * scale, cy * scale, width, height)
    return _Lens(fx * scale, width / 2, height / 2, width, height)


def _thumbnail(picture: UInt8[np.ndarray, "h w 3"]) -> Float32[np.ndarray, " d"]:
    """Returns colours of 12x12 places, without their mean and of unit length."""
    small = cv2.resize(picture, (12, 12), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
    small -= small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)


def _features(photo: UInt8[np.ndarray, "h w 3"]) -> tuple[Float[np.ndarray, "m 2"], Float32[np.ndarray, "m 128"]]:
    """Detects SIFT features: their pixels, and the roots of their descriptors (Arandjelovic & Zisserman, CVPR 2012)."""
    detector = cv2.SIFT_create(nfeatures=3000, contrastThreshold=0.02)
    points, descriptors = detector.detectAndCompute(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    roots = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))
    return np.float64([point.pt for point in points]) + 0.5, roots


def _places(
    gaussians: Gaussians, camera: Camera, pixels: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "m 3"], np.ndarray]:
    """Returns the places in the world under pixels by rendered depth, and which of them lie on a surface."""
    depth, alpha = (np.asarray(image) for image in render_depth(gaussians, camera))
    x, y = np.clip(pixels.T.astype(int), 0, [[camera.width - 1], [camera.height - 1]])
    around = np.ones((3, 3), np.uint8)
    step = cv2.dilate(depth, around) - cv2.erode(depth, around)
    z = depth[y, x].astype(np.float64)
    known = (alpha[y, x] > 0.8) & (z > 0) & (step[y, x] < 0.05 * z)
    local = np.stack([(pixels[:, 0] - camera.cx) / camera.fx * z, (pixels[:, 1] - camera.cy) / camera.fy * z, z], 1)
    pose = np.asarray(camera.world_to_camera, np.float64)
    return (local - pose[:3, 3]) @ pose[:3, :3], known


def _match(
    pixels: Float[np.ndarray, "n 2"],
    descriptors: Float32[np.ndarray, "n 128"],
    others: Float32[np.ndarray, "m 128"],
    places: Float[np.ndarray, "m 3"],
) -> _Matches:
    """Matches features that are each other's nearest, and much nearer than the second."""
    if len(descriptors) < 2 or len(others) < 2:
        return _Matches(np.zeros((0, 2)), np.zeros((0, 3)))
    cosines = descriptors @ others.T
    best = cosines.argmax(1)
    rows = np.arange(len(best))
    nearest = 2 - 2 * cosines[rows, best]
    mutual = cosines.argmax(0)[best] == rows
    cosines[rows, best] = -1
    second = 2 - 2 * cosines.max(1)
    kept = mutual & (nearest <= _RATIO**2 * second)
    return _Matches(pixels[kept], places[best[kept]])


def _poses(matches: _Matches, lenses: Sequence[_Lens]) -> Iterator[_Pose]:
    """Finds the pose on which most matches agree, for each lens."""
    if len(matches.pixels) < 4:
        return
    for lens in lenses:
        cv2.setRNGSeed(0)
        error = _TOLERANCE * max(lens.width, lens.height)
        options = {
            "iterationsCount": 3000,
            "reprojectionError": error,
            "confidence": 0.9999,
            "flags": cv2.SOLVEPNP_AP3P,
        }
        matrix = np.array([[lens.focal, 0, lens.x], [0, lens.focal, lens.y], [0, 0, 1]])
        done, turn, shift, inliers = cv2.solvePnPRansac(matches.points, matches.pixels, matrix, None, **options)
        if done and inliers is not None:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
            yield _Pose(pose, lens, inliers.ravel())


def _refine(
    matches: _Matches, pose: Float[np.ndarray, "4 4"], lens: _Lens, *, free_focal: bool
) -> tuple[Float[np.ndarray, "4 4"], _Lens]:
    """Refines a pose, and the focal length if it is free, by least squares of the distances in px, robustly."""
    extent = np.abs(pose[:3, 3]).max()

    def moved(x: np.ndarray) -> tuple[np.ndarray, _Lens]:
        result = pose.copy()
        result[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix() @ pose[:3, :3]
        result[:3, 3] += x[3:6] * extent
        return result, lens._replace(focal=lens.focal * float(np.exp(x[6]))) if free_focal else lens

    def residuals(x: np.ndarray) -> np.ndarray:
        motion, changed = moved(x)
        local = matches.points @ motion[:3, :3].T + motion[:3, 3]
        pixels = changed.focal * local[:, :2] / np.maximum(local[:, 2:], 1e-9) + [changed.x, changed.y]
        return (pixels - matches.pixels).ravel()

    return moved(least_squares(residuals, np.zeros(6 + free_focal), loss="soft_l1", f_scale=0.5, max_nfev=30).x)


def _flow_matches(photo: UInt8[np.ndarray, "h w 3"], gaussians: Gaussians, camera: Camera) -> _Matches:
    """Matches a photograph with the rendered scene by optical flow that leads back to where it began."""
    image = (np.clip(np.asarray(render_rgb(gaussians, camera).features), 0, 1) * 255).astype(np.uint8)
    rendered, real = (cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (image, photo))
    flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    there, back = flow.calc(rendered, real, None), flow.calc(real, rendered, None)
    y, x = (axis.ravel() for axis in np.mgrid[2 : photo.shape[0] - 2 : 4, 2 : photo.shape[1] - 2 : 4])
    start = np.stack([x, y], 1).astype(np.float32)
    end = start + there[y, x]
    returned = cv2.remap(back, end[:, :1], end[:, 1:], cv2.INTER_LINEAR)[:, 0]
    structure = cv2.cornerMinEigenVal(rendered, 7)[y, x]
    inside = ((end >= 0) & (end < [photo.shape[1], photo.shape[0]])).all(1)
    places, known = _places(gaussians, camera, start.astype(np.float64) + 0.5)
    kept = known & inside & (np.linalg.norm(there[y, x] + returned, axis=1) < 1) & (structure > np.median(structure))
    return _Matches(end[kept].astype(np.float64) + 0.5, places[kept])
