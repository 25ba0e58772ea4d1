"""Refines the poses and exposures of a capture before a fit. Host code.

A probe is a short fit with corrections (corrections.py); it measures how far each frame is off. The result is a capture
again, in the same world, with its frames as under one exposure.

If the frames have depth, the cameras are first aligned to each other by colour and depth (alignment.py), provided that
the frames then agree clearly better: one probe is enough after that. Otherwise points from depth lie where the wrong
pose of their frame puts them, and keep it there. So such a probe starts from few points, which several frames must
share, and each further probe starts from points made with the poses of the one before. The first probes see small
frames and end as soon as the poses are stable; the last sees larger ones.

With a limit of time, what depth does not align is corrected only if that helps, measured on training frames kept aside:
a first probe with corrections and one without are fitted to the other training frames and compared on these. A frame
kept aside is aligned to either frozen probe on half of its pixels and compared on the other half, so that alignment
alone has no advantage. Held-out frames have no part in the probes or in the decision. They are aligned to the last
probe once it is frozen, each by its pose and exposure, as methods that refine poses are measured (Lin et al. 2021,
BARF, section 4.2).
"""

import dataclasses
import math
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jsecon.fit.corrections import (
    CorrectionRates,
    Corrections,
    apply_exposure,
    corrected_camera,
    identity_corrections,
    se3_exp,
)
from jsecon.fit.optimise import FitState, Schedule, fit_gaussians
from jsecon.fit.resize import resize_frame, scale_cameras
from jsecon.fit.start import starting_gaussians
from jsecon.fit.step import LearningRates, cameras_extent
from jsecon.poses.alignment import align_cameras
from jsecon.splat.render import render_rgb
from jsecon.types import Array, Camera, Capture, Gaussians, Progress

MIN_VISITS = 6
"""Visits below which poses do not become stable."""
ALIGN_VISITS = 120
"""Visits of each held-out frame while it is aligned to the last probe."""
DECIDE_VISITS = 24
"""Visits of each frame kept aside while it is aligned to a probe of the decision."""
FINE_SIZE = 0.5
"""Size of the frames in the last probe, which measures as well as full size in half the time."""
COARSE_PX, MIN_COARSE_SIZE = 100, 0.25
"""Longer side in px of the frames in the probes before the last, and their smallest size."""
MIN_GAIN_DB = 0.5
"""PSNR that corrections must gain on the frames kept aside. In the demo's room they gain 0.1 dB without errors,
0.9 if poses are off by 3 mm and 0.15 degrees, and 2 to 3 at three times as much."""
MAX_SPREAD = 0.08
"""Largest change of the cameras' extent by depth, as a share. Rough poses of made-up rooms change it by 0.005."""
MIN_ASIDE, MAX_ASIDE = 2, 8
"""Number of training frames kept aside for the decision, a third of all at most."""
_STEP_COST_PIXELS, _STEP_COST_GAUSSIANS = 0.46, 0.072
"""Time of a step of a probe in steps of the fit: for frames of full size, and for its Gaussians."""

_UNCHANGED = "poses and exposures stay as they are"


class _Plan(NamedTuple):
    """Sizes and lengths of the probes."""

    coarse_size: float
    """Size of the frames in all probes but the last."""
    probes: int
    visits: int
    """Visits of each frame by each probe."""


def _plan_probes(
    capture: Capture, visits: int, probes: int, max_fit_steps: float | None, *, decide: bool
) -> _Plan | None:
    """Plans as many visits as fit into the time of `max_fit_steps` steps; None if these are below MIN_VISITS."""
    held_out = np.asarray(capture.held_out)
    train = int((~held_out).sum())
    coarse_size = min(FINE_SIZE, max(MIN_COARSE_SIZE, COARSE_PX / max(capture.cameras.width, capture.cameras.height)))
    if max_fit_steps is None:
        return _Plan(coarse_size, probes, visits)
    coarse, fine = (_STEP_COST_PIXELS * size**2 + _STEP_COST_GAUSSIANS for size in (coarse_size, FINE_SIZE))
    # The decision takes one probe more, without corrections; two more if there is only one otherwise.
    per_visit = train * (fine + coarse * (probes - 1 + decide * (1 + (probes == 1))))
    fixed = ALIGN_VISITS * int(held_out.sum()) * fine
    fixed += decide * DECIDE_VISITS * min(MAX_ASIDE, train // 3) * coarse * 2
    if capture.depths is not None:  # to align a frame by colour and depth takes about a step of the fit
        fixed += 2 * len(held_out)
    # Alignments are never shortened: an unfinished pose would spoil the measurement of a held-out frame.
    allowed = min(visits, int((max_fit_steps - fixed) / per_visit))
    return None if allowed < min(MIN_VISITS, visits) else _Plan(coarse_size, probes, max(1, allowed))


@dataclasses.dataclass
class _Prober:
    """Runs the probes of one capture and reports their progress."""

    key: PRNGKeyArray
    start: Gaussians | None
    refine: CorrectionRates
    total: int
    progress: Progress | None
    done: int = 0

    def report(self, done: int) -> None:
        if self.progress is not None:
            self.progress(min(done, self.total), self.total)

    def fit(
        self, capture: Capture, size: float, steps: int, frozen: Gaussians | None = None, *, corrects: bool = True
    ) -> tuple[Gaussians, Corrections]:
        """A short fit to frames of this size, and the corrections of all frames; of a `frozen` scene these alone."""
        states: list[FitState] = []
        start, rates = self.start if frozen is None else frozen, LearningRates()
        if start is None:
            start = starting_gaussians(capture, max_points=12_000)[0]
        if frozen is not None:
            still = dict.fromkeys(("log_scales", "quaternions", "opacity_logits", "colors"), 0.0)
            rates = LearningRates(means=0.0, means_last=0.0, **still)
        # Soft Gaussians render a depth before the surface: as a target, depth would push every camera back.
        ignored = capture.ignored
        if ignored is None:  # one program serves probes and alignments on parts of a frame
            ignored = np.broadcast_to(False, np.shape(capture.frames)[:3])
        before, self.done = self.done, self.done + steps
        scene, _ = fit_gaussians(
            dataclasses.replace(capture, depths=None, ignored=ignored),
            key=self.key,
            steps=steps,
            start=start,
            refine=self.refine if corrects else CorrectionRates(0.0, 0.0),  # which shares the program
            rates=rates,
            schedule=Schedule(sizes=((size, 1.0),), max_gaussians=0),
            on_checkpoint=lambda state: states.__setitem__(slice(None), [state]),
            progress=lambda done, _: self.report(before + done),
        )
        return scene, jax.tree.map(np.asarray, states[0].train.corrections.current)

    def align(
        self, capture: Capture, scene: Gaussians, corrections: Corrections, frames: np.ndarray, size: float, visits: int
    ) -> Corrections:
        """The corrections, with those of `frames` (T,) replaced by alignment to the frozen scene."""
        only = dataclasses.replace(capture, held_out=~frames)
        _, aligned = self.fit(only, size, visits * int(frames.sum()), scene)

        def pick(a, b):
            return np.where(frames.reshape(-1, *[1] * (a.ndim - 1)), b, a)

        return jax.tree.map(pick, corrections, aligned)


def refine_capture(
    capture: Capture,
    start: Gaussians | None = None,
    *,
    key: PRNGKeyArray,
    max_fit_steps: float | None = None,
    visits: int = 30,
    probes: int = 4,
    progress: Progress | None = None,
) -> Capture:
    """Corrects the poses and exposures of a capture by short fits; its notes say what was done and why.

    The world stays the same: the rigid motion that brings the training cameras nearest to their original places is
    removed from all corrections, and the mean colour map becomes the identity. A corrected frame is clipped to 8 bits;
    white pixels that become darker are `ignored`.

    Args:
      capture: Frames with the poses to correct. Held-out frames have no part in the probes.
      start: Gaussians that each probe starts from. By default points made with the poses of the probe before.
      key: Key of the order of the frames.
      max_fit_steps: Corrects in about the time of so many steps of the fit, by fewer visits, and only if depth aligns
        the frames or corrections lower the error of training frames kept aside. If too few visits are left, the capture
        stays as it is or as depth aligns it. None corrects in any case.
      visits: Visits of each frame by each probe, at least 1.
      probes: Maximum number of probes, at least 1.
      progress: Called with the number of steps done and of all.
    """
    original, train = capture, ~np.asarray(capture.held_out)
    aligned = None if capture.depths is None else _align_by_depth(capture, train, ~train)
    by_depth, refine = aligned is not None, CorrectionRates()
    decide = max_fit_steps is not None and not by_depth
    if aligned is not None:
        capture, probes, refine = aligned, 1, CorrectionRates(pose=1e-4)  # what is left after depth is small
    plan = _plan_probes(capture, visits, probes, max_fit_steps, decide=decide)
    if plan is None:
        problem = f"{len(capture.names)} frames are too many to correct them within half of the fit's time"
        remedy = "use more --steps, fewer --frames, or --refine always, which takes longer"
        what = "poses are refined by colour and depth of their frames alone" if by_depth else _UNCHANGED
        return _with_notes(capture, f"{what}: {problem} ({remedy})")
    steps, held_out = plan.visits * int(train.sum()), int((~train).sum())
    prober = _Prober(key, start, refine, steps * (plan.probes + 2 * decide) + ALIGN_VISITS * held_out, progress)
    remaining, notes = plan.probes, []
    if decide:
        corrections, note = _decide(capture, prober, plan)
        if corrections is None:
            return _with_notes(capture, note)
        notes.append(note)
        if remaining > 1:
            capture, remaining = _move_cameras(capture, corrections), remaining - 1
    extent = max(cameras_extent(capture.cameras[train]), 1e-6)
    while remaining > 1:
        _, corrections = prober.fit(capture, plan.coarse_size, steps)
        before, capture = capture, _move_cameras(capture, corrections)
        shift, turn = _pose_changes(before.cameras[train], capture.cameras[train])
        pixels = np.asarray(capture.cameras.fx)[train] * np.hypot(shift / extent, turn)
        remaining = 1 if np.median(pixels) < 0.25 else remaining - 1  # px at full size: the poses are stable
    scene, corrections = prober.fit(capture, FINE_SIZE, steps)
    if held_out:
        corrections = prober.align(capture, scene, corrections, ~train, FINE_SIZE, ALIGN_VISITS)
    refined = _even_exposures(_move_cameras(capture, corrections), corrections)
    prober.report(prober.total)
    return _with_notes(refined, *notes, *_describe(original, refined, corrections, by_depth=by_depth))


def _with_notes(capture: Capture, *notes: str) -> Capture:
    return dataclasses.replace(capture, notes=(*capture.notes, *notes))


def _align_by_depth(capture: Capture, train: Bool[np.ndarray, " t"], others: Bool[np.ndarray, " t"]) -> Capture | None:
    """Aligns the training cameras to each other, then the others to them, in one world; None if it does not help.

    It does not either where it spreads the cameras or draws them together: the depth then has another unit.
    """
    poses = np.asarray(capture.cameras.world_to_camera, np.float64)
    moved = align_cameras(capture, train)
    if moved is None:
        return None
    before, after = (cameras_extent(_with_poses(capture, each).cameras[train]) for each in (poses, moved))
    if not abs(after - before) <= MAX_SPREAD * before:
        return None
    moved = moved @ _rigid_drift(moved[train], poses[train], cameras_extent(capture.cameras[train]))
    aligned = _with_poses(capture, moved)
    moved = align_cameras(aligned, others, train)
    return aligned if moved is None else _with_poses(aligned, moved)


def _with_poses(capture: Capture, poses: Float[np.ndarray, "t 4 4"]) -> Capture:
    cameras = dataclasses.replace(capture.cameras, world_to_camera=poses.astype(np.float32))
    return dataclasses.replace(capture, cameras=cameras)


def _decide(capture: Capture, prober: _Prober, plan: _Plan) -> tuple[Corrections | None, str]:
    """Compares a probe with corrections and one without on training frames kept aside.

    Returns:
      Corrections of the training frames, None if they do not help; and a note.
    """
    train = np.flatnonzero(~np.asarray(capture.held_out))
    count = min(MAX_ASIDE, len(train) // 3)
    too_few = f"{_UNCHANGED}: there are too few training frames to test on some of them"
    if count < MIN_ASIDE:
        return None, too_few
    aside = np.zeros(len(capture.names), bool)
    aside[train[((np.arange(count) + 0.5) * len(train) / count).astype(int)]] = True
    # Frames kept aside are aligned on the squares of one colour of a chessboard, and compared on the others.
    rows, columns = (np.arange(length) * 8 // length for length in np.shape(capture.frames)[1:3])
    even = np.add.outer(rows, columns) % 2 == 0
    ignored = np.zeros(np.shape(capture.frames)[:3], bool) if capture.ignored is None else np.asarray(capture.ignored)
    held_out = np.asarray(capture.held_out) | aside
    half = dataclasses.replace(capture, ignored=ignored | (even & aside[:, None, None]), held_out=held_out)
    steps = plan.visits * int((~held_out).sum())
    size = plan.coarse_size
    scene, corrections = prober.fit(half, size, steps)
    plain_scene, _ = prober.fit(half, size, steps, corrects=False)
    corrections = prober.align(half, scene, corrections, aside, size, DECIDE_VISITS)
    plain = prober.align(half, plain_scene, identity_corrections(len(aside)), aside, size, DECIDE_VISITS)
    counted = even & ~ignored
    corrected_db = _mean_psnr(scene, capture, corrections, aside, counted, size)
    plain_db = _mean_psnr(plain_scene, capture, plain, aside, counted, size)
    if math.isnan(corrected_db):  # every pixel to compare is ignored
        return None, too_few
    helps = corrected_db >= plain_db + MIN_GAIN_DB
    verdict = "poses and exposures are corrected" if helps else _UNCHANGED
    note = (
        f"{verdict}: training frames kept aside have {corrected_db:.1f} dB in a short fit with "
        f"corrections, {plain_db:.1f} dB in one without"
    )
    return corrections if helps else None, note


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


def _pose_changes(before: Camera, after: Camera) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """Shifts (world units) and turns (radians) between the poses of cameras."""
    a, b = (np.asarray(cameras.world_to_camera, np.float64) for cameras in (before, after))
    shift = np.linalg.norm(np.asarray(after.centres) - np.asarray(before.centres), axis=1)
    difference = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2))
    return shift, 2 * np.arcsin(np.minimum(difference / math.sqrt(8), 1))


def _move_cameras(capture: Capture, corrections: Corrections) -> Capture:
    """Moves the cameras by their corrections, in the original world."""
    train, poses = ~np.asarray(capture.held_out), np.asarray(capture.cameras.world_to_camera, np.float64)
    moved = np.asarray(jax.vmap(se3_exp)(corrections.twists), np.float64) @ poses
    drift = _rigid_drift(moved[train], poses[train], cameras_extent(capture.cameras[train]))
    return _with_poses(capture, moved @ drift)


def _even_exposures(capture: Capture, corrections: Corrections) -> Capture:
    """Undoes the exposures, with the mean colour map of the training frames kept."""
    maps = np.asarray(corrections.colours, np.float64)
    maps = np.concatenate([maps, np.broadcast_to(np.eye(4)[3:], (len(maps), 1, 4))], axis=1)
    maps = maps @ np.linalg.inv(maps[~np.asarray(capture.held_out)].mean(axis=0))
    frames = np.asarray(capture.frames)
    ignored = np.zeros(frames.shape[:3], bool) if capture.ignored is None else np.array(capture.ignored)
    corrected = np.empty_like(frames)
    for t, inverse in enumerate(np.linalg.inv(maps)):
        colours = frames[t] @ inverse[:3, :3].T + 255 * inverse[:3, 3]
        corrected[t] = np.rint(np.clip(colours, 0, 255)).astype(np.uint8)
        ignored[t] |= ((frames[t] == 255) & (corrected[t] < 255)).any(axis=-1)
    return dataclasses.replace(capture, frames=corrected, ignored=ignored if ignored.any() else None)


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


def _describe(before: Capture, after: Capture, corrections: Corrections, *, by_depth: bool) -> list[str]:
    """How far the frames were off, a sentence each."""
    shift, turn = _pose_changes(before.cameras, after.cameras)
    turn = np.degrees(turn)
    median = f"{np.median(shift):.3g} world units and {np.median(turn):.2g} degrees in the median"
    by = "by colour and depth of their frames, then by a probe fit" if by_depth else "by probe fits"
    gains = np.asarray(corrections.colours).sum(axis=(1, 2)) / 3  # of white: an affine map may spread a gain
    notes = [
        f"poses refined {by}: {median}, {shift.max():.3g} and {turn.max():.2g} at most",
        f"exposures evened out: frames were {gains.min():.2f} to {gains.max():.2f} times as bright",
    ]
    if np.asarray(before.held_out).any():
        notes.append(
            "each held-out frame has its pose and exposure by alignment to the frozen probe, which never saw it"
        )
    return notes
