"""The scenes of a server, opened once and compiled before the first question."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from jsecon.app.scene import Scene, open_scene
from jsecon.errors import InputError


def open_scenes(files: Sequence[Path], embedder: str | Path | None) -> dict[str, Scene]:
    """Opens fields, each named like its folder, and prepares them for questions.

    `embedder` is the CLIP model of the fields (`open_scene`); None takes the one that each run used.
    """
    scenes: dict[str, Scene] = {}
    for file in files:
        scene = open_scene(file, embedder=embedder)
        if scene.name in scenes:
            raise InputError(file, f"it is a second field named {scene.name!r}", remedy="Rename one of the folders.")
        scenes[scene.name] = scene
        _ = scene.embedder
        with contextlib.suppress(InputError):  # an embedder that has no word for what is asked to prepare it
            scene.prepare()
    return scenes


def find_scene(scenes: Mapping[str, Scene], name: str | None) -> Scene:
    """Returns the scene of a name; the first if the name is None."""
    if name is None:
        return next(iter(scenes.values()))
    if name not in scenes:
        raise InputError(f"field {name!r}", "there is no such field", remedy=f"There are {', '.join(scenes)}.")
    return scenes[name]
