"""What only a program may do to its process: the library itself never touches the one it lives in.

Before jax starts, once: `jsecon` on the command line calls `prepare_process` first. A program of your own that wants
both cores and the speed of benchmarks/results.md does the same:

    from jsecon.process import prepare_process
    prepare_process()
    import jsecon

From time to time, where it lives long and sees many scenes: `clear_programs()`.
"""

import _thread
import contextlib
import ctypes
import gc
import hashlib
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jsecon.errors import InputError

# mallopt's parameters (malloc.h), and values: a request is served from memory that was freed before, not from the
# kernel, whose pages cost more to touch anew than a kernel of XLA takes to fill them.
_MALLOPT = {-3: (1 << 31) - 1, -1: (1 << 31) - 1, -2: 1 << 26}
_OPENCV = {"OPENCV_LOG_LEVEL": "OFF", "OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_IO_MAX_IMAGE_PIXELS": str(1 << 27)}
"""what OpenCV says of a damaged file is said in an InputError; and the largest image that it makes room for"""
WORKER = "JSECON_WORKER"
"""environment variable of a process that is one of several (pipeline/processes.py), see `worker_info`"""
MEMORY = "JSECON_MEMORY"
"""environment variable: GiB that a scene's columns may take, in place of half of the memory that is free"""
AGAIN_SECONDS = 0.05
"""after which a stop that Python dropped is raised again: the destructor has ended"""
_UNKEPT = r"Error (?:reading|writing) persistent compilation cache entry for '([\w.-]+)'"
"""how jax warns of a program that it cannot read from disk, or keep there"""
_built: dict[str, int] = {}


def prepare_process(*, keep_programs: bool = True) -> None:
    """Sets XLA's flags (see `settings`), silences OpenCV and keeps freed memory for the next request (glibc only). Call
    it before jax makes its first array and OpenCV is imported. What the user has set in the environment stays; without
    `keep_programs`, compiled programs are not kept on disk."""
    chosen = settings(os.environ, cores(), _cpu_features())
    if not keep_programs:
        chosen.pop("JAX_COMPILATION_CACHE_DIR", None)
    os.environ.update({name: value for name, value in _OPENCV.items() if name not in os.environ} | chosen)
    if (folder := chosen.get("JAX_COMPILATION_CACHE_DIR")) is not None:
        _remove_damaged_programs(Path(folder))
    if sys.platform == "linux" and not any(name.startswith("MALLOC_") for name in os.environ):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", lambda parameter, value: None)
        for parameter, value in _MALLOPT.items():
            mallopt(parameter, value)


def _remove_damaged_programs(folder: Path) -> None:
    """From now on, where jax warns of a program in `folder`, the files of that name go, and nothing is said.

    jax writes to a program's final name: a full disk, or a stop amid the writing, leaves a part there, of which it
    would warn for ever, and never write it anew. `jsecon doctor` tells of a disk without room for programs.
    """
    show = warnings.showwarning

    def shown(message: Warning | str, *rest: Any, **given: Any) -> None:
        told = re.match(_UNKEPT, str(message))
        if told is None:
            return show(message, *rest, **given)
        for file in folder.glob(f"{told[1]}-*-cache"):
            with contextlib.suppress(OSError):
                file.unlink()

    warnings.showwarning = shown
    warnings.filterwarnings("always", _UNKEPT)  # of each, also where two are called alike


def worker_info() -> tuple[int, int, str] | None:
    """(index, count, HOST:PORT of the first) where this is one of the processes of a run, else None."""
    told = os.environ.get(WORKER, "").split()
    return (int(told[0]), int(told[1]), told[2]) if told else None


def prepare_worker() -> None:
    """A member keeps to the cores that WORKER names last ("0,2"); what C++ writes to the terminal is dropped: pages,
    where another process of the run dies. What Python writes stays. Before `prepare_process`."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {int(core) for core in os.environ[WORKER].split()[3].split(",")})
    for number, name in ((1, "stdout"), (2, "stderr")):
        getattr(sys, name).flush()
        kept = os.dup(number)
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        setattr(sys, name, os.fdopen(kept, "w", buffering=1))


def stop_by_signals() -> None:
    """SIGTERM raises KeyboardInterrupt, as Ctrl-C does, so that what is half written is removed. One that Python drops
    (it fell into a destructor, or a callback of the garbage collector, as jax has one) is raised again soon after."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    show = sys.unraisablehook

    def shown(dropped: Any) -> None:
        if dropped.exc_type is not KeyboardInterrupt:
            return show(dropped)
        again = threading.Timer(AGAIN_SECONDS, _stop_main)
        again.daemon = True
        again.start()

    sys.unraisablehook = shown


def _stop_main() -> None:
    """Sends SIGTERM to the main thread; SIGINT may be ignored, as in a shell's background."""
    if hasattr(signal, "pthread_kill"):  # it also ends a call that waits, such as a sleep
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    else:
        _thread.interrupt_main(signal.SIGTERM)


def cores() -> int:
    """The CPU cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_memory() -> tuple[int | None, int | None]:
    """Bytes that are free, and the limit of this process's cgroup, which what is free counts in; None where the system
    does not tell, or sets none."""
    try:
        import psutil

        free = psutil.virtual_memory().available
    except (ImportError, OSError):
        return None, None
    limit = read_cgroup("memory.max", "memory/memory.limit_in_bytes")
    if not limit or not limit[0].isdecimal() or int(limit[0]) >= 1 << 60:  # more is no limit
        return free, None
    used = read_cgroup("memory.current", "memory/memory.usage_in_bytes") or ["0"]
    return min(free, int(limit[0]) - int(used[0])), int(limit[0])


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far, MiB; 0 where the system does not tell."""
    with contextlib.suppress(ImportError):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
    with contextlib.suppress(ImportError):  # Windows
        import psutil

        now = psutil.Process().memory_info()
        return getattr(now, "peak_wset", now.rss) / 2**20
    return 0.0


def memory_budget() -> float:
    """Bytes that a scene's columns may take, above which they are read in blocks: half of what is free, as reading
    takes twice what it reads, or what MEMORY says. Raises InputError where that is no number."""
    told = os.environ.get(MEMORY)
    if told is None:
        return float("inf") if (free := available_memory()[0]) is None else free / 2
    try:
        return float(told) * 2**30
    except ValueError:
        raise InputError(MEMORY, repr(told), "GiB, a number", f"For example: export {MEMORY}=4") from None


def read_cgroup(new: str, old: str) -> list[str]:
    """The words of a file of this process's cgroup, of version 2 or else 1; none where there is none."""
    try:
        own = dict(line.split(":", 2)[1:] for line in Path("/proc/self/cgroup").read_text().splitlines())
    except (OSError, ValueError):
        return []
    kind, _, name = old.partition("/")
    group = own.get(kind, "/").lstrip("/")
    top, at = Path("/sys/fs/cgroup"), own.get("", "/").lstrip("/")
    places = (top / at / new, top / new, top / kind / group / name, top / kind / name)
    return next((path.read_text().split() for path in places if path.is_file()), [])


def compilation_counts() -> dict[str, int]:
    """How many programs jax has built since this was first called: all of them, and those read from disk."""
    import jax

    if not _built:
        _built.update(all=0, from_disk=0)

        def count(event: str, *_: object, **__: object) -> None:
            name = {"backend_compile_duration": "all", "cache_hits": "from_disk"}.get(event.rpartition("/")[2])
            if name is not None:
                _built[name] += 1

        jax.monitoring.register_event_listener(count)
        jax.monitoring.register_event_duration_secs_listener(count)
    return dict(_built)


def show_full_tracebacks() -> None:
    """Errors keep jax's own frames; call it before jax is imported."""
    os.environ.setdefault("JAX_TRACEBACK_FILTERING", "off")


def clear_programs(*, above: int = 25_000) -> bool:
    """Forgets jax's compiled programs where the process holds more than `above` memory maps; whether it did.

    Linux grants a process 65,530 of them and XLA takes several a program: one that sees scene after scene, each with
    sizes of its own, ends in "Unable to allocate section memory". Programs are compiled again, or read from disk, when
    they are next called. Where the maps can't be counted (not Linux) nothing is forgotten.
    """
    try:
        held = Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return False
    if held <= above:
        return False
    import jax

    jax.clear_caches()
    gc.collect()
    return True


def settings(environ: Mapping[str, str], cores: int, cpu_features: frozenset[str]) -> dict[str, str]:
    """The variables to set: one host device per core, full-width vectors, compiled programs kept between runs.

    Flags already in XLA_FLAGS stay as they are. 512-bit vectors are asked for only where the CPU has them. The folder
    of compiled programs carries a digest of the CPU's features, so that a home shared by unlike machines stays safe.
    """
    flags = environ.get("XLA_FLAGS", "").split()
    given = {flag.split("=")[0] for flag in flags}
    if "--xla_force_host_platform_device_count" not in given:
        flags.append(f"--xla_force_host_platform_device_count={cores}")
    if "avx512f" in cpu_features and "--xla_cpu_prefer_vector_width" not in given:
        flags.append("--xla_cpu_prefer_vector_width=512")
    chosen = {"XLA_FLAGS": " ".join(flags)}
    if "JAX_COMPILATION_CACHE_DIR" not in environ and (home := cache_home(environ)) is not None:
        features = hashlib.blake2b(" ".join(sorted(cpu_features)).encode(), digest_size=6).hexdigest()
        chosen["JAX_COMPILATION_CACHE_DIR"] = str(home / "jsecon" / f"xla-{features}")
        # Programs of less than a second too: a query has half a dozen of them.
        chosen |= {name: "0" for name in ("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",) if name not in environ}
    return chosen


def cache_home(environ: Mapping[str, str]) -> Path | None:
    """Returns the user's cache folder, or None where it cannot be written: a program must run without one."""
    home = Path(environ["HOME"]) / ".cache" if "HOME" in environ else None
    base = environ.get("XDG_CACHE_HOME") or home or environ.get("LOCALAPPDATA")  # the last on Windows
    if base is None:
        return None
    try:
        Path(base).mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return Path(base) if os.access(base, os.W_OK) else None


def _cpu_features() -> frozenset[str]:
    """The CPU's feature names where Linux tells them, else none."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    told = (line.split(":", 1)[1].split() for line in lines if line.startswith(("flags", "Features")))
    return frozenset(next(told, ()))
