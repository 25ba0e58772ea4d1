"""The verbs of the command line: options and help text of each.

tyro makes the command line from these classes: the first line of a docstring is the verb's short description, its
attributes are the help texts of the options.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeAlias, TypeVar, dataclass_transform

from tyro.conf import Positional, UseAppendAction, arg

from jsecon.networks.hub import Role
from jsecon.pipeline.options import (
    BareOptions,
    FieldOptions,
    InputOptions,
    MaskOptions,
    ModelOption,
    ModelOptions,
    Option,
    Options,
    Range,
    SceneOptions,
)

T = TypeVar("T")
Repeated: TypeAlias = Option[UseAppendAction[list[T]]]
"""option that can be repeated"""
By = Literal["votes", "code"]
_TwoPoints: TypeAlias = tuple[float, float, float, float, float, float]
_TwoPointsAndLength: TypeAlias = tuple[float, float, float, float, float, float, float]
_PLACE = Range(-1e9, 1e9)

VerbResult: TypeAlias = dict[str, Any]
"""Files and figures of a verb, which --json prints: plain values, paths and records; under "errors" the InputErrors of
what it could not do besides, under "then" what to do after that is printed."""


@dataclass_transform(frozen_default=True, kw_only_default=True)
@dataclasses.dataclass(frozen=True, kw_only=True)
class Verb:
    """Base of the verbs, whose classes become frozen dataclasses.

    Its help shows the examples, command lines; `extra` is the extra of jsecon that it needs.

    Attributes:
      json: Prints one JSON object on standard output at the end, with {"error": ...} of message, where, problem,
        expected and remedy if the verb fails. Everything else goes to standard error.
    """

    examples: ClassVar[tuple[str, ...]]
    extra: ClassVar[str] = ""
    json: Option[bool] = False

    def __init_subclass__(cls) -> None:
        """Makes a dataclass of the class of a verb."""
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)


class Demo(Verb):
    """Copies the capture of a made-up room, builds its field, queries it and writes a report.

    The room has named, coloured objects. It is an ordinary COLMAP capture, of which `jsecon run`, `query` and `eval`
    use only frames, poses and sparse points. The demo writes report.html, metrics.json, field.safetensors and a .ply
    for each query, in one to two minutes on two cores. For other captures, use `jsecon run` and `jsecon query`.

    Attributes:
      out: Output folder.
    """

    examples = ("jsecon demo", "jsecon demo --out room")

    out: Option[Path] = Path("jsecon-demo")


class _PipelineVerb(Verb):
    """Options of the verbs that compute stages.

    Attributes:
      dry_run: Only lists the stages that would run, and checks their inputs. It writes no file.
    """

    dry_run: Option[bool] = False
    scene: SceneOptions = dataclasses.field(default_factory=SceneOptions)

    @property
    def options(self) -> Options:
        """Options of the run without the groups."""
        values = dict(vars(self))
        for group in filter(dataclasses.is_dataclass, vars(self).values()):
            values |= vars(group)
        names = {field.name for field in dataclasses.fields(Options)}
        return Options(**{name: value for name, value in values.items() if name in names})


class Run(_PipelineVerb, InputOptions):
    """Builds the language field of a capture.

    Its stages estimate poses that the capture lacks, fit Gaussians or read them, find objects or read their masks,
    embed each region, and add up its votes on the Gaussians. It lists the stages first, and writes field.safetensors,
    field.evidence, report.html, metrics.json and cache to the output folder.

    Attributes:
      out: Output folder.
      distributed: Shares the masks, the embeddings, the votes and the held-out frames with the other processes that
        mpirun or srun starts. The field stays the same.
    """

    examples = (
        "jsecon run my_capture --out my_field",
        "jsecon run my_capture --out my_field --gaussians point_cloud.ply",
        "jsecon run my_capture --out my_field --models auto",
        "jsecon run scene.ply --out my_field --up 0 0 1",
    )

    out: Option[Path]
    distributed: Option[bool] = False
    bare: BareOptions = dataclasses.field(default_factory=BareOptions)
    masks: MaskOptions = dataclasses.field(default_factory=MaskOptions)
    models: ModelOptions = dataclasses.field(default_factory=ModelOptions)
    field: FieldOptions = dataclasses.field(default_factory=FieldOptions)


class Fit(_PipelineVerb):
    """Fits Gaussians to a capture, and no more.

    Writes a scene of 3D Gaussians in the capture's world, with PSNR and SSIM of the held-out frames. A folder
    named like the file without its ending keeps what is computed: a stopped fit resumes from it, and `jsecon run`
    into that folder goes on from it too.

    Attributes:
      capture: The same captures as for jsecon run.
      out: The .ply (INRIA's layout, which SuperSplat opens) or .usda to write.
    """

    examples = ("jsecon fit my_capture --out scene.ply --minutes 5",)

    capture: Positional[Path]
    out: Option[Path]


class _FieldVerb(Verb):
    """Options of the verbs that read a field and understand texts.

    Attributes:
      field: Path of field.safetensors, the folder that jsecon run wrote it to, or a file of Gaussians or
        points without photographs, of which the field is made once, to NAME_field beside NAME.ply.
      embedder: The CLIP model that the field was made with: a name, hub:owner/name, or a folder. By default it is the
        one that the run used.
    """

    field: Positional[Path]
    embedder: ModelOption = None


class _LevelVerb(_FieldVerb):
    """Options of the verbs that list or select objects.

    Attributes:
      level: What counts as one object in the field's tree: -1 parts, 0 objects, 1 and more what belongs together, so
        many joins up.
    """

    level: Annotated[Option[int], Range(-1, 100)] = 0


class Query(_LevelVerb):
    """Selects the Gaussians of a text or of a pixel.

    For each text or pixel, writes to the output folder: the selected Gaussians as a .ply (INRIA's layout, in
    the capture's world; SuperSplat opens it), a .json with count, score, region, centroid and bounding box, masks
    of the frames that show it best, and answers.html with the pictures. They replace the files of an earlier answer to
    the same text. A field of more than half of the free memory,
    or than JSECON_MEMORY (GiB) of the environment, stays on disk and is read in blocks, with the same answers: texts
    and --at.

    Attributes:
      texts: What to find, such as "red mug" "dark green bottle" "mug or bowl but not handle", or with a relation, an
        order or a number: "the red mug left of the bottle", "the second largest box", "what is on the table". Quotes
        in a text make its words an object as they stand.
      from_frame: Frame from which left, right, front and behind are seen. By default it is the mean camera, or the
        frame that shows most objects where the cameras look in all directions.
      at: Selects what lies under the pixel in column X and row Y of a frame, in the frames as the run used them, or at
        shares of their width and height such as 0.25 0.5. A frame is named by its name, or its place such as #10.
      out: Output folder.
      by: How a matching region selects Gaussians: by its votes, or by its code in a field of jsecon run --paper.
      threshold: Smallest similarity of a selected Gaussian. By default it is 0.5 for votes and 0.9 for code.
      min_rank: Share of unrelated words that must be less similar to the scene than a text, else the text is absent.
        With 0 every text is answered. By default it is found, unsure or absent by how its match compares with theirs.
      keep_outliers: Keeps the Gaussians that stand apart from the rest of an answer. By default DBSCAN drops them, and
        clusters with less than a tenth of the largest one's weight in the views. The .json counts them.
      views: Number of masks to write for each query. 0 leaves out answers.html too: nothing is rendered, and the first
        query on a machine takes a third of its time.
      as_of: Asks a field of jsecon update as it was at the end of a date, such as 2026-11-01.
    """

    examples = (
        'jsecon query my_field/field.safetensors "red mug" "dark green bottle" --out answers',
        "jsecon query my_field/field.safetensors --at frame_00012 310 145 --out answers",
        'jsecon query scene.ply "red mug" --out answers',
    )

    texts: Positional[list[str]]
    at: Annotated[Repeated[tuple[str, float, float]], arg(metavar="FRAME X Y"), Range(0, 100_000)] = dataclasses.field(
        default_factory=list
    )
    out: Option[Path] = Path("answers")
    from_frame: Annotated[Option[str | None], arg(name="from", metavar="FRAME")] = None
    by: Option[By] = "votes"
    threshold: Annotated[Option[float | None], Range(-1, 1)] = None
    min_rank: Annotated[Option[float | None], Range(0, 1)] = None
    keep_outliers: Option[bool] = False
    views: Annotated[Option[int], Range(0, 1000)] = 3
    as_of: Option[str | None] = None


class Objects(_LevelVerb):
    """Lists the objects of a field with names, boxes and sizes.

    Prints a line for each. With --out it also writes objects.json and catalogue.html, a page with pictures of each.
    Regions that show one object are joined, and parts are listed under their whole. Boxes stand upright, in the
    capture's world. An object's id is that of jsecon export.

    Attributes:
      out: Output folder.
    """

    examples = (
        "jsecon objects my_field/field.safetensors",
        "jsecon objects my_field/field.safetensors --out catalogue",
    )

    out: Option[Path | None] = None


class Add(_FieldVerb):
    """Adds photographs of the same scene to a field, without running it anew.

    Regions of the field grow by what the photographs show. The Gaussians, and the poses of the field's frames, stay as
    they are. Photographs without poses are placed by the pictures of the field's own frames; one that shares too little
    with them is refused. Frames that the field has by their names are left out.

    Attributes:
      photos: A capture of any format of jsecon run, a folder of photographs, or one photograph.
      poses: Capture, COLMAP model or transforms.json with the poses of the photographs, in the world of the field's
        capture.
      masks: Folder of masks of the new frames, as for jsecon run --proposals. A mask that matches no region opens one.
        Without it, jsecon finds masks by colour and texture.
      out: Folder for the new field. Without it, the field is replaced.
    """

    examples = (
        "jsecon add my_field new_photographs --out my_field_2",
        "jsecon add my_field room/IMG_0412.jpg",
    )

    photos: Positional[Path]
    poses: Option[Path | None] = None
    masks: Option[Path | None] = None
    out: Option[Path | None] = None


class Forget(Verb):
    """Removes frames from a field, as if they had never been there.

    No file of the field keeps a byte of them: votes, embeddings, poses, names and pictures. Without --out, the cache,
    the poses and the report of the run, which show them, are removed from the field's folder too. The Gaussians stay,
    which the run may have fitted to these frames.

    Attributes:
      field: Path of field.safetensors, or the folder that jsecon run wrote it to.
      frames: Names of the frames.
      out: Folder for the new field. Without it, the field is replaced.
    """

    examples = ("jsecon forget my_field --frames IMG_0412 IMG_0413",)

    field: Positional[Path]
    frames: Option[list[str]]
    out: Option[Path | None] = None


class Export(_LevelVerb):
    """Writes the scene of a field, or objects of it, for other programs.

    The scene is in the capture's world. A .ply has object_id, the id of each Gaussian's object in jsecon objects or -1,
    and class_id, which objects of one name share. A .usda is a text of OpenUSD with a prim for each object. The file
    labels.json beside each export has id, name, probability, colour, box, parent and frames of each object.

    Attributes:
      out: The .ply (INRIA's layout), .usda, .las or .laz to write.
      objects: Folder to write a .ply of each object to, named by its id and name. They replace those of an earlier
        export to that folder.
      shapes: File for the solids of whole objects but surroundings, in metres if their length is known: .json (box,
        convex hull, and the best of box, cylinder and sphere), .obj (hulls), .xml (MuJoCo's MJCF) or .yaml (MoveIt's
        CollisionObjects). A folder gets all four.
      points: Writes, to a .las, .laz or .ply, the points of the file that the field was made of or that its fit started
        from, with object_id and class_id of the nearest Gaussian, in their order. A .las or .laz always has points.
      only: Exports only the Gaussians that jsecon query selects for this text.
      without: Exports all other Gaussians than those. Both exports together hold each Gaussian of the scene once.
    """

    examples = (
        "jsecon export my_field/field.safetensors --out scene.ply",
        "jsecon export my_field/field.safetensors --objects objects",
        "jsecon export my_field/field.safetensors --shapes robot",
        "jsecon export scan_field/field.safetensors --out labelled.laz",
        'jsecon export my_field/field.safetensors --without "red mug" --out rest.ply',
    )

    out: Option[Path | None] = None
    objects: Option[Path | None] = None
    shapes: Option[Path | None] = None
    points: Option[bool] = False
    only: Option[str | None] = None
    without: Option[str | None] = None


class _ChangesVerb(_FieldVerb):
    """Options of the verbs that find changes.

    Attributes:
      photos: A capture with poses in the world of the field's own capture, with or without depth, in any format of
        jsecon run; photographs without poses, which are placed as by jsecon add; or, for jsecon changes, another file
        of Gaussians of the same place.
    """

    photos: Positional[Path]


class Changes(_ChangesVerb):
    """Finds what moved, is gone or is new in new photographs of a field's place.

    Writes changes.json, changes.csv, and changes.html with pictures before and after and a plan from above. Each object
    is the same, moved, gone, of another look, unsure, or not seen, with a probability, and the frames that prove it.
    Light, shadows and exposure are no changes. Walls, floors and the like do not change.

    Attributes:
      out: Output folder.
      transform: Text file with a 4x4 similarity from the world of that file of Gaussians to the field's capture.
    """

    examples = ("jsecon changes my_field/field.safetensors new_capture --out changes",)

    out: Option[Path] = Path("changes")
    transform: Option[Path | None] = None


class Update(_ChangesVerb):
    """Applies what changed in new photographs to a field, whose history keeps what was.

    An object that moved keeps its region and goes to its new place. One that is gone is transparent and answers no
    query. A new one gets Gaussians and the next region. `jsecon query --as-of DATE` asks the field as it was, and "what
    moved", "what is gone" and "what is new" ask for its changes. What is unsure stays as it was. The files of jsecon
    changes are written too.

    Attributes:
      out: Folder for the new field. Without it, the field is replaced.
      date: Date of the photographs, such as 2026-11-28. By default it is that of their EXIF data, else today.
    """

    examples = ("jsecon update my_field new_capture --out my_field_2 --date 2026-11-28",)

    out: Option[Path | None] = None
    date: Option[str | None] = None


class Clean(Verb):
    """Removes what hangs in a scene and shows nothing of it.

    Views that cover the scene tell four kinds: unseen Gaussians, faint ones, which weigh less than 1/255 in each pixel,
    and floaters and haze, which hang in front of surfaces in most of their pixels. The views are at the poses that lie
    near the scene, as for jsecon run, or are planned. Prints how many of each kind went, and how the pictures changed.

    Attributes:
      scene: A file of Gaussians (.ply, .spz, .sog, .splat).
      out: The .ply or .usda to write.
      cameras: Poses to look from instead: a COLMAP model, a transforms.json, or INRIA's cameras.json.
      views: Number of views to plan, in place of poses near the scene.
      capture: Capture of the scene, as for jsecon run. Its poses are the views, and its photographs give the PSNR
        before and after.
      keep_objects: Keeps every Gaussian of an object of the scene's field, which is made first where it has none.
    """

    examples = (
        "jsecon clean scene.ply --out clean.ply",
        "jsecon clean scene.ply --out clean.ply --capture my_capture",
    )

    scene: Positional[Path]
    out: Option[Path]
    cameras: Option[Path | None] = None
    views: Annotated[Option[int | None], Range(2, 1000)] = None
    capture: Option[Path | None] = None
    keep_objects: Option[bool] = False


class Measure(_FieldVerb):
    """Measures lengths between things or points, and gives a field its scale by one known length.

    Lengths are those between the middles, and between the surfaces. They are in metres if the capture's format has them
    or a length is known, else in units of the capture. The field keeps its scale, and every answer uses it ("within 1 m
    of the table").

    Attributes:
      texts: Things to measure between, each with each other.
      points: Two points of the capture's world to measure between.
      scale: Two things, and the length between their middles in metres.
      scale_points: Two points of the capture's world, and the length between them in metres.
      out: CSV file of the lengths.
    """

    examples = (
        'jsecon measure my_field "red mug" "white plate" --out lengths.csv',
        'jsecon measure my_field --scale "white plate" "dark green bottle" 0.82',
    )

    texts: Positional[list[str]]
    points: Annotated[Repeated[_TwoPoints], arg(metavar="X Y Z X Y Z"), _PLACE] = dataclasses.field(
        default_factory=list
    )
    scale: Annotated[Option[tuple[str, str, float] | None], arg(metavar="A B METRES"), Range(0, 1e9, above=True)] = None
    scale_points: Annotated[Option[_TwoPointsAndLength | None], arg(metavar="X Y Z X Y Z METRES"), _PLACE] = None
    out: Option[Path | None] = None


class View(_FieldVerb):
    """Shows a field in a browser and answers queries there.

    A page on this machine shows the Gaussians (extra serve). A text highlights what it selects, a click what lies
    there. The page has a threshold, the frames, and a file of the selection. With --export, jsecon writes one HTML file
    instead, which opens by double click, without a server, with the answers to TEXTS.

    Attributes:
      texts: Texts to highlight.
      export: HTML file to write instead of opening a page.
      port: Port of the page.
    """

    examples = (
        'jsecon view my_field/field.safetensors "red mug"',
        "jsecon view my_field/field.safetensors --export page.html",
    )

    texts: Positional[list[str]]
    export: Option[Path | None] = None
    port: Annotated[Option[int], Range(0, 65535)] = 8766


class Eval(_FieldVerb):
    """Measures a field against labels.

    The protocol is point-level and rendered, on LERF-style labels (one .json per frame): the selected Gaussians alone
    are rendered, and alpha > 0.7 is compared with each labelled mask. A missing prediction counts as 0. Prints mIoU,
    mAcc@0.25 and localisation accuracy, and writes evaluation.json with every pair.

    Attributes:
      labels: Folder of LERF label files (frame.json).
      out: Folder for evaluation.json. By default it is the field's folder.
    """

    examples = ("jsecon eval my_field/field.safetensors --labels my_capture/label --out evaluation",)

    labels: Option[Path]
    out: Option[Path | None] = None


class _FieldsVerb(Verb):
    """Options of the verbs that keep fields open.

    Attributes:
      fields: Paths of field.safetensors files, their folders, or files of Gaussians without photographs, of which the
        fields are made once. Each field is known by the name of its folder or scene.
      embedder: The CLIP model that the fields were made with: a name, hub:owner/name, or a folder. By default it is the
        one that the runs used.
    """

    fields: Positional[list[Path]]
    embedder: ModelOption = None


class Serve(_FieldsVerb):
    """Answers queries over HTTP, with fields that are loaded once.

    Answers POST /query {"text": "red mug"} with Content-Type application/json, and more: see /openapi.json (extra
    serve).

    Attributes:
      host: Address to listen on. Beyond loopback a token is required.
      port: Port to listen on.
      token: Token that requests must carry behind "Bearer" in the header Authorization. By default it is JSECON_TOKEN
        of the environment, and without that no token is needed. Without a token, requests under other names than those
        of this machine are refused: set one behind a proxy.
    """

    examples = ("jsecon serve my_field/field.safetensors other_field/field.safetensors",)
    extra = "serve"

    host: Option[str] = "127.0.0.1"
    port: Annotated[Option[int], Range(0, 65535)] = 8765
    token: Option[str] = ""


class Mcp(_FieldsVerb):
    """Offers fields to language models as tools.

    A server of the Model Context Protocol on standard input and output (extra mcp), which a model's program starts. It
    answers at once and opens the fields in the background; a call waits for its field. Its tools find, count, locate,
    measure and render things and only read. The models of texts must be on this machine.
    """

    examples = ("jsecon mcp my_field/field.safetensors",)
    extra = "mcp"


class Models(Verb):
    """Lists and fetches models.

    With list, prints the models that have a name, their sizes and licences, and which of them are on this machine. With
    get, fetches models from huggingface.co into its cache and compares each file with its hash; HF_HOME, HF_ENDPOINT,
    HF_TOKEN and HF_HUB_OFFLINE work as usual. `hf cache rm` deletes models from the cache.

    Attributes:
      action: What to do.
      names: Names, or addresses (hub:owner/name or hub:owner/name@revision). auto stands for the models of
        `jsecon run --models auto`.
      role: What the models are for: for get an address needs it, and a name has by default every role of its models.
    """

    examples = ("jsecon models list", "jsecon models get auto")

    action: Positional[Literal["list", "get"]]
    names: Positional[list[str]] = dataclasses.field(default_factory=list)
    role: Option[Role | None] = None


class Doctor(Verb):
    """Checks whether this machine has what runs need.

    It prints a line each about Python, the packages, and jax with its devices and numbers. The exit code is 2 if a
    check fails.

    Attributes:
      field: A field to describe instead: what its ledger holds of each kind, and how large that is.
    """

    examples = ("jsecon doctor", "jsecon doctor my_field")

    field: Positional[Path | None] = None


VERBS: dict[type[Verb], str] = {
    Demo: "app.running:_demo",
    Run: "app.running:_run",
    Fit: "app.running:_fit",
    Query: "app.querying:_query",
    Objects: "app.exports:_objects",
    Add: "app.living:_add",
    Forget: "app.living:_forget",
    Export: "app.exports:_export",
    Changes: "app.living:_changes",
    Update: "app.living:_update",
    Clean: "app.cleaning:_clean",
    Measure: "app.querying:_measure",
    View: "app.viewer.view:_view",
    Eval: "app.evaluation:_eval",
    Serve: "app.server:_serve",
    Mcp: "app.mcp_server:_mcp",
    Models: "app.models:_models",
    Doctor: "app.doctor:_doctor",
}
"""A verb's options -> the module and the function that do its work: of (verb, `Console`), to a `VerbResult`. The
function raises InputError for bad input."""
