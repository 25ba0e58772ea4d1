"""The steps of structure from motion, in a process of their own: features, matches, mapping, by pycolmap on the CPU.

`python -m jsecon.data.motion_steps WORK` reads WORK/job.json and writes WORK/capture and WORK/found.json. What it finds
on the way stays in WORK/database.db: stopped and started again it goes on there, photograph by photograph and pair by
pair.

Frames with names near each other are matched, and frames that look alike: of each, its SIFT descriptors' differences
from 64 visual words are summed up (VLAD, Jegou et al., "Aggregating local descriptors into a compact image
representation", CVPR 2010), with words made from the photographs themselves, so that nothing need be fetched.
"""

from __future__ import annotations

import collections
import contextlib
import itertools
import json
import os
import shutil
import sqlite3
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jsecon.files import write_text

Progress = Callable[[int, int], None]
LONG_SIDE, FEATURES = 1600, 4096
"""px that a photograph is shrunk to before features are looked for, and most of them kept"""
UPSAMPLED = 1000
"""px of the longer side up to which features are looked for at twice the size too, as Lowe does: of photographs of
799 x 532 that gives 5,400 features instead of 880, too few for right poses"""
ALL_PAIRS, NEIGHBOURS, ALIKE = 40, 10, 20
"""photographs up to which every pair is matched; above, the neighbours in name order and the frames that look most
alike that each is matched with"""
WORDS, SAMPLED = 64, 1000
"""visual words, and descriptors of a photograph that are looked at"""
HELD, REPAIRS = 0.3, 3
"""A photograph of whose matches a smaller share became points seen in both, against that of the middle photograph,
stands in a wrong place and is registered again, so often. Of the bonsai's 125 two did: shares of 0.08 and 0.12; when
right, the least was 0.59 and the middle 0.87."""
FIRM = 0.6
"""share of the matches, in the middle photograph, below which a model is held for wrong as a whole"""
AT_ONCE_STEPS = 5
"""times, at most, that GLOMAP tells of its model on the way: 5 on 14 photographs of the bonsai, 3 on a made-up scene"""
FEWEST = 3
"""photographs that a model can be made of"""
PAIR = 2147483647
"""COLMAP's number of a pair is PAIR * the smaller image's + the larger's"""


def main(work: Path) -> None:
    """Takes the steps, with a line "done total" on standard output whenever one has come further."""
    import pycolmap

    told = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever COLMAP prints goes where its log goes

    def progress(done: int, total: int) -> None:
        print(done, total, file=told, flush=True)  # fails where nobody listens any more, which ends this process

    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    pycolmap.set_random_seed(0)
    job, database, links = json.loads((work / "job.json").read_text()), work / "database.db", work / "links"
    clock = [time.monotonic()]
    _features(pycolmap, job, database, links, progress)
    clock.append(time.monotonic())
    _matches(pycolmap, database, progress)
    clock.append(time.monotonic())
    best, models = _mapping(pycolmap, len(job["names"]), database, links, progress)
    clock.append(time.monotonic())
    seconds = dict(zip(("features", "matches", "mapping"), np.diff(clock).tolist()))
    result = {"registered": [], "models": models, "points": 0, "error_px": 0.0, "seconds": seconds}
    if best is not None:
        result["registered"] = [image.name for image in best.images.values() if image.has_pose]
        result |= {"points": best.num_points3D(), "error_px": best.compute_mean_reprojection_error()}
        for image in best.images.values():
            image.name = os.fsencode(job["names"][image.name])  # also one that is no UTF-8
        shutil.rmtree(work / "capture", ignore_errors=True)
        (work / "capture" / "sparse" / "0").mkdir(parents=True)
        best.write_binary(work / "capture" / "sparse" / "0")
    write_text(work / "found.json", json.dumps(result))


def _features(colmap: Any, job: Any, database: Path, links: Path, progress: Progress) -> None:
    names = [name for group in job["groups"] for name in group]
    options = colmap.FeatureExtractionOptions()
    options.max_image_size, options.sift.max_num_features = LONG_SIDE, FEATURES
    options.sift.first_octave = -1 if min(max(job["size"]), LONG_SIDE) <= UPSAMPLED else 0
    reader = colmap.ImageReaderOptions()
    reader.camera_model = "OPENCV"
    if not database.exists() or len(_rows(database, "select name from images")) < len(names):
        for file in database.parent.glob(database.name + "*"):
            file.unlink()
        colmap.Database.open(database).close()
        for group in job["groups"]:
            colmap.import_images(database, links, colmap.CameraMode.SINGLE, image_names=group, options=reader)
    done = {name for (name,) in _rows(database, "select name from images join keypoints using (image_id)")}
    left = [name for name in names if name not in done]
    for start in range(0, len(left), 4):
        some, how = left[start : start + 4], {"reader_options": reader, "extraction_options": options}
        colmap.extract_features(database, links, image_names=some, device=colmap.Device.cpu, **how)
        progress(len(names) - len(left) + start + len(some), len(names))


def _matches(colmap: Any, database: Path, progress: Progress) -> None:
    names = dict(_rows(database, "select image_id, name from images"))
    pairs = _pairs(database, sorted(names, key=lambda image: names[image]))
    done = {divmod(pair, PAIR) for (pair,) in _rows(database, "select pair_id from two_view_geometries")}
    left = sorted(pairs - done)
    options, verify = colmap.FeatureMatchingOptions(), colmap.TwoViewGeometryOptions()
    options.use_gpu, verify.ransac.random_seed = False, 0
    listed = colmap.ImportedPairingOptions()
    listed.match_list_path = database.with_name("pairs.txt")
    for start in range(0, len(left), 50):
        some = left[start : start + 50]
        write_text(listed.match_list_path, "".join(f"{names[a]} {names[b]}\n" for a, b in some))
        colmap.match_image_pairs(database, options, listed, verify, device=colmap.Device.cpu)
        progress(len(pairs) - len(left) + start + len(some), len(pairs))


def _mapping(colmap: Any, total: int, database: Path, links: Path, progress: Progress) -> tuple[Any, int]:
    """The model that holds the most matches, or None, and how many models its mapper left.

    The focal lengths that EXIF does not tell are found from the pairs first (Sweeney et al., "Optimizing the viewing
    graph for structure-from-motion", ICCV 2015), then all photographs are placed at once (Pan et al., GLOMAP, arXiv
    2407.20219). Where that leaves photographs out or in wrong places, they are placed one after the other, too. That
    order is the surer one: of two runs of the bonsai one by one, one ended in a model of another lens (a focal length
    of 527 for 821 px, 0.92 px), after 11 minutes; all at once it takes 3, and every camera is right.
    """
    if colmap.Database.open(database).num_verified_image_pairs() > 0:
        colmap.calibrate_view_graph(database, colmap.ViewGraphCalibrationOptions(random_seed=0))
    best, models = _at_once(colmap, total, database, links, progress)
    if best is not None and best.num_reg_images() == total and _firm(database, best):
        return best, models
    found = [(best, models), _one_by_one(colmap, total, database, links, progress)]
    found = [(model, models) for model, models in found if model is not None]
    return max(found, key=lambda one: sum(_held(database, one[0])[0].values()), default=(None, 0))


def _at_once(colmap: Any, total: int, database: Path, links: Path, progress: Progress) -> tuple[Any, int]:
    """The global model with the most photographs, or None, and how many models there are."""
    options, models = colmap.GlobalPipelineOptions(), colmap.ReconstructionManager()
    options.random_seed = options.mapper.random_seed = 0
    options.image_path = str(links)
    pipeline, count = colmap.GlobalPipeline(options, colmap.Database.open(database), models), itertools.count(1)
    told = colmap.GlobalPipelineCallback.MODEL_UPDATE_CALLBACK
    pipeline.add_callback(told, lambda: progress(min(next(count), AT_ONCE_STEPS), AT_ONCE_STEPS + 1))
    progress(0, AT_ONCE_STEPS + 1)
    pipeline.run()
    if not (found := [models.get(number) for number in range(models.size())]):
        return None, 0
    best = max(found, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    progress(best.num_reg_images(), total)
    return best, len(found)


def _one_by_one(colmap: Any, total: int, database: Path, links: Path, progress: Progress) -> tuple[Any, int]:
    """The incremental model with the most photographs, or None, and how many models there are."""
    options = colmap.IncrementalPipelineOptions()
    options.random_seed, options.min_model_size = 0, FEWEST

    def mapped(name: str, registered: int, **start: Path) -> list[Any]:
        count = itertools.count(registered + 1)
        tell = lambda: progress(min(next(count), total), total)
        (folder := database.with_name(name)).mkdir(exist_ok=True)
        how = {"options": options, "initial_image_pair_callback": tell, "next_image_callback": tell}
        return list(colmap.incremental_mapping(database, links, folder, **how, **start).values())

    found = mapped("models", 1)
    if not found:
        return None, 0
    best = max(found, key=lambda model: (model.num_reg_images(), model.num_points3D()))
    options.multiple_models = False
    for turn in range(REPAIRS):
        if not (wrong := _misplaced(database, best)):
            break
        for image in wrong:
            best.deregister_frame(best.images[image].frame_id)
        if turn < REPAIRS - 1 and best.num_reg_images() >= FEWEST:
            (folder := database.with_name(f"repair{turn}")).mkdir(exist_ok=True)
            best.write_binary(folder)
            best = next(iter(mapped(f"repaired{turn}", best.num_reg_images(), input_path=folder)), best)
    return best, len(found)


def _misplaced(database: Path, model: Any) -> list[int]:
    """The photographs whose matches the model does not hold: in another place, it makes points of a few of them."""
    shares = _shares(database, model)
    return [image for image, share in shares.items() if share < HELD * np.median(list(shares.values()))]


def _firm(database: Path, model: Any) -> bool:
    """Whether no photograph stands in a wrong place, and the model as a whole holds its matches."""
    shares = list(_shares(database, model).values()) or [0.0]
    return bool(np.median(shares) >= FIRM) and not _misplaced(database, model)


def _shares(database: Path, model: Any) -> dict[int, float]:
    held, matches = _held(database, model)
    return {image: held[image] / count for image, count in matches.items()}


def _held(database: Path, model: Any) -> tuple[dict[int, int], dict[int, int]]:
    """Of each photograph with a pose, its matches that became points seen in both, and all of its matches."""
    points, matches, held = {}, collections.Counter(), collections.Counter()
    for number, image in model.images.items():
        if image.has_pose:
            points[number] = np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64)
    for pair, data in _rows(database, "select pair_id, data from two_view_geometries where rows > 0"):
        a, b = divmod(pair, PAIR)
        if a in points and b in points:
            rows = np.frombuffer(data, np.uint32).reshape(-1, 2)
            of_a, of_b = points[a][rows[:, 0]], points[b][rows[:, 1]]
            for image in (a, b):
                matches[image] += len(rows)
                held[image] += int(((of_a == of_b) & (of_a >= 0)).sum())
    return held, matches


def _pairs(database: Path, images: list[int]) -> set[tuple[int, int]]:
    """The pairs of images to match, (smaller number, larger number)."""
    count = len(images)
    reach = count if count <= ALL_PAIRS else NEIGHBOURS
    near = {(a, b) for a in range(count) for b in range(a + 1, min(count, a + reach + 1))}
    if count > ALL_PAIRS:
        likeness = _likeness(database, images)
        np.fill_diagonal(likeness, -np.inf)
        most = np.argsort(-likeness, axis=1)[:, :ALIKE]
        near |= {(min(a, int(b)), max(a, int(b))) for a in range(count) for b in most[a]}
    return {(min(images[a], images[b]), max(images[a], images[b])) for a, b in near}


def _likeness(database: Path, images: list[int]) -> Float[np.ndarray, "n n"]:
    """Cosines of the images' VLADs; 0 where an image has no features."""
    from scipy.cluster.vq import kmeans2, vq

    draw, found = np.random.default_rng(0), {}
    with contextlib.closing(sqlite3.connect(database)) as held:
        for image, count, data in held.execute("select image_id, rows, data from descriptors where rows > 0"):
            rows = np.frombuffer(data, np.uint8).reshape(count, -1)
            found[image] = rows[draw.permutation(count)[:SAMPLED]].astype(np.float32)
    if not found:
        return np.zeros((len(images), len(images)))
    sample = np.concatenate([rows[: SAMPLED // 5] for rows in found.values()])
    start = sample[draw.permutation(len(sample))[:WORDS]]
    words, _ = kmeans2(sample, start, iter=10, minit="matrix")
    sums = np.zeros((len(images), *words.shape))
    for place, image in enumerate(images):
        if (rows := found.get(image)) is not None:
            nearest, _ = vq(rows, words)
            np.add.at(sums[place], nearest, rows - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=-1, keepdims=True), 1e-6)  # no word outweighs the others
    flat = sums.reshape(len(images), -1)
    flat /= np.maximum(np.linalg.norm(flat, axis=-1, keepdims=True), 1e-6)
    return flat @ flat.T


def _rows(database: Path, query: str) -> list[tuple]:
    with contextlib.closing(sqlite3.connect(database)) as held:
        return held.execute(query).fetchall()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
