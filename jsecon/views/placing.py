"""Which views show a scene best, by a greedy cover: of a bare scene, planned or given; and frames for masks. Host code.

A scene is a room or an object. In a room, candidates stand in free places inside and look around; around an object
they stand on orbits. The two kinds are never mixed: from outside a room, the things in it are a few pixels.
"""

import dataclasses
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.spatial import KDTree

from jsecon.errors import InputError
from jsecon.field.evidence import MAX_WHOLE, each_view, view_evidence
from jsecon.fit.resize import scale_cameras
from jsecon.parallel import map_over_processes, map_views
from jsecon.types import Camera, Gaussians, Progress
from jsecon.views.frame import SceneFrame, inner_scene, scene_frame, surface_points

FIELD_OF_VIEW = 60.0
"""degrees, horizontal"""
CANDIDATE_WIDTH, CANDIDATE_HEIGHT = 80, 60
"""px of the small renders"""
PLACES = 24
"""free places in a room"""
YAWS, PITCHES = 8, (-45.0, -20.0, 5.0)
"""directions that are looked at from each place: how many around, and degrees above the horizon"""
ORBIT_YAWS, ORBIT_PITCHES, ORBIT_DISTANCES = 16, (5.0, 25.0, 50.0), (1.0, 0.5)
"""orbits around an object: views around, degrees above the horizon, distances in units of the fitting one"""
FOG_SHARE = 0.4
"""a view is fog if Gaussians with a standard deviation above a tenth of its width have this share of its weight"""
DEFAULT_VIEWS = 24
"""views that are planned"""
_LEAST_ALPHA = 0.03
"""mean alpha of a view from which it shows some of the scene"""
SEEN_PX = 0.3
"""px of rendering weight from which a view shows a Gaussian"""
ENOUGH = 8
"""frames with masks that should show a Gaussian: its object is what most of them agree on"""
LEAST_GAIN = 0.01
"""share of the Gaussians that a further frame must show to one that too few chosen frames show"""


@dataclasses.dataclass(frozen=True)
class _PlannedViews:
    """Virtual views of a bare scene."""

    cameras: Camera
    """Batch of T cameras, in the scene's world."""
    frame: SceneFrame
    """The scene's box and up axis."""
    kind: Literal["room", "object"]
    coverage: float
    """Share of the scene without its surroundings, by opacity, that the views show."""
    foggy: int
    """Number of views that are fog (`FOG_SHARE`)."""

    def __str__(self) -> str:
        """Describes the plan on one line: number of views, kind of scene, coverage and up axis."""
        up = ", ".join(f"{number:.2f}" for number in self.frame.axes[2])
        trust = "" if self.frame.sure else "; not sure, jsecon run --up X Y Z sets it"
        return (
            f"{len(self.cameras)} virtual views of {'a room' if self.kind == 'room' else 'an object'}, "
            f"{self.coverage:.0%} of it seen; up is ({up}), from {self.frame.evidence}{trust}"
        )

    def lack_of_detail(self) -> tuple[str, ...]:
        """Says that most views show hardly any detail, if they do."""
        if 2 * self.foggy <= len(self.cameras):
            return ()
        problem = f"{self.foggy} of {len(self.cameras)} views show hardly any detail, so that texts may match nothing."
        return (f"{problem} Wide Gaussians fill them; --cameras FILE gives views of your own.",)


def place_cameras(
    gaussians: Gaussians,
    *,
    views: int = DEFAULT_VIEWS,
    width: int = 400,
    height: int = 300,
    up: np.ndarray | None = None,
    progress: Progress | None = None,
) -> _PlannedViews:
    """Plans virtual views of a scene from its Gaussians alone, or raises InputError if no view can show it.

    Args:
      gaussians: Scene of N Gaussians.
      views: T, number of views.
      width: Width of the views, px.
      height: Height of the views, px.
      up: (3,) up axis of the world; None finds it (`scene_frame`).
      progress: Called as progress(done, total) while candidates are rendered.
    """
    points = surface_points(gaussians)
    frame = scene_frame(points, up)
    places = _free_places(points, frame)
    inside = _interior_cameras(frame, places)
    orbits = _orbit_cameras(frame)

    def weights(poses: np.ndarray, start: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        def report(done: int, _: int) -> None:
            if progress is not None:
                progress(start + done, len(inside) + len(orbits))

        cameras = _cameras(poses, CANDIDATE_WIDTH, CANDIDATE_HEIGHT)
        return _weights_by_view(gaussians, counted, cameras, frame.diagonal, report)

    counted = _Counted.of(gaussians)
    seen, alpha, fog = weights(inside, 0)
    kind: Literal["room", "object"] = "room" if _is_room(alpha, len(places)) else "object"
    candidates = inside
    if kind == "object":
        candidates = orbits
        seen, alpha, fog = weights(orbits, len(inside))
    usable = np.flatnonzero(alpha >= _LEAST_ALPHA)
    clear = usable[fog[usable] < FOG_SHARE]
    usable = clear if len(clear) >= views else usable  # a scene of few large Gaussians has no clear view
    if not len(usable):
        remedy = "Open it in a viewer to check it, or give cameras of your own with --cameras FILE."
        raise InputError("scene", "no virtual view shows it", "", remedy)
    chosen = usable[_greedy_cover(seen[usable] / SEEN_PX, counted.opacity, views)]
    cameras = _cameras(candidates[chosen], width, height)
    coverage = counted.share_seen(seen[chosen], SEEN_PX)
    return _PlannedViews(cameras, frame, kind, coverage, int((fog[chosen] >= FOG_SHARE).sum()))


class _Cover(NamedTuple):
    """A choice of given cameras, and how well they show a scene."""

    chosen: np.ndarray
    """(K,) which cameras are chosen."""
    usable: float
    """Share of all cameras that show some of the scene and no fog."""
    coverage: float
    """Share of the scene without its surroundings, by opacity, that these show."""


def cover_with(gaussians: Gaussians, cameras: Camera, views: int, progress: Progress | None = None) -> _Cover:
    """Chooses those of given cameras that together show a scene best, and measures how well all of them show it."""
    diagonal = scene_frame(surface_points(gaussians), np.eye(3)[2]).diagonal
    counted = _Counted.of(gaussians)
    small = scale_cameras(cameras, CANDIDATE_WIDTH / max(cameras.width, cameras.height))
    seen, alpha, fog = _weights_by_view(gaussians, counted, small, diagonal, progress)
    usable = np.flatnonzero((alpha >= _LEAST_ALPHA) & (fog < FOG_SHARE))
    shown_px = 0.03 * max(float(seen.sum(0).mean()), 1e-30)  # whatever the number of Gaussians
    chosen = usable[_greedy_cover(seen[usable] / SEEN_PX, counted.opacity, views)]
    coverage = counted.share_seen(seen[usable], shown_px)
    return _Cover(chosen, len(usable) / len(cameras), coverage)


def _greedy_cover(
    shown: Float[np.ndarray, "v n"],
    importance: Shaped[np.ndarray, " n"],
    views: int,
    *,
    enough: float | int = np.inf,
    least_gain: float = 0.0,
) -> Int[np.ndarray, " k"]:
    """Chooses views that show the scene, one after the other, each time the one that adds most.

    What a Gaussian adds grows with the logarithm of its weight in all chosen views, so that a near view of a small
    thing still counts when others have shown it. This value is submodular: the choice is within 1 - 1/e of the best
    one.

    Args:
      shown: How much each candidate shows each Gaussian, in units of `SEEN_PX`.
      importance: Weight of each Gaussian in the gain.
      views: Largest number of views to choose.
      enough: Sum over the chosen views from which a Gaussian adds nothing more.
      least_gain: Share of the importance below which what a view adds to `enough` is too little to choose it.
    """
    importance = importance.astype(np.float32)
    covered = np.zeros(shown.shape[1], np.float32)
    chosen: list[int] = []
    bound = np.full(len(shown), np.inf)
    for _ in range(min(views, len(shown))):
        bound[chosen] = -np.inf
        best, gain = -1, -np.inf
        for index in np.argsort(-bound, kind="stable"):  # lazy: a gain never grows
            if bound[index] <= gain:
                break
            added = np.minimum(shown[index], enough - covered)
            bound[index] = float(importance @ np.log1p(added / (1 + covered)))
            if bound[index] > gain:
                best, gain = int(index), bound[index]
        added = np.minimum(shown[best], enough - covered)
        if importance @ added < least_gain * importance.sum():
            break
        chosen.append(best)
        covered += added
    return np.array(chosen, int)


class _Counted(NamedTuple):
    """The Gaussians by which views are compared."""

    inner: np.ndarray
    """Gaussians of the scene without its surroundings."""
    sample: np.ndarray
    """(M,) at most 100,000 of them, evenly spaced."""
    opacity: np.ndarray
    """(M,) of the sample."""

    @classmethod
    def of(cls, gaussians: Gaussians) -> "_Counted":
        """Counts the inner Gaussians of a scene."""
        inner = np.flatnonzero(inner_scene(gaussians))
        sample = inner[np.unique(np.linspace(0, len(inner) - 1, min(len(inner), 100_000)).astype(int))]
        return cls(inner, sample, 1 / (1 + np.exp(-np.asarray(gaussians.opacity_logits, np.float64)[sample])))

    def share_seen(self, seen: np.ndarray, least_px: float) -> float:
        """Share of the sample, by opacity, that has a weight of `least_px` in views, of the weights (V, M) in each."""
        return float(self.opacity @ np.minimum(seen.sum(0) / least_px, 1) / max(self.opacity.sum(), 1e-30))


def _free_places(points: Float[np.ndarray, "p 3"], frame: SceneFrame) -> Float[np.ndarray, "k 3"]:
    """Finds up to `PLACES` places in the box of a scene, 0.06 diagonals from every surface, far from each other."""
    ticks = np.linspace(-0.9, 0.9, 12)
    heights = np.linspace(-0.2, 0.9, 5)  # from below the middle of a room (0) to below its upper end (1)
    grid = np.stack(np.meshgrid(ticks, ticks, heights, indexing="ij"), axis=-1).reshape(-1, 3)
    world = _in_world(frame, grid)
    distance = KDTree(points).query(world)[0]
    free = np.flatnonzero(distance >= 0.06 * frame.diagonal)
    if not len(free):
        return np.zeros((0, 3))
    chosen = [free[np.argmin(np.abs(grid[free]).sum(1))]]
    nearest = np.full(len(free), np.inf)
    while len(chosen) < min(PLACES, len(free)):
        nearest = np.minimum(nearest, np.linalg.norm(world[free] - world[chosen[-1]], axis=1))
        chosen.append(free[np.argmax(nearest)])
    return world[chosen]


def _in_world(frame: SceneFrame, local: np.ndarray) -> Float[np.ndarray, "... 3"]:
    """Maps points in the box, -1 to 1 along each axis, into the world."""
    return (local * frame.half) @ frame.axes + frame.centre


def _is_room(alpha: np.ndarray, places: int) -> bool:
    """Whether half of the places are enclosed: three quarters of their downward views have a mean alpha of 0.8."""
    if not places:
        return False
    down = [index for index, pitch in enumerate(PITCHES) if pitch < 0]
    closed = alpha.reshape(places, YAWS, len(PITCHES))[:, :, down].min(2) >= 0.8
    return bool((closed.mean(1) >= 0.75).mean() >= 0.5)


def _interior_cameras(frame: SceneFrame, places: np.ndarray) -> np.ndarray:
    """(K, 4, 4) poses that look around from each place: places, then yaws, then pitches."""
    poses = []
    for place in places:
        for yaw in np.arange(YAWS) * 2 * np.pi / YAWS:
            poses += [_look(place, _direction(frame, yaw, pitch), frame.axes[2]) for pitch in PITCHES]
    return np.array(poses).reshape(-1, 4, 4)


def _orbit_cameras(frame: SceneFrame) -> np.ndarray:
    """(K, 4, 4) poses on orbits from where the scene's box fills the frame, and from half as far."""
    poses = []
    corners = _in_world(frame, np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3))
    from_below = () if frame.sure else (-25.0, -50.0)  # where the up axis may be wrong
    for pitch in (*ORBIT_PITCHES, *from_below):
        for yaw in np.arange(ORBIT_YAWS) * 2 * np.pi / ORBIT_YAWS:
            forward = -_direction(frame, yaw, pitch)
            distance = _fitting_distance(frame, corners, forward)
            poses += [_look(frame.centre - d * distance * forward, forward, frame.axes[2]) for d in ORBIT_DISTANCES]
    return np.array(poses)


def _fitting_distance(frame: SceneFrame, corners: np.ndarray, forward: np.ndarray) -> float:
    """Distance from the centre at which the corners of the box fill 0.92 of the frame."""
    pose = _look(frame.centre, forward, frame.axes[2])
    x, y, z = pose[:3, :3] @ (corners - frame.centre).T
    tangent = 0.92 * np.tan(np.radians(FIELD_OF_VIEW) / 2)
    ratio = CANDIDATE_HEIGHT / CANDIDATE_WIDTH
    return float(np.max(np.maximum(np.abs(x), np.abs(y) / ratio) / tangent - z))


def _direction(frame: SceneFrame, yaw: float, pitch: float) -> np.ndarray:
    """Unit vector at an angle around the up axis (radians) and above the horizon (degrees)."""
    first, second, up = frame.axes
    level = np.cos(yaw) * first + np.sin(yaw) * second
    return np.cos(np.radians(pitch)) * level + np.sin(np.radians(pitch)) * up


def _look(eye: np.ndarray, forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) world-to-camera pose of a camera at `eye` that looks along `forward`."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ eye
    return pose


def _cameras(poses: np.ndarray, width: int, height: int) -> Camera:
    """Makes the cameras of poses, with the planned field of view."""
    count = len(poses)
    focal = np.full(count, max(width, height) / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2), np.float32)
    middle = np.full(count, width / 2, np.float32), np.full(count, height / 2, np.float32)
    return Camera(poses.astype(np.float32), focal, focal, *middle, width, height)


def _weights_by_view(
    gaussians: Gaussians, counted: _Counted, cameras: Camera, diagonal: float, progress: Progress | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the weight of the sample in each small view (V, M), and the mean alpha and the fog of each (V,).

    The alpha is that of the inner scene: a sky encloses no place.
    """
    pixels, poses = cameras.width * cameras.height, np.asarray(cameras.world_to_camera)
    means = np.asarray(gaussians.means, np.float64)[counted.sample]
    widest = np.exp(np.asarray(gaussians.log_scales, np.float64)[counted.sample].max(1))
    whole, cameras = np.zeros((cameras.height, cameras.width), np.int32), jax.tree.map(np.asarray, cameras)
    if gaussians.count <= MAX_WHOLE:  # once for all views
        gaussians = jax.device_put(dataclasses.replace(gaussians, sh=None))

    def view(t: int) -> tuple[np.ndarray, float, float]:
        evidence = view_evidence(gaussians, cameras[t], whole, 1, near=0.01 * diagonal)
        weights = np.zeros(gaussians.count, np.float32)
        weights[evidence.gaussians] = evidence.weights  # one entry each
        shown = weights[counted.sample]
        with np.errstate(invalid="ignore"):  # centres that are not finite have no weight
            depth = means @ poses[t, 2, :3] + poses[t, 2, 3]
        is_wide = widest * cameras.fx[t] > 0.1 * cameras.width * depth
        return shown, weights[counted.inner].sum() / pixels, shown[is_wide].sum() / max(shown.sum(), 1e-30)

    found = [*each_view(gaussians.count, len(poses), view, progress)]
    seen = np.array([shown for shown, _, _ in found], np.float32).reshape(len(poses), len(means))
    alpha, fog = np.array([shares for _, *shares in found]).reshape(-1, 2).T
    return seen, alpha, fog


def frames_by_need(
    gaussians: Gaussians, cameras: Camera, *, limit: int | None = None, progress: Progress | None = None
) -> Int[np.ndarray, " k"]:
    """Chooses at most `limit` of T frames for masks, those that show most of the scene first.

    A frame is needed where it shows Gaussians that fewer than `ENOUGH` chosen frames show. Several processes that make
    the same call share the work.
    """
    counted = np.unique(np.linspace(0, gaussians.count - 1, min(gaussians.count, 100_000)).astype(int))
    whole = np.zeros((cameras.height, cameras.width), np.int32)

    def shown(t: int) -> Float[np.ndarray, " n"]:
        weights = view_evidence(gaussians, cameras[t], whole, 1).matrix(gaussians.count, 1).sum(1)
        return np.minimum(np.asarray(weights, np.float32)[counted, 0] / SEEN_PX, 1)

    visible = np.stack(map_views(len(cameras), shown, progress))
    views = len(cameras) if limit is None else limit

    def choose(rows: Sequence[int]) -> list[np.ndarray]:
        return [_greedy_cover(visible, visible.max(0) > 0, views, enough=ENOUGH, least_gain=LEAST_GAIN) for _ in rows]

    return map_over_processes(1, choose)[0]  # one process chooses: others may round otherwise
