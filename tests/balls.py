"""A small world that several test files look at: three balls on a disc, seen from a ring of cameras."""

import functools

import numpy as np
from conftest import cameras_of, gaussians_at, look_at

WIDTH, HEIGHT, VIEWS = 96, 72, 24
COLOURS = np.asarray([(150, 150, 150), (200, 40, 40), (40, 90, 200), (60, 160, 60)], np.uint8)


def sphere(rng, centre, radius, count):
    points = rng.normal(size=(count, 3))
    return np.asarray(centre) + radius * points / np.linalg.norm(points, axis=1, keepdims=True)


@functools.cache
def ring_of_balls():
    """Three balls on a disc (their Gaussians lie inside, so that what is rendered ends at the outline), seen
    from a ring of 24 cameras; one hides another in some views. Labels by ray casting.

    (gaussians, cameras, frames (T, H, W, 3), labels (T, H, W), proposals: a list of masks (4, H, W) a frame)."""
    rng = np.random.default_rng(0)
    balls = [((0.0, -0.3, 0.0), 0.3), ((0.75, -0.25, 0.1), 0.25), ((-0.5, -0.2, 0.6), 0.2)]
    turn, away = rng.uniform(0, 2 * np.pi, 2500), 1.6 * np.sqrt(rng.uniform(0, 1, 2500))
    floor = np.stack([away * np.cos(turn), np.zeros(2500), away * np.sin(turn)], -1)
    points = np.concatenate([floor, *(sphere(rng, centre, 0.92 * radius, 1500) for centre, radius in balls)])
    scales = np.concatenate([np.full(2500, 0.035), *(np.full(1500, 0.055 * radius) for _, radius in balls)])
    gaussians = gaussians_at(points, scales[:, None])
    centres = [(2.2 * np.sin(a), -1.0, -2.2 * np.cos(a)) for a in 2 * np.pi * np.arange(VIEWS) / VIEWS]
    poses = np.stack([look_at(centre, (0.0, -0.2, 0.0)) for centre in centres])
    cameras = cameras_of(poses, (90, 90, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)
    x, y = np.meshgrid((np.arange(WIDTH) + 0.5 - WIDTH / 2) / 90, (np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / 90)
    truth = np.zeros((VIEWS, HEIGHT, WIDTH), np.int16)
    for t, (pose, origin) in enumerate(zip(poses.astype(np.float64), centres)):
        rays = np.stack([x, y, np.ones_like(x)], -1) @ pose[:3, :3]
        nearest = np.full(x.shape, np.inf)
        for label, (centre, radius) in enumerate(balls, 1):
            offset = np.asarray(origin) - centre
            a, b, c = (rays**2).sum(-1), (rays * offset).sum(-1), (offset**2).sum() - radius**2
            root = b * b - a * c
            depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
            truth[t][depth < nearest] = label
            nearest = np.minimum(nearest, depth)
    frames = COLOURS[truth]
    proposals = [image[None] == np.arange(4)[:, None, None] for image in truth]
    return gaussians, cameras, frames, truth, proposals


def ious(labels, truth, number):
    """(T, B) IoU of label b with the true label b + 1; nan where that is not seen."""
    result = np.full((len(truth), number), np.nan)
    for t, b in np.ndindex(result.shape):
        true, found = truth[t] == b + 1, labels[t] == b
        if true.sum() >= 20:
            result[t, b] = (true & found).sum() / (true | found).sum()
    return result
