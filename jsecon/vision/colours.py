"""Default embedder without a network: a joint space of regions and texts made of named colours. Host code.

Regions and texts become distributions over CIELAB, and by a smooth kernel vectors over the prototypes of a palette,
which has the basic colour terms (Berlin & Kay 1969) and common mixed ones.
"""

import functools
import itertools
import re
import tomllib
from pathlib import Path

import cv2
import numpy as np
import scipy  # loads scipy.optimize on its first use, which most texts do without
from jaxtyping import Bool, Float32, UInt8

from jsecon.errors import InputError, require_shape

_TABLES = tomllib.loads(Path(__file__).with_name("colours.toml").read_text())
PALETTE: dict[str, tuple[int, int, int]] = {name: tuple(rgb) for name, rgb in _TABLES["palette"].items()}
"""name -> sRGB of a typical matt object; a name of two words is a variant of the basic term in it"""
_WORDS = {kind: frozenset(words) for kind, words in _TABLES["words"].items()}
BASIC = ("black", "white", "red", "green", "yellow", "blue", "brown", "orange", "pink", "purple", "grey")
"""the eleven basic colour terms"""
VOCABULARY = (*(name for name in PALETTE if name.split()[-1] in BASIC), "turquoise", "lilac")
"""Names that objects get: basic terms, their dark and light variants, and the two that came to be basic terms in
English since (Mylonas & MacDonald 2016)."""
_SHADES = {basic: tuple(f"{shade} {basic}" for shade in ("dark", "light")) for basic in BASIC} | {
    "black": ("charcoal",),
    "white": (),
    "blue": ("dark blue", "light blue", "navy"),
}
"""A bare basic term names a family of colours: itself and these shades, and so their neighbours (burgundy, sky) too."""
_SHADE, _GREY_SHADE = 0.7, 0.85
"""Similarity of a bare basic term to the shades of its family, relative to its typical colour: a dark red wall is red,
and a red mug before it is redder. Greys differ only in lightness, part of which the canonical neutrals remove."""
_EXTENT_WEIGHT = 0.12
"""Share of the cosine for the size of a region in the frame: `white plate` is not the white wall."""


def _lab_of(rgb: np.ndarray) -> Float32[np.ndarray, "n 3"]:
    """Converts sRGB to CIELAB (D65)."""
    pixels = np.asarray(rgb, np.float32).reshape(-1, 1, 3) / 255.0
    return cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB).reshape(-1, 3)


class ColourEmbedder:
    """Embedder (jsecon.vision.protocols) over named colours; see the module for the space.

    It understands colour names, their dark and light variants, `-ish` and compound forms (`bluish-green`), bare basic
    terms with all shades of their family (`red` includes dark red and burgundy, `bright red` and `dark red` exclude
    each other), several colours of one object (`red and white striped box`, with equal weights), and whether the object
    is part of the surroundings (wall, floor, table ...). Other nouns, shapes and materials have no influence.

    An embedding is the kernel mean over the palette's P prototypes, times sqrt(1 - _EXTENT_WEIGHT), followed by two
    coordinates of length sqrt(_EXTENT_WEIGHT) that turn from `thing` to `surroundings` with the share of the frame.

    `canonical_phrases` has the place of object / things / stuff / texture in LERF's relevancy: the mean of the palette
    (any colour), mid grey, and a pale and a dark neutral (walls, shadow).

    `unrelated_words` has objects of two colours, for each pair of basic terms and their shades. Most rooms contain most
    colours but few such pairs: a region with one of the two measures the similarity of half a text.
    """

    name = "colours-1"
    vocabulary = (*VOCABULARY, *(f"{name} background" for name in VOCABULARY))
    softmax_scale = 20.0

    def __init__(self):
        self.names = tuple(PALETTE)
        self._points = _lab_of(np.asarray(list(PALETTE.values())))
        self._by_name = dict(zip(self.names, self._points))
        gram = _kernel(self._points, self._points)
        # k(x, .) is projected on the span of the prototypes: phi(x) = K^(-1/2) k(x). Small eigenvalues are rounding
        # errors and are skipped.
        values, vectors = np.linalg.eigh(gram.astype(np.float64))
        kept = values > 1e-3 * values[-1]
        self._projection = (vectors[:, kept] / np.sqrt(values[kept])).astype(np.float32)
        self.dim = int(kept.sum()) + 2
        self._family = functools.cache(self._make_family)
        neutral = _lab_of(np.asarray([(128, 128, 128), (190, 182, 170), (64, 62, 60)]))
        colours = [self._mean(self._points), *(self._mean(point[None]) for point in neutral)]
        self.canonical_phrases = np.stack([_joined(c, angle) for c, angle in zip(colours, (0.25, 0.25, 0.5, 0.25))])

    @functools.cached_property
    def unrelated_words(self) -> Float32[np.ndarray, "w e"]:
        """Embeddings of unrelated texts. A field holds its own."""
        basic = [name for name in self.names if name.split()[-1] in BASIC]
        return self.embed_text([f"{first} and {other}" for first, other in itertools.combinations(basic, 2)])

    def embed_regions(
        self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m _ _"]
    ) -> Float32[np.ndarray, "m e"]:
        """Embeds masks of a frame: unit rows, zero for an empty mask."""
        require_shape("masks", masks, ("M", *frame.shape[:2]), "Pass masks of the size of the frame.")
        lab = cv2.cvtColor(np.ascontiguousarray(frame).astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)

        out = np.zeros((len(masks), self.dim), np.float32)
        for row, mask in zip(out, masks.astype(bool)):
            pixels = _pixels_inside(lab, mask)
            if len(pixels):
                colour = self._mean(_without_shadow_and_shine(pixels))
                # A quarter of the frame counts fully as surroundings.
                row[:] = _joined(colour, np.count_nonzero(mask) / mask.size / 0.25)
        return out

    def embed_text(self, texts: list[str]) -> Float32[np.ndarray, "q e"]:
        """Embeds texts with colour words: unit rows. A text without any, or with a negation, raises InputError."""
        out = np.zeros((len(texts), self.dim), np.float32)
        for row, text in zip(out, texts):
            named = [self._distribution(phrase) for phrase in self._phrases(text)]
            points, weights = (np.concatenate(column) for column in zip(*named))
            surrounds = float(bool(_WORDS["surroundings"] & set(_words(text))))
            row[:] = _joined(self._mean(*_spread(points, weights)), surrounds)
        return out

    def narrower(self, text: str) -> list[str]:
        """Lists texts for the shades of a bare basic colour term: "dark blue mug", "light blue mug", "navy mug".

        There is none if the text has several colours, or one that is not a bare basic term.
        """
        phrases = self._phrases(text)
        word, basic = phrases[0][0], self._base(phrases[0][0])[0]
        if len(phrases) > 1 or not self._is_bare(phrases[0]):
            return []
        return [re.sub(rf"\b{word}\b", shade, text.lower()) for shade in _SHADES[str(basic)]]

    def _mean(self, points: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
        """Unit kernel mean of CIELAB points (n, 3), optionally weighted, in the span of the palette."""
        likeness = _kernel(points, self._points)
        weights = np.ones(len(points)) if weights is None else weights
        mean = (weights.astype(np.float32) @ likeness / weights.sum()) @ self._projection
        return mean / max(float(np.linalg.norm(mean)), 1e-12)

    def _make_family(self, basic: str) -> tuple[Float32[np.ndarray, "p 3"], Float32[np.ndarray, " p"]]:
        """Colours of a bare basic term, and their weights.

        The weights are the least non-negative ones with a similarity of 1 to the typical colour and of _SHADE to each
        shade, so that nearby shades do not count twice.
        """
        points = np.stack([self._by_name[name] for name in (basic, *_SHADES[basic])])
        shade = _GREY_SHADE if basic == "grey" else _SHADE
        similarity = np.where(np.arange(len(points)) == 0, 1.0, shade)
        return points, scipy.optimize.nnls(_kernel(points, points).astype(np.float64), similarity)[0].astype(np.float32)

    def _distribution(self, phrase: list[str]) -> tuple[np.ndarray, np.ndarray]:
        """CIELAB points (P, 3) and weights (P,) of a run of modifiers and colour words."""
        if self._is_bare(phrase):
            return self._family(str(self._base(phrase[0])[0]))
        return self._colour(phrase)[None], np.ones(1, np.float32)

    def _is_bare(self, phrase: list[str]) -> bool:
        """Whether a run of modifiers and colour words is a basic term alone."""
        base, ish = self._base(phrase[0])
        return len(phrase) == 1 and base in BASIC and not ish

    def _phrases(self, text: str) -> list[list[str]]:
        """Splits a text into runs of modifiers and colour words, one run per colour."""
        words = _words(text, separators=True)
        if _WORDS["negation"] & set(words):
            remedy = "Name the colours of the object instead."
            raise InputError(f"query {text!r}", "the text has a negation", remedy=remedy)
        phrases: list[list[str]] = []
        modifiers: list[str] = []
        run_open = False  # the last word was a colour
        for word in words:
            if self._base(word)[0] is not None:
                if run_open:  # 'blue green', 'orange-red': one colour between the two
                    phrases[-1].append(word)
                else:
                    phrases.append([*modifiers, word])
                modifiers, run_open = [], True
            elif word in _WORDS["dark"] | _WORDS["light"] | _WORDS["plain"]:
                modifiers, run_open = [*modifiers, word], False
            else:
                modifiers, run_open = [], False
        if not phrases:
            known = ", ".join(sorted({n for n in self.names if " " not in n}))
            remedy = (
                "Name the colour of the object, as in 'dark green bottle' or 'red and white box'. This embedder knows "
                f"only colours ({known}; dark, light, -ish). Or query a pixel with --at FRAME X Y, or use a field "
                "built with CLIP."
            )
            raise InputError(f"query {text!r}", "the text has no colour word", remedy=remedy)
        return phrases

    def _base(self, word: str) -> tuple[str | None, bool]:
        """Palette name of a word, or None, and whether the word ends in `-ish` (reddish, bluish, greyish)."""
        word = _TABLES["synonyms"].get(word, word)
        if word in self._by_name:
            return word, False
        if word.endswith("ish"):
            stem = word[:-3]
            doubled = [stem[:-1]] if len(stem) > 3 and stem[-1] == stem[-2] else []  # reddish
            for candidate in (stem, stem + "e", *doubled):
                candidate = _TABLES["synonyms"].get(candidate, candidate)
                if candidate in self._by_name:
                    return candidate, True
        return None, False

    def _colour(self, phrase: list[str]) -> np.ndarray:
        """CIELAB (3,) of a run like [dark, bluish, green]."""
        bases = [self._base(word) for word in phrase]
        names = [(base, ish) for base, ish in bases if base is not None]
        dark, light = bool(_WORDS["dark"] & set(phrase)), bool(_WORDS["light"] & set(phrase))
        prefix = "dark " if dark and not light else "light " if light and not dark else ""
        points, weights = [], []
        for base, ish in names:
            shaded = self._by_name.get(prefix + base)
            if shaded is None:
                step = -22.0 if dark else 22.0 if light else 0.0
                shaded = self._by_name[base] + np.asarray([step, 0.0, 0.0], np.float32)
            points.append(shaded)
            # 'bluish green' is more green than blue; 'navy blue' is navy, and its basic term only classifies it.
            weights.append(0.25 if base in BASIC and weights and names[0][0] not in BASIC else 0.5 if ish else 1.0)
        weight = np.asarray(weights, np.float32)[:, None]
        mixed = (np.stack(points) * weight).sum(0) / weight.sum()
        if all(ish for _, ish in names):
            mixed = mixed * np.asarray([1.0, 0.7, 0.7], np.float32)  # 'greenish' is greener than grey, not green
        return mixed.astype(np.float32)


def _kernel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n, m) Gaussian similarity of CIELAB colours (n, 3) and (m, 3), 1 for equal ones."""
    # exp(-1/2) at a distance of 22: about the step from plain to dark or light. Lighting changes L, so that it counts
    # for less, but names depend on it too.
    scale = np.asarray([0.8, 1.0, 1.0], np.float32) / 22.0
    x, y = x * scale, y * scale
    products = x @ y.T
    products *= 2.0
    squared = (x * x).sum(-1)[:, None] + (y * y).sum(-1)
    squared -= products
    np.maximum(squared, 0.0, out=squared)
    squared *= -0.5
    return np.exp(squared, out=squared)


def _spread(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours (P, 3) with their darker and lighter neighbours (3 P, 3), and their weights: a word names a range."""
    steps = np.asarray([[0, 0, 0], [-10, 0, 0], [10, 0, 0]], np.float32)
    spread = (points[:, None] + steps).clip([0, -128, -128], [100, 128, 128]).reshape(-1, 3)
    return spread.astype(np.float32), (weights[:, None] * np.asarray([0.7, 0.15, 0.15], np.float32)).reshape(-1)


def _joined(colour: np.ndarray, extent: float) -> np.ndarray:
    """Unit vector of the joint space from a unit colour vector and an extent (0 object .. 1 surroundings)."""
    angle = 0.5 * np.pi * min(max(float(extent), 0.0), 1.0)
    turned = np.sqrt(_EXTENT_WEIGHT) * np.asarray([np.cos(angle), np.sin(angle)])
    return np.concatenate([np.sqrt(1.0 - _EXTENT_WEIGHT) * colour, turned]).astype(np.float32)


def _pixels_inside(lab: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Pixels (n, 3) of a mask without its rim of one px, where colours mix; all pixels if few are left."""
    x, y, width, height = cv2.boundingRect(mask.view(np.uint8))
    box = slice(max(y - 1, 0), y + height + 1), slice(max(x - 1, 0), x + width + 1)
    mask = mask[box]
    core = cv2.erode(mask.view(np.uint8), np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE).view(bool)
    return lab[box][core if np.count_nonzero(core) >= 0.3 * np.count_nonzero(mask) else mask]


def _without_shadow_and_shine(lab: np.ndarray) -> np.ndarray:
    """Keeps the CIELAB pixels between the 30th and the 95th percentile of lightness.

    The lit side determines the colour name, and shadows are more frequent than highlights.
    """
    low, high = np.percentile(lab[:, 0], [30.0, 95.0])
    kept = (lab[:, 0] >= low) & (lab[:, 0] <= high)
    return lab[kept] if kept.any() else lab  # two pixels have no percentile between them


def _words(text: str, *, separators: bool = False) -> list[str]:
    """Lower-case words; with `separators` also commas, semicolons, slashes and ampersands, which end a colour."""
    return re.findall(r"[a-z]+|[,;/&+]" if separators else r"[a-z]+", text.lower().replace("'", ""))
