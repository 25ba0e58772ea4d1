"""Models by name on the command line: which ones there are, fetching them after asking, and examining them."""

import contextlib
import dataclasses
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from jsecon.app import verbs
from jsecon.errors import InputError
from jsecon.networks import hub
from jsecon.networks.hub import HubModel, Precision, Role
from jsecon.pipeline.progress import Console

T = TypeVar("T", bound=Any)
OLD_FIELD = (
    "an earlier version made this field, without the unrelated words that texts are compared with. Fixed thresholds "
    "decide which texts are answered. Make it again with `jsecon run`."
)


def with_models(options: T, console: Console, *, yes: bool) -> T:
    """Replaces the names of models in options by the folders of their files, fetching what is missing.

    Args:
      options: A dataclass with attributes named like roles (embedder, segmenter, tracker) that hold a name, an
        address or a folder; and perhaps `models` and `precision`.
      console: Where to print and ask.
      yes: Fetch without asking.
    """
    precision = getattr(options, "precision", None)
    recommended = hub.RECOMMENDED if getattr(options, "models", None) == AUTO else {}
    models = {}
    for role in get_args(Role):
        choice = getattr(options, role, None)
        choice = recommended.get(role) if choice is None else choice
        if choice is not None:
            models[role] = hub.parse_model(choice, role, precision)
    return dataclasses.replace(options, **_folders_of_models(models, console, yes=yes))


def _folders_of_models(
    models: Mapping[Role, HubModel | Path], console: Console, *, yes: bool, fresh: bool = False
) -> dict[Role, Path]:
    """Returns the folders of models, after fetching those that are missing; `fresh` fetches all as they are now."""
    folders: dict[Role, Path] = {}
    missing: dict[Role, HubModel] = {}
    for role, model in models.items():
        if isinstance(model, Path):
            folders[role] = model
        elif not fresh and (cached := model.cached_folder) is not None:
            folders[role] = cached
        else:
            missing[role] = model
    if not missing:
        return folders
    with console.progress("hub"):
        downloads: dict[Role, hub.Download] = {role: hub.plan_download(model) for role, model in missing.items()}
    for download in downloads.values():
        console.note(f"fetching {download}" if yes else f"needs {download}")
    if not yes:
        commands = "; ".join(model.get_command for model in missing.values())
        where = " ".join(model.address for model in missing.values())
        if not sys.stdin.isatty():
            raise InputError(where, "not on this machine", "", f"Fetch with: {commands}. Or add --yes.")
        if input("Fetch now? [y/N] ").strip().lower() not in ("y", "yes"):
            raise InputError(where, "not fetched", "", f"To fetch later: {commands}.")
    for role, download in downloads.items():
        folders[role] = hub.fetch(download)
    return folders


def open_embedder(field: Any, verb: verbs.FieldVerb, console: Console) -> Any:
    """Opens the embedder of a field for a verb, which states the model, and warns of a field of an earlier version."""
    from jsecon.pipeline import model_loading

    if field.unrelated_words is None:
        console.note(OLD_FIELD)
    folder = with_models(verb, console, yes=verb.yes).embedder
    if folder is None and (verb.yes or sys.stdin.isatty()):
        missing = model_loading.find_model(field)
        if isinstance(missing, HubModel):
            folder = _folders_of_models({"embedder": missing}, console, yes=verb.yes)["embedder"]
    return model_loading.field_embedder(field, folder)


AUTO = "auto"
"""in place of a name: the recommended models"""
TABLE_HEAD = f"{'name':<11} {'role':<10} {'MB':>5} {'s/frame':>7}"
TABLE_NOTE = "MB and seconds are of fp32: a frame of 400x300 on two cores, 40 regions or one object in it."


def _table_lines() -> Iterator[str]:
    """Yields name, role, size and seconds of each named model, under TABLE_HEAD."""
    for row in hub.catalogue():
        seconds = "-" if row.seconds is None else f"{row.seconds:.1f}"
        yield f"{row.name:<11} {row.role:<10} {row.megabytes['fp32']:>5} {seconds:>7}"


def help_table() -> str:
    """Makes a table of the named models, for the help of a run: name, role, size, seconds and what each model adds."""
    lines = [f"{line}  {row.purpose}" for row, line in zip(hub.catalogue(), _table_lines())]
    return "\n".join(["models", *(f"  {line}" for line in (f"{TABLE_HEAD}  adds", *lines, TABLE_NOTE))])


def _models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon models`; the result has rows, folders or reports, and errors by model."""
    if verb.action == "list":
        return _list_models(console)
    if not verb.names:
        problem = f"models {verb.action} needs a name"
        raise InputError("jsecon", problem, remedy="jsecon models list has the names.")
    return _get_models(verb, console) if verb.action == "get" else _check_models(verb, console)


def _list_models(console: Console) -> verbs.VerbResult:
    """Prints the catalogue: name, role, size, licence, whether it is on this machine, and what it is good for."""
    rows = []
    console.print_line(f"{TABLE_HEAD:<34}  {'here':<10} {'licence':<25} adds")
    for row, line in zip(hub.catalogue(), _table_lines()):
        cached = [each for each in row.megabytes if row.in_precision(each).cached_folder is not None]
        console.print_line(f"{line:<34}  {' '.join(cached) or '-':<10} {row.licence:<25} {row.purpose}")
        rows.append(dataclasses.asdict(row) | {"cached": cached})
    console.print_line(TABLE_NOTE)
    console.print_line(
        "jsecon models get NAME fetches one; hub:owner/name names any other repository of huggingface.co."
    )
    return {"models": rows}


def _get_models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Fetches models, also if an older revision of them is on this machine. One that fails does not stop the others."""
    folders, errors = {}, []
    for name in verb.names:
        models = _candidates(name, verb.role, verb.precision)
        for model in [_usable(models)] if name.startswith(hub.PREFIX) and verb.role is None else models:
            try:
                folder = _folders_of_models({model.role: model}, console, yes=verb.yes, fresh=True)[model.role]
            except InputError as error:
                errors.append(error)
                continue
            console.print_line(f"{name}  {model.role}  {folder}")
            folders[f"{name} ({model.role})"] = folder
    return {"models": folders, "errors": errors}


def _check_models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Lists the graphs of models on this machine, and what jsecon can use them for."""
    with console.progress("start"):
        from jsecon.pipeline.model_loading import inspect_models

    results, errors = [], []
    for name in verb.names:
        with console.progress("graphs"):
            report = inspect_models(_cached_model(name))
        console.print_line(f"{report['folder']}: {len(report['graphs'])} graphs")
        for path, signature in report["graphs"].items():
            console.print_line(f"  {path}\n{textwrap.indent(signature, '    ')}")
        for key, word in (("usable", "usable"), ("unusable", "not usable")):
            for kind, summary in report[key].items():
                console.print_line(f"{kind}: {word}\n  {summary}")
        results.append(report)
        if not report["usable"]:
            problem = f"no model that can be used: neither {', '.join(report['unusable'])}"
            remedy = "See above for what is missing and where such exports are published."
            errors.append(InputError(report["folder"], problem, "", remedy))
    return {"models": results, "errors": errors}


def _cached_model(name: str) -> Path:
    """Returns the folder of a model that is on this machine, by its name, address or folder."""
    if Path(name).exists() and not any(row.name == name for row in hub.catalogue()):
        return Path(name)
    for model in _candidates(name, None, None):
        for precision in get_args(Precision):
            if (folder := dataclasses.replace(model, precision=precision).cached_folder) is not None:
                return folder
    raise InputError(name, "this model is not on this machine", "", f"Fetch it with: jsecon models get {name}")


def _candidates(name: str, role: Role | None, precision: Precision | None) -> list[HubModel]:
    """Returns the models of a name, one for each of its roles; of an address one for each role that it may have."""
    if name.startswith(hub.PREFIX):
        return [hub.parse_address(name, each, precision) for each in get_args(Role) if role in (None, each)]
    if name != AUTO:
        return [row.in_precision(precision) for row in hub.models_of_name(name, role)]
    rows = [hub.models_of_name(each, of)[0] for of, each in hub.RECOMMENDED.items() if role in (None, of)]
    return [row.in_precision(precision) for row in rows]


def _usable(models: Sequence[HubModel]) -> HubModel:
    """Returns the first of the models of a repository that has its files on this machine, else on the hub."""
    for model in models:
        if model.cached_folder is not None:
            return model
    for model in models:
        with contextlib.suppress(hub.NoSuchFilesError):
            hub.plan_download(model)
            return model
    remedy = "jsecon models list has models that work."
    problem = f"it holds no model in {models[0].precision} that jsecon reads"
    raise InputError(models[0].address, problem, "", remedy)
