"""A capture of renders: the frames of a bare scene, seen from planned views."""

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.splat.render import render_rgb
from jsecon.splat.sh import colours_from_sh
from jsecon.types import Camera, Capture, Gaussians, Progress
from jsecon.views.plan import place_cameras

BACKGROUNDS = (0.0, 1.0, 0.5)
"""grey values that may lie behind a scene, the usual one first"""


def render_capture(
    gaussians: Gaussians,
    source_from_scene: np.ndarray,
    *,
    views: int = 24,
    width: int = 400,
    height: int = 300,
    up: np.ndarray | None = None,
    progress: Progress | None = None,
) -> Capture:
    """Plans views of a bare scene and renders them as the frames of a capture.

    Args:
      gaussians: Scene of N Gaussians, in the capture's world.
      source_from_scene: (4, 4) similarity from that world to the file's.
      views: T, number of views.
      width: Width of the frames, px.
      height: Height of the frames, px.
      up: (3,) up axis; None takes it from the scene.
      progress: Called as progress(done, total).

    Returns:
      The capture, no frame of it held out.

    Raises:
      InputError: The scene cannot be judged.
    """
    planned = place_cameras(gaussians, views=views, width=width, height=height, up=up, progress=progress)
    names = tuple(f"view_{index:03d}" for index in range(len(planned.cameras)))
    return capture_from_cameras(gaussians, planned.cameras, names, source_from_scene, notes=(f"{planned.describe()}.",))


def capture_from_cameras(
    gaussians: Gaussians,
    cameras: Camera,
    names: tuple[str, ...],
    source_from_scene: np.ndarray,
    *,
    notes: tuple[str, ...] = (),
) -> Capture:
    """Renders a bare scene as the frames of a capture.

    Args:
      gaussians: Scene of N Gaussians, in the capture's world.
      cameras: Batch of T cameras, in the capture's world.
      names: T names of the frames.
      source_from_scene: (4, 4) similarity from that world to the file's.
      notes: What the user should know, a sentence each.

    Returns:
      The capture, no frame of it held out.
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
    )


def _background(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """(3,) the grey that is farthest from the scene's colours: a black object would vanish before black."""
    colours = np.clip(np.asarray(colours_from_sh(gaussians, camera)), 0, 1)
    opacity = 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits, np.float64)))
    colours = colours[opacity >= 0.5] if (opacity >= 0.5).any() else colours
    distances = [float(np.quantile(np.abs(colours - grey).max(1), 0.05)) for grey in BACKGROUNDS]
    best = BACKGROUNDS[int(np.argmax(distances))] if distances[0] < 0.1 else BACKGROUNDS[0]
    return np.full(3, best, np.float32)
