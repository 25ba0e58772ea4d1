"""`jsecon export --shapes`: solids of objects as JSON, .obj, MuJoCo's MJCF and MoveIt's CollisionObjects."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from jsecon.app.catalogue import Catalogue
from jsecon.app.records import gaussian_rows, source_points
from jsecon.app.scene import Scene
from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.query.object_shapes import gaussian_spreads
from jsecon.query.solids import Solid, object_solid
from jsecon.splat.transform import transform_gaussians


class _Item(NamedTuple):
    """An object: its solids in metres if the field knows them, else in the capture's unit."""

    id: int
    name: str
    """Its id and name."""
    solid: Solid
    box: dict[str, list[float]]
    """Center, size and axes of its box; the center is that of the primitive too."""

    @property
    def centre(self) -> np.ndarray:
        """(3,) middle of its box and of the primitive."""
        return np.array(self.box["center"])

    @property
    def turn(self) -> Rotation:
        """Rotation of the primitive."""
        return Rotation.from_matrix(self.solid.axes)


def write_shapes(scene: Scene, listed: Catalogue, out: Path) -> list[Path]:
    """Writes the solids of all whole objects but surroundings, as the file's suffix says, or in a folder as all four.

    They stand in the capture's world, in metres if the field knows their length.
    """
    scale = scene.field.metres_per_unit or 1.0
    items = []
    for record in listed.records():
        if record["parent"] is None and not record["surroundings"]:
            shape = listed.shapes[record["id"]]
            gaussians = gaussian_rows(scene.field.gaussians, listed.mask(record["id"]))
            spreads = gaussian_spreads(transform_gaussians(gaussians, scene.field.source_from_scene))
            solid = object_solid(source_points(scene.field, np.asarray(gaussians.means)), spreads, shape)
            size = tuple(scale * length for length in solid.size)
            solid = solid._replace(vertices=scale * solid.vertices, volume=scale**3 * solid.volume, size=size)
            box = {"center": scale * shape.center, "size": 2 * scale * shape.half_size, "axes": shape.axes}
            box = {key: values.tolist() for key, values in box.items()}
            items.append(_Item(record["id"], f"{record['id']:03d} {record['name']}".rstrip(), solid, box))
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
    objects = []
    for item in items:
        solid = item.solid
        hull = {"vertices": solid.vertices.tolist(), "triangles": solid.triangles.tolist(), "volume": solid.volume}
        primitive = {"type": solid.primitive, "size": list(solid.size), "axes": solid.axes.tolist()}
        names = {"id": item.id, "name": item.name[4:]}
        objects.append(names | {"box": item.box, "hull": hull, "primitive": primitive | {"center": item.box["center"]}})
    return json.dumps({"unit": unit, "objects": objects}) + "\n"


def _to_obj(items: list[_Item], unit: str) -> str:
    """Returns the hulls as one .obj with an object each."""
    lines, first = [f"# convex hulls of objects, in {unit}"], 1
    for item in items:
        lines.append(f"o {item.name.replace(' ', '_')}")
        lines += ["v {:.9g} {:.9g} {:.9g}".format(*vertex) for vertex in item.solid.vertices.tolist()]
        lines += ["f {} {} {}".format(*face) for face in (item.solid.triangles + first).tolist()]
        first += len(item.solid.vertices)
    return "\n".join(lines) + "\n"


def _to_mjcf(items: list[_Item], unit: str) -> str:
    """Returns a model for MuJoCo: static bodies, whose primitives collide and whose hulls are seen."""
    assets, bodies = [], []
    for item in items:
        solid, name = item.solid, quoteattr(item.name)
        half = {"box": [0.5 * side for side in solid.size], "sphere": list(solid.size)}
        size = half.get(solid.primitive, [solid.size[0], 0.5 * solid.size[-1]])
        turn = np.roll(item.turn.as_quat(), 1)
        assets.append(f"<mesh name={name} vertex={_words(solid.vertices - item.centre)}/>")
        bodies.append(
            f"<body name={name} pos={_words(item.centre)}>"
            f'<geom name={name} type="{solid.primitive}" size={_words(size)} quat={_words(turn)} group="3"/>'
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
        solid = item.solid
        size = solid.size[::-1] if solid.primitive == "cylinder" else solid.size  # its height comes first
        position, turn = (dict(zip("xyzw", row.tolist())) for row in (item.centre, item.turn.as_quat()))
        message = {"header": {"frame_id": "world"}, "id": item.name, "operation": 0}
        message |= {"primitives": [{"type": kinds[solid.primitive], "dimensions": list(size)}]}
        messages.append(message | {"primitive_poses": [{"position": position, "orientation": turn}]})
    return json.dumps({"unit": unit, "collision_objects": messages}, indent=2) + "\n"


_WRITERS: Mapping[str, Callable[[list[_Item], str], str]] = {
    ".json": _to_json, ".obj": _to_obj, ".xml": _to_mjcf, ".yaml": _to_moveit
}  # fmt: skip
"""suffix -> function that writes objects in a unit as a text"""
