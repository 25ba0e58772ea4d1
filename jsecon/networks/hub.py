"""Models by name: which public repository a name stands for, and its files in the cache of the Hugging Face hub.

A user names a model by a name of catalogue.toml ("clip"), by its repository ("hub:owner/name",
"hub:owner/name@revision"), or by a folder. huggingface_hub transfers the files and keeps the cache, so HF_HOME,
HF_ENDPOINT, HF_HUB_OFFLINE and HF_TOKEN work as they do elsewhere. Afterwards each file is compared with the hub's
hash.
"""

import contextlib
import dataclasses
import functools
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from jsecon.errors import InputError, describe_error

Role = Literal["embedder", "segmenter", "tracker"]

PREFIX = "hub:"
RECOMMENDED: Mapping[Role, str] = {"segmenter": "edgetam", "embedder": "siglip2"}
"""what `--models auto` takes"""


class _Layout(NamedTuple):
    """The files of one public layout of a model."""

    required: tuple[str, ...]
    """files without which the model does not work"""
    optional: tuple[str, ...] = ()
    """files that are fetched where the repository has them"""


_TRACKER = tuple(
    f"onnx/{part}.onnx"
    for part in ("vision_encoder", "mask_decoder", "memory_attention", "memory_encoder", "pointer_tpos")
)
_LAYOUTS: Mapping[Role, tuple[_Layout, ...]] = {
    "embedder": (
        _Layout(
            ("onnx/vision_model.onnx", "onnx/text_model.onnx", "preprocessor_config.json", "tokenizer.json"),
            ("config.json", "tokenizer_config.json"),
        ),
        _Layout(
            ("visual/model.onnx", "textual/model.onnx", "visual/preprocess_cfg.json", "textual/tokenizer.json"),
            ("config.json", "textual/tokenizer_config.json"),
        ),
    ),
    "segmenter": (
        _Layout(("onnx/vision_encoder.onnx", "onnx/prompt_encoder_mask_decoder.onnx", "preprocessor_config.json")),
    ),
    "tracker": (_Layout((*_TRACKER, "constants.json")), _Layout((*_TRACKER, "onnx/constants.json"))),
}
"""role -> the layouts that its public exports have. A graph's external data (`.onnx_data`) comes with the graph."""


@dataclasses.dataclass(frozen=True)
class HubModel:
    """A model of the hub: a row of the catalogue, or a repository that the user names."""

    role: Role
    """What it does in jsecon."""
    repository: str
    """"owner/name"."""
    revision: str = "main"
    """Commit, branch or tag."""
    name: str = ""
    """Its name in the catalogue; empty for any other model."""
    megabytes: int | None = None
    """Size of the files."""
    licence: str = ""
    """Licence of the weights."""
    purpose: str = ""
    """What it is good for, in one sentence."""

    @property
    def address(self) -> str:
        """The model as a user can type it: "hub:owner/name@revision"."""
        return f"{PREFIX}{self.repository}@{self.revision}"

    @property
    def get_command(self) -> str:
        """The command that fetches the model."""
        return f"jsecon models get {self.name or self.address} --role {self.role}"

    @property
    def cached_folder(self) -> Path | None:
        """Folder of its files in the hub's cache, looked up without a request; None if one of them is not there."""
        from huggingface_hub import try_to_load_from_cache

        for required, _ in _LAYOUTS[self.role]:
            with contextlib.suppress(ValueError):  # no name of a repository
                files = [try_to_load_from_cache(self.repository, name, revision=self.revision) for name in required]
                if all(isinstance(file, str) for file in files):
                    return Path(str(files[0])).parents[required[0].count("/")]
        return None


@functools.cache
def catalogue() -> tuple[HubModel, ...]:
    """Reads the table of named models, catalogue.toml beside this file."""
    rows = tomllib.loads(Path(__file__).with_name("catalogue.toml").read_text())["model"]
    return tuple(HubModel(**row) for row in rows)


def parse_model(choice: str | Path, role: Role) -> HubModel | Path:
    """Reads what a user gave for a model, or raises InputError.

    A name of the catalogue comes before a folder of that name here, which "./clip" or a `Path` means.

    Args:
      choice: A name, "hub:owner/name", "hub:owner/name@revision", or a folder.
      role: What the model is for.
    """
    if isinstance(choice, Path):
        return choice
    is_known = choice.startswith(PREFIX) or any((row.name, row.role) == (choice, role) for row in catalogue())
    if choice.strip() and not is_known and Path(choice).exists():
        return Path(choice)
    return models_of_name(choice, role)[0]


def _parse_address(text: str, role: Role) -> HubModel:
    """Reads "hub:owner/name" or "hub:owner/name@revision", or raises InputError."""
    address = re.fullmatch(rf"{PREFIX}([\w.-]+/[\w.-]+?)(?:@([\w./-]+))?", text)
    if address is None:
        raise InputError(text, "not the address of a model", "", "Write hub:owner/name or hub:owner/name@revision.")
    return HubModel(role, address[1], address[2] or "main")


def models_of_name(name: str, role: Role | None) -> list[HubModel]:
    """Looks up the models of a name or an address, at least one, for a role or for any; else raises InputError.

    The name "auto" stands for RECOMMENDED. An address may be a model of every role.
    """
    roles = get_args(Role) if role is None else (role,)
    if name.startswith(PREFIX):
        return [_parse_address(name, each) for each in roles]
    names_of_roles = RECOMMENDED if name == "auto" else dict.fromkeys(roles, name)
    rows = [row for row in catalogue() if row.role in roles]
    if matches := [row for row in rows if row.name == names_of_roles.get(row.role)]:
        return matches
    names = ", ".join(dict.fromkeys(row.name for row in rows))
    remedy = f"Known names: {names}. Or give a folder, or hub:owner/name."
    raise InputError(repr(name), f"no folder and no known {role or 'model'}", "", remedy)


def cached_address(folder: Path) -> str | None:
    """Returns the address "hub:owner/name@commit" of a folder of the hub's cache; None for every other folder."""
    parts = folder.absolute().parts
    if len(parts) < 3 or parts[-2] != "snapshots" or not parts[-3].startswith("models--"):
        return None
    return f"{PREFIX}{parts[-3].removeprefix('models--').replace('--', '/')}@{parts[-1]}"


def find_files(folder: str | Path, role: Role) -> list[Path]:
    """Finds the required files of a model in a folder, in the order of its layout, or raises InputError."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "", "Check the path of the model.")
    layout = _present_layout(role, lambda name: (folder / name).is_file(), folder)
    return [folder / name for name in layout.required]


def _present_layout(role: Role, exists: Callable[[str], object], where: object) -> _Layout:
    """Returns the first layout whose required files exist, or raises InputError."""
    missing = []
    for layout in _LAYOUTS[role]:
        missing.append([name for name in layout.required if not exists(name)])
        if not missing[-1]:
            return layout
    remedy = f"`jsecon models list` names models of huggingface.co that work as {role}."
    raise InputError(where, f"no {role}, since it lacks {', '.join(min(missing, key=len))}", "", remedy)


def fetch(model: HubModel, note: Callable[[str], None]) -> Path:
    """Brings the files of a model into the hub's cache, or raises InputError; returns their folder.

    What is there already stays, and a transfer that broke goes on. A file that differs from its hash is removed. `note`
    takes a line with address, size and licence, before the transfer.
    """
    from huggingface_hub import HfApi, snapshot_download

    with _hub_errors(model):
        info = HfApi().model_info(model.repository, revision=model.revision, files_metadata=True)
        sizes = {file.rfilename: file.size or 0 for file in info.siblings or ()}
        layout = _present_layout(model.role, sizes.__contains__, model.address)
        data = tuple(f"{name}_data" for name in layout.required)
        names = [name for name in sizes if name in layout.required + layout.optional or name.startswith(data)]
        licences = [tag.removeprefix("license:") for tag in info.tags or () if tag.startswith("license:")]
        megabytes = max(round(sum(sizes[name] for name in names) / 1e6), 1)
        note(f"{model.address} ({megabytes:,} MB, licence: {', '.join(licences) or 'not stated'})")
        folder = Path(snapshot_download(model.repository, revision=model.revision, allow_patterns=names))
        check = HfApi().verify_repo_checksums(model.repository, revision=folder.name, local_dir=folder)
    damaged = [mismatch["path"] for mismatch in check.mismatches]
    for path in damaged:
        (folder / path).resolve().unlink()
        (folder / path).unlink(missing_ok=True)  # the link to it
    if damaged:
        problem = "its content differs from the hash that the hub gives for it, so it was removed"
        raise InputError(f"{model.address} {', '.join(damaged)}", problem, "", f"Fetch it again: {model.get_command}")
    return folder


@contextlib.contextmanager
def _hub_errors(model: HubModel) -> Iterator[None]:
    """Turns the errors of requests into an InputError: those of the network have no base in common."""
    from huggingface_hub import constants, errors

    try:
        yield
    except InputError:
        raise
    except Exception as error:
        cause: BaseException = error
        while isinstance(cause, FileNotFoundError) and cause.__cause__ is not None:  # LocalEntryNotFoundError
            cause = cause.__cause__
        problem = f"not fetched from {constants.ENDPOINT} ({describe_error(cause)})"
        remedy = f"Check the network, the disk and HF_HUB_OFFLINE. Run it again: {model.get_command}"
        if isinstance(cause, errors.RepositoryNotFoundError | errors.RevisionNotFoundError):  # also GatedRepoError
            problem = "the hub has no such repository or revision, or grants access to accounts only"
            page = f"{constants.ENDPOINT}/{model.repository}"
            remedy = f"Check {page}. Accept its licence there, and set HF_TOKEN to a token of your account."
        raise InputError(model.address, problem, "", remedy) from error
