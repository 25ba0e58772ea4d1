"""Which Gaussians of a scene show nothing of it: unseen, faint, haze and floaters. Host code.

A Gaussian hangs in front of a surface where a pixel shows that surface farther away. The share of its weight on such
pixels tells floaters and haze from surfaces. The first pass compares with the depth of all Gaussians, of which floaters
are a part; the second one with the depth of those that passed the first. Thin things hang in front of surfaces too: so
only what overlaps with hardly any other Gaussian goes.
"""

import dataclasses
import functools
import math
from collections.abc import Callable

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
_PASSES = ((0.4, 0.03), (0.6, 0.06))
"""Of each pass the share of a Gaussian's weight in front of surfaces from which it is left out of the second pass, and
goes; and the share of the depth by which a surface lies behind what hangs in front of it. Measured with
experiments/clean.py."""
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


def find_litter(
    gaussians: Gaussians, cameras: Camera, progress: Progress = lambda done, total: None
) -> Int8[np.ndarray, " n"]:
    """Finds the kind (`KINDS`) of each of N Gaussians from T views that cover the scene.

    Above `MAX_WHOLE` Gaussians, memory beside them is that of a part of one view.
    """
    count, (view, views) = gaussians.count, _open_views(gaussians, cameras)
    seen = np.ones(count, bool)
    for n, (least, gap) in enumerate(_PASSES):
        front, total, peak = np.zeros((3, count), np.float32)
        cast = functools.partial(view, seen, gap)
        found = each_view(count, views, cast, lambda done, _, n=n: progress(n * views + done, 2 * views))
        for rows, own_front, own_total, own_peak in found:
            front[rows] += own_front
            total[rows] += own_total
            peak[rows] = np.maximum(peak[rows], own_peak)
        seen = front < least * np.maximum(total, 1e-30)
    hanging = np.flatnonzero(~seen)
    hanging = hanging[_is_apart(gaussians, peak, hanging)]
    kinds = np.zeros(count, np.int8)
    kinds[hanging] = np.where(peak[hanging] < HAZE, 3, 4)
    return np.where(peak <= 0, 1, np.where(peak < FAINT, 2, kinds)).astype(np.int8)


def _is_apart(
    gaussians: Gaussians, peak: Float[np.ndarray, " n"], rows: Int[np.ndarray, " m"]
) -> Bool[np.ndarray, " m"]:
    """Tells which of some Gaussians overlap with fewer than `_COMPANY` others that are no haze."""
    means, reach = np.asarray(gaussians.means, np.float32), np.exp(np.asarray(gaussians.log_scales).max(1))
    solid = np.append(np.flatnonzero(peak >= HAZE), 0)  # the last stands for one that is missing, infinitely far
    distance, near = KDTree(means[solid[:-1]]).query(means[rows], _NEIGHBOURS)
    others = solid[near]
    touching = distance <= np.where(peak[rows] < HAZE, *_REACH)[:, None] * (reach[others] + reach[rows, None])
    return (touching & (others != rows[:, None])).sum(1) < _COMPANY


def _open_views(gaussians: Gaussians, cameras: Camera) -> tuple[Callable, int]:
    """Makes a function that returns `_view` of a view, and counts the views; those of a large scene are parts of views.

    It takes which Gaussians are seen, the gap, and the number of the view.
    """
    if gaussians.count <= MAX_WHOLE:  # once for all views
        whole = jax.device_put(dataclasses.replace(gaussians, sh=None))
        return lambda seen, gap, t: _view(whole, seen, cameras[t], gap), len(cameras)
    side, room = math.ceil(math.sqrt(gaussians.count / _PART)), [0, 0]
    parts, visible = _divided(cameras, side), functools.lru_cache(1)(lambda t: visible_part(gaussians, cameras[t]))

    def view(seen: np.ndarray, gap: float, t: int) -> tuple[np.ndarray, ...]:
        rows, of_view = visible(t // side**2)
        ids, part = visible_part(of_view, parts[t], least=room[0])
        # The largest numbers of Gaussians and of their pairs so far, so that parts share programs.
        room[:] = part.count, max(room[1], plan_capacity(part, parts[t], margin=1.0, devices=1))
        inside, *columns = _view(part, np.pad(seen[rows[ids]], (0, part.count - len(ids))), parts[t], gap, room[1])
        return rows[ids[inside]], *columns

    return view, len(parts)


def _divided(cameras: Camera, side: int) -> Camera:
    """Divides T views into side^2 T of one size; neighbours overlap where a view is no multiple of `side`."""
    whole, part = (cameras.width, cameras.height), (-(-cameras.width // side), -(-cameras.height // side))
    starts = [[min(k * p, w - p) for k in range(side)] for w, p in zip(whole, part)]
    moved = [dataclasses.replace(cameras, cx=cameras.cx - x, cy=cameras.cy - y) for x in starts[0] for y in starts[1]]
    parts = jax.tree.map(lambda *parts: np.stack(parts, 1).reshape(-1, *parts[0].shape[1:]), *moved)
    return dataclasses.replace(parts, width=part[0], height=part[1])


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
