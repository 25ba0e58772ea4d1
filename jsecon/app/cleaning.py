"""`jsecon clean`: a scene without its floaters, haze and unseen Gaussians, and what that does to its pictures."""

from typing import Any

import jax
import numpy as np

from jsecon.app import pictures, verbs
from jsecon.app.records import gaussian_rows
from jsecon.app.scene import open_scene
from jsecon.errors import InputError
from jsecon.fit.photometric import psnr
from jsecon.fit.quality import measure_quality
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Console
from jsecon.pipeline.scene_files import fit_background, place_in_capture, read_scene
from jsecon.pipeline.scene_stages import open_bare_scene
from jsecon.read.captures.capture import load_capture
from jsecon.read.captures.frames import evenly_spaced
from jsecon.read.splats.writing import require_writable_format, save_gaussians
from jsecon.splat.visible import hide
from jsecon.types import Camera, Capture, Gaussians
from jsecon.views.clean import KINDS, find_litter


def _clean(verb: verbs.Clean, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon clean`; the result has the number of each kind, and the PSNR before and after."""
    require_writable_format(verb.out)
    if verb.scene.resolve() == verb.out.resolve():
        raise InputError("--out", "it is the scene itself", remedy="Write to another file.")
    if verb.capture is not None and (verb.cameras is not None or verb.views is not None):
        raise InputError("--capture", "its poses are the views", remedy="Leave --cameras and --views out.")
    opened = open_scene(verb.scene, console=console) if verb.keep_objects else None
    with console.progress("views") as progress:
        capture = verb.capture and load_capture(verb.capture, long_side=Options.long_side, progress=progress)
        if capture is None:
            scene, _, views = open_bare_scene(Options(verb.scene, cameras=verb.cameras, views=verb.views), progress)
            cameras, notes = views.cameras, views.notes
        else:
            scene, *notes = place_in_capture(read_scene(verb.scene)[0], capture, verb.scene, None, progress)
            cameras = capture.cameras
    for note in notes:
        console.note(note)
    cameras = jax.tree.map(np.asarray, cameras[evenly_spaced(len(cameras), 128)])  # more would show little more
    with console.progress("clean") as progress:
        kinds = find_litter(scene, cameras, progress)
    if opened is not None:
        kinds[opened.objects().labels >= 0] = 0
    counts = {kind: int((kinds == n).sum()) for n, kind in enumerate(KINDS)}
    if not counts["kept"]:
        raise InputError(verb.scene, "no Gaussian would be left", remedy="Check the views: --cameras FILE.")
    words = ", ".join(f"{count} {kind} ({count / len(kinds):.1%})" for kind, count in list(counts.items())[1:])
    console.print_line(f"gone    {words}")
    with console.progress("quality"):
        quality, line = _quality(scene, hide(scene, kinds > 0), cameras, capture)
    console.print_line(line)
    with console.progress("files"):
        del scene  # read again, a large one fits into memory once
        save_gaussians(verb.out, gaussian_rows(read_scene(verb.scene)[0], np.flatnonzero(kinds == 0)))
    console.print_line(f"{counts['kept']} Gaussians, {verb.out.stat().st_size / 2**20:.1f} MiB  {verb.out}")
    return {"written": {"scene": verb.out}, "gaussians": counts} | quality


def _quality(
    before: Gaussians, after: Gaussians, cameras: Camera, capture: Capture | None
) -> tuple[dict[str, Any], str]:
    """Compares pictures before and after, with photographs if there are any, and says what came out."""
    frames = evenly_spaced(len(cameras if capture is None else capture.frames), 12)
    if capture is None:
        views = cameras[frames]
        shots = ([pictures.render_picture(part, view) / np.float32(255) for view in views] for part in (before, after))
        value = float(np.median([*map(psnr, *shots)]))
        return {"psnr_between": value}, f"quality pictures before and after agree to {value:.2f} dB (median)"
    background = fit_background(before, capture)
    found = [measure_quality(part, capture, frames=frames, background=background) for part in (before, after)]
    first, last = (float(np.mean(quality.psnr)) for quality in found)
    line = f"quality {first:.2f} dB before, {last:.2f} dB after, PSNR of {len(frames)} photographs"
    return {"psnr_before": first, "psnr_after": last}, line
