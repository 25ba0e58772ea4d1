"""Where a fit starts from: what the capture holds, and Gaussians made of points."""

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial import KDTree

from jsecon.errors import require, require_one_of
from jsecon.fit.dense import dense_points, random_points
from jsecon.fit.depth import points_from_depth
from jsecon.fit.triangulate import MIN_POINTS, triangulated_points
from jsecon.splat.sh import sh_from_rgb
from jsecon.types import Array, Capture, Gaussians

MIN_SQUARED_DISTANCE = 1e-7
"""floor under a squared neighbour distance, world units^2 (INRIA): duplicate points still get a scale"""

Start = Literal["auto", "sparse", "dense", "random"]
MAX_DENSE = 100_000
"""points of a start from depth, from stereo or drawn at random"""


def starting_gaussians(
    capture: Capture,
    *,
    sh_degree: int = 0,
    start: Start = "auto",
    max_points: int = MAX_DENSE,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Gaussians, str]:
    """The Gaussians that a fit of `capture` starts from, and one sentence on where they come from.

    `start` is "auto": from depth where there is depth, else as "sparse"; "sparse": the capture's own points, or points
    triangulated from the frames that are not held out; "dense": from depth where there is depth, else by stereo between
    neighbouring views; "random": in the space that the cameras look at. All but sparse points are `max_points` at most.
    Raises InputError where the views do not give such points, ValueError on another `start`.

    The scale (in units of the distance to the neighbours) is smaller and the opacity larger than INRIA's 1 and 0.1,
    which are meant for a fit that adds Gaussians. Measured with the same number of steps: on the demo room (seed 0, 400
    steps) 32.6 dB held out for opacity 0.8 and scale 0.6, 31.0 dB for 0.1 and 1, with half the error of the rendered
    depth; on fox (216x384, 500 steps) 25.8 and 25.4 dB.
    """
    require_one_of("start", start, ("auto", "sparse", "dense", "random"), "auto takes what the capture holds.")
    count, given = len(capture.points), {"opacity": 0.7, "scale": 0.6}
    if capture.depths is not None and start in ("auto", "dense"):
        found = points_from_depth(capture, max_points=max_points, stride=2)
        points, colors, given = found.points, found.colors, {"opacity": 0.9, "scale": 0.5, "max_scale": 2 * found.voxel}
        origin = f"{len(points)} points from the depth frames, one a voxel of {found.voxel:.3g} world units"
    elif start == "dense":
        points, colors = dense_points(capture, max_points=max_points, progress=progress)
        origin = f"{len(points)} points by stereo between neighbouring views"
    elif start == "random":
        points, colors = random_points(capture, max_points)
        given = {"opacity": 0.1, "scale": 1.0}
        origin = f"{len(points)} random points in the space that the cameras look at"
    elif count >= MIN_POINTS:
        points, colors, origin = capture.points, capture.point_colors, f"{count} sparse points of the capture"
    else:
        points, colors = triangulated_points(capture, progress=progress)
        few = f"only {count} points" if count else "no points"
        origin = f"the capture has {few}: {len(points)} points triangulated from feature matches between its views"
    return gaussians_from_points(points, colors, sh_degree=sh_degree, **given), origin


def neighbour_distances(points: Float[Array, "p 3"]) -> Float[np.ndarray, " p"]:
    """Root of the mean squared distance to the three nearest other points, world units (simple-knn of graphdeco-inria).

    With fewer other points, the mean is over those there are; a lone point gets the floor.
    """
    points = np.asarray(points, np.float64)
    count = len(points)
    others = min(3, count - 1)
    if others < 1:
        return np.full(count, math.sqrt(MIN_SQUARED_DISTANCE))
    distances, _ = KDTree(points).query(points, k=others + 1, workers=-1)
    return np.sqrt(np.maximum(np.mean(distances[:, 1:] ** 2, axis=1), MIN_SQUARED_DISTANCE))


def gaussians_from_points(
    points: Float[Array, "p 3"],
    colors: UInt8[Array, "p 3"],
    *,
    opacity: float = 0.1,
    scale: float = 1.0,
    max_scale: float | None = None,
    sh_degree: int = 0,
) -> Gaussians:
    """One round Gaussian a point (Kerbl et al. 2023, section 5.1).

    The standard deviation is `scale` times `neighbour_distances`, at most `max_scale` world units; the colour is the
    point's in every direction; the rotation is the identity. Raises ValueError where there is no point, a coordinate
    is not finite, or an option is outside its range.
    """
    points, colors = np.asarray(points), np.asarray(colors)
    require(len(points) > 0, "points", "none", "at least one", "Triangulate them from the frames (fit.triangulate).")
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    require(not bad, "points", f"{bad} with a coordinate that is not finite", "finite coordinates", "Drop them first.")
    require(0 < opacity < 1, "opacity", opacity, "between 0 and 1", "0.1 is usual, 0.9 on depth.")
    require(scale > 0, "scale", scale, "positive", "1 is usual.")
    require(sh_degree in (0, 1, 2, 3), "sh_degree", sh_degree, "0 to 3", "0 is colour alone.")
    deviations = scale * neighbour_distances(points)
    if max_scale is not None:
        deviations = np.minimum(deviations, max_scale)
    count = len(points)
    sh = np.zeros((count, (sh_degree + 1) ** 2, 3), np.float32)
    sh[:, :1] = sh_from_rgb(colors.astype(np.float64) / 255.0)
    return Gaussians(
        means=points.astype(np.float32),
        log_scales=np.repeat(np.log(deviations)[:, None], 3, axis=1).astype(np.float32),
        quaternions=np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1)),
        opacity_logits=np.full(count, math.log(opacity / (1 - opacity)), np.float32),
        sh=sh,
    )
