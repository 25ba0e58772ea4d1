"""`jsecon measure`: lengths between things or points, as lines and as CSV, and a scale from one known length."""

import itertools
from typing import Any

from jsecon.app import verbs
from jsecon.app.opening import locate_field
from jsecon.app.scene import open_scene
from jsecon.errors import InputError
from jsecon.field.field import save_field
from jsecon.files import csv_text, write_text
from jsecon.pipeline.progress import Console


def _measure(verb: verbs.Measure, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon measure`; the result has the measurements, and the scale of the field."""
    pairs = [*itertools.combinations(verb.texts, 2), *((ends[:3], ends[3:]) for ends in verb.points)]
    if verb.scale is not None and verb.scale_points is not None:
        raise InputError("--scale", "it cannot be combined with --scale-points", remedy="Give one known length.")
    known: Any = verb.scale
    if verb.scale_points is not None:
        known = verb.scale_points[:3], verb.scale_points[3:6], verb.scale_points[6]
    if not pairs and known is None:
        remedy = 'For example: jsecon measure my_field "red mug" "white plate"'
        raise InputError("measure", "there is nothing to measure", "two texts, --points, or --scale", remedy)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    if known is not None:
        scene = scene.scaled(*known)
        save_field(locate_field(verb.field).file, scene.field)
        scale = scene.field.metres_per_unit
        console.print_line(f"scale   1 unit is {scale:.6g} m, --metres-per-unit {scale:.6g} of a new run")
    with console.progress("lengths"):
        rows = [scene.measure(*pair) for pair in pairs]
    for row in rows:
        lengths = ", ".join(f"{row[name]:.4g} between {name}" for name in ("centers", "surfaces"))
        console.print_line(f"{row['a']} to {row['b']}: {lengths} ({row['unit']})")
    result: verbs.VerbResult = {"measurements": rows, "metres_per_unit": scene.field.metres_per_unit}
    if verb.out is None:
        return result
    write_text(verb.out, csv_text(("a", "b", "surfaces", "centers", "angle", "unit"), rows))
    console.print_line(f"table   {verb.out}")
    return result | {"written": {"table": verb.out}}
