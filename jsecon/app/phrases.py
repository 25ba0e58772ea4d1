"""Texts put to SAM 3 as phrases in some frames of a field's capture, and lifted to Gaussians.

A frame without a mask of the phrase counts too: what it sees is outside. So an object that SAM 3 takes for the phrase
in one frame alone is not selected.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from jsecon.app.ask import Answer, drop_outliers
from jsecon.data.frames import Progress, evenly_spaced
from jsecon.errors import InputError
from jsecon.language.membership import SHARE_THRESHOLD
from jsecon.networks.sam3 import IMAGE_SIDE, PhraseMasks, Sam3
from jsecon.pipeline.sources import locate_sources
from jsecon.query.outline import lift
from jsecon.query.select import query_region
from jsecon.types import LanguageField

Frames = Mapping[int, np.ndarray]
"""index of a field's frame -> (H, W, 3) uint8 RGB, at any size of the frame's shape"""


def load_frames(field: LanguageField, capture: Path, count: int) -> dict[int, np.ndarray]:
    """Reads frames of a field again from its capture, evenly spaced, at the size that SAM 3 takes.

    Args:
      field: The field.
      capture: The capture that it was made from.
      count: Number of frames.

    Returns:
      Index of a frame -> its image.

    Raises:
      InputError: It is another capture, or cannot be read, or `count` is not positive.
    """
    from jsecon.data.capture import load_capture

    if count < 1:
        raise InputError("--looks", str(count), "at least 1", "8 is the default.")
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


def find_capture(field: LanguageField, folder: Path) -> Path:
    """Finds the capture that a field was made from: the poses that its run estimated, else the run's input.

    Args:
      field: The field.
      folder: Its folder.

    Returns:
      Path of the capture.

    Raises:
      InputError: Neither exists.
    """
    poses = folder / "poses"
    if poses.exists():
        return poses
    capture = locate_sources(field, folder).capture
    if capture is None:
        problem = "the capture that the field was made from is missing"
        raise InputError("--phrases", problem, remedy="Give --images DIR.")
    return capture


def ask_phrases(
    field: LanguageField,
    sam3: Sam3,
    phrases: Sequence[str],
    frames: Frames,
    *,
    threshold: float | None = None,
    outliers: bool = True,
    progress: Progress = None,
) -> tuple[list[Answer], list[InputError]]:
    """Selects all objects that phrases name. Each frame is encoded once for all phrases.

    Args:
      field: The field.
      sam3: The model. It is closed afterwards.
      phrases: The phrases.
      frames: Frames to search.
      threshold: Share of a Gaussian that must lie inside the masks; None is 0.5.
      outliers: Whether to drop outliers.
      progress: Called with the number of finished frames, and of all.

    Returns:
      The answers, and the errors of phrases that the model cannot read.

    Raises:
      InputError: The model cannot be used.
    """
    tokens = {}
    errors = []
    for phrase in phrases:
        try:
            tokens[phrase] = sam3.read(phrase)
        except InputError as error:
            errors.append(error)
    masks: dict[str, dict[int, PhraseMasks]] = {phrase: {} for phrase in tokens}
    for n, (t, frame) in enumerate(frames.items() if tokens else ()):
        encoded = sam3.encode(frame)
        for phrase, words in tokens.items():
            masks[phrase][t] = sam3.masks(encoded, words)
        if progress is not None:
            progress(n + 1, len(frames))
    sam3.close()
    threshold = SHARE_THRESHOLD if threshold is None else threshold
    answers = [lift_phrase(field, phrase, m, threshold=threshold, outliers=outliers) for phrase, m in masks.items()]
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
