"""Opens models: from a name, an address of the hub or a folder to what looks at the frames and reads the texts.

Without models these are OpenCV and colours; with them SAM, SAM 2 and CLIP. A network is opened when first needed and
closed when its stage is done, to free its memory.
"""

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from jsecon.errors import InputError
from jsecon.networks.hub import RECOMMENDED, HubModel, Role, parse_model
from jsecon.pipeline.options import GEOMETRIC, Options
from jsecon.pipeline.sources import locate_sources
from jsecon.types import LanguageField
from jsecon.vision.protocols import Embedder, Models
from jsecon.vision.stores import StoredSegmenter

if TYPE_CHECKING:
    from jsecon.networks.clip import ClipEmbedder


def _local_folders(models: Mapping[Role, HubModel | Path]) -> dict[Role, Path]:
    """Finds the folders of models on this machine, or raises InputError with the commands that fetch the others."""
    folders: dict[Role, Path | None] = {}
    for role, model in models.items():
        folders[role] = model if isinstance(model, Path) else model.cached_folder
    missing = [m for role, m in models.items() if isinstance(m, HubModel) and folders[role] is None]
    if missing:
        commands = "; ".join(model.get_command for model in missing)
        addresses = " ".join(model.address for model in missing)
        raise InputError(addresses, "not on this machine", "", f"Fetch with: {commands}.")
    return {role: folder for role, folder in folders.items() if folder is not None}


def with_folders(options: Options) -> Options:
    """Replaces the models in options by their folders on this machine, or raises InputError."""
    recommended = RECOMMENDED if options.models == "auto" else {}
    models = {}
    for role in get_args(Role):
        choice = getattr(options, role)
        choice = recommended.get(role) if choice is None else choice
        if choice not in (None, GEOMETRIC):
            models[role] = parse_model(choice, role)
    return dataclasses.replace(options, **_local_folders(models))


def open_models(options: Options, store: Path) -> Models:
    """Opens the models of a run by their folders; `store` is the folder that caches proposals."""
    segmenter = tracker = None
    if options.segmenter is not None:
        from jsecon.networks.sam import SamSegmenter

        sam = SamSegmenter(Path(options.segmenter), level=options.level)
        segmenter = StoredSegmenter(sam, store / "proposals")
    if options.tracker not in (None, GEOMETRIC):
        from jsecon.networks.sam2 import Sam2Tracker

        tracker = Sam2Tracker(Path(options.tracker))
    return Models(_open_embedder(folder=options.embedder), segmenter, tracker)


def _open_embedder(name: str | None = None, *, folder: str | Path | None = None) -> Embedder:
    """Opens an embedder: CLIP if one is named, else colours. InputError is raised if it is of another space.

    Args:
      name: Name of the space, or None for any.
      folder: Folder, name or address of a CLIP model.
    """
    if folder is not None:
        from jsecon.networks.clip import ClipEmbedder

        folder = _local_folders({"embedder": parse_model(folder, "embedder")})["embedder"]
        clip = ClipEmbedder(folder)
        return _of_space(clip, name, "Give the model that the field was made with: --embedder DIR.")
    from jsecon.vision.colours import ColourEmbedder

    if name is not None and name.startswith("clip-"):
        remedy = "Give the folder of the model that the field was made with (--embedder DIR), or run again without."
    else:
        remedy = "Run the capture again with this version."
    return _of_space(ColourEmbedder(), name, remedy)


def _of_space(embedder: Any, name: str | None, remedy: str) -> Embedder:
    """Returns the embedder if it is of a space, or of any if the name is None; else raises InputError."""
    if name not in (None, embedder.name):
        raise InputError("field", f"regions embedded by {name!r}", f"{embedder.name!r}", remedy)
    return embedder


def field_embedder(field: LanguageField, folder: str | Path | None = None) -> Embedder:
    """Opens the embedder that a field's regions were embedded by, or raises InputError.

    Args:
      field: The field.
      folder: Folder, name or address of the model; None looks where the run had it and in the hub's cache, and takes it
        only if its content is the same.
    """
    if folder is None:
        model = _find_model(field)
        if isinstance(model, HubModel):
            problem = f"its texts need the model {model.address}, which is not on this machine"
            raise InputError("field", problem, "", f"Fetch it with: {model.get_command}.")
        if model is not None:
            return _of_space(model, field.embedder, "")
    return _open_embedder(field.embedder, folder=folder)


def _find_model(field: LanguageField) -> "ClipEmbedder | HubModel | None":
    """Looks for the CLIP model that a field was made with, in its folder and in the hub's cache.

    Returns the model if it is on this machine, else the one of the hub that is to be fetched; None for a field without
    a model, or if its model came from a folder that is not here.
    """
    sources = locate_sources(field)
    if not (sources.embedder or "").startswith("clip-"):
        return None
    from jsecon.networks.clip import ClipEmbedder

    model = None if sources.address is None else parse_model(sources.address, "embedder")
    on_hub = model if isinstance(model, HubModel) else None
    for folder in (sources.model, None if on_hub is None else on_hub.cached_folder):
        if folder is not None:
            with contextlib.suppress(InputError):  # another model is there now
                embedder = ClipEmbedder(folder)
                if embedder.name == sources.embedder:
                    return embedder
    return on_hub
