"""What a run is asked to do, and whether that can be done at all: checked before any work.

The command line is made from this class: an option's docstring is its help, its type what it takes (arguments.py).
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Annotated, Literal

from jsecon.errors import InputError, why
from jsecon.pipeline.arguments import arguments_of

Folder = Annotated[Path | None, {"metavar": "DIR"}]


@dataclasses.dataclass(frozen=True)
class SceneOptions:
    """What the Gaussians of a capture depend on."""

    capture: Annotated[Path, {"positional": True}]
    """a folder with images/ and sparse/0 (COLMAP), or with transforms.json (nerfstudio, instant-ngp); of ScanNet, TUM,
    ARKitScenes, Polycam or Record3D; of photographs, or a video, whose poses are then found (extra sfm)"""
    downscale: Annotated[float | None, {"metavar": "K", "least": 1}] = None
    """make frames K times smaller (default: so that the longer side is at most --long-side)"""
    long_side: Annotated[int, {"metavar": "PX", "least": 16}] = 400
    """of the frames, where --downscale is not given"""
    frames: Annotated[int | None, {"metavar": "N", "least": 2}] = None
    """use at most N frames, evenly spaced (default: all; of a video 150)"""
    holdout: Annotated[int, {"metavar": "K", "least": 0}] = 8
    """keep every K-th frame for measuring only; 0 = none"""
    refine: Literal["none", "poses", "exposure", "both", "auto"] = "auto"
    """correct camera poses, exposures or both by short fits before anything else; held-out frames are aligned to the
    last of these, frozen. auto corrects both for captures with depth, if that lowers the error of training frames kept
    aside, within half of the fit's time; it changes nothing for captures without depth or with --gaussians"""
    drop_frames: Literal["none", "auto"] = "none"
    """auto: leave out training frames that a probe fit does not explain"""
    steps: Annotated[int, {"least": 1}] = 2000
    """of the photometric fit"""
    minutes: Annotated[float | None, {"metavar": "M", "least": 0.05}] = None
    """of the photometric fit, instead of --steps: the best that can be had in that time on this machine"""
    gaussians_at_most: Annotated[int | None, {"metavar": "N", "least": 1}] = None
    """that the fit may have; a start with more keeps its number (default: one for every other pixel of a frame, in fits
    from 3 minutes or 3000 steps on one for each, at most 100,000)"""
    growth: Literal["votes", "mcmc", "none"] = "votes"
    """of their number during the fit: where the picture is wrong; by opacity, with noise; or none"""
    sh_degree: Annotated[int, {"choices": range(4)}] = 2
    """of the fitted colours"""
    start: Literal["auto", "sparse", "dense", "random"] = "auto"
    """of the fit: from the capture's own points, or points triangulated; by stereo between neighbouring views; at
    random; auto: from depth where there is depth, else as sparse"""
    seed: int = 0
    """of whatever is drawn at random"""


@dataclasses.dataclass(frozen=True)
class Options(SceneOptions):
    """All that the result of a run depends on, but for the files themselves."""

    gaussians: Annotated[Path | None, {"metavar": "FILE"}] = None
    """a scene of 3D Gaussians: .ply (INRIA's layout, also of 2D Gaussians, or SuperSplat's compressed one), .glb, .spz,
    .splat, with the extra formats .sog; in the world of the capture's files, of its poses, of a
    dataparser_transforms.json beside it, or in that which gsplat or nerfstudio normalise to: a few frames are rendered
    to tell which, and a warning says where none shows them; without it, Gaussians are fitted to the frames"""
    masks: Folder = None
    """instance masks: one integer PNG or .npy per frame under the frame's name (0 = none), in folders like the images'
    where those have some; <object>/<frame>.png in black and white; or LangSplat's _s.npy; without it, masks are found
    in the frames"""
    proposals: Folder = None
    """masks of single frames, to be brought together: <frame>.json of SAM's own generator, a COCO file of all frames,
    LangSplat's _s.npy, PNGs, or .npy; named like the masks of --masks"""
    granularity: Literal["fine", "medium", "coarse"] = "medium"
    """of the proposals, without masks: fine parts things; coarse joins the colours of one thing, and tells things apart
    by the depth that the Gaussians render"""
    association: Literal["consensus", "tracking"] = "consensus"
    """of the frames' proposals: what most views agree on, or Algorithm 1 of the paper with a tracker through the
    Gaussians"""
    agreement: Annotated[float, {"metavar": "SHARE"}] = 0.4
    """consensus: share of the views that must put two things into one proposal; less joins more"""
    iou_threshold: Annotated[float, {"metavar": "KAPPA"}] = 0.5
    """tracking: a proposal that overlaps a masklet by more is not new"""
    segmenter: Folder = None
    """a SAM model folder (.onnx) to find proposals with, instead of colour and texture"""
    level: Literal["default", "s", "m", "l"] = "l"
    """of SAM's proposals and of LangSplat's files: subparts, parts, wholes, or all"""
    points_per_side: Annotated[int, {"metavar": "N", "least": 1}] = 32
    """SAM: asked on a grid of NxN points"""
    crop_layers: Annotated[int, {"metavar": "N", "least": 0}] = 0
    """SAM: asked on 4^k crops too, for each layer k; 1 is LangSplat's setting and takes five times longer"""
    tracker: Folder = None
    """a SAM 2 model folder (.onnx) that follows the proposals (the paper's Algorithm 1), instead of consensus"""
    embedder: Folder = None
    """a CLIP model folder (.onnx, tokenizer.json) for regions and texts, instead of colours"""
    features: Folder = None
    """LangSplat's language_features: regions take their embeddings from <frame>_s.npy and _f.npy; texts then need the
    CLIP that made them (--embedder, here or of query)"""
    weighting: Literal["pixels", "uniform"] = "pixels"
    """of the views in a region's embedding"""
    parts: bool = False
    """embed each frame's own masks too, so that `query` finds what no region holds, and `query --all` leaves out what
    most views took for one with its neighbour; takes twice as many embeddings"""
    latent: Annotated[int | Literal["auto"], {"metavar": "D", "least": 1}] = 16
    """most numbers a code may have; 3 as in the paper; auto for as few as keep the regions apart"""
    reduce: Literal["mode", "median", "mean"] = "mode"
    """from a Gaussian's votes to its code"""
    top: Annotated[int, {"metavar": "N", "least": 1}] = 8
    """regions whose votes a Gaussian keeps"""
    centre: Annotated[float, {"metavar": "W", "least": 0.0}] = 0.0
    """how far a Gaussian is what the pixel of its centre shows, not all that it covers: 1 where the answer is points"""

    @property
    def associated_by(self) -> Literal["consensus", "tracking"]:
        """`association`; where a tracker is given, tracking."""
        return self.association if self.tracker is None else "tracking"


def require_inputs(options: Options) -> None:
    """Raises InputError where a file or folder that the options name is not there, or a number is out of its range."""
    for argument in arguments_of(Options):
        value = getattr(options, argument.name)
        if isinstance(value, Path) and not value.exists():
            remedy = f"Mend the path{'' if argument.positional else f', or leave out {argument.flag}'}."
            raise InputError(value, "nothing there", argument.help.partition(";")[0], remedy)
        if argument.least is not None and isinstance(value, int | float) and not value >= argument.least:
            raise InputError(argument.flag, str(value), f"at least {argument.least}", "Mend the option.")
    sources = [f"--{name}" for name in ("masks", "proposals", "segmenter") if getattr(options, name) is not None]
    if len(sources) > 1:
        expected = "one: tracked masks, masks of single frames, or a model that finds them"
        raise InputError(" ".join(sources), "more than one source of masks", expected, "Leave out the others.")
    if not 0 < options.agreement <= 1:
        given, remedy = str(options.agreement), "Leave it out, or use 0.3 to 0.6."
        raise InputError("--agreement", given, "a share above 0 and at most 1", remedy)
    if options.centre > 1:
        raise InputError("--centre", str(options.centre), "0 to 1", "Use 1 for the pixel of the centre alone.")


def require_own_folder(options: Options | SceneOptions, out: Path) -> None:
    """Raises InputError where the output folder is one of the input folders, or a folder of the capture's own files."""
    capture = options.capture
    inputs = {"capture": [capture, *(capture / name for name in ("images", "sparse", "sparse/0", "keyframes"))]}
    inputs |= {argument.name: [getattr(options, argument.name, None)] for argument in arguments_of(Options)[1:]}
    for name, folders in inputs.items():
        for folder in folders:
            if isinstance(folder, Path) and folder.is_dir() and folder.resolve() == out.resolve():
                problem = f"it is the input folder ({name}) and the output folder at once"
                remedy = f"Give the output its own folder, for example {out / 'field'}, or one elsewhere."
                raise InputError(out, problem, "", remedy)


def require_writable(folder: Path) -> None:
    """Raises InputError where no file can be made in `folder`; makes the folder itself."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        found, remedy = why(error), "Choose another output folder, or mend its permissions."
        raise InputError(folder, found, "a folder that can be written", remedy) from error
