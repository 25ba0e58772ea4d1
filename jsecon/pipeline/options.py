"""Options of a run.

The command line is made from these classes by tyro: an attribute's docstring is its help text, and its type says which
values it accepts. Each class is a group of the help.
"""

import dataclasses
import datetime
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_type_hints

import tyro

from jsecon.errors import InputError, describe_error
from jsecon.read.registry import SCENES

T = TypeVar("T")
GEOMETRIC = "geometric"
"""the tracker that needs no model: it follows masks through the Gaussians"""


def _default_hint(default: str) -> str:
    """Returns the default of an option for its help text; empty for a flag or an option without a default."""
    return "" if default in ("", "None", "False") else f"(default: {default})"


Option: TypeAlias = Annotated[T, tyro.conf.arg(prefix_name=False, help_behavior_hint=_default_hint)]
"""an option of the command line; its flag does not name the group"""
ModelOption: TypeAlias = Annotated[Option[str | Path | None], tyro.conf.arg(metavar="MODEL")]
"""a model as the user names it: a text is a name, an address of the hub or a folder; a Path is a folder"""


@dataclasses.dataclass(frozen=True)
class Range:
    """Mark of an option with numbers: each of them must lie in it. NaN lies in no range."""

    low: int | float
    high: int | float
    above: bool = False
    """`low` itself is too small"""
    direction: bool = False
    """the numbers are a direction, so that at least one of them must not be 0"""

    def __contains__(self, numbers: Any) -> bool:
        """Whether all numbers of a tree of tuples and lists lie in the range."""
        leaves = [x for x in _leaves(numbers) if isinstance(x, int | float) and not isinstance(x, bool)]
        if self.direction and leaves and not any(leaves):
            return False
        return all(self.low <= x <= self.high and not (self.above and x == self.low) for x in leaves)

    def __str__(self) -> str:
        """The range in words."""
        if self.direction:
            return "a direction, three numbers that are not all 0"
        return f"{'above' if self.above else 'at least'} {self.low:.10g} and at most {self.high:.10g}"


def _leaves(tree: Any) -> Iterator[Any]:
    if isinstance(tree, tuple | list):
        for part in tree:
            yield from _leaves(part)
    else:
        yield tree


Count: TypeAlias = Annotated[T, Range(1, 1_000_000)]
Seed: TypeAlias = Annotated[T, Range(0, 2**31 - 1)]
"""what jax and NumPy both take"""
Direction: TypeAlias = Annotated[T, Range(-1e6, 1e6, direction=True)]


def check_ranges(options: Any) -> None:
    """Raises InputError if a number of a dataclass of options, or of a group in it, is out of its `Range`."""
    hints = get_type_hints(type(options), include_extras=True)
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            check_ranges(value)
        for mark in getattr(hints[field.name], "__metadata__", ()):
            if isinstance(mark, Range) and value not in mark:
                words = " ".join(map(str, _leaves(value)))
                raise InputError(f"--{field.name.replace('_', '-')}", words, str(mark), "Change the option.")


@dataclasses.dataclass(frozen=True)
class InputOptions:
    """Input of a run.

    Attributes:
      capture: Folder with images/ and sparse/0 (COLMAP), or with transforms.json (nerfstudio, instant-ngp); a folder of
        ScanNet, TUM, ARKitScenes, Polycam, Record3D or OpenSfM; or a folder of photographs, or a video, without poses
        (extra sfm). Or a file of Gaussians (.ply, .spz, .sog, .splat) or a point cloud (.las, .laz, .e57, .pcd,
        .xyz, .txt, .ply) without photographs: jsecon renders it from poses that lie near it, or plans virtual views.
      gaussians: File with the 3D Gaussians of the scene: .ply (INRIA's layout, also of 2D Gaussians, or SuperSplat's
        compressed one), .spz, .splat, with the extra formats also .sog. Its world may be that of the capture's
        files, of its poses, of a dataparser_transforms.json near it, or the one that gsplat or nerfstudio normalise
        to: jsecon renders a few frames to find out, and warns if none fits. Without it, Gaussians are fitted to the
        frames.
      points: Point cloud (.las, .laz, .e57, .pcd, .xyz, .txt, .ply) in the world of the capture's files, such as a
        laser scan. The fit starts from it, and follows its depth where the capture has none of its own.
      panoramas: Tells that the photographs, or the video, without poses show all directions (360 degrees,
        equirectangular). Needed only where their files do not say so.
    """

    capture: tyro.conf.Positional[Path]
    gaussians: Option[Path | None] = None
    points: Option[Path | None] = None
    panoramas: Option[bool] = False


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """Options of the frames and of the photometric fit.

    Attributes:
      long_side: Longest side of the frames in pixels, at least 16. Smaller frames keep their size.
      frames: Maximum number of frames, evenly spaced, at least 2; a panorama counts as one. By default all frames are
        used, of a video 150, or 50 panoramas.
      holdout: Every how many frames one is held out for measuring; 0 holds out no frame. By default those that the
        capture's own split sets aside are held out, or else every eighth.
      refine: When to correct camera poses and exposures by short fits before anything else. With auto, captures with
        depth are corrected within half of the fit's time if depth makes the frames agree clearly better. Captures
        without depth, and runs with --gaussians, stay as they are. Held-out frames are aligned to the last of these
        fits, frozen.
      steps: Number of optimisation steps of the photometric fit.
      minutes: Time limit of the photometric fit in minutes, at least 0.05. It replaces --steps, and the schedule makes
        the best of it on this machine.
      seed: Seed of all random numbers.
    """

    long_side: Annotated[Option[int], Range(16, 16384)] = 400
    frames: Annotated[Option[int | None], Range(2, 1_000_000)] = None
    holdout: Annotated[Option[int | None], Range(0, 1_000_000)] = None
    refine: Option[Literal["never", "auto", "always"]] = "auto"
    steps: Count[Option[int]] = 2000
    minutes: Annotated[Option[float | None], Range(0.05, 10_000)] = None
    seed: Seed[Option[int]] = 0


@dataclasses.dataclass(frozen=True)
class BareOptions:
    """Options of a scene of Gaussians that comes without photographs.

    Attributes:
      views: Plans and renders this number of virtual views, at least 2. By default 48 are taken from poses that lie in
        the folder of the scene or up to two above (INRIA's cameras.json, a transforms.json, a COLMAP sparse/); 24 are
        planned if there are none, or if these do not show the scene.
      cameras: Renders the scene from all of these poses instead: a COLMAP model, a transforms.json, or INRIA's
        cameras.json. Their images are not needed.
    """

    views: Annotated[Option[int | None], Range(2, 1000)] = None
    cameras: Option[Path | None] = None


@dataclasses.dataclass(frozen=True)
class MaskOptions:
    """Options of the masks of objects.

    Attributes:
      masks: Folder of instance masks: an integer PNG or .npy per frame under the frame's name (0 is background), in
        subfolders like the images' if those have some; or <object>/<frame>.png in black and white; or SAM's or COCO's
        JSON with track_id or instance_id. Masks of parts may lie in those of wholes. Without it, jsecon finds the
        objects in the frames.
      proposals: Folder of masks of single frames, to be brought together over the frames: <frame>.json of SAM's
        generator, a COCO file of all frames, LangSplat's _s.npy, PNGs or .npy, named like the masks of --masks.
      ignore: What is no part of the scene, such as "person, screen": a segmenter and an embedder find it in each frame.
        Its pixels count nowhere, and OUT/masks has them in black, as nerfstudio and LichtFeld Studio read masks.
    """

    masks: Option[Path | None] = None
    proposals: Option[Path | None] = None
    ignore: Option[str | None] = None


@dataclasses.dataclass(frozen=True)
class ModelOptions:
    """Options of the models that take the place of colours.

    Attributes:
      models: Takes the recommended models for those that are not named: EdgeTAM finds the masks, SigLIP 2 reads texts.
      segmenter: SAM model that finds the proposals, instead of colour and texture: a name (edgetam, slimsam, sam2),
        hub:owner/name of huggingface.co, or a folder. `jsecon models list` has sizes and licences. A folder that is
        called like a model is written as a path: ./sam2.
      level: Level of SAM's proposals and of LangSplat's masks: subparts (s), parts (m), wholes (l), or all (default).
      tracker: What follows the proposals (Algorithm 1 of the paper), instead of consensus: geometric, through the
        Gaussians, or a SAM 2 model: a name (sam2, edgetam), hub:owner/name, or a folder.
      embedder: CLIP model for regions and texts, instead of colours: a name (clip, siglip2, mobileclip),
        hub:owner/name, or a folder.
      crops: Number of views in which a region is embedded: those that show most of it, not cut off by the frame's
        border, from different directions. A region whose views scatter takes more, a part of an object at most two.
      vision_frames: Maximum number of training frames in which masks are found and embedded; the fit uses all. A
        segmenter takes those that show most of the scene first, and ends where a further one adds less than 1 %. Other
        masks, and a tracker, take evenly spaced frames, by default all.
      vision_minutes: Time limit of a segmenter in minutes, at least 0.05. It takes at least two frames.
    """

    models: Option[Literal["auto"] | None] = None
    segmenter: ModelOption = None
    level: Option[Literal["default", "s", "m", "l"]] = "l"
    tracker: ModelOption = None
    embedder: ModelOption = None
    crops: Count[Option[int]] = 5
    vision_frames: Annotated[Option[int | None], Range(2, 1_000_000)] = None
    vision_minutes: Annotated[Option[float | None], Range(0.05, 10_000)] = None


@dataclasses.dataclass(frozen=True)
class FieldOptions:
    """Options of the language field.

    Attributes:
      paper: Also computes the paper's codes, three numbers per Gaussian, which query --by code compares.
      ledger: Leaves out field.evidence/, what each frame contributes to the field, which jsecon add and forget need.
      centre_pixel_weight: Weight of the pixel at a Gaussian's centre against all pixels that it covers, 0 to 1. Use 1
        if the answer is evaluated on points.
      up: Up axis of the files' world, three numbers. By default it is that of gravity if the format of the capture has
        it, else it follows from what rests on what, else from the cameras without their roll.
      metres_per_unit: Metres of one unit of the files' world, if you measured it. Captures of depth cameras and phones
        have metres; lengths in all others are in units of the capture without it.
      date: Date of the photographs, such as 2026-11-01, from which on the field is true (jsecon query --as-of). By
        default it is the latest of their EXIF data.
    """

    paper: Option[bool] = False
    ledger: Option[bool] = True
    centre_pixel_weight: Annotated[Option[float], Range(0, 1)] = 0.0
    up: Direction[Option[tuple[float, float, float] | None]] = None
    metres_per_unit: Annotated[Option[float | None], Range(0, 1e9, above=True)] = None
    date: Option[str | None] = None


@dataclasses.dataclass(frozen=True)
class Options(FieldOptions, ModelOptions, MaskOptions, BareOptions, SceneOptions, InputOptions):
    """All that the result of a run depends on, except for the content of its files."""


def is_bare_scene(capture: Path) -> bool:
    """Whether the input of a run is a file of Gaussians or points instead of a capture."""
    return capture.suffix.lower() in SCENES and not capture.is_dir()


def read_date(text: str, option: str = "--date") -> str:
    """Reads a date, or a date with a time, as ISO 8601 writes it; InputError for any other."""
    try:
        datetime.datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(option, f"{text!r} is no date", "YYYY-MM-DD", "For example 2026-11-28.") from error
    return text


def require_writable(folder: Path, *, create: bool = True) -> None:
    """Creates a folder, and checks that files can be created in it."""
    try:
        if create:
            folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=next(p for p in (folder, *folder.absolute().parents) if p.exists())).close()
    except OSError as error:
        remedy = "Choose another output folder, or mend its permissions."
        raise InputError(folder, describe_error(error), "a folder that can be written", remedy) from error
