"""Cameras, frames and masks at another image size. Host code (NumPy)."""

import dataclasses

import cv2
import numpy as np

from jsecon.types import Camera


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Returns the same view, or batch of views, at another image size in px."""
    x, y = np.float32(width / camera.width), np.float32(height / camera.height)
    return dataclasses.replace(
        camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y, width=width, height=height
    )


def scale_cameras(cameras: Camera, scale: float) -> Camera:
    """Returns cameras whose images are `scale` times as large, rounded to whole px."""
    return resize_camera(cameras, max(round(cameras.width * scale), 1), max(round(cameras.height * scale), 1))


def shrink_cameras(cameras: Camera, long_side: int) -> Camera:
    """Returns cameras whose images have a longer side of at most `long_side` px."""
    return scale_cameras(cameras, min(1.0, long_side / max(cameras.width, cameras.height)))


def resize_frame(frame: np.ndarray, cameras: Camera) -> np.ndarray:
    """Resizes a frame (h, w, 3) uint8 to the image size of `cameras` by area averaging."""
    if frame.shape[:2] == (cameras.height, cameras.width):
        return np.asarray(frame)
    return cv2.resize(np.asarray(frame), (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)


def resize_mask(mask: np.ndarray, cameras: Camera) -> np.ndarray:
    """Resizes a mask (h, w) bool to the image size of `cameras`; a pixel is set if any pixel it covers is."""
    size = cameras.width, cameras.height
    return cv2.resize(np.asarray(mask, np.float32), size, interpolation=cv2.INTER_AREA) > 0
