"""A run: from a capture to a language field, stage by stage, each stored as it is finished.

    poses (if they are missing) -> load -> gaussians -> masklets -> regions -> codes -> votes -> distil -> field

and with --parts, after regions, the parts of the scene. Last, the held-out frames are measured.

The keys of all stages are known before any runs, so the plan is printed first: which stages run, which are cached, what
is skipped and why. These files are passed on the way, by default; behind each lies more of its own package:

    all stages  pipeline/run, pipeline/stages, pipeline/results
    load        data/capture, data/colmap
    gaussians   fit/start, fit/optimise
    masklets    vision/classical, association/views, association/consensus, association/algorithm1
    regions     vision/colours, language/regions
    codes       language/codes
    votes       language/votes, splat/render
    distil      language/distill
    field       language/field
"""

import dataclasses
import functools
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jsecon
from jsecon.errors import InputError
from jsecon.files import exclusive_lock
from jsecon.language.field import load_field, save_field
from jsecon.pipeline import cache, networks, processes, stages
from jsecon.pipeline.checks import check_inputs
from jsecon.pipeline.options import Options, require_inputs, require_own_folder, require_writable
from jsecon.pipeline.processes import Coordinator
from jsecon.pipeline.progress import Listener, Step
from jsecon.pipeline.results import (
    KEY_FILE,
    Checkpoint,
    Results,
    RunContext,
    Stage,
    StageInput,
    StageResult,
    vision_frames,
)
from jsecon.pipeline.sources import hub_addresses, relative_folders
from jsecon.process import compilation_counts
from jsecon.types import Capture, Gaussians, LanguageField, Quality
from jsecon.vision.classical import require_contrib

FIELD_FILE = "field.safetensors"
OUT_OF_MEMORY = "Take smaller frames (--long-side), fewer (--frames), or fewer Gaussians (--gaussians-at-most)."
"""what to do if memory is full"""


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run.

    Attributes:
      field: The language field.
      capture: The capture.
      labels: (T, H, W) int16 masklets of the training frames that vision uses.
      held_out: PSNR and SSIM of the held-out frames.
      seconds: Wall time of each stage, also of one that was computed in an earlier run.
      steps: Stages, and what was skipped.
      notes: What the user should know, a sentence each.
      options: Options of the run.
      programs: Number of programs that jax compiled ("all"), and of those that it read from disk ("from_disk").
      compilations: The same for each stage.
    """

    field: LanguageField
    capture: Capture
    labels: np.ndarray
    held_out: Quality
    seconds: dict[str, float]
    steps: tuple[Step, ...]
    notes: tuple[str, ...]
    options: Options
    programs: dict[str, int]
    compilations: dict[str, dict[str, int]]

    @property
    def psnr(self) -> np.ndarray:
        """(F,) PSNR of the held-out frames in dB."""
        return np.asarray(self.held_out.psnr)

    @property
    def skipped(self) -> dict[str, str]:
        """Parts that were not needed, each with the reason."""
        return {step.name: step.why for step in self.steps if step.status == "skipped"}


def run_stages(context: RunContext) -> list[Stage]:
    """Plans the stages of a run in order. Mask files come before the long fit, so that their errors are found early."""
    first = [stages.gaussians(context), stages.masklets(context)]
    if context.options.masks is not None:
        first.reverse()
    parts = [stages.parts(context)] if context.options.parts else []
    last = [plan(context) for plan in (stages.codes, stages.votes, stages.distil, stages.held_out)]
    return [*stages.capture_stages(context), *first, stages.regions(context), *parts, *last]


def fit_stages(context: RunContext) -> list[Stage]:
    """Plans the stages that make and measure the scene."""
    return [*stages.capture_stages(context), stages.gaussians(context), stages.held_out(context)]


@dataclasses.dataclass(frozen=True)
class Plan:
    """What would run.

    Attributes:
      keys: Key of each stage.
      files: Digest of each stage's input files, as it went into the key.
      paths: Cache file of each stage.
      stale: Stages whose result is stored and whose output folder is another run's.
      steps: Stages, and what the options make needless.
    """

    keys: dict[str, str]
    files: dict[str, str | None]
    paths: dict[str, Path]
    stale: list[str]
    steps: list[Step]


def _plan(context: RunContext, stage_list: list[Stage], folder: Path) -> Plan:
    """Plans stages: which of them `folder` already holds. Writes no file; raises InputError for invalid options."""
    require_inputs(context.options)
    require_own_folder(context.options, context.out)
    require_contrib()
    keys: dict[str, str] = {}
    files: dict[str, str | None] = {}
    for stage in stage_list:
        files[stage.name] = stage.files_digest(context)
        keys[stage.name] = stage.key(keys, files[stage.name])
    paths = {name: cache.path_of(folder, name, key) for name, key in keys.items()}
    stale = [stage.name for stage in stage_list if not _owns_output(stage, stage_list, paths)]
    cached = {name for name, path in paths.items() if path.exists() and name not in stale}
    steps = [Step(stage.name, "cached" if stage.name in cached else "run", stage.how) for stage in stage_list]
    steps += [Step(part, "skipped", why) for stage in stage_list for part, why in stage.skipped.items()]
    return Plan(keys, files, paths, stale, steps)


def _owns_output(stage: Stage, stage_list: list[Stage], paths: dict[str, Path]) -> bool:
    """Whether a stage's output folder still belongs to it, or no later stage will read it."""
    if stage.output_dir is None:
        return True
    file = stage.output_dir / KEY_FILE
    if file.is_file() and file.read_text() == cache.record_path_of(paths[stage.name]).stem:
        return True
    return all(paths[other.name].exists() for other in stage_list if stage.name in other.after)


@dataclasses.dataclass(frozen=True)
class Computed:
    """Output of stages, as in `Run`."""

    results: Results
    keys: dict[str, str]
    steps: list[Step]
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    notes: list[str] = dataclasses.field(default_factory=list)
    compilations: dict[str, dict[str, int]] = dataclasses.field(default_factory=dict)


def compute_stages(
    context: RunContext,
    stage_list: list[Stage],
    folder: Path,
    *,
    listener: Listener | None = None,
    coordinator: Coordinator | None = None,
) -> Computed:
    """Plans stages, reports the plan, then computes each or reads it from the cache.

    Args:
      context: The run.
      stage_list: Stages in order.
      folder: Folder of the cache.
      listener: Receives plan, progress and notes.
      coordinator: Calls the other processes of the run, if there are any.

    Raises:
      InputError: An option or input is invalid, or memory is full.
    """
    listener = listener or Listener()
    coordinator = coordinator or Coordinator(several=False)
    with listener.progress("plan"):
        plan = _plan(context, stage_list, folder)
        require_writable(context.out)
    with exclusive_lock(context.out):
        cache.prepare(folder)
        for name in plan.stale:
            plan.paths[name].unlink(missing_ok=True)
        listener.steps(f"{context.options.capture} -> {context.out}", plan.steps)
        running = [step.name for step in plan.steps if step.status == "run"]
        context.networks.require_ready(running)
        computed = Computed(Results(), plan.keys, plan.steps)
        for stage in stage_list:
            _compute_stage(context, stage, plan, computed, listener, coordinator)
            if stage.name == "load":
                _note_vision_time(context, computed.results.load, running, listener)
    return computed


def _note_vision_time(context: RunContext, capture: Capture, running: list[str], listener: Listener) -> None:
    """Says how long the models will take, before the long stages."""
    frames = np.asarray(capture.frames)[vision_frames(capture, context.options)]
    with listener.progress("vision"):
        notes = list(networks.estimate_vision(context.networks, frames, running))
    for note in notes:
        listener.note(f"{note}. Fewer frames: --vision-frames.")


def _compute_stage(
    context: RunContext, stage: Stage, plan: Plan, computed: Computed, listener: Listener, coordinator: Coordinator
) -> None:
    """Computes one stage or reads it from the cache, and adds it to `computed`."""
    path, before = plan.paths[stage.name], compilation_counts()
    checkpoint = Checkpoint(cache.record_path_of(path))

    def compute(progress: Any) -> StageResult:
        coordinator.broadcast(stage, computed.results)
        return stage.run(StageInput(context, computed.results, progress, checkpoint), plan.files[stage.name])

    with listener.progress(stage.name) as progress:
        try:
            cached = cache.fetch(path, functools.partial(compute, progress), note=listener.note)
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
                problem, remedy = f"no memory left ({str(error)[:200]})", f"{OUT_OF_MEMORY} Finished stages are kept."
                raise InputError(f"stage {stage.name}", problem, "more memory", remedy) from error
            raise
    result: StageResult = cached.value
    computed.results.add(stage.name, result.value)
    computed.seconds[stage.name] = cached.seconds
    computed.compilations[stage.name] = _since(before)
    checkpoint.remove()
    listener.done(stage.name, cached.seconds, cached.fresh)
    for part, why in result.skipped.items():
        computed.steps.append(Step(part, "skipped", why))
        listener.step(computed.steps[-1])
    for note in result.notes:
        computed.notes.append(note)
        listener.note(note)


def run(
    options: Options,
    out: Path,
    *,
    listener: Listener | None = None,
    load: Callable[[], Capture] | None = None,
    cache_folder: Path | None = None,
    coordinator: Coordinator | None = None,
) -> Run:
    """Builds the field of a capture and writes OUT/field.safetensors.

    A run that was stopped resumes where it stopped, to the same result.

    Args:
      options: Options of the run.
      out: Output folder.
      listener: Receives plan, progress and notes.
      load: Replaces the loader of captures, for data with an unusual layout. It may read no files but those beneath
        `options.capture`.
      cache_folder: Folder of the cache; by default OUT/cache.
      coordinator: Calls the other processes of the run (`run_worker`), if there are any.

    Raises:
      InputError: An option or input is invalid. Finished stages are kept.
    """
    listener, before = listener or Listener(), compilation_counts()
    folder = cache_folder or out / "cache"
    context = RunContext(options, networks.open_networks(options, folder), out, load)
    computed = compute_stages(context, run_stages(context), folder, listener=listener, coordinator=coordinator)
    results, embedder = computed.results, context.networks.embedder
    started = time.monotonic()
    with listener.progress("field"):
        field = stages.field_of(results, embedder, _provenance(options, computed.keys, embedder.name, out), options)
        save_field(out / FIELD_FILE, field)
    computed.seconds["field"] = time.monotonic() - started
    listener.done("field", computed.seconds["field"], True)
    return Run(
        field,
        results.load,
        results.masklets,
        results.held_out,
        computed.seconds,
        tuple(computed.steps),
        tuple(computed.notes),
        options,
        _since(before),
        computed.compilations,
    )


def current_field(options: Options, out: Path) -> Path | None:
    """Looks for the field that a run would write, without running.

    Args:
      options: Options of the run.
      out: Its output folder.

    Returns:
      The field's file, or None if it is missing, or other options, inputs or sources made it.

    Raises:
      InputError: The run would refuse its options or inputs.
    """
    path = out / FIELD_FILE
    if not path.is_file():
        return None
    context = RunContext(options, networks.open_networks(options, out / "cache"), out)
    keys = _plan(context, run_stages(context), out / "cache").keys
    try:
        provenance = json.loads(load_field(path, mapped=True).provenance)
    except (InputError, ValueError):  # damaged: the run writes it anew
        return None
    return path if provenance.get("keys") == keys else None


def run_worker(options: Options, out: Path) -> None:
    """Does the part of a run of every process but the first (`processes`)."""
    context = RunContext(options, networks.open_networks(options, out / "cache"), out)
    processes.run_worker(context, run_stages(context))


def dry_run(options: Options, out: Path, *, scene_only: bool = False, listener: Listener) -> dict[str, Any]:
    """Lists the stages that `run` would compute, and writes no file.

    Args:
      options: Options of the run.
      out: Its output folder.
      scene_only: List the stages of `fit` instead.
      listener: Receives the list.

    Returns:
      {"stages": list of `Step`}.

    Raises:
      InputError: A run would refuse its options or inputs.
    """
    with listener.progress("plan"):
        context = RunContext(options, networks.open_networks(options, out / "cache"), out)
        stage_list = fit_stages(context) if scene_only else run_stages(context)
        plan = _plan(context, stage_list, out / "cache")
        running = [step.name for step in plan.steps if step.status == "run"]
        context.networks.require_ready(running)
        check_inputs(context, running, plan.paths)
    listener.steps(f"{options.capture} -> {out}, a dry run", plan.steps)
    listener.say("Nothing was written.")
    return {"stages": plan.steps}


def fit(options: Options, out: Path, *, listener: Listener | None = None) -> tuple[Gaussians, Capture, Quality]:
    """Computes the stages of `run` that make and measure the scene, into the same cache, so that a `run` continues.

    Args:
      options: Options of the run.
      out: Output folder of the run.
      listener: Receives plan, progress and notes.

    Returns:
      The Gaussians, their capture, and the quality of the held-out frames.

    Raises:
      InputError: An option or input is invalid.
    """
    context = RunContext(options, networks.open_networks(options, out / "cache"), out)
    results = compute_stages(context, fit_stages(context), out / "cache", listener=listener).results
    return results.gaussians, results.load, results.held_out


def _since(before: dict[str, int]) -> dict[str, int]:
    """Compilations since earlier counts."""
    return {name: count - before[name] for name, count in compilation_counts().items()}


def _provenance(options: Options, keys: dict[str, str], embedder: str, out: Path) -> str:
    """JSON of where a field comes from; `jsecon.pipeline.sources` reads "embedder" and "folders"."""
    values = {name: str(value) if isinstance(value, Path) else value for name, value in vars(options).items()}
    models = hub_addresses(options)
    origin = {"jsecon": jsecon.__version__, "options": values | models, "keys": keys, "embedder": embedder}
    places = {"folders": relative_folders(options, out), "models": models}
    return json.dumps(origin | places, sort_keys=True)
