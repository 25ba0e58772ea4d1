"""`jsecon objects` and `jsecon export`: a catalogue as a page, JSON and CSV; a scene, or objects of it, as files."""

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.app import pictures, report, verbs
from jsecon.app.catalogue import Catalogue
from jsecon.app.models import open_embedder
from jsecon.app.outputs import slug
from jsecon.app.records import decimals, rounded
from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError
from jsecon.files import atomic_write, write_text
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.query.outliers import MIN_SAMPLES
from jsecon.read.splats.files import require_writable_format
from jsecon.types import LanguageField


def object_records(catalogue: Catalogue) -> list[dict[str, Any]]:
    """Plain values of each object for JSON, in the capture's world; the columns of "axes" are the axes of the box."""
    records = []
    for n in range(len(catalogue)):
        shape = catalogue.shapes[n]
        length = float(np.linalg.norm(shape.high - shape.low))
        names = zip(catalogue.names[n], catalogue.probability[n])
        box = {"center": rounded(shape.center, length), "size": rounded(2 * shape.half_size, length)}
        record = {
            "id": n,
            "names": [{"name": name, "probability": round(float(p), 4)} for name, p in names if name],
            "surroundings": bool(catalogue.surroundings[n]),
            "parent": int(catalogue.parent[n]) if catalogue.parent[n] >= 0 else None,
            "gaussians": int(shape.count),
            "confidence": round(float(catalogue.confidence[n]), 4),
            "views": int(catalogue.views[n]),
            "frames": [catalogue.frame_names[t] for t in catalogue.frames[n] if t >= 0],
            "box": box | {"axes": np.round(shape.axes, 6).tolist()},
            "low": rounded(shape.low, length),
            "high": rounded(shape.high, length),
        }
        records.append(record)
    return records


def _objects(verb: verbs.Objects, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon objects`; the result has the records of the objects."""
    if verb.out is not None:
        require_writable(verb.out)
    with console.progress("field"):
        names = None if verb.vocabulary is None else _read_vocabulary(verb.vocabulary)
        by_model = names is not None or verb.embedder is not None  # else its words may be in the field
        scene = open_scene(verb.field, embedder=_embedder_of(verb, console) if by_model else None)
        listed = scene.objects(names)
    _print_catalogue(listed, console)
    result: verbs.VerbResult = {"objects": object_records(listed)}
    if verb.out is None:
        return result
    files = _write_catalogue(scene, listed, verb.out, console)
    console.print_line(f"pictures  {files['catalogue']}")
    return result | {"written": files}


def _read_vocabulary(file: Path) -> list[str]:
    """Reads names in UTF-8, one a line, each once. Empty lines and those that begin with # are left out."""
    try:
        lines = [line.strip() for line in file.read_text(encoding="utf-8-sig").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(file, f"cannot read it ({error})", remedy="Give a text file with one name a line.") from error
    names = list(dict.fromkeys(line for line in lines if line and not line.startswith("#")))
    if not names:
        raise InputError(file, "it has no names", remedy="Write one name a line.")
    return names


def _export(verb: verbs.Export, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon export`; the result has the number of exported Gaussians and the bytes of the scene."""
    _check_export(verb)
    text = verb.only if verb.only is not None else verb.without
    with console.progress("field"):
        if verb.out is not None:
            require_writable_format(verb.out)
        scene = open_scene(verb.field, embedder=None if text is None else _embedder_of(verb, console))
    answer = None if text is None else scene.ask(text)
    if answer is not None and not len(answer.rows):
        option = "--only" if verb.only is not None else "--without"
        raise InputError(option, f"{text!r} selects no Gaussian", answer.reason, "Ask with other words.")
    if answer is not None:
        console.print_line(str(answer))
    mask = None if answer is None else ~answer.mask if verb.without is not None else answer.mask
    count = scene.field.gaussians.count if mask is None else int(mask.sum())
    result: verbs.VerbResult = {"written": {}, "gaussians": count}
    with console.progress("files"):
        if verb.out is not None:
            scene.export(verb.out, mask, object_ids=scene.objects().labels if verb.with_labels else None)
            result["bytes"] = verb.out.stat().st_size
            result["written"]["scene"] = verb.out
            console.print_line(f"{count} Gaussians, {result['bytes'] / 2**20:.1f} MiB  {verb.out}")
        if verb.labels is not None:
            ids = scene.objects().labels.astype(np.int32)
            ids = ids if mask is None else ids[mask]
            with atomic_write(verb.labels) as temporary, temporary.open("wb") as stream:
                np.save(stream, ids)
            result["written"]["labels"] = verb.labels
            console.print_line(f"{len(ids)} ids of objects, {int((ids < 0).sum())} of them -1  {verb.labels}")
        if verb.objects is not None:
            files = _save_objects(scene, scene.objects(), verb.objects)
            result["written"]["objects"] = files
            console.print_line(f"{len(files)} objects  {verb.objects}")
    return result


def _embedder_of(verb: verbs.FieldVerb, console: Console) -> Callable[[LanguageField], Any]:
    """Opens the embedder of a verb's field when a text needs it."""
    return lambda field: open_embedder(field, verb, console)


def _check_export(verb: verbs.Export) -> None:
    """Raises InputError for options of an export that say nothing, or that cannot be combined."""
    if verb.out is None and verb.labels is None and verb.objects is None:
        raise InputError("export", "there is nothing to write", remedy="Give --out scene.ply, --labels or --objects.")
    if verb.with_labels and (verb.out is None or verb.out.suffix.lower() == ".spz"):
        raise InputError("--with-labels", "only a .ply or .glb holds them", remedy="Give --out scene.ply, or --labels.")
    if verb.only is not None and verb.without is not None:
        raise InputError("--only", "it cannot be combined with --without", remedy="Export twice, with one of them.")
    if verb.objects is not None and (verb.only is not None or verb.without is not None):
        problem = "it writes all objects, so --only and --without cannot be combined with it"
        raise InputError("--objects", problem, remedy="Leave one of them out.")
    if verb.labels is not None and verb.labels.suffix != ".npy":
        raise InputError("--labels", f"{verb.labels} does not end in .npy", remedy="For example: --labels ids.npy")


def _print_catalogue(catalogue: Catalogue, listener: Console) -> None:
    """Prints a line for each object; parts are indented under their wholes."""
    wide = max((len(_title(catalogue, n)) for n in range(len(catalogue))), default=4) + 2
    listener.print_line(f"{'id':>4}  {'name':<{wide}}  prob.  Gaussians  views  conf.  size, centre")
    for n in range(len(catalogue)):
        name = ("  " if catalogue.parent[n] >= 0 else "") + _title(catalogue, n)
        figures = f"{catalogue.probability[n, 0]:5.2f}  {catalogue.shapes.count[n]:9d}  {catalogue.views[n]:5d}"
        place = f"{_size(catalogue, n)}, at ({_center(catalogue, n)})"
        ending = ", surroundings" if catalogue.surroundings[n] else ""
        listener.print_line(f"{n:>4}  {name:<{wide}}  {figures}  {catalogue.confidence[n]:5.2f}  {place}{ending}")
    if hidden := int((catalogue.regions < 0).sum()):
        listener.print_line(f"  too small to be listed, with fewer than {MIN_SAMPLES} Gaussians: {hidden} regions")
    elif not len(catalogue):
        listener.print_line("  there are no objects: the field has no regions")


def _write_catalogue(scene: Scene, catalogue: Catalogue, out: Path, listener: Console) -> dict[str, Path]:
    """Writes OUT/objects.json, OUT/objects.csv and OUT/catalogue.html; returns the files."""
    files = {"objects": out / "objects.json", "catalogue": out / "catalogue.html", "table": out / "objects.csv"}
    content = {"frame": "the capture's world", "up": catalogue.up.round(6).tolist()}
    content |= {"objects": object_records(catalogue)}
    write_text(files["objects"], json.dumps(content, indent=2) + "\n")
    columns = catalogue.to_dict()
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values()):
        writer.writerow([" ".join(value) if isinstance(value, list) else value for value in row])
    write_text(files["table"], table.getvalue())
    write_text(files["catalogue"], _page(scene, catalogue, listener))
    return files


def _save_objects(scene: Scene, catalogue: Catalogue, folder: Path) -> list[Path]:
    """Writes a .ply of each object, named by its id and name; of a whole with the Gaussians of its parts."""
    files = []
    for n in range(len(catalogue)):
        name = slug(_title(catalogue, n)).encode()[:60].decode("utf-8", "ignore")
        files.append(folder / f"{n:03d}-{name}.ply")
        scene.export(files[-1], catalogue.mask(n))
    return files


def _page(scene: Scene, catalogue: Catalogue, listener: Console) -> str:
    """Returns the page: a card for each object, which opens to its views."""
    cards: dict[bool, list[str]] = {False: [], True: []}
    with listener.progress("pictures") as progress:
        for n in range(len(catalogue)):
            mask = catalogue.mask(n)
            frames = [int(t) for t in catalogue.frames[n] if t >= 0]
            figures = [report.figure(scene.render(t, mask), scene.field.names[t]) for t in frames]
            best = frames[0] if frames else 0
            parent = catalogue.parent[n]
            cards[bool(catalogue.surroundings[n])].append(
                report.card(
                    pictures.fitted(scene.renderer.crop(best, mask), 150),
                    _title(catalogue, n),
                    f"{n} · {_size(catalogue, n)}" + (f" · part of {parent}" if parent >= 0 else ""),
                    report.grid(figures, 3),
                    report.table(("", ""), _facts(catalogue, n), numbers_from=2),
                    search=" ".join((str(n), *map(str, catalogue.names[n]))),
                )
            )
            progress(n + 1, len(catalogue))
    parts = [report.cards(cards[False], search="Search names and ids")]
    if cards[True]:
        words = "Walls, floors and the like, by their names."
        parts.append(report.section("Surroundings", words, report.cards(cards[True])))
    lead = "What jsecon found in the scene. Open an object to see it in the frames that show most of it."
    return report.page("Objects", lead, parts)


def _facts(catalogue: Catalogue, n: int) -> list[tuple[str, str]]:
    """Returns the lines of an object's table."""
    names = [f"{name} {p:.0%}" for name, p in zip(catalogue.names[n], catalogue.probability[n]) if name]
    rows = [
        ("names", ", ".join(names)),
        ("size", _size(catalogue, n)),
        ("centre", _center(catalogue, n)),
        ("Gaussians", str(catalogue.shapes.count[n])),
        ("frames that show it", str(catalogue.views[n])),
        ("confidence", f"{catalogue.confidence[n]:.0%}"),
    ]
    if children := np.flatnonzero(catalogue.parent == n).tolist():
        rows.append(("parts", ", ".join(f"{k} {_title(catalogue, k)}" for k in children)))
    return rows


def _title(catalogue: Catalogue, n: int) -> str:
    """Returns the best name of an object, or "object" where there is no vocabulary."""
    return str(catalogue.names[n, 0]) or "object"


def _size(catalogue: Catalogue, n: int) -> str:
    """Returns length, width and height of an object, to a hundredth of its size."""
    size = 2 * catalogue.shapes.half_size[n]
    digits = decimals(float(np.linalg.norm(size)), 0.01)
    return " x ".join(f"{side:.{digits}f}" for side in size)


def _center(catalogue: Catalogue, n: int) -> str:
    """Returns the centre of an object, to a hundredth of its size."""
    digits = decimals(2 * float(np.linalg.norm(catalogue.shapes.half_size[n])), 0.01)
    return ", ".join(f"{x:.{digits}f}" for x in catalogue.shapes.center[n])
