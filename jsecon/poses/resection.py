"""The pose of one photograph in a scene that is already there. Host code.

Features of the photograph are matched with those of the field's own pictures, which get their places in the world from
the depth that the Gaussians render. A pose follows by PnP with RANSAC. Then the photograph is compared with what the
scene renders from there: optical flow gives thousands of matches, whose pose is that of the photograph. Old poses have
no part in this, so they stay.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, cast

import cv2
import jax
import numpy as np
import scipy  # loads scipy.optimize on its first use, which photographs with poses do without
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from jsecon.fit.resize import resize_camera
from jsecon.fit.triangulate import Features, detect_features, match_features
from jsecon.read.captures.frames import same_aspect
from jsecon.splat.points import back_project
from jsecon.splat.render import render_depth, render_rgb
from jsecon.types import Camera, Gaussians

MIN_INLIERS = 40
"""Matches that agree on a pose. In fox and bonsai, photographs of the other have up to 23, held-out ones 154."""
_FIRST_VIEWS = 16
"""Views whose pictures look most alike, which are matched first; the others only if these do not suffice."""
_ZOOMS = (1.0, 0.6, 0.75, 1.33, 1.75)
"""Focal lengths that are tried then, in those of the field's views."""
_TOLERANCE = 0.008
"""Distance over the longer side up to which a match agrees with a pose."""


class _Landmarks:
    """The features of a field's views and their places in the world; each view is looked at when it is first needed."""

    def __init__(self, gaussians: Gaussians, cameras: Camera, pictures: Sequence[UInt8[np.ndarray, "h w 3"]]):
        self.gaussians, self.cameras, self.pictures = gaussians, jax.tree.map(np.asarray, cameras), pictures
        self._views: dict[int, tuple[Features, np.ndarray]] = {}

    def _lens(self, width: int, height: int) -> Camera:
        """Guesses the lens of a photograph: the median one of the views, its centre only for the same aspect."""
        poses, *numbers = (np.median(column, axis=0) for column in jax.tree.leaves(self.cameras))
        usual = Camera(poses, *numbers, width=self.cameras.width, height=self.cameras.height)
        if same_aspect((width, height), (usual.width, usual.height)):
            return resize_camera(usual, width, height)
        focal = usual.fx * max(width, height) / max(usual.width, usual.height)
        return Camera(poses, focal, focal, *np.array([width / 2, height / 2], np.float32), width=width, height=height)

    def _alike(self, photo: UInt8[np.ndarray, "h w 3"]) -> list[int]:
        """Lists the views, those whose picture looks most like a photograph first: by the colours of 12x12 places."""
        small = [cv2.resize(image, (12, 12), interpolation=cv2.INTER_AREA).ravel() for image in (photo, *self.pictures)]
        with np.errstate(divide="ignore", invalid="ignore"):  # a picture of one colour is like none
            alike = np.nan_to_num(np.atleast_2d(np.corrcoef(small)))
        return np.argsort(-alike[0, 1:], kind="stable").tolist()

    def _match(self, features: Features, t: int) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 3"]]:
        """Matches features with those of a view: the rays of the first, and their places in the world."""
        if t not in self._views:
            found = detect_features(self.pictures[t], self.cameras[t])
            places, known = _places(self.gaussians, self.cameras[t], found.rays)
            self._views[t] = Features(*(column[known] for column in found)), places[known]
        others, places = self._views[t]
        rows, columns = match_features(features, others).T
        return features.rays[rows], places[columns]


def pose_finder(
    gaussians: Gaussians, cameras: Camera, pictures: Sequence[UInt8[np.ndarray, "h w 3"]]
) -> Callable[[UInt8[np.ndarray, "h w 3"]], tuple[Camera | None, int]]:
    """Makes a function that finds where a photograph was taken, and its focal length, by the views of a field.

    The photograph is about as large as the views, and its lens counts as free of distortion. The function returns the
    camera, None if too few matches agree on one, and the number of those that agree.

    Args:
      gaussians: The scene.
      cameras: Batch of T cameras.
      pictures: T photographs of the cameras' size.
    """
    return functools.partial(_find_pose, _Landmarks(gaussians, cameras, pictures))


def _find_pose(landmarks: _Landmarks, photo: UInt8[np.ndarray, "h w 3"]) -> tuple[Camera | None, int]:
    """Finds the camera of a photograph, and the number of matches that agree on it."""
    lens, order = landmarks._lens(*photo.shape[1::-1]), landmarks._alike(photo)
    features, error = detect_features(photo, lens), _TOLERANCE * max(photo.shape) / float(lens.fx)
    matches, count, best = [(np.zeros((0, 2)), np.zeros((0, 3)))], 0, None
    for views, zooms in ((order[:_FIRST_VIEWS], (1.0,)), (order[_FIRST_VIEWS:], _ZOOMS)):
        matches += [landmarks._match(features, t) for t in views]
        rays, places = (np.concatenate(column) for column in zip(*matches))
        for zoom in zooms if len(rays) > 3 else ():
            cv2.setRNGSeed(0)
            options = {"iterationsCount": 3000, "confidence": 0.9999, "flags": cv2.SOLVEPNP_AP3P}
            matrix = np.diag([zoom, zoom, 1.0])
            done, *motion, inliers = cv2.solvePnPRansac(places, rays, matrix, None, reprojectionError=error, **options)
            if done and len(inliers) > count:
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(motion[0])[0], motion[1].ravel()
                inlier_ids = inliers.ravel().astype(int)
                count, best = len(inlier_ids), (pose, zoom, rays[inlier_ids], places[inlier_ids])
        if count >= 3 * MIN_INLIERS:
            break
    if best is None or count < MIN_INLIERS:
        return None, count
    pose, zoom, rays, places = best
    refined = _refine(rays, places, pose, zoom, lens, is_free=True)
    if is_same := abs(np.log(refined[1])) <= 0.04:  # it counts as one of the field's lens
        refined = _refine(rays, places, pose, 1.0, lens, is_free=False)
    for _ in range(3):
        rays, places = _flow_matches(photo, landmarks.gaussians, _placed(lens, *refined), lens)
        if len(rays) >= 4 * MIN_INLIERS:
            refined = _refine(rays, places, *refined, lens, is_free=not is_same)
    return _placed(lens, *refined), count


def _placed(lens: Camera, pose: Float[np.ndarray, "4 4"], zoom: float) -> Camera:
    fx, fy = np.float32(lens.fx * zoom), np.float32(lens.fy * zoom)
    return dataclasses.replace(lens, world_to_camera=pose.astype(np.float32), fx=fx, fy=fy)


def _places(
    gaussians: Gaussians, camera: Camera, rays: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "m 3"], Bool[np.ndarray, " m"]]:
    """Returns the places in the world along rays by rendered depth, and which of them lie on a surface."""
    depth, alpha = (np.asarray(image) for image in render_depth(gaussians, camera))
    pixels = rays * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    x, y = np.clip(pixels.T.astype(int), 0, [[camera.width - 1], [camera.height - 1]])
    around = np.ones((3, 3), np.uint8)
    z, step = depth[y, x].astype(np.float64), (cv2.dilate(depth, around) - cv2.erode(depth, around))[y, x]
    return back_project(camera, pixels[:, ::-1] - 0.5, z), (alpha[y, x] > 0.8) & (z > 0) & (step < 0.05 * z)


def _refine(
    rays: Float[np.ndarray, "m 2"],
    places: Float[np.ndarray, "m 3"],
    pose: Float[np.ndarray, "4 4"],
    zoom: float,
    lens: Camera,
    *,
    is_free: bool,
) -> tuple[Float[np.ndarray, "4 4"], float]:
    """Refines a pose, and the zoom if it is free, by least squares of the distances in px, robustly."""
    away = np.median(np.linalg.norm(places @ pose[:3, :3].T + pose[:3, 3], axis=1))

    def moved(x: np.ndarray) -> tuple[np.ndarray, float]:
        result = pose.copy()
        result[:3, :3] = Rotation.from_rotvec(x[:3]).as_matrix() @ pose[:3, :3]
        result[:3, 3] += x[3:6] * away
        return result, zoom * float(np.exp(x[6:].sum()))

    def residuals(x: np.ndarray) -> np.ndarray:
        motion, scale = moved(x)
        local = places @ motion[:3, :3].T + motion[:3, 3]
        return ((scale * local[:, :2] / np.maximum(local[:, 2:], 1e-9) - rays) * float(lens.fx)).ravel()

    return moved(
        scipy.optimize.least_squares(residuals, np.zeros(6 + is_free), loss="soft_l1", f_scale=0.5, max_nfev=30).x
    )


def _flow_matches(
    photo: UInt8[np.ndarray, "h w 3"], gaussians: Gaussians, camera: Camera, lens: Camera
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 3"]]:
    """Matches a photograph with the scene rendered by a camera, by optical flow that leads back to where it began."""
    image = (np.clip(np.asarray(render_rgb(gaussians, camera).features), 0, 1) * 255).astype(np.uint8)
    rendered, real = (cv2.cvtColor(each, cv2.COLOR_RGB2GRAY) for each in (image, photo))
    flow = cast(Any, cv2).DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    forward, back = flow.calc(rendered, real, None), flow.calc(real, rendered, None)
    y, x = (axis.ravel() for axis in np.mgrid[2 : photo.shape[0] - 2 : 4, 2 : photo.shape[1] - 2 : 4])
    start = np.stack([x, y], 1).astype(np.float32)
    end = start + forward[y, x]
    returned = cv2.remap(back, end[:, :1], end[:, 1:], cv2.INTER_LINEAR)[:, 0]
    structure = cv2.cornerMinEigenVal(rendered, 7)[y, x]
    begun, ended = (
        (pixels + 0.5 - [view.cx, view.cy]) / [view.fx, view.fy] for pixels, view in ((start, camera), (end, lens))
    )
    places, known = _places(gaussians, camera, begun)
    inside = ((end >= 0) & (end < [photo.shape[1], photo.shape[0]])).all(1) & (structure > np.median(structure))
    kept = known & inside & (np.linalg.norm(forward[y, x] + returned, axis=1) < 1)
    return ended[kept], places[kept]
