"""Protocols of segmenters, trackers and embedders, which OpenCV, SAM, SAM 2, CLIP or files implement.

Host code: NumPy in, NumPy out. Frames are uint8 RGB.
"""

import dataclasses
from collections.abc import Collection
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

CANONICAL = ("object", "things", "stuff", "texture")
"""LERF's canonical phrases, which a query must exceed."""


@runtime_checkable
class Segmenter(Protocol):
    """Proposes regions of one frame."""

    def __call__(self, frame: np.ndarray, index: int) -> np.ndarray:
        """Proposes masks.

        Args:
          frame: (H, W, 3) uint8 RGB.
          index: Index of the frame in the capture.

        Returns:
          (M, H, W) bool masks, best first; they may overlap.
        """
        ...


@runtime_checkable
class Tracker(Protocol):
    """Follows regions of one frame through all frames."""

    def __call__(self, frames: np.ndarray, index: int, prompts: np.ndarray) -> np.ndarray:
        """Tracks masks.

        Args:
          frames: (T, H, W, 3) uint8 RGB.
          index: Frame of the prompts.
          prompts: (B, H, W) bool masks.

        Returns:
          (T, H, W) int16 index of a prompt, or -1; the tracker resolves overlaps.
        """
        ...


class Network(Protocol):
    """A component that holds a network in memory."""

    name: str
    """Identifies content and settings."""

    def check(self) -> None:
        """Checks that it can work.

        Raises:
          InputError: It cannot.
        """
        ...

    def close(self) -> None:
        """Frees the memory of the network until it is needed again."""
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

    An embedder may also have `unrelated_words`, (W, E) float32 unit: embeddings of texts unrelated to any scene.
    Without it `REFERENCE_WORDS` are embedded (`reference_words.reference_of`). Texts in a tuple `vocabulary` are the
    names that a catalogue gives to objects by default, and `softmax_scale` scales their cosines before a softmax. A
    function `narrower(text) -> list[str]` lists texts that answer in place of one that no region matches.
    """

    name: str
    """Identifies the space, which a field and its texts must share."""
    dim: int
    """E"""
    canonical_phrases: np.ndarray
    """(C, E) float32 unit embeddings that a query must exceed, such as those of `CANONICAL`."""

    def embed_regions(self, frame: np.ndarray, masks: np.ndarray) -> np.ndarray:
        """Embeds masks of a frame.

        Args:
          frame: (H, W, 3) uint8 RGB.
          masks: (M, H, W) bool.

        Returns:
          (M, E) float32 unit embeddings, zero for an empty mask.
        """
        ...

    def embed_text(self, texts: list[str]) -> np.ndarray:
        """Embeds texts.

        Args:
          texts: Q texts.

        Returns:
          (Q, E) float32 unit embeddings.

        Raises:
          InputError: This space cannot represent a text.
        """
        ...


class Logits(NamedTuple):
    """Calibration of a cosine: P(text is true of image) = sigmoid(scale * cosine + bias)."""

    scale: float
    bias: float


@dataclasses.dataclass(frozen=True)
class Models:
    """Models of a run. A network is opened when first needed and closed when its stage is done."""

    embedder: Embedder
    segmenter: NamedSegmenter | None = None
    """None: by colour and texture."""
    tracker: NamedTracker | None = None
    """None: through the Gaussians."""

    def require_ready(self, stages: Collection[str]) -> None:
        """Checks the networks before the long work starts.

        Args:
          stages: Names of the stages that will run.

        Raises:
          InputError: A network cannot serve them.
        """
        for stage, used in (("objects", self.segmenter), ("objects", self.tracker), ("regions", self.embedder)):
            check = getattr(used, "check", None)
            if stage in stages and check is not None:
                check()

    def close(self) -> None:
        """Frees the memory of the networks until they are needed again."""
        for used in (self.embedder, self.segmenter, self.tracker):
            close = getattr(used, "close", None)
            if close is not None:
                close()
