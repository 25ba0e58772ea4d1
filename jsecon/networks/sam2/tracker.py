"""SAM 2 as a tracker: prompts in one frame, masks in all, forward and then backward (facebookresearch/sam2).

Frames are read one at a time, in the order of tracking; each is encoded once for all objects, and each object is then
tracked by itself. What is held is bounded whatever the length of the sequence: the features of a few frames, and for
each object the memories that a frame to come can reach.
"""

import functools
import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from jsecon.errors import require
from jsecon.networks.sam2 import heads
from jsecon.networks.sam2.bank import Bank, Memory, forget
from jsecon.networks.sam2.graphs import Sam2Graphs, open_sam2, sam2_digest
from jsecon.networks.sam2.heads import Features, Prediction, Prompt


class Sam2Tracker:
    """A Tracker (see protocols.py) over the SAM 2 model of a folder (see sam2_graphs.py).

    Holes of at most `hole_area` pixels of the low-resolution mask are
    filled. The features of the last `keep` frames are held, about 16 MiB each at 1024 px, for calls on the same frames.
    `threads` bounds the cores. A pixel that several objects claim goes to the one with the highest logit.

    Graphs are opened when first needed and kept until `close`; `name` follows from their content and the settings.
    Raises InputError where a file of a SAM 2 model is missing in the folder, and later where one does not fit the rest.
    """

    def __init__(self, folder: Path, *, hole_area: int = 8, keep: int = 16, threads: int | None = None):
        self.name = f"sam2-{sam2_digest(folder, extra=repr(hole_area))}"
        self.hole_area = hole_area
        self._folder, self._keep, self._threads = folder, keep, threads

    @functools.cached_property
    def sam2(self) -> Sam2Graphs:
        """The networks."""
        return open_sam2(self._folder, threads=self._threads)

    @functools.cached_property
    def _encode(self) -> "FrameEncoder":
        return FrameEncoder(self.sam2, keep=self._keep)

    def check(self) -> None:
        """Raises InputError where the folder's files do not make one SAM 2 model."""
        open_sam2(self._folder, threads=self._threads)

    def close(self) -> None:
        """Drops the graphs, the features kept and their memory; they are made again when needed."""
        self.__dict__.pop("_encode", None)
        self.__dict__.pop("sam2", None)

    def __call__(self, frames: np.ndarray, index: int, prompts: np.ndarray) -> np.ndarray:
        """frames (T, H, W, 3) uint8, frame `index`, its masks `prompts` (B, H, W) bool -> labels (T, H, W) int16."""
        height, width = frames.shape[1:3]
        fits = prompts.ndim == 3 and prompts.shape[1:] == (height, width) and 0 <= index < len(frames)
        expected = f"(B, {height}, {width}) and a frame below {len(frames)}"
        require(fits, "Sam2Tracker", (prompts.shape, index), expected, "Give masks of the frames' own size.")
        labels = np.full(frames.shape[:3], -1, np.int16)
        given = [b for b, mask in enumerate(prompts) if mask.any()]
        if not given:
            return labels
        numbers = np.array([*given, -1], np.int16)
        asked, area = [[Prompt(index, prompts[b])] for b in given], self.hole_area
        for t, logits in follow(self.sam2, frames, asked, start=index, hole_area=area, encode=self._encode):
            labels[t] = numbers[strongest(logits, (height, width))]
        return labels


class FrameEncoder:
    """features of a frame (H, W, 3), remembered by its pixels for the last `keep` frames."""

    def __init__(self, sam2: Sam2Graphs, *, keep: int = 1):
        self._sam2, self._keep = sam2, max(keep, 1)
        self._known: OrderedDict[bytes, Features] = OrderedDict()

    def __call__(self, frame: np.ndarray) -> Features:
        key = hashlib.blake2b(np.ascontiguousarray(frame).data, digest_size=16).digest() + repr(frame.shape).encode()
        if key not in self._known:
            self._known[key] = heads.image_features(self._sam2, frame)
        self._known.move_to_end(key)
        while len(self._known) > self._keep:
            self._known.popitem(last=False)
        return self._known[key]


def strongest(logits: Sequence[np.ndarray], size: tuple[int, int]) -> np.ndarray:
    """(H, W) int16: which of the objects' logits (L, L) is highest at a pixel of `size`, -1 where none is above 0."""
    best, label = np.zeros(size, np.float32), np.full(size, -1, np.int16)
    for number, low in enumerate(logits):
        whole = at_size(low, size)
        above = whole > best
        best[above], label[above] = whole[above], number
    return label


def at_size(logits: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """logits (L, L) -> (H, W), bilinear."""
    return cv2.resize(logits, size[::-1], interpolation=cv2.INTER_LINEAR)


def follow(
    sam2: Sam2Graphs,
    frames: np.ndarray,
    prompts: Sequence[Sequence[Prompt]],
    *,
    start: int | None = None,
    hole_area: int = 8,
    encode: FrameEncoder | None = None,
) -> Iterator[tuple[int, list[np.ndarray]]]:
    """Yields (t, logits (L, L) of each object) for every frame: from `start` to the last, then back to the first.

    frames (T, H, W, 3) uint8, anything that is indexed by frame and has a shape (a memory map, say). `prompts` holds
    for each object its prompts, at most one a frame, in any frames; `start` (default: the earliest prompted frame) is
    where tracking begins. As in the official predictor, the backward pass attends to what the forward pass remembered
    of the frames just beyond `start`, and an object is also tracked in frames before its first prompt.
    """
    count, size = len(frames), (int(frames.shape[1]), int(frames.shape[2]))
    encode = encode or FrameEncoder(sam2)
    asked = sorted({prompt.frame for own in prompts for prompt in own})
    fits = bool(asked) and asked[0] >= 0 and asked[-1] < count and all(prompts)
    got, expected = f"prompts of {len(prompts)} objects at {asked}", f"one at least for each, at frames below {count}"
    require(fits, "follow", got, expected, "Leave out objects without prompts.")
    banks, known = _prompted_banks(sam2, frames, prompts, asked, size, hole_area, encode)
    start = asked[0] if start is None else start
    standing = heads.standing(sam2, encode(frames[asked[-1]]))
    for step, order in ((1, range(start, count)), (-1, range(start - 1, -1, -1))):
        turn = start if step == 1 and start > 0 else None
        for t in order:
            features, logits = encode(frames[t]), []
            for number, bank in enumerate(banks):
                if (number, t) in known:
                    logits.append(known[number, t])
                    continue
                found = heads.tracked(sam2, features, bank, t, step=step, count=count, standing=standing)
                spatial = heads.spatial_memory(sam2, features, found, given=False)
                remembered = bank.with_tracked(t, Memory(spatial, found.pointer))
                banks[number] = forget(remembered, t, step, slots=sam2.sizes["N"], turn=turn)
                logits.append(heads.fill_holes(found.logits, hole_area))
            yield t, logits


def _prompted_banks(
    sam2: Sam2Graphs,
    frames: np.ndarray,
    prompts: Sequence[Sequence[Prompt]],
    asked: Sequence[int],
    size: tuple[int, int],
    hole_area: int,
    encode: FrameEncoder,
) -> tuple[list[Bank], dict[tuple[int, int], np.ndarray]]:
    """Each object's bank with its conditioning frames, and its logits there by (object, frame)."""
    conditioning: list[dict[int, Memory]] = [{} for _ in prompts]
    known = {}
    for t in asked:
        features = encode(frames[t])
        for number, own in enumerate(prompts):
            for prompt in (p for p in own if p.frame == t):
                found = heads.prompted(sam2, features, prompt, size)
                found = Prediction(heads.fill_holes(found.logits, hole_area), found.pointer, found.score)
                spatial = heads.spatial_memory(sam2, features, found, given=True)
                conditioning[number][t] = Memory(spatial, found.pointer)
                known[number, t] = found.logits
    return [Bank(own) for own in conditioning], known
