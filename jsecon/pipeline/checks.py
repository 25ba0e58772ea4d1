"""What a dry run looks at, so that a run that it says can start does start: the inputs of the stages that would run.

Every check is one that a stage makes itself before its long work; none reads more than headers and a few files.
"""

import os
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from jsecon.data.frames import Extent, held_out
from jsecon.data.motion import check_photographs, photographs, require_motion
from jsecon.data.video import is_video, size_of
from jsecon.errors import InputError
from jsecon.pipeline.options import Options
from jsecon.pipeline.stages import Work, require_training


def check_inputs(work: Work, running: Collection[str], extent: Extent) -> None:
    """Looks at the inputs of a run.

    Args:
      work: The run.
      running: Names of the stages that would run; the inputs of the others are not looked at.
      extent: The frames that it would load. Without names where only a video's frames will have them.

    Raises:
      InputError: The output folder cannot be written, an extra is missing, photographs or a video cannot be used, too
        few frames are left to fit to, or masks, proposals or features do not belong to the frames.
    """
    options = work.options
    require_place(work.out)
    if "poses" in running:
        require_motion(options.capture)
        if is_video(options.capture):
            if min(size_of(options.capture)) < 1:
                remedy = "Copy it again, or convert it (ffmpeg -i VIDEO walk.mp4)."
                raise InputError(options.capture, "no frame that OpenCV can read", "a video", remedy)
        else:
            check_photographs(photographs(options.capture), options.capture)
    train = np.flatnonzero(~held_out(extent.frames, options.holdout))
    require_training(len(train) if extent.frames > 1 else extent.frames, extent.frames)
    if extent.names and isinstance(options, Options):
        _check_masks(options, running, extent, [extent.names[t] for t in train])


def require_place(folder: Path) -> None:
    """Raises InputError where no output folder could be made; makes none."""
    there = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not there.is_dir():
        raise InputError(folder, f"{there} is a file", "a folder that can be written", "Choose another output folder.")
    if not os.access(there, os.W_OK | os.X_OK):
        remedy = "Choose another output folder, or mend its permissions."
        raise InputError(folder, f"{there} cannot be written", "a folder that can be written", remedy)


def _check_masks(options: Options, running: Collection[str], extent: Extent, names: list[str]) -> None:
    width, height = extent.size
    size = (height, width)
    files: Mapping = dict(zip(extent.names, extent.files))
    how = {"level": options.level, "order": extent.names, "files": files}
    if options.masks is not None and "masklets" in running:
        from jsecon.data.mask_files import check_labels

        check_labels(options.masks, names, size, **how)
    if options.proposals is not None and "masklets" in running:
        from jsecon.data.proposal_files import proposals_from_disk

        read, _ = proposals_from_disk(options.proposals, names, size, **how)
        read(0)
    if options.features is not None and "regions" in running:
        from jsecon.data.langsplat_files import load_features

        load_features(options.features, names[:1], size, **how)
