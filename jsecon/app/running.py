"""`jsecon run` and `jsecon fit`, and what a run writes at its end: metrics.json, and report.html with pictures."""

import contextlib
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jsecon.app import pictures, report, verbs
from jsecon.files import write_text
from jsecon.pipeline import processes, run as pipeline
from jsecon.pipeline.options import is_bare_scene
from jsecon.pipeline.progress import Console
from jsecon.pipeline.run import Run
from jsecon.pipeline.stages import WARNING
from jsecon.process import peak_memory_mib
from jsecon.read.captures.frames import evenly_spaced
from jsecon.read.captures.images import write_image
from jsecon.read.splats.files import require_writable_format, save_gaussians
from jsecon.types import Capture, Gaussians, Quality

FILES = ("field.safetensors", "report.html", "metrics.json")
"""files of a run"""
FIRST_VIEW = "first_view.png"
"""file of a run of photographs: the picture that is there as soon as there is a scene"""


def _run(verb: verbs.Run, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon run`; the result has the metrics, or the plan of a dry run."""
    options = verb.options
    if verb.dry_run:
        return pipeline.dry_run(options, verb.out, console=console)
    show = None if is_bare_scene(options.capture) else partial(show_scene, verb.out, console)
    with processes.connection(options) if verb.distributed else contextlib.nullcontext(0) as index:
        if index == 0:
            run = pipeline.run(options, verb.out, console=console, on_scene=show)
        else:
            pipeline.run_worker(options, verb.out)
    if index > 0:
        raise SystemExit(0)
    title = f"Language field of {options.capture.resolve().name}"
    metrics = write_run(run, verb.out, console, title, "Made by jsecon from posed frames.")
    query = f'jsecon query {verb.out / "field.safetensors"} "dark green bottle" --out {verb.out / "answers"}'
    console.print_line(f"next    {query}")
    names = FILES if show is None else (*FILES, FIRST_VIEW)
    return {"written": [verb.out / name for name in names]} | metrics


def _fit(verb: verbs.Fit, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon fit`: writes the scene in the world of the capture's files, and prints its figures."""
    require_writable_format(verb.out)
    folder = verb.out.with_suffix("")
    if verb.dry_run:
        return pipeline.dry_run(verb.options, folder, scene_only=True, console=console)
    gaussians, capture, held_out = pipeline.fit(verb.options, folder, console=console)
    save_gaussians(verb.out, gaussians, similarity=capture.source_from_scene)
    quality = _quality(held_out, console)
    console.print_line(f"{gaussians.count} Gaussians  {verb.out}")
    return {"written": {"scene": verb.out}, "gaussians": gaussians.count} | quality


def show_scene(out: Path, console: Console, capture: Capture, gaussians: Gaussians) -> None:
    """Writes OUT/first_view.png, a photograph beside the scene from the same place, held out from the fit if any is."""
    t = int(np.argmax(np.asarray(capture.held_out)))
    rendered = pictures.render_picture(gaussians, jax.tree.map(np.asarray, capture.cameras)[t])
    write_image(out / FIRST_VIEW, np.concatenate([np.asarray(capture.frames[t]), rendered], axis=1))
    console.print_line(f"first view, photograph and scene: {out / FIRST_VIEW}")


def write_run(
    run: Run, out: Path, console: Console, title: str, lead: str, parts: Sequence[str] = (), **figures: Any
) -> dict[str, Any]:
    """Writes OUT/metrics.json and OUT/report.html of a run, prints its figures, and returns the metrics.

    `parts` are sections that come first in the report (`jsecon.app.report`), and `figures` more metrics.
    """
    metrics = {
        "gaussians": run.field.gaussians.count,
        "regions": run.field.regions.count,
        "frames": len(run.capture.names),
        "size": [run.capture.cameras.width, run.capture.cameras.height],
        **_quality(run.held_out, console),
        "seconds": {name: round(value, 2) for name, value in run.seconds.items()},
        "skipped": {step.name: step.why for step in run.steps if step.status == "skipped"},
        "notes": list(run.notes),
        "peak_memory_mib": round(peak_memory_mib(), 1),
        **figures,
    }
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    summary = (
        f"{metrics['gaussians']} Gaussians, {metrics['regions']} regions, "
        f"{sum(run.seconds.values()):.0f} s, peak memory {metrics['peak_memory_mib']:.0f} MiB"
    )
    warnings = [note for note in run.notes if note.startswith(WARNING)]
    with console.progress("report"):
        result = report.section("Result", ". ".join([summary, *run.notes]))
        write_text(out / "report.html", report.page(title, lead, [result, *parts, _pictures(run)]))
    console.print_line("\n".join([*warnings, summary]))
    console.print_line(f"field   {out / 'field.safetensors'}\nreport  {out / 'report.html'}")
    return metrics


def _quality(held_out: Quality, console: Console) -> dict[str, float | None]:
    """Prints and returns mean PSNR (dB) and SSIM of the held-out frames, None if there are no such frames."""
    count = len(held_out.frames)
    if not count:
        return {"held_out_psnr": None, "held_out_ssim": None}
    psnr, ssim = float(np.mean(held_out.psnr)), float(np.mean(held_out.ssim))
    console.print_line(f"held-out PSNR {psnr:.2f} dB, SSIM {ssim:.3f} over {count} frames")
    return {"held_out_psnr": round(psnr, 3), "held_out_ssim": round(ssim, 4)}


def _pictures(run: Run) -> str:
    """Returns the part that shows frames, masks, regions and the rendered scene."""
    gaussians, cameras = jax.device_put(run.field.gaussians), jax.tree.map(np.asarray, run.field.cameras)
    colours = pictures.region_colours(run.field)
    cells = []
    for row in evenly_spaced(len(run.labels), 6):
        t = int(run.vision_frames[row])
        frame = np.asarray(run.capture.frames[t])
        cells += [
            report.figure(frame, run.capture.names[t]),
            report.figure(pictures.label_overlay(frame, run.labels[row]), "masks", sharp=True),
            report.figure(pictures.render_picture(gaussians, cameras[t], colours), "regions"),
            report.figure(pictures.render_picture(gaussians, cameras[t]), "rendered"),
        ]
    words = "A region has one colour in all views, and so has each Gaussian by its strongest region; grey has none."
    return report.section("Frames, masks, regions", words, report.grid(cells, 4))
