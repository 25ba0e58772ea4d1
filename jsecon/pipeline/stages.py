"""What a stage of a run is: its name, what its result depends on, what it leaves out and why, and its function.

The stages themselves stand in `scene_stages` (load, gaussians, held_out), `masklet_stages` and `language_stages`
(regions, codes, votes, distil), each made whole by one function of the run's `RunContext`.
"""

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from jsecon.errors import InputError
from jsecon.pipeline import cache
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Progress
from jsecon.types import Capture
from jsecon.vision.protocols import Networks

CHECKPOINT_SECONDS = 20.0
"""between two records of a stage in progress: a stop loses at most this and one chunk of steps, or one tracked frame"""

WARNING = "WARNING: "
"""begins a note on what makes answers wrong"""

KEY_FILE = "made_by.txt"
"""in a folder that a stage leaves beside its result: the name and key of that stage"""


@dataclasses.dataclass(frozen=True)
class StageResult:
    """What a stage made."""

    value: Any
    """the result, a tree of arrays and records."""
    skipped: dict[str, str] = dataclasses.field(default_factory=dict)
    """part that was not needed -> why."""
    notes: tuple[str, ...] = ()
    """what the user should know, a sentence each."""


@dataclasses.dataclass(frozen=True)
class RunContext:
    """What the stages of one run share."""

    options: Options
    networks: Networks
    out: Path
    """the run's output folder, which does not count as input where it lies inside of an input folder."""
    load: Callable[[], Capture] | None = None
    """takes the loader's place for data whose layout is one of a kind."""

    def key_options(self, *names: str) -> dict[str, Any]:
        """The named options, as a part of a stage's key."""
        return {name: getattr(self.options, name) for name in names}


class Checkpoint:
    """How far a stage in progress has come, on disk, so that it goes on there after a stop."""

    def __init__(self, path: Path):
        self._path, self._last = path, time.monotonic()

    @property
    def folder(self) -> Path:
        """Where a stage that works on files may keep them: its name is the stage's and its key's."""
        return self._path.with_suffix("")

    def read(self) -> Any | None:
        """What was last kept, or None. A file that cannot be read loses time and nothing else: the stage starts again,
        to the same result."""
        with contextlib.suppress(cache.CorruptCacheError):
            return cache.load(self._path) if self._path.exists() else None
        return None

    def keep(self, state: Callable[[], Any]) -> None:
        """Keeps `state()`, at most every CHECKPOINT_SECONDS."""
        if time.monotonic() - self._last >= CHECKPOINT_SECONDS:
            cache.save(self._path, state())
            self._last = time.monotonic()

    def remove(self) -> None:
        """Called when the stage's result is kept."""
        self._path.unlink(missing_ok=True)
        shutil.rmtree(self.folder, ignore_errors=True)


Results: TypeAlias = Mapping[str, Any]
"""of the stages that are done, by name"""
Compute: TypeAlias = Callable[[Results, Progress, Checkpoint], StageResult]


@dataclasses.dataclass(frozen=True)
class Stage:
    """One stage of a run. Its key covers all that its result depends on: see `key`."""

    name: str
    how: str
    """what it will do, for the lines that a run prints first."""
    compute: Compute
    room: str
    """the last room of `cache.ROOMS` that `compute` imports; the source up to there is a part of the key."""
    after: tuple[str, ...] = ()
    """the stages whose results it reads."""
    key_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """options and models that its result depends on; models by their content, not by the place of their files."""
    files: Path | Callable[[], Sequence[Path]] | None = None
    """input file or folder, or what lists the input files."""
    skipped: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """what the options alone make needless: part -> why."""
    shared: bool = False
    """whether several processes compute it together: its function then makes the same calls in each."""
    output_dir: Path | None = None
    """folder that it leaves for those after it, with its key in KEY_FILE; where another run left it, it runs again."""

    def key(self, work: RunContext, keys: Mapping[str, str], files: str | None) -> str:
        """Hashes all that the result depends on.

        Args:
          work: The run.
          keys: Keys of the stages before this one.
          files: Digest of the input files, from `files_digest`.

        Returns:
          16 hex digits that cover source, options, input files and the results that the stage reads.
        """
        return cache.key_of(
            self.name,
            {
                "source": cache.source_digest(self.room),
                "after": [keys[other] for other in self.after],
                "given": dict(self.key_options),
                "files": files,
            },
        )

    def files_digest(self, work: RunContext) -> str | None:
        """Digest of the names, sizes and times of its files."""
        if self.files is None:
            return None
        paths = [self.files] if isinstance(self.files, Path) else self.files()
        return cache.files_digest(paths, exclude=work.out)

    def computed(self, work: RunContext, files: str | None, *given: Any) -> StageResult:
        """What it makes of its files. Raises InputError where they are no longer those of the digest `files`: its key
        would stand for a result of others, or of some of each."""
        found = self.compute(*given)
        if files != self.files_digest(work):
            remedy = "Give the same command again when nothing writes there; what is done is kept."
            told = f"files that changed while stage {self.name} read them"
            where = self.files if isinstance(self.files, Path) else work.options.capture
            raise InputError(where, told, "files that stay as they are during a run", remedy)
        return found


def training_frames(capture: Capture) -> np.ndarray:
    """Indices of the frames that may be fitted to. Raises InputError where there are fewer than two."""
    train = np.flatnonzero(~np.asarray(capture.held_out))
    require_training(len(train), len(capture.names))
    return train


def require_training(count: int, of: int) -> None:
    """Raises InputError where fewer than two frames may be fitted to."""
    if count < 2:
        found = f"{count} of {of} frames to work with"
        raise InputError("frames", found, "at least 2", "Hold out fewer frames (--holdout), or use more (--frames).")
