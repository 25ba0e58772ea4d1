"""A run: from a capture to a language field, stage by stage, each kept as it is finished.

    load -> gaussians -> masklets -> regions -> codes -> votes -> distil -> field, then the held-out frames measured

The keys of all stages are known before any runs, so the whole plan is told first: what will run, what is cached, what is
left out and why.
"""

import contextlib
import dataclasses
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import jsecon
from jsecon import cache, stages
from jsecon.errors import InputError
from jsecon.plan import Reporter, Silent, Step
from jsecon.stages import Options, Outcome
from jsecon.types import Capture, LanguageField

CHECKPOINT_SECONDS = 20.0
"""between two records of a fit in progress: a stop loses at most this and one chunk of steps"""
FIELD_FILE = "field.npz"


@dataclasses.dataclass(frozen=True)
class Run:
    """A finished run."""

    field: LanguageField
    capture: Capture
    labels: np.ndarray
    """(T, H, W) int16 masklets of the field's views."""
    psnr: np.ndarray
    """(frames held out,) dB."""
    seconds: dict[str, float]
    """of each stage, also where it was computed in an earlier run."""
    steps: tuple[Step, ...]
    """the plan, with what only the data could settle."""
    notes: tuple[str, ...]
    options: Options

    @property
    def left_out(self) -> dict[str, str]:
        """part -> why it was not needed."""
        return {step.name: step.why for step in self.steps if step.status == "left out"}


@dataclasses.dataclass(frozen=True)
class _Stage:
    name: str
    how: str
    """for the plan."""
    key: str
    compute: Callable[..., Outcome]
    """(the results so far by stage, progress) -> Outcome."""


def embedder_named(name: str | None = None) -> Any:
    """The embedder whose space a field lives in; the default one without a name. Raises InputError for one that this
    version does not have."""
    from jsecon.vision.colours import ColourEmbedder

    embedder = ColourEmbedder()
    if name not in (None, embedder.name):
        raise InputError("field", found=f"regions embedded by {name!r}", expected=f"{embedder.name!r}",
                         remedy="Run the capture again with this version.")
    return embedder


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def run(
    options: Options,
    out: Path,
    *,
    reporter: Reporter | None = None,
    load: Callable[[], Capture] | None = None,
    cache_folder: Path | None = None,
) -> Run:
    """Builds the field of a capture, keeps each stage under `cache_folder` (default OUT/cache), writes OUT/field.npz.

    A run that was stopped goes on where it stopped, to the same result. `load` takes the loader's place for data whose
    layout is one of a kind (the files beneath `options.capture` must still be all that it reads). Raises InputError for
    bad input; what was computed before stays.
    """
    reporter = reporter or Silent()
    folder = cache_folder or out / "cache"
    if out.resolve() == options.capture.resolve():
        raise InputError(out, found="the capture's own folder as the output folder", expected="a folder of its own",
                         remedy=f"For example {out / 'field'}, or one elsewhere.")
    embedder = embedder_named()
    require_writable(out)
    cache.prepare(folder)
    plan = _stages(options, out, folder, embedder, load)
    steps = [Step(s.name, "cached" if cache.path_of(folder, s.name, s.key).exists() else "run", s.how) for s in plan]
    steps += [Step(name, "left out", why) for name, why in _left_out(options).items()]
    reporter.plan(f"{options.capture} -> {out}", steps)
    results: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    notes: list[str] = []
    for stage in plan:
        with reporter.progress(stage.name) as progress:
            kept = cache.fetch(folder, stage.name, stage.key, lambda s=stage, p=progress: s.compute(results, p),
                               note=reporter.note)
        outcome: Outcome = kept.value
        results[stage.name], seconds[stage.name] = outcome.value, kept.seconds
        _record(folder, stage.name, stage.key).unlink(missing_ok=True)
        reporter.done(stage.name, kept.seconds, kept.fresh)
        for part, why in outcome.left_out.items():
            steps.append(Step(part, "left out", why))
            reporter.step(steps[-1])
        for note in outcome.notes:
            notes.append(note)
            reporter.note(note)
    started = time.monotonic()
    field = _field(results, embedder, _provenance(options, plan))
    from jsecon.language.field import save_field

    save_field(out / FIELD_FILE, field)
    seconds["field"] = time.monotonic() - started
    reporter.done("field", seconds["field"], True)
    return Run(field, results["load"], results["masklets"], results["held_out"], seconds, tuple(steps), tuple(notes), options)


def _field(results: dict[str, Any], embedder: Any, provenance: str) -> LanguageField:
    table, coder = results["codes"]
    return stages.assemble(results["load"], results["gaussians"], results["regions"], table, coder, results["votes"],
                           results["distil"], embedder, provenance)


def _provenance(options: Options, plan: list[_Stage]) -> str:
    chosen = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    return json.dumps({"jsecon": jsecon.__version__, "options": {k: str(v) if isinstance(v, Path) else v
                                                                for k, v in chosen.items()},
                       "keys": {stage.name: stage.key for stage in plan}}, sort_keys=True)


def _left_out(options: Options) -> dict[str, str]:
    """What the options alone make needless."""
    left = {}
    if options.gaussians is not None:
        left["photometric fit"] = f"the scene's Gaussians are given ({options.gaussians.name})"
    else:
        left["densification"] = "the fit keeps the points that it starts from"
        if options.sh_degree == 0:
            left["view-dependent colour"] = "SH degree 0"
    if options.masks is not None:
        left["segmenter"] = left["tracker"] = f"masks are given ({options.masks.name})"
    return left


def _stages(
    options: Options, out: Path, folder: Path, embedder: Any, load: Callable[[], Capture] | None
) -> list[_Stage]:
    """The stages in order, with their keys."""
    require_inputs(options)
    keys: dict[str, str] = {}
    plan: list[_Stage] = []

    def add(name: str, how: str, compute: Callable[..., Outcome], *, rooms: tuple[str, ...], after: tuple[str, ...] = (),
            given: dict[str, Any] | None = None, files: Path | None = None) -> None:
        keys[name] = cache.key_of(name, {
            "source": cache.source_digest((*rooms, "stages")), "after": [keys[other] for other in after],
            "given": given or {}, "files": None if files is None else cache.files_digest([files], leave_out=out)})
        plan.append(_Stage(name, how, keys[name], compute))

    size = f"long side <= {options.long_side} px" if options.downscale is None else f"{options.downscale:g} times smaller"
    count = "all frames" if options.frames is None else f"at most {options.frames} frames"
    add("load", f"{count}, {size}, " + (f"1 in {options.holdout} held out" if options.holdout else "none held out"),
        lambda r, p: stages.load_frames(options, p) if load is None else stages.checked(load(), "by its adapter"),
        rooms=("data",), files=options.capture,
        given=_of(options, "downscale", "long_side", "frames", "holdout") | {"loader": getattr(load, "__qualname__", None)})
    if options.gaussians is not None:
        add("gaussians", f"read from {options.gaussians.name}", lambda r, p: stages.given_gaussians(options, r["load"]),
            rooms=("data.ply",), after=("load",), files=options.gaussians)
    else:
        add("gaussians", f"fitted to the frames in {options.steps} steps, SH degree {options.sh_degree}",
            lambda r, p: _fit(options, folder, keys["gaussians"], r["load"], p), rooms=("fit", "splat"), after=("load",),
            given=_of(options, "steps", "sh_degree", "seed"))
    if options.masks is not None:
        add("masklets", f"read from {options.masks.name}", lambda r, p: stages.masklets_from_disk(options, r["load"], p),
            rooms=("data",), after=("load",), files=options.masks)
    else:
        add("masklets", "proposals by colour and texture, followed through the Gaussians",
            lambda r, p: stages.masklets_from_frames(options, r["load"], r["gaussians"], p),
            rooms=("vision", "language.masklets", "language.votes", "splat"), after=("load", "gaussians"),
            given=_of(options, "iou_threshold"))
    add("regions", f"embedded by {embedder.name!r}, views weighted by {options.weighting}",
        lambda r, p: stages.regions(options, r["load"], r["masklets"], embedder, p),
        rooms=("vision", "language.regions"), after=("load", "masklets"), given=_of(options, "weighting"))
    add("codes", f"at most {options.latent} numbers a region", lambda r, p: stages.codes(options, r["regions"], p),
        rooms=("language.autoencoder",), after=("regions",), given=_of(options, "latent", "seed"))
    add("votes", f"the {options.top} strongest regions of each Gaussian",
        lambda r, p: stages.votes(options, r["load"], r["gaussians"], r["masklets"], r["regions"].count, p),
        rooms=("language.votes", "splat", "parallel"), after=("load", "gaussians", "masklets"), given=_of(options, "top"))
    add("distil", f"a Gaussian's code is its votes' {options.reduce}",
        lambda r, p: stages.distil(options, r["votes"], r["codes"][0]),
        rooms=("language.distill",), after=("votes", "codes"), given=_of(options, "reduce"))
    add("held_out", "PSNR of the rendered colours", lambda r, p: stages.held_out_psnr(r["load"], r["gaussians"], p),
        rooms=("fit", "splat"), after=("load", "gaussians"))
    return plan


def _of(options: Options, *names: str) -> dict[str, Any]:
    return {name: getattr(options, name) for name in names}


def require_inputs(options: Options) -> None:
    """Raises InputError where a file or folder that the options name is not there, or a number is out of its range."""
    for path, what, remedy in (
        (options.capture, "a folder with COLMAP's sparse/0 and images/, or a transforms.json", "Give the capture's folder."),
        (options.gaussians, "a .ply of 3D Gaussians", "Give the path of a .ply, or leave out --gaussians to fit the frames."),
        (options.masks, "a folder with one mask a frame", "Give the masks' folder, or leave out --masks to find them."),
    ):
        if path is not None and not path.exists():
            raise InputError(path, found="nothing there", expected=what, remedy=remedy)
    for name, least in (("downscale", 1.0), ("frames", 2), ("holdout", 0), ("steps", 1), ("latent", 1), ("top", 1),
                        ("long_side", 16)):
        value = getattr(options, name)
        if value is not None and not value >= least:
            raise InputError(f"--{name.replace('_', '-')}", found=str(value), expected=f"at least {least}",
                             remedy="Mend the option.")


def require_writable(folder: Path) -> None:
    """Raises InputError where no file can be made in `folder`; makes the folder itself."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(folder, found=error.strerror or type(error).__name__, expected="a folder that can be written",
                         remedy="Choose another output folder, or mend its permissions.") from error


def _record(folder: Path, stage: str, key: str) -> Path:
    """Where a stage in progress keeps how far it has come; removed when its result is kept."""
    return folder / f"{stage}-{key}.checkpoint.npz"


def _fit(options: Options, folder: Path, key: str, capture: Capture, progress: Any) -> Outcome:
    """The photometric fit, gone on with from its last record where there is one."""
    record, state, last = _record(folder, "gaussians", key), None, time.monotonic()
    if record.exists():
        # A record that cannot be read loses time and nothing else: the fit starts again, to the same result.
        with contextlib.suppress(cache.CorruptCacheError):
            state = cache.load(record)

    def keep(current: Any) -> None:
        nonlocal last
        if time.monotonic() - last >= CHECKPOINT_SECONDS:
            cache.save(record, current)
            last = time.monotonic()

    return stages.fitted_gaussians(options, capture, progress, state, keep)
