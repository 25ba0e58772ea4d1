"""A capture put right before anything is made of it: poses, exposures, and frames that nothing explains.

A probe, a short fit with corrections (corrections.py), says how far each frame is off. What comes of it is a capture
again, its cameras where they stood and its frames as one exposure shows them, for all that follows.

Where frames have depth, the cameras are first aligned to each other by colour and depth (alignment.py), if that makes
the frames agree: then one probe is enough. Otherwise points from depth stand where their own frame's wrong pose puts
them, and hold it there: so a probe has few of them, which several frames must share, and after each of the first probes
the next starts from points made anew with the poses found. The first probes see small frames and end as soon as the
poses settle; the last sees larger ones.

Whether corrections help is decided by `decide` on training frames kept aside: a first probe with corrections and one
without, both fitted to the other training frames, are compared on them. A kept-aside frame is aligned to either probe,
frozen, on half of its pixels, and compared on the other half: so alignment alone wins nothing. Frames held out have no
part in the probes or in that decision; they are aligned to the last probe once it is frozen, each by its own pose and
exposure alone, as methods that refine poses are measured (Lin et al. 2021, BARF, section 4.2).
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jsecon.errors import require
from jsecon.fit.alignment import align_cameras
from jsecon.fit.corrections import (
    Corrections,
    RefineOptions,
    apply_exposure,
    corrected_camera,
    identity_corrections,
    se3_exp,
)
from jsecon.fit.optimise import FitState, fit_gaussians
from jsecon.fit.quality import QUICK_LONG_SIDE, is_weak, measure_quality
from jsecon.fit.schedule import LearningRates, Schedule, resize_cameras, resize_frame
from jsecon.fit.start import starting_gaussians
from jsecon.fit.view import cameras_extent
from jsecon.splat.render import render_rgb
from jsecon.types import Array, Camera, Capture, Gaussians

VISITS, PROBES = 30, 4
"""of each frame by a probe, and probes one after the other at most"""
POINTS = 12_000
"""that a probe starts from at most, where it has more than the capture's sparse ones"""
ALIGNING_VISITS = 120
"""of each frame held out, by its alignment to the last probe"""
DECIDING_VISITS = 24
"""of each frame kept aside, by its alignment to a probe of the decision"""
FINE = 0.5
"""size of the frames in the last probe, which measures as well as all of it here, in half the time"""
COARSE_PX, COARSE_LEAST = 100, 0.25
"""longer side of the frames in the probes before it, px, and their least size as a share of the frames' own"""
SETTLED_PX = 0.25
"""median movement of the picture by a probe, px of the frames' own size, from which on the poses have settled"""
GAIN_DB = 0.5
"""that corrections must win on the frames kept aside. In the demo's room they win 0.1 dB where nothing is wrong, 0.9
where poses are off by 3 mm and 0.15 degrees, 2 to 3 by three times as much (experiments/rough_capture.py)"""
ASIDE = 2, 8
"""training frames kept aside for the decision at least (of three times as many), and at most"""
PLACED_RATE = 1e-4
"""radians, of the first steps of poses that depth has placed already: what is left is small"""
FEWEST_VISITS = 6
"""of each frame by a probe: with fewer the poses do not come to rest"""
SQUARES = 8
"""of the chequerboard on which frames kept aside are compared, along each side of a frame"""
TOO_MANY = (
    "{} frames are too many to correct them within half of the fit's time (use more --steps, fewer --frames, or "
    "--refine both, which takes longer)"
)
_STEP_PIXELS, _STEP_ONCE = 0.46, 0.072
"""time of a probe's step, in steps of the fit: for frames of the fit's size, and for its Gaussians"""
_PLACING_STEPS = 1.0
"""time of aligning a frame by colour and depth, in steps of the fit"""
_REFINE = RefineOptions()
_STILL = RefineOptions(poses=False, exposure=False)
"""of a probe without corrections that shares the program of one with them"""
_FROZEN = LearningRates(means=0.0, means_last=0.0, log_scales=0.0, quaternions=0.0, opacity_logits=0.0, colors=0.0)


class _Plan(NamedTuple):
    """How the probes go."""

    coarse: float
    """size of the frames in all probes but the last"""
    probes: int
    visits: int
    """of each frame by each probe"""


def _planned(
    capture: Capture,
    refine: RefineOptions | None,
    *,
    visits: int,
    probes: int,
    decide: bool,
    max_fit_steps: float | None,
) -> _Plan | None:
    """The probes, with as many visits as fit into the time of `max_fit_steps` steps; None where those are fewer than
    FEWEST_VISITS."""
    held = np.asarray(capture.held_out)
    train, out = int((~held).sum()), int(held.sum()) if refine is not None else 0
    coarse = min(FINE, max(COARSE_LEAST, COARSE_PX / max(capture.cameras.width, capture.cameras.height)))
    probes = probes if refine is not None and refine.poses else 1
    small, large = (_STEP_PIXELS * size**2 + _STEP_ONCE for size in (coarse, FINE))
    # The decision takes a probe more, which sees no corrections; where there is one alone, two.
    each = train * (large + small * (probes - 1 + decide + (decide and probes == 1)))
    fixed = ALIGNING_VISITS * out * large + DECIDING_VISITS * min(ASIDE[1], train // 3) * small * 2 * decide
    if capture.depths is not None:
        fixed += _PLACING_STEPS * len(held) * (1 + decide)
    # Alignments are not cut short: a frame held out would be measured by a pose on its way.
    allowed = visits if max_fit_steps is None else min(visits, int((max_fit_steps - fixed) / each))
    if allowed < min(FEWEST_VISITS, visits):
        return None
    return _Plan(coarse, probes, max(1, allowed))


def refine_capture(
    capture: Capture,
    start: Gaussians | None = None,
    *,
    key: PRNGKeyArray,
    refine: RefineOptions | None = _REFINE,
    drop_weak: bool = False,
    decide: bool = False,
    max_fit_steps: float | None = None,
    visits: int = VISITS,
    probes: int = PROBES,
    progress: Callable[[int, int], None] | None = None,
) -> Capture:
    """Corrects a capture's poses and exposures by short fits, and leaves out frames that these do not explain.

    The world stays where it was: of all corrections the rigid motion that brings the training cameras nearest to where
    they were told to stand is taken back, and colours are such that the mean correction is none. A corrected frame is
    clipped to 8 bits; pixels that were white and come out darker are `ignored`.

    Args:
      capture: Frames with the poses to correct. Frames held out have no part in the probes.
      start: Gaussians that each probe starts from. Without, points made with the poses of the probe before.
      key: Draws the order of the frames.
      refine: What to correct, or None.
      drop_weak: Leave out training frames that the last probe does not explain (`quality.is_weak`).
      decide: Correct only where that lowers the error of training frames kept aside. Otherwise the frames and the
        poses stay as they are.
      max_fit_steps: The probes take at most about the time of so many steps of the fit: fewer visits. Where that
        leaves too few of them, nothing is refined.
      visits: Visits of each frame by each probe.
      probes: Maximum number of probes; one where no pose is refined.
      progress: Called with the number of steps done and of all.

    Returns:
      The corrected capture, whose notes say what was done and why. Without `refine` and `drop_weak` the capture itself.

    Raises:
      ValueError: `visits` or `probes` is below 1.
      InputError: A probe does not converge.
    """
    if refine is None and not drop_weak:
        return capture
    require(visits > 0, "visits", visits, "at least 1", f"{VISITS} are usual.")
    require(probes > 0, "probes", probes, "at least 1", f"{PROBES} are usual.")
    told, train, notes = capture, ~np.asarray(capture.held_out), []
    placed = None
    if refine is not None and refine.poses and capture.depths is not None:
        placed = _placed(capture, train, ~train)
    if placed is not None:
        assert refine is not None
        probes, refine = 1, dataclasses.replace(refine, pose_rate=PLACED_RATE)
    plan = _planned(capture, refine, visits=visits, probes=probes, decide=decide, max_fit_steps=max_fit_steps)
    if plan is None:
        refine, plan = None, _Plan(FINE, 1, visits)
        notes.append(f"poses and exposures stay as they are: {TOO_MANY.format(len(capture.names))}")
    steps, out = plan.visits * int(train.sum()), int((~train).sum()) if refine is not None else 0
    total, done = steps * (plan.probes + 2 * decide) + ALIGNING_VISITS * out, 0

    def probed(capture: Capture, start: Gaussians, refine: RefineOptions | None, size: float, steps: int, **given: Any):
        nonlocal done
        before, done = done, done + steps

        def tell(taken: int, _: int) -> None:
            if progress is not None:
                progress(min(before + taken, total), total)

        return _probed(capture, start, refine, key=key, steps=steps, size=size, progress=tell, **given)

    def begun(capture: Capture) -> Gaussians:
        return starting_gaussians(capture, max_points=POINTS)[0] if start is None else start

    left = plan.probes
    if decide and refine is not None:
        found, better, plain = _compared(capture, begun, refine, plan, probed, by_depth=placed is not None)
        notes.append(_decision(found, better, plain))
        if found is None:
            refine, left = None, 1
        elif left > 1:
            moved = dataclasses.replace(refine, exposure=False)
            capture, left = _corrected(capture, found, moved), left - 1
    if refine is None and not drop_weak:
        return dataclasses.replace(told, notes=(*told.notes, *notes))
    capture = capture if placed is None or refine is None else placed
    while refine is not None and left > 1:
        scene, found = probed(capture, begun(capture), refine, plan.coarse, steps)
        before, capture = capture, _corrected(capture, found, dataclasses.replace(refine, exposure=False))
        still = _moved_px(scene, before.cameras[train], capture.cameras[train]) < SETTLED_PX
        left = 1 if still else left - 1
    probe, found = probed(capture, begun(capture), refine, FINE, steps)
    if out:
        found = _with_aligned(capture, probe, found, ~train, refine, FINE, ALIGNING_VISITS, probed)
    # In the probe's own world and colours.
    left_out = weak_frames(probe, _corrected(capture, found, refine, at_home=False)) if drop_weak else np.zeros(0, int)
    better = _corrected(capture, found, refine)
    if progress is not None:
        progress(total, total)
    notes = (*told.notes, *notes, *_told(told, better, found, refine, by_depth=placed is not None))
    return _without(dataclasses.replace(better, notes=notes), left_out)


def _placed(capture: Capture, train: Bool[np.ndarray, " t"], others: Bool[np.ndarray, " t"]) -> Capture | None:
    """With the cameras of `train` aligned to each other by colour and depth, in the world that they had, and each of
    the `others` to these; None where that does not bring them nearer to each other (`align_cameras`)."""
    given = np.asarray(capture.cameras.world_to_camera, np.float64)
    moved = align_cameras(capture, train)
    if moved is None:
        return None
    moved = moved @ _rigid_drift(moved[train], given[train], cameras_extent(capture.cameras[train]))
    placed = _with_poses(capture, moved)
    moved = align_cameras(placed, others, train)
    return placed if moved is None else _with_poses(placed, moved)


def _with_poses(capture: Capture, poses: Float[np.ndarray, "t 4 4"]) -> Capture:
    cameras = dataclasses.replace(capture.cameras, world_to_camera=poses.astype(np.float32))
    return dataclasses.replace(capture, cameras=cameras)


def _probed(
    capture: Capture, start: Gaussians, refine: RefineOptions | None, *, size: float, **given: Any
) -> tuple[Gaussians, Corrections]:
    """A short fit to frames of this size, and its frames' corrections: none where nothing is refined."""
    last: list[FitState] = []
    # What is rendered of soft Gaussians lies before a surface, and depth as a teacher would push every camera back.
    capture = capture if refine is None else dataclasses.replace(capture, depths=None)
    if capture.ignored is None:  # one program serves probes and alignments on parts of a frame
        capture = dataclasses.replace(capture, ignored=np.broadcast_to(False, np.shape(capture.frames)[:3]))
    keep = lambda state: last.__setitem__(slice(None), [state])
    schedule = Schedule(sizes=((size, 1.0),), max_gaussians=0)
    found, _ = fit_gaussians(capture, start=start, refine=refine, schedule=schedule, on_checkpoint=keep, **given)
    refined = last[0].refined
    return found, identity_corrections(len(capture.names)) if refined is None else jax.tree.map(np.asarray, refined.now)


def _with_aligned(
    capture: Capture,
    probe: Gaussians,
    found: Corrections,
    which: Bool[np.ndarray, " t"],
    refine: RefineOptions | None,
    size: float,
    visits: int,
    probed: Callable[..., tuple[Gaussians, Corrections]],
) -> Corrections:
    """`found`, with the corrections of the frames `which` by alignment to the frozen probe."""
    others = dataclasses.replace(capture, held_out=~which)
    _, aligned = probed(others, probe, refine, size, visits * int(which.sum()), rates=_FROZEN)
    pick = lambda a, b: np.where(which.reshape(-1, *[1] * (a.ndim - 1)), b, a)
    return jax.tree.map(pick, found, aligned)


def _compared(
    capture: Capture,
    start: Callable[[Capture], Gaussians],
    refine: RefineOptions,
    plan: _Plan,
    probed: Callable[..., tuple[Gaussians, Corrections]],
    *,
    by_depth: bool,
) -> tuple[Corrections | None, float, float]:
    """Corrections of the training frames, or None where they do not help; and the mean PSNR (dB) of frames kept aside,
    aligned to a probe with corrections and to one without (NaN where there are too few frames to keep any aside)."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    count = min(ASIDE[1], len(train) // 3)
    if count < ASIDE[0]:
        return None, math.nan, math.nan
    aside = np.zeros(len(capture.names), bool)
    aside[train[((np.arange(count) + 0.5) * len(train) / count).astype(int)]] = True
    # Aligned on the squares of one colour of a chequerboard, compared on the others.
    rows, columns = (np.arange(length) * SQUARES // length for length in np.shape(capture.frames)[1:3])
    even = np.add.outer(rows, columns) % 2 == 0
    ignored = np.zeros(np.shape(capture.frames)[:3], bool) if capture.ignored is None else np.asarray(capture.ignored)
    held_out = np.asarray(capture.held_out) | aside
    half = dataclasses.replace(capture, ignored=ignored | (even & aside[:, None, None]), held_out=held_out)
    steps = plan.visits * int((~held_out).sum())
    placed = (_placed(half, ~held_out, aside) if by_depth else None) or half
    scene, found = probed(placed, start(placed), refine, plan.coarse, steps)
    plain, _ = probed(half, start(half), _STILL, plan.coarse, steps)
    found = _with_aligned(placed, scene, found, aside, refine, plan.coarse, DECIDING_VISITS, probed)
    alike = _with_aligned(
        half, plain, identity_corrections(len(aside)), aside, refine, plan.coarse, DECIDING_VISITS, probed
    )
    seen = even & ~ignored
    better = _mean_psnr(scene, placed, found, aside, seen, plan.coarse)
    without = _mean_psnr(plain, capture, alike, aside, seen, plan.coarse)
    return found if better >= without + GAIN_DB else None, better, without


def _mean_psnr(
    scene: Gaussians,
    capture: Capture,
    found: Corrections,
    which: Bool[np.ndarray, " t"],
    seen: Bool[np.ndarray, "t h w"],
    size: float,
) -> float:
    """Mean PSNR (dB) of the frames `which` on the pixels `seen`, rendered with their corrections at this size."""
    cameras, values = resize_cameras(capture.cameras, size), []
    scene = jax.device_put(scene)
    for t in np.flatnonzero(which):
        own = jax.tree.map(lambda a, t=t: jnp.asarray(a[t]), found)
        camera = corrected_camera(jax.tree.map(jnp.asarray, cameras[int(t)]), own.twists)
        image = np.clip(apply_exposure(render_rgb(scene, camera).features, own.colours), 0, 1)
        frame = resize_frame(np.asarray(capture.frames[t]), cameras) / 255.0
        share = cv2.resize(seen[t].astype(np.float32), frame.shape[1::-1], interpolation=cv2.INTER_AREA)
        squares = ((image - frame) ** 2)[share > 0.999]
        if len(squares):
            values.append(-10 * math.log10(max(float(squares.mean()), 1e-10)))
    return float(np.mean(values)) if values else math.nan


def _decision(found: Corrections | None, better: float, without: float) -> str:
    """Whether poses and exposures are corrected, and why."""
    what = "are corrected" if found is not None else "stay as they are"
    if math.isnan(better):
        return f"poses and exposures {what}: there are too few training frames to test on some of them"
    told = f"training frames kept aside have {better:.1f} dB in a short fit with corrections"
    return f"poses and exposures {what}: {told}, {without:.1f} dB in one without"


def _moved_px(scene: Gaussians, before: Camera, after: Camera) -> float:
    """Median over the cameras of the median distance, px, by which their move shifts the scene's Gaussians in view."""
    points, moved = np.asarray(scene.means, np.float64), []
    for t in range(len(before.fx)):
        (u, v), (other_u, other_v) = (_projected(points, cameras, t) for cameras in (before, after))
        inside = (u >= 0) & (u <= before.width) & (v >= 0) & (v <= before.height)
        shifts = np.hypot(other_u - u, other_v - v)[inside]
        moved.append(np.nanmedian(shifts) if np.isfinite(shifts).any() else 0.0)
    return float(np.median(moved))


def _projected(points: Float[np.ndarray, "n 3"], cameras: Camera, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Where points appear in camera t, px; NaN behind it."""
    pose = np.asarray(cameras.world_to_camera[t], np.float64)
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    z = np.where(z > 0, z, np.nan)
    return cameras.fx[t] * x / z + cameras.cx[t], cameras.fy[t] * y / z + cameras.cy[t]


def _corrected(capture: Capture, found: Corrections, refine: RefineOptions | None, *, at_home: bool = True) -> Capture:
    """Cameras moved, frames with their exposures undone; `at_home`: in the world and the colours that were given."""
    if refine is None:
        return capture
    train, cameras = ~np.asarray(capture.held_out), capture.cameras
    if refine.poses:
        given = np.asarray(cameras.world_to_camera, np.float64)
        moved = np.asarray(jax.vmap(se3_exp)(found.twists), np.float64) @ given
        if at_home:
            moved = moved @ _rigid_drift(moved[train], given[train], cameras_extent(cameras[train]))
        capture = _with_poses(capture, moved)
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


def _rigid_drift(moved: Float[Array, "t 4 4"], given: Float[Array, "t 4 4"], extent: float) -> Float[np.ndarray, "4 4"]:
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


def _told(
    before: Capture, after: Capture, found: Corrections, refine: RefineOptions | None, *, by_depth: bool
) -> list[str]:
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
        by = "by colour and depth of their frames, then by a probe fit" if by_depth else "by probe fits"
        notes.append(f"poses refined {by}: {far}, {shift.max():.3g} and {turn.max():.2g} at most")
    if refine.exposure:
        gains = np.asarray(found.colours).sum(axis=(1, 2)) / 3  # of white: an affine map may spread a gain
        notes.append(f"exposures evened out: frames were {gains.min():.2f} to {gains.max():.2f} times as bright")
    if out.any():
        what = " and ".join(["pose"] * refine.poses + ["exposure"] * refine.exposure)
        notes.append(f"each frame held out has its {what} by alignment to the frozen probe, which never saw it")
    return notes


def weak_frames(gaussians: Gaussians, capture: Capture) -> np.ndarray:
    """Indices of the training frames that a scene fitted to them does not explain (`quality.is_weak`)."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    result = measure_quality(gaussians, capture, frames=train, long_side=QUICK_LONG_SIDE)
    return np.asarray(result.frames)[is_weak(np.asarray(result.psnr))]


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
