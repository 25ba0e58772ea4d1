"""Point clouds from file to Gaussians, and labels back: seconds, places and peak memory, in each format.

    python benchmarks/point_clouds.py --points 10000000

Hills of 100 m at coordinates of a map (1e6 m and more), with colours and without. Each format is written by the library
of its makers, and read in a process of its own.
"""

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from jsecon.process import peak_memory_mib, prepare_process

prepare_process()
sys.path.append(str(Path(__file__).parents[1] / "tests"))

import numpy as np
from point_files import OFFSET, WRITERS

from jsecon.read.splats.formats import read_gaussians
from jsecon.read.splats.point_clouds import load_point_cloud, save_point_cloud
from jsecon.splat.points import nearest_gaussians

NAMES = ("a.las", "a.laz", "a.e57", "binary.pcd", "compressed.pcd", "a.xyz", "points.ply")


def hills(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points on multiples of 1 mm, and colours of 8 bits."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 100, (2, count))
    points = np.stack([x, y, 2 * np.sin(x / 7) * np.cos(y / 9)], axis=1).round(3)
    return points + OFFSET, rng.integers(1, 256, (count, 3)).astype(np.uint8)


def one(file: Path, count: int, coloured: bool, back: bool) -> dict[str, float]:
    """Reads a file; compares places, colours and the hills that the Gaussians lie on; writes labels back."""
    start, worked = time.perf_counter(), time.process_time()
    gaussians, _ = read_gaussians(file)
    told = {"to Gaussians, s": time.perf_counter() - start, "s of CPU": time.process_time() - worked}
    told["Gaussians"] = gaussians.count
    x, y, z = (gaussians.means - OFFSET).T
    told["median off the hills, mm"] = 1000 * float(np.median(np.abs(z - 2 * np.sin(x / 7) * np.cos(y / 9))))
    told["peak GiB"] = peak_memory_mib() / 1024
    if back:
        start, worked = time.perf_counter(), time.process_time()
        nearest = nearest_gaussians(load_point_cloud(file).points, gaussians)
        ids = {"object_id": nearest.astype(np.int32), "class_id": (nearest % 50).astype(np.int32)}
        save_point_cloud(file.with_name("out.laz"), file, np.arange(count), ids)
        told["labels back to .laz, s"] = time.perf_counter() - start
        told["of CPU, s"] = time.process_time() - worked
        told["points without a Gaussian"] = int((nearest < 0).sum())
    points, colours = hills(count)
    found = load_point_cloud(file.with_name("out.laz") if back else file)
    told["largest error, mm"] = 1000 * float(np.abs(found.points - points).max())
    told["colours that differ"] = int((found.colors != (colours if coloured else 128)).any(1).sum())
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, default=10_000_000)
    parser.add_argument("--only", nargs="*", default=NAMES)
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        file, coloured, back = given.one
        return print(json.dumps(one(Path(file), given.points, coloured == "True", back == "True")))
    points, colours = hills(given.points)
    for name, coloured in itertools.product(given.only, (True, False)):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, name)
            WRITERS[name](file, points, colours if coloured else None)
            command = [sys.executable, __file__, "--points", str(given.points), "--one"]
            command += [str(file), str(coloured), str(coloured and name == "a.laz")]
            told = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
        words = ", ".join(f"{key} {value:.4g}" for key, value in told.items())
        print(f"{name} {'with' if coloured else 'without'} colours: {words}", flush=True)


if __name__ == "__main__":
    main()
