"""Photographs of a made-up corner with textured boards, whose poses are known: enough for structure from motion."""

import cv2
import numpy as np
from conftest import look_at
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL = 320, 240, 290.0
# corner, edge, edge of each board, from the farthest to the nearest
BOARDS = (
    ((-4, -3, 5), (8, 0, 0), (0, 6, 0)),
    ((-4, 1.5, 5), (8, 0, 0), (0, 0, -4)),
    ((-1.6, -0.9, 3.6), (1.2, 0, 0.5), (0, 1.6, 0.2)),
    ((0.3, -0.4, 3.0), (1.1, 0, -0.4), (0, 1.5, 0.1)),
)
HALF = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts from the centre of the first pixel


def _texture(draw, size=512):
    layers = (draw.uniform(0, 1, (size // step, size // step, 3)).astype(np.float32) for step in (8, 16, 64))
    image = sum(cv2.resize(layer, (size, size), interpolation=cv2.INTER_CUBIC) for layer in layers)
    return np.clip(130 * image - 70, 0, 255).astype(np.uint8)


def photo_poses(count: int, spread: float = 0.7) -> np.ndarray:
    """(count, 4, 4) float64 world-to-camera on an arc of `spread` radians about the boards."""
    target, angles = np.array([0, 0, 3.6]), np.linspace(-spread / 2, spread / 2, count)
    away = [np.array([3.4 * np.sin(a), 0.25 * np.sin(7 * a) - 0.5, -3.4 * np.cos(a)]) for a in angles]
    return np.stack([look_at(target + offset, target, dtype=float) for offset in away])


def photo_images(poses: np.ndarray, boards=BOARDS) -> list[np.ndarray]:
    """What cameras of FOCAL px at `poses` see of boards, (HEIGHT, WIDTH, 3) uint8."""
    draw, images = np.random.default_rng(0), []
    textures = [_texture(draw) for _ in boards]
    lens = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    for pose in poses:
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for (corner, across, down), texture in zip(boards, textures):
            plane = np.stack([across, down, corner], axis=1).astype(float)
            to_pixels = lens @ (pose[:3, :3] @ plane + np.outer(pose[:3, 3], (0, 0, 1)))
            height, width = texture.shape[:2]
            warp = np.linalg.inv(HALF) @ to_pixels @ np.diag([1 / width, 1 / height, 1]) @ HALF
            seen = cv2.warpPerspective(np.full((height, width), 255, np.uint8), warp, (WIDTH, HEIGHT)) > 127
            image[seen] = cv2.warpPerspective(texture, warp, (WIDTH, HEIGHT))[seen]
        images.append(image)
    return images


def write_photos(folder, count: int, name: str = "photo {:02d}.png") -> np.ndarray:
    """Writes `count` of them to `folder`; their true poses."""
    folder.mkdir(parents=True)
    poses = photo_poses(count)
    for number, image in enumerate(photo_images(poses)):
        cv2.imwrite(str(folder / name.format(number)), image)
    return poses


def apart(found: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of poses (t, 4, 4) and the true ones, once a similarity has brought the camera centres together:
    distances as shares of the cameras' extent, and angles in degrees."""
    ours, theirs = (-np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3]) for poses in (found, true))
    a, b = ours - ours.mean(0), theirs - theirs.mean(0)
    turn = Rotation.align_vectors(b, a)[0].as_matrix()
    scale = (b * (a @ turn.T)).sum() / (a**2).sum()
    distances = np.linalg.norm(scale * a @ turn.T - b, axis=1) / np.linalg.norm(np.ptp(theirs, axis=0))
    between = np.einsum("tij,jk,tlk->til", found[:, :3, :3], turn.T, true[:, :3, :3])
    cosines = (np.trace(between, axis1=1, axis2=2) - 1) / 2
    return distances, np.degrees(np.arccos(np.clip(cosines, -1, 1)))
