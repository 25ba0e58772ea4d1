"""How well a scene shows its photographs, frame by frame: PSNR and SSIM, and which frames stay far below the others."""

from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.fit.photometric import psnr, ssim_map
from jsecon.fit.schedule import resize_cameras, resize_frame, resize_mask
from jsecon.parallel import map_over_processes
from jsecon.splat.render import render_rgb
from jsecon.types import Array, Capture, Gaussians, Quality

QUICK_LONG_SIDE = 400
"""px of the longer side that weak frames are looked for at: a thousand large ones would take half an hour"""
FAR_BELOW_DB = 5.0
"""below the median frame at least, for a frame to be called weak"""
SPREADS = 5.0
"""and so many times the median distance from it"""


@jax.jit
def _compare(image: Array, frame: UInt8[Array, "h w 3"], counted: Bool[Array, "h w"]) -> tuple[Array, Array]:
    """PSNR over the counted pixels, and the mean SSIM with the frame as rendered elsewhere."""
    image, target = jnp.clip(image, 0, 1), frame.astype(jnp.float32) / 255.0
    target = jnp.where(counted[..., None], target, image)
    share = jnp.mean(counted.astype(image.dtype))
    similarity = 1 - jnp.sum((1 - ssim_map(image, target)) * counted[..., None]) / (share * image.size)
    return psnr(image, target) + 10 * jnp.log10(share), similarity


def measure_quality(
    gaussians: Gaussians,
    capture: Capture,
    *,
    frames: Int[np.ndarray, " f"] | None = None,
    long_side: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Quality:
    """Compares renderings, clamped to [0, 1], with photographs. Pixels that the capture ignores do not count.

    Args:
      gaussians: Scene of N Gaussians.
      capture: Photographs and their cameras.
      frames: Indices of the frames to compare; by default those held out.
      long_side: Longer side that larger frames are shrunk to first, px.
      progress: Called with the number of frames done and of all.

    Returns:
      PSNR and SSIM of each frame; frames that are ignored whole are left out. Over several processes
      (`jax.distributed`) the frames are shared out, and all get the same result.
    """
    chosen = np.flatnonzero(capture.held_out) if frames is None else np.asarray(frames)
    if capture.ignored is not None:
        chosen = np.array([t for t in chosen if not np.all(capture.ignored[t])], int)
    gaussians, cameras = jax.device_put(gaussians), capture.cameras
    if long_side is not None:
        cameras = resize_cameras(cameras, min(1.0, long_side / max(cameras.width, cameras.height)))

    def rows(own: Sequence[int]) -> Iterator[list[float]]:
        for t in chosen[list(own)]:
            image = render_rgb(gaussians, cameras[int(t)]).features
            frame = resize_frame(np.asarray(capture.frames[t]), cameras)
            counted = np.ones(frame.shape[:2], bool)
            if capture.ignored is not None:
                counted = ~resize_mask(np.asarray(capture.ignored[t]), cameras)
            yield [float(value) for value in _compare(image, frame, counted)]

    values = map_over_processes(len(chosen), rows, progress)
    by_frame = np.array(values).reshape(-1, 2)
    return Quality(chosen, by_frame[:, 0], by_frame[:, 1])


def evaluate_psnr(
    gaussians: Gaussians, capture: Capture, *, progress: Callable[[int, int], None] | None = None
) -> Float[np.ndarray, " f"]:
    """PSNR (dB) of each held-out frame."""
    return np.asarray(measure_quality(gaussians, capture, progress=progress).psnr)


def is_weak(psnr: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """(F,) bool: frames so far below the median that the scene does not explain them: a wrong pose, something that
    moved, a finger before the lens."""
    if not len(psnr):
        return np.zeros(0, bool)
    below = np.median(psnr) - np.asarray(psnr)
    return below > max(FAR_BELOW_DB, SPREADS * float(np.median(np.abs(below))))
