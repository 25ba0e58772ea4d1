"""Protocols of segmenters, trackers and embedders, which OpenCV, SAM, SAM 2, CLIP or files implement.

Host code: NumPy in, NumPy out. Frames are uint8 RGB.
"""

import dataclasses
from collections.abc import Callable, Collection
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np

CANONICAL = ("object", "things", "stuff", "texture")
"""LERF's canonical phrases, which a query must exceed."""


Segmenter: TypeAlias = Callable[[np.ndarray, int], np.ndarray]
"""Proposes masks (M, H, W) bool, best first, which may overlap, of a frame (H, W, 3) and its index in the capture."""
Tracker: TypeAlias = Callable[[np.ndarray, int, np.ndarray], np.ndarray]
"""Follows masks through frames, from frames (T, H, W, 3), the index of one, and masks (B, H, W) bool there: returns
(T, H, W) int16, the index of a mask, or -1. The tracker resolves overlaps."""


@runtime_checkable
class Embedder(Protocol):
    """A joint space of images and texts; every vector has unit length, so that a cosine is a similarity.

    An embedder may also have `unrelated_words`, (W, E) float32 unit: embeddings of texts unrelated to any scene.
    Without it `UNRELATED_WORDS` are embedded (`embed_unrelated_words`). Texts in a tuple `vocabulary` are the names
    that a catalogue gives to objects by default, and `softmax_scale` scales their cosines before a softmax. A function
    `narrower(text) -> list[str]` lists texts that answer in place of one that no region matches.
    """

    name: str
    """Identifies the space, which a field and its texts must share."""
    dim: int
    """E"""
    canonical_phrases: np.ndarray
    """(C, E) float32 unit embeddings that a query must exceed, such as those of `CANONICAL`."""

    def embed_regions(self, frame: np.ndarray, masks: np.ndarray) -> np.ndarray:
        """Embeds the masks (M, H, W) bool of a frame (H, W, 3): unit rows (M, E) float32, zero for an empty mask."""
        ...

    def embed_text(self, texts: list[str]) -> np.ndarray:
        """Embeds Q texts: unit rows (Q, E) float32; raises InputError for one that the space cannot represent."""
        ...


@dataclasses.dataclass(frozen=True)
class Models:
    """Models of a run. A network is opened when first needed and closed when its stage is done.

    Segmenters and trackers that hold a network have a `name` of its content and settings, `check()`, which raises
    InputError if it cannot work, and `close()`, which frees its memory until it is needed again.
    """

    embedder: Embedder
    segmenter: Any = None
    """A `Segmenter` with a network; None: by colour and texture."""
    tracker: Any = None
    """A `Tracker` with a network; None: through the Gaussians."""

    def require_ready(self, stages: Collection[str]) -> None:
        """Checks the networks of stages before the long work starts; raises InputError if one cannot work."""
        for stage, model in (("objects", self.segmenter), ("objects", self.tracker), ("regions", self.embedder)):
            check = getattr(model, "check", None)
            if stage in stages and check is not None:
                check()

    def close(self) -> None:
        """Frees the memory of the networks until they are needed again."""
        for model in (self.embedder, self.segmenter, self.tracker):
            close = getattr(model, "close", None)
            if close is not None:
                close()
