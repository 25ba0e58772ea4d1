"""What is written at the end of a verb: metrics.json, and a page of pictures to look at."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.app import pictures, report
from jsecon.data.gaussians.files import save_gaussians
from jsecon.files import write_text
from jsecon.pipeline.progress import Listener
from jsecon.pipeline.results import WARNING
from jsecon.pipeline.run import Run
from jsecon.process import peak_memory_mib
from jsecon.types import Capture, Gaussians, Quality

FRAMES_SHOWN, FOLLOWED, LARGE = 6, 10, 0.15
"""rows of frames; masklets followed, the largest of those that fill less than a part of a frame; frames of each"""


def write_run(run: Run, out: Path, listener: Listener) -> dict[str, Any]:
    """OUT/metrics.json and OUT/report.html of a run without ground truth; says the figures. Returns the metrics."""
    metrics = run_metrics(run)
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    with listener.progress("report"):
        told = [note.removeprefix(WARNING) for note in run.notes if note.startswith(WARNING)]
        warnings = [report.section("Warning", note) for note in told]
        parts = [*warnings, report.tiles(_tiles(metrics)), *scene_parts(run), *work_parts(run)]
        title = f"Language field of {run.options.capture.resolve().name}"
        write_text(out / "report.html", report.page(title, "Made by jsecon from posed frames.", parts))
    print_quality(run.held_out, listener)
    for note in told:
        listener.say(f"{WARNING}{note}")
    listener.say(
        f"{metrics['gaussians']} Gaussians, {metrics['regions']} regions, codes of {metrics['code_size']} numbers, "
        f"{sum(run.seconds.values()):.0f} s, peak memory {metrics['peak_memory_mib']:.0f} MiB, "
        f"{run.programs['all']} programs compiled ({run.programs['from_disk']} of them read from disk)"
    )
    file = out / "field.safetensors"
    listener.say(
        f"field   {file}\nreport  {out / 'report.html'}\nask it  jsecon query {file} "
        f'"dark green bottle" --out {out / "answers"}'
    )
    return metrics


def write_scene(
    gaussians: Gaussians, capture: Capture, held_out: Quality, out: Path, listener: Listener
) -> dict[str, Any]:
    """The file of a fitted scene, in the world of the capture's files; says the figures, and returns them."""
    save_gaussians(out, gaussians, similarity=capture.to_source)
    print_quality(held_out, listener)
    listener.say(f"{gaussians.count} Gaussians  {out}")
    return {"written": {"scene": out}, "gaussians": gaussians.count} | quality_metrics(held_out)


def quality_metrics(held_out: Quality) -> dict[str, float | None]:
    """Mean PSNR (dB) and SSIM of the frames held out; None where there are none."""
    some, (psnr, ssim) = len(held_out.frames), (held_out.psnr, held_out.ssim)
    return {
        "held_out_psnr": round(float(np.mean(psnr)), 3) if some else None,
        "held_out_ssim": round(float(np.mean(ssim)), 4) if some else None,
    }


def print_quality(held_out: Quality, listener: Listener) -> None:
    """How well the scene shows the frames held out; nothing where there are none."""
    count = len(held_out.frames)
    if count:
        psnr, ssim = float(np.mean(held_out.psnr)), float(np.mean(held_out.ssim))
        listener.say(f"held-out PSNR {psnr:.2f} dB, SSIM {ssim:.3f} over {count} frames")


def run_metrics(run: Run) -> dict[str, Any]:
    """The figures of a run, for metrics.json."""
    return {
        "gaussians": run.field.gaussians.count,
        "regions": run.field.regions.count,
        "code_size": int(run.field.region_codes.shape[1]),
        "frames": len(run.capture.names),
        "size": [run.capture.cameras.width, run.capture.cameras.height],
        **quality_metrics(run.held_out),
        "seconds": {name: round(value, 2) for name, value in run.seconds.items()},
        "left_out": run.skipped,
        "notes": list(run.notes),
        "programs_compiled": run.programs,
        "peak_memory_mib": round(peak_memory_mib(), 1),
    }


def _tiles(metrics: dict[str, Any]) -> dict[str, str]:
    psnr = metrics["held_out_psnr"]
    return {
        "Gaussians": f"{metrics['gaussians']:,}",
        "regions": str(metrics["regions"]),
        "numbers a code": str(metrics["code_size"]),
        "held-out PSNR": "none held out" if psnr is None else f"{psnr:.2f} dB",
        "in all": f"{sum(metrics['seconds'].values()):.0f} s",
        "peak memory": f"{metrics['peak_memory_mib']:,.0f} MiB",
    }


def scene_parts(run: Run) -> list[str]:
    """Frames, masklets, codes and the rendered scene, row by row."""
    train = np.flatnonzero(~np.asarray(run.capture.held_out))
    shown = train[np.unique(np.linspace(0, len(train) - 1, FRAMES_SHOWN).round().astype(int))]
    renderer, colours = pictures.Renderer(run.field.gaussians, run.field.cameras), pictures.code_colours(run.field)
    place = {int(t): n for n, t in enumerate(train)}
    cells = []
    for t in (int(t) for t in shown):
        frame = np.asarray(run.capture.frames[t])
        cells += [
            report.figure(frame, run.capture.names[t]),
            report.figure(pictures.label_overlay(frame, run.labels[place[t]]), "masklets", sharp=True),
            report.figure(renderer.colours(t, colours), "codes"),
            report.figure(renderer.photo(t), "the Gaussians' own colours"),
        ]
    words = "One colour is one region in every view. Codes are shown by their first three principal components, as the "
    words += "Gaussians render them; grey is unknown."
    parts = [report.section("Frames, masklets, codes", words, report.grid(cells, 4)), _followed(run, train)]
    if len(run.psnr):
        out = np.flatnonzero(run.capture.held_out)
        order = out[np.unique(np.linspace(0, len(out) - 1, 4).round().astype(int))]
        values, cells = dict(zip(out.tolist(), run.psnr.tolist())), []
        for t in order.tolist():
            cells.append(report.figure(np.asarray(run.capture.frames[t]), run.capture.names[t]))
            cells.append(report.figure(renderer.photo(t), "rendered", strong=f"{values[t]:.2f} dB"))
        words = "Never seen by any step; photograph and rendering."
        parts.append(report.section("Held-out frames", words, report.grid(cells, 4)))
    return parts


def _followed(run: Run, train: np.ndarray) -> str:
    """Masklets through the frames, a row each."""
    views = np.unique(np.linspace(0, len(train) - 1, FOLLOWED).round().astype(int))
    frames, labels = np.asarray(run.capture.frames)[train[views]], run.labels[views]
    sizes = np.stack([np.bincount(own[own >= 0], minlength=run.field.regions.count) for own in labels])
    small = np.flatnonzero(sizes.max(0) < LARGE * labels[0].size)
    largest = small[np.argsort(-sizes.sum(0)[small], kind="stable")][:FOLLOWED]
    rows = []
    for region in largest[sizes.sum(0)[largest] > 0].tolist():
        seen = int((np.asarray(run.field.regions.pixels)[region] > 0).sum())
        strip = pictures.followed(frames, labels, region)
        rows.append(report.wide(strip, f"in {seen} of {len(run.labels)} frames", strong=f"region {region}"))
    words = "The same region, cut out of frames that follow each other around the scene; dark where it is not seen."
    return report.section("Masklets through the frames", words, *rows)


def work_parts(run: Run) -> list[str]:
    """Seconds, stages, notes and where it all came from."""
    notes = report.table(["notes"], [[note] for note in run.notes], numbers_from=9) if run.notes else ""
    given = [(f.name, getattr(run.options, f.name), f.default) for f in dataclasses.fields(run.options)]
    tables = [
        report.table([head, "value"], [row[:2] for row in given if (row[1] == row[2]) == usual], numbers_from=9)
        for head, usual in (("changed", False), ("setting", True))
    ]
    kept = report.preformatted(json.dumps(json.loads(run.field.provenance), indent=2))
    folded = (
        report.folded("the others, as they are by default", tables[1]),
        report.folded("as the field keeps it", kept),
    )
    measured = "Wall time, also of what happened in an earlier run; and the programs that jax built for it now, in "
    measured += "brackets those that it read from disk."
    counts = run.compilations
    built = {name: f"{count['all']} ({count['from_disk']})" if count["all"] else "" for name, count in counts.items()}
    ran = "What ran, and what was left out because this scene does not need it."
    return [
        report.section("Seconds of each stage", measured, report.bars(run.seconds, built)),
        report.section("Stages", ran, report.steps(run.steps), notes),
        report.section("Settings", "", tables[0], *folded),
    ]
