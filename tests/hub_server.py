"""A server on this machine that speaks the part of the Hugging Face hub's protocol that huggingface_hub uses.

It serves repositories from memory, counts the requests, and can break them on purpose.
"""

import contextlib
import dataclasses
import hashlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import uvicorn
from huggingface_hub import constants
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route

LARGE = 1000
"""bytes from which a file is stored as LFS, with a SHA-256"""


@dataclasses.dataclass
class Repository:
    """One repository: its files, and what is wrong with it.

    Attributes:
      files: Path -> content.
      licence: Licence on its card.
      gated: Status of its answers with GatedRepo: 401 to who is nobody, 403 to who has no access; 0 if it is open.
      corrupt: Paths whose content is sent with its first byte changed.
    """

    files: dict[str, bytes]
    licence: str = "mit"
    gated: int = 0
    corrupt: frozenset[str] = frozenset()

    @property
    def commit(self) -> str:
        """40 hexadecimal digits that follow from the content."""
        digest = hashlib.sha1()
        for path, content in sorted(self.files.items()):
            digest.update(path.encode() + b"\0" + content)
        return digest.hexdigest()

    def entry(self, path: str) -> dict:
        """What the hub tells of a file in a listing."""
        content = self.files[path]
        blob = hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()
        entry = {"type": "file", "path": path, "size": len(content), "oid": blob}
        if len(content) >= LARGE:
            entry["lfs"] = {"oid": hashlib.sha256(content).hexdigest(), "size": len(content), "pointerSize": 130}
        return entry


def _refusal(status: int, code: str) -> Response:
    return JSONResponse({"error": code}, status, {"X-Error-Code": code})


class Hub:
    """The server: `repositories` by name, `requests` as "METHOD path"."""

    def __init__(self) -> None:
        self.repositories: dict[str, Repository] = {}
        self.requests: list[str] = []
        self.endpoint = ""

    def answer(self, handler: Callable) -> Callable:
        """A route's function: `handler` of a request and its repository, or why there is none."""

        async def answer(request: Request) -> Response:
            self.requests.append(f"{request.method} {request.url.path}")
            repository = self.repositories.get(f"{request.path_params['owner']}/{request.path_params['name']}")
            if repository is None:
                return _refusal(404, "RepoNotFound")
            if repository.gated:
                return _refusal(repository.gated, "GatedRepo")
            if request.path_params.get("revision", "main") not in ("main", repository.commit):
                return _refusal(404, "RevisionNotFound")
            return handler(request, repository)

        return answer

    def info(self, request: Request, repository: Repository) -> Response:
        """GET /api/models/OWNER/NAME/revision/REVISION."""
        name = f"{request.path_params['owner']}/{request.path_params['name']}"
        entries = [repository.entry(path) for path in sorted(repository.files)]
        siblings = [{"rfilename": e["path"], "size": e["size"], "blobId": e["oid"]} for e in entries]
        tags = [f"license:{repository.licence}"]
        return JSONResponse({"id": name, "sha": repository.commit, "siblings": siblings, "tags": tags})

    def tree(self, request: Request, repository: Repository) -> Response:
        """GET /api/models/OWNER/NAME/tree/REVISION."""
        return JSONResponse([repository.entry(path) for path in sorted(repository.files)])

    def resolve(self, request: Request, repository: Repository) -> Response:
        """HEAD and GET /OWNER/NAME/resolve/REVISION/PATH."""
        path = request.path_params["path"]
        if path not in repository.files:
            return _refusal(404, "EntryNotFound")
        content, entry = repository.files[path], repository.entry(path)
        etag = entry["lfs"]["oid"] if "lfs" in entry else entry["oid"]
        headers = {"X-Repo-Commit": repository.commit, "ETag": f'"{etag}"'}
        if path in repository.corrupt:
            content = bytes([content[0] ^ 255]) + content[1:]
        if request.method == "HEAD":
            return Response(headers=headers | {"Content-Length": str(len(content))})
        return Response(content, headers=headers | {"Content-Length": str(len(content))})


@contextlib.contextmanager
def running_hub() -> Iterator[Hub]:
    """Runs a hub on a free port of this machine while the context lasts."""
    hub = Hub()
    home = "/{owner}/{name}"
    app = Starlette(
        routes=[
            Route(f"/api/models{home}", hub.answer(hub.info)),
            Route(f"/api/models{home}/revision/{{revision:path}}", hub.answer(hub.info)),
            Route(f"/api/models{home}/tree/{{revision}}", hub.answer(hub.tree)),
            Route(f"{home}/resolve/{{revision}}/{{path:path}}", hub.answer(hub.resolve), methods=["GET", "HEAD"]),
        ]
    )
    server = uvicorn.Server(uvicorn.Config(app, host="127.0.0.1", port=0, log_level="critical"))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    hub.endpoint = f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    yield hub
    server.should_exit = True
    thread.join()


def use_hub(hub: Hub, cache: Path, monkeypatch: pytest.MonkeyPatch, *, offline: bool = False) -> None:
    """Lets huggingface_hub ask this hub and keep its cache in a folder, until `monkeypatch` is undone."""
    for name, value in {
        "ENDPOINT": hub.endpoint,
        "HUGGINGFACE_CO_URL_TEMPLATE": hub.endpoint + "/{repo_id}/resolve/{revision}/{filename}",
        "HF_HUB_CACHE": str(cache),
        "HF_HUB_OFFLINE": offline,
    }.items():
        monkeypatch.setattr(constants, name, value)


def files_in(folder: Path) -> dict[str, bytes]:
    """The files of a folder as those of a repository."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
