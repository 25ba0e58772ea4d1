"""A scene of a benchmark as every dataset's loader returns it, whatever its files look like.

LERF and 3D-OVS have their truth in pixels (`frames`), Replica in points (`point_classes`).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.errors import InputError
from jsecon.read.masks.labels import LabelledFrame
from jsecon.types import Array, Capture

TWIN_FILE = "twin.json"
"""at the root of a made-up dataset: what its generator put there, and that it is none of the real scenes"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Benchmark:
    """One scene with what is asked of it and what is true."""

    capture: Capture
    """its held-out frames are those that nothing may be fitted to."""
    frames: tuple[LabelledFrame, ...]
    """truth in pixels; empty where it is in points."""
    points: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 3), np.float32))
    """(P, 3) float32 labelled points, world, in the files' order; P = 0 where the truth is in pixels."""
    point_colors: Array = dataclasses.field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    """(P, 3) uint8."""
    point_classes: Array = dataclasses.field(default_factory=lambda: np.zeros(0, np.int32))
    """(P,) int32 index into `queries`; -1 = none of them, not evaluated."""
    name: str
    """of the scene."""
    dataset: str
    """lerf, ovs3d or replica."""
    queries: tuple[str, ...]
    """the texts."""
    pairs: int
    """the protocol's denominator: (frame, query) pairs, or classes that occur, that the dataset defines."""
    twin: bool
    """a made-up scene in this dataset's layout."""


def twin_of(root: str | Path, scene: str) -> dict[str, Any] | None:
    """What the generator of a twin wrote of `scene`, or None for a real dataset. Raises InputError where the file is
    damaged or has no such scene."""
    file = Path(root) / TWIN_FILE
    if not file.is_file():
        return None
    try:
        told = json.loads(file.read_text(encoding="utf-8"))["scenes"]
        return told[scene]
    except (ValueError, KeyError, TypeError) as error:
        remedy = "Make the twin again, or remove the file if these are real data."
        raise InputError(file, f"nothing readable about {scene!r} ({error})", remedy=remedy) from error


def hold_out(capture: Capture, frames: Sequence[LabelledFrame], where: Path) -> Capture:
    """The capture with exactly the labelled frames held out. Raises InputError for a label of a frame that the capture
    does not have: by name, never by position."""
    index = {name: t for t, name in enumerate(capture.names)}
    for frame in frames:
        if frame.name not in index:
            problem = f"labels of {frame.name}, which is not among the {len(index)} frames of the capture"
            raise InputError(where, problem, remedy="Keep images, poses and labels of one scene together.")
    out = np.zeros(len(capture.names), bool)
    out[[index[frame.name] for frame in frames]] = True
    return dataclasses.replace(capture, held_out=out)


def require_count(where: Path, found: int, expected: int, what: str) -> None:
    """Raises InputError where a dataset does not hold what its protocol counts: a smaller denominator measures
    something else."""
    if found != expected:
        problem = f"has {found} {what}, where the protocol counts {expected}"
        raise InputError(where, problem, remedy="Use the dataset's own label files, all of them.")
