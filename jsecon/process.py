"""Settings of the process, which only a program may change: the library never changes the process that it runs in.

Before jax starts, once: `jsecon` on the command line calls `prepare_process` first. A program that needs
all cores and the speed of benchmarks/results.md does the same:

    from jsecon.process import prepare_process
    prepare_process()
    import jsecon
"""

import _thread
import contextlib
import ctypes
import hashlib
import os
import re
import signal
import sys
import threading
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jsecon.errors import InputError

MEMORY = "JSECON_MEMORY"
"""environment variable: GiB for a scene's columns, in place of half of the free memory"""
_counts: dict[str, int] = {}


def prepare_process(*, keep_programs: bool = True) -> None:
    """Sets XLA's flags and the folder of compiled programs (see `_settings`), silences OpenCV, keeps freed memory.

    Call it before jax makes its first array and OpenCV is imported. Variables that the user has set stay.
    """
    chosen = _settings(os.environ, cores(), _cpu_features())
    if not keep_programs:
        chosen.pop("JAX_COMPILATION_CACHE_DIR", None)
    # No messages of OpenCV, as an InputError reports damaged files; and the largest image that it allocates.
    opencv = {"OPENCV_LOG_LEVEL": "OFF", "OPENCV_FFMPEG_LOGLEVEL": "-8", "OPENCV_IO_MAX_IMAGE_PIXELS": str(1 << 27)}
    os.environ.update({name: value for name, value in opencv.items() if name not in os.environ} | chosen)
    if (folder := chosen.get("JAX_COMPILATION_CACHE_DIR")) is not None:
        _remove_old_programs(Path(folder).parent)
        _remove_damaged_programs(Path(folder))
    if sys.platform == "linux" and not any(name.startswith("MALLOC_") for name in os.environ):
        # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD and M_TOP_PAD of glibc: a large array takes pages that were touched before,
        # which makes a forward render of garden 1.15 times as fast.
        mallopt = getattr(ctypes.CDLL(None), "mallopt", lambda parameter, value: None)
        for parameter, value in ((-3, (1 << 31) - 1), (-1, (1 << 31) - 1), (-2, 1 << 26)):
            mallopt(parameter, value)


def _remove_old_programs(home: Path) -> None:
    """Deletes compiled programs that were last read or written 60 days ago: each upgrade makes new ones."""
    oldest = time.time() - 86400 * 60
    for file in home.glob("xla-*/*"):
        with contextlib.suppress(OSError):  # another process may have deleted it
            status = file.stat()
            if max(status.st_atime, status.st_mtime) < oldest:
                file.unlink()


def _remove_damaged_programs(folder: Path) -> None:
    """From now on removes the files of a program in `folder` that jax warns of, without printing the warning.

    jax writes to a program's final name: a full disk, or a stop during the writing, leaves a part there. It would warn
    of that forever, and never write the program again. `jsecon doctor` reports a disk without room for programs.
    """
    show = warnings.showwarning
    warning = r"Error (?:reading|writing) persistent compilation cache entry for '([\w.-]+)'"

    def show_or_remove(message: Warning | str, *args: Any, **kwargs: Any) -> None:
        match = re.match(warning, str(message))
        if match is None:
            return show(message, *args, **kwargs)
        for file in folder.glob(f"{match[1]}-*-cache"):
            with contextlib.suppress(OSError):
                file.unlink()

    warnings.showwarning = show_or_remove
    warnings.filterwarnings("always", warning)  # each time, also for programs of the same name


def stop_by_signals() -> None:
    """Makes SIGTERM raise KeyboardInterrupt, as Ctrl-C does, so that half-written files are removed.

    One that Python drops, in a destructor or a callback of the garbage collector such as jax's, is raised again.
    """
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    show = sys.unraisablehook

    def show_or_repeat(dropped: Any) -> None:
        if dropped.exc_type is not KeyboardInterrupt:
            return show(dropped)
        again = threading.Timer(0.05, _stop_main)  # s; the destructor has ended by then
        again.daemon = True
        again.start()

    sys.unraisablehook = show_or_repeat


def _stop_main() -> None:
    """Sends SIGTERM to the main thread; a shell's background jobs ignore SIGINT."""
    if hasattr(signal, "pthread_kill"):  # it also ends a call that waits, such as a sleep
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
    else:
        _thread.interrupt_main(signal.SIGTERM)


VIEWS_AT_ONCE = 8
"""largest number of views that are worked on side by side, as each holds its plan in memory"""


def cores() -> int:
    """Counts the CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def available_memory() -> tuple[int | None, int | None]:
    """Reads the free memory within this process's cgroup, and the cgroup's limit, in bytes; None if not stated."""
    try:
        found = re.search(r"MemAvailable: *(\d+) kB", Path("/proc/meminfo").read_text())
    except OSError:
        return None, None
    if found is None:
        return None, None
    free = int(found[1]) << 10
    limit = _read_cgroup("memory.max", "memory/memory.limit_in_bytes")
    if not limit or not limit[0].isdecimal() or int(limit[0]) >= 1 << 60:  # more is no limit
        return free, None
    used = _read_cgroup("memory.current", "memory/memory.usage_in_bytes") or ["0"]
    return min(free, int(limit[0]) - int(used[0])), int(limit[0])


def peak_memory_mib() -> float:
    """Reads the largest resident memory of this process so far, in MiB; 0 on Windows."""
    try:
        import resource
    except ImportError:
        return 0.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def memory_budget() -> float:
    """Computes how many bytes a scene's columns may take; larger ones are read in blocks.

    It is the value of MEMORY, or half of the free memory, as reading takes twice the size of the columns. Raises
    InputError if MEMORY is not a number.
    """
    text = os.environ.get(MEMORY)
    if text is None:
        return float("inf") if (free := available_memory()[0]) is None else free / 2
    try:
        return float(text) * 2**30
    except ValueError:
        raise InputError(MEMORY, repr(text), "GiB, a number", f"For example: export {MEMORY}=4") from None


def _read_cgroup(new: str, old: str) -> list[str]:
    """Words of a file of this process's cgroup, by its name in version 2 and its path in version 1; or none."""
    try:
        groups = dict(line.split(":", 2)[1:] for line in Path("/proc/self/cgroup").read_text().splitlines())
    except (OSError, ValueError):
        return []
    kind, _, name = old.partition("/")
    group = groups.get(kind, "/").lstrip("/")
    top, at = Path("/sys/fs/cgroup"), groups.get("", "/").lstrip("/")
    places = (top / at / new, top / new, top / kind / group / name, top / kind / name)
    return next((path.read_text().split() for path in places if path.is_file()), [])


def compilation_counts() -> dict[str, int]:
    """Counts the programs that jax has compiled since the first call ("all"), and of these those "from_disk"."""
    import jax

    if not _counts:
        _counts.update(all=0, from_disk=0)

        def count(event: str, *_: object, **__: object) -> None:
            name = {"backend_compile_duration": "all", "cache_hits": "from_disk"}.get(event.rpartition("/")[2])
            if name is not None:
                _counts[name] += 1

        jax.monitoring.register_event_listener(count)
        jax.monitoring.register_event_duration_secs_listener(count)
    return dict(_counts)


def _settings(environ: Mapping[str, str], cores: int, cpu_features: frozenset[str]) -> dict[str, str]:
    """Chooses environment variables for one host device per core, full-width vectors and stored programs.

    512-bit vectors are used only if the CPU has them. The folder of compiled programs is named by a digest of the CPU's
    features, so that different machines can share a home folder. Flags that XLA_FLAGS has stay.
    """
    flags = environ.get("XLA_FLAGS", "").split()
    present = {flag.split("=")[0] for flag in flags}
    if "--xla_force_host_platform_device_count" not in present:
        flags.append(f"--xla_force_host_platform_device_count={cores}")
    if "avx512f" in cpu_features and "--xla_cpu_prefer_vector_width" not in present:
        flags.append("--xla_cpu_prefer_vector_width=512")
    chosen = {"XLA_FLAGS": " ".join(flags)}
    if "JAX_COMPILATION_CACHE_DIR" not in environ and (home := cache_home(environ)) is not None:
        features = hashlib.blake2b(" ".join(sorted(cpu_features)).encode(), digest_size=6).hexdigest()
        chosen["JAX_COMPILATION_CACHE_DIR"] = str(home / "jsecon" / f"xla-{features}")
        # Programs of less than a second too: a query has half a dozen of them.
        chosen |= {name: "0" for name in ("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",) if name not in environ}
    return chosen


def cache_home(environ: Mapping[str, str]) -> Path | None:
    """Finds the user's cache folder, and makes it if it is missing; None if it cannot be written."""
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
    """Names of the CPU's features; empty without Linux."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    features = (line.split(":", 1)[1].split() for line in lines if line.startswith(("flags", "Features")))
    return frozenset(next(features, ()))
