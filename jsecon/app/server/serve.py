"""The server of `jsecon serve`: fields behind HTTP, loaded once and compiled before the first query (extra `serve`).

    POST /query           {"text": "red mug"} -> where it is, and its score
    POST /relation        {"text": "the red mug left of the bottle"} -> the objects, or why there is none
    POST /measure         {"a": "red mug", "b": "bottle"} -> distances
    GET  /objects         the catalogue of objects
    GET  /regions         pixels and views of each region
    GET  /selection.ply   the Gaussians that a text selects, INRIA layout
    GET  /mask.png        the selection in a frame
    GET  /healthz, /openapi.json, /

New queries are computed by as many threads as there are cores. Others wait in turn, and more than `Limits.waiting` are
refused with the request to try again. Known answers are sent at once. A request reads only the fields: no name in it is
a path.
"""

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import uvicorn

from jsecon.app import verbs
from jsecon.app.access import bracketed, listen, token_for
from jsecon.app.models import OLD_FIELD, with_models
from jsecon.app.server.api import application
from jsecon.app.server.scenes import describe_scene, open_scenes
from jsecon.pipeline.progress import Console

MAX_REQUESTS = 256
"""number of requests at once, the cheap ones included; uvicorn refuses others (503)"""


def prepare(
    files: list[Path], *, host: str, port: int, token: str, embedder: Path | None, hosts: Collection[str] = ()
) -> tuple[dict[str, Any], Callable[[], None]]:
    """Loads fields and listens.

    Args:
      files: Paths of field.safetensors files.
      host: Address to listen on.
      port: Port to listen on; 0 takes a free one.
      token: Token that clients must send; "" is that of the environment, if any.
      embedder: Folder of the CLIP model of the fields; None where the runs had it.
      hosts: Names of this machine besides those of loopback and `host`.

    Returns:
      {"address": ..., "fields": ...}, and the function that answers requests until it is stopped.

    Raises:
      InputError: The address cannot be listened on, others can reach it without a token, or a field cannot be read.
    """
    token = token_for(host, token)
    listening = listen(host, port)
    scenes = open_scenes(files, embedder)
    app = application(scenes, token=token, hosts=(host, *hosts))
    options: dict[str, Any] = {"timeout_keep_alive": 5, "limit_concurrency": MAX_REQUESTS}
    config = uvicorn.Config(app, log_level="warning", ws="none", server_header=False, **options)
    address = f"http://{bracketed(host)}:{listening.getsockname()[1]}"
    description = {"address": address, "fields": [describe_scene(scene) for scene in scenes.values()]}
    return description, lambda: uvicorn.Server(config).run(sockets=[listening])


def _serve(verb: verbs.Serve, console: Console) -> verbs.VerbResult:
    """Does the work of `jsecon serve`; the result is as of `prepare`, with its function under "then"."""
    access = {"host": verb.host, "port": verb.port, "token": verb.token, "hosts": verb.allow_host}
    with console.progress("fields"):
        embedder = with_models(verb, console, yes=False).embedder
        result, serve = prepare(verb.fields, embedder=embedder, **access)
    for scene in result["fields"]:
        console.say(f"{scene['name']}: {scene['gaussians']} Gaussians, {scene['regions']} regions")
        if scene["unrelated_words"] is None:
            console.note(f"{scene['name']}: {OLD_FIELD}")
    console.say(result["address"])
    return result | {"then": serve}


VERBS = {verbs.Serve: _serve}
"""what does the work of each verb"""
