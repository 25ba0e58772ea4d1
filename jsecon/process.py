"""Settings of the process, which only a program may change: the library never changes the process that it runs in.

Before jax starts, once: `jsecon` on the command line calls `prepare_process` first. A program that needs
all cores and the speed of benchmarks/results.md does the same:

    from jsecon.process import prepare_process
    prepare_process()
    import jsecon
"""

import contextlib
import ctypes
import hashlib
import os
import re
import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jsecon.errors import InputError

MEMORY = "JSECON_MEMORY"
"""environment variable: GiB for a scene's columns, in place of half of the free memory"""


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
    of that forever, and never write the program again.
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


VIEWS_AT_ONCE = 8
"""largest number of views that are worked on side by side, as each holds its plan in memory"""


def cores() -> int:
    """Counts the CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _available_memory() -> float:
    """Reads the free memory, in bytes, within this process's cgroup of version 2; infinite where it is not stated."""
    try:
        found = re.search(r"MemAvailable: *(\d+) kB", Path("/proc/meminfo").read_text())
        group = re.search(r"^0::/(.*)", Path("/proc/self/cgroup").read_text(), re.MULTILINE)
    except OSError:
        return float("inf")
    free = float("inf") if found is None else int(found[1]) << 10
    top = Path("/sys/fs/cgroup")
    for folder in (top if group is None else top / group[1], top):  # a container has its own at the top
        if (folder / "memory.max").is_file():
            limit = (folder / "memory.max").read_text().strip()
            used = int((folder / "memory.current").read_text())
            return free if limit == "max" else min(free, int(limit) - used)
    return free


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
        return _available_memory() / 2
    try:
        return float(text) * 2**30
    except ValueError:
        raise InputError(MEMORY, repr(text), "GiB, a number", f"For example: export {MEMORY}=4") from None


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
