"""Which Gaussians of a scene show nothing of it: unseen, faint, haze and floaters. Host code.

A Gaussian hangs in front of a surface where a pixel shows that surface farther away. The share of its weight on such
pixels tells floaters and haze from surfaces. The first pass compares with the depth of all Gaussians, of which floaters
are a part; the second one with the depth of those that passed the first. Thin things hang in front of surfaces too: so
only what overlaps with hardly any other Gaussian goes.
"""

import dataclasses
import functools
import math

import jax
import numpy as np
from jaxtyping import Bool, Float, Int, Int8
from scipy.spatial import KDTree

from jsecon.field.evidence import MAX_WHOLE, each_view, view_evidence
from jsecon.splat.capacity import plan_capacity
from jsecon.splat.render import render_depth
from jsecon.splat.visible import hide, visible_part
from jsecon.types import Camera, Gaussians, Progress

KINDS = ("kept", "unseen", "faint", "haze", "floaters")
"""what `find_litter` tells apart: its numbers are places here"""
FAINT = 1 / 255
"""Largest weight of a pixel below which a Gaussian changes no picture of 8 bits."""
HAZE = 0.1
"""Largest weight of a pixel below which what hangs in front of a surface is called haze."""
_FIRST_SHARE, _SHARE = 0.4, 0.6
"""Shares of a Gaussian's weight in front of surfaces from which it is left out of the second pass, and goes. Measured
with experiments/clean.py."""
_FIRST_GAP, _GAP = 0.03, 0.06
"""Shares of the depth by which a surface lies behind what hangs in front of it, in each pass."""
_NEIGHBOURS, _COMPANY = 9, 2
"""Nearest Gaussians that are asked for, and number of these with which what belongs to a surface overlaps."""
_REACH = (0.8, 1.0)
"""Sums of both largest deviations within which two Gaussians overlap: of haze, and of all others."""
_LEAST_ALPHA = 0.3
"""Alpha of a pixel from which it shows a surface."""
_PART = 1_250_000
"""Gaussians of a large scene for each part that its views are divided into."""
_STEP = 0.01
"""Ratio of two depths that are told apart, less one."""


def find_litter(gaussians: Gaussians, cameras: Camera, progress: Progress | None = None) -> Int8[np.ndarray, " n"]:
    """Finds the kind (`KINDS`) of each of N Gaussians from T views that cover the scene.

    Above `MAX_WHOLE` Gaussians, memory beside them is that of a part of one view.
    """
    count, seen = gaussians.count, np.ones(gaussians.count, bool)
    means = np.asarray(gaussians.means, np.float32)
    peak = np.zeros(count, np.float32)
    reach = np.exp(np.asarray(gaussians.log_scales).max(1))
    seen_by, room, side = None, [0, 0], math.ceil(math.sqrt(count / _PART))
    if count <= MAX_WHOLE:  # once for all views
        gaussians = jax.device_put(dataclasses.replace(gaussians, sh=None))
    else:
        seen_by = functools.lru_cache(1)(lambda t, views=cameras: visible_part(gaussians, views[t]))
        cameras = _divided(cameras, side)
    for n, (least, gap) in enumerate(((_FIRST_SHARE, _FIRST_GAP), (_SHARE, _GAP))):
        front, total, peak = np.zeros((3, count), np.float32)

        def view(t: int, seen=seen, gap=gap) -> tuple[np.ndarray, ...]:
            if seen_by is None:
                return _view(gaussians, seen, cameras[t], gap)
            return _part(*seen_by(t // side**2), seen, cameras[t], gap, room)

        def report(done: int, views: int, first: int = n * len(cameras)) -> None:
            if progress is not None:
                progress(first + done, 2 * views)

        for rows, own_front, own_total, own_peak in each_view(count, len(cameras), view, report):
            front[rows] += own_front
            total[rows] += own_total
            peak[rows] = np.maximum(peak[rows], own_peak)
        seen = front < least * np.maximum(total, 1e-30)
    hanging = ~seen
    hanging[hanging] = _is_apart(means, reach, peak, np.flatnonzero(hanging))
    kinds = np.where(hanging, np.where(peak < HAZE, 3, 4), 0)
    return np.where(peak <= 0, 1, np.where(peak < FAINT, 2, kinds)).astype(np.int8)


def _is_apart(
    means: Float[np.ndarray, "n 3"],
    reach: Float[np.ndarray, " n"],
    peak: Float[np.ndarray, " n"],
    rows: Int[np.ndarray, " m"],
) -> Bool[np.ndarray, " m"]:
    """Tells which of some Gaussians overlap with fewer than `_COMPANY` others that are no haze."""
    solid = np.flatnonzero(peak >= HAZE)
    if not len(solid):
        return np.ones(len(rows), bool)
    distance, near = KDTree(means[solid]).query(means[rows], min(_NEIGHBOURS, len(solid)))
    distance, others = (a.reshape(len(rows), -1) for a in (distance, solid[near]))
    touching = distance <= np.where(peak[rows] < HAZE, *_REACH)[:, None] * (reach[others] + reach[rows, None])
    return (touching & (others != rows[:, None])).sum(1) < _COMPANY


def _divided(cameras: Camera, side: int) -> Camera:
    """Divides T views into side^2 T of one size; neighbours overlap where a view is no multiple of `side`."""
    whole, part = (cameras.width, cameras.height), (-(-cameras.width // side), -(-cameras.height // side))
    starts = [[min(k * p, w - p) for k in range(side)] for w, p in zip(whole, part)]
    moved = [dataclasses.replace(cameras, cx=cameras.cx - x, cy=cameras.cy - y) for x in starts[0] for y in starts[1]]
    parts = jax.tree.map(lambda *parts: np.stack(parts, 1).reshape(-1, *parts[0].shape[1:]), *moved)
    return dataclasses.replace(parts, width=part[0], height=part[1])


def _part(
    rows: np.ndarray, whole: Gaussians, seen: np.ndarray, camera: Camera, gap: float, room: list[int]
) -> tuple[np.ndarray, ...]:
    """Does what `_view` does of a part of a view, which this sees.

    `room` keeps the largest numbers of Gaussians and of their pairs, so that parts share programs.
    """
    ids, gaussians = visible_part(whole, camera, least=room[0])
    room[0] = gaussians.count
    room[1] = max(room[1], plan_capacity(gaussians, camera, margin=1.0, devices=1))
    inside, *columns = _view(gaussians, np.pad(seen[rows[ids]], (0, room[0] - len(ids))), camera, gap, room[1])
    return rows[ids[inside]], *columns


def _view(
    gaussians: Gaussians, seen: Bool[np.ndarray, " n"], camera: Camera, gap: float, capacity: int | None = None
) -> tuple[np.ndarray, ...]:
    """Returns the Gaussians of a view, their weight in front of the surface and on it, and their largest weight.

    The surface is that of the Gaussians that are `seen`.
    """
    depth, alpha = map(np.asarray, render_depth(hide(gaussians, ~seen), camera, capacity=capacity))
    shown = (alpha >= _LEAST_ALPHA) & (depth > 0)
    nearest = float(depth[shown].min(initial=np.inf))
    bins = np.where(shown, np.log(np.where(shown, depth, 1) / nearest) / np.log1p(_STEP), -1).astype(np.int32)
    regions = int(bins.max(initial=-1)) + 1
    found = view_evidence(gaussians, camera, bins, regions, capacity=capacity)
    rows, pose = found.gaussians, np.asarray(camera.world_to_camera, np.float32)
    owner = np.repeat(np.arange(len(rows)), np.diff(found.starts))
    middles = np.append(nearest * (1 + _STEP) ** (np.arange(regions) + 0.5), 0)  # the last is that of no surface
    z = np.asarray(gaussians.means, np.float32)[rows] @ pose[2, :3] + pose[2, 3]
    weights = np.where(found.regions < regions, found.weights, 0)
    front = np.bincount(owner, weights * (middles[found.regions] > (1 + gap) * z[owner]), len(rows))
    return rows, front, np.bincount(owner, weights, len(rows)), found.max_pixel_weights
