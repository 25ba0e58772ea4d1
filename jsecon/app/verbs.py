"""The verbs of the command line: what each does and takes, in the words of its help."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from jsecon.pipeline.options import Folder, Options, SceneOptions

By = Literal["votes", "silhouette", "strict_silhouette", "lenient_silhouette", "code", "one_step", "canonical"]


@dataclasses.dataclass(frozen=True)
class Output:
    """What every verb takes."""

    json: bool = False
    """print one JSON object on standard output at the end, {"error": ...} with message, name, found, expected and
    remedy where it went wrong; all else goes to standard error"""
    debug: bool = False
    """the whole trace of an error"""


@dataclasses.dataclass(frozen=True)
class Demo:
    """make a room, build its field, query it and write a report

    Makes a procedural room of named, coloured objects, writes it to disk as an ordinary COLMAP capture, and runs on it
    what `jsecon run`, `query` and `eval` run: nothing of the ground truth but frames, poses and sparse points is used.
    Ends with report.html, metrics.json, field.npz, a short film and a .ply for each query. One to two minutes on two
    cores. On a capture of your own, use `jsecon run` and `jsecon query`.
    """

    seed: int = 0
    """which room"""
    out: Path = Path("jsecon-demo")
    """folder for all of it"""
    steps: int = 550
    """number of optimisation steps of the photometric fit"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run(Options):
    """build the language field of a capture

    From frames to a language field: poses (found where the capture has none), Gaussians (fitted, or given as a .ply),
    masklets (found in the frames and brought together, or given as masks), one embedding per region, codes distilled
    into the Gaussians. Prints its stages first. Writes OUT/field.npz, OUT/report.html, OUT/metrics.json and OUT/cache.
    """

    out: Path
    """folder for the field, the report and the cache"""
    dry_run: bool = False
    """only list the stages that would run, and check their inputs; writes nothing"""
    processes: Annotated[int, {"metavar": "N", "least": 1}] = 1
    """that share the masklets, the embeddings, the votes and the held-out frames, to the same field: all on this
    machine, each with its part of the cores, or one a machine, see --coordinator"""
    coordinator: Annotated[str | None, {"metavar": "HOST:PORT"}] = None
    """several machines: where process 0 listens, an address of its own machine; every machine runs this command, with
    the same capture and models at the same paths, and its own name must stand for an address that the others reach"""
    process: Annotated[int | None, {"metavar": "I"}] = None
    """which of the processes this is, 0 to N - 1; process 0 writes OUT"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fit(SceneOptions):
    """fit Gaussians to a capture, and no more

    From posed frames to a scene of 3D Gaussians in the capture's own world, as a .ply (INRIA's layout; SuperSplat opens
    it), .spz or .glb, with PSNR and SSIM of the frames held out. What it keeps lies in a folder of the
    same name without the ending, from which it goes on when it was stopped, and `jsecon run` into that folder too.
    """

    out: Annotated[Path, {"metavar": "FILE"}]
    """the .ply, .spz or .glb to write"""
    dry_run: bool = False
    """only list the stages that would run, and check their inputs; writes nothing"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Asking:
    """What `jsecon query`, `view` and `eval` take."""

    field: Annotated[Path, {"positional": True}]
    """field.npz of a run"""
    embedder: Folder = None
    """the CLIP model folder that the field was made with (default: where the run had it)"""
    template: Annotated[list[str] | None, {"action": "append", "metavar": "PHRASE"}] = None
    """CLIP: a phrase for the text, such as "a photo of a {}."; several are averaged (default: the bare text)"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Query(Asking):
    """the Gaussians that a text names, that lie under a pixel, or that somebody outlined

    For each text, pixel or outline, writes to OUT: the selected Gaussians as a .ply (INRIA's layout, in the capture's
    own world; SuperSplat opens it), a .json with count, score, region, centroid and bounding box, masks of the frames
    that show it best, and answers.html with the pictures. A field of more than half of the free memory, or than
    JSECON_MEMORY (GiB) of the environment, stays on disk and is read in blocks, to the same answers: texts and --at, by
    votes or code.
    """

    texts: Annotated[list[str], {"positional": True, "nargs": "*", "metavar": "TEXT"}]
    """what to find: "red mug" "dark green bottle" "mug or bowl but not handle" ..."""
    at: Annotated[list[list[str]] | None, {"action": "append", "nargs": 3, "metavar": ("FRAME", "X", "Y")}] = None
    """what lies under pixel (column X, row Y) of a frame, in the frames as the run used them; needs no text. A frame is
    named by its name, the end of it, or its place, #10"""
    mask: Annotated[list[list[str]] | None, {"action": "append", "nargs": "+", "metavar": ("FRAME", "PNG")}] = None
    """what a mask outlines in a frame, or one thing in several: FRAME PNG FRAME PNG; black is outside"""
    box: Annotated[
        list[list[str]] | None, {"action": "append", "nargs": 5, "metavar": ("FRAME", "X0", "Y0", "X1", "Y1")}
    ] = None
    """what lies in a box of a frame: the regions that are seen there by more than half"""
    out: Path
    """folder for the answers"""
    by: By = "votes"
    """votes, code: text -> the region that answers it -> the Gaussians with its votes, or with its code; silhouette: by
    votes, then each taken or left by what the outline of all gains in the views: strict where it is opaque, lenient
    where it is there at all; one_step, canonical: each Gaussian's code against the text"""
    threshold: float | None = None
    """on what --by measures (default: 0.5 votes and silhouettes, 0.9 code, 0.8 one_step, too high
    for CLIP, 0.5 canonical)"""
    all: bool = False
    """every region that answers a text, such as all the chairs, not only the best: those whose similarity has come 0.75
    of the way from the middle region's to the best one's (by votes or a silhouette)"""
    even: bool = False
    """even the votes out over each Gaussian's ten neighbours before they are cut: sharper rims where masks are noisy"""
    keep_outliers: bool = False
    """keep the Gaussians that stand apart from the rest of an answer. Without it DBSCAN drops them, and clusters with
    less than a tenth of the largest one's weight in the views; the .json counts them"""
    phrases: Folder = None
    """a SAM 3 model folder (.onnx): each text is put to it as a phrase, in some frames of the capture; selected is what
    lies in its masks in most of the frames that see it, all things of the kind"""
    images: Folder = None
    """with --phrases: the capture, whose frames are asked (default: where the run had it)"""
    looks: Annotated[int, {"metavar": "N"}] = 8
    """with --phrases: in how many frames, evenly spaced; a frame takes long"""
    views: Annotated[int, {"metavar": "N"}] = 3
    """masks to write per query"""
    format: Literal["ply", "spz", "glb"] = "ply"
    """of the selected Gaussians; glb is glTF with Khronos' KHR_gaussian_splatting, y up, and holds their codes and
    regions too"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Export:
    """write the whole scene of a field for other programs

    As .ply (INRIA's layout), .spz or .glb, in the capture's own world. The .glb is glTF with Khronos'
    KHR_gaussian_splatting, y up, and holds each Gaussian's code (_CODE_0, _CODE_1 ...) and region (_REGION) too.
    """

    field: Annotated[Path, {"positional": True}]
    """field.npz of a run"""
    out: Annotated[Path, {"metavar": "FILE"}]
    """the .ply, .spz or .glb to write"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class View(Asking):
    """look at a field and ask it, in a browser

    A page on loopback: the Gaussians, to turn and come near; each text lights up what it selects, a click what lies
    there; thresholds, other candidates, frames, files of the selection, a link that keeps what is seen (extra viewer).
    With --export instead one HTML file that opens by double click, without a server.
    """

    texts: Annotated[list[str], {"positional": True, "nargs": "*", "metavar": "TEXT"}]
    """what to light up"""
    export: Annotated[Path | None, {"metavar": "HTML"}] = None
    """write a page, and open none"""
    link: Annotated[str, {"metavar": "LINE"}] = ""
    """what the viewer gave as its link, to have it back"""
    host: str = "127.0.0.1"
    """address to listen on; beyond loopback a token is required"""
    port: Annotated[int, {"least": 0}] = 8766
    """port to listen on"""
    token: str = ""
    """what the page's address must carry, as the printed one does (default: JSECON_TOKEN of the environment)"""
    allow_host: Annotated[list[str] | None, {"action": "append", "metavar": "NAME"}] = None
    """a name by which browsers reach this server beside localhost and --host, such as that of a proxy"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eval(Asking):
    """measure a field against labels

    Point-level rendered protocol on LERF-style labels (one .json per frame): the selected Gaussians alone are rendered,
    alpha > 0.7, against each labelled mask; a missing prediction counts as 0. Prints mIoU, mAcc@0.25 and localisation
    accuracy of each kind of query, and writes OUT/evaluation.json with every pair.
    """

    labels: Annotated[Path, {"metavar": "DIR"}]
    """folder of LERF label files (frame.json)"""
    out: Path | None = None
    """folder for evaluation.json (default: the field's)"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Serve:
    """answer over HTTP, loaded once

    POST /query {"text": "red mug"} as application/json and more, see GET / and /openapi.json. On loopback unless --host
    names another address, which needs a token (extra serve).
    """

    fields: Annotated[list[Path], {"positional": True, "nargs": "+", "metavar": "FIELD"}]
    """field.npz of runs; each is known by its folder's name"""
    host: str = "127.0.0.1"
    """address to listen on"""
    port: Annotated[int, {"least": 0}] = 8765
    """port to listen on"""
    token: str = ""
    """what clients must send as "Authorization: Bearer TOKEN" (default: the environment's JSECON_TOKEN, else none)"""
    allow_host: Annotated[list[str] | None, {"action": "append", "metavar": "NAME"}] = None
    """a name by which clients reach this server beside localhost and --host, such as that of a proxy; without a token a
    request by any other name is refused"""
    embedder: Folder = None
    """the CLIP model folder that the fields were made with (default: where the runs had it)"""


@dataclasses.dataclass(frozen=True)
class Models:
    """look into a folder of models

    check DIR: what models a folder holds, each graph's inputs and outputs, what it can be used for, what is missing,
    and where such exports are published. Exit code 2 where nothing in it can be used.
    """

    action: Annotated[str, {"positional": True, "choices": ("check",), "metavar": "check"}]
    """tell what a model folder holds"""
    folder: Annotated[Path, {"positional": True, "metavar": "DIR"}]
    """folder with .onnx files"""


@dataclasses.dataclass(frozen=True)
class Doctor:
    """look whether this machine has what runs need

    A line each: the backend's numbers, jax and its devices, cores, memory, disk, where compiled programs are kept,
    models, and each extra with the command that installs it. Exit code 2 where something is wrong that every run needs.
    """

    models: Folder = None
    """folder with .onnx files, or of such folders, to look into"""


@dataclasses.dataclass(frozen=True)
class Completion:
    """a script that completes jsecon's words in a shell

    bash: jsecon completion bash > ~/.local/share/bash-completion/completions/jsecon. zsh: > a folder of $fpath, as
    _jsecon. fish: > ~/.config/fish/completions/jsecon.fish. Then open a new shell.
    """

    shell: Annotated[Literal["bash", "zsh", "fish"], {"positional": True, "metavar": "SHELL"}]
    """bash, zsh or fish"""
