"""`jsecon add` and `jsecon forget`."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from jsecon.app import verbs
from jsecon.app.opening import locate_field
from jsecon.app.scene import open_scene
from jsecon.errors import InputError, join_first
from jsecon.field.field import load_field
from jsecon.field.ledger_file import remove_stale
from jsecon.files import FIELD_FILE, exclusive_lock, remove_files
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console


def _add(verb: verbs.Add, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon add`; photographs that are refused are errors, and the others are added."""
    refused: list[InputError] = []
    with _changing(verb.field, verb.out) as path:
        scene = open_scene(verb.field, embedder=verb.embedder, console=console)
        try:
            grown = scene.add(verb.photos, poses=verb.poses, masks=verb.masks, refused=refused, console=console)
        except InputError as error:
            return {"errors": [*refused, error]}
        with console.progress("write"):
            grown.save(path)
    added = [name for name in grown.field.names if name not in scene.field.names]
    opened = grown.field.regions.count - scene.field.regions.count
    console.print_line(f"added   {join_first(added)}; {opened} new regions\nfield   {path}")
    return {"written": [path], "added": added, "new_regions": opened, "errors": refused}


def _forget(verb: verbs.Forget, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon forget`."""
    with _changing(verb.field, verb.out) as path:
        scene = open_scene(verb.field, console=console)
        with console.progress("votes"):
            less = scene.forget(verb.frames)
        # First: the same command finishes what is left if it is stopped here.
        removed = _remove_traces(path.parent) if verb.out is None else []
        with console.progress("write"):
            less.save(path)
    forgotten = [name for name in scene.field.names if name not in less.field.names]
    console.print_line(f"forgot  {join_first(forgotten)}\nfield   {path}")
    if removed:
        console.print_line(f"removed {', '.join(removed)}, which showed them")
    return {"written": [path], "forgotten": forgotten, "removed": removed}


@contextlib.contextmanager
def _changing(field: Path, out: Path | None) -> Iterator[Path]:
    """Yields the path of the field to write, for one process at a time; what a stopped one left there is removed."""
    old = locate_field(field)
    if old.splat is not None:
        problem = "it is a file of Gaussians, whose views are rendered"
        raise InputError(field, problem, remedy=f"Give its field, {old.file.parent}, or make one of photographs.")
    path = old.file if out is None else out / FIELD_FILE
    require_writable(path.parent)
    with exclusive_lock(path.parent):
        if path.is_file():
            remove_stale(path, load_field(path, mapped=True))
        yield path


def _remove_traces(folder: Path) -> list[str]:
    """Removes what a run keeps of its frames beside the field; returns the names."""
    from jsecon.app.running import FILES, FIRST_VIEW  # late: to add frames needs no run

    names = [name for name in (*FILES[1:], FIRST_VIEW) if (folder / name).is_file()]
    remove_files(folder, names)
    mark = "cache/CACHEDIR.TAG"  # as of a run; beside it `jsecon demo` keeps pictures of its answers
    for place in [place for place in ("cache", "queries") if (folder / mark).is_file() and (folder / place).is_dir()]:
        shutil.rmtree(folder / place)
        names.append(f"{place}/")
    return names
