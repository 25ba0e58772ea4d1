"""Tracker by SAM 2.1 or EdgeTAM on ONNX Runtime: masks of one frame are followed through all frames.

The model folder is the public export of five graphs with constants.json (square-zero-labs/sam2.1-tiny-video-onnx,
jax-image-tools/edgetam-video-onnx):
    vision_encoder     a frame -> its features at three scales, the coarsest also as a prompted frame's (feats2_no_mem)
    mask_decoder       features and points -> mask logits, score of the object's presence, object pointer
    memory_encoder     features and mask -> K memory tokens of M numbers
    memory_attention   features and 7 memories with 16 object pointers -> features conditioned on them
    pointer_tpos       distances of the pointers in time -> their temporal codes
The steps are those of the video predictor of facebookresearch/sam2. Two things follow from the export: empty slots of
the memory repeat the newest memory and pointer, and a mask prompt gives its object pointer by its box.

Frames are read one at a time, in the order of tracking. Each is encoded once for all objects, and each object is
tracked by itself. Memory is bounded whatever the length of the sequence.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax.numpy as jnp
import numpy as np
from PIL import Image

from jsecon.errors import InputError
from jsecon.files import read_json, reading
from jsecon.networks.hub import find_files
from jsecon.networks.session import Graph, content_digest
from jsecon.numerics import is_finite_and_bounded

SLOTS = 7
"""memories that a frame attends to, the prompted one among them"""
POINTERS = 16
"""object pointers that a frame attends to, the prompted one among them"""
HOLE_AREA = 8
"""pixels of a low-resolution mask: holes up to this size are filled"""
_FETCH = "Fetch the folder again, all of it from one repository."
_MASK_LOGIT = 10.0
"""logit of a pixel of a mask prompt; its negative outside"""

_OUTPUTS: Mapping[str, tuple[str, ...]] = {
    "vision_encoder": ("feats0", "feats1", "feats2", "feats2_no_mem", "vision_pos_embed"),
    "mask_decoder": ("low_res_mask", "high_res_mask", "object_pointer", "object_score_logits"),
    "memory_encoder": ("memory_tokens", "memory_pos"),
    "memory_attention": ("conditioned_feats",),
    "pointer_tpos": ("pointer_pos",),
}
"""graph -> outputs that are used"""

Features = Mapping[str, np.ndarray]
"""output of the vision encoder for a frame, by name, shared by all objects"""
Points = tuple[np.ndarray, np.ndarray]
"""(P, 2) x, y in px of the frame, and their labels (P,): 1 inside, 0 outside, 2 and 3 the corners of a box (top left,
bottom right)"""


class _Constants(NamedTuple):
    """Content of constants.json."""

    mean: np.ndarray
    """(3,) mean of RGB in 0..1"""
    std: np.ndarray
    """(3,) standard deviation of RGB in 0..1"""
    temporal_code: np.ndarray
    """(SLOTS, M) code of a memory by its distance in frames; the last row is the prompted frame's"""


class _Prediction(NamedTuple):
    """An object in a frame."""

    logits: np.ndarray
    """(L, L) float32 mask logits"""
    high_res: np.ndarray
    """(S, S) float32 mask logits"""
    pointer: np.ndarray
    """(C,) float32 object pointer"""
    score: np.ndarray
    """(1, 1) float32 logit of the object's presence"""


class _Memory(NamedTuple):
    """What a frame adds to the memory of an object."""

    tokens: np.ndarray | None
    """(K, M) bfloat16; None once no frame can reach it"""
    pointer: np.ndarray
    """(C,) float32"""


class _Sam2Graphs:
    """The graphs of one model, with the sizes that they agree on, and the steps of the predictor.

    Args:
      graphs: By name, as in the module's docstring.
      constants: Content of constants.json.
      sizes: Sizes S of the image, G of the grid of the coarsest features, C of their channels, M of a
        memory token.
    """

    def __init__(self, graphs: Mapping[str, Any], constants: _Constants, sizes: Mapping[str, int]):
        self.graphs, self.constants, self.sizes = graphs, constants, sizes
        self._encode = functools.lru_cache(16)(self._encode_bytes)  # about 16 MiB for each frame at 1024 px

    def encode(self, frame: np.ndarray) -> Features:
        """Encodes a frame (H, W, 3), stretched to a square; the last frames are remembered by their content."""
        return self._encode(frame.tobytes(), frame.shape)

    def _encode_bytes(self, content: bytes, shape: tuple[int, ...]) -> Features:
        side = self.sizes["S"]
        frame = Image.fromarray(np.frombuffer(content, np.uint8).reshape(shape))
        small = np.asarray(frame.resize((side, side), Image.Resampling.BICUBIC))
        image = ((small / 255.0).astype(np.float32) - self.constants.mean) / self.constants.std
        outputs = self._run("vision_encoder", pixel_values=image.transpose(2, 0, 1)[None])
        return {name: outputs[name] for name in _OUTPUTS["vision_encoder"]}

    def _run(self, name: str, **feeds: np.ndarray) -> dict[str, np.ndarray]:
        """Runs a graph by name."""
        return self.graphs[name].run(feeds)

    def _prompted(self, features: Features, prompt: np.ndarray | Points, size: tuple[int, int]) -> _Prediction:
        """Predicts the object of a mask or of points in a frame of size (H, W) from that frame alone."""
        side = self.sizes["S"]
        scale = np.array([side / size[1], side / size[0]], np.float32)
        if isinstance(prompt, tuple):
            points, labels = prompt
            return self._decode(features, features["feats2_no_mem"], np.asarray(points, np.float32) * scale, labels)
        rows, columns = np.flatnonzero(prompt.any(1)), np.flatnonzero(prompt.any(0))
        box = np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]], np.float32) * scale
        decoded = self._decode(features, features["feats2_no_mem"], box, np.array([2, 3]))
        inside = _resize(prompt.astype(np.float32), side) >= 0.5
        mask = np.where(inside, _MASK_LOGIT, -_MASK_LOGIT).astype(np.float32)
        score = np.full((1, 1), _MASK_LOGIT, np.float32)
        return _Prediction(_resize(mask, len(decoded.logits)), mask, decoded.pointer, score)

    def _tracked(
        self, features: Features, bank: "_Bank", t: int, step: int, count: int, position: np.ndarray
    ) -> _Prediction:
        """Predicts the object of a bank in frame t of `count`; `position` (K, M) is the spatial code of a memory."""
        memories, pointers = bank.attended(t, step, count)
        width = self.sizes["M"]
        distances = np.array([distance for distance, _ in pointers], np.float32) / max(min(count, POINTERS) - 1, 1)
        ages = self._run("pointer_tpos", normalized_diffs=distances)["pointer_pos"]
        pointer_tokens = np.array([pointer for _, pointer in pointers], np.float32).reshape(-1, width)
        tokens = [np.asarray(array, np.float32) for _, array in memories]
        codes = [position + self.constants.temporal_code[row] for row, _ in memories]
        conditioned = self._run(
            "memory_attention",
            current_vision_features=_as_tokens(features["feats2"]),
            current_vision_position_embeddings=_as_tokens(features["vision_pos_embed"]),
            memory=np.concatenate([*tokens, pointer_tokens])[:, None],
            memory_pos=np.concatenate([*codes, np.repeat(ages, self.sizes["C"] // width, axis=0)])[:, None],
        )["conditioned_feats"]
        return self._decode(features, conditioned, np.zeros((1, 2), np.float32), np.array([-1]))

    def _decode(self, features: Features, image: np.ndarray, points: np.ndarray, labels: np.ndarray) -> _Prediction:
        """Runs the mask decoder with points (P, 2) in px of the square image; it chooses among its masks by itself."""
        outputs = self._run(
            "mask_decoder",
            feats0=features["feats0"],
            feats1=features["feats1"],
            feats2_cond=image,
            input_points=points[None, None],
            input_labels=labels[None, None],
        )
        masks = outputs["low_res_mask"][0, 0], outputs["high_res_mask"][0, 0]
        return _Prediction(*masks, outputs["object_pointer"][0, 0], outputs["object_score_logits"].reshape(1, 1))

    def _memorize(self, features: Features, prediction: _Prediction, *, binarize: bool) -> tuple[_Memory, np.ndarray]:
        """Encodes the memory of an object in a frame, binary if it was prompted there; and returns its spatial code."""
        outputs = self._run(
            "memory_encoder",
            feats2=features["feats2"],
            high_res_mask=prediction.high_res[None, None],
            object_score_logits=prediction.score,
            binarize=np.asarray(binarize, np.float32),
        )
        tokens = outputs["memory_tokens"][:, 0].astype(jnp.bfloat16)
        return _Memory(tokens, prediction.pointer), outputs["memory_pos"][:, 0]


def _as_tokens(grid: np.ndarray) -> np.ndarray:
    """(1, C, G, G) to (G^2, 1, C)."""
    return np.ascontiguousarray(grid.reshape(grid.shape[1], -1).T[:, None])


def _resize(image: np.ndarray, side: int) -> np.ndarray:
    """(H, W) float32 to (side, side), bilinear with a kernel that widens as it shrinks, like PyTorch's antialias."""
    return np.asarray(Image.fromarray(image).resize((side, side), Image.Resampling.BILINEAR))


def _sam2_files(folder: Path) -> dict[str, Path]:
    """Finds the five graphs and constants.json, by the names of the files without their endings."""
    return {path.stem: path for path in find_files(folder, "tracker")}


def _open_sam2(folder: Path) -> _Sam2Graphs:
    """Opens the model in a folder, or raises InputError if its files do not make one model."""
    files = _sam2_files(folder)
    constants = _read_constants(files["constants"])
    graphs = {name: Graph(files[name]) for name in _OUTPUTS}
    encoder, decoder = graphs["vision_encoder"], graphs["mask_decoder"]
    image = encoder.require("input", "pixel_values", (1, 3, None, None), "SAM 2's vision encoder")
    # Sizes are those of inputs: PyTorch's exporter leaves some sizes of the encoder's outputs open.
    features = decoder.require("input", "feats2_cond", (1, None, None, None), "SAM 2's mask decoder")
    side, channels, grid = image.fixed(2), features.fixed(1), features.fixed(2)
    if side is None or channels is None or grid is None:
        expected = "an image and features of fixed sizes"
        raise InputError(decoder.path, f"{image} and {features}", expected, _FETCH)
    for name, outputs in _OUTPUTS.items():
        for output in outputs:
            graphs[name].require("output", output, None, f"SAM 2's {name.replace('_', ' ')}")
    width = constants.temporal_code.shape[1]
    graphs["memory_encoder"].require("output", "memory_tokens", (None, 1, width), "the encoder of these constants")
    return _Sam2Graphs(graphs, constants, {"S": side, "C": channels, "G": grid, "M": width})


def _read_constants(path: Path) -> _Constants:
    expected = f"image_mean, image_std and memory_temporal_positional_encoding of {SLOTS} rows"
    content = read_json(path, expected, _FETCH)
    with reading(path, expected, _FETCH), np.errstate(over="ignore"):  # what overflows is refused below
        names = ("image_mean", "image_std", "memory_temporal_positional_encoding")
        constants = _Constants(*(np.asarray(content[name], np.float32) for name in names))
    shapes = [array.shape for array in constants]
    fits = shapes[:2] == [(3,), (3,)] and len(shapes[2]) == 2 and shapes[2][0] == SLOTS and shapes[2][1] > 0
    if not fits or not is_finite_and_bounded(*constants) or constants.std.min() <= 0:
        raise InputError(path, f"shapes {shapes}, or numbers that are not finite", expected, _FETCH)
    return constants


@dataclasses.dataclass(frozen=True)
class _Bank:
    """The memories of one object."""

    start: int
    """The prompted frame."""
    prompted: _Memory
    """Its memory."""
    tracked: Mapping[int, _Memory] = dataclasses.field(default_factory=dict)
    """Memories of tracked frames that a later frame can still reach, by frame."""

    def attended(
        self, t: int, step: int, count: int
    ) -> tuple[list[tuple[int, np.ndarray]], list[tuple[int, np.ndarray]]]:
        """Lists what frame t attends to, filled up by repeating the newest entry.

        The prompted frame comes first, then the frames before t in the direction of tracking, the nearest first.

        Args:
          t: The frame.
          step: Direction of tracking: 1 forward, -1 backward.
          count: Number of frames of the sequence.

        Returns:
          SLOTS pairs of a row of the temporal code and memory tokens (K, M), and POINTERS pairs of a distance in frames
          and a pointer (C,).
        """
        near = [(d, self.tracked[t - step * d]) for d in range(1, POINTERS) if t - step * d in self.tracked]
        tokens = [(SLOTS - 1, self.prompted.tokens), *((d - 1, memory.tokens) for d, memory in near if d < SLOTS)]
        pointers = [(abs(t - self.start), self.prompted.pointer)]
        pointers += [(d, memory.pointer) for d, memory in near if d < count]
        memories = [(row, array) for row, array in tokens if array is not None]
        newest = min(1, len(memories) - 1), min(1, len(pointers) - 1)
        memories += [memories[newest[0]]] * (SLOTS - len(memories))
        pointers += [pointers[newest[1]]] * (POINTERS - len(pointers))
        return memories, pointers

    def with_tracked(self, t: int, memory: _Memory, step: int) -> "_Bank":
        """Adds the memory of a frame, and drops what no later frame can reach.

        The backward pass begins before the prompted frame and reads what the forward pass left beyond it.
        """
        kept = {}
        for frame, old in {**self.tracked, t: memory}.items():
            distance = (t + step - frame) * step  # from the next frame
            if step == 1 and self.start > 0:
                distance = min(distance, frame - (self.start - 1))
            if distance < POINTERS:
                kept[frame] = old if distance < SLOTS else old._replace(tokens=None)
        return dataclasses.replace(self, tracked=kept)


def follow(
    model: _Sam2Graphs, frames: np.ndarray, start: int, prompts: Sequence[np.ndarray | Points]
) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Follows objects from a prompted frame to the last, then back to the first.

    Args:
      model: The model.
      frames: (T, H, W, 3) uint8, anything that is indexed by frame and has a shape, such as a memory map.
      start: The prompted frame.
      prompts: Mask (H, W) bool or points of each object in that frame.

    Yields:
      A frame index and the mask logits (L, L) of each object, for every frame.
    """
    count = len(frames)
    features = model.encode(frames[start])
    first = [model._prompted(features, prompt, frames.shape[1:3]) for prompt in prompts]
    memories = [model._memorize(features, prediction, binarize=True) for prediction in first]
    banks = [_Bank(start, memory) for memory, _ in memories]
    position = memories[0][1]
    yield start, [prediction.logits for prediction in first]
    for step, order in ((1, range(start + 1, count)), (-1, range(start - 1, -1, -1))):
        for t in order:
            features = model.encode(frames[t])
            logits = []
            for number, bank in enumerate(banks):
                prediction = model._tracked(features, bank, t, step, count, position)
                memory, _ = model._memorize(features, prediction, binarize=False)
                banks[number] = bank.with_tracked(t, memory, step)
                logits.append(prediction.logits)
            yield t, logits


class Sam2Tracker:
    """Tracker (jsecon.vision.protocols) that runs SAM 2.1 or EdgeTAM, or an InputError if a file is no such model's.

    The graphs are opened when first needed and stay open until `close`.

    Attributes:
      name: Follows from the content of the files.
    """

    def __init__(self, folder: Path):
        files = _sam2_files(folder)
        graphs = [files[name] for name in _OUTPUTS]
        self.name = f"sam2-{content_digest(graphs, [files['constants']], extra=repr(HOLE_AREA))}"
        self._folder = folder

    @functools.cached_property
    def _graphs(self) -> _Sam2Graphs:
        return _open_sam2(self._folder)

    def check(self) -> None:
        """Opens and closes the graphs."""
        _open_sam2(self._folder)

    def close(self) -> None:
        """Closes the graphs and frees their memory; they are opened again when needed."""
        self.__dict__.pop("_graphs", None)

    def __call__(self, frames: np.ndarray, index: int, prompts: np.ndarray) -> np.ndarray:
        """Follows objects through all frames.

        Args:
          frames: (T, H, W, 3) uint8 RGB.
          index: Frame of the prompts.
          prompts: (B, H, W) bool masks of B objects in that frame; an empty one is not followed.

        Returns:
          (T, H, W) int16 index of the object, or -1. A pixel of several objects goes to the highest logit.
        """
        height, width = frames.shape[1:3]
        labels = np.full(frames.shape[:3], -1, np.int16)
        objects = [b for b, mask in enumerate(prompts) if mask.any()]
        if not objects:
            return labels
        for t, logits in follow(self._graphs, frames, index, [prompts[b] for b in objects]):
            best = np.zeros((height, width), np.float32)
            for number, low_res in zip(objects, logits):
                resized = cv2.resize(_fill_holes(low_res, HOLE_AREA), (width, height))
                above = resized > best
                best[above], labels[t, above] = resized[above], number
        return labels


def _fill_holes(logits: np.ndarray, area: int) -> np.ndarray:
    """Fills the holes of a mask's logits (8-connected, at or below 0) of up to `area` pixels with 0.1."""
    number, labels, stats, _ = cv2.connectedComponentsWithStats((logits <= 0).astype(np.uint8), connectivity=8)
    small = stats[:, cv2.CC_STAT_AREA] <= area
    small[0] = False  # label 0 is the object itself
    return np.where(small[np.asarray(labels, np.intp)], np.float32(0.1), logits) if number > 1 else logits
