"""A phrase put to SAM 3 in some frames of a field's capture: what most of them find of it, as Gaussians.

A frame in which nothing is found speaks too: what it sees is outside. So a thing that one frame alone takes for it is
not selected.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from jsecon.app.ask import Answer, answer_of
from jsecon.data.frames import Progress, evenly_spaced
from jsecon.errors import InputError
from jsecon.language.membership import SHARE_THRESHOLD
from jsecon.networks.sam3 import IMAGE_SIDE, PhraseMasks, Sam3
from jsecon.pipeline.sources import locate_sources
from jsecon.query.anchored import query_region
from jsecon.query.outline import lift
from jsecon.types import LanguageField

Frames = Mapping[int, np.ndarray]
"""index of a field's frame -> (H, W, 3) uint8 RGB, at any size of the frame's shape"""


def frames_of(field: LanguageField, capture: Path, count: int) -> dict[int, np.ndarray]:
    """`count` of the field's frames, evenly spaced, read again from the capture that it was made from: as large as SAM
    3 takes them, where their files are. Raises InputError where it is another capture, or cannot be read."""
    from jsecon.data.capture import load_capture

    if count < 1:
        raise InputError("--looks", str(count), "at least 1", "8 is the default.")
    chosen = [int(t) for t in evenly_spaced(len(field.names), count)]
    names = [field.names[t] for t in chosen]
    found = load_capture(capture, long_side=IMAGE_SIDE, holdout=None, only=names)
    (height, width), own = found.frames.shape[1:3], (field.cameras.width, field.cameras.height)
    if abs(width * own[1] - height * own[0]) > max(own) + max(width, height):
        told, wanted = f"frames of {width}x{height}", f"{own[0]}x{own[1]}, or the same shape at another size"
        raise InputError(capture, told, wanted, "Give the capture that the field was made from.")
    return {t: np.asarray(found.frames[found.names.index(name)]) for t, name in zip(chosen, names)}


def capture_of(field: LanguageField, beside: Path) -> Path:
    """The capture that a field in the folder `beside` was made from: the poses that its run found, else the folder that
    the run was given. Raises InputError where neither is there."""
    if (poses := beside / "poses").exists():
        return poses
    if (capture := locate_sources(field, beside).capture) is not None:
        return capture
    raise InputError("--phrases", "the capture that the field was made from is not found", remedy="Give --images DIR.")


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
    """An answer to each phrase, of all the things that it names, and why other phrases have none. Each frame is encoded
    once for all of them. Raises InputError where the model cannot be used."""
    read, refused = {}, []
    for phrase in phrases:
        try:
            read[phrase] = sam3.read(phrase)
        except InputError as error:
            refused.append(error)
    found: dict[str, dict[int, PhraseMasks]] = {phrase: {} for phrase in read}
    for n, (t, frame) in enumerate(frames.items() if read else ()):
        encoded = sam3.encode(frame)
        for phrase, words in read.items():
            found[phrase][t] = sam3.masks(encoded, words)
        if progress is not None:
            progress(n + 1, len(frames))
    sam3.close()
    how = {"threshold": SHARE_THRESHOLD if threshold is None else threshold, "outliers": outliers}
    return [lifted(field, phrase, masks, **how) for phrase, masks in found.items()], refused


def lifted(
    field: LanguageField, phrase: str, found: Mapping[int, PhraseMasks], *, threshold: float, outliers: bool
) -> Answer:
    """The Gaussians that lie in the masks of a phrase in most of the frames that see them (`jsecon.lift`)."""
    size, names = (field.cameras.width, field.cameras.height), field.names
    scores = {names[t]: [round(float(score), 4) for score in own.scores] for t, own in found.items()}
    masks = [np.asarray(own.masks.any(0), np.float32) for own in found.values()]
    stack = np.stack([cv2.resize(mask, size, interpolation=cv2.INTER_AREA) >= 0.5 for mask in masks])
    left = {"text encoder": "SAM 3 reads the phrase"}
    if not stack.any():
        none = np.zeros(field.gaussians.count, bool)
        return Answer(phrase, "phrase", query_region(field, -1), none, left, frames=scores)
    selection = lift(field, stack, list(found), threshold=threshold)
    answer = answer_of(field, phrase, "phrase", selection, outliers, left, keep="all")
    return dataclasses.replace(answer, frames=scores)
