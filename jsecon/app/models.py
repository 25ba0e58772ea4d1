"""Models by name on the command line: which ones there are, fetching them after asking, and removing them."""

import contextlib
import dataclasses
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from jsecon.errors import InputError
from jsecon.networks.hub import (
    LAYOUTS,
    PREFIX,
    RECOMMENDED,
    Download,
    HubModel,
    NoSuchFilesError,
    Precision,
    Role,
    cached_folder,
    catalogue,
    catalogue_rows,
    fetch,
    get_command,
    parse_model,
    plan_download,
    remove,
)
from jsecon.pipeline.progress import Console

T = TypeVar("T", bound=Any)


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
    recommended = RECOMMENDED if getattr(options, "models", None) == "auto" else {}
    models = {}
    for role in get_args(Role):
        value = getattr(options, role, None) or recommended.get(role)
        if value is not None:
            models[role] = parse_model(str(value), role, precision)
    return dataclasses.replace(options, **folders_of_models(models, console, yes=yes))


def folders_of_models(
    models: Mapping[Role, HubModel | Path], console: Console, *, yes: bool, fresh: bool = False
) -> dict[Role, Path]:
    """Finds the folders of models, and fetches those that are not on this machine.

    Args:
      models: The models, or their folders, by role.
      console: Where to say and ask.
      yes: Fetch without asking.
      fresh: Fetch the present revision also of models that are on this machine.

    Returns:
      The folders by role.

    Raises:
      InputError: A model cannot be fetched, or the user declines.
    """
    folders: dict[Role, Path] = {}
    missing: dict[Role, HubModel] = {}
    for role, model in models.items():
        folder = model if isinstance(model, Path) else None if fresh else cached_folder(model)
        if folder is not None:
            folders[role] = folder
        elif isinstance(model, HubModel):
            missing[role] = model
    if not missing:
        return folders
    with console.progress("hub"):
        downloads: list[tuple[Role, Download]] = [(role, plan_download(model)) for role, model in missing.items()]
    for _, download in downloads:
        console.note(f"fetching {download}")
    if not yes:
        commands = "; ".join(get_command(model) for model in missing.values())
        where = " ".join(model.address for model in missing.values())
        if not sys.stdin.isatty():
            raise InputError(where, "not on this machine", "", f"Fetch with: {commands}. Or add --yes.")
        if input("Fetch now? [y/N] ").strip().lower() not in ("y", "yes"):
            raise InputError(where, "not fetched", "", f"To fetch later: {commands}.")
    for role, download in downloads:
        folders[role] = fetch(download)
    return folders


TABLE_HEAD = f"{'name':<11} {'role':<10} {'MB':>5} {'s/frame':>7}"
TABLE_NOTE = (
    "MB and seconds are of the default precision: a frame of 400x300 on two cores, 40 regions or one object in it."
)


def table_lines() -> Iterator[str]:
    """Yields name, role, size and seconds of each named model, under TABLE_HEAD."""
    for row in catalogue():
        seconds = f"{row.seconds[row.precision]:.1f}" if row.precision in row.seconds else "-"
        yield f"{row.name:<11} {row.role:<10} {row.megabytes[row.precision]:>5} {seconds:>7}"


def help_table() -> str:
    """Returns a table of the named models and what each adds, for the help of a run."""
    lines = [f"{line}  {row.purpose}" for row, line in zip(catalogue(), table_lines())]
    return "\n".join(["models", *(f"  {line}" for line in (f"{TABLE_HEAD}  adds", *lines, TABLE_NOTE))])


def list_models(console: Console) -> dict[str, Any]:
    """Prints the catalogue: name, role, size, licence, whether it is on this machine, and what it is good for."""
    rows = list(catalogue_rows())
    console.say(f"{TABLE_HEAD:<34}  {'here':<10} {'licence':<25} adds")
    for row, line in zip(rows, table_lines()):
        here = " ".join(row["cached"]) or "-"
        console.say(f"{line:<34}  {here:<10} {row['licence']:<25} {row['purpose']}")
    console.say(TABLE_NOTE)
    console.say("jsecon models get NAME fetches one; hub:owner/name names any other repository of huggingface.co.")
    return {"models": rows}


def get_models(
    names: Sequence[str], role: Role | None, precision: Precision | None, console: Console, *, yes: bool
) -> dict[str, Any]:
    """Fetches models, also if an older revision of them is on this machine.

    Args:
      names: Names or addresses.
      role: What they are for; None takes every role that a name has.
      precision: Precision of their graphs, or None for the defaults.
      console: Where to say and ask.
      yes: Fetch without asking.

    Returns:
      {"models": name -> folder}.

    Raises:
      InputError: A name is unknown, or a model cannot be fetched.
    """
    folders = {}
    for name in names:
        for model in _models_of(name, role, precision):
            folder = folders_of_models({model.role: model}, console, yes=yes, fresh=True)[model.role]
            console.say(f"{name}  {model.role}  {folder}")
            folders[f"{name} ({model.role})"] = folder
    return {"models": folders}


def remove_models(names: Sequence[str], console: Console) -> dict[str, Any]:
    """Removes models from the hub's cache.

    Args:
      names: Names or addresses.
      console: Where to say what was freed.

    Returns:
      {"freed": bytes}.

    Raises:
      InputError: A name is unknown.
    """
    freed = 0
    for name in names:
        repositories = {model.repository: model for model in _models_of(name, None, None)}
        freed += sum(remove(model) for model in repositories.values())
    console.say(f"{freed / 1e6:.0f} MB freed")
    return {"freed": freed}


def cached_model(name: str) -> Path:
    """Finds the folder of a model that is on this machine.

    Args:
      name: A name, an address or a folder.

    Returns:
      The folder.

    Raises:
      InputError: The name is unknown, or the model is not on this machine.
    """
    if Path(name).exists():
        return Path(name)
    models = _models_of(name, None, None)
    folders = [cached_folder(dataclasses.replace(model, precision=p)) for model in models for p in get_args(Precision)]
    folder = next((folder for folder in folders if folder is not None), None)
    if folder is None:
        raise InputError(name, "this model is not on this machine", "", f"Fetch it with: {get_command(models[0])}")
    return folder


def _models_of(name: str, role: Role | None, precision: Precision | None) -> list[HubModel]:
    """Returns the models of a name, one for each of its roles."""
    if name.startswith(PREFIX):
        roles: list[Role] = [role or _role_of_repository(name)]
    else:
        roles = [row.role for row in catalogue() if row.name == name and role in (None, row.role)]
        if not roles:
            known = ", ".join(dict.fromkeys(row.name for row in catalogue() if role in (None, row.role)))
            raise InputError(name, "no known model", "", f"Known names: {known}. Or give hub:owner/name.")
    models = [parse_model(name, each, precision) for each in roles]
    on_hub = [model for model in models if isinstance(model, HubModel)]
    if len(on_hub) < len(models):
        raise InputError(
            name, "a folder of this name lies here", "", "Run this in another folder, or name hub:owner/name."
        )
    return on_hub


def _role_of_repository(address: str) -> Role:
    """Returns the first role whose files a repository has, on this machine or on the hub."""
    for role in LAYOUTS:
        model = parse_model(address, role)
        assert isinstance(model, HubModel)
        if cached_folder(model) is not None:
            return role
    for role in LAYOUTS:
        model = parse_model(address, role)
        assert isinstance(model, HubModel)
        with contextlib.suppress(NoSuchFilesError):
            plan_download(model)
            return role
    raise InputError(address, "it holds no model that jsecon reads", "", "jsecon models list has models that work.")
