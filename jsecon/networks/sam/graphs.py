"""SAM's image encoder and mask decoder as ONNX graphs: found in a folder, their signatures read, run on a frame.

Four dialects of decoder are known, told apart by the names of their inputs:
    segment-anything   point_coords (B, P, 2), point_labels (B, P) -> iou_predictions, low_res_masks. B is 1 in the
                       project's own export (one call per point), or free in one that takes a batch of prompts.
    transformers.js    input_points (1, B, P, 2), input_labels (1, B, P) -> iou_scores, pred_masks
    SAM 2 on images    as the first, with high_res_feats_0 and _1 of the encoder; the frame is stretched to a square
    SAM 2.1, SAM 3     as the second, with image_embeddings.0, .1 and .2 of the encoder, and input_boxes (1, 0, 4); the
                       frame is stretched, and preprocessor_config.json says how its colours are scaled
Masks are taken at the decoder's own resolution and brought to the frame's size here.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from jsecon.errors import InputError
from jsecon.networks.clip_folder import read_preprocessing
from jsecon.networks.onnx_graph import Graph, Tensor, batches, content_digest, describe, graph_files

MEAN, STD = MEAN_STD = np.array([[123.675, 116.28, 103.53], [58.395, 57.12, 57.375]], np.float32)
"""of RGB in 0..255"""
IMAGE_SIDE = 1024
"""px of the encoder's square image, where its file does not fix it"""
MASK_SIDE = 256
"""px of a mask prompt, where the file does not fix it"""
ENCODERS = ("vision_encoder.onnx", "image_encoder.onnx", "encoder.onnx")
DECODERS = ("prompt_encoder_mask_decoder.onnx", "mask_decoder.onnx", "decoder.onnx")
PUBLISHED = (
    "SAM folders are published on huggingface.co: Xenova/sam-vit-base, Xenova/slimsam-77-uniform (a batch of prompts a "
    "call), onnx-community/sam2.1-hiera-tiny-ONNX, onnx-community/sam3-tracker-ONNX; vietanhdev/samexporter and "
    "segment-anything's scripts/export_onnx_model.py write one prompt per call."
)


@dataclasses.dataclass(frozen=True)
class Dialect:
    """How one kind of decoder calls its tensors."""

    name: str
    coords: str
    labels: str
    scores: str
    masks: str
    nested: bool = False
    """the batch of prompts is the second axis, behind one of size 1."""
    padded: bool = False
    """a prompt without a box must end in a point of label -1."""
    stretched: bool = False
    """the frame is stretched to a square, instead of scaled by its longer side and padded."""
    configured: bool = False
    """the folder must say how colours are scaled: SAM 2.1 takes them as SAM does, SAM 3 does not."""


OWN = Dialect("segment-anything", "point_coords", "point_labels", "iou_predictions", "low_res_masks", padded=True)
HUB = Dialect("transformers.js", "input_points", "input_labels", "iou_scores", "pred_masks", nested=True)
SECOND = Dialect("SAM 2 on images", "point_coords", "point_labels", "iou_predictions", "masks", stretched=True)
HUB_SECOND = dataclasses.replace(HUB, name="SAM 2.1 and SAM 3 for transformers.js", stretched=True, configured=True)
CONFIG = "preprocessor_config.json"


@dataclasses.dataclass(frozen=True)
class SamFiles:
    """The two graphs of a SAM model, and how it takes colours."""

    encoder: Path
    decoder: Path
    colours: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """mean and std of RGB in 0..1, where preprocessor_config.json has others than SAM."""
    configured: bool = False
    """whether there was such a file."""
    side: int | None = None
    """px of the square image by that file."""

    def digest(self, *, extra: str = "") -> str:
        """32 hex digits of the files' contents, of the colours, and of `extra`."""
        told = extra if self.colours is None else f"{extra}{self.colours}"
        return content_digest([*graph_files(self.encoder), *graph_files(self.decoder)], extra=told)


@dataclasses.dataclass(frozen=True)
class Encoded:
    """A frame as the decoder wants it."""

    features: dict[str, np.ndarray]
    """by the decoder's names."""
    height: int
    width: int
    scaled_height: int
    """px of the frame within the encoder's square."""
    scaled_width: int


def find_sam(folder: str | Path) -> SamFiles:
    """The graphs of the SAM model in a folder, or in its `onnx`. Raises InputError naming what was found instead."""
    folder = Path(folder)
    places = [place for place in (folder, folder / "onnx") if place.is_dir()]
    graphs = [path for place in places for path in sorted(place.glob("*.onnx"))]
    decoders = [path for path in graphs if "decoder" in path.name]
    encoders = [path for path in graphs if "encoder" in path.name and path not in decoders]
    encoder, decoder = _one_of(encoders, ENCODERS), _one_of(decoders, DECODERS)
    if encoder is None or decoder is None:
        found = ", ".join(str(path.relative_to(folder)) for path in graphs) or "no .onnx file"
        first = f"an image encoder ({' or '.join(ENCODERS)}, or one *encoder*.onnx)"
        second = f"a mask decoder ({' or '.join(DECODERS)}, or one *decoder*.onnx)"
        raise InputError(folder, found, f"{first} and {second}", PUBLISHED)
    config = folder / CONFIG
    if not config.is_file():
        return SamFiles(encoder, decoder)
    mean, std, side = read_preprocessing(config, whole=True)
    own = np.allclose(np.multiply((mean, std), 255), MEAN_STD, rtol=1e-5)
    return SamFiles(encoder, decoder, None if own else (mean, std), True, side)


def _one_of(paths: list[Path], names: tuple[str, ...]) -> Path | None:
    """The file of one of these names, the first named first; else the only file there is."""
    named = [path for name in names for path in paths if path.name == name]
    return named[0] if named else paths[0] if len(paths) == 1 else None


class SamGraphs:
    """SAM's two graphs, ready to run; `batch` prompts go through the decoder at once where it leaves that free.

    Raises InputError naming the tensor where a graph is of another kind.
    """

    def __init__(self, files: SamFiles, *, batch: int = 64, threads: int | None = None):
        self.files = files
        self._encoder = Graph(files.encoder, threads=threads)
        self._decoder = Graph(files.decoder, threads=threads)
        self._image = self._checked_image()
        self.dialect = self._checked_decoder()
        coords = self._decoder.inputs[self.dialect.coords]
        self._fixed_batch = coords.fixed(1 if self.dialect.nested else 0)
        if "input_boxes" in self._decoder.inputs:  # none of them go with one prompt, not with a batch
            self._fixed_batch = 1
        self.batch = self._fixed_batch or batch
        told = files.side if self.dialect.configured else None
        self.side = (len(self._image.shape or ()) == 4 and self._image.fixed(3)) or told or IMAGE_SIDE
        self._links = self._checked_links()
        colours = MEAN_STD if files.colours is None else np.multiply(files.colours, 255)
        self._mean, self._std = np.asarray(colours, np.float32)

    def _checked_image(self) -> Tensor:
        """The encoder's one input: (1, 3, S, S) normalised, or (H, W, 3) of 0..255."""
        inputs = list(self._encoder.inputs.values())
        if len(inputs) == 1 and (inputs[0].fits((1, 3, None, None)) or inputs[0].fits((None, None, 3))):
            return inputs[0]
        where = f"{self.files.encoder}, input {inputs[0].name if inputs else 'image'!r}"
        expected = "one image, float32[1, 3, S, S] or float32[H, W, 3], as SAM's image encoder has"
        raise InputError(where, describe(inputs), expected, PUBLISHED)

    def _checked_decoder(self) -> Dialect:
        inputs = self._decoder.inputs
        dialect = HUB if HUB.coords in inputs else SECOND if "high_res_feats_0" in inputs else OWN
        if dialect is HUB and "image_embeddings.0" in inputs:
            dialect = HUB_SECOND
        if dialect.configured and not self.files.configured:
            found, remedy = f"a decoder of {dialect.name}", f"Fetch {CONFIG} into the model's folder."
            raise InputError(self.files.decoder, found, f"{CONFIG} in its folder: means and deviations", remedy)
        lead = (1,) if dialect.nested else ()
        what = f"SAM's mask decoder ({dialect.name})"
        self._decoder.require("input", dialect.coords, (*lead, None, None, 2), what)
        self._decoder.require("input", dialect.labels, (*lead, None, None), what)
        self._decoder.require("output", dialect.scores, (*lead, None, None), what)
        masks = self._decoder.require("output", dialect.masks, (*lead, None, None, None, None), what)
        if masks.fixed(-3) not in (None, 3, 4):
            raise self._not_three(masks.name, str(masks))
        return dialect

    def _not_three(self, masks: str, found: str) -> InputError:
        expected = "3 or 4 masks per prompt, from the smallest part to the whole, each with its score"
        remedy = "Export the decoder without --return-single-mask."
        return InputError(f"{self.files.decoder}, output {masks!r}", found, expected, remedy)

    def _checked_links(self) -> dict[str, str]:
        """Decoder input -> encoder output, for all that the decoder takes from the frame."""
        links = {name: name for name in self._decoder.inputs if name in self._encoder.outputs}
        given = ("mask_input", "has_mask_input", "orig_im_size", "input_boxes")
        own = {self.dialect.coords, self.dialect.labels, *given}
        left = [name for name in self._decoder.inputs if name not in links and name not in own]
        maps = [name for name, tensor in self._encoder.outputs.items() if tensor.fits((1, None, None, None))]
        if len(left) == 1 and len(maps) == 1:  # the encoder's only map, whatever its exporter called it
            links[left.pop()] = maps[0]
        for name in left:
            where, given = f"{self.files.decoder}, input {name!r}", describe(self._encoder.outputs.values())
            found = f"no such output of {self.files.encoder.name}, which gives {given}"
            raise InputError(where, found, str(self._decoder.inputs[name]), "Take encoder and decoder from one export.")
        for name, output in links.items():
            needed = self._decoder.inputs[name].shape
            if needed is not None:
                what = f"the encoder that {self.files.decoder.name} belongs to"
                self._encoder.require("output", output, needed, what)
        return links

    def encode(self, frame: UInt8[np.ndarray, "h w 3"]) -> Encoded:
        """frame (H, W, 3) uint8 RGB -> what the decoder needs of it. Resized by Pillow, as SAM was trained: it
        widens the kernel where an image shrinks, and OpenCV does not."""
        height, width = frame.shape[:2]
        scale = self.side / max(height, width)
        size = (int(height * scale + 0.5), int(width * scale + 0.5))
        if self.dialect.stretched:
            size = (self.side, self.side)
        image = np.asarray(Image.fromarray(frame).resize((size[1], size[0]), Image.Resampling.BILINEAR), np.float32)
        if len(self._image.shape or ()) == 4:
            square = np.zeros((self.side, self.side, 3), np.float32)
            square[: size[0], : size[1]] = (image - self._mean) / self._std
            image = square.transpose(2, 0, 1)[None]
        found = self._encoder.run({self._image.name: image}, sorted(set(self._links.values())))
        return Encoded({name: found[output] for name, output in self._links.items()}, height, width, *size)

    def decode(
        self, encoded: Encoded, points: Float32[np.ndarray, "p 2"]
    ) -> Iterator[tuple[Float32[np.ndarray, "b 3 l l"], Float32[np.ndarray, "b 3"]]]:
        """P points (x, y) in px of the frame -> batch by batch, three mask logits (B, 3, L, L), from part to whole, and
        their predicted IoUs (B, 3)."""
        scale = np.array([encoded.scaled_width / encoded.width, encoded.scaled_height / encoded.height], np.float32)
        names, lead = [self.dialect.masks, self.dialect.scores], int(self.dialect.nested)
        for part, count in batches(points * scale, self._fixed_batch, self.batch):
            found = self._decoder.run(encoded.features | self._prompts(part), names)
            masks, scores = (found[name].reshape(found[name].shape[lead:])[:count] for name in names)
            if masks.shape[:2] != scores.shape or masks.shape[1] not in (3, 4):
                raise self._not_three(names[0], f"{list(masks.shape)} with scores {list(scores.shape)}")
            # of 4, the first is the single one
            yield masks[:, -3:].astype(np.float32), scores[:, -3:].astype(np.float32)

    def _prompts(self, points: Float32[np.ndarray, "b 2"]) -> dict[str, np.ndarray]:
        count, dialect = len(points), self.dialect
        coords, labels = points[:, None], np.ones((count, 1), np.float32)
        if dialect.padded:
            coords = np.concatenate([coords, np.zeros_like(coords)], axis=1)
            labels = np.concatenate([labels, -labels], axis=1)
        if self._decoder.inputs[dialect.labels].dtype.startswith("int"):
            labels = labels.astype(np.int64)
        lead = (None,) if dialect.nested else ()
        feeds = {dialect.coords: coords[lead], dialect.labels: labels[lead]}
        if "mask_input" in self._decoder.inputs:
            tensor = self._decoder.inputs["mask_input"]
            side = tensor.fixed(3) or MASK_SIDE
            feeds["mask_input"] = np.zeros((tensor.fixed(0) or count, 1, side, side), np.float32)
        if "has_mask_input" in self._decoder.inputs:
            feeds["has_mask_input"] = np.zeros(self._decoder.inputs["has_mask_input"].fixed(0) or count, np.float32)
        if "input_boxes" in self._decoder.inputs:
            feeds["input_boxes"] = np.zeros((1, 0, 4), np.float32)
        if "orig_im_size" in self._decoder.inputs:  # of the graph's own upscaled masks, which are not used: tiny
            feeds["orig_im_size"] = np.full(2, 8, np.float32)
        return feeds

    def to_frame(self, logits: Float32[np.ndarray, "l l"], encoded: Encoded) -> Float32[np.ndarray, "h w"]:
        """A mask's logits (L, L) at the frame's size, bilinear, through the encoder's square as SAM does it."""
        size = (encoded.width, encoded.height)
        if self.dialect.stretched:
            return cv2.resize(logits, size)
        square = cv2.resize(logits, (self.side, self.side))
        return cv2.resize(np.ascontiguousarray(square[: encoded.scaled_height, : encoded.scaled_width]), size)
