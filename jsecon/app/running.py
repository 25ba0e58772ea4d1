"""`jsecon run` and `jsecon fit`, and what a run writes at its end: metrics.json, and report.html with pictures."""

import contextlib
import dataclasses
import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.app import pictures, report, verbs
from jsecon.files import write_text
from jsecon.pipeline import processes, run as pipeline
from jsecon.pipeline.progress import Console
from jsecon.pipeline.results import WARNING, vision_frames
from jsecon.pipeline.run import Run
from jsecon.process import peak_memory_mib
from jsecon.read.captures.frames import evenly_spaced
from jsecon.read.splats.files import require_writable_format, save_gaussians
from jsecon.types import Quality

FILES = ("field.safetensors", "report.html", "metrics.json")
"""files of a run"""


def _run(verb: verbs.Run, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon run`; the result has the metrics, or the plan of a dry run."""
    options = verb.options
    if verb.dry_run:
        return pipeline.dry_run(options, verb.out, console=console)
    with processes.connection(options) if verb.distributed else contextlib.nullcontext(0) as index:
        if index == 0:
            run = pipeline.run(options, verb.out, console=console)
        else:
            pipeline.run_worker(options, verb.out)
    if index > 0:
        raise SystemExit(0)
    title = f"Language field of {options.capture.resolve().name}"
    metrics = write_run(run, verb.out, console, title, "Made by jsecon from posed frames.")
    query = f'jsecon query {verb.out / "field.safetensors"} "dark green bottle" --out {verb.out / "answers"}'
    console.print_line(f"next    {query}")
    return {"written": [verb.out / name for name in FILES]} | metrics


def _fit(verb: verbs.Fit, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon fit`: writes the scene in the world of the capture's files, and prints its figures."""
    require_writable_format(verb.out)
    folder = verb.out.with_suffix("")
    if verb.dry_run:
        return pipeline.dry_run(verb.options, folder, scene_only=True, console=console)
    gaussians, capture, held_out = pipeline.fit(verb.options, folder, console=console)
    save_gaussians(verb.out, gaussians, similarity=capture.source_from_scene)
    _print_quality(held_out, console)
    console.print_line(f"{gaussians.count} Gaussians  {verb.out}")
    return {"written": {"scene": verb.out}, "gaussians": gaussians.count} | _quality_metrics(held_out)


def write_run(
    run: Run, out: Path, console: Console, title: str, lead: str, parts: Sequence[str] = (), **figures: Any
) -> dict[str, Any]:
    """Writes OUT/metrics.json and OUT/report.html of a run, prints its figures, and returns the metrics.

    `parts` are sections that come first in the report (`jsecon.app.report`), and `figures` more metrics.
    """
    metrics = _run_metrics(run) | figures
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    warnings = [note.removeprefix(WARNING) for note in run.notes if note.startswith(WARNING)]
    with console.progress("report"):
        parts = [*(report.section("Warning", note) for note in warnings), _figures(metrics), *parts]
        write_text(out / "report.html", report.page(title, lead, [*parts, *_scene_parts(run), *_work_parts(run)]))
    _print_quality(run.held_out, console)
    for note in warnings:
        console.print_line(f"{WARNING}{note}")
    console.print_line(
        f"{metrics['gaussians']} Gaussians, {metrics['regions']} regions, "
        f"{sum(run.seconds.values()):.0f} s, peak memory {metrics['peak_memory_mib']:.0f} MiB, "
        f"{run.programs['all']} programs compiled ({run.programs['from_disk']} of them read from disk)"
    )
    field = out / "field.safetensors"
    console.print_line(f"field   {field}\nreport  {out / 'report.html'}")
    return metrics


def _quality_metrics(held_out: Quality) -> dict[str, float | None]:
    """Returns mean PSNR (dB) and SSIM of the held-out frames, None if there are no such frames."""
    some = len(held_out.frames) > 0
    return {
        "held_out_psnr": round(float(np.mean(held_out.psnr)), 3) if some else None,
        "held_out_ssim": round(float(np.mean(held_out.ssim)), 4) if some else None,
    }


def _print_quality(held_out: Quality, console: Console) -> None:
    """Prints mean PSNR and SSIM if there are held-out frames."""
    count = len(held_out.frames)
    if count:
        psnr, ssim = float(np.mean(held_out.psnr)), float(np.mean(held_out.ssim))
        console.print_line(f"held-out PSNR {psnr:.2f} dB, SSIM {ssim:.3f} over {count} frames")


def _run_metrics(run: Run) -> dict[str, Any]:
    """Returns the figures of a run for metrics.json."""
    return {
        "gaussians": run.field.gaussians.count,
        "regions": run.field.regions.count,
        "frames": len(run.capture.names),
        "size": [run.capture.cameras.width, run.capture.cameras.height],
        **_quality_metrics(run.held_out),
        "seconds": {name: round(value, 2) for name, value in run.seconds.items()},
        "skipped": run.skipped,
        "notes": list(run.notes),
        "programs_compiled": run.programs,
        "peak_memory_mib": round(peak_memory_mib(), 1),
    }


def _figures(metrics: dict[str, Any]) -> str:
    """Returns the table of the headline figures."""
    psnr = metrics["held_out_psnr"]
    figures = {
        "Gaussians": f"{metrics['gaussians']:,}",
        "regions": str(metrics["regions"]),
        "held-out PSNR": "no held-out frames" if psnr is None else f"{psnr:.2f} dB",
        "total": f"{sum(metrics['seconds'].values()):.0f} s",
        "peak memory": f"{metrics['peak_memory_mib']:,.0f} MiB",
    }
    return report.table(tuple(figures), [tuple(figures.values())])


def _scene_parts(run: Run) -> list[str]:
    """Returns the parts that show frames, masks, regions and the rendered scene."""
    train = vision_frames(run.capture, run.options)
    renderer = pictures.Renderer(run.field.gaussians, run.field.cameras)
    colours = pictures.region_colours(run.field)
    cells = []
    for row in evenly_spaced(len(train), 6):
        t = int(train[row])
        frame = np.asarray(run.capture.frames[t])
        cells += [
            report.figure(frame, run.capture.names[t]),
            report.figure(pictures.label_overlay(frame, run.labels[row]), "masks", sharp=True),
            report.figure(renderer.colours(t, colours), "regions"),
            report.figure(renderer.photo(t), "rendered"),
        ]
    words = (
        "A region has one colour in all views, and so has each Gaussian by its strongest region; a grey one has none."
    )
    parts = [report.section("Frames, masks, regions", words, report.grid(cells, 4))]
    if len(run.held_out.frames):
        held_out = np.flatnonzero(run.capture.held_out)
        psnr = dict(zip(held_out.tolist(), run.held_out.psnr.tolist()))
        cells = []
        for t in held_out[evenly_spaced(len(held_out), 4)].tolist():
            cells.append(report.figure(np.asarray(run.capture.frames[t]), run.capture.names[t]))
            cells.append(report.figure(renderer.photo(t), "rendered", strong=f"{psnr[t]:.2f} dB"))
        words = "Photographs that no step has seen, and their renderings."
        parts.append(report.section("Held-out frames", words, report.grid(cells, 4)))
    return parts


def _work_parts(run: Run) -> list[str]:
    """Returns the parts that show seconds, stages, notes and settings."""
    seconds = [(name, round(value, 1)) for name, value in run.seconds.items()]
    stages = report.table(["step", "", "how, or why not"], [(step.name, step.status, step.why) for step in run.steps])
    notes = report.table(["notes"], [[note] for note in run.notes]) if run.notes else ""
    options = [(f.name, getattr(run.options, f.name), f.default) for f in dataclasses.fields(run.options)]
    changed = report.table(
        ["changed", "value"], [(name, str(value)) for name, value, default in options if value != default]
    )
    provenance = html.escape(json.dumps(json.loads(run.field.provenance), indent=2))
    folded = f"<details><summary>provenance of the field</summary><pre>{provenance}</pre></details>"
    measured = "Wall time of each stage, also of those that an earlier run computed."
    return [
        report.section("Seconds of each stage", measured, report.table(["stage", "s"], seconds)),
        report.section("Stages", "What ran, and what this scene does not need.", stages, notes),
        report.section("Settings", "", changed, folded),
    ]
