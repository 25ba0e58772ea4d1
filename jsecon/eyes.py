"""Which eyes a run has: OpenCV and colours without any weights, or SAM, SAM 2 and CLIP from model folders.

Networks are opened when first needed and closed when their stage is done: their memory would stay otherwise.
"""

import dataclasses
import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from jsecon.errors import InputError
from jsecon.options import Options
from jsecon.types import LanguageField
from jsecon.vision.given import GivenSpace, given_dim, missing_model
from jsecon.vision.proposal_store import StoredSegmenter
from jsecon.vision.protocols import Embedder, NamedSegmenter, NamedTracker


@dataclasses.dataclass(frozen=True)
class Eyes:
    """What looks at a run's frames."""

    embedder: Embedder
    segmenter: NamedSegmenter | None
    """None: what needs no weights."""
    tracker: NamedTracker | None
    """None: through the Gaussians."""

    def require_ready(self, stages: Collection[str]) -> None:
        """Raises InputError where a network cannot do what `stages` want of it: before the long work starts."""
        for stage, eye in (("masklets", self.segmenter), ("masklets", self.tracker), ("regions", self.embedder)):
            check = getattr(eye, "check", None)
            if stage in stages and check is not None:
                check()


def eyes_of(options: Options, store: Path) -> Eyes:
    """SAM, SAM 2 and CLIP where the options name their folders; what they find is kept under `store`.

    Raises InputError where a folder holds no such model.
    """
    segmenter = tracker = None
    if options.segmenter is not None:
        from jsecon.vision.sam import SamSegmenter, SamSettings

        settings = SamSettings(
            level=options.level, points_per_side=options.points_per_side, crop_layers=options.crop_layers
        )
        segmenter = StoredSegmenter(SamSegmenter(options.segmenter, settings), store / "proposals")
    if options.tracker is not None:
        from jsecon.vision.sam2 import Sam2Tracker

        tracker = Sam2Tracker(options.tracker)
    given = None
    if options.features is not None:
        from jsecon.data.langsplat_files import feature_size

        given = GivenSpace(feature_size(options.features))
        if options.embedder is None:
            return Eyes(given, segmenter, tracker)
    name = None if given is None else given.name
    return Eyes(embedder_named(name, folder=options.embedder, store=store / "embeddings"), segmenter, tracker)


def embedder_named(
    name: str | None = None,
    *,
    folder: Path | None = None,
    templates: Sequence[str] = ("{}",),
    store: Path | None = None,
) -> Embedder:
    """The embedder whose space is called `name` (None: any): CLIP where its folder is given, else colours. In a given
    space (`GivenSpace`) only CLIP knows texts, and any will do whose embeddings have as many numbers.

    `templates` are phrases for CLIP to put texts into. Raises InputError where the folder holds no CLIP model, or the
    embedder found is of another space.
    """
    dim = given_dim(name)
    if dim is not None and folder is None:
        raise missing_model(dim)
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
    if dim is not None and found.dim != dim:
        raise InputError(
            "--embedder",
            found=f"a model whose embeddings have {found.dim} numbers",
            expected=f"{dim}, as those from files have",
            remedy="Give the CLIP model that made the files.",
        )
    if dim is None and name not in (None, found.name):
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


def close(*seeing: Any) -> None:
    """Drops the graphs of those that hold any."""
    for eye in seeing:
        drop = getattr(eye, "close", None)
        if drop is not None:
            drop()
