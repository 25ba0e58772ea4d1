"""`jsecon view`: the page of a field, served or as a file."""

import threading
from pathlib import Path

from jsecon.app import verbs
from jsecon.app.records import Answer
from jsecon.app.scene import open_scene
from jsecon.app.viewer.page import field_page
from jsecon.errors import InputError
from jsecon.files import write_text
from jsecon.pipeline.options import require_writable
from jsecon.pipeline.progress import Console


def _view(verb: verbs.View, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon view`: address, and under "then" what answers requests until it is stopped."""
    if verb.export is not None:
        return _export_page(verb, verb.export, console)
    try:
        from jsecon.app.server import listen, page_application, runner
    except ModuleNotFoundError as error:
        remedy = 'Run: pip install "jsecon[serve]". Or write a page with --export.'
        raise InputError("jsecon view", f"the package {error.name} is missing", remedy=remedy) from error
    listening, address = listen("127.0.0.1", verb.port)
    # Without its model a field can be clicked, so the model is opened when the first text is asked.
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    app = page_application(scene, list(dict.fromkeys(verb.texts)))
    console.print_line(f"{scene}\n{address}")
    threading.Thread(target=scene.prepare).start()
    return {"address": address, "then": runner(app, listening)}


def _export_page(verb: verbs.View, file: Path, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon view --export`; the result has the texts that were answered."""
    if file.suffix != ".html":
        raise InputError("--export", f"{file} does not end in .html", remedy="For example: --export page.html")
    require_writable(file.parent)
    scene = open_scene(verb.field, embedder=verb.embedder, console=console)
    with console.progress("page"):
        if verb.texts:
            _ = scene.embedder  # without it one error stands for all texts
        results = scene.ask_all(verb.texts)
        answers = {str(answer.query): answer for answer in results if isinstance(answer, Answer)}
        errors = [error for error in results if isinstance(error, InputError)]
        write_text(file, field_page(scene.field, answers, title=scene.name))
    for answer in answers.values():
        console.print_line(str(answer))
    console.print_line(f"page    {file}, texts answered: {len(answers)}")
    return {"written": {"page": file}, "answers": [*answers], "errors": errors}
