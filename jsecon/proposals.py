"""Where a run's proposals come from: the masks of single frames, before anything brings them together."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.options import Options
from jsecon.types import Capture, Gaussians
from jsecon.vision.protocols import Segmenter
from jsecon.vision.runs import remembered

CLOUD = 100_000
"""points, at most, that the normals of a capture with depth are taken from"""
GRAIN = 0.02
"""least distance between them, as a share of the median depth: nearer ones show a sensor's noise, not the surface"""


def proposals_of(
    options: Options, capture: Capture, train: np.ndarray, gaussians: Gaussians, segmenter: Segmenter | None
) -> tuple[Callable[[int], np.ndarray], tuple[str, ...]]:
    """masks (M, H, W) bool of the t-th of the frames `train`: from disk where they are given, else by `segmenter`, else
    by the classical one at the granularity asked for; and notes."""
    frames = np.asarray(capture.frames)[train]
    if options.proposals is not None:
        from jsecon.data.proposals import proposals_from_disk

        names = [capture.names[t] for t in train]
        return proposals_from_disk(options.proposals, names, frames.shape[1:3], level=options.level)
    if segmenter is not None:  # which keeps what it finds on disk
        return lambda t: segmenter(frames[t], t), ()
    classical = classical_segmenter(options.granularity, capture, train, gaussians)
    return remembered(lambda t: classical(frames[t], t)), ()


def classical_segmenter(granularity: str, capture: Capture, train: np.ndarray, gaussians: Gaussians) -> Segmenter:
    """The segmenter without weights, of the frames `train`.

    Surfaces come from the capture's depth; where there is none, the coarse one takes the depth that the Gaussians
    render. (The finer ones do not: rendered depth costs them more outline than it tells.)
    """
    from jsecon.fit.initialise import points_from_depth
    from jsecon.splat.render import render_depth
    from jsecon.splat.tiles import plan_capacity
    from jsecon.vision.classical import GRANULARITIES, ClassicalSegmenter
    from jsecon.vision.relief import steadied_depth
    from jsecon.vision.surfaces import surfaces_from_depth

    cameras = jax.tree.map(jnp.asarray, capture.cameras[train])
    setting = GRANULARITIES[granularity]
    depths = None if capture.depths is None else np.asarray(capture.depths)[train]
    if depths is not None and depths[:, ::4, ::4].any():
        known = depths[:, ::4, ::4]
        cloud = points_from_depth(capture, voxel=GRAIN * float(np.median(known[known > 0])), stride=4)
        if len(cloud.points) > CLOUD:
            cloud = points_from_depth(capture, max_points=CLOUD, stride=4)
        surfaces = surfaces_from_depth(depths, capture.cameras[train], cloud.points)
        return ClassicalSegmenter(**setting, surfaces=surfaces)
    if granularity == "coarse":
        capacity = plan_capacity(gaussians, cameras)
        draw = jax.jit(lambda camera: render_depth(gaussians, camera, capacity=capacity))

        def rendered(t: int) -> np.ndarray:
            depth, alpha = (np.asarray(image) for image in draw(cameras[t]))
            return steadied_depth(np.where(alpha > 0.5, depth, 0.0).astype(np.float32))

        return ClassicalSegmenter(**setting, depths=rendered)
    return ClassicalSegmenter(**setting)
