"""Opens what looks at the frames: OpenCV and colours without weights, or SAM, SAM 2 and CLIP from model folders.

A network is opened when first needed and closed when its stage is done, to free their memory.
"""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import numpy as np

from jsecon.errors import InputError
from jsecon.networks.hub import HubModel, parse_model
from jsecon.pipeline.options import Options
from jsecon.pipeline.sources import locate_sources
from jsecon.types import LanguageField
from jsecon.vision.protocols import Embedder, Models
from jsecon.vision.stores import StoredSegmenter

if TYPE_CHECKING:
    from jsecon.networks.clip import ClipFiles

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
        self.canonical_phrases = self.unrelated_words = np.zeros((0, dim), np.float32)

    def _refuse(self, *args: object, **kwargs: object) -> NoReturn:
        raise _missing_model(self.dim)

    embed_regions = embed_text = _refuse


def external_dim(name: str | None) -> int | None:
    """Reads the name of a space of embeddings from files.

    Args:
      name: Name of a field's space, or None.

    Returns:
      Length of its embeddings; None for the space of an embedder.
    """
    return int(name.removeprefix(_EXTERNAL)) if name is not None and name.startswith(_EXTERNAL) else None


def _missing_model(dim: int) -> InputError:
    """Returns the error that the model of an external space is needed."""
    remedy = "Give its folder: --embedder DIR. Without it, ask by a pixel (--at)."
    problem = f"regions whose embeddings came from files, {dim} numbers each"
    return InputError("field", problem, "the CLIP model that made them", remedy)


def open_models(options: Options, store: Path) -> Models:
    """Opens SAM, SAM 2 and CLIP if the options name their folders.

    Args:
      options: Options of the run.
      store: Folder that caches proposals and embeddings.

    Returns:
      The models; colours embed if no CLIP is named.

    Raises:
      InputError: A folder holds no such model.
    """
    segmenter = tracker = None
    if options.segmenter is not None:
        from jsecon.networks.sam import SamSegmenter, SamSettings, find_sam

        level, side, layers = options.level, options.points_per_side, options.crop_layers
        settings = SamSettings(level=level, prompts=options.prompts, points_per_side=side, crop_layers=layers)
        files = find_sam(options.segmenter, options.precision)
        segmenter = StoredSegmenter(SamSegmenter(files, settings), store / "proposals")
    if options.tracker is not None:
        from jsecon.networks.sam2 import Sam2Tracker

        tracker = Sam2Tracker(options.tracker)
    name = model = None
    if options.embedder is not None:
        from jsecon.networks.clip import find_clip

        model = find_clip(options.embedder, options.precision)
    if options.features is not None:
        from jsecon.read.masks.langsplat import embedding_size

        external = ExternalSpace(embedding_size(options.features))
        if model is None:
            return Models(external, segmenter, tracker)
        name = external.name
    return Models(open_embedder(name, folder=model, store=store / "embeddings"), segmenter, tracker)


def open_embedder(
    name: str | None = None,
    *,
    folder: "Path | ClipFiles | None" = None,
    templates: Sequence[str] = ("{}",),
    store: Path | None = None,
) -> Embedder:
    """Opens an embedder: CLIP if its folder is named, else colours.

    Args:
      name: Name of the space, or None for any. In an external space any CLIP with embeddings of that length is taken.
      folder: Folder of a CLIP model.
      templates: Phrases for texts of CLIP.
      store: Folder that caches embeddings.

    Returns:
      The embedder.

    Raises:
      InputError: The folder holds no CLIP model, or the embedder is of another space.
    """
    dim = external_dim(name)
    if dim is not None and folder is None:
        raise _missing_model(dim)
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
    """Opens the embedder that a field's regions were embedded by.

    Args:
      field: The field.
      folder: Folder of the model; None looks where the run had it and in the hub's cache, and takes it only if its
        content is the same.
      templates: Phrases for the texts, with CLIP.

    Returns:
      The embedder.

    Raises:
      InputError: The model is not on this machine, or is another one.
    """
    model = find_model(field) if folder is None else folder
    if isinstance(model, HubModel):
        problem = f"its texts need the model {model.address}, which is not on this machine"
        raise InputError("field", problem, "", f"Fetch it with: {model.get_command}. Or add --yes.")
    return open_embedder(field.embedder, folder=model, templates=templates)


def find_model(field: LanguageField) -> "ClipFiles | HubModel | None":
    """Looks for the CLIP model that a field was made with, in its folder and in the hub's cache.

    Args:
      field: The field.

    Returns:
      Its files if they are on this machine, else the model of the hub that is to be fetched; None for a field without
      a model, or if its model came from a folder that is not here.

    Raises:
      InputError: The provenance of the field is not what a run writes.
    """
    sources = locate_sources(field)
    if not (sources.embedder or "").startswith("clip-"):
        return None
    from jsecon.networks.clip import find_clip

    model = None if sources.address is None else parse_model(sources.address, "embedder", sources.precision)
    on_hub = model if isinstance(model, HubModel) else None
    for folder in (sources.model, None if on_hub is None else on_hub.cached_folder):
        if folder is not None:
            with contextlib.suppress(InputError):  # another model is there now
                files = find_clip(folder, sources.precision)
                if files.name == sources.embedder:
                    return files
    return on_hub
