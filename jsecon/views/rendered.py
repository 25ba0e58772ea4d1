"""A capture of renders: the frames of a scene without photographs."""

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.splat.render import render_rgb
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Camera, Capture, Gaussians, UpAxis


def render_capture(
    gaussians: Gaussians,
    cameras: Camera,
    names: tuple[str, ...],
    source_from_scene: np.ndarray,
    *,
    notes: tuple[str, ...] = (),
    up: UpAxis | None = None,
) -> Capture:
    """Renders a bare scene as the frames of a capture, none of them held out.

    Args:
      gaussians: Scene in the capture's world.
      cameras: Batch of T cameras, in the capture's world.
      names: T names of the frames.
      source_from_scene: (4, 4) similarity from that world to the file's.
      notes: What the user should know, a sentence each.
      up: Which way is up in the capture's world, if the planner of the views knows.
    """
    scene = jax.tree.map(jnp.asarray, gaussians)
    background = _background(scene, cameras[0])
    frames = np.empty((len(cameras), cameras.height, cameras.width, 3), np.uint8)
    for frame, camera in zip(frames, cameras):
        image = np.asarray(render_rgb(scene, camera, background=background).features)
        frame[:] = np.round(255 * np.clip(image, 0, 1))
    return Capture(
        frames=frames,
        cameras=cameras,
        points=np.zeros((0, 3), np.float32),
        point_colors=np.zeros((0, 3), np.uint8),
        held_out=np.zeros(len(frames), bool),
        depths=None,
        source_from_scene=source_from_scene,
        names=names,
        notes=notes,
        up=up,
    )


def _background(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """(3,) the grey that is farthest from the scene's colours: a black object would vanish before black."""
    colours = np.clip(np.asarray(colours_from_sh(gaussians, camera)), 0, 1)
    opacity = 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits, np.float64)))
    colours = colours[opacity >= 0.5] if (opacity >= 0.5).any() else colours
    greys = (0.0, 1.0, 0.5)  # the usual one first
    distances = [float(np.quantile(np.abs(colours - grey).max(1), 0.05)) for grey in greys]
    best = greys[int(np.argmax(distances))] if distances[0] < 0.1 else greys[0]
    return np.full(3, best, np.float32)
