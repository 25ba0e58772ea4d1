"""What each verb of the command line does.

A verb's function returns what it wrote and its figures, which is what --json prints (ending.py), and under "then" what
it does when that is told.
"""

import dataclasses
import re
import sys
from pathlib import Path
from typing import Any

from jsecon.app.ending import Told
from jsecon.app.verbs import Demo, Doctor, Eval, Export, FieldVerb, Fit, Models, Query, Run, Serve, View
from jsecon.errors import InputError
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console
from jsecon.process import member

_RUN_FILES = ("field.npz", "report.html", "metrics.json")


def _demo(asked: Demo, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.demo.demo import demo

    told = demo(asked.out, seed=asked.seed, steps=asked.steps, listener=console)
    return {"written": [asked.out / name for name in (*_RUN_FILES, "queries", "demo.jpg", "demo.webp")]} | told


def _run(asked: Run, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.app.summary import write_run
        from jsecon.pipeline import pipeline, processes

    options = asked.options
    if asked.dry_run:
        return pipeline.dry_run(options, asked.out, listener=console)
    if (own := member()) is None and (asked.processes, asked.coordinator, asked.process) != (1, None, None):
        raise SystemExit(processes.launched(sys.argv[1:], asked.processes, asked.coordinator, asked.process))
    with processes.lost_touch():
        if own is not None:
            processes.join(options, *own)
            if own[0] > 0:
                pipeline.assist(options, asked.out)
                return {}
        first = processes.First(several=own is not None)
        run = pipeline.run(options, asked.out, listener=console, first=first)
        first.dismiss()
    return {"written": [asked.out / name for name in _RUN_FILES]} | write_run(run, asked.out, console)


def _fit(asked: Fit, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.app.summary import write_scene
        from jsecon.data.gaussian_files import require_written
        from jsecon.pipeline import pipeline
    require_written(asked.out)

    folder = asked.out.with_suffix("")
    if asked.dry_run:
        return pipeline.dry_run(asked.options, folder, scene_only=True, listener=console)
    return write_scene(*pipeline.fit(asked.options, folder, listener=console), asked.out, console)


def _query(asked: Query, console: Console) -> Told:
    if not (asked.texts or asked.at or asked.mask or asked.box):
        remedy = 'For example: jsecon query field.npz "red mug" --out answers'
        raise InputError("query", "nothing to find", "a TEXT, --at FRAME X Y, --mask or --box", remedy)
    pixels = [(frame, *_whole("--at", x, y)) for frame, x, y in asked.at]
    boxes = [(frame, *_whole("--box", *ends)) for frame, *ends in asked.box]
    for given in asked.mask:
        if len(given) % 2:
            remedy = "For example: --mask frame_00012 mug.png"
            raise InputError("--mask", " ".join(given), "FRAME PNG, in pairs", remedy)
    _check_phrases(asked)
    require_writable(asked.out)
    with console.progress("field"):
        from jsecon.app import asking
        from jsecon.app.summary import write_answers
        from jsecon.data.gaussian_files import require_written
        from jsecon.language.field import check_field, load_field

        require_written(asked.out / f"answer.{asked.format}")
        if large := asking.larger_than_memory(asked.field):
            outlined = bool(asked.mask or boxes or asked.phrases)
            asking.require_blocks(asked.field, by=asked.by, even=asked.even, outlined=outlined)
            check_field(asked.field)
        field = load_field(asked.field, mapped=large)
        texts = asked.texts if asked.phrases is None else []
        embedder = _embedder(field, asked) if texts else None
    by_phrase, unread = ([], []) if asked.phrases is None else _phrases(field, asked, console)
    how: dict[str, Any] = {"texts": texts, "pixels": pixels, "several": asked.all, "by": asked.by}
    how |= {"threshold": asked.threshold, "outliers": not asked.keep_outliers}
    with console.progress("answers"):
        if large:
            answers, refused = asking.answered_in_blocks(field, embedder, **how)
        else:
            how |= {"masks": asked.mask, "boxes": boxes, "even": asked.even}
            answers, refused = asking.asked_each(asking.questions_of(field, embedder, **how))
    answers, refused = by_phrase + answers, unread + refused
    files = {"views": asked.views, "ending": asked.format}
    told = write_answers(field, answers, asked.out, console, **files) if answers else {"answers": []}
    return told | {"refused": refused}


def _check_phrases(asked: Query) -> None:
    """Raises InputError where --phrases is given with what it has no use for, or --images or --looks without it."""
    if asked.phrases is None:
        for name, given in (("--images", asked.images is not None), ("--looks", asked.looks != Query.looks)):
            if given:
                found = "no --phrases is given, which it belongs to"
                raise InputError(name, found, remedy="Give --phrases DIR, a SAM 3 model folder.")
        return
    if not asked.texts:
        remedy = 'For example: jsecon query field.npz "red mug" --phrases sam3 --out answers'
        raise InputError("--phrases", "no text is given, which is the phrase", remedy=remedy)
    given = {"by": asked.by != "votes", "all": asked.all, "even": asked.even}
    given |= {"template": bool(asked.template), "embedder": asked.embedder is not None}
    if any(given.values()):
        found = " ".join(f"--{name}" for name, there in given.items() if there)
        why_not = f"{found} cannot be combined with it: SAM 3 reads the texts and finds all of a kind"
        raise InputError("--phrases", why_not, remedy=f"Leave out {found}.")


def _phrases(field: Any, asked: Query, console: Console) -> tuple[list[Any], list[InputError]]:
    """What SAM 3 answers to the texts."""
    with console.progress("phrases") as progress:
        from jsecon.app import phrases
        from jsecon.networks.sam3 import Sam3

        assert asked.phrases is not None
        sam3 = Sam3(asked.phrases)
        frames = phrases.frames_of(field, asked.images or phrases.capture_of(field, asked.field.parent), asked.looks)
        how = {"threshold": asked.threshold, "outliers": not asked.keep_outliers, "progress": progress}
        answers, refused = phrases.ask_phrases(field, sam3, asked.texts, frames, **how)
    for answer in answers:
        seen = sum(map(bool, (answer.frames or {}).values()))
        console.say(f"{answer.question!r}: seen in {seen} of {len(frames)} frames")
    return answers, refused


def _export(asked: Export, console: Console) -> Told:
    with console.progress("field"):
        from jsecon.app.answers import save_scene
        from jsecon.data.gaussian_files import require_written
        from jsecon.language.field import check_field, load_field

        require_written(asked.out)
        check_field(asked.field)
        field = load_field(asked.field, mapped=True)
        save_scene(field, asked.out)
    count, size = field.gaussians.count, asked.out.stat().st_size
    console.say(f"{count} Gaussians, {size / 2**20:.1f} MiB  {asked.out}")
    return {"written": {"scene": asked.out}, "gaussians": count, "bytes": size}


def _view(asked: View, console: Console) -> Told:
    if asked.export is None:
        from jsecon.app.viewer import view

        return view(asked, _embedder, console.say)
    if asked.export.suffix != ".html":
        raise InputError("--export", f"{asked.export} does not end in .html", remedy="For example: --export page.html")
    require_writable(asked.export.parent)
    with console.progress("page"):
        from jsecon.app import asking
        from jsecon.app.splat_page import write_page
        from jsecon.language.field import load_field

        field = load_field(asked.field)
        embedder = _embedder(field, asked) if asked.texts else None
        answers, refused = asking.asked_each(asking.questions_of(field, embedder, texts=asked.texts))
        size = write_page(field, answers, asked.export, title=asked.field.resolve().parent.name)
    console.say(
        f"{(count := field.gaussians.count)} Gaussians, {len(answers)} answers, {size / 2**20:.1f} MiB  {asked.export}"
    )
    lit = [answer.question for answer in answers]
    return {"written": {"page": asked.export}, "refused": refused, "gaussians": count, "answers": lit, "bytes": size}


def _eval(asked: Eval, console: Console) -> Told:
    out = asked.out or asked.field.parent
    require_writable(out)
    with console.progress("field"):
        from jsecon.app.summary import write_evaluation
        from jsecon.language.field import load_field

        embedder = _embedder(field := load_field(asked.field), asked)
    return write_evaluation(field, embedder, asked.labels, out, console)


def _serve(asked: Serve, console: Console) -> Told:
    with console.progress("start"):
        from jsecon.app import server

    given = {"host": asked.host, "port": asked.port, "token": asked.token, "embedder": asked.embedder}
    given["hosts"] = asked.allow_host
    with console.progress("fields"):
        told, answer = server.ready([Path(file) for file in asked.fields], **given)
    for scene in told["fields"]:
        console.say(f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['regions']} regions")
    console.say(told["address"])
    return told | {"then": answer}


def _models(asked: Models, console: Console) -> Told:
    with console.progress("graphs"):
        from jsecon.pipeline.models import examine, report_lines, unusable

        findings = examine(asked.folder)
    for line in report_lines(findings):
        console.say(line)
    return dataclasses.asdict(findings) | {"refused": unusable(findings)}


def _doctor(asked: Doctor, console: Console) -> Told:
    with console.progress("looking"):
        from jsecon.app.doctor import checks_of, wrong

        checks = checks_of(asked.models)
    console.say("\n".join(f"{check.status:<8} {check.name:<10} {check.told}" for check in checks))
    return {"checks": checks, "refused": wrong(checks)}


def _embedder(field: Any, asked: FieldVerb) -> Any:
    from jsecon.pipeline import networks

    return networks.embedder_of_field(field, asked.embedder, templates=asked.template or ("{}",))


_EXAMPLES = {"--at": "For example: --at frame_00012 310 145", "--box": "For example: --box frame_00012 280 120 340 190"}


def _whole(option: str, *texts: str) -> list[int]:
    for text in texts:
        if not re.fullmatch("[0-9]{1,9}", text):
            raise InputError(option, repr(text), "whole numbers of pixels", _EXAMPLES[option])
    return [int(text) for text in texts]


VERBS: dict[str, tuple[Any, type]] = {
    "demo": (_demo, Demo),
    "run": (_run, Run),
    "fit": (_fit, Fit),
    "query": (_query, Query),
    "export": (_export, Export),
    "view": (_view, View),
    "eval": (_eval, Eval),
    "serve": (_serve, Serve),
    "models": (_models, Models),
    "doctor": (_doctor, Doctor),
}
