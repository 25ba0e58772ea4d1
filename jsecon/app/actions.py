"""The work of each verb of the command line.

A verb's function returns its files and figures, which --json prints (ending.py), and under "then" what it does after
that is printed.
"""

import dataclasses
import re
import sys
from pathlib import Path
from typing import Any

from jsecon.app.verbs import Demo, Doctor, Eval, Export, FieldVerb, Fit, Models, Query, Run, Serve, VerbResult, View
from jsecon.errors import InputError
from jsecon.pipeline.options import is_bare_scene, require_writable
from jsecon.pipeline.progress import Console
from jsecon.process import worker_info

_RUN_FILES = ("field.safetensors", "report.html", "metrics.json")


def _demo(verb: Demo, console: Console) -> VerbResult:
    with console.progress("start"):
        from jsecon.demo.demo import run_demo

    result = run_demo(verb.out, seed=verb.seed, steps=verb.steps, listener=console)
    return {"written": [verb.out / name for name in (*_RUN_FILES, "queries", "demo.jpg", "demo.webp")]} | result


def _run(verb: Run, console: Console) -> VerbResult:
    with console.progress("start"):
        from jsecon.app.run_report import write_run
        from jsecon.pipeline import processes, run as pipeline

    options = verb.options
    if verb.dry_run:
        return pipeline.dry_run(options, verb.out, listener=console)
    place = worker_info()
    if place is None and (verb.processes, verb.coordinator, verb.process) != (1, None, None):
        raise SystemExit(processes.launch(sys.argv[1:], verb.processes, verb.coordinator, verb.process))
    with processes.exit_if_disconnected():
        if place is not None:
            processes.join(options, *place)
            if place[0] > 0:
                pipeline.run_worker(options, verb.out)
                return {}
        coordinator = processes.Coordinator(several=place is not None)
        run = pipeline.run(options, verb.out, listener=console, coordinator=coordinator)
        coordinator.shutdown()
    return {"written": [verb.out / name for name in _RUN_FILES]} | write_run(run, verb.out, console)


def _fit(verb: Fit, console: Console) -> VerbResult:
    with console.progress("start"):
        from jsecon.app.run_report import write_scene
        from jsecon.data.gaussians.files import require_writable_format
        from jsecon.pipeline import run as pipeline
    require_writable_format(verb.out)

    folder = verb.out.with_suffix("")
    if verb.dry_run:
        return pipeline.dry_run(verb.options, folder, scene_only=True, listener=console)
    return write_scene(*pipeline.fit(verb.options, folder, listener=console), verb.out, console)


def _query(verb: Query, console: Console) -> VerbResult:
    if not (verb.texts or verb.at or verb.mask or verb.box):
        remedy = 'For example: jsecon query field.safetensors "red mug" --out answers'
        raise InputError("query", "nothing to find", "a TEXT, --at FRAME X Y, --mask or --box", remedy)
    pixels = [(frame, *_whole("--at", x, y)) for frame, x, y in verb.at]
    boxes = [(frame, *_whole("--box", *ends)) for frame, *ends in verb.box]
    for pairs in verb.mask:
        if len(pairs) % 2:
            remedy = "For example: --mask frame_00012 mug.png"
            raise InputError("--mask", " ".join(pairs), "FRAME PNG, in pairs", remedy)
    if not 0 <= verb.quantile <= 1:
        remedy = f"{Query.quantile:g} is the default; 0 refuses no text."
        raise InputError("--quantile", f"{verb.quantile:g}", "a share of words, 0 to 1", remedy)
    _check_phrases(verb)
    require_writable(verb.out)
    with console.progress("field"):
        from jsecon.app import ask
        from jsecon.app.outputs import write_answers
        from jsecon.data.gaussians.files import require_writable_format
        from jsecon.language.field import check_field, load_field

        require_writable_format(verb.out / f"answer.{verb.format}")
    if is_bare_scene(verb.field):
        verb = dataclasses.replace(verb, field=_field_of_scene(verb, console))
    with console.progress("field"):
        if large := ask.larger_than_memory(verb.field):
            outlined = bool(verb.mask or boxes or verb.phrases)
            ask.require_blocks(verb.field, by=verb.by, even=verb.even, outlined=outlined)
            check_field(verb.field)
        field = load_field(verb.field, mapped=large)
        texts = verb.texts if verb.phrases is None else []
        embedder = _embedder(field, verb, console) if texts else None
    by_phrase, unread = ([], []) if verb.phrases is None else _phrases(field, verb, console)
    options: dict[str, Any] = {"texts": texts, "pixels": pixels, "several": verb.all, "by": verb.by}
    options |= {"threshold": verb.threshold, "quantile": verb.quantile, "outliers": not verb.keep_outliers}
    with console.progress("answers"):
        if large:
            answers, refused = ask.answer_in_blocks(field, embedder, **options)
        else:
            options |= {"masks": verb.mask, "boxes": boxes, "even": verb.even}
            answers, refused = ask.answer_each(ask.queries_of(field, embedder, **options))
    answers, refused = by_phrase + answers, unread + refused
    files = {"views": verb.views, "ending": verb.format}
    result = write_answers(field, answers, verb.out, console, **files) if answers else {"answers": []}
    return result | {"refused": refused}


def _field_of_scene(verb: Query, console: Console) -> Path:
    """Returns the field of a scene without photographs, made in OUT/field if it is not there yet."""
    from jsecon.pipeline import run as pipeline
    from jsecon.pipeline.options import Options

    options, folder = Options(verb.field, embedder=verb.embedder), verb.out / "field"
    with console.progress("plan"):
        path = pipeline.current_field(options, folder)
    if path is None:
        pipeline.run(options, folder, listener=console)
        path = folder / pipeline.FIELD_FILE
        console.say(f"field   {path}")
    return path


def _check_phrases(verb: Query) -> None:
    """Raises InputError if --phrases is combined with options that it does not use, or --images or --looks lack it."""
    if verb.phrases is None:
        for name, used in (("--images", verb.images is not None), ("--looks", verb.looks != Query.looks)):
            if used:
                problem = "no --phrases is given, which it belongs to"
                raise InputError(name, problem, remedy="Give --phrases DIR, a SAM 3 model folder.")
        return
    if not verb.texts:
        remedy = 'For example: jsecon query field.safetensors "red mug" --phrases sam3 --out answers'
        raise InputError("--phrases", "no text is given, which is the phrase", remedy=remedy)
    unused = {"by": verb.by != "votes", "all": verb.all, "even": verb.even}
    unused["quantile"] = verb.quantile != Query.quantile
    unused |= {"template": bool(verb.template), "embedder": verb.embedder is not None}
    if any(unused.values()):
        flags = " ".join(f"--{name}" for name, used in unused.items() if used)
        problem = f"{flags} cannot be combined with it: SAM 3 reads the texts and finds all of a kind"
        raise InputError("--phrases", problem, remedy=f"Leave out {flags}.")


def _phrases(field: Any, verb: Query, console: Console) -> tuple[list[Any], list[InputError]]:
    """Returns the answers of SAM 3 to the texts, and the errors of texts that it cannot read."""
    with console.progress("phrases") as progress:
        from jsecon.app import phrases
        from jsecon.networks.sam3 import Sam3

        assert verb.phrases is not None
        sam3 = Sam3(verb.phrases)
        frames = phrases.frames_of(field, verb.images or phrases.capture_of(field, verb.field.parent), verb.looks)
        options = {"threshold": verb.threshold, "outliers": not verb.keep_outliers, "progress": progress}
        answers, refused = phrases.ask_phrases(field, sam3, verb.texts, frames, **options)
    for answer in answers:
        seen = sum(map(bool, (answer.frames or {}).values()))
        console.say(f"{answer.question!r}: seen in {seen} of {len(frames)} frames")
    return answers, refused


def _export(verb: Export, console: Console) -> VerbResult:
    with console.progress("field"):
        from jsecon.app.outputs import save_scene
        from jsecon.data.gaussians.files import require_writable_format
        from jsecon.language.field import check_field, load_field

        require_writable_format(verb.out)
        check_field(verb.field)
        field = load_field(verb.field, mapped=True)
        save_scene(field, verb.out)
    count, size = field.gaussians.count, verb.out.stat().st_size
    console.say(f"{count} Gaussians, {size / 2**20:.1f} MiB  {verb.out}")
    return {"written": {"scene": verb.out}, "gaussians": count, "bytes": size}


def _view(verb: View, console: Console) -> VerbResult:
    if verb.export is None:
        from jsecon.app.viewer.window import view

        return view(verb, lambda field, verb: _embedder(field, verb, console), console.say)
    if verb.export.suffix != ".html":
        raise InputError("--export", f"{verb.export} does not end in .html", remedy="For example: --export page.html")
    require_writable(verb.export.parent)
    with console.progress("page"):
        from jsecon.app import ask
        from jsecon.app.viewer.static_page import write_page
        from jsecon.language.field import load_field

        field = load_field(verb.field)
        embedder = _embedder(field, verb, console) if verb.texts else None
        answers, refused = ask.answer_each(ask.queries_of(field, embedder, texts=verb.texts))
        size = write_page(field, answers, verb.export, title=verb.field.resolve().parent.name)
    console.say(
        f"{(count := field.gaussians.count)} Gaussians, {len(answers)} answers, {size / 2**20:.1f} MiB  {verb.export}"
    )
    lit = [answer.question for answer in answers]
    return {"written": {"page": verb.export}, "refused": refused, "gaussians": count, "answers": lit, "bytes": size}


def _eval(verb: Eval, console: Console) -> VerbResult:
    out = verb.out or verb.field.parent
    require_writable(out)
    with console.progress("field"):
        from jsecon.app.evaluation import write_evaluation
        from jsecon.language.field import load_field

        embedder = _embedder(field := load_field(verb.field), verb, console)
    return write_evaluation(field, embedder, verb.labels, out, console)


def _serve(verb: Serve, console: Console) -> VerbResult:
    with console.progress("start"):
        from jsecon.app.server.serve import ready

    access = {"host": verb.host, "port": verb.port, "token": verb.token, "hosts": verb.allow_host}
    with console.progress("fields"):
        result, serve = ready(verb.fields, embedder=verb.embedder, **access)
    for scene in result["fields"]:
        console.say(f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['regions']} regions")
        if scene["unrelated_words"] is None:
            console.note(f"{scene['name']}: {_OLD_FIELD}")
    console.say(result["address"])
    return result | {"then": serve}


def _models(verb: Models, console: Console) -> VerbResult:
    with console.progress("graphs"):
        from jsecon.pipeline.models import inspect_models, report_lines, unusable

        findings = inspect_models(verb.folder)
    for line in report_lines(findings):
        console.say(line)
    return dataclasses.asdict(findings) | {"refused": unusable(findings)}


def _doctor(verb: Doctor, console: Console) -> VerbResult:
    with console.progress("looking"):
        from jsecon.app.doctor import run_checks, wrong

        checks = run_checks(verb.models)
    console.say("\n".join(f"{check.status:<8} {check.name:<10} {check.told}" for check in checks))
    return {"checks": checks, "refused": wrong(checks)}


_OLD_FIELD = (
    "an earlier version made this field, without the unrelated words that texts are compared with. Fixed thresholds "
    "decide which texts are answered. Make it again with `jsecon run`."
)


def _embedder(field: Any, verb: FieldVerb, console: Console) -> Any:
    from jsecon.pipeline import networks

    if field.reference is None:
        console.note(_OLD_FIELD)
    return networks.field_embedder(field, verb.embedder, templates=verb.template or ("{}",))


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
