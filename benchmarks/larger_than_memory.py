"""Votes, queries, export and cleaning of a scene whose columns stay on disk: seconds, peak memory, growth.

    python benchmarks/larger_than_memory.py --gaussians 20000000 --views 20        (11 GB in FOLDER while it runs)
    python benchmarks/larger_than_memory.py --clean --views 12        (`jsecon clean`, a .ply of 1.4 GB to another)
    python benchmarks/larger_than_memory.py --growth votes        (or: queries)

A made-up landscape of 100 m, hills and low growth, in the order of a curve that fills the ground; a hundred regions are
the squares of the ground, as far as its plane tells; cameras on a ring look across it. Every step runs in a process of
its own, whose largest resident memory is told: pages of mapped files count, which the system takes back when it needs
them. The part that is compared with `region_votes` and `query_anchored` in memory are 2 million Gaussians about the
middle.
"""

import argparse
import dataclasses
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from jsecon.process import peak_memory_mib, prepare_process

prepare_process()

import jax
import numpy as np

import jsecon
from jsecon.app import cli
from jsecon.files import map_npy
from jsecon.types import Camera, Gaussians, LanguageField, Regions, Selection, Votes

SIDE, ACROSS, SQUARES, PART = 100.0, 64, 10, 2_000_000
"""m of the ground; tiles along each side, in whose order Gaussians lie; regions along each side"""
SHAPES = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity_logits": (), "sh": (1, 3)}
REGIONS, EMBEDDING, TEXTS = SQUARES**2, 64, 100


def landscape(count: int, first: int, rows: int) -> Gaussians:
    """The Gaussians `first` to `first + rows` of `count`, NumPy float32."""
    rng = np.random.default_rng([count, first])
    tiles = np.arange(first, first + rows, dtype=np.int64) * ACROSS**2 // count
    x, z = (sum((tiles >> (2 * bit + axis) & 1) << bit for bit in range(6)) for axis in (0, 1))
    x, z = ((tile + rng.random(rows)) * SIDE / ACROSS - SIDE / 2 for tile in (x, z))
    height = 2 * np.sin(x / 7) * np.cos(z / 9) + (rng.random(rows) < 0.3) * rng.exponential(1.0, rows)
    spacing = SIDE / np.sqrt(count)
    sizes = 0.6 * spacing * rng.uniform(0.5, 1.5, (rows, 3)) * [1, 0.3, 1]
    columns = np.stack([x, -height, z], 1), np.log(sizes), rng.normal(size=(rows, 4)), rng.normal(1.5, 1.5, rows)
    return Gaussians(*(a.astype(np.float32) for a in columns), rng.normal(0, 0.3, (rows, 1, 3)).astype(np.float32))


def write_npy(path: Path, shape: tuple[int, ...], dtype: type, blocks: Iterable[np.ndarray]) -> None:
    """Writes a .npy block by block. On a full disk a write raises; a memory map would end the process."""
    with open(path, "wb") as file:
        header = {"descr": np.lib.format.dtype_to_descr(np.dtype(dtype)), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        for block in blocks:
            file.write(np.ascontiguousarray(block, dtype).tobytes())


def write_landscape(folder: Path, count: int) -> None:
    """Each column as a .npy."""
    folder.mkdir(parents=True)
    firsts = range(0, count, 1 << 20)
    for name, rest in SHAPES.items():
        blocks = (getattr(landscape(count, first, min(1 << 20, count - first)), name) for first in firsts)
        write_npy(folder / f"{name}.npy", (count, *rest), np.float32, blocks)


def mapped(folder: Path) -> Gaussians:
    return Gaussians(*(map_npy(folder / f"{name}.npy") for name in SHAPES))


def ring(views: int, width: int, height: int) -> Camera:
    """Cameras 12 m above the ground, on a ring of 35 m, that look at its middle."""
    poses = []
    for angle in np.arange(views) * 2.399963:
        centre = np.array([35 * np.sin(angle), -12.0, -35 * np.cos(angle)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross([0, 1.0, 0], z) / np.linalg.norm(np.cross([0, 1.0, 0], z))
        rotation = np.stack([x, np.cross(z, x), z])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
        poses.append(pose.astype(np.float32))
    lens = (np.full(views, value, np.float32) for value in (0.8 * width, 0.8 * width, width / 2, height / 2))
    return Camera(np.stack(poses), *lens, width, height)


class Labels:
    """Label images made when they are asked for: the square of the ground that a pixel's ray meets."""

    def __init__(self, cameras: Camera):
        self.cameras = cameras

    def __len__(self) -> int:
        return len(self.cameras.world_to_camera)

    def __getitem__(self, t: int) -> np.ndarray:
        camera = self.cameras[t]
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
        rays = rays @ camera.world_to_camera[:3, :3].astype(np.float64)
        centre = np.asarray(camera.centres, np.float64)
        down = rays[..., 1] > 1e-3
        ground = centre + rays * (-centre[1] / np.where(down, rays[..., 1], 1.0))[..., None]
        square = np.floor((ground[..., [0, 2]] + SIDE / 2) * SQUARES / SIDE)
        inside = down & (square >= 0).all(-1) & (square < SQUARES).all(-1)
        return np.where(inside, square @ [1, SQUARES], -1).astype(np.int32)


def main_regions(labels: Labels) -> Regions:
    """Random embeddings, true pixels."""
    pixels = [np.bincount(image[image >= 0], minlength=REGIONS) for image in (labels[t] for t in range(len(labels)))]
    embeddings = np.random.default_rng(0).normal(size=(REGIONS, EMBEDDING)).astype(np.float32)
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    return Regions(embeddings, np.stack(pixels, 1).astype(np.int32))


def field_of(gaussians: Gaussians, votes: Votes, cameras: Camera, regions: Regions) -> LanguageField:
    names = tuple(f"{t:05d}" for t in range(len(cameras.world_to_camera)))
    canonical = np.random.default_rng(1).normal(size=(4, EMBEDDING)).astype(np.float32)
    return LanguageField(gaussians, votes, regions, cameras, canonical, np.eye(4), names)


def texts_near(regions: Regions) -> np.ndarray:
    near = np.random.default_rng(2).normal(0, 0.05, regions.embeddings.shape)
    return (regions.embeddings + near).astype(np.float32)[:TEXTS]


def answers(field: LanguageField, texts: np.ndarray) -> Iterator[Selection]:
    """What each text selects, one after the other."""
    return (jsecon.query_anchored(field, text) for text in texts)


def timed(told: dict[str, float], name: str, call):
    """Seconds on the clock, and of CPU, which other work on the machine disturbs less."""
    start, worked = time.perf_counter(), time.process_time()
    out = jax.block_until_ready(call())
    told[name], told[f"{name} of CPU"] = time.perf_counter() - start, time.process_time() - worked
    return out


def votes_step(folder: Path, views: int, width: int, height: int) -> dict[str, float]:
    """Votes, overlap; and all in one field file."""
    cameras, told = ring(views, width, height), {}
    labels, gaussians = Labels(cameras), mapped(folder / "scene")
    regions = timed(told, "labels' pixels, s", lambda: main_regions(labels))
    how = {"folder": folder / "votes", "by_view": True}
    steps, worked = [], []
    votes = timed(
        told,
        "votes, s",
        lambda: jsecon.region_votes(
            gaussians,
            cameras,
            labels,
            REGIONS,
            **how,
            progress=lambda *_: (steps.append(time.perf_counter()), worked.append(time.process_time())),
        ),
    )
    for name, own in (("votes, a view, s", steps), ("votes, a view, s of CPU", worked)):
        told[name] = float(np.median(np.diff(own))) if len(own) > 1 else np.nan
    told["seen"] = float(np.mean([np.count_nonzero(votes.views[a : a + (1 << 20)]) / len(votes.views[a : a + (1 << 20)])
                                  for a in range(0, len(votes.views), 1 << 20)]))  # fmt: skip
    votes = timed(told, "votes finished, s", lambda: jsecon.normalise_votes(votes, regions))
    field = field_of(gaussians, votes, cameras, regions)
    timed(told, "field written, s", lambda: jsecon.save_field(folder / "field.safetensors", field))
    return told


def query_step(folder: Path, *_: int) -> dict[str, float]:
    """A hundred texts in one pass, one text, and export."""
    told: dict[str, float] = {}
    field = timed(told, "field opened, s", lambda: jsecon.load_field(folder / "field.safetensors", mapped=True))
    texts = texts_near(field.regions)
    timed(told, "first query, compilation included, s", lambda: list(answers(field, texts[:1])))
    timed(told, "one query, s", lambda: list(answers(field, texts[:1])))
    found = timed(told, "100 queries, s", lambda: [int(own.mask.sum()) for own in answers(field, texts)])
    told["selected by a query, mean"] = float(np.mean(found))
    return told


def export_step(folder: Path, *_: int) -> dict[str, float]:
    """The file checked, and a .ply written of it."""
    told: dict[str, float] = {}
    timed(told, "field checked, s", lambda: jsecon.check_field(folder / "field.safetensors"))
    field = jsecon.load_field(folder / "field.safetensors", mapped=True)
    turn = np.array([[0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    turned = dataclasses.replace(field, source_from_scene=turn)
    timed(told, "exported, s", lambda: jsecon.Scene(turned).export(folder / "scene.ply"))
    return told


def clean_step(folder: Path, views: int, width: int, height: int) -> dict[str, float]:
    """`jsecon clean` of a file; without views, from planned ones."""
    told: dict[str, float] = {}
    options = []
    if views:
        cameras = ring(views, width, height)
        lens = {"width": width, "height": height, "fx": 0.8 * width, "fy": 0.8 * width}
        rows = [
            {"img_name": f"{n}", "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist()} | lens
            for n, pose in enumerate(np.linalg.inv(cameras.world_to_camera.astype(np.float64)))
        ]
        (folder / "poses.json").write_text(json.dumps(rows))
        options = ["--cameras", str(folder / "poses.json")]
    command = ["clean", str(folder / "large.ply"), "--out", str(folder / "clean.ply"), *options]
    code = timed(told, "cleaned, s", lambda: cli.main([*command, "--json"]))
    assert code == 0
    return told


def finished(gaussians, cameras, labels, regions, **how):
    """Votes in blocks with all that queries read."""
    return jsecon.normalise_votes(jsecon.region_votes(gaussians, cameras, labels, REGIONS, **how), regions)


def part_step(folder: Path, views: int, width: int, height: int) -> dict[str, float]:
    """The part in memory and in blocks."""
    whole, told = mapped(folder / "scene"), {}
    first = max(0, whole.count // 2 - PART // 2)
    part = jax.tree.map(lambda a: np.array(a[first : first + PART]), whole)
    cameras = ring(views, width, height)
    labels = Labels(cameras)
    regions, images = main_regions(labels), np.stack([labels[t] for t in range(views)])
    how = {"folder": folder / "part", "by_view": True}
    blocks = timed(told, "in blocks, s", lambda: finished(part, cameras, labels, regions, **how))
    memory = timed(
        told,
        "in memory, s",
        lambda: jsecon.normalise_votes(jsecon.region_votes(part, cameras, images, REGIONS, by_view=True), regions),
    )
    told["part"], told["seen"] = part.count, float((np.asarray(memory.views) > 0).mean())
    for name in ("weights", "weight_where_region_visible", "labelled", "total", "max_pixel_weight"):
        own, other = (np.asarray(getattr(votes, name), np.float64) for votes in (blocks, memory))
        told[f"{name}: largest difference"] = float(np.abs(own - other).max())
        told[f"{name}: relative"] = float(np.linalg.norm(own - other) / np.linalg.norm(other))
    for name in ("regions", "views"):
        told[f"{name}: differ"] = int((np.asarray(getattr(blocks, name)) != np.asarray(getattr(memory, name))).sum())
    mapped_field = field_of(part, blocks, cameras, regions)
    held = {own.name: getattr(mapped_field.votes, own.name) for own in dataclasses.fields(Votes)}
    held = {name: np.array(a) if isinstance(a, np.memmap) else a for name, a in held.items()}
    held_field = dataclasses.replace(mapped_field, votes=Votes(**held))
    texts, apart = texts_near(regions), 0
    for text, own in zip(texts, answers(mapped_field, texts)):
        selection = jsecon.query_anchored(held_field, text)
        same = np.array_equal(own.mask, selection.mask) and np.array_equal(own.similarity, selection.similarity)
        apart += not same
    told["queries of 100 that differ in a bit"] = apart
    return told


STEPS = {"votes": votes_step, "query": query_step, "export": export_step, "part": part_step, "clean": clean_step}


def one(step: str, folder: Path, *sizes: int) -> dict[str, float]:
    """A step in a process of its own, with its peak memory."""
    command = [sys.executable, __file__, "--one", step, str(folder), *map(str, sizes)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def show(what: str, told: dict[str, float]) -> None:
    for name, value in told.items():
        print(f"| {what} | {name} | {value:.4g} |", flush=True)


def slope(sizes: list[float], seconds: list[float]) -> float:
    """Of the logarithms, by least squares."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def whole(base: Path, count: int, views: int) -> None:
    start = time.perf_counter()
    write_landscape(base / "scene", count)
    print(f"{count:,} Gaussians made in {time.perf_counter() - start:.0f} s\n| step | what | figure |\n|---|---|---|")
    for step, sizes in (("votes", (views, 1280, 720)), ("query", ()), ("export", ()), ("part", (4, 1280, 720))):
        show(step, one(step, base, *sizes))


def clean(base: Path, count: int, views: int) -> None:
    """Writes a file and cleans it. Its memory is that of one program, from file to file."""
    if not (base / "large.ply").exists():
        write_landscape(base / "scene", count)
        jsecon.save_gaussians(base / "large.ply", mapped(base / "scene"))
        shutil.rmtree(base / "scene")
    show(f"clean {count:,}", one("clean", base, views, 400, 300))


def cast(base: Path, count: int, views: int, width: int, height: int) -> dict[str, float]:
    """Votes of all views, compiled before."""
    folder, told = base / f"{count}", {}
    if not folder.exists():
        write_landscape(folder, count)
    for given in (1, views):
        cameras, out = ring(given, width, height), base / "votes"

        def call(c=cameras, o=out):
            return jsecon.region_votes(mapped(folder), c, Labels(c), REGIONS, folder=o)

        timed(told, "s", call)
        shutil.rmtree(out)
    return told


def growth(base: Path, largest: int) -> None:
    """Votes along N, views and pixels, in one process; the slopes are those of CPU seconds."""
    print("| along | N | views | pixels | s | s of CPU |\n|---|---|---|---|---|---|", flush=True)
    sizes = {"N": [(n, 3, 1280, 720) for n in (100_000, 1_000_000, 4_000_000, 20_000_000) if n <= largest]}
    sizes["pixels"] = [(1_000_000, 3, *size) for size in ((320, 180), (640, 360), (1280, 720), (2560, 1440))]
    sizes["views"] = [(1_000_000, views, 640, 360) for views in (2, 6, 18)]
    for along, rows in sizes.items():
        given, taken = [], []
        for count, views, width, height in rows:
            told = cast(base, count, views, width, height)
            given.append({"N": count, "views": views, "pixels": width * height}[along])
            taken.append(told["s of CPU"])
            row = f"| {along} | {count:,} | {views} | {width}x{height} | {told['s']:.2f} | {told['s of CPU']:.2f} |"
            print(row, flush=True)
        steps = [slope(given[k : k + 2], taken[k : k + 2]) for k in range(len(given) - 1)]
        print(f"slope in {along}: {slope(given, taken):.2f}; from row to row", *(f"{own:.2f}" for own in steps))


def random_votes(folder: Path, count: int) -> Votes:
    """Mapped columns of votes that nothing cast."""
    folder.mkdir(parents=True)
    kinds = {
        "regions": ((8,), np.int32),
        "weights": ((8,), np.float32),
        "weight_where_region_visible": ((8,), np.float32),
    }
    kinds |= {name: ((), np.float32) for name in ("labelled", "total", "max_pixel_weight")} | {"views": ((), np.int32)}
    for name, (rest, dtype) in kinds.items():
        rng = np.random.default_rng(len(name))
        sizes = ((min(1 << 20, count - first), *rest) for first in range(0, count, 1 << 20))
        draw = (lambda shape: rng.integers(1, REGIONS, shape)) if dtype is np.int32 else rng.random  # noqa: B023
        write_npy(folder / f"{name}.npy", (count, *rest), dtype, map(draw, sizes))
    columns = {name: map_npy(folder / f"{name}.npy") for name in kinds}
    return Votes(**columns, overflow=np.zeros((), np.int32), num_regions=REGIONS)


def query_growth(base: Path, largest: int) -> None:
    """A query by votes along N."""
    print("| N | one query, s | s of CPU | 100 queries, s | s of CPU |\n|---|---|---|---|---|", flush=True)
    cameras, rows = ring(1, 64, 36), []
    regions = main_regions(Labels(cameras))
    texts = texts_near(regions)
    for count in (100_000, 1_000_000, 4_000_000, 20_000_000):
        if count <= largest:
            votes, told = random_votes(base / f"{count}", count), {}
            none = Gaussians(*(np.zeros((0, *rest), np.float32) for rest in SHAPES.values()))
            field = field_of(none, votes, cameras, regions)
            for _ in range(2):
                timed(told, "one", lambda f=field: list(answers(f, texts[:1])))
                timed(told, "many", lambda f=field: [own.mask.sum() for own in answers(f, texts)])
            rows.append((count, told["one of CPU"], told["many of CPU"]))
            print(f"| {count:,} | {' | '.join(f'{value:.3f}' for value in told.values())} |", flush=True)
    for k, name in ((1, "one query"), (2, "100 queries")):
        print(f"slope of {name} in N: {slope([row[0] for row in rows], [row[k] for row in rows]):.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, default=20_000_000)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--growth", choices=("votes", "queries"))
    parser.add_argument("--folder", type=Path, help="where the columns go; by default a temporary folder")
    parser.add_argument("--clean", action="store_true", help="of a file; --views 0 plans them")
    parser.add_argument("--one", nargs="+", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        step, folder, *sizes = given.one
        told = STEPS[step](Path(folder), *map(int, sizes))
        peak = peak_memory_mib() / 1024
        return print(json.dumps(told | {"peak GiB": peak}))
    with tempfile.TemporaryDirectory(dir=given.folder) as base:
        if given.clean:
            clean(Path(base), given.gaussians, given.views)
        elif given.growth:
            {"votes": growth, "queries": query_growth}[given.growth](Path(base), given.gaussians)
        else:
            whole(Path(base), given.gaussians, given.views)


if __name__ == "__main__":
    main()
