"""Pixels that a run leaves out by name, such as people and screens, as its models find them. Host code."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from jsecon.errors import InputError
from jsecon.query.match import compare_words, rank_among_words, region_similarities
from jsecon.query.rules import RULES
from jsecon.read.captures.images import write_image
from jsecon.types import Capture, Progress
from jsecon.vision.protocols import Models
from jsecon.vision.unrelated_words import embed_unrelated_words


def ignore_named(capture: Capture, texts: list[str], models: Models, folder: Path, progress: Progress) -> Capture:
    """Ignores the pixels of masks that show what one of the texts names.

    Writes FOLDER/<frame>.png as nerfstudio and LichtFeld Studio read masks: black where a photograph's pixels are
    ignored, in its size.
    """
    embedder = models.embedder
    named, words = np.asarray(embedder.embed_text(texts)), embed_unrelated_words(embedder)
    ignored = np.zeros(capture.frames.shape[:3], bool) if capture.ignored is None else np.array(capture.ignored)
    found = 0
    for t, (name, file) in enumerate(zip(capture.names, capture.files)):
        frame = np.asarray(capture.frames[t])
        masks = models.segmenter(frame, t)
        pixels = masks[_is_named(embedder.embed_regions(frame, masks), named, words)].any(axis=0)
        found += bool(pixels.any())
        ignored[t] |= pixels
        kept = np.where(pixels, 0, 255).astype(np.uint8)
        kept = cv2.resize(kept, (file.width, file.height), interpolation=cv2.INTER_NEAREST)
        write_image(folder / f"{name}.png", kept)
        progress(t + 1, len(capture.names))
    note = f"{', '.join(texts)}: found and ignored in {found} of {len(ignored)} frames; the masks are in {folder}."
    return dataclasses.replace(capture, ignored=ignored, notes=(*capture.notes, note))


def _is_named(
    masks: Float[np.ndarray, "m e"], texts: Float[np.ndarray, "q e"], words: Float[np.ndarray, "w e"]
) -> Bool[np.ndarray, " m"]:
    """Tells which masks show what one of Q texts names: only synonyms among the unrelated words match better."""
    others = compare_words(masks, words, RULES.retrieval)
    if others is None or not others.apart.any():
        raise InputError("--ignore", "the embedder knows no unrelated words to compare with", remedy="Take another.")
    best = np.max([region_similarities(masks, text, words, RULES.retrieval)[0] for text in texts], axis=0)
    return (rank_among_words(best, others) >= 0.98) & (masks != 0).any(axis=1)
