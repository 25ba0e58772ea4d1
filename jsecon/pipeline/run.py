"""A run: from a capture to a language field, stage by stage, each stored as it is finished.

The keys of all stages are known before any runs, so the plan is printed first: which stages run, and which are
cached. `stages` has the table of the stages.
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

from jsecon.backend import start_backend
from jsecon.errors import InputError
from jsecon.field.field import load_field
from jsecon.field.ledger import Ledger, LedgerView, camera_row
from jsecon.field.ledger_file import save_with_ledger
from jsecon.field.membership import normalise_votes
from jsecon.field.tree import voted_leaves
from jsecon.files import FIELD_FILE, exclusive_lock
from jsecon.parallel import allgather_tree
from jsecon.pipeline import cache
from jsecon.pipeline.model_loading import open_models
from jsecon.pipeline.objects import plan_objects
from jsecon.pipeline.options import Options, check_ranges, is_bare_scene, read_date, require_writable
from jsecon.pipeline.progress import Console, Step
from jsecon.pipeline.scene_files import read_scene
from jsecon.pipeline.scene_stages import plan_scene
from jsecon.pipeline.sources import provenance
from jsecon.pipeline.stages import (
    WARNING,
    Checkpoint,
    Results,
    RunContext,
    Stage,
    StageInput,
    StageResult,
    training_frames,
)
from jsecon.poses.sfm import require_pycolmap
from jsecon.read.captures.build import plan_frames
from jsecon.read.captures.capture import read_posed_images
from jsecon.read.captures.frames import FrameOptions, evenly_spaced
from jsecon.read.captures.images import encode_jpeg
from jsecon.read.masks.masks import load_proposals
from jsecon.read.splats.point_clouds import load_point_cloud
from jsecon.types import Capture, Gaussians, LanguageField, Quality, Regions
from jsecon.views.frame import field_up
from jsecon.vision.classical import require_contrib
from jsecon.vision.protocols import Embedder
from jsecon.vision.unrelated_words import embed_unrelated_words


@dataclasses.dataclass(frozen=True)
class _RunState:
    """The plan of stages, and what is computed of it."""

    keys: dict[str, str]
    """Key of each stage."""
    paths: dict[str, Path]
    """Cache file of each stage."""
    steps: list[Step]
    """The stages."""
    results: Results = dataclasses.field(default_factory=Results)
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    """Wall time of each stage, also of one that was computed in an earlier run."""
    notes: list[str] = dataclasses.field(default_factory=list)
    """What the user should know, a sentence each."""
    sent: set[str] = dataclasses.field(default_factory=set)
    """Results that the other processes have."""

    @property
    def running(self) -> list[str]:
        """Stages that would run."""
        return [step.name for step in self.steps if step.status == "run"]


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run."""

    field: LanguageField
    options: Options
    capture: Capture
    """The capture, corrected if the options ask for that."""
    labels: np.ndarray
    """(T, H, W) int16 labels of the training frames that vision uses."""
    vision_frames: np.ndarray
    """(T,) which frames of the capture these are."""
    held_out: Quality
    """PSNR and SSIM of the held-out frames."""
    steps: list[Step]
    """The stages."""
    seconds: dict[str, float]
    """Wall time of each stage, also of one that was computed in an earlier run."""
    notes: list[str]
    """What the user should know, a sentence each."""


def _run_stages(context: RunContext) -> list[Stage]:
    """Plans the stages of a run. Mask files come before the long fit, so that their errors are found early."""
    stages = [*plan_scene(context), *plan_objects(context)]
    early = ("objects", "gaussians") if context.options.masks is not None else ("gaussians", "objects")
    order = ("poses", "load", *early, "regions", "parts", "votes", "codes", "held_out")
    return sorted(stages, key=lambda stage: order.index(stage.name))


def _plan(context: RunContext, stage_list: list[Stage]) -> _RunState:
    """Plans stages: which of them the cache holds. Writes no file; raises InputError for invalid options."""
    _require_inputs(context.options)
    _require_own_folder(context.options, context.out)
    require_contrib()
    keys: dict[str, str] = {}
    for stage in stage_list:
        keys[stage.name] = stage.key(keys, context.out)
    paths = {name: context.out / "cache" / f"{name}-{key}.safetensors" for name, key in keys.items()}
    steps = [Step(stage.name, "cached" if paths[stage.name].exists() else "run", stage.task) for stage in stage_list]
    return _RunState(keys, paths, steps)


def _require_inputs(options: Options) -> None:
    """Raises InputError for a missing file, a value that is out of its range, or several sources of masks."""
    check_ranges(options)
    if options.date is not None:
        read_date(options.date)
    _require_options_apply(options)
    for name, value in vars(options).items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, Path) and not value.exists():
            remedy = "Check the path." if name == "capture" else f"Check the path, or leave out {flag}."
            raise InputError(value, "no such file or folder", remedy=remedy)
    sources = [f"--{name}" for name in ("masks", "proposals", "segmenter") if getattr(options, name) is not None]
    if len(sources) > 1:
        expected = "one: tracked masks, masks of single frames, or a model that finds them"
        raise InputError(" ".join(sources), "more than one source of masks", expected, "Leave out the others.")


def _require_options_apply(options: Options) -> None:
    """Raises InputError if an option is set that the input has no use for."""
    bare = is_bare_scene(options.capture)
    kind = "a scene without photographs" if bare else "a capture, which has its own views"
    defaults = {field.name: field.default for field in dataclasses.fields(options)}
    for name in ("frames", "holdout", "refine", "ignore", "gaussians", "points") if bare else ("views", "cameras"):
        if getattr(options, name) != defaults[name]:
            remedy = "Leave it out, or give the folder of the photographs." if bare else "Leave it out."
            raise InputError(f"--{name}", f"{options.capture.name} is {kind}", remedy=remedy)


def _require_own_folder(options: Options, out: Path) -> None:
    """Raises InputError if the output folder is an input folder, or a folder of the capture's files."""
    inputs = [value for value in vars(options).values() if isinstance(value, Path)]
    inputs += [options.capture / name for name in ("images", "sparse", "sparse/0", "keyframes")]
    if any(folder.is_dir() and folder.resolve() == out.resolve() for folder in inputs):
        remedy = f"Give the output its own folder, for example {out / 'field'}, or one elsewhere."
        raise InputError(out, "it is an input folder and the output folder at once", "", remedy)


def _compute_stages(
    context: RunContext,
    stage_list: list[Stage],
    console: Console | None = None,
    on_scene: Callable[[Capture, Gaussians], None] | None = None,
) -> _RunState:
    """Plans stages, reports the plan, then computes each or reads it from the cache.

    `on_scene` is called with the capture and the scene as soon as both are known.
    """
    console = console or Console()
    with console.progress("plan"):
        state = _plan(context, stage_list)
        require_writable(context.out)
    with exclusive_lock(context.out):
        cache.prepare(context.out / "cache")
        _print_plan(console, f"{context.options.capture} -> {context.out}", state.steps)
        context.models.require_ready(state.running)
        for stage in stage_list:
            _compute_stage(context, stage, state, console)
            if stage.name == "gaussians" and on_scene is not None:
                on_scene(state.results.load, state.results.gaussians)
        _broadcast(None, state)
    return state


def _print_plan(console: Console, title: str, steps: list[Step]) -> None:
    """Prints the steps that are planned."""
    console.print_line(title)
    for step in steps:
        console.print_line(f"  {step.name:<16} {step.status:<9} {step.why}".rstrip())


def _compute_stage(context: RunContext, stage: Stage, state: _RunState, console: Console) -> None:
    """Computes one stage or reads it from the cache, and adds it to the state."""
    path = state.paths[stage.name]
    checkpoint = Checkpoint(path)

    def compute(progress: Any) -> StageResult:
        _broadcast(stage, state)
        result = stage.compute(StageInput(context, state.results, progress, checkpoint))
        if stage.key(state.keys, context.out) != state.keys[stage.name]:  # then it does not describe the result
            where = next(filter(None, stage.files)) if len(stage.files) == 1 else context.options.capture
            problem = f"files that changed while stage {stage.name} read them"
            remedy = "Run the same command again when no program writes there; finished stages are kept."
            raise InputError(where, problem, "files that stay as they are during a run", remedy)
        return result

    with console.progress(stage.name) as progress:
        result, seconds, fresh = cache.read_or_compute(path, functools.partial(compute, progress), note=console.note)
    setattr(state.results, stage.name, result.value)
    state.seconds[stage.name] = seconds
    checkpoint.remove()
    console.done(stage.name, seconds, fresh)
    for note in result.notes:
        state.notes.append(note)
        console.note(note)


def _broadcast(stage: Stage | None, state: _RunState) -> None:
    """Lets all processes compute a stage that is distributed, or ends the work of the others if there is no stage."""
    if jax.process_count() == 1:
        return
    if stage is None:
        allgather_tree({"stage": ""})
    elif stage.distributed:
        new = {name: getattr(state.results, name) for name in stage.after if name not in state.sent}
        state.sent.update(new)
        allgather_tree({"stage": stage.name, "results": new})


def run_worker(options: Options, out: Path) -> None:
    """Computes each stage that the first process calls for, until it ends the work. It writes no file."""
    context, results = _open_context(options, out), Results()
    by_name = {stage.name: stage for stage in _run_stages(context)}
    while (call := allgather_tree(None)[0])["stage"]:
        vars(results).update(call["results"])
        checkpoint = Checkpoint(out / "worker")
        by_name[call["stage"]].compute(StageInput(context, results, lambda done, total: None, checkpoint))


def run(
    options: Options,
    out: Path,
    *,
    console: Console | None = None,
    on_scene: Callable[[Capture, Gaussians], None] | None = None,
) -> Run:
    """Builds the field of a capture and writes OUT/field.safetensors.

    A run that was stopped resumes where it stopped, to the same result. `on_scene` is called with the capture and the
    scene as soon as both are known.
    """
    console = console or Console()
    context = _open_context(options, out)
    state = _compute_stages(context, _run_stages(context), console, on_scene)
    results, seconds, embedder = state.results, state.seconds, context.models.embedder
    started = time.monotonic()
    with console.progress("field"):
        warnings = [note.removeprefix(WARNING) for note in state.notes if note.startswith(WARNING)]
        origin = provenance(context.options, state.keys, out, warnings)
        field = join_field(results, embedder, origin, context.options)
        field = save_with_ledger(out / FIELD_FILE, field, _make_ledger(results) if options.ledger else None)
    seconds["field"] = time.monotonic() - started
    console.done("field", seconds["field"], True)
    if field.up is not None and not field.up.sure:
        state.notes.append(f"up is from {field.up}")
        console.note(state.notes[-1])
    made = results.load, results.objects.labels, results.objects.frames, results.held_out
    return Run(field, context.options, *made, state.steps, seconds, state.notes)


def join_field(results: Results, embedder: Embedder, provenance: str, options: Options) -> LanguageField:
    """Joins the results of a run to a field."""
    capture, embedded = results.load, results.regions

    def of_capture(regions: Regions) -> Regions:
        """Regions with their pixels in all frames of the capture."""
        pixels = np.zeros((regions.count, len(capture.names)), np.int32)
        pixels[:, results.objects.frames] = regions.pixel_counts
        return Regions(regions.embeddings, pixels)

    scale = capture.metres_per_unit if options.metres_per_unit is None else options.metres_per_unit
    field = LanguageField(
        gaussians=results.gaussians,
        votes=normalise_votes(results.votes[0], embedded),
        regions=of_capture(embedded),
        cameras=capture.cameras,
        canonical_phrases=np.asarray(embedder.canonical_phrases, np.float32),
        source_from_scene=np.asarray(capture.source_from_scene),
        names=capture.names,
        embedder=embedder.name,
        provenance=provenance,
        unrelated_words=embed_unrelated_words(embedder).astype(np.float16),
        codes=results.codes,
        up=capture.up,
        metres_per_unit=scale,
        tree=results.objects.tree,
        leaf=results.objects.leaf,
        part_regions=None if results.parts is None else of_capture(results.parts),
        part_nodes=results.objects.part_nodes,
    )
    if (nodes := results.votes[2]) is not None:
        field = dataclasses.replace(field, leaf=voted_leaves(field, np.asarray(nodes)))
    return dataclasses.replace(field, up=field_up(field, options.up))


def _make_ledger(results: Results) -> Ledger:
    """Gathers what each view contributed to the field of a run."""
    capture, regions, views = results.load, results.regions, {}
    assert regions.embedded is not None
    assert regions.view_embeddings is not None
    for t, (frame, evidence) in enumerate(zip(results.objects.frames, results.votes[1])):
        shown, rows = np.flatnonzero(regions.pixel_counts[:, t]), regions.embedded[:, 1] == t
        pixels = np.stack([shown, regions.pixel_counts[shown, t]]).astype(np.int32)
        embedded = np.asarray(regions.embedded[rows, 0]), np.asarray(regions.view_embeddings[rows])
        row, picture = camera_row(capture.cameras[frame]), encode_jpeg(np.asarray(capture.frames[frame]))
        views[capture.names[frame]] = LedgerView(evidence, pixels, *embedded, row, picture)
    return Ledger(regions.count, views)


def _open_context(options: Options, out: Path) -> RunContext:
    """Starts jax's devices, and opens the models of a run."""
    start_backend()
    return RunContext(*open_models(options, out / "cache"), out)


def current_field(options: Options, out: Path) -> Path | None:
    """Looks for the field that a run would write, without running."""
    path = out / FIELD_FILE
    if not path.is_file():
        return None
    context = _open_context(options, out)
    keys = _plan(context, _run_stages(context)).keys
    try:
        origin = json.loads(load_field(path, mapped=True).provenance)
    except (InputError, ValueError):  # damaged: the run writes it anew
        return None
    return path if origin.get("keys") == keys else None


def dry_run(options: Options, out: Path, *, scene_only: bool = False, console: Console) -> dict[str, Any]:
    """Lists the stages that `run` would compute, and writes no file."""
    with console.progress("plan"):
        context = _open_context(options, out)
        plan = _plan(context, plan_scene(context) if scene_only else _run_stages(context))
        context.models.require_ready(plan.running)
        _check_inputs(context, plan)
    _print_plan(console, f"{options.capture} -> {out}, a dry run", plan.steps)
    console.print_line("Nothing was written.")
    return {"stages": plan.steps}


def _check_inputs(context: RunContext, plan: _RunState) -> None:
    """Raises InputError for inputs that a run would refuse, as its stages check them before their long work.

    Those of stages that would run are checked, by headers and a few files; masks only if the frames have poses.
    """
    options, running = context.options, plan.running
    require_writable(context.out, create=False)
    if is_bare_scene(options.capture):
        read_scene(options.capture)
        return
    if options.gaussians is not None and "gaussians" in running:
        read_scene(options.gaussians)
    if options.points is not None and "load" in running:
        load_point_cloud(options.points)
    if "poses" in running:
        require_pycolmap(options.capture)
        return
    folder = plan.paths["poses"].with_suffix("") if "poses" in plan.paths else options.capture
    of_frames = FrameOptions(long_side=options.long_side, frames=options.frames, holdout=options.holdout)
    frames, (width, height), held_out = plan_frames(read_posed_images(folder), of_frames)
    train = training_frames(held_out)
    names = [list(frames)[t] for t in train[evenly_spaced(len(train), options.vision_frames)]]
    size, layout = (height, width), {"level": options.level, "frames": frames}
    for masks in (options.masks, options.proposals):
        if masks is not None and "objects" in running:
            load_proposals(masks, names, size, **layout)[0](0)


def fit(options: Options, out: Path, *, console: Console | None = None) -> tuple[Gaussians, Capture, Quality]:
    """Computes the stages of `run` that make and measure the scene, into the same cache, so that a `run` continues."""
    context = _open_context(options, out)
    results = _compute_stages(context, plan_scene(context), console).results
    return results.gaussians, results.load, results.held_out
