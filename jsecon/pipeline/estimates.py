"""What a run will cost, stage by stage, before it runs: seconds, memory and disk.

Each figure is a sum over the units of `units_of`: so much for once, so much for a million pixels of all frames ...
`MEASURED` is what benchmarks/estimates.py measured; the seconds are scaled by how long `workload` takes here and now,
against the machine that they were measured on.
"""

import dataclasses
import statistics
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from jsecon.data.capture import capture_extent
from jsecon.data.frames import Extent, frame_names, shrunk, spread
from jsecon.data.images import image_size
from jsecon.data.motion import check_photographs, photographs
from jsecon.data.video import VIDEO_FRAMES, is_video, size_of
from jsecon.fit.schedule import gaussians_for
from jsecon.pipeline import cache
from jsecon.pipeline.checks import check_inputs
from jsecon.pipeline.options import Options
from jsecon.pipeline.progress import Listener, Step
from jsecon.pipeline.scene_stages import refinement
from jsecon.pipeline.stages import Work
from jsecon.types import ImageFile

REFERENCE = 0.06
"""seconds of `workload` on the machine that it was MEASURED on (two cores of an AMD EPYC)"""
FULL_SIZE = 0.625
"""of a frame's pixels, that a step of the fit takes on average: half of them at half the size"""


def units_of(extent: Extent, gaussians: int, steps: int) -> dict[str, float]:
    """How much there is of each unit that costs something."""
    pixels, source = (width * height / 1e6 for width, height in (extent.size, extent.source))
    return {
        "once": 1.0,
        "pixels": pixels,
        "images": extent.frames * source,
        "frames": extent.frames * pixels,
        "gaussians": gaussians / 1e6,
        "views": extent.frames * gaussians / 1e6,
        "steps": steps / 1e3,
        "step_pixels": steps / 1e3 * FULL_SIZE * pixels,
        "step_gaussians": steps / 1e3 * gaussians / 1e6,
    }


MEASURED = """
load      | once=0.197 images=0.0138 | once=0.0177 | once=229 frames=5.01 | frames=2.89
gaussians | once=1.47 steps=23.8 step_pixels=326 | once=14.4 | once=1090 pixels=625 frames=39.7 | gaussians=145
masklets  | once=0.445 frames=0.693 views=1.02 | once=2.74 | once=1090 pixels=1320 frames=108 | frames=1.61
regions   | once=0.0435 frames=0.223 | once=0.0258 | once=1070 pixels=3980 frames=88.8 | once=0.00415
codes     | once=0.163 | once=0.75 | once=1070 pixels=3980 frames=88.8 | once=0.00537
votes     | once=0.197 frames=0.0236 views=0.864 | once=4.04 | once=1070 pixels=3960 frames=90.4 | once=0.0104 gaussians=66.4 views=3.36
distil    | once=0.0834 | once=0.246 | once=1070 pixels=3970 frames=90.1 | gaussians=61
held_out  | once=0.342 frames=0.166 | once=1.78 | once=1080 pixels=4600 frames=78.5 |
field     | once=0.182 views=0.0548 | once=0.935 | once=1120 pixels=4130 frames=76 | gaussians=312
"""  # noqa: E501
"""stage | seconds | of compilation, the first time that a machine sees such sizes | MiB of memory at the peak, what the
stages before left included | MiB on disk"""
Cost: TypeAlias = list[dict[str, float]]
COSTS: dict[str, Cost] = {
    name.strip(): [{unit: float(x) for unit, x in (word.split("=") for word in part.split())} for part in parts]
    for name, *parts in (line.split("|") for line in MEASURED.strip().splitlines())
}


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What a stage will cost; None: that is not known before."""

    name: str
    status: str
    how: str
    seconds: float | None = 0.0
    compilation: float | None = 0.0
    memory_mib: float | None = 0.0
    disk_mib: float | None = 0.0

    def told(self) -> str:
        """The figures in words."""
        if self.status != "run":
            return "-"
        if self.seconds is None:
            return "not known before"
        return f"{self.seconds:6.1f} s {self.memory_mib:6.0f} MiB {self.disk_mib:5.0f} MiB"


def workload() -> float:
    """Seconds that a fixed piece of work takes here and now, on two threads."""
    numbers = np.random.default_rng(0).random((2, 1_000_000), np.float32)

    def work(row: np.ndarray) -> None:
        for _ in range(4):
            np.sort(row)
            for _ in range(12):
                row = np.exp(-row)

    with ThreadPoolExecutor(2) as pool:
        began = time.perf_counter()
        list(pool.map(work, numbers))
        return time.perf_counter() - began


def estimates(work: Work, steps: Sequence[Step], place: Mapping[str, Path], slower: float) -> list[Estimate]:
    """Of each stage; `slower`: how many times this machine takes the time of the one that measured. Raises InputError
    where a run would for its inputs (`check_inputs`)."""
    options, running = work.options, {step.name for step in steps if step.status == "run"}
    extent, gaussians = _extent(work, running, place), None
    check_inputs(work, running, extent)
    if "gaussians" not in running:
        gaussians = cache.load(place["gaussians"]).value.count
    elif options.gaussians is not None:
        from jsecon.pipeline.scene_stages import given_gaussians

        gaussians = given_gaussians(options.gaussians)[0].count
    else:
        pixels = extent.size[0] * extent.size[1]
        most = options.gaussians_at_most or gaussians_for(pixels, steps=options.steps, minutes=options.minutes)
        gaussians = max(extent.points, most if options.growth != "none" else 0)
    units = units_of(extent, gaussians, options.steps)
    if any(step.name == "distil" for step in steps):
        steps = [*steps, Step("field", "run", "all of it in one file")]
    found = [_estimate(step, _cost(step.name, options), units, options, slower) for step in steps]
    if "load" in running and refinement(work) == "auto":
        fit = next(one for one in found if one.name == "gaussians")
        found = [_refined(one, fit) if one.name == "load" else one for one in found]
    return found


def _refined(load: Estimate, fit: Estimate) -> Estimate:
    """Of loading with poses and exposures refined: half of the fit's time more at most; not known where that is not."""
    if load.seconds is None or fit.seconds is None:
        return dataclasses.replace(load, seconds=None, compilation=None, memory_mib=None, disk_mib=None)
    assert load.compilation is not None
    assert load.memory_mib is not None
    return dataclasses.replace(
        load,
        seconds=load.seconds + fit.seconds / 2,
        compilation=load.compilation + (fit.compilation or 0.0),
        memory_mib=max(load.memory_mib, fit.memory_mib or 0.0),
    )


def _cost(name: str, options: Options) -> Cost | None:
    """None where nothing like it was measured."""
    others = {
        "load": options.refine not in ("none", "auto") or options.drop_frames != "none",
        "gaussians": options.gaussians is not None or options.start in ("dense", "random"),
        "masklets": any((options.masks, options.proposals, options.segmenter, options.tracker))
        or options.association != "consensus"
        or options.granularity == "coarse",
        "regions": options.embedder is not None or options.features is not None,
    }
    return None if others.get(name) else COSTS.get(name)


def _estimate(step: Step, cost: Cost | None, units: Mapping[str, float], options: Options, slower: float) -> Estimate:
    if step.status != "run":
        return Estimate(step.name, step.status, step.why)
    if cost is None:
        return Estimate(step.name, step.status, step.why, None, None, None, None)
    seconds, compilation, memory, disk = (sum((x * units[unit] for unit, x in part.items()), 0.0) for part in cost)
    if step.name == "gaussians" and options.minutes is not None:
        seconds = cost[0]["once"] + 60 * options.minutes / slower
    return Estimate(step.name, step.status, step.why, slower * seconds, slower * compilation, memory, disk)


def _extent(work: Work, running: set[str], place: Mapping[str, Path]) -> Extent:
    options = work.options
    given = {name: getattr(options, name) for name in ("downscale", "long_side", "frames")}
    if "load" not in running:
        capture = cache.load(place["load"]).value
        size = capture.cameras.width, capture.cameras.height
        return Extent(len(capture.names), size, size, len(capture.points), capture.names, capture.files)
    if "poses" not in place:
        return capture_extent(options.capture, **given)
    if "poses" not in running:
        return capture_extent(work.out / "poses", **given)
    if is_video(options.capture):
        count, source = options.frames or VIDEO_FRAMES, size_of(options.capture)
    else:
        photos = photographs(options.capture)
        paths = check_photographs(photos, options.capture)
        chosen = spread(len(photos), options.frames)
        sizes = [image_size(photo) for photo in photos]
        count, source = len(chosen), max(set(sizes), key=sizes.count)
        files = tuple(ImageFile(paths[i], *sizes[i]) for i in chosen)
        names = frame_names(paths, options.capture)
        size = shrunk(source, options.downscale, options.long_side)
        return Extent(count, size, source, 0, tuple(names[i] for i in chosen), files)
    return Extent(count, shrunk(source, options.downscale, options.long_side), source, 0)


def tell(work: Work, steps: Sequence[Step], place: Mapping[str, Path], listener: Listener) -> dict[str, Any]:
    """Says the stages with what each will cost, and the sums; returns them."""
    with listener.progress("estimates"):
        slower = statistics.median(workload() for _ in range(3)) / REFERENCE
        found = estimates(work, steps, place, slower)
    listener.say(f"{work.options.capture} -> {work.out}, a dry run: seconds, peak memory, disk")
    for one in found:
        listener.say(f"  {one.name:<16} {one.status:<9} {one.told():<30} {one.how}".rstrip())
    known = [one for one in found if one.seconds is not None]
    sums = {
        "seconds": sum(one.seconds or 0.0 for one in known),
        "compilation": sum(one.compilation or 0.0 for one in known),
        "memory_mib": max((one.memory_mib or 0.0 for one in known), default=0.0),
        "disk_mib": sum(one.disk_mib or 0.0 for one in known),
    }
    least = "" if len(known) == len(found) else "at least "
    again = f"{sums['compilation']:.0f} s more to compile where this machine has not seen such sizes"
    room = f"{sums['memory_mib']:.0f} MiB of memory, {sums['disk_mib']:.0f} MiB on disk"
    listener.say(f"in all {least}{sums['seconds']:.0f} s, and {again}; {room}. Nothing was written.")
    return {"stages": found, "slower": slower} | sums
