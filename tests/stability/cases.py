"""The rows of the stability table: scenes that are stiff or extreme in one way each."""

import dataclasses
from collections.abc import Iterator

import numpy as np

from jsecon.types import Camera
from stability.case import (
    ARGUMENTS,
    STRAIGHT,
    Case,
    camera_of,
    case_of,
    changed,
    cloud,
    directions,
    ordinary,
    quaternion_onto,
)

CANCELS = (
    "the gradient of the camera is a sum over the stack that cancels: each Gaussian's own gradient is within 5e-6, and "
    "as large errors come at every opacity from 0.5 to 1 (2e-5 to 9e-5)"
)
"""rounding of terms, not of inputs: the one-ulp figure does not show it"""


def shapes() -> Iterator[Case]:
    """Needles, discs, the very small and the very large."""
    axes = directions(48)
    turns, points = quaternion_onto(axes), cloud(48, 1)
    yield case_of("needles, aspect 1e6, 9 px long", points, (0.5, 5e-7, 5e-7), turns)
    yield case_of("needles, aspect 1e6, 1 px wide", points, (5e4, 0.05, 0.05), turns)
    ray = points / np.linalg.norm(points, axis=1, keepdims=True)
    yield case_of(
        "needles, aspect 1e6, along the ray",
        points,
        (1.0, 1e-6, 1e-6),
        quaternion_onto(ray),
        bounds={"log_scales": 5e-3, "quaternions": 5.0},
        why="seen end on, the image grows with the square of the angle off the ray, which float32 knows to 1e-7 only",
    )
    normal = np.cross(ray, axes)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    yield case_of("discs, aspect 1e6, edge-on", points, (3e-7, 0.3, 0.3), quaternion_onto(normal))
    tilted = normal + 1e-4 * ray
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    yield case_of(
        "discs, aspect 1e6, 1e-4 rad off edge-on",
        points,
        (3e-5, 30.0, 30.0),
        quaternion_onto(tilted),
        bounds={"value": 5e-5, **dict.fromkeys(("means", "log_scales", "quaternions", "pose"), 3e-3)},
        why="the 1e-4 rad, and so the width of 0.1 px, are known to 1e-3",
    )
    rng = np.random.default_rng(5)
    unequal, turns = rng.uniform(0.5, 2.0, (48, 3)), rng.normal(size=(48, 4))
    yield case_of("sub-pixel, 2e-4 px", points, 1e-5 * unequal, turns, 2.0)
    yield case_of("screen-filling, 2e4 px", points, 1e3 * unequal, turns, -1.0)
    scales = np.full((48, 3), np.exp(-3.0))
    for name, exponents in (
        ("log scales 80", (80, 80, 80)),
        ("log scales -80", (-80, -80, -80)),
        ("log scales 80, -3, -3", (80, -3, -3)),
        ("log scales 80, 80, -80", (80, 80, -80)),
        ("log scales -inf: the logarithm of 0", (-np.inf, -2, -3)),
    ):
        yield changed(case_of(name, points, scales, turns), name, [("log_scales", slice(0, 48), exponents)])


def opacities() -> Iterator[Case]:
    """Saturated logits and long stacks."""
    both = np.where(np.arange(48) % 2, 1.0, -1.0)
    for size, name in ((30.0, "30"), (1e4, "1e4"), (np.inf, "inf: the logits of 1 and 0")):
        yield changed(ordinary(), f"opacity logits +-{name}", [("opacity_logits", slice(0, 48), size * both)])
    rng = np.random.default_rng(11)
    n = 10_000
    points = rng.normal(scale=(0.02, 0.02, 0), size=(n, 3))
    points[:, 2] = 2 + rng.permutation(n) / n
    small = camera_of(width=17, height=13)
    turns, sizes = rng.normal(size=(n, 4)), rng.uniform(0.1, 0.3, (n, 3))
    limit = {"bounds": {"intrinsics": 2e-4, "pose": 2e-4}, "why": CANCELS}
    for name, logits, rest in (
        ("opaque", 10.0, limit),
        ("faint", rng.uniform(-5.4, -5.0, n), {}),
        ("faint below the cut", -5.6, {}),
    ):
        name = f"10,000 {name} in a stack, image of 17x13"
        yield case_of(name, points, sizes, turns, logits, camera=small, count=n, **rest)


def depths() -> Iterator[Case]:
    """Ties, the near plane, the edge of the clamp, far away."""
    straight = camera_of(STRAIGHT)
    rng = np.random.default_rng(13)
    ties = cloud(48, 4)
    ties[:, 2] = 2.0
    yield case_of("equal depths", ties, rng.uniform(0.1, 0.4, (48, 3)), rng.normal(size=(48, 4)), 2.0, camera=straight)
    near = np.float32(0.01)
    steps = [near, np.nextafter(near, np.float32(1)), np.nextafter(near, np.float32(0)), 0.0, -0.01, -1.0, -1e6, 1e-30]
    z = np.array([*steps, *(near * np.float32(1.0) + np.float32(k) * np.float32(1e-3) for k in range(1, 17))])
    points = np.stack([rng.uniform(-0.4, 0.4, len(z)) * np.abs(z), rng.uniform(-0.4, 0.4, len(z)) * np.abs(z), z], 1)
    sizes, turns = rng.uniform(0.001, 0.01, (len(z), 3)), rng.normal(size=(len(z), 4))
    yield case_of("on, behind and just before the near plane", points, sizes, turns, 0.0, camera=straight)
    sizes, turns = rng.uniform(0.2, 0.6, (32, 3)), rng.normal(size=(32, 4))
    beside, on = (_clamp_edge(straight, factors) for factors in ((1 - 1e-4, 1 + 1e-4), (1.0, 1.0)))
    yield case_of("beside the clamp's edge", beside, sizes, turns, 0.0, camera=straight)
    yield case_of(
        "on the clamp's edge",
        on,
        sizes,
        turns,
        0.0,
        camera=straight,
        bounds={"means": 0.2, "pose": 0.5, "intrinsics": 0.5},
        why="a kink: rounding chooses between the derivatives of its two sides",
    )
    yield case_of("1e15 m away", 1e15 * cloud(48, 6), 1e14 * rng.uniform(0.3, 1, (48, 3)), rng.normal(size=(48, 4)))
    sideways = np.concatenate([cloud(24, 6), cloud(24, 6) * (2e38, -2e38, 1)])
    yield case_of("half of them 2e38 m aside", sideways, rng.uniform(0.1, 0.3, (48, 3)), rng.normal(size=(48, 4)))


def _clamp_edge(camera: Camera, factors: tuple[float, float]) -> np.ndarray:
    """(32, 3) points whose x/z or y/z is `factors` times the clamp's limit, on all four sides."""
    rows = []
    f, cx, cy = float(camera.fx), float(camera.cx), float(camera.cy)
    low = (-cx / f - 0.15 * camera.width / f, -cy / f - 0.15 * camera.height / f)
    high = ((camera.width - cx) / f + 0.15 * camera.width / f, (camera.height - cy) / f + 0.15 * camera.height / f)
    for k in range(32):
        limit, axis = (low, high)[k % 2], k // 2 % 2
        ratio = np.zeros(2)
        ratio[axis] = limit[axis] * factors[k // 4 % 2]
        ratio[1 - axis] = np.linspace(-0.4, 0.4, 8)[k // 4]
        z = 1.5 + 0.05 * k
        rows.append([*(ratio * z), z])
    return np.array(rows)


def cameras() -> Iterator[Case]:
    """Focal lengths, sizes, principal points."""
    rng = np.random.default_rng(17)
    sizes, turns = rng.uniform(0.03, 0.3, (48, 3)), rng.normal(size=(48, 4))
    wide = cloud(48, 8, spread=20.0)
    yield case_of("focal length 1 px", wide, 20 * sizes, turns, camera=camera_of(f=1.0))
    narrow = cloud(48, 8, spread=0.45 * 45e-5)
    yield case_of("focal length 1e5 px, straight pose", narrow, 45e-5 * sizes, turns, camera=camera_of(STRAIGHT, f=1e5))
    yield case_of(
        "focal length 1e5 px, turned pose",
        narrow,
        45e-5 * sizes,
        turns,
        camera=camera_of(f=1e5),
        bounds={"value": 1e-3, **dict.fromkeys(ARGUMENTS, 1e-3)},
        why="a position of metres is known to 1e-7 m, at this focal length 0.01 px",
    )
    aside = cloud(48, 8) + np.array([1.0, -1.0, 0]) * cloud(48, 8)[:, 2:] * (100 / 45.0)
    yield case_of("principal point outside the image", aside, sizes, turns, camera=camera_of(cx=-75.0, cy=119.0))
    for width, height in ((1, 1), (9, 7)):
        yield ordinary(f"image of {width}x{height}", camera=camera_of(width=width, height=height))
    yield ordinary("one Gaussian", 1, count=1)
    yield case_of("no Gaussian", np.zeros((0, 3)), 1.0, count=0)


def numbers() -> Iterator[Case]:
    """Quaternions and features at the ends of the float range; numbers that are none."""

    def length(name, factor):
        return changed(
            ordinary(),
            name,
            [("quaternions", slice(0, 48), ordinary().gaussians.quaternions[:48] * np.float32(factor))],
        )

    yield length("quaternions of length 0", 0.0)
    yield length("denormal quaternions, 1e-40", 1e-40)
    yield length("quaternions of length 1e-30", 1e-30)
    yield length("quaternions of length 1e30", 1e30)
    for factor in (1e30, 1e-30, 0.0):
        yield dataclasses.replace(
            ordinary(f"features of {factor:g}"), features=ordinary().features * np.float32(factor)
        )
    bad = [(5, np.nan), (9, np.inf), (14, -np.inf)]
    yield changed(ordinary(), "NaN and infinite means", [("means", (i, i % 3), v) for i, v in bad], bad=3)
    yield changed(ordinary(), "NaN and infinite log scales", [("log_scales", (i, i % 3), v) for i, v in bad[:2]], bad=2)
    yield changed(ordinary(), "NaN and infinite quaternions", [("quaternions", (i, i % 4), v) for i, v in bad], bad=3)
    yield changed(ordinary(), "NaN opacity logit", [("opacity_logits", 5, np.nan)], bad=1)
    everything = ("means", "log_scales", "quaternions", "opacity_logits")
    yield changed(ordinary(), "every second one NaN", [(k, slice(0, 48, 2), np.nan) for k in everything], bad=24)
    yield changed(ordinary(), "NaN and infinite features", [("features", (i, i % 3), v) for i, v in bad], bad=3)


def offsets() -> Iterator[Case]:
    """A scene 1e6 m from the origin: as it is, recentred after float32 took its toll, and recentred before."""
    base = ordinary()
    shift = np.array([1e6, -1e6, 1e6])
    gaussians, camera = base.gaussians, base.camera
    pose = np.asarray(camera.world_to_camera, np.float64)
    pose[:3, 3] -= pose[:3, :3] @ shift
    far = dataclasses.replace(gaussians, means=gaussians.means.astype(np.float64) + shift)
    far_camera = dataclasses.replace(camera, world_to_camera=pose)
    stored = dataclasses.replace(far, means=far.means.astype(np.float32))
    stored_camera = dataclasses.replace(far_camera, world_to_camera=pose.astype(np.float32))
    yield dataclasses.replace(
        base,
        name="1e6 m off, as it is",
        gaussians=stored,
        camera=stored_camera,
        bounds={"value": 1.0, **dict.fromkeys(ARGUMENTS, 2.0)},
        why="float32 has steps of 0.06 m at 1e6 m: nothing can be promised; recentre (the next rows)",
    )
    for name, exact in (
        ("1e6 m off, stored in float32, then recentred", (stored, stored_camera)),
        ("1e6 m off, recentred from float64", (far, far_camera)),
    ):
        means, poses = (np.asarray(a, np.float64) for a in (exact[0].means, exact[1].world_to_camera))
        origin, moved = np.median(means, axis=0), poses.copy()
        moved[:3, 3] += poses[:3, :3] @ origin
        gaussians = dataclasses.replace(exact[0], means=(means - origin).astype(np.float32))
        camera = dataclasses.replace(exact[1], world_to_camera=moved.astype(np.float32))
        yield dataclasses.replace(
            base, name=name, gaussians=gaussians, camera=camera, exact=exact, origin=tuple(origin)
        )


def cases() -> list[Case]:
    """Every row, in the order of the table."""
    return [ordinary(), *shapes(), *opacities(), *depths(), *cameras(), *numbers(), *offsets()]
