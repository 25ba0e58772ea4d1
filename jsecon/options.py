"""What a run is asked to do, and whether that can be done at all: checked before any work."""

import dataclasses
import tempfile
from pathlib import Path
from typing import Literal

from jsecon.errors import InputError


@dataclasses.dataclass(frozen=True)
class Options:
    """All that the result of a run depends on, but for the files themselves."""

    capture: Path
    """folder: COLMAP (images/, sparse/0) or nerfstudio / instant-ngp (transforms.json)."""
    gaussians: Path | None = None
    """.ply (INRIA layout) of the scene; None: Gaussians are fitted to the frames."""
    masks: Path | None = None
    """folder of instance masks: an integer PNG a frame, a folder an object, or LangSplat's `_s.npy`; None: found."""
    proposals: Path | None = None
    """folder of masks of single frames, to be brought together: SAM's JSON, LangSplat's `_s.npy`, PNGs; None: found."""
    segmenter: Path | None = None
    """SAM model folder that finds proposals; None: OpenCV's, by colour and texture."""
    level: Literal["default", "s", "m", "l"] = "l"
    """of SAM's proposals, and of LangSplat's files: all, subparts, parts, wholes."""
    points_per_side: int = 32
    """SAM: the grid of points put to a frame."""
    crop_layers: int = 0
    """SAM: also asked on 4^k crops for each layer k; 1 is LangSplat's, five times slower."""
    tracker: Path | None = None
    """SAM 2 model folder that follows the proposals (Algorithm 1); None: through the Gaussians."""
    embedder: Path | None = None
    """CLIP model folder for regions and texts; None: colours."""
    features: Path | None = None
    """folder of LangSplat's `_f.npy` beside `_s.npy`, from which regions get their embeddings; None: `embedder`."""
    downscale: float | None = None
    """frames are made this many times smaller; None: so that the longer side is at most `long_side`."""
    long_side: int = 400
    """px."""
    frames: int | None = None
    """at most this many frames, evenly spaced; None: all."""
    holdout: int = 8
    """every so manieth frame is kept for measuring only; 0 = none."""
    steps: int = 1500
    """of the photometric fit."""
    sh_degree: int = 1
    """of the fitted colours, 0 to 3."""
    granularity: Literal["fine", "medium", "coarse"] = "medium"
    """of the proposals: fine parts things, coarse joins colours that no jump of depth parts."""
    association: Literal["consensus", "tracking"] = "consensus"
    """of the frames' proposals: what most views agree on, or Algorithm 1 with a tracker."""
    agreement: float = 0.4
    """consensus: share of the views that must put two things into one proposal."""
    iou_threshold: float = 0.5
    """tracking: a proposal that overlaps a masklet by more is not new (the paper's kappa)."""
    weighting: Literal["pixels", "uniform"] = "pixels"
    """of the views in a region's embedding: pixels or uniform."""
    latent: int | Literal["auto"] = 16
    """most numbers a code may have; 3 reproduces the paper; auto: as few as keep the regions apart."""
    reduce: Literal["mode", "median", "mean"] = "mode"
    """of a Gaussian's votes to its code: mode, median or mean."""
    top: int = 8
    """regions whose votes a Gaussian keeps."""
    seed: int = 0
    """of whatever is drawn at random."""

    @property
    def associated_by(self) -> Literal["consensus", "tracking"]:
        """`association`; where a tracker is given, tracking."""
        return self.association if self.tracker is None else "tracking"


def require_inputs(options: Options) -> None:
    """Raises InputError where a file or folder that the options name is not there, or a number is out of its range."""
    for path, what, remedy in (
        (
            options.capture,
            "a folder with COLMAP's sparse/0 and images/, or a transforms.json",
            "Give the capture's folder.",
        ),
        (
            options.gaussians,
            "a .ply of 3D Gaussians",
            "Give the path of a .ply, or leave out --gaussians to fit the frames.",
        ),
        (options.masks, "a folder with one mask a frame", "Give the masks' folder, or leave out --masks to find them."),
        (options.proposals, "a folder with the masks of each frame", "Give the folder, or leave out --proposals."),
        (options.features, "a folder with each frame's _s.npy and _f.npy", "Give the folder, or leave out --features."),
        (options.segmenter, "a folder with a SAM model", "See `jsecon models check DIR`."),
        (options.tracker, "a folder with a SAM 2 model", "See `jsecon models check DIR`."),
        (options.embedder, "a folder with a CLIP model", "See `jsecon models check DIR`."),
    ):
        if path is not None and not path.exists():
            raise InputError(path, found="nothing there", expected=what, remedy=remedy)
    for name, least in (
        ("downscale", 1.0),
        ("frames", 2),
        ("holdout", 0),
        ("steps", 1),
        ("latent", 1),
        ("top", 1),
        ("long_side", 16),
        ("points_per_side", 1),
        ("crop_layers", 0),
    ):
        value = getattr(options, name)
        if value not in (None, "auto") and not value >= least:
            raise InputError(
                f"--{name.replace('_', '-')}", found=str(value), expected=f"at least {least}", remedy="Mend the option."
            )
    sources = [f"--{name}" for name in ("masks", "proposals", "segmenter") if getattr(options, name) is not None]
    if len(sources) > 1:
        raise InputError(
            " ".join(sources),
            found="more than one source of masks",
            expected="one: tracked masks, masks of single frames, or a model that finds them",
            remedy="Leave out the others.",
        )
    if not 0 < options.agreement <= 1:
        raise InputError(
            "--agreement",
            found=str(options.agreement),
            expected="a share above 0 and at most 1",
            remedy="Leave it out, or use 0.3 to 0.6.",
        )


def require_writable(folder: Path) -> None:
    """Raises InputError where no file can be made in `folder`; makes the folder itself."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(
            folder,
            found=error.strerror or type(error).__name__,
            expected="a folder that can be written",
            remedy="Choose another output folder, or mend its permissions.",
        ) from error
