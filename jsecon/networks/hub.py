"""Models by name: which public repository a name stands for, and its files in the cache of the Hugging Face hub.

A model is asked for by a name of catalogue.toml ("clip"), by repository ("hub:owner/name", "hub:owner/name@revision"),
or by folder. huggingface_hub transfers the files and keeps the cache, so HF_HOME, HF_ENDPOINT, HF_HUB_OFFLINE and
HF_TOKEN work as they do elsewhere. A transfer is planned first (`plan_download`: commit, files, size, licence), so
that a user can be asked before anything is fetched. Afterwards each file is compared with the hub's hash.
"""

import contextlib
import dataclasses
import errno
import functools
import hashlib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jsecon.errors import InputError, describe_error

Role = Literal["embedder", "segmenter", "tracker"]

Precision = Literal["fp32", "fp16", "int8"]
"""numbers that a graph computes with"""
SUFFIXES: Mapping[Precision, str] = {"fp32": "", "fp16": "_fp16", "int8": "_quantized"}
"""precision -> what public exports append to the name of a graph"""
PREFIX = "hub:"


def graph_variants(names: Sequence[str], precision: Precision | None = None) -> Iterator[tuple[str, ...]]:
    """Names graphs in one precision after the other.

    Args:
      names: Names of the graphs in full precision, such as onnx/vision_model.onnx.
      precision: The only precision to yield; None yields all, full precision first.

    Yields:
      The names in that precision, in the order of `names`.
    """
    for suffix in SUFFIXES.values() if precision is None else (SUFFIXES[precision],):
        yield tuple(name.removesuffix(".onnx") + f"{suffix}.onnx" for name in names)


class NoSuchFilesError(InputError):
    """A repository has none of the layouts of a role."""


class _FileSet(NamedTuple):
    """The files of one public layout of a model. `{p}` stands for the suffix of the precision."""

    required: tuple[str, ...]
    """files without which the model does not work"""
    optional: tuple[str, ...] = ()
    """files that are fetched where the repository has them"""


_TEXTS = ("config.json", "tokenizer_config.json")
_TRACKER = tuple(
    f"onnx/{part}.onnx"
    for part in ("vision_encoder", "mask_decoder", "memory_attention", "memory_encoder", "pointer_tpos")
)
LAYOUTS: Mapping[Role, tuple[_FileSet, ...]] = {
    "embedder": (
        _FileSet(
            ("onnx/vision_model{p}.onnx", "onnx/text_model{p}.onnx", "preprocessor_config.json", "tokenizer.json"),
            (*_TEXTS, "logits.json"),
        ),
        _FileSet(
            ("visual/model.onnx", "textual/model.onnx", "visual/preprocess_cfg.json", "textual/tokenizer.json"),
            (*_TEXTS, "textual/tokenizer_config.json", "logits.json"),
        ),
    ),
    "segmenter": (
        _FileSet(
            ("onnx/vision_encoder{p}.onnx", "onnx/prompt_encoder_mask_decoder{p}.onnx"),
            ("preprocessor_config.json", "config.json"),
        ),
    ),
    "tracker": (_FileSet((*_TRACKER, "constants.json")), _FileSet((*_TRACKER, "onnx/constants.json"))),
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
    seconds: Mapping[Precision, float] = dataclasses.field(default_factory=dict)
    """Seconds of a frame by precision, on two cores of a Xeon with AVX-512: of a segmenter with 70 guided prompts, of
    an embedder for 40 regions, of a tracker for one object. Those not measured are missing."""
    precision: Precision = "fp32"
    """Precision that is taken unless the user asks for another."""
    sha256: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """File -> hash of the content, where it is known from elsewhere than the hub."""
    refused: Mapping[Precision, str] = dataclasses.field(default_factory=dict)
    """Precision -> why it is not offered."""


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
        rows = [row for row in catalogue() if (row.repository, row.role) == (self.repository, self.role)]
        name = rows[0].name if rows and self.revision == rows[0].revision else self.address
        precision = "" if self.precision == "fp32" else f" --precision {self.precision}"
        return f"jsecon models get {name} --role {self.role}{precision} --yes"

    @property
    def cached_folder(self) -> Path | None:
        """Folder of its files in the hub's cache, looked up without a request; None if one of them is not there."""
        from huggingface_hub import snapshot_download
        from huggingface_hub.errors import LocalEntryNotFoundError

        for layout in LAYOUTS[self.role]:
            required = _named(layout.required, self.precision)
            patterns = [*required, *_named(layout.optional, self.precision), *(f"{name}_data*" for name in required)]
            try:
                folder = snapshot_download(
                    self.repository, revision=self.revision, local_files_only=True, allow_patterns=patterns
                )
            except (LocalEntryNotFoundError, ValueError):  # ValueError: no name of a repository
                continue
            if all((Path(folder) / name).is_file() for name in required):
                return Path(folder)
        return None


@dataclasses.dataclass(frozen=True)
class HubFile:
    """A file of a repository: its path there, its bytes, and its hash (SHA-256, or that of a git blob)."""

    path: str
    size: int
    digest: str


@dataclasses.dataclass(frozen=True)
class Download:
    """What has to be fetched for a model."""

    model: HubModel
    commit: str
    """Commit that its revision names now."""
    files: tuple[HubFile, ...]
    """Files of the commit that the model needs."""
    licence: str
    """Licence by the repository's own card, or "not stated"."""

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self.files)

    def __str__(self) -> str:
        """Returns the address as the command line takes it."""
        megabytes = max(round(self.size / 1e6), 1)
        return f"{self.model.address} ({len(self.files)} files, {megabytes:,} MB, licence: {self.licence})"


def parse_model(text: str, role: Role, precision: Precision | None = None) -> HubModel | Path:
    """Reads what a user typed for a model.

    Args:
      text: A name of the catalogue, "hub:owner/name", "hub:owner/name@revision", or a folder.
      role: What the model is for.
      precision: Precision of its graphs; None takes the model's default.

    Returns:
      The model on the hub, or the folder.

    Raises:
      InputError: It is none of these, or the precision is not offered.
    """
    if text.startswith(PREFIX):
        address = re.fullmatch(r"([\w.-]+/[\w.-]+?)(?:@([\w./-]+))?", text.removeprefix(PREFIX))
        if address is None:
            raise InputError(text, "not the address of a model", "", "Write hub:owner/name or hub:owner/name@revision.")
        row = next((row for row in catalogue() if (row.role, row.repository) == (role, address[1])), None)
        if row is not None and precision is not None and precision in row.refused:
            raise _refused(row, precision)
        return HubModel(role, address[1], address[2] or "main", precision or "fp32")
    if Path(text).exists():
        return Path(text)
    names = {row.name: row for row in catalogue() if row.role == role}
    if text not in names:
        remedy = f"Known names: {', '.join(names)}. Or give a folder, or hub:owner/name."
        raise InputError(text, f"no folder and no known {role}", "", remedy)
    row = names[text]
    precision = precision or row.precision
    if precision not in row.megabytes:
        raise _refused(row, precision)
    return HubModel(role, row.repository, row.revision, precision, row.sha256)


def _refused(row: NamedModel, precision: Precision) -> InputError:
    """Returns the error that a named model is not offered in a precision."""
    reason = row.refused.get(precision, "Its repository has no such graphs.")
    problem = f"{row.name} is not offered in {precision}. {reason}"
    return InputError("--precision", problem, "", f"Use {' or '.join(row.megabytes)}.")


def model_name(folder: Path, role: Role) -> str:
    """Names the model of a folder.

    Args:
      folder: A folder, in the hub's cache or elsewhere.
      role: What the model is for.

    Returns:
      Its name in the catalogue, or that of the folder.
    """
    repository = (cached_address(folder) or "").removeprefix(PREFIX).partition("@")[0]
    return next((row.name for row in catalogue() if (row.role, row.repository) == (role, repository)), folder.name)


def choose_files(model: HubModel, paths: Sequence[str]) -> tuple[str, ...]:
    """Chooses the files that a model needs from those of its repository.

    Args:
      model: The model.
      paths: All files of the repository.

    Returns:
      Their paths, sorted.

    Raises:
      NoSuchFilesError: The repository has none of the layouts that jsecon reads.
    """
    known = set(paths)
    missing = []
    for layout in LAYOUTS[model.role]:
        required = _named(layout.required, model.precision)
        optional = _named(layout.optional, model.precision)
        missing.append([name for name in required if name not in known])
        if not missing[-1]:
            data = [path for path in paths if any(path.startswith(f"{name}_data") for name in required)]
            return tuple(sorted({*required, *known.intersection(optional), *data}))
    fewest = min(missing, key=len)
    problem = f"no {model.role} of {model.precision} that jsecon reads: {', '.join(fewest)} missing"
    remedy = f"Choose another repository or --precision. `jsecon models list` has {model.role} models that work."
    raise NoSuchFilesError(model.address, problem, "", remedy)


def _named(templates: Sequence[str], precision: Precision) -> tuple[str, ...]:
    """Returns the names of a layout's files in one precision."""
    return tuple(template.format(p=SUFFIXES[precision]) for template in templates)


def plan_download(model: HubModel) -> Download:
    """Asks the hub which files a model needs.

    Args:
      model: The model.

    Returns:
      The files, and the commit.

    Raises:
      InputError: The hub does not answer, or has no such repository, revision or files.
    """
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoFile

    with _hub_errors(model):
        api = HfApi()
        info = api.model_info(model.repository, revision=model.revision)
        tree = api.list_repo_tree(model.repository, recursive=True, revision=info.sha)
        files = {
            entry.path: HubFile(entry.path, entry.size, entry.lfs.sha256 if entry.lfs else entry.blob_id)
            for entry in tree
            if isinstance(entry, RepoFile)
        }
    chosen = tuple(files[path] for path in choose_files(model, list(files)))
    licences = [tag.removeprefix("license:") for tag in info.tags or () if tag.startswith("license:")]
    return Download(model, str(info.sha), chosen, ", ".join(licences) or "not stated")


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
    from huggingface_hub import snapshot_download

    model = download.model
    names = [file.path for file in download.files]
    with _hub_errors(model):
        folder = Path(snapshot_download(model.repository, revision=model.revision, allow_patterns=names))
    for file in download.files:
        expected = {file.digest} | ({model.sha256[file.path]} if file.path in model.sha256 else set())
        if any(_content_hash(folder / file.path, digest) != digest for digest in expected):
            broken = folder / file.path
            broken.resolve().unlink()
            broken.unlink(missing_ok=True)
            problem = "its content differs from the hash that the hub gives for it, so it was removed"
            raise InputError(f"{model.address} {file.path}", problem, "", f"Fetch it again: {model.get_command}")
    return folder


def _content_hash(path: Path, like: str) -> str:
    """Returns the SHA-256 of a file in hexadecimal digits, or the hash of its git blob if `like` has 40 digits."""
    digest = hashlib.sha256() if len(like) == 64 else hashlib.sha1(b"blob %d\0" % path.stat().st_size)
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: digest).hexdigest()


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


def remove(model: HubModel) -> int:
    """Removes a repository from the hub's cache, all its revisions.

    Args:
      model: The model.

    Returns:
      Bytes that were freed; 0 if it was not there.
    """
    from huggingface_hub import constants, scan_cache_dir
    from huggingface_hub.errors import CacheNotFound

    try:
        cache = scan_cache_dir(constants.HF_HUB_CACHE)
    except CacheNotFound:
        return 0
    commits = [
        revision.commit_hash
        for repository in cache.repos
        if repository.repo_id == model.repository and repository.repo_type == "model"
        for revision in repository.revisions
    ]
    plan = cache.delete_revisions(*commits)
    plan.execute()
    return plan.expected_freed_size


def catalogue_rows() -> Iterator[dict[str, Any]]:
    """Lists the named models, and which of them are on this machine.

    Yields:
      A row of `jsecon models list`: the fields of `NamedModel`, and "cached", precisions in the hub's cache.
    """
    for row in catalogue():
        models = [HubModel(row.role, row.repository, row.revision, precision) for precision in row.megabytes]
        cached = [model.precision for model in models if model.cached_folder is not None]
        yield dataclasses.asdict(row) | {"cached": cached}


@contextlib.contextmanager
def _hub_errors(model: HubModel) -> Iterator[None]:
    """Turns the errors of huggingface_hub and of the disk into an InputError with one sentence."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        problem, remedy = _explain(model, error)
        if not problem:
            raise
        raise InputError(model.address, problem, "", remedy) from error


def _explain(model: HubModel, error: BaseException) -> tuple[str, str]:
    """Returns what is wrong and what to do, for an error during a request; empty for a fault of the program."""
    from huggingface_hub import constants, errors

    page = f"{constants.ENDPOINT}/{model.repository}"
    again = f"Run it again: {model.get_command}"
    if isinstance(error, errors.OfflineModeIsEnabled):
        return (
            "not in the cache, and HF_HUB_OFFLINE forbids requests",
            f"Unset HF_HUB_OFFLINE, then {model.get_command}",
        )
    if isinstance(error, errors.GatedRepoError):
        remedy = f"Accept its licence on {page}, set HF_TOKEN to a token of your account, then {model.get_command}"
        return "its owner grants access to accounts only", remedy
    if isinstance(error, errors.RevisionNotFoundError):
        return f"the repository has no revision {model.revision}", f"See {page}/commits/main for those it has."
    if isinstance(error, errors.RepositoryNotFoundError):
        return "the hub has no such repository, or it is private", "Check the name; for a private one set HF_TOKEN."
    if isinstance(error, errors.RemoteEntryNotFoundError):
        return "a file of the repository is missing on the hub", again
    if isinstance(error, errors.LocalEntryNotFoundError):
        cause = error.__cause__
        if cause is not None and not isinstance(cause, errors.LocalEntryNotFoundError):
            return _explain(model, cause)
        return f"{constants.ENDPOINT} cannot be reached", f"Check the network or HF_ENDPOINT, then {model.get_command}"
    if isinstance(error, errors.HfHubHTTPError):
        status = error.response.status_code
        return f"the hub answers with HTTP status {status}", f"Wait a minute. {again}"
    library = type(error).__module__.partition(".")[0]
    if isinstance(error, ConnectionError) or library in ("httpx", "httpx2"):  # by the version of huggingface_hub
        return f"{constants.ENDPOINT} cannot be reached or the transfer broke", f"Check the network. {again}"
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        return f"no space left for it in {constants.HF_HUB_CACHE}", "Free some space, or set HF_HOME to another disk."
    if isinstance(error, PermissionError) or (isinstance(error, OSError) and error.errno == errno.EROFS):
        return f"no permission to write in {constants.HF_HUB_CACHE}", "Set HF_HOME to a folder of yours."
    if isinstance(error, OSError):
        return describe_error(error), again
    return "", ""
