"""A capture put right before anything is made of it: poses, exposures, and frames that nothing explains.

A probe, a short fit with corrections (corrections.py), says how far each frame is off. What comes of it is a capture
again, its cameras where they stood and its frames as one exposure shows them, for all that follows. Frames held out
have no part in the probe; they are aligned to it once it is frozen, each by its own pose and exposure alone, as methods
that refine poses are measured (Lin et al. 2021, BARF, section 4.2).
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jsecon.errors import require
from jsecon.fit.corrections import Corrections, Refine, at_rest, exponential
from jsecon.fit.optimise import FitState, fit_gaussians
from jsecon.fit.quality import quality, weak
from jsecon.fit.schedule import LearningRates, Schedule
from jsecon.fit.view import cameras_extent
from jsecon.types import Array, Capture, Gaussians

VISITS = 60
"""of each frame by the probe"""
ALIGNING_VISITS = 40
"""of each held-out frame by its alignment"""
SCHEDULE = Schedule(sizes=((0.5, 0.7), (1.0, 1.0)), growth="none")
"""of the probe"""
_REFINE = Refine()
_FROZEN = LearningRates(means=0.0, means_last=0.0, log_scales=0.0, quaternions=0.0, opacity_logits=0.0, colors=0.0)


def settled(
    capture: Capture,
    start: Gaussians,
    *,
    key: PRNGKeyArray,
    refine: Refine | None = _REFINE,
    drop_weak: bool = False,
    visits: int = VISITS,
    progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """The capture with its poses and exposures corrected by a probe from `start`, without the training frames that the
    probe does not explain where `drop_weak` (`quality.weak`); its notes say what was done, and how far.

    The world stays where it was: of all corrections the rigid motion that brings the training cameras nearest to where
    they were told to stand is taken back, and colours are such that the mean correction is none. A corrected frame is
    clipped to 8 bits; pixels that were white and come out darker are `ignored`. With neither a refinement nor
    `drop_weak` the capture is returned as it is. Raises InputError where the probe does not converge.
    """
    if refine is None and not drop_weak:
        return capture
    train, out = ~np.asarray(capture.held_out), np.asarray(capture.held_out)
    require(visits > 0, "visits", visits, "at least 1", "60 are usual.")
    steps, more = visits * int(train.sum()), ALIGNING_VISITS * int(out.sum()) if refine is not None else 0
    tell = lambda done, _: None if progress is None else progress(done, steps + more)
    probe, found = _probed(capture, start, refine, key=key, steps=steps, progress=tell)
    if more:
        others = dataclasses.replace(capture, held_out=train)
        tell = lambda done, _: None if progress is None else progress(steps + done, steps + more)
        _, aligned = _probed(others, probe, refine, key=key, steps=more, rates=_FROZEN, progress=tell)
        pick = lambda a, b: np.where(out.reshape(-1, *[1] * (a.ndim - 1)), b, a)
        found = jax.tree.map(pick, found, aligned)
    # In the probe's own world and colours.
    left = weak_frames(probe, _corrected(capture, found, refine, at_home=False)) if drop_weak else np.zeros(0, int)
    better = _corrected(capture, found, refine)
    better = dataclasses.replace(better, notes=(*capture.notes, *_told(capture, better, found, refine)))
    return _without(better, left)


def _probed(capture: Capture, start: Gaussians, refine: Refine | None, **given: Any) -> tuple[Gaussians, Corrections]:
    """A short fit, and its frames' corrections: none where nothing is refined."""
    last: list[FitState] = []
    keep = lambda state: last.__setitem__(slice(None), [state])
    found, _ = fit_gaussians(capture, start=start, refine=refine, schedule=SCHEDULE, on_checkpoint=keep, **given)
    refined = last[0].refined
    return found, at_rest(len(capture.names)) if refined is None else jax.tree.map(np.asarray, refined.now)


def _corrected(capture: Capture, found: Corrections, refine: Refine | None, *, at_home: bool = True) -> Capture:
    """Cameras moved, frames with their exposures undone; `at_home`: in the world and the colours that were given."""
    if refine is None:
        return capture
    train, cameras = ~np.asarray(capture.held_out), capture.cameras
    if refine.poses:
        given = np.asarray(cameras.world_to_camera, np.float64)
        moved = np.asarray(jax.vmap(exponential)(found.twists), np.float64) @ given
        if at_home:
            moved = moved @ _drift(moved[train], given[train], cameras_extent(cameras[train]))
        cameras = dataclasses.replace(cameras, world_to_camera=moved.astype(np.float32))
        capture = dataclasses.replace(capture, cameras=cameras)
    if refine.exposure:
        squared = lambda maps: np.concatenate([maps, np.broadcast_to(np.eye(4)[3:], (len(maps), 1, 4))], axis=1)
        maps = squared(np.asarray(found.colours, np.float64))
        maps = maps @ np.linalg.inv(maps[train].mean(axis=0)) if at_home else maps
        frames = np.asarray(capture.frames)
        ignored = np.zeros(frames.shape[:3], bool) if capture.ignored is None else np.array(capture.ignored)
        settled = np.empty_like(frames)
        for t, back in enumerate(np.linalg.inv(maps)):
            shown = frames[t] @ back[:3, :3].T + 255 * back[:3, 3]
            settled[t] = np.rint(np.clip(shown, 0, 255)).astype(np.uint8)
            ignored[t] |= ((frames[t] == 255) & (settled[t] < 255)).any(axis=-1)
        kept = ignored if ignored.any() else None
        capture = dataclasses.replace(capture, frames=settled, ignored=kept)
    return capture


def _drift(moved: Float[Array, "t 4 4"], given: Float[Array, "t 4 4"], extent: float) -> Float[np.ndarray, "4 4"]:
    """The rigid motion of the world that brings the `moved` cameras nearest to the `given` ones: their centres, and
    their axes as points an extent away (Umeyama 1991). Maps points of the given world to that of the moved ones."""
    centre = lambda poses: -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])
    a, b = centre(moved), centre(given)
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    axes = np.einsum("tki,tkj->ij", moved[:, :3, :3], given[:, :3, :3])
    u, _, vt = np.linalg.svd((a - mean_a).T @ (b - mean_b) + max(extent, 1e-6) ** 2 * axes)
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, mean_a - turn @ mean_b
    return motion


def _told(before: Capture, after: Capture, found: Corrections, refine: Refine | None) -> list[str]:
    """How far the frames were off, a sentence each."""
    notes, out = [], np.asarray(before.held_out)
    if refine is None:
        return notes
    if refine.poses:
        a, b = (np.asarray(c.cameras.world_to_camera, np.float64) for c in (before, after))
        shift = np.linalg.norm(np.asarray(after.cameras.centres) - np.asarray(before.cameras.centres), axis=1)
        cosine = (np.einsum("tij,tij->t", a[:, :3, :3], b[:, :3, :3]) - 1) / 2
        turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        far = f"{np.median(shift):.3g} world units and {np.median(turn):.2g} degrees in the median"
        notes.append(f"poses refined by a probe fit: {far}, {shift.max():.3g} and {turn.max():.2g} at most")
    if refine.exposure:
        gains = np.trace(np.asarray(found.colours)[:, :, :3], axis1=1, axis2=2) / 3
        notes.append(f"exposures evened out: frames were {gains.min():.2f} to {gains.max():.2f} times as bright")
    if out.any():
        what = " and ".join(["pose"] * refine.poses + ["exposure"] * refine.exposure)
        notes.append(f"each frame held out has its {what} by alignment to the frozen probe, which never saw it")
    return notes


def weak_frames(gaussians: Gaussians, capture: Capture) -> np.ndarray:
    """Indices of the training frames that a scene fitted to them does not explain (`quality.weak`)."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    return train[weak(np.asarray(quality(gaussians, capture, frames=train).psnr))]


def _without(capture: Capture, left: np.ndarray) -> Capture:
    """The capture without the frames `left`."""
    if not len(left):
        return capture
    keep = np.setdiff1d(np.arange(len(capture.names)), left)
    take = lambda a: None if a is None else np.asarray(a)[keep]
    told = ", ".join(capture.names[t] for t in left)
    return dataclasses.replace(
        capture,
        frames=take(capture.frames),
        cameras=capture.cameras[keep],
        held_out=take(capture.held_out),
        depths=take(capture.depths),
        ignored=take(capture.ignored),
        names=tuple(capture.names[t] for t in keep),
        notes=(*capture.notes, f"left out, as a probe fit does not explain them: {told}"),
    )
