"""The pytrees that flow through the pipeline.

They are frozen dataclasses of arrays, one line per field (shape, unit, range, frame).

Conventions, fixed here once: OpenCV camera axes (x right, y down, z forward); `world_to_camera` matrices; quaternions
wxyz, normalised on use; pixel (row i, column j) is sampled at (x, y) = (j + 0.5, i + 0.5) and u = fx x/z + cx; metres
where the data has them. Letters: N Gaussians, T frames, H x W pixels, R regions, E embedding, d code, D feature
channels.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeAlias, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax import export
from jax.core import Tracer
from jaxtyping import PRNGKeyArray, UInt32

Array: TypeAlias = jax.Array | np.ndarray
Leaf: TypeAlias = Any
"""an array field of a pytree defined elsewhere: while jax transforms it, it may hold a tracer, an axis or a sentinel"""
Key: TypeAlias = PRNGKeyArray | UInt32[Array, "2"]
"""of jax.random, new style or old"""
Progress: TypeAlias = Callable[[int, int], None]
"""called as progress(done, total)"""


def static(**kwargs) -> Any:
    """Declares a field that jax holds to be part of the type: jit compiles anew for each value."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True)
def record(cls):
    """Makes a class a frozen dataclass that is a pytree."""
    cls = jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(cls))
    export.register_pytree_node_serialization(
        cls,
        serialized_name=f"{cls.__module__}.{cls.__qualname__}",
        serialize_auxdata=lambda static: json.dumps(static).encode(),
        deserialize_auxdata=lambda text: tuple(json.loads(text)),
    )
    return cls


@record
class Gaussians:
    """A scene of N anisotropic 3D Gaussians (Kerbl et al. 2023), stored before their activations."""

    means: Array
    """(N, 3) centres, world."""
    log_scales: Array
    """(N, 3) natural logarithm of the standard deviations along the Gaussian's axes, world units."""
    quaternions: Array
    """(N, 4) wxyz rotation of the Gaussian's axes into the world; any length but zero."""
    opacity_logits: Array
    """(N,) logit of the opacity."""
    sh: Leaf = None
    """(N, K, 3) spherical harmonics of colour, K in {1, 4, 9, 16}, degree by degree; rgb = 0.5 + sum, clamped at 0.
    None if only features are rendered."""

    @property
    def count(self) -> int:
        """Number of records along the first axis."""
        return self.means.shape[0]


@record
class Camera:
    """A pinhole camera; leading axes batch every array alike. Width and height are static."""

    world_to_camera: Array
    """(..., 4, 4) rigid, OpenCV axes."""
    fx: Array
    """(...,) focal length in x, px."""
    fy: Array
    """(...,) focal length in y, px."""
    cx: Array
    """(...,) principal point, px, measured from the left edge of the first pixel."""
    cy: Array
    """(...,) principal point, px, measured from the upper edge of the first pixel."""
    width: int = static()
    """px."""
    height: int = static()
    """px."""

    def __getitem__(self, index) -> Camera:
        """The camera(s) at `index` of the leading axis."""
        return jax.tree.map(lambda a: a[index], self)

    def __len__(self) -> int:
        """Number of cameras along the leading axis. Raises TypeError for a single camera."""
        if self.world_to_camera.ndim < 3:
            raise TypeError("a single camera has no length: give it a leading axis to make a batch of one")
        return self.world_to_camera.shape[0]

    def __iter__(self) -> Iterator[Camera]:
        """Goes over the cameras of the leading axis. Raises TypeError for a single camera."""
        return (self[index] for index in range(len(self)))

    @property
    def centres(self) -> Array:
        """(..., 3) camera centres in the world."""
        rotation, translation = self.world_to_camera[..., :3, :3], self.world_to_camera[..., :3, 3]
        return -(rotation * translation[..., :, None]).sum(-2)


@dataclasses.dataclass(frozen=True)
class ImageFile:
    """The image that a frame was made of."""

    path: str
    """As the capture names it, with "/": its folders tell cameras apart."""
    width: int
    """px of the image as it was read: upright, unless its pose belongs to the stored pixels."""
    height: int
    orientation: int = 1
    """EXIF's that was applied; 1 if none."""


@dataclasses.dataclass(frozen=True)
class UpAxis:
    """Which way is up, and how that is known."""

    axis: tuple[float, ...]
    """(3,) unit vector, in the world of what it belongs to."""
    evidence: str
    """What it was taken from, in words."""
    sure: bool = True
    """Whether it is trusted."""

    def __str__(self) -> str:
        """Its evidence, and whether that is sure."""
        return f"{self.evidence}{'' if self.sure else ' (not sure: jsecon run --up X Y Z sets it)'}"


@record
class Capture:
    """A posed set of frames, as every loader returns it. Arrays are NumPy on the host."""

    frames: Array
    """(T, H, W, 3) uint8 RGB."""
    cameras: Camera
    """batch of T."""
    points: Array
    """(P, 3) float32 sparse points, world; P may be 0."""
    point_colors: Array
    """(P, 3) uint8 RGB."""
    held_out: Array
    """(T,) bool: frames that are only measured, never fitted to."""
    depths: Array | None
    """(T, H, W) float32 z-depth in world units, 0 = unknown; or None."""
    source_from_scene: Array
    """(4, 4) float64 similarity from this world to the files' world (identity if it was not normalised)."""
    names: tuple[str, ...] = static()
    """T file names without folder or ending, in frame order."""
    notes: tuple[str, ...] = static(default=())
    """What the loader left out or changed, a sentence each."""
    ignored: Array | None = None
    """(T, H, W) bool: pixels that no fit and no region counts, as of what moved, or overexposed ones; or None."""
    files: tuple[ImageFile, ...] = static(default=())
    """T images, or () if the frames have no files. Masks, proposals and depth follow their folders."""
    poses_from_scene: Array | None = None
    """(4, 4) similarity from this world to that of the poses in the files, before any transform that they name
    (applied_transform) is undone; None: it is the same."""
    up: UpAxis | None = static(default=None)
    """Which way is up in this world, where the capture's format or the planner of its views knows it."""
    metres_per_unit: float | None = static(default=None)
    """Metres of one unit of the files' world, where the format guarantees them."""


@record
class Rendering:
    """One rendered view."""

    features: Array
    """(H, W, D) sum of alpha T f over the Gaussians (+ (1 - alpha) background if there is one)."""
    alpha: Array
    """(H, W) sum of alpha T, in [0, 1); 0 on pixels that no Gaussian covers."""
    overflow: Array
    """() int32: pairs that did not fit the capacity and were left out; 0 means the image is exact."""
    depth: Array | None = None
    """(H, W) expected z-depth, world units, 0 on uncovered pixels; or None if it was not asked for."""


@record
class Quality:
    """How well a scene shows F photographs."""

    frames: Array
    """(F,) int indices into the capture's frames."""
    psnr: Array
    """(F,) dB."""
    ssim: Array
    """(F,) in [-1, 1]."""


@record
class Votes:
    """The weight that each region casts on each Gaussian: the K strongest regions of W^T onto one-hot labels."""

    regions: Array
    """(N, K) int32 region ids, strongest first, -1 in empty places."""
    weights: Array
    """(N, K) float32 sum of alpha T over the region's pixels in all views, 0 in empty places."""
    labelled: Array
    """(N,) sum of alpha T over labelled pixels, all regions."""
    total: Array
    """(N,) sum of alpha T over all pixels, labelled or not."""
    max_pixel_weight: Array
    """(N,) largest alpha T at any pixel of any view, in [0, 1)."""
    views: Array
    """(N,) int32 views in which the Gaussian has any weight; 0 = never seen: unknown."""
    overflow: Array
    """() int32 (block, Gaussian) pairs left out for want of capacity, all views; 0 means exact."""
    num_regions: int = static()
    """R."""
    by_view: Array | None = None
    """(T, N) sum of alpha T over the pixels of each view, or None where it was not kept."""
    weight_where_region_visible: Array | None = None
    """(N, K) sum of alpha T over the views that show that region, or one alike to it; None: not known."""
    overlap: Array | None = None
    """(R, R) in [0, 1]: soft IoU of the Gaussians of two regions; None: not known."""

    def dense(self) -> Array:
        """Spreads the votes over all regions."""
        n, k = self.regions.shape
        rows = jnp.broadcast_to(jnp.arange(n)[:, None], (n, k))
        columns = jnp.where(self.regions >= 0, self.regions, self.num_regions)
        return jnp.zeros((n, self.num_regions), self.weights.dtype).at[rows, columns].add(self.weights, mode="drop")


@record
class Regions:
    """One row per region: an object that the masks of several frames show."""

    embeddings: Array
    """(R, E) unit length; pixel-weighted mean of the views' embeddings (paper: phi_bar); zero where never embedded."""
    pixel_counts: Array
    """(R, T) int32 pixels of the region in each view; 0 where it is not seen."""
    embedded: Array | None = None
    """(C, 2) int32 region and view of each embedding that was averaged; a saved field has them in its ledger."""
    view_embeddings: Array | None = None
    """(C, E) float32 these embeddings."""

    @property
    def count(self) -> int:
        """Number of records along the first axis."""
        return self.embeddings.shape[0]


@record
class Autoencoder:
    """Parameters of one scene's autoencoder (`train_autoencoder`)."""

    encoder: Leaf
    """{"params", "batch_stats"}: nested dicts of arrays, flax's layout."""
    decoder: Leaf
    """{"params"}: nested dicts of arrays."""


@record
class Codes:
    """The paper's compressed features of d numbers, which `jsecon run --paper` adds to a field."""

    gaussians: Array
    """(N, d) unit codes; zero = unknown (never seen or never labelled)."""
    regions: Array
    """(R, d) unit codes of the regions."""
    autoencoder: Any
    """What encodes a text in the same way, an `Autoencoder`."""


@record
class Event:
    """A change of a field, with what it replaced there."""

    rows: Array
    """(M,) int32 Gaussians that it changed."""
    gaussians: Gaussians
    """(M,) these before."""
    views: Array
    """(M,) int32 `Votes.views` of these before."""
    regions: Array
    """(L,) int32 regions that it changed."""
    embeddings: Array
    """(L, E) theirs before."""
    description: str = static()
    """JSON: kind, date, name, region, frames, from and to in the capture's world."""


class _Texts(tuple):
    """Texts of a record that jit shall not compile for: any two are equal to it."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Texts)

    def __ne__(self, other: object) -> bool:
        return not isinstance(other, _Texts)

    def __hash__(self) -> int:
        return hash(_Texts)


@dataclasses.dataclass(frozen=True)
class LanguageField:
    """Everything a query needs, in one file: the scene, its votes, its regions, and where they came from.

    jit compiles once for all fields of the same shapes. So a field has no names, embedder and provenance inside of a
    trace, and neither has one that a compiled function returns.
    """

    gaussians: Gaussians
    votes: Votes
    regions: Regions
    cameras: Camera
    """batch of T: the capture's views, for masks and for `--at`."""
    canonical_phrases: Array
    """(C, E) embeddings of the canonical phrases (LERF: object, things, stuff, texture) in the embedder's space."""
    source_from_scene: Array
    """(4, 4) from the field's world to the capture files' world; undone on export."""
    names: tuple[str, ...] = static()
    """T frame names."""
    embedder: str = static(default="")
    """name of the embedder whose space the regions live in; texts must be embedded by the same."""
    provenance: str = static(default="{}")
    """JSON: version, options, inputs' digests."""
    unrelated_words: Array | None = None
    """(W, E) embeddings of words unrelated to the scene, W may be 0: what a text's similarity is
    measured against (jsecon.query.match). None: a field of an earlier version."""
    codes: Codes | None = None
    """codes of Gaussians and regions, which only queries by code read; None if the run was not asked for them."""
    up: UpAxis | None = None
    """which way is up in the field's world; None: a field of an earlier version."""
    metres_per_unit: float | None = None
    """metres of one unit of the capture files' world; None: not known."""
    tree: Array | None = None
    """(M,) int32 parent of each node, -1 at the top: nodes 0 .. R-1 are the regions, later ones unions of earlier ones,
    and then parts of regions, each before its parent if that is a part too. None where a tracker found the regions, or
    masks of files none of which lies in another."""
    leaf: Array | None = None
    """(N,) int32 smallest node of each Gaussian, -1 for none: a part of a region, or a region without parts."""
    part_regions: Regions | None = None
    """P parts of regions that masks show alone, or that have masks of their own; None where they are not known."""
    part_nodes: Array | None = None
    """(P,) int32 node of each of these parts."""
    history: tuple[Event, ...] = ()
    """changes of the field since it was made, in order of time (NumPy)."""


_TEXTS = {"names": (), "embedder": "", "provenance": "{}", "up": None, "metres_per_unit": None, "history": ()}
"""Static fields of LanguageField, and their values inside of a trace."""
_ARRAYS = tuple(part.name for part in dataclasses.fields(LanguageField) if part.name not in _TEXTS)


def _flatten_field(field: LanguageField) -> tuple[tuple, _Texts]:
    """The arrays of a field with their names, and its texts."""
    arrays = tuple((jax.tree_util.GetAttrKey(name), getattr(field, name)) for name in _ARRAYS)
    return arrays, _Texts(getattr(field, name) for name in _TEXTS)


def _unflatten_field(texts: _Texts, arrays: Iterable) -> LanguageField:
    parts = dict(zip(_ARRAYS, arrays))
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(parts))
    return LanguageField(**parts, **dict(zip(_TEXTS, _TEXTS.values() if traced else texts)))


jax.tree_util.register_pytree_with_keys(LanguageField, _flatten_field, _unflatten_field)


@record
class Selection:
    """The answer to one query."""

    mask: Array
    """(N,) bool: the selected Gaussians."""
    similarity: Array
    """(N,) float: cosine, relevancy, or share of votes, as the query says; what the threshold was applied to."""
    region: Array
    """() int32 region that anchored the query; -1 if no region was retrieved, or for a query without anchor."""
    score: Array
    """() float: similarity of the text to that region; for queries without anchor the best similarity."""
    rank: Array | None = None
    """() float: share of unrelated words that are less similar to the scene than the text is; NaN or None where that is
    not known."""
    state: Array | None = None
    """() int: index of `jsecon.query.rules.STATES`, whether the scene has what the text names; None without a text."""
