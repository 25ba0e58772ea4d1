"""Shared fixtures and hooks: type checks at run time, a float64 switch, a small scene, a finished run.

Two host devices, the flags of `compiling` and the import hook are set before jax makes its first array and before
jsecon is imported.
"""

import atexit
import contextlib
import functools
import gc
import os
import pickle
import shutil
import tempfile
from pathlib import Path

import compiling

os.environ.setdefault("XLA_FLAGS", f"--xla_force_host_platform_device_count=2 {compiling.ENVIRONMENT}")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of a worker: threads of several wait by spinning
os.environ.setdefault("OMP_NUM_THREADS", "1")
# glibc of workers and subprocesses: freed memory is used again without a search, 5 % of a small program's time, and
# never goes back to the kernel, whose new pages take 1 % of a test's (as `prepare_process` sets it)
os.environ.setdefault(
    "GLIBC_TUNABLES",
    "glibc.malloc.tcache_count=4000:glibc.malloc.mmap_threshold=2147483647:"
    "glibc.malloc.trim_threshold=2147483647:glibc.malloc.top_pad=67108864",
)
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")  # as the command line sets them
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

# Subprocesses of a run share one folder of compiled programs. xdist's workers inherit it.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="jsecon-tests-")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import beartype
import jax
import pytest
from filelock import FileLock
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

# The tests' own processes compile programs of their own: to write all takes longer than to compile twice the few that
# another process, or a cleared cache, would read.
jax.config.update("jax_compilation_cache_dir", None)

HOME = Path(__file__).resolve().parent.parent


def checked(function):
    """beartype's checks of a module's function; one inside another would get them anew at each call of that."""
    return function if "<locals>" in function.__qualname__ else beartype.beartype(function)


# The modules whose signatures have shapes: a check of any other costs more than its call. jsecon.types is left out, as
# pytrees are also built from tracers, shapes and None while jax transforms them. A process that compiles as a user's
# does runs the modules as they are.
if not compiling.is_shipped():
    files = [path for path in (HOME / "jsecon").rglob("*.py") if path.stem != "types"]
    shaped = [path.relative_to(HOME).with_suffix("") for path in files if "from jaxtyping" in path.read_text()]
    install_import_hook([".".join(path.parts) for path in shaped], "conftest.checked")

# A loaded machine, or hypothesis' first table of Unicode, is no fault of a test. CI draws the same examples each time.
_SLOW = [HealthCheck.too_slow]
settings.register_profile("jsecon", deadline=None, suppress_health_check=_SLOW, derandomize="CI" in os.environ)
settings.load_profile("jsecon")

import numpy as np  # noqa: E402

from experiments.memory_maps import clear_programs  # noqa: E402
from jsecon.types import Camera, Capture, Gaussians  # noqa: E402

MANY = pytest.param(40_000, marks=[pytest.mark.as_shipped, pytest.mark.long])
"""so many rows that jax was silently wrong in float32 (its issue 39103: about 32,769 to 43,000); in every run
test_numerics.py has the products that all functions are made of at such a size"""

# Tracing makes many objects and few cycles: ten times fewer collections save a tenth of a test's time.
gc.freeze()
gc.set_threshold(20_000, 20, 20)

LONGEST = (
    "compiling", "pipeline", "corrections", "fit", "views", "render", "cores", "cli", "readme", "networks",
    "capacity", "relations", "retrieval", "votes", "tiles", "anchored", "distill", "motion", "photometric", "evidence",
)  # fmt: skip
"""files, without test_, that start first; files that use `room_run` come after test_pipeline, which makes it"""


def pytest_collection_modifyitems(items):
    """Leaves tests marked `as_shipped` to test_compiling.py, and sorts the longest files first: they would keep one
    worker busy alone at the end."""
    if not compiling.is_shipped():
        items[:] = [item for item in items if item.get_closest_marker("as_shipped") is None]
    place = {name: n for n, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem.removeprefix("test_"), len(place)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """After a file, clears the programs if they hold many of the process's memory maps."""
    done = yield
    if nextitem is None or nextitem.path != item.path:
        clear_programs(above=40_000)
    return done


@pytest.fixture
def x64():
    """Enables float64 for one test, for gradients against central differences."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def scene() -> Gaussians:
    """64 Gaussians of many sizes, turns and opacities in a unit ball at the origin, SH degree 1, float32 NumPy."""
    rng = np.random.default_rng(0)
    count = 64
    means, sizes = rng.uniform(-0.6, 0.6, (count, 3)), rng.uniform(0.02, 0.2, (count, 3))
    turns, logit = rng.normal(size=(count, 4)), rng.uniform(-2.0, 4.0, count)
    return gaussians_at(means, sizes, turns=turns, logit=logit, sh=0.3 * rng.normal(size=(count, 4, 3)))


def gaussians_at(means, size, *, turns=(1, 0, 0, 0), logit=3.0, sh=((0, 0, 0),)) -> Gaussians:
    """Float32 Gaussians at `means` (N, 3); standard deviations, turns, opacities and harmonics of each or of all."""
    shapes = (3,), (3,), (4,), (), np.shape(sh)[-2:]
    columns = zip((means, np.log(size), turns, logit, sh), shapes)
    return Gaussians(*(np.array(np.broadcast_to(a, (len(means), *shape)), np.float32) for a, shape in columns))


def look_at(centre, target=(0.0, 0.0, 0.0), up=(0.0, -1.0, 0.0), dtype=np.float32) -> np.ndarray:
    """(4, 4) world_to_camera, OpenCV axes, of a camera at `centre` that looks at `target`."""
    centre, target, up = (np.asarray(v, np.float64) for v in (centre, target, up))
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross(-up, z) / np.linalg.norm(np.cross(up, z))
    y = np.cross(z, x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, y, z])
    matrix[:3, 3] = -matrix[:3, :3] @ centre
    return matrix.astype(dtype)


def cameras_of(poses, lens, width: int, height: int) -> Camera:
    """Cameras of one lens (fx, fy, cx, cy) at `poses` (T, 4, 4), float32."""
    columns = (np.full(len(poses), number, np.float32) for number in lens)
    return Camera(np.asarray(poses, np.float32), *columns, width=width, height=height)


def capture_of(frames, cameras, held_out, depths=None, **more) -> Capture:
    """A capture without points, whose frames are called f0, f1 and so on."""
    points = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    names = tuple(f"f{t}" for t in range(len(frames)))
    return Capture(np.asarray(frames, np.uint8), cameras, *points, held_out, depths, np.eye(4), names, **more)


@pytest.fixture(scope="session")
def cameras() -> Camera:
    """Four cameras of 48x40 on a ring of radius 2.5 about the scene, principal point off the middle; a batch."""
    poses = np.stack([look_at((2.5 * np.sin(a), -0.7, -2.5 * np.cos(a))) for a in (0.0, 1.4, 3.0, 4.7)])
    return cameras_of(poses, (45, 43, 25.5, 19), 48, 40)


@pytest.fixture(scope="session")
def camera(cameras) -> Camera:
    """The first of the four."""
    return cameras[0]


@pytest.fixture(scope="session")
def made(scene, cameras):
    """The small field of the scene, and its label images."""
    from small_field import make_field

    return make_field(scene, cameras)


@pytest.fixture(scope="session")
def field(made):
    """The small field of the scene."""
    return made[0]


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of real captures beside the checkout; without it the test is skipped."""
    folder = HOME.parent / "shared"
    if not (folder / "captures").is_dir():
        pytest.skip("no real captures beside the checkout")
    return folder


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """A context manager for a folder that all workers share: one worker fills it while the others wait."""

    @contextlib.contextmanager
    def alone(name):
        base = tmp_path_factory.getbasetemp()
        base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
        with FileLock(base / f"{name}.lock"):
            yield base / name

    return alone


@pytest.fixture(scope="session", autouse=True)
def _bake_once():
    """Lights the surfaces of a made-up room once a process: most of the time of a small rendering."""
    from experiments.rooms import raycast

    bake, kept = raycast.bake_room, {}

    @functools.wraps(bake)
    def once(room, **options):
        key = pickle.dumps((room, options))
        if key not in kept:
            kept[key] = bake(room, **options)
        return kept[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raycast, "bake_room", once)
        yield


@pytest.fixture(scope="session")
def room(made_once) -> Path:
    """A small demo room on disk, in a folder of an odd name: 8 views of 160x120, 2 held out."""
    from experiments.datasets.plain_room import make_room
    from experiments.rooms import write_room

    with made_once("Büro für Köln 日本 #1 %20 'é'") as folder:
        if not (folder / "written").exists():
            write_room(folder / "capture", make_room(0), views=8, width=160, height=120, holdout=4, points=1200)
            (folder / "written").touch()
    return folder / "capture"


@pytest.fixture(scope="session")
def room_run(room, made_once, tmp_path_factory):
    """(result, folder) of a finished run on the room with its true masks; the folder is this worker's copy."""
    from capture_files import ROOM_FIT

    from jsecon.pipeline import run as pipeline

    options = pipeline.Options(room, masks=room / "masks", **ROOM_FIT)
    with made_once("run") as folder:
        pipeline.run(options, folder)
        own = Path(shutil.copytree(folder, tmp_path_factory.mktemp("run") / "Ausgabe ß 出力"))
    return pipeline.run(options, own), own  # a field names the folders of its run as seen from its own
