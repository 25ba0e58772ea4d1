"""The stages of a run in order, each with the key of its result and the step that computes it."""

import contextlib
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jsecon import cache, stages
from jsecon.eyes import Eyes
from jsecon.options import Options
from jsecon.stages import Outcome
from jsecon.types import Capture

CHECKPOINT_SECONDS = 20.0
"""between two records of a stage in progress: a stop loses at most this and one chunk of steps, or one tracked frame"""


@dataclasses.dataclass(frozen=True)
class Stage:
    """One step of a run."""

    name: str
    how: str
    """for the plan."""
    key: str
    compute: Callable[..., Outcome]
    """(the results so far by stage, progress) -> Outcome."""


def left_out(options: Options) -> dict[str, str]:
    """What the options alone make needless."""
    left = {}
    if options.gaussians is not None:
        left["photometric fit"] = f"the scene's Gaussians are given ({options.gaussians.name})"
    else:
        left["densification"] = "the fit keeps the points that it starts from"
        if options.sh_degree == 0:
            left["view-dependent colour"] = "SH degree 0"
    if options.masks is not None:
        left["segmenter"] = left["association"] = f"masks are given ({options.masks.name})"
    if options.features is not None:
        left["embedder"] = f"embeddings are given ({options.features.name})"
    return left


def stages_of(
    options: Options,
    out: Path,
    folder: Path,
    seeing: Eyes,
    load: Callable[[], Capture] | None,
) -> list[Stage]:
    """The stages in order, with their keys. Models count by their content, not by the place of their files."""
    keys: dict[str, str] = {}
    plan: list[Stage] = []

    def add(
        name: str,
        how: str,
        compute: Callable[..., Outcome],
        *,
        rooms: tuple[str, ...],
        after: tuple[str, ...] = (),
        given: dict[str, Any] | None = None,
        files: Path | None = None,
    ) -> None:
        keys[name] = cache.key_of(
            name,
            {
                "source": cache.source_digest((*rooms, "stages")),
                "after": [keys[other] for other in after],
                "given": given or {},
                "files": None if files is None else cache.files_digest([files], leave_out=out),
            },
        )
        plan.append(Stage(name, how, keys[name], compute))

    if options.downscale is None:
        size = f"long side at most {options.long_side} px"
    else:
        size = "full size" if options.downscale == 1 else f"{options.downscale:g} times smaller"
    count = "all frames" if options.frames is None else f"at most {options.frames} frames"
    add(
        "load",
        f"{count}, {size}, " + (f"1 in {options.holdout} held out" if options.holdout else "none held out"),
        lambda r, p: stages.load_frames(options, p) if load is None else stages.checked(load(), "by its adapter"),
        rooms=("data",),
        files=options.capture,
        given=_of(options, "downscale", "long_side", "frames", "holdout")
        | {"loader": getattr(load, "__qualname__", None)},
    )
    if options.masks is not None:  # files first: what is wrong with them is said before the long fit
        add(
            "masklets",
            f"read from {options.masks.name}",
            lambda r, p: stages.masklets_from_disk(options, r["load"], p),
            rooms=("data",),
            after=("load",),
            files=options.masks,
            given=_of(options, "level"),
        )
    if options.gaussians is not None:
        add(
            "gaussians",
            f"read from {options.gaussians.name}",
            lambda r, p: stages.given_gaussians(options, r["load"]),
            rooms=("data",),
            after=("load",),
            files=options.gaussians,
        )
    else:
        add(
            "gaussians",
            f"fitted to the frames in {options.steps} steps, SH degree {options.sh_degree}",
            lambda r, p: _fit(options, folder, keys["gaussians"], r["load"], p),
            rooms=("fit", "splat", "parallel"),
            after=("load",),
            given=_of(options, "steps", "sh_degree", "seed"),
        )
    if options.masks is None:
        consensus, tracker = options.associated_by == "consensus", seeing.tracker
        add(
            "masklets",
            f"{_proposals(options)}, {_association(options)}",
            lambda r, p: _masklets(options, folder, keys["masklets"], r, seeing, p),
            rooms=(
                "vision",
                "language.masklets",
                "language.consensus",
                "language.grouping",
                "language.votes",
                "fit.initialise",
                "proposals",
                "splat",
                "parallel",
            ),
            after=("load", "gaussians"),
            given=_of(options, *(("agreement", "seed") if consensus else ("iou_threshold",)))
            | {"association": options.associated_by, "tracker": None if tracker is None else tracker.name}
            | _eye(options, seeing.segmenter),
            files=options.proposals,
        )
    if options.features is None:
        how, rooms, given = f"embedded by {seeing.embedder.name!r}", ("vision",), {"embedder": seeing.embedder.name}
    else:
        how = f"embeddings read from {options.features.name}, level {options.level}"
        rooms, given = ("data",), _of(options, "level")
    add(
        "regions",
        f"{how}, views weighted by {options.weighting}",
        lambda r, p: stages.regions(options, r["load"], r["masklets"], seeing.embedder, p),
        rooms=(*rooms, "language.regions"),
        after=("load", "masklets"),
        given=_of(options, "weighting") | given,
        files=options.features,
    )
    add(
        "codes",
        "as few numbers a region as keep them apart"
        if options.latent == "auto"
        else f"at most {options.latent} numbers a region",
        lambda r, p: stages.codes(options, r["regions"], p),
        rooms=("language.autoencoder", "language.codes"),
        after=("regions",),
        given=_of(options, "latent", "seed"),
    )
    add(
        "votes",
        f"the {options.top} strongest regions of each Gaussian",
        lambda r, p: stages.votes(options, r["load"], r["gaussians"], r["masklets"], r["regions"].count, p),
        rooms=("language.votes", "splat", "parallel"),
        after=("load", "gaussians", "masklets"),
        given=_of(options, "top"),
    )
    add(
        "distil",
        f"a Gaussian's code is its votes' {options.reduce}",
        lambda r, p: stages.distil(options, r["votes"], r["codes"][0]),
        rooms=("language.distill",),
        after=("votes", "codes"),
        given=_of(options, "reduce"),
    )
    add(
        "held_out",
        "PSNR of the rendered colours",
        lambda r, p: stages.held_out_psnr(r["load"], r["gaussians"], p),
        rooms=("fit", "splat", "parallel"),
        after=("load", "gaussians"),
    )
    return plan


def _proposals(options: Options) -> str:
    """Where the proposals come from, for the plan."""
    if options.proposals is not None:
        return f"proposals read from {options.proposals.name}"
    if options.segmenter is not None:
        crops = f" and {options.crop_layers} layers of crops" if options.crop_layers else ""
        grid = f"{options.points_per_side}x{options.points_per_side}"
        return f"proposals of level {options.level} by {options.segmenter.name}, asked at {grid} points{crops}"
    return f"{options.granularity} proposals by colour and texture"


def _association(options: Options) -> str:
    """How they are brought together, for the plan."""
    if options.associated_by == "consensus":
        return "what the views agree on"
    return "followed " + (
        "through the Gaussians" if options.tracker is None else f"by the SAM 2 of {options.tracker.name}"
    )


def _eye(options: Options, segmenter: Any) -> dict[str, Any]:
    """What the proposals depend on beside the frames."""
    if options.proposals is not None:
        return _of(options, "level")
    if segmenter is not None:
        return {"model": segmenter.name}
    return _of(options, "granularity")


def _of(options: Options, *names: str) -> dict[str, Any]:
    return {name: getattr(options, name) for name in names}


def record_of(folder: Path, stage: str, key: str) -> Path:
    """Where a stage in progress keeps how far it has come; removed when its result is kept."""
    return folder / f"{stage}-{key}.checkpoint.npz"


def _fit(options: Options, folder: Path, key: str, capture: Capture, progress: Any) -> Outcome:
    """The photometric fit, gone on with from its last record where there is one."""
    state, keep = _records(record_of(folder, "gaussians", key))
    return stages.fitted_gaussians(options, capture, progress, state, lambda current: keep(lambda: current))


def _masklets(
    options: Options, folder: Path, key: str, results: dict[str, Any], seeing: Eyes, progress: Any
) -> Outcome:
    """The masklets; a tracker that was stopped goes on behind the last frame recorded."""
    state, keep = _records(record_of(folder, "masklets", key))
    return stages.masklets_from_frames(
        options, results["load"], results["gaussians"], seeing, progress, state=state, on_checkpoint=keep
    )


def _records(record: Path) -> tuple[Any, Callable[[Callable[[], Any]], None]]:
    """What a stopped stage last recorded, or None; and what records it anew, given a function that makes the state."""
    state, last = None, time.monotonic()
    if record.exists():
        # A record that cannot be read loses time and nothing else: the stage starts again, to the same result.
        with contextlib.suppress(cache.CorruptCacheError):
            state = cache.load(record)

    def keep(current: Callable[[], Any]) -> None:
        nonlocal last
        if time.monotonic() - last >= CHECKPOINT_SECONDS:
            cache.save(record, current())
            last = time.monotonic()

    return state, keep
