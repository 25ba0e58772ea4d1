"""Which eyes a run has: OpenCV and colours without any weights, or SAM and CLIP from model folders.

Networks are opened when first needed and closed when their stage is done: their memory would stay otherwise.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jsecon.errors import InputError
from jsecon.options import Options
from jsecon.types import LanguageField
from jsecon.vision.proposal_store import NamedSegmenter, StoredSegmenter
from jsecon.vision.protocols import Embedder


def segmenter_of(options: Options, store: Path) -> NamedSegmenter | None:
    """SAM where the options name its folder, its masks kept under `store`; None: what needs no weights.

    Raises InputError where the folder holds no SAM model.
    """
    if options.segmenter is None:
        return None
    from jsecon.vision.sam import SamSegmenter, SamSettings

    settings = SamSettings(
        level=options.level, points_per_side=options.points_per_side, crop_layers=options.crop_layers
    )
    return StoredSegmenter(SamSegmenter(options.segmenter, settings), store / "proposals")


def embedder_of(options: Options, store: Path) -> Embedder:
    """CLIP where the options name its folder, its regions' embeddings kept under `store`; else colours.

    Raises InputError where the folder holds no CLIP model.
    """
    return embedder_named(folder=options.embedder, store=store / "embeddings")


def embedder_named(
    name: str | None = None,
    *,
    folder: Path | None = None,
    templates: Sequence[str] = ("{}",),
    store: Path | None = None,
) -> Embedder:
    """The embedder whose space is called `name` (None: any): CLIP where its folder is given, else colours.

    `templates` are phrases for CLIP to put texts into. Raises InputError where the folder holds no CLIP model, or the
    embedder found is of another space.
    """
    if folder is not None:
        from jsecon.vision.clip import ClipEmbedder

        found: Embedder = ClipEmbedder(folder, templates=templates, store=store)
        remedy = "Give the folder of the model that the field was made with: --embedder DIR."
    else:
        from jsecon.vision.colours import ColourEmbedder

        found = ColourEmbedder()
        remedy = "Run the capture again with this version."
        if name is not None and name.startswith("clip-"):
            remedy = "Give the folder of the model that the field was made with (--embedder DIR), or run again without."
        elif tuple(templates) != ("{}",):
            raise InputError(
                "--template",
                found="a field whose texts are colours",
                expected="one made with CLIP",
                remedy="Leave out --template.",
            )
    if name not in (None, found.name):
        raise InputError("field", found=f"regions embedded by {name!r}", expected=f"{found.name!r}", remedy=remedy)
    return found


def embedder_of_field(
    field: LanguageField, folder: Path | None = None, *, templates: Sequence[str] = ("{}",)
) -> Embedder:
    """The embedder that a field's regions live with: from `folder`, else from the folder that its run used, if that is
    still there. Raises InputError where it cannot be had."""
    if folder is None:
        used = json.loads(field.provenance or "{}").get("options", {}).get("embedder")
        folder = Path(used) if used is not None and Path(used).is_dir() else None
    return embedder_named(field.embedder, folder=folder, templates=templates)


def require_ready(eye: Any) -> None:
    """Raises InputError where a network's files cannot do what they are for; said before the long work starts."""
    check = getattr(eye, "check", None)
    if check is not None:
        check()


def close(eye: Any) -> None:
    """Drops a network's graphs, where there are any."""
    drop = getattr(eye, "close", None)
    if drop is not None:
        drop()
