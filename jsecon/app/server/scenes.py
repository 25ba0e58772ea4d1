"""The fields of a server, loaded once, with the answers that they gave."""

import contextlib
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from jsecon.app.ask import Answer, ask_pixel, ask_text, frame_index
from jsecon.app.locate import locate_answer
from jsecon.app.object_scene import ObjectScene
from jsecon.app.outputs import best_frames
from jsecon.errors import InputError
from jsecon.field.field import load_field
from jsecon.pipeline.model_loading import field_embedder
from jsecon.query.render import selection_mask
from jsecon.types import LanguageField

MAX_ANSWERS = 64
"""number of answers that are kept, of five bytes a Gaussian each"""
MAX_RECORDS = 4096
"""number of records that are kept, of some kilobytes each"""


class SceneQuery(NamedTuple):
    """A query.

    Attributes:
      text: The text; "" for a pixel.
      pixel: Frame (name or index), column and row, or None.
      by: One of `METHODS`.
      threshold: Threshold of the method; None is its default.
      several: Whether to select all regions that match the text.
    """

    text: str
    pixel: tuple[str | int, int, int] | None = None
    by: str = "votes"
    threshold: float | None = None
    several: bool = False


class Scene:
    """A loaded field.

    Args:
      name: Its name.
      field: The field.
      embedder: The embedder of its regions.

    Attributes:
      answer: Answers a query. It keeps the last answers.
      records: Records of the queries that were answered, as plain values.
      gaussians: The field's, on jax's device.
      cameras: The field's, as NumPy arrays.
    """

    def __init__(self, name: str, field: LanguageField, embedder: Any):
        self.name = name
        self.field = field
        self.embedder = embedder
        self.answer = functools.lru_cache(MAX_ANSWERS)(self._answer)
        self.records: dict[SceneQuery, dict[str, Any]] = {}
        self.gaussians = jax.device_put(field.gaussians)
        self.cameras = jax.tree.map(np.asarray, field.cameras)  # whose items need no compilation

    def _answer(self, query: SceneQuery) -> Answer:
        """Answers a query that is not among the last ones."""
        options: dict[str, Any] = {"by": query.by, "threshold": query.threshold}
        if query.pixel is not None:
            return ask_pixel(self.field, *query.pixel, **options)
        return ask_text(self.field, self.embedder, query.text, several=query.several, **options)

    def record(self, query: SceneQuery) -> dict[str, Any]:
        """Answers a query by plain values, which are kept in `records`.

        Args:
          query: The query.

        Returns:
          Count, objects, region, score and `Place` of the selection, without a place if it is empty.

        Raises:
          InputError: The query cannot be answered (`ask_text`, `ask_pixel`).
        """
        answer = self.answer(query)
        region = int(answer.selection.region)
        if len(self.records) >= MAX_RECORDS:
            self.records.clear()
        self.records[query] = {
            "query": answer.query,
            "field": self.name,
            "count": int(answer.mask.sum()),
            "objects": answer.objects if answer.mask.any() else 0,
            "region": region if region >= 0 else None,
            "score": round(float(answer.selection.score), 6),
            "place": locate_answer(self.field, answer).as_dict() if answer.mask.any() else None,
        }
        return self.records[query]

    @functools.cached_property
    def object_scene(self) -> ObjectScene:
        """The field as relations read it."""
        return ObjectScene(self.field, self.embedder)

    def mask(self, answer: Answer, frame: int | str | None) -> tuple[int, Bool[np.ndarray, "h w"]]:
        """Renders an answer alone in a frame.

        Args:
          answer: The answer.
          frame: Name or index of the frame; None is the one that shows most of it.

        Returns:
          Index of the frame, and the pixels of the answer.

        Raises:
          InputError: There is no such frame.
        """
        best = [*best_frames(self.field, answer, 1), 0][0]
        index = best if frame is None else frame_index(self.field, frame)
        return index, np.asarray(selection_mask(self.gaussians, self.cameras[index], jnp.asarray(answer.mask)))

    @property
    def description(self) -> dict[str, Any]:
        """Plain values: name, numbers of Gaussians, regions and unrelated words, frames and their size."""
        return {
            "name": self.name,
            "gaussians": self.field.gaussians.count,
            "regions": self.field.regions.count,
            "unrelated_words": None if self.field.unrelated_words is None else len(self.field.unrelated_words),
            "frames": list(self.field.names),
            "size": [self.field.cameras.width, self.field.cameras.height],
        }


def open_scenes(files: list[Path], embedder: Path | None) -> dict[str, Scene]:
    """Loads fields, asks each once so that its programs are compiled, and measures its objects.

    Args:
      files: Paths of field.safetensors files. A field is named like its folder.
      embedder: Folder of the CLIP model of the fields; None where the runs had it.

    Returns:
      The fields by name.

    Raises:
      InputError: A field cannot be read, or two have the same name.
    """
    scenes: dict[str, Scene] = {}
    for file in files:
        name = file.parent.name if file.stem == "field" and file.parent.name else file.stem
        if name in scenes:
            raise InputError(file, f"it is a second field named {name!r}", remedy="Rename one of the folders.")
        field = load_field(file)
        scenes[name] = Scene(name, field, field_embedder(field, embedder))
        with contextlib.suppress(InputError):  # an embedder that has no word for it
            scenes[name].mask(scenes[name].answer(SceneQuery("red")), 0)
            scenes[name].object_scene.prepare()
    return scenes
