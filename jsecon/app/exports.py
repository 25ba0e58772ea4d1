"""`jsecon objects` and `jsecon export`: a catalogue as a page and JSON; a scene, or objects of it, as files."""

import contextlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from jsecon.app import pictures, report, verbs
from jsecon.app.catalogue import SURE_SHARE, Catalogue
from jsecon.app.querying import slug
from jsecon.app.records import decimals
from jsecon.app.scene import Scene, open_scene
from jsecon.app.shapes import require_shapes_format, write_shapes
from jsecon.errors import InputError
from jsecon.field.columns import is_mapped
from jsecon.files import parse_json, reading, remove_files, write_text
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.query.outliers import MIN_SAMPLES
from jsecon.read.splats.files import require_writable_format


def _objects(verb: verbs.Objects, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon objects`; the result has the records of the objects."""
    if verb.out is not None:
        require_writable(verb.out)
    names = None if verb.vocabulary is None else _read_vocabulary(verb.vocabulary)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console).at_level(verb.level)
    with console.progress("objects"):
        listed = scene.objects(names)
    records = listed.records()
    unsure = [record["id"] for record in records if _is_unsure(records, record)]
    for record in records:
        if record["id"] not in unsure:
            console.print_line(f"{record['id']:>4}  {_title(record)}: {_words(record)}")
    if unsure:
        ids = " to ".join(map(str, sorted({unsure[0], unsure[-1]})))
        few = f"shown by fewer than {SURE_SHARE:.0%} of the frames that see it, so perhaps a fragment"
        console.print_line(f"  unsure, {few}: {ids}")
    if hidden := int(np.any(np.asarray(scene.field.regions.pixel_counts)[listed.regions < 0], axis=1).sum()):
        console.print_line(f"  too small to be listed, with fewer than {MIN_SAMPLES} Gaussians: {hidden} regions")
    elif not records:
        console.print_line("  there are no objects: the field has no regions")
    if verb.out is None:
        return {"objects": records}
    files = {"objects": verb.out / "objects.json", "catalogue": verb.out / "catalogue.html"}
    _write_records(files["objects"], listed)
    write_text(files["catalogue"], _page(scene, listed, records, console))
    console.print_line(f"pictures  {files['catalogue']}")
    return {"objects": records, "written": files}


def _write_records(file: Path, listed: Catalogue) -> None:
    """Writes the records of the objects as JSON."""
    write_text(file, json.dumps(listed.as_dict(), indent=2) + "\n")


def _read_vocabulary(file: Path) -> list[str]:
    """Reads names in UTF-8, one a line, each once. Empty lines and those that begin with # are left out."""
    with reading(file, remedy="Give a text file with one name a line."):
        lines = [line.strip() for line in file.read_text(encoding="utf-8-sig").splitlines()]
    names = list(dict.fromkeys(line for line in lines if line and not line.startswith("#")))
    if not names:
        raise InputError(file, "it has no names", remedy="Write one name a line.")
    return names


def _export(verb: verbs.Export, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon export`; the result has the number of exported Gaussians and the bytes of the scene."""
    _check_export(verb)
    text = verb.only if verb.only is not None else verb.without
    suffix = "" if verb.out is None else verb.out.suffix.lower()
    points = verb.points or suffix in (".las", ".laz")
    if verb.out is not None:
        require_writable_format(verb.out, points)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console).at_level(verb.level)
    answer = None if text is None else scene.ask(text)
    if answer is not None and not len(answer.rows):
        option = "--only" if verb.only is not None else "--without"
        raise InputError(option, f"{text!r} selects no Gaussian", answer.reason, "Ask with other words.")
    if answer is not None:
        console.print_line(str(answer))
    mask = None if answer is None else ~answer.mask if verb.without is not None else answer.mask
    count = scene.field.gaussians.count if mask is None else int(mask.sum())
    result: verbs.VerbResult = {"written": {}, "gaussians": count}
    has_labels = verb.out is not None and (verb.with_labels or points or suffix == ".usda")
    with console.progress("objects"):
        listed = _list_objects(scene, has_labels or verb.out is None or bool(verb.objects or verb.shapes), console)
    written = result["written"]
    with console.progress("files"):
        if verb.out is not None:
            scene.export(verb.out, mask, labels=listed if has_labels else None, points=points)
            result["bytes"] = verb.out.stat().st_size
            written["scene"] = verb.out
            console.print_line(
                f"{'points of ' * points}{count} Gaussians, {result['bytes'] / 2**20:.1f} MiB  {verb.out}"
            )
        if verb.objects is not None and listed is not None:
            written["objects"] = _save_objects(scene, listed, verb.objects)
            console.print_line(f"{len(written['objects'])} objects  {verb.objects}")
        if verb.shapes is not None and listed is not None:
            written["shapes"] = write_shapes(scene, listed, verb.shapes)
            console.print_line(f"shapes  {verb.shapes}")
        files = [written.get("scene"), *written.get("objects", [])[:1], *written.get("shapes", [])[:1]]
        if listed is not None:
            written["labels"] = [folder / "labels.json" for folder in {file.parent: None for file in files if file}]
            for file in written["labels"]:
                _write_records(file, listed)
    return result


def _list_objects(scene: Scene, is_needed: bool, console: Console) -> Catalogue | None:
    """Lists the objects; None with a note where an export can do without and they cannot be had."""
    reason: Any = "the field is larger than memory"
    if is_needed or not is_mapped(scene.field):
        try:
            return scene.objects()
        except InputError as error:  # such as no model for the names
            if is_needed:
                raise
            reason = error
    console.note(f"no labels.json is written: {reason}")
    return None


def _check_export(verb: verbs.Export) -> None:
    """Raises InputError for options of an export that say nothing, or that cannot be combined."""
    if verb.out is None and verb.objects is None and verb.shapes is None:
        raise InputError("export", "there is nothing to write", remedy="Give --out scene.ply, --objects or --shapes.")
    if verb.shapes is not None:
        require_shapes_format(verb.shapes)
    if verb.with_labels and verb.out is None:
        raise InputError("--with-labels", "there is no file to write them to", remedy="Give --out scene.ply.")
    if verb.only is not None and verb.without is not None:
        raise InputError("--only", "it cannot be combined with --without", remedy="Export twice, with one of them.")
    if verb.objects is not None and (verb.only is not None or verb.without is not None):
        problem = "it writes all objects, so --only and --without cannot be combined with it"
        raise InputError("--objects", problem, remedy="Leave one of them out.")


def _save_objects(scene: Scene, listed: Catalogue, folder: Path) -> list[Path]:
    """Writes a .ply of each object, named by its id and name; of a whole with the Gaussians of its parts.

    They replace those of an earlier export to the folder, whose labels.json names them.
    """
    earlier: list[str] = []
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):  # there is none, or it is another program's
        earlier = [_object_file(record) for record in parse_json((folder / "labels.json").read_bytes())["objects"]]
    remove_files(folder, earlier)
    files = []
    for record in listed.records():
        files.append(folder / _object_file(record))
        scene.export(files[-1], listed.mask(record["id"]))
    return files


def _object_file(record: dict[str, Any]) -> str:
    """Names the file of an object by its id and name."""
    name = slug(_title(record)).encode()[:60].decode("utf-8", "ignore")
    return f"{record['id']:03d}-{name}.ply"


def _page(scene: Scene, catalogue: Catalogue, records: list[dict[str, Any]], console: Console) -> str:
    """Returns the page: a card for each object, which opens to its views."""
    cards: dict[bool, list[str]] = {False: [], True: []}  # folded or not
    with console.progress("pictures") as progress:
        for record in records:
            mask = catalogue.mask(record["id"])
            figures = [report.figure(scene.render(name, mask), name) for name in record["frames"]]
            best = scene.frame_index(record["frames"][0]) if record["frames"] else 0
            outline = scene.mask(mask, best)
            picture = pictures.crop(pictures.selection_overlay(scene.render(best), outline, tint=0.0), outline)
            words = f"{record['id']}: {_words(record)}"
            card = report.card(picture, _title(record), words, report.grid(figures, 3))
            cards[_is_unsure(records, record) or record["surroundings"]].append(card)
            progress(record["id"] + 1, len(records))
    lead = "The objects of the scene. Open an object to see it in the frames that show most of it."
    more = f"{len(cards[True])} more: surroundings, and what few of the frames that see it show"
    folded = [report.grid(cards[True], folded=more)] if cards[True] else []
    return report.page("Objects", lead, [report.grid(cards[False]), *folded])


def _is_unsure(records: list[dict[str, Any]], record: dict[str, Any]) -> bool:
    """Whether an object, or the one that it is a part of, is unsure."""
    whole = record if record["parent"] is None else records[record["parent"]]
    return not whole["sure"] and not whole["surroundings"]


def _title(record: dict[str, Any]) -> str:
    """Returns the best name of an object, or "object" where there is no vocabulary."""
    return record["name"] or "object"


def _words(record: dict[str, Any]) -> str:
    """Says how large an object is and where, to a hundredth of its size, what shows it, and what it belongs to."""
    size, center = record["box"]["size"], record["box"]["center"]
    digits = decimals(float(np.linalg.norm(size)), 0.01)
    sides = " x ".join(f"{x:.{digits}f}" for x in size)
    place = ", ".join(f"{x:.{digits}f}" for x in center)
    words = [sides, f"at ({place})", f"{record['gaussians']} Gaussians", f"{record['views']} frames"]
    words += [] if record["parent"] is None else [f"part of {record['parent']}"]
    return ", ".join([*words, "surroundings"] if record["surroundings"] else words)
