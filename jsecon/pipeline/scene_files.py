"""Gaussians of a file in the world of a capture.

A splat file does not record its world. It may be the world of the poses, the world before an `applied_transform`, or
one that a training program normalises to. Rendered in the right world, a scene correlates with the photographs, and
more with the photograph of the same camera than with the others. That holds for crude scenes too, whose PSNR may lie
below that of a plain colour.
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jsecon.errors import InputError
from jsecon.fit.quality import QUICK_LONG_SIDE
from jsecon.fit.resize import resize_frame, shrink_cameras
from jsecon.pipeline.results import WARNING
from jsecon.read.captures.frames import evenly_spaced, transform_poses
from jsecon.read.splats.files import MAX_READ_ROUNDING, read_gaussians
from jsecon.splat.project import project
from jsecon.splat.render import render_rgb
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Camera, Capture, Gaussians, Progress


def read_scene(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a file of Gaussians."""
    scene, notes = read_gaussians(path)
    if not scene.count:
        raise InputError(path, "the file holds no Gaussians", "at least one", "Export the scene again.")
    return scene, notes


class _PhotoSimilarity(NamedTuple):
    """Similarity of a scene to the photographs."""

    correlation: float
    """Mean over the views, in [-1, 1]."""
    contrast: float
    """Standard deviations above the correlation with the photographs shuffled among the cameras."""
    psnr: float
    """Mean, dB."""
    views: int
    """Number of views compared."""

    @property
    def explained(self) -> bool:
        """Whether the photographs show this scene from these cameras.

        Fitted scenes have a correlation of 0.8 to 0.97 in their world, and -0.1 to 0.1 in others. Scenes of one
        Gaussian per sparse point, not fitted, have 0.40 (fox) and 0.50 (bonsai) in theirs, and up to 0.40 in others;
        but their contrast is 4.2 and 4.9, and up to 3.6 in others (4.0 if shifted by a tenth of the scene's size).
        """
        if self.views < 6:  # whose contrast is not significant
            return self.correlation >= 0.5
        return self.correlation >= 0.85 or (self.correlation >= 0.3 and self.contrast >= 4.0)


class _Placement(NamedTuple):
    """Gaussians in a world that they may be in."""

    name: str
    gaussians: Gaussians
    similarity: _PhotoSimilarity

    def leads(self, other: "_Placement") -> bool:
        """Whether it is clearly more like the photographs."""
        return self.similarity.correlation > other.similarity.correlation + 0.05


def place_in_capture(
    gaussians: Gaussians, capture: Capture, path: Path, trained: np.ndarray | None, progress: Progress
) -> tuple[Gaussians, tuple[str, ...]]:
    """Moves a file's Gaussians into the world of the capture's cameras.

    A few frames are rendered in each world that the file may be in: the one that `trained` leads back from, that of the
    capture's files, that of its poses, and those of known training programs. The one most like the frames is taken.
    """
    source_from_scene = np.asarray(capture.source_from_scene, np.float64)
    poses_from_scene = (
        np.eye(4) if capture.poses_from_scene is None else np.asarray(capture.poses_from_scene, np.float64)
    )
    transformed = not np.allclose(
        poses_from_scene, source_from_scene, rtol=1e-9, atol=1e-9 * np.abs(source_from_scene).max()
    )
    worlds: list[tuple[str, np.ndarray]] = []
    if trained is not None:
        worlds.append(("dataparser_transforms.json", trained))
        if transformed:
            worlds.append(
                (
                    "dataparser_transforms.json, of the poses",
                    source_from_scene @ np.linalg.inv(poses_from_scene) @ trained,
                )
            )
    worlds.append(("the capture's files" if transformed else "the capture's poses", np.eye(4)))
    if transformed:
        worlds.append(
            ("the poses, without the applied_transform undone", source_from_scene @ np.linalg.inv(poses_from_scene))
        )

    def place(name: str, world: np.ndarray) -> _Placement:
        moved = transform_gaussians(gaussians, np.linalg.inv(source_from_scene) @ world)
        scene = jax.tree.map(jnp.asarray, moved)
        return _Placement(name, scene, _photo_similarity(scene, capture))

    best = None
    for n, (name, world) in enumerate(worlds):
        other = place(name, world)
        best = other if best is None or other.leads(best) else best
        progress(n + 1, len(worlds))
    assert best is not None
    if not best.similarity.explained:
        cameras = np.linalg.inv(
            transform_poses(np.asarray(capture.cameras.world_to_camera, np.float64), poses_from_scene)
        )
        points = np.asarray(capture.points, np.float64) @ poses_from_scene[:3, :3].T + poses_from_scene[:3, 3]
        for name, world in _training_worlds(cameras, points):
            other = place(
                f"the training, normalised as by {name}", source_from_scene @ np.linalg.inv(world @ poses_from_scene)
            )
            if other.similarity.explained and other.leads(best):
                best = other
    figures = f"correlation with the frames {best.similarity.correlation:.2f}, {best.similarity.psnr:.1f} dB"
    note = f"The Gaussians were read in the world of {best.name} ({figures})."
    # A fitted scene has 0.97 in its world, 0.56 a tenth of a metre beside it, 0.39 when turned by 20 degrees; a crude
    # one 0.81 in its world.
    if best.similarity.correlation < 0.6:
        note += " They show the frames only roughly: the scene is crude, or its world or poses are a bit off."
    if not best.similarity.explained:
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


def _photo_similarity(gaussians: Gaussians, capture: Capture) -> _PhotoSimilarity:
    """Compares renderings of a scene with at most eight training frames."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    views = train[evenly_spaced(len(train), 8)]
    cameras = shrink_cameras(capture.cameras, QUICK_LONG_SIDE)
    gaussians = jax.device_put(gaussians)
    rendered, photos, psnr = [], [], []
    for t in views.tolist():
        image = np.clip(np.asarray(render_rgb(gaussians, cameras[t]).features), 0, 1)
        photo = resize_frame(np.asarray(capture.frames[t]), cameras).astype(np.float32) / 255
        psnr.append(-10 * np.log10(max(float(np.mean((image - photo) ** 2)), 1e-10)))
        rendered.append(_pattern(image))
        photos.append(_pattern(photo))
    table = np.stack(rendered) @ np.stack(photos).T
    draw, rows = np.random.default_rng(0), np.arange(len(views))
    shuffled = np.array([table[rows, draw.permutation(len(views))].sum() for _ in range(500)])
    deviation = max(float(shuffled.std()), 1e-9)
    contrast = float((np.trace(table) - shuffled.mean()) / deviation)
    return _PhotoSimilarity(float(np.diag(table).mean()), contrast, float(np.mean(psnr)), len(views))


def _pattern(image: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, " p"]:
    """The image as a small vector of length 1 whose channels have mean 0; zero for a plain colour."""
    size = 64 / max(image.shape[:2])  # px: crude scenes look right at this size
    if size < 1:
        shape = max(round(image.shape[1] * size), 1), max(round(image.shape[0] * size), 1)
        image = cv2.resize(image, shape, interpolation=cv2.INTER_AREA)
    centred = image.astype(np.float64) - image.mean((0, 1), dtype=np.float64)
    length = np.linalg.norm(centred)
    return (centred / length if length > 1e-6 else np.zeros_like(centred)).ravel()


def _training_worlds(
    cameras_to_world: Float[np.ndarray, "t 4 4"], points: Float[np.ndarray, "p 3"]
) -> list[tuple[str, Float[np.ndarray, "4 4"]]]:
    """Computes the worlds that training programs normalise a capture to, from its cameras and points.

    gsplat (examples/datasets/normalize.py): the cameras' up to -y by the smallest turn, the median of the points of
    their axes nearest to the origin to the origin, the median camera to distance 1; then the points' principal axes,
    whose signs are open. nerfstudio (auto_orient_and_center_poses, "up" and "poses"): the cameras' up to z, their mean
    to the origin, the largest coordinate of one to 1. Returns for each world the program and the (4, 4) similarity from
    the world of the poses, that of the arguments.
    """
    turns, centres = cameras_to_world[:, :3, :3], cameras_to_world[:, :3, 3]
    up = -turns[:, :, 1].mean(0)
    if not np.linalg.norm(up) > 1e-6:
        return []
    worlds = []
    turn = _least_turn(up, np.array([0.0, -1.0, 0.0]))
    ahead, places = turns[:, :, 2] @ turn.T, centres @ turn.T
    middle = np.median(places - (ahead * places).sum(1, keepdims=True) * ahead, axis=0)
    plain = _scaled(turn, middle, np.median(np.linalg.norm(places - middle, axis=1)))
    if plain is not None:
        if len(points) > 3:
            there = points @ plain[:3, :3].T + plain[:3, 3]
            centre = np.median(there, axis=0)
            axes = np.linalg.eigh(np.cov(there - centre, rowvar=False))[1][:, ::-1].T
            axes[0] *= np.sign(np.linalg.det(axes))
            for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
                aligned = np.eye(4)
                aligned[:3, :3] = np.diag(signs) @ axes
                aligned[:3, 3] = -aligned[:3, :3] @ centre
                worlds.append(("gsplat", aligned @ plain))
        worlds.append(("gsplat", plain))
    # What nerfstudio applies first to a COLMAP model that it reads itself: (x, y, z) to (x, z, -y).
    from_colmap = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for before in (np.eye(4), from_colmap):
        turn = _least_turn(before[:3, :3] @ up, np.array([0.0, 0.0, 1.0]))
        places = centres @ (turn @ before[:3, :3]).T
        middle = places.mean(0)
        trained = _scaled(turn, middle, np.abs(places - middle).max())
        if trained is not None:
            worlds.append(("nerfstudio", trained @ before))
    return worlds


def _scaled(turn: np.ndarray, middle: np.ndarray, size: float) -> np.ndarray | None:
    """Turned, `middle` to the origin, `size` to 1; None without a size."""
    if not (np.isfinite(size) and size > 0):
        return None
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turn / size, -middle / size
    return result


def _least_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(3, 3) the smallest rotation that brings the direction of a to the unit vector b."""
    a = a / np.linalg.norm(a)
    x, y, z = np.cross(a, b)
    cosine = float(a @ b)
    if cosine < -1 + 1e-8:
        return np.diag([-1.0, 1.0, -1.0]) if abs(b[1]) < 0.5 else np.diag([-1.0, -1.0, 1.0])
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + cosine)


def check_overlap(gaussians: Gaussians, cameras: Camera, where: str) -> None:
    """Checks that at least two cameras see some of the Gaussians."""
    each = jax.lax.map(lambda camera: project(gaussians, camera).visible, jax.tree.map(jnp.asarray, cameras))
    visible = np.asarray(each)
    share = float(np.mean(visible.sum(0) >= 2)) if gaussians.count else 0.0
    if share < 0.01:
        problem = f"{share:.1%} of {gaussians.count} points in the view of two or more of the {len(visible)} frames"
        remedy = "Check that the poses belong to these frames, and the Gaussians to this capture."
        raise InputError(where, problem, "views that overlap, and a scene in the world of their poses", remedy)
