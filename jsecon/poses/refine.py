"""Refines the poses and exposures of a capture before a fit. Host code.

A probe is a short fit with corrections (corrections.py); it measures how far each frame is off. The result is a capture
again, in the same world, with its frames as under one exposure.

If the frames have depth, the cameras are first aligned to each other by colour and depth (alignment.py), provided that
the frames then agree clearly better: one probe is enough after that. Otherwise points from depth lie where the wrong
pose of their frame puts them, and keep it there. So such a probe starts from few points, which several frames must
share, and each further probe starts from points made with the poses of the one before. The first probes see small
frames and end as soon as the poses are stable; the last sees larger ones.

With a limit of time, only what depth aligns is corrected: colour alone does not tell whether poses are wrong. Held-out
frames have no part in the probes. They are aligned to the last probe once it is frozen, each by its pose and exposure,
as methods that refine poses are measured (Lin et al. 2021, BARF, section 4.2).
"""

import dataclasses
import math

import jax
import numpy as np
from jaxtyping import Bool, Float, PRNGKeyArray

from jsecon.fit.corrections import CorrectionRates, Corrections, se3_exp
from jsecon.fit.optimise import FitState, Schedule, fit_gaussians
from jsecon.fit.start import starting_gaussians
from jsecon.fit.step import LearningRates, cameras_extent
from jsecon.poses.alignment import align_cameras
from jsecon.types import Array, Camera, Capture, Gaussians, Progress

MIN_VISITS = 6
"""Visits below which poses do not become stable."""
ALIGN_VISITS = 120
"""Visits of each held-out frame while it is aligned to the last probe."""
FINE_SIZE = 0.5
"""Size of the frames in the last probe, which measures as well as full size in half the time."""
COARSE_PX, MIN_COARSE_SIZE = 100, 0.25
"""Longer side in px of the frames in the probes before the last, and their smallest size."""
MAX_SPREAD = 0.08
"""Largest change of the cameras' extent by depth, as a share. Rough poses of made-up rooms change it by 0.005."""
_STEP_COST = 0.187
"""Time of a step of the last probe, in steps of the fit."""


def _affordable_visits(held_out: Bool[np.ndarray, " t"], visits: int, max_fit_steps: float) -> int:
    """Computes how many visits of each frame by one probe fit into the time of `max_fit_steps` steps; 0 if too few.

    Alignments are never shortened: an unfinished pose would spoil the measurement of a held-out frame.
    """
    fixed = ALIGN_VISITS * int(held_out.sum()) * _STEP_COST
    fixed += 2 * len(held_out)  # to align a frame by colour and depth takes about a step of the fit
    allowed = min(visits, int((max_fit_steps - fixed) / (int((~held_out).sum()) * _STEP_COST)))
    return 0 if allowed < min(MIN_VISITS, visits) else allowed


def _probe(
    capture: Capture,
    size: float,
    steps: int,
    key: PRNGKeyArray,
    refine: CorrectionRates,
    progress: Progress,
    frozen: Gaussians | None = None,
) -> tuple[Gaussians, Corrections]:
    """A short fit to frames of this size, and the corrections of all frames; of a `frozen` scene these alone."""
    states: list[FitState] = []
    start, rates = frozen, LearningRates()
    if start is None:
        start = starting_gaussians(capture, max_points=12_000)[0]
    else:
        still = dict.fromkeys(("log_scales", "quaternions", "opacity_logits", "colors"), 0.0)
        rates = LearningRates(means=0.0, means_last=0.0, **still)
    # Soft Gaussians render a depth before the surface: as a target, depth would push every camera back.
    ignored = capture.ignored
    if ignored is None:  # one program serves captures with and without ignored pixels
        ignored = np.broadcast_to(False, np.shape(capture.frames)[:3])
    scene, _ = fit_gaussians(
        dataclasses.replace(capture, depths=None, ignored=ignored),
        key=key,
        steps=steps,
        start=start,
        refine=refine,
        rates=rates,
        schedule=Schedule(sizes=((size, 1.0),), max_gaussians=0),
        on_checkpoint=lambda state: states.__setitem__(slice(None), [state]),
        progress=progress,
    )
    return scene, jax.tree.map(np.asarray, states[0].train.corrections.current)


def refine_capture(
    capture: Capture,
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
      key: Key of the order of the frames.
      max_fit_steps: Corrects in about the time of so many steps of the fit, by fewer visits, and only if depth aligns
        the frames. If too few visits are left, the capture stays as depth aligns it. None corrects in any case.
      visits: Visits of each frame by each probe, at least 1.
      probes: Maximum number of probes, at least 1.
      progress: Called with the number of steps done and of all.
    """
    original, held_out = capture, np.asarray(capture.held_out)
    train = ~held_out
    aligned = None if capture.depths is None else _align_by_depth(capture, train, held_out)
    if aligned is None and max_fit_steps is not None:
        return _with_notes(
            capture, "poses and exposures stay as they are: depth does not bring the frames clearly nearer together"
        )
    by_depth, refine = aligned is not None, CorrectionRates()
    if aligned is not None:
        capture, probes, refine = aligned, 1, CorrectionRates(pose=1e-4)  # what is left after depth is small
    if max_fit_steps is not None:
        visits = _affordable_visits(held_out, visits, max_fit_steps)
    if not visits:
        problem = f"{len(capture.names)} frames are too many to correct them within half of the fit's time"
        remedy = "use more --steps, fewer --frames, or --refine always, which takes longer"
        note = f"poses are refined by colour and depth of their frames alone: {problem} ({remedy})"
        return _with_notes(capture, note)
    steps, aligning = visits * int(train.sum()), ALIGN_VISITS * int(held_out.sum())
    total, done = steps * probes + aligning, 0

    def report(now: int, _: int) -> None:
        if progress is not None:
            progress(min(done + now, total), total)

    extent = max(cameras_extent(capture.cameras[train]), 1e-6)
    coarse_size = min(FINE_SIZE, max(MIN_COARSE_SIZE, COARSE_PX / max(capture.cameras.width, capture.cameras.height)))
    for _ in range(probes - 1):
        _, corrections = _probe(capture, coarse_size, steps, key, refine, report)
        before, capture, done = capture, _move_cameras(capture, corrections), done + steps
        shift, turn = _pose_changes(before.cameras[train], capture.cameras[train])
        pixels = np.asarray(capture.cameras.fx)[train] * np.hypot(shift / extent, turn)
        if np.median(pixels) < 0.25:  # px at full size: the poses are stable
            break
    scene, corrections = _probe(capture, FINE_SIZE, steps, key, refine, report)
    done += steps
    if aligning:
        others = dataclasses.replace(capture, held_out=train)
        _, alone = _probe(others, FINE_SIZE, aligning, key, refine, report, scene)
        twists = np.where(held_out[:, None], alone.twists, corrections.twists)
        corrections = Corrections(twists, np.where(held_out[:, None, None], alone.colours, corrections.colours))
    refined = _even_exposures(_move_cameras(capture, corrections), corrections)
    report(total, total)
    return _with_notes(refined, *_describe(original, refined, corrections, by_depth=by_depth))


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
    return [
        f"poses refined {by}: {median}, {shift.max():.3g} and {turn.max():.2g} at most",
        f"exposures evened out: frames were {gains.min():.2f} to {gains.max():.2f} times as bright",
    ]
