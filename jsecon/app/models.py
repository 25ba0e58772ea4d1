"""`jsecon models`: which models there are, and fetching them."""

import dataclasses

from jsecon.app import verbs
from jsecon.errors import InputError
from jsecon.networks import hub
from jsecon.pipeline.progress import Console


def _models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon models`; the result has rows or folders, and errors by model."""
    if verb.action == "list":
        return _list_models(console)
    if not verb.names:
        raise InputError("jsecon", "models get needs a name", remedy="jsecon models list has the names.")
    return _get_models(verb, console)


def _list_models(console: Console) -> verbs.VerbResult:
    """Prints the catalogue: name, role, size, licence, whether it is on this machine, and what it is good for."""
    rows = []
    columns = "{:<11} {:<10} {:>5}  {:<5} {:<25} {}".format
    console.print_line(columns("name", "role", "MB", "here", "licence", "adds"))
    for row in hub.catalogue():
        cached = row.cached_folder is not None
        mark = "yes" if cached else "-"
        console.print_line(columns(row.name, row.role, row.megabytes, mark, row.licence, row.purpose))
        rows.append(dataclasses.asdict(row) | {"cached": cached})
    console.print_line("jsecon models get NAME fetches one; hub:owner/name is any other repository of huggingface.co.")
    return {"models": rows}


def _get_models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Fetches models, also if an older revision of them is on this machine. One that fails does not stop the others."""
    folders, errors = {}, []
    for name in verb.names:
        if name.startswith(hub.PREFIX) and verb.role is None:
            errors.append(InputError(name, "an address does not tell what the model is for", remedy="Give --role."))
            continue
        for model in hub.models_of_name(name, verb.role):
            try:
                folder = hub.fetch(model, lambda line: console.note(f"fetching {line}"))
            except InputError as error:
                errors.append(error)
                continue
            console.print_line(f"{name}  {model.role}  {folder}")
            folders[f"{name} ({model.role})"] = folder
    return {"models": folders, "errors": errors}
