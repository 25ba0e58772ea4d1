"""Texts put to SAM 3 as phrases in some frames of a field's capture, and lifted to Gaussians.

A frame without a mask of the phrase counts too: what it sees is outside. So an object that SAM 3 takes for the phrase
in one frame alone is not selected.
"""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from jsecon.app import verbs
from jsecon.app.ask import Answer, collect, drop_outliers
from jsecon.errors import InputError
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.networks.sam3 import IMAGE_SIDE, PhraseMasks, Sam3
from jsecon.pipeline.progress import Console
from jsecon.pipeline.sources import locate_sources
from jsecon.query.outline import lift
from jsecon.query.select import query_region
from jsecon.read.captures.capture import load_capture
from jsecon.read.captures.frames import evenly_spaced
from jsecon.types import LanguageField


def load_frames(
    field: LanguageField, folder: Path, count: int, capture: Path | None = None
) -> dict[int, UInt8[np.ndarray, "h w 3"]]:
    """Reads frames of a field again from its capture, evenly spaced, at the size that SAM 3 takes.

    Args:
      field: The field.
      folder: Its folder.
      count: Number of frames.
      capture: The capture that it was made from; None finds it: the poses that its run estimated, else the run's input.

    Returns:
      Index of a frame -> its image.

    Raises:
      InputError: It is missing, another capture, or cannot be read, or `count` is not positive.
    """
    if count < 1:
        raise InputError("--looks", str(count), "at least 1", "8 is the default.")
    if capture is None:
        capture = folder / "poses" if (folder / "poses").exists() else locate_sources(field, folder).capture
    if capture is None:
        problem = "the capture that the field was made from is missing"
        raise InputError("--phrases", problem, remedy="Give --images DIR.")
    indices = [int(t) for t in evenly_spaced(len(field.names), count)]
    names = [field.names[t] for t in indices]
    loaded = load_capture(capture, long_side=IMAGE_SIDE, holdout=None, only=names)
    height, width = loaded.frames.shape[1:3]
    field_width, field_height = field.cameras.width, field.cameras.height
    if abs(width * field_height - height * field_width) > max(field_width, field_height) + max(width, height):
        problem = f"frames of {width}x{height}"
        expected = f"{field_width}x{field_height}, or the same shape at another size"
        raise InputError(capture, problem, expected, "Give the capture that the field was made from.")
    return {t: np.asarray(loaded.frames[loaded.names.index(name)]) for t, name in zip(indices, names)}


def ask_phrases(field: LanguageField, verb: verbs.Query, console: Console) -> tuple[list[Answer], list[InputError]]:
    """Selects all objects that the texts of a query name, and prints in how many frames SAM 3 sees them.

    Args:
      field: The field.
      verb: The query; its `phrases` is the model's folder. Each frame is encoded once for all texts.
      console: Receives progress.

    Returns:
      The answers, and the errors of texts that the model cannot read.

    Raises:
      InputError: The model or the capture cannot be used.
    """
    assert verb.phrases is not None
    with console.progress("phrases") as progress:
        sam3 = Sam3(verb.phrases)
        frames = load_frames(field, verb.field.parent, verb.looks, verb.images)
        words, errors = collect([lambda text=text: (text, sam3.read(text)) for text in verb.texts])
        masks: dict[str, dict[int, PhraseMasks]] = {text: {} for text, _ in words}
        for n, (t, frame) in enumerate(frames.items() if words else ()):
            encoded = sam3.encode(frame)
            for text, tokens in words:
                masks[text][t] = sam3.masks(encoded, tokens)
            progress(n + 1, len(frames))
        sam3.close()
        threshold = SHARE_THRESHOLD if verb.threshold is None else verb.threshold
        options = {"threshold": threshold, "outliers": not verb.keep_outliers}
        answers = [lift_phrase(field, text, of_text, **options) for text, of_text in masks.items()]
    for answer in answers:
        seen = sum(map(bool, (answer.frames or {}).values()))
        console.say(f"{answer.query!r}: seen in {seen} of {len(frames)} frames")
    return answers, errors


def lift_phrase(
    field: LanguageField, phrase: str, masks: Mapping[int, PhraseMasks], *, threshold: float, outliers: bool
) -> Answer:
    """Selects the Gaussians that lie in the masks of a phrase in most of the frames that see them (`jsecon.lift`).

    Args:
      field: The field.
      phrase: The phrase.
      masks: Index of a frame -> the masks of the phrase in it, possibly without any.
      threshold: Share of a Gaussian that must lie inside.
      outliers: Whether to drop outliers.

    Returns:
      The answer.
    """
    size = field.cameras.width, field.cameras.height
    scores = {field.names[t]: [round(float(score), 4) for score in m.scores] for t, m in masks.items()}
    unions = [np.asarray(m.masks.any(0), np.float32) for m in masks.values()]
    stack = np.stack([cv2.resize(union, size, interpolation=cv2.INTER_AREA) >= 0.5 for union in unions])
    skipped = {"text encoder": "SAM 3 reads the phrase"}
    if not stack.any():
        selection = query_region(field, -1)
        return Answer(phrase, "phrase", selection, np.asarray(selection.mask), skipped, frames=scores)
    selection = lift(field, stack, list(masks), threshold=threshold)
    answer = Answer(phrase, "phrase", selection, np.asarray(selection.mask), skipped, frames=scores)
    return drop_outliers(field, answer, outliers, keep="all")
