"""Two processes against one, each with a core of its own, on one capture.

    python benchmarks/processes.py [CAPTURE] [--repeats 3] [--long-side 400] [--steps 300]

Fits the capture's Gaussians once, which several processes don't share; then runs all the rest by one process on one
core and by `mpirun -n 2` on two, one after the other, a first time to compile and then `--repeats` times.
Prints of each stage that is shared the median seconds and the ratio, and whether the fields are the same to the bit.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

STAGES = ("objects", "regions", "votes", "held_out")
ONE, TWO = "one process", "two processes"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("capture", nargs="?", default="../shared/captures/bonsai")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--long-side", type=int, default=400)
    parser.add_argument("--steps", type=int, default=300)
    given = parser.parse_args()
    jsecon = [sys.executable, "-m", "jsecon"]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        common = [given.capture, "--long-side", str(given.long_side)]
        fit = [*jsecon, "fit", *common, "--out", str(place / "scene.ply"), "--steps", str(given.steps)]
        subprocess.run(fit, check=True, stdout=subprocess.DEVNULL)
        run = [*jsecon, "run", *common, "--gaussians", str(place / "scene.ply")]
        mpirun = ["mpirun", "--allow-run-as-root", "-n", "2"]
        how = {ONE: (["taskset", "-c", "0"], []), TWO: (mpirun, ["--distributed"])}
        seconds = {name: {stage: [] for stage in STAGES} for name in how}
        for repeat in range(given.repeats + 1):
            for name, (before, behind) in how.items():
                out = place / name.replace(" ", "_")
                shutil.rmtree(out, ignore_errors=True)
                subprocess.run(
                    [*before, *run, "--out", str(out), *behind], check=True, stdout=subprocess.DEVNULL, stderr=-1
                )
                for stage, taken in json.loads((out / "metrics.json").read_text())["seconds"].items():
                    if stage in STAGES and repeat:
                        seconds[name][stage].append(taken)
        a, b = (load_file(place / name.replace(" ", "_") / "field.safetensors") for name in (ONE, TWO))
        columns = sorted(a)
        unlike = [name for name in columns if not np.array_equal(a[name], b[name])]
    print(f"columns of the field that differ: {', '.join(unlike) or f'none of {len(columns)}'}")
    median = {name: [statistics.median(taken) for taken in of.values()] for name, of in seconds.items()}
    print(f"| stage | {ONE}, s | {TWO}, s | ratio |\n|---|---|---|---|")
    for stage, one, two in (*zip(STAGES, *median.values()), ("all", *map(sum, median.values()))):
        print(f"| {stage} | {one:.1f} | {two:.1f} | {one / two:.2f} |")


if __name__ == "__main__":
    main()
