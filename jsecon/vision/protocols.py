"""What looks at pixels, behind three small protocols, so that OpenCV, SAM, SAM 2, CLIP or files from disk can take each
place.

Everything here lives on the host: NumPy in, NumPy out. Frames are uint8 RGB.
"""

import dataclasses
from collections.abc import Collection
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

CANONICAL = ("object", "things", "stuff", "texture")
"""LERF's canonical phrases: what a query must beat"""


@runtime_checkable
class Segmenter(Protocol):
    """Proposes regions of one frame."""

    def __call__(self, frame: np.ndarray, index: int) -> np.ndarray:
        """frame (H, W, 3) uint8 RGB, its index in the capture -> masks (M, H, W) bool, best first; they may overlap."""
        ...


@runtime_checkable
class Tracker(Protocol):
    """Follows regions of one frame through all frames."""

    def __call__(self, frames: np.ndarray, index: int, prompts: np.ndarray) -> np.ndarray:
        """frames (T, H, W, 3) uint8, frame `index`, its masks `prompts` (B, H, W) bool -> labels (T, H, W) int16.

        A label is the index of a prompt, or -1 for none: prompts that overlap are resolved by the tracker.
        """
        ...


class Network(Protocol):
    """What holds a network in memory."""

    name: str
    """of its content and settings"""

    def check(self) -> None:
        """Raises InputError where it cannot work."""
        ...

    def close(self) -> None:
        """Drops what it holds in memory, until it is needed again."""
        ...


@runtime_checkable
class NamedSegmenter(Segmenter, Network, Protocol):
    """A segmenter that holds a network."""


@runtime_checkable
class NamedTracker(Tracker, Network, Protocol):
    """A tracker that holds a network."""


@runtime_checkable
class Embedder(Protocol):
    """A joint space of images and texts; every vector has unit length, so that a cosine is a similarity.

    An embedder may also have `reference`, (W, E) float32 unit: texts that have nothing to do with a scene. Without it
    `REFERENCE_WORDS` are embedded (`reference_words.reference_of`).
    """

    name: str
    """identifies the space: fields and texts must come from the same"""
    dim: int
    """E"""
    canonical: np.ndarray
    """(C, E) float32 unit: what a query must beat, such as `CANONICAL`"""

    def embed_regions(self, frame: np.ndarray, masks: np.ndarray) -> np.ndarray:
        """frame (H, W, 3) uint8, masks (M, H, W) bool -> (M, E) float32 unit; zero for an empty mask."""
        ...

    def embed_text(self, texts: list[str]) -> np.ndarray:
        """Q texts -> (Q, E) float32 unit. Raises InputError on a text that this space has no words for."""
        ...


class Logits(NamedTuple):
    """What makes a probability of a cosine: P(a text is true of an image) = sigmoid(scale * cosine + bias)."""

    scale: float
    bias: float


@dataclasses.dataclass(frozen=True)
class Networks:
    """What looks at a run's frames. Networks are opened when first needed, and closed when their stage is done."""

    embedder: Embedder
    segmenter: NamedSegmenter | None = None
    """None: what needs no weights."""
    tracker: NamedTracker | None = None
    """None: through the Gaussians."""

    def require_ready(self, stages: Collection[str]) -> None:
        """Raises InputError where a network cannot do what `stages` want of it: before the long work starts."""
        for stage, used in (("masklets", self.segmenter), ("masklets", self.tracker), ("regions", self.embedder)):
            check = getattr(used, "check", None)
            if stage in stages and check is not None:
                check()

    def close(self) -> None:
        """Drops what they hold in memory, until it is needed again."""
        for used in (self.embedder, self.segmenter, self.tracker):
            drop = getattr(used, "close", None)
            if drop is not None:
                drop()
