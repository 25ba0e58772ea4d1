"""Image quality of a scene: PSNR and SSIM of its renderings against the photographs. Host code."""

from collections.abc import Iterator, Sequence

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.fit.photometric import C1, C2, SSIM_WINDOW, psnr
from jsecon.fit.resize import resize_frame, resize_mask, shrink_cameras
from jsecon.parallel import map_over_processes
from jsecon.splat.render import render_rgb
from jsecon.types import Capture, Gaussians, Progress, Quality

QUICK_LONG_SIDE = 400
"""Longer side in px at which weak frames are looked for: a thousand large frames would take half an hour."""
MIN_COUNTED_SHARE = 0.01
"""Least share of the pixels of a frame that must count: fewer measure nothing."""


def _compare(
    image: Float[np.ndarray, "h w 3"], frame: UInt8[np.ndarray, "h w 3"], counted: Bool[np.ndarray, "h w"]
) -> tuple[float, float]:
    """PSNR over the counted pixels, and the mean SSIM over their windows, with the rendering in place of the others."""
    image = np.clip(image, 0, 1)
    target = np.where(counted[..., None], frame.astype(np.float32) / 255, image)
    similarity = ssim_map(image, target)[counted].mean(dtype=np.float64)
    return float(psnr(image[counted], target[counted])), float(similarity)


def ssim_map(image: Float[np.ndarray, "h w c"], target: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "h w c"]:
    """Computes the structural similarity of each pixel and channel, in [-1, 1] (Wang 2004, eq. 13).

    OpenCV blurs: no program is compiled for a size.
    """
    products = image, target, image * image, target * target, image * target
    mean_i, mean_t, square_i, square_t, product = (
        cv2.sepFilter2D(each, -1, SSIM_WINDOW, SSIM_WINDOW, borderType=cv2.BORDER_CONSTANT) for each in products
    )
    variance_i, variance_t = square_i - mean_i * mean_i, square_t - mean_t * mean_t
    covariance = product - mean_i * mean_t
    numerator = (2 * mean_i * mean_t + C1) * (2 * covariance + C2)
    return numerator / ((mean_i * mean_i + mean_t * mean_t + C1) * (variance_i + variance_t + C2))


def measure_quality(
    gaussians: Gaussians,
    capture: Capture,
    *,
    frames: Int[np.ndarray, " f"] | None = None,
    long_side: int | None = None,
    background: Float[np.ndarray, " 3"] | None = None,
    progress: Progress | None = None,
) -> Quality:
    """Compares renderings, clamped to [0, 1], with photographs. Ignored pixels do not count.

    Over several processes (`jax.distributed`) the frames are divided, and all get the same result.

    Args:
      gaussians: Scene of N Gaussians.
      capture: Photographs and their cameras.
      frames: Indices of the frames to compare; by default the held-out frames.
      long_side: Longer side in px to which larger frames are shrunk first.
      background: (3,) colour in [0, 1] behind the scene; by default black.
      progress: Called with the number of frames done and of all.

    Returns:
      PSNR and SSIM of each frame; frames of which less than MIN_COUNTED_SHARE counts are skipped.
    """
    chosen = np.flatnonzero(capture.held_out) if frames is None else np.asarray(frames)
    gaussians, cameras = jax.device_put(gaussians), jax.tree.map(np.asarray, capture.cameras)
    if long_side is not None:
        cameras = shrink_cameras(cameras, long_side)

    def counted_pixels(t: int) -> np.ndarray:
        if capture.ignored is None:
            return np.ones((cameras.height, cameras.width), bool)
        return ~resize_mask(np.asarray(capture.ignored[t]), cameras)

    chosen = np.array([t for t in chosen.tolist() if counted_pixels(t).mean() >= MIN_COUNTED_SHARE], int)

    def compare(t: int) -> list[float]:
        image = np.asarray(render_rgb(gaussians, cameras[t], background=background).features)
        frame = resize_frame(np.asarray(capture.frames[t]), cameras)
        return list(_compare(image, frame, counted_pixels(t)))

    def rows(positions: Sequence[int]) -> Iterator[list[float]]:
        return map(compare, chosen[list(positions)].tolist())

    by_frame = np.array(map_over_processes(len(chosen), rows, progress)).reshape(-1, 2)
    return Quality(chosen, by_frame[:, 0], by_frame[:, 1])
