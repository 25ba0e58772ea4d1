"""Opens what looks at the frames: OpenCV and colours without weights, or SAM, SAM 2 and CLIP from model folders.

Networks are opened when first needed and closed when their stage is done, to free their memory.
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

_EXTERNAL = "given-"
"""prefix of the names of external spaces, as fields hold them"""


class ExternalSpace:
    """Embedder (jsecon.vision.protocols) of embeddings from files, whose model is missing.

    It embeds neither texts nor regions; its regions can be queried by a pixel.

    Args:
      dim: Length of an embedding.
    """

    def __init__(self, dim: int):
        self.dim, self.name = dim, f"{_EXTERNAL}{dim}"
        self.canonical = self.reference = np.zeros((0, dim), np.float32)

    def embed_regions(self, frame: np.ndarray, masks: np.ndarray) -> NoReturn:
        """Raises InputError."""
        raise missing_model(self.dim)

    def embed_text(self, texts: list[str]) -> NoReturn:
        """Raises InputError."""
        raise missing_model(self.dim)


def external_dim(name: str | None) -> int | None:
    """Returns the length of an embedding in the external space of this name, or None for any other space."""
    return int(name.removeprefix(_EXTERNAL)) if name is not None and name.startswith(_EXTERNAL) else None


def missing_model(dim: int) -> InputError:
    """Returns the error that the model of an external space is needed."""
    remedy = "Give its folder: --embedder DIR. Without it, ask by a pixel (--at)."
    problem = f"regions whose embeddings came from files, {dim} numbers each"
    return InputError("field", problem, "the CLIP model that made them", remedy)


def open_networks(options: Options, store: Path) -> Networks:
    """Opens SAM, SAM 2 and CLIP if the options name their folders.

    Args:
      options: Options of the run.
      store: Folder that caches proposals and embeddings.

    Raises:
      InputError: A folder holds no such model.
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
    external = None
    if options.features is not None:
        from jsecon.data.langsplat import embedding_size

        external = ExternalSpace(embedding_size(options.features))
        if options.embedder is None:
            return Networks(external, segmenter, tracker)
    name = None if external is None else external.name
    return Networks(open_embedder(name, folder=options.embedder, store=store / "embeddings"), segmenter, tracker)


def open_embedder(
    name: str | None = None,
    *,
    folder: Path | None = None,
    templates: Sequence[str] = ("{}",),
    store: Path | None = None,
) -> Embedder:
    """Opens an embedder: CLIP if its folder is named, else colours.

    Args:
      name: Name of the space, or None for any. In an external space any CLIP with embeddings of that length is taken.
      folder: Folder of a CLIP model.
      templates: Phrases for texts of CLIP.
      store: Folder that caches embeddings.

    Raises:
      InputError: The folder holds no CLIP model, or the embedder is of another space.
    """
    dim = external_dim(name)
    if dim is not None and folder is None:
        raise missing_model(dim)
    if folder is not None:
        from jsecon.networks.clip import ClipEmbedder

        # pyright compares a cached_property with a protocol's attribute without reading it.
        embedder: Embedder = ClipEmbedder(folder, templates=templates, store=store)  # pyright: ignore[reportAssignmentType]
        remedy = "Give the folder of the model that the field was made with: --embedder DIR."
    else:
        from jsecon.vision.colours import ColourEmbedder

        embedder = ColourEmbedder()
        remedy = "Run the capture again with this version."
        if name is not None and name.startswith("clip-"):
            remedy = "Give the folder of the model that the field was made with (--embedder DIR), or run again without."
        elif tuple(templates) != ("{}",):
            there = "a field whose texts are colours"
            raise InputError("--template", there, "one made with CLIP", "Leave out --template.")
    if dim is not None and embedder.dim != dim:
        problem, expected = f"a model whose embeddings have {embedder.dim} numbers", f"{dim}, as those from files have"
        raise InputError("--embedder", problem, expected, "Give the CLIP model that made the files.")
    if dim is None and name not in (None, embedder.name):
        raise InputError("field", f"regions embedded by {name!r}", f"{embedder.name!r}", remedy)
    return embedder


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
