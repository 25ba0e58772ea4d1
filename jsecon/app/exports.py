"""`jsecon objects` and `jsecon export`: a catalogue as a page and JSON; a scene, objects or their solids as files."""

import contextlib
import dataclasses
import json
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.spatial.transform import Rotation

from jsecon.app import pictures, report, verbs
from jsecon.app.catalogue import SURE_SHARE, Catalogue
from jsecon.app.querying import slug
from jsecon.app.records import decimals, source_points
from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError
from jsecon.field.columns import is_mapped
from jsecon.files import parse_json, remove_files, write_text
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.query.outliers import MIN_SAMPLES
from jsecon.query.solids import object_solid, object_surfaces
from jsecon.read.splats.writing import require_writable_format

_Item: TypeAlias = dict[str, Any]
"""an object with its box, hull and primitive, as the JSON of solids has it with lists in place of arrays"""


def _objects(verb: verbs.Objects, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon objects`; the result has the records of the objects."""
    if verb.out is not None:
        require_writable(verb.out)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console).at_level(verb.level)
    with console.progress("objects"):
        listed = scene.objects()
    records = listed.records()
    unsure = [record["id"] for record in records if _is_unsure(records, record)]
    for record in records:
        if record["id"] not in unsure:
            console.print_line(f"{record['id']:>4}  {record['name']}: {_words(record)}")
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


def _export(verb: verbs.Export, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon export`; the result has the number of exported Gaussians."""
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
    is_needed = points or suffix == ".usda" or bool(verb.objects or verb.shapes)
    with console.progress("objects"):
        listed = _list_objects(scene, is_needed, console)
    written = result["written"]
    with console.progress("files"):
        if verb.out is not None:
            scene.export(verb.out, mask, labels=listed, points=points)
            written["scene"] = verb.out
            console.print_line(f"{'points of ' * points}{count} Gaussians  {verb.out}")
        if verb.objects is not None and listed is not None:
            written["objects"] = _save_objects(scene, listed, verb.objects)
            console.print_line(f"{len(written['objects'])} objects  {verb.objects}")
        if verb.shapes is not None and listed is not None:
            written["shapes"] = _write_shapes(scene, listed, verb.shapes)
            console.print_line(f"shapes  {verb.shapes}")
        files = [written.get("scene"), *written.get("objects", [])[:1], *written.get("shapes", [])[:1]]
        if listed is not None:
            written["labels"] = [folder / "labels.json" for folder in {file.parent: None for file in files if file}]
            for file in written["labels"]:
                _write_records(file, listed)
    return result


def _list_objects(scene: Scene, is_needed: bool, console: Console) -> Catalogue | None:
    """Lists the objects; None with a note where an export can do without and they cannot be had."""
    try:
        if is_mapped(scene.field) and not is_needed:
            raise InputError("", "the field is larger than memory")
        return scene.objects()
    except InputError as error:  # such as no model for the names
        if is_needed:
            raise
        console.note(f"no labels.json is written: {error}")
        return None


def _check_export(verb: verbs.Export) -> None:
    """Raises InputError for options of an export that say nothing, or that cannot be combined."""
    if verb.out is None and verb.objects is None and verb.shapes is None:
        raise InputError("export", "there is nothing to write", remedy="Give --out scene.ply, --objects or --shapes.")
    if verb.shapes is not None and verb.shapes.suffix not in ("", *_WRITERS) and not verb.shapes.is_dir():
        known = f"{', '.join(_WRITERS)}, or a folder"
        problem = f"its name ends in {verb.shapes.suffix}"
        raise InputError(verb.shapes, problem, known, "For example: --shapes shapes.xml")
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
    name = slug(record["name"]).encode()[:60].decode("utf-8", "ignore")
    return f"{record['id']:03d}-{name}.ply"


def _page(scene: Scene, catalogue: Catalogue, records: list[dict[str, Any]], console: Console) -> str:
    """Returns the page: a card for each object, which opens to its views."""
    cards: dict[bool, list[str]] = {False: [], True: []}  # folded or not
    with console.progress("pictures") as progress:
        for record in records:
            mask = catalogue.mask(record["id"])
            figures = [report.figure(scene.render(name, mask), name) for name in record["frames"]]
            best = next(iter(record["frames"]), 0)
            outline = scene.mask(mask, best)
            picture = crop(pictures.selection_overlay(scene.render(best), outline, tint=0.0), outline)
            words = f"{record['id']}: {_words(record)}"
            card = report.card(picture, record["name"], words, report.grid(figures, 3))
            cards[_is_unsure(records, record) or record["surroundings"]].append(card)
            progress(record["id"] + 1, len(records))
    lead = "The objects of the scene. Open an object to see it in the frames that show most of it."
    more = f"{len(cards[True])} more: surroundings, and what few of the frames that see it show"
    folded = [report.grid(cards[True], folded=more)] if cards[True] else []
    return report.page("Objects", lead, [report.grid(cards[False]), *folded])


def crop(image: UInt8[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Cuts out the square around a mask, with a margin; the whole image if the mask is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return image
    half = 0.8 * max(np.ptp(rows), np.ptp(columns), 16)  # px; the margin is 0.3 of the object's size
    top, left = (int(max((ends[0] + ends[-1]) / 2 - half, 0)) for ends in (rows, columns))
    return image[top : int(top + 2 * half) + 1, left : int(left + 2 * half) + 1]


def _is_unsure(records: list[dict[str, Any]], record: dict[str, Any]) -> bool:
    """Whether an object, or the one that it is a part of, is unsure."""
    whole = record if record["parent"] is None else records[record["parent"]]
    return not whole["sure"] and not whole["surroundings"]


def _words(record: dict[str, Any]) -> str:
    """Says how large an object is and where, to a hundredth of its size, what shows it, and what it belongs to."""
    size, center = record["box"]["size"], record["box"]["center"]
    digits = decimals(float(np.linalg.norm(size)), 0.01)
    sides = " x ".join(f"{x:.{digits}f}" for x in size)
    place = ", ".join(f"{x:.{digits}f}" for x in center)
    words = [sides, f"at ({place})", f"{record['gaussians']} Gaussians", f"{record['views']} frames"]
    words += [] if record["parent"] is None else [f"part of {record['parent']}"]
    return ", ".join([*words, "surroundings"] if record["surroundings"] else words)


def _write_shapes(scene: Scene, listed: Catalogue, out: Path) -> list[Path]:
    """Writes the solids of all whole objects but surroundings, as the file's suffix says, or in a folder as all four.

    They stand in the capture's world, in metres if the field knows their length.
    """
    field, scale = scene.field, scene.field.metres_per_unit or 1.0
    owners = np.where(np.append(listed.surroundings, True)[listed.labels], -1, listed.labels)
    ids, labels = np.unique(np.append(owners, -1), return_inverse=True)  # -1 is the first
    items = []
    for n, points in zip(ids[1:].tolist(), object_surfaces(field.gaussians, field.cameras, labels[:-1] - 1)):
        shape = listed.shapes[n]
        shape = dataclasses.replace(shape, center=scale * shape.center, half_size=scale * shape.half_size)
        box = {"center": shape.center, "size": 2 * shape.half_size, "axes": shape.axes}
        item = {"id": n, "name": listed.names[n], "box": box}
        items.append(item | object_solid(scale * source_points(field, points), shape))
    unit = "capture units" if scene.field.metres_per_unit is None else "metres"
    files = [out] if out.suffix in _WRITERS else [out / f"shapes{suffix}" for suffix in _WRITERS]
    for file in files:
        write_text(file, _WRITERS[file.suffix](items, unit))
    return files


def _to_json(items: list[_Item], unit: str) -> str:
    """Returns box, hull and primitive of each object."""
    return json.dumps({"unit": unit, "objects": items}, default=np.ndarray.tolist) + "\n"


def _title(item: _Item) -> str:
    """Returns the id and the name of an object."""
    return f"{item['id']:03d} {item['name']}"


def _turn(item: _Item) -> np.ndarray:
    """Returns the rotation of a primitive as a quaternion x, y, z, w."""
    return Rotation.from_matrix(item["primitive"]["axes"]).as_quat()


def _to_obj(items: list[_Item], unit: str) -> str:
    """Returns the hulls as one .obj with an object each."""
    lines, first = [f"# convex hulls of objects, in {unit}"], 1
    for item in items:
        vertices, triangles = item["hull"]["vertices"], item["hull"]["triangles"]
        lines.append(f"o {_title(item).replace(' ', '_')}")
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in vertices.tolist()]
        lines += ["f {} {} {}".format(*face) for face in (triangles + first).tolist()]
        first += len(vertices)
    return "\n".join(lines) + "\n"


def _to_mjcf(items: list[_Item], unit: str) -> str:
    """Returns a model for MuJoCo: static bodies, whose primitives collide and whose hulls are seen."""
    model, add = ElementTree.Element("mujoco", model="scene"), ElementTree.SubElement
    model.append(ElementTree.Comment(f" in {unit} "))
    assets, world = add(model, "asset"), add(model, "worldbody")
    for item in items:
        name, center = _title(item), item["primitive"]["center"]
        kind, size = item["primitive"]["type"], item["primitive"]["size"]
        half = {"box": 0.5 * size, "sphere": size}.get(kind, np.array([size[0], 0.5 * size[-1]]))
        add(assets, "mesh", name=name, vertex=_numbers(item["hull"]["vertices"] - center))
        body, turn = add(world, "body", name=name, pos=_numbers(center)), np.roll(_turn(item), 1)
        add(body, "geom", name=name, type=kind, size=_numbers(half), quat=_numbers(turn), group="3")
        add(body, "geom", type="mesh", mesh=name, contype="0", conaffinity="0", mass="0")
    ElementTree.indent(model)
    return ElementTree.tostring(model, encoding="unicode") + "\n"


def _numbers(numbers: np.ndarray) -> str:
    """Returns numbers as the value of an attribute."""
    return " ".join(f"{number:.9g}" for number in np.ravel(numbers).tolist())


def _to_moveit(items: list[_Item], unit: str) -> str:
    """Returns a moveit_msgs/CollisionObject of each primitive, as JSON, which readers of YAML take."""
    kinds = {"box": 1, "sphere": 2, "cylinder": 3}  # of shape_msgs/SolidPrimitive
    messages = []
    for item in items:
        kind, size = item["primitive"]["type"], item["primitive"]["size"].tolist()
        size = size[::-1] if kind == "cylinder" else size  # its height comes first
        position, turn = (dict(zip("xyzw", row.tolist())) for row in (item["primitive"]["center"], _turn(item)))
        message = {"header": {"frame_id": "world"}, "id": _title(item), "operation": 0}
        message |= {"primitives": [{"type": kinds[kind], "dimensions": size}]}
        messages.append(message | {"primitive_poses": [{"position": position, "orientation": turn}]})
    return json.dumps({"unit": unit, "collision_objects": messages}, indent=2) + "\n"


_WRITERS = {".json": _to_json, ".obj": _to_obj, ".xml": _to_mjcf, ".yaml": _to_moveit}
"""suffix -> function that writes objects in a unit as a text"""
