"""Opens models: from a name, an address of the hub or a folder to what looks at the frames and reads the texts.

Without models these are OpenCV and colours; with them SAM, SAM 2 and CLIP. A network is opened when first needed and
closed when its stage is done, to free its memory.
"""

import contextlib
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from jsecon.errors import InputError
from jsecon.networks.hub import RECOMMENDED, HubModel, Role, parse_model
from jsecon.pipeline.options import GEOMETRIC, Options
from jsecon.pipeline.sources import locate_sources
from jsecon.types import LanguageField
from jsecon.vision.protocols import Embedder, Models


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


def open_models(options: Options, store: Path) -> tuple[Options, Models]:
    """Opens the models of a run, and replaces them in its options by their folders on this machine.

    `store` is the folder that caches proposals.
    """
    recommended = RECOMMENDED if options.models == "auto" else {}
    models = {}
    for role in get_args(Role):
        choice = getattr(options, role)
        choice = recommended.get(role) if choice is None else choice
        if choice not in (None, GEOMETRIC):
            models[role] = parse_model(choice, role)
    options = dataclasses.replace(options, **_local_folders(models))
    segmenter = tracker = None
    if options.segmenter is not None:
        from jsecon.networks.sam import SamSegmenter

        segmenter = SamSegmenter(Path(options.segmenter), level=options.level, store=store / "proposals")
    if options.tracker not in (None, GEOMETRIC):
        from jsecon.networks.sam2 import Sam2Tracker

        tracker = Sam2Tracker(Path(options.tracker))
    return options, Models(_open_embedder(options.embedder), segmenter, tracker)


def _open_embedder(folder: str | Path | None) -> Embedder:
    """Opens CLIP from a folder, a name or an address; colours if there is none."""
    if folder is None:
        from jsecon.vision.colours import ColourEmbedder

        return ColourEmbedder()
    from jsecon.networks.clip import ClipEmbedder

    clip: Any = ClipEmbedder(_local_folders({"embedder": parse_model(folder, "embedder")})["embedder"])
    return clip


def field_embedder(field: LanguageField, folder: str | Path | None = None) -> Embedder:
    """Opens the embedder that a field's regions were embedded by, or raises InputError.

    Args:
      field: The field.
      folder: Folder, name or address of the model; None looks where the run had it and in the hub's cache, and takes it
        only if its content is the same.
    """
    embedder = (_find_model(field) if folder is None else None) or _open_embedder(folder)
    if embedder.name != field.embedder:
        remedy = "Give the model that the field was made with (--embedder DIR), or run the capture again."
        raise InputError("field", f"regions embedded by {field.embedder!r}", repr(embedder.name), remedy)
    return embedder


def _find_model(field: LanguageField) -> Embedder | None:
    """Looks for the CLIP model that a field was made with, in its folder and in the hub's cache.

    Returns None if it is on neither. InputError is raised if it is to be fetched from the hub.
    """
    if not field.embedder.startswith("clip-"):
        return None
    sources = locate_sources(field)
    on_hub = parse_model(sources.address, "embedder") if sources.address else None
    for folder in (sources.model, on_hub.cached_folder if isinstance(on_hub, HubModel) else None):
        if folder is not None:
            with contextlib.suppress(InputError):  # another model is there now
                embedder = _open_embedder(folder)
                if embedder.name == field.embedder:
                    return embedder
    if isinstance(on_hub, HubModel):
        problem = f"its texts need the model {on_hub.address}, which is not on this machine"
        raise InputError("field", problem, "", f"Fetch it with: {on_hub.get_command}.")
    return None
