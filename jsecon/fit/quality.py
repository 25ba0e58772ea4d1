"""How well a scene shows its photographs, frame by frame: PSNR and SSIM, and which frames stay far below the others."""

from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jsecon.fit.photometric import psnr, ssim
from jsecon.fit.schedule import resized, resized_frame
from jsecon.parallel import dealt_out
from jsecon.splat.render import render_rgb
from jsecon.types import Array, Capture, Gaussians, Quality

GLANCE = 400
"""px of the longer side that weak frames are looked for at: a thousand large ones would take half an hour"""
FAR_BELOW_DB = 5.0
"""below the median frame at least, for a frame to be called weak"""
SPREADS = 5.0
"""and so many times the median distance from it"""


@jax.jit
def _compared(image: Array, frame: UInt8[Array, "h w 3"]) -> tuple[Array, Array]:
    image, target = jnp.clip(image, 0, 1), frame.astype(jnp.float32) / 255.0
    return psnr(image, target), ssim(image, target)


def quality(
    gaussians: Gaussians,
    capture: Capture,
    *,
    frames: Int[np.ndarray, " f"] | None = None,
    long_side: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Quality:
    """PSNR and SSIM of `frames` (by default those held out) against the photographs; renderings clamped to [0, 1].
    `long_side`: px that larger frames are shrunk to first. Over several processes (`jax.distributed`) the frames are
    dealt out."""
    chosen = np.flatnonzero(capture.held_out) if frames is None else np.asarray(frames)
    gaussians, cameras = jax.device_put(gaussians), capture.cameras
    if long_side is not None:
        cameras = resized(cameras, min(1.0, long_side / max(cameras.width, cameras.height)))

    def rows(own: Sequence[int]) -> Iterator[list[float]]:
        for t in chosen[list(own)]:
            image = render_rgb(gaussians, cameras[int(t)]).features
            frame = resized_frame(np.asarray(capture.frames[t]), cameras)
            yield [float(value) for value in _compared(image, frame)]

    values = dealt_out(len(chosen), rows, progress)
    by_frame = np.array(values).reshape(-1, 2)
    return Quality(chosen, by_frame[:, 0], by_frame[:, 1])


def evaluate_psnr(
    gaussians: Gaussians, capture: Capture, *, progress: Callable[[int, int], None] | None = None
) -> Float[np.ndarray, " f"]:
    """PSNR (dB) of each held-out frame."""
    return np.asarray(quality(gaussians, capture, progress=progress).psnr)


def weak(psnr: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """(F,) bool: frames so far below the median that the scene does not explain them: a wrong pose, something that
    moved, a finger before the lens."""
    if not len(psnr):
        return np.zeros(0, bool)
    below = np.median(psnr) - np.asarray(psnr)
    return below > max(FAR_BELOW_DB, SPREADS * float(np.median(np.abs(below))))
