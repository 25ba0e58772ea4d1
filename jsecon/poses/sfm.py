"""Camera poses of photographs by structure from motion with pycolmap (extra sfm), on the CPU.

The steps are COLMAP's own: SIFT features, matches of image pairs, a global model (GLOMAP, Pan et al., arXiv
2407.20219), and an incremental model if the global one leaves photographs out or contradicts the matches. Up to
ALL_PAIRS photographs, every pair is matched. Above, each photograph is matched with its neighbours in name order and
with those that look most alike, by a vocabulary of visual words made of the photographs themselves.

A panorama has one pose: its features are matched as directions. Below it, where its operator stands, no feature counts.

COLMAP writes to the standard streams, ends its process when an internal check fails, and cannot be stopped within a
step. After `import pycolmap`, Pillow ends the process when it saves a PNG. Therefore the steps run in a process of
their own. Features and matches stay in WORK/database.db: a stopped run resumes there.
"""

import collections
import contextlib
import importlib.util
import multiprocessing
import os
import shutil
import warnings
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.process import cores
from jsecon.read.captures.frames import frame_names
from jsecon.read.captures.images import image_header, read_image, write_image
from jsecon.read.captures.lens import OPERATOR_DEGREES, PANORAMA
from jsecon.types import Progress

MIN_PHOTOS = 3
"""Photographs that a model needs."""
ALL_PAIRS = 40
"""Number of photographs up to which every pair is matched."""
NEIGHBOURS, ALIKE = 10, 20
"""Neighbours in name order, and most similar photographs, that a photograph is matched with."""
MIN_EXPLAINED, MIN_EXPLAINED_OF_MEDIAN = 0.6, 0.3
"""Share of a photograph's matches that became common points: the least in the median photograph, and the least of any
photograph relative to the median. In a right model of 125 photographs the median was 0.87 and the least 0.59; two
wrongly placed ones had 0.08 and 0.12."""


class _Job(NamedTuple):
    """Photographs, by the names of their links in WORK/links."""

    names: dict[str, str]
    """Name of each link -> name of its photograph."""
    lenses: list[tuple[list[str], tuple[int, int], bool]]
    """Links that share a lens, group by group, their (width, height), and whether they are panoramas."""


class _Model(NamedTuple):
    """The model in WORK/capture."""

    registered: set[str]
    """Links of the photographs with a pose."""
    models: int = 0
    """Number of separate models; the largest is kept."""
    points: int = 0
    error_px: float = 0.0
    """Mean reprojection error, px of the photographs."""


def require_pycolmap(where: object) -> None:
    """Checks that pycolmap is installed; `where` names the capture in the InputError."""
    if importlib.util.find_spec("pycolmap") is None:
        remedy = "Run: pip install 'jsecon[sfm]' (or give poses: sparse/0 of COLMAP, or transforms.json)."
        raise InputError(where, "photographs without poses need pycolmap, which is not installed", remedy=remedy)


def _check_photographs(photos: Sequence[Path], where: object) -> list[str]:
    """Checks that photographs are enough and have different names; returns these, relative to their common folder."""
    if len(photos) < MIN_PHOTOS:
        remedy = "Take more that overlap by two thirds."
        raise InputError(where, f"there are only {len(photos)} photographs", f"at least {MIN_PHOTOS}", remedy)
    root = os.path.commonpath([photo.parent for photo in photos])
    names = [photo.relative_to(root).as_posix() for photo in photos]
    frame_names(names, where)
    return names


def find_poses(
    photos: Sequence[Path],
    work: Path,
    *,
    panoramas: Collection[Path] = (),
    where: object = "photographs",
    progress: Progress | None = None,
) -> tuple[Path, tuple[str, ...]]:
    """Estimates the poses of photographs.

    The lens model is COLMAP's OPENCV. Photographs share one lens if they have one size and their EXIF names one camera
    and focal length, or if it names none and they lie in one folder. Seeds are set, but COLMAP's threads add up in any
    order: results of two runs may differ in the last digits.

    Args:
      photos: The photographs.
      work: Folder in which the steps keep their state; the caller removes it.
      panoramas: Those of the photographs that are panoramas.
      where: Name of the capture for errors.
      progress: Called with (done, total): photographs, then pairs, then photographs with a pose.

    Returns:
      A COLMAP capture in `work` whose images/ holds links to the photographs (copies where the system has no links),
      and notes for the user.
    """
    require_pycolmap(where)
    original = _check_photographs(photos, where)
    with ThreadPoolExecutor(cores()) as pool:  # reads all pixels: a damaged photograph is an error now
        sizes = [image.shape[1::-1] for image in pool.map(read_image, photos)]
    links: list[str] = []
    for number, photo in enumerate(photos):
        # COLMAP ignores EXIF orientations and reads no HEIC and AVIF: it gets a copy of the upright pixels.
        copied = image_header(photo).orientation != 1 or photo.suffix.lower() in (".heic", ".heif", ".avif")
        links.append(f"{number:06d}{'.png' if copied else photo.suffix.lower()}")  # COLMAP's lists split at spaces
        _link(photo, work / "links" / links[-1], upright_copy=copied)
    groups = _lens_groups(photos, sizes, panoramas)
    lenses = [([links[n] for n in group], sizes[group[0]], photos[group[0]] in panoramas) for group in groups]
    model = _run_in_own_process(work, _Job(dict(zip(links, original)), lenses), progress)
    if len(model.registered) < MIN_PHOTOS:
        remedy = "Take more that overlap by two thirds: sharp photographs of a still scene, from different places."
        raise InputError(where, f"fewer than {MIN_PHOTOS} of {len(photos)} photographs match each other", remedy=remedy)
    for link, photo, name in zip(links, photos, original):
        if link in model.registered:
            _link(photo, work / "capture" / "images" / name)
    notes = [
        f"Found the poses of {len(model.registered)} of {len(photos)} photographs, and {model.points} points; "
        f"mean reprojection error {model.error_px:.2f} px."
    ]
    if skipped := [name for link, name in zip(links, original) if link not in model.registered]:
        listed = ", ".join(skipped[:5]) + (" ..." if len(skipped) > 5 else "")
        hint = "" if model.models == 1 else f" There are {model.models} separate models: photograph the gaps."
        notes.append(f"{len(skipped)} photographs match the others too little and are skipped: {listed}.{hint}")
    return work / "capture", tuple(notes)


def _lens_groups(photos: Sequence[Path], sizes: Sequence[Any], panoramas: Collection[Path] = ()) -> list[list[int]]:
    """Indices of the photographs that share a lens, group by group."""
    groups: dict[Any, list[int]] = collections.defaultdict(list)
    for index, (photo, size) in enumerate(zip(photos, sizes)):
        lens: object = photo.parent
        damaged_exif = contextlib.suppress(OSError, SyntaxError, ValueError)
        with damaged_exif, warnings.catch_warnings(action="ignore"), Image.open(photo) as image:
            exif = image.getexif()
            folder = exif.get_ifd(0x8769)
            tags = exif.get(0x0110), folder.get(0x920A), folder.get(0xA405)  # model, focal length, and of 35 mm film
            if any(tag is not None for tag in tags):
                lens = tuple(map(str, tags))
        groups[size, photo in panoramas, lens].append(index)
    return list(groups.values())


def _link(photo: Path, link: Path, *, upright_copy: bool = False) -> None:
    """Links to a photograph, or writes a copy of its upright pixels."""
    link.parent.mkdir(parents=True, exist_ok=True)
    link.unlink(missing_ok=True)
    if upright_copy:
        write_image(link, read_image(photo))
        return
    try:
        link.symlink_to(photo.resolve())
    except OSError:
        shutil.copyfile(photo, link)


def _run_in_own_process(work: Path, job: _Job, progress: Progress | None) -> _Model:
    """Runs the steps in a process that ends with this one, and passes its progress on."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_run_steps, args=(work, job, sender), daemon=True)
    child.start()
    sender.close()
    model = None
    try:
        with contextlib.suppress(EOFError):
            while model is None:
                message = receiver.recv()
                if isinstance(message, _Model):
                    model = message
                elif progress is not None:
                    progress(*message)
        child.join(None if model is None else 10)
    finally:
        child.kill()
        child.join()
    if model is None:
        log = work / "log.txt"
        if not log.is_file():  # a script without that line begins anew in the process
            remedy = 'A script that starts a run needs `if __name__ == "__main__":` before it.'
            raise InputError("pycolmap", f"its process did not start (code {child.exitcode})", remedy=remedy)
        last = (log.read_text(errors="replace").strip().splitlines() or ["no message"])[-1]
        problem = f"it ended with code {child.exitcode} ({last})"
        raise InputError("pycolmap", problem, remedy=f"The whole log is {log}.")
    return model


def _run_steps(work: Path, job: _Job, sender: Connection) -> None:
    """Runs the steps and sends their progress, (done, total) each, and the model, which it writes to WORK/capture."""
    log = os.open(work / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(log, stream)
    import pycolmap

    def progress(done: int, total: int) -> None:
        sender.send((done, total))  # fails once the parent has ended, which ends this process

    pycolmap.logging.minloglevel = pycolmap.logging.WARNING.value
    pycolmap.set_random_seed(0)
    _extract(pycolmap, job, work, progress)
    _match(pycolmap, work, progress)
    best, models = _map(pycolmap, len(job.names), work, progress)
    if best is None:
        sender.send(_Model(set(), models))
        return
    registered = {image.name for image in best.images.values() if image.has_pose}
    for image in best.images.values():
        image.name = os.fsencode(job.names[image.name])  # a file name need not be UTF-8
    shutil.rmtree(work / "capture", ignore_errors=True)
    (work / "capture" / "sparse" / "0").mkdir(parents=True)
    best.write_binary(work / "capture" / "sparse" / "0")
    sender.send(_Model(registered, models, best.num_points3D(), best.compute_mean_reprojection_error()))


def _extract(colmap: Any, job: _Job, work: Path, progress: Progress) -> None:
    """Detects the features of the photographs that have none in the database."""
    database, total = work / "database.db", len(job.names)
    options, reader = colmap.FeatureExtractionOptions(), colmap.ImageReaderOptions()
    options.num_threads, done = cores(), 0
    with colmap.Database.open(database) as opened:
        imported = opened.num_images() == total
    if not imported:
        for file in work.glob("database.db*"):
            file.unlink()
        colmap.Database.open(database).close()
        for group, _, is_panorama in job.lenses:
            reader.camera_model = PANORAMA if is_panorama else "OPENCV"
            colmap.import_images(database, work / "links", colmap.CameraMode.SINGLE, image_names=group, options=reader)
    for group, (width, height), is_panorama in job.lenses:
        views = 3 if is_panorama else 1  # of 120 degrees side by side, with as many pixels a degree
        options.max_image_size, options.sift.max_num_features = 1600 * views, 8192 if is_panorama else 4096
        # Features of small photographs are also detected at twice the size: 5,400 instead of 880 on photographs of 799
        # x 532, where 880 gave wrong poses.
        options.sift.first_octave = -1 if max(width, height) <= 1000 * views else 0
        reader.camera_mask_path = work / "mask.png" if is_panorama else ""
        if is_panorama:
            mask = np.full((height, width), 255, np.uint8)
            mask[height - round(height * OPERATOR_DEGREES / 180) :] = 0
            write_image(reader.camera_mask_path, mask)
        for start in range(0, len(group), 4):  # COLMAP skips those that have features
            part = {"image_names": group[start : start + 4], "reader_options": reader, "extraction_options": options}
            colmap.extract_features(database, work / "links", device=colmap.Device.cpu, **part)
            done += len(part["image_names"])
            progress(done, total)


def _match(colmap: Any, work: Path, progress: Progress) -> None:
    """Matches and verifies image pairs."""
    database = work / "database.db"
    with colmap.Database.open(database) as opened:
        names = {image.image_id: image.name for image in opened.read_all_images()}
        if len(names) <= ALL_PAIRS:
            pairs = colmap.ExhaustivePairGenerator(colmap.ExhaustivePairingOptions(), opened).all_pairs()
        else:
            sequential = colmap.SequentialPairingOptions(overlap=NEIGHBOURS, quadratic_overlap=False)
            pairs = colmap.SequentialPairGenerator(sequential, opened).all_pairs()
            pairs += _pairs_that_look_alike(colmap, opened, list(names), work / "vocabulary.bin")
    pairs = sorted({(min(pair), max(pair)) for pair in pairs if pair[0] != pair[1]})
    options, verification = colmap.FeatureMatchingOptions(), colmap.TwoViewGeometryOptions()
    options.use_gpu, options.num_threads, verification.ransac.random_seed = False, cores(), 0
    listed = colmap.ImportedPairingOptions()
    listed.match_list_path = work / "pairs.txt"
    for start in range(0, len(pairs), 50):  # COLMAP skips those that are matched
        chunk = pairs[start : start + 50]
        write_text(listed.match_list_path, "".join(f"{names[a]} {names[b]}\n" for a, b in chunk))
        colmap.match_image_pairs(database, options, listed, verification, device=colmap.Device.cpu)
        progress(start + len(chunk), len(pairs))


def _pairs_that_look_alike(colmap: Any, opened: Any, images: list[int], file: Path) -> list[tuple[int, int]]:
    """Pairs each image with the ALIKE most similar ones, by a vocabulary built of a sample of their own descriptors."""
    if not file.exists():
        draw = np.random.default_rng(0)
        samples = []
        for image in images:
            descriptors = opened.read_descriptors(image).to_float()
            samples.append(draw.permutation(descriptors.data)[:1000])
        sample = np.concatenate(samples)
        words = min(len(sample) // 40, 4096)  # k-means asks for 40 descriptors a word
        if words < ALIKE:
            return []
        index, options = colmap.VisualIndex.create(sample.shape[1], 64), colmap.VisualIndex.BuildOptions()
        options.num_visual_words, options.num_iterations, options.num_rounds = words, 10, 1
        options.num_threads = cores()
        index.build(options, colmap.FeatureDescriptorsFloat(descriptors.type, sample))
        partial = file.with_suffix(".partial")
        index.write(partial)
        partial.replace(file)
    retrieval = colmap.VocabTreePairingOptions(num_images=ALIKE + 1, vocab_tree_path=file)
    return colmap.VocabTreePairGenerator(retrieval, opened).all_pairs()


def _map(colmap: Any, total: int, work: Path, progress: Progress) -> tuple[Any, int]:
    """Returns the best model, or None, and the number of models of its mapper.

    Focal lengths that EXIF does not name are estimated from the pairs first (Sweeney et al., "Optimizing the viewing
    graph for structure-from-motion", ICCV 2015).
    """
    database, links = work / "database.db", work / "links"
    with colmap.Database.open(database) as opened:
        if opened.num_verified_image_pairs() == 0:
            return None, 0
    colmap.calibrate_view_graph(database, colmap.ViewGraphCalibrationOptions(random_seed=0))
    progress(0, total)
    options = colmap.GlobalPipelineOptions(random_seed=0, min_model_size=MIN_PHOTOS, num_threads=cores())
    options.mapper.random_seed = 0
    (work / "global").mkdir(exist_ok=True)
    models = list(colmap.global_mapping(database, links, work / "global", options).values())
    candidates = [(_largest(models), len(models))]
    if not _is_consistent(colmap, database, candidates[0][0], total):
        count = 1

        def registered() -> None:
            nonlocal count
            count = min(count + 1, total)
            progress(count, total)

        options = colmap.IncrementalPipelineOptions(random_seed=0, min_model_size=MIN_PHOTOS, num_threads=cores())
        (work / "incremental").mkdir(exist_ok=True)
        callbacks = {"initial_image_pair_callback": registered, "next_image_callback": registered}
        models = colmap.incremental_mapping(database, links, work / "incremental", options, **callbacks).values()
        candidates.append((_largest(list(models)), len(models)))
    progress(total, total)
    candidates = [(model, count) for model, count in candidates if model is not None]
    explained = [sum(_explained_matches(colmap, database, model)[0].values()) for model, _ in candidates]
    return candidates[int(np.argmax(explained))] if candidates else (None, 0)


def _largest(models: list[Any]) -> Any:
    """Returns the model with the most photographs, or None."""
    return max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def _is_consistent(colmap: Any, database: Path, model: Any, total: int) -> bool:
    """Whether a model has all photographs, and each where most of its matches became common points."""
    if model is None or model.num_reg_images() < total:
        return False
    explained, matches = _explained_matches(colmap, database, model)
    shares = [explained[image] / count for image, count in matches.items()]
    median = float(np.median(shares))
    return median >= MIN_EXPLAINED and min(shares) >= MIN_EXPLAINED_OF_MEDIAN * median


def _explained_matches(colmap: Any, database: Path, model: Any) -> tuple[dict[int, int], dict[int, int]]:
    """Counts by image the verified matches whose two features became one point, and all its verified matches."""
    points = {}
    for number, image in model.images.items():
        if image.has_pose:
            points[number] = np.array([p.point3D_id if p.has_point3D() else -1 for p in image.points2D], np.int64)
    explained: collections.Counter[int] = collections.Counter()
    matches: collections.Counter[int] = collections.Counter()
    with colmap.Database.open(database) as opened:
        pairs, geometries = opened.read_two_view_geometries()
    for pair, geometry in zip(pairs, geometries):
        a, b = colmap.pair_id_to_image_pair(pair)
        if a in points and b in points and len(geometry.inlier_matches):
            of_a, of_b = points[a][geometry.inlier_matches[:, 0]], points[b][geometry.inlier_matches[:, 1]]
            for image in (a, b):
                matches[image] += len(of_a)
                explained[image] += int(((of_a == of_b) & (of_a >= 0)).sum())
    return explained, matches
