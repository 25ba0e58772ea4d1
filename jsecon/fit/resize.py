"""Cameras, frames and masks at another image size. Host code (NumPy)."""

import dataclasses

import cv2
import numpy as np

from jsecon.types import Camera, Capture


def resize_camera(camera: Camera, width: int, height: int) -> Camera:
    """Changes the image size of one camera or a batch; the field of view stays."""
    x, y = np.float32(width / camera.width), np.float32(height / camera.height)
    return dataclasses.replace(
        camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y, width=width, height=height
    )


def scale_cameras(cameras: Camera, scale: float) -> Camera:
    """Multiplies the image size of one camera or a batch, rounded to whole px."""
    return resize_camera(cameras, max(round(cameras.width * scale), 1), max(round(cameras.height * scale), 1))


def shrink_cameras(cameras: Camera, long_side: int) -> Camera:
    """Limits the longer side of one camera or a batch to `long_side` px."""
    return scale_cameras(cameras, min(1.0, long_side / max(cameras.width, cameras.height)))


def resize_frame(frame: np.ndarray, cameras: Camera) -> np.ndarray:
    """Resizes a frame (h, w, 3) uint8 to the image size of cameras by area averaging; of that size, it is returned."""
    if frame.shape[:2] == (cameras.height, cameras.width):
        return np.asarray(frame)
    return cv2.resize(np.asarray(frame), (cameras.width, cameras.height), interpolation=cv2.INTER_AREA)


def resize_mask(mask: np.ndarray, cameras: Camera) -> np.ndarray:
    """Resizes a mask (h, w) bool to the image size of cameras; a pixel is set if any pixel that it covers is."""
    if mask.shape == (cameras.height, cameras.width):
        return np.asarray(mask)
    size = cameras.width, cameras.height
    return cv2.resize(np.asarray(mask, np.float32), size, interpolation=cv2.INTER_AREA) > 0


def resize_capture(capture: Capture, cameras: Camera) -> Capture:
    """Brings the images of a capture to the size of cameras, which take the place of its own."""
    size = cameras.width, cameras.height
    depths, ignored = capture.depths, capture.ignored
    if depths is not None:
        depths = [cv2.resize(np.asarray(z, np.float32), size, interpolation=cv2.INTER_NEAREST) for z in depths]
        depths = np.stack(depths)
    if ignored is not None:
        ignored = np.stack([resize_mask(np.asarray(mask), cameras) for mask in ignored])
    frames = np.stack([resize_frame(np.asarray(frame), cameras) for frame in capture.frames])
    return dataclasses.replace(capture, frames=frames, cameras=cameras, depths=depths, ignored=ignored)
