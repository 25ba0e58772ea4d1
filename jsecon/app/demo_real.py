"""`jsecon demo --real DIR`: the demo's report of a capture of one's own, of which nobody knows what is true."""

import html
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jsecon.app import pictures, question, report, summary
from jsecon.app.answers import masks_of
from jsecon.app.demo import answers_to, demo, say_files, write_pictures, write_queries
from jsecon.app.verbs import Demo
from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.pipeline import networks, pipeline
from jsecon.pipeline.options import Options, require_writable
from jsecon.pipeline.progress import Listener
from jsecon.query.masks import selection_mask
from jsecon.types import LanguageField

REAL_FRAMES = 60
"""of the capture, at most: so that it takes minutes"""
TEXTS, LARGE = 6, 0.01
"""asked where none are given; least part of the Gaussians that such a text selects"""


def asked_demo(asked: Demo, listener: Listener) -> dict[str, Any]:
    """What the command line asks for: the room, or a capture of one's own."""
    how: dict[str, Any] = {"seed": asked.seed, "steps": asked.steps, "listener": listener}
    if asked.real is not None:
        return demo_real(asked.real, asked.out, texts=asked.texts or (), **how)
    if asked.texts:
        raise InputError("--texts", "no --real is given, the capture to ask them of", remedy="Give --real CAPTURE.")
    return demo(asked.out, **how)


def demo_real(
    capture: Path, out: Path, *, texts: Sequence[str] = (), seed: int = 0, steps: int, listener: Listener
) -> dict[str, Any]:
    """The field, answers and report of a capture of one's own, of REAL_FRAMES at most; returns the metrics. `texts`:
    what to ask (default: the colours that its regions answer best). Raises InputError for a text that the default
    vision has no words for, before any work."""
    require_writable(out)
    networks.embedder_named().embed_text(list(texts))
    run = pipeline.run(Options(capture, frames=REAL_FRAMES, steps=steps, seed=seed), out, listener=listener)
    field, embedder = run.field, networks.embedder_of_field(run.field)
    answers = answers_to(field, embedder, texts) if texts else colours_of(field, embedder)
    with listener.progress("report"):
        queries = write_queries(field, answers, out / "queries")
        cells, masks = [], dict[int, dict[str, np.ndarray]]()
        for text, answer in answers.items():
            told = queries[text]
            words = f"{told['count']} Gaussians, region {told['region']}, score {told['score']:.2f}"
            seen = masks_of(field, answer, views=1)
            for t, mask in seen.items():
                masks.setdefault(t, {})[text] = mask
                frame = np.asarray(run.capture.frames[t])
                overlay = pictures.selection_overlay(frame, mask)
                cells.append(report.pair(frame, overlay, f"{words}; {field.names[t]}", strong=text))
            if not seen:
                cells.append(f"<p>{html.escape(text)}: nothing here answers it (score {told['score']:.2f}).</p>")
        best = max(masks, key=lambda t: len(masks[t]), default=0)
        there = {text: _mask_in(field, answer, best) for text, answer in answers.items()}
        pictured = write_pictures(out, run, answers, best, there)
        words = "Pink: the selected Gaussians, rendered alone, over the photograph; move the line."
        parts = [pictured, report.section("Answers", words, report.grid(cells, 3))]
        parts += [*summary.scene_parts(run), *summary.work_parts(run)]
        lead = "Frames and poses in, answers to texts out, on a plain CPU and without any learned weights."
        write_text(out / "report.html", report.page(f"jsecon demo of {capture.resolve().name}", lead, parts))
    metrics = summary.run_metrics(run) | {"answers": queries}
    write_text(out / "metrics.json", json.dumps(metrics, indent=2) + "\n")
    summary.say_quality(run.held_out, listener)
    for text, told in queries.items():
        listener.say(f"  {text!r}: {told['count']} Gaussians, region {told['region']}, score {told['score']:.3f}")
    say_files(out, next(iter(answers), ""), listener)
    return metrics


def colours_of(field: LanguageField, embedder: Any) -> dict[str, question.Answer]:
    """The answers to the TEXTS colours that regions of the field answer best and that select LARGE parts of it, no two
    the same region, best first."""
    found = answers_to(field, embedder, list(embedder.names))
    best: dict[str, question.Answer] = {}
    for text in sorted(found, key=lambda text: -float(found[text].selection.score)):
        regions, own = {int(answer.selection.region) for answer in best.values()}, int(found[text].selection.region)
        if found[text].mask.mean() >= LARGE and own not in regions and len(best) < TEXTS:
            best[text] = found[text]
    return best


def _mask_in(field: LanguageField, answer: question.Answer, t: int) -> np.ndarray:
    camera = jax.tree.map(np.asarray, field.cameras)[t]
    return np.asarray(selection_mask(*jax.device_put((field.gaussians, camera, answer.mask))))
