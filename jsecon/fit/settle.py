"""A capture put right before anything is made of it: poses, exposures, and frames that nothing explains.

A probe, a short fit with corrections (corrections.py), says how far each frame is off. What comes of it is a capture
again, its cameras where they stood and its frames as one exposure shows them, for all that follows. Points from depth
stand where their own frame's wrong pose puts them, and hold it there: so a probe has few of them, which several frames
must share, and after each of the first probes the next starts from points made anew with the poses found. Frames held
out have no part in the probes; they are aligned to the last once it is frozen, each by its own pose and exposure alone,
as methods that refine poses are measured (Lin et al. 2021, BARF, section 4.2).
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
from jsecon.fit.quality import GLANCE, quality, weak
from jsecon.fit.schedule import LearningRates, Schedule
from jsecon.fit.start import starting_gaussians
from jsecon.fit.view import cameras_extent
from jsecon.types import Array, Capture, Gaussians

VISITS, PROBES = 30, 4
"""of each frame by a probe, and probes one after the other"""
POINTS = 12_000
"""that a probe starts from at most, where it has more than the capture's sparse ones"""
ALIGNING_VISITS = 120
"""of each held-out frame by its alignment"""
SCHEDULE = Schedule(sizes=((0.5, 1.0),), growth="none")
"""of a probe: half the frames' size, which measures as well as all of it here, in half the time"""
_REFINE = Refine()
_FROZEN = LearningRates(means=0.0, means_last=0.0, log_scales=0.0, quaternions=0.0, opacity_logits=0.0, colors=0.0)


def settled(
    capture: Capture,
    start: Gaussians | None = None,
    *,
    key: PRNGKeyArray,
    refine: Refine | None = _REFINE,
    drop_weak: bool = False,
    visits: int = VISITS,
    probes: int = PROBES,
    progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """The capture with its poses and exposures corrected by `probes` probes (one where no pose is refined), without the
    training frames that the last does not explain where `drop_weak` (`quality.weak`); its notes say what was done, and
    how far. Each starts from `start`; without, from what the capture and the poses of the probe before give.

    The world stays where it was: of all corrections the rigid motion that brings the training cameras nearest to where
    they were told to stand is taken back, and colours are such that the mean correction is none. A corrected frame is
    clipped to 8 bits; pixels that were white and come out darker are `ignored`. With neither a refinement nor
    `drop_weak` the capture is returned as it is. Raises InputError where the probe does not converge.
    """
    if refine is None and not drop_weak:
        return capture
    train, out = ~np.asarray(capture.held_out), np.asarray(capture.held_out)
    require(visits > 0, "visits", visits, "at least 1", f"{VISITS} are usual.")
    require(probes > 0, "probes", probes, "at least 1", f"{PROBES} are usual.")
    told, probes = capture, probes if refine is not None and refine.poses else 1
    steps, more = visits * int(train.sum()), ALIGNING_VISITS * int(out.sum()) if refine is not None else 0

    def tell(before: int):
        return lambda done, _: None if progress is None else progress(before + done, probes * steps + more)

    def probed(number: int):
        begun = starting_gaussians(capture, at_most=POINTS)[0] if start is None else start
        return _probed(capture, begun, refine, key=key, steps=steps, progress=tell(number * steps))

    for number in range(probes - 1):
        assert refine is not None
        found = probed(number)[1]
        capture = _corrected(capture, found, dataclasses.replace(refine, exposure=False))
    probe, found = probed(probes - 1)
    if more:
        others = dataclasses.replace(capture, held_out=train)
        _, aligned = _probed(others, probe, refine, key=key, steps=more, rates=_FROZEN, progress=tell(probes * steps))
        pick = lambda a, b: np.where(out.reshape(-1, *[1] * (a.ndim - 1)), b, a)
        found = jax.tree.map(pick, found, aligned)
    # In the probe's own world and colours.
    left = weak_frames(probe, _corrected(capture, found, refine, at_home=False)) if drop_weak else np.zeros(0, int)
    better = _corrected(capture, found, refine)
    better = dataclasses.replace(better, notes=(*capture.notes, *_told(told, better, found, refine)))
    return _without(better, left)


def _probed(capture: Capture, start: Gaussians, refine: Refine | None, **given: Any) -> tuple[Gaussians, Corrections]:
    """A short fit, and its frames' corrections: none where nothing is refined."""
    last: list[FitState] = []
    # What is rendered of soft Gaussians lies before a surface, and depth as a teacher would push every camera back.
    capture = capture if refine is None else dataclasses.replace(capture, depths=None)
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
        notes.append(f"poses refined by probe fits: {far}, {shift.max():.3g} and {turn.max():.2g} at most")
    if refine.exposure:
        gains = np.asarray(found.colours).sum(axis=(1, 2)) / 3  # of white: an affine map may spread a gain
        notes.append(f"exposures evened out: frames were {gains.min():.2f} to {gains.max():.2f} times as bright")
    if out.any():
        what = " and ".join(["pose"] * refine.poses + ["exposure"] * refine.exposure)
        notes.append(f"each frame held out has its {what} by alignment to the frozen probe, which never saw it")
    return notes


def weak_frames(gaussians: Gaussians, capture: Capture) -> np.ndarray:
    """Indices of the training frames that a scene fitted to them does not explain (`quality.weak`)."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    return train[weak(np.asarray(quality(gaussians, capture, frames=train, long_side=GLANCE).psnr))]


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
        files=tuple(capture.files[t] for t in keep) if capture.files else (),
        notes=(*capture.notes, f"left out, as a probe fit does not explain them: {told}"),
    )
