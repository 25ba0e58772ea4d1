"""Votes of a scene that need not fit into memory: columns are read, views composited and votes summed in blocks.

Each view is composited band by band, front to back (splat/bands.py), with the transmittance of each pixel carried from
band to band: a Gaussian has the weight that it has among all. What a view casts goes to disk by blocks of Gaussians
(language/records.py) and is added up block by block, so that no array of N rows is ever held: nothing is cut before all
views are summed.
"""

import contextlib
import dataclasses
import functools
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from jsecon.errors import InputError, require, require_shape
from jsecon.files import atomic_write, map_npy, write_npy
from jsecon.language.distill import MIN_LABELLED, distill_votes
from jsecon.language.membership import views_that_show, vote_blocks
from jsecon.language.records import append, summed_columns
from jsecon.language.votes import at_centre, distinct_labels
from jsecon.numerics import FULL_PRECISION, NEAR, require_labels
from jsecon.splat.banded import listed, still_open
from jsecon.splat.bands import MOST_HELD, ROWS, Band, Bounds, band_size, bands, block_bounds
from jsecon.splat.fusion import materialize
from jsecon.splat.tiles import TILE, TileLists, tile_grid
from jsecon.splat.walk import blend_weights, make_batches, make_table, to_tiles, walk
from jsecon.types import Array, Camera, Gaussians, Regions, Votes

_SLOTS = 4
"""distinct labels of a tile that one walk counts; where a tile shows more, it is walked again for the rest"""

_MOST_SEEN = 1 << 26
"""weights, each of a view on a Gaussian, of a block that is summed with `by_view`"""


@runtime_checkable
class Images(Protocol):
    """One image after the other: an array, or what reads them from where they lie."""

    def __len__(self) -> int: ...

    def __getitem__(self, t: int, /) -> Any: ...


def region_votes_in_blocks(
    gaussians: Gaussians,
    cameras: Camera,
    labels: Images,
    num_regions: int,
    *,
    folder: str | os.PathLike,
    top: int = 8,
    by_view: bool = False,
    centre: float = 0.0,
    near: float = NEAR,
    regions: Regions | None = None,
    rows: int = ROWS,
    most_held: int = MOST_HELD,
    progress: Callable[[int, int], None] | None = None,
) -> Votes:
    """`region_votes` for N Gaussians in memory-mapped columns (float32; `load_field(path, mapped=True).gaussians`).

    labels: T label images (H, W; -1 = none), read one at a time: a memory map (T, H, W), or what gives one by its index
    and has a length. The votes come back as memory maps of files in `folder`, which must be empty or new; they stay as
    long as the files do. The strongest `top` regions are those of the sums over all views; the rest is counted
    (`Votes.cut`). `by_view` is as in `region_votes`, and `with_shown` reads it in blocks; in its place `regions` (of
    the same labels) gives `Votes.shown` at once.

    Equal to `region_votes` up to float32's rounding, which here and there takes a pixel's last weight, of at most
    0.01, to the other side of the transmittance at which it stops. Memory: `most_held` visible splats of a view, 150
    bytes each at the peak, a band, and one block of `rows` Gaussians with its votes. Disk, until it returns: 12 bytes a
    (tile, Gaussian, region) with weight and 16 a Gaussian, for each view; `by_view` keeps 4 for every view and
    Gaussian. One device, host code. Raises ValueError on shapes that disagree, InputError where `folder` cannot be
    written or is not empty.
    """
    count, views = gaussians.count, len(cameras.world_to_camera)
    poses, remedy = cameras.world_to_camera, "Add a leading axis to all arrays of a single camera."
    require_shape("cameras.world_to_camera", poses, ("T", 4, 4), remedy)
    told = "Give one label image per view."
    require(len(labels) == views, "labels", f"{len(labels)} images", f"{views}, one per view", told)
    require(num_regions >= 0, "num_regions", num_regions, ">= 0", "Count the regions.")
    shows = None if regions is None else np.asarray(views_that_show(regions))
    if shows is not None:
        require_shape("regions.pixels", shows, (num_regions, views), "Give the regions made from these labels.")
    cameras = jax.tree.map(np.asarray, cameras)
    if by_view:
        rows = min(rows, max(_MOST_SEEN // max(views, 1), 1))
    bounds, size = block_bounds(gaussians, rows), band_size(count, cameras.width, cameras.height)
    with _spool(Path(folder)) as spool:
        overflow = 0
        for t in range(views):
            image = np.asarray(labels[t])
            require_shape(f"labels[{t}]", image, (cameras.height, cameras.width), "Give images of the camera's size.")
            require_labels(image, num_regions)
            image = np.asarray(image, np.int32)
            for band, missing, seen, votes in _cast_view(
                gaussians, bounds, cameras[t], image, centre, near, size, most_held
            ):
                overflow += missing
                append(spool, "seen", rows, band.ids[seen[0]], np.full(len(seen[0]), t, np.int32), *seen[1:])
                append(spool, "votes", rows, band.ids[votes[0]], *votes[1:])
            if progress is not None:
                progress(t + 1, views)
        sizes = count, num_regions, rows, min(top, max(num_regions, 1))
        columns = summed_columns(spool, Path(folder), *sizes, shows, views if by_view else 0)
    return Votes(**columns, overflow=np.asarray(overflow, np.int32), num_regions=num_regions)


def codes_in_blocks(
    votes: Votes,
    region_codes: Float[Array, "r d"],
    path: str | os.PathLike,
    reduce: str = "mode",
    *,
    min_labelled: float = MIN_LABELLED,
) -> Float[np.ndarray, "n d"]:
    """`distill_votes` of mapped votes, block by block: the codes (N, d) as a memory map of the .npy `path`."""
    shape = (votes.regions.shape[0], region_codes.shape[1])
    blocks = (distill_votes(own, region_codes, reduce, min_labelled=min_labelled) for own in vote_blocks(votes))
    with atomic_write(path) as temporary:
        write_npy(temporary, shape, np.float32, map(np.asarray, blocks))
    return map_npy(Path(path))


@contextlib.contextmanager
def _spool(folder: Path) -> Iterator[Path]:
    """A folder inside `folder` that is gone afterwards."""
    remedy, spool = "Name a new folder on a disk with room for the votes.", None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise InputError(folder, "a folder that is not empty", "an empty or a new one", remedy)
        spool = Path(tempfile.mkdtemp(prefix=".spool-", dir=folder))
        yield spool
    except OSError as error:
        found = f"{error.strerror or error} on writing votes to it"
        raise InputError(folder, found, "a folder that can be written, and has room", remedy) from error
    finally:
        if spool is not None:
            shutil.rmtree(spool, ignore_errors=True)


class _View(NamedTuple):
    """What the bands of one view share."""

    tiles: Array
    """(tiles + 1, pixels) labels, -1 = none; the last tile is the empty one."""
    distinct: Array
    """(tiles + 1, pixels + _SLOTS) each tile's distinct labels, ascending and to the left."""
    inside: Array
    """(tiles + 1, pixels) 1 in the image, 0 outside."""


@jax.jit
def _prepared(labels: Array) -> _View:
    tiles = to_tiles(labels + 1, TILE) - 1
    return _View(tiles, distinct_labels(tiles, _SLOTS), to_tiles(jnp.ones(labels.shape, jnp.float32), TILE))


def _cast_view(
    gaussians: Gaussians,
    bounds: Bounds,
    camera: Camera,
    labels: np.ndarray,
    centre: float,
    near: float,
    size: int,
    most_held: int,
) -> Iterator[tuple[Band, int, tuple[np.ndarray, ...], tuple[np.ndarray, ...]]]:
    """Band by band of one view: the band, pairs that overflowed, (Gaussian of the band, weight, largest weight of a
    pixel) of those that have any, and (Gaussian, region, weight), a row for each tile."""
    view = _prepared(labels)
    left = view.inside  # what is outside the image has stopped
    across, down = tile_grid(camera.width, camera.height, TILE)
    names = np.asarray(view.distinct)
    several = (names >= 0).sum(1)
    is_open = lambda: np.asarray(still_open(left)).reshape(down, across)
    for band in bands(gaussians, bounds, camera, is_open, near=near, size=size, most_held=most_held):
        splats, lists = listed(band.splats, camera.width, camera.height, size)
        starts, lengths = np.asarray(lists.starts), np.asarray(lists.lengths)
        used = int((starts + lengths).max(initial=0))
        room = size * next(times for times in (1, 2, 4, 8, 16) if used <= times * size)
        owner, tile = np.asarray(lists.gaussians)[:used], np.zeros(used, np.int32)
        places = np.arange(lengths.sum()) + np.repeat(starts - (np.cumsum(lengths) - lengths), lengths)
        tile[places] = np.repeat(np.arange(len(lengths), dtype=np.int32), lengths)
        before, votes, seen = left, [], ()
        for first in range(0, max(int(several.max()), 1), _SLOTS):
            wanted = several > first if first else np.ones(len(several), bool)
            cast, left_now = _cast_band(splats, lists, view, before, wanted, first, room, camera.width, centre)
            cast = np.asarray(cast)[:used]
            if first == 0:
                left = left_now
                alive = np.flatnonzero(cast[:, _SLOTS] > 0)
                total, peak = np.bincount(owner[alive], cast[alive, _SLOTS]), np.zeros(size, np.float32)
                np.maximum.at(peak, owner[alive], cast[alive, _SLOTS + 1])
                visible = np.flatnonzero(total > 0)
                seen = visible, total[visible].astype(np.float32), peak[visible]
            pair, slot = np.nonzero(cast[:, :_SLOTS])
            votes.append((owner[pair], names[tile[pair], first + slot], cast[pair, slot]))
        yield band, int(lists.overflow.sum()), seen, tuple(np.concatenate(column) for column in zip(*votes))


@functools.partial(jax.jit, static_argnums=(6, 7, 8))
def _cast_band(
    splats: Array,
    lists: TileLists,
    view: _View,
    left: Array,
    wanted: Array,
    first: Array | int,
    room: int,
    width: int,
    centre: float,
) -> tuple[Array, Array]:
    """(room, _SLOTS + 2) of each pair of the tiles' lists the weight on the tile's labels `first`, `first` + 1, ..., on
    all its pixels, and the largest of a pixel; and (tiles + 1, pixels) the transmittance behind the band.

    Tiles that are not `wanted` (tiles + 1,), or have stopped, are passed over.
    """
    runs = wanted[:-1] & still_open(left)
    lists = dataclasses.replace(lists, lengths=jnp.where(runs, lists.lengths, 0))
    batches, table = make_batches(lists, width), make_table(splats)
    slots = lax.dynamic_slice_in_dim(view.distinct, first, _SLOTS, axis=1)

    def one_batch(carry, ids_of_tiles):
        cast, left = carry
        names, covered = slots[ids_of_tiles], view.inside[ids_of_tiles]
        is_slot = (view.tiles[ids_of_tiles][:, :, None] == names[:, None, :]) & (names >= 0)[:, None, :]
        columns = jnp.concatenate([is_slot.astype(splats.dtype), jnp.ones_like(covered)[..., None]], axis=2)
        corners = batches.corners(ids_of_tiles, splats.dtype)

        def body(transmittance, inner, chunk):
            cast, _ = inner
            weight, transmittance = materialize(chunk.always, blend_weights, transmittance, chunk.alpha)
            weight = weight * covered[:, None]
            if centre:
                weight = weight * (1 - centre + centre * at_centre(chunk.attributes, corners, lists.tile))
            own = jnp.einsum("bcp,bps->bcs", weight, columns, precision=FULL_PRECISION)
            own = jnp.concatenate([own, weight.max(-1)[..., None]], axis=2)
            return transmittance, (cast.at[chunk.places].set(own, mode="drop"), transmittance)

        start = left[ids_of_tiles]
        (cast, behind), _ = walk(table, lists, batches, ids_of_tiles, body, (cast, start), start)
        return (cast, left.at[ids_of_tiles].set(behind)), None

    empty = jnp.zeros((room, _SLOTS + 2), splats.dtype)
    return lax.scan(one_batch, (empty, left), batches.tiles)[0]
