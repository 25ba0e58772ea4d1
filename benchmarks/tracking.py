"""Masks brought together over many frames without weights: peak memory and time a frame.

    python benchmarks/tracking.py [--frames 300] [--way tracking|consensus] [--width 988] [--height 731] [--side 10]

The scene: SIDE x SIDE balls on a floor, each of its own colour, seen from a ring of views above them; its Gaussians
lie on the surfaces. Each frame proposes its true masks: as many masklets as balls, and the floor. They are followed
through the Gaussians by Algorithm 1 (`tracking`, the default tracker), or associated by what the views agree on
(`consensus`, the default of a run). Prints one line: the process's peak memory with the frames in it, seconds a frame
of the views' votes and of the rest, and of OpenCV's segmentation of such a frame, which would come before.
"""

import argparse
import time

import numpy as np

from jsecon.process import peak_memory_mib

RADIUS = 0.45
"""of a ball, in units of the distance between two"""


def camera_poses(count: int, side: int) -> np.ndarray:
    """(T, 4, 4) world-to-camera of a ring of views that all see every ball."""
    poses = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2 * np.pi, count, endpoint=False)):
        eye = side * np.array([0.3 * np.cos(angle), 0.3 * np.sin(angle), 1.6])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[:3, 3] = -pose[:3, :3] @ eye
    return poses


def surfaces(side: int, per_ball: int = 400, per_cell: int = 100) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres (B, 3), and points (P, 3) on the balls and the floor with their owner (P,), B = the floor."""
    grid = np.arange(side) - (side - 1) / 2
    centres = np.stack([*np.meshgrid(grid, grid), np.full((side, side), RADIUS)], -1).reshape(-1, 3)
    turns = np.arange(per_ball) + 0.5
    height = 1 - 2 * turns / per_ball
    around = np.sqrt(1 - height**2)
    sphere = np.stack([around * np.cos(2.39996 * turns), around * np.sin(2.39996 * turns), height], 1)
    floor = (np.random.default_rng(0).random((per_cell * (side + 2) ** 2, 2)) - 0.5) * (side + 2)
    points = [centres[:, None] + RADIUS * sphere, np.concatenate([floor, np.zeros((len(floor), 1))], 1)]
    owners = np.append(np.repeat(np.arange(side**2), per_ball), np.full(len(floor), side**2))
    return centres, np.concatenate([points[0].reshape(-1, 3), points[1]]), owners


def draw(pose: np.ndarray, focal: float, size: tuple[int, int], centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) int16 owner of each pixel and (H, W) float32 brightness: rays against balls before a floor."""
    height, width = size
    labels, light = np.full(size, len(centres), np.int16), np.full(size, 0.55, np.float32)
    nearest = np.full(size, np.inf, np.float32)
    seen = centres @ pose[:3, :3].T + pose[:3, 3]
    for number, (x, y, z) in enumerate(seen):
        reach = 1.3 * focal * RADIUS / z + 2
        column, row = focal * x / z + width / 2, focal * y / z + height / 2
        top, bottom = int(max(row - reach, 0)), int(min(row + reach, height))
        left, right = int(max(column - reach, 0)), int(min(column + reach, width))
        v, u = np.mgrid[top:bottom, left:right].astype(np.float32)
        rays = np.stack([(u + 0.5 - width / 2) / focal, (v + 0.5 - height / 2) / focal, np.ones_like(u)], -1)
        square = (rays**2).sum(-1)
        along = rays @ np.array([x, y, z], np.float32)
        root = along**2 - square * np.float32(x * x + y * y + z * z - RADIUS**2)
        depth = (along - np.sqrt(np.maximum(root, 0))) / square
        window = np.s_[top:bottom, left:right]
        hit = (root > 0) & (depth < nearest[window])
        nearest[window][hit], labels[window][hit] = depth[hit], number
        light[window][hit] = (0.35 + 0.65 * np.sqrt(np.maximum(root, 0)) / (np.sqrt(square) * RADIUS))[hit]
    return labels, light


def main() -> None:
    """Prints one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--way", choices=("tracking", "consensus"), default="tracking")
    for name, default in (("frames", 300), ("width", 988), ("height", 731), ("side", 10)):
        parser.add_argument(f"--{name}", type=int, default=default)
    asked = parser.parse_args()

    from jsecon.process import prepare_process

    prepare_process()
    import jax.numpy as jnp

    from jsecon.association.consensus import track_masks
    from jsecon.paper.algorithm1 import masklets
    from jsecon.paper.tracker import GeometricTracker
    from jsecon.splat.points import gaussians_from_points
    from jsecon.types import Camera
    from jsecon.vision.classical import ClassicalSegmenter

    size, count = (asked.height, asked.width), asked.side**2
    poses, focal = camera_poses(asked.frames, asked.side), 1.0 * asked.height
    centres, points, owners = surfaces(asked.side)
    palette = np.random.default_rng(1).integers(40, 255, (count + 1, 3)).astype(np.float32)
    frames = np.empty((asked.frames, *size, 3), np.uint8)
    for frame, pose in zip(frames, poses):
        owner, light = draw(pose, focal, size, centres)
        frame[:] = palette[owner] * np.minimum(light, 1)[..., None]
    gaussians = gaussians_from_points(points, palette[owners].astype(np.uint8), opacity=0.9, scale=0.7)
    lens = [np.full(asked.frames, number, np.float32) for number in (focal, focal, size[1] / 2, size[0] / 2)]
    cameras = Camera(jnp.asarray(poses), *map(jnp.asarray, lens), width=size[1], height=size[0])

    def proposals(t: int) -> np.ndarray:
        return draw(poses[t], focal, size, centres)[0] == np.arange(count + 1)[:, None, None]

    tracker = GeometricTracker(gaussians, cameras, proposals)
    start = time.perf_counter()
    tracker.views.all(frames)
    seeing = time.perf_counter() - start
    start = time.perf_counter()
    if asked.way == "tracking":
        labels = masklets(frames, lambda frame, t: proposals(t), tracker)
    else:
        labels = track_masks(frames, tracker.views).labels
    rest = time.perf_counter() - start
    peak = peak_memory_mib() / 1024
    shared = np.zeros((count + 1, int(labels.max()) + 2), np.int64)
    for pose, image in zip(poses, labels):
        pairs = np.ravel_multi_index((draw(pose, focal, size, centres)[0], image + 1), shared.shape)
        shared += np.bincount(pairs.ravel(), minlength=shared.size).reshape(shared.shape)
    held = (shared[:count, 1:].max(1) / shared[:count].sum(1)).mean()
    start = time.perf_counter()
    ClassicalSegmenter()(frames[0], 0)
    cut = time.perf_counter() - start
    print(
        f"{asked.way}: {asked.frames} frames of {size[1]}x{size[0]}, {gaussians.count} Gaussians, "
        f"{len(np.unique(labels[labels >= 0]))} masklets that hold {held:.1%} of the {count} balls: "
        f"peak {peak:.2f} GiB; s a frame: votes {seeing / asked.frames:.2f}, {asked.way} {rest / asked.frames:.2f}, "
        f"OpenCV's segmentation {cut:.2f}"
    )


if __name__ == "__main__":
    main()
