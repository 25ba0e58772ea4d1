"""The server under load and under odd input.

    python benchmarks/serve.py FIELD [--copies 3] [--clients 8] [--seconds 60] [--odd 10000]

FIELD, copied side by side until it has as many Gaussians as are wanted, is served by `jsecon serve` in a process of its
own, with a token. Clients ask for a minute, each in its own thread, one question after the other: a third of the texts
are new ones, the others have been asked before. Then what should be refused: mutated requests, a body of 1 GB,
wrong tokens, paths that lead out. Says the server's memory before, after 2,000 questions and at the end.
"""

import argparse
import collections
import contextlib
import dataclasses
import http.client
import json
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from jsecon.process import prepare_process

prepare_process(keep_programs=False)

import jax
import numpy as np

from jsecon.field.field import load_field, save_field
from jsecon.types import LanguageField

TOKEN = "measured"
WORDS = ["red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "white", "black", "grey"]
SHADES = ["light", "dark", "pale", "deep", "bright"]


def copied(field: LanguageField, copies: int) -> LanguageField:
    """The field's Gaussians `copies` times, side by side; each copy votes for the same regions."""
    means = np.asarray(field.gaussians.means)
    apart = 1.5 * np.ptp(np.quantile(means, (0.02, 0.98), axis=0)[:, 0])
    count = len(means)

    def tile(a):
        return np.concatenate([np.asarray(a)] * copies) if np.shape(a)[:1] == (count,) else a

    gaussians, votes = jax.tree.map(tile, field.gaussians), jax.tree.map(tile, field.votes)
    shift = np.repeat(np.arange(copies), count)[:, None] * np.float32([apart, 0, 0])
    gaussians = dataclasses.replace(gaussians, means=(np.asarray(gaussians.means) + shift).astype(np.float32))
    leaf = None if field.leaf is None else tile(field.leaf)
    return dataclasses.replace(field, gaussians=gaussians, votes=votes, codes=None, leaf=leaf)


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def memory(process: subprocess.Popen) -> float:
    """MiB resident."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def request(port: int, verb: str, path: str, body: bytes | None = None, token: str = TOKEN, connection=None):
    """(status, body) of one request."""
    own = connection or http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    headers = {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {token}"} if token else {})
    own.request(verb, path, body, headers)
    answer = own.getresponse()
    told = answer.status, answer.read()
    if connection is None:
        own.close()
    return told


def load(port: int, clients: int, seconds: float) -> dict:
    """Latencies of clients that ask at once for `seconds`."""
    times, wrong, until = [], collections.Counter(), time.perf_counter() + seconds

    def client(k: int) -> None:
        draw, connection = random.Random(k), http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        while time.perf_counter() < until:
            text = draw.choice(WORDS)
            if draw.random() < 1 / 3:
                text = f"{draw.choice(SHADES)} {text} {draw.choice(['or', 'but not'])} {draw.choice(WORDS)}"
            began = time.perf_counter()
            status, told = request(port, "POST", "/query", json.dumps({"text": text}).encode(), connection=connection)
            times.append(time.perf_counter() - began)
            if status not in (200, 422):  # 422: these words mean nothing to the embedder
                wrong[status, told[:80]] += 1

    threads = [threading.Thread(target=client, args=(k,)) for k in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    ms = 1000 * np.array(times)
    p50, p95, p99 = np.percentile(ms, (50, 95, 99))
    return {"requests": len(ms), "p50_ms": p50, "p95_ms": p95, "p99_ms": p99, "errors": dict(wrong)}


def odd(port: int, count: int) -> dict:
    """Statuses of mutated requests and of what should be refused."""
    draw, statuses = random.Random(0), collections.Counter()
    seeds = [b'{"text": "red mug", "by": "votes", "threshold": 0.4}', b'{"at": ["#1", 30, 40], "threshold": 0.5}']
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    for _ in range(count):
        body = bytearray(draw.choice(seeds))
        for _ in range(draw.randint(1, 6)):
            place = draw.randrange(len(body))
            body[place : place + draw.randint(0, 3)] = bytes(draw.randrange(256) for _ in range(draw.randint(0, 3)))
        try:
            statuses[request(port, "POST", "/query", bytes(body), connection=connection)[0]] += 1
        except (http.client.HTTPException, OSError):
            statuses["no answer"] += 1
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    found = {f"{count} mutated": dict(statuses)}
    found["wrong token"] = request(port, "GET", "/healthz", token="wrong")[0]
    paths = ("/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/selection.ply?text=red&field=../../x")
    found["paths"] = [request(port, "GET", path)[0] for path in paths]
    with socket.create_connection(("127.0.0.1", port), timeout=60) as raw:
        lines = "POST /query HTTP/1.1", "Host: x", f"Authorization: Bearer {TOKEN}"
        lines += "Content-Type: application/json", f"Content-Length: {10**9}"
        raw.sendall("\r\n".join((*lines, "", "")).encode())
        sent = 0
        with contextlib.suppress(OSError):
            while sent < 10**9:
                sent += raw.send(b"x" * 65536)
        try:
            found["1 GB body"] = f"{raw.recv(64).split(b' ')[1].decode()} after {sent / 2**20:.0f} MiB"
        except (OSError, IndexError):
            found["1 GB body"] = f"cut after {sent / 2**20:.0f} MiB"
    found["alive"] = request(port, "GET", "/healthz")[0]
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("field", type=Path)
    parser.add_argument("--copies", type=int, default=3)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--odd", type=int, default=10_000)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "field.safetensors"
        field = copied(load_field(given.field), given.copies)
        save_field(file, field)
        print(f"{field.gaussians.count} Gaussians, {field.regions.count} regions")
        port, began = free_port(), time.perf_counter()
        command = [sys.executable, "-m", "jsecon", "serve", str(file), "--port", str(port), "--token", TOKEN]
        with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
            while True:
                try:
                    if request(port, "GET", "/healthz")[0] == 200:
                        break
                except OSError:
                    time.sleep(0.05)
                if process.poll() is not None:
                    raise SystemExit("the server did not start")
            print(f"ready after {time.perf_counter() - began:.1f} s, {memory(process):.0f} MiB")
            try:
                told = load(port, given.clients, given.seconds)
                print({k: round(v, 1) if isinstance(v, float) else v for k, v in told.items()})
                before = memory(process)
                connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
                for k in range(2000):
                    text = f"{WORDS[k % len(WORDS)]} or {WORDS[k // len(WORDS) % len(WORDS)]}"
                    request(port, "POST", "/query", json.dumps({"text": text}).encode(), connection=connection)
                print(f"memory {before:.0f} MiB, {memory(process):.0f} MiB after 2,000 questions more")
                print(odd(port, given.odd))
                print(f"memory {memory(process):.0f} MiB at the end")
            finally:
                process.terminate()


if __name__ == "__main__":
    main()
