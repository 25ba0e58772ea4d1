"""Segmenter by SAM, SlimSAM, EdgeTAM, SAM 2.1 or SAM 3 on ONNX Runtime: the automatic mask generator.

Points prompt the frame and crops of it: one in the middle of each region that differs by colour, then some in what the
masks of these do not explain (guided prompts), or the 1,024 points of SAM's grid. Each point gives three masks:
subpart, part and whole, the levels s, m and l; the level `default` pools all three. Masks that the model predicts to be
poor, that are not stable or that a crop cuts off are dropped, then repetitions by box, then small holes and islands are
removed, then LangSplat's suppression of masks by masks follows (minghanqin/LangSplat, preprocess.py). The steps are
those of facebookresearch/segment-anything, automatic_mask_generator.py. All of it runs on the host, on NumPy arrays.

A model folder has onnx/vision_encoder.onnx and onnx/prompt_encoder_mask_decoder.onnx, as exported for transformers.js.
The decoder takes input_points (1, B, P, 2) and input_labels (1, B, P) and gives iou_scores and pred_masks. There are
two kinds, which differ in the decoder's other inputs:
    SAM      image_embeddings of a frame that is scaled by its longer side and padded; a batch of prompts in one run
    SAM 2    image_embeddings.0, .1 and .2 of a frame that is stretched to a square, as EdgeTAM, SAM 2.1 and SAM 3 have;
             input_boxes (1, 0, 4), so one prompt a run; preprocessor_config.json states how colours are scaled
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from PIL import Image
from scipy import sparse

from jsecon.errors import InputError, require
from jsecon.networks.clip import read_preprocessing
from jsecon.networks.hub import Precision, graph_variants
from jsecon.networks.prompts import GuidedPrompts
from jsecon.networks.session import Graph, batches, content_digest, describe, graph_files

MEAN_STD = np.array([[123.675, 116.28, 103.53], [58.395, 57.12, 57.375]], np.float32)
"""SAM's mean and deviation of RGB in 0..255"""
IMAGE_SIDE = 1024
"""px of the encoder's square image, if its file does not fix it"""
EDGE = 20.0
"""px: a box this close to the edge of a crop was probably cut off by it"""
ENCODER = "vision_encoder.onnx"
DECODER = "prompt_encoder_mask_decoder.onnx"
CONFIG = "preprocessor_config.json"
PUBLISHED = (
    "SAM folders are published on huggingface.co: Xenova/sam-vit-base, Xenova/slimsam-77-uniform (a batch of prompts a "
    "run), onnx-community/EdgeTAM-ONNX, onnx-community/sam2.1-hiera-tiny-ONNX, onnx-community/sam3-tracker-ONNX."
)
_TOGETHER = "Take encoder and decoder from one export."

BATCH = 4
"""prompts of one run, if the decoder does not fix it: of EdgeTAM's decoder on two cores, 8 take 42 ms each, one alone
34 ms; 64 of SAM's take more than 1 GiB"""

Level = Literal["default", "s", "m", "l"]
Prompts = Literal["guided", "grid"]
TOKENS: dict[str, tuple[int, ...]] = {"default": (0, 1, 2), "s": (0,), "m": (1,), "l": (2,)}
"""level -> which of a point's three masks it takes"""


@dataclasses.dataclass(frozen=True)
class SamFiles:
    """Files and settings of a SAM model."""

    encoder: Path
    """Graph of frames."""
    decoder: Path
    """Graph of prompts."""
    colours: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Mean and standard deviation of RGB in 0..1 if they differ from SAM's, else None."""
    configured: bool = False
    """Whether the folder has a preprocessor_config.json."""
    side: int | None = None
    """Side of the square image in px by that file, or None."""


def find_sam(folder: str | Path, precision: Precision | None = None) -> SamFiles:
    """Finds the graphs of the SAM model in a folder, or in its subfolder `onnx`.

    Args:
      folder: The folder.
      precision: Precision of its graphs; None takes the highest that is there.

    Returns:
      The files, and how the model takes colours.

    Raises:
      InputError: A graph is missing, or the configuration cannot be read.
    """
    folder = Path(folder)
    pairs = [
        SamFiles(place / encoder, place / decoder)
        for encoder, decoder in graph_variants((ENCODER, DECODER), precision)
        for place in (folder, folder / "onnx")
    ]
    files = next((pair for pair in pairs if pair.encoder.is_file() and pair.decoder.is_file()), None)
    if files is None:
        graphs = [path for p in (folder, folder / "onnx") if p.is_dir() for path in sorted(p.glob("*.onnx"))]
        problem = ", ".join(str(path.relative_to(folder)) for path in graphs) or "no .onnx file"
        raise InputError(folder, problem, f"SAM's graphs {ENCODER} and {DECODER}", PUBLISHED)
    if not (folder / CONFIG).is_file():
        return files
    mean, std, side = read_preprocessing(folder / CONFIG, complete=True)
    is_default = np.allclose(np.multiply((mean, std), 255), MEAN_STD, rtol=1e-5)
    colours = None if is_default else (mean, std)
    return dataclasses.replace(files, colours=colours, configured=True, side=side)


class EncodedFrame(NamedTuple):
    """A frame as the decoder needs it."""

    features: dict[str, np.ndarray]
    """by the decoder's names"""
    size: tuple[int, int]
    """(H, W) px of the frame"""
    scaled: tuple[int, int]
    """(H, W) px of the frame within the encoder's square"""


class SamGraphs:
    """SAM's two graphs, ready to run.

    Args:
      files: The model's files.
      batch: Number of prompts of one run of the decoder, if it does not fix it.
      threads: Number of cores of one run, as for `Graph`.

    Attributes:
      batch: Number of prompts of one run.
      side: Side of the encoder's square image in px.
      stretched: Whether frames are stretched to a square (SAM 2), else scaled and padded (SAM).

    Raises:
      InputError: A graph has other tensors than SAM.
    """

    def __init__(self, files: SamFiles, *, batch: int = BATCH, threads: int | None = None):
        self.files = files
        self._encoder = Graph(files.encoder, threads=threads)
        self._decoder = Graph(files.decoder, threads=threads)
        image = self._encoder.require("input", "pixel_values", (1, 3, None, None), "SAM's image encoder")
        inputs = self._decoder.inputs
        self.stretched = "image_embeddings.0" in inputs
        if self.stretched and not files.configured:
            problem, remedy = "a decoder of SAM 2", f"Fetch {CONFIG} into the model's folder."
            raise InputError(files.decoder, problem, f"{CONFIG} in its folder: means and deviations", remedy)
        what = "SAM's mask decoder"
        points = self._decoder.require("input", "input_points", (1, None, None, 2), what)
        self._decoder.require("input", "input_labels", (1, None, None), what)
        self._decoder.require("output", "iou_scores", (1, None, None), what)
        masks = self._decoder.require("output", "pred_masks", (1, None, None, None, None), what)
        if masks.fixed(2) not in (None, 3, 4):
            raise self._not_three_masks(str(masks))
        self._fixed_batch = 1 if "input_boxes" in inputs else points.fixed(1)
        self.batch = self._fixed_batch or batch
        self.side = image.fixed(3) or (files.side if self.stretched else None) or IMAGE_SIDE
        self._links = self._checked_links()
        self._mean, self._std = MEAN_STD if files.colours is None else np.multiply(files.colours, 255).astype("f4")

    def _not_three_masks(self, problem: str) -> InputError:
        expected = "3 or 4 masks per prompt, from the smallest part to the whole, each with its score"
        where = f"{self.files.decoder}, output 'pred_masks'"
        return InputError(where, problem, expected, "Export the decoder with all of its masks.")

    def _checked_links(self) -> list[str]:
        """Names of what the decoder takes from the encoder."""
        prompts = ("input_points", "input_labels", "input_boxes")
        links = [name for name in self._decoder.inputs if name not in prompts]
        for name in links:
            if name not in self._encoder.outputs:
                outputs = describe(self._encoder.outputs.values())
                problem = f"no such output of {self.files.encoder.name}, which gives {outputs}"
                where = f"{self.files.decoder}, input {name!r}"
                raise InputError(where, problem, str(self._decoder.inputs[name]), _TOGETHER)
            shape = self._decoder.inputs[name].shape
            if shape is not None:
                self._encoder.require("output", name, shape, f"the encoder that {self.files.decoder.name} belongs to")
        return links

    def encode(self, frame: UInt8[np.ndarray, "h w 3"]) -> EncodedFrame:
        """Encodes a frame.

        It is resized by Pillow, as in SAM's training: its kernel widens if an image shrinks, OpenCV's does not.

        Args:
          frame: (H, W, 3) RGB.

        Returns:
          Its features, for `decode`.
        """
        height, width = frame.shape[:2]
        scale = self.side / max(height, width)
        size = (self.side, self.side) if self.stretched else (int(height * scale + 0.5), int(width * scale + 0.5))
        image = np.asarray(Image.fromarray(frame).resize((size[1], size[0]), Image.Resampling.BILINEAR), np.float32)
        square = np.zeros((self.side, self.side, 3), np.float32)
        square[: size[0], : size[1]] = (image - self._mean) / self._std
        features = self._encoder.run({"pixel_values": square.transpose(2, 0, 1)[None]}, self._links)
        return EncodedFrame(features, (height, width), size)

    def decode(
        self, encoded: EncodedFrame, points: Float32[np.ndarray, "p 2"]
    ) -> Iterator[tuple[Float32[np.ndarray, "b 3 l l"], Float32[np.ndarray, "b 3"]]]:
        """Predicts the masks of prompts, batch by batch.

        Args:
          encoded: The frame.
          points: (P, 2) points x, y in px of the frame.

        Yields:
          Mask logits (B, 3, L, L) from part to whole, and predicted IoUs (B, 3).
        """
        scaled = points * np.divide(encoded.scaled[::-1], encoded.size[::-1], dtype=np.float32)
        for part, count in batches(scaled, self._fixed_batch, self.batch):
            masks, scores = self._run_decoder(encoded, part)
            yield masks[:count], scores[:count]

    def _run_decoder(self, encoded: EncodedFrame, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mask logits (B, 3, L, L) and predicted IoUs (B, 3) of points (B, 2) in px of the encoder's square."""
        labels_dtype = np.int64 if self._decoder.inputs["input_labels"].dtype.startswith("int") else np.float32
        feeds = {"input_points": points[None, :, None], "input_labels": np.ones((1, len(points), 1), labels_dtype)}
        if "input_boxes" in self._decoder.inputs:
            feeds["input_boxes"] = np.zeros((1, 0, 4), np.float32)
        outputs = self._decoder.run(encoded.features | feeds, ["pred_masks", "iou_scores"])
        masks, scores = outputs["pred_masks"][0], outputs["iou_scores"][0]
        if masks.shape[:2] != scores.shape or masks.shape[1] not in (3, 4):
            raise self._not_three_masks(f"{list(masks.shape)} with scores {list(scores.shape)}")
        return masks[:, -3:].astype(np.float32), scores[:, -3:].astype(np.float32)  # of 4, the first is SAM's best

    def to_frame(self, logits: Float32[np.ndarray, "l l"], encoded: EncodedFrame) -> Float32[np.ndarray, "h w"]:
        """Resizes the logits of a mask to the frame, bilinearly, through the encoder's square as SAM does.

        Args:
          logits: (L, L) from `decode`.
          encoded: The frame.

        Returns:
          (H, W) logits.
        """
        size = encoded.size[::-1]
        if self.stretched:
            return cv2.resize(logits, size)
        square = cv2.resize(logits, (self.side, self.side))
        return cv2.resize(np.ascontiguousarray(square[: encoded.scaled[0], : encoded.scaled[1]]), size)


class Crop(NamedTuple):
    """A part of the frame in px, half open."""

    left: int
    top: int
    right: int
    bottom: int
    layer: int
    """0: the whole frame; k: one of 4^k crops"""

    @property
    def area(self) -> int:
        """Area in px^2."""
        return (self.right - self.left) * (self.bottom - self.top)


class _Candidate(NamedTuple):
    """A predicted mask on its way through the filters."""

    bits: np.ndarray
    """the frame's pixels, packed"""
    box: tuple[int, int, int, int]
    iou: float
    """as the model predicts it"""
    stability: float
    token: int
    crop: Crop


@dataclasses.dataclass(frozen=True)
class SamSettings:
    """Settings of the mask generator. The defaults are LangSplat's (preprocess.py), except for the prompts."""

    level: Level = "l"
    """Level of the masks that a call returns."""
    prompts: Prompts = "guided"
    """Where the points are: "guided", in regions by colour and in what their masks leave unexplained (`GuidedPrompts`),
    or "grid", SAM's own."""
    points_per_side: int = 32
    """Points along each side of the grid of a crop."""
    predicted_iou: float = 0.7
    """A mask must be predicted to be better than this."""
    stability: float = 0.85
    """Least IoU of the masks at logits of +- `stability_offset`."""
    stability_offset: float = 1.0
    """Offset in logits."""
    box_iou: float = 0.7
    """Boxes with a higher IoU repeat each other."""
    crop_layers: int = 1
    """Layers of 4^k crops beside the whole frame. A frame takes 1 + 4 + ... 4^layers runs of the encoder and as many
    grids of prompts: without crops a fifth of LangSplat's time."""
    crop_overlap: float = 512 / 1500
    """Overlap of neighbouring crops, as a share of the frame's shorter side."""
    least_area: int = 100
    """px; smaller holes are filled, smaller islands removed."""
    mask_iou: float = 0.8
    """As in `langsplat_nms`."""
    mask_score: float = 0.7
    """As in `langsplat_nms`."""
    mask_inner: float = 0.5
    """As in `langsplat_nms`."""


class SamSegmenter:
    """Segmenter (jsecon.vision.protocols) that runs a SAM model.

    The graphs are opened when first needed and stay open until `close`.

    Args:
      model: The model folder, or its files.
      settings: Settings of the mask generator.
      batch: Number of prompts of one run, as for `SamGraphs`.
      threads: Number of cores of one run, as for `Graph`.

    Attributes:
      name: Follows from the content of the files and the settings.

    Raises:
      InputError: The folder holds no SAM model. Methods raise it if a graph has other tensors than SAM.
    """

    def __init__(
        self,
        model: str | Path | SamFiles,
        settings: SamSettings | None = None,
        *,
        batch: int = BATCH,
        threads: int | None = None,
    ):
        self.files = model if isinstance(model, SamFiles) else find_sam(model)
        self.settings = settings or SamSettings()
        graphs = [*graph_files(self.files.encoder), *graph_files(self.files.decoder)]
        extra = repr(self.settings) if self.files.colours is None else f"{self.settings}{self.files.colours}"
        self.name = f"sam-{content_digest(graphs, extra=extra)}"
        self._batch = batch
        self._threads = threads

    def __call__(self, frame: UInt8[np.ndarray, "h w 3"], index: int) -> Bool[np.ndarray, "m h w"]:
        """Segments a frame.

        Args:
          frame: (H, W, 3) RGB.
          index: Index of the frame; not used.

        Returns:
          (M, H, W) masks of the level, best score first; they may overlap.
        """
        level = self.settings.level
        return self.levels(frame, (level,))[level][0]

    def levels(
        self, frame: UInt8[np.ndarray, "h w 3"], levels: Sequence[Level] = ("default", "s", "m", "l")
    ) -> dict[str, tuple[Bool[np.ndarray, "m h w"], Float64[np.ndarray, " m"]]]:
        """Segments a frame at several levels, with one run of the prompts.

        Args:
          frame: (H, W, 3) RGB.
          levels: The levels.

        Returns:
          Masks (M, H, W) and scores (M,), stability times predicted IoU, of each level, best first.
        """
        tokens = sorted({token for level in levels for token in TOKENS[level]})
        height, width = frame.shape[:2]
        crops = crops_of(height, width, self.settings.crop_layers, self.settings.crop_overlap)
        by_crop = [list(self._candidates(frame, crop, tokens)) for crop in crops]
        return {level: self._filtered((height, width), by_crop, TOKENS[level]) for level in levels}

    def check(self) -> None:
        """Opens and closes the graphs.

        Raises:
          InputError: A graph is damaged, or not a SAM model's.
        """
        _ = self._graphs
        self.close()

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        self.__dict__.pop("_graphs", None)

    @functools.cached_property
    def _graphs(self) -> SamGraphs:
        return SamGraphs(self.files, batch=self._batch, threads=self._threads)

    def _candidates(self, frame: np.ndarray, crop: Crop, tokens: Sequence[int]) -> Iterable[_Candidate]:
        """Yields the masks of one crop that are good, stable and not cut off, in the order of the points."""
        part = np.ascontiguousarray(frame[crop.top : crop.bottom, crop.left : crop.right])
        encoded = self._graphs.encode(part)
        if self.settings.prompts == "grid":
            points = point_grid(self.settings.points_per_side) * np.array([part.shape[1], part.shape[0]], np.float32)
            yield from (candidate for _, candidate in self._predicted(frame, crop, encoded, points, tokens))
            return
        prompts = GuidedPrompts(part, len(tokens))
        while len(points := prompts.next_points()):
            for number, candidate in self._predicted(frame, crop, encoded, points, tokens):
                mask = np.unpackbits(candidate.bits, count=frame[..., 0].size).reshape(frame.shape[:2]).astype(bool)
                shown = mask[crop.top : crop.bottom, crop.left : crop.right]
                prompts.explain(tokens.index(candidate.token), points[number], shown)
                yield candidate

    def _predicted(
        self, frame: np.ndarray, crop: Crop, encoded: EncodedFrame, points: np.ndarray, tokens: Sequence[int]
    ) -> Iterator[tuple[int, _Candidate]]:
        """Yields the masks of points (P, 2) in px of a crop, each with the number of its point."""
        height, width = frame.shape[:2]
        start = 0
        for logits, ious in self._graphs.decode(encoded, points):
            for prompt, token in zip(*np.nonzero(ious > self.settings.predicted_iou)):
                if token not in tokens:
                    continue
                mask_logits = self._graphs.to_frame(logits[prompt, token], encoded)
                steady = stability(mask_logits, self.settings.stability_offset)
                if steady < self.settings.stability:
                    continue
                mask = np.zeros((height, width), bool)
                mask[crop.top : crop.bottom, crop.left : crop.right] = mask_logits > 0
                box = box_of(mask)
                if mask.any() and not cut_by_crop(box, crop, width, height):
                    iou = float(ious[prompt, token])
                    yield start + prompt, _Candidate(np.packbits(mask), box, iou, steady, int(token), crop)
            start += len(ious)

    def _filtered(
        self, size: tuple[int, int], by_crop: list[list[_Candidate]], tokens: tuple[int, ...]
    ) -> tuple[Bool[np.ndarray, "m h w"], Float64[np.ndarray, " m"]]:
        """Filters the candidates of some tokens; returns masks and scores."""
        settings = self.settings
        left: list[_Candidate] = []
        for candidates in by_crop:
            mine = [c for c in candidates if c.token in tokens]
            left += [mine[i] for i in box_nms(_boxes(mine), np.asarray([c.iou for c in mine]), settings.box_iou)]
        # Of what several crops show, the smaller crop's is the finer; with one crop this changes nothing.
        fineness = np.asarray([1.0 / c.crop.area for c in left])
        left = [left[i] for i in box_nms(_boxes(left), fineness, settings.box_iou)]
        masks, changed = np.zeros((len(left), *size), bool), np.zeros(len(left), bool)
        for n, candidate in enumerate(left):
            mask = np.unpackbits(candidate.bits, count=size[0] * size[1]).reshape(size).astype(bool)
            masks[n], changed[n] = remove_small_regions(mask, settings.least_area)
        boxes = np.asarray([box_of(mask) for mask in masks], np.float64).reshape(-1, 4)
        kept = np.sort(box_nms(boxes, 1.0 - changed, settings.box_iou))
        masks = masks[kept]
        scores = np.asarray([left[i].iou * left[i].stability for i in kept], np.float64)
        kept = langsplat_nms(
            masks,
            scores,
            iou_threshold=settings.mask_iou,
            score_threshold=settings.mask_score,
            inner_threshold=settings.mask_inner,
        )
        return masks[kept], scores[kept]


def _boxes(candidates: list[_Candidate]) -> Float64[np.ndarray, "m 4"]:
    return np.asarray([c.box for c in candidates], np.float64).reshape(-1, 4)


def point_grid(side: int) -> Float32[np.ndarray, "p 2"]:
    """Makes SAM's grid of points.

    Args:
      side: Points a side, at least 1.

    Returns:
      (side^2, 2) x, y in 0..1, the centres of side x side cells, x fastest.

    Raises:
      ValueError: side is below 1.
    """
    require(side >= 1, "side", side, "at least 1", "SAM's default is 32.")
    line = np.linspace(1 / (2 * side), 1 - 1 / (2 * side), side)
    return np.stack(np.meshgrid(line, line), -1).reshape(-1, 2).astype(np.float32)


def crops_of(height: int, width: int, layers: int, overlap: float) -> list[Crop]:
    """Cuts a frame into crops: 2^k x 2^k in layer k.

    Args:
      height: px of the frame.
      width: px of the frame.
      layers: Number of layers of crops.
      overlap: Neighbours overlap by this share of the frame's shorter side, times 2 / 2^k.

    Returns:
      The whole frame, then the crops layer by layer, column by column.
    """
    crops = [Crop(0, 0, width, height, 0)]
    for layer in range(1, layers + 1):
        number = 2**layer
        common = int(overlap * min(height, width) * 2 / number)
        long = [math.ceil((common * (number - 1) + length) / number) for length in (width, height)]
        starts = [[(size - common) * i for i in range(number)] for size in long]
        for left, top in itertools.product(*starts):
            crops.append(Crop(left, top, min(left + long[0], width), min(top + long[1], height), layer))
    return crops


def langsplat_nms(
    masks: Bool[np.ndarray, "m h w"],
    scores: Float[np.ndarray, " _"],
    *,
    iou_threshold: float = 0.8,
    score_threshold: float = 0.7,
    inner_threshold: float = 0.5,
) -> Int64[np.ndarray, " k"]:
    """LangSplat's suppression of masks by masks.

    A mask is kept if its score is high enough, no better mask repeats it, and it lies inside of no other: at least 0.85
    of it in a mask of which that is less than half, with 1 - (share of it) * (share of the other) above
    1 - `inner_threshold`. A mask that is itself dropped still suppresses. Of equal scores the earlier counts as better.
    Empty masks are dropped.

    Args:
      masks: (M, H, W).
      scores: (M,), stability times predicted IoU.
      iou_threshold: A mask with a higher IoU with a better one is dropped.
      score_threshold: A mask needs a higher score.
      inner_threshold: Share for masks inside of others.

    Returns:
      (K,) indices of the masks that are kept, best score first.

    Raises:
      ValueError: The numbers of masks and scores differ.
    """
    require(len(scores) == len(masks), "scores", len(scores), str(len(masks)), "One score per mask.")
    order = np.argsort(-scores, kind="stable")
    shared = shared_areas(masks[order])
    area = np.diagonal(shared)
    union = area[:, None] + area[None, :] - shared
    overlap = np.triu(shared / np.maximum(union, 1.0), k=1)
    share = shared / np.maximum(area[:, None], 1.0)  # [i, j]: share of mask i that lies in mask j
    inside = (share.T >= 0.85) & (share < 0.5)  # [i, j]: j lies in i, and is less than half of it
    inner = np.where(inside, 1.0 - share * share.T, 0.0)
    kept = (
        (overlap.max(0, initial=0.0) <= iou_threshold)
        & (scores[order] > score_threshold)
        & (inner.max(0, initial=0.0) <= 1.0 - inner_threshold)
        & (area > 0)
    )
    return order[kept]


def shared_areas(masks: Bool[np.ndarray, "m h w"]) -> Float64[np.ndarray, "m m"]:
    """Counts the pixels that any two masks share.

    Args:
      masks: (M, H, W) bool.

    Returns:
      (M, M) numbers of pixels; the diagonal has the areas.
    """
    flat = masks.reshape(len(masks), masks.shape[1] * masks.shape[2])
    columns = np.flatnonzero(flat) % max(flat.shape[1], 1)
    ends = np.concatenate([[0], np.cumsum(np.count_nonzero(flat, axis=1))])
    rows = sparse.csr_matrix((np.ones(len(columns), np.int32), columns, ends), shape=flat.shape)
    return (rows @ rows.T).toarray().astype(np.float64)


def stability(logits: Float[np.ndarray, "h w"], offset: float) -> float:
    """Compares the masks of logits at two thresholds.

    Args:
      logits: (H, W).
      offset: The thresholds are +offset and -offset.

    Returns:
      IoU of the two masks; 0 if the wider one is empty.
    """
    wide = int(np.count_nonzero(logits > -offset))
    return int(np.count_nonzero(logits > offset)) / wide if wide else 0.0


def box_of(mask: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """Finds the outermost pixels of a mask.

    Args:
      mask: (H, W) bool.

    Returns:
      (left, top, right, bottom), all within the mask; zeros if it is empty.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])) if len(rows) else (0, 0, 0, 0)


def cut_by_crop(box: tuple[int, int, int, int], crop: Crop, width: int, height: int) -> bool:
    """Whether the edge of a crop probably cuts off a thing.

    Args:
      box: (left, top, right, bottom) of its mask, px of the frame.
      crop: The crop.
      width: px of the frame.
      height: px of the frame.

    Returns:
      True if the box lies within EDGE of an edge of the crop that is no edge of the frame.
    """
    pairs = zip(box, (crop.left, crop.top, crop.right, crop.bottom), (0, 0, width, height))
    return any(abs(side - edge) <= EDGE and abs(side - frame) > EDGE for side, edge, frame in pairs)


def box_nms(
    boxes: Float[np.ndarray, "m 4"], scores: Float[np.ndarray, " m"], threshold: float
) -> Int64[np.ndarray, " k"]:
    """Non-maximum suppression of boxes.

    Areas are (right - left) * (bottom - top) of the coordinates as they are; a box without area overlaps no other. Of
    equal scores the earlier goes first.

    Args:
      boxes: (M, 4) left, top, right, bottom.
      scores: (M,).
      threshold: A box with a higher IoU with a better one is dropped.

    Returns:
      (K,) indices of the boxes that are kept, best score first.
    """
    order = np.argsort(-scores, kind="stable")
    boxes = boxes[order].astype(np.float64)
    area = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    alive = np.ones(len(boxes), bool)
    kept = []
    for i in range(len(boxes)):
        if alive[i]:
            kept.append(order[i])
            later = boxes[i + 1 :]
            sides = np.minimum(boxes[i, 2:], later[:, 2:]) - np.maximum(boxes[i, :2], later[:, :2])
            common = np.prod(np.maximum(sides, 0.0), axis=1)
            alive[i + 1 :] &= common <= threshold * (area[i] + area[i + 1 :] - common)
    return np.asarray(kept, np.int64)


def remove_small_regions(mask: Bool[np.ndarray, "h w"], least: int) -> tuple[Bool[np.ndarray, "h w"], bool]:
    """Fills small holes of a mask, then removes small islands (8-connected).

    Args:
      mask: (H, W) bool.
      least: Pixels from which a hole or island is not small.

    Returns:
      The mask (H, W), and whether it changed. If every island is small, the largest stays.
    """
    holes, areas = _components(~mask)
    small = np.flatnonzero(areas < least)
    filled = mask | np.isin(holes, small + 1) if len(small) else mask
    islands, areas = _components(filled)
    kept = np.flatnonzero(areas >= least)
    if len(areas) and not len(kept):
        kept = np.array([areas.argmax()])
    clean = np.isin(islands, kept + 1) if len(kept) < len(areas) else filled
    return clean, bool(len(small)) or len(kept) < len(areas)


def _components(mask: Bool[np.ndarray, "h w"]) -> tuple[np.ndarray, Float64[np.ndarray, " n"]]:
    """Labels (H, W), 0 outside, 1.. for the N components, and their areas."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    return labels, stats[1:, cv2.CC_STAT_AREA].astype(np.float64)
