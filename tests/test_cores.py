"""Any number of cores gives the same answers; and machines without Unix's modules give any."""

import os
import subprocess
import sys
from pathlib import Path

import compiling
import numpy as np
import pytest

TESTS = Path(__file__).resolve().parent
DEVICES = (1, 3, 6)
VIEWS, HEIGHT, WIDTH = 5, 43, 50
"""fewer views than 6 devices; rows of pixels that no number of devices divides"""


def work(out: str, field: str) -> None:
    """Votes, a rendering, a few steps of a fit and a query on this process's devices, into the folder `out`."""
    import jax
    from conftest import look_at

    import jsecon
    from jsecon.app.command_line import main
    from jsecon.fit.optimise import fit_gaussians
    from jsecon.fit.schedule import Schedule

    rng = np.random.default_rng(0)
    count = 61
    scene = jsecon.Gaussians(
        means=rng.uniform(-0.6, 0.6, (count, 3)).astype(np.float32),
        log_scales=np.log(rng.uniform(0.05, 0.2, (count, 3))).astype(np.float32),
        quaternions=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.uniform(-1.0, 3.0, count).astype(np.float32),
        sh=rng.normal(size=(count, 1, 3)).astype(np.float32),
    )
    poses = np.stack([look_at((2.5 * np.sin(a), -0.7, -2.5 * np.cos(a))) for a in np.linspace(0, 1, VIEWS)])
    lens = (np.full(VIEWS, value, np.float32) for value in (45, 43, 25.5, 21))
    cameras = jsecon.Camera(poses, *lens, width=WIDTH, height=HEIGHT)
    labels = rng.integers(-1, 7, (VIEWS, HEIGHT, WIDTH))
    votes = jsecon.region_votes(scene, cameras, labels, 7, by_view=True)
    found = {name: getattr(votes, name) for name in ("regions", "weights", "labelled", "total", "peak", "by_view")}
    camera = jax.tree.map(np.asarray, cameras[0])
    found["image"] = jsecon.render_rgb(scene, camera, mesh=jsecon.host_mesh()).features
    frames = rng.integers(0, 256, (VIEWS, HEIGHT, WIDTH, 3)).astype(np.uint8)
    points = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    held_out = np.arange(VIEWS) == 4
    capture = jsecon.Capture(frames, cameras, *points, held_out, None, np.eye(4), tuple("abcde"))
    schedule = Schedule(sizes=((1.0, 1.0),), growth="mcmc", at_most=count)
    fitted, found["losses"] = fit_gaussians(
        capture, start=scene, steps=3, key=jax.random.key(0), schedule=schedule, chunk=2
    )
    found |= {"means": fitted.means, "colours": fitted.sh}
    np.savez(f"{out}/found.npz", **{name: np.asarray(array) for name, array in found.items()})
    assert jax.local_device_count() == int(Path(out).name)
    assert main(["query", field, "red mug", "--out", f"{out}/answer"]) == 0


@pytest.fixture(scope="module")
def on(room_run, tmp_path_factory) -> dict[int, Path]:
    """Number of devices -> the folder of what a process with so many found."""
    _, folder = room_run
    base, running = tmp_path_factory.mktemp("cores"), {}
    for count in DEVICES:
        (base / str(count)).mkdir()
        environ = os.environ | {
            "XLA_FLAGS": f"--xla_force_host_platform_device_count={count} {compiling.ENVIRONMENT}",
            "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)]),
        }
        given = str(base / str(count)), str(folder / "field.npz")
        line = [sys.executable, "-c", f"from test_cores import work; work{given}"]
        running[count] = subprocess.Popen(line, env=environ, stdout=-1, stderr=-2, text=True)
    for process in running.values():
        said, _ = process.communicate(timeout=300)
        assert process.returncode == 0, said
    return {count: base / str(count) for count in DEVICES}


@pytest.mark.parametrize("devices", DEVICES[1:])
def test_any_number_of_devices_gives_the_same_answers(on, devices):
    one, several = (np.load(on[count] / "found.npz") for count in (1, devices))
    assert one["weights"].max() > 1
    for name in ("regions", "weights", "labelled", "total", "peak", "by_view"):
        np.testing.assert_array_equal(several[name], one[name], err_msg=name)
    np.testing.assert_allclose(several["image"], one["image"], atol=1e-6)
    for name in (
        "losses",
        "means",
        "colours",
    ):  # gradients are summed in another order, and Adam's steps are of one size
        np.testing.assert_allclose(several[name], one[name], atol=2e-3, err_msg=name)
    answers = [
        {file.name: file.read_bytes() for file in (on[count] / "answer").rglob("*") if file.suffix in (".png", ".npz")}
        for count in (1, devices)
    ]
    assert answers[0]
    assert answers[0] == answers[1]


HIDDEN = "fcntl", "resource", "termios", "pwd", "grp"
WITHOUT = f"""
import importlib, importlib.abc, pathlib, sys

class Hide(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in {HIDDEN}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Hide())
for name in {HIDDEN}:
    sys.modules.pop(name, None)

import signal
for name in ("SIGKILL", "SIGHUP"):
    delattr(signal, name)

from jsecon.process import memory_budget, peak_memory_mib, prepare_process
prepare_process()
import jsecon
home = pathlib.Path(jsecon.__file__).parent
for path in sorted(home.rglob("*.py")):
    if path.stem != "__main__":
        importlib.import_module(".".join(path.relative_to(home.parent).with_suffix("").parts).removesuffix(".__init__"))
from jsecon.app.command_line import main
code = main(["query", sys.argv[1], "red mug", "--out", sys.argv[2]])
assert memory_budget() > 1 << 20 and peak_memory_mib() >= 0
assert not set({HIDDEN}) & set(sys.modules), set({HIDDEN}) & set(sys.modules)
sys.exit(code)
"""


def test_every_module_is_imported_and_a_query_answered_without_the_modules_of_unix(on, room_run, tmp_path):
    _, folder = room_run
    environ = os.environ | {"PYTHONPATH": str(TESTS.parent)}
    line = [sys.executable, "-c", WITHOUT, str(folder / "field.npz"), str(tmp_path)]
    done = subprocess.run(line, env=environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    answers = [{f.name: f.read_bytes() for f in where.rglob("*.npz")} for where in (tmp_path, on[1] / "answer")]
    assert answers[0]
    assert answers[0] == answers[1]
