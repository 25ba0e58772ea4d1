"""The table of stages: from a capture to what its language field is made of.

    stage      planned by             from
    poses      scene.plan_capture     photographs or a video without poses
    load       scene.plan_capture     the capture, or views of a scene without photographs
    gaussians  scene.plan_scene       load: fitted, or read from a file
    objects    objects.plan_objects   load, gaussians (--masks: load alone)
    regions    objects.plan_objects   load, objects
    parts      objects.plan_objects   load, objects, regions, but with a tracker
    votes      objects.plan_objects   load, gaussians, objects
    codes      objects.plan_objects   regions, votes, with --paper
    held_out   scene.plan_scene       load, gaussians, if there are photographs

Each plan states how the stage works, for what a run prints first; the stages that it reads (`after`); and the options,
models and files on which its result depends. The function that computes it stands beside the plan. `run` computes the
rows, or reads them from the cache. `jsecon fit` computes those of `scene.plan_scene`.

Here is what they share: their results, what a stage is, and how it resumes after a stop.
"""

import contextlib
import dataclasses
import hashlib
import json
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jsecon.errors import InputError
from jsecon.pipeline import cache
from jsecon.pipeline.options import Options
from jsecon.types import Array, Capture, Codes, Gaussians, Progress, Quality, Regions, Votes
from jsecon.vision.protocols import Models

CHECKPOINT_SECONDS = 20.0
"""s between two checkpoints of a stage; a stop loses at most this and one chunk of steps"""
WARNING = "WARNING: "
"""begins a note on what makes answers wrong"""


@dataclasses.dataclass(frozen=True)
class ObjectLabels:
    """Labels of objects in the training frames that vision uses."""

    labels: np.ndarray
    """(T, H, W) int16, -1 for no region."""
    frames: np.ndarray
    """(T,) which frames of the capture these are, ascending."""
    tree: np.ndarray | None = None
    """(M,) int32 parent of each node, as `LanguageField.tree` has it."""
    leaf: np.ndarray | None = None
    """(N,) int32 smallest node of each Gaussian, as `LanguageField.leaf` has it; None where votes decide it."""
    parts: np.ndarray | None = None
    """(L, T, H, W) int16 part 0 .. P-1 at each pixel, -1 for none; parts that lie in each other are on other layers."""
    part_nodes: np.ndarray | None = None
    """(P,) int32 node of each of these parts."""


class Results:
    """Results of the finished stages, by the names of the stages. Reading one that is missing raises AttributeError."""

    load: Capture
    """the capture, corrected if the options ask for that"""
    gaussians: Gaussians
    """N Gaussians, read or fitted"""
    objects: ObjectLabels
    """labels of the training frames that vision uses"""
    regions: Regions
    """R regions of the training frames"""
    parts: Regions | None = None
    """P parts of the regions; None where masks have no tree"""
    votes: tuple[Votes, tuple[np.ndarray, ...], np.ndarray | None]
    """weight of each region on each Gaussian; with a ledger the packed list of each view, of which it is the sum; and
    where masks that were given nest, the node of most weight on each Gaussian, without its parts (N,)"""
    codes: Codes | None = None
    """codes of the paper, if the options ask for them"""
    held_out: Quality = Quality(np.zeros(0, int), np.zeros(0), np.zeros(0))
    """PSNR and SSIM of the held-out frames; of no frame for a scene without photographs"""
    poses: str | None = None
    """name of the folder in OUT/cache with the capture of photographs that came without poses"""

    def __init__(self, **results: Any):
        vars(self).update(results)


@dataclasses.dataclass(frozen=True)
class StageResult:
    """Output of a stage."""

    value: Any
    """The result, a tree of arrays and records."""
    notes: tuple[str, ...] = ()
    """What the user should know, a sentence each."""


@dataclasses.dataclass(frozen=True)
class RunContext:
    """What the stages of one run share."""

    options: Options
    """Options of the run."""
    models: Models
    """Models of the run."""
    out: Path
    """Output folder. It does not count as input if it lies inside of an input folder."""

    def key_options(self, *names: str) -> dict[str, Any]:
        """Picks options for the key of a stage."""
        return {name: getattr(self.options, name) for name in names}


class Checkpoint:
    """State of a stage in progress, on disk beside the file of its result, so that it resumes there after a stop."""

    def __init__(self, result: Path):
        self._path = result.with_suffix(".checkpoint.safetensors")
        self._last = time.monotonic()

    @property
    def folder(self) -> Path:
        """Folder for a stage that works on files; its name is the stage's and its key's."""
        return self._path.with_suffix("")

    def read(self) -> Any | None:
        """Reads the last state."""
        with contextlib.suppress(InputError):
            return cache.load(self._path)[0] if self._path.exists() else None
        return None

    def keep(self, state: Any) -> None:
        """Writes the state, at most every CHECKPOINT_SECONDS."""
        if time.monotonic() - self._last >= CHECKPOINT_SECONDS:
            cache.save(self._path, state)
            self._last = time.monotonic()

    def remove(self) -> None:
        """Removes the state once the result of the stage is stored."""
        self._path.unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)


class StageInput(NamedTuple):
    """What a stage computes from."""

    context: RunContext
    results: Results
    progress: Progress
    checkpoint: Checkpoint


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage of a run, as it is planned."""

    name: str
    """Name of the stage, and of its result in `Results`."""
    task: str
    """What it will do, for the plan that a run prints first."""
    compute: Callable[[StageInput], StageResult]
    """Computes the result."""
    after: tuple[str, ...] = ()
    """Stages whose results it reads."""
    key_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Options and models that the result depends on; models by their content, not by the place of files."""
    files: tuple[Path | None, ...] = ()
    """Input files and folders; None for one that the options do not name."""
    distributed: bool = False
    """Whether several processes compute it together, each a part of the views."""

    def key(self, keys: Mapping[str, str], out: Path) -> str:
        """Hashes all that the result depends on; of the input files, but for those in `out`, names, sizes and times."""
        parts = {
            "source": cache.source_digest(),
            "after": [keys[other] for other in self.after],
            "options": dict(self.key_options),
            "files": cache.files_digest(filter(None, self.files), exclude=out),
        }
        text = json.dumps([self.name, parts], sort_keys=True)
        return hashlib.blake2b(text.encode(), digest_size=8).hexdigest()


def training_frames(held_out: Array) -> np.ndarray:
    """Lists the frames that may be fitted to."""
    train = np.flatnonzero(~np.asarray(held_out))
    if len(train) < 2:
        problem = f"{len(train)} of {len(held_out)} frames to work with"
        raise InputError("frames", problem, "at least 2", "Hold out fewer frames (--holdout), or use more (--frames).")
    return train
