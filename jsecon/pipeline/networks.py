"""What looks at the frames: OpenCV and colours without any weights, or SAM, SAM 2 and CLIP from model folders.

Networks are opened when first needed and closed when their stage is done: their memory would stay otherwise.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import numpy as np

from jsecon.errors import InputError
from jsecon.pipeline.options import Options
from jsecon.pipeline.sources import locate_sources
from jsecon.types import LanguageField
from jsecon.vision.protocols import Embedder, Networks
from jsecon.vision.stores import StoredSegmenter

_NAME = "given-"


class ExternalSpace:
    """Embedder (jsecon.vision.protocols) of a space of `dim` numbers that no model here knows: it has no texts and no
    canonical phrases, and embeds nothing. Its regions can be asked for by a pixel."""

    def __init__(self, dim: int):
        self.dim, self.name = dim, f"{_NAME}{dim}"
        self.canonical = self.reference = np.zeros((0, dim), np.float32)

    def embed_regions(self, frame: np.ndarray, masks: np.ndarray) -> NoReturn:
        """Raises InputError."""
        raise missing_model(self.dim)

    def embed_text(self, texts: list[str]) -> NoReturn:
        """Raises InputError."""
        raise missing_model(self.dim)


def external_dim(name: str | None) -> int | None:
    """How many numbers an embedding has in the given space of this name; None for every other space."""
    return int(name.removeprefix(_NAME)) if name is not None and name.startswith(_NAME) else None


def missing_model(dim: int) -> InputError:
    """That the model of a given space is needed."""
    remedy = "Give its folder: --embedder DIR. Without it, ask by a pixel (--at)."
    found = f"regions whose embeddings came from files, {dim} numbers each"
    return InputError("field", found, "the CLIP model that made them", remedy)


def open_networks(options: Options, store: Path) -> Networks:
    """SAM, SAM 2 and CLIP where the options name their folders; what they find is kept under `store`.

    Raises InputError where a folder holds no such model.
    """
    segmenter = tracker = None
    if options.segmenter is not None:
        from jsecon.networks.sam import SamSegmenter, SamSettings

        level, side, layers = options.level, options.points_per_side, options.crop_layers
        settings = SamSettings(level=level, points_per_side=side, crop_layers=layers)
        segmenter = StoredSegmenter(SamSegmenter(options.segmenter, settings), store / "proposals")
    if options.tracker is not None:
        from jsecon.networks.sam2 import Sam2Tracker

        tracker = Sam2Tracker(options.tracker)
    given = None
    if options.features is not None:
        from jsecon.data.langsplat import embedding_size

        given = ExternalSpace(embedding_size(options.features))
        if options.embedder is None:
            return Networks(given, segmenter, tracker)
    name = None if given is None else given.name
    return Networks(open_embedder(name, folder=options.embedder, store=store / "embeddings"), segmenter, tracker)


def open_embedder(
    name: str | None = None,
    *,
    folder: Path | None = None,
    templates: Sequence[str] = ("{}",),
    store: Path | None = None,
) -> Embedder:
    """The embedder whose space is called `name` (None: any): CLIP where its folder is given, else colours. In a given
    space (`ExternalSpace`) only CLIP knows texts, and any will do whose embeddings have as many numbers.

    `templates` are phrases for CLIP to put texts into. Raises InputError where the folder holds no CLIP model, or the
    embedder found is of another space.
    """
    dim = external_dim(name)
    if dim is not None and folder is None:
        raise missing_model(dim)
    if folder is not None:
        from jsecon.networks.clip import ClipEmbedder

        # pyright compares a cached_property with a protocol's attribute without reading it.
        found: Embedder = ClipEmbedder(folder, templates=templates, store=store)  # pyright: ignore[reportAssignmentType]
        remedy = "Give the folder of the model that the field was made with: --embedder DIR."
    else:
        from jsecon.vision.colours import ColourEmbedder

        found = ColourEmbedder()
        remedy = "Run the capture again with this version."
        if name is not None and name.startswith("clip-"):
            remedy = "Give the folder of the model that the field was made with (--embedder DIR), or run again without."
        elif tuple(templates) != ("{}",):
            there = "a field whose texts are colours"
            raise InputError("--template", there, "one made with CLIP", "Leave out --template.")
    if dim is not None and found.dim != dim:
        there, wanted = f"a model whose embeddings have {found.dim} numbers", f"{dim}, as those from files have"
        raise InputError("--embedder", there, wanted, "Give the CLIP model that made the files.")
    if dim is None and name not in (None, found.name):
        raise InputError("field", f"regions embedded by {name!r}", f"{found.name!r}", remedy)
    return found


def field_embedder(field: LanguageField, folder: Path | None = None, *, templates: Sequence[str] = ("{}",)) -> Embedder:
    """The embedder that a field's regions live with: from `folder`, else from where the run had it, if the same model
    is still there (`locate_sources`). Raises InputError where it cannot be had."""
    if folder is None:
        sources = locate_sources(field)
        folder = sources.model if sources.model is not None and _holds(sources.model, sources.embedder) else None
    return open_embedder(field.embedder, folder=folder, templates=templates)


def _holds(folder: Path, name: str | None) -> bool:
    """Whether a folder holds the CLIP model of this name, which follows from the content of its files."""
    from jsecon.networks.clip import clip_name, find_clip

    try:
        return clip_name(find_clip(folder)) == name
    except InputError:  # another thing lies there now: the model is as good as gone
        return False
