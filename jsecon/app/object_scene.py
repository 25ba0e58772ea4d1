"""A field prepared for referring expressions: the objects that phrases name, with their Gaussians, boxes and points."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jsecon.app.ask import frame_index, narrow_texts, with_phrases
from jsecon.app.catalogue import Catalogue, objects as list_objects, region_objects
from jsecon.app.locate import gaussian_rows
from jsecon.errors import InputError
from jsecon.field.columns import votes_of_rows
from jsecon.field.membership import SHARE_THRESHOLD, inside_fraction_of_regions
from jsecon.pipeline.sources import locate_sources
from jsecon.query.answer import match_regions
from jsecon.query.grouping import join_fragments
from jsecon.query.object_shapes import ObjectShapes, gaussian_spreads, object_shapes
from jsecon.query.outliers import split_outliers
from jsecon.query.referring import FoundObject
from jsecon.query.relations import Viewpoint, viewpoint
from jsecon.query.rules import QueryRules
from jsecon.read.captures.capture import has_depth
from jsecon.types import Camera, LanguageField
from jsecon.views.frame import field_up

ONE_WAY = 0.5
"""length of the mean of the cameras' horizontal directions from which they look one way"""
SAME_NAME = 1e-4
"""cosine by which a name must be nearer to an object than the text, to fit it better"""


class ObjectScene:
    """A field prepared for expressions. It keeps the objects that phrases named, with their shapes.

    Args:
      field: The field.
      embedder: Its embedder.
      up: (3,) up axis in the capture's world; None takes it from the cameras, or from the ground.

    Raises:
      InputError: `up` has no direction.
    """

    def __init__(self, field: LanguageField, embedder: Any, *, up: Sequence[Any] | None = None):
        """Finds the up axis; objects are measured when they are first asked for."""
        self.up = field_up(field, up)
        field = with_phrases(field, embedder)
        regions = jax.tree.map(jnp.asarray, field.regions)  # on the device once, not for each phrase
        reference = None if field.unrelated_words is None else jnp.asarray(field.unrelated_words)
        cameras = jax.tree.map(np.asarray, field.cameras)  # on which jax would compile each step of a viewpoint
        self.field = dataclasses.replace(field, regions=regions, unrelated_words=reference, cameras=cameras)
        self.embedder = embedder
        self.source_from_scene = np.asarray(field.source_from_scene, np.float64)
        self.scale = float(np.cbrt(abs(np.linalg.det(self.source_from_scene[:3, :3]))))
        self.rules = QueryRules(all_of_class=True, logits=getattr(embedder, "logits", None))
        self._given_up = up
        self._votes = jax.tree.map(np.asarray, field.votes)
        self._object = functools.cache(self._measure_object)
        self._phrases: dict[str, tuple[list[FoundObject], float]] = {}

    def prepare(self) -> None:
        """Measures the object of every region, so that the first questions are as fast as later ones.

        Raises:
          InputError: The embedder has no names for objects.
        """
        for group in join_fragments(range(self.field.regions.count), self._joined):
            for regions in {(region,) for region in group} | {group}:
                self._object(regions)
        if self.field.regions.count:
            match_regions(self.field, self.field.regions.embeddings[:1], self.rules)  # compiles it
        _ = self.catalogue, self._names

    @functools.cached_property
    def catalogue(self) -> Catalogue:
        """All objects with names, which tell objects of one name apart."""
        return list_objects(self.field, None, self.embedder, up=self._given_up)

    def objects_of(self, phrase: str) -> tuple[list[FoundObject], float]:
        """Finds the objects that a phrase names: regions that match it, those of one object joined.

        These overlap, or are one object in the catalogue: the ends of a beam whose middle is hidden. Where a text is
        the best name of some of the objects, the others do not count.

        Args:
          phrase: Free text for the embedder.

        Returns:
          The objects, and the share of unrelated words that are less similar to the scene than the phrase.

        Raises:
          InputError: The embedder has no words for the phrase.
        """
        if phrase not in self._phrases:
            texts = narrow_texts(self.field, self.embedder, [phrase], self.rules, every=True)
            embedded = jax.device_put(self.embedder.embed_text(texts))
            match = match_regions(self.field, embedded, self.rules)
            regions = np.flatnonzero(np.asarray(match.chosen)) if int(match.region) >= 0 else np.zeros(0, int)
            groups = self._best_named(texts, join_fragments(regions, self._joined))
            made = [(group, self._object(group)) for group in groups]
            objects = [FoundObject(phrase, group, *parts) for group, parts in made if parts is not None]
            self._phrases[phrase] = objects, float(match.rank)
        return self._phrases[phrase]

    def _best_named(self, texts: Sequence[str], groups: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
        """Keeps the objects that no other name of the vocabulary fits better than the text, if there are any.

        "Orange" means the orange thing where there is a dark orange one too.
        """
        if len(texts) > 1 or len(groups) < 2 or self._names is None:
            return groups
        embeddings = np.asarray(self.field.regions.embeddings)
        similarity = embeddings @ np.asarray(self.embedder.embed_text(list(texts)))[0]
        fits = similarity >= (embeddings @ self._names.T).max(1) - SAME_NAME
        return [group for group in groups if fits[list(group)].any()] or groups

    @functools.cached_property
    def _names(self) -> np.ndarray | None:
        """(V, E) embeddings of the embedder's vocabulary, if it has one."""
        names = getattr(self.embedder, "vocabulary", ())
        return np.asarray(self.embedder.embed_text(list(names))) if names else None

    @functools.cached_property
    def _joined(self) -> np.ndarray:
        """(R, R) overlap of the regions; 1 for those of one object."""
        groups = region_objects(self.field, self.up)
        same = (groups[:, None] == groups).astype(np.float32)
        return same if self._votes.overlap is None else np.maximum(self._votes.overlap, same)

    @functools.cached_property
    def _voters(self) -> list[np.ndarray]:
        """The Gaussians that have votes for each region, rising."""
        regions = self._votes.regions
        count = self.field.regions.count
        owners = np.where((regions >= 0) & (regions < count), regions, count).ravel()
        order = np.argsort(owners.astype(np.uint16 if count < 1 << 16 else np.int32), kind="stable")
        ends = np.cumsum(np.bincount(owners, minlength=count + 1))[:count]
        return np.split(order // regions.shape[1], ends)[:count]

    def _measure_object(self, regions: tuple[int, ...]) -> tuple[np.ndarray, ObjectShapes] | None:
        """Returns Gaussians and shape of the object of some regions; None if it has no Gaussian."""
        voters = np.unique(np.concatenate([self._voters[region] for region in regions]))
        share = inside_fraction_of_regions(votes_of_rows(self._votes, voters), regions)
        rows, share = voters[share >= SHARE_THRESHOLD], share[share >= SHARE_THRESHOLD]
        taken = gaussian_rows(dataclasses.replace(self.field.gaussians, sh=None), rows)
        weight = share * self._votes.total[rows]
        kept = split_outliers(taken.means, np.ones(len(rows), bool), keep="supported", weight=weight).mask
        if not kept.any():
            return None
        taken = gaussian_rows(taken, kept)
        shape = object_shapes(taken.means, np.zeros(taken.count, int), self.up, spreads=gaussian_spreads(taken))
        return rows[kept], shape

    def view(self, frame: int | str | None, camera: Camera | None) -> tuple[Viewpoint, str]:
        """Chooses from where directions are seen.

        Args:
          frame: Name or index of a frame, or None.
          camera: Camera in the field's world, or None. Without frame and camera it is the mean camera, or the frame
            that shows most objects where the cameras look in all directions.

        Returns:
          The viewpoint, and what it is in words.

        Raises:
          InputError: The field has no such frame.
        """
        words = "as seen from the given camera"
        if camera is None and frame is None:
            ahead = np.asarray(self.field.cameras.world_to_camera, np.float64)[:, 2, :3]
            ahead = ahead - (ahead @ self.up)[:, None] * self.up
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
            mean = ahead.mean(0)
            if np.linalg.norm(mean) >= ONE_WAY:
                middle = np.asarray(self.field.cameras.centres, np.float64).mean(0)
                return Viewpoint(middle, mean / np.linalg.norm(mean), self.up), "as seen from the mean of the cameras"
            pixels = np.asarray(self.field.regions.pixel_counts, np.int64)
            frame = int(np.lexsort((pixels.sum(0), (pixels > 0).sum(0)))[-1])
        if camera is None:
            index = frame_index(self.field, frame if frame is not None else 0)
            camera = self.field.cameras[index]
            words = f"as seen from {self.field.names[index]}"
        return viewpoint(jax.tree.map(np.asarray, camera), self.up), words

    @property
    def unit(self) -> str:
        """Unit of the capture's world."""
        capture = locate_sources(self.field).capture
        return "metres" if capture is not None and has_depth(Path(capture)) else "capture units"


def open_scene(field: LanguageField | ObjectScene, embedder: Any, up: Sequence[Any] | None = None) -> ObjectScene:
    """Prepares a field for expressions, unless it is prepared.

    Args:
      field: The field, or an `ObjectScene`, which is returned as it is.
      embedder: Embedder of the field; None opens it.
      up: (3,) up axis in the capture's world; None finds it.

    Returns:
      The prepared field.

    Raises:
      InputError: The field has no regions, its embedder cannot be opened, or `up` has no direction.
    """
    if isinstance(field, ObjectScene):
        return field
    if field.regions.count == 0:
        raise InputError("field", "it has no regions, so no objects", remedy="Make it again with other --masks.")
    if embedder is None:
        from jsecon.pipeline.model_loading import field_embedder

        embedder = field_embedder(field)
    return ObjectScene(field, embedder, up=up)
