"""Gaussians of a file in the world of a capture.

A splat file does not record its world. It may be the world of the poses, the world before an `applied_transform`, or
one that a training program normalises to. Rendered in the right world, a scene correlates with the photographs, and
more with the photograph of the same camera than with the others. That holds for crude scenes too, whose PSNR may lie
below that of a plain colour. A file does not record either over which colour the scene was trained: that is fitted.
"""

from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError
from jsecon.fit.quality import QUICK_LONG_SIDE
from jsecon.fit.resize import resize_frame, shrink_cameras
from jsecon.pipeline.stages import WARNING
from jsecon.read.captures.frames import evenly_spaced, transform_poses
from jsecon.read.splats.formats import read_gaussians
from jsecon.splat.render import render_rgb
from jsecon.splat.transform import transform_gaussians
from jsecon.types import Capture, Gaussians, Progress


def read_scene(path: Path) -> tuple[Gaussians, tuple[str, ...]]:
    """Reads a file of Gaussians."""
    scene, notes = read_gaussians(path)
    if not scene.count:
        raise InputError(path, "the file holds no Gaussians", "at least one", "Export the scene again.")
    return scene, notes


class _Placement(NamedTuple):
    """Gaussians in a world that they may be in."""

    world: str
    gaussians: Gaussians
    correlation: float
    """With the photographs of the same cameras, the mean over the views, in [-1, 1]."""
    explained: bool
    """Whether the photographs show this scene from these cameras."""
    background: Float[np.ndarray, " 3"] | None
    """The colour in [0, 1] over which they show it; None for black."""


def place_in_capture(
    gaussians: Gaussians, capture: Capture, path: Path, trained: np.ndarray | None, progress: Progress
) -> tuple[Gaussians, str]:
    """Moves a file's Gaussians into the world of the capture's cameras, and notes which world the file was in.

    A few frames are rendered in each world that the file may be in: the one that `trained` leads back from, that of the
    capture's files, and that of its poses; if none shows the frames well, those of known training programs. The first
    is taken, unless the frames are explained by another that is clearly more like them.
    """
    source_from_scene = np.asarray(capture.source_from_scene, np.float64)
    poses = capture.poses_from_scene
    poses_from_scene = np.eye(4) if poses is None else np.asarray(poses, np.float64)
    size = np.abs(source_from_scene).max()
    worlds = {"the capture's files": np.linalg.inv(source_from_scene)}
    if not np.allclose(poses_from_scene, source_from_scene, rtol=1e-9, atol=1e-9 * size):
        worlds["the poses, without the applied_transform undone"] = np.linalg.inv(poses_from_scene)
    if trained is not None:
        worlds = {f"dataparser_transforms.json, of {name}": way @ trained for name, way in worlds.items()} | worlds
    best = None
    for candidates in (list(worlds.items()), _training_worlds(capture, poses_from_scene)):
        if best is not None and best.explained and best.correlation >= 0.9:
            break
        for n, (world, scene_from_world) in enumerate(candidates):
            moved = jax.tree.map(jnp.asarray, transform_gaussians(gaussians, scene_from_world))
            other = _Placement(world, moved, *_compare_with_photographs(moved, capture))
            least = best.correlation + 0.05 if best is not None and best.explained else -1.0
            if best is None or (other.explained and other.correlation > least):
                best = other
            progress(n + 1, len(candidates))
    assert best is not None
    figure = f"correlation with the frames {best.correlation:.2f}"
    note = f"The Gaussians were read in the world of {best.world} ({figure})."
    if best.background is not None:
        levels = np.round(255 * best.background).astype(int)
        colour = "white" if levels.min() >= 250 else f"the colour {tuple(levels.tolist())}"
        note += f" The frames show them over {colour}; held-out frames are compared over it."
    # A fitted scene has 0.97 in its world, 0.56 a tenth of a metre beside it, 0.39 when turned by 20 degrees; a crude
    # one 0.81 in its world.
    if best.correlation < 0.6:
        note += " They show the frames only roughly: the scene is crude, or its world or poses are a bit off."
    if not best.explained:
        note = (
            f"{WARNING}The Gaussians of {path.name} do not look like the frames ({figure}). They are probably in "
            f"another world than the poses, and answers will be wrong. Give Gaussians in the world of the capture, or "
            f"put the dataparser_transforms.json of their training beside {path.name}."
        )
    return best.gaussians, note


def fit_background(gaussians: Gaussians, capture: Capture) -> Float[np.ndarray, " 3"] | None:
    """Fits the plain colour in [0, 1] over which the photographs show Gaussians in their world; None for black."""
    return _compare_with_photographs(gaussians, capture)[2]


def _compare_with_photographs(
    gaussians: Gaussians, capture: Capture
) -> tuple[float, bool, Float[np.ndarray, " 3"] | None]:
    """Renders at most eight training frames: their correlation, whether they explain the photographs, the background.

    The background is the colour b that fits photograph = image + (1 - alpha) b best. It replaces black where it makes
    the scene clearly more like the photographs. Over it, outlines alone correlate in other worlds too, by up to 0.67;
    in its world a crude scene has 0.85. The colours within the outlines have 0.7 to 0.9 there, and up to 0.25 in
    others. A thing of one colour has nothing within: its outline decides.
    """
    train = np.flatnonzero(~np.asarray(capture.held_out))
    cameras = shrink_cameras(capture.cameras, QUICK_LONG_SIDE)
    rendered, shrunk = [], []
    for t in train[evenly_spaced(len(train), 8)].tolist():
        rendering = render_rgb(gaussians, cameras[t])
        rendered.append(_shrink(np.dstack([rendering.features, rendering.alpha])))
        shrunk.append(_shrink(resize_frame(np.asarray(capture.frames[t]), cameras).astype(np.float32) / 255))
    photos, (images, alpha) = np.stack(shrunk), np.split(np.stack(rendered), [3], axis=-1)
    correlation, explained = _judge(images, photos)
    gaps = 1 - alpha
    fitted = (gaps * (photos - images)).sum((0, 1, 2)) / max((gaps**2).sum(), 1e-9)
    background = np.clip(fitted, 0, 1).astype(np.float32)
    with_background, explained_with = _judge(images + gaps * background, photos)
    within = np.diag(_correlations(images / np.maximum(alpha, 1e-3), photos, alpha)).mean()
    shown = with_background >= 0.9 or (explained_with and with_background >= 0.65 and within >= 0.3)
    empty = (gaps > 0.95).mean() >= 0.02  # else these are the holes of a scene that is not fitted to its end
    if empty and shown and (not explained or with_background >= correlation + 0.1):
        return with_background, True, background
    return correlation, explained, None


def _judge(images: Float[np.ndarray, "t h w 3"], photos: Float[np.ndarray, "t h w 3"]) -> tuple[float, bool]:
    """Returns the correlation of renderings with the photographs of the same cameras, and whether they explain them.

    Fitted scenes have a correlation of 0.8 to 0.97 in their world, and -0.1 to 0.1 in others. Scenes of one Gaussian
    per sparse point, not fitted, have 0.40 (fox) and 0.50 (bonsai) in theirs, and up to 0.40 in others. But with the
    photographs shuffled among the cameras, theirs lies 4.2 and 4.9 standard deviations above the mean, and up to 3.6 in
    others (4.0 if shifted by a tenth of the scene's size).
    """
    table = _correlations(images, photos, np.ones_like(images[..., :1]))
    count, correlation = len(table), float(np.diag(table).mean())
    if count < 6:  # a shuffle of so few is not significant
        return correlation, correlation >= 0.5
    draw, rows = np.random.default_rng(0), np.arange(count)
    shuffled = np.array([table[rows, draw.permutation(count)].sum() for _ in range(500)])
    contrast = (np.trace(table) - shuffled.mean()) / max(shuffled.std(), 1e-9)
    return correlation, bool(correlation >= 0.85 or (correlation >= 0.3 and contrast >= 4.0))


def _shrink(image: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "a b c"]:
    """Shrinks an image to 64 px and clips it to [0, 1]: crude scenes look right at this size."""
    size = min(64 / max(image.shape[:2]), 1.0)
    shape = max(round(image.shape[1] * size), 1), max(round(image.shape[0] * size), 1)
    return cv2.resize(np.clip(image, 0, 1), shape, interpolation=cv2.INTER_AREA).astype(np.float64)


def _correlations(
    images: Float[np.ndarray, "t h w 3"], photos: Float[np.ndarray, "t h w 3"], weights: Float[np.ndarray, "t h w 1"]
) -> Float[np.ndarray, "t t"]:
    """Correlates each image with each photograph, both weighted by the image's weights; a plain colour has 0."""

    def patterns(pictures: np.ndarray) -> np.ndarray:
        """Vectors of length 1 whose channels have mean 0."""
        mean = (weights * pictures).sum((1, 2), keepdims=True) / np.maximum(weights.sum((1, 2), keepdims=True), 1e-9)
        centred = (weights * (pictures - mean)).reshape(len(pictures), -1)
        length = np.linalg.norm(centred, axis=1, keepdims=True)
        return np.where(length > 1e-6, centred / np.maximum(length, 1e-6), 0.0)

    return patterns(images) @ patterns(photos).T


def _training_worlds(
    capture: Capture, poses_from_scene: Float[np.ndarray, "4 4"]
) -> list[tuple[str, Float[np.ndarray, "4 4"]]]:
    """Computes the worlds that training programs normalise a capture to: what they are, and the way from them.

    gsplat (examples/datasets/normalize.py): the cameras' up to -y by the smallest turn, the median of the points of
    their axes nearest to the origin to the origin, the median camera to distance 1; then the points' principal axes,
    whose signs are open. nerfstudio (auto_orient_and_center_poses, "up" and "poses"): the cameras' up to z, their mean
    to the origin, the largest coordinate of one to 1.
    """
    poses = transform_poses(np.asarray(capture.cameras.world_to_camera, np.float64), poses_from_scene)
    points = np.asarray(capture.points, np.float64) @ poses_from_scene[:3, :3].T + poses_from_scene[:3, 3]
    cameras = np.linalg.inv(poses)
    turns, centres = cameras[:, :3, :3], cameras[:, :3, 3]
    up = -turns[:, :, 1].mean(0)
    if not np.linalg.norm(up) > 1e-6:
        return []
    worlds = []
    turn = Rotation.align_vectors([0.0, -1.0, 0.0], up)[0].as_matrix()
    ahead, places = turns[:, :, 2] @ turn.T, centres @ turn.T
    middle = np.median(places - (ahead * places).sum(1, keepdims=True) * ahead, axis=0)
    plain = _similarity(turn, middle, np.median(np.linalg.norm(places - middle, axis=1)))
    if len(points) > 3:
        moved = points @ plain[:3, :3].T + plain[:3, 3]
        centre = np.median(moved, axis=0)
        axes = np.linalg.eigh(np.cov(moved - centre, rowvar=False))[1][:, ::-1].T
        axes[0] *= np.sign(np.linalg.det(axes))
        for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
            turn = np.diag(signs) @ axes
            worlds.append(("gsplat", _similarity(turn, turn @ centre, 1.0) @ plain))
    worlds.append(("gsplat", plain))
    # What nerfstudio applies first to a COLMAP model that it reads itself: (x, y, z) to (x, z, -y).
    from_colmap = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for before in (np.eye(4), from_colmap):
        turn = Rotation.align_vectors([0.0, 0.0, 1.0], before[:3, :3] @ up)[0].as_matrix()
        places = centres @ (turn @ before[:3, :3]).T
        middle = places.mean(0)
        worlds.append(("nerfstudio", _similarity(turn, middle, np.abs(places - middle).max()) @ before))
    return [
        (f"the training, normalised as by {program}", np.linalg.inv(world @ poses_from_scene))
        for program, world in worlds
    ]


def _similarity(turn: np.ndarray, middle: np.ndarray, size: float) -> np.ndarray:
    """(4, 4) what turns, then brings `middle` to the origin and `size` to 1; a size of 0 stays."""
    size = size if size > 0 else 1.0
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = turn / size, -middle / size
    return result
