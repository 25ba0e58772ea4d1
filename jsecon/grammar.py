"""The grammar of the command line: its verbs, their options, and what each says of itself."""

import argparse
import textwrap
from pathlib import Path

import jsecon
from jsecon.options import Options

EPILOG = """
examples
  jsecon demo                                           a made-up room, from frames to answers and a report
  jsecon run my_capture --out my_field                  COLMAP or nerfstudio folder -> my_field/field.npz
  jsecon run my_capture --out my_field --gaussians point_cloud.ply
                                                        the same on a scene that is already splatted
  jsecon query my_field/field.npz "red mug" "dark green bottle" --out answers
  jsecon query my_field/field.npz --at frame_00012 310 145 --out answers
  jsecon eval my_field/field.npz --labels my_capture/label --out evaluation
  jsecon run my_capture --out my_field --segmenter sam --embedder clip
                                                        with SAM and CLIP from model folders
  jsecon models check clip                              what a model folder holds and lacks

A run that is stopped goes on where it stopped when the same command is given again.
"""


def parser() -> argparse.ArgumentParser:
    """The whole grammar of the command line."""
    top = argparse.ArgumentParser(
        prog="jsecon",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EPILOG,
        description="Find things in 3D Gaussian scenes by text, at the level of points, on a plain CPU.",
    )
    top.add_argument("--version", action="version", version=f"jsecon {jsecon.__version__}")
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")
    for add in (_demo, _run, _query, _eval, _models):
        add(verbs)
    return top


def _verb(verbs, name: str, short: str, long: str) -> argparse.ArgumentParser:
    return verbs.add_parser(
        name,
        help=short,
        description=textwrap.dedent(long).strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _demo(verbs) -> None:
    verb = _verb(
        verbs,
        "demo",
        "make a room, build its field, query it and write a report",
        """
        Makes a procedural room of named, coloured objects, writes it to disk as an ordinary COLMAP capture, and runs on
        it what `jsecon run`, `query` and `eval` run: nothing of the ground truth but frames, poses and sparse points is
        used. Ends with report.html, metrics.json, field.npz and a .ply for each query. One to two minutes on two cores.
        """,
    )
    verb.add_argument("--seed", type=int, default=0, help="which room (default 0)")
    verb.add_argument(
        "--out", type=Path, default=Path("jsecon-demo"), help="folder for all of it (default ./jsecon-demo)"
    )
    verb.add_argument("--steps", type=int, default=None, help="of the photometric fit (default 700)")


def _run(verbs) -> None:
    verb = _verb(
        verbs,
        "run",
        "build the language field of a capture",
        """
        From posed frames to a language field: Gaussians (fitted, or given as a .ply), masklets (found in the frames and
        brought together, or given as masks), one embedding a region, codes distilled into the Gaussians. Prints its
        plan first. Writes OUT/field.npz, OUT/report.html, OUT/metrics.json and OUT/cache.
        """,
    )
    verb.add_argument(
        "capture",
        type=Path,
        metavar="CAPTURE",
        help="folder with images/ and sparse/0 (COLMAP), or with transforms.json (nerfstudio, instant-ngp)",
    )
    verb.add_argument("--out", type=Path, required=True, help="folder for the field, the report and the cache")
    for add in (_scene_options, _mask_options, _model_options, _field_options):
        add(verb)


def _scene_options(run: argparse.ArgumentParser) -> None:
    group = run.add_argument_group("frames and scene")
    group.add_argument(
        "--gaussians",
        type=Path,
        metavar="PLY",
        help="a scene of 3D Gaussians in the capture's world; without it, Gaussians are fitted to the frames",
    )
    group.add_argument(
        "--downscale",
        type=float,
        metavar="K",
        help=f"make frames K times smaller (default: so that the longer side is at most {Options.long_side} px)",
    )
    group.add_argument("--frames", type=int, metavar="N", help="use at most N frames, evenly spaced (default: all)")
    group.add_argument(
        "--holdout",
        type=int,
        default=Options.holdout,
        metavar="K",
        help="keep every K-th frame for measuring only; 0 = none (default %(default)s)",
    )
    group.add_argument("--steps", type=int, default=Options.steps, help="of the photometric fit (default %(default)s)")
    group.add_argument(
        "--sh-degree",
        type=int,
        default=Options.sh_degree,
        choices=range(4),
        help="of the fitted colours (default %(default)s)",
    )


def _mask_options(run: argparse.ArgumentParser) -> None:
    group = run.add_argument_group("masks")
    group.add_argument(
        "--masks",
        type=Path,
        metavar="DIR",
        help="instance masks, one integer PNG a frame under the frame's "
        "name (0 = none), <id>/<frame>.png, or LangSplat's _s.npy; without it, they are found in the frames",
    )
    group.add_argument(
        "--proposals",
        type=Path,
        metavar="DIR",
        help="masks of single frames, to be brought together: <frame>.json of SAM's own generator, "
        "LangSplat's _s.npy, or PNGs",
    )
    group.add_argument(
        "--granularity",
        choices=("fine", "medium", "coarse"),
        default=Options.granularity,
        help="of the proposals, without masks: fine parts things; coarse joins the colours of one thing, and tells "
        "things apart by the depth that the Gaussians render (default %(default)s)",
    )
    group.add_argument(
        "--association",
        choices=("consensus", "tracking"),
        default=Options.association,
        help="of the frames' proposals: what most views agree on, or Algorithm 1 of the paper with a tracker through "
        "the Gaussians (default %(default)s)",
    )
    group.add_argument(
        "--agreement",
        type=float,
        default=Options.agreement,
        metavar="SHARE",
        help="consensus: share of the views that must put two things into one proposal; less joins more (default "
        "%(default)s)",
    )
    group.add_argument(
        "--iou-threshold",
        type=float,
        default=Options.iou_threshold,
        metavar="KAPPA",
        help="tracking: a proposal that overlaps a masklet by more is not new (default %(default)s)",
    )


def _model_options(run: argparse.ArgumentParser) -> None:
    group = run.add_argument_group("models")
    group.add_argument(
        "--segmenter",
        type=Path,
        metavar="DIR",
        help="a SAM model folder (.onnx) to find proposals with, instead of colour and texture",
    )
    group.add_argument(
        "--level",
        choices=("default", "s", "m", "l"),
        default=Options.level,
        help="of SAM's proposals and of LangSplat's files: subparts, parts, wholes, or all (default %(default)s)",
    )
    group.add_argument(
        "--points-per-side",
        type=int,
        default=Options.points_per_side,
        metavar="N",
        help="SAM: asked on a grid of NxN points (default %(default)s)",
    )
    group.add_argument(
        "--crop-layers",
        type=int,
        default=Options.crop_layers,
        metavar="N",
        help="SAM: asked on crops too; 1 is LangSplat's setting and takes five times longer (default %(default)s)",
    )
    group.add_argument(
        "--tracker",
        type=Path,
        metavar="DIR",
        help="a SAM 2 model folder (.onnx) that follows the proposals (the paper's Algorithm 1), instead of consensus",
    )
    group.add_argument(
        "--embedder",
        type=Path,
        metavar="DIR",
        help="a CLIP model folder (.onnx, tokenizer.json) for regions and texts, instead of colours",
    )
    group.add_argument(
        "--features",
        type=Path,
        metavar="DIR",
        help="LangSplat's language_features: regions take their embeddings from <frame>_s.npy and _f.npy; texts then "
        "need the CLIP that made them (--embedder, here or of query)",
    )


def _field_options(run: argparse.ArgumentParser) -> None:
    group = run.add_argument_group("field")
    group.add_argument(
        "--latent",
        type=_code_size,
        default=Options.latent,
        metavar="D",
        help="most numbers a code may have; 3 as in the paper; auto for as few as keep the regions apart (default "
        "%(default)s)",
    )
    group.add_argument(
        "--reduce",
        choices=("mode", "median", "mean"),
        default=Options.reduce,
        help="from a Gaussian's votes to its code (default %(default)s)",
    )
    group.add_argument(
        "--seed", type=int, default=Options.seed, help="of whatever is drawn at random (default %(default)s)"
    )


def _code_size(text: str) -> int | str:
    return text if text == "auto" else int(text)


def _query(verbs) -> None:
    verb = _verb(
        verbs,
        "query",
        "the Gaussians that a text names, or that lie under a pixel",
        """
        For each text, or for a pixel, writes to OUT: the selected Gaussians as a .ply (INRIA layout, in the capture's
        own world; SuperSplat opens it), a .json with count, score, region, centroid and bounding box, masks of the
        frames that show it best, and answers.html with the pictures.
        """,
    )
    verb.add_argument("field", type=Path, metavar="FIELD", help="field.npz of a run")
    verb.add_argument(
        "texts",
        nargs="*",
        metavar="TEXT",
        help='what to find: "red mug" "dark green bottle" "mug or bowl but not handle" ...',
    )
    verb.add_argument(
        "--at",
        nargs=3,
        action="append",
        default=[],
        metavar=("FRAME", "X", "Y"),
        help="what lies under pixel "
        "(column X, row Y) of a frame, by its name or number, in the frames as the run used them; needs no text",
    )
    verb.add_argument("--out", type=Path, required=True, help="folder for the answers")
    verb.add_argument(
        "--by",
        choices=("votes", "code", "one_step", "canonical"),
        default="votes",
        help="votes, code: text -> the region that answers it -> the Gaussians with its votes, or with its code; "
        "one_step, canonical: each Gaussian's code against the text (default votes)",
    )
    verb.add_argument(
        "--threshold",
        type=float,
        help="on what --by measures (default: 0.5 votes, 0.9 code, 0.8 one_step, 0.5 canonical)",
    )
    _texts(verb)
    verb.add_argument(
        "--all",
        action="store_true",
        dest="several",
        help="every region that answers a text, such as all the chairs, not only the best: those whose similarity has "
        "come 0.8 of the way from the middle region's to the best one's (by votes)",
    )
    verb.add_argument("--keep-outliers", action="store_true", help="leave out the last step, DBSCAN")
    verb.add_argument("--views", type=int, default=3, metavar="N", help="masks to write a query (default 3)")


def _eval(verbs) -> None:
    verb = _verb(
        verbs,
        "eval",
        "measure a field against labels",
        """
        Point-level rendered protocol on LERF-style labels (one .json a frame): the selected Gaussians alone are
        rendered, alpha > 0.7, against each labelled mask; a missing prediction counts as 0. Prints mIoU, mAcc@0.25
        and localisation accuracy of each kind of query, and writes OUT/evaluation.json with every pair.
        """,
    )
    verb.add_argument("field", type=Path, metavar="FIELD", help="field.npz of a run")
    verb.add_argument(
        "--labels", type=Path, required=True, metavar="DIR", help="folder of LERF label files (frame.json)"
    )
    verb.add_argument("--out", type=Path, help="folder for evaluation.json (default: the field's)")
    _texts(verb)


def _texts(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--embedder",
        type=Path,
        metavar="DIR",
        help="the CLIP model folder that the field was made with (default: where the run had it)",
    )
    verb.add_argument(
        "--template",
        action="append",
        metavar="PHRASE",
        help='CLIP: a phrase for the text, such as "a photo of a {}."; several are averaged (default: the bare text)',
    )


def _models(verbs) -> None:
    verb = _verb(
        verbs,
        "models",
        "look into a folder of models",
        """
        check DIR: what models a folder holds, each graph's inputs and outputs, what it can be used for, what is
        missing, and where such exports are published. Exit code 2 where nothing in it can be used.
        """,
    )
    actions = verb.add_subparsers(dest="action", required=True, metavar="ACTION", help="check")
    check = actions.add_parser("check", help="tell what a model folder holds")
    check.add_argument("folder", type=Path, metavar="DIR", help="folder with .onnx files")
