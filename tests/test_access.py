"""Who may reach the server and the viewer: names of this machine, tokens, IPv4 and IPv6."""

import socket

import pytest

from jsecon.app.access import is_allowed_host, listen, token_for
from jsecon.errors import InputError


@pytest.mark.parametrize(("header", "fits"), [
    ("127.0.0.1:8765", True), ("localhost", True), ("LOCALHOST.:80", True), ("[::1]:8765", True),
    ("127.9.9.9", True), ("box.lan:1", False), ("[fe80::2]:5", False), ("evil.example:8765", False),
    ("localhost.evil.example", False), ("127.0.0.1.evil.example", False), ("evil.example@", False), ("", False),
    ("[::1", False), ("0.0.0.0", False),
])  # fmt: skip
def test_only_names_of_this_machine_are_taken(header, fits):
    assert is_allowed_host(header) == fits


def test_beyond_loopback_a_token_is_needed(monkeypatch):
    monkeypatch.delenv("JSECON_TOKEN", raising=False)
    for host in ("::1", "[::1]", "localhost"):
        assert token_for(host, "") == ""
    for host in ("0.0.0.0", "::", "192.168.0.3", "box"):
        with pytest.raises(InputError, match="--token"):
            token_for(host, "")
    assert token_for("0.0.0.0", "a") == "a"
    monkeypatch.setenv("JSECON_TOKEN", "b")
    assert token_for("0.0.0.0", "") == "b"


def test_addresses_of_both_families_are_listened_on():
    with listen("127.0.0.1", 0) as four:
        assert four.family == socket.AF_INET
        with pytest.raises(InputError, match="in use"):
            listen("127.0.0.1", four.getsockname()[1])
    for host, port in (("no.such.host.invalid", 0), ("a\0b", 0), ("x" * 300, 0), ("127.0.0.1", 70000)):
        with pytest.raises(InputError, match="cannot listen"):
            listen(host, port)
