"""What is rendered to be timed: a made-up ball of Gaussians, and the reference scene beside the checkout."""

from pathlib import Path

import numpy as np

from jsecon.types import Camera, Gaussians

GARDEN = Path(__file__).resolve().parent.parent.parent / "shared" / "splats" / "garden"


def ball(
    count: int, sizes: tuple[float, float], width: int, height: int, focal: float, *, seed: int = 0
) -> tuple[Gaussians, Camera]:
    """Gaussians in a ball before a camera, standard deviations of `sizes`, turns and opacities at random."""
    rng = np.random.default_rng(seed)
    gaussians = Gaussians(
        rng.normal(size=(count, 3)).astype(np.float32),
        np.log(rng.uniform(*sizes, (count, 3))).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(size=count).astype(np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = 4
    return gaussians, Camera(pose, *(np.float32(v) for v in (focal, focal, width / 2, height / 2)), width, height)


def garden(folder: Path = GARDEN) -> tuple[Gaussians, Camera, np.ndarray] | None:
    """The scene, its view 0 and its colours (N, 3), or None where it is not at hand."""
    if not (folder / "scene.npz").exists():
        return None
    d = np.load(folder / "scene.npz")
    opacity, k = d["opacities"].astype(np.float64), d["Ks"][0].astype(np.float32)
    gaussians = Gaussians(
        d["means"].astype(np.float32),
        np.log(d["scales"]).astype(np.float32),
        d["quats"].astype(np.float32),
        (np.log(opacity) - np.log1p(-opacity)).astype(np.float32),
        np.zeros((len(opacity), 1, 3), np.float32),
    )
    numbers = (k[0, 0], k[1, 1], k[0, 2], k[1, 2], int(d["width"]), int(d["height"]))
    return gaussians, Camera(d["viewmats"][0].astype(np.float32), *numbers), d["colors"].astype(np.float32)
