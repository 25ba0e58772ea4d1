"""A run: from a capture to a language field, stage by stage, each kept as it is finished.

    load -> gaussians -> masklets -> regions -> codes -> votes -> distil -> field, then the held-out frames measured

and with --parts, after regions, the parts of the scene.

Before it all, `poses` where the capture has none (data/motion, data/video).

The keys of all stages are known before any runs, so all of it is told first: what will run, what is cached, what is
left out and why. Read on the way, by default, without the ground (the root's modules); behind each file lies more of
its own room, behind splat/render the engine:

    all stages  pipeline/pipeline, pipeline/stages
    load        pipeline/scene_stages, data/capture, data/colmap
    gaussians   fit/start, fit/optimise
    masklets    pipeline/masklet_stages, vision/protocols, vision/classical, vision/region_graph, association/atoms,
                association/views, association/consensus, association/algorithm1
    regions     pipeline/language_stages, vision/colours, language/regions
    codes       language/codes
    votes       language/votes, splat/plan, splat/render
    distil      language/distill
    field       language/membership, language/field, vision/reference_words
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
from jsecon.pipeline import cache, networks, processes
from jsecon.pipeline.language_stages import codes, distil, field_of, parts, regions, votes
from jsecon.pipeline.masklet_stages import masklets
from jsecon.pipeline.options import Options, require_inputs, require_own_folder, require_writable
from jsecon.pipeline.processes import Coordinator
from jsecon.pipeline.progress import Listener, Step
from jsecon.pipeline.scene_stages import capture_stages, gaussians, held_out
from jsecon.pipeline.sources import relative_folders
from jsecon.pipeline.stages import KEY_FILE, Checkpoint, RunContext, Stage, StageResult
from jsecon.process import compilation_counts
from jsecon.types import Capture, Gaussians, LanguageField, Quality
from jsecon.vision.classical import require_contrib

FIELD_FILE = "field.safetensors"
SMALLER = "Take smaller frames (--long-side), fewer (--frames), or fewer Gaussians (--gaussians-at-most)."
"""what helps where memory ends"""


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run."""

    field: LanguageField
    capture: Capture
    labels: np.ndarray
    """(T, H, W) int16 masklets of the field's views."""
    held_out: Quality
    """PSNR and SSIM of the frames held out."""
    seconds: dict[str, float]
    """of each stage, also where it was computed in an earlier run."""
    steps: tuple[Step, ...]
    """the stages and what was left out of them, with what only the data could settle."""
    notes: tuple[str, ...]
    options: Options
    programs: dict[str, int]
    """that jax built for it: "all" of them, and those that it read "from_disk"."""
    built: dict[str, dict[str, int]]
    """the same for each stage."""

    @property
    def psnr(self) -> np.ndarray:
        """(frames held out,) dB."""
        return np.asarray(self.held_out.psnr)

    @property
    def skipped(self) -> dict[str, str]:
        """part -> why it was not needed."""
        return {step.name: step.why for step in self.steps if step.status == "skipped"}


def stages_of(work: RunContext) -> list[Stage]:
    """The stages of a run in order. Mask files come before the long fit: what is wrong with them is said at once."""
    first = (masklets, gaussians) if work.options.masks is not None else (gaussians, masklets)
    then = (regions, *((parts,) if work.options.parts else ()), codes, votes, distil, held_out)
    return [*capture_stages(work), *(stage(work) for stage in (*first, *then))]


@dataclasses.dataclass(frozen=True)
class _Plan:
    """What would run."""

    keys: dict[str, str]
    files: dict[str, str | None]
    """digests of the stages' files, as they went into the keys."""
    place: dict[str, Path]
    """where each stage's result is, or will be."""
    stale: list[str]
    """the stages whose result is there and whose folder is another run's."""
    steps: list[Step]


def _planned(work: RunContext, stages: list[Stage], folder: Path) -> _Plan:
    """The stages, and which of them `folder` holds already; writes nothing. Raises InputError for bad options."""
    options, keys, files = work.options, {}, {}
    require_inputs(options)
    require_own_folder(options, work.out)
    require_contrib()
    for stage in stages:
        files[stage.name] = stage.files_digest(work)
        keys[stage.name] = stage.key(work, keys, files[stage.name])
    place = {name: cache.path_of(folder, name, key) for name, key in keys.items()}
    stale = [stage.name for stage in stages if stage.output_dir is not None and not _left(stage, stages, place)]
    held = {name for name, path in place.items() if path.exists() and name not in stale}
    steps = [Step(stage.name, "cached" if stage.name in held else "run", stage.how) for stage in stages]
    steps += [Step(part, "skipped", why) for stage in stages for part, why in stage.skipped.items()]
    return _Plan(keys, files, place, stale, steps)


@dataclasses.dataclass(frozen=True)
class _Done:
    """What stages made, see Run."""

    results: dict[str, Any]
    keys: dict[str, str]
    seconds: dict[str, float]
    steps: list[Step]
    notes: list[str]
    built: dict[str, dict[str, int]]


def _computed(work: RunContext, stages: list[Stage], folder: Path, listener: Listener, first: Coordinator) -> _Done:
    """The stages, told first, then each computed or read from `folder`."""
    with listener.progress("plan"):
        plan = _planned(work, stages, folder)
        require_writable(work.out)
    with exclusive_lock(work.out):
        return _in_turn(work, stages, plan, folder, listener, first)


def _in_turn(
    work: RunContext, stages: list[Stage], plan: _Plan, folder: Path, listener: Listener, first: Coordinator
) -> _Done:
    place, steps = plan.place, plan.steps
    cache.prepare(folder)
    for name in plan.stale:
        place[name].unlink(missing_ok=True)
    listener.steps(f"{work.options.capture} -> {work.out}", steps)
    work.networks.require_ready([step.name for step in steps if step.status == "run"])
    done = _Done({}, plan.keys, {}, steps, [], {})
    for stage in stages:
        record, before = Checkpoint(cache.record_path_of(place[stage.name])), compilation_counts()
        with listener.progress(stage.name) as progress:
            given = (work, plan.files[stage.name], done.results, progress, record)
            compute = functools.partial(stage.computed, *given)
            begin = functools.partial(first.broadcast, stage, done.results)
            try:
                kept = cache.fetch(place[stage.name], compute, note=listener.note, begin=begin)
            except (MemoryError, jax.errors.JaxRuntimeError) as error:
                if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
                    found, remedy = f"no memory left ({str(error)[:200]})", f"{SMALLER} What is done is kept."
                    raise InputError(f"stage {stage.name}", found, "more memory", remedy) from error
                raise
        outcome: StageResult = kept.value
        done.results[stage.name], done.seconds[stage.name] = outcome.value, kept.seconds
        done.built[stage.name] = _since(before)
        record.remove()
        listener.done(stage.name, kept.seconds, kept.fresh)
        for part, why in outcome.skipped.items():
            steps.append(Step(part, "skipped", why))
            listener.step(steps[-1])
        for note in outcome.notes:
            done.notes.append(note)
            listener.note(note)
    return done


def run(
    options: Options,
    out: Path,
    *,
    listener: Listener | None = None,
    load: Callable[[], Capture] | None = None,
    cache_folder: Path | None = None,
    first: Coordinator | None = None,
) -> Run:
    """Builds the field of a capture, keeps each stage under `cache_folder` (default OUT/cache), writes FIELD_FILE.
    `first` calls the other processes of the run (`assist`), where there are any.

    A run that was stopped goes on where it stopped, to the same result. `load` takes the loader's place for data whose
    layout is one of a kind (the files beneath `options.capture` must still be all that it reads). Raises InputError for
    bad input; what was computed before stays.
    """
    listener, before = listener or Listener(), compilation_counts()
    folder = cache_folder or out / "cache"
    work = RunContext(options, networks.open_networks(options, folder), out, load)
    done = _computed(work, stages_of(work), folder, listener, first or Coordinator(several=False))
    started = time.monotonic()
    with listener.progress("field"):
        from jsecon.language.field import save_field

        field = field_of(
            done.results, work.networks.embedder, _provenance(options, done.keys, work.networks.embedder.name, out)
        )
        save_field(out / FIELD_FILE, field)
    done.seconds["field"] = time.monotonic() - started
    listener.done("field", done.seconds["field"], True)
    capture, labels, quality = (done.results[name] for name in ("load", "masklets", "held_out"))
    steps, notes = tuple(done.steps), tuple(done.notes)
    return Run(field, capture, labels, quality, done.seconds, steps, notes, options, _since(before), done.built)


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
    from jsecon.language.field import load_field

    path = out / FIELD_FILE
    if not path.is_file():
        return None
    work = RunContext(options, networks.open_networks(options, out / "cache"), out)
    keys = _planned(work, stages_of(work), out / "cache").keys
    try:
        made_by = json.loads(load_field(path, mapped=True).provenance)
    except (InputError, ValueError):  # damaged: the run writes it anew
        return None
    return path if made_by.get("keys") == keys else None


def run_worker(options: Options, out: Path) -> None:
    """What every process of a run but the first does, see `processes`."""
    processes.run_worker(stages_of(RunContext(options, networks.open_networks(options, out / "cache"), out)), out)


def _since(before: dict[str, int]) -> dict[str, int]:
    return {name: count - before[name] for name, count in compilation_counts().items()}


def dry_run(options: Options, out: Path, *, scene_only: bool = False, listener: Listener) -> dict[str, Any]:
    """Lists the stages that `run` would compute, and writes nothing.

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
    from jsecon.pipeline.checks import check_inputs

    with listener.progress("plan"):
        work = RunContext(options, networks.open_networks(options, out / "cache"), out)
        stages = [*capture_stages(work), gaussians(work), held_out(work)] if scene_only else stages_of(work)
        plan = _planned(work, stages, out / "cache")
        running = [step.name for step in plan.steps if step.status == "run"]
        work.networks.require_ready(running)
        check_inputs(work, running, plan.place)
    listener.steps(f"{options.capture} -> {out}, a dry run", plan.steps)
    listener.say("Nothing was written.")
    return {"stages": plan.steps}


def fit(options: Options, out: Path, *, listener: Listener | None = None) -> tuple[Gaussians, Capture, Quality]:
    """The stages of `run` that make and measure the scene; OUT/cache is theirs too, so a `run` into OUT goes on from
    it. Returns the Gaussians, their capture, and the quality of the frames held out."""
    work = RunContext(options, networks.open_networks(options, out / "cache"), out)
    stages = [*capture_stages(work), gaussians(work), held_out(work)]
    results = _computed(work, stages, out / "cache", listener or Listener(), Coordinator(several=False)).results
    return results["gaussians"], results["load"], results["held_out"]


def _left(stage: Stage, stages: list[Stage], place: dict[str, Path]) -> bool:
    """Whether the folder that the stage left is still its own, or nobody will look for it."""
    key = stage.output_dir / KEY_FILE if stage.output_dir is not None else None
    if key is not None and key.is_file() and key.read_text() == cache.record_path_of(place[stage.name]).stem:
        return True
    return all(place[other.name].exists() for other in stages if stage.name in other.after)


def _provenance(options: Options, keys: dict[str, str], embedder: str, out: Path) -> str:
    """JSON of where a field comes from: `jsecon.pipeline.sources` reads "embedder" and "folders"."""
    chosen = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    chosen = {name: str(value) if isinstance(value, Path) else value for name, value in chosen.items()}
    told = {"jsecon": jsecon.__version__, "options": chosen, "keys": keys, "embedder": embedder}
    return json.dumps(told | {"folders": relative_folders(options, out)}, sort_keys=True)
