"""Vision simulated from true instance labels, with the faults of real vision at stated rates: for experiments and
tests.

Masks: objects cut into parts, merged with a neighbour, missing or with a shifted border in single views; a tracker that
loses objects and swaps two. Embeddings: those of an image in a space of text vectors such as CLIP's. There texts lie in
a narrow cone (mean pairwise cosine 0.74 in CLIP ViT-B/32), images in another, so that an image has a cosine of only
about 0.3 with a text that fits it and 0.2 with one that does not (the modality gap of Liang et al., NeurIPS 2022), and
small crops are seen badly.
"""

import dataclasses
import hashlib
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from jsecon.errors import InputError, require

PAIRWISE_COSINE = 0.74
"""mean over pairs of the 1,203 LVIS class names in CLIP ViT-B/32"""
SPREAD = 53.0
"""a made text space's variance falls by e every so many dimensions; twice as many carry it, as in CLIP (107)"""
MOST_NOISE = 4.0
"""the view noise of a tiny mask, in units of that of a mask of `reference_pixels`"""
REACH_PX = 3
"""regions at most so far apart are neighbours"""


@dataclasses.dataclass(frozen=True)
class Faults:
    """How bad the vision is. Shares are in [0, 1]; the defaults are the level "medium"."""

    split: float | int = 0.2
    """share of the masks (a region in a view) that are cut by straight lines; the largest part keeps the id."""
    parts: int = 2
    """parts of a mask that is cut; each further one has an id of its own, the same in all views."""
    merge: float | int = 0.1
    """share of the masks that take the id of the neighbour with the longest common border, where there is one."""
    miss: float | int = 0.05
    """share of the masks that are missing."""
    jitter_px: int = 2
    """masks grow or shrink by a whole number of px, uniform in -jitter_px .. jitter_px."""
    lose: float | int = 0.2
    """share of the objects that the tracker loses at a frame of the middle half, and never finds by the same id."""
    gone: float | int = 0.5
    """share of the lost objects that stay without label; the others go on under a new id."""
    swap: float | int = 0.2
    """share of the objects whose ids are exchanged, in pairs, from a frame of the middle half on."""
    gap: float | int = 2.2
    """length of what all images have in common, in lengths of a text vector; across the texts' mean direction."""
    gap_along: float | int = -0.16
    """what an image has along the texts' mean direction beyond its own text's."""
    object_noise: float | int = 1.4
    """length of what sets an object's images apart from its class's text, the same in all views."""
    view_noise: float | int = 1.1
    """length of what differs from view to view, at `reference_pixels`; it falls with the root of the pixels."""
    reference_pixels: int = 1000


LEVELS = {
    "low": Faults(0.05, 2, 0.02, 0.02, 1, 0.1, 0.5, 0.0, object_noise=1.0, view_noise=0.6),
    "medium": Faults(),
    "high": Faults(0.4, 3, 0.2, 0.15, 4, 0.4, 0.5, 0.35, object_noise=1.8, view_noise=1.8),
}
"""named levels of noise; `Faults` of all zeros is perfect vision"""


class SimulatedMasks(NamedTuple):
    """What the segmenter and the tracker make of the true labels."""

    labels: np.ndarray
    """(T, H, W) int16 regions 0 .. R-1, -1 = none."""
    origin: np.ndarray
    """(R,) int64 the object that most of the region's pixels show; -1 where most show none."""


def simulated_masks(labels: Int[np.ndarray, "t h w"], faults: Faults, *, seed: int = 0) -> SimulatedMasks:
    """Disturbed region labels of the true objects' labels (T, H, W), -1 = none; a function of its arguments.

    First the tracker's faults, then within each frame cuts, merges, missing masks and jitter. Each kind has its own
    random stream: changing one rate leaves what the others do. Raises ValueError for shares outside [0, 1].
    """
    _check(faults)
    count = int(labels.max(initial=-1)) + 1
    tracked = _track(labels.astype(np.int64), count, faults, seed)
    found = np.stack([_propose(image, 2 * count, faults, seed, t) for t, image in enumerate(tracked)])
    kept, compact = np.unique(found, return_inverse=True)
    compact = (compact.reshape(found.shape) - int((kept < 0).any())).astype(np.int16)
    regions = int((kept >= 0).sum())
    shown = compact >= 0
    joint = np.bincount(
        compact[shown].astype(np.int64) * (count + 1) + labels[shown] + 1, minlength=regions * (count + 1)
    )
    return SimulatedMasks(compact, joint.reshape(regions, count + 1).argmax(1) - 1)


def _check(faults: Faults) -> None:
    for name in ("split", "merge", "miss", "lose", "gone", "swap"):
        share = getattr(faults, name)
        require(0 <= share <= 1, f"Faults.{name}", got=share, expected="a share in [0, 1]", remedy="See LEVELS.")
    require(
        faults.parts >= 2 and faults.jitter_px >= 0,
        "Faults",
        got=f"parts={faults.parts}, jitter_px={faults.jitter_px}",
        expected="parts >= 2, jitter_px >= 0",
        remedy="split=0 cuts nothing.",
    )


def _track(labels: np.ndarray, count: int, faults: Faults, seed: int) -> np.ndarray:
    """The true labels under the tracker's ids; a lost object k goes on as count + k, or not at all."""
    tracked, frames = labels.copy(), len(labels)
    draw = np.random.default_rng([seed, 0])
    whole = draw.permutation(count)[: 2 * round(faults.swap * count / 2)]
    for a, b in whole.reshape(-1, 2):
        later = tracked[_middle(draw, frames) :]
        is_a, is_b = later == a, later == b
        later[is_a], later[is_b] = b, a
    draw = np.random.default_rng([seed, 1])
    lost = draw.permutation(count)[: round(faults.lose * count)]
    for place, k in enumerate(lost):
        later = tracked[_middle(draw, frames) :]
        later[later == k] = -1 if place < round(faults.gone * len(lost)) else count + k
    return tracked


def _middle(draw: np.random.Generator, frames: int) -> int:
    return int(draw.integers(frames // 4, max(3 * frames // 4, frames // 4 + 1)))


def _propose(image: np.ndarray, ids: int, faults: Faults, seed: int, t: int) -> np.ndarray:
    """One frame's masks; part p of id r is ids * p + r."""
    found = image.copy()
    here = np.unique(image[image >= 0])

    draw = np.random.default_rng([seed, 2, t])
    for r in here:
        cut, angle = draw.random() < faults.split, draw.uniform(0, np.pi)
        if cut:
            rows, columns = np.nonzero(image == r)
            along = np.cos(angle) * columns + np.sin(angle) * rows
            share = np.sort(draw.dirichlet(np.full(faults.parts, 3.0)))[::-1]
            part = np.searchsorted(np.quantile(along, np.cumsum(share)[:-1]), along)
            found[rows, columns] = ids * part + r

    draw = np.random.default_rng([seed, 3, t])
    before = found.copy()
    for r in here:
        if draw.random() < faults.merge:
            mask = image == r
            near = image[_grown(mask, REACH_PX) & ~mask]
            near = near[near >= 0]
            if len(near):
                other = np.bincount(near).argmax()
                # Each takes the id that its neighbour had before any merge: two that choose each other trade theirs.
                found[mask] = np.where(before[mask] == r, other, before[mask])

    draw = np.random.default_rng([seed, 4, t])
    for r in here:
        if draw.random() < faults.miss:
            found[image == r] = -1

    if faults.jitter_px:
        draw = np.random.default_rng([seed, 5, t])
        before = found.copy()
        for r in np.unique(before[before >= 0]):
            by, mask = int(draw.integers(-faults.jitter_px, faults.jitter_px + 1)), before == r
            if by > 0:
                found[_grown(mask, by)] = r
            elif by < 0:
                found[mask & (found == r) & _grown(~mask, -by)] = -1
    return found


def _grown(mask: np.ndarray, by: int) -> np.ndarray:
    """The mask and all pixels at most `by` steps to a side from it."""
    grown = mask.copy()
    for _ in range(by):
        last = grown.copy()
        grown[1:] |= last[:-1]
        grown[:-1] |= last[1:]
        grown[:, 1:] |= last[:, :-1]
        grown[:, :-1] |= last[:, 1:]
    return grown


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
        raise InputError(
            vectors, found=str(error), expected="text vectors and their names", remedy="Use made_text_space instead."
        ) from error
    if rows.ndim != 2 or len(rows) != len(texts):
        raise InputError(
            vectors,
            found=f"vectors {rows.shape} beside {len(texts)} names",
            expected="a row a name",
            remedy="Give the two files of one space.",
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
    """An `Embedder` that knows what the frames show.

    frames (T, H, W, 3) with the true labels (T, H, W), -1 = none, and the class of each object, a name of `space`. The
    embedding of a mask is the direction of

        sum_k share_k (text_k + object_noise o_k) + share_none mean + gap + view_noise sqrt(reference / pixels) v

    with share_k the part of its pixels that shows object k, o_k drawn once an object and v once a mask, both isotropic
    of unit length. The gap is drawn once a space: across the texts' mean, plus `gap_along` of it.
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
            got=f"labels {labels.shape} up to {labels.max(initial=-1)}, {len(classes)} classes",
            expected=f"labels {frames.shape[:3]} below the number of classes",
            remedy="Give the true labels of these frames and a class an object.",
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
                found="a frame without true labels",
                expected=f"one of the {len(self._frames)} frames it was made with",
                remedy="Simulated vision sees only what it was told.",
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
                raise InputError(
                    text, found="no such name", expected=f"one of {len(self._words)}", remedy="Use a name of the space."
                )
        return np.array([self._words[text] for text in texts], np.float32).reshape(len(texts), self.dim)


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def _digest(frame: np.ndarray) -> bytes:
    return hashlib.sha1(np.ascontiguousarray(frame).tobytes()).digest()
