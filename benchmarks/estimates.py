"""What the stages of a run cost: the numbers in jsecon/pipeline/estimates.py, by which `jsecon run --dry-run` reckons.

    python benchmarks/estimates.py [--capture FOLDER ...] [--kept FILE]

Runs made-up rooms of several sizes, and captures where they are given, each twice and each time in a process of its
own: first without a compiled program on disk, then with all of them. The second gives the seconds of the work, the
difference the seconds of compilation. Seconds are divided by how much longer the threads took because they waited for
a core (Linux' schedstat), down to the processor time over all cores, so that other work on the machine counts little.
Of every stage the seconds, the memory (the kernel's VmHWM, reset where the stage begins; of the first run, which
compiles) and the bytes it leaves are fitted by its units, by least squares of the relative errors with nothing below
zero. Prints the table and how far it is from what it was fitted to. --kept: a JSON file of what was measured, to which
new cases are added.

The table that is kept is of the four rooms alone. On what it was not fitted to, on a quiet machine with all programs on
disk: the demo's room 28 s of work reckoned, 22 taken, 1.6 GiB for 1.5; bonsai at 400x266, 125 photographs, 122 s for
110, 2.6 GiB for 2.2. Where fifteen other threads want the two cores, `workload` sees too little of that: 80 and 102 s
reckoned for the demo's room (two tries), 158 taken; 28 s for 66 on 16 photographs of fox, whose 26 regions needed an
autoencoder (15 s), which no room does and the table leaves out.
"""

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls

from jsecon.process import cores, prepare_process

prepare_process()

from jsecon.data.capture import capture_extent
from jsecon.data.frames import Extent
from jsecon.pipeline.estimates import units_of, workload

ROOMS = (
    {"views": 12, "width": 160, "height": 120, "points": 1200, "steps": 150},
    {"views": 40, "width": 320, "height": 240, "points": 6000, "steps": 150},
    {"views": 20, "width": 480, "height": 360, "points": 8000, "steps": 100},
    {"views": 60, "width": 200, "height": 150, "points": 3000, "steps": 300},
)
CAPTURES = ({"frames": 30, "long_side": 240, "steps": 200}, {"frames": 24, "long_side": 500, "steps": 100})


def waiting() -> dict[str, tuple[int, int]]:
    """thread -> (ns on a core, ns of waiting for one), of this process, as Linux counts them."""
    found = {}
    for path in Path("/proc/self/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):  # the thread has ended
            worked, waited, _ = map(int, path.read_text().split())
            found[path.parent.name] = worked, waited
    return found


def one(capture: Path, options: dict[str, Any], out: Path) -> None:
    """A run, and what its stages took, to OUT/measured.json."""
    from jsecon.pipeline import pipeline
    from jsecon.pipeline.progress import Listener

    memory, quiet = {}, {}

    class Told(Listener):
        """Takes the peak memory of each stage, and how long its threads waited for a core."""

        before, worked = waiting(), time.process_time()

        def done(self, name: str, seconds: float, fresh: bool) -> None:
            status = Path("/proc/self/status").read_text()
            memory[name] = int(status.partition("VmHWM:")[2].split()[0]) / 1024
            Path("/proc/self/clear_refs").write_text("5")
            now = waiting()
            worked, waited = (sum(now[t][k] - self.before.get(t, (0, 0))[k] for t in now) for k in (0, 1))
            at_least = (time.process_time() - self.worked) / cores()  # threads that have ended count here alone
            quiet[name] = max(seconds / (1 + waited / worked), at_least)
            self.before, self.worked = now, time.process_time()

    run = pipeline.run(pipeline.Options(capture, **options), out, listener=Told())
    files = {file.stem.partition("-")[0]: file.stat().st_size / 2**20 for file in (out / "cache").glob("*-*.npz")}
    files["field"] = (out / "field.npz").stat().st_size / 2**20
    height, width = run.capture.frames.shape[1:3]
    extent = {"frames": len(run.capture.names), "steps": options["steps"]}
    extent |= {"gaussians": run.field.gaussians.count, "size": [width, height]}
    extent["source"] = capture_extent(capture).source
    told = {name: {"seconds": quiet[name], "memory": memory[name], "disk": files[name]} for name in run.seconds}
    (out / "measured.json").write_text(json.dumps({"extent": extent, "stages": told}))


def measured(capture: Path, options: dict[str, Any], work: Path) -> dict[str, Any]:
    """Seconds of work and of compilation, memory and disk of each stage."""
    environ = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(work / "programs")}
    environ |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    told = []
    for turn in ("first", "again"):
        command = [sys.executable, __file__, "--one", str(capture), json.dumps(options), str(work / turn)]
        subprocess.run(command, check=True, env=environ, stdout=sys.stderr)
        told.append(json.loads((work / turn / "measured.json").read_text()))
    return {"cold": told[0], "warm": told[1]}


def measure_all(captures: list[Path], kept: dict[str, Any], keep: Callable[[], object]) -> None:
    """Adds to `kept` what is not measured yet."""
    from jsecon.demo import write_room

    cases = [(f"room {room['views']}x{room['width']}", None, room) for room in ROOMS]
    cases += [(f"{path.name} {o['frames']}x{o['long_side']}", path, o) for path in captures for o in CAPTURES]
    for name, capture, options in cases:
        if name in kept:
            continue
        with tempfile.TemporaryDirectory() as folder:
            if capture is None:
                options = dict(options)
                steps = options.pop("steps")
                capture = write_room(Path(folder) / "room", 1, holdout=8, **options)
                options = {"steps": steps, "downscale": 1.0}
            kept[name] = measured(capture, options, Path(folder))
        keep()
        print(name, json.dumps(kept[name]), file=sys.stderr, flush=True)


SECONDS = {
    "load": ("once", "images"),
    "gaussians": ("once", "steps", "step_pixels", "step_gaussians"),
    "masklets": ("once", "frames", "views"),
    "regions": ("once", "frames"),
    "codes": ("once",),
    "votes": ("once", "frames", "views"),
    "distil": ("once", "gaussians"),
    "held_out": ("once", "frames", "views"),
    "field": ("once", "views"),
}
"""the units that a stage's seconds go with"""
MEMORY, DISK = ("once", "pixels", "frames"), ("once", "frames", "gaussians", "views")
"""those of memory and disk"""


def fitted(rows: list[dict[str, float]], names: Sequence[str], values: list[float]) -> dict[str, float]:
    """Figure of each unit, not below zero, by least squares of the relative errors; those of no weight are left out."""
    measured = np.maximum(np.array(values), 0.05)
    matrix = np.array([[row[name] for name in names] for row in rows]) / measured[:, None]
    found, _ = nnls(matrix, np.array(values) / measured)
    weight = (matrix * found).max(0)
    return {name: float(f"{value:.3g}") for name, value, most in zip(names, found, weight) if most > 0.05}


def table(kept: dict[str, Any]) -> str:
    """MEASURED as it stands in jsecon/pipeline/estimates.py, and beneath it the errors on what it was fitted to."""
    cases, rows, lines, errors = list(kept.values()), [], [], []
    for case in cases:
        told = dict(case["warm"]["extent"])
        frames, gaussians, steps = (told[name] for name in ("frames", "gaussians", "steps"))
        rows.append(units_of(Extent(frames, tuple(told["size"]), tuple(told["source"]), 0), gaussians, steps))
    for stage, names in SECONDS.items():
        of = lambda turn, what, stage=stage: [case[turn]["stages"][stage][what] for case in cases]
        warm, cold = of("warm", "seconds"), of("cold", "seconds")
        seconds, compilation = fitted(rows, names, warm), statistics.median(max(c - w, 0) for c, w in zip(cold, warm))
        memory, disk = fitted(rows, MEMORY, of("cold", "memory")), fitted(rows, DISK, of("cold", "disk"))
        parts = [seconds, {"once": float(f"{compilation:.3g}")}, memory, disk]
        words = [" ".join(f"{unit}={value:g}" for unit, value in part.items()) for part in parts]
        lines.append(" | ".join([f"{stage:<9}", *words]).rstrip())
        reckoned = [sum(value * row[name] for name, value in seconds.items()) for row in rows]
        errors.append(f"{stage:<10} " + " ".join(f"{r:.2g}/{w:.2g}" for r, w in zip(reckoned, warm)))
    return "\n".join(["MEASURED", *lines, "", f"seconds reckoned / measured: {', '.join(kept)}", *errors])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, action="append", default=[])
    parser.add_argument("--kept", type=Path)
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        return one(Path(given.one[0]), json.loads(given.one[1]), Path(given.one[2]))
    kept = json.loads(given.kept.read_text()) if given.kept and given.kept.exists() else {}
    measure_all(given.capture, kept, lambda: given.kept and given.kept.write_text(json.dumps(kept)))
    print(table(kept))
    print(f"REFERENCE = {min(workload() for _ in range(20)):.2g}")


if __name__ == "__main__":
    main()
