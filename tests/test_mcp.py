"""The server for language models, driven by the SDK's own client, in the process and over standard input and output.
test_doors.py has its answers."""

import asyncio
import base64
import sys

import cv2
import numpy as np
import pytest

pytest.importorskip("mcp", reason="the extra mcp is not installed")
from mcp import Client, StdioServerParameters
from table_field import table_field

from jsecon.app.mcp_server import make_server
from jsecon.app.scene import Scene
from jsecon.field.field import save_field


@pytest.fixture(scope="module")
def server():
    return make_server({"table": Scene(*table_field(), name="table")})


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
    assert {tool.name for tool in tools} == {"find", "objects", "locate", "measure", "render"}
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
    ("find", {"text": "red mug", "field": "../etc"}, "no such field"), ("find", {"text": " "}, "pattern"),
    ("find", {"text": "the meaning of life"}, "colour"), ("find", {"text": "word " * 200}, "at most"),
    ("find", {"text": "the leftmost red mug", "frame": "nowhere"}, "no such frame"),
    ("locate", {"text": "red mug"}, "names 2 objects"), ("measure", {"a": "red mug"}, "b"),
    ("measure", {"a": "red mug", "b": "dark blue box"}, "names 2 objects"),
    ("render", {"text": "red mug", "frame": "#99"}, "no such frame"),
])  # fmt: skip
def test_odd_calls_are_errors_that_say_what_to_change(server, name, arguments, words):
    result = call(server, name, **arguments)
    assert result.is_error
    assert words in result.content[0].text


def test_over_standard_input_and_output(tmp_path):
    save_field(tmp_path / "field.safetensors", table_field()[0])
    line = ["-m", "jsecon", "mcp", str(tmp_path / "field.safetensors")]
    result = call(StdioServerParameters(command=sys.executable, args=line), "find", text="white")
    assert result.structured_content["count"] > 0
