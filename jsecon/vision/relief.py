"""Depth and normals as channels of a frame, in which a step of shape weighs as much as a step of colour."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32


def steadied_depth(depth: Float32[np.ndarray, "h w"], *, noise: float = 0.06, rounds: int = 3) -> np.ndarray:
    """z-depth (H, W), 0 = unknown, as Gaussians render it -> the same without what is noise (relative steps below about
    `noise`), its jumps kept: a median, then bilateral filters on its logarithm. Unknown pixels are filled from the
    nearest known one; all 0 stays so."""
    known = np.asarray(depth > 0)
    if not known.any():
        return depth
    logarithm = cv2.medianBlur(np.log(np.maximum(_filled(depth, known), 1e-12)).astype(np.float32), 5)
    for _ in range(rounds):
        logarithm = cv2.bilateralFilter(logarithm, 9, noise, 4)
    return np.exp(logarithm)


def geometry_features(
    depth: Float32[np.ndarray, "h w"] | None,
    normal: Float32[np.ndarray, "h w 3"] | None,
    *,
    unit: float,
    depth_jump: float,
    crease_degrees: float,
) -> Float32[np.ndarray, "h w c"] | None:
    """(H, W, 1..4) channels in which a relative depth step of `depth_jump` and an angle of `crease_degrees` are `unit`.

    Unknown pixels (0) take the value of the nearest known one, so that nothing known begins or ends at them. None where
    nothing is known.
    """
    channels = []
    if depth is not None and (depth > 0).any():
        logarithm = np.log(np.maximum(_filled(depth, np.asarray(depth > 0)), 1e-12))
        channels.append(logarithm[..., None] * np.float32(unit / np.log1p(depth_jump)))
    if normal is not None and normal.any():
        chord = 2.0 * np.sin(np.radians(crease_degrees) / 2.0)
        channels.append(_filled(normal, np.asarray(normal.any(-1))) * np.float32(unit / chord))
    return np.concatenate(channels, -1).astype(np.float32) if channels else None


def _filled(values: np.ndarray, known: Bool[np.ndarray, "h w"]) -> np.ndarray:
    """values (H, W, ...) with the unknown pixels as the nearest known one."""
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.asarray(nearest, np.int64)
    table = np.zeros(int(nearest.max()) + 1, np.int64)
    table[nearest[known]] = np.flatnonzero(known)
    return values.reshape(known.size, -1)[table[nearest.reshape(-1)]].reshape(values.shape)
