"""Models by name: which public repository a name stands for, and its files in the cache of the Hugging Face hub.

A user names a model by a name of catalogue.toml ("clip"), by its repository ("hub:owner/name",
"hub:owner/name@revision"), or by a folder. huggingface_hub transfers the files and keeps the cache, so HF_HOME,
HF_ENDPOINT, HF_HUB_OFFLINE and HF_TOKEN work as they do elsewhere. A transfer is planned first (files, size, licence),
so that the user can be asked. Afterwards huggingface_hub compares each file with the hub's hash.
"""

import contextlib
import dataclasses
import difflib
import functools
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from jsecon.errors import InputError, describe_error

Role = Literal["embedder", "segmenter", "tracker"]

Precision = Literal["fp32", "fp16", "int8"]
"""numbers that a graph computes with"""
SUFFIXES: Mapping[Precision, str] = {"fp32": "", "fp16": "_fp16", "int8": "_quantized"}
"""precision -> what public exports append to the name of a graph"""
PREFIX = "hub:"
RECOMMENDED: Mapping[Role, str] = {"segmenter": "edgetam", "embedder": "siglip2"}
"""what `--models auto` takes"""


class _Layout(NamedTuple):
    """The files of one public layout of a model. `{p}` stands for the suffix of the precision."""

    required: tuple[str, ...]
    """files without which the model does not work"""
    optional: tuple[str, ...] = ()
    """files that are fetched where the repository has them"""

    def in_precision(self, precision: Precision) -> "_Layout":
        """Writes the names of the files in one precision."""
        return _Layout(*(tuple(name.format(p=SUFFIXES[precision]) for name in names) for names in self))


_TRACKER = tuple(
    f"onnx/{part}.onnx"
    for part in ("vision_encoder", "mask_decoder", "memory_attention", "memory_encoder", "pointer_tpos")
)
_LAYOUTS: Mapping[Role, tuple[_Layout, ...]] = {
    "embedder": (
        _Layout(
            ("onnx/vision_model{p}.onnx", "onnx/text_model{p}.onnx", "preprocessor_config.json", "tokenizer.json"),
            ("config.json", "tokenizer_config.json", "logits.json"),
        ),
        _Layout(
            ("visual/model{p}.onnx", "textual/model{p}.onnx", "visual/preprocess_cfg.json", "textual/tokenizer.json"),
            ("config.json", "textual/tokenizer_config.json", "logits.json"),
        ),
    ),
    "segmenter": (
        _Layout(
            ("onnx/vision_encoder{p}.onnx", "onnx/prompt_encoder_mask_decoder{p}.onnx", "preprocessor_config.json"),
        ),
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
    precision: Precision = "fp32"
    """Precision of its graphs."""
    name: str = ""
    """Its name in the catalogue; empty for any other model."""
    megabytes: Mapping[Precision, int] = dataclasses.field(default_factory=dict)
    """Size of the files by precision. A repository of the catalogue is offered in these precisions alone."""
    licence: str = ""
    """Licence of the weights."""
    purpose: str = ""
    """What it is good for, in one sentence."""
    seconds: float | None = None
    """Seconds of a frame in fp32 on two cores of a Xeon with AVX-512: of a segmenter with 70 guided prompts, of an
    embedder for 40 regions, of a tracker for one object. None if they were not measured."""

    @property
    def address(self) -> str:
        """The model as a user can type it: "hub:owner/name@revision"."""
        return f"{PREFIX}{self.repository}@{self.revision}"

    @property
    def get_command(self) -> str:
        """The command that fetches the model."""
        precision = "" if self.precision == "fp32" else f" --precision {self.precision}"
        return f"jsecon models get {self.name or self.address} --role {self.role}{precision}"

    @property
    def cached_folder(self) -> Path | None:
        """Folder of its files in the hub's cache, looked up without a request; None if one of them is not there."""
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import LocalEntryNotFoundError

        for layout in _LAYOUTS[self.role]:
            required, optional = layout.in_precision(self.precision)
            patterns = [*required, *optional, *(f"{name}_data*" for name in required)]
            with contextlib.suppress(LocalEntryNotFoundError, ValueError):  # ValueError: no name of a repository
                folder = snapshot_download(
                    self.repository, revision=self.revision, local_files_only=True, allow_patterns=patterns
                )
                if all((Path(folder) / name).is_file() for name in required):
                    return Path(folder)
        return None

    def in_precision(self, precision: Precision | None) -> "HubModel":
        """Returns the model with graphs in a precision, by default fp32, or raises InputError if it is not offered.

        Models of masks stay in fp32 if they have no other precision.
        """
        precision = precision or "fp32"
        if self.megabytes and precision not in self.megabytes:
            if self.role == "embedder":
                problem = f"{self.name or self.repository} is not offered in {precision}"
                raise InputError("--precision", problem, "", f"Use {' or '.join(self.megabytes)}.")
            precision = "fp32"
        return dataclasses.replace(self, precision=precision)


@functools.cache
def catalogue() -> tuple[HubModel, ...]:
    """Reads the table of named models, catalogue.toml beside this file."""
    rows = tomllib.loads(Path(__file__).with_name("catalogue.toml").read_text())["model"]
    return tuple(HubModel(**row) for row in rows)


def _published(role: Role) -> str:
    """Says in a sentence where models of a role are published."""
    names = ", ".join(row.repository for row in catalogue() if row.role == role)
    return f"Such models are published on huggingface.co: {names}, and others of the same layout."


def parse_model(choice: str | Path, role: Role, precision: Precision | None = None) -> HubModel | Path:
    """Reads what a user gave for a model, or raises InputError.

    A name of the catalogue comes before a folder of that name here, which "./clip" or a `Path` means.

    Args:
      choice: A name, "hub:owner/name", "hub:owner/name@revision", or a folder.
      role: What the model is for.
      precision: Precision of a model of the hub; None takes fp32.
    """
    if isinstance(choice, Path):
        return choice
    if choice.startswith(PREFIX):
        return parse_address(choice, role, precision)
    is_name = any((row.name, row.role) == (choice, role) for row in catalogue())
    if choice.strip() and not is_name and Path(choice).exists():
        return Path(choice)
    return models_of_name(choice, role)[0].in_precision(precision)


def parse_address(text: str, role: Role, precision: Precision | None = None) -> HubModel:
    """Reads "hub:owner/name" or "hub:owner/name@revision", or raises InputError."""
    address = re.fullmatch(rf"{PREFIX}([\w.-]+/[\w.-]+?)(?:@([\w./-]+))?", text)
    if address is None:
        raise InputError(text, "not the address of a model", "", "Write hub:owner/name or hub:owner/name@revision.")
    repository, revision = address[1], address[2] or "main"
    row = _row_of_repository(role, repository)
    if row is None:
        return HubModel(role, repository, revision, precision or "fp32")
    if revision != row.revision:
        row = dataclasses.replace(row, revision=revision, name="")
    return row.in_precision(precision)


def models_of_name(name: str, role: Role | None) -> list[HubModel]:
    """Looks up the models of a name in the catalogue, at least one, for a role or for any; else raises InputError."""
    rows = [row for row in catalogue() if role in (None, row.role)]
    if matches := [row for row in rows if row.name == name]:
        return matches
    names = list(dict.fromkeys(row.name for row in rows))
    similar = [f"the {row.role} {name}" for row in catalogue() if row.name == name]
    similar += difflib.get_close_matches(name, names, 1)
    if re.fullmatch(r"[\w-][\w.-]*/[\w.-]+(@[\w./-]+)?", name):
        similar = [f"{PREFIX}{name}"]
    suggestion = f"Did you mean {similar[0]}? " if similar else ""
    remedy = f"{suggestion}Known names: {', '.join(names)}. Or give a folder, or hub:owner/name."
    raise InputError(repr(name), f"no folder and no known {role or 'model'}", "", remedy)


def _row_of_repository(role: Role, repository: str) -> HubModel | None:
    """Returns the row of the catalogue that a repository has."""
    return next((row for row in catalogue() if (row.role, row.repository) == (role, repository)), None)


def model_name(folder: str | Path, role: Role) -> str:
    """Returns the name of the model of a folder: that of the catalogue, or that of the folder."""
    folder = Path(folder)
    repository = (cached_address(folder) or "").removeprefix(PREFIX).partition("@")[0]
    row = _row_of_repository(role, repository)
    return folder.name if row is None else row.name


def cached_address(folder: Path) -> str | None:
    """Returns the address "hub:owner/name@commit" of a folder of the hub's cache; None for every other folder."""
    parts = folder.absolute().parts
    if len(parts) < 3 or parts[-2] != "snapshots" or not parts[-3].startswith("models--"):
        return None
    return f"{PREFIX}{parts[-3].removeprefix('models--').replace('--', '/')}@{parts[-1]}"


def find_files(folder: str | Path, role: Role, precision: Precision | None = None) -> list[Path]:
    """Finds the required files of a model in a folder, in the order of its layout, or raises InputError.

    Args:
      folder: The folder.
      role: What the model is for.
      precision: Precision of its graphs. None takes the highest that is there, as models of masks do that lack it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "", _published(role))
    precisions: list[Precision] = [precision] if precision is not None else []
    if precision is None or role != "embedder":
        precisions += SUFFIXES
    layout = _present_layout(role, precisions, lambda name: (folder / name).is_file(), folder, _published(role))
    return [folder / name for name in layout.required]


def _present_layout(
    role: Role, precisions: list[Precision], exists: Callable[[str], object], where: object, remedy: str
) -> _Layout:
    """Returns the first layout whose required files exist, in the first precision in which they do."""
    missing = []
    for precision in precisions:
        for layout in _LAYOUTS[role]:
            named = layout.in_precision(precision)
            missing.append([name for name in named.required if not exists(name)])
            if not missing[-1]:
                return named
    raise InputError(where, f"no {role}, since it lacks {', '.join(min(missing, key=len))}", "", remedy)


@dataclasses.dataclass(frozen=True)
class Download:
    """What has to be fetched for a model."""

    model: HubModel
    sizes: Mapping[str, int]
    """Files that the model needs, with their bytes."""
    licence: str
    """Licence by the repository's own card, or "not stated"."""

    def __str__(self) -> str:
        """Describes it on one line."""
        megabytes = max(round(sum(self.sizes.values()) / 1e6), 1)
        return f"{self.model.address} ({len(self.sizes)} files, {megabytes:,} MB, licence: {self.licence})"


def plan_download(model: HubModel) -> Download:
    """Asks the hub which files a model needs, or raises InputError."""
    from huggingface_hub import HfApi

    with _hub_errors(model):
        info = HfApi().model_info(model.repository, revision=model.revision, files_metadata=True)
    sizes = {file.rfilename: file.size or 0 for file in info.siblings or ()}
    remedy = f"Choose another repository or --precision. `jsecon models list` has {model.role} models that work."
    layout = _present_layout(model.role, [model.precision], sizes.__contains__, model.address, remedy)
    data = tuple(f"{name}_data" for name in layout.required)
    needed = {
        path: size
        for path, size in sizes.items()
        if path in (*layout.required, *layout.optional) or path.startswith(data)
    }
    licences = [tag.removeprefix("license:") for tag in info.tags or () if tag.startswith("license:")]
    return Download(model, needed, ", ".join(licences) or "not stated")


def fetch(download: Download) -> Path:
    """Brings the files of a model into the hub's cache, or raises InputError; returns their folder.

    What is there already stays, and a transfer that broke goes on. A file that differs from its hash is removed.
    """
    from huggingface_hub import HfApi, snapshot_download

    model = download.model
    with _hub_errors(model):
        names = list(download.sizes)
        folder = Path(snapshot_download(model.repository, revision=model.revision, allow_patterns=names))
        check = HfApi().verify_repo_checksums(model.repository, revision=folder.name, local_dir=folder)
    damaged = [mismatch["path"] for mismatch in check.mismatches]
    for path in damaged:
        (folder / path).resolve().unlink(missing_ok=True)
        (folder / path).unlink(missing_ok=True)
    if damaged:
        problem = "its content differs from the hash that the hub gives for it, so it was removed"
        raise InputError(f"{model.address} {', '.join(damaged)}", problem, "", f"Fetch it again: {model.get_command}")
    return folder


@contextlib.contextmanager
def _hub_errors(model: HubModel) -> Iterator[None]:
    """Turns the errors of requests into an InputError: those of the network have no base in common."""
    try:
        yield
    except Exception as error:
        cause: BaseException = error
        while isinstance(cause, FileNotFoundError) and cause.__cause__ is not None:  # LocalEntryNotFoundError
            cause = cause.__cause__
        problem, remedy = _explain(model, cause)
        raise InputError(model.address, problem, "", remedy) from error


def _explain(model: HubModel, error: BaseException) -> tuple[str, str]:
    """Returns what is wrong and what to do, for an error during a request."""
    from huggingface_hub import constants, errors

    page, get = f"{constants.ENDPOINT}/{model.repository}", model.get_command
    match error:  # in this order: GatedRepoError is a RepositoryNotFoundError
        case errors.OfflineModeIsEnabled():
            return "not in the cache, and HF_HUB_OFFLINE forbids requests", f"Unset HF_HUB_OFFLINE, then {get}"
        case errors.GatedRepoError():
            remedy = f"Accept its licence on {page}, set HF_TOKEN to a token of your account, then {get}"
            return "its owner grants access to accounts only", remedy
        case errors.RevisionNotFoundError():
            return f"the repository has no revision {model.revision}", f"See {page}/commits/main for those it has."
        case errors.RepositoryNotFoundError():
            remedy = "Check the name; for a private one set HF_TOKEN."
            return "the hub has no such repository, or it is private", remedy
    remedy = f"Check the network and the disk. Run it again: {get}"
    return f"not fetched from {constants.ENDPOINT} ({describe_error(error)})", remedy
