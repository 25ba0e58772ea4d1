"""The server for language models, driven by the SDK's own client, in the process and over standard input and output.
test_doors.py has its answers."""

import asyncio
import base64
import subprocess
import sys
from concurrent.futures import Future

import cv2
import numpy as np
import pytest

pytest.importorskip("mcp", reason="the extra mcp is not installed")
from mcp import Client, StdioServerParameters
from table_field import table_field

import jsecon
from jsecon import InputError
from jsecon.app import mcp_server
from jsecon.app.mcp_server import make_server
from jsecon.app.scene import Scene
from jsecon.field.field import save_field


@pytest.fixture(scope="module")
def server():
    opened = Future()
    opened.set_result(Scene(*table_field(), name="table"))
    return make_server({"table": opened})


def use(server, act):
    """What `act` of a client gives."""

    async def run():
        async with Client(server) as client:
            return await act(client)

    return asyncio.run(run())


def call(server, name, **arguments):
    """The result of one call."""
    return use(server, lambda client: client.call_tool(name, arguments))


def test_every_tool_has_a_schema_and_only_reads(server):
    tools = use(server, lambda client: client.list_tools()).tools
    assert {tool.name for tool in tools} == {"changes", "find", "history", "objects", "locate", "measure", "render"}
    for tool in tools:
        assert tool.annotations.read_only_hint
        assert "field" in tool.input_schema["properties"]


def test_the_tools_answer(server):
    assert call(server, "objects").structured_content["count"] == 6
    top = call(server, "locate", text="the leftmost red mug").structured_content["top"]
    assert top == pytest.approx([-0.5, 0, 0.1], abs=0.02)
    way = call(server, "measure", a="dark blue box", b="dark green bottle", field="table").structured_content
    assert way["centers"] == pytest.approx(0.6, rel=0.05)
    (image,) = call(server, "render", text="dark blue box").content
    assert cv2.imdecode(np.frombuffer(base64.b64decode(image.data), np.uint8), 1).shape == (80, 100, 3)


@pytest.mark.parametrize(("name", "arguments", "words"), [
    ("find", {"text": "red mug", "field": "../etc"}, "no such field"), ("changes", {"later": "x"}, "no such field"),
    ("find", {"text": " "}, "pattern"),
    ("find", {"text": "the meaning of life"}, "colour"), ("find", {"text": "word " * 200}, "at most"),
    ("locate", {"text": "red mug"}, "names 2 objects"), ("measure", {"a": "red mug"}, "b"),
    ("render", {"text": "red mug", "frame": "#99"}, "no such frame"),
])  # fmt: skip
def test_odd_calls_are_errors_that_say_what_to_change(server, name, arguments, words):
    result = call(server, name, **arguments)
    assert result.is_error
    assert words in result.content[0].text


def test_it_answers_before_its_fields_are_open_and_a_call_waits(server, monkeypatch):
    """Progress comes while a call waits; a field that fails is the error of its calls alone."""
    monkeypatch.setattr(mcp_server, "PROGRESS_SECONDS", 0.05)
    scenes = {"slow": Future(), "broken": Future()}
    progress = []

    async def heard(done, total, message):
        progress.append(message)
        if len(progress) == 2:
            scenes["slow"].set_result(Scene(*table_field(), name="slow"))
            scenes["broken"].set_exception(InputError("broken", "no room", remedy="Make some."))

    async def ask():
        async with Client(make_server(scenes)) as client:
            assert client.server_info.version == jsecon.__version__
            assert len((await client.list_tools()).tools) == 7
            arguments = {"text": "red mug"}
            slow = await client.call_tool("find", arguments, progress_callback=heard)
            return slow, await client.call_tool("find", arguments | {"field": "broken"})

    slow, broken = asyncio.run(ask())
    assert slow.structured_content["field"] == "slow"
    assert len(progress) >= 2
    assert "being opened" in progress[0]
    assert broken.is_error
    assert "broken: no room. Make some." in broken.content[0].text


def test_it_starts_without_jax_and_refuses_what_is_no_field_before_the_protocol(tmp_path):
    (tmp_path / "a.json").write_text("{}")
    program = (
        "import sys\n"
        "from jsecon.app import cli\n"
        "code = cli.main(sys.argv[1:])\n"
        "sys.exit(code if 'jax' not in sys.modules and 'jsecon.app.mcp_server' in sys.modules else 1)"
    )
    command = [sys.executable, "-c", program, "mcp", str(tmp_path / "a.json")]
    done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    assert (done.returncode, done.stdout) == (2, "")
    assert "a file of another kind, expected a field" in done.stderr


def test_over_standard_input_and_output(tmp_path):
    (tmp_path / "table").mkdir()
    save_field(tmp_path / "table" / "field.safetensors", table_field()[0])
    (tmp_path / "cut.safetensors").write_bytes((tmp_path / "table" / "field.safetensors").read_bytes()[:5000])
    line = ["-m", "jsecon", "mcp", str(tmp_path / "cut.safetensors"), str(tmp_path / "table")]

    async def ask():
        async with Client(StdioServerParameters(command=sys.executable, args=line)) as client:
            text = {"text": "white"}
            return [await client.call_tool("find", text | {"field": name}) for name in ("cut", "table")]

    cut, table = asyncio.run(ask())
    assert cut.is_error
    assert "damaged" in cut.content[0].text
    assert table.structured_content["count"] > 0
