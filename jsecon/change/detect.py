"""What changed of the objects of a scene since it was made: its renderings against new photographs with cameras.

An object whose pixels the scene does not explain in any frame that sees it is displaced. The scene without the
displaced objects is compared again: what it leaves unexplained, coherent over the frames, is where something new
stands. Each displaced object is placed there, turned and shifted until its rendering explains most; if it explains
enough, it moved. Else it is gone where the scene without it explains the photographs, and what is left is new. An
object that too few pixels see keeps its state: it is not seen, never gone.

Photographs are compared in the colours of the scene: `_fit_exposure` brings them there. A pixel may be lighter or
darker by a factor, at a small cost, because light and shadows change what nothing moved. NumPy arrays in and out.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from scipy.spatial.transform import Rotation

from jsecon.errors import InputError, require_shape
from jsecon.numerics import axes_across
from jsecon.splat.points import back_project
from jsecon.splat.render import render, render_rgb
from jsecon.splat.sh import C0
from jsecon.splat.visible import hide, points_in_view
from jsecon.types import Camera, Gaussians

KINDS = ("same", "moved", "gone", "new", "look", "unsure", "not seen")
"""What became of an object; "look": it stands where it was and looks another way; "unsure": too little shows it."""
MIN_EXPLAINED = 0.3
"""Share of a photograph's pixels that the scene must explain, or it shows another place."""
MIN_PIXELS = 14.0
"""Pixels of an object in a frame, at the size of `object_changes`, from which the frame sees it."""
DISPLACED_SHARE = 0.5
"""Share of an object's pixels that the scene does not explain from which the object is not where it was."""
GONE_MARGIN = 0.25
"""By how much the scene without an object must explain its pixels better, in mean cost, for it to be gone."""
MIN_GAIN = 0.25
"""Cost that a moved object must take away at its new place, per pixel of its silhouette."""
TURN_SHARE = 0.1
"""Share of an object's pixels in two frames or more that the scene does not explain from which it may be turned."""
MIN_TURN_GAIN = 0.03
"""Cost that a turn must take away, per pixel of the object, beyond what the unturned object does."""
LIGHT_FACTOR = 3.0
"""By how much more than what turns explain of most things a turn must explain: other light shades them all anew."""
MIN_RADIUS = 2.0
"""Radius of the largest disc in the pixels of a new thing: edges that lie a pixel off are narrower."""
MIN_MOVE = 0.2
"""Shift, as a share of its size, or turn, radians, from which an object has moved."""
MIN_PROBABILITY = 0.5
"""Probability of what became of an object below which it is "unsure": neither reported nor applied as a change."""
_COLOUR_STEP = 22.0
"""CIELAB distance from which a pixel is not explained at all; half of it decides."""
_LIGHT_STEP = 40.0
"""CIELAB distance that a factor of e in lightness is worth."""
_DEPTH_STEP = 0.03
"""Difference of depth from which a pixel is not explained, as a share of the depth; a third of it is noise."""
_KNOWN = 0.8
"""Alpha from which a rendering tells what a pixel shows."""
_SUBPIXEL = 16
"""Parts of a pixel in which discs are placed; a power of two."""
_FIT_FRAMES = 4
"""Frames, the best ones, that poses of moved objects are fitted to."""


@dataclasses.dataclass(frozen=True)
class Change:
    """What became of an object, or a new one."""

    kind: str
    """One of KINDS."""
    object: int
    """Label of the object; -1 of a new one."""
    probability: float
    """That the kind is right."""
    frames: tuple[int, ...]
    """Frames that prove it, best first."""
    motion: np.ndarray
    """(4, 4) rigid motion of the object's Gaussians, world units; identity unless it moved."""
    place: np.ndarray
    """(3,) middle of the object now, or where it was last, world."""
    before: np.ndarray
    """(F, H, W) bool pixels where the object would be seen had nothing changed."""
    after: np.ndarray
    """(F, H, W) bool pixels where it is seen now."""
    suspected: str = ""
    """The likeliest kind where `kind` is "unsure"."""

    @property
    def start(self) -> np.ndarray:
        """(3,) `place` before the motion."""
        return np.linalg.solve(self.motion, np.append(self.place, 1.0))[:3]


class _View(NamedTuple):
    """A frame with what the scene shows in it."""

    camera: Camera
    photo: np.ndarray
    """(H, W, 3) in the colours of the scene."""
    depth: np.ndarray | None
    rgb: np.ndarray
    """(H, W, 3) of the rendering, alpha (H, W) and z-depth (H, W)."""
    alpha: np.ndarray
    z: np.ndarray
    cost: np.ndarray
    """(H, W) how little the rendering explains the photograph, 0 to 1; NaN where that is not known."""

    def compare(self, rgb: np.ndarray, alpha: np.ndarray, z: np.ndarray, window=np.s_[:, :]) -> np.ndarray:
        """The cost of a rendering inside a window."""
        cost = _colour_cost(self.photo[window], rgb)
        if self.depth is not None:
            apart = depth_cost(self.depth[window], z)
            cost = np.where(np.isnan(apart), cost, np.maximum(0.6 * cost, np.abs(apart)))
        return np.where(alpha >= _KNOWN, cost, np.nan)

    def render(self, gaussians: Gaussians) -> "_View":
        """The same frame with what other Gaussians show."""
        image = _render(gaussians, self.camera)
        return self._replace(rgb=image[0], alpha=image[1], z=image[2], cost=self.compare(*image))

    def place(self, body: "_Body", motion: np.ndarray) -> tuple["_View", np.ndarray]:
        """The same frame with an object added to what it shows, after a motion, and its visible silhouette."""
        silhouette, drawn = np.zeros_like(self.alpha, bool), body.draw(self.camera, motion)
        if drawn is None:
            return self, silhouette
        window, rgb, z = drawn
        inside = (z > 0) & ((z < self.z[window] * 1.02) | (self.alpha[window] < 0.5))
        silhouette[window] = inside
        shown = [column.copy() for column in (self.rgb, self.alpha, self.z)]
        for column, values in zip(shown, (rgb, np.ones_like(z), z)):
            column[window][inside] = values[inside]
        cost = self.cost.copy()
        cost[window] = self.compare(*(column[window] for column in shown), window=window)
        return self._replace(rgb=shown[0], alpha=shown[1], z=shown[2], cost=cost), silhouette


class _Body:
    """An object: where it stands, and its Gaussians as opaque discs, which are drawn thousands of times."""

    def __init__(self, gaussians: Gaussians, rows: np.ndarray, up: np.ndarray):
        means = np.asarray(gaussians.means, np.float64)
        points = means[rows]
        self.middle = np.median(points, axis=0)
        self.foot = self.middle + (np.quantile(points @ up, 0.03) - self.middle @ up) * up
        self.extent = float(np.linalg.norm(np.quantile(points, 0.95, 0) - np.quantile(points, 0.05, 0))) / np.sqrt(2)
        step = -(-len(rows) // 3000) or 1  # of a large object every second or third Gaussian is a larger disc
        rows = rows[::step]
        self.means, sizes = means[rows], np.asarray(gaussians.log_scales, np.float64)[rows]
        self.radii = 1.1 * np.sqrt(step) * np.exp(np.sort(sizes, axis=1)[:, 1])
        self.colours = np.clip(0.5 + C0 * np.asarray(gaussians.sh)[rows, 0], 0, 1).astype(np.float32)

    def draw(self, camera: Camera, motion: np.ndarray) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray] | None:
        """Draws it after a motion: a window of the image, with colours and z-depth there, 0 where there is none."""
        pose = np.asarray(camera.world_to_camera, np.float64) @ motion
        x, y, z = (self.means @ pose[:3, :3].T + pose[:3, 3]).T
        order = np.argsort(-z)  # the nearest is drawn last
        order = order[z[order] > 1e-6]
        x, y, z = x[order], y[order], z[order]
        u, v = float(camera.fx) * x / z + float(camera.cx) - 0.5, float(camera.fy) * y / z + float(camera.cy) - 0.5
        centres = np.rint(_SUBPIXEL * np.clip(np.stack([u, v], 1), -1e4, 1e4)).astype(int).tolist()
        radii = np.clip(self.radii[order] * float(camera.fx) / z, 0.75, 24) - 0.25  # OpenCV also fills its rim
        radii = np.rint(_SUBPIXEL * radii).astype(int).tolist()
        image = np.full((camera.height, camera.width), -1, np.float32)
        for n, (centre, radius) in enumerate(zip(centres, radii)):
            cv2.circle(image, centre, radius, n, cv2.FILLED, shift=_SUBPIXEL.bit_length() - 1)
        left, top, width, height = cv2.boundingRect((image >= 0).astype(np.uint8))
        if not width:
            return None
        window = slice(max(top - 2, 0), top + height + 2), slice(max(left - 2, 0), left + width + 2)
        disc = image[window].astype(int)
        inside = disc >= 0
        rgb, depth = self.colours[order[disc]] * inside[..., None], (z[disc] * inside).astype(np.float32)
        return window, rgb, depth


def _fit_exposure(
    photo: Float32[np.ndarray, "h w 3"], render: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Brings a photograph to the colours of a rendering by a gain and an offset of each channel.

    The fit weighs pixels by how well they agree (Cauchy), so that what changed does not count.
    """
    known = known & (photo > 0.01).all(-1) & (photo < 0.99).all(-1)
    if known.sum() < 64:
        return photo
    source, target = photo[known].astype(np.float64), render[known].astype(np.float64)
    gain, offset = np.median(target, 0) / np.maximum(np.median(source, 0), 1e-3), np.zeros(3)
    for _ in range(12):
        error = source * gain + offset - target
        weight = 1 / (1 + (error**2).sum(1) / 0.04**2)
        mean, middle = (np.average(values, axis=0, weights=weight) for values in (source, target))
        spread = np.average((source - mean) ** 2, axis=0, weights=weight)
        both = np.average((source - mean) * (target - middle), axis=0, weights=weight)
        gain = np.clip((both + 1e-4 * gain) / (spread + 1e-4), 0.2, 5.0)
        offset = middle - gain * mean
    return np.clip(photo * gain + offset, 0, 1.5).astype(np.float32)


def _find_shift(
    photo: Float32[np.ndarray, "h w 3"], render: Float32[np.ndarray, "h w 3"], known: Bool[np.ndarray, "h w"]
) -> tuple[int, int]:
    """Finds by how many rows and columns a photograph lies off the rendering of its pose, from edges of lightness."""

    def edges(image):
        grey = cv2.GaussianBlur(image.mean(-1), (0, 0), 1.0)
        return np.minimum(np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)), 0.5)

    reach = max(round(0.025 * photo.shape[1]), 1)  # px; errors of poses are smaller
    around = cv2.copyMakeBorder(edges(photo), reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    errors = cv2.matchTemplate(around, edges(render), cv2.TM_SQDIFF, mask=known.astype(np.float32))
    row, column = np.unravel_index(errors.argmin(), errors.shape)
    return reach - int(row), reach - int(column)


def _shifted(image: np.ndarray, shift: tuple[int, int]) -> np.ndarray:
    """Moves an image by (rows, columns), px; its edge is repeated."""
    (down, across), size = shift, image.shape[1::-1]
    motion = np.array([[1.0, 0, across], [0, 1, down]])
    return cv2.warpAffine(image, motion, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def _shifts(image: np.ndarray) -> list[np.ndarray]:
    """An image moved by up to one px each way."""
    return [_shifted(image, (y, x)) for y in (1, 0, -1) for x in (1, 0, -1)]


def _colour_cost(
    photo: Float32[np.ndarray, "h w 3"], render: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "h w"]:
    """How little a rendering explains the colours of a photograph, 0 to 1: least over shifts of up to one px."""
    best = np.full(photo.shape[:2], np.inf, np.float32)
    lab = cv2.cvtColor(np.clip(photo, 0, 1), cv2.COLOR_RGB2LAB)
    for moved in _shifts(render):
        gain = (np.einsum("hwc,hwc->hw", photo, moved) + 1e-3) / (np.einsum("hwc,hwc->hw", moved, moved) + 1e-3)
        gain = np.clip(gain, 0.4, 2.5).astype(np.float32)
        apart = lab - cv2.cvtColor(np.clip(moved * gain[..., None], 0, 1), cv2.COLOR_RGB2LAB)
        best = np.minimum(best, np.einsum("hwc,hwc->hw", apart, apart) + (_LIGHT_STEP * np.log(gain)) ** 2)
    return np.minimum(np.sqrt(best) / _COLOUR_STEP, 1.0)


def depth_cost(depth: Float[np.ndarray, "h w"], rendered: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """How little rendered depth explains a measured one, -1 to 1: negative where the measured surface is nearer.

    It is that of least size over shifts of up to one px; NaN where either is unknown (0).
    """
    known, best = (depth > 0) & (rendered > 0), np.full(depth.shape, np.inf)
    for moved in _shifts(rendered):
        difference = np.where(moved > 0, (depth - moved) / (_DEPTH_STEP * np.maximum(moved, 1e-9)), np.inf)
        best = np.where(np.abs(difference) < np.abs(best), difference, best)
    return np.where(known, np.sign(best) * np.clip(1.5 * np.abs(best) - 0.5, 0, 1), np.nan)


def _render(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Renders colour (clamped), alpha and z-depth."""
    image = render_rgb(gaussians, camera, depth=True)
    return np.clip(np.asarray(image.features), 0, 1), np.asarray(image.alpha), np.asarray(image.depth)


def _first_view(gaussians: Gaussians, camera: Camera, frame: np.ndarray, depth: np.ndarray | None) -> _View:
    """Renders a frame, and aligns the photograph and its exposure to that."""
    image = _render(gaussians, camera)
    photo, known = frame.astype(np.float32) / 255, image[1] >= _KNOWN
    shift = _find_shift(photo, image[0], known)
    photo = _fit_exposure(_shifted(photo, shift), image[0], known)
    if depth is not None:
        depth = _shifted(np.asarray(depth, np.float32), shift)
        depth = np.where(depth > 0, cv2.medianBlur(depth, 3), 0)  # a third of the noise
    view = _View(camera, photo, depth, *image, image[1])
    return view._replace(cost=view.compare(*image))


def _owners(gaussians: Gaussians, labels: np.ndarray, camera: Camera) -> np.ndarray:
    """Finds the object that makes up more than half of each pixel (H, W); -1 without one."""
    owners = np.full((camera.height, camera.width), -1)
    for first in range(0, int(labels.max(initial=-1)) + 1, 32):  # scenes share the program
        things = (labels[:, None] == first + np.arange(32)).astype(np.float32)
        shares = np.asarray(render(gaussians, camera, things).features)
        owners = np.where(shares.max(-1) > 0.5, first + shares.argmax(-1), owners)
    return owners


def _ranked(scores: np.ndarray, kept: np.ndarray) -> tuple[int, ...]:
    """Lists the frames that are kept, those of the highest scores first."""
    return tuple(t for t in np.argsort(-scores, kind="stable").tolist() if kept[t])


def object_changes(
    gaussians: Gaussians,
    labels: Int[np.ndarray, " n"],
    frames: UInt8[np.ndarray, "f h w 3"],
    cameras: Camera,
    depths: Float[np.ndarray, "f h w"] | None = None,
    *,
    up: Float[np.ndarray, " 3"],
) -> list[Change]:
    """Finds what became of each object of a scene, and what is new, in new photographs.

    Args:
      gaussians: Scene of N Gaussians.
      labels: Object of each Gaussian; -1 for surroundings, which do not change.
      frames: New photographs.
      cameras: Batch of F cameras in the scene's world.
      depths: z-depth of the photographs, world units, 0 = unknown.
      up: Up axis of the scene's world, unit length.

    Returns:
      A change for each object, in order, then the new ones.
    """
    require_shape("labels", labels, (gaussians.count,), "Give one label per Gaussian.")
    gaussians, cameras = jax.tree.map(np.asarray, (gaussians, cameras))
    depth_maps = [None] * len(frames) if depths is None else depths
    views = [_first_view(gaussians, camera, frame, depth) for camera, frame, depth in zip(cameras, frames, depth_maps)]
    for t, view in enumerate(views):
        explained = float((view.cost < 0.5).mean())
        if explained < MIN_EXPLAINED:
            problem = f"the scene explains {explained:.0%} of its pixels"
            remedy = "Check that it shows the field's place, and that its pose is in the world of the field's capture."
            raise InputError(f"photograph {t + 1}", problem, f"{MIN_EXPLAINED:.0%} or more", remedy)
    search = _Search(gaussians, labels, views, cameras, up / np.linalg.norm(up))
    known, differing = search.count_pixels()
    seen = known >= MIN_PIXELS
    share = differing / np.maximum(known, 1)
    excess = np.where(seen, share - DISPLACED_SHARE, 0).sum(1) / np.maximum(seen.sum(1), 1)
    displaced = np.flatnonzero(seen.any(1) & (excess > 0)).tolist()
    objects = np.unique(labels[labels >= 0]).tolist()
    changes = {k: search.unmoved(k, seen[k], excess[k], share[k]) for k in objects}
    turned = (seen.sum(1) > 1) & (differing.sum(1) >= TURN_SHARE * known.sum(1)) & ~(seen.any(1) & (excess > 0))
    turns = search.turns({k: changes[k].frames for k in np.flatnonzero(turned).tolist()})
    search.remove(displaced, list(turns))
    moved = {k: search.place_object(k, *turn) for k, turn in turns.items()} | search.moved()
    changes |= moved
    clusters = search.clusters()
    for k in displaced:
        if k not in moved:
            changes[k] = search.gone(k, seen[k])
        clusters = [cluster for cluster in clusters if cluster.inside(search.owners == k) <= 0.6]
    found = [*changes.values(), *(search.new(cluster) for cluster in clusters)]
    for n, change in enumerate(found):
        if change.probability < MIN_PROBABILITY:
            found[n] = dataclasses.replace(change, kind="unsure", suspected=change.kind)
    return found


class _Cluster(NamedTuple):
    """Unexplained pixels of several frames that one thing at one place would show."""

    place: np.ndarray
    """(3,) its lower end on what it stands on, world."""
    size: float
    """World units."""
    masks: dict[int, np.ndarray]
    """Frame -> (H, W) bool."""
    radius: float
    """Radius of the largest disc in a mask, px."""

    def inside(self, silhouettes: np.ndarray) -> float:
        """The share of its pixels in silhouettes (F, H, W), two pixels wider: what a thing there left bare."""
        wider = {t: cv2.dilate(silhouettes[t].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for t in self.masks}
        return float(np.mean(np.concatenate([wider[t][mask] for t, mask in self.masks.items()])))


def _gain(views: Sequence[_View], body: _Body, motion: np.ndarray) -> tuple[float, int]:
    """The cost that an object takes away in some views after a motion, and the pixels of its silhouette."""
    placed = [view.place(body, motion) for view in views]
    gain = sum(float(np.nansum(view.cost - new.cost)) for view, (new, _) in zip(views, placed))
    return gain, sum(int(inside.sum()) for _, inside in placed)


def _sigmoid(evidence: float) -> float:
    return float(1 / (1 + np.exp(-evidence)))


class _Search:
    """The search for what is turned, displaced and new; its views show what was found."""

    def __init__(self, gaussians, labels, views, cameras, up):
        self.gaussians, self.labels, self.first, self.cameras, self.up = gaussians, labels, views, cameras, up
        self.flat = axes_across(up)
        self.body = functools.cache(lambda k: _Body(gaussians, np.flatnonzero(labels == k), up))
        self.owners = np.stack([_owners(gaussians, labels, view.camera) for view in views])

    def count_pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Counts each object's pixels in each frame (K, F): those that are known, and those that are not explained.

        A measured surface in front of the scene tells nothing of what it hides.
        """
        count, columns = int(self.labels.max(initial=-1)) + 1, []
        for view, owners in zip(self.first, self.owners):
            known = (owners >= 0) & ~np.isnan(view.cost)
            if view.depth is not None:
                known &= ~(depth_cost(view.depth, view.z) < -0.5)
            columns.append([np.bincount(owners[mask], minlength=count) for mask in (known, known & (view.cost > 0.5))])
        known, differing = np.array(columns).transpose(1, 2, 0)
        return known, differing

    def remove(self, displaced: list[int], turned: list[int]) -> None:
        """Renders the scene without some objects."""
        self.displaced, mask = displaced, np.isin(self.labels, [*displaced, *turned])
        self.views = [view.render(hide(self.gaussians, mask)) if mask.any() else view for view in self.first]

    def change(
        self,
        kind: str,
        k: int,
        probability: float,
        frames: tuple[int, ...],
        motion: np.ndarray | None = None,
        after: np.ndarray | None = None,
    ) -> Change:
        """Describes what became of an object; by default it stands where it stood."""
        motion, before, middle = np.eye(4) if motion is None else motion, self.owners == k, self.body(k).middle
        place = motion[:3, :3] @ middle + motion[:3, 3]
        return Change(kind, k, probability, frames, motion, place, before, before if after is None else after)

    def unmoved(self, k: int, seen: np.ndarray, excess: float, share: np.ndarray) -> Change:
        """The change of an object that is where it was, or that no frame sees."""
        kind, probability = ("same", _sigmoid(-12 * excess)) if seen.any() else ("not seen", 1.0)
        return self.change(kind, k, probability, _ranked(-share, seen))

    def clusters(self) -> list[_Cluster]:
        """Places the unexplained pixels of the frames, and joins those that lie at one place; of two frames or more."""
        parts = [cluster for t in range(len(self.views)) for cluster in self._components(t)]
        groups: list[_Cluster] = []
        for part in sorted(parts, key=lambda c: -sum(int(mask.sum()) for mask in c.masks.values())):
            for n, group in enumerate(groups):
                near = np.linalg.norm(group.place - part.place) < 0.75 * max(part.size, group.size)
                if near and not group.masks.keys() & part.masks.keys():
                    place = (len(group.masks) * group.place + part.place) / (len(group.masks) + 1)
                    # The size stays that of the first frame, which has most pixels.
                    groups[n] = _Cluster(place, group.size, group.masks | part.masks, max(group.radius, part.radius))
                    break
            else:
                groups.append(part)
        return [group for group in groups if len(group.masks) >= min(2, len(self.views))]

    def _components(self, t: int) -> list[_Cluster]:
        """The connected unexplained pixels of a frame, each with the place where it stands."""
        view = self.views[t]
        mask = (np.nan_to_num(view.cost) > 0.5).astype(np.uint8)
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        number, image, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
        down = -(np.asarray(view.camera.world_to_camera, np.float64)[:3, :3] @ self.up)[:2]
        height, width = mask.shape
        bare = np.zeros(mask.shape, bool) if view.depth is None else depth_cost(view.depth, view.z) > 0.3
        result = []
        for n in range(1, number):
            left, top, across, tall, area = stats[n]
            inside = image == n
            radius = float(cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5).max())
            cut = left == 0 or top == 0 or left + across == width or top + tall == height
            if cut or area < MIN_PIXELS or radius < MIN_RADIUS or bare[inside].mean() > 0.5:  # what went left it bare
                continue
            measured = np.zeros_like(inside) if view.depth is None else inside & (view.depth > 0)
            if view.depth is not None and measured.any():
                z = float(np.quantile(view.depth[measured], 0.5, method="nearest"))
                measured &= np.abs(view.depth - z) <= z * np.sqrt(area) / float(view.camera.fx)  # not what is behind it
                surface = back_project(view.camera, np.argwhere(measured), view.depth[measured])
                contact = np.median(surface, axis=0)
                contact += (np.quantile(surface @ self.up, 0.05) - contact @ self.up) * self.up
            else:
                rows, columns = np.nonzero(inside)
                along = down[0] * columns + down[1] * rows
                low = along >= np.quantile(along, 0.95)
                z = float(np.median(view.z[rows[low], columns[low]]))
                contact = back_project(view.camera, np.array([[rows[low].mean(), columns[low].mean()]]), z)[0]
            size = z * np.sqrt(area) / float(view.camera.fx)
            ahead = contact - np.asarray(view.camera.centres, np.float64)
            ahead -= (ahead @ self.up) * self.up
            place = contact + 0.4 * size * ahead / max(np.linalg.norm(ahead), 1e-9)
            result.append(_Cluster(place, size, {t: inside}, radius))
        return result

    def moved(self) -> dict[int, Change]:
        """Finds the displaced objects elsewhere, the one that explains most first."""
        result: dict[int, Change] = {}
        while left := [k for k in self.displaced if k not in result]:
            places = [(cluster.place, cluster.size) for cluster in self.clusters()[:6]]  # the largest
            bodies = map(self.body, self.displaced)  # their own, too: what moved may hide it, or it is turned
            places += [(body.foot, body.extent) for body in bodies]
            fits = [fit for k in left for place in places if (fit := self._fit(k, *place)) and fit.gain >= MIN_GAIN]
            if not fits:
                break
            best = max(fits, key=lambda fit: fit.total)
            result[best.object] = self.place_object(best.object, best.motion, 14 * (best.gain - MIN_GAIN) + 0.5)
        return result

    def place_object(self, k: int, motion: np.ndarray, evidence: float) -> Change:
        """Puts an object into the views where it is now; `evidence` is the logit of its probability."""
        self.views, masks = map(list, zip(*(view.place(self.body(k), motion) for view in self.views)))
        after, pixels = np.stack(masks), np.sum(masks, axis=(1, 2))
        frames = _ranked(pixels, pixels >= MIN_PIXELS)
        change = self.change("moved", k, _sigmoid(evidence), frames, motion, after)
        shift, turn = change.place - change.start, Rotation.from_matrix(motion[:3, :3]).magnitude()
        if np.linalg.norm(shift) < MIN_MOVE * self.body(k).extent and turn < MIN_MOVE:
            return self.change("same", k, _sigmoid(evidence), frames)
        return change

    def _motion(self, k: int, pose: np.ndarray) -> np.ndarray:
        """The motion that turns an object about its middle by pose[2], and shifts it by pose[:2] and up by pose[3]."""
        middle, motion = self.body(k).middle, np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(self.up * pose[2]).as_matrix()
        motion[:3, 3] = middle - motion[:3, :3] @ middle + pose[:2] @ self.flat + pose[3] * self.up
        return motion

    def turns(self, suspects: dict[int, tuple[int, ...]]) -> dict[int, tuple[np.ndarray, float]]:
        """Finds which of some objects, with the frames that see them, are turned in their place.

        Returns:
          The motion of each that is, and the logit of its probability.
        """
        best = {}
        for k, frames in suspects.items():
            views = [self.first[t].render(hide(self.gaussians, self.labels == k)) for t in frames[:_FIT_FRAMES]]
            motions = [self._motion(k, np.array([0, 0, angle, 0])) for angle in np.radians(np.arange(0, 341, 20))]
            gains, pixels = zip(*(_gain(views, self.body(k), motion) for motion in motions))
            best[k] = motions[int(np.argmax(gains))], (max(gains) - gains[0]) / max(pixels[0], 1)
        usual = sorted([0.0, 0.0, 0.0, *(gain for _, gain in best.values())])[-3]  # two may be turned
        least = MIN_TURN_GAIN + LIGHT_FACTOR * usual
        return {k: (motion, 40 * (gain - least)) for k, (motion, gain) in best.items() if gain >= least}

    def _fit(self, k: int, place: np.ndarray, size: float) -> "_Fit | None":
        """Turns and shifts an object about a place until it explains most of the photographs there."""
        body = self.body(k)
        if not 1 / 3 < size / max(body.extent, 1e-9) < 3:
            return None
        shift, lift = (place - body.middle) @ self.flat.T, float((place - body.foot) @ self.up)
        lift = 0.0 if abs(lift) < 0.35 * body.extent else lift
        views = [self.views[t] for t in self._frames_near(body.middle + shift @ self.flat + lift * self.up)]

        def score(pose: np.ndarray) -> tuple[float, int]:
            return _gain(views, body, self._motion(k, pose))

        best = np.array([*shift, 0.0, lift])
        value = score(best)
        if value[1] < MIN_PIXELS or value[0] < -0.1 * value[1]:
            return None
        axes = np.array([(1, 0, 0, 0), (-1, 0, 0, 0), (0, 1, 0, 0), (0, -1, 0, 0)]) * body.extent
        yaw = np.array([0.0, 0, 1, 0])
        for n, step in enumerate((0.35, 0.18, 0.09, 0.045)):
            turns = np.arange(1, 8) * np.pi / 4 if n == 1 else np.array([-2, 2]) * step if n else np.zeros(0)
            moves = [*(step * axes), *(turns[:, None] * yaw)]
            for _ in range(3):
                options = [(*score(best + move), best + move) for move in moves]
                top = max(options, key=lambda option: option[0])
                if top[0] <= value[0]:
                    break
                value, best = top[:2], top[2]
        return _Fit(k, self._motion(k, best), value[0], value[0] / max(value[1], 1))

    def _frames_near(self, place: np.ndarray) -> tuple[int, ...]:
        """The frames that see a place, at most _FIT_FRAMES, the nearest first."""
        poses = self.cameras.world_to_camera
        depths = poses[:, 2, :3] @ place + poses[:, 2, 3]
        return _ranked(-depths, points_in_view(self.cameras, place[None])[:, 0])[:_FIT_FRAMES]

    def gone(self, k: int, seen: np.ndarray) -> Change:
        """The change of an object that is not where it was, nor elsewhere.

        It is gone where the scene without it explains the photographs. Where something of its outline stands in its
        place, it has another look. Else something hides it.
        """
        before = self.owners == k
        gains = [(first.cost - view.cost)[mask] for first, view, mask in zip(self.first, self.views, before)]
        margins = np.array([np.mean(gain[np.isfinite(gain)]) if np.isfinite(gain).any() else 0.0 for gain in gains])
        margin, frames = float(margins[seen].mean()), _ranked(margins, seen)
        if margin >= GONE_MARGIN:
            gone = _sigmoid(10 * (margin - GONE_MARGIN))
            return self.change("gone", k, gone, frames, after=np.zeros_like(before))
        after = before & np.stack([np.nan_to_num(view.cost) > 0.5 for view in self.views])
        filled = float(after.sum() / max(before[seen].sum(), 1))
        kind, probability = ("look", filled) if filled > 0.5 else ("not seen", 1 - filled)
        return self.change(kind, k, probability, frames, after=after)

    def new(self, cluster: _Cluster) -> Change:
        """Something that no object explains, coherent over the frames."""
        after = np.zeros((len(self.views), *self.views[0].alpha.shape), bool)
        for t, mask in cluster.masks.items():
            after[t] = mask
        visible = max(len(self._frames_near(cluster.place)), len(cluster.masks))
        pixels = after.sum((1, 2))
        place = cluster.place + 0.5 * cluster.size * self.up
        probability = len(cluster.masks) / (visible + 0.5) * (1 - np.exp(1 - cluster.radius / 1.5))
        frames = _ranked(pixels, pixels > 0)
        return Change("new", -1, float(probability), frames, np.eye(4), place, np.zeros_like(after), after)


class _Fit(NamedTuple):
    """An object at another place."""

    object: int
    motion: np.ndarray
    total: float
    """Cost that it takes away, px."""
    gain: float
    """The same per pixel of its silhouette."""
