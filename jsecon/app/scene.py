"""A scene that is asked: `open_scene(path)`, and `Scene.ask`, the one way from a question to its answer.

Every door (command line, viewer, server, tools of language models, notebook, evaluation) opens a `Scene`, gives it a
`Query`, and shows the `Answer`. The rules are here and below: how a text is read, shades of colours, refusal, outliers,
frames and units.
"""

import contextlib
import dataclasses
import functools
import re
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool, UInt8

from jsecon.app import pictures
from jsecon.app.catalogue import Catalogue, objects
from jsecon.app.comparison import LONG_SIDE, Changes, apply_changes, new_things, splat_capture
from jsecon.app.object_index import ObjectIndex, choose_shades
from jsecon.app.opening import locate_field
from jsecon.app.records import Answer, At, Box, Mask, Query, Question, Region, gaussian_rows
from jsecon.change.detect import object_changes
from jsecon.change.history import add_unseen, events, field_as_of
from jsecon.errors import InputError
from jsecon.field.columns import is_mapped
from jsecon.field.field import check_field, load_field
from jsecon.field.ledger import Ledger, add_views, forget_views, sum_ledger
from jsecon.field.ledger_file import load_ledger, save_with_ledger
from jsecon.field.membership import SHARE_THRESHOLD
from jsecon.field.tree import PARTS, cut_field
from jsecon.files import FIELD_FILE, parse_json
from jsecon.fit.resize import resize_capture, shrink_cameras
from jsecon.networks.hub import parse_model
from jsecon.paper.queries import CODE_THRESHOLD
from jsecon.pipeline.options import Options, read_date
from jsecon.pipeline.progress import Console
from jsecon.pipeline.sources import forget_warnings, locate_sources, move_hints
from jsecon.process import MEMORY, memory_budget
from jsecon.query.answer import answer_question, trim
from jsecon.query.expressions import is_expression, parse_query, split_part
from jsecon.query.object_shapes import ObjectShapes
from jsecon.query.parts import match_parts
from jsecon.query.pointing import OUTSIDE, UNKNOWN, frame_index, lift, region_at
from jsecon.query.rules import FOUND, ONE_REGION, STATES, UNSURE, QueryRules
from jsecon.query.selection_masks import selection_mask
from jsecon.read.captures.frames import move_capture, take_frames
from jsecon.read.splats.point_clouds import load_point_cloud, save_point_cloud
from jsecon.read.splats.writing import save_gaussians
from jsecon.splat.points import nearest_gaussians
from jsecon.splat.transform import transform_gaussians
from jsecon.splat.visible import points_in_view
from jsecon.types import Capture, Gaussians, LanguageField, Selection
from jsecon.views.frame import field_up

_CHANGE_QUESTIONS = {"what moved": "moved", "what is gone": "gone", "what is new": "new", "what changed": ""}
"""Question -> kind of event that it asks for, "" for any."""
CACHED_BYTES = 1 << 28
"""bytes of the answers that a scene keeps, of five bytes a Gaussian each"""


def open_scene(
    path: str | Path,
    *,
    embedder: Any = None,
    console: Console | None = None,
) -> "Scene":
    """Opens a field, or a file of Gaussians, to be asked.

    Args:
      path: A field file, a folder with field.safetensors, or a file of Gaussians without photographs (.ply, .spz ...),
        of which a field is made once, in NAME_field beside NAME.ply.
      embedder: What embeds texts: an embedder, or a folder or a name of a CLIP model that is on this machine, which is
        opened when a text needs it. None takes the model that the field was made with.
      console: Receives the progress where a field is made.

    Returns:
      The scene. A field of more than the memory budget (JSECON_MEMORY, GiB) stays on disk and is read in blocks, with
      the same answers.

    Raises:
      InputError: The file cannot be read, or no model has such a name.
    """
    console = console or Console()
    named, file, splat = locate_field(Path(path))
    model = embedder if isinstance(embedder, str | Path) else None
    if splat is not None:
        file = _field_of_gaussians(Options(splat, embedder=model), file.parent, console)
    large = file.is_file() and file.stat().st_size > memory_budget()
    with console.progress("field"):
        if large:
            check_field(file)
        field = load_field(file, mapped=large)
    if model is not None:
        parse_model(model, "embedder")
    has_ledger = "ledger" in parse_json(field.provenance)
    ledger = functools.partial(load_ledger, file, field) if has_ledger else None
    return Scene(field, embedder, name=named.name, ledger=ledger)


def open_prepared(name: str, path: Path, embedder: str | Path | None, console: Console) -> "Scene":
    """Opens a field under a name, and prepares it for questions.

    `embedder` is the CLIP model of the field (`open_scene`); None takes the one that its run used.
    """
    scene = open_scene(path, embedder=embedder, console=console)
    scene.name = name
    _ = scene.embedder
    scene.prepare()
    return scene


def _field_of_gaussians(options: Options, folder: Path, console: Console) -> Path:
    """Finds the field of a file of Gaussians in a folder, or makes it there.

    Without a model of its own the options take that of the field which is there.
    """
    from jsecon.pipeline import run as pipeline  # late: questions to a field need none of it

    with console.progress("plan"):
        if options.embedder is None and (folder / FIELD_FILE).is_file():
            with contextlib.suppress(InputError):  # damaged: it is made anew
                sources = locate_sources(load_field(folder / FIELD_FILE, mapped=True))
                options = dataclasses.replace(options, embedder=sources.model or sources.address)
        path = pipeline.current_field(options, folder)
    if path is None:
        pipeline.run(options, folder, console=console)
        path = folder / FIELD_FILE
        console.print_line(f"field   {path}")
    return path


class Scene:
    """A field that is asked. Its methods may be called from several threads: one computes at a time.

    It keeps the last answers and what it has measured of objects, within fixed bounds. Answers hold a boolean and a
    number for each Gaussian of the field.

    Args:
      field: The field. One from `load_field(mapped=True)` is read in blocks; boxes, masks and relations need all of it
        in memory.
      embedder: Its embedder, or as for `open_scene`.
      name: Name of the scene.
      ledger: Returns the ledger of the field's views, which `add` and `forget` need; None if the field has none.

    Attributes:
      field: The field.
      name: Name of the scene.
    """

    def __init__(
        self,
        field: LanguageField,
        embedder: Any = None,
        *,
        name: str = "scene",
        ledger: Callable[[], Ledger] | None = None,
    ):
        self.field = field
        self._read_ledger = ledger
        self.name = name
        self._embedder = embedder
        self._lock = threading.RLock()
        count = max(CACHED_BYTES // (5 * max(field.gaussians.count, 1)), 1)
        self._answers = functools.lru_cache(count)(lambda query: self._answer(query))
        self._cameras = jax.tree.map(np.asarray, field.cameras)  # whose items need no compilation
        self._photo = functools.cache(lambda t: pictures.render_picture(self._gaussians, self._cameras[t]))

    def __str__(self) -> str:
        """Its name and its size, in a line."""
        return f"{self.name}: {self.field.gaussians.count} Gaussians, {self.field.regions.count} regions"

    @functools.cached_property
    def embedder(self) -> Any:
        """The embedder of texts, which is opened when it is first used.

        Raises:
          InputError: The model is not on this machine, or is another one.
        """
        from jsecon.pipeline.model_loading import field_embedder  # late: questions without a text need none of it

        with self._lock:
            is_open = hasattr(self._embedder, "embed_text")
            return self._embedder if is_open else field_embedder(self.field, self._embedder)

    @functools.cached_property
    def _index(self) -> ObjectIndex:
        """The objects that phrases name, with their shapes."""
        self._require_memory("a relation, an order or a number")
        if self.field.regions.count == 0:
            raise InputError("field", "it has no regions, so no objects", remedy="Make it again with other --masks.")
        return ObjectIndex(self.field, self.embedder, self._catalogue, field_up(self.field))

    @functools.cached_property
    def ledger(self) -> Ledger:
        """What each view contributes to the field (`jsecon.field.ledger`).

        Raises:
          InputError: The field has none, or its file is damaged.
        """
        self._require_memory("a change of its views")
        if self._read_ledger is None:
            remedy = "Make the field again with jsecon run, without --no-ledger; the finished stages are reused."
            raise InputError(f"scene {self.name}", "the field has no ledger of its views", remedy=remedy)
        return self._read_ledger()

    def add(
        self,
        photos: str | Path | Capture,
        *,
        poses: str | Path | None = None,
        masks: str | Path | None = None,
        refused: list[InputError] | None = None,
        console: Console | None = None,
    ) -> "Scene":
        """Adds photographs of the same scene: its regions grow by what they show.

        Old poses and Gaussians stay as they are. Where frames have depth, what they show and no Gaussian explains gets
        Gaussians and a region of its own. To the last bit, the votes are those of one run with all frames and
        the same regions, in whatever order they are added. Photographs that the field has by their names are left out.

        Args:
          photos: A capture, its folder, a folder of photographs, or one photograph. Photographs without poses get them
            from what the field's own frames show.
          poses: A capture's file or folder with the poses of the photographs, in the world of the field's capture.
          masks: Folder of masks of the new frames, as `jsecon run --proposals` takes them. A mask that matches no
            region opens one. None finds masks by colour and texture.
          refused: Receives the error of each photograph that cannot be read or placed, and the others are added. None
            raises the first.
          console: Receives the progress.

        Returns:
          The new scene.

        Raises:
          InputError: The field has no ledger, or no photograph can be added.
        """
        from jsecon.pipeline.new_frames import make_views, read_frames  # late: questions to a field need none of it

        console, errors = console or Console(), [] if refused is None else refused

        def refuse(error: InputError) -> None:
            if refused is None:
                raise error
            refused.append(error)

        with self._lock, ThreadPoolExecutor(1) as pool:
            ledger, embedder = self.ledger, self.embedder
            summed = pool.submit(sum_ledger, self.field, ledger)  # meanwhile frames are read and labelled
            pose_file, mask_folder = (None if path is None else Path(path) for path in (poses, masks))
            photos = photos if isinstance(photos, Capture) else Path(photos)
            with console.progress("frames") as progress:
                capture = read_frames(self.field, ledger, photos, pose_file, refuse, progress)
            with console.progress("views") as progress:
                views = make_views(self.field, capture, embedder, mask_folder, refuse, progress, {})
                if not views:
                    raise errors.pop()
                capture = take_frames(capture, [t for t, name in enumerate(capture.names) if name in views])
                field, things = self._add_new_things(capture)
                if things:
                    views = make_views(field, capture, embedder, mask_folder, refuse, progress, things)
            with console.progress("votes"):
                ledger = Ledger(ledger.num_regions, ledger.views) if things else summed.result()
                field, grown = add_views(field, ledger, views)
                return self._with(field, lambda: grown)

    def _add_new_things(self, capture: Capture) -> tuple[LanguageField, dict[str, np.ndarray]]:
        """Gives Gaussians to what frames with depth show and no Gaussian explains; returns its masks by their names."""
        if capture.depths is None or not capture.depths.any():
            return self.field, {}
        shown = take_frames(capture, np.flatnonzero(capture.depths.any(axis=(1, 2))).tolist())
        things, masks = new_things(self._compare(shown), capture.cameras)
        field = add_unseen(self.field, things) if things else self.field
        return field, {shown.names[t]: mask for t, mask in masks.items()}

    def forget(self, frames: Sequence[int | str]) -> "Scene":
        """Takes frames out: votes, embeddings, poses and pictures, as if they had never been there.

        The Gaussians stay, which a run may have fitted to these frames too.

        Args:
          frames: Their names or indices.

        Returns:
          The new scene.

        Raises:
          InputError: The field has no such frame, no ledger, or no frame would be left.
        """
        with self._lock:
            names = {self.field.names[frame_index(self.field, frame)] for frame in frames}
            if names >= {*self.ledger.views}:
                raise InputError("frames", "no frame with evidence would be left", remedy="Delete the field instead.")
            field = forget_warnings(self.field, sorted(names))
            field, ledger = forget_views(field, self.ledger, names)
            return self._with(field, lambda: ledger)

    def _with(self, field: LanguageField, ledger: Callable[[], Ledger] | None) -> "Scene":
        """A scene of another state of the field, with what returns its ledger."""
        scene = Scene(field, self._embedder, name=self.name, ledger=ledger)
        if "embedder" in vars(self):
            scene.embedder = self.embedder
        return scene

    def save(self, path: str | Path) -> None:
        """Writes the field, and its ledger beside it if it has one, atomically.

        Args:
          path: Path of the file, such as field.safetensors.

        Raises:
          InputError: The folder cannot be written.
        """
        path = Path(path)
        ledger = None if self._read_ledger is None else self.ledger
        save_with_ledger(path, move_hints(self.field, path.parent), ledger)

    def _require_memory(self, what: str) -> None:
        """Raises InputError if the field is mapped, which `what` needs in memory."""
        if is_mapped(self.field):
            size = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(self.field)) / 2**30
            budget = memory_budget() / 2**30
            problem = f"the field has {size:.3g} GiB, memory has room for {budget:.3g}, and {what} needs all of it"
            remedy = f"Ask a plain text or a pixel, or set {MEMORY}={1.1 * size:.2g} (GiB) to read it whole."
            raise InputError(f"scene {self.name}", problem, remedy=remedy)

    def ask(self, question: Question | Query, **options: Any) -> Answer:
        """Answers a question.

        Args:
          question: A text, `At`, `Box`, `Mask` or `Region`; or a `Query`, which has its options.
          **options: Options of `Query` for a question: by, threshold, min_rank, outliers, frame.

        Returns:
          The answer. Its mask is empty if the scene does not have what the question names; `reason` and `str` say why.

        Raises:
          InputError: The question cannot be answered: the embedder has no words for a text, the field has no such frame
            or pixel, no region lies at a pixel, or an option is out of its range.
        """
        query = question if isinstance(question, Query) else Query(question, **options)
        with self._lock:
            # The arrays of a mask may change.
            return (self._answer if isinstance(query.question, Mask) else self._answers)(query)

    def ask_all(self, questions: Sequence[Question | Query]) -> list[Answer | InputError]:
        """Answers several questions.

        Args:
          questions: As for `ask`.

        Returns:
          For each question in turn its answer, or the error that it ends in.
        """
        results: list[Answer | InputError] = []
        for question in questions:
            try:
                results.append(self.ask(question))
            except InputError as error:
                results.append(error)
        return results

    def _answer(self, query: Query) -> Answer:
        """Answers a query that is not among the last ones."""
        question = query.question
        if query.by == "code" and self.field.codes is None:
            raise InputError("", "This field has no codes", remedy="Run jsecon run --paper, or ask by votes.")
        if isinstance(question, str):
            plain = question.lower().strip(" ?").replace("what's", "what is").replace("what has", "what")
            if (kind := _CHANGE_QUESTIONS.get(plain)) is not None:
                return self._answer_history(query, kind)
            is_related = is_expression(question) or self._names_part(question)
            answer = None if is_related else self._answer_text(query)
            if answer is None or (
                answer.state != STATES[FOUND] and query.by == "votes" and self._names_any_part(question, answer)
            ):
                answer = self.relate(question, frame=query.frame)
            return answer
        if isinstance(question, Box | Mask):
            return self._answer_outline(query, question)
        if isinstance(question, Region):
            return self._answer_region(query, question.id)
        index = frame_index(self.field, question.frame)
        name = self.field.names[index]
        cameras = self.field.cameras
        x, y = pixel_of(question, cameras.width, cameras.height)
        region = region_at(self.field, index, x, y)
        if region < 0:
            problem = f"no region lies under column {x}, row {y} of {cameras.width}x{cameras.height} px"
            remedy = "Choose another pixel or frame: report.html of the run shows the regions."
            raise InputError(f"frame {name}", problem, remedy=remedy)
        query = dataclasses.replace(query, question=At(name, x, y))
        return self._answer_region(query, region)

    def _names_part(self, text: str) -> bool:
        """Whether a text such as "the lid of the pot" names a part that a thing of the scene has."""
        named = split_part(text) if self.field.part_regions is not None and not is_mapped(self.field) else None
        return named is not None and len(self._index.find_parts(*named)) > 0

    def _names_any_part(self, text: str, answer: Answer) -> bool:
        """Whether a text that no region matches for certain, such as "lid", names parts of things."""
        texts, excluded = parse_query(text)
        if self.field.part_regions is None or is_mapped(self.field) or len(texts) > 1 or excluded:
            return False
        unsure = int(answer.selection.region) if answer.state == STATES[UNSURE] else -1
        embedded = np.asarray(self.embedder.embed_text(texts))
        return len(match_parts(self.field, embedded, QueryRules(), unless=unsure)[0]) > 0

    def _answer_text(self, query: Query) -> Answer:
        """Selects the Gaussians that a text names."""
        field, embedder = self.field, self.embedder
        included, excluded = parse_query(str(query))
        rules = self._rules(query, QueryRules())
        included = choose_shades(field, embedder, included, rules, every=bool(excluded))
        excluded = choose_shades(field, embedder, excluded, rules, every=True)
        if query.by == "code" and len(included + excluded) > 1:
            problem = "codes cannot select several regions"
            raise InputError(f"query {str(query)!r}", problem, remedy="Ask by votes, or for one thing.")
        embedded = embedder.embed_text(included + excluded)
        texts, without = embedded[: len(included)], embedded[len(included) :]
        found = answer_question(field, texts, rules, excluded=without, outliers=query.outliers)
        warnings = [] if found[1].any() else _run_warnings(field)
        reason = " ".join(["no region matches it; the run warned:", *warnings]).rstrip(".") if warnings else ""
        return self._finish(query, found, reason)

    def _answer_region(self, query: Query, region: int) -> Answer:
        """Selects the Gaussians of a region."""
        found = answer_question(self.field, region, self._rules(query, ONE_REGION), outliers=query.outliers)
        last = (self.field.regions.count if self.field.tree is None else len(self.field.tree)) - 1
        reason = "" if 0 <= region <= last else f"there is no region {region}: the regions are 0 to {last}"
        return self._finish(query, found, reason)

    def at_level(self, level: int) -> "Scene":
        """The scene with another cut of its tree as its objects. Regions keep their ids, those of nodes.

        Args:
          level: -1 for the parts that masks show alone, 0 for the objects, 1 and more for unions, so many joins up.

        Raises:
          InputError: There is no such level, the field has no tree, or it is too large for memory.
        """
        if level == 0:
            return self
        self._require_memory("another level")
        if level < PARTS:
            raise InputError("level", f"{level}", "-1 for parts, 0 for objects, or more", "Give another level.")
        if self.field.tree is None:
            problem = "the field has no tree of objects: its masks were tracked, or given and none lies in another"
            raise InputError("level", problem, remedy="Leave it out, or make the field with masks that jsecon finds.")
        return self._with(cut_field(self.field, level), None)

    def _rules(self, query: Query, rules: QueryRules) -> QueryRules:
        """Rules with the options of a query."""
        options: dict[str, Any] = {"min_rank": query.min_rank}
        if query.by == "code":
            options["code_threshold"] = CODE_THRESHOLD if query.threshold is None else query.threshold
        elif query.threshold is not None:
            options["min_share"] = query.threshold
        return dataclasses.replace(rules, **options)

    def _answer_outline(self, query: Query, question: Box | Mask) -> Answer:
        """Selects the object that a box or masks outline in frames."""
        self._require_memory("an outline")
        frames = question.frames if isinstance(question, Mask) else {question.frame: self._box_mask(question)}
        masks_by_frame = {frame_index(self.field, frame): mask for frame, mask in frames.items()}
        if len(masks_by_frame) < len(frames):
            raise InputError("mask", "a frame has two masks", remedy="Give one mask of an object in each frame.")
        masks = np.stack([np.asarray(mask, int) for mask in masks_by_frame.values()])
        threshold = SHARE_THRESHOLD if query.threshold is None else query.threshold
        selection = lift(self.field, masks, list(masks_by_frame), threshold=threshold)
        mask, _ = trim(self.field, selection, "supported" if query.outliers else None)
        return self._finish(query, (selection, mask, 1))

    def _box_mask(self, box: Box) -> np.ndarray:
        """Makes the mask of a box: OUTSIDE, and UNKNOWN from its first column and row to its last ones."""
        mask = np.full((self.field.cameras.height, self.field.cameras.width), OUTSIDE)
        mask[max(box.y0, 0) : max(box.y1 + 1, 0), max(box.x0, 0) : max(box.x1 + 1, 0)] = UNKNOWN
        if not mask.any():
            problem = f"{box.x0} {box.y0} {box.x1} {box.y1} has no pixels of a frame of {mask.shape[1]}x{mask.shape[0]}"
            remedy = "Give its left, upper, right and lower end, in the frames as the run used them."
            raise InputError("box", problem, remedy=remedy)
        return mask

    def _finish(self, query: Query, found: tuple[Selection, np.ndarray, int], reason: str = "") -> Answer:
        """The answer of a query whose Gaussians were selected and trimmed: these, and the number of objects."""
        selection, mask, count = found
        return Answer(
            query,
            "outline" if isinstance(query.question, Box | Mask) else query.by,
            mask,
            jax.tree.map(np.asarray, selection),
            self.field,
            count=count if mask.any() else 0,
            reason=reason,
        )

    def relate(self, text: str, *, frame: int | str | None = None) -> Answer:
        """Finds the objects that a text names and tells apart, such as "the red mug left of the bottle".

        `ask` does so for texts with a word of place, an order or a number; this reads any text so, as "red mugs".

        Args:
          text: The text.
          frame: Frame from which left, right, front and behind are seen (`Query.frame`).

        Returns:
          The answer, with 0, 1 or several `objects`.

        Raises:
          InputError: The text is not understood, the field has no such frame or no regions, or the embedder has no
            words for an object.
        """
        with self._lock:
            return self._index.answer(Query(text, frame=frame))

    def locate(self, text: str, *, frame: int | str | None = None) -> Answer:
        """Finds the one thing that a text names.

        In five made-up rooms it finds all 60 things that have a unique name; the centre of their `place` is off by 5 mm
        in the median (experiments/catalogue.py).

        Args:
          text: For example "orange ball" or "the red mug left of the bottle".
          frame: As for `relate`.

        Returns:
          The answer, of one object.

        Raises:
          InputError: The text names no object, or several.
        """
        answer = self.ask(text, frame=frame)
        if answer.count != 1:
            problem = f"it names {answer.count} objects" + (f": {answer.reason}" if answer.reason else "")
            remedy = answer.question or "Say which, as in 'the red mug left of the green bottle', or point at it."
            raise InputError(f"query {text!r}", problem, "one object", remedy[:1].upper() + remedy[1:])
        return answer

    def measure(
        self, a: str | Sequence[float | int], b: str | Sequence[float | int], *, frame: int | str | None = None
    ) -> dict[str, Any]:
        """Measures the distance between two objects or points.

        Args:
          a: Text that names the first object, or a point (x, y, z) of the capture's world.
          b: The same of the second.
          frame: As for `relate`.

        Returns:
          Plain values: "a" and "b"; "surfaces", the smallest distance between Gaussians of the two; "centers", that of
          the middles of their boxes; "angle", degrees of the second above the horizontal as seen from the first; the
          "unit" of the lengths (metres if the capture's format guarantees them or the run was given a scale, else
          capture units); and "up", what the up axis was taken from.

        Raises:
          InputError: As for `relate`; or a text names no object, or several.
        """
        with self._lock:
            ends = [self.locate(end, frame=frame) if isinstance(end, str) else end for end in (a, b)]
            return {"a": a, "b": b} | self._index.distances(ends)

    def scaled(self, a: str | Sequence[float | int], b: str | Sequence[float | int], metres: float | int) -> "Scene":
        """Gives the scene its scale by one known length, which replaces any other.

        Args:
          a: Text or point, as for `measure`.
          b: The same of the other end.
          metres: Length between the middles of the two, m, above 0.

        Returns:
          A scene whose field knows its `metres_per_unit`; `save` keeps it.

        Raises:
          InputError: As for `measure`; or the two are one place.
        """
        length = self.measure(a, b)["centers"] / (self.field.metres_per_unit or 1.0)  # capture units
        if not length > 0 or not metres > 0:
            problem = f"{metres:g} m are not the length between {a} and {b}, which are {length:g} units apart"
            raise InputError("scale", problem, remedy="Give two places and the length between them.")
        return self._with(dataclasses.replace(self.field, metres_per_unit=metres / length), self._read_ledger)

    @functools.cached_property
    def _catalogue(self) -> Catalogue:
        """All objects, named by an embedder that was given, else by the words that the field holds."""
        return objects(self.field, None, self._embedder and self.embedder)

    def objects(self, vocabulary: Sequence[str] | None = None) -> Catalogue:
        """Lists the objects of the scene with names, boxes and sizes.

        Args:
          vocabulary: Names to choose from; None takes those of the embedder.

        Returns:
          The catalogue (`jsecon.objects`).

        Raises:
          InputError: The vocabulary is empty, or the embedder cannot represent a name.
        """
        with self._lock:
            if vocabulary is None:
                return self._catalogue
            return objects(self.field, vocabulary, self.embedder)

    def changes(self, later: "Capture | Scene") -> Changes:
        """Finds what became of each object, and what is new, in new photographs.

        An object is the same, moved, gone, of another look, unsure or not seen. Light, shadows and exposure are no
        changes.

        Args:
          later: The photographs, with poses in the world of the field's own capture, and with depth if there is any; or
            a later scene of the same place, of the same world.

        Returns:
          The changes; `records()` has plain values.

        Raises:
          InputError: The photographs show another place, or the field is too large for memory.
        """
        with self._lock:
            self._require_memory("a comparison")
            if isinstance(later, Scene):
                later = splat_capture(self.field, later.field.gaussians, np.asarray(later.field.source_from_scene))
            return self._compare(later)

    def _compare(self, capture: Capture) -> Changes:
        """Compares the objects with a capture whose poses are in the world of the field's own capture."""
        field, listed = self.field, self._catalogue
        capture = move_capture(capture, field.source_from_scene)
        capture = resize_capture(capture, shrink_cameras(capture.cameras, LONG_SIDE))
        things = np.append(~listed.surroundings, False)
        labels = np.where(things[listed.labels], listed.labels, -1)
        up = np.array(field_up(field).axis)
        frames, depths = np.asarray(capture.frames), None if capture.depths is None else np.asarray(capture.depths)
        found = object_changes(field.gaussians, labels, frames, capture.cameras, depths, up=up)
        return Changes(field, listed, capture, tuple(found))

    def update(self, changes: Capture | Changes, *, date: str) -> "Scene":
        """Applies what changed: objects move or are gone, and new ones come. Ids of regions stay.

        The field's history keeps what it was (`as_of`). What is unsure stays as it is.

        Args:
          changes: What `changes` returned, or the photographs.
          date: Date of the photographs, as in "2026-11-28", or a date and a time.

        Returns:
          The new scene.

        Raises:
          InputError: As for `changes`; or the date is none, or is before that of the last update.
        """
        date = read_date(date)
        with self._lock:
            changes = self.changes(changes) if isinstance(changes, Capture) else changes
            field, ledger = apply_changes(changes, self.embedder, date, lambda: self.ledger)
            return self._with(field, self._read_ledger if ledger is None else lambda: ledger)

    def as_of(self, date: str) -> "Scene":
        """The scene as it was at the end of a date, such as "2026-11-01".

        Raises:
          InputError: The date is none.
        """
        field = field_as_of(self.field, read_date(date, "--as-of"))
        return self._with(field, self._read_ledger if field is self.field else None)

    def _answer_history(self, query: Query, kind: str) -> Answer:
        """Selects what moved, is gone or is new."""
        found = [e for e in zip(self.field.history, events(self.field)) if kind in ("", e[1]["kind"])]
        mask = np.zeros(self.field.gaussians.count, bool)
        for event, _ in found:
            mask[np.asarray(event.rows)] = True
        words = [f"{record['name'] or 'something'} {record['kind']} {record['date']}" for _, record in found]
        reason = "; ".join(words) or "the history of the field has no such change (jsecon update)"
        region, score = np.asarray(-1, np.int32), np.asarray(float(len(found) > 0), np.float32)
        selection = Selection(mask, mask.astype(np.float32), region, score)
        return Answer(query, "history", mask, selection, self.field, count=len(found), reason=reason)

    def prepare(self) -> None:
        """Compiles what questions need, so that the first question is as fast as later ones."""
        with self._lock, contextlib.suppress(InputError):  # an embedder without words: each text then has this error
            self.mask(self.ask("red"), 0)
            self.relate("red")

    def best_frames(self, answer: Answer, count: int) -> list[int]:
        """Chooses the frames that show an answer best.

        Args:
          answer: The answer.
          count: Maximum number of frames.

        Returns:
          Indices, best first: by the pixels of its region, or without a region by the centres in view.
        """
        region = int(answer.selection.region)
        if 0 <= region < self.field.regions.count:
            visible = np.asarray(self.field.regions.pixel_counts)[region]
        else:
            means = np.asarray(self.field.gaussians.means)[answer.rows]
            visible = points_in_view(self._cameras, means).sum(1)
        order = np.argsort(-visible, kind="stable")[:count]
        return [int(t) for t in order if visible[t] > 0]

    def mask(self, selected: Answer | Bool[np.ndarray, " n"], frame: int | str) -> Bool[np.ndarray, "h w"]:
        """Renders an answer alone in a frame.

        Args:
          selected: The answer, or a mask of Gaussians.
          frame: Name or index of the frame.

        Returns:
          (H, W) bool, where its alpha is above 0.7.

        Raises:
          InputError: There is no such frame.
        """
        with self._lock:
            gaussians, mask = self._gaussians, selected.mask if isinstance(selected, Answer) else selected
            if is_mapped(gaussians):
                chosen = np.flatnonzero(mask)
                rows = np.zeros(_padded(len(chosen), self.field.gaussians.count), np.int64)
                rows[: len(chosen)] = chosen
                mask = np.arange(len(rows)) < len(chosen)
                gaussians = jax.device_put(gaussian_rows(gaussians, rows))
            return np.asarray(selection_mask(gaussians, self._cameras[frame_index(self.field, frame)], mask))

    @functools.cached_property
    def _gaussians(self) -> Gaussians:
        """The Gaussians, on jax's device unless they are mapped."""
        return self.field.gaussians if is_mapped(self.field.gaussians) else jax.device_put(self.field.gaussians)

    def render(
        self, frame: int | str, selected: Answer | Bool[np.ndarray, " n"] | None = None
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Renders a frame of the scene.

        Args:
          frame: Name or index of the frame.
          selected: Answer, or mask of Gaussians, that is lit up in it.

        Returns:
          (H, W, 3) RGB.

        Raises:
          InputError: There is no such frame.
        """
        with self._lock:
            photo = self._photo(frame_index(self.field, frame))
            return photo if selected is None else pictures.selection_overlay(photo, self.mask(selected, frame))

    def export(
        self,
        file: str | Path,
        selected: Answer | Bool[np.ndarray, " n"] | None = None,
        *,
        labels: Catalogue | None = None,
        points: bool = False,
    ) -> None:
        """Writes Gaussians in the world of the capture's files, in blocks, so that a mapped field need not fit memory.

        Args:
          file: The .ply or .usda to write; with points .las, .laz or .ply.
          selected: Answer or mask whose Gaussians are written; None writes the whole scene.
          labels: Catalogue of the scene. A .ply and points get the object_id and the class_id of each Gaussian,
            a .usda a prim for each object.
          points: Whether to write, in place of Gaussians, the points of the file that the field was made of or that its
            fit started from: those whose nearest Gaussian is near and written, with its labels; all without `selected`.

        Raises:
          InputError: The file cannot be written, or the field has no points.
        """
        field, ids, names, world = self.field, {}, (), self.field.source_from_scene
        gaussians = field.gaussians
        if labels is not None:
            classes = np.append(labels.class_ids, np.int32(-1))
            names, ids = labels.names.tolist(), {"object_id": labels.labels, "class_id": classes[labels.labels]}
        mask = selected.mask if isinstance(selected, Answer) else selected
        if points:
            cloud = locate_sources(field).points
            if cloud is None:
                problem, remedy = "the field has no file of points that is still there", "Make it of one, or keep that."
                raise InputError(f"scene {self.name}", problem, remedy=remedy)
            placed = transform_gaussians(dataclasses.replace(gaussians, sh=None), world)
            near = nearest_gaussians(load_point_cloud(cloud).points, placed)
            rows = np.arange(len(near)) if mask is None else np.flatnonzero(np.append(mask, False)[near])
            ids = {name: np.append(column, np.int32(-1))[near[rows]] for name, column in ids.items()}
            return save_point_cloud(Path(file), cloud, rows, ids)
        if mask is not None:
            rows = np.flatnonzero(mask)
            gaussians, ids = gaussian_rows(gaussians, rows), {name: column[rows] for name, column in ids.items()}
        save_gaussians(file, gaussians, similarity=world, ids=ids, names=names)


def locate(
    field: LanguageField,
    text: str,
    embedder: Any = None,
    *,
    frame: int | str | None = None,
) -> ObjectShapes:
    """Locates the one thing that a text names.

    Args:
      field: The field.
      text: For example "orange ball" or "the red mug left of the bottle".
      embedder: Embedder of the field; None opens it.
      frame: As for `Scene.relate`.

    Returns:
      Its boxes and points, in the capture's world and its unit.

    Raises:
      InputError: As for `Scene.locate`.
    """
    return Scene(field, embedder).locate(text, frame=frame).place


def _run_warnings(field: LanguageField) -> list[str]:
    """What the run that made a field warned of: the first sentence of each warning."""
    try:
        warnings = parse_json(field.provenance or "{}").get("warnings", [])
        return [re.split(r"(?<=\.) ", warning)[0] for warning in warnings]
    except (ValueError, TypeError, AttributeError):  # not written by jsecon
        return []


def pixel_of(point: At, width: int, height: int) -> tuple[int, int]:
    """Column and row of a point in frames of a size, px."""
    is_share = 0 <= point.x <= 1 and 0 <= point.y <= 1 and any(number % 1 for number in (point.x, point.y))
    if not is_share:
        return int(point.x), int(point.y)
    return min(int(point.x * width), width - 1), min(int(point.y * height), height - 1)


def _padded(count: int, most: int) -> int:
    """A power of two of at least `count` and 4,096 rows, so that few sizes are compiled; at most `most`."""
    return min(max(1 << max(count - 1, 0).bit_length(), 1 << 12), most)
