"""Where a run's seconds go: each stage, cold and warm, the programs compiled and the memory.

    python benchmarks/run.py CAPTURE [--out FOLDER] [--steps N] [--warm]
    PYTHONPATH=. python benchmarks/run.py rgbd     (a made-up room: 100 RGB-D frames of 400x300, 100,000 Gaussians)

Two processes, one after the other: cold, nothing cached, no program compiled before; warm, the frames and the Gaussians
kept from the first, its programs on disk. `--warm` leaves out the first where FOLDER holds a run already.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from jsecon.process import peak_memory_mib, prepare_process

KEPT = "load", "gaussians"
"""stages of the cold run that the warm one finds in the cache"""
ASKED = "objects", "regions", "votes", "held_out"
"""whose warm seconds are added up"""


def measure(capture: Path, out: Path, steps: int) -> None:
    """One run in this process; prints its figures as JSON."""
    prepare_process()
    import jax
    import numpy as np

    from jsecon.pipeline import run as pipeline
    from jsecon.pipeline.options import Options

    programs = {"all": 0, "from_disk": 0}  # compiled from here on

    def count(event: str, *_: object, **__: object) -> None:
        name = {"backend_compile_duration": "all", "cache_hits": "from_disk"}.get(event.rpartition("/")[2])
        if name is not None:
            programs[name] += 1

    jax.monitoring.register_event_listener(count)
    jax.monitoring.register_event_duration_secs_listener(count)
    run = pipeline.run(Options(capture, steps=steps), out)
    figures = {
        "seconds": run.seconds,
        "programs": programs,
        "peak_mib": peak_memory_mib(),
        "psnr": float(np.mean(run.held_out.psnr)),
        "gaussians": run.field.gaussians.count,
        "regions": run.field.regions.count,
    }
    print(json.dumps(figures))


def rgbd_room(folder: Path, *, seed: int = 0, views: int = 100, width: int = 400, height: int = 300) -> Path:
    """Writes the synthetic room as a nerfstudio capture whose depth frames have the noise of a sensor (1 mm at 1 m,
    growing with z^2) in millimetres. Returns the folder; one that is there already is left as it is."""
    import cv2
    import numpy as np

    from experiments.datasets.plain_room import make_room
    from experiments.rooms import render_views, room_cameras

    if (folder / "transforms.json").exists():
        return folder
    room = make_room(seed)
    cameras = room_cameras(room, views=views, width=width, height=height)
    frames, _, depths = render_views(room, cameras)
    draw = np.random.default_rng(seed)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "depth").mkdir(exist_ok=True)
    entries = []
    for t, (frame, depth) in enumerate(zip(frames, depths)):
        noisy = 1000.0 * (depth + 0.001 * depth**2 * draw.standard_normal(depth.shape))
        cv2.imwrite(str(folder / f"images/{t:03d}.png"), frame[..., ::-1])
        cv2.imwrite(str(folder / f"depth/{t:03d}.png"), noisy.round().astype(np.uint16))
        camera_to_world = np.linalg.inv(cameras.world_to_camera[t].astype(np.float64)) * [1, -1, -1, 1]
        entries.append(
            {
                "file_path": f"images/{t:03d}.png",
                "depth_file_path": f"depth/{t:03d}.png",
                "transform_matrix": camera_to_world.tolist(),
            }
        )
    lens = {"fl_x": float(cameras.fx[0]), "fl_y": float(cameras.fy[0]), "cx": width / 2, "cy": height / 2}
    scene = {"camera_model": "PINHOLE", **lens, "w": width, "h": height, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(scene))
    return folder


def run_apart(capture: Path, out: Path, steps: int, environ: dict[str, str]) -> dict:
    """`measure` in a process of its own."""
    command = [sys.executable, __file__, str(capture), "--out", str(out), "--steps", str(steps), "--measure"]
    text = subprocess.run(command, env=environ, check=True, stdout=subprocess.PIPE, text=True).stdout
    return json.loads(text.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--warm", action="store_true")
    parser.add_argument("--steps", type=int, default=1500, help="of the fit, which is not what is timed")
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.measure:
        return measure(Path(arguments.capture), arguments.out, arguments.steps)
    out = arguments.out or Path(tempfile.mkdtemp(prefix="jsecon-run-"))
    capture = rgbd_room(out / "capture") if arguments.capture == "rgbd" else Path(arguments.capture)
    out = out / "run"
    # The programs of this benchmark alone, kept as `jsecon` keeps them.
    environ = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    environ["XDG_CACHE_HOME"] = str(out / "home")
    found = {} if arguments.warm else {"cold": run_apart(capture, out, arguments.steps, environ)}
    for file in (out / "cache").glob("*.safetensors"):
        if not file.name.startswith(KEPT):
            file.unlink()
    found["warm"] = run_apart(capture, out, arguments.steps, environ)
    print("| " + " | ".join(["stage", *(f"{name}, s" for name in found)]) + " |")
    print("|---" * (1 + len(found)) + "|")
    for stage in found["warm"]["seconds"]:
        print(f"| {stage} | " + " | ".join(f"{told['seconds'][stage]:.1f}" for told in found.values()) + " |")
    sums = [sum(told["seconds"][stage] for stage in ASKED) for told in found.values()]
    print(f"| {' + '.join(ASKED)} | " + " | ".join(f"{seconds:.1f}" for seconds in sums) + " |")
    for name, told in found.items():
        print(
            f"{name}: {told['gaussians']} Gaussians, {told['regions']} regions, {told['psnr']:.2f} dB held out, "
            f"peak {told['peak_mib']:.0f} MiB, {told['programs']}"
        )


if __name__ == "__main__":
    main()
