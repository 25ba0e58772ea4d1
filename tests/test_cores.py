"""Any number of cores gives the same answers; and machines without Unix's modules give any."""

import functools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import compiling
import numpy as np
import pytest
from small_field import colour_field

from jsecon import Scene
from jsecon.field.field import save_field

TESTS = Path(__file__).resolve().parent
PARTS = "votes", "image", "fit", "query"
VOTES = "regions", "weights", "labelled", "total", "max_pixel_weight", "views", "by_view"
VIEWS, HEIGHT, WIDTH = 5, 235, 50
"""fewer views than some numbers of devices; a strip for each of up to 8, and rows of pixels that few numbers divide"""


def work(out: str, field: str, word: str, parts: tuple[str, ...]) -> None:
    """Votes, a rendering, a few steps of a fit and a query on this process's devices, into the folder `out`."""
    import jax

    import jsecon
    from experiments.rooms.capture import look_at
    from jsecon.app.cli import main
    from jsecon.fit.optimise import Schedule, fit_gaussians

    rng = np.random.default_rng(0)
    count = 61
    scene = jax.tree.map(lambda column: column[:count], jsecon.load_field(field).gaussians)
    poses = np.stack([look_at((2.5 * np.sin(a), -2.5 * np.cos(a), 0.7), np.zeros(3)) for a in np.linspace(0, 1, VIEWS)])
    lens = (np.full(VIEWS, value, np.float32) for value in (45, 43, 25.5, 117))
    cameras = jsecon.Camera(poses, *lens, width=WIDTH, height=HEIGHT)
    labels = rng.integers(-1, 7, (VIEWS, HEIGHT, WIDTH))
    found = {}
    if "votes" in parts:
        votes = jsecon.region_votes(scene, cameras, labels, 7, by_view=True)
        found |= {name: getattr(votes, name) for name in VOTES}
    if "image" in parts:
        camera = jax.tree.map(np.asarray, cameras[0])
        found["image"] = jsecon.render_rgb(scene, camera, mesh=jsecon.host_mesh()).features
    if "fit" in parts:
        frames = rng.integers(0, 256, (VIEWS, HEIGHT, WIDTH, 3)).astype(np.uint8)
        points = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
        held_out = np.arange(VIEWS) == 4
        capture = jsecon.Capture(frames, cameras, *points, held_out, None, np.eye(4), tuple("abcde"))
        given = {"steps": 3, "key": jax.random.key(0), "chunk": 2}
        schedule = Schedule(sizes=((1.0, 1.0),), max_gaussians=2 * count)
        fitted, found["losses"] = fit_gaussians(capture, start=scene, schedule=schedule, **given)
        found |= {"means": fitted.means, "colours": fitted.sh}
    np.savez(f"{out}/found.npz", **{name: np.asarray(array) for name, array in found.items()})
    assert "query" not in parts or main(["query", field, word, "--out", f"{out}/answer"]) == 0


def answers(folder: Path) -> dict[str, bytes]:
    return {
        file.name: file.read_bytes() for file in folder.rglob("*") if file.suffix in (".png", ".npz", ".safetensors")
    }


@pytest.fixture(scope="module")
def asked(scene, cameras, tmp_path_factory) -> tuple[str, str]:
    """The file of a small field, and a colour that selects a part of it."""
    field = colour_field(scene, cameras)
    file = tmp_path_factory.mktemp("asked") / "field.safetensors"
    save_field(file, field)
    words = ("red", "green", "blue", "orange", "pink")
    return str(file), next(word for word in words if Scene(field).ask(word).mask.any())


@pytest.fixture(scope="module")
def two(asked, tmp_path_factory) -> Callable[[tuple[str, ...]], Path]:
    """Gives the folder of what this process computes on its two devices."""

    @functools.cache
    def folder_of(parts):
        folder = tmp_path_factory.mktemp("two")
        work(str(folder), *asked, parts)
        return folder

    return folder_of


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
    if path.stem not in ("__main__", "mcp_server"):  # the SDK of mcp asks for fcntl on what it takes for Unix
        importlib.import_module(".".join(path.relative_to(home.parent).with_suffix("").parts).removesuffix(".__init__"))
import jax
from test_cores import work
out, field, word, devices, parts = sys.argv[1:]
assert jax.local_device_count() == int(devices)
work(out, field, word, parts.split())
assert memory_budget() > 1 << 20 and peak_memory_mib() >= 0
assert not set({HIDDEN}) & set(sys.modules), set({HIDDEN}) & set(sys.modules)
"""


def agree(two: Path, found: Path) -> None:
    """Whether other devices gave the answers of two."""
    expected, found_arrays = (np.load(folder / "found.npz") for folder in (two, found))
    assert expected["weights"].max() > 1
    for name in found_arrays.files:
        if name in VOTES:  # added up in one order everywhere
            np.testing.assert_array_equal(found_arrays[name], expected[name], err_msg=name)
        else:  # the sums of gradients in another
            tolerance = 1e-6 if name == "image" else 2e-3
            np.testing.assert_allclose(found_arrays[name], expected[name], atol=tolerance, err_msg=name)
    assert answers(two / "answer")
    assert answers(found / "answer") == answers(two / "answer")


LONG = [pytest.param(devices, PARTS, marks=pytest.mark.long) for devices in (1, 3, 5, 6, 8, 16)]


@pytest.mark.parametrize(("devices", "parts"), [(3, ("votes", "image", "query")), *LONG])
def test_any_number_of_devices_gives_the_same_answers_without_the_modules_of_unix(two, asked, tmp_path, devices, parts):
    """Every module is imported there. (Long: a fit, whose step each number of devices compiles anew.)"""
    environ = os.environ | {
        "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices} {compiling.ENVIRONMENT}",
        "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)]),
    }
    line = [sys.executable, "-c", WITHOUT, str(tmp_path), *asked, str(devices), " ".join(parts)]
    done = subprocess.run(line, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    agree(two(parts), tmp_path)
