"""Refines the poses and exposures of a capture before a fit, and drops frames that no scene explains. Host code.

A probe is a short fit with corrections (corrections.py); it measures how far each frame is off. The result is a capture
again, in the same world, with its frames as under one exposure.

If the frames have depth, the cameras are first aligned to each other by colour and depth (alignment.py), provided that
the frames then agree better: one probe is enough after that. Otherwise points from depth lie where the wrong pose of
their frame puts them, and keep it there. So such a probe starts from few points, which several frames must share,
and each further probe starts from points made with the poses of the one before. The first probes see small frames and
end as soon as the poses are stable; the last sees larger ones.

`decide` corrects only if it helps, measured on training frames kept aside: a first probe with corrections and one
without are fitted to the other training frames and compared on these. A frame kept aside is aligned to either frozen
probe on half of its pixels and compared on the other half, so that alignment alone has no advantage. Held-out frames
have no part in the probes or in the decision. They are aligned to the last probe once it is frozen, each by its pose
and exposure, as methods that refine poses are measured (Lin et al. 2021, BARF, section 4.2).
"""

import dataclasses
import math
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jsecon.errors import require
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
from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.fit.schedule import LearningRates, Schedule
from jsecon.fit.start import starting_gaussians
from jsecon.fit.step import cameras_extent
from jsecon.poses.alignment import align_cameras
from jsecon.splat.render import render_rgb
from jsecon.types import Array, Camera, Capture, Gaussians, Progress

VISITS = 30
"""Visits of each frame by a probe."""
MIN_VISITS = 6
"""Visits below which poses do not become stable."""
PROBES = 4
"""Maximum number of probes, one after the other."""
PROBE_POINTS = 12_000
"""Maximum number of points from depth that a probe starts from."""
ALIGN_VISITS = 120
"""Visits of each held-out frame while it is aligned to the last probe."""
DECIDE_VISITS = 24
"""Visits of each frame kept aside while it is aligned to a probe of the decision."""
FINE_SIZE = 0.5
"""Size of the frames in the last probe, which measures as well as full size in half the time."""
COARSE_PX = 100
"""Longer side in px of the frames in the probes before the last."""
MIN_COARSE_SIZE = 0.25
"""Smallest size of the frames in these probes."""
STABLE_PX = 0.25
"""Median movement of the image by a probe, px at full size, below which the poses are stable."""
MIN_GAIN_DB = 0.5
"""PSNR that corrections must gain on the frames kept aside. In the demo's room they gain 0.1 dB without errors,
0.9 if poses are off by 3 mm and 0.15 degrees, and 2 to 3 at three times as much."""
MIN_ASIDE, MAX_ASIDE = 2, 8
"""Number of training frames kept aside for the decision, a third of all at most."""
ALIGNED_POSE_RATE = 1e-4
"""First step of poses that depth has aligned already, radians: what is left is small."""
CHESS_SQUARES = 8
"""Squares of the chessboard on which frames kept aside are compared, along each side of a frame."""
TOO_MANY = (
    "{} frames are too many to correct them within half of the fit's time (use more --steps, fewer --frames, or "
    "--refine both, which takes longer)"
)
_STEP_COST_PIXELS, _STEP_COST_GAUSSIANS = 0.46, 0.072
"""Time of a step of a probe in steps of the fit: for frames of full size, and for its Gaussians."""
_DEPTH_ALIGNMENT_COST = 1.0
"""Time to align a frame by colour and depth, in steps of the fit."""
_REFINE = RefineOptions()
_NO_CORRECTION = RefineOptions(poses=False, exposure=False)
"""Options of a probe without corrections that shares the program of a probe with them."""
_FROZEN = LearningRates(means=0.0, means_last=0.0, log_scales=0.0, quaternions=0.0, opacity_logits=0.0, colors=0.0)


class _Plan(NamedTuple):
    """Sizes and lengths of the probes."""

    coarse_size: float
    """Size of the frames in all probes but the last."""
    probes: int
    visits: int
    """Visits of each frame by each probe."""


def _plan_probes(
    capture: Capture,
    refine: RefineOptions | None,
    *,
    visits: int,
    probes: int,
    decide: bool,
    max_fit_steps: float | None,
) -> _Plan | None:
    """Plans as many visits as fit into the time of `max_fit_steps` steps; None if these are below MIN_VISITS."""
    held_out = np.asarray(capture.held_out)
    train = int((~held_out).sum())
    aligned = int(held_out.sum()) if refine is not None else 0
    coarse_size = min(FINE_SIZE, max(MIN_COARSE_SIZE, COARSE_PX / max(capture.cameras.width, capture.cameras.height)))
    probes = probes if refine is not None and refine.poses else 1
    coarse, fine = (_STEP_COST_PIXELS * size**2 + _STEP_COST_GAUSSIANS for size in (coarse_size, FINE_SIZE))
    # The decision takes one probe more, without corrections; two more if there is only one otherwise.
    per_visit = train * (fine + coarse * (probes - 1 + decide + (decide and probes == 1)))
    fixed = ALIGN_VISITS * aligned * fine + DECIDE_VISITS * min(MAX_ASIDE, train // 3) * coarse * 2 * decide
    if capture.depths is not None:
        fixed += _DEPTH_ALIGNMENT_COST * len(held_out) * (1 + decide)
    # Alignments are never shortened: an unfinished pose would spoil the measurement of a held-out frame.
    allowed = visits if max_fit_steps is None else min(visits, int((max_fit_steps - fixed) / per_visit))
    if allowed < min(MIN_VISITS, visits):
        return None
    return _Plan(coarse_size, probes, max(1, allowed))


@dataclasses.dataclass
class _Prober:
    """Runs the probes of one capture and reports their progress."""

    key: PRNGKeyArray
    start: Gaussians | None
    total: int
    progress: Progress | None
    done: int = 0

    def initial(self, capture: Capture) -> Gaussians:
        """Gaussians that a probe of this capture starts from."""
        return starting_gaussians(capture, max_points=PROBE_POINTS)[0] if self.start is None else self.start

    def report(self, done: int) -> None:
        if self.progress is not None:
            self.progress(min(done, self.total), self.total)

    def fit(
        self,
        capture: Capture,
        start: Gaussians,
        refine: RefineOptions | None,
        size: float,
        steps: int,
        rates: LearningRates | None = None,
    ) -> tuple[Gaussians, Corrections]:
        """A short fit to frames of this size, and the corrections of all frames; identity without refinement."""
        states: list[FitState] = []
        # Soft Gaussians render a depth before the surface: as a target, depth would push every camera back.
        capture = capture if refine is None else dataclasses.replace(capture, depths=None)
        if capture.ignored is None:  # one program serves probes and alignments on parts of a frame
            ignored = np.broadcast_to(False, np.shape(capture.frames)[:3])
            capture = dataclasses.replace(capture, ignored=ignored)
        before, self.done = self.done, self.done + steps
        scene, _ = fit_gaussians(
            capture,
            key=self.key,
            steps=steps,
            start=start,
            refine=refine,
            rates=LearningRates() if rates is None else rates,
            schedule=Schedule(sizes=((size, 1.0),), max_gaussians=0),
            on_checkpoint=lambda state: states.__setitem__(slice(None), [state]),
            progress=lambda done, _: self.report(before + done),
        )
        corrections = states[0].corrections
        if corrections is None:
            return scene, identity_corrections(len(capture.names))
        return scene, jax.tree.map(np.asarray, corrections.current)

    def align(
        self,
        capture: Capture,
        scene: Gaussians,
        corrections: Corrections,
        frames: Bool[np.ndarray, " t"],
        refine: RefineOptions | None,
        size: float,
        visits: int,
    ) -> Corrections:
        """The corrections, with those of `frames` replaced by alignment to the frozen scene."""
        only = dataclasses.replace(capture, held_out=~frames)
        _, aligned = self.fit(only, scene, refine, size, visits * int(frames.sum()), _FROZEN)

        def pick(a, b):
            return np.where(frames.reshape(-1, *[1] * (a.ndim - 1)), b, a)

        return jax.tree.map(pick, corrections, aligned)


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
    progress: Progress | None = None,
) -> Capture:
    """Corrects the poses and exposures of a capture by short fits, and drops frames that these do not explain.

    The world stays the same: the rigid motion that brings the training cameras nearest to their original places is
    removed from all corrections, and the mean colour map becomes the identity. A corrected frame is clipped to 8 bits;
    white pixels that become darker are `ignored`.

    Args:
      capture: Frames with the poses to correct. Held-out frames have no part in the probes.
      start: Gaussians that each probe starts from. By default points made with the poses of the probe before.
      key: Key of the order of the frames.
      refine: What to correct, or None.
      drop_weak: Whether to drop training frames that the last probe does not explain (`quality.is_weak`).
      decide: Whether to correct only if that lowers the error of training frames kept aside.
      max_fit_steps: Limits the probes to about the time of so many steps of the fit, by fewer visits. If that leaves
        too few of them, the capture stays as it is.
      visits: Visits of each frame by each probe.
      probes: Maximum number of probes; one if no pose is refined.
      progress: Called with the number of steps done and of all.

    Returns:
      The corrected capture; its notes say what was done and why. Without `refine` and `drop_weak` the capture itself.

    Raises:
      ValueError: `visits` or `probes` is below 1.
      InputError: A probe does not converge.
    """
    if refine is None and not drop_weak:
        return capture
    require(visits > 0, "visits", visits, "at least 1", f"{VISITS} are usual.")
    require(probes > 0, "probes", probes, "at least 1", f"{PROBES} are usual.")
    original, train, notes = capture, ~np.asarray(capture.held_out), []
    aligned = None
    if refine is not None and refine.poses and capture.depths is not None:
        aligned = _align_by_depth(capture, train, ~train)
    by_depth = aligned is not None
    if refine is not None and by_depth:
        probes, refine = 1, dataclasses.replace(refine, pose_rate=ALIGNED_POSE_RATE)
    plan = _plan_probes(capture, refine, visits=visits, probes=probes, decide=decide, max_fit_steps=max_fit_steps)
    if plan is None:
        refine, plan = None, _Plan(FINE_SIZE, 1, visits)
        notes.append(f"poses and exposures stay as they are: {TOO_MANY.format(len(capture.names))}")
    steps = plan.visits * int(train.sum())
    held_out = int((~train).sum()) if refine is not None else 0
    prober = _Prober(key, start, steps * (plan.probes + 2 * decide) + ALIGN_VISITS * held_out, progress)
    remaining = plan.probes
    if decide and refine is not None:
        decision = _decide(capture, prober, refine, plan, by_depth=by_depth)
        notes.append(decision.note)
        if decision.corrections is None:
            refine, remaining = None, 1
        elif remaining > 1:
            capture = _apply(capture, decision.corrections, dataclasses.replace(refine, exposure=False))
            remaining -= 1
    if refine is None and not drop_weak:
        return dataclasses.replace(original, notes=(*original.notes, *notes))
    capture = aligned if aligned is not None and refine is not None else capture
    while refine is not None and remaining > 1:
        scene, corrections = prober.fit(capture, prober.initial(capture), refine, plan.coarse_size, steps)
        before, capture = capture, _apply(capture, corrections, dataclasses.replace(refine, exposure=False))
        stable = _median_shift_px(scene, before.cameras[train], capture.cameras[train]) < STABLE_PX
        remaining = 1 if stable else remaining - 1
    scene, corrections = prober.fit(capture, prober.initial(capture), refine, FINE_SIZE, steps)
    if held_out:
        corrections = prober.align(capture, scene, corrections, ~train, refine, FINE_SIZE, ALIGN_VISITS)
    # In the world and the colours of the probe.
    as_probed = _apply(capture, corrections, refine, keep_world=False)
    dropped = _weak_frames(scene, as_probed) if drop_weak else np.zeros(0, int)
    refined = _apply(capture, corrections, refine)
    prober.report(prober.total)
    notes = (*original.notes, *notes, *_describe(original, refined, corrections, refine, by_depth=by_depth))
    return _without_frames(dataclasses.replace(refined, notes=notes), dropped)


def _align_by_depth(capture: Capture, train: Bool[np.ndarray, " t"], others: Bool[np.ndarray, " t"]) -> Capture | None:
    """Aligns the training cameras to each other, then the others to them, in one world; None if it does not help."""
    poses = np.asarray(capture.cameras.world_to_camera, np.float64)
    moved = align_cameras(capture, train)
    if moved is None:
        return None
    moved = moved @ _rigid_drift(moved[train], poses[train], cameras_extent(capture.cameras[train]))
    aligned = _with_poses(capture, moved)
    moved = align_cameras(aligned, others, train)
    return aligned if moved is None else _with_poses(aligned, moved)


def _with_poses(capture: Capture, poses: Float[np.ndarray, "t 4 4"]) -> Capture:
    cameras = dataclasses.replace(capture.cameras, world_to_camera=poses.astype(np.float32))
    return dataclasses.replace(capture, cameras=cameras)


class _Decision(NamedTuple):
    """Whether corrections help."""

    corrections: Corrections | None
    """Corrections of the training frames; None if they do not help."""
    note: str


def _decide(capture: Capture, prober: _Prober, refine: RefineOptions, plan: _Plan, *, by_depth: bool) -> _Decision:
    """Compares a probe with corrections and one without on training frames kept aside."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    count = min(MAX_ASIDE, len(train) // 3)
    too_few = "poses and exposures stay as they are: there are too few training frames to test on some of them"
    if count < MIN_ASIDE:
        return _Decision(None, too_few)
    aside = np.zeros(len(capture.names), bool)
    aside[train[((np.arange(count) + 0.5) * len(train) / count).astype(int)]] = True
    # Frames kept aside are aligned on the squares of one colour of a chessboard, and compared on the others.
    rows, columns = (np.arange(length) * CHESS_SQUARES // length for length in np.shape(capture.frames)[1:3])
    even = np.add.outer(rows, columns) % 2 == 0
    ignored = np.zeros(np.shape(capture.frames)[:3], bool) if capture.ignored is None else np.asarray(capture.ignored)
    held_out = np.asarray(capture.held_out) | aside
    half = dataclasses.replace(capture, ignored=ignored | (even & aside[:, None, None]), held_out=held_out)
    steps = plan.visits * int((~held_out).sum())
    aligned = (_align_by_depth(half, ~held_out, aside) if by_depth else None) or half
    size = plan.coarse_size
    scene, corrections = prober.fit(aligned, prober.initial(aligned), refine, size, steps)
    plain_scene, _ = prober.fit(half, prober.initial(half), _NO_CORRECTION, size, steps)
    corrections = prober.align(aligned, scene, corrections, aside, refine, size, DECIDE_VISITS)
    plain = prober.align(half, plain_scene, identity_corrections(len(aside)), aside, refine, size, DECIDE_VISITS)
    counted = even & ~ignored
    corrected_db = _mean_psnr(scene, aligned, corrections, aside, counted, size)
    plain_db = _mean_psnr(plain_scene, capture, plain, aside, counted, size)
    if math.isnan(corrected_db):  # every pixel to compare is ignored
        return _Decision(None, too_few)
    helps = corrected_db >= plain_db + MIN_GAIN_DB
    verdict = "are corrected" if helps else "stay as they are"
    note = (
        f"poses and exposures {verdict}: training frames kept aside have {corrected_db:.1f} dB in a short fit with "
        f"corrections, {plain_db:.1f} dB in one without"
    )
    return _Decision(corrections if helps else None, note)


def _mean_psnr(
    scene: Gaussians,
    capture: Capture,
    corrections: Corrections,
    frames: Bool[np.ndarray, " t"],
    counted: Bool[np.ndarray, "t h w"],
    size: float,
) -> float:
    """Mean PSNR (dB) of the chosen frames on the counted pixels, rendered with their corrections at this size."""
    cameras, values = scale_cameras(capture.cameras, size), []
    scene = jax.device_put(scene)
    for t in np.flatnonzero(frames):
        correction = jax.tree.map(lambda a, t=t: jnp.asarray(a[t]), corrections)
        camera = corrected_camera(jax.tree.map(jnp.asarray, cameras[int(t)]), correction.twists)
        image = np.clip(apply_exposure(render_rgb(scene, camera).features, correction.colours), 0, 1)
        frame = resize_frame(np.asarray(capture.frames[t]), cameras) / 255.0
        share = cv2.resize(counted[t].astype(np.float32), frame.shape[1::-1], interpolation=cv2.INTER_AREA)
        squares = ((image - frame) ** 2)[share > 0.999]
        if len(squares):
            values.append(-10 * math.log10(max(float(squares.mean()), 1e-10)))
    return float(np.mean(values)) if values else math.nan


def _median_shift_px(scene: Gaussians, before: Camera, after: Camera) -> float:
    """Median over the cameras of the median distance, px, by which their move shifts the Gaussians in view."""
    points, shifts = np.asarray(scene.means, np.float64), []
    for t in range(len(before.fx)):
        (u, v), (moved_u, moved_v) = (_project_points(points, cameras, t) for cameras in (before, after))
        inside = (u >= 0) & (u <= before.width) & (v >= 0) & (v <= before.height)
        distances = np.hypot(moved_u - u, moved_v - v)[inside]
        shifts.append(np.nanmedian(distances) if np.isfinite(distances).any() else 0.0)
    return float(np.median(shifts))


def _project_points(points: Float[np.ndarray, "n 3"], cameras: Camera, t: int) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows (px) of points in camera t; NaN behind it."""
    pose = np.asarray(cameras.world_to_camera[t], np.float64)
    x, y, z = pose[:3, :3] @ points.T + pose[:3, 3:]
    z = np.where(z > 0, z, np.nan)
    return cameras.fx[t] * x / z + cameras.cx[t], cameras.fy[t] * y / z + cameras.cy[t]


def _apply(
    capture: Capture, corrections: Corrections, refine: RefineOptions | None, *, keep_world: bool = True
) -> Capture:
    """Moves the cameras and undoes the exposures; `keep_world` keeps the original world and the mean colours."""
    if refine is None:
        return capture
    train, cameras = ~np.asarray(capture.held_out), capture.cameras
    if refine.poses:
        poses = np.asarray(cameras.world_to_camera, np.float64)
        moved = np.asarray(jax.vmap(se3_exp)(corrections.twists), np.float64) @ poses
        if keep_world:
            moved = moved @ _rigid_drift(moved[train], poses[train], cameras_extent(cameras[train]))
        capture = _with_poses(capture, moved)
    if refine.exposure:
        maps = np.asarray(corrections.colours, np.float64)
        maps = np.concatenate([maps, np.broadcast_to(np.eye(4)[3:], (len(maps), 1, 4))], axis=1)
        maps = maps @ np.linalg.inv(maps[train].mean(axis=0)) if keep_world else maps
        frames = np.asarray(capture.frames)
        ignored = np.zeros(frames.shape[:3], bool) if capture.ignored is None else np.array(capture.ignored)
        corrected = np.empty_like(frames)
        for t, inverse in enumerate(np.linalg.inv(maps)):
            colours = frames[t] @ inverse[:3, :3].T + 255 * inverse[:3, 3]
            corrected[t] = np.rint(np.clip(colours, 0, 255)).astype(np.uint8)
            ignored[t] |= ((frames[t] == 255) & (corrected[t] < 255)).any(axis=-1)
        capture = dataclasses.replace(capture, frames=corrected, ignored=ignored if ignored.any() else None)
    return capture


def _rigid_drift(moved: Float[Array, "t 4 4"], poses: Float[Array, "t 4 4"], extent: float) -> Float[np.ndarray, "4 4"]:
    """Returns the rigid motion of the world that brings moved cameras nearest to their original poses (Umeyama 1991).

    It maps points of the original world into that of the moved cameras. The ends of the cameras' axes, `extent` world
    units long, are matched beside their centres.
    """

    def centre(poses):
        return -np.einsum("tji,tj->ti", poses[:, :3, :3], poses[:, :3, 3])

    a, b = centre(moved), centre(poses)
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    axes = np.einsum("tki,tkj->ij", moved[:, :3, :3], poses[:, :3, :3])
    u, _, vt = np.linalg.svd((a - mean_a).T @ (b - mean_b) + max(extent, 1e-6) ** 2 * axes)
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, mean_a - rotation @ mean_b
    return motion


def _describe(
    before: Capture, after: Capture, corrections: Corrections, refine: RefineOptions | None, *, by_depth: bool
) -> list[str]:
    """How far the frames were off, a sentence each."""
    notes: list[str] = []
    if refine is None:
        return notes
    if refine.poses:
        a, b = (np.asarray(c.cameras.world_to_camera, np.float64) for c in (before, after))
        shift = np.linalg.norm(np.asarray(after.cameras.centres) - np.asarray(before.cameras.centres), axis=1)
        cosine = (np.einsum("tij,tij->t", a[:, :3, :3], b[:, :3, :3]) - 1) / 2
        turn = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        median = f"{np.median(shift):.3g} world units and {np.median(turn):.2g} degrees in the median"
        by = "by colour and depth of their frames, then by a probe fit" if by_depth else "by probe fits"
        notes.append(f"poses refined {by}: {median}, {shift.max():.3g} and {turn.max():.2g} at most")
    if refine.exposure:
        gains = np.asarray(corrections.colours).sum(axis=(1, 2)) / 3  # of white: an affine map may spread a gain
        notes.append(f"exposures evened out: frames were {gains.min():.2f} to {gains.max():.2f} times as bright")
    if np.asarray(before.held_out).any():
        parts = " and ".join(["pose"] * refine.poses + ["exposure"] * refine.exposure)
        notes.append(f"each held-out frame has its {parts} by alignment to the frozen probe, which never saw it")
    return notes


def _weak_frames(gaussians: Gaussians, capture: Capture) -> np.ndarray:
    """Returns the indices of the training frames that a scene fitted to them does not explain (`is_weak`)."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    result = measure_quality(gaussians, capture, frames=train, long_side=QUICK_LONG_SIDE)
    return np.asarray(result.frames)[is_weak(np.asarray(result.psnr))]


def _without_frames(capture: Capture, dropped: np.ndarray) -> Capture:
    """The capture without the frames at these indices."""
    if not len(dropped):
        return capture
    keep = np.setdiff1d(np.arange(len(capture.names)), dropped)

    def take(a):
        return None if a is None else np.asarray(a)[keep]

    names = ", ".join(capture.names[t] for t in dropped)
    return dataclasses.replace(
        capture,
        frames=take(capture.frames),
        cameras=capture.cameras[keep],
        held_out=take(capture.held_out),
        depths=take(capture.depths),
        ignored=take(capture.ignored),
        names=tuple(capture.names[t] for t in keep),
        files=tuple(capture.files[t] for t in keep) if capture.files else (),
        notes=(*capture.notes, f"frames dropped, as a probe fit does not explain them: {names}"),
    )
