"""Cameras, frames and masks at another image size. Host code (NumPy)."""

import dataclasses

import cv2
import numpy as np

from jsecon.types import Camera


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Changes the image size of a view, or of a batch of views.

    Args:
      camera: One camera or a batch.
      width: New width, px.
      height: New height, px.

    Returns:
      Cameras with the same field of view.
    """
    x, y = np.float32(width / camera.width), np.float32(height / camera.height)
    return dataclasses.replace(
        camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y, width=width, height=height
    )


def scale_cameras(cameras: Camera, scale: float) -> Camera:
    """Scales the image size of cameras.

    Args:
      cameras: One camera or a batch.
      scale: Factor on width and height, which are rounded to whole px.

    Returns:
      Cameras with the same field of view.
    """
    return resize_camera(cameras, max(round(cameras.width * scale), 1), max(round(cameras.height * scale), 1))


def shrink_cameras(cameras: Camera, long_side: int) -> Camera:
    """Limits the image size of cameras.

    Args:
      cameras: One camera or a batch.
      long_side: Maximum length of the longer side, px.

    Returns:
      Cameras with the same field of view.
    """
    return scale_cameras(cameras, min(1.0, long_side / max(cameras.width, cameras.height)))


def resize_frame(frame: np.ndarray, cameras: Camera) -> np.ndarray:
    """Resizes a frame by area averaging.

    Args:
      frame: (h, w, 3) uint8.
      cameras: Cameras whose image size it gets.

    Returns:
      (H, W, 3) uint8; the frame itself if it has that size.
    """
    if frame.shape[:2] == (cameras.height, cameras.width):
        return np.asarray(frame)
    return cv2.resize(np.asarray(frame), (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)


def resize_mask(mask: np.ndarray, cameras: Camera) -> np.ndarray:
    """Resizes a mask; a pixel is set if any pixel that it covers is.

    Args:
      mask: (h, w) bool.
      cameras: Cameras whose image size it gets.

    Returns:
      (H, W) bool.
    """
    size = cameras.width, cameras.height
    return cv2.resize(np.asarray(mask, np.float32), size, interpolation=cv2.INTER_AREA) > 0
