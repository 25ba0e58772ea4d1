"""The fields of a server, loaded once and compiled before the first question."""

import contextlib
from pathlib import Path
from typing import Any

from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError


def open_scenes(files: list[Path], embedder: Path | None) -> dict[str, Scene]:
    """Opens fields, asks each once so that its programs are compiled, and measures its objects.

    Args:
      files: Paths of field.safetensors files. A field is named like its folder.
      embedder: Folder of the CLIP model of the fields; None where the runs had it.

    Returns:
      The scenes by name.

    Raises:
      InputError: A field cannot be read, or two have the same name.
    """
    scenes: dict[str, Scene] = {}
    for file in files:
        scene = open_scene(file, embedder=embedder)
        if scene.name in scenes:
            raise InputError(file, f"it is a second field named {scene.name!r}", remedy="Rename one of the folders.")
        scenes[scene.name] = scene
        _ = scene.embedder
        with contextlib.suppress(InputError):  # an embedder that has no word for it
            scene.prepare()
    return scenes


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Plain values: name, numbers of Gaussians, regions and unrelated words, frames and their size."""
    field = scene.field
    return {
        "name": scene.name,
        "gaussians": field.gaussians.count,
        "regions": field.regions.count,
        "unrelated_words": None if field.unrelated_words is None else len(field.unrelated_words),
        "frames": list(field.names),
        "size": [field.cameras.width, field.cameras.height],
    }
