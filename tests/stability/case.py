"""A row of the stability table: a scene and the error that float32 allows it; and what such scenes are built with.

Scenes are stated in camera axes (x right, y down, z forward, metres) and carried into the world by a turned pose,
unless exact arithmetic is the point. All are float32, padded with Gaussians behind the camera to a few sizes, so that
the compiled programs are shared.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from jsecon.types import Camera, Gaussians

COUNT = 64
"""Gaussians in a case, with the padding"""
FACING = (1.0, 0.0, 0.0, 0.0)
ARGUMENTS = ("means", "log_scales", "quaternions", "opacity_logits", "pose", "intrinsics", "features")
"""what gradients are taken with respect to"""
VALUE = 1e-5
"""bound on the largest error of image (in units of the largest feature) and alpha, where no cut is in doubt"""
GRADIENT = 5e-5
"""bound on the relative L2 error of the gradient with respect to each argument"""


@dataclasses.dataclass(frozen=True)
class Case:
    """One row: a scene, and the largest errors that it may show."""

    name: str
    gaussians: Gaussians
    camera: Camera
    features: np.ndarray
    """(N, 3) float32."""
    bounds: dict[str, float] = dataclasses.field(default_factory=dict)
    """wider bounds than VALUE and GRADIENT, for "value" or an argument's gradient; never above a few times what one
    rounding of the inputs does to the float64 result"""
    why: str = ""
    """what makes the wider bound the best that float32 can do"""
    exact: tuple[Gaussians, Camera] | None = None
    """the float64 scene that the case stands for, where float32 can't hold it as it is"""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """where in the world of `exact` this scene's own origin lies"""
    bad: int = 0
    """Gaussians that must be counted as not finite"""


def _turned(seed: int = 0) -> np.ndarray:
    """(4, 4) float32 rigid pose at no special angle."""
    matrix = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    pose = np.eye(4)
    pose[:3, :3] = matrix * np.sign(np.linalg.det(matrix))
    pose[:3, 3] = 0.3, -0.2, 0.5
    return pose.astype(np.float32)


TURNED, STRAIGHT = _turned(), np.eye(4, dtype=np.float32)


def camera_of(pose=TURNED, width=48, height=40, f=45.0, cx=None, cy=None) -> Camera:
    numbers = (f, f, width * 0.53 if cx is None else cx, height * 0.47 if cy is None else cy)
    return Camera(pose, *(np.float32(v) for v in numbers), width, height)


def quaternion_onto(axis: np.ndarray) -> np.ndarray:
    """(N, 4) wxyz that turn the x axis onto each unit `axis` (N, 3)."""
    half = np.stack([1 + axis[:, 0], 0 * axis[:, 0], -axis[:, 2], axis[:, 1]], axis=1)
    half[axis[:, 0] < -1 + 1e-12] = 0, 0, 1, 0
    return half / np.linalg.norm(half, axis=1, keepdims=True)


def _product(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return r @ np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])


def case_of(name, points, scales, quaternions=FACING, logits=1.0, *, camera=None, features=None, count=COUNT, **rest):
    """A Case from camera-frame `points` (n, 3), `scales` (metres, no logarithms) and quaternions, padded to `count`."""
    camera = camera_of() if camera is None else camera
    points = np.asarray(points, np.float64).reshape(-1, 3)
    n = len(points)
    pose = np.asarray(camera.world_to_camera, np.float64)
    rng = np.random.default_rng(7)
    with np.errstate(divide="ignore"):
        log_scales = np.log(np.broadcast_to(np.asarray(scales, np.float64), (n, 3)))
    turned = np.broadcast_to(np.asarray(quaternions, np.float64), (n, 4))
    if not np.array_equal(pose[:3, :3], np.eye(3)):
        turned = _product(Rotation.from_matrix(pose[:3, :3].T).as_quat(scalar_first=True), turned)
    behind = np.array([0.0, 0.0, -5.0])
    points = np.concatenate([points, np.tile(behind, (count - n, 1))])
    means = (points - pose[:3, 3]) @ pose[:3, :3]
    gaussians = Gaussians(
        *(
            a.astype(np.float32)
            for a in (
                means,
                np.concatenate([log_scales, np.full((count - n, 3), -3.0)]),
                np.concatenate([turned, np.tile(FACING, (count - n, 1))]),
                np.concatenate([np.broadcast_to(np.asarray(logits, np.float64), n), np.zeros(count - n)]),
                np.zeros((count, 1, 3)),
            )
        )
    )
    if features is None:
        features = rng.uniform(-1, 1, (count, 3))
    return Case(name, gaussians, camera, np.asarray(features, np.float32), **rest)


def changed(case: Case, name: str, where=(), **changes) -> Case:
    """`case` with other numbers: `where` holds (field of Gaussians or "features", index, value)."""
    arrays = {f.name: getattr(case.gaussians, f.name).copy() for f in dataclasses.fields(Gaussians)}
    arrays["features"] = case.features.copy()
    for field, index, value in where:
        arrays[field][index] = value
    features = arrays.pop("features")
    return dataclasses.replace(case, name=name, gaussians=Gaussians(**arrays), features=features, **changes)


def directions(n: int) -> np.ndarray:
    """(n, 3) unit vectors all round: the axes, then a Fibonacci spiral."""
    k = np.arange(n - 3) + 0.5
    z, angle = 1 - 2 * k / (n - 3), np.pi * (1 + 5**0.5) * k
    spiral = np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)
    return np.concatenate([np.eye(3), spiral])


def cloud(n: int, seed: int, depth=(1.5, 4.0), spread=0.45) -> np.ndarray:
    """(n, 3) points inside the view."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(*depth, n)
    return np.stack([rng.uniform(-spread, spread, n) * z, rng.uniform(-spread, spread, n) * z, z], axis=1)


def ordinary(name: str = "ordinary scene", n: int = 48, **rest) -> Case:
    """A scene without anything special: the measure for the others, and what bad numbers are put into."""
    rng = np.random.default_rng(3)
    return case_of(
        name, cloud(n, 2), rng.uniform(0.03, 0.3, (n, 3)), rng.normal(size=(n, 4)), rng.uniform(-2, 4, n), **rest
    )
