"""Models by name: which public repository a name stands for, and its files in the cache of the Hugging Face hub.

A model is asked for by a name of catalogue.toml ("clip"), by repository ("hub:owner/name", "hub:owner/name@revision"),
or by folder. huggingface_hub transfers the files and keeps the cache, so HF_HOME, HF_ENDPOINT, HF_HUB_OFFLINE and
HF_TOKEN work as they do elsewhere. A transfer is planned first (`plan_download`: files, size, licence), so that a user
can be asked before anything is fetched. Afterwards each file is compared with the hub's hash.
"""

import contextlib
import dataclasses
import difflib
import errno
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


class NoSuchFilesError(InputError):
    """A folder or repository lacks files of every layout of a role."""


class Layout(NamedTuple):
    """The files of one public layout of a model. `{p}` stands for the suffix of the precision."""

    required: tuple[str, ...]
    """files without which the model does not work"""
    optional: tuple[str, ...] = ()
    """files that are fetched where the repository has them"""


def _in_precision(layout: Layout, precision: Precision) -> Layout:
    """Returns the names of the files in one precision."""
    suffix = SUFFIXES[precision]
    return Layout(*(tuple(name.format(p=suffix) for name in names) for names in layout))


_TRACKER = tuple(
    f"onnx/{part}.onnx"
    for part in ("vision_encoder", "mask_decoder", "memory_attention", "memory_encoder", "pointer_tpos")
)
LAYOUTS: Mapping[Role, tuple[Layout, ...]] = {
    "embedder": (
        Layout(
            ("onnx/vision_model{p}.onnx", "onnx/text_model{p}.onnx", "preprocessor_config.json", "tokenizer.json"),
            ("config.json", "tokenizer_config.json", "logits.json"),
        ),
        Layout(
            ("visual/model{p}.onnx", "textual/model{p}.onnx", "visual/preprocess_cfg.json", "textual/tokenizer.json"),
            ("config.json", "textual/tokenizer_config.json", "logits.json"),
        ),
    ),
    "segmenter": (
        Layout(
            ("onnx/vision_encoder{p}.onnx", "onnx/prompt_encoder_mask_decoder{p}.onnx", "preprocessor_config.json"),
        ),
    ),
    "tracker": (Layout((*_TRACKER, "constants.json")), Layout((*_TRACKER, "onnx/constants.json"))),
}
"""role -> the layouts that its public exports have. A graph's external data (`.onnx_data`) comes with the graph."""


@dataclasses.dataclass(frozen=True)
class NamedModel:
    """A row of the catalogue."""

    name: str
    """What a user types."""
    role: Role
    """What it does in jsecon."""
    repository: str
    """"owner/name" on the hub."""
    megabytes: Mapping[Precision, int]
    """Size of the files by precision. Precisions that are missing are not offered."""
    licence: str
    """Licence of the weights."""
    purpose: str
    """What it is good for, in one sentence."""
    revision: str = "main"
    """Commit that is fetched, or a branch."""
    seconds: float | None = None
    """Seconds of a frame in fp32 on two cores of a Xeon with AVX-512: of a segmenter with 70 guided prompts, of an
    embedder for 40 regions, of a tracker for one object. None if they were not measured."""
    sha256: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """File -> hash of the content, where it is known from elsewhere than the hub."""
    refused: Mapping[Precision, str] = dataclasses.field(default_factory=dict)
    """Precision -> why it is not offered."""

    def in_precision(self, precision: Precision | None) -> "HubModel":
        """The model with graphs in one precision.

        Args:
          precision: The precision; None takes fp32. Models of masks stay in fp32 if they are not offered in it.

        Returns:
          The model on the hub.

        Raises:
          InputError: The precision is not offered.
        """
        if precision is None or (self.role != "embedder" and precision not in self.megabytes):
            precision = "fp32"
        if precision not in self.megabytes:
            reason = self.refused.get(precision, "Its repository has no such graphs.")
            problem = f"{self.name} is not offered in {precision}. {reason}"
            raise InputError("--precision", problem, "", f"Use {' or '.join(self.megabytes)}.")
        return HubModel(self.role, self.repository, self.revision, precision, self.sha256)


RECOMMENDED: Mapping[Role, str] = {"segmenter": "edgetam", "embedder": "siglip2"}
"""what `--models auto` takes"""


@functools.cache
def catalogue() -> tuple[NamedModel, ...]:
    """Reads the table of named models, catalogue.toml beside this file.

    Returns:
      Its rows.
    """
    rows = tomllib.loads(Path(__file__).with_name("catalogue.toml").read_text())["model"]
    return tuple(NamedModel(**row) for row in rows)


def published(role: Role) -> str:
    """Says where models are published.

    Args:
      role: What they are for.

    Returns:
      A sentence with the repositories of the catalogue.
    """
    names = ", ".join(row.repository for row in catalogue() if row.role == role)
    return f"Such models are published on huggingface.co: {names}, and others of the same layout."


@dataclasses.dataclass(frozen=True)
class HubModel:
    """A model on the hub."""

    role: Role
    """What it does in jsecon."""
    repository: str
    """"owner/name"."""
    revision: str = "main"
    """Commit, branch or tag."""
    precision: Precision = "fp32"
    """Precision of its graphs."""
    sha256: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """File -> hash of its content, where it is known beforehand."""

    @property
    def address(self) -> str:
        """The model as a user can type it: "hub:owner/name@revision"."""
        return f"{PREFIX}{self.repository}@{self.revision}"

    @property
    def get_command(self) -> str:
        """The command that fetches the model."""
        row = _row_of_repository(self.role, self.repository)
        name = row.name if row is not None and self.revision == row.revision else self.address
        precision = "" if self.precision == "fp32" else f" --precision {self.precision}"
        return f"jsecon models get {name} --role {self.role}{precision} --yes"

    @property
    def cached_folder(self) -> Path | None:
        """Folder of its files in the hub's cache, looked up without a request; None if one of them is not there."""
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import LocalEntryNotFoundError

        for layout in LAYOUTS[self.role]:
            required, optional = _in_precision(layout, self.precision)
            patterns = [*required, *optional, *(f"{name}_data*" for name in required)]
            with contextlib.suppress(LocalEntryNotFoundError, ValueError):  # ValueError: no name of a repository
                folder = snapshot_download(
                    self.repository, revision=self.revision, local_files_only=True, allow_patterns=patterns
                )
                if all((Path(folder) / name).is_file() for name in required):
                    return Path(folder)
        return None


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


def parse_model(text: str, role: Role, precision: Precision | None = None) -> HubModel | Path:
    """Reads what a user typed for a model.

    Args:
      text: A name of the catalogue, "hub:owner/name", "hub:owner/name@revision", or a folder.
      role: What the model is for.
      precision: Precision of its graphs; None takes fp32.

    Returns:
      The model on the hub, or the folder.

    Raises:
      InputError: It is none of these, or the precision is not offered.
    """
    if text.startswith(PREFIX):
        return parse_address(text, role, precision)
    if Path(text).exists():
        return Path(text)
    return rows_of_name(text, role)[0].in_precision(precision)


def parse_address(text: str, role: Role, precision: Precision | None = None) -> HubModel:
    """Reads the address of a model on the hub.

    Args:
      text: "hub:owner/name" or "hub:owner/name@revision".
      role: What the model is for.
      precision: Precision of its graphs; None takes fp32.

    Returns:
      The model.

    Raises:
      InputError: It is no such address, or the model is known not to work in this precision.
    """
    address = re.fullmatch(rf"{PREFIX}([\w.-]+/[\w.-]+?)(?:@([\w./-]+))?", text)
    if address is None:
        raise InputError(text, "not the address of a model", "", "Write hub:owner/name or hub:owner/name@revision.")
    row = _row_of_repository(role, address[1])
    if row is not None and precision in row.refused:
        return row.in_precision(precision)
    return HubModel(role, address[1], address[2] or "main", precision or "fp32")


def rows_of_name(name: str, role: Role | None) -> list[NamedModel]:
    """Looks up a name in the catalogue.

    Args:
      name: The name.
      role: What the model is for; None for any role.

    Returns:
      Its rows, at least one.

    Raises:
      InputError: There is no such name.
    """
    rows = [row for row in catalogue() if role in (None, row.role)]
    if matches := [row for row in rows if row.name == name]:
        return matches
    names = list(dict.fromkeys(row.name for row in rows))
    similar = [f"the {row.role} {name}" for row in catalogue() if row.name == name]
    similar += difflib.get_close_matches(name, names, 1)
    if re.fullmatch(r"[\w-][\w.-]*/[\w.-]+(@[\w./-]+)?", name):
        similar = [f"{PREFIX}{name}"]
    meant = f"Did you mean {similar[0]}? " if similar else ""
    remedy = f"{meant}Known names: {', '.join(names)}. Or give a folder, or hub:owner/name."
    problem = f"no folder and no known {role or 'model'}"
    raise InputError(name, "a folder, not a name" if Path(name).exists() else problem, "", remedy)


def _row_of_repository(role: Role, repository: str) -> NamedModel | None:
    """Returns the row of the catalogue that a repository has."""
    return next((row for row in catalogue() if (row.role, row.repository) == (role, repository)), None)


def model_name(folder: Path, role: Role) -> str:
    """Names the model of a folder.

    Args:
      folder: A folder, in the hub's cache or elsewhere.
      role: What the model is for.

    Returns:
      Its name in the catalogue, or that of the folder.
    """
    repository = (cached_address(folder) or "").removeprefix(PREFIX).partition("@")[0]
    row = _row_of_repository(role, repository)
    return folder.name if row is None else row.name


def _present_layout(
    role: Role, precision: Precision | None, exists: Callable[[str], object], where: object, remedy: str
) -> Layout:
    """Returns the first layout whose required files exist: in the precision, of None in the highest that is there."""
    missing = []
    for each in SUFFIXES if precision is None else (precision,):
        for layout in LAYOUTS[role]:
            named = _in_precision(layout, each)
            missing.append([name for name in named.required if not exists(name)])
            if not missing[-1]:
                return named
    raise NoSuchFilesError(where, f"no {role}, since it lacks {', '.join(min(missing, key=len))}", "", remedy)


def find_files(folder: str | Path, role: Role, precision: Precision | None = None) -> list[Path]:
    """Finds the files of a model in a folder.

    Args:
      folder: The folder.
      role: What the model is for.
      precision: Precision of its graphs; None takes the highest that is there.

    Returns:
      The required files of its layout, in the order of LAYOUTS.

    Raises:
      InputError: There is no such folder, or files are missing in it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "", published(role))
    layout = _present_layout(role, precision, lambda name: (folder / name).is_file(), folder, published(role))
    return [folder / name for name in layout.required]


def plan_download(model: HubModel) -> Download:
    """Asks the hub which files a model needs.

    Args:
      model: The model.

    Returns:
      The files, and the licence.

    Raises:
      NoSuchFilesError: The repository lacks files of every layout that jsecon reads.
      InputError: The hub does not answer, has no such repository or revision, or states another hash of a file than
        the catalogue.
    """
    from huggingface_hub import HfApi

    with _hub_errors(model):
        info = HfApi().model_info(model.repository, revision=model.revision, files_metadata=True)
    files = {file.rfilename: file for file in info.siblings or ()}
    remedy = f"Choose another repository or --precision. `jsecon models list` has {model.role} models that work."
    required, optional = _present_layout(model.role, model.precision, files.__contains__, model.address, remedy)
    data = tuple(f"{name}_data" for name in required)
    chosen = [path for path in files if path in (*required, *optional) or path.startswith(data)]
    for path in model.sha256.keys() & set(chosen):
        stated = files[path].lfs
        if stated is None or stated.sha256 != model.sha256[path]:
            problem = "the hash that the hub states for it is not the one that jsecon knows"
            raise InputError(f"{model.address} {path}", problem, "", "Choose another model: jsecon models list.")
    licences = [tag.removeprefix("license:") for tag in info.tags or () if tag.startswith("license:")]
    sizes = {path: files[path].size or 0 for path in chosen}
    return Download(model, sizes, ", ".join(licences) or "not stated")


def fetch(download: Download) -> Path:
    """Brings a model into the hub's cache and compares each file with its hash.

    Files that are in the cache already are not fetched again. A transfer that breaks is taken up where it stopped.

    Args:
      download: What to fetch.

    Returns:
      The folder with the files.

    Raises:
      InputError: The transfer fails, or a file differs from its hash; that file is removed from the cache.
    """
    from huggingface_hub import HfApi, snapshot_download

    model = download.model
    with _hub_errors(model):
        names = list(download.sizes)
        folder = Path(snapshot_download(model.repository, revision=model.revision, allow_patterns=names))
        check = HfApi().verify_repo_checksums(model.repository, revision=folder.name, local_dir=folder)
    for mismatch in check.mismatches:
        broken = folder / mismatch["path"]
        broken.resolve().unlink(missing_ok=True)
        broken.unlink(missing_ok=True)
    if check.mismatches:
        paths = ", ".join(mismatch["path"] for mismatch in check.mismatches)
        problem = "its content differs from the hash that the hub gives for it, so it was removed"
        raise InputError(f"{model.address} {paths}", problem, "", f"Fetch it again: {model.get_command}")
    return folder


def cached_address(folder: Path) -> str | None:
    """Names what a folder of the hub's cache holds.

    Args:
      folder: A folder; it need not exist.

    Returns:
      "hub:owner/name@commit"; None for every other folder.
    """
    parts = folder.absolute().parts
    inside = len(parts) > 2 and parts[-2] == "snapshots" and parts[-3].startswith("models--")
    if not inside:
        return None
    return f"{PREFIX}{parts[-3].removeprefix('models--').replace('--', '/')}@{parts[-1]}"


def remove(repository: str) -> int:
    """Removes a repository from the hub's cache, all its revisions.

    Args:
      repository: "owner/name".

    Returns:
      Bytes that were freed; 0 if it was not there.
    """
    from huggingface_hub import constants, scan_cache_dir
    from huggingface_hub.errors import CacheNotFound

    try:
        cache = scan_cache_dir(constants.HF_HUB_CACHE)
    except CacheNotFound:
        return 0
    revisions = (repo.revisions for repo in cache.repos if (repo.repo_type, repo.repo_id) == ("model", repository))
    plan = cache.delete_revisions(*(revision.commit_hash for each in revisions for revision in each))
    plan.execute()
    return plan.expected_freed_size


@contextlib.contextmanager
def _hub_errors(model: HubModel) -> Iterator[None]:
    """Turns the errors of huggingface_hub and of the disk into an InputError with one sentence."""
    from huggingface_hub.errors import LocalEntryNotFoundError

    try:
        yield
    except Exception as error:
        cause: BaseException = error
        while isinstance(cause, LocalEntryNotFoundError) and cause.__cause__ is not None:
            cause = cause.__cause__
        explained = _explain(model, cause)
        if explained is None:
            raise
        problem, remedy = explained
        raise InputError(model.address, problem, "", remedy) from error


def _explain(model: HubModel, error: BaseException) -> tuple[str, str] | None:
    """Returns what is wrong and what to do, for an error during a request; None for a fault of the program."""
    from huggingface_hub import constants, errors

    page, get = f"{constants.ENDPOINT}/{model.repository}", model.get_command
    again = f"Run it again: {get}"
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
        case errors.RemoteEntryNotFoundError():
            return "a file of the repository is missing on the hub", again
        case errors.HfHubHTTPError():
            return f"the hub answers with HTTP status {error.response.status_code}", f"Wait a minute. {again}"
        case errors.LocalEntryNotFoundError() | ConnectionError():
            return f"{constants.ENDPOINT} cannot be reached or the transfer broke", f"Check the network. {again}"
        case OSError(errno=errno.ENOSPC):
            remedy = "Free some space, or set HF_HOME to another disk."
            return f"no space left for it in {constants.HF_HUB_CACHE}", remedy
        case OSError(errno=errno.EACCES | errno.EPERM | errno.EROFS):
            return f"no permission to write in {constants.HF_HUB_CACHE}", "Set HF_HOME to a folder of yours."
        case OSError():
            return describe_error(error), again
    if type(error).__module__.partition(".")[0] in ("httpx", "httpx2"):  # by the version of huggingface_hub
        return f"{constants.ENDPOINT} cannot be reached or the transfer broke", f"Check the network. {again}"
    return None
