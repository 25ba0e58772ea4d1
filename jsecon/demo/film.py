"""A short film of a field: once around the scene, in which the answers to texts light up one after the other."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from jsecon.app.ask import Answer
from jsecon.app.pictures import Renderer
from jsecon.demo.capture import look_at
from jsecon.files import atomic_write
from jsecon.fit.schedule import resize_cameras
from jsecon.splat.sh import C0
from jsecon.types import Camera, LanguageField

SECONDS, PER_SECOND = 15, 8
WIDE_GAP = np.radians(60)
"""between two neighbouring cameras, seen from what they look at: from there on nobody has been behind the scene"""
DIM, SHINE = 0.35, 0.12
"""what is left of the grey of what no text has lit, and the part of white in what one has"""
FAR = 0.75
"""part of the cameras that stand nearer"""
PARALLEL = 1e-6
"""part of a length below which what is left of it across a direction is rounding"""
STEEPEST = 0.1
"""radius of the way by its height over what it looks at, at least: from straight above nothing is upright"""
WIDE, QUALITY = 480, 70
"""px of its longer side, at most twice that of the frames"""


def write_film(field: LanguageField, answers: Sequence[Answer], file: Path) -> int:
    """Writes the film as an animated WebP of SECONDS; returns its bytes."""
    count = SECONDS * PER_SECOND
    around, long = orbit(field.cameras, count), max(field.cameras.width, field.cameras.height)
    renderer = Renderer(field.gaussians, resize_cameras(around, min(WIDE / long, 2.0)))
    own = np.clip(0.5 + C0 * np.asarray(field.gaussians.sh, np.float32)[:, 0], 0, 1)
    dark = np.repeat(DIM * own.mean(1, keepdims=True), 3, axis=1)
    frames, every = [], count / (len(answers) + 1)
    for t in range(count):
        began = t / every - 1  # answers lit so far
        rgb = own + min(t / every, 1.0) * (dark - own)
        for n, answer in enumerate(answers):
            lit, bright = min(max(2 * (began - n), 0.0), 1.0), SHINE + (1 - SHINE) * own[answer.mask]
            rgb[answer.mask] += lit * (bright - rgb[answer.mask])
        image, latest = renderer.colours(t, rgb), int(np.floor(began))
        if 0 <= latest < len(answers):
            image = _captioned(image, answers[latest].question)
        frames.append(Image.fromarray(image))
    first, *rest = frames
    how = {"duration": 1000 // PER_SECOND, "loop": 0, "quality": QUALITY, "method": 2}
    with atomic_write(file) as temporary:
        first.save(temporary, format="WEBP", save_all=True, append_images=rest, **how)
    return file.stat().st_size


def _captioned(image: np.ndarray, text: str) -> np.ndarray:
    image, at = np.ascontiguousarray(image), (10, image.shape[0] - 14)
    for grey, thickness in ((0, 4), (255, 1)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.7, (grey,) * 3, thickness, cv2.LINE_AA)
    return image


def orbit(cameras: Camera, count: int) -> Camera:
    """`count` cameras around the point that the given ones look at, farther from it than most of them, at their middle
    height: a whole turn where they stand on all sides of it, else there and back along their arc."""
    poses = np.asarray(cameras.world_to_camera, np.float64)
    eyes, forward = -np.einsum("tij,ti->tj", poses[:, :3, :3], poses[:, :3, 3]), poses[:, 2, :3]
    up = -poses[:, 1, :3].mean(0)
    if np.linalg.norm(up) < PARALLEL:  # the cameras are rolled all ways
        up = -poses[0, 1, :3]
    up /= np.linalg.norm(up)
    across = np.eye(3) - forward[:, :, None] * forward[:, None]
    target = np.linalg.lstsq(across.sum(0), (across @ eyes[..., None]).sum(0)[:, 0])[0]
    away = eyes - target
    lift = away @ up
    flat = away - lift[:, None] * up
    radii = np.linalg.norm(flat, axis=1)
    # Cameras on the axis stand at no angle around it.
    aside = flat[radii > PARALLEL * np.linalg.norm(away, axis=1)]
    if not len(aside):
        aside = np.eye(3)[[np.abs(up).argmin()]]
        aside = aside - (aside @ up)[:, None] * up
    first = aside[0] / np.linalg.norm(aside[0])
    second = np.cross(up, first)
    angles = np.sort(np.arctan2(aside @ second, aside @ first))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest, part = int(gaps.argmax()), np.arange(count) / count
    if gaps[widest] > WIDE_GAP:
        part = (2 * np.pi - gaps[widest]) / (2 * np.pi) * (0.5 - 0.5 * np.cos(2 * np.pi * part))
    turn = angles[(widest + 1) % len(angles)] + 2 * np.pi * part
    out = np.cos(turn)[:, None] * first + np.sin(turn)[:, None] * second
    radius, height = np.quantile(radii, FAR), np.median(lift)
    radius = max(radius, STEEPEST * abs(height)) or 1.0  # cameras that look around from one place have no distance
    places = target + radius * out + height * up
    placed = np.stack([look_at(eye, target, up) for eye in places])
    lens = (np.full(count, np.asarray(a)[0], np.float32) for a in (cameras.fx, cameras.fy, cameras.cx, cameras.cy))
    return Camera(placed, *lens, width=cameras.width, height=cameras.height)
