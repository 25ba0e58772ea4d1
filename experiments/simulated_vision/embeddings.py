"""Embeddings simulated from true instance labels: those of an image in a space of text vectors such as CLIP's.

There texts lie in a narrow cone (mean pairwise cosine 0.74 in CLIP ViT-B/32), images in another, so that an image has a
cosine of only about 0.3 with a text that fits it and 0.2 with one that does not (the modality gap of Liang et al.,
NeurIPS 2022), and small crops are seen badly.
"""

import hashlib
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from experiments.simulated_vision.masks import Faults
from jsecon.errors import InputError, require

PAIRWISE_COSINE = 0.74
"""mean over pairs of the 1,203 LVIS class names in CLIP ViT-B/32"""
SPREAD = 53.0
"""a made text space's variance falls by e every so many dimensions; twice as many carry it, as in CLIP (107)"""
MOST_NOISE = 4.0
"""the view noise of a tiny mask, in units of that of a mask of `reference_pixels`"""


class TextSpace(NamedTuple):
    """Texts and their vectors."""

    names: tuple[str, ...]
    vectors: np.ndarray
    """(C, E) float32 unit."""


def load_text_space(vectors: str | Path, names: str | Path) -> TextSpace:
    """A (C, E) .npy file and a JSON list of C names. Raises InputError where they are missing or disagree."""
    try:
        rows, texts = np.load(vectors).astype(np.float32), json.loads(Path(names).read_text())
    except (OSError, ValueError) as error:
        raise InputError(vectors, str(error), "text vectors and their names", "Use made_text_space instead.") from error
    if rows.ndim != 2 or len(rows) != len(texts):
        raise InputError(
            vectors,
            f"vectors {rows.shape} beside {len(texts)} names",
            "a row per name",
            "Give the two files of one space.",
        )
    return TextSpace(tuple(texts), _unit(rows))


def made_text_space(names: Sequence[str], *, dim: int = 512, seed: int = 0) -> TextSpace:
    """A space with CLIP's statistics: unit vectors of mean pairwise cosine 0.74, the rest falling off over about 107
    dimensions."""
    draw = np.random.default_rng([seed, 6])
    basis = np.linalg.qr(draw.standard_normal((dim, dim)))[0]
    spread = np.exp(-np.arange(dim - 1) / (2 * SPREAD))
    own = _unit(draw.standard_normal((len(names), dim - 1)) * spread)
    local = np.concatenate([np.full((len(names), 1), PAIRWISE_COSINE**0.5), (1 - PAIRWISE_COSINE) ** 0.5 * own], axis=1)
    return TextSpace(tuple(names), (local @ basis.T).astype(np.float32))


class SimulatedEmbedder:
    """An `Embedder` of frames whose true labels are given.

    frames (T, H, W, 3) with the true labels (T, H, W), -1 = none, and the class of each object, a name of `space`. The
    embedding of a mask is the direction of

        sum_k share_k (text_k + object_noise o_k) + share_none mean + gap + view_noise sqrt(reference / pixels) v

    with share_k the part of its pixels that shows object k, o_k drawn once per object and v once per mask, both
    isotropic of unit length. The gap is drawn once per space: across the texts' mean, plus `gap_along` of it.
    """

    def __init__(
        self,
        frames: UInt8[np.ndarray, "t h w 3"],
        labels: Int[np.ndarray, "t h w"],
        classes: Sequence[str],
        space: TextSpace,
        faults: Faults,
        *,
        seed: int = 0,
    ):
        require(
            labels.shape == frames.shape[:3] and int(labels.max(initial=-1)) < len(classes),
            "SimulatedEmbedder",
            f"labels {labels.shape} up to {labels.max(initial=-1)}, {len(classes)} classes",
            f"labels {frames.shape[:3]} below the number of classes",
            "Give the true labels of these frames and a class per object.",
        )
        self.name, self.dim = f"simulated (seed {seed})", space.vectors.shape[1]
        self._labels, self._faults, self._seed, self._classes = labels, faults, seed, len(classes)
        self._frames = {_digest(frame): t for t, frame in enumerate(frames)}
        self._words = dict(zip(space.names, space.vectors))
        draw = np.random.default_rng([seed, 7])
        mean = _unit(space.vectors.mean(0))
        across = draw.standard_normal(self.dim)
        self._gap = faults.gap * _unit(across - (across @ mean) * mean) + faults.gap_along * mean
        noise = faults.object_noise * _unit(draw.standard_normal((len(classes), self.dim)))
        text = self.embed_text(list(classes)).reshape(len(classes), self.dim)
        self._content = np.concatenate([mean[None], text + noise])  # first what shows no object
        # Canonical phrases are words like any other of the space.
        words = PAIRWISE_COSINE**0.5 * mean + (1 - PAIRWISE_COSINE) ** 0.5 * _unit(draw.standard_normal((4, self.dim)))
        self.canonical = _unit(words).astype(np.float32)

    def embed_regions(
        self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"]
    ) -> Float32[np.ndarray, "m e"]:
        """(M, E) unit embeddings of the masks of one of the frames; zero for an empty mask. Raises InputError for a
        frame that is not among those whose content is known."""
        t = self._frames.get(_digest(frame))
        if t is None:
            raise InputError(
                "SimulatedEmbedder",
                "a frame without true labels",
                f"one of the {len(self._frames)} frames it was made with",
                "Simulated vision sees only what it was told.",
            )
        found = np.zeros((len(masks), self.dim))
        for m, mask in enumerate(masks):
            shown = self._labels[t][mask]
            if not len(shown):
                continue
            shares = np.bincount(shown + 1, minlength=self._classes + 1) / len(shown)
            draw = np.random.default_rng([self._seed, 8, t, zlib.crc32(np.packbits(mask).tobytes())])
            noise = min((self._faults.reference_pixels / len(shown)) ** 0.5, MOST_NOISE) * self._faults.view_noise
            found[m] = _unit(shares @ self._content + self._gap + noise * _unit(draw.standard_normal(self.dim)))
        return found.astype(np.float32)

    def embed_text(self, texts: list[str]) -> Float32[np.ndarray, "q e"]:
        """(Q, E) vectors of names of the space. Raises InputError for any other text."""
        for text in texts:
            if text not in self._words:
                raise InputError(text, "no such name", f"one of {len(self._words)}", "Use a name of the space.")
        return np.array([self._words[text] for text in texts], np.float32).reshape(len(texts), self.dim)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def _digest(frame: np.ndarray) -> bytes:
    return hashlib.sha1(np.ascontiguousarray(frame).tobytes()).digest()
