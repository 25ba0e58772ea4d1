"""Checks of a dry run: it refuses the inputs that a run would refuse.

Each check is one that a stage makes before its long work. It reads no more than headers and a few files.
"""

import contextlib
import os
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from jsecon.data.capture import capture_extent
from jsecon.data.frames import CaptureExtent, downscaled_size, evenly_spaced, frame_names, holdout_mask
from jsecon.data.images import image_size
from jsecon.data.sfm import check_photographs, list_photographs, require_pycolmap
from jsecon.data.video import DEFAULT_VIDEO_FRAMES, is_video, video_size
from jsecon.errors import InputError
from jsecon.pipeline import cache
from jsecon.pipeline.options import Options, is_bare_scene
from jsecon.pipeline.results import RunContext, require_training
from jsecon.pipeline.scene_files import read_scene
from jsecon.types import ImageFile


def check_inputs(context: RunContext, running: Collection[str], results: Mapping[str, Path]) -> None:
    """Checks the inputs of a run.

    Args:
      context: The run.
      running: Names of the stages that would run. Inputs of the other stages are not checked.
      results: Cache file of each stage by its name; files of stages that would run need not exist.

    Raises:
      InputError: The output folder cannot be written, an extra is missing, photographs or a video cannot be used, too
        few frames are left to fit to, a file of Gaussians cannot be read, or masks, proposals or features do not belong
        to the frames.
    """
    options = context.options
    _require_place(context.out)
    if "poses" in running:
        require_pycolmap(options.capture)
        if is_video(options.capture) and min(video_size(options.capture)) < 1:
            remedy = "Copy it again, or convert it (ffmpeg -i VIDEO walk.mp4)."
            raise InputError(options.capture, "no frame that OpenCV can read", "a video", remedy)
    if is_bare_scene(options.capture):
        read_scene(options.capture)
        return
    extent = _extent(context, running, results)
    train = np.flatnonzero(~holdout_mask(extent.frames, options.holdout))
    require_training(len(train) if extent.frames > 1 else extent.frames, extent.frames)
    if options.gaussians is not None and "gaussians" in running:
        read_scene(options.gaussians)
    if extent.names:
        seen = train[evenly_spaced(len(train), options.vision_frames)]
        _check_masks(options, running, extent, [extent.names[t] for t in seen])


def _require_place(folder: Path) -> None:
    """Raises InputError if an output folder cannot be created: a parent of it is a file, or cannot be written."""
    parent = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    if not parent.is_dir():
        raise InputError(folder, f"{parent} is a file", "a folder that can be written", "Choose another output folder.")
    if not os.access(parent, os.W_OK | os.X_OK):
        remedy = "Choose another output folder, or mend its permissions."
        raise InputError(folder, f"{parent} cannot be written", "a folder that can be written", remedy)


def _extent(context: RunContext, running: Collection[str], results: Mapping[str, Path]) -> CaptureExtent:
    """Returns number, size and names of the frames that a run would load. A video's frames have no names yet."""
    options = context.options
    size_options = {name: getattr(options, name) for name in ("downscale", "long_side", "frames")}
    if "load" not in running:
        with contextlib.suppress(cache.CorruptCacheError):  # a run would compute it again
            capture = cache.load(results["load"]).value
            size = capture.cameras.width, capture.cameras.height
            return CaptureExtent(len(capture.names), size, capture.names, capture.files)
    if "poses" not in results:
        return capture_extent(options.capture, **size_options)
    if "poses" not in running:
        return capture_extent(context.out / "poses", **size_options)
    if is_video(options.capture):
        size = downscaled_size(video_size(options.capture), options.downscale, options.long_side)
        return CaptureExtent(options.frames or DEFAULT_VIDEO_FRAMES, size)
    photos = list_photographs(options.capture)
    paths = check_photographs(photos, options.capture)
    names = frame_names(paths, options.capture)
    sizes = [image_size(photo) for photo in photos]
    chosen = evenly_spaced(len(photos), options.frames)
    size = downscaled_size(max(set(sizes), key=sizes.count), options.downscale, options.long_side)
    files = tuple(ImageFile(paths[i], *sizes[i]) for i in chosen)
    return CaptureExtent(len(chosen), size, tuple(names[i] for i in chosen), files)


def _check_masks(options: Options, running: Collection[str], extent: CaptureExtent, train_names: list[str]) -> None:
    """Checks that files of masks, proposals and features belong to the frames."""
    width, height = extent.size
    files = dict(zip(extent.names, extent.files))
    layout = {"level": options.level, "order": extent.names, "files": files}
    if options.masks is not None and "masklets" in running:
        from jsecon.data.masks import check_labels

        check_labels(options.masks, train_names, (height, width), **layout)
    if options.proposals is not None and "masklets" in running:
        from jsecon.data.proposals import load_proposals

        read, _ = load_proposals(options.proposals, train_names, (height, width), **layout)
        read(0)
    if options.features is not None and "regions" in running:
        from jsecon.data.langsplat import load_features

        load_features(options.features, train_names[:1], (height, width), **layout)
