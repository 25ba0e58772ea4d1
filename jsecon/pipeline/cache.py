"""The cache of a run: one file per stage, named by a digest of all that its content depends on.

    OUT/cache/<stage>-<key>.safetensors

The key covers the stage's options, its input files, the installed source that computes it, and the keys of the stages
that it reads. So a stopped run resumes, a changed option reruns only what depends on it, and a stale result is never
used. A file holds arrays and a JSON description of their tree, without pickle.
"""

import contextlib
import functools
import hashlib
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jsecon
from jsecon.errors import InputError
from jsecon.files import (
    atomic_write,
    list_files,
    pack_tree,
    read_arrays,
    reading,
    unpack_tree,
    write_arrays,
    write_text,
)

PACKAGE = Path(jsecon.__file__).parent
PACKAGES = ("association", "field", "fit", "networks", "paper", "pipeline", "poses", "read", "splat", "views", "vision")
"""subpackages that stages compute with"""
MAPPED = 1 << 30
"""bytes; larger arrays are memory-mapped"""


def files_digest(paths: Iterable[Path], *, exclude: Path | None = None) -> str:
    """Hashes names, sizes and times of files, and of all files beneath folders (`list_files`)."""
    entries = []
    outputs = (".spz", ".glb", ".splat", ".sog", ".html")  # of programs, beside a capture
    for root in paths:
        output = None if exclude is None or exclude.resolve() == root.resolve() else exclude
        written = None if output is None else output.resolve().with_name(f"{output.name}.ply")
        for path in list_files(root, exclude=output) if root.is_dir() else [root]:
            inside = path.relative_to(root) if path != root else Path(path.name)
            if path != root and (path.suffix.lower() in outputs or path.absolute() == written):
                continue
            with contextlib.suppress(FileNotFoundError):  # gone since it was listed
                stat = path.stat()
                entries.append(os.fsencode(f"{inside.as_posix()} {stat.st_size} {stat.st_mtime_ns}"))
    return hashlib.blake2b(b"\n".join(entries), digest_size=8).hexdigest()


@functools.cache
def source_digest() -> str:
    """Hashes the installed source files that a stage can depend on.

    The packages behind all stages (query, evaluate, app, demo) are left out: a change of the viewer does not recompute
    a fit.
    """
    digest = hashlib.blake2b(digest_size=16)
    files = [*PACKAGE.glob("*.py"), *(file for name in PACKAGES for file in (PACKAGE / name).rglob("*.py"))]
    for file in sorted(files):
        digest.update(file.relative_to(PACKAGE).as_posix().encode())
        digest.update(hashlib.blake2b(file.read_bytes()).digest())
    return digest.hexdigest()


def prepare(folder: Path) -> None:
    """Makes the folder of a cache, marks it for backup programs, and removes half-written files of killed runs."""
    tag = folder / "CACHEDIR.TAG"
    if not tag.exists():
        write_text(tag, "Signature: 8a477f597d28d172789f06886806bc55\n# Made by jsecon; see bford.info/cachedir\n")
    for partial in folder.glob(".*.partial.safetensors"):
        age = time.time() - partial.stat().st_mtime
        if abs(age) > 600:  # s; its writer is gone, or the clock was set back
            partial.unlink(missing_ok=True)


def read_or_compute(
    path: Path, compute: Callable[[], Any], *, note: Callable[[str], None] = lambda text: None
) -> tuple[Any, float, bool]:
    """Reads the result of a stage, or computes and stores it.

    Returns the result with NumPy arrays, the wall time of its computation, also of one in an earlier run, and whether
    it was computed now.
    """
    if path.exists():
        try:
            return *load(path), False
        except InputError as error:
            note(f"{error} The stage {path.stem.partition('-')[0]} is computed again.")
    started = time.monotonic()
    value = compute()
    jax.block_until_ready(value)
    seconds = time.monotonic() - started
    return save(path, value, seconds), seconds, True


def save(path: Path, value: Any, seconds: float = 0.0) -> Any:
    """Writes a tree to a file, atomically."""
    arrays: dict[str, np.ndarray] = {}
    tree = pack_tree(value, "root", arrays)
    with atomic_write(path) as temporary:
        write_arrays(temporary, arrays, {"tree": tree, "seconds": seconds})
        with open(temporary, "r+b") as file:
            os.fsync(file.fileno())  # a rename may reach the disk before the content does
    is_mapped = any(isinstance(array, np.memmap) for array in arrays.values())
    return load(path)[0] if is_mapped else unpack_tree(tree, arrays)


def load(path: Path) -> tuple[Any, float]:
    """Reads what `save` wrote."""
    with reading(path):
        description, arrays = read_arrays(path, memory_map_above=MAPPED)
        return unpack_tree(description["tree"], arrays), float(description["seconds"])
