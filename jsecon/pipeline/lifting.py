"""The stages that lift labels of frames to the Gaussians: votes, the paper's codes on request; and the field of all."""

import shutil

import jax
import numpy as np

from jsecon.errors import InputError
from jsecon.field.columns import vote_blocks
from jsecon.field.evidence import region_votes, votes_memory
from jsecon.field.membership import normalise_votes
from jsecon.paper.autoencoder import encode, train_autoencoder
from jsecon.paper.distill import distill_votes
from jsecon.pipeline.options import Options
from jsecon.pipeline.stages import Results, RunContext, Stage, StageInput, StageResult
from jsecon.process import memory_budget
from jsecon.types import Codes, LanguageField, Regions
from jsecon.views.frame import find_up_axis, given_up
from jsecon.vision.protocols import Embedder
from jsecon.vision.unrelated_words import embed_unrelated_words


def plan_lifting(context: RunContext) -> list[Stage]:
    """Plans the votes of the regions for each Gaussian, and the codes of the paper if the options ask for them."""
    how, after = "the strongest regions of each Gaussian", ("load", "gaussians", "objects")
    key_options = context.key_options("centre_pixel_weight")
    votes = Stage("votes", how, _accumulate_votes, after=after, key_options=key_options, distributed=True)
    if not context.options.paper:
        return [votes]
    how = "3 numbers per region by an autoencoder, distilled into the Gaussians by their votes"
    key_options = context.key_options("seed")
    return [votes, Stage("codes", how, _compute_codes, after=("regions", "votes"), key_options=key_options)]


def _accumulate_votes(stage: StageInput) -> StageResult:
    """Accumulates votes, on disk if they do not fit into memory; the votes are the same."""
    options, capture, scene = stage.context.options, stage.results.load, stage.results.gaussians
    labels, folder = stage.results.objects.labels, stage.checkpoint.folder
    cameras = capture.cameras[stage.results.objects.frames]
    count = int(labels.max()) + 1
    settings = {"centre_pixel_weight": options.centre_pixel_weight, "by_view": True, "progress": stage.progress}
    needed, budget = votes_memory(scene.count, len(labels)), memory_budget()
    on_disk = needed > budget and jax.process_count() == 1  # several processes exchange them in memory
    notes = ()
    if on_disk:
        shutil.rmtree(folder, ignore_errors=True)  # of a run that was stopped
        sizes = f"{needed / 2**30:.2g} GiB otherwise, where memory has room for {budget / 2**30:.2g}"
        notes = (f"votes are kept on disk: {sizes}",)
    accumulated = region_votes(scene, cameras, labels, count, folder=folder if on_disk else None, **settings)
    unseen = int((np.asarray(accumulated.views) == 0).sum())
    if unseen:
        notes = (*notes, f"no frame sees {unseen} of {scene.count} Gaussians")
    return StageResult(accumulated, notes)


def _compute_codes(stage: StageInput) -> StageResult:
    """Trains the paper's autoencoder, and distils the codes of the regions into the Gaussians by their votes."""
    options, embeddings, cast = stage.context.options, stage.results.regions.embeddings, stage.results.votes
    if not np.any(np.asarray(embeddings)):
        raise InputError("--paper", "no region has an embedding to train the autoencoder on", remedy="Leave it out.")
    key = jax.random.key(options.seed)
    autoencoder = train_autoencoder(embeddings, latent=3, key=key, progress=stage.progress)
    table = encode(autoencoder, embeddings)
    codes = np.concatenate([np.asarray(distill_votes(block, table)) for block in vote_blocks(cast)])
    return StageResult(Codes(codes, table, autoencoder))


def join_field(results: Results, embedder: Embedder, provenance: str, options: Options) -> LanguageField:
    """Joins the results of a run to a field."""
    capture, embedded = results.load, results.regions
    pixels = np.zeros((embedded.count, len(capture.names)), np.int32)
    pixels[:, results.objects.frames] = embedded.pixel_counts
    given = None if options.up is None else given_up(options.up, capture.source_from_scene)
    scale = capture.metres_per_unit if options.metres_per_unit is None else options.metres_per_unit
    return LanguageField(
        gaussians=results.gaussians,
        votes=normalise_votes(results.votes, embedded),
        regions=Regions(embedded.embeddings, pixels),
        cameras=capture.cameras,
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.asarray(capture.source_from_scene),
        names=capture.names,
        embedder=embedder.name,
        provenance=provenance,
        parts=results.parts,
        unrelated_words=embed_unrelated_words(embedder).astype(np.float16),
        codes=results.codes,
        up=given or capture.up or find_up_axis(results.gaussians, capture.cameras),
        metres_per_unit=scale,
    )
