"""The server for language models, driven by the SDK's own client, in the process and over standard input and output."""

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

TOOLS = {"find", "objects", "locate", "measure", "render"}


@pytest.fixture(scope="module")
def server():
    return make_server({"table": Scene(*table_field(), name="table")})


def call(server, name, **arguments):
    """The result of one call."""

    async def ask():
        async with Client(server) as client:
            return await client.call_tool(name, arguments)

    return asyncio.run(ask())


def test_every_tool_has_a_schema_and_only_reads(server):
    async def ask():
        async with Client(server) as client:
            return (await client.list_tools()).tools

    tools = asyncio.run(ask())
    assert {tool.name for tool in tools} == TOOLS
    for tool in tools:
        assert tool.annotations.read_only_hint
        assert tool.description
        assert "field" in tool.input_schema["properties"]
    assert set(next(t for t in tools if t.name == "measure").input_schema["required"]) == {"a", "b"}


def test_the_tools_answer(server):
    answers = {
        "find": {"text": "the red mug left of the dark green bottle", "frame": "frame_0"},
        "objects": {},
        "locate": {"text": "the leftmost red mug"},
        "measure": {"a": "dark blue box", "b": "dark green bottle", "field": "table"},
    }
    told = {name: call(server, name, **arguments) for name, arguments in answers.items()}
    assert not any(result.is_error for result in told.values()), told
    values = {name: result.structured_content for name, result in told.items()}
    assert values["find"]["objects"] == len(values["find"]["relation"]["objects"]) == 1
    assert values["find"]["count"] > 100
    assert values["objects"]["count"] == len(values["objects"]["objects"]) == 6
    assert values["locate"]["top"] == pytest.approx([-0.5, 0, 0.1], abs=0.02)
    assert values["measure"]["centers"] == pytest.approx(0.6, rel=0.05)
    assert len(str(values["find"])) < 4000
    assert call(server, "find", text="how many red mugs").structured_content["objects"] == 2
    (image,) = call(server, "render", text="dark blue box").content
    assert cv2.imdecode(np.frombuffer(base64.b64decode(image.data), np.uint8), 1).shape == (80, 100, 3)


@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("find", {"text": "red mug", "field": "../etc"}, "no such field"),
        ("find", {"text": " "}, "pattern"),
        ("find", {"text": "the meaning of life"}, "colour"),
        ("find", {"text": "word " * 200}, "at most"),
        ("find", {"text": "the leftmost red mug", "frame": "nowhere"}, "no such frame"),
        ("locate", {"text": "two red mugs"}, "names 2 objects"),
        ("locate", {"text": "red mug"}, "names 2 objects"),
        ("measure", {"a": "red mug", "b": "dark blue box"}, "names 2 objects"),
        ("measure", {"a": "red mug"}, "b"),
        ("render", {"text": "red mug", "frame": "#99"}, "no such frame"),
    ],
)
def test_odd_calls_are_errors_that_say_what_to_change(server, name, arguments, words):
    result = call(server, name, **arguments)
    assert result.is_error
    assert words in result.content[0].text


def test_over_standard_input_and_output(tmp_path):
    save_field(tmp_path / "field.safetensors", table_field()[0])
    line = ["-m", "jsecon", "mcp", str(tmp_path / "field.safetensors")]
    result = call(StdioServerParameters(command=sys.executable, args=line), "find", text="how many red mugs")
    assert result.structured_content["objects"] == 2
