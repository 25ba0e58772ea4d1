"""Gaussians of a file in the world of a capture: the file does not state its world, so rendered frames decide it."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.data.coordinates import transform_poses
from jsecon.data.gaussians.files import read_gaussians
from jsecon.data.gaussians.ply import MAX_READ_ROUNDING
from jsecon.errors import InputError
from jsecon.fit.worlds import photo_similarity, training_worlds
from jsecon.pipeline.progress import Progress
from jsecon.pipeline.results import WARNING
from jsecon.splat.project import project
from jsecon.splat.transform import transform_gaussians_float64
from jsecon.types import Camera, Capture, Gaussians

MIN_LEAD = 0.05
"""correlation with the frames by which a less likely world must exceed a likelier one"""
ROUGH_CORRELATION = 0.6
"""correlation with the frames below which a note says more: a fitted scene has 0.97 in its world, 0.56 a tenth of a
metre beside it, 0.39 when turned by 20 degrees, and a crude one 0.81 in its world"""
MIN_OVERLAP = 0.01
"""share of the Gaussians that at least two views must see"""


def read_scene(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a file of Gaussians.

    Returns:
      The Gaussians (NumPy), and the notes of the reader.

    Raises:
      InputError: The file cannot be read, or holds no Gaussians.
    """
    scene, notes = read_gaussians(path)
    if not scene.count:
        raise InputError(path, "the file holds no Gaussians", "at least one", "Export the scene again.")
    return scene, notes


class _Placement(NamedTuple):
    """Gaussians in a world that they may be in."""

    name: str
    gaussians: Gaussians
    explained: bool
    correlation: float
    psnr: float


def place_in_capture(
    gaussians: Gaussians, capture: Capture, path: Path, trained: np.ndarray | None, progress: Progress
) -> tuple[Gaussians, tuple[str, ...]]:
    """Moves a file's Gaussians into the world of the capture's cameras.

    A few frames are rendered in each world that the file may be in: the one that `trained` leads back from, that of the
    capture's files, that of its poses, and those of known training programs. The one most like the frames is taken.

    Args:
      gaussians: Gaussians of the file (NumPy, float64 means).
      capture: The capture.
      path: The file, for notes.
      trained: (4, 4) from the file's world to that of the capture's files, by dataparser_transforms.json; or None.
      progress: Callback.

    Returns:
      The Gaussians in the capture's world, and notes on the world that was taken.
    """
    to_source = np.asarray(capture.to_source, np.float64)
    to_poses = np.eye(4) if capture.to_poses is None else np.asarray(capture.to_poses, np.float64)
    transformed = not np.allclose(to_poses, to_source, rtol=1e-9, atol=1e-9 * np.abs(to_source).max())
    worlds: list[tuple[str, np.ndarray]] = []
    if trained is not None:
        worlds.append(("dataparser_transforms.json", trained))
        if transformed:
            worlds.append(("dataparser_transforms.json, of the poses", to_source @ np.linalg.inv(to_poses) @ trained))
    worlds.append(("the capture's files" if transformed else "the capture's poses", np.eye(4)))
    if transformed:
        worlds.append(("the poses, without the applied_transform undone", to_source @ np.linalg.inv(to_poses)))

    def place(name: str, world: np.ndarray) -> _Placement:
        moved = transform_gaussians_float64(gaussians, np.linalg.inv(to_source) @ world)
        scene = jax.tree.map(jnp.asarray, moved)
        similarity = photo_similarity(scene, capture)
        return _Placement(name, scene, similarity.explained, similarity.correlation, similarity.psnr)

    placements = []
    for n, (name, world) in enumerate(worlds):
        placements.append(place(name, world))
        progress(n + 1, len(worlds))
    best = placements[0]
    for other in placements[1:]:
        if other.correlation > best.correlation + MIN_LEAD:
            best = other
    if not best.explained:
        cameras = np.linalg.inv(transform_poses(np.asarray(capture.cameras.world_to_camera, np.float64), to_poses))
        points = np.asarray(capture.points, np.float64) @ to_poses[:3, :3].T + to_poses[:3, 3]
        for name, world in training_worlds(cameras, points):
            name = f"the training, normalised as by {name}"
            other = place(name, to_source @ np.linalg.inv(world @ to_poses))
            if other.explained and other.correlation > best.correlation + MIN_LEAD:
                best = other
    figures = f"correlation with the frames {best.correlation:.2f}, {best.psnr:.1f} dB"
    note = f"The Gaussians were read in the world of {best.name} ({figures})."
    if best.correlation < ROUGH_CORRELATION:
        note += " They show the frames only roughly: the scene is crude, or its world or poses are a bit off."
    if not best.explained:
        note = (
            f"{WARNING}The Gaussians of {path.name} do not look like the frames ({figures}). They are probably in "
            f"another world than the poses, and answers will be wrong. Give Gaussians in the world of the capture, or "
            f"put the dataparser_transforms.json of their training beside {path.name}."
        )
    return best.gaussians, (note, *_rounding_note(gaussians, path))


def _rounding_note(gaussians: Gaussians, path: Path) -> tuple[str, ...]:
    """A warning if a file's float32 has rounded the positions of its Gaussians, which cannot be undone."""
    if gaussians.means.dtype != np.float32:
        return ()
    steps = np.spacing(np.abs(gaussians.means).max(axis=1))
    if np.median(steps / np.exp(gaussians.log_scales.max(axis=1).astype(np.float64))) < 2 * MAX_READ_ROUNDING:
        return ()
    note = f"{path.name} holds positions in float32, which rounds them to {np.median(steps):.2g} units out there."
    return (f"{WARNING}{note} Export them in double precision, or nearer to the origin.",)


def check_overlap(gaussians: Gaussians, cameras: Camera, where: str) -> None:
    """Checks that at least two cameras see some of the Gaussians.

    Args:
      gaussians: N Gaussians.
      cameras: Batch of cameras.
      where: File or folder, for the message.

    Raises:
      InputError: Fewer than MIN_OVERLAP of them are in the view of two cameras.
    """
    visible = jax.lax.map(lambda camera: project(gaussians, camera).visible, jax.tree.map(jnp.asarray, cameras))
    share = float(jnp.mean(visible.sum(0) >= 2)) if gaussians.count else 0.0
    if share < MIN_OVERLAP:
        problem = f"{share:.1%} of {gaussians.count} points in the view of two or more of the {len(visible)} frames"
        remedy = "Check that the poses belong to these frames, and the Gaussians to this capture."
        raise InputError(where, problem, "views that overlap, and a scene in the world of their poses", remedy)
