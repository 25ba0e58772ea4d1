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
from jaxtyping import Bool, Float, Float32, Int, UInt8

from experiments.simulated_vision.masks import Faults
from experiments.simulated_vision.worlds import World
from jsecon.errors import InputError, require

PAIRWISE_COSINE = 0.74
"""mean over pairs of the 1,203 LVIS class names in CLIP ViT-B/32"""
SPREAD = 53.0
"""a made text space's variance falls by e every so many dimensions; twice as many carry it, as in CLIP (107)"""
WORDS = 0.8
"""the part of what tells names apart that their words have, in the hardest world"""
HARMONICS = 4
"""of the noise that follows the azimuth"""
MOST_NOISE = 4.0
"""the view noise of a tiny mask, in units of that of a mask of `reference_pixels`"""
LEANING = 0.75
"""part of an object's text that others take the place of where `World.shared` is 1. Chosen so that the own text is then
the best of the scene's for about a quarter of the regions by the centred cosine (experiments/shared_errors.py)"""
CONFUSED = 2
"""other classes of the scene in an object's mixture; where names that nothing has are given, as many of these too"""
PLAIN = World()


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
        raise InputError(vectors, f"has vectors {rows.shape} for {len(texts)} names", remedy="Give files of one space.")
    return TextSpace(tuple(texts), _unit(rows))


def named_after(
    space: TextSpace, names: Sequence[str], *, near: bool, seed: int = 0, others: Sequence[str] = ()
) -> TextSpace:
    """The names under vectors of a real space: of words drawn by lot, or of one word and those nearest to it. `others`,
    which come last, have those that are drawn next, or are next nearest.

    Raises InputError where the space has too few.
    """
    count = len(names) + len(others)
    if count > len(space.names):
        raise InputError("the text space", f"{len(space.names)} words", f"{count} or more", "Take a larger one.")
    draw = np.random.default_rng([seed, 13])
    rows = draw.permutation(len(space.names))
    if near:
        rows = np.argsort(-(space.vectors @ space.vectors[rows[0]]), kind="stable")
    own = draw.permutation(rows[: len(names)])
    return TextSpace((*names, *others), space.vectors[np.concatenate([own, rows[len(names) : count]])])


def made_text_space(names: Sequence[str], *, dim: int = 512, seed: int = 0, common: float | int = 0.0) -> TextSpace:
    """A space with CLIP's statistics: unit vectors of mean pairwise cosine 0.74, the rest falling off over about 107
    dimensions. `common`, from 0 to 1, brings names with words in common nearer to each other."""
    draw = np.random.default_rng([seed, 6])
    basis = np.linalg.qr(draw.standard_normal((dim, dim)))[0]
    spread = np.exp(-np.arange(dim - 1) / (2 * SPREAD))
    own = _unit(draw.standard_normal((len(names), dim - 1)) * spread)
    if common:

        def word(w):
            return np.random.default_rng([seed, 6, zlib.crc32(w.encode())]).standard_normal(dim - 1) * spread

        shared = _unit(np.stack([sum(_unit(word(w)) for w in name.split()) for name in names]))
        own = _unit((1 - WORDS * common) ** 0.5 * own + (WORDS * common) ** 0.5 * shared)
    local = np.concatenate([np.full((len(names), 1), PAIRWISE_COSINE**0.5), (1 - PAIRWISE_COSINE) ** 0.5 * own], axis=1)
    return TextSpace(tuple(names), (local @ basis.T).astype(np.float32))


class SimulatedEmbedder:
    """An `Embedder` of frames whose true labels are given.

    frames (T, H, W, 3) with the true labels (T, H, W), -1 = none, and the class of each object, a name of `space`. The
    embedding of a mask is the direction of

        sum_k share_k (text_k + object_noise o_k) + share_none mean + gap + view_noise sqrt(reference / pixels) v

    with share_k the part of its pixels that shows object k, o_k drawn once per object and v once per mask, both
    isotropic of unit length. The gap is drawn once per space: across the texts' mean, plus `gap_along` of it.

    In a hard `world`, labels may be pieces of `objects` (L,), each set apart from its object's text by a direction of
    its own; the gap's length differs by class; v follows the views' `azimuths` (T,), radians; and each object's text is

        (1 - LEANING shared) text_k + LEANING shared sum_j m_kj text_j

    with m_kj the object's mixture (`leanings`) of the other classes and of names that nothing has, `others` (O, E).
    `unrelated_words` (W, E) are the unrelated words of the space; by default there are none.
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
        world: World = PLAIN,
        objects: Int[np.ndarray, " l"] | None = None,
        azimuths: Float[np.ndarray, " t"] | None = None,
        others: Float[np.ndarray, "o e"] | None = None,
        reference: Float[np.ndarray, "w e"] | None = None,
    ):
        objects = np.arange(len(classes)) if objects is None else np.asarray(objects)
        require(
            labels.shape == frames.shape[:3] and int(labels.max(initial=-1)) < len(objects),
            "SimulatedEmbedder",
            f"labels {labels.shape} up to {labels.max(initial=-1)}, {len(objects)} classes",
            f"labels {frames.shape[:3]} below the number of classes",
            "Give the true labels of these frames and a class per object.",
        )
        self.name, self.dim = f"simulated (seed {seed})", space.vectors.shape[1]
        self._labels, self._faults, self._seed, self._objects = labels, faults, seed, objects
        self._frames = {_digest(frame): t for t, frame in enumerate(frames)}
        self._words = dict(zip(space.names, space.vectors))
        draw = np.random.default_rng([seed, 7])
        mean = _unit(space.vectors.mean(0))
        across = draw.standard_normal(self.dim)
        self._gap = faults.gap * _unit(across - (across @ mean) * mean) + faults.gap_along * mean
        noise = faults.object_noise * _unit(draw.standard_normal((len(classes), self.dim)))
        text = self.embed_text(list(classes)).reshape(len(classes), self.dim)
        if world.shared:
            others = np.zeros((0, self.dim)) if others is None else others
            mixture = leanings(classes, len(others), seed=seed)
            part = LEANING * world.shared * mixture.sum(1, keepdims=True)
            text = (1 - part) * text + LEANING * world.shared * mixture @ np.concatenate([text, others])
        content = (text + noise)[objects]
        hard = np.random.default_rng([seed, 9])
        aside = _unit(hard.standard_normal((len(objects), self.dim)))
        spread = 0.5 * world.gap * hard.standard_normal((len(set(classes)), 1))
        basis = hard.standard_normal((2 * HARMONICS, self.dim))
        turning = hard.standard_normal((len(classes) + 1, HARMONICS, 2 * HARMONICS)) @ basis
        if len(objects) > len(classes):
            content = content + world.parts * aside
        if world.gap:
            kinds = np.unique(list(classes), return_inverse=True)[1]
            content = content + spread[kinds[objects]] * self._gap
        self._content = np.concatenate([mean[None], content])  # first what shows no object
        self._smooth = 0.0 if azimuths is None else world.azimuth
        if self._smooth:
            waves = np.stack([np.cos(azimuths), np.sin(azimuths), np.cos(2 * azimuths), np.sin(2 * azimuths)])
            self._turning = _unit(np.einsum("khe,ht->kte", turning, waves))
        # Canonical phrases are words like any other of the space.
        words = PAIRWISE_COSINE**0.5 * mean + (1 - PAIRWISE_COSINE) ** 0.5 * _unit(draw.standard_normal((4, self.dim)))
        self.canonical_phrases = _unit(words).astype(np.float32)
        self.unrelated_words = np.zeros((0, self.dim), np.float32) if reference is None else reference

    def embed_regions(
        self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m h w"]
    ) -> Float32[np.ndarray, "m e"]:
        """(M, E) unit embeddings of the masks of one of the frames; zero for an empty mask. Raises InputError for a
        frame that is not among those whose content is known."""
        t = self._frames.get(_digest(frame))
        if t is None:
            raise InputError("SimulatedEmbedder", "the frame is none of those whose true labels are known")
        found = np.zeros((len(masks), self.dim))
        for m, mask in enumerate(masks):
            shown = self._labels[t][mask]
            if not len(shown):
                continue
            shares = np.bincount(shown + 1, minlength=len(self._content)) / len(shown)
            draw = np.random.default_rng([self._seed, 8, t, zlib.crc32(np.packbits(mask).tobytes())])
            noise = min((self._faults.reference_pixels / len(shown)) ** 0.5, MOST_NOISE) * self._faults.view_noise
            apart = _unit(draw.standard_normal(self.dim))
            if self._smooth:
                most = int(shares.argmax()) - 1
                smooth = self._turning[self._objects[most] if most >= 0 else -1, t]
                apart = _unit((1 - self._smooth) ** 0.5 * apart + self._smooth**0.5 * smooth)
            found[m] = _unit(shares @ self._content + self._gap + noise * apart)
        return found.astype(np.float32)

    def embed_text(self, texts: list[str]) -> Float32[np.ndarray, "q e"]:
        """(Q, E) vectors of names of the space. Raises InputError for any other text."""
        for text in texts:
            if text not in self._words:
                raise InputError(text, "no such name", f"one of {len(self._words)}", "Use a name of the space.")
        return np.array([self._words[text] for text in texts], np.float32).reshape(len(texts), self.dim)


def leanings(classes: Sequence[str], others: int, *, seed: int) -> Float[np.ndarray, "k m"]:
    """(K, K + O) what each of K objects of the named classes is taken for: weights of their K texts and of O others.

    An object's weights are drawn from a flat distribution over CONFUSED other classes of the scene and CONFUSED of the
    others. They sum to 1; to 0 where there is no other class and no other name. Each object has a draw of its own, by
    `seed` and its number: what is seen of the scene, and how badly, changes none.
    """
    names = np.array(classes)
    found = np.zeros((len(names), len(names) + others))
    first = np.sort(np.unique(names, return_index=True)[1])  # an object of each class
    for k, name in enumerate(names):
        draw = np.random.default_rng([seed, 16, k])
        inside = first[names[first] != name]
        chosen = draw.permutation(inside)[:CONFUSED]
        beside = len(names) + draw.permutation(others)[:CONFUSED]
        chosen = np.concatenate([chosen, beside]).astype(int)
        if len(chosen):
            found[k, chosen] = draw.dirichlet(np.ones(len(chosen)))
    return found


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def _digest(frame: np.ndarray) -> bytes:
    return hashlib.sha1(np.ascontiguousarray(frame).tobytes()).digest()
