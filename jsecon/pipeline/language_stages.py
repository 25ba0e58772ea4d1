"""The stages about what the regions are: embeddings, codes, votes, distilled codes; and the field made of them.

Frames that are held out are read by none of them.
"""

import shutil
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.errors import InputError
from jsecon.language.regions import Embed
from jsecon.pipeline.progress import Progress
from jsecon.pipeline.stages import Checkpoint, Results, RunContext, Stage, StageResult, training_frames
from jsecon.types import LanguageField, Regions


def regions(work: RunContext) -> Stage:
    """One embedding for each region: by the embedder, or from files."""
    options, embedder = work.options, work.networks.embedder

    def embedded(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.language.regions import region_embeddings

        capture = results["load"]
        frames = np.asarray(capture.frames)[training_frames(capture)]
        found = region_embeddings(
            frames, results["masklets"], embedder.embed_regions, weighting=options.weighting, progress=progress
        )
        work.networks.close()
        return StageResult(found)

    def read(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.data.langsplat import load_features
        from jsecon.language.regions import embeddings_of_masks

        capture, labels = results["load"], results["masklets"]
        assert options.features is not None
        names = [capture.names[t] for t in training_frames(capture)]
        how = {"level": options.level, "order": capture.names, "files": dict(zip(capture.names, capture.files))}
        given = load_features(options.features, names, labels.shape[1:], **how)
        if not len(given.embeddings):
            there = f"no mask of level {options.level} in any frame"
            remedy = "Take another --level, or write the files again."
            raise InputError(options.features, there, "masks with their embeddings", remedy)
        found = embeddings_of_masks(
            labels, given.labels, given.embeddings, weighting=options.weighting, progress=progress
        )
        bare = int((~found.embeddings.any(1)).sum())
        notes = (f"{len(given.embeddings)} embeddings in the files",)
        return StageResult(found, notes=(*notes, f"{bare} regions lie on no mask with one") if bare else notes)

    how, given, left = f"embedded by {embedder.name!r}", {"embedder": embedder.name}, {}
    if options.features is not None:
        how, given = f"embeddings read from {options.features.name}, level {options.level}", work.key_options("level")
        left = {"embedder": f"embeddings are given ({options.features.name})"}
    return Stage(
        "regions",
        f"{how}, views weighted by {options.weighting}",
        embedded if options.features is None else read,
        "language",
        after=("load", "masklets"),
        key_options=work.key_options("weighting") | given,
        files=options.features,
        skipped=left,
        shared=options.features is None,
    )


def parts(work: RunContext) -> Stage:
    """Small parts of the scene, each with the embeddings of all masks of single frames that hold it."""
    options, embedder = work.options, work.networks.embedder

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.association.consensus import pieces_on_masks
        from jsecon.association.views import SceneViews
        from jsecon.language.regions import scene_parts

        capture, scene = results["load"], results["gaussians"]
        train = training_frames(capture)
        frames, cameras = np.asarray(capture.frames)[train], jax.tree.map(jnp.asarray, capture.cameras[train])
        masks, embed = _masks_of(work, results)
        views = SceneViews(scene, cameras, masks, centre=options.centre)
        piece, cast = pieces_on_masks(frames, views, seed=options.seed, progress=progress)
        rows = np.concatenate([embed(t, masks(t)) for t in range(len(train))])
        work.networks.close()
        return StageResult(scene_parts(piece, cast, rows))

    return Stage(
        "parts",
        "of the scene, by what single masks say of them",
        compute,
        "association",
        after=("load", "gaussians", "masklets"),
        key_options=work.key_options("seed", "level", "granularity", "centre") | {"embedder": embedder.name},
        files=options.features,
    )


def _masks_of(work: RunContext, results: Results) -> tuple[Callable[[int], np.ndarray], Embed]:
    """masks (M, H, W) bool of the t-th training frame, and what embeds them: those of --features, else the proposals,
    else the masklets that were given."""
    options, capture = work.options, results["load"]
    frames = np.asarray(capture.frames)[training_frames(capture)]
    by_model: Embed = lambda t, masks: work.networks.embedder.embed_regions(frames[t], masks)
    if options.features is not None:
        from jsecon.data.langsplat import load_features

        names = [capture.names[t] for t in training_frames(capture)]
        how = {"level": options.level, "order": capture.names, "files": dict(zip(capture.names, capture.files))}
        given = load_features(options.features, names, frames.shape[1:3], **how)
        rows = lambda t: np.flatnonzero(np.asarray(given.frame) == t)
        return lambda t: given.labels[t][None] == rows(t)[:, None, None], lambda t, masks: given.embeddings[rows(t)]
    if options.masks is not None:
        labels = results["masklets"]
        return lambda t: labels[t][None] == np.unique(labels[t][labels[t] >= 0])[:, None, None], by_model
    from jsecon.pipeline.masklet_stages import frame_proposals

    return frame_proposals(work, capture, results["gaussians"])[0], by_model


def codes(work: RunContext) -> Stage:
    """(codes (R, d), coder): the regions' embeddings, compressed only where they don't fit as they are."""
    options = work.options

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.language.autoencoder import Autoencoder
        from jsecon.language.codes import region_codes

        table, coder, why = region_codes(
            results["regions"].embeddings, latent=options.latent, key=jax.random.key(options.seed), progress=progress
        )
        trained, why = isinstance(coder, Autoencoder), why.partition(": ")[2] or why
        notes = (f"autoencoder: {why}",) if trained else ()
        return StageResult((table, coder), {} if trained else {"autoencoder": why}, notes)

    auto = options.latent == "auto"
    how = "as few numbers per region as keep them apart" if auto else f"at most {options.latent} numbers per region"
    return Stage("codes", how, compute, "language", after=("regions",), key_options=work.key_options("latent", "seed"))


def votes(work: RunContext) -> Stage:
    """The weight that each region casts on each Gaussian over the training frames, with each frame's total. Where
    memory has no room for that (`memory_budget`) it is cast in blocks, to the same up to float32's rounding."""

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.language.blocks import region_votes_in_blocks
        from jsecon.language.votes import region_votes, votes_memory
        from jsecon.process import memory_budget

        capture, scene, labels = results["load"], results["gaussians"], results["masklets"]
        cameras = capture.cameras[training_frames(capture)]
        count, how, notes = int(labels.max()) + 1, work.key_options("top", "centre"), ()
        needed, room = votes_memory(scene.count, len(labels), count), memory_budget()
        if needed > room and jax.process_count() == 1:  # several processes cast them together, each its own views
            shutil.rmtree(record.folder, ignore_errors=True)  # what a stopped run left
            how |= {"folder": record.folder}
            cast = region_votes_in_blocks(scene, cameras, labels, count, by_view=True, progress=progress, **how)
            told = f"{needed / 2**30:.2g} GiB otherwise, where memory has room for {room / 2**30:.2g}"
            notes = (f"votes are cast in blocks: {told}",)
        else:
            cast = region_votes(scene, cameras, labels, count, by_view=True, progress=progress, **how)
        unseen = int((np.asarray(cast.views) == 0).sum())
        left = {"unseen Gaussians": f"{unseen} of {scene.count} that no frame sees get no code"} if unseen else {}
        return StageResult(cast, left, notes)

    return Stage(
        "votes",
        f"the {work.options.top} strongest regions of each Gaussian",
        compute,
        "language",
        after=("load", "gaussians", "masklets"),
        key_options=work.key_options("top", "centre"),
        shared=True,
    )


def distil(work: RunContext) -> Stage:
    """codes (N, d) of the Gaussians, from their votes."""

    def compute(results: Results, progress: Progress, record: Checkpoint) -> StageResult:
        from jsecon.language.distill import distill_votes

        table, cast = results["codes"][0], results["votes"]
        if isinstance(cast.regions, np.memmap):
            from jsecon.language.blocks import codes_in_blocks

            return StageResult(codes_in_blocks(cast, table, record.folder / "codes.npy", work.options.reduce))
        return StageResult(distill_votes(cast, table, reduce=work.options.reduce))

    how = f"a Gaussian's code is its votes' {work.options.reduce}"
    return Stage("distil", how, compute, "language", after=("votes", "codes"), key_options=work.key_options("reduce"))


def field_of(results: Results, embedder: Any, provenance: str) -> LanguageField:
    """The field: everything that a query needs. It knows all views; in those held out, no region has any pixels."""
    from jsecon.language.membership import finish_votes
    from jsecon.vision.reference_words import reference_of

    capture, found = results["load"], results["regions"]
    pixels = np.zeros((found.count, len(capture.names)), np.int32)
    pixels[:, training_frames(capture)] = found.pixels
    table, coder = results["codes"]
    return LanguageField(
        gaussians=results["gaussians"],
        codes=results["distil"],
        votes=finish_votes(results["votes"], found),
        regions=Regions(found.embeddings, pixels),
        region_codes=table,
        autoencoder=coder,
        cameras=capture.cameras,
        canonical=np.asarray(embedder.canonical, np.float32),
        to_source=np.asarray(capture.to_source),
        names=capture.names,
        embedder=embedder.name,
        provenance=provenance,
        parts=results.get("parts"),
        reference=reference_of(embedder).astype(np.float16),
    )
