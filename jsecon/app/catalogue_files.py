"""A catalogue as files: objects.json, objects.csv, catalogue.html with pictures, and a .ply of each object."""

import csv
import io
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jsecon.app import pictures, report
from jsecon.app.catalogue import Catalogue
from jsecon.app.locate import decimals, rounded
from jsecon.app.outputs import save_scene, slug
from jsecon.files import atomic_write, write_text
from jsecon.pipeline.progress import Listener
from jsecon.query.render import selection_mask
from jsecon.types import LanguageField

THUMBNAIL_PX = 150
"""longer side of an object's small picture"""
MAX_NAME_BYTES = 60
"""bytes of an object's name in the name of a file"""


def object_record(catalogue: Catalogue, index: int) -> dict[str, Any]:
    """Returns an object as plain values for JSON. Columns of "axes" are the axes of the box."""
    shape = catalogue.shapes[index]
    length = float(np.linalg.norm(shape.high - shape.low))
    names = zip(catalogue.names[index], catalogue.probability[index])
    box = {"center": rounded(shape.center, length), "size": rounded(2 * shape.half_size, length)}
    return {
        "id": index,
        "names": [{"name": name, "probability": round(float(p), 4)} for name, p in names if name],
        "surroundings": bool(catalogue.surroundings[index]),
        "parent": int(catalogue.parent[index]) if catalogue.parent[index] >= 0 else None,
        "gaussians": int(shape.count),
        "confidence": round(float(catalogue.confidence[index]), 4),
        "views": int(catalogue.views[index]),
        "frames": [catalogue.frame_names[t] for t in catalogue.frames[index] if t >= 0],
        "box": box | {"axes": np.round(shape.axes, 6).tolist()},
        "low": rounded(shape.low, length),
        "high": rounded(shape.high, length),
    }


def print_catalogue(catalogue: Catalogue, listener: Listener) -> None:
    """Prints a line for each object; parts are indented under their wholes."""
    wide = max((len(_title(catalogue, n)) for n in range(len(catalogue))), default=4) + 2
    listener.say(f"{'id':>4}  {'name':<{wide}}  prob.  Gaussians  views  conf.  size, centre")
    for n in range(len(catalogue)):
        name = ("  " if catalogue.parent[n] >= 0 else "") + _title(catalogue, n)
        figures = f"{catalogue.probability[n, 0]:5.2f}  {catalogue.shapes.count[n]:9d}  {catalogue.views[n]:5d}"
        place = f"{_size(catalogue, n)}, at ({_center(catalogue, n)})"
        ending = ", surroundings" if catalogue.surroundings[n] else ""
        listener.say(f"{n:>4}  {name:<{wide}}  {figures}  {catalogue.confidence[n]:5.2f}  {place}{ending}")
    if not len(catalogue):
        listener.say("  there are no objects: the field has no regions with Gaussians")


def write_catalogue(field: LanguageField, catalogue: Catalogue, out: Path, listener: Listener) -> dict[str, Path]:
    """Writes OUT/objects.json, OUT/objects.csv and OUT/catalogue.html.

    Args:
      field: The field.
      catalogue: Its catalogue.
      out: Output folder.
      listener: Receives progress.

    Returns:
      The files.
    """
    files = {name: out / f"{name}.{ending}" for name, ending in (("objects", "json"), ("catalogue", "html"))}
    files["table"] = out / "objects.csv"
    rows = [object_record(catalogue, n) for n in range(len(catalogue))]
    content = {"frame": "the capture's world", "up": catalogue.up.round(6).tolist(), "objects": rows}
    write_text(files["objects"], json.dumps(content, indent=2) + "\n")
    columns = catalogue.to_dict()
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values()):
        writer.writerow([" ".join(value) if isinstance(value, list) else value for value in row])
    write_text(files["table"], table.getvalue())
    write_text(files["catalogue"], _page(field, catalogue, listener))
    return files


def save_objects(field: LanguageField, catalogue: Catalogue, folder: Path) -> list[Path]:
    """Writes a .ply of each object, named by its id and name; of a whole with the Gaussians of its parts.

    Args:
      field: The field.
      catalogue: Its catalogue.
      folder: Output folder.

    Returns:
      The files, in the order of the catalogue.
    """
    files = []
    for n in range(len(catalogue)):
        name = slug(_title(catalogue, n)).encode()[:MAX_NAME_BYTES].decode("utf-8", "ignore")
        files.append(folder / f"{n:03d}-{name}.ply")
        save_scene(field, files[-1], rows=np.flatnonzero(catalogue.mask(n)))
    return files


def save_labels(labels: np.ndarray, file: Path) -> None:
    """Writes the id of the object of each Gaussian as a .npy of int32, -1 for none."""
    with atomic_write(file) as temporary, temporary.open("wb") as stream:
        np.save(stream, np.asarray(labels, np.int32))


def _page(field: LanguageField, catalogue: Catalogue, listener: Listener) -> str:
    """Returns the page: a card for each object, which opens to its views."""
    renderer = pictures.Renderer(field.gaussians, field.cameras)
    cameras = jax.tree.map(np.asarray, field.cameras)
    gaussians = jax.device_put(field.gaussians)
    means = np.asarray(field.gaussians.means)
    cards: dict[bool, list[str]] = {False: [], True: []}
    with listener.progress("pictures") as progress:
        for n in range(len(catalogue)):
            mask = catalogue.mask(n)
            frames = [int(t) for t in catalogue.frames[n] if t >= 0]
            figures = []
            for t in frames:
                seen = np.asarray(selection_mask(gaussians, cameras[t], mask))
                figures.append(report.figure(pictures.selection_overlay(renderer.photo(t), seen), field.names[t]))
            photo = renderer.photo(frames[0] if frames else 0)
            crop = pictures.crop_to_points(photo, cameras[frames[0] if frames else 0], means[mask])
            cards[bool(catalogue.surroundings[n])].append(
                report.card(
                    pictures.fitted(crop, THUMBNAIL_PX),
                    _title(catalogue, n),
                    f"{n} · {_size(catalogue, n)}{_part(catalogue, n)}",
                    report.grid(figures, 3),
                    report.table(("", ""), _facts(catalogue, n), numbers_from=2),
                    search=" ".join((str(n), *map(str, catalogue.names[n]))),
                )
            )
            progress(n + 1, len(catalogue))
    things = int((~catalogue.surroundings & (catalogue.parent < 0)).sum())
    figures = {
        "objects": str(things),
        "parts of them": str(int((catalogue.parent >= 0).sum())),
        "surroundings": str(int(catalogue.surroundings.sum())),
        "of the Gaussians in objects": f"{float((catalogue.labels >= 0).mean() if len(catalogue.labels) else 0):.0%}",
    }
    parts = [report.tiles(figures), report.search_box("Search names and ids"), report.cards(cards[False])]
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


def _part(catalogue: Catalogue, n: int) -> str:
    """Returns what an object is a part of, in words, or ""."""
    return f" · part of {catalogue.parent[n]}" if catalogue.parent[n] >= 0 else ""


def _size(catalogue: Catalogue, n: int) -> str:
    """Returns length, width and height of an object, to a hundredth of its size."""
    size = 2 * catalogue.shapes.half_size[n]
    digits = decimals(float(np.linalg.norm(size)), 0.01)
    return " x ".join(f"{side:.{digits}f}" for side in size)


def _center(catalogue: Catalogue, n: int) -> str:
    """Returns the centre of an object, to a hundredth of its size."""
    digits = decimals(2 * float(np.linalg.norm(catalogue.shapes.half_size[n])), 0.01)
    return ", ".join(f"{x:.{digits}f}" for x in catalogue.shapes.center[n])
