"""`jsecon export --shapes`: solids of objects as JSON, .obj, MuJoCo's MJCF and MoveIt's CollisionObjects."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from jsecon.app.catalogue import Catalogue
from jsecon.app.records import source_points
from jsecon.app.scene import Scene
from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.query.solids import object_solid, surface_points

_Item: TypeAlias = dict[str, Any]
"""An object with its box, hull and primitive, as the JSON has it with lists in place of arrays."""


def write_shapes(scene: Scene, listed: Catalogue, out: Path) -> list[Path]:
    """Writes the solids of all whole objects but surroundings, as the file's suffix says, or in a folder as all four.

    They stand in the capture's world, in metres if the field knows their length.
    """
    field, scale = scene.field, scene.field.metres_per_unit or 1.0
    wholes = [record for record in listed.records() if record["parent"] is None and not record["surroundings"]]
    labels = np.full(field.gaussians.count, -1)
    for n, record in enumerate(wholes):
        labels[listed.mask(record["id"])] = n
    items = []
    for record, points in zip(wholes, surface_points(field.gaussians, field.cameras, labels)):
        shape = listed.shapes[record["id"]]
        solid = object_solid(source_points(field, points), shape)
        hull = {"vertices": scale * solid.vertices, "triangles": solid.triangles, "volume": scale**3 * solid.volume}
        primitive = {"type": solid.primitive, "size": scale * np.array(solid.size), "axes": solid.axes}
        box = {"center": scale * shape.center, "size": 2 * scale * shape.half_size, "axes": shape.axes}
        item = {"id": record["id"], "name": record["name"], "box": box, "hull": hull}
        items.append(item | {"primitive": primitive | {"center": scale * solid.center}})
    unit = "capture units" if scene.field.metres_per_unit is None else "metres"
    files = [out] if out.suffix in _WRITERS else [out / f"shapes{suffix}" for suffix in _WRITERS]
    for file in files:
        write_text(file, _WRITERS[file.suffix](items, unit))
    return files


def require_shapes_format(out: Path) -> None:
    """Checks that `write_shapes` knows the suffix of a file, which need not exist, or that it is a folder."""
    if out.suffix and out.suffix not in _WRITERS and not out.is_dir():
        expected = f"{', '.join(_WRITERS)}, or a folder"
        raise InputError(out, f"its name ends in {out.suffix}", expected, "For example: --shapes shapes.xml")


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
    assets, bodies = [], []
    for item in items:
        name, center = quoteattr(_title(item)), item["primitive"]["center"]
        kind, size = item["primitive"]["type"], item["primitive"]["size"]
        half = {"box": 0.5 * size, "sphere": size}.get(kind, np.array([size[0], 0.5 * size[-1]]))
        assets.append(f"<mesh name={name} vertex={_words(item['hull']['vertices'] - center)}/>")
        bodies.append(
            f"<body name={name} pos={_words(center)}>"
            f'<geom name={name} type="{kind}" size={_words(half)} quat={_words(np.roll(_turn(item), 1))} group="3"/>'
            f'<geom type="mesh" mesh={name} contype="0" conaffinity="0" mass="0"/></body>'
        )
    return (
        f'<mujoco model="scene">\n  <!-- in {unit} -->\n  <asset>\n    '
        + "\n    ".join(assets)
        + "\n  </asset>\n  <worldbody>\n    "
        + "\n    ".join(bodies)
        + "\n  </worldbody>\n</mujoco>\n"
    )


def _words(numbers: Any) -> str:
    """Returns numbers as an attribute of XML."""
    return f'"{" ".join(f"{number:.9g}" for number in np.ravel(numbers).tolist())}"'


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


_WRITERS: Mapping[str, Callable[[list[_Item], str], str]] = {
    ".json": _to_json, ".obj": _to_obj, ".xml": _to_mjcf, ".yaml": _to_moveit
}  # fmt: skip
"""suffix -> function that writes objects in a unit as a text"""
