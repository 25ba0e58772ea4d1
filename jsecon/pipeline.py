"""A run: from a capture to a language field, stage by stage, each kept as it is finished.

    load -> gaussians -> masklets -> regions -> codes -> votes -> distil -> field, then the held-out frames measured

The keys of all stages are known before any runs, so the whole plan is told first: what will run, what is cached, what
is left out and why.
"""

import dataclasses
import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import jsecon
from jsecon import cache, eyes, stages
from jsecon.errors import InputError
from jsecon.options import Options, require_inputs, require_writable
from jsecon.plan import Reporter, Silent, Step
from jsecon.recipe import Stage, left_out, record_of, stages_of
from jsecon.stages import Outcome
from jsecon.types import Capture, LanguageField

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
        raise InputError(
            out,
            found="the capture's own folder as the output folder",
            expected="a folder of its own",
            remedy=f"For example {out / 'field'}, or one elsewhere.",
        )
    require_inputs(options)
    require_writable(out)
    seeing = eyes.eyes_of(options, folder)
    cache.prepare(folder)
    plan = stages_of(options, out, folder, seeing, load)
    steps = [Step(s.name, "cached" if cache.path_of(folder, s.name, s.key).exists() else "run", s.how) for s in plan]
    steps += [Step(name, "left out", why) for name, why in left_out(options).items()]
    reporter.plan(f"{options.capture} -> {out}", steps)
    seeing.require_ready([step.name for step in steps if step.status == "run"])
    results: dict[str, Any] = {}
    seconds: dict[str, float] = {}
    notes: list[str] = []
    for stage in plan:
        with reporter.progress(stage.name) as progress:
            kept = cache.fetch(
                folder, stage.name, stage.key, lambda s=stage, p=progress: s.compute(results, p), note=reporter.note
            )
        outcome: Outcome = kept.value
        results[stage.name], seconds[stage.name] = outcome.value, kept.seconds
        record_of(folder, stage.name, stage.key).unlink(missing_ok=True)
        reporter.done(stage.name, kept.seconds, kept.fresh)
        for part, why in outcome.left_out.items():
            steps.append(Step(part, "left out", why))
            reporter.step(steps[-1])
        for note in outcome.notes:
            notes.append(note)
            reporter.note(note)
    started = time.monotonic()
    field = _field(results, seeing.embedder, _provenance(options, plan))
    from jsecon.language.field import save_field

    save_field(out / FIELD_FILE, field)
    seconds["field"] = time.monotonic() - started
    reporter.done("field", seconds["field"], True)
    return Run(
        field, results["load"], results["masklets"], results["held_out"], seconds, tuple(steps), tuple(notes), options
    )


def _field(results: dict[str, Any], embedder: Any, provenance: str) -> LanguageField:
    table, coder = results["codes"]
    return stages.assemble(
        results["load"],
        results["gaussians"],
        results["regions"],
        table,
        coder,
        results["votes"],
        results["distil"],
        embedder,
        provenance,
    )


def _provenance(options: Options, plan: list[Stage]) -> str:
    chosen = {f.name: getattr(options, f.name) for f in dataclasses.fields(options)}
    return json.dumps(
        {
            "jsecon": jsecon.__version__,
            "options": {k: str(v) if isinstance(v, Path) else v for k, v in chosen.items()},
            "keys": {stage.name: stage.key for stage in plan},
        },
        sort_keys=True,
    )
