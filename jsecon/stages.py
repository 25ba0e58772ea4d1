"""The steps of a run, each a function of the options and of what came before it; nothing here caches, times or prints.

A step returns an Outcome: its result, and what it found it could leave out. Frames that are held out are never read
by any step after the loading, the final measurement apart.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsecon import eyes
from jsecon.errors import InputError
from jsecon.options import Options
from jsecon.plan import Progress
from jsecon.types import Camera, Capture, Gaussians, LanguageField, Regions, Votes


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a step made."""

    value: Any
    """the result, a tree of arrays and records."""
    left_out: dict[str, str] = dataclasses.field(default_factory=dict)
    """part that was not needed -> why."""
    notes: tuple[str, ...] = ()
    """what the user should know, a sentence each."""


def training_frames(capture: Capture) -> np.ndarray:
    """Indices of the frames that may be fitted to. Raises InputError where there are fewer than two."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    if len(train) < 2:
        raise InputError(
            "frames",
            found=f"{len(train)} of {len(capture.names)} frames to work with",
            expected="at least 2",
            remedy="Hold out fewer frames (--holdout), or use more (--frames).",
        )
    return train


def load_frames(options: Options, progress: Progress) -> Outcome:
    """The capture, at the size that the options ask for."""
    from jsecon.data.capture import load_capture

    downscale = options.downscale
    if downscale is None:
        size = load_capture(options.capture, frames=1, holdout=0).cameras
        downscale = max(max(size.width, size.height) / options.long_side, 1.0)
    capture = load_capture(
        options.capture, downscale=downscale, frames=options.frames, holdout=options.holdout, progress=progress
    )
    return checked(capture, f"{downscale:.3g} times smaller" if downscale > 1 else "at full size")


def checked(capture: Capture, size: str) -> Outcome:
    """The capture as an Outcome that says what it is. Raises InputError where its views cannot be used together."""
    from jsecon.data.capture import check_views_overlap

    train = training_frames(capture)
    check_views_overlap(capture)
    count, height, width = capture.frames.shape[:3]
    told = (
        f"{count} frames of {width}x{height} ({size}), {count - len(train)} of them held out, "
        f"{len(capture.points)} sparse points{'' if capture.depths is None else ', depth'}"
    )
    return Outcome(capture, notes=(told, *capture.notes))


def given_gaussians(options: Options, capture: Capture) -> Outcome:
    """The Gaussians of the .ply, in the capture's world."""
    from jsecon.data.ply import load_ply

    assert options.gaussians is not None
    gaussians = load_ply(options.gaussians)
    check_overlap(gaussians, capture.cameras[training_frames(capture)], str(options.gaussians))
    return Outcome(gaussians)


def fitted_gaussians(
    options: Options, capture: Capture, progress: Progress, state: Any | None, on_checkpoint: Callable[[Any], None]
) -> Outcome:
    """Gaussians fitted to the training frames, from depth, from the sparse points or from triangulated ones.

    `state` is the last one that `on_checkpoint` was given by a fit that was stopped, or None.
    """
    from jsecon.fit.optimise import fit_gaussians
    from jsecon.fit.start import starting_gaussians

    start, notes = None, ()
    if state is None:
        start, whence = starting_gaussians(capture, sh_degree=options.sh_degree, progress=progress)
        check_overlap(start, capture.cameras[training_frames(capture)], str(options.capture))
        notes = (f"start of the fit: {whence}",)
    gaussians, _ = fit_gaussians(
        capture,
        steps=options.steps,
        key=jax.random.key(options.seed),
        start=start,
        state=state,
        on_checkpoint=on_checkpoint,
        progress=progress,
    )
    return Outcome(gaussians, notes=notes)


def check_overlap(gaussians: Gaussians, cameras: Camera, where: str, *, least: float = 0.01) -> None:
    """Raises InputError where fewer than `least` of the Gaussians lie in the view of at least two cameras."""
    from jsecon.splat.project import project

    seen = jax.lax.map(lambda camera: project(gaussians, camera).visible, jax.tree.map(jnp.asarray, cameras))
    share = float(jnp.mean(seen.sum(0) >= 2)) if gaussians.count else 0.0
    if share < least:
        raise InputError(
            where,
            found=f"{share:.1%} of {gaussians.count} points in the view of two or more of the {len(seen)} frames",
            expected="views that overlap, and a scene in the world of their poses",
            remedy="Check that the poses belong to these frames, and the .ply to this capture.",
        )


def masklets_from_frames(
    options: Options,
    capture: Capture,
    gaussians: Gaussians,
    seeing: eyes.Eyes,
    progress: Progress,
    *,
    state: Any | None = None,
    on_checkpoint: Callable[[Callable[[], Any]], None] | None = None,
) -> Outcome:
    """labels (T, H, W) int16 of the training frames: the proposals of each, brought together over the frames by what
    the scene's own Gaussians say, by consensus or by tracking, or by a tracker of its own. `state` and `on_checkpoint`
    are those of `jsecon.language.masklets.masklets`."""
    from jsecon.language.consensus import consensus_masklets
    from jsecon.language.masklets import clean_masklets, masklets
    from jsecon.proposals import proposals_of
    from jsecon.vision.geometric import GeometricTracker
    from jsecon.vision.views import SceneViews

    train = training_frames(capture)
    frames, cameras = np.asarray(capture.frames)[train], jax.tree.map(jnp.asarray, capture.cameras[train])
    proposals, notes = proposals_of(options, capture, train, gaussians, seeing.segmenter)
    if options.associated_by == "consensus":
        scene = SceneViews(gaussians, cameras, proposals)
        labels = consensus_masklets(frames, scene, agreement=options.agreement, seed=options.seed, progress=progress)
    else:
        tracker = seeing.tracker or GeometricTracker(gaussians, cameras, proposals)
        labels = masklets(
            frames,
            lambda frame, index: proposals(index),
            tracker,
            iou_threshold=options.iou_threshold,
            state=state,
            on_checkpoint=on_checkpoint,
            progress=progress,
        )
        if isinstance(tracker, GeometricTracker):
            labels = tracker.consistent(frames, labels)
    labels = clean_masklets(labels)
    eyes.close(seeing.segmenter, seeing.tracker)
    _require_regions(labels, str(options.capture))
    return Outcome(labels, notes=notes)


def masklets_from_disk(options: Options, capture: Capture, progress: Progress) -> Outcome:
    """labels (T, H, W) int16 of the training frames, as the mask files have them."""
    from jsecon.data.labels import load_labels

    assert options.masks is not None
    height, width = capture.frames.shape[1:3]
    names = [capture.names[t] for t in training_frames(capture)]
    found = load_labels(
        options.masks, names, (height, width), level=options.level, order=capture.names, progress=progress
    )
    _require_regions(found.labels, str(options.masks))
    return Outcome(found.labels, notes=(f"{len(found.ids)} regions in the masks", *found.notes))


def _require_regions(labels: np.ndarray, where: str) -> None:
    if labels.max(initial=-1) < 0:
        raise InputError(
            where,
            found="no region in any frame",
            expected="at least one",
            remedy="Give masks (--masks DIR), or frames with more contrast.",
        )


def regions(options: Options, capture: Capture, labels: np.ndarray, embedder: Any, progress: Progress) -> Outcome:
    """One embedding a region, by the embedder or from files."""
    from jsecon.language.regions import given_embeddings, region_embeddings

    if options.features is not None:
        from jsecon.data.langsplat_files import load_features

        names = [capture.names[t] for t in training_frames(capture)]
        given = load_features(options.features, names, labels.shape[1:], level=options.level)
        if not len(given.embeddings):
            raise InputError(
                options.features,
                found=f"no mask of level {options.level} in any frame",
                expected="masks with their embeddings",
                remedy="Take another --level, or write the files again.",
            )
        found = given_embeddings(labels, given.labels, given.embeddings, weighting=options.weighting, progress=progress)
        bare = int((~found.embeddings.any(1)).sum())
        notes = (f"{len(given.embeddings)} embeddings in the files",)
        return Outcome(found, notes=(*notes, f"{bare} regions lie on no mask with one") if bare else notes)
    frames = np.asarray(capture.frames)[training_frames(capture)]
    found = region_embeddings(frames, labels, embedder.embed_regions, weighting=options.weighting, progress=progress)
    eyes.close(embedder)
    return Outcome(found)


def codes(options: Options, found: Regions, progress: Progress) -> Outcome:
    """(codes (R, d), coder): the regions' embeddings, compressed only where they don't fit as they are."""
    from jsecon.language.autoencoder import Autoencoder
    from jsecon.language.codes import region_codes

    table, coder, why = region_codes(
        found.embeddings, latent=options.latent, key=jax.random.key(options.seed), progress=progress
    )
    trained, why = isinstance(coder, Autoencoder), why.partition(": ")[2] or why
    return Outcome((table, coder), {} if trained else {"autoencoder": why}, (f"autoencoder: {why}",) if trained else ())


def votes(
    options: Options, capture: Capture, gaussians: Gaussians, labels: np.ndarray, num_regions: int, progress: Progress
) -> Outcome:
    """The weight that each region casts on each Gaussian over the training frames, with each frame's total."""
    from jsecon.language.votes import region_votes

    cameras = jax.tree.map(jnp.asarray, capture.cameras[training_frames(capture)])
    cast = region_votes(gaussians, cameras, labels, num_regions, top=options.top, by_view=True, progress=progress)
    unseen = int(jnp.sum(cast.views == 0))
    left = {"unseen Gaussians": f"{unseen} of {gaussians.count} that no frame sees get no code"} if unseen else {}
    return Outcome(cast, left)


def distil(options: Options, cast: Votes, table: np.ndarray) -> Outcome:
    """codes (N, d) of the Gaussians, from their votes."""
    from jsecon.language.distill import distill_votes

    return Outcome(distill_votes(cast, jnp.asarray(table), reduce=options.reduce))


def assemble(
    capture: Capture,
    gaussians: Gaussians,
    found: Regions,
    table: np.ndarray,
    coder: Any,
    cast: Votes,
    point_codes: np.ndarray,
    embedder: Any,
    provenance: str,
) -> LanguageField:
    """The field: everything that a query needs. It knows all views; in those held out, no region has any pixels."""
    from jsecon.query.pieces import with_overlap
    from jsecon.query.showing import with_shown

    pixels = np.zeros((found.count, len(capture.names)), np.int32)
    pixels[:, training_frames(capture)] = found.pixels
    return LanguageField(
        gaussians=gaussians,
        codes=point_codes,
        votes=with_overlap(with_shown(cast, found)),
        regions=Regions(found.embeddings, pixels),
        region_codes=table,
        autoencoder=coder,
        cameras=capture.cameras,
        canonical=np.asarray(embedder.canonical, np.float32),
        to_source=np.asarray(capture.to_source),
        names=capture.names,
        embedder=embedder.name,
        provenance=provenance,
    )


def held_out_psnr(capture: Capture, gaussians: Gaussians, progress: Progress) -> Outcome:
    """(frames held out,) PSNR in dB of the rendered colours against the photographs."""
    from jsecon.fit.optimise import evaluate_psnr

    return Outcome(evaluate_psnr(gaussians, capture, progress=progress))
