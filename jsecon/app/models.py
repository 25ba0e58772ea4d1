"""Models by name on the command line: which ones there are, fetching them after asking, and removing them."""

import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Mapping
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
      console: Where to say and ask.
      yes: Fetch without asking.

    Returns:
      The options with folders.

    Raises:
      InputError: A name is unknown, a model cannot be fetched, or the user declines.
    """
    precision = getattr(options, "precision", None)
    recommended = hub.RECOMMENDED if getattr(options, "models", None) == AUTO else {}
    models = {}
    for role in get_args(Role):
        value = getattr(options, role, None) or recommended.get(role)
        if value is not None:
            models[role] = hub.parse_model(str(value), role, precision)
    return dataclasses.replace(options, **_folders_of_models(models, console, yes=yes))


def _folders_of_models(
    models: Mapping[Role, HubModel | Path], console: Console, *, yes: bool, fresh: bool = False
) -> dict[Role, Path]:
    """Returns the folders of models, after fetching those that are missing; `fresh` fetches all as they are now."""
    folders: dict[Role, Path] = {}
    missing: dict[Role, HubModel] = {}
    for role, model in models.items():
        folder = model if isinstance(model, Path) else None if fresh else model.cached_folder
        if folder is not None:
            folders[role] = folder
        elif isinstance(model, HubModel):
            missing[role] = model
    if not missing:
        return folders
    with console.progress("hub"):
        downloads: list[tuple[Role, hub.Download]] = [(role, hub.plan_download(m)) for role, m in missing.items()]
    for _, download in downloads:
        console.note(f"needs {download}" if not yes else f"fetching {download}")
    if not yes:
        commands = "; ".join(model.get_command for model in missing.values())
        where = " ".join(model.address for model in missing.values())
        if not sys.stdin.isatty():
            raise InputError(where, "not on this machine", "", f"Fetch with: {commands}. Or add --yes.")
        if input("Fetch now? [y/N] ").strip().lower() not in ("y", "yes"):
            raise InputError(where, "not fetched", "", f"To fetch later: {commands}.")
    for role, download in downloads:
        folders[role] = hub.fetch(download)
    return folders


def open_embedder(field: Any, verb: verbs.FieldVerb, console: Console) -> Any:
    """Opens the embedder of a field for a verb, and warns of a field of an earlier version.

    Args:
      field: The `LanguageField`.
      verb: States the model and its templates, and whether to fetch a missing model without asking.
      console: Where to say and ask.

    Returns:
      The embedder.

    Raises:
      InputError: The model is not on this machine, or is another one.
    """
    from jsecon.pipeline import networks

    if field.reference is None:
        console.note(OLD_FIELD)
    folder = with_models(verb, console, yes=verb.yes).embedder
    if folder is None and verb.yes and (missing := networks.missing_model_of_field(field)) is not None:
        _folders_of_models({"embedder": missing}, console, yes=True)
    return networks.field_embedder(field, folder, templates=verb.template or ("{}",))


AUTO = "auto"
"""in place of a name: the recommended models"""
TABLE_HEAD = f"{'name':<11} {'role':<10} {'MB':>5} {'s/frame':>7}"
TABLE_NOTE = (
    "MB and seconds are of the default precision: a frame of 400x300 on two cores, 40 regions or one object in it."
)


def _table_lines() -> Iterator[str]:
    """Yields name, role, size and seconds of each named model, under TABLE_HEAD."""
    for row in hub.catalogue():
        seconds = f"{row.seconds[row.precision]:.1f}" if row.precision in row.seconds else "-"
        yield f"{row.name:<11} {row.role:<10} {row.megabytes[row.precision]:>5} {seconds:>7}"


def help_table() -> str:
    """Makes a table of the named models, for the help of a run.

    Returns:
      Lines with name, role, size, seconds and what each model adds.
    """
    lines = [f"{line}  {row.purpose}" for row, line in zip(hub.catalogue(), _table_lines())]
    return "\n".join(["models", *(f"  {line}" for line in (f"{TABLE_HEAD}  adds", *lines, TABLE_NOTE))])


def models_verb(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon models`.

    Args:
      verb: Its options.
      console: Receives the lines of the action, and asks before it fetches.

    Returns:
      Rows, folders, freed bytes or reports, and the errors of the models that an action failed for.

    Raises:
      InputError: A name is missing or unknown, or the model is not on this machine.
    """
    if verb.action == "list":
        return _list_models(console)
    if not verb.names:
        problem = f"models {verb.action} needs a name"
        raise InputError("jsecon", problem, remedy="jsecon models list has the names.")
    act = {"get": _get_models, "remove": _remove_models, "check": _check_models}[verb.action]
    return act(verb, console)


def _list_models(console: Console) -> verbs.VerbResult:
    """Prints the catalogue: name, role, size, licence, whether it is on this machine, and what it is good for."""
    rows = list(hub.catalogue_rows())
    console.say(f"{TABLE_HEAD:<34}  {'here':<10} {'licence':<25} adds")
    for row, line in zip(rows, _table_lines()):
        here = " ".join(row["cached"]) or "-"
        console.say(f"{line:<34}  {here:<10} {row['licence']:<25} {row['purpose']}")
    console.say(TABLE_NOTE)
    console.say("jsecon models get NAME fetches one; hub:owner/name names any other repository of huggingface.co.")
    return {"models": rows}


def _get_models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Fetches models, also if an older revision of them is on this machine. One that fails does not stop the others."""
    folders, errors = {}, []
    models = [(name, model) for name in verb.names for model in _models_of(name, verb.role, verb.precision)]
    for name, model in models:
        try:
            folder = _folders_of_models({model.role: model}, console, yes=verb.yes, fresh=True)[model.role]
        except InputError as error:
            errors.append(error)
            continue
        console.say(f"{name}  {model.role}  {folder}")
        folders[f"{name} ({model.role})"] = folder
    return {"models": folders, "errors": errors}


def _remove_models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Removes models from the hub's cache, and prints how much was freed."""
    freed = 0
    for name in verb.names:
        repositories = {model.repository: model for model in _models_of(name, None, None)}
        freed += sum(hub.remove(model) for model in repositories.values())
    console.say(f"{freed / 1e6:.0f} MB freed")
    return {"freed": freed}


def _check_models(verb: verbs.Models, console: Console) -> verbs.VerbResult:
    """Lists the graphs of models on this machine, and what jsecon can use them for."""
    with console.progress("start"):
        from jsecon.pipeline.models import inspect_models

    results, errors = [], []
    for name in verb.names:
        with console.progress("graphs"):
            report = inspect_models(_cached_model(name))
        for line in report.lines:
            console.say(line)
        results.append(dataclasses.asdict(report))
        errors += report.errors
    return {"models": results, "errors": errors}


def _cached_model(name: str) -> Path:
    """Returns the folder of a model that is on this machine, by its name, address or folder."""
    if Path(name).exists():
        return Path(name)
    models = _models_of(name, None, None)
    exact = [dataclasses.replace(model, precision=p) for model in models for p in get_args(Precision)]
    folder = next(filter(None, (model.cached_folder for model in exact)), None)
    if folder is None:
        raise InputError(name, "this model is not on this machine", "", f"Fetch it with: {models[0].get_command}")
    return folder


def _models_of(name: str, role: Role | None, precision: Precision | None) -> list[HubModel]:
    """Returns the models of a name, one for each of its roles."""
    if name == AUTO:
        recommended: list[Role] = [each for each in hub.RECOMMENDED if role is None or each == role]
        return [model for each in recommended for model in _models_of(hub.RECOMMENDED[each], each, precision)]
    if name.startswith(hub.PREFIX):
        roles: list[Role] = [role or _role_of_repository(name)]
    else:
        roles = [row.role for row in hub.catalogue() if row.name == name and role in (None, row.role)]
        if not roles:
            known = ", ".join(dict.fromkeys(row.name for row in hub.catalogue() if role in (None, row.role)))
            raise InputError(name, "no known model", "", f"Known names: {known}. Or give hub:owner/name.")
    models = [hub.parse_model(name, each, precision) for each in roles]
    on_hub = [model for model in models if isinstance(model, HubModel)]
    if len(on_hub) < len(models):
        remedy = "Run this in another folder, or name hub:owner/name."
        raise InputError(name, "a folder of this name lies here", "", remedy)
    return on_hub


def _role_of_repository(address: str) -> Role:
    """Returns the first role whose files a repository has, on this machine or on the hub."""
    models = [model for role in hub.LAYOUTS if isinstance(model := hub.parse_model(address, role), HubModel)]
    for model in models:
        if model.cached_folder is not None:
            return model.role
    for model in models:
        with contextlib.suppress(hub.NoSuchFilesError):
            hub.plan_download(model)
            return model.role
    raise InputError(address, "it holds no model that jsecon reads", "", "jsecon models list has models that work.")
