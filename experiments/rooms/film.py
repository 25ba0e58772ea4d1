"""A short film of a field: one turn around the scene in which the answers to texts light up one after the other."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import jax
import numpy as np
from PIL import Image

from experiments.rooms.capture import look_at
from jsecon.app.pictures import render_picture
from jsecon.app.records import Answer
from jsecon.files import atomic_write
from jsecon.fit.resize import scale_cameras
from jsecon.splat.sh import C0
from jsecon.types import Camera, LanguageField

SECONDS = 15
"""Length of the film, s."""
FRAMES_PER_SECOND = 8
"""Frame rate of the film, Hz."""
DIM = 0.35
"""Share of grey that remains of Gaussians that no text has lit."""
SHINE = 0.12
"""Share of white in Gaussians that a text lights."""
DISTANCE_QUANTILE = 0.75
"""Share of the cameras that stand nearer to the scene than the film's."""
LONG_SIDE_PX = 480
"""Longer side of the film, at most twice that of the frames, px."""
WEBP_QUALITY = 70
"""Quality of the WebP, 0 to 100."""


def write_film(field: LanguageField, answers: Sequence[Answer], file: Path) -> int:
    """Writes the film as an animated WebP.

    Args:
      field: The field, whose cameras stand around its scene.
      answers: Answers in the order in which they light up.
      file: Where to write.

    Returns:
      Size of the file, bytes.
    """
    count = SECONDS * FRAMES_PER_SECOND
    long_side = max(field.cameras.width, field.cameras.height)
    cameras = scale_cameras(orbit(field.cameras, count), min(LONG_SIDE_PX / long_side, 2.0))
    gaussians = jax.device_put(field.gaussians)
    colours = np.clip(0.5 + C0 * np.asarray(field.gaussians.sh, np.float32)[:, 0], 0, 1)
    dark = np.repeat(DIM * colours.mean(1, keepdims=True), 3, axis=1)
    frames_per_answer = count / (len(answers) + 1)
    frames = []
    for t in range(count):
        lit_answers = t / frames_per_answer - 1
        rgb = colours + min(t / frames_per_answer, 1.0) * (dark - colours)
        for n, answer in enumerate(answers):
            lit = min(max(2 * (lit_answers - n), 0.0), 1.0)
            bright = SHINE + (1 - SHINE) * colours[answer.mask]
            rgb[answer.mask] += lit * (bright - rgb[answer.mask])
        image, latest = render_picture(gaussians, cameras[t], rgb), int(np.floor(lit_answers))
        if 0 <= latest < len(answers):
            image = _captioned(image, str(answers[latest].query))
        frames.append(Image.fromarray(image))
    first, *rest = frames
    options = {"duration": 1000 // FRAMES_PER_SECOND, "loop": 0, "quality": WEBP_QUALITY, "method": 2}
    with atomic_write(file) as temporary:
        first.save(temporary, format="WEBP", save_all=True, append_images=rest, **options)
    return file.stat().st_size


def _captioned(image: np.ndarray, text: str) -> np.ndarray:
    """The image with a text in its lower left corner."""
    image, at = np.ascontiguousarray(image), (10, image.shape[0] - 14)
    for grey, thickness in ((0, 4), (255, 1)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, (grey,) * 3, thickness, cv2.LINE_AA)
    return image


def orbit(cameras: Camera, count: int) -> Camera:
    """Cameras on one turn around the point that a ring of cameras looks at.

    Args:
      cameras: Cameras that stand around a scene.
      count: Number of cameras T of the turn.

    Returns:
      T cameras at the median height of the ring, farther from the scene than most of its cameras.
    """
    poses = np.asarray(cameras.world_to_camera, np.float64)
    centres = -np.einsum("tij,ti->tj", poses[:, :3, :3], poses[:, :3, 3])
    forward = poses[:, 2, :3]
    up = -poses[:, 1, :3].mean(0)
    up /= np.linalg.norm(up)
    across = np.eye(3) - forward[:, :, None] * forward[:, None]
    target = np.linalg.lstsq(across.sum(0), (across @ centres[..., None]).sum(0)[:, 0])[0]
    offsets = centres - target
    heights = offsets @ up
    horizontal = offsets - heights[:, None] * up
    first = horizontal[0] / np.linalg.norm(horizontal[0])
    second = np.cross(up, first)
    angles = np.sort(np.arctan2(horizontal @ second, horizontal @ first))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    start = angles[(int(gaps.argmax()) + 1) % len(angles)]
    turn = start + 2 * np.pi * np.arange(count) / count
    radius = np.quantile(np.linalg.norm(horizontal, axis=1), DISTANCE_QUANTILE)
    directions = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    turned = np.stack([look_at(c, target, up) for c in target + radius * directions + np.median(heights) * up])
    lens = (np.full(count, np.asarray(a)[0], np.float32) for a in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
    return Camera(turned, *lens, width=cameras.width, height=cameras.height)
