"""The work of each verb of the command line.

A verb's function returns the files that it wrote and its figures, which --json prints, and the errors of what it could
not do besides under "errors". Under "then" it returns what to do after that is printed.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from jsecon.app.models import folders_of_models, with_models
from jsecon.app.verbs import (
    Demo,
    Doctor,
    Eval,
    Export,
    FieldVerb,
    Fit,
    Mcp,
    Models,
    Objects,
    Query,
    Run,
    Serve,
    VerbResult,
    View,
)
from jsecon.errors import InputError
from jsecon.pipeline.options import is_bare_scene, require_writable
from jsecon.pipeline.progress import Console
from jsecon.process import worker_info
from jsecon.query.expressions import is_expression

_RUN_FILES = ("field.safetensors", "report.html", "metrics.json")
_OLD_FIELD = (
    "an earlier version made this field, without the unrelated words that texts are compared with. Fixed thresholds "
    "decide which texts are answered. Make it again with `jsecon run`."
)


def _demo(verb: Demo, console: Console) -> VerbResult:
    with console.progress("start"):
        from jsecon.demo.demo import run_demo

    result = run_demo(verb.out, seed=verb.seed, steps=verb.steps, listener=console)
    return {"written": [verb.out / name for name in (*_RUN_FILES, "queries", "demo.jpg", "demo.webp")]} | result


def _run(verb: Run, console: Console) -> VerbResult:
    with console.progress("start"):
        from jsecon.app.run_report import write_run
        from jsecon.pipeline import processes, run as pipeline

    options = with_models(verb.options, console, yes=verb.yes)
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
    _check_query(verb)
    require_writable(verb.out)
    verb = with_models(verb, console, yes=verb.yes)
    with console.progress("field"):
        from jsecon.app import ask
        from jsecon.app.outputs import write_answers
        from jsecon.data.gaussians.files import require_writable_format
        from jsecon.language.field import check_field, load_field

        require_writable_format(verb.out / f"answer.{verb.format}")
    if is_bare_scene(verb.field):
        verb = dataclasses.replace(verb, field=_field_of_scene(verb, console))
    with console.progress("field"):
        large = ask.larger_than_memory(verb.field)
        if large:
            edited = bool(verb.grow or verb.shrink or verb.invert)
            outlined = bool(verb.mask or verb.box or verb.phrases)
            ask.require_blocks(verb.field, by=verb.by, outlined=outlined, edited=edited)
            check_field(verb.field)
        field = load_field(verb.field, mapped=large)
        texts = verb.texts if verb.phrases is None else []
        embedder = _embedder(field, verb, console) if texts else None
    answers, errors = ([], []) if verb.phrases is None else _ask_phrases(field, verb, console)
    expressions = [text for text in texts if is_expression(text)]
    texts = [text for text in texts if text not in expressions]
    if expressions and large:
        problem = f"{expressions[0]!r} has a relation, an order or a number, which needs the whole field in memory"
        raise InputError(verb.field, problem, remedy="Raise JSECON_MEMORY (GiB), or put the text in quotes.")
    if expressions:
        answers, errors = _ask_relations(field, embedder, expressions, console, frame=verb.from_frame, up=verb.up)
    with console.progress("answers"):
        outline: dict[str, Any] = {"threshold": verb.threshold, "outliers": not verb.keep_outliers}
        options = outline | {"by": verb.by, "several": verb.all, "quantile": verb.quantile}
        outlines = [lambda pairs=pairs: ask.ask_masks(field, pairs, **outline) for pairs in verb.mask]
        outlines += [lambda box=box: ask.ask_box(field, *box, **outline) for box in verb.box]
        for more, refused in (
            ask.ask_each(field, embedder, texts=texts, pixels=verb.at, **options),
            ask.collect(outlines),
        ):
            answers += more
            errors += refused
        answers = ask.edit_answers(field, answers, grow=verb.grow, shrink=verb.shrink, invert=verb.invert)
    files = {"views": verb.views, "ending": verb.format}
    result = write_answers(field, answers, verb.out, console, **files) if answers else {"answers": []}
    return result | {"errors": errors}


def _ask_relations(
    field: Any, embedder: Any, texts: list[str], console: Console, *, frame: str | None = None, up: Any = None
) -> tuple[list[Any], list[InputError]]:
    """Returns the answers to texts with relations, orders or numbers, and the errors of those not understood."""
    from jsecon.app import ask, relations

    with console.progress("relations"):
        scene = relations.open_scene(field, embedder, up)
        queries = [lambda text=text: relations.query_relation(scene, text, frame=frame) for text in texts]
        answers, errors = ask.collect(queries)
    for answer in answers:
        console.say(f"{answer.text!r}: {answer.describe()}")
        console.note("Words in quotes are searched for as they stand, without relations.")
    return [relations.relation_answer(answer) for answer in answers], errors


def _field_of_scene(verb: Query, console: Console) -> Path:
    """Returns the field of a scene without photographs, which is made in OUT/field unless it is there."""
    from jsecon.pipeline import run as pipeline
    from jsecon.pipeline.options import Options

    options = Options(verb.field, embedder=verb.embedder, up=verb.up)
    folder = verb.out / "field"
    with console.progress("plan"):
        path = pipeline.current_field(options, folder)
    if path is None:
        pipeline.run(options, folder, listener=console)
        path = folder / pipeline.FIELD_FILE
        console.say(f"field   {path}")
    return path


def _check_query(verb: Query) -> None:
    """Raises InputError for options of a query that are out of range, or that cannot be combined."""
    if not (verb.texts or verb.at or verb.mask or verb.box):
        remedy = 'For example: jsecon query field.safetensors "red mug" --out answers'
        raise InputError("query", "there is no query", "a TEXT, --at FRAME X Y, --mask or --box", remedy)
    for pairs in verb.mask:
        if len(pairs) % 2:
            remedy = "For example: --mask frame_00012 mug.png"
            raise InputError("--mask", " ".join(pairs), "FRAME PNG, in pairs", remedy)
    if verb.from_frame is not None and not any(map(is_expression, verb.texts)):
        remedy = 'For example: "the red mug left of the bottle" --from frame_00012'
        raise InputError("--from", "no text has a relation that is seen from a frame", remedy=remedy)
    if verb.up is not None and not any(map(is_expression, verb.texts)) and not is_bare_scene(verb.field):
        problem = "no text has a relation, and the field has its views"
        raise InputError("--up", problem, remedy="Leave it out, or make the field again: jsecon run --up.")
    if not 0 <= verb.quantile <= 1:
        remedy = f"{Query.quantile:g} is the default; 0 refuses no text."
        raise InputError("--quantile", f"{verb.quantile:g}", "a share of words, 0 to 1", remedy)
    for name, shells in (("--grow", verb.grow), ("--shrink", verb.shrink)):
        if shells < 0:
            raise InputError(name, f"{shells}", "a number of shells, 0 or more", "1 is a small step.")
    if (verb.mask or verb.box) and verb.by != "votes":
        problem = "--mask and --box select by the outline alone"
        raise InputError("--by", problem, remedy="Leave --by out, or ask by a text.")
    if verb.phrases is None:
        for name, used in (("--images", verb.images is not None), ("--looks", verb.looks != Query.looks)):
            if used:
                raise InputError(name, "it needs --phrases", remedy="Give --phrases DIR, a SAM 3 model folder.")
        return
    if not verb.texts:
        remedy = 'For example: jsecon query field.safetensors "red mug" --phrases sam3 --out answers'
        raise InputError("--phrases", "there is no text, which is the phrase", remedy=remedy)
    unused = {
        "--by": verb.by != "votes",
        "--all": verb.all,
        "--quantile": verb.quantile != Query.quantile,
        "--template": bool(verb.template),
        "--embedder": verb.embedder is not None,
    }
    if any(unused.values()):
        flags = " ".join(flag for flag, used in unused.items() if used)
        problem = f"{flags} cannot be combined with it, since SAM 3 reads the texts and finds all objects of a kind"
        raise InputError("--phrases", problem, remedy=f"Leave out {flags}.")


def _ask_phrases(field: Any, verb: Query, console: Console) -> tuple[list[Any], list[InputError]]:
    """Returns the answers of SAM 3 to the texts, and the errors of texts that it cannot read."""
    with console.progress("phrases") as progress:
        from jsecon.app import phrases
        from jsecon.networks.sam3 import Sam3

        assert verb.phrases is not None
        sam3 = Sam3(verb.phrases)
        capture = verb.images or phrases.find_capture(field, verb.field.parent)
        frames = phrases.load_frames(field, capture, verb.looks)
        options = {"threshold": verb.threshold, "outliers": not verb.keep_outliers, "progress": progress}
        answers, errors = phrases.ask_phrases(field, sam3, verb.texts, frames, **options)
    for answer in answers:
        seen = sum(map(bool, (answer.frames or {}).values()))
        console.say(f"{answer.query!r}: seen in {seen} of {len(frames)} frames")
    return answers, errors


def _objects(verb: Objects, console: Console) -> VerbResult:
    if verb.out is not None:
        require_writable(verb.out)
    with console.progress("field"):
        from jsecon.app import catalogue, catalogue_files
        from jsecon.language.field import load_field

        names = None if verb.vocabulary is None else catalogue.read_vocabulary(verb.vocabulary)
        field = load_field(verb.field)
        by_model = names is not None or verb.template or verb.embedder is not None  # else its words may be in the field
        listed = catalogue.objects(field, names, _embedder(field, verb, console) if by_model else None)
    catalogue_files.print_catalogue(listed, console)
    result: VerbResult = {"objects": [catalogue_files.object_record(listed, n) for n in range(len(listed))]}
    if verb.out is None:
        return result
    files = catalogue_files.write_catalogue(field, listed, verb.out, console)
    console.say(f"pictures  {files['catalogue']}")
    return result | {"written": files}


def _export(verb: Export, console: Console) -> VerbResult:
    _check_export(verb)
    with console.progress("field"):
        import numpy as np

        from jsecon.app import ask, catalogue_files
        from jsecon.app.catalogue import objects
        from jsecon.app.outputs import save_scene
        from jsecon.data.gaussians.files import require_writable_format
        from jsecon.language.field import check_field, load_field

        if verb.out is not None:
            require_writable_format(verb.out)
        text = verb.only if verb.only is not None else verb.without
        listed_ids = verb.with_labels or verb.labels is not None or verb.objects is not None
        check_field(verb.field)
        field = load_field(verb.field, mapped=text is None and not listed_ids)
    rows = None
    if text is not None:
        mask = ask.ask_text(field, _embedder(field, verb, console), text).mask
        if not mask.any():
            option = "--only" if verb.only is not None else "--without"
            raise InputError(option, f"{text!r} selects no Gaussian", remedy="Ask with other words.")
        rows = np.flatnonzero(mask if verb.only is not None else ~mask)
    result: VerbResult = {"written": {}, "gaussians": field.gaussians.count if rows is None else len(rows)}
    with console.progress("files"):
        listed = objects(field) if listed_ids else None
        if verb.out is not None:
            save_scene(field, verb.out, rows=rows, object_ids=listed.labels if listed and verb.with_labels else None)
            result["bytes"] = verb.out.stat().st_size
            result["written"]["scene"] = verb.out
            console.say(f"{result['gaussians']} Gaussians, {result['bytes'] / 2**20:.1f} MiB  {verb.out}")
        if listed is not None and verb.labels is not None:
            ids = listed.labels if rows is None else listed.labels[rows]
            catalogue_files.save_labels(ids, verb.labels)
            result["written"]["labels"] = verb.labels
            console.say(f"{len(ids)} ids of objects, {int((ids < 0).sum())} of them -1  {verb.labels}")
        if listed is not None and verb.objects is not None:
            files = catalogue_files.save_objects(field, listed, verb.objects)
            result["written"]["objects"] = files
            console.say(f"{len(files)} objects  {verb.objects}")
    return result


def _check_export(verb: Export) -> None:
    """Raises InputError for options of an export that say nothing, or that cannot be combined."""
    if verb.out is None and verb.labels is None and verb.objects is None:
        raise InputError("export", "there is nothing to write", remedy="Give --out scene.ply, --labels or --objects.")
    if verb.with_labels and (verb.out is None or verb.out.suffix.lower() != ".ply"):
        raise InputError("--with-labels", "only a .ply holds them", remedy="Give --out scene.ply, or --labels ids.npy.")
    if verb.only is not None and verb.without is not None:
        raise InputError("--only", "it cannot be combined with --without", remedy="Export twice, with one of them.")
    if verb.objects is not None and (verb.only is not None or verb.without is not None):
        problem = "it writes all objects, so --only and --without cannot be combined with it"
        raise InputError("--objects", problem, remedy="Leave one of them out.")
    if verb.labels is not None and verb.labels.suffix != ".npy":
        raise InputError("--labels", f"{verb.labels} does not end in .npy", remedy="For example: --labels ids.npy")


def _view(verb: View, console: Console) -> VerbResult:
    if verb.export is not None:
        return _export_page(verb, console)
    from jsecon.app.access import bracketed, token_for
    from jsecon.app.viewer.view_state import ViewState, from_link, with_texts
    from jsecon.app.viewer.window import open_viewer
    from jsecon.language.field import load_field
    from jsecon.pipeline.networks import ExternalSpace, external_dim

    token = token_for(verb.host, verb.token)
    state = from_link(verb.link) if verb.link else ViewState()
    if verb.texts:
        state = with_texts(state, "; ".join(verb.texts))
    field = load_field(verb.field)
    name = verb.field.resolve().parent.name
    dim = None
    if not verb.texts and verb.embedder is None:
        dim = external_dim(field.embedder)  # without its model a field can be clicked, but not searched by texts
    embedder = _embedder(field, verb, console) if dim is None else ExternalSpace(dim)
    access = {"host": verb.host, "port": verb.port, "token": token, "hosts": verb.allow_host}
    viewer = open_viewer(field, embedder, name=name, state=state, **access)
    console.say(f"{name}: {field.gaussians.count} Gaussians, {field.regions.count} regions")
    query = f"/?{urlencode({'token': token})}" if token else ""
    console.say(f"http://{bracketed(verb.host)}:{viewer.server.get_port()}{query}")
    viewer.run()
    return {}


def _export_page(verb: View, console: Console) -> VerbResult:
    """Writes the page of `jsecon view --export`."""
    assert verb.export is not None
    if verb.export.suffix != ".html":
        raise InputError("--export", f"{verb.export} does not end in .html", remedy="For example: --export page.html")
    require_writable(verb.export.parent)
    with console.progress("page"):
        from jsecon.app.ask import ask_each
        from jsecon.app.viewer.static_page import write_page
        from jsecon.language.field import load_field

        field = load_field(verb.field)
        embedder = _embedder(field, verb, console) if verb.texts else None
        expressions = [text for text in verb.texts if is_expression(text)]
        answers, errors = _ask_relations(field, embedder, expressions, console) if expressions else ([], [])
        more, refused = ask_each(field, embedder, texts=[text for text in verb.texts if text not in expressions])
        answers, errors = answers + more, errors + refused
        size = write_page(field, answers, verb.export, title=verb.field.resolve().parent.name)
    count = field.gaussians.count
    console.say(f"{count} Gaussians, texts answered: {len(answers)}, {size / 2**20:.1f} MiB  {verb.export}")
    texts = [answer.query for answer in answers]
    return {"written": {"page": verb.export}, "gaussians": count, "answers": texts, "bytes": size, "errors": errors}


def _eval(verb: Eval, console: Console) -> VerbResult:
    out = verb.out or verb.field.parent
    require_writable(out)
    with console.progress("field"):
        from jsecon.app.evaluation import write_evaluation
        from jsecon.language.field import load_field

        field = load_field(verb.field)
        embedder = _embedder(field, verb, console)
    return write_evaluation(field, embedder, verb.labels, out, console)


def _serve(verb: Serve, console: Console) -> VerbResult:
    with console.progress("start"):
        from jsecon.app.server.serve import prepare

    access = {"host": verb.host, "port": verb.port, "token": verb.token, "hosts": verb.allow_host}
    with console.progress("fields"):
        embedder = with_models(verb, console, yes=False).embedder
        result, serve = prepare(verb.fields, embedder=embedder, **access)
    for scene in result["fields"]:
        console.say(f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['regions']} regions")
        if scene["unrelated_words"] is None:
            console.note(f"{scene['name']}: {_OLD_FIELD}")
    console.say(result["address"])
    return result | {"then": serve}


def _mcp(verb: Mcp, console: Console) -> VerbResult:
    console = Console(sys.stderr)  # standard output belongs to the protocol
    with console.progress("fields"):
        from jsecon.app.mcp_server import serve_models

        embedder = with_models(verb, console, yes=False).embedder
        result, serve = serve_models(verb.fields, embedder)
    for scene in result["fields"]:
        console.say(f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['regions']} regions")
    return {"then": serve}


def _models(verb: Models, console: Console) -> VerbResult:
    from jsecon.app import models

    if verb.action == "list":
        return models.list_models(console)
    if not verb.names:
        problem = f"models {verb.action} needs a name"
        raise InputError("jsecon", problem, remedy="jsecon models list has the names.")
    if verb.action == "get":
        return models.get_models(verb.names, verb.role, verb.precision, console, yes=verb.yes)
    if verb.action == "remove":
        return models.remove_models(verb.names, console)
    from jsecon.pipeline.models import inspect_models, report_lines, unusable

    results, errors = [], []
    for name in verb.names:
        with console.progress("graphs"):
            report = inspect_models(models.cached_model(name))
        for line in report_lines(report):
            console.say(line)
        results.append(dataclasses.asdict(report))
        errors += unusable(report)
    return {"models": results, "errors": errors}


def _doctor(verb: Doctor, console: Console) -> VerbResult:
    with console.progress("checks"):
        from jsecon.app.doctor import failures, run_checks

        checks = run_checks(verb.models)
    console.say("\n".join(f"{check.status:<8} {check.name:<10} {check.message}" for check in checks))
    return {"checks": checks, "errors": failures(checks)}


def _embedder(field: Any, verb: FieldVerb, console: Console) -> Any:
    """Opens the embedder of a field, and warns of a field of an earlier version."""
    from jsecon.pipeline import networks

    if field.reference is None:
        console.note(_OLD_FIELD)
    folder = with_models(verb, console, yes=verb.yes).embedder
    if folder is None and verb.yes and (missing := networks.missing_model_of_field(field)) is not None:
        folders_of_models({"embedder": missing}, console, yes=True)
    return networks.field_embedder(field, folder, templates=verb.template or ("{}",))


VERBS: dict[str, tuple[Any, type]] = {
    "demo": (_demo, Demo),
    "run": (_run, Run),
    "fit": (_fit, Fit),
    "query": (_query, Query),
    "objects": (_objects, Objects),
    "export": (_export, Export),
    "view": (_view, View),
    "eval": (_eval, Eval),
    "serve": (_serve, Serve),
    "mcp": (_mcp, Mcp),
    "models": (_models, Models),
    "doctor": (_doctor, Doctor),
}
"""Name of a verb -> the function that does its work, and the class of its options."""
